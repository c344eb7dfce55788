"""What a refinement of many images did in all: counts, figures, and lists of what was left alone."""

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from physpose_torch.report import PhysicsReport

__all__ = ["Totals", "figures_of"]

_COUNTS = ("images", "refined", "rows", "righted")
_WHY = ("rejected", "unsupported", "doubted")
_DIGITS = 6  # of a millimetre


def figures_of(before: PhysicsReport, after: PhysicsReport, left: torch.Tensor) -> dict[str, list]:
    """Penetration and gap [mm] of each object before and after, an infinite gap where nothing is below it, and whether it was
    left (N,) as it was: JSON, for :meth:`Totals.add`."""
    reports = {"before": before, "after": after}
    columns = {f"{what}_{when}": getattr(r, what) for when, r in reports.items() for what in ("penetration", "gap")}
    mm = {name: np.round(1e3 * column.numpy(), _DIGITS).tolist() for name, column in columns.items()}
    return {**mm, "left": left.int().tolist()}


class Totals:
    """Adds up records of batches. Memory is 17 bytes an object, and what lists of rows and messages take."""

    def __init__(self) -> None:
        self.counts = dict.fromkeys(_COUNTS, 0)
        self.problems: list[str] = []
        self.doubts: list[str] = []
        self._seconds = 0.0
        self._left = {why: array("q") for why in _WHY}  # line, obj_id, scene_id, im_id of each row
        self._mm = {f"{what}_{when}": array("f") for what in ("penetration", "gap") for when in ("before", "after")}
        self._kept = bytearray()

    def add(self, record: Mapping[str, Any]) -> None:
        """Take the record of a batch: ``images``, ``refined``, ``rows``, ``righted`` (counts), ``seconds`` (sum over refined
        images), ``left`` (why: [line, obj_id, scene_id, im_id] of each row), ``figures`` (a list of :func:`figures_of`),
        ``doubts`` and ``problems`` (messages)."""
        for name in _COUNTS:
            self.counts[name] += record[name]
        self._seconds += record["seconds"]
        for why, rows in record["left"].items():
            self._left[why].extend(number for row in rows for number in row)
        for figures in record["figures"]:
            for name, column in self._mm.items():
                column.extend(figures[name])
            self._kept += bytes(figures["left"])
        self.doubts += record["doubts"]
        self.problems += record["problems"]

    def summary(self, *, rows: bool = True) -> dict[str, Any]:
        """Everything, as ``physpose refine --json`` writes it; without the list of ``rows`` that were left, if not wanted."""
        moved = ~np.frombuffer(self._kept, dtype=bool)
        left = {why: np.frombuffer(numbers, dtype=np.int64).reshape(-1, 4) for why, numbers in self._left.items()}
        return {
            **self.counts,
            **{why: len(numbers) for why, numbers in left.items()},
            "seconds_per_image": self._seconds / max(self.counts["refined"], 1),
            "before": self._figures("before"),
            "after": self._figures("after"),
            "after_moved": self._figures("after", moved),
            "left": [row for why, numbers in left.items() for row in _rows(why, numbers)] if rows else [],
            "doubts": self.doubts,
            "problems": self.problems,
        }

    def _figures(self, when: str, chosen: np.ndarray | None = None) -> dict[str, float]:
        deep, gap = (np.frombuffer(self._mm[f"{what}_{when}"], dtype=np.float32) for what in ("penetration", "gap"))
        if chosen is not None:
            deep, gap = deep[chosen], gap[chosen]
        gap = gap[np.isfinite(gap)]
        return {
            "penetration_mean_mm": _mean(deep),
            "penetration_p95_mm": _quantile(deep, 0.95),
            "penetrating_3mm": _mean(deep > 3),
            "gap_mean_mm": _mean(gap),
            "gap_p95_mm": _quantile(gap, 0.95),
            "floating_3mm": _mean(gap > 3),
        }


def _rows(why: str, numbers: np.ndarray) -> list[dict[str, Any]]:
    names = ("line", "obj_id", "scene_id", "im_id")
    return [{**dict(zip(names, row, strict=True)), "why": why} for row in numbers[np.argsort(numbers[:, 0])].tolist()]


def _mean(x: np.ndarray | Sequence) -> float:
    return float(np.mean(x, dtype=np.float64)) if len(x) else 0.0


def _quantile(x: np.ndarray, q: float) -> float:
    return float(np.quantile(x, q)) if len(x) else 0.0
