"""The rows of ``physpose ablate``: their numbers, and the lines that are printed of them."""

import dataclasses
import math
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physpose_torch.ablation import Variant
from physpose_torch.bop.ablation import Ablation, Difference, Outcome, difference
from physpose_torch.bop.harm import Harm, Share, harm

__all__ = ["WIDTH", "Row", "header", "plain", "planted_header"]

WIDTH = 120
NAME = 27
"""Characters of a row's name."""
CELLS = (5, 17, 5, 17, 13, 3, 5, 5, 5)
PLANTED_CELLS = (5, 17, 5, 17, 13, 13, 6)


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    variant: Variant
    outcome: Outcome | None = None
    to_reference: tuple[Difference, Difference] | None = None
    """Differences of AR_MSSD and AR_MSPD to the reference."""
    to_input: tuple[Difference, Difference] | None = None
    """And to the input."""
    harm: Harm | None = None
    """Against the input."""
    others: Harm | None = None
    """The same for the objects that planting has left alone; None where nothing is planted."""
    error: str = ""

    @classmethod
    def of(
        cls,
        variant: Variant,
        outcome: Outcome,
        ablation: Ablation,
        *,
        reference: Outcome | None,
        measured: Outcome,
        touched: np.ndarray | None = None,
        seed: int = 0,
    ) -> "Row":
        """Compare an outcome with those of the reference and of the input, ``measured``.

        Args:
            touched: (rows,) bool, which estimates planting has made or moved.
        """

        def to(other: Outcome) -> tuple[Difference, Difference]:
            mssd, mspd = (difference(outcome.scores, other.scores, e, seed=seed) for e in ("ar_mssd", "ar_mspd"))
            return mssd, mspd

        matches = ablation.matches
        others = None
        if touched is not None:
            others = harm(matches, outcome.mssd, chosen=~touched[matches.rows], seed=seed)
        return cls(
            variant,
            outcome,
            None if reference is None else to(reference),
            to(measured),
            harm(matches, outcome.mssd, seed=seed),
            others,
        )

    def line(self) -> str:
        """Of the table without planted failures."""
        if self.outcome is None:
            return self._failed()
        p, s = self.outcome.physics, self.outcome.scores
        mssd, mspd = self.to_reference or (None, None)
        return _line(
            CELLS,
            self.variant.shown,
            f"{s.ar_mssd:.3f}",
            _thousandths(mssd),
            f"{s.ar_mspd:.3f}",
            _thousandths(mspd),
            _percent(self.harm.worse),
            _number(p["inside_static_3mm"], 100, 0),
            _number(p["above_support_3mm"], 100, 0),
            _number(p["penetration_object_p95_mm"], 1, 1),
            f"{self.outcome.ms_per_image:.0f}" if self.variant.config is not None else "-",
        )

    def planted_line(self) -> str:
        """Of the table of a planted failure."""
        if self.outcome is None:
            return self._failed()
        s, (mssd, mspd) = self.outcome.scores, self.to_input
        return _line(
            PLANTED_CELLS,
            self.variant.shown,
            f"{s.ar_mssd:.3f}",
            _thousandths(mssd),
            f"{s.ar_mspd:.3f}",
            _thousandths(mspd),
            _percent(self.harm.worse),
            _percent(self.others.worse),
            _number(self.harm.better and self.harm.better.value, 100, 0),
        )

    def _failed(self) -> str:
        first, rest = f"{self.variant.shown:<{NAME}}  failed: ", " " * (NAME + 2)
        return textwrap.fill(self.error, WIDTH, initial_indent=first, subsequent_indent=rest)

    def to_dict(self) -> dict[str, Any]:
        """Ready for JSON. Where something is planted there are no figures of physics: what the scene is told is wrong."""
        v, o = self.variant, self.outcome
        content: dict[str, Any] = {
            "name": v.name,
            "label": v.shown,
            "group": v.group,
            "planes": v.knowledge,
            "config": None if v.config is None else plain(dataclasses.asdict(v.config)),
            "error": self.error or None,
        }
        if o is None:
            return content
        content |= {"ar_mssd": o.scores.ar_mssd, "ar_mspd": o.scores.ar_mspd}
        if self.others is None:
            content |= o.physics
        content["ms_per_image"] = o.ms_per_image
        for name, pair in (("difference", self.to_reference), ("change", self.to_input)):
            for k, error in enumerate(("mssd", "mspd")):
                content[f"{name}_{error}"] = None if pair is None else pair[k]._asdict()
        content |= _shares(self.harm, "")
        if self.others is not None:
            content |= _shares(self.others, "others_")
        return content


def header() -> str:
    """Above the rows of the table without planted failures."""
    recalls = "  ".join(f"{name:<7}{'Δ·10³ [95 %]':>17}" for name in ("AR_MSSD", "AR_MSPD"))
    above = f"{'':{NAME + 52}}{'worse > 2 mm':>13}  {'>3 mm [%]':>10}  depth  ms per"
    below = f"{'':{NAME}}  {recalls}  {'[%] [95 %]':>13}  {'in':>3}  above   95 %  image"
    return "\n".join([above.rstrip(), below, "-" * WIDTH])


def planted_header(what: str) -> str:
    """Above the rows of a planted failure."""
    recalls = "  ".join(f"{name:<7}{'Δ·10³ [95 %]':>17}" for name in ("AR_MSSD", "AR_MSPD"))
    above = f"{'':{NAME + 52}}{'worse > 2 mm':>13}  {'of untouched':>13}  better"
    below = f"{'':{NAME}}  {recalls}  {'[%] [95 %]':>13}  {'[%] [95 %]':>13}  {'[%]':>6}"
    return "\n".join(["", *textwrap.wrap(what, WIDTH), "", above, below, "-" * WIDTH])


def plain(value: Any) -> Any:
    """The same for JSON: paths and infinities as text."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, Path) or (isinstance(value, float) and not math.isfinite(value)):
        return str(value)
    return value


def _shares(found: Harm, prefix: str) -> dict[str, Any]:
    shares = {f"{prefix}made_worse": found.worse, f"{prefix}made_better": found.better}
    return {f"{prefix}objects": found.objects} | {k: None if s is None else s._asdict() for k, s in shares.items()}


def _line(widths: tuple[int, ...], name: str, *cells: str) -> str:
    return "  ".join([f"{name:<{NAME}}", *(f"{c:>{w}}" for c, w in zip(cells, widths, strict=True))]).rstrip()


def _thousandths(d: Difference | None) -> str:
    if d is None:
        return "-"
    value, low, high = (f"{n:+d}" if n else "0" for n in (round(1000 * x) for x in d))
    return f"{value} [{low}, {high}]"


def _percent(s: Share | None) -> str:
    if s is None:
        return "-"
    value, low, high = (f"{100 * x:.0f}" for x in s)
    # an interval that is a point says nothing more
    return value if low == high == value else f"{value} [{low}, {high}]"


def _number(x: float | None, factor: float, digits: int) -> str:
    return "-" if x is None else f"{factor * x:.{digits}f}"
