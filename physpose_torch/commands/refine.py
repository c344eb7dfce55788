"""``physpose refine``: BOP result CSV in, refined BOP result CSV out."""

import dataclasses
import hashlib
import json
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physpose_torch import __version__
from physpose_torch.bop.formats import Estimates, rewrite_rows
from physpose_torch.bop.index import EstimatesIndex
from physpose_torch.bop.journal import Journal
from physpose_torch.bop.scenes import ImageScene, poses_of
from physpose_torch.commands.common import check_output, describe, progress
from physpose_torch.commands.images import ImageOptions, Known, in_batches, together
from physpose_torch.commands.totals import Totals, figures_of
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import DataError
from physpose_torch.files import replacing, write_file, written
from physpose_torch.refiner import PhysPoseRefiner, Refinement, silent_doubts
from physpose_torch.report import PhysicsReport, physics_report
from physpose_torch.scene import Scene

__all__ = ["Refine"]

AT_A_TIME = 256
"""Images whose rows are read at a time, at least."""
logger = logging.getLogger("physpose_torch")


@dataclass(frozen=True, kw_only=True)
class Refine(ImageOptions):
    """Refine the poses of a BOP result file so that they are physically consistent.

    All rows, their order and scores are kept; the time spent is added to the time column. Images that cannot be refined
    (bad rows, no plane, unknown objects) keep their poses, are listed at the end, and the exit code is 1. Images that
    --scenes and --every leave out are copied as they are.

    Poses that physics contradicts too much to be put right are left as they are, as are objects with nothing below them and
    images whose objects together contradict their plane; --json lists them row by row.

    The file may be of any size. OUT.journal keeps what is done until OUT is written, in one step; a run that was killed or
    interrupted goes on with --resume, and ends with the same result.
    """

    out: Path
    """Result file to write."""
    resume: bool = False
    """Go on where an earlier run with the same files and options stopped; if none did, begin. Only --batch, --json and
    --quiet may differ; poses from other batches are equal but for rounding."""
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
        self.check()
        out = self.out.resolve()  # of a link, the file it points to
        if out.exists() and not out.is_file():
            raise DataError(f"{self.out}: is no regular file; name a file to write")
        totals = Totals()
        with Journal(out.with_name(f"{out.name}.journal"), resume=self.resume) as journal, self._index() as index:
            try:
                self._refine(index, journal, totals)
                # what a killed run left there is overwritten
                with written(out), replacing(out, temporary=out.with_name(f".{out.name}.tmp")) as file:
                    file.writelines(journal.merged(index))
                if self.json is not None:
                    write_file(self.json, json.dumps(totals.summary(), indent=2) + "\n")
            except KeyboardInterrupt:
                if not journal.committed:
                    raise
                done = f"{totals.counts['images']} of {self._count(index)} images are done"
                raise KeyboardInterrupt(f"{done}; the same command with --resume goes on") from None
            journal.remove()
        if not self.quiet:
            print(describe(totals.summary(rows=False)))
        for doubt in totals.doubts:
            logger.warning("%s", doubt)
        for problem in totals.problems:
            logger.error(problem)
        return 1 if totals.problems else 0

    def _index(self) -> EstimatesIndex:
        size = self.estimates.stat().st_size if self.estimates.is_file() else None
        with progress(size, "read", "B", quiet=self.quiet, unit_scale=True, leave=False) as bar:
            return EstimatesIndex(self.estimates, on_bytes=bar.update)

    def _refine(self, index: EstimatesIndex, journal: Journal, totals: Totals) -> None:
        """Refine what the journal does not have yet."""
        known = self.known()
        for record in journal.begin(self._about(index, known), lines=index.lines):
            totals.add(record)
        refiner = PhysPoseRefiner(self.config)
        chosen = index.choose(self.scenes, self.every)
        done, size = totals.counts["images"], max(AT_A_TIME, self.batch)
        with progress(self._count(index), "refine", "image", quiet=self.quiet, initial=done) as bar:
            # sums round differently in other batches, so those of a resumed run begin and end where they would have
            while (start := totals.counts["images"]) < len(chosen):
                keys = [(s, i) for s, i in index.keys[chosen[start : start - start % size + size]].tolist()]
                estimates = index.read(index.numbers([*keys, *known.partners(keys)]))
                for batch in in_batches(known.images(estimates, keys), self.batch):
                    groups = together(batch, lambda images, rows=estimates: _refine(images, rows, refiner))
                    record = _record(batch, groups, estimates)
                    journal.commit(_rewritten(groups, estimates), record)
                    totals.add(record)
                    for image in batch:
                        image.scene = None  # its memory is needed for the next ones
                    bar.update(len(batch))
            bar.update(bool(index.unplaced))
        if index.unplaced:
            totals.counts["images"] += 1
            totals.problems += index.unplaced

    def _count(self, index: EstimatesIndex) -> int:
        """How many images there are to look at or to complain about; rows of no image count as one."""
        return len(index.choose(self.scenes, self.every)) + bool(index.unplaced)

    def _about(self, index: EstimatesIndex, known: Known) -> dict[str, Any]:
        """Whatever decides the result, by what it is called in messages."""
        files = {name: getattr(self, name) for name in ("planes", "pairs", "statics")}
        files["targets"] = known.dataset.targets_path
        folders = {name: getattr(self, name) for name in ("dataset", "models")}
        options = {name: getattr(self, name) for name in ("split", "scenes", "every", "table", "plane_sigma_mm")}
        return {
            "version": __version__,
            "estimates (SHA-256)": index.digest,
            **{f"{name} (SHA-256)": _digest(path) for name, path in files.items()},
            **{f"--{name}": None if path is None else str(path.resolve()) for name, path in folders.items()},
            **{f"--{name.replace('_', '-')}": value for name, value in options.items()},
            "--config": dataclasses.asdict(self.config),
        }


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


def _record(batch: Sequence[ImageScene], groups: Sequence[_Group], estimates: Estimates) -> dict[str, Any]:
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


def _digest(path: Path | None) -> str | None:
    """SHA-256 of a file that was read as a whole before; None: of a pipe, which cannot be read again."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path is not None and path.is_file() else None
