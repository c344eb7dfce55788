"""The layer to append to a pose estimator: poses in, physically consistent poses out."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor, nn

from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.implicit import Solution, attach
from physpose_torch.losses import PhysicsLoss, PhysicsTerms, acting, check_poses, flatten_covariance
from physpose_torch.prior import make_prior
from physpose_torch.report import PhysicsReport, report_of
from physpose_torch.righting import right_fallen
from physpose_torch.scene import Scene, as_matrix
from physpose_torch.solvers.descent import descend
from physpose_torch.solvers.lm import levenberg_marquardt

__all__ = ["PhysPoseRefiner", "Refinement"]

FARTHEST = 100.0
"""[m]; estimates beyond this are in millimetres."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """Refined poses and what there is to know about them."""

    poses: Tensor
    """T_camera_object, (..., N, 4, 4) [m], in the caller's dtype and on its device."""
    report: PhysicsReport
    """Penetration, gap and support of each object at the refined poses."""
    terms: PhysicsTerms
    """Costs (..., N) at the refined poses."""
    trajectory: Tensor | None
    """(steps + 1, ..., N, 4, 4) if the config keeps it, from the estimates on; removing the depth bias and the slide out of
    planes are in the first step."""
    steps: Tensor
    """(..., I) steps that each image took, both times if it was refined once more with objects righted."""
    converged: Tensor
    """(..., I) bool: the image came to rest before the step limit."""
    image: Tensor
    """(N,) image of each object, as in the scene."""
    righted: Tensor
    """(..., N) bool: objects that could not have stood as they were estimated, and were turned to stand."""

    def best(self) -> Tensor:
        """Poses (N, 4, 4) of the hypothesis with the lowest cost, chosen image by image."""
        hypotheses, n = self.steps.shape[:-1].numel(), self.poses.shape[-3]
        poses, cost = self.poses.reshape(hypotheses, n, 4, 4), self.terms.total.reshape(hypotheses, n)
        image = self.image.to(cost.device)
        per_image = cost.new_zeros(len(poses), self.steps.shape[-1]).index_add(1, image, cost)
        choice = per_image.argmin(0)[image]
        return poses[choice, torch.arange(poses.shape[1], device=poses.device)]


def _check_metres(poses: Tensor, scene: Scene) -> None:
    distance = torch.linalg.vector_norm(poses.detach()[..., :3, 3], dim=-1)
    if bool((distance > FARTHEST).any()):
        row = int((distance > FARTHEST).nonzero()[0, -1])
        raise InvalidInputError(
            f"poses[..., {row}] ({scene.labels[row]}) is {float(distance.max()):.4g} m from the camera; "
            "translations are in metres, divide millimetres by 1000"
        )


class PhysPoseRefiner(nn.Module):
    """Refine all poses of each image together, so that they are physically consistent (paper Sec. 3.1).

    Args:
        config: cost and optimizer; None: the tuned default. ``RefinerConfig.paper()`` is the paper's.
    """

    def __init__(self, config: RefinerConfig | None = None) -> None:
        super().__init__()
        self.config = config or RefinerConfig()
        self.loss = PhysicsLoss(self.config.physics)

    def forward(
        self,
        poses: Tensor,
        scene: Scene,
        *,
        measured_covariance: Tensor | None = None,
        scores: Tensor | None = None,
        callback: Callable[[int, Tensor, PhysicsTerms], None] | None = None,
    ) -> Refinement:
        """Refine the poses of a scene. Works under ``no_grad`` and ``inference_mode``; nothing is drawn at random.

        Args:
            poses: estimates T̃_camera_object, (..., N, 4, 4) [m]; leading dimensions are hypotheses of the same scene.
            scene: the N objects (of one or many images), statics and gravity.
            measured_covariance: (..., N, 6, 6) of the estimates, order [t in the camera frame, log(R̃ᵀR) in the object
                frame]; None: from the config's sigmas.
            scores: (N,), see :class:`~physpose_torch.losses.PhysicsLoss`.
            callback: called before each step with step, flat poses and terms of the images still running.

        Raises:
            InvalidInputError: shapes, NaN or non-rigid poses, a covariance that is not positive definite.
        """
        poses = as_matrix(poses)
        check_poses(poses, scene)
        _check_metres(poses, scene)
        leading = poses.shape[:-3]
        with (
            torch.inference_mode(False),
            torch.enable_grad(),
            torch.autocast(poses.device.type, enabled=False),
        ):
            measured = poses.detach().clone().double()
            if measured_covariance is not None:
                measured_covariance = torch.as_tensor(measured_covariance).detach().clone()
            many = scene if leading.numel() == 1 else Scene.cat([scene] * leading.numel())
            covariance = flatten_covariance(measured_covariance, measured)
            acts = acting(scene, scores).repeat(leading.numel())
            prior = make_prior(measured.reshape(-1, 4, 4), many, acts, covariance, self.config.physics)
            solve = levenberg_marquardt if self.config.solver == "lm" else descend
            solve = partial(solve, config=self.config, callback=callback)
            result = solve(prior, many, acts)
            backend = self.config.physics.backend
            report = report_of(result.poses.reshape(measured.shape), scene, many, acts, backend, result.cost)
            righted = torch.zeros(len(many), dtype=torch.bool, device=measured.device)
            if self.config.righting > 0 and self.config.steps > 0 and self.config.physics.gravity_weight > 0:
                planes = len(scene) + len(scene.static_bodies)
                result, righted = right_fallen(
                    result,
                    report,
                    prior,
                    many,
                    acts,
                    solve,
                    pose_weight=self.config.physics.pose_weight,
                    first_plane=planes,
                    limit=self.config.righting,
                    backend=backend,
                )
            refined = result.poses.reshape(measured.shape)
            if bool(righted.any()):
                report = report_of(refined, scene, many, acts, backend)
            terms = (x.reshape(measured.shape[:-2]) for x in result.terms)
        lengths = ("penetration_static", "penetration_object", "gap")
        report = replace(report, **{name: getattr(report, name).to(poses.dtype) for name in lengths})
        images = (*leading, scene.n_images)
        trajectory = result.trajectory
        if trajectory is not None:
            trajectory = trajectory.reshape(len(trajectory), *measured.shape).to(poses.dtype)
            trajectory[0] = poses.detach()  # the descent begins where the depth bias is removed
        refined = refined.to(poses.dtype)
        if self.config.gradient == "implicit" and poses.requires_grad and torch.is_grad_enabled():
            solution = Solution(result.poses, many, acts, covariance, righted, self.config)
            refined = attach(poses.reshape(-1, 4, 4), solution).reshape(poses.shape)
        return Refinement(
            poses=refined,
            report=report,
            terms=PhysicsTerms(*(x.to(poses.dtype) for x in terms)),
            trajectory=trajectory,
            steps=result.steps.reshape(images),
            converged=result.converged.reshape(images),
            image=scene.image,
            righted=righted.reshape(measured.shape[:-2]),
        )
