"""First-order descent on the physics cost with torch.optim, all images at once, each stopped on its own."""

import itertools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from physpose_torch.config import RefinerConfig
from physpose_torch.contacts import object_heights, plane_variance
from physpose_torch.distance.autograd import chosen_backend
from physpose_torch.errors import InvalidInputError
from physpose_torch.losses import PhysicsTerms
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene
from physpose_torch.solvers.general import GeneralCost

if TYPE_CHECKING:
    from physpose_torch.fused import FusedCost

__all__ = ["Descent", "descend", "iterate", "make_cost", "out_of_planes", "start"]

ADAM_BETAS = (0.8, 0.95)
"""Short memories: contacts come and go within a few steps."""
LEAST_SLOPE = 0.2
"""Sine of the least angle between viewing ray and plane at which an object is slid along its ray."""
ADAM_EPS = 0.1
"""In units of 1/σ. Forces far below one σ of the prior are not blown up to full steps: a consistent scene stays put."""


class Descent(NamedTuple):
    poses: Tensor
    """(N, 4, 4)."""
    terms: PhysicsTerms
    """(N,) each, costs at the poses."""
    steps: Tensor
    """(I,) steps that each image took."""
    converged: Tensor
    """(I,) bool: it stopped before the step limit."""
    trajectory: Tensor | None
    """(steps + 1, N, 4, 4), from the estimates on."""
    cost: "GeneralCost | FusedCost"
    """At the poses."""


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
    cost = start(prior, scene, acts, config)
    x = cost.step.requires_grad_()
    if config.optimizer == "adam":
        optimizer = torch.optim.Adam([x], lr=config.learning_rate, betas=ADAM_BETAS, eps=ADAM_EPS, fused=True)
    else:
        optimizer = torch.optim.SGD([x], lr=config.learning_rate, fused=True)
    group = optimizer.param_groups[0]
    taken = itertools.count()

    def advance() -> None:
        # what an LR scheduler would do, which takes as long as the optimizer itself
        if config.decay == "cosine":
            group["lr"] = config.learning_rate * 0.5 * (1 + math.cos(math.pi * next(taken) / config.steps))
        x.grad = cost.gradient
        optimizer.step()

    return iterate(cost, advance, prior, scene, config, callback)


def start(prior: PosePrior, scene: Scene, acts: Tensor, config: RefinerConfig) -> "GeneralCost | FusedCost":
    """The cost where the iteration begins."""
    poses = out_of_planes(prior, scene) if config.start == "slide" else prior.measured.clone()
    scaled = config.solver == "lm" or config.optimizer == "adam"
    scale = _principal_scale(prior) if scaled else torch.eye(6).to(poses).expand(len(scene), 6, 6)
    return make_cost(prior, scene, acts, config, poses, scale)


def iterate(
    cost: "GeneralCost | FusedCost",
    advance: Callable[[], None],
    prior: PosePrior,
    scene: Scene,
    config: RefinerConfig,
    callback: Callable[[int, Tensor, PhysicsTerms], None] | None,
) -> Descent:
    """Evaluate, let ``advance`` set the cost's step, move; until all images are done or the steps are used up."""
    trajectory = [prior.measured.clone()] if config.keep_trajectory else None
    watch = _Watch(cost)
    for step in range(config.steps):
        cost.evaluate(step)
        if watch.all_done():
            break
        if callback is not None:
            rows = (~cost.done[scene.image.to(cost.done.device)]).nonzero()[:, 0].to(cost.poses.device)
            callback(step, cost.poses[rows], cost.terms(rows))
        advance()
        cost.move()
        if trajectory is not None:
            trajectory.append(cost.poses.clone())
    else:
        cost.settle(config.steps)  # who came to rest in the last step
    done = cost.done.cpu()
    steps = torch.where(done, cost.steps.cpu(), config.steps)
    terms = PhysicsTerms(*(x.clone() for x in cost.all_terms()))
    trajectory = torch.stack(trajectory) if trajectory is not None else None
    return Descent(cost.poses.clone(), terms, steps, done, trajectory, cost)


def make_cost(
    prior: PosePrior, scene: Scene, acts: Tensor, config: RefinerConfig, poses: Tensor, scale: Tensor
) -> "GeneralCost | FusedCost":
    """The cost at hand: compiled kernels where they know it, else autograd."""
    if chosen_backend(config.physics.backend) == "warp":
        from physpose_torch.fused import FusedCost, remembers

        if FusedCost.fits(config, scene) and remembers(scene, poses, FusedCost.margin(config, prior)):
            return FusedCost(prior, scene, acts, config, poses, scale)
    if config.solver == "lm":
        raise InvalidInputError(
            "solver 'lm' needs the warp backend, gravity='support' and smoothing ring, gaussian or none"
        )
    return GeneralCost(prior, scene, acts, config, poses, scale)


class _Watch:
    """Tells when all images are done, without making the host wait for a CUDA device."""

    def __init__(self, cost: "GeneralCost | FusedCost") -> None:
        self._cost = cost
        self._asked: tuple[Tensor, torch.cuda.Event] | None = None

    def all_done(self) -> bool:
        if self._cost.poses.device.type != "cuda":
            return bool(self._cost.done.all())
        if self._asked is None:
            answer = torch.empty((), dtype=torch.bool, pin_memory=True)
            answer.copy_(self._cost.done.all(), non_blocking=True)
            self._asked = answer, torch.cuda.Event()
            self._asked[1].record()
        elif self._asked[1].query():
            answer, self._asked = bool(self._asked[0]), None
            return answer
        return False


def out_of_planes(prior: PosePrior, scene: Scene) -> Tensor:
    """The estimates (N, 4, 4), those that lie in a plane slid along their viewing rays until they touch it.

    Estimators misjudge depth most of all, so this is where most objects end; the descent has only the rest to do. An object
    that is seen along the plane stays where it is.
    """
    poses = prior.measured.clone()
    if not len(scene.planes):
        return poses
    who, plane = scene.plane_pairs.to(poses.device).unbind(1)
    # what lies no deeper than the plane may be off can stay
    height = object_heights(poses, scene) + plane_variance(poses, scene, who, plane, prior.acts).sqrt()
    slope = -(scene.plane_normal.to(poses)[plane] * torch.nn.functional.normalize(prior.ray, dim=-1)[who]).sum(-1)
    slide = torch.where(slope > LEAST_SLOPE, (-height).clamp_min(0.0) / slope.clamp_min(LEAST_SLOPE), 0.0)
    slide = poses.new_zeros(len(poses)).scatter_reduce(0, who, slide, "amax")
    range_ = torch.linalg.vector_norm(prior.ray, dim=-1).clamp_min(torch.finfo(poses.dtype).tiny)
    slide = torch.where(slide < 0.9 * range_, slide, 0.0)  # never behind the camera
    poses[:, :3, 3] -= (slide / range_)[:, None] * prior.ray
    return poses


def _principal_scale(prior: PosePrior) -> Tensor:
    """L (N, 6, 6) with L Lᵀ = the translation and rotation blocks of the covariance, along their principal axes."""
    covariance = torch.linalg.inv(prior.precision)
    covariance[:, :3, :3] += prior.sigma_common**2 * prior.ray[:, :, None] * prior.ray[:, None, :]
    scale = torch.zeros_like(covariance)
    for block in (slice(0, 3), slice(3, 6)):
        part = covariance[:, block, block]
        # equal variances leave their axes to rounding, and Adam's steps depend on them
        tie = torch.arange(3.0).diag().to(part) * part.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]
        variance, axes = torch.linalg.eigh(part + 1e-6 * tie)
        scale[:, block, block] = axes * variance.clamp_min(0).sqrt()[:, None]
    return scale
