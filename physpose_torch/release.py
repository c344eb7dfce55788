"""Before the refinement, which estimates may push and how much they are trusted; after it, which are left as they were."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.agreement import (
    Flush,
    Heights,
    agreed_scale,
    asked_depth,
    asked_tilt,
    look,
    scaled,
    vertical_variance,
)
from physpose_torch.config import RefinerConfig
from physpose_torch.conflicts import find_dubious
from physpose_torch.prior import PosePrior, common_depth
from physpose_torch.report import PhysicsReport
from physpose_torch.scene import Scene
from physpose_torch.stability import BALANCE, Posed, stability_margin

__all__ = ["Plan", "Released", "make_plan", "release"]

DEEP = 5e-3
"""[m]; an object this deep in something, or this high above it, has not come to rest; nor is it if that is more than …"""
SOFT = 3.0
"""… this many σ of its plane."""
DUBIOUS = 0.01
"""[m]; one that pushes nobody, and is this deep in another one at the end, has not found its place."""
LEAST_REACH = 0.015
"""[m]; so far down supports are always looked for."""
DEPTH = 0.01
"""Least standard deviation of the depth factor of an image: however well an estimator is known, scenes differ by so much."""
TILT = math.radians(2.75)
"""Standard deviation of the tilt that the objects of an image agree on, where estimates and plane are right."""
LOWEST = 0.05
"""[m]; a camera that is no higher above the objects sees the plane edge-on, and their depths tell nothing of it."""
MOST = 2 / 3
"""Where this share of an image's objects would have to move too far, it is not them that are wrong."""


class Plan(NamedTuple):
    """How the estimates of a flat scene are gone about; what is None or all alike is as in the config."""

    acts: Tensor
    """(N,) bool, on the CPU: those of the scene without the dubious ones."""
    dubious: Tensor
    """(N,) bool, on the CPU."""
    scale: Tensor
    """(I,) of the variances of each image's estimates."""
    flush: Flush | None
    """Who stands."""
    reach: Tensor
    """(N,) how far down supports are looked for while all are still off by the common depth factor [m]."""
    own_reach: Tensor
    """(N,) and how far without it."""
    plane_sigma: Tensor
    """(N,) of the height of the plane that each object is on or in [m]."""
    doubts: tuple[str, ...]
    """(I) why each image is left as it is, or nothing."""

    def changes(self, prior: PosePrior) -> bool:
        """Whether it is another cost than that of the plain estimates."""
        alike = bool((self.scale == 1).all()) and torch.equal(self.reach, prior.reach)
        flush = self.flush is not None and bool(self.flush.stands.any())
        return not alike or flush or bool(self.dubious.any())

    def prior(self, prior: PosePrior, config: RefinerConfig, copies: int = 1) -> PosePrior:
        """The prior of the estimates, or ``copies`` of it one after another, with what the plan makes of it."""
        prior = scaled(prior, self.scale.repeat(copies))
        acts, reach = self.acts.to(prior.acts.device).repeat(copies), self.reach.to(prior.reach).repeat(copies)
        prior = prior._replace(acts=acts, reach=reach)
        if self.flush is None:
            return prior
        flush = Flush(*(x.repeat(copies, *[1] * (x.ndim - 1)) for x in self.flush))
        return flush.join(prior, config.physics.sigma_flush)


def make_plan(
    prior: PosePrior, scene: Scene, acts: Tensor, scores: Tensor | None, config: RefinerConfig, *, given: bool
) -> Plan:
    """Look at the estimates before anything is moved.

    Args:
        prior: of the flat estimates.
        scene: the flat scene.
        acts: (N,) bool, on the CPU.
        scores: (N,), or None.
        config: its caution and σ.
        given: the estimates' covariance was given with them, and is taken as it is.
    """
    caution, physics = config.caution, config.physics
    nobody = torch.zeros(len(scene), dtype=torch.bool)
    ones, none = prior.ray.new_ones(scene.n_images), ("",) * scene.n_images
    flush = physics.sigma_flush < math.inf
    careful = min(caution.conflict, caution.release, caution.doubt) < math.inf or caution.least_sigma < 1
    if not len(scene) or not (flush or careful):
        return Plan(acts, nobody, ones, None, prior.reach, prior.reach, 0 * prior.reach, none)
    heights = look(prior, scene, acts, physics.backend)
    weighed = torch.ones(len(scene)) if scores is None else torch.as_tensor(scores).detach()
    weighed = weighed.to(prior.ray)
    depth = asked_depth(heights, prior, weighed)
    scale = ones
    if caution.least_sigma < 1 and not given:
        scale = agreed_scale(heights, prior, sigma_contact=physics.sigma_contact, least=caution.least_sigma)
    surer = scaled(prior, scale)
    own_reach = reach = prior.reach
    if caution.release < math.inf:
        own_reach = caution.release * vertical_variance(heights, surer).sqrt()
        own_reach = own_reach.clamp_min(LEAST_REACH).minimum(prior.reach)
        down = depth[prior.image].clamp_min(0.0) * heights.camera.clamp_min(0.0)
        reach = (own_reach + down).minimum(prior.reach)
    options = {"limit": caution.conflict, "backend": physics.backend}
    dubious = find_dubious(heights, depth, surer, scene, weighed, **options)
    doubts = none
    if caution.doubt < math.inf:
        doubts = _doubts(heights, depth, prior, scene, caution.doubt)
    stands = Flush.of(heights) if flush else None
    return Plan(acts & ~dubious, dubious, scale, stands, reach, own_reach, heights.variance.sqrt(), doubts)


def _doubts(heights: Heights, depth: Tensor, prior: PosePrior, scene: Scene, limit: float) -> tuple[str, ...]:
    """Where depth or tilt of an image's objects contradict what is known of it, in words.

    An object that is alone and contradicts its plane is taken to be wrong itself.
    """
    zeros = depth.new_zeros(scene.n_images)
    count = zeros.index_add(0, prior.image, prior.acts.to(zeros))
    acting = torch.where(prior.acts, 1 / count[prior.image].clamp_min(1), 0.0)
    camera, variance = (zeros.index_add(0, prior.image, acting * x) for x in (heights.camera, heights.variance))
    common = max(prior.sigma_common, DEPTH) if prior.sigma_common > 0 else 0.0
    depth_sigma = (common**2 + variance / camera.clamp_min(LOWEST) ** 2).sqrt()
    tilt_variance = scene.plane_covariance.to(zeros).diagonal(dim1=1, dim2=2)[:, :2].amax(1)
    tilt_variance = zeros.scatter_reduce(0, scene.plane_image.to(zeros.device), tilt_variance, "amax")
    tilt_sigma = (TILT**2 + tilt_variance).sqrt()
    out = []
    columns = (count, depth, depth_sigma, asked_tilt(heights, prior), tilt_sigma)
    for n, s, s_sigma, tilt, t_sigma in zip(*(x.tolist() for x in columns), strict=True):
        reasons = []
        if n > 1 and common > 0 and abs(s) > limit * s_sigma:
            reasons.append(
                f"its objects would have to be at {1 + s:.3f} of their distances to stand on the plane, expected 1 ± "
                f"{limit * s_sigma:.3f}; check plane, units and intrinsics, or calibrate the estimator"
            )
        if tilt > limit * t_sigma:
            reasons.append(
                f"its objects stand {math.degrees(tilt):.0f}° askew, expected up to {math.degrees(limit * t_sigma):.0f}°; "
                "check the plane and gravity"
            )
        out.append("; ".join(reasons))
    return tuple(out)


class Released(NamedTuple):
    """Estimates that are left as they were."""

    rejected: Tensor
    """(N,) bool: moved too far, and still not at rest."""
    unsupported: Tensor
    """(N,) bool: nothing below within reach. They stay where their estimates are, but for the estimator's depth bias."""
    doubts: tuple[str, ...]
    """(I) why whole images are, or nothing."""


def release(
    poses: Tensor,
    standing: Tensor,
    plan: Plan,
    prior: PosePrior,
    scene: Scene,
    righted: Tensor,
    report: PhysicsReport,
    config: RefinerConfig,
) -> Released:
    """Decide which estimates are left as they were.

    Args:
        poses: (N, 4, 4) refined.
        standing: (N, 4, 4) the estimates, those that were righted as they stand.
        plan: what the refinement followed.
        prior: that of the plan.
        scene: the flat scene.
        righted: (N,) bool, turned to stand; how far they were turned is not held against them.
        report: at these poses, those of the plan acting; of the N objects in this order.
        config: its caution.
    """
    caution = config.caution
    nobody = torch.zeros_like(righted)
    gap, in_object, depth, in_static, support = (
        x.reshape(-1)
        for x in (report.gap, report.penetration_object, report.penetration, report.penetration_static, report.support)
    )
    grounded = (scene.has_static & (scene.gravity != 0).any(-1)).to(righted.device)[prior.image]
    grounded = grounded & (config.physics.gravity_weight > 0)
    moved = _excess(poses, standing, prior, scene, turned=righted)
    far = moved > caution.release
    rejected = nobody
    if bool(far.any()):
        part, here = scene.select(scene.image[far.cpu()].unique())  # most images have nothing to look at
        at = here.to(far.device)
        # a plane that is not well known is soft; who lies in it is judged where it would just touch
        bedded = torch.where(support >= len(scene) + len(scene.static_bodies), in_static, 0.0)
        posed = Posed.of(poses[at], part, plan.acts[here], (gap - bedded)[at], config.physics.backend)
        margin = torch.full_like(gap, torch.nan).index_copy(0, at, stability_margin(posed, only=far[at]).to(gap))
        deep = (SOFT * plan.plane_sigma).clamp_min(DEEP)
        stands = ~grounded | ((gap < deep) & (margin > BALANCE))
        rejected = far & (righted | (depth > deep) | ~stands)
    if caution.release < math.inf:
        rejected = rejected | (plan.dubious.to(righted.device) & (in_object > DUBIOUS))
    unsupported = nobody
    if caution.unsupported == "stay":
        unsupported = grounded & ~rejected & (gap > plan.own_reach)
    doubts = plan.doubts
    if caution.doubt < math.inf:
        count, too_far = (
            torch.zeros(scene.n_images, dtype=torch.long)
            .index_add(0, scene.image, (x & prior.acts).long().cpu())
            .tolist()
            for x in (grounded, far & grounded)
        )
        found = zip(doubts, too_far, count, strict=True)
        doubts = tuple(doubt or (_most(m, n) if n > 1 and m >= MOST * n else "") for doubt, m, n in found)
    doubted = torch.tensor([bool(d) for d in doubts], dtype=torch.bool, device=righted.device)[prior.image]
    return Released(rejected & ~doubted, unsupported & ~doubted, doubts)


def _most(far: int, count: int) -> str:
    return f"{far} of its {count} objects would have to move implausibly far; check poses, plane and gravity"


def _excess(poses: Tensor, estimates: Tensor, prior: PosePrior, scene: Scene, *, turned: Tensor) -> Tensor:
    """How far (N,) poses are from their estimates in σ, the depth factor of each image aside; of ``turned`` ones the centre."""
    e = se3.residual(poses, estimates)
    e[turned, :3] = (scene.centers(poses) - scene.centers(estimates))[turned]
    if prior.sigma_common > 0:
        factor = common_depth(e, prior)
        e[:, :3] -= factor[prior.image, None] * prior.ray
    e[turned, 3:] = 0.0
    return torch.einsum("ni,nij,nj->n", e, prior.precision, e).clamp_min(0.0).sqrt()
