"""What is known about objects, cameras and table: the terms of the adjustment, each a whitened residual.

Residuals are functions of unknowns that may have leading dimensions (...), which they keep.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from physpose_torch.config import TableConfig
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.table.adjustment import State, Unknowns
from physpose_torch.table.standing import FEET, Feet
from physpose_torch.table.view import pixel_rays, project

__all__ = [
    "CommonDepth",
    "Contact",
    "EpipolarMatches",
    "Gravity",
    "ModelPoints",
    "NotBelow",
    "Outlines",
    "PlaneMatches",
    "PosePrior",
    "SurfaceMatches",
    "Upright",
    "few",
    "plane_terms",
]


LEANING = math.radians(20.0)
"""What is tilted by more than this from all faces it could stand on stands on none."""
INDEPENDENT = 100.0
"""Matches on the table count as this many at the most: neither lenses nor tables are perfect."""
GATE = 4.0
"""Standard deviations within which a match may be on the plane …"""
LEAST_ON_PLANE = 50
"""Fewer matches than this agree on some plane by chance: edges, shadows, the rim of another table."""
NEAREST, FARTHEST = 0.05, 20.0
"""[m]; depths between which a table may be."""
SLACK = 0.5
"""… with so much to spare [px]."""


def few(owner: Tensor, most: float) -> Tensor:
    """Weights (G,) that let the rows of one object (or all rows, owner 0) count for at most so many independent ones."""
    count = torch.bincount(owner).clamp_min(1).double()
    return (most / count).clamp_max(1.0)[owner]


def _seen(x: Unknowns, view: int, owner: Tensor, points: Tensor) -> Tensor:
    """Points (G, 3) of objects, in a view's camera frame (..., G, 3)."""
    R, t = x.pose(view)
    return _turned(R[..., owner, :, :], points) + t[..., owner, :]


def _turned(R: Tensor, vectors: Tensor) -> Tensor:
    return (R * vectors[..., None, :]).sum(-1)


def _moved(x: Unknowns, points: Tensor) -> Tensor:
    """Points (..., G, 3) of view 0 in view 1."""
    return points @ x.R10.mT + x.t10[..., None, :]


@dataclass(frozen=True, eq=False)
class PosePrior:
    """The estimated poses of one view (paper, Eq. 2, with a factor that all depths share)."""

    view: int
    measured: Tensor
    """(G, 4, 4), of the objects that were seen."""
    center: Tensor
    """(G, 3) of their bounds, object frame; viewing rays go there [m]."""
    owner: Tensor
    config: TableConfig
    weight: float = 1.0
    nu: float = 8.0
    cap: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(G, 6): along the ray, across it, rotation."""
        R, t = (v[..., self.owner, :, :] for v in (x.pose(self.view)[0], x.pose(self.view)[1][..., None]))
        measured = _turned(self.measured[:, :3, :3], self.center) + self.measured[:, :3, 3]
        distance = torch.linalg.vector_norm(measured, dim=1, keepdim=True)
        ray = measured / distance
        # divided, not the estimates multiplied: residuals must not shrink with the scene
        off = (_turned(R, self.center) + t[..., 0]) / x.depth_factor[..., None, None] - measured
        along = (off * ray).sum(-1, keepdim=True) / (self.config.sigma_ray_fraction * distance)
        across = (tangent_basis(ray) @ off[..., None])[..., 0] / self.config.sigma_lateral
        turn = self.measured[:, :3, :3].mT @ R
        turn = 0.5 * (turn - turn.mT)  # sine times axis: all that is needed near the estimate
        turn = torch.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], -1) / self.config.sigma_rotation
        return torch.cat([along, across, turn], -1)


@dataclass(frozen=True, eq=False)
class Contact:
    """Objects stand on the table, with the feet of one face each; or on something else, which is not much less likely."""

    feet: Feet
    owner: Tensor
    sigma: float
    cost: float = 0.0
    """Of the objects that stand on nothing, so that planes can be compared by how many stand on them."""
    weight: float = 1.0
    nu: float = math.inf
    cap: float = 12.0

    @classmethod
    def of(cls, feet: Feet, sigma: float) -> "Contact":
        """All objects that do not lean too much; those that do cost as much as those that are far above."""
        owner = (feet.tilt < LEANING).nonzero()[:, 0]
        leaning = int(feet.tilt.isfinite().sum()) - len(owner)
        return cls(feet, owner, sigma, leaning * cls.cap)

    def residual(self, x: Unknowns) -> Tensor:
        """(G, FEET): heights above where they belong; three of them would say all."""
        points, rest = self.feet.points[self.owner], self.feet.rest[self.owner]
        up = (x.R[..., self.owner, :, :] * x.normal[..., None, :, None]).sum(-2)
        level = (x.t[..., self.owner, :] * x.normal[..., None, :]).sum(-1) - x.offset[..., None]
        height = (points * up[..., None, :]).sum(-1) + level[..., None]
        return (height - rest) * (math.sqrt(3.0 / FEET) / self.sigma)


@dataclass(frozen=True, eq=False)
class NotBelow:
    """Nothing is below the table, whatever it stands on."""

    lowest: Tensor
    """(G, 3) the lowest point of each object, object frame [m]."""
    owner: Tensor
    sigma: float
    weight: float = 1.0
    nu: float = 30.0
    cap: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(G, 1): how deep each is."""
        height = (_seen(x, 0, self.owner, self.lowest) * x.normal[..., None, :]).sum(-1) - x.offset[..., None]
        return height.clamp_max(0.0)[..., None] / self.sigma


@dataclass(frozen=True, eq=False)
class CommonDepth:
    """The factor that all estimated depths are off by."""

    sigma: float
    owner: None = None
    weight: float = 1.0
    nu: float = math.inf
    cap: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(1, 1)."""
        return ((x.depth_factor - 1.0) / self.sigma)[..., None, None]


@dataclass(frozen=True, eq=False)
class Gravity:
    """The table is level, and what is down is known."""

    down: Tensor
    """(3,) unit vector, view 0."""
    sigma: float
    owner: None = None
    weight: float = 1.0
    nu: float = math.inf
    cap: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(1, 3): the chord, which unlike the sine goes on growing up to upside down."""
        return ((x.normal + self.down) / self.sigma)[..., None, :]


@dataclass(frozen=True, eq=False)
class Upright:
    """Where gravity is not known: cameras are mostly held upright, and look along the table or down on it."""

    sigma: float
    """Standard deviation of the sine of the roll."""
    owner: None = None
    weight: float = 1.0
    nu: float = math.inf
    cap: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(1, 1)."""
        return (x.normal[..., 0] / self.sigma)[..., None, None]


@dataclass(frozen=True, eq=False)
class EpipolarMatches:
    """Matches off the objects lie on their epipolar lines, whatever they are on."""

    rays: Tensor
    """(M, 3) of the points in view 0."""
    depth: Tensor
    """(M,) any depth [m]: it moves points along their lines only."""
    points_1: Tensor
    """(M, 2) [px]."""
    across: Tensor
    """(M, 2) across the line, divided by the standard deviation [1/px]; of the state it was made for."""
    K1: Tensor
    weight: Tensor
    nu: float = 4.0
    cap: None = None
    owner: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(M, 1)."""
        off = project(self.K1, _moved(x, self.depth[:, None] * self.rays)) - self.points_1
        return (self.across * off).sum(-1, keepdim=True)


@dataclass(frozen=True, eq=False)
class PlaneMatches:
    """Matches that may be on the plane are where it puts them along their epipolar lines; across, it has no say."""

    rays: Tensor
    """(M, 3) of the points in view 0."""
    points_1: Tensor
    """(M, 2) [px]."""
    along: Tensor
    """(M, 2) along the line, given what is across, divided by the standard deviation [1/px]."""
    K1: Tensor
    weight: Tensor
    cost: float = 0.0
    """What they cost if they were elsewhere, negative: planes can be compared by how many are on them."""
    nu: float = 4.0
    cap: None = None
    owner: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(M, 1)."""
        depth = x.offset[..., None] / (x.normal @ self.rays.mT)
        off = project(self.K1, _moved(x, depth[..., None] * self.rays)) - self.points_1
        return (self.along * off).sum(-1, keepdim=True)


def plane_terms(
    state: State, plane: Tensor, K0: Tensor, K1: Tensor, points_0: Tensor, points_1: Tensor, covariance: Tensor
) -> tuple[EpipolarMatches, PlaneMatches]:
    """Terms of matches (M, 2), (M, 2) off the objects, the second with covariances (M, 2, 2) [px²].

    Where a match lies along its epipolar line counts only if it may be on the plane, as well as that is known: with covariance
    ``plane`` (3, 3). There are other planes in the world, a floor above all, and often more of them is seen.
    """
    rays = pixel_rays(K0, points_0)
    depth = state.offset / (rays @ state.normal)
    ahead = (depth > NEAREST) & (depth < FARTHEST)  # else above the horizon
    depth = torch.where(ahead, depth, 1.0)
    near = depth[:, None] * rays
    R, t = state.T_view1_view0[:3, :3], state.T_view1_view0[:3, 3]
    where = project(K1, near @ R.mT + t)
    along = (project(K1, 1.01 * near @ R.mT + t) - where) / 0.01
    length = torch.linalg.vector_norm(along, dim=1, keepdim=True)
    along = torch.where(length > 1e-9, along / length.clamp_min(1e-9), along.new_tensor([1.0, 0.0]))
    turn = torch.stack([torch.stack([-along[:, 1], along[:, 0]], 1), along], 1)
    turned = turn @ covariance @ turn.mT
    whitening = torch.linalg.solve_triangular(torch.linalg.cholesky(turned), turn, upper=False)
    off = _turned(whitening, where - points_1)

    lever = (near - state.middle) @ tangent_basis(state.normal[None])[0].mT
    lever = torch.cat([lever, torch.ones_like(lever[:, :1])], 1)
    # a plane that is higher by h is nearer by h / offset of the depth
    wander = torch.einsum("mi,ij,mj->m", lever, plane, lever) * (length[:, 0] / state.offset) ** 2
    shift = ((where - points_1) * along).sum(1)
    on = ahead & (off[:, 0].abs() < GATE) & (shift**2 < GATE**2 * (turned[:, 1, 1] + wander + SLACK**2))
    if int(on.sum()) < LEAST_ON_PLANE:
        on = torch.zeros_like(on)
    together = torch.zeros(len(rays), dtype=torch.int64)
    # by how much likelier they are on the plane than anywhere
    cost = -0.5 * (PlaneMatches.nu + 1) * math.log1p(GATE**2 / PlaneMatches.nu) * min(int(on.sum()), INDEPENDENT)
    return (
        EpipolarMatches(rays, depth, points_1, whitening[:, 0], K1, few(together, INDEPENDENT)),
        PlaneMatches(rays[on], points_1[on], whitening[on, 1], K1, few(together[on], INDEPENDENT), cost),
    )


@dataclass(frozen=True, eq=False)
class SurfaceMatches:
    """Matches on objects: the ray of view 0 meets the surface, and view 1 sees that point. No colours are needed."""

    rays: Tensor
    """(M, 3) of the points in view 0."""
    points_1: Tensor
    """(M, 2) [px]."""
    surface: Tensor
    """(M, 3) a point of the face that is met, object frame [m]."""
    normal: Tensor
    """(M, 3) of that face, object frame."""
    whitening: Tensor
    """(M, 2, 2)."""
    owner: Tensor
    K1: Tensor
    weight: Tensor
    nu: float = 4.0
    cap: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(M, 2)."""
        surface = _seen(x, 0, self.owner, self.surface)
        normal = _turned(x.R[..., self.owner, :, :], self.normal)
        depth = (normal * surface).sum(-1) / (normal * self.rays).sum(-1)
        off = project(self.K1, _moved(x, depth[..., None] * self.rays)) - self.points_1
        return _turned(self.whitening, off)


@dataclass(frozen=True, eq=False)
class ModelPoints:
    """Points of objects that were found in an image, by their colours."""

    view: int
    points: Tensor
    """(M, 3) object frame [m]."""
    pixels: Tensor
    """(M, 2)."""
    whitening: Tensor
    """(M, 2, 2)."""
    owner: Tensor
    K: Tensor
    weight: Tensor
    nu: float = 4.0
    cap: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(M, 2)."""
        off = project(self.K, _seen(x, self.view, self.owner, self.points)) - self.pixels
        return _turned(self.whitening, off)


@dataclass(frozen=True, eq=False)
class Outlines:
    """Points of objects' outlines that were found in an image, across the outline only."""

    view: int
    points: Tensor
    """(M, 3) of the outline, object frame [m]."""
    pixels: Tensor
    """(M, 2) where the outline is in the image."""
    across: Tensor
    """(M, 2) unit normals of the outline, divided by the standard deviation [1/px]."""
    owner: Tensor
    K: Tensor
    weight: Tensor
    nu: float = 3.0
    cap: None = None

    def residual(self, x: Unknowns) -> Tensor:
        """(M, 1)."""
        off = project(self.K, _seen(x, self.view, self.owner, self.points)) - self.pixels
        return (off * self.across).sum(-1, keepdim=True)
