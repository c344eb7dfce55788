"""What every test relies on: one thread, its own cache, a table before a camera, and the real data if it is there."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from physpose_torch import se3
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts

torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Decompositions and downloads of the tests never touch the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PHYSPOSE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def ycbv() -> Path:
    """The real YCB-V data."""
    root = os.environ.get("PHYSPOSE_DATA")
    if not root or not (Path(root) / "ycbv").is_dir():
        pytest.skip("PHYSPOSE_DATA does not point to a folder with ycbv/")
    return Path(root) / "ycbv"


class Table:
    """A table 0.8 m in front of a camera that looks down at it by 40°. Poses are given on the table, z up [m, rad]."""

    def __init__(self) -> None:
        tilt = math.radians(40)
        up = torch.tensor([0.0, -math.cos(tilt), -math.sin(tilt)], dtype=torch.float64)
        x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        R = torch.stack([x, torch.linalg.cross(up, x), up], dim=1)
        self.T = se3.from_rotation_translation(R, torch.tensor([0.0, 0.05, 0.8], dtype=torch.float64))
        self.up = up
        self.gravity = -up
        self.plane = Plane.from_pose(self.T)

    def at(self, x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)) -> torch.Tensor:
        """T_camera_object (4, 4) of an object at a point of the table frame, turned by a rotation vector."""
        turn = torch.as_tensor(turn, dtype=torch.float64)
        T = se3.from_rotation_translation(se3.exp_so3(turn), torch.tensor([x, y, z], dtype=torch.float64))
        return self.T @ T

    def poses(self, *rows) -> torch.Tensor:
        """(N, 4, 4) of the arguments of :meth:`at`."""
        return torch.stack([self.at(*row) for row in rows])

    def where(self, T_camera_object) -> torch.Tensor:
        """Positions (..., 3) in the table frame [m]."""
        return (se3.inverse(self.T) @ T_camera_object.to(self.T))[..., :3, 3]


@pytest.fixture(scope="session")
def table() -> Table:
    return Table()


@pytest.fixture(scope="session")
def box() -> Body:
    """100 × 60 × 40 mm: at rest its centre is 20 mm above the table."""
    return Body.box((0.1, 0.06, 0.04), label="box")


@pytest.fixture(scope="session")
def can() -> Body:
    """30 mm in radius and 80 mm high: at rest its centre is 40 mm above the table."""
    return Body.cylinder(0.03, 0.08, label="can")


@pytest.fixture(scope="session")
def angle() -> Body:
    """An L of two parts: a foot of 90 × 30 × 30 mm, and a post of 30 × 30 × 60 mm on its end; z = 0 under the foot."""
    foot = trimesh.creation.box(bounds=[[0, 0, 0], [0.09, 0.03, 0.03]])
    post = trimesh.creation.box(bounds=[[0, 0, 0.03], [0.03, 0.03, 0.09]])
    parts = ConvexParts.from_hulls([np.array(foot.vertices), np.array(post.vertices)])
    return Body("angle", parts, trimesh.util.concatenate([foot, post]))


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request) -> torch.dtype:
    return request.param
