"""What an estimator's poses say: how sure they are across and along the viewing ray, alone and together."""

from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch.config import PhysicsConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.scene import Scene

__all__ = ["PosePrior", "common_depth", "make_prior", "pose_covariance"]

REWEIGHTINGS = 8
"""Steps of reweighted least squares for the common depth factor."""


LEAST_RATIO, MOST_RATIO = 1e-3, 1e5
"""Of σ along the ray to that across it, what a matrix can hold and be inverted: by default from 0.2 mm to 20 km away."""


class PosePrior(NamedTuple):
    """Estimates of N objects with their uncertainty, flat."""

    measured: Tensor
    """T̃_camera_object (N, 4, 4) [m], depth bias removed."""
    precision: Tensor
    """H = Σ⁻¹ (N, 6, 6), order [t in the camera frame, log(R̃ᵀR) in the object frame]."""
    ray: Tensor
    """(N, 3) from the camera to the centre of each object's bounds [m]; a depth factor 1 + s shifts it by s times this. Zero
    in images without anything static: what their objects have in common is not to be found out there."""
    acts: Tensor
    """(N,) bool; an alternative that pushes nobody has no say in the depth factor either."""
    reach: Tensor
    """(N,) an object higher than this above any support [m] feels no gravity."""
    image: Tensor
    """(N,) image of each object."""
    n_images: int
    sigma_common: float
    """Standard deviation of the depth factor that all estimates of an image share; 0: they are independent."""
    robust: float
    """ν of the robust kernel ρ(m²) = ½ ν log(1 + m²/ν); infinite: ½ m²."""

    def of(self, rows: Tensor, part: Scene) -> "PosePrior":
        """The prior of the objects ``rows``, which are those of ``part``, see :meth:`Scene.select`."""
        columns = (x[rows.to(x.device)] for x in (self.measured, self.precision, self.ray, self.acts, self.reach))
        image = part.image.to(self.image.device)
        return PosePrior(*columns, image, part.n_images, self.sigma_common, self.robust)


def make_prior(
    measured: Tensor, scene: Scene, acts: Tensor, covariance: Tensor | None, config: PhysicsConfig
) -> PosePrior:
    """The prior of flat estimates (N, 4, 4).

    Args:
        acts: (N,) bool, see :func:`physpose_torch.losses.acting`.
        covariance: (N, 6, 6) or broadcastable; None: from the config's sigmas. A given covariance is taken as it is,
            without a depth factor in common.

    Raises:
        InvalidInputError: the covariance has another shape or is not positive definite.
    """
    sigma_common = config.sigma_depth_common if covariance is None else 0.0
    if config.depth_factor != 1.0:
        measured = measured.clone()
        measured[:, :3, 3] *= config.depth_factor
    ray = scene.centers(measured)
    if covariance is None:
        covariance = pose_covariance(measured.double(), scene.object_center.to(measured.device), config)
    else:
        covariance = torch.as_tensor(covariance, device=measured.device).double()
        try:
            covariance = covariance.expand(len(measured), 6, 6)
        except RuntimeError as error:
            raise InvalidInputError(
                f"measured_covariance has shape {tuple(covariance.shape)}, expected (..., {len(measured)}, 6, 6)"
            ) from error
    factor, failed = torch.linalg.cholesky_ex(0.5 * (covariance + covariance.mT))
    bad = (failed != 0) | ~covariance.isfinite().flatten(1).all(1)
    if bool(bad.any()):
        row = int(bad.nonzero()[0, 0])
        raise InvalidInputError(f"measured_covariance[{row}] ({scene.labels[row]}) is not positive definite")
    precision = torch.cholesky_inverse(factor).to(measured)
    image, acts = scene.image.to(measured.device), acts.to(measured.device)
    # nothing but collisions would drive all objects away from the camera together, where their rays are farther apart
    ray = torch.where(scene.has_static.to(image.device)[image, None], ray, 0.0)
    reach = measured.new_full((len(measured),), config.gravity_reach)
    return PosePrior(measured, precision, ray, acts, reach, image, scene.n_images, sigma_common, config.robust)


def pose_covariance(measured: Tensor, center: Tensor, config: PhysicsConfig) -> Tensor:
    """Covariance of estimates that are less sure along the viewing ray than across it (paper Sec. 3.1).

    Args:
        measured: T̃_camera_object (..., N, 4, 4) [m].
        center: (N, 3) point of the object that the ray goes to [m].
        config: its sigma fields.

    Returns:
        (..., N, 6, 6): translation in the camera frame [m²], rotation (isotropic) in the object frame [rad²]. σ along the ray
        is 1e-3 to 1e5 times that across it, which is what a matrix in float64 can hold.
    """
    ray = (measured[..., :3, :3] @ center.to(measured)[..., None])[..., 0] + measured[..., :3, 3]
    distance = torch.linalg.vector_norm(ray, dim=-1)[..., None, None]
    direction = torch.nn.functional.normalize(ray, dim=-1)
    along = direction[..., :, None] * direction[..., None, :]
    eye = torch.eye(3, dtype=measured.dtype, device=measured.device)
    variance = config.sigma_ray**2 + (config.sigma_ray_fraction * distance) ** 2
    lateral = config.sigma_lateral**2
    variance = variance.clamp(lateral * LEAST_RATIO**2, lateral * MOST_RATIO**2)
    covariance = torch.zeros(*measured.shape[:-2], 6, 6, dtype=measured.dtype, device=measured.device)
    covariance[..., :3, :3] = lateral * (eye - along) + variance * along
    covariance[..., 3:, 3:] = config.sigma_rotation**2 * eye
    return covariance


def common_depth(residual: Tensor, prior: PosePrior) -> Tensor:
    """The depth factor s (I,) of each image that explains its objects' residuals best.

    Minimises Σ ρ(‖e_i - s [ray_i, 0]‖²_H) + ½ s²/σ² over s, by reweighted least squares from s = 0: estimators misjudge
    the depths of one image together, and an estimate that is wrong altogether has no say in it.

    Args:
        residual: (N, 6), see :func:`physpose_torch.se3.residual`.
        prior: with ``sigma_common`` > 0.
    """
    weighted = (prior.precision[:, :3] * prior.ray[:, :, None]).sum(1)  # H [ray, 0]
    own = torch.einsum("ni,nij,nj->n", residual, prior.precision, residual)
    toward, curvature = (weighted * residual).sum(1), (weighted[:, :3] * prior.ray).sum(1)
    zeros = residual.new_zeros(prior.n_images)
    factor = zeros
    for _ in range(1 if prior.robust == torch.inf else REWEIGHTINGS):
        s = factor[prior.image]
        weight = prior.acts / (1.0 + (own - 2 * s * toward + s * s * curvature).clamp_min(0) / prior.robust)
        numerator = zeros.index_add(0, prior.image, weight * toward)
        information = zeros.index_add(0, prior.image, weight * curvature)
        factor = numerator / (information + 1.0 / prior.sigma_common**2)
    return factor
