"""The paper's grasping test on generated scenes: how often a gripper sent to estimated and to refined poses gets hold.

Every scene is arranged, seen by a camera, and estimated with the errors of an RGB estimator. Objects have handles, made by
hand for each shape: points 5 mm below the edge of the surface that the pads close on. A trial is an object that can be grasped
where it truly is; its first handle that can be is taken, and tried at the estimated pose and at every refined one. Objects
that cannot be grasped from above at all (a plate, a box on its broad side, what carries another object) are no trials.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.ablation import as_estimated, scale_depth, slide_onto_planes
from physpose_torch.commands.common import progress, table
from physpose_torch.config import RefinerConfig
from physpose_torch.demo import household_bodies
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.household import HouseholdScene, household_meshes, household_scene, perturb_like_estimator
from physpose_torch.refiner import PhysPoseRefiner, silent_doubts
from physpose_torch.robot.grasp import OUTCOMES, Handle, grasp_pose, judge_grasps
from physpose_torch.scene import Scene

__all__ = ["GraspOptions", "bootstrap", "household_handles", "run_grasps", "wilson"]

INSIDE = 0.005
"""[m]; how far below the edge of the surface the tips go, as in the paper."""
UPRIGHT = math.cos(math.radians(5))
TOP_HEIGHT = 0.8
"""[m]; of the camera that looks straight down, above the table."""
RESAMPLES = 10_000
Z95 = 1.959964
"""Two-sided 95 % quantile of the normal distribution."""


@dataclass(frozen=True)
class GraspOptions:
    """How many scenes, seen how, estimated how badly."""

    seeds: int = 50
    """Scenes; the first has the number --seed."""
    views: tuple[Literal["oblique", "top"], ...] = ("oblique", "top")
    """Cameras: 35° above the table, or straight down as on the paper's gripper."""
    bias: tuple[float, ...] = (0.024, -0.024)
    """Common relative errors of all distances: what an RGB estimator showed on YCB-V, and the same the other way."""
    inside: float = INSIDE
    """How far below the edge of a surface the finger tips are sent [m]."""


@cache
def household_handles(inside: float = INSIDE) -> dict[str, tuple[Handle, ...]]:
    """Handles of the household objects, by hand, in the order in which they are tried.

    Args:
        inside: how far the tips go below the edge of the surface that the pads close on [m].
    """
    bounds = {name: mesh.bounds for name, mesh in household_meshes().items()}
    out: dict[str, tuple[Handle, ...]] = {name: () for name in bounds}

    def around(name: str, height: float, width: float, radius: float, axis: float, turns: Sequence[int]) -> None:
        """Handles at some angles [deg] around an upright axis at (axis, 0); ``height`` is that of the edge above the foot."""
        z = float(bounds[name][0, 2]) + height - inside
        found = []
        for turn in turns:
            c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
            found.append(Handle(f"{turn}°", (axis + radius * c, radius * s, z), (c, s, 0.0), width))
        out[name] = tuple(found)

    around("can", 0.099, 0.068, 0.0, 0.0, (0, 45, 90, 135))
    around("bottle", 0.184, 0.033, 0.0, 0.0, (0, 45, 90, 135))
    around("bowl", 0.0554, 0.005, 0.0727, 0.0, range(0, 360, 45))
    around("mug", 0.0895, 0.004, 0.039, float(bounds["mug"][0, 0]) + 0.041, (180, 90, 270, 135, 225))
    top = float(bounds["box"][1, 2]) - inside
    out["box"] = tuple(Handle(f"{1e3 * x:+.0f} mm", (x, 0.0, top), (0.0, 1.0, 0.0), 0.06) for x in (0.0, 0.04, -0.04))
    # a banana lies: the pads must reach beyond its widest line
    out["banana"] = (Handle("middle", (0.0, float(bounds["banana"][1, 1]) - 0.018, -inside), (0.0, 1.0, 0.0), 0.036),)
    return out


def run_grasps(
    results: dict[str, Any], options: GraspOptions, seed: int, bodies: dict[str, Body] | None = None
) -> None:
    """Try every object of every scene, print a table, add rows to the results.

    Raises:
        InvalidInputError: an option is out of range.
    """
    if options.seeds < 1 or not options.views or not options.bias:
        raise InvalidInputError("--seeds, --views, --bias: expected at least one of each")
    if not 0 < options.inside < 0.02:
        raise InvalidInputError(f"--inside {options.inside}: expected metres between 0 and 0.02")
    if any(not -0.5 < b < 0.5 for b in options.bias):
        raise InvalidInputError(f"--bias {options.bias}: expected fractions, 0.024 for 2.4 percent")
    bodies = bodies or household_bodies()
    groups = [(view, bias) for view in options.views for bias in options.bias]
    rows: list[dict[str, Any]] = []
    with progress(options.seeds * len(groups), "grasps", "scene") as bar:
        for number in range(seed, seed + options.seeds):
            truth = household_scene(number)
            for view, bias in groups:
                rows += _scene_rows(truth, bodies, number, view, bias, options.inside)
                bar.update()
    results["grasps"] = rows
    results["grasp_summary"] = []
    for view, bias in groups:
        chosen = [r for r in rows if r["view"] == view and r["bias"] == bias]
        objects = {r["object"] for r in chosen}
        print(
            f"\n{options.seeds} scenes from seed {seed}, {view} view, distances {100 * bias:+.1f} %: "
            f"{len({(r['seed'], r['object']) for r in chosen})} trials"
        )
        print(grasp_table(chosen, seed))
        print(f"refined against initial, points: {_gain(chosen, seed)}")
        print(f"\n{object_table(chosen, [n for n in bodies if n in objects])}", flush=True)
        results["grasp_summary"] += [{"view": view, "bias": bias, **s} for s in summarise(chosen, seed)]


def _scene_rows(
    truth: HouseholdScene, bodies: dict[str, Body], seed: int, view: str, bias: float, inside: float
) -> list[dict[str, Any]]:
    """A row for each trial and method in one scene."""
    T_true, plane = _seen(truth, view)
    objects = [bodies[n] for n in truth.names]
    up = plane.normal
    trials = _feasible(truth.names, T_true, objects, plane, inside)
    if not trials:
        return []
    scene = Scene.tabletop(objects, plane)
    estimates = perturb_like_estimator(T_true, seed=seed, depth_bias=bias)
    rows = []
    for method, run in _methods(bias).items():
        poses = run(estimates, scene)
        T = torch.stack([grasp_pose(handle, poses[i], up) for i, handle in trials])
        outcomes = judge_grasps(T, [h.width for _, h in trials], [i for i, _ in trials], T_true, objects, plane)
        for (i, handle), outcome in zip(trials, outcomes, strict=True):
            off = grasp_pose(handle, poses[i], up)[:3, 3] - grasp_pose(handle, T_true[i], up)[:3, 3]
            rows.append(
                {
                    "seed": seed,
                    "view": view,
                    "bias": bias,
                    "object": truth.names[i],
                    "handle": handle.name,
                    "method": method,
                    "outcome": outcome,
                    "height_mm": 1e3 * float(off @ up),
                    "sideways_mm": 1e3 * float(torch.linalg.vector_norm(off - (off @ up) * up)),
                }
            )
    return rows


def _methods(bias: float) -> dict[str, Callable[[Tensor, Scene], Tensor]]:
    """What is compared; the one factor is the true one, which only a label could tell."""
    refiner = PhysPoseRefiner(RefinerConfig())

    def refined(poses: Tensor, scene: Scene) -> Tensor:
        with silent_doubts():
            return refiner(poses, scene).poses

    return {
        "initial": as_estimated,
        "one depth factor (by label)": partial(scale_depth, factor=1 / (1 + bias)),
        "slid onto the table": slide_onto_planes,
        "refined": refined,
    }


def _seen(truth: HouseholdScene, view: str) -> tuple[Tensor, Plane]:
    """T_camera_object (N, 4, 4) and the table as the camera of this view sees them."""
    T, normal, offset = truth.T_camera_object, truth.normal, torch.tensor(truth.offset, dtype=torch.float64)
    if view == "oblique":
        return T, Plane(normal, offset)
    middle = T[:, :3, 3].mean(0)
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    x = torch.nn.functional.normalize(x - (x @ normal) * normal, dim=0)
    R_old_new = torch.stack([x, torch.linalg.cross(-normal, x), -normal], dim=1)
    foot = middle - (middle @ normal - offset) * normal
    T_new_old = se3.inverse(se3.from_rotation_translation(R_old_new, foot + TOP_HEIGHT * normal))
    up = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    return T_new_old @ T, Plane(up, torch.tensor(-TOP_HEIGHT, dtype=torch.float64))


def _feasible(names, T_true: Tensor, objects, plane: Plane, inside: float) -> list[tuple[int, Handle]]:
    """Of each object the first handle that holds where the object truly is."""
    offered = [
        (i, handle)
        for i, name in enumerate(names)
        for handle in household_handles(inside)[name]
        if float(T_true[i, :3, :3] @ torch.tensor(handle.up, dtype=torch.float64) @ plane.normal) > UPRIGHT
    ]
    if not offered:
        return []
    T = torch.stack([grasp_pose(handle, T_true[i], plane.normal) for i, handle in offered])
    outcomes = judge_grasps(T, [h.width for _, h in offered], [i for i, _ in offered], T_true, objects, plane)
    first: dict[int, Handle] = {}
    for (i, handle), outcome in zip(offered, outcomes, strict=True):
        if outcome == "held":
            first.setdefault(i, handle)
    return list(first.items())


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % interval of a proportion of independent trials (Wilson 1927)."""
    if trials == 0:
        return 0.0, 1.0
    p, z2 = successes / trials, Z95 * Z95
    middle, spread = p + z2 / (2 * trials), Z95 * math.sqrt(p * (1 - p) / trials + z2 / (4 * trials * trials))
    low, high = ((middle + s * spread) / (1 + z2 / trials) for s in (-1, 1))
    return max(low, 0.0), min(high, 1.0)


def bootstrap(successes: Sequence[int], trials: Sequence[int], *, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the share of successes: scenes are drawn with all their trials, which are not independent.

    Args:
        successes: of each scene; of a difference between two methods, those of one less those of the other.
        trials: of each scene.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(trials), size=(RESAMPLES, len(trials)))
    won, tried = (np.asarray(x)[draws].sum(1) for x in (successes, trials))
    low, high = np.quantile(won[tried > 0] / tried[tried > 0], [0.025, 0.975])
    return float(low), float(high)


def summarise(rows: Sequence[dict[str, Any]], seed: int = 0) -> list[dict[str, Any]]:
    """Of each method: share held with its interval over scenes, outcomes, and median errors of the grasp point."""
    out = []
    seeds = sorted({r["seed"] for r in rows})
    for method in dict.fromkeys(r["method"] for r in rows):
        mine = [r for r in rows if r["method"] == method]
        tried = [sum(r["seed"] == s for r in mine) for s in seeds]
        won = [sum(r["seed"] == s and r["outcome"] == "held" for r in mine) for s in seeds]
        out.append(
            {
                "method": method,
                "trials": len(mine),
                "held": sum(won) / len(mine),
                "interval": bootstrap(won, tried, seed=seed),
                "outcomes": {o: sum(r["outcome"] == o for r in mine) for o in OUTCOMES},
                "height_mm_median": float(np.median([r["height_mm"] for r in mine])),
                "sideways_mm_median": float(np.median([r["sideways_mm"] for r in mine])),
            }
        )
    return out


def grasp_table(rows: Sequence[dict[str, Any]], seed: int = 0) -> str:
    """A line for each method: share held, its 95 % interval (bootstrap over scenes), why the others failed."""
    if not rows:
        return "no object could be grasped"
    header = ["poses", "held [%]", "95 %", *OUTCOMES[1:], "height [mm]", "sideways [mm]"]
    cells = []
    for s in summarise(rows, seed):
        low, high = s["interval"]
        counts = [str(s["outcomes"][o]) for o in OUTCOMES[1:]]
        cells.append(
            [
                s["method"],
                f"{100 * s['held']:.1f}",
                f"{100 * low:.0f}–{100 * high:.0f}",
                *counts,
                f"{s['height_mm_median']:+.1f}",
                f"{s['sideways_mm_median']:.1f}",
            ]
        )
    return table(header, cells)


def _gain(rows: Sequence[dict[str, Any]], seed: int) -> str:
    """Difference of the shares held, with its interval over scenes; the same trials on both sides."""
    if not rows:
        return "-"
    seeds = sorted({r["seed"] for r in rows})
    sign = {"refined": 1, "initial": -1}
    more = [sum(sign.get(r["method"], 0) for r in rows if r["seed"] == s and r["outcome"] == "held") for s in seeds]
    tried = [sum(r["method"] == "refined" for r in rows if r["seed"] == s) for s in seeds]
    low, high = bootstrap(more, tried, seed=seed)
    return f"{100 * sum(more) / sum(tried):+.1f} ({100 * low:+.0f} to {100 * high:+.0f})"


def object_table(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> str:
    """Held of each object [%], with Wilson's 95 % interval: an object is once in a scene."""
    methods = list(dict.fromkeys(r["method"] for r in rows))
    cells = []
    for name in names:
        mine = [r for r in rows if r["object"] == name]
        row = [name, str(len({r["seed"] for r in mine}))]
        for method in methods:
            won = [r["outcome"] == "held" for r in mine if r["method"] == method]
            low, high = wilson(sum(won), len(won))
            row.append(f"{100 * sum(won) / len(won):.0f} ({100 * low:.0f}–{100 * high:.0f})")
        cells.append(row)
    return table(["held [%]", "trials", *methods], cells)
