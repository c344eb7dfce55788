"""Tables from images of BOP data: scene files of ``physpose table``, pairs of images, planes for ``physpose refine``."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import MAX_ID, Estimates, load_json
from physpose_torch.errors import DataError, PhysPoseError, UnknownLabelError
from physpose_torch.files import write_file
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.reading import inside, read_pixels, shown
from physpose_torch.scene import Scene
from physpose_torch.table.estimator import TableEstimate, TableEstimator
from physpose_torch.table.view import View

__all__ = ["Pair", "TableScene", "TablesOnTheWay", "load_models", "read_image", "read_pairs", "read_scene", "write_table"]

MM = 1e-3
MESHES = (".ply", ".glb", ".gltf", ".obj", ".stl", ".off")
"""Endings of meshes, in the order of preference."""


class TableScene(NamedTuple):
    """What a scene file says of one or two images."""

    K: Tensor
    """(3, 3) [px], of both views."""
    obj_ids: list[int]
    poses: tuple[Tensor, Tensor]
    """(N, 4, 4) of each view [m], NaN where the file has none."""


class Pair(NamedTuple):
    """Where an image and its partner are."""

    second: int | None
    """Image id of the partner; its estimates are used, too. None: there is none."""
    files: tuple[Path | None, Path | None]
    """Image files; None: the dataset's."""
    gravity: Tensor | None = None
    """(3,) unit vector pointing down in the image's camera, by an IMU or a robot; None: not known."""


def read_scene(path: str | Path) -> TableScene:
    """Read K, obj_id and T_cam0_est, T_cam1_est [mm] of a scene file; whatever else it holds is not looked at.

    Raises:
        DataError: the file is missing or broken, or an entry is not what it should be; the message says which.
    """
    path = Path(path)
    content = load_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("objects"), list):
        raise DataError(f'{path}: expected {{"K": 3x3, "objects": [{{"obj_id", "T_cam0_est", "T_cam1_est"}}]}}')
    K = _matrix(content.get("K"), 3, f"{path}: K")
    obj_ids, poses = [], ([], [])
    for i, entry in enumerate(content["objects"]):
        where = f"{path}, objects[{i}]"
        if not isinstance(entry, dict) or type(entry.get("obj_id")) is not int or not 0 <= entry["obj_id"] < MAX_ID:
            raise DataError(f"{where}: expected an object with an integer obj_id")
        obj_ids.append(entry["obj_id"])
        for view, column in enumerate(poses):
            key = f"T_cam{view}_est"
            if entry.get(key) is None:
                column.append(torch.full((4, 4), math.nan, dtype=torch.float64))
                continue
            T = _matrix(entry[key], 4, f"{where}: {key}")
            T[:3, 3] *= MM
            try:
                se3.check_rigid(T, key)
            except PhysPoseError as error:
                raise DataError(f"{where}: {error}") from None
            distance = float(torch.linalg.vector_norm(T[:3, 3]))
            if not 0.02 <= distance <= 20:
                raise DataError(f"{where}: {key} is {distance:.3g} m from the camera; translations are in millimetres")
            column.append(T)
    empty = torch.zeros(0, 4, 4, dtype=torch.float64)
    return TableScene(K, obj_ids, tuple(torch.stack(c) if c else empty for c in poses))


def load_models(folder: str | Path, obj_ids: Sequence[int]) -> list[Body]:
    """Bodies of BOP objects, in millimetres in the folder, by their convex hulls alone.

    Raises:
        DataError: no such folder, or a mesh cannot be read.
        UnknownLabelError: an object has no mesh.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; expected meshes obj_000001.ply, ... in millimetres")
    files: dict[int, Path] = {}
    for ending in reversed(MESHES):
        for file in folder.glob(f"obj_*{ending}"):
            if match := re.fullmatch(r"obj_(\d+)", file.stem):
                files[int(match[1])] = file
    bodies = {}
    for i in dict.fromkeys(obj_ids):
        if i not in files:
            known = ", ".join(map(str, sorted(files))) or "none"
            raise UnknownLabelError(f"object {i} has no mesh obj_{i:06d}.ply in {folder}; there are objects: {known}")
        bodies[i] = Body.from_hull(files[i], label=f"obj_{i:06d}", scale=MM)
    return [bodies[i] for i in obj_ids]


def read_image(path: str | Path) -> Tensor:
    """An image file as (H, W, 3) uint8, RGB.

    Raises:
        DataError: it is missing, no image, or broken.
    """
    mode, pixels = read_pixels(path)
    if pixels.ndim != 3:
        raise DataError(f"{path}: has 16 bits or more a pixel (Pillow's mode {mode}); expected a photograph of 8 bits")
    return torch.from_numpy(pixels)


def table_entry(estimate: TableEstimate) -> dict[str, Any]:
    """What a planes file says of a table, and what else is known of it."""
    return {
        "normal": estimate.plane.normal.tolist(),
        "offset_mm": float(estimate.plane.offset) / MM,
        # against poses estimated in the same images, for contacts; and against the world
        "sigma_deg": math.degrees(float(torch.linalg.eigvalsh(estimate.plane.covariance[:2, :2].double()).amax().sqrt())),
        "sigma_mm": float(estimate.plane.covariance[2, 2].double().sqrt()) / MM,
        "sigma_world_deg": math.degrees(estimate.sigma_tilt),
        "sigma_world_mm": estimate.sigma_offset / MM,
        "scale": estimate.scale,
        "method": estimate.method,
        "inliers": estimate.inliers,
        "standing": estimate.standing.tolist(),
        "depth_factor": estimate.depth_factor,
        "warnings": list(estimate.warnings),
    }


def write_table(path: str | Path, estimate: TableEstimate) -> None:
    """Write a table as JSON, an entry that planes files accept; DataError if that cannot be done."""
    write_file(path, json.dumps(table_entry(estimate), indent=2) + "\n")


def read_pairs(path: str | Path) -> dict[tuple[int, int], Pair]:
    """Read which image goes with which: ``{scene: {image: {"second": image, "files": [first, second], "gravity": [3]}}}``.

    All are optional. ``second`` is the id of the partner in the same scene; ``files`` are image files relative to the JSON's
    folder, which they may not leave, and are only needed where the dataset has no images; ``gravity`` points down in the
    camera frame of the (first) image, of any length.

    Raises:
        DataError: the file is missing or broken, or an entry is not of this form.
    """
    path = Path(path)
    content = load_json(path)
    pairs = {}
    for scene, images in _ids(content, f"{path}"):
        for image, entry in _ids(images, f"{path}, scene {scene}"):
            where = f"{path}, scene {scene}, image {image}"
            if not isinstance(entry, dict):
                raise DataError(f'{where}: expected {{"second": image, "files": [first, second]}}')
            second, files = entry.get("second"), entry.get("files") or []
            if second is not None and (type(second) is not int or not 0 <= second < MAX_ID):
                raise DataError(f"{where}: second is {shown(second)}, expected an image id or null")
            if not isinstance(files, list) or len(files) > 2 or not all(isinstance(f, str) for f in files):
                raise DataError(f"{where}: files is {shown(files)}, expected one or two file names")
            try:
                found = [inside(path.parent, name) for name in files]
            except ValueError as error:
                raise DataError(f"{where}: {error}") from None
            pairs[scene, image] = Pair(second, (*found, None, None)[:2], _direction(entry.get("gravity"), where))
    return pairs


def _direction(value: Any, where: str) -> Tensor | None:
    if value is None:
        return None
    numbers = isinstance(value, list) and len(value) == 3 and all(type(x) in (int, float) and abs(x) < 1e9 for x in value)
    gravity = torch.tensor(value if numbers else [0.0] * 3, dtype=torch.float64)
    length = torch.linalg.vector_norm(gravity)
    if not 0 < float(length) < math.inf:
        raise DataError(f"{where}: gravity is {shown(value)}, expected three numbers that point down in the camera frame")
    return gravity / length


class TablesOnTheWay:
    """Estimates the table of each image of a result file, from its estimates and its image, and its partner's.

    Args:
        estimates: the result file.
        dataset: its images and cameras.
        pairs: partners; an image without an entry stands alone.
        estimator: does the work.
    """

    def __init__(
        self,
        estimates: Estimates,
        dataset: BopDataset,
        pairs: Mapping[tuple[int, int], Pair],
        estimator: TableEstimator,
    ) -> None:
        self.estimates, self.dataset, self.pairs, self.estimator = estimates, dataset, pairs, estimator
        self._rows: dict[tuple[int, int], list[int]] = {}
        for row, key in enumerate(zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), strict=True)):
            self._rows.setdefault(key, []).append(row)

    def __call__(self, scene_id: int, im_id: int, scene: Scene, rows: np.ndarray) -> tuple[Plane, tuple[str, ...]]:
        """The plane in an image, with warnings; ``scene`` has its objects, ``rows`` their rows.

        Raises:
            TableNotFoundError: the evidence is too thin.
            DataError: an image that should be there is missing or broken.
        """
        best = self._best(scene.same_object.tolist(), rows)
        bodies = [scene.objects[i] for i in best]
        obj_ids = self.estimates.obj_id[rows[best]].tolist()
        pair = self.pairs.get((scene_id, im_id), Pair(None, (None, None)))
        views = [self._view(scene_id, im_id, pair.files[0], self.estimates.T_camera_object[rows[best]])]
        if pair.second is not None:
            other = self._partner(scene_id, pair.second, obj_ids)
            views.append(self._view(scene_id, pair.second, pair.files[1], other))
        estimate = self.estimator(views, bodies, gravity=pair.gravity)
        return estimate.plane, estimate.warnings

    def _best(self, same: Sequence[int], rows: np.ndarray) -> list[int]:
        """Of alternatives, the best-scored."""
        scores = self.estimates.score[rows]
        best: dict[int, int] = {}
        for i, group in enumerate(same):
            if group not in best or scores[i] > scores[best[group]]:
                best[group] = i
        return sorted(best.values())

    def _view(self, scene_id: int, im_id: int, file: Path | None, poses: Tensor) -> View:
        image = None
        if file is not None:
            image = read_image(file)
        elif self.dataset.has_image(scene_id, im_id):
            image = read_image(self.dataset.image_path(scene_id, im_id))
        return View(image, self.dataset.camera(scene_id, im_id).K, poses)

    def _partner(self, scene_id: int, im_id: int, obj_ids: Sequence[int]) -> Tensor:
        """Poses of the same objects in the other image; NaN where it is not plain which they are."""
        poses = torch.full((len(obj_ids), 4, 4), math.nan, dtype=torch.float64)
        rows = np.array(self._rows.get((scene_id, im_id), []), dtype=np.int64)
        for i, obj_id in enumerate(obj_ids):
            mine = rows[self.estimates.obj_id[rows] == obj_id]
            if len(mine) and obj_ids.count(obj_id) == 1:
                poses[i] = self.estimates.T_camera_object[mine[self.estimates.score[mine].argmax()]]
        return poses


def _matrix(value: Any, size: int, where: str) -> Tensor:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.shape != (size, size) or not np.isfinite(array).all():
        raise DataError(f"{where} is not a {size}x{size} matrix of finite numbers")
    return torch.from_numpy(array)


def _ids(content: Any, where: str) -> list[tuple[int, Any]]:
    if not isinstance(content, dict) or not all(re.fullmatch(r"[0-9]{1,9}", key) for key in content):
        raise DataError(f"{where}: expected an object with ids as keys")
    return [(int(key), value) for key, value in content.items()]
