"""Smoothed witness points of two convex parts: the quadrature of distance/smoothing.py as Warp functions."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes

__all__ = ["smooth"]

MOMENTS = """
    // mean and second moments of the vertex foremost along each wobbling direction, relative to the foremost of all;
    // eight directions at a time, which the compiler turns into vector instructions
    typedef REAL real;
    typedef long long index;
    const int lanes = 8, room = 96;
    const wp::vec_t<3, real> origin = vertices.data[foremost];
    const real tilt = noise * reach, shrink = tangential ? real(1) : real(1) - tilt;
    // only what the farthest direction can bring foremost; if that is more than there is room for, all of them each time
    wp::vec_t<3, real> candidate[room];
    int count = 0;
    for (int i = first; i < last && count <= room; ++i) {
        const wp::vec_t<3, real> x = wp::mul(to_frame, wp::sub(vertices.data[i], origin));
        if (shrink <= real(0) || shrink * x[2] + tilt * wp::sqrt(x[0] * x[0] + x[1] * x[1]) >= real(0)) {
            if (count < room)
                candidate[count] = x;
            ++count;
        }
    }
    const bool all = count > room;
    if (all)
        count = last - first;
    wp::vec_t<6, real> out;
    const int n = nodes.shape[0];
    for (int k = 0; k < n; k += lanes) {
        real dx[lanes], dy[lanes], dz[lanes], top[lanes];
        index best[lanes];
        for (int l = 0; l < lanes; ++l) {
            wp::vec_t<3, real> node = nodes.data[k + l < n ? k + l : k];
            if (!tangential)
                node = wp::mul(frame, node);
            dx[l] = noise * node[0];
            dy[l] = noise * node[1];
            dz[l] = real(1) + noise * node[2];
            top[l] = real(-1e30f);
            best[l] = 0;
        }
        for (int c = 0; c < count; ++c) {
            const wp::vec_t<3, real> x =
                all ? wp::mul(to_frame, wp::sub(vertices.data[first + c], origin)) : candidate[c];
            for (int l = 0; l < lanes; ++l) {
                const real h = dx[l] * x[0] + dy[l] * x[1] + dz[l] * x[2];
                best[l] = h > top[l] ? c : best[l];
                top[l] = h > top[l] ? h : top[l];
            }
        }
        for (int l = 0; l < lanes && k + l < n; ++l) {
            const wp::vec_t<3, real> x = all
                ? wp::mul(to_frame, wp::sub(vertices.data[first + best[l]], origin)) : candidate[best[l]];
            const real w = share.data[k + l];
            out[0] += w * x[0];
            out[1] += w * x[1];
            out[2] += w * x[2];
            out[3] += w * x[0] * x[0];
            out[4] += w * x[0] * x[1];
            out[5] += w * x[1] * x[1];
        }
    }
    return out;
"""


@functools.cache
def smooth(real: type) -> SimpleNamespace:
    """Functions in ``wp.float32`` or ``wp.float64``."""
    s = shapes(real)
    vec3, Parts, Pair, farthest = s.vec3, s.Parts, s.Pair, s.farthest
    vec6 = wp.types.vector(6, real)
    mat33 = s.mat33
    one, zero = real(1.0), real(0.0)

    @wp.struct
    class Wobble:
        """Directions n + noise (x u + y v + z n) in the tangent basis (u, v, n), or n + noise z in the frame of a."""

        nodes: wp.array(dtype=vec3)
        share: wp.array(dtype=real)
        noise: real
        reach: real
        """Largest length of a node."""
        tangential: wp.int32
        blur: real

    @wp.struct
    class Moments:
        """Mean of a smoothed contact point along (u, v, n), and its spread across n."""

        mean: vec3
        uu: real
        uv: real
        vv: real

    @wp.struct
    class Points:
        a: vec3
        b: vec3

    @wp.func
    def basis(normal: vec3):
        """Rows (u, v, n) of physpose_torch.distance.smoothing.tangent_basis."""
        sign = one
        if normal[2] < real(-0.3):
            sign = -one
        a = -one / (sign + normal[2])
        b = normal[0] * normal[1] * a
        return mat33(
            one + sign * normal[0] * normal[0] * a,
            sign * b,
            -sign * normal[0],
            b,
            sign + normal[1] * normal[1] * a,
            -normal[1],
            normal[0],
            normal[1],
            normal[2],
        )

    @wp.func_native(snippet=MOMENTS.replace("REAL", "double" if real is wp.float64 else "float"))
    def _moments(
        vertices: wp.array(dtype=vec3),
        first: wp.int32,
        last: wp.int32,
        foremost: wp.int32,
        to_frame: mat33,
        frame: mat33,
        nodes: wp.array(dtype=vec3),
        share: wp.array(dtype=real),
        noise: real,
        reach: real,
        tangential: wp.int32,
    ) -> vec6: ...

    @wp.func
    def moments(parts: Parts, part: wp.int32, R: mat33, frame: mat33, wobble: Wobble):
        """Mean and spread, in the basis ``frame``, of the vertex that is foremost along directions about its third row.

        R takes vertices to the space of ``frame``.
        """
        to_frame = frame * R
        foremost = farthest(parts, part, vec3(to_frame[2, 0], to_frame[2, 1], to_frame[2, 2]))
        x = _moments(
            parts.vertices, parts.vertex_start[part], parts.vertex_start[part + 1], foremost, to_frame, frame,
            wobble.nodes, wobble.share, wobble.noise, wobble.reach, wobble.tangential,
        )  # fmt: skip
        out = Moments()
        out.mean = vec3(x[0], x[1], x[2]) + to_frame * parts.vertices[foremost]
        out.uu = x[3] - x[0] * x[0] + wobble.blur * wobble.blur
        out.uv = x[4] - x[0] * x[1]
        out.vv = x[5] - x[1] * x[1] + wobble.blur * wobble.blur
        return out

    @wp.func
    def smoothed(parts: Parts, pair: Pair, normal: vec3, wobble: Wobble):
        """Smoothed witness points on a and on b in the frame of a: the two contact points, fused by their spreads."""
        frame = basis(normal)
        eye = wp.identity(n=3, dtype=real)
        on_a = moments(parts, pair.a, eye, frame, wobble)
        # b's directions wobble in the basis of -n; what it gives is taken to that of n
        back = basis(-normal)
        on_b = moments(parts, pair.b, pair.R, back, wobble)
        turn = frame * wp.transpose(back)
        b = turn * on_b.mean + frame * pair.t
        # turn maps tangent vectors to tangent vectors
        uu = (
            turn[0, 0] * turn[0, 0] * on_b.uu
            + real(2.0) * turn[0, 0] * turn[0, 1] * on_b.uv
            + turn[0, 1] * turn[0, 1] * on_b.vv
        )
        uv = (
            turn[0, 0] * turn[1, 0] * on_b.uu
            + (turn[0, 0] * turn[1, 1] + turn[0, 1] * turn[1, 0]) * on_b.uv
            + turn[0, 1] * turn[1, 1] * on_b.vv
        )
        vv = (
            turn[1, 0] * turn[1, 0] * on_b.uu
            + real(2.0) * turn[1, 0] * turn[1, 1] * on_b.uv
            + turn[1, 1] * turn[1, 1] * on_b.vv
        )
        # both contact points agree where their spreads allow
        x = b[0] - on_a.mean[0]
        y = b[1] - on_a.mean[1]
        suu = on_a.uu + uu
        suv = on_a.uv + uv
        svv = on_a.vv + vv
        # of two thin spreads that lie along each other nearly all cancels, and float32 would be left with noise
        blur = real(2.0) * wobble.blur * wobble.blur
        thin = wp.max((suu - blur) * (svv - blur) - suv * suv, zero)
        det = thin + blur * (suu + svv - blur)
        fx = (svv * x - suv * y) / det
        fy = (suu * y - suv * x) / det
        u = vec3(frame[0, 0], frame[0, 1], frame[0, 2])
        v = vec3(frame[1, 0], frame[1, 1], frame[1, 2])
        out = Points()
        out.a = wp.transpose(frame) * on_a.mean + (on_a.uu * fx + on_a.uv * fy) * u + (on_a.uv * fx + on_a.vv * fy) * v
        out.b = wp.transpose(frame) * b - (uu * fx + uv * fy) * u - (uv * fx + vv * fy) * v
        return out

    return SimpleNamespace(**locals())
