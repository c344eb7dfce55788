"""``physpose refine``: BOP result CSV in, refined BOP result CSV out."""

import json
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from physpose_torch.bop.formats import Estimates, write_estimates
from physpose_torch.bop.scenes import ImageScene, poses_of
from physpose_torch.commands.common import check_output, describe, progress
from physpose_torch.commands.images import ImageOptions, in_batches, together
from physpose_torch.config import RefinerConfig
from physpose_torch.refiner import PhysPoseRefiner, Refinement, silent_doubts
from physpose_torch.report import PhysicsReport, physics_report
from physpose_torch.scene import Scene

__all__ = ["Refine"]

logger = logging.getLogger("physpose_torch")


@dataclass(frozen=True, kw_only=True)
class Refine(ImageOptions):
    """Refine the poses of a BOP result file so that they are physically consistent.

    All rows, their order and scores are kept; the time spent is added to the time column. Images that cannot be refined
    (bad rows, no plane, unknown objects) keep their poses, are listed at the end, and the exit code is 1. Images that
    --scenes and --every leave out are copied as they are.

    Poses that physics contradicts too much to be put right are left as they are, as are objects with nothing below them and
    images whose objects together contradict their plane; --json lists them row by row.
    """

    out: Path
    """Result file to write."""
    preset: str = "default"
    """default; lm: the same cost by fifteen Gauss-Newton steps; or paper: the paper's cost and gradient descent."""
    calibration: Path | None = None
    """The estimator's bias and spread, by physpose calibrate; without: what RGB estimators are usually like."""
    config: RefinerConfig = field(default_factory=RefinerConfig)
    """Single options, starting from preset and calibration."""
    json: Path | None = None
    """Write penetration and gap before and after, and what could not be refined, to this file."""
    quiet: bool = False
    """No progress bar and no summary."""

    def __call__(self) -> int:
        check_output(self.json, self.out)
        estimates, _, total, todo = self.open()
        refiner = PhysPoseRefiner(self.config)
        poses = estimates.T_camera_object.clone()
        seconds = np.zeros(len(estimates))
        before, after, moved = _Summary(), _Summary(), _Summary()
        images: list[ImageScene] = []
        righted = 0
        left: dict[str, list[int]] = {"rejected": [], "unsupported": [], "doubted": []}
        doubts: list[str] = []
        with progress(total, "refine", "image", quiet=self.quiet) as bar:
            for batch in in_batches(todo, self.batch):
                for group in together(batch, lambda images: _refine(images, estimates, refiner)):
                    rows = np.concatenate([i.rows for i in group.images])
                    poses[rows] = group.result.poses
                    seconds[rows] = group.seconds / len(group.images)
                    result = group.result
                    before.add(group.before)
                    after.add(result.report)
                    doubted = result.doubted[result.image]
                    flags = {"rejected": result.rejected, "unsupported": result.unsupported, "doubted": doubted}
                    for why, flag in flags.items():
                        left[why] += rows[flag.numpy()].tolist()
                    moved.add(result.report, ~(result.rejected | result.unsupported | doubted))
                    righted += int(result.righted.sum())
                    doubts += [f"{i.name}: {d}" for i, d in zip(group.images, result.doubts, strict=True) if d]
                for image in batch:
                    image.scene = None  # its memory is needed for the next ones
                images += batch
                bar.update(len(batch))
        write_estimates(self.out, estimates, poses, time=seconds)
        problems = [p for i in images for p in i.problems]
        refined = [i for i in images if not i.problems]
        summary = {
            "images": len(images),
            "refined": len(refined),
            "rows": int(sum(len(i.rows) for i in refined)),
            "righted": righted,
            **{why: len(rows) for why, rows in left.items()},
            "seconds_per_image": float(sum(seconds[i.rows[0]] for i in refined) / max(len(refined), 1)),
            "before": before.figures(),
            "after": after.figures(),
            "after_moved": moved.figures(),
            "left": [
                {"line": int(estimates.line[row]), "obj_id": int(estimates.obj_id[row]), "why": why}
                | {"scene_id": int(estimates.scene_id[row]), "im_id": int(estimates.im_id[row])}
                for why, rows in left.items()
                for row in rows
            ],
            "doubts": doubts,
            "problems": problems,
        }
        if self.json is not None:
            self.json.write_text(json.dumps(summary, indent=2) + "\n")
        if not self.quiet:
            print(describe(summary))
        for doubt in doubts:
            logger.warning("%s", doubt)
        for problem in problems:
            logger.error(problem)
        return 1 if problems else 0


@dataclass
class _Group:
    images: Sequence[ImageScene]
    result: Refinement
    seconds: float
    before: PhysicsReport


def _refine(images: Sequence[ImageScene], estimates: Estimates, refiner: PhysPoseRefiner) -> _Group:
    start = time.perf_counter()
    scene = Scene.cat([i.scene for i in images])
    measured, scores = poses_of(images, estimates)
    before = physics_report(measured, scene, scores=scores, backend=refiner.config.physics.backend)
    with silent_doubts():  # told by the names of their images
        result = refiner(measured, scene, scores=scores)
    return _Group(images, result, time.perf_counter() - start, before)


class _Summary:
    """Penetrations and gaps of many images."""

    def __init__(self) -> None:
        self.penetration: list[torch.Tensor] = []
        self.gap: list[torch.Tensor] = []

    def add(self, report: PhysicsReport, chosen: torch.Tensor | None = None) -> None:
        """Those of the objects that are ``chosen`` (N,); None: all."""
        gap = report.gap if chosen is None else report.gap[chosen]
        self.penetration.append(report.penetration if chosen is None else report.penetration[chosen])
        self.gap.append(gap[gap.isfinite()])

    def figures(self) -> dict[str, float]:
        deep = torch.cat([torch.zeros(0, dtype=torch.float64), *self.penetration]) * 1e3
        gap = torch.cat([torch.zeros(0, dtype=torch.float64), *self.gap]) * 1e3
        return {
            "penetration_mean_mm": _mean(deep),
            "penetration_p95_mm": _quantile(deep, 0.95),
            "penetrating_3mm": _mean((deep > 3).double()),
            "gap_mean_mm": _mean(gap),
            "gap_p95_mm": _quantile(gap, 0.95),
            "floating_3mm": _mean((gap > 3).double()),
        }


def _mean(x: torch.Tensor) -> float:
    return float(x.mean()) if len(x) else 0.0


def _quantile(x: torch.Tensor, q: float) -> float:
    return float(torch.quantile(x, q)) if len(x) else 0.0
