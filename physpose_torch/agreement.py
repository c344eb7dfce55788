"""What a scene says of estimates before anything is moved: how high they are, how accurate, and how they are all wrong."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.contacts import SUPPORT_SLOPE, object_heights, plane_variance
from physpose_torch.geometry.resting import NearestRest, nearest_rest
from physpose_torch.prior import PosePrior
from physpose_torch.report import measure
from physpose_torch.scene import Scene

__all__ = [
    "Flush",
    "Heights",
    "agreed_scale",
    "asked_depth",
    "asked_tilt",
    "look",
    "scaled",
    "vertical_variance",
    "weights",
]

LEVEL = math.cos(math.radians(20))
"""Cosine of the slope up to which objects stand on a plane as they would on a table."""
FARTHEST = 0.05
"""[m]; objects this far from what carries them say nothing of the accuracy of the others."""
BETTER = 0.25
"""Estimates are of the usual accuracy, or have heights that spread by this share of it, …"""
RARE = 0.2
"""… which so many images are expected to have."""
NU = 2.0
"""Degrees of freedom of Student's t of the depth factor that each object asks for: some estimates are grossly wrong."""
PRIOR = 3.0
"""Width of the prior of the depth factor that an image asks for, in σ of the common one."""
NEAREST = 0.01
"""[m]; what is nearer to the camera has no direction to be seen in."""
GRID = torch.arange(-200, 201, dtype=torch.float64) / 1000
"""Depth factors, less one, that an image may ask for."""
NEAR = 0.02
"""[m]; an object no higher than this above a plane stands on it, …"""
SUNK = 0.1
"""… [m]; unless it is deeper in it than this."""
FLUSH = math.radians(8)
"""An object that is tilted by more than this against its nearest stable pose is not meant to stand flush."""
ASKEW = math.radians(20)
"""One that is tilted by more than this says nothing of the plane's tilt."""


class Heights(NamedTuple):
    """How estimates stand; (N,) each."""

    height: Tensor
    """Above what carries it [m], negative inside something static; NaN or infinite where that is not known."""
    level: Tensor
    """Above the level plane it is above or in [m]; NaN where something else carries it, or nothing."""
    camera: Tensor
    """How high the camera is above the object's centre [m]: a depth factor 1 + s lowers the object by s times this."""
    variance: Tensor
    """Of the plane's surface there [m²]."""
    tilt_variance: Tensor
    """And of the plane's tilt [rad²]."""
    rest: NearestRest
    """The nearest stable pose."""
    up: Tensor
    """(N, 3) against gravity, camera frame; zero where it is not known."""


def look(prior: PosePrior, scene: Scene, acts: Tensor, backend: str) -> Heights:
    """How the estimates stand, depth bias removed.

    Args:
        prior: the flat estimates.
        scene: the flat scene.
        acts: (N,) bool.
        backend: distance backend.
    """
    poses, n = prior.measured, len(scene)
    in_static, _, drop, support = measure(poses, scene, acts, backend)
    gravity = scene.gravity.to(poses)[scene.image.to(poses.device)]
    falls = (gravity != 0).any(-1) & scene.has_static.to(poses.device)[scene.image.to(poses.device)]
    height = torch.where(falls, torch.where(in_static > 0, -in_static, drop), torch.nan)

    who, plane = scene.plane_pairs.to(poses.device).unbind(1)
    flat = -(scene.plane_normal.to(poses)[plane] * gravity[who]).sum(-1) >= LEVEL
    above = torch.where(flat, object_heights(poses, scene), torch.inf)
    lowest = poses.new_full((n,), torch.inf).scatter_reduce(0, who, above, "amin")
    on_plane = (lowest < 0) | (support >= len(scene.entity_image))
    level = torch.where(on_plane & lowest.isfinite(), lowest, torch.nan)
    variance = torch.where(flat, plane_variance(poses, scene, who, plane, acts), 0.0)
    variance = poses.new_zeros(n).scatter_reduce(0, who, variance, "amax")
    tilt = scene.plane_covariance.to(poses).diagonal(dim1=1, dim2=2)[:, :2].mean(1)
    tilt = poses.new_zeros(n).scatter_reduce(0, who, torch.where(flat, tilt[plane], 0.0), "amax")

    camera = (scene.centers(poses) * gravity).sum(-1)
    local = -(poses[:, :3, :3].mT @ gravity[:, :, None])[:, :, 0]
    return Heights(height, level, camera, variance, tilt, nearest_rest(scene.objects, local), -gravity)


def asked_depth(heights: Heights, prior: PosePrior, scores: Tensor) -> Tensor:
    """The factor, less one, by which the depths of each image (I,) would have to change for its objects to stand on planes.

    A vote of objects that act, weighted by their scores, each with Student's t about what it asks for itself: estimates that
    are wrong altogether are outvoted. Objects on other objects have no say. Without a depth factor in common it is zero.
    """
    out = prior.ray.new_zeros(prior.n_images)
    if prior.sigma_common == 0 or not len(scores):
        return out
    grid = GRID.to(out)
    distance = prior.ray.norm(dim=-1)
    voters = prior.acts & heights.level.isfinite() & (heights.camera > SUPPORT_SLOPE * distance) & (distance > NEAREST)
    distance, camera = (torch.where(voters, x, 1.0) for x in (distance, heights.camera))
    covariance = torch.linalg.inv(prior.precision)[:, :3, :3]
    along = torch.einsum("ni,nij,nj->n", prior.ray, covariance, prior.ray) / distance**4
    asks = torch.where(voters, heights.level, 0.0) / camera
    spread = torch.where(voters, along + heights.variance / camera**2, 1.0).sqrt()
    off = ((asks[:, None] - grid) / spread[:, None]) ** 2
    share = torch.where(voters, weights(scores, prior), 0.0)
    cost = 0.5 * (NU + 1) * torch.log1p(off / NU) * share[:, None]
    total = 0.5 * (grid / (PRIOR * prior.sigma_common)) ** 2
    total = total.expand(prior.n_images, -1).index_add(0, prior.image, cost)
    return grid[total.argmin(1)]


def weights(scores: Tensor, prior: PosePrior) -> Tensor:
    """Scores (N,) as shares of the best of each image, 0 to 1; all 1 in images with negative ones, or none above zero."""
    scores = scores.to(prior.ray)
    best = scores.new_full((prior.n_images,), -torch.inf).scatter_reduce(0, prior.image, scores, "amax")
    least = scores.new_full((prior.n_images,), torch.inf).scatter_reduce(0, prior.image, scores, "amin")
    told = (best > 0) & (least >= 0)
    return torch.where(told[prior.image], scores / torch.where(told, best, 1.0)[prior.image], 1.0)


def asked_tilt(heights: Heights, prior: PosePrior) -> Tensor:
    """By how much [rad] gravity would have to turn in each image (I,) for its objects to stand flush; NaN: too few of them.

    The median, each way, of the turns that bring objects on level planes to their nearest stable poses.
    """
    out = prior.ray.new_full((prior.n_images,), torch.nan)
    rest, up = heights.rest, heights.up
    upright = (prior.measured[:, :3, :3] @ rest.up[:, :, None])[:, :, 0]
    voters = prior.acts & (rest.tilt < ASKEW) & (heights.level < NEAR)
    for image in prior.image[voters].unique().tolist():
        there = voters & (prior.image == image)
        if int(there.sum()) > 1:
            turn = torch.quantile((upright - up)[there], 0.5, dim=0)
            out[image] = 2 * torch.arcsin((0.5 * turn.norm()).clamp(max=1.0))
    return out


def agreed_scale(heights: Heights, prior: PosePrior, *, sigma_contact: float, least: float) -> Tensor:
    """By what (I,) to scale the variances of each image's estimates, along the ray and in rotation.

    σ are what RGB estimators are usually like; some are much better, and moving theirs as if they were not would do harm. By
    the heights at which the objects of an image are estimated, either they are of the usual kind, or of one whose heights
    spread ``BETTER`` times as much; the scale is the mean of 1 and of ``least``² by the posterior of the two.

    Args:
        heights: of the estimates.
        prior: with the usual σ.
        sigma_contact: standard deviation of gaps between bodies in contact [m].
        least: smallest share of σ.
    """
    variance = vertical_variance(heights, prior) + (prior.sigma_common * heights.camera) ** 2 + sigma_contact**2
    voters = prior.acts & (heights.height.abs() < FARTHEST)
    square = torch.where(voters, heights.height**2 / variance, 0.0)
    ratio = -math.log(BETTER) - 0.5 * square * (BETTER**-2 - 1)
    odds = prior.ray.new_full((prior.n_images,), math.log(RARE / (1 - RARE)))
    better = odds.index_add(0, prior.image, torch.where(voters, ratio, 0.0)).sigmoid()
    return 1 - better * (1 - least**2)


def scaled(prior: PosePrior, scale: Tensor) -> PosePrior:
    """The prior with variances along the rays and of rotations times ``scale`` (I,); heights tell nothing of those across."""
    scale = scale[prior.image]
    if bool((scale == 1).all()):
        return prior
    direction = torch.nn.functional.normalize(prior.ray, dim=-1)
    covariance = torch.linalg.inv(prior.precision)
    along = torch.einsum("ni,nij,nj->n", direction, covariance[:, :3, :3], direction) * (scale - 1)
    covariance[:, :3, :3] += along[:, None, None] * direction[:, :, None] * direction[:, None, :]
    covariance[:, 3:, 3:] *= scale[:, None, None]
    return prior._replace(precision=torch.linalg.inv(covariance))


def vertical_variance(heights: Heights, prior: PosePrior) -> Tensor:
    """Variance (N,) of each estimate's height above its plane [m²], the common depth factor aside."""
    covariance = torch.linalg.inv(prior.precision)[:, :3, :3]
    return torch.einsum("ni,nij,nj->n", heights.up, covariance, heights.up) + heights.variance


class Flush(NamedTuple):
    """Objects that stand on planes, and how they would stand flush."""

    stands: Tensor
    """(N,) bool."""
    up: Tensor
    """(N, 3) against gravity, camera frame."""
    own_up: Tensor
    """(N, 3) what points there in the nearest stable pose, object frame."""
    variance: Tensor
    """(N,) of the plane's tilt [rad²]."""

    @classmethod
    def of(cls, heights: Heights) -> "Flush":
        stands = (heights.rest.tilt < FLUSH) & (heights.level < NEAR) & (heights.level > -SUNK)
        return cls(stands, heights.up, heights.rest.up, heights.tilt_variance)

    def join(self, prior: PosePrior, sigma: float) -> PosePrior:
        """The prior joined with this: the tilt against the stable pose, about two axes, is zero to within ``sigma`` [rad], and
        what the plane's own tilt may be off.

        True poses and planes of real data are 2° apart. Turning about the vertical is left free.
        """
        if sigma == math.inf or not bool(self.stands.any()):
            return prior
        up = (prior.measured[:, :3, :3].mT @ self.up[:, :, None])[:, :, 0]
        axis = torch.linalg.cross(self.own_up, up)
        sine = axis.norm(dim=1, keepdim=True).clamp(1e-12, 1.0)
        turn = torch.arcsin(sine) / sine * axis
        level = torch.eye(3).to(up) - up[:, :, None] * up[:, None, :]
        level = level / (sigma**2 + self.variance)[:, None, None]
        precision = prior.precision.clone()
        precision[:, 3:, 3:] += level
        pull = torch.cat([torch.zeros_like(turn), (level @ turn[:, :, None])[:, :, 0]], dim=1)
        joined = se3.retract(prior.measured, torch.linalg.solve(precision, pull))
        stands = self.stands[:, None, None]
        measured = torch.where(stands, joined, prior.measured)
        return prior._replace(measured=measured, precision=torch.where(stands, precision, prior.precision))
