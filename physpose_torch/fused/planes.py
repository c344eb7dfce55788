"""Objects against planes: what is inside, and how high each is above the nearest."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.contacts import SUPPORT_SLOPE
from physpose_torch.distance.kernels.shapes import shapes
from physpose_torch.distance.kernels.smooth import smooth
from physpose_torch.fused.world import world

__all__ = ["planes"]


@functools.cache
def planes(real: type) -> SimpleNamespace:
    """Functions and the kernel in ``wp.float32`` or ``wp.float64``."""
    s, m, w = shapes(real), smooth(real), world(real)
    vec3, Parts, Wobble, moments, basis = s.vec3, s.Parts, m.Wobble, m.moments, m.basis
    rotation, translation = s.rotation, s.translation
    World, Options, State, vec6, mat66 = w.World, w.Options, w.State, w.vec6, w.mat66
    join, hinge, hinge_slope = w.join, w.hinge, w.hinge_slope
    module, zero, one, far = w.module, w.zero, w.one, w.far
    support_slope = real(SUPPORT_SLOPE)

    @wp.func
    def plane_softness(world: World, state: State, options: Options, weight: real, i: wp.int32, plane: wp.int32):
        """ζσ² of the plane's height at an object, at least the usual softness: ζ d²/2w is d²/2σ² then."""
        frame = basis(world.plane_normal[plane])
        origin = rotation(state.poses[i]) * world.center[i] + translation(state.poses[i])
        lever = frame * (origin - state.middle[world.image[i]])
        j = vec3(lever[0], lever[1], one)
        return wp.max(options.softness, weight * wp.dot(j, world.plane_covariance[plane] * j))

    @wp.func
    def lowest_point(parts: Parts, part: wp.int32, down: vec3, wobble: Wobble, smoothing: wp.int32):
        """Where a part touches what lies across ``down``, in its body's frame."""
        if smoothing <= 0:
            return parts.vertices[s.farthest(parts, part, down)]
        frame = basis(down)
        x = moments(parts, part, wp.identity(n=3, dtype=real), frame, wobble)
        return wp.transpose(frame) * x.mean

    @wp.kernel(enable_backward=False, module=module)
    def planes(parts: Parts, world: World, state: State, options: Options, wobble: Wobble):
        """Each object against the planes of its image: what is inside, and how high it is above the nearest."""
        i = wp.tid()
        image = world.image[i]
        if state.done[image] == 1:
            return
        R = rotation(state.poses[i])
        t = translation(state.poses[i])
        cost = zero
        gradient = vec6()
        curvature = mat66()
        depth = zero
        nearest = far
        best = far
        best_lowest = far
        best_plane = int(-1)
        best_instance = int(-1)
        for k in range(world.object_plane_start[i], world.object_plane_start[i + 1]):
            plane = world.object_plane[k]
            normal = world.plane_normal[plane]
            up = wp.transpose(R) * normal
            level = wp.dot(normal, t) - world.plane_offset[plane]
            softness = plane_softness(world, state, options, options.collision_weight, i, plane)
            count = zero
            sum = zero
            force = zero
            torque = vec3(zero, zero, zero)
            block = mat66()
            lowest = far
            lowest_instance = int(-1)
            heights = zero
            for q in range(world.instance_start[i], world.instance_start[i + 1]):
                part = world.instance_part[q]
                height = level + wp.dot(up, parts.vertices[s.farthest(parts, part, -up)])
                heights += height
                if height < lowest:
                    lowest = height
                    lowest_instance = q
                    depth = wp.max(depth, -height)
                if height < zero:
                    count += one
                    sum += hinge(-height, softness)
                    slope = hinge_slope(-height, softness)
                    point = lowest_point(parts, part, -up, wobble, options.smooth)
                    force -= slope
                    torque -= slope * wp.cross(point, up)
                    if options.newton == 1:
                        j = join(normal, wp.cross(point, up))
                        block += slope / -height * wp.outer(j, j)
            if count > zero:
                cost += sum / count
                gradient += join(force / count * normal, torque / count)
                if options.newton == 1:
                    curvature += (one / count) * block
            nearest = wp.min(nearest, lowest)
            slope = -wp.dot(normal, world.gravity[image])
            if options.paper == 1:
                # which plane is below is decided by the nearest part
                if slope >= support_slope and lowest < best_lowest:
                    best_lowest = lowest
                    best = heights / real(world.instance_start[i + 1] - world.instance_start[i])
                    best_plane = plane
            elif slope >= support_slope:
                above = wp.max(lowest, zero) / slope
                if above <= state.reach[i] and above < best:
                    best = above
                    best_plane = plane
                    best_instance = lowest_instance
        if options.paper == 1 and nearest < options.margin:
            best = zero  # in contact, it is not pulled
        state.plane_cost[i] = cost
        state.plane_depth[i] = depth
        state.plane_gradient[i] = gradient
        if options.newton == 1:
            state.plane_curvature[i] = curvature
        state.plane_height[i] = best
        state.plane_best[i] = best_plane
        state.plane_instance[i] = best_instance

    return SimpleNamespace(**locals())
