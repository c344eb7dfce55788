"""How far one convex part can move along a direction before it meets another: a ray against B - A, as Warp functions."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes

__all__ = ["drop"]

STEPS = 64
MISSES, HITS = 0, 1


@functools.cache
def drop(real: type) -> SimpleNamespace:
    """Functions in ``wp.float32`` or ``wp.float64``."""
    s = shapes(real)
    vec3, Parts, Pair, farthest, lowest_b, point_b = s.vec3, s.Parts, s.Pair, s.farthest, s.lowest_b, s.point_b
    tolerance = real(1e-13 if real is wp.float64 else 0.0)
    rounding = real(1e-15 if real is wp.float64 else 1e-6)
    grazing = real(1e-9 if real is wp.float64 else 1e-5)

    @wp.struct
    class Corner:
        """A point of B - A and the vertices it comes from."""

        x: vec3
        a: wp.int32
        b: wp.int32

    @wp.struct
    class Fall:
        """Where the ray enters: after ``height``, through a facet with normal ``normal`` from a to b."""

        status: wp.int32
        height: real
        normal: vec3
        a: vec3
        b: vec3
        aside: real
        """The ray misses by at least this much; neither part falls onto the other then."""

    @wp.func
    def lowest(parts: Parts, pair: Pair, direction: vec3):
        """The corner of B - A that lies least far along a direction."""
        out = Corner()
        out.a = farthest(parts, pair.a, direction)
        out.b = lowest_b(parts, pair, direction)
        out.x = point_b(parts, pair, out.b) - parts.vertices[out.a]
        return out

    @wp.func
    def sideways(x: vec3, gravity: vec3):
        return x - wp.dot(x, gravity) * gravity

    @wp.func
    def turn(x: vec3, y: vec3, gravity: vec3):
        """Twice the area of the triangle (0, x, y), seen along gravity."""
        return wp.dot(gravity, wp.cross(x, y))

    @wp.func
    def fall(parts: Parts, pair: Pair, gravity: vec3):
        """How far part a can move along a unit vector (in its own frame) before it meets part b.

        The ray s·gravity enters the polytope B - A at the height h = max over n·gravity > 0 of gap(n) / (n·gravity). A
        triangle of its corners that the ray goes through is found by GJK in the plane across gravity, then the triangle
        is pushed against the ray until it is a facet (portal refinement; Snethen 2008). Heights below zero mean that the
        parts overlap, or that a has passed b.
        """
        out = Fall()
        out.status = MISSES
        # a triangle seen by the ray
        c0 = lowest(parts, pair, gravity)
        direction = sideways(c0.x, gravity)
        scale = wp.length(c0.x)
        c1 = c0
        c2 = c0
        found = int(0)
        if wp.length(direction) <= rounding * scale:  # the ray goes through the corner: any side will do
            axis = vec3(real(1.0), real(0.0), real(0.0))
            if wp.abs(gravity[0]) > real(0.6):
                axis = vec3(real(0.0), real(1.0), real(0.0))
            direction = wp.cross(gravity, axis)
        c1 = lowest(parts, pair, direction)
        scale = wp.max(scale, wp.length(c1.x))
        slack = -rounding * scale * scale
        possible = int(1)
        if wp.dot(direction, c1.x) > real(0.0):
            possible = 0
            out.aside = wp.dot(direction, c1.x) / wp.length(direction)
        if possible == 1:
            direction = wp.cross(gravity, c1.x - c0.x)
            if wp.dot(direction, c0.x) < real(0.0):
                direction = -direction
            c2 = lowest(parts, pair, direction)
            for _ in range(STEPS):
                # c2 is the farthest across the edge c0 c1, on whose other side the ray is
                if wp.dot(direction, c2.x) > real(0.0):
                    out.aside = wp.dot(direction, c2.x) / wp.length(direction)
                    break
                if turn(c1.x - c0.x, c2.x - c0.x, gravity) < real(0.0):
                    swap = c0
                    c0 = c1
                    c1 = swap
                inner = turn(c1.x, c2.x, gravity)
                outer = turn(c2.x, c0.x, gravity)
                if inner >= slack and outer >= slack:
                    found = 1
                    break
                if inner < outer:
                    c0 = c2
                else:
                    c1 = c2
                direction = wp.cross(gravity, c1.x - c0.x)
                if wp.dot(direction, c0.x) < real(0.0):
                    direction = -direction
                size = wp.length(direction)
                if size <= rounding * scale:
                    break
                direction = direction / size
                c2 = lowest(parts, pair, direction)
                if wp.dot(direction, c0.x - c2.x) <= rounding * scale:
                    break
        if found == 1:
            # pushed against the ray
            for _ in range(STEPS):
                normal = wp.cross(c1.x - c0.x, c2.x - c0.x)
                size = wp.length(normal)
                if size <= real(1e-30):
                    found = 0
                    break
                normal = normal / size
                slope = wp.dot(normal, gravity)
                if slope < real(0.0):
                    normal = -normal
                    slope = -slope
                if slope <= grazing:
                    found = 0
                    break
                level = wp.dot(normal, c0.x)
                out.normal = normal
                out.height = level / slope
                c3 = lowest(parts, pair, normal)
                if level - wp.dot(normal, c3.x) <= wp.max(tolerance, rounding * scale):
                    break
                s0 = turn(c3.x, c0.x, gravity)
                s1 = turn(c3.x, c1.x, gravity)
                s2 = turn(c3.x, c2.x, gravity)
                # of the three triangles at c3 one that the ray goes through; through an edge, it goes through two, and the
                # smaller one may be none, seen along the ray
                m0 = wp.min(s0, -s1)
                m1 = wp.min(s1, -s2)
                m2 = wp.min(s2, -s0)
                least = wp.min(wp.max(wp.max(m0, m1), m2), slack)
                area0 = real(-1.0)
                area1 = real(-1.0)
                area2 = real(-1.0)
                if m0 >= least:
                    area0 = turn(c0.x, c1.x, gravity) - s1 + s0
                if m1 >= least:
                    area1 = turn(c1.x, c2.x, gravity) - s2 + s1
                if m2 >= least:
                    area2 = turn(c2.x, c0.x, gravity) - s0 + s2
                if area0 >= area1 and area0 >= area2:
                    c2 = c3
                elif area1 >= area2:
                    c0 = c3
                else:
                    c1 = c3
        if found == 1:
            w0 = wp.max(turn(c1.x, c2.x, gravity), real(0.0))
            w1 = wp.max(turn(c2.x, c0.x, gravity), real(0.0))
            w2 = wp.max(turn(c0.x, c1.x, gravity), real(0.0))
            total = w0 + w1 + w2
            if total > real(0.0):
                out.status = HITS
                out.a = (w0 * parts.vertices[c0.a] + w1 * parts.vertices[c1.a] + w2 * parts.vertices[c2.a]) / total
                out.b = (
                    w0 * point_b(parts, pair, c0.b) + w1 * point_b(parts, pair, c1.b) + w2 * point_b(parts, pair, c2.b)
                ) / total
        return out

    return SimpleNamespace(**locals())
