"""First-order descent on the physics cost with torch.optim, all images at once, each stopped on its own."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.config import RefinerConfig
from physpose_torch.contacts import object_heights
from physpose_torch.losses import PhysicsTerms, physics_terms, prior_loss
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene

__all__ = ["Descent", "descend"]

STILL_STEPS = 10
"""An image stops after this many steps on end without motion; finished images leave the batch at these intervals."""
ADAM_BETAS = (0.8, 0.95)
"""Short memories: contacts come and go within a few steps."""
LEAST_SLOPE = 0.2
"""Sine of the least angle between viewing ray and plane at which an object is slid along its ray."""
ADAM_EPS = 0.1
"""In units of 1/σ. Forces far below one σ of the prior are not blown up to full steps: a consistent scene stays put."""


class Descent(NamedTuple):
    poses: Tensor
    """(N, 4, 4)."""
    steps: Tensor
    """(I,) steps that each image took."""
    converged: Tensor
    """(I,) bool: it stopped before the step limit."""
    trajectory: Tensor | None
    """(steps + 1, N, 4, 4), from the estimates on."""


def descend(
    prior: PosePrior,
    scene: Scene,
    acts: Tensor,
    config: RefinerConfig,
    callback: Callable[[int, Tensor, PhysicsTerms], None] | None = None,
) -> Descent:
    """Minimise the cost from the measured poses.

    Steps are taken in the tangent space at the current poses, t += L_t x_t, R ← R exp(L_R x_R). For Adam, L L^T are the
    blocks of the estimates' covariance, so an object moves most easily along its viewing ray, where its estimate is least
    sure; for plain gradient descent L is the identity, as in the paper.

    Args:
        prior: the flat estimates and their uncertainty, float64.
        scene: the flat scene.
        acts: (N,) bool, see :func:`physpose_torch.losses.acting`.
        config: optimizer options.
        callback: called with step, poses (N, 4, 4) and terms of the images still running before each step.
    """
    n, n_images = len(scene), scene.n_images
    poses = out_of_planes(prior, scene) if config.start == "slide" else prior.measured.clone()
    radius = scene.object_radius.to(poses)
    scale = _principal_scale(prior) if config.optimizer == "adam" else torch.eye(6).to(poses).expand(n, 6, 6)
    x = torch.zeros(n, 6, dtype=poses.dtype, device=poses.device, requires_grad=True)
    if config.optimizer == "adam":
        optimizer = torch.optim.Adam([x], lr=config.learning_rate, betas=ADAM_BETAS, eps=ADAM_EPS)
    else:
        optimizer = torch.optim.SGD([x], lr=config.learning_rate)
    schedule = None
    if config.decay == "cosine" and config.steps:
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda k: 0.5 * (1 + math.cos(math.pi * k / config.steps))
        )

    still = torch.zeros(n_images, dtype=torch.long)
    steps = torch.full((n_images,), config.steps)
    done = torch.bincount(scene.image, minlength=n_images) == 0  # nothing in an empty image: nothing to do
    steps[done] = 0
    active, rows, active_prior = _select(scene, prior, ~done)
    trajectory = [prior.measured.clone()] if config.keep_trajectory else None
    for step in range(config.steps):
        if bool(done.all()):
            break
        leaf = poses[rows].requires_grad_()
        pose = prior_loss(leaf, active_prior)
        collision, share, gravity = physics_terms(leaf, active, acts[rows], config.physics)
        weights = config.physics
        total = weights.pose_weight * pose + weights.collision_weight * share + weights.gravity_weight * gravity
        (gradient,) = torch.autograd.grad(total.sum(), leaf)
        if callback is not None:
            callback(
                step, leaf.detach(), PhysicsTerms(pose.detach(), collision.detach(), gravity.detach(), total.detach())
            )

        tangent = se3.tangent_gradient(leaf.detach(), gradient)
        tangent = (scale[rows].mT @ tangent[:, :, None])[:, :, 0]
        if config.max_gradient is not None:
            length = torch.linalg.vector_norm(tangent, dim=1, keepdim=True)
            tangent = tangent * (config.max_gradient / length.clamp_min(config.max_gradient))
        x.grad = torch.zeros_like(x).index_copy(0, rows, tangent)
        with torch.no_grad():
            x.zero_()
        optimizer.step()
        if schedule is not None:
            schedule.step()
        move = (scale[rows] @ x.detach()[rows, :, None])[:, :, 0]
        reach = move[:, :3].norm(dim=1) + move[:, 3:].norm(dim=1) * radius[rows]
        shorten = (config.max_step / reach.clamp_min(config.max_step))[:, None]
        poses = poses.index_copy(0, rows, se3.retract(leaf.detach(), move * shorten))
        if trajectory is not None:
            trajectory.append(poses.clone())

        farthest = torch.zeros(n_images, dtype=poses.dtype).scatter_reduce(0, scene.image[rows], reach.cpu(), "amax")
        still = torch.where(farthest <= config.tolerance, still + 1, 0)
        finished = ~done & (still >= STILL_STEPS)
        steps[finished] = step + 1
        if bool(finished.any()):
            done = done | finished
            active, rows, active_prior = _select(scene, prior, ~done)
    return Descent(poses, steps, done, torch.stack(trajectory) if trajectory is not None else None)


def out_of_planes(prior: PosePrior, scene: Scene) -> Tensor:
    """The estimates (N, 4, 4), those that lie in a plane slid along their viewing rays until they touch it.

    Estimators misjudge depth most of all, so this is where most objects end; the descent has only the rest to do. An object
    that is seen along the plane stays where it is.
    """
    poses = prior.measured.clone()
    if not len(scene.planes):
        return poses
    height = object_heights(poses, scene)
    who, plane = scene.plane_pairs.to(poses.device).unbind(1)
    slope = -(scene.plane_normal.to(poses)[plane] * torch.nn.functional.normalize(prior.ray, dim=-1)[who]).sum(-1)
    slide = torch.where(slope > LEAST_SLOPE, (-height).clamp_min(0.0) / slope.clamp_min(LEAST_SLOPE), 0.0)
    slide = poses.new_zeros(len(poses)).scatter_reduce(0, who, slide, "amax")
    range_ = torch.linalg.vector_norm(prior.ray, dim=-1)
    slide = torch.where(slide < 0.9 * range_, slide, 0.0)  # never behind the camera
    poses[:, :3, 3] -= (slide / range_)[:, None] * prior.ray
    return poses


def _select(scene: Scene, prior: PosePrior, running: Tensor) -> tuple[Scene, Tensor, PosePrior]:
    """Scene, rows and prior of the images that are still running."""
    active, rows = scene.select(running.nonzero()[:, 0])
    image = active.image.to(prior.image.device)
    selected = (x[rows.to(x.device)] for x in prior[:4])
    return active, rows, PosePrior(*selected, image, active.n_images, *prior[6:])


def _principal_scale(prior: PosePrior) -> Tensor:
    """L (N, 6, 6) with L Lᵀ = the translation and rotation blocks of the covariance, along their principal axes."""
    covariance = torch.linalg.inv(prior.precision)
    covariance[:, :3, :3] += prior.sigma_common**2 * prior.ray[:, :, None] * prior.ray[:, None, :]
    scale = torch.zeros_like(covariance)
    for block in (slice(0, 3), slice(3, 6)):
        variance, axes = torch.linalg.eigh(covariance[:, block, block])
        scale[:, block, block] = axes * variance.clamp_min(0).sqrt()[:, None]
    return scale
