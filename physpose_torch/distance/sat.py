"""Exact penetration depth of convex parts: the largest gap over all facet normals of their Minkowski difference."""

from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch.geometry.convex import ConvexParts

__all__ = ["separating_axis"]

CHUNK = 64
"""Pairs at a time; keeps the faces-against-vertices table in the processor's cache."""
NEGLIGIBLE = 1e-14
"""[m]; an arc that can add no more than this to the gap is not followed."""
ROUNDS = 64
"""Most splits of an arc; it takes one for each vertex that comes foremost along the arc, and a few at most."""


def separating_axis(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Largest gap over all facet normals of the Minkowski difference B - A, and the normal that attains it.

    These normals are the faces of A, the faces of B, and n = e_a × e_b for the edges whose arcs cross on the Gauss
    sphere (Gottschalk 2000; Gregorius 2013). Instead of trying all pairs of edges, every arc of A is searched by
    branch and bound: on an arc from n0 to n1, where v0 and v1 of B are foremost, and that belongs to an edge through
    p of A, the gap n·(v(n) - p) is at most the lesser of n·(v0 - p) and n·(v1 - p), which meet in one direction. Only
    arcs whose bound beats the best gap so far are split there.

    Args:
        parts: convex parts.
        pairs: (E, 2) indices of parts a and b.
        R: (E, 3, 3), t: (E, 3), pose of b in the frame of a [m].

    Returns:
        gap (E,) [m] and unit normal (E, 3) from a to b, in the frame of a. A gap below zero is the exact signed
        distance; where it is positive, the parts are apart by at least that much.
    """
    if len(pairs) == 0:
        return t.new_zeros(0), t.new_zeros(0, 3)
    chunks = [slice(i, i + CHUNK) for i in range(0, len(pairs), CHUNK)]
    gaps, normals = zip(*(_separating_axis(parts, pairs[c], R[c], t[c]) for c in chunks), strict=True)
    return torch.cat(gaps), torch.cat(normals)


class _Arcs(NamedTuple):
    """Arcs of directions around edges of A, (M, ...) each."""

    pair: Tensor
    anchor: Tensor
    """A vertex p of the edge."""
    n0: Tensor
    n1: Tensor
    v0: Tensor
    """Vertex of B that is foremost along n0; v1 along n1."""
    v1: Tensor


def _separating_axis(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    a, b = pairs.unbind(1)
    B = parts.padded[b] @ R.mT + t[:, None]
    low_b, foremost = (parts.face_normals[a] @ B.mT).min(2)
    low_a = (parts.face_normals[b] @ ((parts.padded[a] - t[:, None]) @ R).mT).amin(2)
    gap, best = torch.cat([low_b - parts.face_offsets[a], low_a - parts.face_offsets[b]], dim=1).max(1)
    rows, n_faces = torch.arange(len(pairs), device=t.device), parts.face_normals.shape[1]
    from_b = -(R @ parts.face_normals[b, best - n_faces, :, None])[:, :, 0]
    normal = torch.where((best < n_faces)[:, None], parts.face_normals[a, best % n_faces], from_b)

    # the same vertex foremost at both ends: the gap is linear along the arc, its ends have been looked at
    side = parts.edge_faces[a]
    vertex = foremost[rows[:, None, None], side]
    pair, edge = ((vertex[:, :, 0] != vertex[:, :, 1]) & (gap <= 0)[:, None]).nonzero(as_tuple=True)
    side, vertex, part = side[pair, edge], vertex[pair, edge], a[pair]
    arcs = _Arcs(
        pair,
        parts.padded[part, parts.edge_vertices[part, edge, 0]],
        *parts.face_normals[part[:, None], side].unbind(1),
        *B[pair[:, None], vertex].unbind(1),
    )
    for _ in range(ROUNDS):
        arcs, middle = _promising(arcs, gap)
        if len(middle) == 0:
            break
        low_b, foremost = (B[arcs.pair] @ middle[:, :, None])[:, :, 0].min(1)
        found = low_b - (middle * arcs.anchor).sum(-1)
        better = (found > gap[arcs.pair]).nonzero()[:, 0]
        gap = gap.scatter_reduce(0, arcs.pair, found, "amax")
        best = better[found[better] == gap[arcs.pair[better]]]
        # of equals the first, always the same
        first = torch.full_like(rows, len(found)).scatter_reduce(0, arcs.pair[best], best, "amin")
        improved = (first < len(found)).nonzero()[:, 0]
        normal[improved] = middle[first[improved]]
        vertex = B[arcs.pair, foremost]
        halves = arcs._replace(n1=middle, v1=vertex), arcs._replace(n0=middle, v0=vertex)
        arcs = _Arcs(*(torch.cat(x) for x in zip(*halves, strict=True)))
    return gap, normal


def _promising(arcs: _Arcs, gap: Tensor) -> tuple[_Arcs, Tensor]:
    """The arcs that may hold more than the best gap of their pair, and the unit direction (M, 3) where they may."""
    across = arcs.v1 - arcs.v0
    at_0, at_1 = ((n * across).sum(-1, keepdim=True).abs() for n in (arcs.n0, arcs.n1))
    middle = at_1 * arcs.n0 + at_0 * arcs.n1  # where v0 and v1 are equally far
    middle = middle / torch.linalg.vector_norm(middle, dim=-1, keepdim=True).clamp_min(1e-300)
    bound = (middle * (arcs.v0 - arcs.anchor)).sum(-1)
    # a vertex that is hardly ahead of the other at its own end adds hardly more than that to what the ends have
    bent = torch.minimum(at_0, at_1)[:, 0] > NEGLIGIBLE
    keep = (bent & (bound > gap[arcs.pair] + NEGLIGIBLE)).nonzero()[:, 0]
    return _Arcs(*(x[keep] for x in arcs)), middle[keep]
