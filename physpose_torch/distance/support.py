"""Support functions of convex parts, and the lower bound that they give for every direction."""

from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch.geometry.convex import ConvexParts

__all__ = ["DistanceResult", "gap_along", "support_index"]


class DistanceResult(NamedTuple):
    """Signed distances of E pairs, in the frame of the given poses."""

    distance: Tensor
    """(E,) [m]; positive apart, negative penetrating. Differentiable with respect to the poses."""
    normal: Tensor
    """(E, 3) unit vectors from a to b. Not differentiable, nor are the points."""
    point_a: Tensor
    """(E, 3) witness points on a [m]."""
    point_b: Tensor
    """(E, 3) witness points on b [m]."""


def support_index(vertices: Tensor, direction: Tensor) -> Tensor:
    """Index (E,) of the vertex of each padded part (E, K, 3) that lies farthest along direction (E, 3)."""
    return torch.einsum("eki,ei->ek", vertices, direction).argmax(1)


def gap_along(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor, normals: Tensor) -> Tensor:
    """Separation -(σ_A(n) + σ_B(-n)) of each pair along C directions n: never more than the signed distance.

    Args:
        parts: convex parts.
        pairs: (E, 2) indices of parts a and b.
        R: (E, 3, 3), t: (E, 3), pose of b in the frame of a [m].
        normals: (E, C, 3) unit vectors from a to b, in the frame of a.

    Returns:
        (E, C) gaps [m].
    """
    A, B = parts.padded[pairs[:, 0]], parts.padded[pairs[:, 1]]
    top_a = (A @ normals.mT).amax(1)
    low_b = (B @ (R.mT @ normals.mT)).amin(1)
    return low_b + torch.einsum("eci,ei->ec", normals, t) - top_a
