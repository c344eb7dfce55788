"""Signed distance of convex parts to half-spaces: exact, closed form."""

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.config import Smoothing
from physpose_torch.distance.smoothing import vertex_weights
from physpose_torch.distance.support import DistanceResult
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Plane
from physpose_torch.geometry.convex import ConvexParts

__all__ = ["half_space_distance", "plane_distance"]


def plane_distance(
    T: Tensor, parts: ConvexParts, plane: Plane, *, smoothing: Smoothing | None = None
) -> DistanceResult:
    """Signed distances of all parts to the half-space below one plane.

    The error is at most 16 eps (that of the poses' dtype) of |t| + |offset| + the part's extent.

    Args:
        T: (P, 4, 4) pose of each part's body, T_camera_object [m].
        parts: P convex parts.
        plane: the plane, in the camera frame.
        smoothing: smoothing of the gradient; None for the exact one. ``pose`` means ``ring`` here.

    Returns:
        distance (P,), differentiable with respect to poses and plane; normal from part to half-space (down); witness
        points.
    """
    if T.shape != (parts.n_parts, 4, 4):
        raise InvalidInputError(f"T has shape {tuple(T.shape)}, expected ({parts.n_parts}, 4, 4): a pose for each part")
    index = torch.arange(parts.n_parts, device=T.device)
    normal, offset = plane.normal.to(T).expand(len(T), 3), plane.offset.to(T).expand(len(T))
    return half_space_distance(T, parts, index, normal, offset, smoothing=smoothing)


def half_space_distance(
    T: Tensor, parts: ConvexParts, index: Tensor, normal: Tensor, offset: Tensor, *, smoothing: Smoothing | None = None
) -> DistanceResult:
    """Signed distances of parts to half-spaces ``normal · x ≤ offset``, pair by pair.

    Args:
        T: (E, 4, 4) poses; index: (E,) which part; normal: (E, 3) pointing out of the half-space; offset: (E,) [m].
    """
    with torch.autocast(T.device.type, enabled=False):  # a micrometre is lost in half precision
        return _half_space_distance(T, parts, index, normal, offset, smoothing)


def _half_space_distance(T, parts, index, normal, offset, smoothing) -> DistanceResult:
    local = parts.padded.to(T)[index]
    down = -(normal[:, None] @ T[:, :3, :3])[:, 0]
    with torch.no_grad():
        if smoothing is None:
            deepest = torch.einsum("eki,ei->ek", local, down).argmax(1)
            witness = local[torch.arange(len(T), device=T.device), deepest]
        else:
            weights = vertex_weights(local, parts.padded_mask.to(T.device)[index], down, smoothing)
            witness = torch.einsum("ek,eki->ei", weights, local)
        depth = torch.einsum("eki,ei->ek", local, down).amax(1)
        height = torch.einsum("ei,ei->e", normal, T[:, :3, 3]) - offset - depth
    # the value is the hard distance, its gradient runs through the (smoothed) witness point
    point = se3.apply(T, witness[:, None])[:, 0]
    linear = torch.einsum("ei,ei->e", normal, point) - offset
    distance = height + (linear - linear.detach())
    point_a = (point - (linear - height)[:, None] * normal).detach()
    return DistanceResult(distance, -normal.detach(), point_a, (point_a - height[:, None] * normal).detach())
