"""A batch of images of a result file, refined: what the engines of ``physpose refine`` do, wherever they do it."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch

from physpose_torch.bop.formats import Estimates, rewrite_rows
from physpose_torch.bop.index import EstimatesIndex
from physpose_torch.bop.scenes import ImageScene, poses_of
from physpose_torch.commands.images import Known, together
from physpose_torch.commands.totals import figures_of
from physpose_torch.config import RefinerConfig
from physpose_torch.refiner import PhysPoseRefiner, Refinement, silent_doubts
from physpose_torch.report import PhysicsReport, physics_report
from physpose_torch.scene import Scene

__all__ = ["Batch", "BatchRefiner", "lost_batch"]


class Batch(NamedTuple):
    """What became of a batch; JSON."""

    rows: list[tuple[int, str]]
    """(line number, new text) of the rows that changed."""
    record: dict[str, Any]
    """For the journal and :meth:`Totals.add`."""


@dataclass(frozen=True)
class BatchRefiner:
    """Refines images of a result file, a batch at a time. Can be sent to another process, which must find the file and the
    dataset under the same paths."""

    index: EstimatesIndex
    known: Known
    config: RefinerConfig

    @cached_property
    def refiner(self) -> PhysPoseRefiner:
        return PhysPoseRefiner(self.config)

    def __call__(self, numbers: np.ndarray) -> Batch:
        """Refine the images with these numbers in the index, together.

        Raises:
            DataError: the result file was changed since the index was made.
        """
        keys = self.index.names(numbers)
        estimates = self.index.read(np.concatenate([numbers, self.index.numbers(self.known.partners(keys))]))
        images = list(self.known.images(estimates, keys))
        groups = together(images, lambda some: _refine(some, estimates, self.refiner))
        return Batch(_rewritten(groups, estimates), _record(images, groups, estimates))


def lost_batch(keys: Sequence[tuple[int, int]], why: str) -> Batch:
    """A batch of which nothing came back: its images keep their poses."""
    images = [ImageScene(*key, np.zeros(0, dtype=np.int64)) for key in keys]
    for image in images:
        image.problems.append(f"{image.name}: {why}")
    return Batch([], _record(images, [], None))


@dataclass
class _Group:
    images: Sequence[ImageScene]
    result: Refinement
    seconds: float
    before: PhysicsReport

    @property
    def rows(self) -> np.ndarray:
        return np.concatenate([i.rows for i in self.images])


def _refine(images: Sequence[ImageScene], estimates: Estimates, refiner: PhysPoseRefiner) -> _Group:
    start = time.perf_counter()
    scene = Scene.cat([i.scene for i in images])
    measured, scores = poses_of(images, estimates)
    before = physics_report(measured, scene, scores=scores, backend=refiner.config.physics.backend)
    with silent_doubts():  # told by the names of their images
        result = refiner(measured, scene, scores=scores)
    return _Group(images, result, time.perf_counter() - start, before)


def _rewritten(groups: Sequence[_Group], estimates: Estimates) -> list[tuple[int, str]]:
    """(line number, new text) of the rows of a batch that changed."""
    poses, seconds = estimates.T_camera_object.clone(), np.zeros(len(estimates))
    for group in groups:
        poses[group.rows] = group.result.poses
        seconds[group.rows] = group.seconds / len(group.images)
    return [(int(estimates.line[row]), text) for row, text in rewrite_rows(estimates, poses, time=seconds)]


def _record(batch: Sequence[ImageScene], groups: Sequence[_Group], estimates: Estimates | None) -> dict[str, Any]:
    """What happened to a batch, for the journal and :meth:`Totals.add`."""
    refined = [i for i in batch if not i.problems]
    left: dict[str, list] = {"rejected": [], "unsupported": [], "doubted": []}
    figures, doubts = [], []
    for group in groups:
        result = group.result
        flags = (result.rejected, result.unsupported, result.doubted[result.image])
        ids = [getattr(estimates, name)[group.rows] for name in ("line", "obj_id", "scene_id", "im_id")]
        for rows, flag in zip(left.values(), flags, strict=True):
            rows += np.stack(ids, axis=1)[flag.numpy()].tolist()
        figures.append(figures_of(group.before, result.report, torch.stack(flags).any(0)))
        doubts += [f"{i.name}: {d}" for i, d in zip(group.images, result.doubts, strict=True) if d]
    return {
        "images": len(batch),
        "refined": len(refined),
        "rows": sum(len(i.rows) for i in refined),
        "righted": sum(int(g.result.righted.sum()) for g in groups),
        "seconds": sum(g.seconds for g in groups),
        "left": left,
        "figures": figures,
        "doubts": doubts,
        "problems": [p for i in batch for p in i.problems],
    }
