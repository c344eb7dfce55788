"""What refined poses are worth: their covariance, from the curvature of the cost where they came to rest."""

import torch
from torch import Tensor

from physpose_torch.implicit import Solution, jacobian, ranks
from physpose_torch.prior import make_prior

__all__ = ["posterior_covariance"]

FLOOR = 0.5
"""Curvatures below this, that of an estimate by itself being 1, count as this: robust costs may bend the other way."""


def posterior_covariance(s: Solution) -> Tensor:
    """Covariance (N, 6, 6) of each refined pose, order [t in the camera frame, rotation in the object frame].

    Laplace's approximation: the inverse of the curvature of all poses of an image together, of which each object's block is
    its own. The depth factor that the estimates share is in it. An estimate that was left as it was has its own covariance.
    """
    prior = make_prior(s.measured, s.scene, s.acts, s.covariance, s.config.physics)
    own = torch.linalg.inv(prior.precision)
    own[:, :3, :3] += prior.sigma_common**2 * prior.ray[:, :, None] * prior.ray[:, None, :]
    out = own.clone()
    planned = s.plan.prior(prior, s.config)
    spread = planned.precision.diagonal(dim1=1, dim2=2).rsqrt()
    rank, size = ranks(s.scene)
    moved = ~s.left
    if not bool(moved.any()):
        return out
    curvature = jacobian(s.measured, s, rank, size, of="poses")
    for i in s.scene.image.unique().tolist():
        rows = (s.scene.image == i).nonzero()[:, 0].to(out.device)
        if not bool(moved[rows].any()):
            continue
        k = 6 * len(rows)
        unit = spread[rows].reshape(k)
        A = unit[:, None] * curvature[rows][:, :, : len(rows)].reshape(k, k) * unit
        value, axes = torch.linalg.eigh(0.5 * (A + A.mT))
        whole = unit[:, None] * (axes / value.clamp_min(FLOOR)) @ axes.mT * unit
        blocks = whole.reshape(len(rows), 6, len(rows), 6).diagonal(dim1=0, dim2=2).permute(2, 0, 1)
        out[rows] = torch.where(moved[rows, None, None], blocks, out[rows])
    return out
