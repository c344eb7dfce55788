"""``physpose ablate``: plain baselines, and the refiner with one thing changed at a time, in one table."""

import dataclasses
import json
import logging
import math
import textwrap
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from physpose_torch.ablation import Variant, choose, list_variants
from physpose_torch.bop.ablation import (
    Ablation,
    Batch,
    Difference,
    Disturbance,
    Outcome,
    difference,
    prepare,
    restricted,
)
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.scenes import ImageScene
from physpose_torch.commands.common import check_output, progress
from physpose_torch.commands.images import ImageOptions, in_batches
from physpose_torch.config import Calibration, RefinerConfig
from physpose_torch.errors import InvalidInputError, PhysPoseError

__all__ = ["Ablate"]

logger = logging.getLogger("physpose_torch")

WIDTH = 120
NAME = 33
"""Characters of a row's name."""


@dataclass(frozen=True, kw_only=True)
class Ablate(ImageOptions):
    """Compare the refiner with plain baselines, with each cost term and each choice on and off, and with less knowledge.

    One table: average recalls of MSSD and MSPD over the targets of the images that the file names; the difference of each
    to the reference, which is the preset as it is, in thousandths with its 95 % interval (paired bootstrap: images are
    drawn with replacement from the file as a whole, all scenes together); how many objects are more than 3 mm inside
    something static or above their support, and how deep they are in each other, all measured with the planes as known.
    Images that cannot be refined keep their poses in all rows, are listed at the end, and the exit code is 1; so it is if
    a row fails.
    """

    calibration: Path | None = None
    """What physpose calibrate wrote: adds rows that use it, and its depth factor replaces that of MegaPose on YCB-V."""
    rows: tuple[str, ...] = ()
    """Only these rows, by name, beside the baselines and the reference. An unknown name lists them all."""
    slow: bool = False
    """Run the slow rows, too."""
    disturb_deg: float = 1.5
    """Disturbed planes: standard deviation of the tilt about each of two axes. The refiner is told."""
    disturb_mm: float = 6.0
    """Disturbed planes: standard deviation of the height."""
    seed: int = 0
    """Seed of the disturbed planes and of the bootstrap."""
    preset: str = "default"
    """default; lm: the same cost by fifteen Gauss-Newton steps; or paper: the paper's cost, weights and plain descent, slow."""
    config: RefinerConfig = field(default_factory=RefinerConfig)
    """Single options of the reference, starting from the preset."""
    json: Path | None = None
    """Write everything, with the options and each row's config, to this file."""
    quiet: bool = False
    """No progress bar and no table."""

    def __call__(self) -> int:
        check_output(self.json)
        variants = self._variants()
        estimates, dataset, total, todo = self.open()
        images: list[ImageScene] = []
        batches: list[Batch] = []
        with progress(total, "scenes", "image", quiet=self.quiet) as bar:
            bar.leave = False
            for some in in_batches(todo, self.batch):
                batches += prepare(some, estimates, self._disturbance)
                images += some
                bar.update(len(some))
        looked_at = {(i.scene_id, i.im_id) for i in images}
        if not looked_at:
            raise InvalidInputError(f"{self.estimates}: no images to compare; check --scenes, or the file")
        ablation = Ablation(estimates, restricted(dataset, looked_at), batches)
        count = sum(len(b.images) for b in batches)
        with progress(count * (len(variants) + 1), "ablate", "image", quiet=self.quiet) as bar:
            bar.leave = False
            results = self._run(ablation, variants, bar)
        skipped = [v.name for v in self._all_variants() if v.slow and v not in variants and not self.rows]
        problems = [p for i in images for p in i.problems]
        if self.json is not None:
            content = self._content(results, estimates, ablation.dataset, len(looked_at), count, skipped, problems)
            self.json.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
        if not self.quiet:
            print("", *self._notes(ablation.dataset, len(looked_at), count, skipped), sep="\n")
        for problem in problems:
            logger.error(problem)
        return 1 if problems or any(r.error for r in results) else 0

    @property
    def _disturbance(self) -> Disturbance:
        return Disturbance(math.radians(self.disturb_deg), self.disturb_mm / 1000, self.seed)

    def _all_variants(self) -> list[Variant]:
        return list_variants(
            self.config,
            calibration=self._calibration(),
            planes=self.planes is not None,
            disturbance=self._disturbance[:2],
        )

    def _variants(self) -> list[Variant]:
        for name in ("disturb_deg", "disturb_mm", "seed"):
            if not getattr(self, name) >= 0:
                option = "--" + name.replace("_", "-")
                raise InvalidInputError(f"{option} {getattr(self, name)}: expected a number >= 0")
        return choose(self._all_variants(), self.rows, slow=self.slow)

    def _calibration(self) -> Calibration | None:
        if self.calibration is None:
            return None
        from physpose_torch.bop.calibration import read_calibration

        return read_calibration(self.calibration)

    def _run(self, ablation: Ablation, variants: list[Variant], bar: tqdm) -> "list[_Result]":
        """All rows in the order of the table, each printed as soon as it is known; the reference is worked out first."""
        reference = None
        wanted = next(v for v in variants if v.key == (self.config, None, "known"))
        if not self.quiet:
            bar.write(_header())
        bar.set_description(wanted.name)
        try:
            reference = ablation.run(wanted, bar.update)
        except PhysPoseError:
            bar.update(0)  # its row will tell
        results: list[_Result] = []
        for variant in variants:
            bar.set_description(variant.name)
            try:
                result = _Result.of(variant, ablation.run(variant, bar.update), reference, self.seed)
            except PhysPoseError as error:
                result = _Result(variant, error=str(error))
            if not self.quiet:
                if not results or results[-1].variant.group != variant.group:
                    bar.write(f"\n{variant.group}")
                bar.write(result.line())
            results.append(result)
        return results

    def _content(
        self,
        results: "list[_Result]",
        estimates: Estimates,
        dataset: BopDataset,
        looked_at: int,
        used: int,
        skipped: list[str],
        problems: list[str],
    ) -> dict[str, Any]:
        in_file = len(set(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True)))
        options = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "config"}
        return {
            "options": {**_plain(options), "config": _plain(dataclasses.asdict(self.config))},
            "images": {
                "in_file": in_file,
                "looked_at": looked_at,
                "refined": used,
                "share": looked_at / max(in_file, 1),
            },
            "targets": sum(t.inst_count for t in dataset.targets),
            "rows": [r.to_dict() for r in results],
            "skipped": skipped,
            "problems": problems,
        }

    def _notes(self, dataset: BopDataset, looked_at: int, used: int, skipped: list[str]) -> list[str]:
        targets = sum(t.inst_count for t in dataset.targets)
        left = f", {looked_at - used} of them kept as they are" if used < looked_at else ""
        notes = [
            f"{looked_at} images{left}, {targets} targets; differences in thousandths, with 95 % intervals over images"
        ]
        if self.calibration is None:
            notes.append(
                "The depth factor was found beforehand on YCB-V's ground truth; --calibration brings one without it"
            )
        if skipped:
            notes.append(f"Left out because they are slow: {', '.join(skipped)}; see --slow and --rows")
        return notes


@dataclass(frozen=True)
class _Result:
    """A row of the table."""

    variant: Variant
    outcome: Outcome | None = None
    mssd: Difference | None = None
    mspd: Difference | None = None
    error: str = ""

    @classmethod
    def of(cls, variant: Variant, outcome: Outcome, reference: Outcome | None, seed: int) -> "_Result":
        if reference is None:
            return cls(variant, outcome)
        changes = (difference(outcome.scores, reference.scores, e, seed=seed) for e in ("ar_mssd", "ar_mspd"))
        return cls(variant, outcome, *changes)

    def line(self) -> str:
        name = self.variant.shown
        if self.outcome is None:
            first, rest = f"{name:<{NAME}}  failed: ", " " * (NAME + 2)
            return textwrap.fill(self.error, WIDTH, initial_indent=first, subsequent_indent=rest)
        p, s = self.outcome.physics, self.outcome.scores
        ms = f"{self.outcome.ms_per_image:.0f}" if self.variant.config is not None else "-"
        return _line(
            name,
            f"{s.ar_mssd:.3f}",
            _thousandths(self.mssd),
            f"{s.ar_mspd:.3f}",
            _thousandths(self.mspd),
            _number(p["inside_static_3mm"], 100, 0),
            _number(p["above_support_3mm"], 100, 0),
            _number(p["penetration_object_median_mm"], 1, 1),
            _number(p["penetration_object_p95_mm"], 1, 1),
            ms,
        )

    def to_dict(self) -> dict[str, Any]:
        v, o = self.variant, self.outcome
        content: dict[str, Any] = {
            "name": v.name,
            "label": v.shown,
            "group": v.group,
            "planes": v.knowledge,
            "config": None if v.config is None else _plain(dataclasses.asdict(v.config)),
            "error": self.error or None,
        }
        if o is not None:
            content |= {"ar_mssd": o.scores.ar_mssd, "ar_mspd": o.scores.ar_mspd, **o.physics}
            content["ms_per_image"] = o.ms_per_image
            for name, change in (("difference_mssd", self.mssd), ("difference_mspd", self.mspd)):
                content[name] = None if change is None else change._asdict()
        return content


def _line(name: str, *cells: str) -> str:
    widths = (5, 17, 5, 17, 4, 5, 6, 4, 6)
    return "  ".join([f"{name:<{NAME}}", *(f"{c:>{w}}" for c, w in zip(cells, widths, strict=True))]).rstrip()


def _header() -> str:
    over, overlap = f"{'over 3 mm [%]':>13}", f"{'overlap [mm]':>12}"
    recalls = "  ".join(f"{name:<7}{'Δ·10³ [95 %]':>17}" for name in ("AR_MSSD", "AR_MSPD"))
    below = "  ".join([f"{'in':>4}", "above", "median", "95 %", " image"])
    return "\n".join([f"{'':{NAME + 52}}{over}  {overlap}  ms per", f"{'':{NAME}}  {recalls}  {below}", "-" * WIDTH])


def _thousandths(d: Difference | None) -> str:
    if d is None:
        return "-"
    value, low, high = (f"{n:+d}" if n else "0" for n in (round(1000 * x) for x in d))
    return f"{value} [{low}, {high}]"


def _number(x: float | None, factor: float, digits: int) -> str:
    return "-" if x is None else f"{factor * x:.{digits}f}"


def _plain(value: Any) -> Any:
    """The same for JSON: paths and infinities as text."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Path) or (isinstance(value, float) and not math.isfinite(value)):
        return str(value)
    return value
