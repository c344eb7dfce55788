"""``physpose report``: BOP result CSV in; how deep, how high and how stable its objects are out."""

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.scenes import ImageScene, poses_of
from physpose_torch.commands.common import check_output, progress
from physpose_torch.commands.images import ImageOptions, in_batches, together
from physpose_torch.files import write_file
from physpose_torch.losses import acting
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene

__all__ = ["Report"]

logger = logging.getLogger("physpose_torch")

FEW = 3
"""Up to this many images every object gets a line."""
MUCH = 3.0
"""[mm]; the summary counts penetrations and gaps above this."""

Row = dict[str, Any]
_Column = tuple[str, str, Callable[[Any], str]]


@dataclass(frozen=True, kw_only=True)
class Report(ImageOptions):
    """Measure how physical the poses of a BOP result file are: penetration, gap to the support, stability. Changes nothing.

    Up to three images are told object by object, more as a summary by object id. Estimates that are alternatives of a
    better one (see refine) are measured, too, but left out of the summary. Images that cannot be measured are listed at
    the end, and the exit code is 1.
    """

    json: Path | None = None
    """Write every row's numbers and what could not be measured to this file."""
    backend: str = "auto"
    """Distance backend: warp, fcl, or fcl-isolated (in a process of its own)."""
    quiet: bool = False
    """No progress bar and no table."""

    def __call__(self) -> int:
        check_output(self.json)
        estimates, _, total, todo = self.open()
        rows: list[Row] = []
        problems: list[str] = []
        measured = 0
        with progress(total, "report", "image", quiet=self.quiet) as bar:
            for batch in in_batches(todo, self.batch):
                for some in together(batch, lambda images: _rows(images, estimates, self.backend)):
                    rows += some
                problems += [p for i in batch for p in i.problems]
                measured += sum(not i.problems for i in batch)
                bar.update(len(batch))
        if self.json is not None:
            content = {"images": measured, "rows": rows, "problems": problems}
            write_file(self.json, json.dumps(content, indent=2, allow_nan=False) + "\n")
        if not self.quiet:
            print(describe(rows, measured, statics=self.planes is not None or self.statics is not None))
        for problem in problems:
            logger.error(problem)
        return 1 if problems else 0


def _rows(images: Sequence[ImageScene], estimates: Estimates, backend: str) -> list[Row]:
    scene = Scene.cat([i.scene for i in images])
    poses, scores = poses_of(images, estimates)
    objects = physics_report(poses, scene, scores=scores, backend=backend).to_dict()["objects"]
    numbers = np.concatenate([i.rows for i in images]).tolist()
    return [
        {
            "scene_id": int(estimates.scene_id[row]),
            "im_id": int(estimates.im_id[row]),
            "obj_id": int(estimates.obj_id[row]),
            "score": float(estimates.score[row]),
            "row": row,
            "penetration_static_mm": _mm(o["penetration_static"]),
            "penetration_object_mm": _mm(o["penetration_object"]),
            "gap_mm": _mm(o["gap"]),
            "support": o["support"],
            "stable": o["stable"],
            "stability_margin_mm": _mm(o["stability_margin"]),
            "status": o["status"],
            "alternative": not acts,
        }
        for row, o, acts in zip(numbers, objects, acting(scene, scores).tolist(), strict=True)
    ]


def describe(rows: Sequence[Row], images: int, *, statics: bool) -> str:
    """What was measured, as text.

    Args:
        rows: as in the JSON file.
        images: how many there are.
        statics: whether anything static may be in them.
    """
    falls = any(row["stable"] is not None for row in rows)
    alternatives = sum(row["alternative"] for row in rows)
    lines = [f"{_count(images, 'image')}, {_count(len(rows), 'pose')}"]
    if rows:
        lines += ["", _one_by_one(rows, statics, falls) if images <= FEW else _summary(rows, statics, falls)]
    notes = []
    if alternatives:
        left_out = "" if images <= FEW else "; left out of this table"
        are = "is an alternative" if alternatives == 1 else "are alternatives"
        notes.append(f"{_count(alternatives, 'pose')} {are} of a better one{left_out}")
    if rows and not falls:
        notes.append("no plane, so gravity is unknown, and with it gaps and stability; see --planes")
    return "\n".join(lines + ([""] if notes else []) + notes)


def _one_by_one(rows: Sequence[Row], statics: bool, falls: bool) -> str:
    """A line for each pose, images one after another."""
    words = {None: "-", True: "yes", False: "no"}
    columns: list[_Column] = [
        ("", "object", lambda row: str(row["obj_id"])),
        ("", "score", lambda row: f"{row['score']:.3f}"),
    ]
    if statics:
        columns.append(("[mm]", "in static", lambda row: f"{row['penetration_static_mm']:.1f}"))
    columns.append(("[mm]", "in object", lambda row: f"{row['penetration_object_mm']:.1f}"))
    if falls:
        columns += [
            ("[mm]", "gap", lambda row: "-" if row["gap_mm"] is None else f"{row['gap_mm']:.1f}"),
            ("", "carried by", lambda row: row["support"]),
            ("", "stable", lambda row: words[row["stable"]]),
        ]
        columns.append(("", "status", lambda row: row["status"] + (", alternative" if row["alternative"] else "")))
    elif any(row["alternative"] for row in rows):
        columns.append(("", "", lambda row: "alternative" if row["alternative"] else ""))
    cells = [["image", *(name for _, name, _ in columns)]]
    image = None
    for row in rows:
        key = f"{row['scene_id']}/{row['im_id']}"
        cells.append(["" if key == image else key, *(make(row) for _, _, make in columns)])
        image = key
    return _grouped(
        ["", *(title for title, _, _ in columns)], cells, left=("image", "carried by", "stable", "status", "")
    )


def _summary(rows: Sequence[Row], statics: bool, falls: bool) -> str:
    """A line for each object id and one for all; poses that act only. Gaps are of those that have something below."""
    acting_rows = [row for row in rows if not row["alternative"]]
    groups: dict[str, list[Row]] = {}
    for row in sorted(acting_rows, key=lambda row: row["obj_id"]):
        groups.setdefault(str(row["obj_id"]), []).append(row)
    groups["all"] = acting_rows

    columns: list[_Column] = [("", "poses", lambda group: str(len(group)))]
    over = f"over {MUCH:.0f} mm [%]"
    if statics:
        columns.append((over, "in static", lambda g: _percent(r["penetration_static_mm"] > MUCH for r in g)))
    columns.append((over, "in object", lambda g: _percent(r["penetration_object_mm"] > MUCH for r in g)))
    if falls:
        columns.append((over, "above", lambda g: _percent(r["gap_mm"] > MUCH for r in g if r["gap_mm"] is not None)))
    for name, quantile in (("median", 0.5), ("95 %", 0.95)):
        columns.append(("penetration [mm]", name, lambda g, q=quantile: _quantile(map(_deepest, g), q)))
    if falls:
        for name, quantile in (("median", 0.5), ("95 %", 0.95)):
            columns.append(("gap [mm]", name, lambda g, q=quantile: _quantile((r["gap_mm"] for r in g), q)))
        columns.append(("[%]", "stable", lambda g: _percent(r["stable"] for r in g if r["stable"] is not None)))
        columns.append(("[%]", "unsupported", lambda g: _percent(r["status"] == "unsupported" for r in g)))
    cells = [["object", *(name for _, name, _ in columns)]]
    cells += [[key, *(make(group) for _, _, make in columns)] for key, group in groups.items()]
    text = _grouped(["", *(title for title, _, _ in columns)], cells, left=("object",)).splitlines()
    return "\n".join([*text[:-1], text[2], text[-1]])  # a rule above the total


def _grouped(titles: Sequence[str], cells: Sequence[Sequence[str]], *, left: Sequence[str]) -> str:
    """A table whose neighbouring columns with one title share it; columns are flush right but for those named ``left``."""
    runs: list[tuple[str, list[int]]] = []
    for i, title in enumerate(titles):
        if runs and title and runs[-1][0] == title:
            runs[-1][1].append(i)
        else:
            runs.append((title, [i]))
    widths = [max(len(row[i]) for row in cells) for i in range(len(titles))]
    for title, members in runs:  # a group is at least as wide as its title
        widths[members[0]] += max(len(title) - sum(widths[i] for i in members) - 2 * (len(members) - 1), 0)
    flush = [str.ljust if name in left else str.rjust for name in cells[0]]
    lines = []
    for row in cells:
        columns = [align(c, w) for align, c, w in zip(flush, row, widths, strict=True)]
        lines.append("   ".join("  ".join(columns[i] for i in members) for _, members in runs).rstrip())
    spans = [sum(widths[i] for i in members) + 2 * (len(members) - 1) for _, members in runs]
    top = "   ".join(title.center(span) for (title, _), span in zip(runs, spans, strict=True)).rstrip()
    return "\n".join([top, lines[0], "-" * max(map(len, lines)), *lines[1:]])


def _deepest(row: Row) -> float:
    return max(row["penetration_static_mm"], row["penetration_object_mm"])


def _percent(flags) -> str:
    flags = list(flags)
    return f"{100 * np.mean(flags):.0f}" if flags else "-"


def _quantile(values, q: float) -> str:
    values = [x for x in values if x is not None]
    return f"{np.quantile(values, q):.1f}" if values else "-"


def _mm(length: float | None) -> float | None:
    return None if length is None else round(1e3 * length, 4)


def _count(n: int, thing: str) -> str:
    return f"{n} {thing}{'' if n == 1 else 's'}"
