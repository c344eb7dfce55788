"""Exact penetration depth of convex parts: the separating-axis theorem over the facets of their Minkowski difference."""

import torch
from torch import Tensor

from physpose_torch.distance.support import gap_along
from physpose_torch.geometry.convex import ConvexParts

__all__ = ["separating_axis"]

CHUNK = 16
"""Pairs at a time; keeps the all-against-all edge table in the processor's cache."""


def separating_axis(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Largest gap over all facet normals of the Minkowski difference B - A, and the normal that attains it.

    These normals are the faces of A, the faces of B, and n = e_a × e_b for the edges whose arcs cross on the Gauss
    sphere (Gottschalk 2000; Gregorius 2013). Where the gap is negative it is the exact signed distance; where it is
    positive the parts are apart by at least that much.

    Args:
        parts: convex parts.
        pairs: (E, 2) indices of parts a and b.
        R: (E, 3, 3), t: (E, 3), pose of b in the frame of a [m].

    Returns:
        gap (E,) [m] and unit normal (E, 3) from a to b, in the frame of a.
    """
    if len(pairs) == 0:
        return t.new_zeros(0), t.new_zeros(0, 3)
    chunks = [slice(i, i + CHUNK) for i in range(0, len(pairs), CHUNK)]
    gaps, normals = zip(*(_separating_axis(parts, pairs[c], R[c], t[c]) for c in chunks), strict=True)
    return torch.cat(gaps), torch.cat(normals)


def _separating_axis(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    a, b = pairs.unbind(1)
    normals = torch.cat([parts.face_normals[a], -(parts.face_normals[b] @ R.mT)], dim=1)
    gap, best = gap_along(parts, pairs, R, t, normals).max(1)
    normal = normals[torch.arange(len(pairs), device=t.device), best]

    # A's edge is the arc (a0, a1) on the Gauss sphere, B's edge in B - A the arc (-b0, -b1); they cross where each
    # arc's ends lie on different sides of the other's great circle, and on the same hemisphere
    ends_a, ends_b = parts.edge_ends[a], parts.edge_ends[b] @ R.mT[:, None] + t[:, None, None]
    arc_a, arc_b = parts.edge_normals[a], -(parts.edge_normals[b] @ R.mT[:, None])
    circle_a = torch.linalg.cross(arc_a[:, :, 0], arc_a[:, :, 1])
    circle_b = torch.linalg.cross(arc_b[:, :, 0], arc_b[:, :, 1])
    b0, b1 = circle_a @ arc_b[:, :, 0].mT, circle_a @ arc_b[:, :, 1].mT
    a0, a1 = arc_a[:, :, 0] @ circle_b.mT, arc_a[:, :, 1] @ circle_b.mT
    crossing = (b0 * b1 < 0) & (a0 * a1 < 0) & (b0 * a1 > 0)
    pair, i, j = crossing.nonzero(as_tuple=True)
    if len(pair) == 0:
        return gap, normal
    point_a, point_b = ends_a[pair, i, 0], ends_b[pair, j, 0]
    axis = torch.linalg.cross(ends_a[pair, i, 1] - point_a, ends_b[pair, j, 1] - point_b)
    length = torch.linalg.vector_norm(axis, dim=-1)
    axis = axis / length.clamp_min(1e-300)[:, None]
    axis = axis * torch.where((axis * (arc_a[pair, i, 0] + arc_a[pair, i, 1])).sum(-1) < 0, -1.0, 1.0)[:, None]
    edge_gap = torch.where(length > 0, (axis * (point_b - point_a)).sum(-1), -torch.inf)
    rows = torch.arange(len(pairs), device=t.device)
    while True:
        best_gap = edge_gap.new_full((len(pairs),), -torch.inf).scatter_reduce(0, pair, edge_gap, "amax")
        wins = best_gap > gap
        if not bool(wins.any()):
            return gap, normal
        winner = ((edge_gap == best_gap[pair]) & wins[pair]).nonzero()[:, 0]
        which = torch.zeros_like(rows).scatter(0, pair[winner], winner)[wins]
        # where arcs all but coincide, rounding invents crossings; the gap along their normal tells
        truth = gap_along(parts, pairs[wins], R[wins], t[wins], axis[which][:, None])[:, 0]
        gap[wins], normal[wins] = _better(gap[wins], normal[wins], truth, axis[which])
        edge_gap = edge_gap.scatter(0, which, -torch.inf)


def _better(gap: Tensor, normal: Tensor, other_gap: Tensor, other_normal: Tensor) -> tuple[Tensor, Tensor]:
    better = other_gap > gap
    return torch.where(better, other_gap, gap), torch.where(better[:, None], other_normal, normal)
