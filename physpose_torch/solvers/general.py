"""The cost and its gradient by autograd: any cost, any distance backend."""

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.config import STILL_STEPS, RefinerConfig
from physpose_torch.losses import PhysicsTerms, physics_terms, prior_loss
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene

__all__ = ["GeneralCost"]


class GeneralCost:
    """State of a refinement in flight; the same interface as :class:`physpose_torch.fused.FusedCost`."""

    def __init__(
        self, prior: PosePrior, scene: Scene, acts: Tensor, config: RefinerConfig, poses: Tensor, scale: Tensor
    ) -> None:
        self._scene, self._prior, self._acts, self._config, self._scale = scene, prior, acts, config, scale
        self.poses = poses.clone()
        self.step = torch.zeros(len(scene), 6, dtype=poses.dtype, device=poses.device)
        self.gradient = torch.zeros_like(self.step)
        self.done = (
            torch.bincount(scene.image, minlength=scene.n_images) == 0
        )  # nothing in an empty image: nothing to do
        self.steps = torch.zeros(scene.n_images, dtype=torch.long)
        self._span = scene.entity_span[: len(scene)].to(poses)
        self._still = torch.zeros(scene.n_images, dtype=torch.long)
        self._farthest = torch.full((scene.n_images,), torch.inf, dtype=poses.dtype)
        self._select()

    def terms(self, rows: Tensor) -> PhysicsTerms:
        """Costs of the objects of images that are still running, which ``rows`` must be."""
        return self._terms

    def all_terms(self) -> PhysicsTerms:
        """Costs of all objects at the current poses."""
        w = self._config.physics
        with torch.no_grad():
            pose = prior_loss(self.poses, self._prior)
            collision, share, gravity = physics_terms(self.poses, self._scene, self._acts, w, self._prior.reach)
        total = w.pose_weight * pose + w.collision_weight * share + w.gravity_weight * gravity
        return PhysicsTerms(pose, collision, gravity, total)

    def settle(self, step: int) -> None:
        """Finish the images that have come to rest."""
        self._still = torch.where(self._farthest <= self._config.tolerance, self._still + 1, 0)
        finished = ~self.done & (self._still >= STILL_STEPS)
        if bool(finished.any()):
            self.steps[finished] = step
            self.done = self.done | finished
            self._select()

    def evaluate(self, step: int) -> None:
        """Costs and gradient at the current poses; images that have come to rest are finished first."""
        self.settle(step)
        w, rows = self._config.physics, self._rows
        leaf = self.poses[rows].requires_grad_()
        pose = prior_loss(leaf, self._active_prior)
        collision, share, gravity = physics_terms(leaf, self._active, self._acts[rows], w, self._active_prior.reach)
        total = w.pose_weight * pose + w.collision_weight * share + w.gravity_weight * gravity
        (gradient,) = torch.autograd.grad(total.sum(), leaf)
        self._terms = PhysicsTerms(*(x.detach() for x in (pose, collision, gravity, total)))
        tangent = se3.tangent_gradient(leaf.detach(), gradient)
        tangent = (self._scale[rows].mT @ tangent[:, :, None])[:, :, 0]
        if self._config.max_gradient is not None:
            length = torch.linalg.vector_norm(tangent, dim=1, keepdim=True)
            tangent = tangent * (self._config.max_gradient / length.clamp_min(self._config.max_gradient))
        self.gradient.zero_().index_copy_(0, rows, tangent)

    def move(self) -> None:
        """Move the objects by :attr:`step`, which is zero again then."""
        rows = self._rows
        with torch.no_grad():
            move = (self._scale[rows] @ self.step[rows, :, None])[:, :, 0]
            self.step.zero_()
            reach = move[:, :3].norm(dim=1) + move[:, 3:].norm(dim=1) * self._span[rows]
            shorten = (self._config.max_step / reach.clamp_min(self._config.max_step))[:, None]
            self.poses = self.poses.index_copy(0, rows, se3.retract(self.poses[rows], move * shorten))
        zero = torch.zeros(self._scene.n_images, dtype=reach.dtype)
        self._farthest = zero.scatter_reduce(0, self._scene.image[rows], reach.cpu(), "amax")

    def _select(self) -> None:
        """Scene, rows and prior of the images that are still running."""
        self._active, self._rows = self._scene.select((~self.done).nonzero()[:, 0])
        self._active_prior = self._prior.of(self._rows, self._active)
