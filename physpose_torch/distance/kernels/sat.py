"""Exact penetration depth of two convex parts: the separating-axis search of distance/sat.py as Warp functions."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes

__all__ = ["sat"]

REMEMBERED = 256
"""Faces of A whose culling vertex is kept; at those beyond it is looked for again."""
DEPTH = 32
"""Most halves of an arc that wait their turn."""


@functools.cache
def sat(real: type) -> SimpleNamespace:
    """Functions in ``wp.float32`` or ``wp.float64``."""
    s = shapes(real)
    vec3, Parts, Pair, farthest, lowest_b, point_b = s.vec3, s.Parts, s.Pair, s.farthest, s.lowest_b, s.point_b
    negligible = real(1e-14 if real is wp.float64 else 1e-8)
    tiny = real(1e-30)

    @wp.struct
    class Axis:
        gap: real
        normal: vec3

    @wp.func
    def separating_axis(parts: Parts, pair: Pair, gap: real, normal: vec3):
        """Largest gap over all facet normals of B - A, not less than a ``gap`` that is known along ``normal``.

        A gap of zero or less is the exact signed distance; above zero, the parts are apart by at least that much. Every
        candidate is first held against one vertex that put an earlier one out; most go no further.
        """
        best = gap
        best_normal = normal
        seen = wp.zeros(shape=(REMEMBERED,), dtype=wp.int32)
        start_a = parts.normal_start[pair.a]
        faces_a = parts.normal_start[pair.a + 1] - start_a
        last = lowest_b(parts, pair, normal)
        low = point_b(parts, pair, last)
        for f in range(faces_a):
            n = parts.normals[start_a + f]
            offset = parts.offsets[start_a + f]
            if wp.dot(n, low) - offset > best:
                last = lowest_b(parts, pair, n)
                low = point_b(parts, pair, last)
                g = wp.dot(n, low) - offset
                if g > best:
                    best = g
                    best_normal = n
            if f < REMEMBERED:
                seen[f] = last
        back = wp.transpose(pair.R)
        high = back * (parts.vertices[farthest(parts, pair.a, best_normal)] - pair.t)
        for f in range(parts.normal_start[pair.b], parts.normal_start[pair.b + 1]):
            m = parts.normals[f]
            if wp.dot(m, high) - parts.offsets[f] > best:
                direction = -(pair.R * m)
                a = farthest(parts, pair.a, direction)
                high = back * (parts.vertices[a] - pair.t)
                g = wp.dot(m, high) - parts.offsets[f]
                if g > best:
                    best = g
                    best_normal = direction
        if best <= real(0.0):
            stack_n0 = wp.zeros(shape=(DEPTH,), dtype=vec3)
            stack_n1 = wp.zeros(shape=(DEPTH,), dtype=vec3)
            stack_v0 = wp.zeros(shape=(DEPTH,), dtype=wp.int32)
            stack_v1 = wp.zeros(shape=(DEPTH,), dtype=wp.int32)
            for e in range(parts.edge_start[pair.a], parts.edge_start[pair.a + 1]):
                edge = parts.edges[e]
                anchor = parts.vertices[pair.first_a + edge[0]]
                stack_n0[0] = parts.normals[start_a + edge[2]]
                stack_n1[0] = parts.normals[start_a + edge[3]]
                waiting = int(1)
                if wp.max(edge[2], edge[3]) < REMEMBERED:
                    stack_v0[0] = seen[edge[2]]
                    stack_v1[0] = seen[edge[3]]
                    if stack_v0[0] == stack_v1[0]:  # it bounds the whole arc
                        waiting = 0
                else:
                    stack_v0[0] = lowest_b(parts, pair, stack_n0[0])
                    stack_v1[0] = lowest_b(parts, pair, stack_n1[0])
                while waiting > 0:
                    waiting = waiting - 1
                    n0 = stack_n0[waiting]
                    n1 = stack_n1[waiting]
                    v0 = stack_v0[waiting]
                    v1 = stack_v1[waiting]
                    p0 = point_b(parts, pair, v0) - anchor
                    p1 = point_b(parts, pair, v1) - anchor
                    # n·p0 and n·p1 bound the gap along the arc; each is ≤ best at its own end, and where it is negative at
                    # both ends of an arc it is greatest at one of them
                    a0 = wp.dot(n0, p0)
                    b0 = wp.dot(n1, p0)
                    a1 = wp.dot(n0, p1)
                    b1 = wp.dot(n1, p1)
                    if wp.min(wp.max(a0, b0), wp.max(a1, b1)) > best + negligible:
                        fall = a1 - a0
                        rise = b0 - b1
                        if fall > negligible and rise > negligible and waiting + 2 <= DEPTH:
                            middle = rise * n0 + fall * n1  # where v0 and v1 are equally far
                            length = wp.length(middle)
                            if length > tiny:
                                middle = middle / length
                                if wp.dot(middle, p0) > best + negligible:
                                    v = lowest_b(parts, pair, middle)
                                    g = wp.dot(middle, point_b(parts, pair, v) - anchor)
                                    if g > best:
                                        # slivers have poor normals, whose arcs may leave the edge's own
                                        a = farthest(parts, pair.a, middle)
                                        g = g - wp.dot(middle, parts.vertices[a] - anchor)
                                        if g > best:
                                            best = g
                                            best_normal = middle
                                    stack_n0[waiting] = n0
                                    stack_n1[waiting] = middle
                                    stack_v0[waiting] = v0
                                    stack_v1[waiting] = v
                                    stack_n0[waiting + 1] = middle
                                    stack_n1[waiting + 1] = n1
                                    stack_v0[waiting + 1] = v
                                    stack_v1[waiting + 1] = v1
                                    waiting = waiting + 2
        out = Axis()
        out.gap = best
        out.normal = best_normal
        return out

    return SimpleNamespace(**locals())
