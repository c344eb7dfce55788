"""Reader of a BOP dataset folder: models, cameras, ground truth, targets and images, as far as they are on disk.

Everything is read on first use. The files speak millimetres; what is handed out is in metres, float64.
"""

import logging
import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from physpose_torch.bop.formats import MAX_ID, Target, load_json, read_targets
from physpose_torch.errors import DataError, InvalidInputError, UnknownLabelError
from physpose_torch.geometry.body import FARTHEST, read_mesh
from physpose_torch.reading import LONGEST_SIDE, MOST_PIXELS, read_pixels, read_size

__all__ = ["MESH_SCALE", "BopDataset", "Camera", "GroundTruth", "symmetry_transforms"]

MESH_SCALE = 1e-3
"""Factor from the unit of BOP meshes to metres."""

MOST_SYMMETRIES = 1000
"""Discrete ones times continuous axes."""

_log = logging.getLogger("physpose_torch")
_MIN_VISIBLE = 0.1  # BOP19 asks only for objects that are visible to 10 %
_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_WIDTHS = (320, 400, 424, 640, 720, 800, 848, 960, 1024, 1280, 1440, 1600, 1920, 2048, 2560, 3840)
_RATIOS = (3 / 4, 5 / 8, 9 / 16)


class Camera(NamedTuple):
    """A pinhole camera, OpenCV axes.

    `K` is (3, 3) float64 [px], `depth_scale` takes values of a depth image to metres, or is None.
    """

    K: torch.Tensor
    depth_scale: float | None


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """All annotated instances of one scene, by image and then in file order."""

    im_id: np.ndarray
    """(n,) int64."""
    gt_id: np.ndarray
    """(n,) int64, position in the image's list in scene_gt.json."""
    obj_id: np.ndarray
    """(n,) int64."""
    T_camera_object: torch.Tensor
    """(n, 4, 4) float64 [m], as annotated."""
    visib_fract: np.ndarray
    """(n,) float64, visible fraction of the silhouette; NaN where scene_gt_info.json does not tell."""


class BopDataset:
    """A BOP dataset folder.

    Args:
        path: The folder with `models/` and the splits.
        split: Name of the split's folder. Default: `test`, or the only folder `test_*`, or the only one `val*`, or the
            only one there is.
        models: Folder of the meshes for physics, instead of `models/` (or `models_cad/`, or the only `models_*/`).
        targets: Target list, a path or a name within `path`. Default: `<split>_targets_bop19.json`, if it exists.
        image_width: Width of all images [px]. Default: from an image on disk, or `camera*.json`.

    Raises:
        DataError: No such folder or split, or several splits to choose from.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        split: str | None = None,
        models: str | os.PathLike | None = None,
        targets: str | os.PathLike | None = None,
        image_width: int | None = None,
    ):
        self.path = Path(path)
        if not self.path.is_dir():
            raise DataError(f"{self.path}: no such folder; expected a BOP dataset (models/, test/, ...)")
        self.split_path = self._find_split(split)
        self._models, self._targets, self._image_width = models, targets, image_width
        self._cache: dict[Any, Any] = {}

    def __repr__(self) -> str:
        return f"BopDataset({str(self.path)!r}, split={self.split_path.name!r})"

    # Models

    @cached_property
    def models_path(self) -> Path:
        """Folder of the meshes for physics."""
        if self._models is None:
            return self._own_models
        if not Path(self._models).is_dir():
            raise DataError(f"{self._models}: no such folder; expected meshes obj_000001.ply, ...")
        return Path(self._models)

    @cached_property
    def eval_models_path(self) -> Path:
        """Folder of the meshes for errors: `models_eval/`, or else the dataset's own models."""
        folder = self.path / "models_eval"
        if folder.is_dir():
            return folder
        try:
            return self._own_models
        except DataError:
            return self.models_path

    @property
    def object_ids(self) -> list[int]:
        """Ids of all objects that have a mesh for physics, ascending."""
        return sorted(self._meshes(self.models_path))

    def model_path(self, obj_id: int, *, evaluation: bool = False) -> Path:
        """The mesh of an object [mm], for physics or for errors; `MESH_SCALE` takes it to metres.

        Raises:
            UnknownLabelError: There is no such mesh.
        """
        folder = self.eval_models_path if evaluation else self.models_path
        meshes = self._meshes(folder)
        if int(obj_id) not in meshes:
            ids = ", ".join(map(str, sorted(meshes))) or "none"
            name = f"obj_{int(obj_id):06d}.ply"
            raise UnknownLabelError(f"object {obj_id} has no mesh {name} in {folder}; there are objects: {ids}")
        return meshes[int(obj_id)]

    def vertices(self, obj_id: int) -> torch.Tensor:
        """Vertices of the mesh for errors, object frame, shape (V, 3) float64 [m]."""
        return self._mesh(obj_id)[0]

    def faces(self, obj_id: int) -> torch.Tensor:
        """Triangles of the mesh for errors, rows of `vertices`, shape (F, 3) int64."""
        return self._mesh(obj_id)[1]

    def hull(self, obj_id: int) -> torch.Tensor:
        """The `vertices` that are corners of their convex hull, shape (H, 3) float64 [m]; all, if they are flat."""

        def find() -> torch.Tensor:
            from scipy.spatial import ConvexHull, QhullError

            vertices = self.vertices(obj_id)
            try:
                return vertices[ConvexHull(vertices.numpy()).vertices]
            except (QhullError, ValueError):  # flat, or too few points
                return vertices

        return self._once(("hull", obj_id), find)

    def diameter(self, obj_id: int) -> float:
        """Diameter of an object [m], from models_info.json.

        Raises:
            DataError: There is no models_info.json, or no diameter of the object in it.
        """
        diameter = self._info(obj_id).get("diameter")
        if not isinstance(diameter, int | float) or not 0 < diameter < 1e6:
            place = self.eval_models_path / "models_info.json"
            raise DataError(f"{place}: no diameter of object {obj_id}, which MSSD needs; add the file of the dataset")
        return diameter * MESH_SCALE

    def symmetries(self, obj_id: int, *, max_step: float = 0.01) -> torch.Tensor:
        """Transforms that leave an object's looks unchanged, the identity first, shape (S, 4, 4) float64 [m].

        Continuous symmetries are discretised as in `symmetry_transforms`. An object without an entry in
        models_info.json has only the identity.
        """
        key = ("symmetries", obj_id, max_step)
        try:
            return self._once(key, lambda: symmetry_transforms(self._info(obj_id), max_step))
        except (ValueError, TypeError, KeyError, RuntimeError, OverflowError) as error:
            place = self.eval_models_path / "models_info.json"
            raise DataError(f"{place}, object {obj_id}: broken symmetry ({error}); see BOP's format") from error

    # Scenes

    @cached_property
    def scene_ids(self) -> list[int]:
        """Ids of the scenes on disk, ascending."""
        return sorted(self._scenes)

    def images(self) -> list[tuple[int, int]]:
        """(scene_id, im_id) of all images that have a camera or ground truth, ascending."""
        found = set()
        for scene_id in self.scene_ids:
            for name in ("scene_camera.json", "scene_gt.json"):
                if (self._scenes[scene_id] / name).is_file():
                    found.update((scene_id, im_id) for im_id in self._scene_file(scene_id, name))
        return sorted(found)

    def camera(self, scene_id: int, im_id: int) -> Camera:
        """The camera of an image.

        Raises:
            DataError: scene_camera.json is missing, does not know the image, or has no valid K.
        """
        place = f"{self._scene(scene_id) / 'scene_camera.json'}, image {im_id}"
        cameras = self._scene_file(scene_id, "scene_camera.json")
        if im_id not in cameras:
            raise DataError(f"{place}: no such image; there are {_some(cameras)}")
        entry = cameras[im_id]
        K = _array(entry, "cam_K", 9, place).reshape(3, 3)
        if not (K[0, 0] > 0 and K[1, 1] > 0 and K[2, 2] == 1 and np.abs(K).max() < 1e6):
            raise DataError(f"{place}: cam_K is {K.tolist()}, expected a pinhole camera, 3×3 row-major")
        scale = None
        if entry.get("depth_scale") is not None:
            scale = float(_array(entry, "depth_scale", 1, place)[0]) * MESH_SCALE
        return Camera(torch.from_numpy(K), scale)

    def ground_truth(self, scene_id: int) -> GroundTruth:
        """All annotated instances of a scene.

        Raises:
            DataError: scene_gt.json is missing, or an entry of it is broken.
        """
        return self._once(("gt", scene_id), lambda: self._read_ground_truth(scene_id))

    @property
    def targets_path(self) -> Path | None:
        """The list of targets that was asked for, or the split's own; None if there is none."""
        if self._targets is None:
            default = self.path / f"{self.split_path.name.split('_')[0]}_targets_bop19.json"
            return default if default.is_file() else None
        path = Path(self._targets)
        return self.path / path if not path.is_file() and (self.path / path).is_file() else path

    @cached_property
    def targets(self) -> list[Target]:
        """What is to be found, from the target list; without one, all instances that are visible to 10 %.

        Raises:
            DataError: The list is missing although it was asked for, or broken.
        """
        if self.targets_path is not None:
            return read_targets(self.targets_path)
        counts: dict[tuple[int, int, int], int] = {}
        for scene_id in self.scene_ids:
            gt = self.ground_truth(scene_id)
            if np.isnan(gt.visib_fract).any():
                _log.warning("%s has no visib_fract for all objects; those count as targets", self._scenes[scene_id])
            for index in np.flatnonzero(~(gt.visib_fract < _MIN_VISIBLE)):
                key = (scene_id, int(gt.im_id[index]), int(gt.obj_id[index]))
                counts[key] = counts.get(key, 0) + 1
        return [Target(*key, count) for key, count in counts.items()]

    def image_path(self, scene_id: int, im_id: int, kind: str = "rgb") -> Path:
        """The file of an image: `rgb`, `gray` or `depth`.

        Raises:
            DataError: There is no such file.
        """
        if (path := self._image_file(scene_id, im_id, kind)) is None:
            folder = self._scene(scene_id) / kind
            raise DataError(f"scene {scene_id}, image {im_id}: no {kind} image in {folder}; download it")
        return path

    def has_image(self, scene_id: int, im_id: int, kind: str = "rgb") -> bool:
        """Whether there is the file of an image: `rgb`, `gray` or `depth`."""
        return self._image_file(scene_id, im_id, kind) is not None

    def depth(self, scene_id: int, im_id: int) -> torch.Tensor:
        """A depth image: z in the camera frame, shape (H, W) float64 [m]; 0 where it is unknown.

        Raises:
            DataError: The file is missing, unreadable, of 8 bits, or not of the size of the colour image; or
                scene_camera.json has no depth_scale.
        """
        path = self.image_path(scene_id, im_id, "depth")
        scale = self.camera(scene_id, im_id).depth_scale
        if scale is None or not scale > 0:
            place = f"{self._scene(scene_id) / 'scene_camera.json'}, image {im_id}"
            raise DataError(f"{place}: no positive 'depth_scale', so {path} has no unit; add it [mm per value]")
        mode, values = read_pixels(path)
        if values.ndim != 2 or not mode.startswith(("I", "F")):
            what = f"Pillow's mode {mode}, shape {values.shape}"
            raise DataError(f"{path}: not a depth image ({what}); expected one channel of 16 bits")
        for other in filter(None, (self._image_file(scene_id, im_id, kind) for kind in ("rgb", "gray"))):
            size = read_size(other)
            if size and size != values.shape[::-1]:
                sizes = f"{values.shape[1]}×{values.shape[0]} px, but {other} is {size[0]}×{size[1]} px"
                raise DataError(f"{path}: {sizes}; K belongs to one of them, bring the depth to the other's view")
        values = values.astype(np.float64)
        return torch.from_numpy(np.where(np.isfinite(values) & (values > 0), values, 0.0)) * scale

    def image_width(self, scene_id: int) -> int:
        """Width of a scene's images [px]: the one given, or as in `image_size`."""
        return self._image_width or self.image_size(scene_id)[0]

    def image_size(self, scene_id: int) -> tuple[int, int]:
        """Width and height of a scene's images [px]: of an image on disk, or as in `camera*.json`.

        If all fail, the usual width nearest to twice the principal point and a height to go with it, with a warning.
        A width given to the constructor replaces another one, the height then keeps its proportion.
        """
        width, height = self._once(("size", scene_id), lambda: self._find_size(scene_id))
        if self._image_width and self._image_width != width:
            return self._image_width, round(height * self._image_width / width)
        return width, height

    # Insides

    def _once(self, key: Any, make: Callable[[], Any]) -> Any:
        if key not in self._cache:
            self._cache[key] = make()
        return self._cache[key]

    def _find_split(self, split: str | None) -> Path:
        if split is not None and (Path(split).name != split or split in ("", ".", "..")):
            raise InvalidInputError(f"split is {split!r}, expected the name of a folder in {self.path}")
        names = sorted(folder.name for folder in self.path.iterdir() if folder.is_dir() and _scene_folders(folder))
        listing = f"there are: {', '.join(names) or 'none'}"
        if split is not None:
            if split not in names:
                raise DataError(f"{self.path}: no split {split!r} with scenes in it; {listing}")
            return self.path / split
        if not names:
            raise DataError(f"{self.path}: no folder with scenes in it, such as test/000001; expected a BOP dataset")
        alike = ([name for name in names if name.startswith(prefix)] for prefix in ("test", "val", ""))
        choice = ["test"] if "test" in names else next(filter(None, alike))
        if len(choice) > 1:
            raise DataError(f"{self.path}: cannot tell the split, {listing}; name one (--split)")
        return self.path / choice[0]

    @cached_property
    def _model_folders(self) -> list[str]:
        names = [p.name for p in self.path.iterdir() if p.is_dir() and re.fullmatch(r"models(_.*)?", p.name)]
        return sorted(names, key=lambda name: (name != "models", name != "models_cad", name == "models_eval", name))

    @property
    def _own_models(self) -> Path:
        if not (names := self._model_folders):
            raise DataError(f"{self.path}: no folder models/; download the models or name a folder (--models)")
        if names[0] not in ("models", "models_cad") and len([n for n in names if n != "models_eval"]) > 1:
            raise DataError(f"{self.path}: cannot tell the models, there are: {', '.join(names)}; name one (--models)")
        return self.path / names[0]

    def _meshes(self, folder: Path) -> dict[int, Path]:
        def find() -> dict[int, Path]:
            return {int(m[1]): p for p in folder.iterdir() if (m := re.fullmatch(r"obj_(\d+)\.ply", p.name))}

        return self._once(("meshes", folder), find)

    def _info(self, obj_id: int) -> dict:
        def load() -> dict:
            for folder in dict.fromkeys((self.eval_models_path, self.models_path)):
                if (path := folder / "models_info.json").is_file():
                    return _ids(load_json(path), path)
            _log.warning("%s has no models_info.json: no diameters, no symmetries", self.eval_models_path)
            return {}

        info = self._once("models_info", load).get(int(obj_id), {})
        return info if isinstance(info, dict) else {}

    @cached_property
    def _scenes(self) -> dict[int, Path]:
        return _scene_folders(self.split_path)

    def _scene(self, scene_id: int) -> Path:
        if int(scene_id) not in self._scenes:
            raise DataError(f"scene {scene_id} is not in {self.split_path}; there are {_some(self._scenes)}")
        return self._scenes[int(scene_id)]

    def _scene_file(self, scene_id: int, name: str) -> dict[int, Any]:
        path = self._scene(scene_id) / name
        if path.exists() and not path.is_file():  # a pipe would be waited for at every image
            raise DataError(f"{path}: is no regular file; download it again")
        return self._once(path, lambda: _ids(load_json(path), path))

    def _read_ground_truth(self, scene_id: int) -> GroundTruth:
        path = self._scene(scene_id) / "scene_gt.json"
        has_info = path.with_name("scene_gt_info.json").is_file()
        info = self._scene_file(scene_id, "scene_gt_info.json") if has_info else {}
        ids, poses, visible = [], [], []
        for im_id, instances in sorted(self._scene_file(scene_id, "scene_gt.json").items()):
            if not isinstance(instances, list):
                raise DataError(f"{path}, image {im_id}: expected a list of instances; download the file again")
            infos = info.get(im_id, [{}] * len(instances))
            if not isinstance(infos, list) or len(infos) != len(instances):
                what = f"scene_gt_info.json has not one entry for each of the {len(instances)} instances"
                raise DataError(f"{path}, image {im_id}: {what}; download both files again")
            for gt_id, (instance, extra) in enumerate(zip(instances, infos, strict=True)):
                place = f"{path}, image {im_id}, entry {gt_id}"
                obj_id = _array(instance, "obj_id", 1, place)[0]
                if not 0 <= obj_id < MAX_ID:
                    raise DataError(f"{place}: obj_id is {obj_id:g}, expected an id; download the file again")
                ids.append((im_id, gt_id, int(obj_id)))
                T = np.eye(4)
                T[:3, :3] = _array(instance, "cam_R_m2c", 9, place).reshape(3, 3)
                T[:3, 3] = _array(instance, "cam_t_m2c", 3, place) * MESH_SCALE
                poses.append(T)
                known = isinstance(extra, dict) and "visib_fract" in extra
                visible.append(_array(extra, "visib_fract", 1, f"{place} of the info")[0] if known else math.nan)
        columns = np.array(ids, dtype=np.int64).reshape(-1, 3).T
        T = torch.from_numpy(np.array(poses, dtype=np.float64).reshape(-1, 4, 4))
        return GroundTruth(*columns, T, np.array(visible, dtype=np.float64))

    def _mesh(self, obj_id: int) -> tuple[torch.Tensor, torch.Tensor]:
        def load() -> tuple[torch.Tensor, torch.Tensor]:
            path = self.model_path(obj_id, evaluation=True)
            mesh = read_mesh(path, label=path.name)
            points, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
            if not np.abs(points).max() * MESH_SCALE < FARTHEST:  # nor is NaN
                raise DataError(f"{path}: vertices that are not finite, or farther than {FARTHEST:g} m; download it again")
            return torch.from_numpy(points) * MESH_SCALE, torch.from_numpy(faces)

        return self._once(("mesh", obj_id), load)

    def _image_file(self, scene_id: int, im_id: int, kind: str) -> Path | None:
        if kind not in ("rgb", "gray", "depth"):
            raise InvalidInputError(f"kind is {kind!r}, expected 'rgb', 'gray' or 'depth'")
        stem = self._scene(scene_id) / kind / f"{int(im_id):06d}"
        return next((path for ending in _IMAGES if (path := stem.with_suffix(ending)).is_file()), None)

    def _find_size(self, scene_id: int) -> tuple[int, int]:
        for folder in (self._scene(scene_id), *self._scenes.values()):
            for image in (image for kind in ("rgb", "gray", "depth") for image in sorted((folder / kind).glob("*"))):
                if image.suffix.lower() in _IMAGES and (size := read_size(image)):
                    return size
            if folder == self._scene(scene_id) and (size := self._camera_file_size()):
                return size
        cameras = self._scene_file(scene_id, "scene_camera.json")
        cx, cy = self.camera(scene_id, next(iter(cameras))).K[:2, 2].tolist()
        width = min(_WIDTHS, key=lambda width: abs(width - 2 * cx))
        height = min((round(width * ratio) for ratio in _RATIOS), key=lambda height: abs(height - 2 * cy))
        message = "%s has neither images nor a camera.json: taking them to be %d px wide, as cx = %.1f suggests"
        _log.warning(message + ", and %d px high (cy = %.1f)", self._scene(scene_id), width, cx, height, cy)
        return width, height

    def _camera_file_size(self) -> tuple[int, int] | None:
        sensor = self.split_path.name.partition("_")[2]
        names = [f"camera_{sensor}.json", "camera.json"]
        paths = [self.path / name for name in names if (self.path / name).is_file()][:1]
        cameras = [load_json(path) for path in paths or sorted(self.path.glob("camera_*.json"))]
        sizes = [(camera.get("width"), camera.get("height")) for camera in cameras if isinstance(camera, dict)]
        if not sizes or any(size != sizes[0] for size in sizes):
            return None
        width, height = (x if isinstance(x, int) and 0 < x <= LONGEST_SIDE else None for x in sizes[0])
        size = (width, height or round(width * 3 / 4)) if width else None
        return size if size and size[0] * size[1] <= MOST_PIXELS else None


def symmetry_transforms(info: dict, max_step: float = 0.01) -> torch.Tensor:
    """Symmetries of one entry of models_info.json, the identity first, shape (S, 4, 4) float64 [m].

    Discrete symmetries as listed; each continuous one in ceil(π / max_step) equal steps, so that the farthest vertex
    moves at most max_step times the diameter; both together in all combinations.

    Args:
        info: The entry, with `symmetries_discrete` (4×4 row-major, mm) and `symmetries_continuous` (axis, offset [mm]).
        max_step: Fraction of the diameter.

    Source:
        `get_symmetry_transformations` of the BOP toolkit.
    """
    discrete = [torch.eye(4, dtype=torch.float64)]
    for symmetry in info.get("symmetries_discrete", []):
        T = torch.tensor(symmetry, dtype=torch.float64).reshape(4, 4)
        T[:3, 3] *= MESH_SCALE
        discrete.append(T)
    continuous = []
    steps = math.ceil(math.pi / max_step)
    angles = torch.arange(steps, dtype=torch.float64) * (2 * math.pi / steps)
    for symmetry in info.get("symmetries_continuous", []):
        axis = torch.tensor(symmetry["axis"], dtype=torch.float64)
        if not 0 < axis.norm() < math.inf:
            raise ValueError(f"axis is {symmetry['axis']}")
        x, y, z = (axis / axis.norm()).tolist()
        offset = torch.tensor(symmetry["offset"], dtype=torch.float64) * MESH_SCALE
        cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        sin, cos = angles.sin()[:, None, None], angles.cos()[:, None, None]
        T = torch.eye(4, dtype=torch.float64).repeat(steps, 1, 1)
        T[:, :3, :3] += sin * cross + (1 - cos) * (cross @ cross)
        T[:, :3, 3] = offset - T[:, :3, :3] @ offset
        continuous.append(T)
    if not all(bool(T.isfinite().all()) for T in (*discrete, *continuous)):
        raise ValueError("a number is not finite")
    if len(discrete) * max(len(continuous), 1) > MOST_SYMMETRIES:
        raise ValueError(f"{len(discrete) - 1} discrete and {len(continuous)} continuous ones are too many")
    if not continuous:
        return torch.stack(discrete)
    return (torch.cat(continuous) @ torch.stack(discrete)[:, None]).flatten(0, 1)


def _scene_folders(split: Path) -> dict[int, Path]:
    names = ("scene_camera.json", "scene_gt.json")
    folders = (p for p in sorted(split.iterdir()) if re.fullmatch(r"\d{1,9}", p.name))
    return {int(p.name): p for p in folders if any((p / name).is_file() for name in names)}


def _ids(content: Any, path: Path) -> dict[int, Any]:
    if not isinstance(content, dict) or not all(re.fullmatch(r"[0-9]{1,9}", key) for key in content):
        raise DataError(f"{path}: expected an object with ids as keys; see BOP's format")
    return {int(key): value for key, value in content.items()}


def _array(entry: Any, key: str, count: int, place: str) -> np.ndarray:
    try:
        array = np.array(entry[key], dtype=np.float64).reshape(-1)
    except (KeyError, TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.shape != (count,) or not np.isfinite(array).all():
        numbers = "a finite number" if count == 1 else f"{count} finite numbers"
        raise DataError(f"{place}: {key!r} is missing or is not {numbers}; download the file again")
    return array


def _some(ids: Any) -> str:
    ids = sorted(ids)
    return ", ".join(map(str, ids[:10])) + (f", ... ({len(ids)})" if len(ids) > 10 else "") if ids else "none"
