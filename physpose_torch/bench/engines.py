"""``bench engines``: images a second by one process and by the workers of a Ray cluster, and whether the poses are the same."""

import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import numpy as np

from physpose_torch.bench.scenes import make_config
from physpose_torch.bop.index import EstimatesIndex
from physpose_torch.commands.batches import Batch, BatchRefiner
from physpose_torch.commands.common import progress
from physpose_torch.commands.common import table as text_table
from physpose_torch.commands.engines import refine_here, refine_on_ray
from physpose_torch.commands.images import ImageOptions
from physpose_torch.errors import InvalidInputError

__all__ = ["EngineOptions", "run_engines"]


@dataclass(frozen=True, kw_only=True)
class EngineOptions(ImageOptions):
    """What is refined, and by whom."""

    workers: tuple[int, ...] = (1, 2)
    """Numbers of Ray's workers to try, each after the one process that they are compared with."""
    preset: str = "default"
    """default, lm or paper."""


def run_engines(results: dict[str, Any], options: EngineOptions) -> None:
    """Refine the same images by every engine, print a table, add rows to the results.

    Raises:
        InvalidInputError: an option is out of range.
        MissingExtraError: Ray is not installed.
        DataError: a file cannot be used.
    """
    options.check()
    if min(options.workers, default=0) < 1:
        raise InvalidInputError(f"--workers {options.workers}: expected positive numbers")
    with EstimatesIndex(options.estimates) as index:
        chosen = index.choose(options.scenes, options.every)
        batches = [b for b in np.split(chosen, range(options.batch, len(chosen), options.batch)) if len(b)]
        if len(batches) < 2:
            raise InvalidInputError(f"{options.estimates}: {len(batches)} batches; there is nothing to share out")
        refine = BatchRefiner(index, options.known(), make_config(options.preset, "auto"))
        rows, alone = [], None
        for workers in (0, *options.workers):
            engine = refine_on_ray(refine, batches, workers=workers) if workers else refine_here(refine, batches)
            row, poses = _timed(engine, len(chosen))
            alone = poses if alone is None else alone
            rows.append({"workers": workers} | row | _differences(alone, poses))
    results["engines"] = rows
    print(f"\n{len(chosen)} images, {options.batch} at a time, preset {options.preset}; rates are of the second half")
    print(_table(rows))


def _timed(engine: Generator[Batch, None, None], count: int) -> tuple[dict[str, float], dict[int, np.ndarray]]:
    """Seconds in all, images a second of the second half, and [R, t in mm] by line."""
    poses, start, done, half = {}, time.perf_counter(), 0, None
    with progress(count, "refine", "image", leave=False) as bar:
        for batch in engine:
            done += batch.record["images"]
            bar.update(batch.record["images"])
            if half is None and done >= count / 2:
                half = done, time.perf_counter()
            for line, text in batch.rows:
                poses[line] = np.array(" ".join(text.split(",")[4:6]).split(), dtype=np.float64)
    end = time.perf_counter()
    return {"seconds": end - start, "images_per_second": (done - half[0]) / (end - half[1])}, poses


def _differences(alone: dict[int, np.ndarray], poses: dict[int, np.ndarray]) -> dict[str, float]:
    """Rows that differ, and by how much at most [mm]; rows that only one of them changed count, too."""
    both = alone.keys() & poses.keys()
    apart = [np.abs(alone[line] - poses[line]) for line in both]
    return {
        "rows_that_differ": len(alone.keys() ^ poses.keys()) + sum(bool(d.any()) for d in apart),
        "difference_mm": max((float(d[9:].max()) for d in apart), default=0.0),
    }


def _table(rows: list[dict[str, Any]]) -> str:
    cells = []
    for row in rows:
        rate, plural = row["images_per_second"], "s" * (row["workers"] > 1)
        cells.append(
            [
                f"Ray, {row['workers']} worker{plural}" if row["workers"] else "this process",
                f"{row['seconds']:.1f}",
                f"{rate:.1f}",
                f"{rate / rows[0]['images_per_second']:.2f}",
                str(row["rows_that_differ"]),
                f"{row['difference_mm']:.0e}" if row["difference_mm"] else "0",
            ]
        )
    names = ["", "seconds in all", "images a second", "ratio", "rows that differ", "by at most [mm]"]
    return text_table(names, cells)
