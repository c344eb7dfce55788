"""Exact penetration depth of two convex parts: the separating-axis search of distance/sat.py as Warp functions."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes

__all__ = ["sat"]

FACES = 256
"""Faces of A of which it is kept what put them out; at those beyond it is looked for again."""
REMEMBERED = 64
"""Points of B that are kept."""
ROUNDS = 64
"""Most splits of an arc; it takes one for each vertex that comes foremost along the arc, and a few at most."""
DEPTH = 24
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
        # points of B in the frame of A that have put a face of A out; a face is put out by one that is deep enough below
        deep = wp.zeros(shape=(REMEMBERED,), dtype=vec3)
        seen = wp.zeros(shape=(FACES,), dtype=wp.int32)
        start_a = parts.normal_start[pair.a]
        deep[0] = pair.R * parts.middle[pair.b] + pair.t
        deep[1] = point_b(parts, pair, lowest_b(parts, pair, normal))
        known = int(2)
        last = int(1)
        for f in range(parts.normal_start[pair.a + 1] - start_a):
            n = parts.normals[start_a + f]
            level = parts.offsets[start_a + f] + best
            if wp.dot(n, deep[last]) > level:
                last = 0
                if wp.dot(n, deep[0]) > level:
                    last = 1
                    if wp.dot(n, deep[1]) > level:
                        low = point_b(parts, pair, lowest_b(parts, pair, n))
                        g = wp.dot(n, low) - parts.offsets[start_a + f]
                        if g > best:
                            best = g
                            best_normal = n
                        last = wp.min(known, REMEMBERED - 1)
                        deep[last] = low
                        known = known + 1
            if f < FACES:
                seen[f] = last
        back = wp.transpose(pair.R)
        high = back * (parts.vertices[farthest(parts, pair.a, best_normal)] - pair.t)
        center = back * (parts.middle[pair.a] - pair.t)
        for f in range(parts.normal_start[pair.b], parts.normal_start[pair.b + 1]):
            m = parts.normals[f]
            level = parts.offsets[f] + best
            if wp.dot(m, high) > level and wp.dot(m, center) > level:
                direction = -(pair.R * m)
                high = back * (parts.vertices[farthest(parts, pair.a, direction)] - pair.t)
                g = wp.dot(m, high) - parts.offsets[f]
                if g > best:
                    best = g
                    best_normal = direction
        if best <= real(0.0):
            stack_n0 = wp.zeros(shape=(DEPTH,), dtype=vec3)
            stack_n1 = wp.zeros(shape=(DEPTH,), dtype=vec3)
            stack_b0 = wp.zeros(shape=(DEPTH,), dtype=vec3)
            stack_b1 = wp.zeros(shape=(DEPTH,), dtype=vec3)
            for e in range(parts.edge_start[pair.a], parts.edge_start[pair.a + 1]):
                edge = parts.edges[e]
                remembered = int(0)
                if wp.max(edge[2], edge[3]) < FACES and known <= REMEMBERED:
                    remembered = 1
                    if seen[edge[2]] == seen[edge[3]]:
                        continue  # it bounds the whole arc
                anchor = parts.vertices[parts.vertex_start[pair.a] + edge[0]]
                stack_n0[0] = parts.normals[start_a + edge[2]]
                stack_n1[0] = parts.normals[start_a + edge[3]]
                if remembered == 1:
                    stack_b0[0] = deep[seen[edge[2]]]
                    stack_b1[0] = deep[seen[edge[3]]]
                else:
                    stack_b0[0] = point_b(parts, pair, lowest_b(parts, pair, stack_n0[0]))
                    stack_b1[0] = point_b(parts, pair, lowest_b(parts, pair, stack_n1[0]))
                waiting = int(1)
                rounds = int(0)
                while waiting > 0 and rounds < ROUNDS:
                    rounds = rounds + 1
                    waiting = waiting - 1
                    n0 = stack_n0[waiting]
                    n1 = stack_n1[waiting]
                    b0 = stack_b0[waiting]
                    b1 = stack_b1[waiting]
                    # n·(b0 - anchor) and n·(b1 - anchor) bound the gap along the arc; each is ≤ best at its own end, and
                    # where it is negative at both ends of an arc it is greatest at one of them
                    rise = wp.dot(n1, b0 - anchor)
                    fall = wp.dot(n0, b1 - anchor)
                    if rise > best + negligible and fall > best + negligible and waiting + 2 <= DEPTH:
                        rise = rise - wp.dot(n1, b1 - anchor)
                        fall = fall - wp.dot(n0, b0 - anchor)
                        middle = rise * n0 + fall * n1  # where b0 and b1 are equally far
                        length = wp.length(middle)
                        if rise > negligible and fall > negligible and length > tiny:
                            middle = middle / length
                            if wp.dot(middle, b0 - anchor) > best + negligible:
                                low = point_b(parts, pair, lowest_b(parts, pair, middle))
                                g = wp.dot(middle, low - anchor)
                                if g > best:
                                    # slivers have poor normals, whose arcs may leave the edge's own
                                    g = wp.dot(middle, low - parts.vertices[farthest(parts, pair.a, middle)])
                                    if g > best:
                                        best = g
                                        best_normal = middle
                                stack_n0[waiting] = n0
                                stack_n1[waiting] = middle
                                stack_b0[waiting] = b0
                                stack_b1[waiting] = low
                                stack_n0[waiting + 1] = middle
                                stack_n1[waiting + 1] = n1
                                stack_b0[waiting + 1] = low
                                stack_b1[waiting + 1] = b1
                                waiting = waiting + 2
        out = Axis()
        out.gap = best
        out.normal = best_normal
        return out

    return SimpleNamespace(**locals())
