"""Packed convex parts as Warp sees them, their support functions, and the relative pose of two of them."""

import functools
from types import SimpleNamespace

import warp as wp

__all__ = ["LANES", "shapes"]

LANES = 4
FARTHEST = """
    // four vertices at a time, which the compiler turns into vector instructions
    typedef REAL real;
    typedef long long index;  // as wide as a double, so that comparisons select both alike
    real top[4] = {-1e30f, -1e30f, -1e30f, -1e30f};
    index block[4] = {0, 0, 0, 0};
    const real* p = lanes.data + 12 * (size_t)first;
    for (int b = 0; b < last - first; ++b, p += 12)
        for (int l = 0; l < 4; ++l) {
            const real h = x * p[l] + y * p[4 + l] + z * p[8 + l];
            block[l] = h > top[l] ? b : block[l];
            top[l] = h > top[l] ? h : top[l];
        }
    int best = 4 * (int)block[0];
    real height = top[0];
    for (int l = 1; l < 4; ++l) {
        const int i = 4 * (int)block[l] + l;
        if (top[l] > height || (top[l] == height && i < best)) {
            height = top[l];
            best = i;
        }
    }
    return best;
"""


@functools.cache
def shapes(real: type) -> SimpleNamespace:
    """Types and functions in ``wp.float32`` or ``wp.float64``."""
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    mat44 = wp.types.matrix((4, 4), real)
    epsilon = real(1e-15 if real is wp.float64 else 1e-6)

    @wp.struct
    class Parts:
        vertices: wp.array(dtype=vec3)
        vertex_start: wp.array(dtype=wp.int32)
        lanes: wp.array(dtype=real)
        """The vertices again, in blocks of four: x x x x y y y y z z z z; the first one fills up the last block."""
        lane_start: wp.array(dtype=wp.int32)
        normals: wp.array(dtype=vec3)
        offsets: wp.array(dtype=real)
        normal_start: wp.array(dtype=wp.int32)
        edges: wp.array(dtype=wp.vec4i)
        edge_start: wp.array(dtype=wp.int32)
        center: wp.array(dtype=vec3)
        half: wp.array(dtype=vec3)
        middle: wp.array(dtype=vec3)
        """A point inside; the centre of the bounds may be outside."""

    @wp.struct
    class Pair:
        """Two parts; b's pose in the frame of a."""

        a: wp.int32
        b: wp.int32
        R: mat33
        t: vec3

    @wp.func_native(snippet=FARTHEST.replace("REAL", "double" if real is wp.float64 else "float"))
    def _foremost(
        lanes: wp.array(dtype=real), first: wp.int32, last: wp.int32, x: real, y: real, z: real
    ) -> wp.int32: ...

    @wp.func
    def farthest(parts: Parts, part: wp.int32, direction: vec3):
        """Index of the part's vertex farthest along a direction; of equals the first."""
        return parts.vertex_start[part] + _foremost(
            parts.lanes, parts.lane_start[part], parts.lane_start[part + 1], direction[0], direction[1], direction[2]
        )

    @wp.func
    def orthonormal(R: mat33):
        """The rotation nearest to an almost-rotation: distances are as exact as rotations are."""
        eye = wp.identity(n=3, dtype=real)
        for _ in range(4):
            excess = wp.transpose(R) * R - eye
            if wp.ddot(excess, excess) > epsilon * epsilon:
                R = R - real(0.5) * (R * excess)
        return R

    @wp.func
    def rotation(T: mat44):
        return mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])

    @wp.func
    def translation(T: mat44):
        return vec3(T[0, 3], T[1, 3], T[2, 3])

    @wp.func
    def make_pair(a: wp.int32, b: wp.int32, R: mat33, t: vec3):
        pair = Pair()
        pair.a = a
        pair.b = b
        pair.R = R
        pair.t = t
        return pair

    @wp.func
    def lowest_b(parts: Parts, pair: Pair, direction: vec3):
        """Index of the vertex of b that lies least far along a direction in the frame of a."""
        return farthest(parts, pair.b, -(wp.transpose(pair.R) * direction))

    @wp.func
    def point_b(parts: Parts, pair: Pair, index: wp.int32):
        return pair.R * parts.vertices[index] + pair.t

    @wp.func
    def gap_along(parts: Parts, pair: Pair, normal: vec3):
        """-(σ_A(n) + σ_B(-n)) for a unit n from a to b: never more than the signed distance."""
        a = parts.vertices[farthest(parts, pair.a, normal)]
        b = point_b(parts, pair, lowest_b(parts, pair, normal))
        return wp.dot(normal, b - a)

    @wp.func
    def across(parts: Parts, pair: Pair):
        """Unit vector between the centres; any where they coincide."""
        d = pair.R * parts.center[pair.b] + pair.t - parts.center[pair.a]
        length = wp.length(d)
        n = vec3(real(0.0), real(0.0), real(1.0))
        if length > real(1e-12):
            n = d / length
        return n

    return SimpleNamespace(**locals())
