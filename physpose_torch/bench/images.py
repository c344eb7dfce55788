"""What the benchmarks run on: real YCB-V images with estimated poses, or generated tabletop scenes."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import read_estimates, read_planes
from physpose_torch.bop.scenes import BodyLibrary, image_scenes, poses_of
from physpose_torch.errors import DataError, InvalidInputError, PhysPoseError
from physpose_torch.geometry.body import Plane
from physpose_torch.scene import Scene

__all__ = ["BenchImage", "ImageSet", "batch_of", "load_images"]

PLANE_SIGMA = 0.0025
"""[m], what ``physpose refine`` assumes of a plane whose entry states none."""
ARRANGEMENTS = 64
"""Generated scenes that differ; more images than that repeat them under other estimation errors."""


@dataclass(frozen=True, eq=False)
class BenchImage:
    """One image: its scene and the estimates."""

    scene: Scene
    poses: Tensor
    """T_camera_object (N, 4, 4) [m], float64."""
    scores: Tensor | None = None
    """(N,)."""


@dataclass(frozen=True, eq=False)
class ImageSet:
    """Images, where they come from, and what it took to build them."""

    source: str
    images: list[BenchImage]
    seconds_bodies: float
    """Meshes and their convex parts, from the disk cache if they are there."""
    seconds_scenes: float
    """All scenes, bodies excluded."""


def load_images(count: int, *, data: Path | None = None, seed: int = 0) -> ImageSet:
    """Up to ``count`` images, spread evenly over the data: YCB-V of ``data`` or ``PHYSPOSE_DATA``, else generated ones.

    Raises:
        DataError: ``data`` is given and holds no ``ycbv`` folder with estimates.
        InvalidInputError: ``count`` is not positive.
    """
    if count < 1:
        raise InvalidInputError(f"{count} images: expected at least one")
    if data is None and os.environ.get("PHYSPOSE_DATA"):
        data = Path(os.environ["PHYSPOSE_DATA"])
    if data is None:
        return _household(count, seed)
    if not (data / "ycbv").is_dir():
        raise DataError(f"{data}: no folder ycbv/ in it; unset PHYSPOSE_DATA to use generated scenes")
    return _ycbv(data / "ycbv", count)


def batch_of(images: Sequence[BenchImage]) -> tuple[Scene, Tensor, Tensor | None]:
    """One scene, poses (N, 4, 4) and scores (N,) of several images."""
    scores = [i.scores for i in images]
    return (
        Scene.cat([i.scene for i in images]),
        torch.cat([i.poses for i in images]),
        None if any(s is None for s in scores) else torch.cat(scores),
    )


def _ycbv(root: Path, count: int) -> ImageSet:
    """As ``physpose refine`` builds them: estimates, table planes, numbers of instances from the targets file."""
    files = sorted((root / "estimates").glob("*.csv"))
    if not files:
        raise DataError(f"{root / 'estimates'}: no estimates (*.csv) in it")
    estimates = read_estimates(files[0])
    planes, _ = read_planes(root / "table_planes.json")
    dataset = BopDataset(root)
    all_keys = list(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True))
    keys = list(dict.fromkeys(all_keys))
    wanted = {keys[i * len(keys) // count] for i in range(count)} if count < len(keys) else set(keys)
    counts = {}
    if dataset.targets_path is not None:
        counts = {(t.scene_id, t.im_id, t.obj_id): t.inst_count for t in dataset.targets}
    library = BodyLibrary(dataset)
    start = time.perf_counter()
    rows = zip(all_keys, estimates.obj_id.tolist(), strict=True)
    for obj_id in sorted({obj_id for key, obj_id in rows if key in wanted}):
        try:
            library.model(obj_id)
        except PhysPoseError:  # its images say so below
            continue
    middle = time.perf_counter()
    found = list(image_scenes(estimates, library, planes=planes, plane_sigma=PLANE_SIGMA, counts=counts, wanted=wanted))
    ready = [i for i in found if i.scene is not None]
    seconds_scenes = time.perf_counter() - middle
    if not ready:
        raise DataError(f"{files[0]}: no image of it can be used; {found[0].problems[0] if found else 'it is empty'}")
    images = [BenchImage(i.scene, *poses_of([i], estimates)) for i in ready]
    return ImageSet(f"YCB-V, {len(images)} images, {files[0].name}", images, middle - start, seconds_scenes)


def _household(count: int, seed: int) -> ImageSet:
    from physpose_torch.demo import household_bodies
    from physpose_torch.household import household_scene, perturb_like_estimator

    start = time.perf_counter()
    bodies = household_bodies()
    middle = time.perf_counter()
    truths = [household_scene(seed + i) for i in range(min(count, ARRANGEMENTS))]
    images = []
    for i in range(count):
        truth = truths[i % len(truths)]
        plane = Plane(truth.normal, torch.tensor(truth.offset, dtype=torch.float64))
        scene = Scene.tabletop([bodies[n] for n in truth.names], plane)
        images.append(BenchImage(scene, perturb_like_estimator(truth.T_camera_object, seed=seed + i)))
    return ImageSet(f"generated household scenes, {count} images", images, middle - start, time.perf_counter() - middle)
