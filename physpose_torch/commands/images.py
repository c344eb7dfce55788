"""What commands over the images of a result file share: their options, opening the files, and images by the batch."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

import numpy as np
import tyro

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates, read_estimates, read_planes, read_statics
from physpose_torch.bop.scenes import BodyLibrary, ImageScene, image_scenes
from physpose_torch.bop.table import TablesOnTheWay, read_pairs
from physpose_torch.config import TableConfig
from physpose_torch.errors import InvalidInputError, PhysPoseError
from physpose_torch.table.estimator import TableEstimator

__all__ = ["ImageOptions", "Images", "in_batches", "together"]


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
        if not self.plane_sigma_mm >= 0:
            raise InvalidInputError(f"--plane-sigma-mm {self.plane_sigma_mm}: expected a number >= 0")
        if self.batch < 1 or self.every < 1:
            raise InvalidInputError(f"--batch {self.batch}, --every {self.every}: expected positive numbers")
        estimates = read_estimates(self.estimates)
        dataset = BopDataset(self.dataset, split=self.split, models=self.models, targets=self.targets)
        broken: dict[tuple[int, int], list[str]] = {}
        unplaced = []
        planes = None
        bad = list(estimates.problems)
        if self.planes is not None:
            planes, bad_planes = read_planes(self.planes)
            bad += bad_planes
        for problem in bad:
            if problem.scene_id is None or problem.im_id is None:
                unplaced.append(problem.message)
            else:
                broken.setdefault((problem.scene_id, problem.im_id), []).append(problem.message)
        counts = {}
        if dataset.targets_path is not None:  # never from the ground truth
            counts = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in dataset.targets}
        statics = read_statics(self.statics) if self.statics is not None else []
        readable = dict.fromkeys(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True))
        keys = [k for k in {**readable, **broken} if not self.scenes or k[0] in self.scenes][:: self.every]
        # none of these images' rows could be read; a bad plane of an image without rows harms nobody
        bad_rows = {(p.scene_id, p.im_id) for p in estimates.problems}
        lost = [k for k in keys if k in bad_rows and k not in readable]
        nothing = np.zeros(0, dtype=np.int64)
        rest = [ImageScene(*key, nothing, problems=broken[key]) for key in lost]
        if unplaced:
            rest.append(ImageScene(-1, -1, nothing, problems=unplaced))
        images = image_scenes(
            estimates,
            BodyLibrary(dataset),
            planes=planes,
            find_table=self._tables(estimates, dataset),
            plane_sigma=self.plane_sigma_mm / 1000,
            statics=statics,
            counts=counts,
            broken=broken,
            wanted=set(keys),
        )
        return Images(estimates, dataset, sum(k in readable for k in keys) + len(rest), chain(images, rest))


    def _tables(self, estimates: Estimates, dataset: BopDataset) -> TablesOnTheWay | None:
        if self.table is None:
            if self.pairs is not None:
                raise InvalidInputError(f"--pairs {self.pairs} says where second images are; add --table auto to use them")
            return None
        pairs = read_pairs(self.pairs) if self.pairs is not None else {}
        return TablesOnTheWay(estimates, dataset, pairs, TableEstimator(TableConfig(method=self.table)))


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
