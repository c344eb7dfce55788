"""``physpose refine``: BOP result CSV in, refined BOP result CSV out."""

import json
import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates, read_estimates, read_planes, read_statics, write_estimates
from physpose_torch.bop.scenes import BodyLibrary, ImageScene, image_scenes, poses_of
from physpose_torch.commands.common import describe, progress
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError, PhysPoseError
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import PhysicsReport, physics_report
from physpose_torch.scene import Scene

__all__ = ["Refine"]

logger = logging.getLogger("physpose_torch")


@dataclass(frozen=True)
class Refine:
    """Refine the poses of a BOP result file so that they are physically consistent.

    All rows, their order and scores are kept; the time spent is added to the time column. Images that cannot be refined
    (bad rows, no plane, unknown objects) keep their poses, are listed at the end, and the exit code is 1.
    """

    estimates: Annotated[Path, tyro.conf.Positional]
    """Result file: scene_id,im_id,obj_id,score,R,t,time (t in mm)."""
    dataset: Path
    """BOP dataset folder."""
    out: Path
    """Result file to write."""
    planes: Path | None = None
    """Table planes: {scene: {image: {"normal": [3], "offset_mm": x}}} or {"R": 3x3, "t": [m]}. Without: collisions only."""
    plane_sigma_mm: float = 2.5
    """Standard deviation of the height of planes whose entry states none; contacts are as soft. 0: they are exact. Scans,
    true poses and tables agree to a few mm, not better."""
    statics: Path | None = None
    """Static meshes or boxes with their poses, JSON."""
    models: Path | None = None
    """Folder of the meshes, instead of DATASET/models."""
    split: str | None = None
    """Split of the dataset, if it has several."""
    targets: Path | None = None
    """Targets file: how many instances of each object an image has. Default: the dataset's, if there."""
    preset: str = "default"
    """default; lm: the same cost by ten Gauss-Newton steps; or paper: the paper's cost, weights and plain gradient descent."""
    config: RefinerConfig = field(default_factory=RefinerConfig)
    """Single options, starting from the preset."""
    scenes: tuple[int, ...] = ()
    """Only these scenes; the rows of others are copied as they are."""
    every: int = 1
    """Only every n-th image; the others are copied as they are."""
    batch: int = 16
    """Images at a time."""
    json: Path | None = None
    """Write penetration and gap before and after, and what could not be refined, to this file."""
    quiet: bool = False
    """No progress bar and no summary."""

    def __call__(self) -> int:
        if not self.plane_sigma_mm >= 0:
            raise InvalidInputError(f"--plane-sigma-mm {self.plane_sigma_mm}: expected a number >= 0")
        if self.batch < 1 or self.every < 1:
            raise InvalidInputError(f"--batch {self.batch}, --every {self.every}: expected positive numbers")
        estimates = read_estimates(self.estimates)
        dataset = BopDataset(self.dataset, split=self.split, models=self.models, targets=self.targets)
        total, todo = self._images(estimates, dataset)
        refiner = PhysPoseRefiner(self.config)
        poses = estimates.T_camera_object.clone()
        seconds = np.zeros(len(estimates))
        before, after = _Summary(), _Summary()
        images: list[ImageScene] = []
        with progress(total, "refine", "image", quiet=self.quiet) as bar:
            for batch in _batches(todo, self.batch):
                for group in self._run([i for i in batch if i.scene is not None], estimates, refiner):
                    rows = np.concatenate([i.rows for i in group.images])
                    poses[rows] = group.poses
                    seconds[rows] = group.seconds / len(group.images)
                    before.add(group.before)
                    after.add(group.after)
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
            "seconds_per_image": float(sum(seconds[i.rows[0]] for i in refined) / max(len(refined), 1)),
            "before": before.figures(),
            "after": after.figures(),
            "problems": problems,
        }
        if self.json is not None:
            self.json.write_text(json.dumps(summary, indent=2) + "\n")
        if not self.quiet:
            print(describe(summary))
        for problem in problems:
            logger.error(problem)
        return 1 if problems else 0

    def _images(self, estimates: Estimates, dataset: BopDataset) -> tuple[int, Iterator[ImageScene]]:
        """How many images there are to refine or to complain about, and these, in file order, made one by one."""
        broken: dict[tuple[int, int], list[str]] = {}
        unplaced = []
        planes = None
        bad = list(estimates.problems)
        if self.planes is not None:
            planes, bad_planes = read_planes(self.planes)
            bad += bad_planes
        for problem in bad:
            if problem.scene_id is None or problem.im_id is None:
                unplaced.append(problem.message)
            else:
                broken.setdefault((problem.scene_id, problem.im_id), []).append(problem.message)
        counts = {}
        if dataset.targets_path is not None:  # never from the ground truth
            counts = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in dataset.targets}
        statics = read_statics(self.statics) if self.statics is not None else []
        readable = dict.fromkeys(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True))
        keys = [k for k in {**readable, **broken} if not self.scenes or k[0] in self.scenes][:: self.every]
        # none of these images' rows could be read; a bad plane of an image without rows harms nobody
        bad_rows = {(p.scene_id, p.im_id) for p in estimates.problems}
        lost = [k for k in keys if k in bad_rows and k not in readable]
        nothing = np.zeros(0, dtype=np.int64)
        rest = [ImageScene(*key, nothing, problems=broken[key]) for key in lost]
        if unplaced:
            rest.append(ImageScene(-1, -1, nothing, problems=unplaced))
        images = image_scenes(
            estimates,
            BodyLibrary(dataset),
            planes=planes,
            plane_sigma=self.plane_sigma_mm / 1000,
            statics=statics,
            counts=counts,
            broken=broken,
            wanted=set(keys),
        )
        return sum(k in readable for k in keys) + len(rest), chain(images, rest)

    def _run(self, images: Sequence[ImageScene], estimates: Estimates, refiner: PhysPoseRefiner) -> "list[_Group]":
        """Refine images as one batch; if that fails, one by one, so that only the culprit is left out."""
        if not images:
            return []
        try:
            return [_refine(images, estimates, refiner)]
        except PhysPoseError as error:
            if len(images) == 1:
                images[0].problems.append(f"{images[0].name}: {error}")
                return []
            return [g for i in images for g in self._run([i], estimates, refiner)]


def _batches(images: Iterable[ImageScene], size: int) -> Iterator[list[ImageScene]]:
    """The images in order, ``size`` of those with a scene at a time; the others come along."""
    batch, ready = [], 0
    for image in images:
        batch.append(image)
        ready += image.scene is not None
        if ready == size:
            yield batch
            batch, ready = [], 0
    if batch:
        yield batch


@dataclass
class _Group:
    images: Sequence[ImageScene]
    poses: torch.Tensor
    seconds: float
    before: PhysicsReport
    after: PhysicsReport


def _refine(images: Sequence[ImageScene], estimates: Estimates, refiner: PhysPoseRefiner) -> _Group:
    start = time.perf_counter()
    scene = Scene.cat([i.scene for i in images])
    measured, scores = poses_of(images, estimates)
    before = physics_report(measured, scene, scores=scores, backend=refiner.config.physics.backend)
    result = refiner(measured, scene, scores=scores)
    return _Group(images, result.poses, time.perf_counter() - start, before, result.report)


class _Summary:
    """Penetrations and gaps of many images."""

    def __init__(self) -> None:
        self.penetration: list[torch.Tensor] = []
        self.gap: list[torch.Tensor] = []

    def add(self, report: PhysicsReport) -> None:
        self.penetration.append(report.penetration)
        self.gap.append(report.gap[report.gap.isfinite()])

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
