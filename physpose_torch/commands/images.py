"""What commands over the images of a result file share: their options, opening the files, and images by the batch."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

import numpy as np
import tyro

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates, PlaneRecord, StaticRecord, read_estimates, read_planes, read_statics
from physpose_torch.bop.scenes import BodyLibrary, ImageScene, image_scenes
from physpose_torch.bop.table import Pair, TablesOnTheWay, read_pairs
from physpose_torch.config import TableConfig
from physpose_torch.errors import InvalidInputError, PhysPoseError
from physpose_torch.table.estimator import TableEstimator

__all__ = ["ImageOptions", "Images", "Known", "in_batches", "together"]


T = TypeVar("T")
class Images(NamedTuple):
    """An opened result file."""

    estimates: Estimates
    dataset: BopDataset
    count: int
    """How many images there are to look at or to complain about."""
    scenes: Iterator[ImageScene]
    """These, in file order, made one by one; those without a scene tell their problems."""


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """Which images of a result file, and what is known about them."""

    estimates: Annotated[Path, tyro.conf.Positional]
    """Result file: scene_id,im_id,obj_id,score,R,t,time (t in mm)."""
    dataset: Path
    """BOP dataset folder."""
    planes: Path | None = None
    """Table planes: {scene: {image: {"normal": [3], "offset_mm": x}}} or {"R": 3x3, "t": [m]}. Without: collisions only."""
    table: Literal["auto", "joint", "support"] | None = None
    """Estimate the table plane of images that PLANES has none for: from the objects' poses and, with auto and joint, from the
    dataset's images or those that PAIRS names."""
    pairs: Path | None = None
    """Second images and gravity for --table: {scene: {image: {"second": image, "files": [first, second], "gravity": [3]}}}, all
    optional: files only where the dataset has no images, gravity pointing down in the image's camera."""
    plane_sigma_mm: float = 2.0
    """Standard deviation of the height of planes whose entry states none; contacts are as soft. 0: they are exact. Scans,
    true poses and tables agree to a few mm, not better."""
    statics: Path | None = None
    """Static meshes or boxes with their poses, JSON."""
    models: Path | None = None
    """Folder of the meshes, instead of DATASET/models."""
    split: str | None = None
    """Split of the dataset, if it has several."""
    targets: Path | None = None
    """Targets file: how many instances of each object an image has. Default: the dataset's, if there."""
    scenes: tuple[int, ...] = ()
    """Only these scenes."""
    every: int = 1
    """Only every n-th image."""
    batch: int = 16
    """Images at a time."""

    def open(self) -> Images:
        """Read the files; scenes are made later, one by one.

        Raises:
            InvalidInputError: an option out of range.
            DataError: a file is missing or broken as a whole.
        """
        self.check()
        estimates = read_estimates(self.estimates)
        known = self.known()
        readable = dict.fromkeys(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True))
        lost = {(p.scene_id, p.im_id): None for p in estimates.problems if None not in (p.scene_id, p.im_id)}
        keys = [k for k in {**readable, **lost} if not self.scenes or k[0] in self.scenes][:: self.every]
        unplaced = [p.message for p in estimates.problems if None in (p.scene_id, p.im_id)]
        rest = [ImageScene(-1, -1, np.zeros(0, dtype=np.int64), problems=unplaced)] if unplaced else []
        return Images(estimates, known.dataset, len(keys) + len(rest), chain(known.images(estimates, keys), rest))

    def check(self) -> None:
        """Refuse options that are out of range.

        Raises:
            InvalidInputError: the first one.
        """
        if not self.plane_sigma_mm >= 0:
            raise InvalidInputError(f"--plane-sigma-mm {self.plane_sigma_mm}: expected a number >= 0")
        if self.batch < 1 or self.every < 1:
            raise InvalidInputError(f"--batch {self.batch}, --every {self.every}: expected positive numbers")
        if self.table is None and self.pairs is not None:
            raise InvalidInputError(f"--pairs {self.pairs} says where second images are; add --table auto to use them")

    def known(self) -> "Known":
        """Read what is known about the images, but for the estimates.

        Raises:
            DataError: a file is missing or broken as a whole.
        """
        dataset = BopDataset(self.dataset, split=self.split, models=self.models, targets=self.targets)
        planes, bad_planes = read_planes(self.planes) if self.planes is not None else (None, [])
        counts = {}
        if dataset.targets_path is not None:  # never from the ground truth
            counts = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in dataset.targets}
        return Known(
            dataset=dataset,
            library=BodyLibrary(dataset),
            planes=planes,
            bad_planes={(p.scene_id, p.im_id): p.message for p in bad_planes},
            plane_sigma=self.plane_sigma_mm / 1000,
            statics=read_statics(self.statics) if self.statics is not None else [],
            counts=counts,
            pairs=read_pairs(self.pairs) if self.pairs is not None else {},
            table=None if self.table is None else TableEstimator(TableConfig(method=self.table)),
        )


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known about the images of a result file, but for the estimates."""

    dataset: BopDataset
    library: BodyLibrary
    planes: dict[tuple[int, int], PlaneRecord] | None
    """By (scene_id, im_id); None: not asked for."""
    bad_planes: dict[tuple[int, int], str]
    """What is wrong with a plane."""
    plane_sigma: float
    """σ of the height of planes that state none [m]."""
    statics: list[StaticRecord]
    counts: dict[tuple[int, int, int], int]
    """Number of instances by (scene_id, im_id, obj_id)."""
    pairs: dict[tuple[int, int], Pair]
    table: TableEstimator | None
    """None: planes are not estimated."""

    def images(self, estimates: Estimates, keys: Sequence[tuple[int, int]]) -> Iterator[ImageScene]:
        """The images with these (scene_id, im_id): first those with usable rows, in file order and made one by one, then the
        others in the order of ``keys``; those without a scene tell their problems."""
        wanted = set(keys)
        broken: dict[tuple[int, int], list[str]] = {}
        for problem in estimates.problems:
            if (problem.scene_id, problem.im_id) in wanted:
                broken.setdefault((problem.scene_id, problem.im_id), []).append(problem.message)
        for key in keys:  # a bad plane of an image without rows harms nobody
            if key in self.bad_planes:
                broken.setdefault(key, []).append(self.bad_planes[key])
        readable = set(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True))
        find_table = None
        if self.table is not None:
            find_table = TablesOnTheWay(estimates, self.dataset, self.pairs, self.table)
        images = image_scenes(
            estimates,
            self.library,
            planes=self.planes,
            find_table=find_table,
            plane_sigma=self.plane_sigma,
            statics=self.statics,
            counts=self.counts,
            broken=broken,
            wanted=wanted,
        )
        nothing = np.zeros(0, dtype=np.int64)
        lost = [ImageScene(*key, nothing, problems=broken[key]) for key in keys if key not in readable]
        return chain(images, lost)

    def partners(self, keys: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
        """(scene_id, im_id) of the second images of these images, whose estimates are used with theirs."""
        seconds = ((key[0], self.pairs[key].second) for key in keys if key in self.pairs)
        return [(scene, second) for scene, second in seconds if second is not None] if self.table is not None else []


def in_batches(images: Iterable[ImageScene], size: int) -> Iterator[list[ImageScene]]:
    """The images in order, ``size`` of those with a scene at a time; the others come along."""
    batch, ready = [], 0
    for image in images:
        batch.append(image)
        ready += image.scene is not None
        if ready == size:
            yield batch
            batch, ready = [], 0
    if batch:
        yield batch


def together(images: Iterable[ImageScene], work: Callable[[Sequence[ImageScene]], T]) -> list[T]:
    """What ``work`` makes of those images that have a scene; if it refuses, of each, so that only the culprit is left out."""
    images = [i for i in images if i.scene is not None]
    if not images:
        return []
    try:
        return [work(images)]
    except PhysPoseError as error:
        if len(images) == 1:
            images[0].problems.append(f"{images[0].name}: {error}")
            return []
        return [made for i in images for made in together([i], work)]
