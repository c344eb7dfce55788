"""The layer to append to a pose estimator: poses in, physically consistent poses out."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.implicit import Solution, attach
from physpose_torch.losses import PhysicsLoss, PhysicsTerms, acting, check_poses, flatten_covariance
from physpose_torch.posterior import posterior_covariance
from physpose_torch.prior import PosePrior, make_prior
from physpose_torch.release import Plan, Released, make_plan, release
from physpose_torch.report import NOTABLE, PhysicsReport, report_of
from physpose_torch.righting import right_fallen
from physpose_torch.scene import Scene, Static, as_matrix
from physpose_torch.solvers.descent import Descent, descend, make_cost
from physpose_torch.solvers.lm import levenberg_marquardt

__all__ = ["PhysPoseRefiner", "Refinement", "silent_doubts"]

LEFT = "poses are left as they were estimated"
WORST = 1e6
"""What an object that was left as it was costs a hypothesis; no cost of poses is as high."""
FARTHEST = 100.0
"""[m]; estimates beyond this, and farther away than a hundred times their body's size, are in millimetres."""


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
    rejected: Tensor
    """(..., N) bool: estimates that physics contradicts too much to be put right; they keep their poses."""
    unsupported: Tensor
    """(..., N) bool: objects with nothing known below them within reach; they keep their poses, but for a known depth bias."""
    doubts: tuple[str, ...]
    """Flat over (..., I): why an image was left as it is, for its objects together contradict what is known of it; or
    nothing."""
    _solution: Solution = field(repr=False)
    """What covariances are worked out of, when they are asked for."""
    _rows: Tensor = field(repr=False)
    """Its objects among all, flat."""

    @cached_property
    def covariance(self) -> Tensor:
        """Covariance (..., N, 6, 6) of each pose, order [t in the camera frame, rotation in the object frame].

        From the curvature of the cost at rest, contacts included: across a contact a pose is better known than along it.
        Where an estimate was left as it was, it is the estimate's own; zero for objects that were not to be refined. Worked
        out on first use, 12 evaluations of the cost for each object of the largest image and a matrix of 6 N × 6 N for it: of
        thousands of objects in one image it is not to be had. In float32 variances below eps of the largest are lost.
        """
        shape, flat = self.poses.shape[:-2], self.poses.shape[:-2].numel()
        with torch.inference_mode(False), torch.no_grad():
            found = posterior_covariance(self._solution)
        whole = found.new_zeros(flat, 6, 6).index_copy(0, self._rows, found)
        return whole.reshape(*shape, 6, 6).to(self.poses.dtype)

    @property
    def doubted(self) -> Tensor:
        """(..., I) bool: images that were left as they are, see :attr:`doubts`."""
        doubted = torch.tensor([bool(d) for d in self.doubts], dtype=torch.bool, device=self.poses.device)
        return doubted.reshape(self.steps.shape)

    @property
    def status(self) -> list[str]:
        """One word for each object, flat over (..., N): ``rejected``, ``unsupported``, or that of the report."""
        flags = zip(self.rejected.reshape(-1).tolist(), self.unsupported.reshape(-1).tolist(), strict=True)
        own = ["rejected" if r else "unsupported" if u else "" for r, u in flags]
        return [word or reported for word, reported in zip(own, self.report.status, strict=True)]

    def best(self) -> Tensor:
        """Poses (N, 4, 4) of the hypothesis of which most was refined, then of that with the lowest cost, image by image."""
        hypotheses, n = self.steps.shape[:-1].numel(), self.poses.shape[-3]
        poses, cost = self.poses.reshape(hypotheses, n, 4, 4), self.terms.total.reshape(hypotheses, n)
        image = self.image.to(cost.device)
        left = self.rejected | self.unsupported | self.doubted[..., image]
        cost = cost.double() + WORST * left.reshape(hypotheses, n)
        per_image = cost.new_zeros(len(poses), self.steps.shape[-1]).index_add(1, image, cost)
        choice = per_image.argmin(0)[image]
        return poses[choice, torch.arange(poses.shape[1], device=poses.device)]


def _check_metres(poses: Tensor, scene: Scene) -> None:
    distance = torch.linalg.vector_norm(poses.detach()[..., :3, 3].double(), dim=-1)
    if not bool((distance > FARTHEST).any()):
        return
    far = distance > (FARTHEST * 2 * scene.entity_span[: len(scene)].to(distance)).clamp_min(FARTHEST)
    if bool(far.any()):
        *_, row = first = far.nonzero()[0].tolist()
        raise InvalidInputError(
            f"poses[..., {row}] ({scene.labels[row]}) is {float(distance[tuple(first)]):.4g} m from the camera; "
            "translations are in metres, divide millimetres by 1000"
        )


@contextmanager
def silent_doubts() -> Iterator[None]:
    """Refinements in here do not warn of images that they leave alone: :attr:`Refinement.doubts` tells."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", LEFT)
        yield


def _warn(doubts: tuple[str, ...]) -> None:
    told = [f"image {i}: {doubt}" for i, doubt in enumerate(doubts) if doubt]
    if told:
        more = f" (and {len(told) - 1} more)" if len(told) > 1 else ""
        warnings.warn(f"{LEFT} in {told[0]}{more}; see Refinement.doubts", stacklevel=5)


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
        refine_only: Tensor | None = None,
        callback: Callable[[int, Tensor, PhysicsTerms], None] | None = None,
    ) -> Refinement:
        """Refine the poses of a scene. Works under ``no_grad`` and ``inference_mode``; nothing is drawn at random.

        Args:
            poses: estimates T̃_camera_object, (..., N, 4, 4) [m]; leading dimensions are hypotheses of the same scene.
            scene: the N objects (of one or many images), statics and gravity.
            measured_covariance: (..., N, 6, 6) of the estimates, order [t in the camera frame, log(R̃ᵀR) in the object
                frame]; None: from the config's sigmas.
            scores: (N,), see :class:`~physpose_torch.losses.PhysicsLoss`.
            refine_only: (N,) bool; the other objects keep their poses, as do alternatives of them, and all else must fit them:
                known ones among the detections. None: all may move.
            callback: called before each step with step, flat poses and terms of the images still running.

        Raises:
            InvalidInputError: shapes, NaN or non-rigid poses, a covariance that is not positive definite; or an object is more
                than 100 m and more than a hundred times its size away from the camera, as in millimetres.
        """
        poses = as_matrix(poses)
        check_poses(poses, scene)
        leading, shape = poses.shape[:-3], poses.shape[:-2]
        hypotheses = leading.numel()
        moves = _checked_mask(refine_only, scene).repeat(hypotheses)
        with (
            torch.inference_mode(False),
            torch.enable_grad(),
            torch.autocast(poses.device.type, enabled=False),
        ):
            measured = poses.detach().clone().double().reshape(-1, 4, 4)
            _check_metres(measured.reshape(*shape, 4, 4), scene)
            if measured_covariance is not None:
                measured_covariance = torch.as_tensor(measured_covariance).detach().clone()
            covariance = flatten_covariance(measured_covariance, poses)
            many = scene if hypotheses == 1 else Scene.cat([scene] * hypotheses)
            acts = acting(scene, scores).repeat(hypotheses)
            scores = None if scores is None else torch.as_tensor(scores).detach().repeat(hypotheses)
            whole = make_prior(measured, many, acts, covariance, self.config.physics)
            part, rows = many, torch.arange(len(many))
            if not bool(moves.all()):
                part, rows = _with_frozen(many, measured, acts, moves)
                covariance, scores = (None if x is None else x[rows.to(x.device)] for x in (covariance, scores))
            at = rows.to(measured.device)
            prior = whole
            if part is not many:  # what is known of the others tells depths, too
                prior = make_prior(measured[at], part, acts[rows], covariance, self.config.physics)
            plan = make_plan(prior, part, acts[rows], scores, self.config, given=covariance is not None)
            found = self._solve(plan.prior(prior, self.config), plan, part, callback)
            kept, left = self._put_back(found, measured[at], prior, part, acts[rows])
            refined, result, released = measured.index_copy(0, at, kept), found.result, found.released
            terms, cost = result.terms, result.cost
            if part is not many or bool(left.any()) or plan.changes(prior):
                terms = self._terms(refined, whole, many, acts)
                cost = None if part is not many or bool(left.any()) or bool(plan.dubious.any()) else cost
            backend = self.config.physics.backend
            with torch.no_grad():
                report = report_of(refined.reshape(*shape, 4, 4), scene, many, acts, backend, cost)
            own = part.detached()  # planes may be moved later on
            solution = Solution(
                result.poses, kept, left, measured[at], own, acts[rows], covariance, found.righted, plan, self.config
            )
        _warn(released.doubts)
        lengths = ("penetration_static", "penetration_object", "gap")
        report = replace(report, **{name: getattr(report, name).to(poses.dtype) for name in lengths})

        def spread(flags: Tensor) -> Tensor:
            return torch.zeros(len(many), dtype=torch.bool, device=flags.device).index_copy(0, at, flags).reshape(shape)

        trajectory = None
        if result.trajectory is not None:
            trajectory = measured.expand(len(result.trajectory), -1, 4, 4).clone()
            trajectory[1:, at] = result.trajectory[1:]  # the descent begins where the depth bias is removed
            if len(trajectory) > 1:
                trajectory[-1] = refined
            trajectory = trajectory.reshape(len(trajectory), *shape, 4, 4).to(poses.dtype)
        refined = refined.reshape(*shape, 4, 4).to(poses.dtype)
        if self.config.gradient == "implicit" and poses.requires_grad and torch.is_grad_enabled():
            flat = poses.reshape(-1, 4, 4)
            refined = flat.index_copy(0, at, attach(flat[at], solution)).reshape(poses.shape)
        images = (*leading, scene.n_images)
        return Refinement(
            poses=refined,
            report=report,
            terms=PhysicsTerms(*(x.reshape(shape).to(poses.dtype) for x in terms)),
            trajectory=trajectory,
            steps=result.steps.reshape(images),
            converged=result.converged.reshape(images),
            image=scene.image,
            righted=spread(found.righted & ~left),
            rejected=spread(released.rejected),
            unsupported=spread(released.unsupported & left),
            doubts=released.doubts,
            _solution=solution,
            _rows=at,
        )

    def _solve(
        self,
        prior: PosePrior,
        plan: Plan,
        scene: Scene,
        callback: Callable[[int, Tensor, PhysicsTerms], None] | None,
    ) -> "_Found":
        """Minimise the cost, right what has fallen, and see whose estimates must be left alone."""
        config, backend = self.config, self.config.physics.backend
        solve = levenberg_marquardt if config.solver == "lm" else descend
        solve = partial(solve, config=config, callback=callback)
        result = solve(prior, scene, plan.acts)
        with torch.no_grad():
            report = report_of(result.poses, scene, scene, plan.acts, backend, result.cost)
        righted, standing = torch.zeros(len(scene), dtype=torch.bool, device=result.poses.device), prior.measured
        if config.righting > 0 and config.steps > 0 and config.physics.gravity_weight > 0:
            result, righted, standing = right_fallen(
                result,
                report,
                prior,
                scene,
                plan.acts,
                solve,
                pose_weight=config.physics.pose_weight,
                first_plane=len(scene) + len(scene.static_bodies),
                limit=config.righting,
                backend=backend,
            )
            if bool(righted.any()):
                with torch.no_grad():
                    report = report_of(result.poses, scene, scene, plan.acts, backend)
        released = release(result.poses, standing, plan, prior, scene, righted, report, config)
        return _Found(result, report, righted, released)

    def _put_back(
        self, found: "_Found", measured: Tensor, prior: PosePrior, scene: Scene, acts: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The poses (N, 4, 4), with those as they were that must be left alone, and which these are (N,)."""
        released, backend, refined = found.released, self.config.physics.backend, found.result.poses
        doubted = torch.tensor([bool(d) for d in released.doubts], dtype=torch.bool, device=refined.device)[prior.image]
        as_given = (released.rejected | doubted)[:, None, None]
        left = released.rejected | released.unsupported | doubted
        poses = torch.where(as_given, measured, torch.where(left[:, None, None], prior.measured, refined))
        if bool(released.unsupported.any()):
            # what hangs in the air stays where others have not come into its place
            pushed = report_of(poses, scene, scene, acts, backend).penetration > found.report.penetration + NOTABLE
            pushed &= released.unsupported
            left = left & ~pushed
            poses = torch.where(pushed[:, None, None], refined, poses)
        return poses, left

    def _terms(self, poses: Tensor, prior: PosePrior, scene: Scene, acts: Tensor) -> PhysicsTerms:
        """What the poses cost by the estimates as they were given."""
        eye = torch.eye(6).to(poses).expand(len(scene), 6, 6)
        config = replace(self.config, solver="descent")
        return make_cost(prior, scene, acts, config, poses.contiguous(), eye).all_terms()


def _checked_mask(refine_only: Tensor | None, scene: Scene) -> Tensor:
    if refine_only is None:
        return torch.ones(len(scene), dtype=torch.bool)
    mask = torch.as_tensor(refine_only).detach().cpu()
    if mask.dtype != torch.bool or mask.shape != (len(scene),):
        raise InvalidInputError(
            f"refine_only is {mask.dtype} of shape {tuple(mask.shape)}, expected bool ({len(scene)},): True for objects to move"
        )
    return mask


def _with_frozen(scene: Scene, poses: Tensor, acts: Tensor, moves: Tensor) -> tuple[Scene, Tensor]:
    """The scene of the objects that move, the others that act as static bodies in it, and the former's indices."""
    stays = (~moves & acts).nonzero()[:, 0].tolist()
    group = list(zip(scene.image.tolist(), scene.same_object.tolist(), strict=True))
    known = {group[i] for i in stays}
    moves = moves & torch.tensor([g not in known for g in group], dtype=torch.bool)
    rows = moves.nonzero()[:, 0]
    frozen = [Static(scene.objects[i], poses[i], image=scene.image[i].item()) for i in stays]
    return scene.replaced(rows, [*scene.statics, *frozen]), rows


class _Found(NamedTuple):
    """What a refinement came to, flat."""

    result: Descent
    report: PhysicsReport
    """At its poses; only those push that should."""
    righted: Tensor
    """(N,) bool."""
    released: Released
