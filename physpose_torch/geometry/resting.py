"""The ways in which a body can stand on a level surface."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from torch import Tensor

from physpose_torch.geometry.body import Body, is_flat

__all__ = ["HullStands", "NearestRest", "RestingPoses", "hull_stands", "nearest_rest", "resting_poses"]

WOBBLE = math.radians(2.0)
"""A corner counts as touching if the body would stand on it when tilted by this: scans are not flat, and balls roll."""
LEAST_BASE = 0.1
"""Least distance of the centre of mass from the edge over which the body tips first, as a share of the body's radius."""
ALIKE = math.radians(10.0)
"""Poses nearer to each other than this are one; that with the lowest centre of mass stands for them."""
DIRECTIONS = 64
"""Sides to which the body may tip."""


class HullStands(NamedTuple):
    """A body's convex hull, and the faces of it that have the centre of mass over them, however small."""

    corners: np.ndarray
    """(V, 3) of the hull, body frame [m]."""
    center: np.ndarray
    """(3,) centre of mass."""
    up: np.ndarray
    """(F, 3) what points up when the body stands on each, the one with the lowest centre of mass first."""


class RestingPoses(NamedTuple):
    """Stable poses on a level surface, that with the lowest centre of mass first."""

    up: Tensor
    """(S, 3) unit vector that points up then, object frame."""
    height: Tensor
    """(S,) of the centre of the bounds above the surface [m]."""
    apart: Tensor
    """(S,) angle to the nearest other one [rad]; π if there is none."""


class NearestRest(NamedTuple):
    """The stable pose that each object's pose is nearest to; see :class:`RestingPoses`."""

    tilt: Tensor
    """(N,) angle to it [rad]; infinite where the body has none."""
    up: Tensor
    """(N, 3)."""
    height: Tensor
    """(N,) [m]."""
    apart: Tensor
    """(N,) [rad]."""


def nearest_rest(bodies: Sequence[Body], up: Tensor) -> NearestRest:
    """The nearest stable poses of bodies, given what is up (N, 3) in the frame of each."""
    tilt, height, apart = (up.new_full((len(bodies),), torch.inf) for _ in range(3))
    nearest = up.clone()
    members: dict[Body, list[int]] = {}
    for i, body in enumerate(bodies):
        members.setdefault(body, []).append(i)
    for body, rows in members.items():
        rest = RestingPoses(*(x.to(up) for x in resting_poses(body)))
        if len(rest.up):
            cosine, best = (up[rows] @ rest.up.mT).max(1)
            tilt[rows] = torch.arccos(cosine.clamp(-1.0, 1.0))
            nearest[rows], height[rows], apart[rows] = rest.up[best], rest.height[best], rest.apart[best]
    return NearestRest(tilt, nearest, height, apart)


@lru_cache(maxsize=256)
def hull_stands(body: Body) -> HullStands | None:
    """On which faces of its convex hull a body can stand, if only for a moment; None if it is flat, or a line."""
    if is_flat(body.mesh):
        return None
    hull = trimesh.Trimesh(body.mesh.vertices, body.mesh.faces, process=False).convex_hull
    center = body.center_of_mass.numpy()
    triangles, normals = np.asarray(hull.triangles), np.asarray(hull.face_normals)
    depth = ((triangles[:, 0] - center) * normals).sum(1)
    foot = center + depth[:, None] * normals
    sides = np.roll(triangles, -1, 1) - triangles
    over = (np.cross(sides, foot[:, None] - triangles) * normals[:, None]).sum(2)
    scale = np.linalg.norm(sides, axis=2).max(1, keepdims=True) ** 2
    standing = np.flatnonzero((over >= -1e-9 * scale).all(1))
    standing = standing[np.argsort(depth[standing], kind="stable")]
    return HullStands(np.asarray(hull.vertices), center, -normals[standing])


@lru_cache(maxsize=256)
def resting_poses(body: Body) -> RestingPoses:
    """Faces of the convex hull of a body's mesh on which it stands with a base to speak of; none for a ball.

    The centre of mass over a face is where the body comes to rest; faces that it would leave at a touch (the side of a can,
    the edge of a plate) do not count.
    """
    stands = hull_stands(body)
    if stands is None:
        none = torch.zeros(0, dtype=torch.float64)
        return RestingPoses(none.reshape(0, 3), none, none)
    corners, center, radius = stands.corners, stands.center, body.radius
    chosen: list[np.ndarray] = []
    for up in stands.up:
        if all(up @ other < math.cos(ALIKE) for other in chosen) and _base(corners - center, up) > LEAST_BASE * radius:
            chosen.append(up)
    up = torch.from_numpy(np.array(chosen).reshape(-1, 3))
    height = -((torch.from_numpy(corners) - body.center) @ up.mT).amin(0)
    cosine = (up @ up.mT).clamp(-1.0, 1.0).fill_diagonal_(-1.0)
    return RestingPoses(up, height, torch.arccos(cosine.amax(1)) if len(up) else height)


def _base(corners: np.ndarray, up: np.ndarray) -> float:
    """How far the centre of mass, the origin, is from tipping over the nearest edge [m]."""
    height = corners @ up
    height = (height - height.min()) / math.tan(WOBBLE)
    x = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    x /= np.linalg.norm(x)
    angle = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    side = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * np.cross(up, x)
    return float((corners @ side.T - height[:, None]).max(0).min())
