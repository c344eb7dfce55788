"""``physpose calibrate``: an estimator's depth bias and spread, from its estimates on known tables and no labels."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from physpose_torch.bop.calibration import write_calibration
from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.scenes import ImageScene, poses_of
from physpose_torch.calibrate import Observations, calibrate, observe
from physpose_torch.commands.common import check_output, progress, table
from physpose_torch.commands.images import ImageOptions, in_batches, together
from physpose_torch.config import Calibration
from physpose_torch.errors import InvalidInputError
from physpose_torch.scene import Scene

__all__ = ["Calibrate"]

logger = logging.getLogger("physpose_torch")


@dataclass(frozen=True, kw_only=True)
class Calibrate(ImageOptions):
    """Estimate how an estimator errs from what must be true of objects that stand on a known table; no labels are used.

    Writes the factor that its translations must be multiplied by, and its standard deviations along and across the viewing
    ray and in rotation, each with a 95 % confidence interval (bootstrap over scenes, then their images). Use many images of
    many arrangements, from different heights: from one direction, errors along and across the ray look alike.
    """

    planes: Path | None = None
    """Table planes, which are needed: {scene: {image: {"normal": [3], "offset_mm": x}}} or {"R": 3x3, "t": [m]}."""
    plane_sigma_mm: float = 0.0
    """Standard deviation of the height of planes whose entry states none. 0: what planes are off by is put down to the
    estimator, and a refinement with such planes can count on it."""
    out: Path
    """Calibration to write, JSON; physpose refine --calibration takes it."""
    resamples: int = 50
    """How often the images are drawn anew, for the intervals; 0: no intervals."""
    seed: int = 0
    """Of these draws."""
    quiet: bool = False
    """No progress bar and no table."""

    def __call__(self) -> int:
        if self.planes is None:
            raise InvalidInputError("physpose calibrate needs the table: give --planes P.json")
        if self.resamples < 0 or self.resamples == 1 or self.seed < 0:
            raise InvalidInputError(
                f"--resamples {self.resamples}, --seed {self.seed}: expected 0, or 2 or more resamples, and a seed >= 0"
            )
        check_output(self.out)
        opened = self.open()
        observations, clusters, problems = [], [], []
        with progress(opened.count, "look", "image", quiet=self.quiet) as bar:
            for batch in in_batches(opened.scenes, self.batch):
                for seen, scenes in together(batch, lambda images: _observe(images, opened.estimates)):
                    observations.append(seen)
                    clusters += scenes
                problems += [problem for image in batch for problem in image.problems]
                bar.update(len(batch))
        for problem in problems:
            logger.error(problem)
        seen = Observations.cat(observations)
        with progress(self.resamples, "resample", "fit", quiet=self.quiet) as bar:
            calibration = calibrate(
                seen,
                cluster=torch.tensor(clusters, dtype=torch.long),
                resamples=self.resamples,
                seed=self.seed,
                on_resample=bar.update,
            )
        write_calibration(self.out, calibration, images=seen.images, objects=len(seen.rise))
        if not self.quiet:
            print(f"{len(seen.rise)} estimates in {seen.images} images may stand upright on their plane\n")
            print(_describe(calibration))
            print(f"\nwritten: {self.out}")
        return 1 if problems else 0


def _observe(images: Sequence[ImageScene], estimates: Estimates) -> tuple[Observations, list[int]]:
    """What images say, and the scene that each is in."""
    poses, scores = poses_of(images, estimates)
    seen = observe(poses, Scene.cat([image.scene for image in images]), scores=scores)
    return seen, [image.scene_id for image in images]


def _describe(calibration: Calibration) -> str:
    rows = []
    for name, field, unit, digits in (
        ("depth factor", "depth_factor", 1.0, 4),
        ("σ along the ray, each estimate [%]", "sigma_ray_fraction", 0.01, 2),
        ("σ along the ray, an image's in common [%]", "sigma_depth_common", 0.01, 2),
        ("σ across the ray, per axis [mm]", "sigma_lateral", 1e-3, 2),
        ("σ of rotation, per axis [°]", "sigma_rotation", torch.pi / 180, 2),
    ):
        interval = calibration.interval.get(field)
        bounds = "" if interval is None else " to ".join(f"{x / unit:.{digits}f}" for x in interval)
        rows.append([name, f"{getattr(calibration, field) / unit:.{digits}f}", bounds])
    return table(["", "estimate", "95 % interval"], rows)
