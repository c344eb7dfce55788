"""Variants of the refiner and baselines on the images of a BOP result file: poses, recalls, physics and time of each."""

import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from physpose_torch.ablation import Knowledge, Variant, disturb, with_exact_planes, without_planes
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.harm import RESAMPLES, Matches, match_acting, mssd_of
from physpose_torch.bop.metrics import Scores, evaluate
from physpose_torch.bop.scenes import ImageScene, poses_of
from physpose_torch.errors import PhysPoseError
from physpose_torch.losses import acting
from physpose_torch.refiner import PhysPoseRefiner, silent_doubts
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene

__all__ = ["Ablation", "Batch", "Difference", "Disturbance", "Outcome", "difference", "prepare", "restricted"]

MUCH = 3.0
"""[mm]; penetrations and gaps above this count."""


class Disturbance(NamedTuple):
    """How wrong disturbed planes are."""

    tilt: float
    """Standard deviation about each of two axes [rad]."""
    offset: float
    """Standard deviation of the height [m]."""
    seed: int
    """Of the draws; an image's own draw does not depend on which other images there are."""


@dataclass(eq=False)
class Batch:
    """Some images, with their scenes as one for each knowledge of the planes."""

    images: list[ImageScene]
    rows: np.ndarray
    """Their rows of the estimates, in the order of the scene."""
    measured: Tensor
    """T̃_camera_object (N, 4, 4) [m]."""
    scores: Tensor
    """(N,)."""
    disturbance: Disturbance
    _scenes: dict[Knowledge, Scene] = field(default_factory=dict)

    @classmethod
    def of(cls, images: list[ImageScene], estimates: Estimates, disturbance: Disturbance) -> "Batch":
        rows = np.concatenate([i.rows for i in images])
        return cls(images, rows, *poses_of(images, estimates), disturbance)

    def scene(self, knowledge: Knowledge = "known") -> Scene:
        """The scene, made once."""
        if knowledge not in self._scenes:
            start = np.cumsum([0, *(len(i.rows) for i in self.images)])
            parts = [
                self._told(image, knowledge, slice(a, b))
                for image, a, b in zip(self.images, start[:-1], start[1:], strict=True)
            ]
            self._scenes[knowledge] = Scene.cat(parts)
        return self._scenes[knowledge]

    def _told(self, image: ImageScene, knowledge: Knowledge, part: slice) -> Scene:
        if knowledge == "none":
            return without_planes(image.scene)
        if knowledge == "exact":
            return with_exact_planes(image.scene)
        if knowledge == "disturbed":
            tilt, offset, seed = self.disturbance
            state = np.random.SeedSequence([seed, image.scene_id, image.im_id]).generate_state(1)
            generator = torch.Generator().manual_seed(int(state[0]))
            poses, scores = self.measured[part], self.scores[part]
            return disturb(image.scene, poses, tilt=tilt, offset=offset, generator=generator, scores=scores)
        return image.scene


def prepare(images: list[ImageScene], estimates: Estimates, disturbance: Disturbance) -> list[Batch]:
    """One batch of those images that have a scene and can be measured; an image that cannot is told its problem."""
    images = [i for i in images if i.scene is not None and not i.problems]
    if not images:
        return []
    batch = Batch.of(images, estimates, disturbance)
    try:
        physics_report(batch.measured, batch.scene(), scores=batch.scores)
    except PhysPoseError as error:
        if len(images) > 1:
            return [b for i in images for b in prepare([i], estimates, disturbance)]
        images[0].problems.append(f"{images[0].name}: {error}")
        return []
    return [batch]


def restricted(dataset: BopDataset, images: Collection[tuple[int, int]]) -> BopDataset:
    """The same dataset, with the targets of these images, (scene_id, im_id), only."""
    options = {"models": dataset.models_path, "targets": dataset.targets_path}
    part = BopDataset(dataset.path, split=dataset.split_path.name, **options)
    part.targets = [t for t in dataset.targets if t[:2] in images]
    return part


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a variant."""

    poses: Tensor
    """(rows, 4, 4) [m] of the whole file; rows of no batch are as in the file."""
    scores: Scores
    physics: dict[str, float | None]
    """Figures of the objects that act, measured with the planes as known; None where there is nothing to measure."""
    ms_per_image: float
    mssd: np.ndarray
    """Of the objects in :attr:`Ablation.matches`, to the same instances [m]."""


class Ablation:
    """Runs variants on the same images, each once.

    Args:
        estimates: the result file.
        dataset: whose targets are scored, see :func:`restricted`.
        batches: the images.
    """

    def __init__(self, estimates: Estimates, dataset: BopDataset, batches: list[Batch]) -> None:
        self.estimates, self.dataset, self.batches = estimates, dataset, batches
        self._done: dict[Any, Outcome] = {}
        self._cold = True

    @cached_property
    def matches(self) -> Matches:
        """The estimates that act in some batch, with the ground truth that they are held against."""
        acts = np.zeros(len(self.estimates), dtype=bool)
        for batch in self.batches:
            acts[batch.rows] = acting(batch.scene(), batch.scores).numpy()
        return match_acting(self.estimates, self.dataset, acts)

    def run(self, variant: Variant, on_images: Callable[[int], Any] | None = None) -> Outcome:
        """Poses of a variant, and what they are worth.

        Args:
            variant: what to run.
            on_images: called with how many images have been done, for a progress bar.

        Raises:
            PhysPoseError: the refiner refuses.
        """
        if variant.key not in self._done:
            self._done[variant.key] = self._run(variant, on_images or (lambda n: None))
        elif on_images is not None:
            on_images(sum(len(b.images) for b in self.batches))
        return self._done[variant.key]

    def _warm_up(self, variant: Variant) -> None:
        """Load kernels, and the first time find out what is remembered of each body, outside of the time that is taken."""
        refiner = PhysPoseRefiner(replace(variant.config, steps=1))
        for batch in self.batches[: None if self._cold else 1]:
            images = torch.arange(len(batch.images) if self._cold else 1)
            scene, rows = batch.scene(variant.knowledge).select(images)
            with silent_doubts():
                refiner(batch.measured[rows], scene, scores=batch.scores[rows])
        self._cold = False

    def _run(self, variant: Variant, on_images: Callable[[int], Any]) -> Outcome:
        poses, seconds, reports = self.estimates.T_camera_object.clone(), 0.0, []
        refiner = None if variant.config is None else PhysPoseRefiner(variant.config)
        if variant.config is not None:
            self._warm_up(variant)
        for batch in self.batches:
            scene = batch.scene(variant.knowledge)
            start = time.perf_counter()
            if refiner is None:
                new = variant.baseline(batch.measured, scene)
            else:
                with silent_doubts():
                    new = refiner(batch.measured, scene, scores=batch.scores).poses
            seconds += time.perf_counter() - start
            poses[batch.rows] = new
            known = batch.scene()  # whatever the variant was told
            report = physics_report(new, known, scores=batch.scores)
            reports.append((report, acting(known, batch.scores), known))
            on_images(len(batch.images))
        count = sum(len(b.images) for b in self.batches)
        scores = evaluate(self.estimates, self.dataset, poses=poses)
        mssd = mssd_of(self.matches, self.estimates, self.dataset, poses)
        return Outcome(poses, scores, _figures(reports), 1000 * seconds / max(count, 1), mssd)


def _figures(reports: Iterable) -> dict[str, float | None]:
    in_static, in_object, gap = [], [], []
    for report, acts, scene in reports:
        in_static.append(1e3 * report.penetration_static[acts & scene.has_static[scene.image]])
        in_object.append(1e3 * report.penetration_object[acts])
        height = 1e3 * report.gap[acts]
        gap.append(height[height.isfinite()])
    in_static, in_object, gap = (np.concatenate([[], *x]) for x in (in_static, in_object, gap))
    return {
        "inside_static_3mm": float((in_static > MUCH).mean()) if len(in_static) else None,
        "above_support_3mm": float((gap > MUCH).mean()) if len(gap) else None,
        "inside_object_3mm": float((in_object > MUCH).mean()) if len(in_object) else None,
        "penetration_object_median_mm": float(np.median(in_object)) if len(in_object) else None,
        "penetration_object_p95_mm": float(np.quantile(in_object, 0.95)) if len(in_object) else None,
    }


class Difference(NamedTuple):
    """Of an average recall to that of the reference, and the 95 % interval of it."""

    value: float
    low: float
    high: float


def difference(scores: Scores, reference: Scores, error: str, *, seed: int = 0) -> Difference:
    """Paired bootstrap over images: images are drawn with replacement, all scenes together, and weigh as much as targets.

    Args:
        scores, reference: of the same targets.
        error: ``ar_mssd`` or ``ar_mspd``.
        seed: of the draws.
    """
    images = sorted(reference.per_image)
    weight = np.array([reference.per_image[i].targets for i in images], dtype=np.float64)
    gain = np.array([getattr(scores.per_image[i], error) - getattr(reference.per_image[i], error) for i in images])
    drawn = np.random.default_rng(seed).integers(len(images), size=(RESAMPLES, len(images)))
    means = (weight * gain)[drawn].sum(1) / weight[drawn].sum(1)
    low, high = np.quantile(means, [0.025, 0.975]).tolist()
    return Difference(float((weight * gain).sum() / weight.sum()), low, high)
