"""Gradients through the refiner, by the implicit function theorem at the poses where it came to rest."""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.config import RefinerConfig
from physpose_torch.prior import make_prior
from physpose_torch.release import Plan
from physpose_torch.scene import Scene
from physpose_torch.solvers.descent import make_cost

__all__ = ["Solution", "attach", "jacobian", "ranks"]

STEP = (2e-5, 2e-4)
"""Half of a central difference [m, rad]."""
FLOOR = 0.02
"""Curvatures below this, that of an estimate by itself being 1, count as this; so gradients are finite everywhere."""
MOST_COPIES = 4096
"""Objects in one evaluation of the cost."""


class Solution(NamedTuple):
    """What a refinement minimised, and where it ended; flat."""

    poses: Tensor
    """(N, 4, 4) where the solver ended, float64."""
    kept: Tensor
    """(N, 4, 4) what was kept of that."""
    left: Tensor
    """(N,) bool: estimates that were left as they were."""
    measured: Tensor
    """(N, 4, 4) the estimates, float64."""
    scene: Scene
    acts: Tensor
    """(N,) bool, before the plan."""
    covariance: Tensor | None
    """(N, 6, 6) as given, None: from the config."""
    righted: Tensor
    """(N,) bool."""
    plan: Plan
    config: RefinerConfig


def attach(measured: Tensor, solution: Solution) -> Tensor:
    """The refined poses (N, 4, 4), with gradients towards the measured ones (N, 4, 4).

    At rest the gradient F of the cost vanishes: F(x, m) = 0. So dx/dm = -(∂F/∂x)⁻¹ ∂F/∂m, whatever path led there; both
    Jacobians are central differences of F, whose contacts turn smoothly because they are smoothed (:mod:`.distance.smoothing`).
    """
    return _Refined.apply(measured, solution)


class _Refined(torch.autograd.Function):
    @staticmethod
    def forward(ctx, measured, solution):
        ctx.save_for_backward(measured)
        ctx.solution = solution
        return solution.kept.to(measured)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        (measured,) = ctx.saved_tensors
        s = ctx.solution
        wanted = se3.tangent_gradient(s.kept, gradient.to(s.kept))
        left = s.left[:, None]
        at_measured = _pulled_back(measured.to(s.poses), s, torch.where(left, 0.0, wanted))
        # what stays where it is lacks the depth bias, if that is known and the pose itself is not left as it was
        bias = torch.where((s.kept != measured.to(s.kept)).flatten(1).any(1), s.config.physics.depth_factor, 1.0)
        own = torch.cat([bias[:, None] * wanted[:, :3], wanted[:, 3:]], dim=1)
        at_measured = torch.where(left, own, at_measured)
        out = torch.zeros_like(s.poses)
        # the 4×4 gradient G_R = ½ R [v]× has v as its tangent
        out[:, :3, :3] = 0.5 * measured.to(out)[:, :3, :3] @ se3.hat(at_measured[:, 3:])
        out[:, :3, 3] = at_measured[:, :3]
        return out.to(gradient), None


def _pulled_back(measured: Tensor, s: Solution, wanted: Tensor) -> Tensor:
    """-(∂F/∂m)ᵀ (∂F/∂x)⁻ᵀ wanted, tangent vectors (N, 6) at the refined and at the measured poses."""
    images = s.scene.n_images
    rank, size = ranks(s.scene)
    dF_dx, dF_dm = (jacobian(measured, s, rank, size, of=of) for of in ("poses", "measured"))
    prior = s.plan.prior(make_prior(measured, s.scene, s.acts, s.covariance, s.config.physics), s.config)
    spread = prior.precision.diagonal(dim1=1, dim2=2).rsqrt()  # an estimate's own, the unit of each coordinate
    out = torch.zeros_like(wanted)
    for i in range(images):
        rows = (s.scene.image == i).nonzero()[:, 0].to(wanted.device)
        if not len(rows) or not bool((wanted[rows] != 0).any()):
            continue
        k = 6 * len(rows)
        # [object, coordinate] of F by [object, coordinate] of x or m
        A, B = (x[rows][:, :, : len(rows)].reshape(k, k) for x in (dF_dx, dF_dm))
        unit = spread[rows].reshape(k)
        A, B = unit[:, None] * A * unit, unit[:, None] * B * unit
        U, S, Vh = torch.linalg.svd(A.mT)
        adjoint = Vh.mT @ ((U.mT @ (unit * wanted[rows].reshape(k))) / S.clamp_min(FLOOR))
        out[rows] = (-(B.mT @ adjoint) / unit).reshape(-1, 6)
    out[s.righted, 3:] = 0.0  # an object that was turned stands as it must, however it was estimated
    return out


def ranks(scene: Scene) -> tuple[Tensor, int]:
    """The number (N,) of each object in its image, and how many objects the fullest image has."""
    counts = torch.bincount(scene.image, minlength=scene.n_images)
    rank = torch.zeros(len(scene), dtype=torch.long)
    for i in range(scene.n_images):
        rank[scene.image == i] = torch.arange(int(counts[i]))
    return rank, int(counts.max()) if len(scene) else 0


def jacobian(measured: Tensor, s: Solution, rank: Tensor, size: int, *, of: str) -> Tensor:
    """(N, 6, size, 6) of F of each object with respect to the poses, or the measured poses, of all objects of its image.

    All images at once: a difference moves the same coordinate of one object in each.
    """
    n = len(rank)
    out = measured.new_zeros(n, 6, size, 6)
    estimates = _prior_poses(measured, s)
    moves = [(k, axis, sign) for k in range(size) for axis in range(6) for sign in (1, -1)]
    at_once = max(MOST_COPIES // max(n, 1) // 2, 1) * 2
    for start in range(0, len(moves), at_once):
        part = moves[start : start + at_once]
        step = measured.new_zeros(len(part), n, 6)
        for c, (k, axis, sign) in enumerate(part):
            step[c, (rank == k).to(step.device), axis] = sign * STEP[axis >= 3]
        x, m = (T.expand(len(part), n, 4, 4) for T in (s.poses, estimates))
        if of == "poses":
            x = se3.retract(x, step)
        else:
            m = se3.retract(m, step)
        F = _gradient(x.reshape(-1, 4, 4), m.reshape(-1, 4, 4), s, len(part)).reshape(len(part), n, 6)
        for c, (k, axis, sign) in enumerate(part):
            out[:, :, k, axis] += sign * F[c] / (2 * STEP[axis >= 3])
    return out


def _prior_poses(measured: Tensor, s: Solution) -> Tensor:
    """The estimates, those that were righted as they stand."""
    out = measured.clone()
    out[s.righted, :3, :3] = s.poses[s.righted, :3, :3]
    return out


def _gradient(poses: Tensor, measured: Tensor, s: Solution, copies: int) -> Tensor:
    """F (copies · N, 6): the cost's gradient in the tangent spaces at the poses."""
    scene, acts = Scene.cat([s.scene] * copies), s.acts.repeat(copies)
    pushes = s.plan.acts.repeat(copies)
    covariance = None if s.covariance is None else s.covariance.repeat(copies, 1, 1)
    prior = s.plan.prior(make_prior(measured, scene, acts, covariance, s.config.physics), s.config, copies)
    config = replace(s.config, solver="descent", optimizer="sgd", max_gradient=None, tolerance=0.0)
    cost = make_cost(prior, scene, pushes, config, poses.contiguous(), torch.eye(6).to(poses).expand(len(poses), 6, 6))
    with torch.enable_grad():  # backward passes run without
        cost.evaluate(0)
    return cost.gradient.clone()
