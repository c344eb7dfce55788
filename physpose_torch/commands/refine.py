"""``physpose refine``: BOP result CSV in, refined BOP result CSV out."""

import dataclasses
import hashlib
import json
import logging
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from physpose_torch import __version__
from physpose_torch.bop.index import EstimatesIndex
from physpose_torch.bop.journal import Journal
from physpose_torch.commands.batches import BatchRefiner
from physpose_torch.commands.common import check_output, describe, progress
from physpose_torch.commands.engines import refine_here, refine_on_ray
from physpose_torch.commands.images import ImageOptions, Known
from physpose_torch.commands.totals import Totals
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.files import replacing, resolved, write_file, written

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

    The file may be of any size. OUT.journal keeps what is done until OUT is written, in one step; a run that was killed or
    interrupted goes on with --resume, and ends with the same result.
    """

    out: Path
    """Result file to write."""
    engine: Literal["local", "ray"] = "local"
    """local: in this process; ray: on all cores of this machine, or of a Ray cluster (RAY_ADDRESS) whose machines find the
    files under the same paths. The poses are the same but for rounding."""
    workers: int | None = None
    """With --engine ray: batches at a time; default: one a core of the cluster."""
    resume: bool = False
    """Go on where an earlier run with the same files and options stopped; if none did, begin. Only --batch, --engine,
    --workers, --json and --quiet may differ; poses from other batches are equal but for rounding."""
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
        if self.workers is not None and (self.engine == "local" or self.workers < 1):
            raise InvalidInputError(f"--workers {self.workers}: expected a positive number, and --engine ray")
        out = resolved(self.out)  # of a link, the file it points to
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
        chosen, done = index.choose(self.scenes, self.every), totals.counts["images"]
        # sums round differently in other batches, so those of a resumed run end where they would have
        ends = np.arange(done - done % self.batch + self.batch, len(chosen), self.batch)
        batches = [b for b in np.split(chosen[done:], ends - done) if len(b)]
        refine = BatchRefiner(index, known, self.config)
        if self.engine == "ray":
            refined = refine_on_ray(refine, batches, workers=self.workers)
        else:
            refined = refine_here(refine, batches)
        bar = progress(self._count(index), "refine", "image", quiet=self.quiet, initial=done)
        with bar, closing(refined):
            for batch in refined:
                journal.commit(batch.rows, batch.record)
                totals.add(batch.record)
                bar.update(batch.record["images"])
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


def _digest(path: Path | None) -> str | None:
    """SHA-256 of a file that was read as a whole before; None: of a pipe, which cannot be read again."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path is not None and path.is_file() else None
