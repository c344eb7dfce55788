"""Signed and drop distances of part pairs: the Warp functions that put the pieces together, and their kernels."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.drop import HITS, drop
from physpose_torch.distance.kernels.gjk import APART, INSIDE, gjk
from physpose_torch.distance.kernels.sat import sat
from physpose_torch.distance.kernels.shapes import shapes
from physpose_torch.distance.kernels.smooth import smooth

__all__ = ["OPTIONS", "pairs"]

OPTIONS = {"enable_backward": False, "max_unroll": 1, "cpu_compiler_flags": "-march=native"}
"""Of Warp modules: what adjoints, unrolled loops and inlining without end gain, they lose in time to compile."""
PULL = 2e-3
"""[m]; parts that overlap are pulled this far apart along their normal to find their witness points."""
CONTACT = 1e-9
"""[m]; a falling part has arrived when it is this near."""
GRAZING = 1e-3
"""Least n·g that the gradient of a drop is divided by."""


@functools.cache
def pairs(real: type) -> SimpleNamespace:
    """Functions and kernels in ``wp.float32`` or ``wp.float64``."""
    s, m = shapes(real), smooth(real)
    vec3, mat33, mat44, Parts, Pair = s.vec3, s.mat33, s.mat44, s.Parts, s.Pair
    make_pair, across, rotation, translation, orthonormal = (
        s.make_pair,
        s.across,
        s.rotation,
        s.translation,
        s.orthonormal,
    )
    closest, separating_axis, fall = gjk(real).closest, sat(real).separating_axis, drop(real).fall
    Wobble, Points, smoothed = m.Wobble, m.Points, m.smoothed
    module = wp.get_module(f"physpose_torch.{real.__name__}")
    module.options |= OPTIONS
    never = real(float("inf"))
    gap_along = s.gap_along
    touching = real(1e-12 if real is wp.float64 else 1e-6)
    arrived = real(CONTACT if real is wp.float64 else 1e-7)

    @wp.struct
    class Distance:
        """Signed distance of a pair, normal from a to b, witness points; in the frame of a."""

        value: real
        normal: vec3
        a: vec3
        b: vec3

    @wp.struct
    class Drop:
        """How far a part falls, and whether it falls any less or more when it moves."""

        height: real
        normal: vec3
        a: vec3
        b: vec3
        lands: wp.int32

    @wp.func
    def moved(pair: Pair, shift: vec3):
        """The pair with b moved."""
        return make_pair(pair.a, pair.b, pair.R, pair.t + shift)

    @wp.func
    def distance(parts: Parts, pair: Pair, hint: vec3, overlapping: wp.int32, enough: real, witness: wp.int32):
        """Signed distance; where it is surely above ``enough``, a lower bound of at least half of it will do.

        ``hint`` is a guess of the normal; parts that are thought to be ``overlapping`` are tried for that first. Witness
        points of parts that overlap cost another search; they are left out unless asked for.
        """
        out = Distance()
        start = hint
        gap = gap_along(parts, pair, hint)
        status = int(INSIDE)
        seen_apart = int(0)
        if overlapping == 0 or gap > touching:
            near = closest(parts, pair, hint, enough, 0)
            seen_apart = 1
            status = near.status
            gap = near.gap
            start = near.normal
            out.value = near.length
            if status == APART and near.gap > enough:
                out.value = near.gap
            out.normal = near.normal
            out.a = near.a
            out.b = near.b
        if status != APART:
            axis = separating_axis(parts, pair, gap, start)
            if axis.gap <= touching:
                # a hair's breadth apart, their nearest features are the ones that face each other along the axis
                out.value = axis.gap
                out.normal = axis.normal
                if witness == 1:
                    pull = (real(PULL) - axis.gap) * axis.normal
                    facing = closest(parts, moved(pair, pull), axis.normal, never, 1)
                    out.a = facing.a
                    out.b = facing.b - pull
            else:
                # rounding misled the first search, or there was none; this one starts where they are surely apart
                near = closest(parts, pair, axis.normal, enough, 1)
                out.normal = axis.normal
                if near.gap > axis.gap:
                    out.normal = near.normal
                if seen_apart == 0 or near.length < out.value or status == INSIDE:
                    out.value = near.length
                    out.a = near.a
                    out.b = near.b
                if wp.max(near.gap, axis.gap) > enough:
                    out.value = wp.max(near.gap, axis.gap)
        return out

    @wp.func
    def relative(a: wp.int32, b: wp.int32, R_a: mat33, R_b: mat33, t: vec3):
        """The pair, b's pose in the frame of a; t is b's origin as seen from a's, in the frame of the poses."""
        back = wp.transpose(R_a)
        return make_pair(a, b, back * R_b, back * t)

    @wp.func
    def outer(n: vec3, point: vec3):
        """n ⊗ [point; 1] with a zero bottom row."""
        zero = real(0.0)
        return mat44(
            n[0] * point[0], n[0] * point[1], n[0] * point[2], n[0],
            n[1] * point[0], n[1] * point[1], n[1] * point[2], n[1],
            n[2] * point[0], n[2] * point[1], n[2] * point[2], n[2],
            zero, zero, zero, zero,
        )  # fmt: skip

    @wp.kernel(enable_backward=False, module=module)
    def signed_distances(
        parts: Parts,
        pairs: wp.array2d(dtype=wp.int64),
        T_a: wp.array(dtype=mat44),
        T_b: wp.array(dtype=mat44),
        wobble: Wobble,
        value: wp.array(dtype=real),
        normal: wp.array(dtype=vec3),
        point_a: wp.array(dtype=vec3),
        point_b: wp.array(dtype=vec3),
        gradient_a: wp.array(dtype=mat44),
        gradient_b: wp.array(dtype=mat44),
    ):
        i = wp.tid()
        origin = translation(T_a[i])
        R_a = orthonormal(rotation(T_a[i]))
        R_b = orthonormal(rotation(T_b[i]))
        pair = relative(int(pairs[i, 0]), int(pairs[i, 1]), R_a, R_b, translation(T_b[i]) - origin)
        d = distance(parts, pair, across(parts, pair), 0, never, 1)
        value[i] = d.value
        normal[i] = R_a * d.normal
        point_a[i] = R_a * d.a + origin
        point_b[i] = R_a * d.b + origin
        if gradient_a.shape[0] > 0:
            p = Points()
            p.a = d.a
            p.b = d.b
            if wobble.nodes.shape[0] > 0:
                p = smoothed(parts, pair, d.normal, wobble)
            gradient_a[i] = -outer(R_a * d.normal, p.a)
            gradient_b[i] = outer(R_a * d.normal, wp.transpose(pair.R) * (p.b - pair.t))

    @wp.func
    def drop_distance(parts: Parts, pair: Pair, gravity: vec3):
        """How far part a falls along a unit vector in its own frame before it meets b: 0 where they touch or overlap.

        Witness points are those at the meeting point, a's before the fall.
        """
        out = Drop()
        out.height = never
        out.lands = 0
        hit = fall(parts, pair, gravity)
        if hit.status == HITS:
            if hit.height > real(0.0):
                out.height = hit.height
                out.normal = hit.normal
                out.a = hit.a
                out.b = hit.b
                out.lands = 1
            else:
                d = distance(parts, pair, across(parts, pair), 0, arrived, 1)
                if d.value <= arrived:
                    out.height = real(0.0)
                    out.normal = d.normal
                    out.a = d.a
                    out.b = d.b
                    if d.value >= -arrived:
                        out.lands = 1
        return out

    @wp.kernel(enable_backward=False, module=module)
    def drop_distances(
        parts: Parts,
        pairs: wp.array2d(dtype=wp.int64),
        T_a: wp.array(dtype=mat44),
        T_b: wp.array(dtype=mat44),
        wobble: Wobble,
        gravity: wp.array(dtype=vec3),
        limit: real,
        value: wp.array(dtype=real),
        normal: wp.array(dtype=vec3),
        point_a: wp.array(dtype=vec3),
        point_b: wp.array(dtype=vec3),
        gradient_a: wp.array(dtype=mat44),
        gradient_b: wp.array(dtype=mat44),
    ):
        i = wp.tid()
        origin = translation(T_a[i])
        R_a = orthonormal(rotation(T_a[i]))
        R_b = orthonormal(rotation(T_b[i]))
        pair = relative(int(pairs[i, 0]), int(pairs[i, 1]), R_a, R_b, translation(T_b[i]) - origin)
        g = wp.normalize(wp.transpose(R_a) * gravity[i])
        d = drop_distance(parts, pair, g)
        value[i] = never
        if d.height <= limit:
            value[i] = d.height
            normal[i] = R_a * d.normal
            point_a[i] = R_a * d.a + origin
            point_b[i] = R_a * d.b + origin
            rate = wp.dot(d.normal, g)
            # what is inside already, or slides along, cannot fall any less; the rest is bounded where it only grazes
            if gradient_a.shape[0] > 0 and rate > real(0.0) and d.lands == 1:
                met = moved(pair, -d.height * g)
                p = Points()
                p.a = d.a
                p.b = d.b - d.height * g
                if wobble.nodes.shape[0] > 0:
                    p = smoothed(parts, met, d.normal, wobble)
                n = R_a * d.normal / wp.max(rate, real(GRAZING))
                gradient_a[i] = -outer(n, p.a)
                gradient_b[i] = outer(n, wp.transpose(pair.R) * (p.b - met.t))

    return SimpleNamespace(**locals())
