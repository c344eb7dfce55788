"""A camera on a robot: where the links and the table are in its image, and which way is down."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.robot.kinematics import Kinematics, listed
from physpose_torch.robot.shapes import Meshes, link_body
from physpose_torch.robot.urdf import RobotModel, read_urdf
from physpose_torch.scene import Static, as_matrix

__all__ = ["RobotEnvironment", "RobotState"]


class RobotState(NamedTuple):
    """What a :class:`~physpose_torch.scene.Scene` asks for, in the camera frame of each image."""

    statics: tuple[Static, ...]
    """Links, fixtures and table, image by image; poses carry the graph of q and T_link_camera."""
    gravity: Tensor
    """(3,), or (I, 3) for a batch; unit vectors pointing down."""


class RobotEnvironment:
    """A robot with a camera on one of its links, and what stands around it.

    Frames: *base* is the URDF's root link; *link* is ``camera_link``; *camera* is OpenCV's (x right, y down, z forward).

    Args:
        model: a URDF that has been read.
        camera_link: the link that carries the camera.
        T_link_camera: hand–eye transform (4, 4) [m], may require grad; None: the link's frame is the camera's.
        ignore_links: links without a static: the camera's housing, or a hand that holds one of the objects.
        gravity_base: unit vector (3,) pointing down, base frame; other than (0, 0, -1) if the robot hangs or leans.
        table: a plane in the base frame [m]; its covariance, if any, is turned along.
        fixtures: static bodies with their poses T_base_body (4, 4) [m].
        packages: folders of ROS packages, for meshes by ``package://``; see :func:`~physpose_torch.robot.shapes.find_mesh`.
        meshes: ``decompose`` collision meshes into convex parts (minutes at first, then cached), or take their ``hull``,
            which is fine for meshes that are nearly convex and closes any cavity of others.

    Raises:
        InvalidInputError: no such link, a transform that is not rigid, a gravity that is no unit vector.
        DataError: a collision mesh is missing or cannot be used.
    """

    def __init__(
        self,
        model: RobotModel,
        *,
        camera_link: str,
        T_link_camera: Tensor | None = None,
        ignore_links: Collection[str] = (),
        gravity_base: Tensor | Sequence[float] = (0.0, 0.0, -1.0),
        table: Plane | None = None,
        fixtures: Sequence[tuple[Body, Tensor]] = (),
        packages: Mapping[str, str | Path] | None = None,
        meshes: Meshes = "decompose",
    ) -> None:
        if isinstance(ignore_links, str):
            raise InvalidInputError(f"ignore_links = {ignore_links!r} is a string, expected a list of names")
        for what, name in (("camera_link", camera_link), *(("ignore_links", x) for x in ignore_links)):
            if name not in model.links:
                raise InvalidInputError(
                    f"{what}: there is no link {name!r} in {model.path}; it has {listed(model.links)}"
                )
        self.model, self.camera_link = model, camera_link
        eye = torch.eye(4, dtype=torch.float64)
        self.T_link_camera = eye if T_link_camera is None else as_matrix(T_link_camera, single=True)
        _check_pose(self.T_link_camera, "T_link_camera")
        self.gravity_base = torch.as_tensor(gravity_base, dtype=torch.float64)
        if self.gravity_base.shape != (3,) or not abs(float(self.gravity_base.norm()) - 1.0) < 1e-3:
            raise InvalidInputError(
                f"gravity_base = {self.gravity_base.tolist()}, expected a unit vector (3,) pointing down"
            )
        if table is not None and not isinstance(table, Plane):
            raise InvalidInputError(f"table is a {type(table).__name__}, expected a Plane; bodies go into fixtures")
        self.table = table
        self.fixtures = tuple((body, as_matrix(T, single=True)) for body, T in fixtures)
        for body, T in self.fixtures:
            _check_pose(T, f"T_base_body of fixture {body.label!r}")
        bodies = {
            x: link_body(model, x, packages=packages, meshes=meshes) for x in model.links if x not in ignore_links
        }
        self.bodies: dict[str, Body] = {name: body for name, body in bodies.items() if body is not None}
        """Links with collision shapes, each one body in its link frame."""
        self.kinematics = Kinematics(model)

    @classmethod
    def from_urdf(
        cls, path: str | Path, *, camera_link: str, T_link_camera: Tensor | None = None, **options
    ) -> "RobotEnvironment":
        """The environment of a URDF file; options as of the class.

        Raises:
            DataError: the file cannot be used, see :func:`~physpose_torch.robot.urdf.read_urdf`.
            InvalidInputError: an argument does not fit the robot.
        """
        return cls(read_urdf(path), camera_link=camera_link, T_link_camera=T_link_camera, **options)

    @property
    def joint_names(self) -> list[str]:
        """Order of q: depth first as in pytorch-kinematics, without fixed joints and those that mimic another."""
        return self.kinematics.joint_names

    @property
    def limits(self) -> Tensor:
        """(dof, 2) lower and upper limits [rad] or [m], float64; infinite for continuous joints."""
        return self.kinematics.limits

    def __repr__(self) -> str:
        return (
            f"RobotEnvironment({self.model.name!r}, {len(self.joint_names)} joints, {len(self.bodies)} links with shapes, "
            f"camera on {self.camera_link!r})"
        )

    def __call__(self, q, *, T_link_camera: Tensor | None = None) -> RobotState:
        """Statics and gravity in the camera frame.

        Args:
            q: joint values [rad] or [m]: (dof,) in the order of :attr:`joint_names`, a dict of all of them, or (I, dof) (a dict
                of (I,)) for I images, whose statics are then numbered 0 … I - 1. dtype and device of what comes back are q's.
            T_link_camera: (4, 4) or (I, 4, 4), instead of the one given before.

        Raises:
            InvalidInputError: names, shapes, NaN, or values beyond a joint's limits (degrees, say).
        """
        q, batched = self.kinematics.checked(q)
        poses = self.kinematics.link_poses(q)
        T_camera_base = se3.inverse(self._camera_pose(poses, q, T_link_camera))
        gravity = T_camera_base[:, :3, :3] @ self.gravity_base.to(q)
        T_camera_link = {name: T_camera_base @ poses[name] for name in self.bodies}
        statics: list[Static] = []
        for i, T in enumerate(T_camera_base):
            statics += [Static(body, T_camera_link[name][i], image=i) for name, body in self.bodies.items()]
            statics += [Static(body, T @ T_base_body.to(T), image=i) for body, T_base_body in self.fixtures]
            if self.table is not None:
                statics.append(Static(_in_camera(self.table, T), image=i))
        return RobotState(tuple(statics), gravity if batched else gravity[0])

    def link_poses(self, q) -> dict[str, Tensor]:
        """T_base_link of every link, (4, 4) or (I, 4, 4) [m]; q as for calling."""
        q, batched = self.kinematics.checked(q)
        return {name: T if batched else T[0] for name, T in self.kinematics.link_poses(q).items()}

    def camera_pose(self, q, *, T_link_camera: Tensor | None = None) -> Tensor:
        """T_base_camera, (4, 4) or (I, 4, 4) [m]; q as for calling. It takes poses of objects into the base frame."""
        q, batched = self.kinematics.checked(q)
        T = self._camera_pose(self.kinematics.link_poses(q), q, T_link_camera)
        return T if batched else T[0]

    def _camera_pose(self, poses: dict[str, Tensor], q: Tensor, T_link_camera: Tensor | None) -> Tensor:
        T = self.T_link_camera
        if T_link_camera is not None:
            T = as_matrix(T_link_camera)
            _check_pose(T, "T_link_camera", len(q))
        return poses[self.camera_link] @ T.to(q)


def _in_camera(plane: Plane, T_camera_base: Tensor) -> Plane:
    """A plane of the base frame in the camera frame; the two tilts of its covariance change their axes with the normal."""
    R, t = T_camera_base[:3, :3], T_camera_base[:3, 3]
    normal = R @ plane.normal.to(R)
    offset = plane.offset.to(R) + normal @ t
    covariance = plane.covariance
    if covariance is not None:
        with torch.no_grad():
            turn = torch.eye(3, dtype=R.dtype, device=R.device)
            turn[:2, :2] = tangent_basis(normal[None])[0] @ R @ tangent_basis(plane.normal.to(R)[None])[0].mT
            covariance = turn @ covariance.to(R) @ turn.mT
    return Plane(normal, offset, covariance)


def _check_pose(T: Tensor, name: str, images: int | None = None) -> None:
    se3.check_rigid(T, name)
    if T.shape != (4, 4) and (images is None or T.shape != (images, 4, 4)):
        raise InvalidInputError(
            f"{name} has shape {tuple(T.shape)}, expected (4, 4)"
            + (f" or ({images}, 4, 4)" if images is not None else "")
        )
