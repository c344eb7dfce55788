"""Refinement under failures: generated scenes with each of them planted, before and after, and what the covariance is worth."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.alternatives import find_alternatives
from physpose_torch.bench.scenes import make_config
from physpose_torch.bench.training_scenes import household_symmetries
from physpose_torch.bop.harm import NOTABLE, RESAMPLES, share
from physpose_torch.bop.pose_error import mssd
from physpose_torch.commands.common import progress, table
from physpose_torch.config import Calibration, RefinerConfig
from physpose_torch.demo import household_bodies
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.household import household_scene, perturb_like_estimator
from physpose_torch.losses import acting
from physpose_torch.planted import FAILURES, Estimated, Failure, Planted
from physpose_torch.refiner import PhysPoseRefiner, silent_doubts
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene

__all__ = ["StressOptions", "coverage", "run_stress"]

PLANE_SIGMA = 0.002
"""[m]; what a plane is said to be known to where nobody says."""
SCORES = (0.5, 1.0)
"""Estimates have scores between these."""
THRESHOLDS = np.arange(0.05, 0.51, 0.05)
"""Of the recall, in shares of an object's diameter."""
MUCH = 3e-3
"""[m]"""
CHI2 = {3: 7.815, 6: 12.592}
"""95 % quantiles of χ²."""
ERRORS = Calibration(
    depth_factor=1 / 1.024,
    sigma_ray_fraction=0.01,
    sigma_lateral=0.003,
    sigma_rotation=float(np.radians(2.5)),
    sigma_depth_common=0.005,
)
"""What the generated estimates are like: a common bias of 2.4 %."""


@dataclass(frozen=True)
class StressOptions:
    """What is tried."""

    seeds: int = 50
    """Generated scenes, numbered from the seed on."""
    presets: tuple[str, ...] = ("paper", "default")
    """default, lm, paper, or several of them."""


class _Trial(NamedTuple):
    """An image of estimates, and the truth about those that have one."""

    scene: Scene
    poses: Tensor
    scores: Tensor
    rows: Tensor
    """(K,) estimates that act and that an object is matched with."""
    truth: Tensor
    """(K, 4, 4)."""
    known: Scene
    """The scene with the true plane."""


def run_stress(results: dict[str, Any], options: StressOptions, seed: int) -> None:
    """Try every failure on every scene, print tables, add rows to the results.

    Raises:
        InvalidInputError: an option is out of range.
    """
    if options.seeds < 1 or not options.presets:
        raise InvalidInputError(f"--seeds {options.seeds}, --presets {options.presets}: expected at least one of each")
    configs = {preset: make_config(preset, "auto") for preset in options.presets}
    bodies = household_bodies()
    failures: list[Failure | None] = [None, *FAILURES]
    numbers = range(seed, seed + options.seeds)
    results["stress"] = []
    with progress(len(failures) * len(configs), "stress", "table", quiet=False) as bar:
        bar.leave = False
        for failure in failures:
            trials = [t for n in numbers if (t := _trial(n, failure, bodies)) is not None]
            for preset, config in configs.items():
                label = failure.label if failure else "nothing"
                results["stress"].append({"failure": label, "preset": preset} | _row(trials, config, seed))
                bar.update()
    print(f"\n{options.seeds} generated scenes from seed {seed}: recall of MSSD, in thousandths; objects in percent")
    print(_table(results["stress"]))
    print("\nErrors of refined poses within the 95 % ellipsoids of Refinement.covariance")
    results["coverage"] = []
    default = RefinerConfig()
    for name, config in {"usual σ": default, "calibrated": default.calibrated(ERRORS)}.items():
        found = coverage(numbers, config, bodies)
        results["coverage"].append({"config": name} | found)
        shares = ", ".join(f"{key} {100 * found[key]:.0f} %" for key in ("pose", "translation", "rotation"))
        print(f"{name}: {shares} of {found['objects']} objects; mean of squared Mahalanobis distances / 6: {found['mean']:.2f}")


def _estimated(number: int, bodies: dict[str, Body]) -> Estimated:
    """Estimates of a generated scene with an RGB estimator's errors, all matched with the truth."""
    truth = household_scene(number)
    objects = tuple(bodies[n] for n in truth.names)
    sigma = torch.diag(torch.tensor([0.0, 0.0, PLANE_SIGMA**2], dtype=torch.float64))
    plane = Plane(truth.normal, torch.tensor(truth.offset, dtype=torch.float64), sigma)
    poses = perturb_like_estimator(truth.T_camera_object, seed=number)
    scores = SCORES[0] + (SCORES[1] - SCORES[0]) * torch.rand(
        len(objects), generator=torch.Generator().manual_seed(number), dtype=torch.float64
    )
    absent = tuple(body for name, body in bodies.items() if name not in truth.names)
    everyone = torch.arange(len(objects))
    return Estimated(poses, scores, Scene.tabletop(objects, plane), truth.T_camera_object, objects, everyone, absent)


def _trial(number: int, failure: Failure | None, bodies: dict[str, Body]) -> _Trial | None:
    image = _estimated(number, bodies)
    n = len(image.poses)
    untouched = Planted(image.poses, image.scores, image.scene, torch.arange(n), torch.zeros(n, dtype=torch.bool))
    planted = failure.plant(image, torch.Generator().manual_seed(number)) if failure else untouched
    if planted is None:
        return None
    same = find_alternatives(planted.poses, planted.scene, planted.scores)
    made = planted.scene
    scene = Scene(made.objects, made.statics, gravity=made.gravity, same_object=same)
    known = Scene(made.objects, image.scene.statics, gravity=image.scene.gravity, same_object=same)
    exact = failure is not None and failure.name == "accurate"
    source = torch.arange(len(planted.poses)) if exact else planted.source
    rows = ((source >= 0) & acting(scene, planted.scores)).nonzero()[:, 0]
    return _Trial(scene, planted.poses, planted.scores, rows, image.true_poses[source[rows]], known)


def _row(trials: list[_Trial], config: RefinerConfig, seed: int) -> dict[str, Any]:
    refiner = PhysPoseRefiner(config)
    before, after, image, figures = [], [], [], []
    for start in range(0, len(trials), 16):
        some = trials[start : start + 16]
        scene = Scene.cat([t.scene for t in some])
        poses, scores = torch.cat([t.poses for t in some]), torch.cat([t.scores for t in some])
        with silent_doubts():
            refined = refiner(poses, scene, scores=scores).poses
        report = physics_report(refined, Scene.cat([t.known for t in some]), scores=scores)
        sizes = np.cumsum([0, *(len(t.poses) for t in some)])
        for k, (trial, first, last) in enumerate(zip(some, sizes[:-1], sizes[1:], strict=True)):
            for errors, T in ((before, trial.poses), (after, refined[first:last])):
                errors += [_error(trial, int(r), T[r], truth) for r, truth in zip(trial.rows, trial.truth, strict=True)]
            image += [start + k] * len(trial.rows)
            at = trial.rows + int(first)
            figures += torch.stack([report.penetration[at], report.gap[at], report.stable[at].double()], dim=1).tolist()
    before, after, image = np.array(before), np.array(after), np.array(image)
    diameter = before[:, 1:] * THRESHOLDS
    gain = (after[:, :1] < diameter).mean(1) - (before[:, :1] < diameter).mean(1)
    grown = after[:, 0] - before[:, 0]
    figures = np.array(figures)
    low, high = _interval(gain, image, seed)
    return {
        "scenes": len(trials),
        "objects": len(gain),
        "recall_before": float((before[:, :1] < diameter).mean()),
        "change": {"value": float(gain.mean()), "low": low, "high": high},
        "worse": share(grown > NOTABLE, image, seed=seed)._asdict(),
        "better": share(grown < -NOTABLE, image, seed=seed)._asdict(),
        "inside_3mm": float((figures[:, 0] > MUCH).mean()),
        "above_3mm": float((figures[:, 1] > MUCH).mean()),
        "stable": float(figures[:, 2].mean()),
    }


def _error(trial: _Trial, row: int, T: Tensor, truth: Tensor) -> tuple[float, float]:
    """MSSD of a pose, and the object's diameter [m]."""
    body = trial.scene.objects[row]
    hull = torch.from_numpy(np.asarray(body.mesh.convex_hull.vertices)).double()
    error = mssd(T, truth, hull, household_symmetries(body.label))
    return float(error), float(torch.cdist(hull, hull).max())


def _interval(values: np.ndarray, image: np.ndarray, seed: int) -> tuple[float, float]:
    """95 % interval of a mean, by drawing images with replacement."""
    total = np.bincount(image, minlength=image.max() + 1)
    sums = np.bincount(image, weights=values, minlength=len(total))
    drawn = np.random.default_rng(seed).integers(len(total), size=(RESAMPLES, len(total)))
    low, high = np.quantile(sums[drawn].sum(1) / total[drawn].sum(1), [0.025, 0.975]).tolist()
    return low, high


def coverage(numbers: range, config: RefinerConfig, bodies: dict[str, Body]) -> dict[str, Any]:
    """How many errors of refined poses lie within the ellipsoids that their covariance says 95 % lie in.

    Estimates that were left as they were, or turned to stand, are not counted.
    """
    refiner, squares = PhysPoseRefiner(config), []
    for trial in (_trial(n, None, bodies) for n in numbers):
        with silent_doubts():
            result = refiner(trial.poses, trial.scene, scores=trial.scores)
        error = se3.residual(result.poses[trial.rows], trial.truth)
        covariance = result.covariance[trial.rows]
        counts = ~(result.rejected | result.unsupported | result.righted | result.doubted[result.image])[trial.rows]
        for part in (slice(0, 6), slice(0, 3), slice(3, 6)):
            e, C = error[counts][:, part], covariance[counts][:, part, part]
            squares.append((part, (e * torch.linalg.solve(C, e)).sum(1)))
    whole, t, r = (
        torch.cat([x for p, x in squares if p == part]) for part in (slice(0, 6), slice(0, 3), slice(3, 6))
    )
    within = {"pose": (whole, 6), "translation": (t, 3), "rotation": (r, 3)}
    shares = {name: float((x < CHI2[k]).double().mean()) for name, (x, k) in within.items()}
    return {"objects": len(whole), "mean": float(whole.mean()) / 6} | shares


def _table(rows: list[dict[str, Any]]) -> str:
    head = ["planted, preset", "scenes", "recall", "change [95 %]", "worse [95 %]", "better", "> 3 mm in", "above", "stable"]
    return table(head, list(_cells(rows)))


def _cells(rows: list[dict[str, Any]]) -> Iterator[list[str]]:
    for r in rows:
        change, worse = r["change"], r["worse"]
        yield [
            f"{r['failure']}, {r['preset']}",
            str(r["scenes"]),
            f"{1000 * r['recall_before']:.0f}",
            f"{1000 * change['value']:+.0f} [{1000 * change['low']:+.0f}, {1000 * change['high']:+.0f}]",
            f"{100 * worse['value']:.1f} [{100 * worse['low']:.0f}, {100 * worse['high']:.0f}]",
            f"{100 * r['better']['value']:.0f}",
            *(f"{100 * r[key]:.0f}" for key in ("inside_3mm", "above_3mm", "stable")),
        ]
