"""What touches: rows of parts against each other, and how far each can fall onto the other."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.contacts import SUPPORT_SLOPE
from physpose_torch.distance.kernels.drop import HITS
from physpose_torch.distance.kernels.pair import pairs
from physpose_torch.distance.kernels.smooth import smooth
from physpose_torch.fused.boxes import boxes
from physpose_torch.fused.world import world

__all__ = ["contact"]

REACHED = {wp.float32: 1e-7, wp.float64: 1e-9}
"""[m]; parts nearer than this touch."""


@functools.cache
def contact(real: type) -> SimpleNamespace:
    """Functions and kernels in ``wp.float32`` or ``wp.float64``."""
    p, m, w = pairs(real), smooth(real), world(real)
    s = p.s
    vec3, mat33, Parts, Wobble = s.vec3, s.mat33, s.Parts, m.Wobble
    rotation, translation, orthonormal = s.rotation, s.translation, s.orthonormal
    make_pair, across = s.make_pair, s.across
    distance, fall, smoothed, Points = p.distance, p.fall, m.smoothed, m.Points
    World, Options, State, vec6, mat66 = w.World, w.Options, w.State, w.vec6, w.mat66
    join, hinge, hinge_slope, contact_softness = w.join, w.hinge, w.hinge_slope, w.contact_softness
    lands, apart = boxes(real).lands, boxes(real).apart
    module, zero, one, far = w.module, w.zero, w.one, w.far
    reached = real(REACHED[real])
    support_slope = real(SUPPORT_SLOPE)

    @wp.func
    def may_fall(world: World, state: State, options: Options, who: wp.int32, onto: wp.int32):
        """How far down it is worth looking for what carries an entity; 0: not at all."""
        if who >= world.n_objects or options.gravity_weight == zero or options.paper == 1:
            return zero
        if world.falls[world.image[who]] == 0:
            return zero
        if onto < world.n_objects:
            if world.acts[onto] == 0:
                return zero
        return wp.min(state.plane_height[who], state.reach[who])

    @wp.func
    def fall_of(parts: Parts, a: wp.int32, b: wp.int32, R_a: mat33, t_a: vec3, R_b: mat33, t_b: vec3, g: vec3):
        """The fall of part a onto part b along g, poses and g in one frame."""
        back = wp.transpose(R_a)
        return fall(parts, make_pair(a, b, back * R_b, back * (t_b - t_a)), back * g)

    @wp.kernel(enable_backward=False, module=module)
    def rows(
        parts: Parts, world: World, state: State, options: Options, wobble: Wobble, first: wp.int32, stride: wp.int32
    ):
        """One part of a body against all parts of another: penetrations, and how far each can fall onto the other."""
        r = first + stride * wp.tid()
        pair = world.row_pair[r]
        a = world.pair_first[pair]
        b = world.pair_second[pair]
        image = world.image[a]
        if state.done[image] == 1:
            return
        i = world.row_instance[r]
        limit_a = may_fall(world, state, options, a, b)
        limit_b = may_fall(world, state, options, b, a)
        state.row_cost[r] = zero
        state.row_count[r] = 0
        state.row_depth[r] = zero
        state.row_touches[r] = 0
        state.row_drop_a[r] = far
        state.row_drop_b[r] = far
        travelled = state.moved[a] + state.moved[b]
        # a fall is never shorter than the distance
        limit = wp.max(wp.max(limit_a, limit_b), options.margin)
        if state.clear[r] - travelled > limit:
            return
        low = state.lower[i]
        high = state.upper[i]
        clear = apart(low, high, state.entity_lower[b], state.entity_upper[b])
        if clear > limit:
            state.clear[r] = clear + travelled
            return
        clear = far
        R_a = orthonormal(rotation(state.poses[a]))
        R_b = orthonormal(rotation(state.poses[b]))
        t_a = translation(state.poses[a])
        t_b = translation(state.poses[b])
        back = wp.transpose(R_a)
        R = back * R_b
        t = back * (t_b - t_a)
        g = world.gravity[image]
        softness = contact_softness(world, options, options.collision_weight, b)
        part_a = world.instance_part[i]
        cost = zero
        count = int(0)
        depth = zero
        force = vec3(zero, zero, zero)
        torque_a = vec3(zero, zero, zero)
        torque_b = vec3(zero, zero, zero)
        curvature_a = mat66()
        curvature_b = mat66()
        best_a = limit_a
        best_b = limit_b
        onto_a = int(-1)
        onto_b = int(-1)
        for j in range(world.instance_start[b], world.instance_start[b + 1]):
            slot = world.row_slot[r] + j - world.instance_start[b]
            known = state.slot_clear[slot] - travelled
            aside = state.slot_aside[slot] - travelled
            if known > wp.max(wp.max(best_a, best_b), options.margin) or aside > options.margin:
                clear = wp.min(clear, wp.max(known, aside))
                continue
            aside = zero
            low_b = state.lower[j]
            high_b = state.upper[j]
            gap = apart(low, high, low_b, high_b)
            part_b = world.instance_part[j]
            inside = int(0)
            normal = vec3(zero, zero, zero)
            if gap <= wp.max(reached, options.margin):
                both = make_pair(part_a, part_b, R, t)
                hint = state.slot_normal[slot]
                if wp.dot(hint, hint) == zero:
                    hint = across(parts, both)
                overlapping = int(0)
                if state.slot_clear[slot] == -one:
                    overlapping = 1
                d = distance(parts, both, hint, overlapping, options.margin, wp.where(options.smooth == 0, 1, 0))
                gap = d.value
                state.slot_normal[slot] = d.normal
                if gap <= reached:
                    inside = 1
                    normal = R_a * d.normal
                if gap < options.margin:
                    state.row_touches[r] = 1
                if gap < zero:
                    point = Points()
                    point.a = d.a
                    point.b = d.b
                    if options.smooth == 1:
                        point = smoothed(parts, both, d.normal, wobble)
                    slope = hinge_slope(-gap, softness)
                    cost += hinge(-gap, softness)
                    count += 1
                    depth = wp.max(depth, -gap)
                    n = slope * d.normal
                    force += R_a * n
                    torque_a += wp.cross(point.a, n)
                    back_b = wp.transpose(R)
                    torque_b -= wp.cross(back_b * (point.b - t), back_b * n)
                    if options.newton == 1:
                        facing = R_a * d.normal
                        ja = join(facing, wp.cross(point.a, d.normal))
                        jb = join(facing, wp.cross(back_b * (point.b - t), back_b * d.normal))
                        curvature_a += slope / -gap * wp.outer(ja, ja)
                        curvature_b += slope / -gap * wp.outer(jb, jb)
            state.slot_clear[slot] = gap + travelled
            if gap < zero:
                state.slot_clear[slot] = -one
            # overlapping parts fall no farther; whether one carries the other, their normal says
            if gap < zero:
                if limit_a > zero and wp.dot(normal, g) >= support_slope:
                    best_a = zero
                    onto_a = j
                if limit_b > zero and -wp.dot(normal, g) >= support_slope:
                    best_b = zero
                    onto_b = j
            elif gap < best_a and lands(low, high, low_b, high_b, best_a):
                hit = fall_of(parts, part_a, part_b, R_a, t_a, R_b, t_b, g)
                aside = hit.aside
                if hit.status == HITS:
                    if hit.height > zero:
                        if hit.height < best_a and wp.dot(R_a * hit.normal, g) >= support_slope:
                            best_a = hit.height
                            onto_a = j
                    elif inside == 1 and wp.dot(normal, g) >= support_slope:
                        best_a = zero
                        onto_a = j
            if gap >= zero and gap < best_b and aside == zero and lands(low_b, high_b, low, high, best_b):
                hit = fall_of(parts, part_b, part_a, R_b, t_b, R_a, t_a, g)
                aside = hit.aside
                if hit.status == HITS:
                    if hit.height > zero:
                        if hit.height < best_b and wp.dot(R_b * hit.normal, g) >= support_slope:
                            best_b = hit.height
                            onto_b = j
                    elif inside == 1 and -wp.dot(normal, g) >= support_slope:
                        best_b = zero
                        onto_b = j
            state.slot_aside[slot] = -one
            if aside > zero:
                state.slot_aside[slot] = aside + travelled
            clear = wp.min(clear, wp.max(wp.max(gap, aside), zero))
        state.clear[r] = clear + travelled
        state.row_cost[r] = cost
        state.row_count[r] = count
        state.row_depth[r] = depth
        state.row_force[r] = force
        state.row_torque_a[r] = torque_a
        state.row_torque_b[r] = torque_b
        if options.newton == 1 and count > 0:
            state.row_curvature_a[r] = curvature_a
            state.row_curvature_b[r] = curvature_b
        if onto_a >= 0:
            state.row_drop_a[r] = best_a
            state.row_onto_a[r] = onto_a
        if onto_b >= 0:
            state.row_drop_b[r] = best_b
            state.row_onto_b[r] = onto_b

    return SimpleNamespace(**locals())
