"""The paper's three costs, each one function, and the Module that adds them up."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from physpose_torch import se3
from physpose_torch.config import PhysicsConfig
from physpose_torch.contacts import Contacts, Drops, find_contacts, find_drops, find_static_gaps
from physpose_torch.errors import InvalidInputError
from physpose_torch.prior import PosePrior, common_depth, make_prior, pose_covariance
from physpose_torch.scene import Scene, as_matrix

__all__ = [
    "PhysicsLoss",
    "PhysicsTerms",
    "collision_loss",
    "gravity_loss",
    "pose_covariance",
    "pose_loss",
    "prior_loss",
    "soft_hinge",
]


class PhysicsTerms(NamedTuple):
    """Costs of each object, (..., N); differentiable with respect to the poses."""

    pose: Tensor
    """P_i, unweighted."""
    collision: Tensor
    """C_i as printed in the paper, unweighted [m]: a pair of movable objects appears in both."""
    gravity: Tensor
    """G_i, unweighted [m]."""
    total: Tensor
    """Weighted sum in which every pair counts once (half at each of two movable objects)."""


class _Mahalanobis(torch.autograd.Function):
    """½ eᵀ H e with the analytic gradient of the paper's appendix, finite wherever the residual is."""

    @staticmethod
    def forward(ctx, T, T_measured, precision):
        e = se3.residual(T, T_measured)
        He = (precision @ e[..., None])[..., 0]
        ctx.save_for_backward(T, e, He)
        return 0.5 * (e * He).sum(-1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        T, e, He = ctx.saved_tensors
        # d log(R̃ᵀR) = J_r⁻¹ δ for R exp(δ); a 4×4 gradient G_R = ½ R [v]× has v as its tangent
        v = (se3.right_jacobian_inverse(e[..., 3:]).mT @ He[..., 3:, None])[..., 0]
        G = torch.zeros_like(T)
        G[..., :3, :3] = 0.5 * T[..., :3, :3] @ se3.hat(v)
        G[..., :3, 3] = He[..., :3]
        return grad[..., None, None] * G, None, None


def pose_loss(poses: Tensor, measured: Tensor, precision: Tensor) -> Tensor:
    """Squared Mahalanobis distance to the estimates, halved (paper Eq. 2).

    Args:
        poses: T_camera_object, (..., N, 4, 4) [m]; the only argument that gets a gradient.
        measured: the estimates T̃_camera_object, (..., N, 4, 4) [m].
        precision: H = Σ⁻¹, (..., N, 6, 6), order [t in the camera frame, log(R̃ᵀR) in the object frame].

    Returns:
        P (..., N), no unit.
    """
    return _Mahalanobis.apply(*torch.broadcast_tensors(poses, measured), precision)


def prior_loss(poses: Tensor, prior: PosePrior) -> Tensor:
    """Robust pose cost (N,) of flat poses (N, 4, 4); the depth factor that an image's estimates share is eliminated.

    With the best factor s the estimates move by s along their rays; its own cost ½ s²/σ² is spread over the objects. The
    gradient is that at fixed s, which is exact at the optimum.
    """
    measured, own = prior.measured, poses.new_zeros(len(poses))
    if prior.sigma_common > 0:
        with torch.no_grad():
            factor = common_depth(se3.residual(poses, prior.measured), prior)
            measured = prior.measured.clone()
            measured[:, :3, 3] += factor[prior.image, None] * prior.ray
            count = torch.bincount(prior.image[prior.acts], minlength=prior.n_images)[prior.image]
            own = prior.acts * 0.5 * (factor[prior.image] / prior.sigma_common) ** 2 / count
    cost = pose_loss(poses, measured, prior.precision)
    if prior.robust != torch.inf:
        cost = 0.5 * prior.robust * torch.log1p(2 * cost / prior.robust)
    return cost + own


def soft_hinge(x: Tensor, softness: Tensor | float) -> Tensor:
    """max(0, x) with a quadratic start: x²/2w for 0 < x < w, then x - w/2; ``softness`` w ≥ 0 in the unit of x."""
    positive = torch.relu(x)  # no force at exact contact, unlike clamp
    w = torch.as_tensor(softness, dtype=x.dtype, device=x.device)
    quadratic = positive * positive / (2 * w.clamp_min(torch.finfo(x.dtype).tiny))
    return torch.where(positive < w, quadratic, positive - 0.5 * w)


def collision_loss(contacts: Contacts, n_objects: int, *, softness: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
    """Mean penetration of the colliding part pairs of every two bodies, summed over the others (paper Eq. 7-8).

    Args:
        contacts: signed distances of part pairs, see :func:`physpose_torch.contacts.find_contacts`.
        n_objects: number of movable objects N.
        softness: see :func:`soft_hinge` [m], one or (D,) a pair of bodies; 0 is the paper's.

    Returns:
        C_i as printed (N,) [m], in which a pair of movable objects counts for both; and each object's share (N,) [m]
        of the sum in which every pair counts once.
    """
    c = contacts
    softness = torch.as_tensor(softness, dtype=c.distance.dtype, device=c.distance.device)
    penetration = soft_hinge(-c.distance, softness if softness.ndim == 0 else softness[c.pair])
    n_pairs = len(c.pair_first)
    n_colliding = c.distance.new_zeros(n_pairs).index_add(0, c.pair, (c.distance < 0).to(c.distance))
    cost = c.distance.new_zeros(n_pairs).index_add(0, c.pair, penetration) / n_colliding.clamp_min(1.0)
    printed, share = c.distance.new_zeros(n_objects), c.distance.new_zeros(n_objects)
    both = c.moves_first & c.moves_second
    for who, moves in ((c.pair_first, c.moves_first), (c.pair_second, c.moves_second)):
        printed = printed.index_add(0, who[moves], cost[moves])
        share = share.index_add(0, who[moves], (cost * torch.where(both, 0.5, 1.0))[moves])
    return printed, share


def gravity_loss(drops: Drops, *, softness: Tensor | float = 0.0) -> Tensor:
    """Height of each object above what would carry it; none where it touches something or hangs out of reach.

    With gaps from :func:`~physpose_torch.contacts.find_static_gaps` it is the paper's Eq. 9; with those of
    :func:`~physpose_torch.contacts.find_drops` the drop along gravity.

    Returns:
        G (N,) [m].
    """
    gap = torch.where(drops.height.isfinite(), drops.height, torch.zeros_like(drops.height))
    return torch.where(drops.touching, torch.zeros_like(gap), soft_hinge(gap, softness))


class PhysicsLoss(nn.Module):
    """Pose + collision + gravity cost of posed objects (paper Eq. 1), for training and for the refiner.

    Args:
        config: weights and options.
    """

    def __init__(self, config: PhysicsConfig | None = None) -> None:
        super().__init__()
        self.config = config or PhysicsConfig()

    def extra_repr(self) -> str:
        return str(self.config)

    def forward(
        self,
        poses: Tensor,
        scene: Scene,
        *,
        measured: Tensor | None = None,
        measured_covariance: Tensor | None = None,
        scores: Tensor | None = None,
    ) -> PhysicsTerms:
        """Costs of all objects.

        Args:
            poses: T_camera_object, (..., N, 4, 4) [m]; leading dimensions are hypotheses of the same scene.
            scene: the N objects, statics and gravity.
            measured: the estimates, same shape; None: no pose cost.
            measured_covariance: (..., N, 6, 6), order [t in the camera frame, log(R̃ᵀR) in the object frame];
                None: from the config's sigmas.
            scores: (N,) confidence of the estimates; among alternatives of one object the best one acts on the scene,
                the others feel it and push nobody. None: the first one.

        Which parts are near each other decides every shape in here, so ``torch.compile`` breaks the graph once, at this call,
        and runs it as it is; what is before and after it is compiled.

        Computed in the poses' dtype. Finite, gradients too, from 1e-9 to 1e9 m; distances have the errors of
        :func:`~physpose_torch.distance.autograd.signed_distance`, those to planes of
        :func:`~physpose_torch.distance.plane.plane_distance`.

        Raises:
            InvalidInputError: shapes, NaN, non-rigid poses, or a covariance that is not positive definite.
        """
        if torch.compiler.is_compiling():
            # one break instead of one at every shape that depends on data, and no new graph for every number of contacts
            return torch.compiler.disable(self._terms)(poses, scene, measured, measured_covariance, scores)
        return self._terms(poses, scene, measured, measured_covariance, scores)

    def _terms(
        self,
        poses: Tensor,
        scene: Scene,
        measured: Tensor | None,
        measured_covariance: Tensor | None,
        scores: Tensor | None,
    ) -> PhysicsTerms:
        poses = check_poses(poses, scene)
        leading = poses.shape[:-3]
        hypotheses = leading.numel()
        with torch.autocast(poses.device.type, enabled=False):
            flat = poses.reshape(-1, 4, 4)
            many = scene if hypotheses == 1 else Scene.cat([scene] * hypotheses)
            acts = acting(scene, scores).repeat(hypotheses)
            pose = flat.new_zeros(len(flat))
            if measured is not None:
                measured = check_poses(measured, scene, "measured").to(poses)
                if measured.shape[:-3] not in (leading, ()):
                    shapes = f"{tuple(measured.shape)}, expected {tuple(poses.shape)}"
                    raise InvalidInputError(f"measured has shape {shapes}")
                covariance = flatten_covariance(measured_covariance, poses)
                prior = make_prior(measured.expand_as(poses).reshape(-1, 4, 4), many, acts, covariance, self.config)
                pose = prior_loss(flat, prior)
            collision, share, gravity = physics_terms(flat, many, acts, self.config)
        shape = poses.shape[:-2]
        pose = pose.reshape(shape)
        total = (
            self.config.pose_weight * pose
            + self.config.collision_weight * share.reshape(shape)
            + self.config.gravity_weight * gravity.reshape(shape)
        )
        return PhysicsTerms(pose, collision.reshape(shape), gravity.reshape(shape), total)


def physics_terms(
    poses: Tensor, scene: Scene, acts: Tensor, config: PhysicsConfig, reach: Tensor | float | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """C_i as printed, each object's share of the collisions counted once, and G_i; (N,) each, of flat poses (N, 4, 4).

    An object higher than its ``reach`` [m] above any support feels no gravity; None: the config's, for all.
    """
    reach = config.gravity_reach if reach is None else reach
    smoothing, backend = config.smoothing if config.smoothing.kind != "none" else None, config.backend
    margin = config.contact_tolerance if config.gravity == "paper" else 0.0
    contacts = find_contacts(poses, scene, acts=acts, smoothing=smoothing, backend=backend, margin=margin)
    among = contacts.pair_second < len(scene)
    softness = _contact_softness(contacts.variance, among, config.collision_weight, config)
    collision, share = collision_loss(contacts, len(scene), softness=softness)
    if config.gravity_weight == 0 or not bool((scene.gravity != 0).any()):
        return collision, share, poses.new_zeros(len(scene))
    if config.gravity == "paper":
        drops = find_static_gaps(
            poses,
            scene,
            contacts,
            acts=acts,
            tolerance=config.contact_tolerance,
            smoothing=smoothing,
            backend=backend,
        )
    else:
        drops = find_drops(poses, scene, acts=acts, reach=reach, smoothing=smoothing, backend=backend)
    among = (drops.support >= 0) & (drops.support < len(scene))
    softness = _contact_softness(drops.variance, among, config.gravity_weight, config)
    gravity = gravity_loss(drops, softness=softness)
    carried = scene.has_static[scene.image].to(poses.device)  # what rests on nothing known is not pulled together
    return collision, share, torch.where(carried, gravity, torch.zeros_like(gravity))


def _contact_softness(variance: Tensor, among: Tensor, weight: float, config: PhysicsConfig) -> Tensor:
    """Softness w of contacts that are uncertain, those ``among`` objects alike: ζ d²/2w is d²/2σ² for w = ζσ²."""
    variance = torch.where(among, config.sigma_contact**2, variance)
    return (weight * variance).clamp_min(config.softness)


def acting(scene: Scene, scores: Tensor | None) -> Tensor:
    """(N,) bool: the best-scored alternative of each physical object (the first among equals)."""
    n = len(scene)
    if scores is None:
        scores = torch.zeros(n, dtype=torch.float64)
    scores = torch.as_tensor(scores).detach().double().cpu()
    if scores.shape != (n,) or not bool(scores.isfinite().all()):
        raise InvalidInputError(f"scores have shape {tuple(scores.shape)}, expected finite ({n},)")
    groups = scene.image * (int(scene.same_object.max()) + 1 if n else 1) + scene.same_object
    order = torch.argsort(scores, descending=True, stable=True)
    order = order[torch.argsort(groups[order], stable=True)]
    first = torch.ones(n, dtype=torch.bool)
    first[1:] = groups[order][1:] != groups[order][:-1]
    acts = torch.zeros(n, dtype=torch.bool)
    acts[order[first]] = True
    return acts


def check_poses(poses: Tensor, scene: Scene, name: str = "poses") -> Tensor:
    """Poses (..., N, 4, 4) that fit the scene, in a dtype to compute in; the matrices of a ``Transform3d``."""
    poses = as_matrix(poses)
    try:
        se3.check_rigid(poses, name, scene.labels or None)
    except InvalidInputError as error:
        if isinstance(poses, Tensor) and _in_half_precision(poses):
            raise InvalidInputError(
                f"{error}. Autocast rounds products of matrices to half precision: put poses together in float32, inside "
                "torch.autocast(device_type, enabled=False)"
            ) from error
        raise
    if poses.ndim < 3 or poses.shape[-3] != len(scene):
        raise InvalidInputError(
            f"{name} has shape {tuple(poses.shape)}, expected (..., {len(scene)}, 4, 4) for a scene of {len(scene)} objects"
        )
    return poses if poses.dtype in (torch.float32, torch.float64) else poses.float()


def _in_half_precision(poses: Tensor) -> bool:
    """Whether that may be why rotations are not rigid: bfloat16 is off by up to 0.4 %."""
    return poses.dtype in (torch.float16, torch.bfloat16) or torch.is_autocast_enabled(poses.device.type)


def flatten_covariance(covariance: Tensor | None, poses: Tensor) -> Tensor | None:
    """Covariances (..., N, 6, 6) or broadcastable as (M, 6, 6), for poses (..., N, 4, 4)."""
    if covariance is None:
        return None
    covariance = torch.as_tensor(covariance).detach()
    expected = (*poses.shape[:-2], 6, 6)
    try:
        return covariance.expand(expected).reshape(-1, 6, 6)
    except RuntimeError as error:
        raise InvalidInputError(
            f"measured_covariance has shape {tuple(covariance.shape)}, expected {expected}"
        ) from error
