"""Closest points of two convex parts that are apart (Gilbert, Johnson and Keerthi 1988), as Warp functions."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes

__all__ = ["gjk"]

STEPS = 64
APART, UNSURE, INSIDE = 0, 1, 2


@functools.cache
def gjk(real: type) -> SimpleNamespace:
    """Functions in ``wp.float32`` or ``wp.float64``."""
    s = shapes(real)
    vec3, Parts, Pair, farthest, lowest_b, point_b = s.vec3, s.Parts, s.Pair, s.farthest, s.lowest_b, s.point_b
    vec4 = wp.types.vector(4, real)
    mat43 = wp.types.matrix((4, 3), real)
    tolerance = real(1e-12 if real is wp.float64 else 0.0)
    zero = real(0.0)
    rounding = real(1e-15 if real is wp.float64 else 1e-6)

    @wp.struct
    class Simplex:
        """Points of B - A as rows, each with the vertices it comes from, and the weights of the point nearest to 0."""

        points: mat43
        a: wp.vec4i
        b: wp.vec4i
        weights: vec4
        size: wp.int32
        nearest: vec3
        inside: wp.int32

    @wp.struct
    class Closest:
        """What is known of a distance: ``gap`` along ``normal`` ≤ distance ≤ ``length`` between ``a`` and ``b``."""

        status: wp.int32
        gap: real
        normal: vec3
        length: real
        a: vec3
        b: vec3

    @wp.func
    def _det(a: vec3, b: vec3, c: vec3):
        return wp.dot(a, wp.cross(b, c))

    @wp.func
    def reduce(x: Simplex):
        """Drop the points that do not carry the nearest one; the last of them is new, and certain to carry it.

        All edges and triangles at the new point are tried, rather than Johnson's recursion, which fails near contact.
        """
        n = x.size - 1
        o = x.points[n]
        best = wp.dot(o, o)
        i1 = int(-1)
        i2 = int(-1)
        w1 = real(0.0)
        w2 = real(0.0)
        nearest = o
        for i in range(n):
            p = x.points[i]
            along = p - o
            square = wp.dot(along, along)
            u = -wp.dot(o, along)
            if u > real(0.0) and u < square:
                u = u / square
                q = o + u * along
                d = wp.dot(q, q)
                if d < best:
                    best = d
                    i1 = i
                    i2 = -1
                    w1 = u
                    w2 = real(0.0)
                    nearest = q
            for j in range(i + 1, n):
                q = x.points[j]
                normal = wp.cross(along, q - o)
                square = wp.dot(normal, normal)
                u = wp.dot(normal, wp.cross(q, o))
                v = wp.dot(normal, wp.cross(o, p))
                if u > real(0.0) and v > real(0.0) and u + v < square:
                    u = u / square
                    v = v / square
                    r = (wp.dot(normal, o) / square) * normal  # more exact than from the weights
                    d = wp.dot(r, r)
                    if d < best:
                        best = d
                        i1 = i
                        i2 = j
                        w1 = u
                        w2 = v
                        nearest = r
        out = Simplex()
        out.inside = 0
        if n == 3:
            p = x.points[0]
            q = x.points[1]
            r = x.points[2]
            d0 = _det(q, r, o)
            d1 = -_det(p, r, o)
            d2 = _det(p, q, o)
            d3 = -_det(p, q, r)
            if (d0 > real(0.0) and d1 > real(0.0) and d2 > real(0.0) and d3 > real(0.0)) or (
                d0 < real(0.0) and d1 < real(0.0) and d2 < real(0.0) and d3 < real(0.0)
            ):
                out.inside = 1
        out.points[0] = o
        out.a[0] = x.a[n]
        out.b[0] = x.b[n]
        out.size = 1
        if i1 >= 0:
            out.points[1] = x.points[i1]
            out.a[1] = x.a[i1]
            out.b[1] = x.b[i1]
            out.size = 2
        if i2 >= 0:
            out.points[2] = x.points[i2]
            out.a[2] = x.a[i2]
            out.b[2] = x.b[i2]
            out.size = 3
        out.weights = vec4(real(1.0) - w1 - w2, w1, w2, real(0.0))
        out.nearest = nearest
        return out

    @wp.func
    def closest(parts: Parts, pair: Pair, start: vec3, enough: real, thorough: wp.int32):
        """Closest points of a pair, from a first guess of the normal.

        Stops early when a direction shows a gap of at least half the distance and more than ``enough``; a ``thorough`` search
        otherwise goes on until rounding stops it.

        ``status``: APART: known to rounding, or ``gap`` > ``enough``. INSIDE: B - A seems to hold the origin. UNSURE:
        rounding stopped the iteration.
        """
        out = Closest()
        out.normal = start
        x = Simplex()
        x.a[0] = farthest(parts, pair.a, start)
        x.b[0] = lowest_b(parts, pair, start)
        x.points[0] = point_b(parts, pair, x.b[0]) - parts.vertices[x.a[0]]
        x.weights = vec4(real(1.0), real(0.0), real(0.0), real(0.0))
        x.size = 1
        x.nearest = x.points[0]
        out.gap = wp.dot(start, x.nearest)
        out.status = UNSURE
        accuracy = wp.max(tolerance, rounding * wp.length(x.nearest))
        if thorough == 1:
            accuracy = zero
        for _ in range(STEPS):
            length = wp.length(x.nearest)
            out.length = length
            if length <= accuracy:
                break
            if length - out.gap <= accuracy:
                out.status = APART
                break
            if out.gap > enough and real(2.0) * out.gap >= length:
                out.status = APART
                break
            direction = x.nearest / length
            a = farthest(parts, pair.a, direction)
            b = lowest_b(parts, pair, direction)
            w = point_b(parts, pair, b) - parts.vertices[a]
            gap = wp.dot(direction, w)
            if gap > out.gap:
                out.gap = gap
                out.normal = direction
            if length - out.gap <= accuracy:
                out.status = APART
                break
            stuck = int(0)
            for i in range(x.size):
                if x.a[i] == a and x.b[i] == b:
                    stuck = 1
            if stuck == 1:
                break
            x.points[x.size] = w
            x.a[x.size] = a
            x.b[x.size] = b
            x.size = x.size + 1
            smaller = reduce(x)
            if smaller.inside == 1:
                out.status = INSIDE
                break
            if wp.dot(smaller.nearest, smaller.nearest) >= length * length:
                x.size = x.size - 1
                break
            x = smaller
        for i in range(x.size):
            if i < 3:  # a tetrahedron around the origin has no nearest point
                out.a += x.weights[i] * parts.vertices[x.a[i]]
                out.b += x.weights[i] * point_b(parts, pair, x.b[i])
        return out

    return SimpleNamespace(**locals())
