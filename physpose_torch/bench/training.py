"""Does :class:`~physpose_torch.losses.PhysicsLoss` help a pose network that trains on rendered scenes, and at what price?

A small render-and-compare refiner sees the crop of an object in a photograph and the object rendered at a coarse pose, and
predicts how to move it. It never sees the table: physics acts through the loss alone. Every row of the table is a network of
its own, by the same data, initial weights, order and noise as its neighbours in that seed; tested on scenes it has not seen.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.bench.pose_network import PoseTrainer, predict, surface_points, symmetric_truth
from physpose_torch.bench.training_scenes import LABELS, PoseSamples, household_symmetries, pose_samples
from physpose_torch.bop.pose_error import mssd
from physpose_torch.commands.common import progress, table
from physpose_torch.config import PhysicsConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.refiner import PhysPoseRefiner, silent_doubts
from physpose_torch.report import physics_report

__all__ = ["MEASURES", "TrainingOptions", "evaluate", "run_training", "training_table"]

DEEP = 3e-3
"""[m]; penetrations and gaps above this are counted."""
DRAWS = 4
"""Coarse poses of each scene to train on."""
TEST_SEED = 10_000_000
"""Scenes to test on, the same for all seeds, start at this seed; those to train on are all below."""
MEASURES = {
    "inside_mm": "inside [mm]",
    "inside_share": "> 3 mm [%]",
    "gap_mm": "above [mm]",
    "gap_share": "> 3 mm [%]",
    "ray_mm": "ray [mm]",
    "lateral_mm": "across [mm]",
    "rotation_deg": "turn [deg]",
    "mssd_mm": "MSSD [mm]",
}
"""What is measured, and its column."""


def evaluate(poses: Tensor, data: PoseSamples, bodies: Mapping[str, Body]) -> dict[str, float]:
    """Means over all objects: physics by the report, errors against the truth; keys of :data:`MEASURES`.

    Args:
        poses: T_camera_object (M, 4, 4) [m].
        data: the samples.
        bodies: of all labels.
    """
    report = physics_report(poses, data.scene(range(len(data))))
    gap = torch.where(report.gap.isfinite(), report.gap, 0.0)
    truth = symmetric_truth(poses, data.truth, data.label)
    ray = torch.nn.functional.normalize(truth[:, :3, 3], dim=1)
    moved = poses[:, :3, 3] - truth[:, :3, 3]
    along = (moved * ray).sum(1)
    turn = torch.linalg.vector_norm(se3.log_so3(truth[:, :3, :3].mT @ poses[:, :3, :3]), dim=1)
    surface = torch.zeros(len(poses), dtype=torch.float64)
    for i, name in enumerate(LABELS):
        of = data.label == i
        hull = torch.tensor(bodies[name].mesh.convex_hull.vertices, dtype=torch.float64)
        surface[of] = mssd(poses[of].double(), data.truth[of].double(), hull, household_symmetries(name))
    values = {
        "inside_mm": 1e3 * report.penetration,
        "inside_share": 100.0 * (report.penetration > DEEP),
        "gap_mm": 1e3 * gap,
        "gap_share": 100.0 * (gap > DEEP),
        "ray_mm": 1e3 * along.abs(),
        "lateral_mm": 1e3 * torch.linalg.vector_norm(moved - along[:, None] * ray, dim=1),
        "rotation_deg": torch.rad2deg(turn),
        "mssd_mm": 1e3 * surface,
    }
    return {name: float(x.double().mean()) for name, x in values.items()}


@dataclass(frozen=True)
class TrainingOptions:
    """What is trained, how often."""

    seeds: int = 5
    """Runs of everything, each with other scenes to train on, coarse poses, initial weights, order and noise."""
    scenes: int = 128
    """Scenes to train on, four coarse poses each."""
    test_scenes: int = 40
    """Scenes to test on, two coarse poses each."""
    labelled: int = 8
    """Scenes whose labels are known in the rows with few labels; the others are seen without."""
    steps: int = 600
    """Steps of training."""
    weights: tuple[float, ...] = (0.1,)
    """Of the physics term: its mean over objects, against a supervised loss in centimetres."""
    gravity_weight: float = 700.0
    """Weight of gravity within the physics term [1/m]; that of collisions is 700 / m. With the 200 of the refiner, which has
    estimates to hold on to, networks learn to let objects float."""


def run_training(results: dict[str, Any], options: TrainingOptions, seed: int) -> None:
    """Train and test everything for each seed, print one table, and add to the results."""
    from physpose_torch.demo import household_bodies

    for name in ("seeds", "scenes", "test_scenes", "labelled", "steps"):
        if getattr(options, name) < 1:
            raise InvalidInputError(f"--{name.replace('_', '-')} {getattr(options, name)}: expected at least 1")
    if options.labelled > options.scenes or not all(w > 0 and math.isfinite(w) for w in options.weights):
        raise InvalidInputError(
            f"--labelled {options.labelled}, --weights {options.weights}: expected at most --scenes {options.scenes} and "
            "positive numbers"
        )
    bodies = household_bodies()
    points = surface_points(bodies)
    trainer = PoseTrainer(steps=options.steps, physics=PhysicsConfig(gravity_weight=options.gravity_weight))
    test = pose_samples(range(TEST_SEED, TEST_SEED + options.test_scenes), bodies, draws=2, seed=TEST_SEED)
    scene = test.scene(range(len(test)))
    plans = _plans(options)
    rows = [{"seed": None, "name": "coarse poses", **evaluate(test.coarse, test, bodies)}]
    with progress(options.seeds * len(plans), "training", "network") as bar:
        for s in range(seed, seed + options.seeds):
            data = pose_samples(range(s * 10_000, s * 10_000 + options.scenes), bodies, draws=DRAWS, seed=s)
            for name, arguments in plans.items():
                poses = predict(trainer(data, points, seed=s, **arguments), test)
                rows.append({"seed": s, "name": name, **evaluate(poses, test, bodies)})
                if name == "labels":
                    with silent_doubts():
                        refined = PhysPoseRefiner()(poses, scene).poses
                    rows.append({"seed": s, "name": "labels, then refined", **evaluate(refined, test, bodies)})
                bar.update()
    results["training"] = rows
    print(training_table(rows))


def _plans(options: TrainingOptions) -> dict[str, dict[str, Any]]:
    """What to train with, by the name of its row."""
    everything, few = range(options.scenes * DRAWS), range(options.labelled * DRAWS)
    rest = range(options.labelled * DRAWS, options.scenes * DRAWS)
    plans: dict[str, dict[str, Any]] = {"labels": {"labelled": everything}}
    for w in options.weights:
        plans[f"labels + {w:g} physics"] = {"labelled": everything, "weight": w}
    if len(rest):
        plans["few labels"] = {"labelled": few}
        for w in options.weights:
            plans[f"few labels + {w:g} physics on all"] = {"labelled": few, "weight": w, "unlabelled": rest}
    return plans


def training_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Mean ± standard deviation over the seeds, a line for each kind of training."""
    lines = []
    for name in dict.fromkeys(row["name"] for row in rows):
        own = [row for row in rows if row["name"] == name]
        lines.append([name, *(_spread([row[key] for row in own]) for key in MEASURES)])
    return table(["", *MEASURES.values()], lines)


def _spread(values: Sequence[float]) -> str:
    mean = f"{statistics.fmean(values):.2f}"
    return mean if len(values) < 2 else f"{mean} ± {statistics.stdev(values):.2f}"
