"""``physpose ablate``: plain baselines, and the refiner with one thing changed at a time, in one table."""

import dataclasses
import json
import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from physpose_torch.ablation import Variant, as_estimated, choose, list_variants
from physpose_torch.bop.ablation import Ablation, Batch, Disturbance, Outcome, prepare, restricted
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.harm import NOTABLE
from physpose_torch.bop.planted import plant, true_images
from physpose_torch.bop.scenes import ImageScene
from physpose_torch.commands.ablate_table import Row, header, plain, planted_header
from physpose_torch.commands.common import check_output, progress
from physpose_torch.commands.images import ImageOptions, in_batches
from physpose_torch.config import Calibration, RefinerConfig
from physpose_torch.errors import InvalidInputError, PhysPoseError
from physpose_torch.files import write_file
from physpose_torch.losses import acting
from physpose_torch.planted import Failure, FailureName, choose_failures

__all__ = ["Ablate"]

logger = logging.getLogger("physpose_torch")


@dataclass(frozen=True, kw_only=True)
class Ablate(ImageOptions):
    """Compare the refiner with plain baselines, with each cost term and each choice on and off, and with less knowledge.

    One table: average recalls of MSSD and MSPD over the targets of the images that the file names; the difference of each
    to the reference, which is the preset as it is, in thousandths with its 95 % interval (paired bootstrap: images are
    drawn with replacement from the file as a whole, all scenes together); how many objects are made worse, that is, have an
    MSSD more than 2 mm above that of the input; how many objects are more than 3 mm inside something static or above their
    support, and how deep they are in each other (95th percentile), all measured with the planes as known. Images that
    cannot be refined keep their poses in all rows, are listed at the end, and the exit code is 1; so it is if a row fails.

    What is made worse is counted among the estimates that act and are matched with a ground truth instance of their object
    in their image, by the smallest MSSD of the input, each instance and each estimate once; the match stays whatever a row
    makes of the poses. Its interval is a bootstrap over the same images.

    With --plant, failures are planted into the estimates first: a table for each, over the images that it fits, of how much
    each row gains on the planted input. The targets are the same as without.
    """

    calibration: Path | None = None
    """What physpose calibrate wrote: adds rows that use it, and its depth factor replaces that of MegaPose on YCB-V."""
    rows: tuple[str, ...] = ()
    """Only these rows, by name, beside the baselines and the reference. An unknown name lists them all."""
    slow: bool = False
    """Run the slow rows, too."""
    plant: tuple[FailureName, ...] = ()
    """Plant these failures, each on its own, and compare the baselines, the reference and ROWS on them. false-positive: a
    body that is not there in the middle of the others, once with a low and once with a high score; duplicate: a second
    estimate of an object, and no targets file tells that there is one; missing-supporter: no estimate of an object that
    carries another; depth-order: two neighbours with their depths swapped; outliers: 30 % of the objects grossly wrong;
    wrong-plane: once 2 cm too high, once tilted by 8°; accurate: ground truth with 1 mm and 0.5° of noise as the input."""
    disturb_deg: float = 1.5
    """Disturbed planes: standard deviation of the tilt about each of two axes. The refiner is told."""
    disturb_mm: float = 6.0
    """Disturbed planes: standard deviation of the height."""
    seed: int = 0
    """Seed of the disturbed planes, of what is planted and of the bootstrap."""
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
        variants, failures = self._variants(), choose_failures(self.plant)
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
        count = sum(len(b.images) for b in batches)
        part = restricted(dataset, looked_at)
        problems = [p for i in images for p in i.problems]
        if failures:
            listed = dataset.targets if dataset.targets_path is not None else []  # never from the ground truth
            counts = {t[:3]: t.inst_count for t in listed}
            planted = list(self._planted(failures, variants, images, estimates, part, counts))
            problems += [p for block in planted for p in block.pop("problems")]
            content = {"planted": planted}
            failed = any(row["error"] for block in planted for row in block["rows"])
        else:
            rows = self._run(Ablation(estimates, part, batches), variants, header(), Row.line)
            content = {"rows": [row.to_dict() for row in rows]}
            failed = any(row.error for row in rows)
        skipped = [v.name for v in self._all_variants() if v.slow and v not in variants]
        skipped = [] if self.rows or self.plant else skipped
        if self.json is not None:
            content = self._options(estimates, part, len(looked_at), count) | content
            content |= {"skipped": skipped, "problems": problems}
            write_file(self.json, json.dumps(content, indent=2, allow_nan=False) + "\n")
        if not self.quiet:
            print("", *self._notes(part, len(looked_at), count, skipped), sep="\n")
        elif not failures:
            problems += [f"{row.variant.name}: {row.error}" for row in rows if row.error]
        for problem in problems:
            logger.error(problem)
        return 1 if problems or failed else 0

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
        chosen = choose(self._all_variants(), self.rows, slow=self.slow)
        return [v for v in chosen if v.always or self.rows or not self.plant]

    def _calibration(self) -> Calibration | None:
        if self.calibration is None:
            return None
        from physpose_torch.bop.calibration import read_calibration

        return read_calibration(self.calibration)

    def _run(
        self,
        ablation: Ablation,
        variants: list[Variant],
        head: str,
        line: Callable[[Row], str],
        *,
        touched: np.ndarray | None = None,
    ) -> list[Row]:
        """All rows in the order of the table, each printed as soon as it is known; the reference is worked out first."""
        wanted = next(v for v in variants if v.key == (self.config, None, "known"))
        count = sum(len(b.images) for b in ablation.batches)
        rows: list[Row] = []
        with progress(count * (len(variants) + 2), "ablate", "image", quiet=self.quiet) as bar:
            bar.leave = False
            if not self.quiet:
                bar.write(head)
            estimated = next(v for v in variants if v.baseline is as_estimated)
            measured, reference = (self._worked_out(ablation, v, bar) for v in (estimated, wanted))
            for variant in variants:
                bar.set_description(variant.name)
                try:
                    outcome = ablation.run(variant, bar.update)
                    compare = {"reference": reference, "measured": measured, "touched": touched, "seed": self.seed}
                    row = Row.of(variant, outcome, ablation, **compare)
                except PhysPoseError as error:
                    row = Row(variant, error=str(error))
                if not self.quiet:
                    if not rows or rows[-1].variant.group != variant.group:
                        bar.write(f"\n{variant.group}")
                    bar.write(line(row))
                rows.append(row)
        return rows

    @staticmethod
    def _worked_out(ablation: Ablation, variant: Variant, bar: tqdm) -> Outcome | None:
        bar.set_description(variant.name)
        try:
            return ablation.run(variant, bar.update)
        except PhysPoseError:
            return None  # its row will tell

    def _planted(
        self,
        failures: list[Failure],
        variants: list[Variant],
        images: list[ImageScene],
        estimates: Estimates,
        dataset: BopDataset,
        counts: dict[tuple[int, int, int], int],
    ) -> Iterator[dict[str, Any]]:
        """A block for each failure, ready for JSON, printed on the way."""
        known = true_images(images, estimates, dataset)
        for failure in failures:
            planted = plant(failure, known, estimates, counts=counts, seed=self.seed)
            batches = [
                batch
                for some in in_batches(planted.images, self.batch)
                for batch in prepare(some, planted.estimates, self._disturbance)
            ]
            problems = [f"{failure.label}: {p}" for i in planted.images for p in i.problems]
            if not planted.images:
                problems.append(f"{failure.label}: fits none of {len(known.images)} images ({failure.what})")
            there = {(i.scene_id, i.im_id) for i in planted.images}
            part = restricted(dataset, there)
            targets = sum(t.inst_count for t in part.targets)
            block = {
                "name": failure.name,
                "label": failure.label,
                "what": failure.what,
                "images": len(there),
                "rows_planted": int(planted.touched.sum()),
                "rows_planted_acting": sum(
                    int((acting(b.scene(), b.scores).numpy() & planted.touched[b.rows]).sum()) for b in batches
                ),
                "targets": targets,
                "rows": [],
                "problems": problems,
            }
            if batches:
                title = f"{failure.label}: {failure.what}; in {len(there)} of {len(known.images)} images, {targets} targets"
                ablation = Ablation(planted.estimates, part, batches)
                rows = self._run(ablation, variants, planted_header(title), Row.planted_line, touched=planted.touched)
                block["rows"] = [row.to_dict() for row in rows]
            yield block

    def _options(self, estimates: Estimates, dataset: BopDataset, looked_at: int, used: int) -> dict[str, Any]:
        in_file = len(set(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True)))
        options = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "config"}
        return {
            "options": {**plain(options), "config": plain(dataclasses.asdict(self.config))},
            "images": {
                "in_file": in_file,
                "looked_at": looked_at,
                "refined": used,
                "share": looked_at / max(in_file, 1),
            },
            "targets": sum(t.inst_count for t in dataset.targets),
            "made_worse_above_mm": 1000 * NOTABLE,
        }

    def _notes(self, dataset: BopDataset, looked_at: int, used: int, skipped: list[str]) -> list[str]:
        targets = sum(t.inst_count for t in dataset.targets)
        left = f", {looked_at - used} of them kept as they are" if used < looked_at else ""
        to = "to the planted input " if self.plant else ""
        notes = [
            f"{looked_at} images{left}, {targets} targets; differences {to}in thousandths, with 95 % intervals over images"
        ]
        if self.calibration is None:
            notes.append(
                "The depth factor was found beforehand on YCB-V's ground truth; --calibration brings one without it"
            )
        if skipped:
            notes.append(f"Left out because they are slow: {', '.join(skipped)}; see --slow and --rows")
        return notes
