"""Bounding boxes of bodies and their parts along gravity: the kernel that moves them along, and how two of them lie."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes
from physpose_torch.distance.kernels.smooth import smooth
from physpose_torch.fused.world import world

__all__ = ["boxes"]


@functools.cache
def boxes(real: type) -> SimpleNamespace:
    """Functions and the kernel in ``wp.float32`` or ``wp.float64``."""
    s, w = shapes(real), world(real)
    vec3, Parts, rotation, translation, basis = s.vec3, s.Parts, s.rotation, s.translation, smooth(real).basis
    World, State, module, zero, one, far = w.World, w.State, w.module, w.zero, w.one, w.far

    @wp.func
    def overlap(a: vec3, b: vec3, c: vec3, d: vec3, k: wp.int32):
        """Whether the boxes a..b and c..d overlap along axis k."""
        return a[k] <= d[k] and c[k] <= b[k]

    @wp.func
    def lands(a: vec3, b: vec3, c: vec3, d: vec3, limit: real):
        """Whether the box a..b, falling by at most ``limit`` along the third axis, may meet the box c..d."""
        return (
            overlap(a, b, c, d, 0) and overlap(a, b, c, d, 1) and d[2] > a[2] and c[2] < b[2] + limit and limit > zero
        )

    @wp.func
    def apart(a: vec3, b: vec3, c: vec3, d: vec3):
        """Distance of two boxes."""
        x = wp.max(wp.max(a[0] - d[0], c[0] - b[0]), zero)
        y = wp.max(wp.max(a[1] - d[1], c[1] - b[1]), zero)
        z = wp.max(wp.max(a[2] - d[2], c[2] - b[2]), zero)
        return wp.sqrt(x * x + y * y + z * z)

    @wp.kernel(enable_backward=False, module=module)
    def boxes(parts: Parts, world: World, state: State):
        """Boxes of instances and entities in the frame whose third axis is gravity."""
        e = wp.tid()
        image = world.image[e]
        if state.done[image] == 1:
            return
        down = world.gravity[image]
        if world.falls[image] == 0:
            down = vec3(zero, zero, one)
        axes = basis(down)
        R = axes * rotation(state.poses[e])
        t = axes * translation(state.poses[e])
        low = vec3(far, far, far)
        high = -low
        for q in range(world.instance_start[e], world.instance_start[e + 1]):
            part = world.instance_part[q]
            c = R * parts.center[part] + t
            h = parts.half[part]
            x = wp.abs(R[0, 0]) * h[0] + wp.abs(R[0, 1]) * h[1] + wp.abs(R[0, 2]) * h[2]
            y = wp.abs(R[1, 0]) * h[0] + wp.abs(R[1, 1]) * h[1] + wp.abs(R[1, 2]) * h[2]
            z = wp.abs(R[2, 0]) * h[0] + wp.abs(R[2, 1]) * h[1] + wp.abs(R[2, 2]) * h[2]
            h = vec3(x, y, z)
            state.lower[q] = c - h
            state.upper[q] = c + h
            low = wp.min(low, c - h)
            high = wp.max(high, c + h)
        state.entity_lower[e] = low
        state.entity_upper[e] = high

    return SimpleNamespace(**locals())
