"""Where a table would be that the objects stand on: their hulls' faces, the points that touch, and what most agree on."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from physpose_torch.config import TableConfig
from physpose_torch.geometry.body import Body
from physpose_torch.geometry.resting import hull_stands

__all__ = ["FEET", "ROLL", "Feet", "Hypothesis", "plane_hypotheses", "standing_on"]

FEET = 8
"""Points a face stands on, one towards each side."""
CLEARANCE = 0.002
"""[m]; what is within this of the plane that a body stands on may be one of its feet: scans are not flat."""
DISTINCT = (math.radians(12.0), 0.03)
"""Planes that differ by less than this in tilt [rad] and height at the objects [m] are one hypothesis."""
LEAST_HEIGHT = 0.05
"""[m]; the camera is at least this far above the table."""
ROLL = 0.2
"""Standard deviation of how far up in the image is from up in the world (sine of the roll), if gravity is not known."""


class Feet(NamedTuple):
    """What each object would stand on, object frame."""

    points: Tensor
    """(N, FEET, 3) [m]."""
    rest: Tensor
    """(N, FEET) how high each is above the plane when the object stands [m]."""
    tilt: Tensor
    """(N,) angle between the pose and standing [rad]; infinite where a body can stand on nothing."""
    lowest: Tensor
    """(N, 3) the lowest point at the pose as it is [m]; NaN where the pose is unknown."""


class Hypothesis(NamedTuple):
    """A plane that some objects would stand on."""

    normal: Tensor
    """(3,) up, camera frame."""
    offset: Tensor
    """() [m]."""
    score: float
    """Logarithm of how likely, up to a constant."""


class _Stands(NamedTuple):
    up: Tensor  # (F, 3)
    level: Tensor  # (F,) least up · x of the hull
    feet: Tensor  # (F, FEET, 3)
    rest: Tensor  # (F, FEET)
    corners: Tensor  # (V, 3)


@lru_cache(maxsize=256)
def _stands(body: Body) -> _Stands | None:
    stands = hull_stands(body)
    if stands is None or not len(stands.up):
        return None
    corners = stands.corners
    feet, rest = [], []
    angle = np.arange(FEET) * (2 * np.pi / FEET) + 0.1
    for up in stands.up:
        x = np.cross(up, np.eye(3)[np.abs(up).argmin()])
        x /= np.linalg.norm(x)
        side = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * np.cross(up, x)
        height = corners @ up
        height = height - height.min()
        near = np.flatnonzero(height < CLEARANCE)
        outermost = near[(corners[near] @ side.T).argmax(0)]
        feet.append(corners[outermost])
        rest.append(height[outermost])
    up, corners = torch.from_numpy(stands.up.copy()), torch.from_numpy(corners.copy())
    level = (corners @ up.mT).amin(0)
    return _Stands(up, level, torch.from_numpy(np.array(feet)), torch.from_numpy(np.array(rest)), corners)


def standing_on(bodies: Sequence[Body], poses: Tensor, normal: Tensor) -> Feet:
    """The feet of the faces that objects at poses (N, 4, 4) are nearest to standing on, given what is up (3,)."""
    points, rest, tilt, lowest = [], [], [], []
    for body, T in zip(bodies, poses, strict=True):
        stands = _stands(body)
        if stands is None or not bool(T.isfinite().all()):
            points.append(torch.zeros(FEET, 3, dtype=torch.float64))
            rest.append(torch.zeros(FEET, dtype=torch.float64))
            tilt.append(torch.tensor(torch.inf, dtype=torch.float64))
            lowest.append(torch.full((3,), torch.nan, dtype=torch.float64))
            continue
        up = T[:3, :3].mT @ normal
        lowest.append(stands.corners[(stands.corners @ up).argmin()])
        cosine, best = (stands.up @ up).max(0)
        points.append(stands.feet[best])
        rest.append(stands.rest[best])
        tilt.append(torch.arccos(cosine.clamp(-1.0, 1.0)))
    if not points:
        none = torch.zeros(0, FEET, 3, dtype=torch.float64)
        return Feet(none, none[..., 0], none[:, 0, 0], none[:, 0])
    return Feet(torch.stack(points), torch.stack(rest), torch.stack(tilt), torch.stack(lowest))


def plane_hypotheses(
    bodies: Sequence[Body], poses: Tensor, config: TableConfig, *, gravity: Tensor | None = None, most: int = 4
) -> list[Hypothesis]:
    """Planes that the objects may stand on, the likeliest first: each object proposes the faces of its hull that it could
    stand on, and the others say how well they would stand, too.

    Args:
        bodies: N objects.
        poses: T_camera_object (N, 4, 4) [m]; rows of NaN propose nothing.
        config: standard deviations of the poses.
        gravity: (3,) unit vector pointing down, if known.
        most: how many.
    """
    members = [
        (stands, T)
        for body, T in zip(bodies, poses, strict=True)
        if bool(T.isfinite().all()) and (stands := _stands(body)) is not None
    ]
    if not members:
        return []
    up = [stands.up @ T[:3, :3].mT for stands, T in members]
    normal = torch.cat(up)
    offset = torch.cat([u @ T[:3, 3] + stands.level for u, (stands, T) in zip(up, members, strict=True)])
    score = torch.zeros(len(normal), dtype=torch.float64)
    for own, (stands, T) in zip(up, members, strict=True):
        tilt = torch.arccos((normal @ own.mT).clamp(-1.0, 1.0)).amin(1)
        corners = stands.corners @ T[:3, :3].mT + T[:3, 3]
        lowest = (corners @ normal.mT).amin(0) - offset
        reach = (normal @ T[:3, 3]) * config.sigma_ray_fraction
        extent = torch.linalg.vector_norm(corners - corners.mean(0), dim=1).max()
        variance = 2 * (reach**2 + (extent * config.sigma_rotation) ** 2 + config.sigma_lateral**2)
        stands_badly = tilt**2 / (4 * config.sigma_rotation**2) + lowest**2 / variance
        # it may stand on something else, and then it is above the plane; it cannot be below
        score -= torch.where(lowest > 0, 2.0 * torch.log1p(stands_badly / 4.0), 12.0 * torch.log1p(stands_badly / 24.0))
    if gravity is not None:
        score -= 0.5 * torch.arccos((-normal @ gravity).clamp(-1.0, 1.0)) ** 2 / (4 * config.sigma_gravity) ** 2
    else:
        score -= 0.5 * (normal[:, 0] / ROLL) ** 2 + 2.0 * (normal[:, 1] > 0.5)
    score = torch.where(offset < -LEAST_HEIGHT, score, -torch.inf)

    middle = torch.stack([T[:3, 3] for _, T in members]).mean(0)
    height = offset - normal @ middle
    found: list[Hypothesis] = []
    while len(found) < most:
        best = int(score.argmax())
        if not math.isfinite(float(score[best])):
            break
        found.append(Hypothesis(normal[best], offset[best], float(score[best])))
        same = torch.arccos((normal @ normal[best]).clamp(-1.0, 1.0)) < DISTINCT[0]
        same &= (height - height[best]).abs() < DISTINCT[1]
        score = torch.where(same, -torch.inf, score)
    return found
