"""Closest points of convex parts that are apart, in float64 torch: exact, for the few that a backend gets wrong."""

import torch
from torch import Tensor

from physpose_torch.geometry.convex import ConvexParts

__all__ = ["closest_points"]

STEPS = 64
CONVERGED = 1e-13
"""[m]; the distance is known to this when the iteration stops."""
SEGMENTS = torch.tensor([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
TRIANGLES = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])


def closest_points(
    parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor, normal: Tensor
) -> tuple[Tensor, Tensor]:
    """Closest points of pairs of parts that do not overlap (Gilbert, Johnson and Keerthi 1988).

    The closest point of each simplex is found by trying all of its edges and triangles rather than by Johnson's
    recursion, which is what fails near contact.

    Args:
        parts: convex parts.
        pairs: (E, 2) indices of parts a and b.
        R: (E, 3, 3), t: (E, 3), pose of b in the frame of a [m].
        normal: (E, 3) where to start: unit vectors from a to b.

    Returns:
        Points on a and on b, (E, 3) each, in the frame of part a [m].
    """
    A, B = parts.padded[pairs[:, 0]], parts.padded[pairs[:, 1]] @ R.mT + t[:, None]
    point_a, point_b = torch.empty_like(t), torch.empty_like(t)
    todo = torch.arange(len(pairs), device=t.device)
    # the simplex of B - A, as pairs of points on A and on B
    corners = _support(A, B, normal)[:, None].expand(-1, 3, -1, -1)
    closest = corners[:, 0]
    for _ in range(STEPS):
        point_a[todo], point_b[todo] = closest.unbind(1)
        gap = closest[:, 1] - closest[:, 0]
        length = torch.linalg.vector_norm(gap, dim=-1)
        new = _support(A[todo], B[todo], gap)
        ahead = length - (gap * (new[:, 1] - new[:, 0])).sum(-1) / length.clamp_min(1e-300)
        wrong = (ahead > CONVERGED).nonzero()[:, 0]
        if len(wrong) == 0:
            break
        todo, length = todo[wrong], length[wrong]
        corners, closest = _closest(torch.cat([corners[wrong], new[wrong, None]], dim=1))
        shrinks = (torch.linalg.vector_norm(closest[:, 1] - closest[:, 0], dim=-1) < length).nonzero()[:, 0]
        todo, corners, closest = todo[shrinks], corners[shrinks], closest[shrinks]
    return point_a, point_b


def _support(A: Tensor, B: Tensor, direction: Tensor) -> Tensor:
    """(E, 2, 3): the points of A farthest along the direction and of B farthest against it."""
    rows = torch.arange(len(A), device=A.device)
    a = (A @ direction[:, :, None])[:, :, 0].argmax(1)
    b = (B @ direction[:, :, None])[:, :, 0].argmin(1)
    return torch.stack([A[rows, a], B[rows, b]], dim=1)


def _closest(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Corners (E, 3, 2, 3) of the edge or triangle of a tetrahedron (E, 4, 2, 3) nearest to the origin, and its nearest
    point (E, 2, 3)."""
    x = corners[:, :, 1] - corners[:, :, 0]
    p, q = (x[:, i] for i in SEGMENTS.unbind(1))
    along = q - p
    s = (-(p * along).sum(-1) / (along * along).sum(-1).clamp_min(1e-300)).clamp(0.0, 1.0)
    weights = [torch.stack([1.0 - s, s, torch.zeros_like(s)], dim=-1)]
    o, p, q = (x[:, i] for i in TRIANGLES.unbind(1))
    normal = torch.linalg.cross(p - o, q - o)
    square = (normal * normal).sum(-1)
    u = (normal * torch.linalg.cross(p, q)).sum(-1)
    v = (normal * torch.linalg.cross(q, o)).sum(-1)
    inside = (u > 0) & (v > 0) & (u + v < square)
    u, v = (c / square.clamp_min(1e-300) for c in (u, v))
    weights.append(torch.stack([u, v, 1.0 - u - v], dim=-1))
    weights = torch.cat(weights, dim=1)
    index = torch.cat([torch.cat([SEGMENTS, SEGMENTS[:, :1]], dim=1), TRIANGLES]).to(x.device)
    size = torch.linalg.vector_norm(torch.einsum("esk,eski->esi", weights, x[:, index]), dim=-1)
    size[:, len(SEGMENTS) :] = torch.where(inside, size[:, len(SEGMENTS) :], torch.inf)
    best = size.argmin(1)
    rows = torch.arange(len(x), device=x.device)
    chosen = corners[rows[:, None], index[best]]
    return chosen, torch.einsum("ek,ekpi->epi", weights[rows, best], chosen)
