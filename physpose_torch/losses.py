"""The paper's three costs, each one function, and the Module that adds them up."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from physpose_torch import se3
from physpose_torch.config import PhysicsConfig
from physpose_torch.contacts import Contacts, Drops, find_contacts, find_drops, find_static_gaps
from physpose_torch.errors import InvalidInputError
from physpose_torch.scene import Scene

__all__ = [
    "PhysicsLoss",
    "PhysicsTerms",
    "collision_loss",
    "gravity_loss",
    "pose_covariance",
    "pose_loss",
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


def pose_covariance(measured: Tensor, center: Tensor, config: PhysicsConfig) -> Tensor:
    """Covariance of estimates that are less sure along the viewing ray than across it (paper Sec. 3.1).

    Args:
        measured: T̃_camera_object (..., N, 4, 4) [m].
        center: (N, 3) point of the object that the ray goes to [m].
        config: its sigma fields.

    Returns:
        (..., N, 6, 6): translation in the camera frame [m²], rotation (isotropic) in the object frame [rad²].
    """
    ray = (measured[..., :3, :3] @ center.to(measured)[..., None])[..., 0] + measured[..., :3, 3]
    distance = torch.linalg.vector_norm(ray, dim=-1)[..., None, None]
    direction = torch.nn.functional.normalize(ray, dim=-1)
    along = direction[..., :, None] * direction[..., None, :]
    eye = torch.eye(3, dtype=measured.dtype, device=measured.device)
    variance = config.sigma_ray**2 + (config.sigma_ray_fraction * distance) ** 2
    covariance = torch.zeros(*measured.shape[:-2], 6, 6, dtype=measured.dtype, device=measured.device)
    covariance[..., :3, :3] = config.sigma_lateral**2 * (eye - along) + variance * along
    covariance[..., 3:, 3:] = config.sigma_rotation**2 * eye
    return covariance


def soft_hinge(x: Tensor, softness: float) -> Tensor:
    """max(0, x) with a quadratic start: x²/2w for 0 < x < w, then x - w/2; ``softness`` w in the unit of x."""
    positive = x.clamp_min(0)
    if softness == 0:
        return positive
    return torch.where(positive < softness, positive * positive / (2 * softness), positive - 0.5 * softness)


def collision_loss(contacts: Contacts, n_objects: int, *, softness: float = 0.0) -> tuple[Tensor, Tensor]:
    """Mean penetration of the colliding part pairs of every two bodies, summed over the others (paper Eq. 7-8).

    Args:
        contacts: signed distances of part pairs, see :func:`physpose_torch.contacts.find_contacts`.
        n_objects: number of movable objects N.
        softness: see :func:`soft_hinge` [m]; 0 is the paper's.

    Returns:
        C_i as printed (N,) [m], in which a pair of movable objects counts for both; and each object's share (N,) [m]
        of the sum in which every pair counts once.
    """
    c = contacts
    penetration = soft_hinge(-c.distance, softness)
    n_pairs = len(c.pair_first)
    n_colliding = c.distance.new_zeros(n_pairs).index_add(0, c.pair, (c.distance < 0).to(c.distance))
    cost = c.distance.new_zeros(n_pairs).index_add(0, c.pair, penetration) / n_colliding.clamp_min(1.0)
    printed, share = c.distance.new_zeros(n_objects), c.distance.new_zeros(n_objects)
    both = c.moves_first & c.moves_second
    for who, moves in ((c.pair_first, c.moves_first), (c.pair_second, c.moves_second)):
        printed = printed.index_add(0, who[moves], cost[moves])
        share = share.index_add(0, who[moves], (cost * torch.where(both, 0.5, 1.0))[moves])
    return printed, share


def gravity_loss(drops: Drops, *, softness: float = 0.0) -> Tensor:
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

        Raises:
            InvalidInputError: shapes, NaN, non-rigid poses, or a covariance that is not positive definite.
        """
        poses = check_poses(poses, scene)
        leading = poses.shape[:-3]
        hypotheses = leading.numel()
        with torch.autocast(poses.device.type, enabled=False):
            pose = poses.new_zeros(poses.shape[:-2])
            if measured is not None:
                measured = check_poses(measured, scene, "measured").to(poses)
                precision = check_precision(measured, scene, measured_covariance, self.config)
                pose = pose_loss(poses, measured, precision)
            flat = poses.reshape(-1, 4, 4)
            many = scene if hypotheses == 1 else Scene.cat([scene] * hypotheses)
            acts = acting(scene, scores).repeat(hypotheses)
            collision, share, gravity = physics_terms(flat, many, acts, self.config)
        shape = poses.shape[:-2]
        total = (
            self.config.pose_weight * pose
            + self.config.collision_weight * share.reshape(shape)
            + self.config.gravity_weight * gravity.reshape(shape)
        )
        return PhysicsTerms(pose, collision.reshape(shape), gravity.reshape(shape), total)


def physics_terms(poses: Tensor, scene: Scene, acts: Tensor, config: PhysicsConfig) -> tuple[Tensor, Tensor, Tensor]:
    """C_i as printed, each object's share of the collisions counted once, and G_i; (N,) each, of flat poses (N, 4, 4)."""
    smoothing, backend = config.smoothing, config.backend
    contacts = find_contacts(poses, scene, acts=acts, smoothing=smoothing, backend=backend,
                             margin=config.contact_tolerance if config.gravity == "paper" else 0.0)
    collision, share = collision_loss(contacts, len(scene), softness=config.softness)
    if config.gravity_weight == 0 or not bool((scene.gravity != 0).any()):
        return collision, share, poses.new_zeros(len(scene))
    if config.gravity == "paper":
        drops = find_static_gaps(poses, scene, contacts, tolerance=config.contact_tolerance, smoothing=smoothing,
                                 backend=backend)
    else:
        drops = find_drops(poses, scene, acts=acts, reach=config.gravity_reach, smoothing=smoothing, backend=backend)
    return collision, share, gravity_loss(drops, softness=config.softness)


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
    se3.check_rigid(poses, name, scene.labels or None)
    if poses.ndim < 3 or poses.shape[-3] != len(scene):
        raise InvalidInputError(
            f"{name} has shape {tuple(poses.shape)}, expected (..., {len(scene)}, 4, 4) for a scene of {len(scene)} objects"
        )
    return poses if poses.dtype in (torch.float32, torch.float64) else poses.float()


def check_precision(measured: Tensor, scene: Scene, covariance: Tensor | None, config: PhysicsConfig) -> Tensor:
    """H = Σ⁻¹ (..., N, 6, 6) of given covariances or of the config's sigmas."""
    if covariance is None:
        covariance = pose_covariance(measured.double(), scene.object_center.to(measured.device), config)
    else:
        covariance = torch.as_tensor(covariance, device=measured.device).double()
        expected = (*measured.shape[:-2], 6, 6)
        try:
            covariance = covariance.expand(expected)
        except RuntimeError as error:
            raise InvalidInputError(
                f"measured_covariance has shape {tuple(covariance.shape)}, expected {expected}"
            ) from error
    factor, failed = torch.linalg.cholesky_ex(0.5 * (covariance + covariance.mT))
    bad = (failed != 0) | ~covariance.isfinite().flatten(-2).all(-1)
    if bool(bad.any()):
        row = int(bad.reshape(-1).nonzero()[0, 0])
        raise InvalidInputError(f"measured_covariance of object {row % len(scene)} is not positive definite")
    return torch.cholesky_inverse(factor).to(measured)
