"""From a BOP result file to scenes and back: one scene an image, with what could not be used set aside."""

import logging
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from physpose_torch.alternatives import find_alternatives
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates, PlaneRecord, StaticRecord
from physpose_torch.errors import PhysPoseError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.scene import Scene, Static

__all__ = ["BodyLibrary", "ImageScene", "image_scenes", "plane_of"]

MM = 1e-3
logger = logging.getLogger("physpose_torch")


class BodyLibrary:
    """Bodies of a dataset's models and of static meshes, each made once.

    Args:
        dataset: where the models are.
        options: decomposition options, see :meth:`Body.from_mesh`.
    """

    def __init__(self, dataset: BopDataset, **options) -> None:
        self.dataset = dataset
        self.options = options
        self._made: dict[object, Body | PhysPoseError] = {}

    def model(self, obj_id: int) -> Body:
        """The body of a BOP object; the same error again if it could not be made."""
        return self._once(obj_id, self._make_model)

    def static(self, record: StaticRecord) -> Body:
        """The body of a static mesh or box."""
        return self._once(record, self._make_static)

    def _once(self, key, make) -> Body:
        if key not in self._made:
            try:
                self._made[key] = make(key)
            except PhysPoseError as error:
                self._made[key] = error
        made = self._made[key]
        if isinstance(made, PhysPoseError):
            raise made
        return made

    def _make_model(self, obj_id: int) -> Body:
        path = self.dataset.model_path(obj_id)
        return Body.from_mesh(path, label=f"obj_{obj_id:06d}", scale=MM, **self.options)

    def _make_static(self, record: StaticRecord) -> Body:
        if record.mesh is None:
            return Body.box(record.box, label=record.label)
        return Body.from_mesh(record.mesh, label=record.label, scale=record.scale, **self.options)


@dataclass
class ImageScene:
    """One image of a result file."""

    scene_id: int
    im_id: int
    rows: np.ndarray
    """Indices of its rows in the :class:`Estimates`."""
    scene: Scene | None = None
    """None if the image cannot be refined."""
    problems: list[str] = field(default_factory=list)
    """Why not."""

    @property
    def name(self) -> str:
        return f"scene {self.scene_id} image {self.im_id}"


def plane_of(record: PlaneRecord, *, sigma: float = 0.0) -> Plane:
    """The plane of a planes file; where the file states no σ of its height it is ``sigma`` [m], and no tilt is none."""
    tilt, offset = np.deg2rad(record.sigma_deg or 0.0), sigma if record.sigma is None else record.sigma
    covariance = torch.diag(torch.tensor([tilt**2, tilt**2, offset**2], dtype=torch.float64))
    position = torch.tensor(record.offset, dtype=torch.float64)
    return Plane(record.normal, position, covariance if tilt > 0 or offset > 0 else None)


def image_scenes(
    estimates: Estimates,
    library: BodyLibrary,
    *,
    planes: Mapping[tuple[int, int], PlaneRecord] | None = None,
    plane_sigma: float = 0.0,
    find_table: Callable[[int, int, Scene, np.ndarray], tuple[Plane, tuple[str, ...]]] | None = None,
    statics: Sequence[StaticRecord] = (),
    counts: Mapping[tuple[int, int, int], int] | None = None,
    broken: Mapping[tuple[int, int], list[str]] | None = None,
    wanted: Container[tuple[int, int]] | None = None,
) -> Iterator[ImageScene]:
    """One scene for each image that the estimates name, in file order, made when it is asked for.

    Args:
        estimates: the result file.
        library: bodies by obj_id.
        planes: table plane by (scene_id, im_id); an image without one gets no gravity and is refined by collisions only,
            and says so if ``planes`` is given at all. None: collisions only, everywhere.
        plane_sigma: σ of the height of planes that state none [m].
        find_table: estimates the plane of images that ``planes`` has none for: (scene_id, im_id, scene of the objects, rows)
            to the plane, and what should be known of it.
        statics: static bodies, see :func:`physpose_torch.bop.formats.read_statics`.
        counts: (scene_id, im_id, obj_id) → number of instances, from a targets file.
        broken: images with rows or planes that cannot be used, and why; they are left alone.
        wanted: (scene_id, im_id) of the images to look at; None: all.
    """
    images: dict[tuple[int, int], list[int]] = {}
    for row, key in enumerate(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True)):
        if wanted is None or key in wanted:
            images.setdefault(key, []).append(row)
    for key, rows in images.items():
        image = ImageScene(*key, np.array(rows), problems=list((broken or {}).get(key, [])))
        if not image.problems and planes is not None and key not in planes and find_table is None:
            image.problems.append(f"{image.name}: no plane in the planes file; add one, or leave out --planes")
        if not image.problems:
            try:
                image.scene = _scene(image, estimates, library, planes, plane_sigma, find_table, statics, counts or {})
            except PhysPoseError as error:
                image.problems.append(f"{image.name}: {error}")
        yield image


def _scene(image, estimates, library, planes, plane_sigma, find_table, statics, counts) -> Scene:
    key = (image.scene_id, image.im_id)
    obj_ids = estimates.obj_id[image.rows].tolist()
    objects = [library.model(i) for i in obj_ids]
    known = {
        (0, body.label): counts[(*key, i)] for i, body in zip(obj_ids, objects, strict=True) if (*key, i) in counts
    }
    measured, scores = poses_of([image], estimates)
    same = find_alternatives(measured, Scene(objects), scores, counts=known)
    plane, standing, gravity = None, [], None
    if planes is not None and key in planes:
        plane = plane_of(planes[key], sigma=plane_sigma)
    elif find_table is not None:
        plane, warnings = find_table(*key, Scene(objects, same_object=same), image.rows)
        for warning in warnings:
            logger.warning("%s: table: %s", image.name, warning)
    if plane is not None:
        standing.append(Static(plane))
        gravity = -plane.normal
    for record in statics:
        pose = record.pose(*key)
        if pose is not None:
            standing.append(Static(library.static(record), pose))
    return Scene(objects, standing, gravity=gravity, same_object=same)


def poses_of(images: Sequence[ImageScene], estimates: Estimates) -> tuple[Tensor, Tensor]:
    """Poses (N, 4, 4) [m] and scores (N,) of several images, in the order of their concatenated scene."""
    rows = np.concatenate([i.rows for i in images]) if images else np.zeros(0, dtype=np.int64)
    return estimates.T_camera_object[rows], torch.from_numpy(estimates.score[rows])
