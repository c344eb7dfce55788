"""Files of MegaPose's and happypose's example folders: ``object_data.json`` with poses, ``camera_data.json``.

example = Path("examples/barbecue-sauce")
data = read_object_data(example / "outputs/object_data.json")
bodies = bodies_from_folder(example / "meshes", labels=data.labels)
scene = Scene.tabletop([bodies[label] for label in data.labels], plane)
refined = PhysPoseRefiner()(data.poses, scene)
write_object_data(example / "outputs/object_data_refined.json", data.with_poses(refined.poses))
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from physpose_torch import se3
from physpose_torch.bop.formats import load_json
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.files import write_file, written

__all__ = ["CameraData", "ObjectData", "read_camera_data", "read_object_data", "write_object_data"]

UNIT = 1e-3
"""How far from 1 the length of a quaternion may be."""


@dataclass(frozen=True, eq=False)
class ObjectData:
    """The objects of one image."""

    labels: tuple[str, ...]
    """One a row."""
    poses: Tensor | None
    """T_world_object (N, 4, 4) float64 [m]. The estimators write camera poses there: the world is the camera. None: the
    file has detections only."""
    entries: tuple[dict, ...] = ()
    """The rows as they are in the file, with whatever else is there (``bbox_modal``, ``visib_fract``, …)."""

    def with_poses(self, poses: Tensor) -> "ObjectData":
        """The same objects at other poses (N, 4, 4) [m].

        Raises:
            InvalidInputError: a wrong number of poses, or poses that are not rigid.
        """
        se3.check_rigid(poses, "poses", self.labels or None)
        if poses.shape != (len(self.labels), 4, 4):
            raise InvalidInputError(f"poses has shape {tuple(poses.shape)}, expected ({len(self.labels)}, 4, 4)")
        return replace(self, poses=poses.detach().double().cpu())


class CameraData(NamedTuple):
    """A camera of an example folder."""

    K: Tensor
    """(3, 3) float64 [px]."""
    resolution: tuple[int, int] | None
    """Height and width [px]."""
    T_world_camera: Tensor | None
    """(4, 4) float64 [m]; None: not in the file."""


def read_object_data(path: str | Path) -> ObjectData:
    """Read ``object_data.json``: ``[{"label", "TWO": [[qx, qy, qz, qw], [x, y, z]], "bbox_modal", …}]``, metres.

    Raises:
        DataError: no such file or no JSON; a row without a label, or with a pose that is none; poses in some rows only.
    """
    content = load_json(path)
    if not isinstance(content, list):
        raise DataError(f"{path}: expected a list of objects, got a {type(content).__name__}")
    labels, poses = [], []
    for i, entry in enumerate(content):
        if not isinstance(entry, dict) or not isinstance(entry.get("label"), str):
            raise DataError(f"{path}, row {i}: expected an object with a 'label', a string")
        labels.append(entry["label"])
        poses.append(_pose(entry["TWO"], f"{path}, row {i} ({entry['label']}): TWO") if "TWO" in entry else None)
    missing = [i for i, pose in enumerate(poses) if pose is None]
    if missing and len(missing) < len(poses):
        raise DataError(f"{path}, row {missing[0]} ({labels[missing[0]]}): no pose 'TWO', while other rows have one")
    if not poses:
        return ObjectData((), torch.zeros(0, 4, 4, dtype=torch.float64))
    return ObjectData(tuple(labels), None if missing else torch.stack(poses), tuple(content))


def write_object_data(path: str | Path, data: ObjectData) -> None:
    """Write ``object_data.json``; folders are made. Read again by happypose and MegaPose, or :func:`read_object_data`."""
    entries = [dict(entry) for entry in data.entries] or [{} for _ in data.labels]
    for i, (entry, label) in enumerate(zip(entries, data.labels, strict=True)):
        entry["label"] = label
        if data.poses is not None:
            T = data.poses[i].double().cpu().numpy()
            entry["TWO"] = [Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), T[:3, 3].tolist()]
    with written(path):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_file(path, json.dumps(entries))


def read_camera_data(path: str | Path) -> CameraData:
    """Read ``camera_data.json``: ``{"K": 3×3, "resolution": [height, width], "TWC": [[qx, qy, qz, qw], [x, y, z]]}``.

    Raises:
        DataError: no such file or no JSON, or no camera matrix in it.
    """
    content = load_json(path)
    K = _numbers(content.get("K"), (3, 3)) if isinstance(content, dict) else None
    if K is None:
        raise DataError(f"{path}: expected an object with 'K', 3×3 finite numbers")
    resolution = content.get("resolution")
    if resolution is not None:
        if _numbers(resolution, (2,)) is None or any(int(x) != x or x <= 0 for x in resolution):
            raise DataError(f"{path}: resolution = {resolution}, expected [height, width]")
        resolution = (int(resolution[0]), int(resolution[1]))
    T = _pose(content["TWC"], f"{path}: TWC") if content.get("TWC") is not None else None
    return CameraData(torch.from_numpy(K), resolution, T)


def _pose(value: Any, place: str) -> Tensor:
    """(4, 4) of [[qx, qy, qz, qw], [x, y, z]]."""
    pair = isinstance(value, list) and len(value) == 2
    quaternion, translation = (_numbers(value[0], (4,)), _numbers(value[1], (3,))) if pair else (None, None)
    if quaternion is None or translation is None or abs(np.linalg.norm(quaternion) - 1) > UNIT:
        raise DataError(f"{place} = {value}, expected [[qx, qy, qz, qw], [x, y, z]] with a unit quaternion, metres")
    R = torch.from_numpy(Rotation.from_quat(quaternion).as_matrix())
    return se3.from_rotation_translation(R, torch.from_numpy(translation))


def _numbers(value: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """The value as an array of finite numbers of that shape, if it is one."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.shape == shape and np.isfinite(array).all() else None
