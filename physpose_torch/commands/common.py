"""What the commands share: progress bars and the tables they print."""

import os
import sys
from pathlib import Path
from typing import Any

from tqdm import tqdm

from physpose_torch.errors import DataError
from physpose_torch.files import resolved, streams, written

__all__ = ["check_output", "describe", "progress", "table"]


def check_output(*paths: Path | None) -> None:
    """Refuse to start long work whose results could not be written.

    Raises:
        DataError: a file's folder does not exist, or the path is a folder or a loop of links, or one of them is read-only.
    """
    for path in paths:
        if path is None:
            continue
        with written(path):
            replaced = not streams(path)
            folder = (resolved(path) if replaced else path.absolute()).parent
        faults = {
            "is a folder": path.is_dir(),
            "lies in no existing folder": not folder.is_dir(),
            "is read-only": path.exists() and not os.access(path, os.W_OK),
            "lies in a read-only folder": replaced and not os.access(folder, os.W_OK),
        }
        if told := [what for what, true in faults.items() if true]:
            raise DataError(f"{path} {told[0]}; name a file to write")


def progress(total: int | None, what: str, unit: str, *, quiet: bool = False, **options: Any) -> tqdm:
    """A progress bar on stderr, with rate and time left; silent if asked, or where nobody watches. Options are tqdm's."""
    off = quiet or not sys.stderr.isatty()
    return tqdm(total=total, desc=what, unit=unit, disable=off, dynamic_ncols=True, **options)


def table(header: list[str], rows: list[list[Any]]) -> str:
    """Plain text table; first column left, the others right."""
    cells = [header, *([c if isinstance(c, str) else f"{c:.2f}" for c in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = [
        "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in cells
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def describe(summary: dict[str, Any]) -> str:
    """The summary of a refinement, in mm and percent."""
    names = {
        "penetration_mean_mm": "penetration, mean [mm]",
        "penetration_p95_mm": "penetration, 95th percentile [mm]",
        "penetrating_3mm": "more than 3 mm inside something [%]",
        "gap_mean_mm": "gap to the support, mean [mm]",
        "gap_p95_mm": "gap to the support, 95th percentile [mm]",
        "floating_3mm": "more than 3 mm above the support [%]",
    }
    rows = []
    for key, name in names.items():
        factor = 100.0 if name.endswith("[%]") else 1.0
        rows.append([name, *(factor * summary[when][key] for when in ("before", "after", "after_moved"))])
    head = (
        f"{summary['refined']} of {summary['images']} images refined, {summary['rows']} poses, "
        f"{1000 * summary['seconds_per_image']:.0f} ms an image"
    )
    if summary["righted"]:
        head += f"\n{summary['righted']} of them could not have stood as estimated, and were turned"
    left = {
        "rejected": "contradict physics too much to be put right",
        "unsupported": "have nothing below them",
        "doubted": "are in images that contradict their planes, listed below",
    }
    for why, text in left.items():
        if summary[why]:
            head += f"\n{summary[why]} were left as estimated: they {text}"
    lines = [head, "", table(["", "before", "after", "those moved"], rows)]
    if summary["problems"]:
        lines += ["", f"{summary['images'] - summary['refined']} images kept their poses; see the messages below"]
    return "\n".join(lines)
