"""Each object: its costs, their gradient and curvature, summed over what it touches; and what a report measures."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes
from physpose_torch.distance.kernels.smooth import smooth
from physpose_torch.fused.contact import contact
from physpose_torch.fused.planes import planes
from physpose_torch.fused.step import step
from physpose_torch.fused.world import world

__all__ = ["objects"]


@functools.cache
def objects(real: type) -> SimpleNamespace:
    """Kernels in ``wp.float32`` or ``wp.float64``."""
    s, m, w, flat = shapes(real), smooth(real), world(real), planes(real)
    vec3, Parts, Wobble, smoothed = s.vec3, s.Parts, m.Wobble, m.smoothed
    rotation, translation, orthonormal, make_pair = s.rotation, s.translation, s.orthonormal, s.make_pair
    World, Prior, Options, State, vec6, mat66 = w.World, w.Prior, w.Options, w.State, w.vec6, w.mat66
    join, hinge, hinge_slope, contact_softness = w.join, w.hinge, w.hinge_slope, w.contact_softness
    plane_softness, lowest_point, fall_of = flat.plane_softness, flat.lowest_point, contact(real).fall_of
    cholesky, solve = step(real).cholesky, step(real).solve
    module, zero, one, half, two = w.module, w.zero, w.one, w.half, w.two

    @wp.kernel(enable_backward=False, module=module)
    def objects(parts: Parts, world: World, prior: Prior, state: State, options: Options, wobble: Wobble):
        """Each object's costs and their gradient for a step [t in the camera frame, rotation in the object frame]."""
        i = wp.tid()
        image = world.image[i]
        if state.done[image] == 1:
            state.gradient[i] = vec6()
            return
        R = orthonormal(rotation(state.poses[i]))
        t = translation(state.poses[i])
        g = world.gravity[image]
        collision = state.plane_cost[i]
        share = collision
        gradient = options.pose_weight * state.pose_gradient[i] + options.collision_weight * state.plane_gradient[i]
        curvature = mat66()
        if options.newton == 1:
            curvature = options.collision_weight * state.plane_curvature[i]
            for k in range(6):
                for c in range(6):
                    curvature[k, c] = curvature[k, c] + (
                        options.pose_weight * state.pose_slope[i] * prior.precision[6 * i + k][c]
                    )
        height = state.plane_height[i]
        other = int(-1)
        own_instance = state.plane_instance[i]
        other_instance = int(-1)
        for k in range(world.object_pair_start[i], world.object_pair_start[i + 1]):
            pair = world.object_pair[k]
            first = world.pair_first[pair]
            second = world.pair_second[pair]
            count = int(0)
            touches = int(0)
            cost = zero
            force = vec3(zero, zero, zero)
            torque = vec3(zero, zero, zero)
            block = mat66()
            for r in range(world.pair_row[pair], world.pair_row[pair + 1]):
                if state.row_count[r] > 0:
                    count += state.row_count[r]
                    cost += state.row_cost[r]
                    if first == i:
                        force += state.row_force[r]
                        torque += state.row_torque_a[r]
                        if options.newton == 1:
                            block += state.row_curvature_a[r]
                    else:
                        force -= state.row_force[r]
                        torque += state.row_torque_b[r]
                        if options.newton == 1:
                            block += state.row_curvature_b[r]
                if options.paper == 1:
                    touches = wp.max(touches, state.row_touches[r])
                elif first == i:
                    if state.row_drop_a[r] < height:
                        height = state.row_drop_a[r]
                        own_instance = world.row_instance[r]
                        other_instance = state.row_onto_a[r]
                        other = second
                elif state.row_drop_b[r] < height:
                    height = state.row_drop_b[r]
                    own_instance = state.row_onto_b[r]
                    other_instance = world.row_instance[r]
                    other = first
            if count > 0 or touches == 1:
                # a contact acts on a body unless the other one is an alternative that pushes nobody
                partner = second
                if second == i:
                    partner = first
                moves = int(1)
                partner_moves = int(1)
                if partner < world.n_objects:
                    moves = world.acts[partner]
                    partner_moves = world.acts[i]
                else:
                    partner_moves = 0
                if touches == 1 and moves == 1:
                    height = zero
                if count > 0 and moves == 1:
                    cost = cost / real(count)
                    collision += cost
                    if partner_moves == 1:
                        cost = half * cost
                    share += cost
                    gradient += options.collision_weight / real(count) * join(force, torque)
                    if options.newton == 1:
                        # both bodies move: (x + y)² ≤ 2x² + 2y² keeps their blocks apart
                        weight = options.collision_weight / real(count)
                        if partner_moves == 1:
                            weight = two * weight
                        curvature += weight * block
        gravity = zero
        if height > zero and height <= state.reach[i] and options.gravity_weight > zero and world.grounded[image] == 1:
            softness = options.softness
            if other < 0:
                plane = state.plane_best[i]
                softness = plane_softness(world, state, options, options.gravity_weight, i, plane)
                up = wp.transpose(R) * world.plane_normal[plane]
                rate = -wp.dot(world.plane_normal[plane], g)
                begin = own_instance
                end = own_instance + 1
                if options.paper == 1:
                    rate = one
                    begin = world.instance_start[i]
                    end = world.instance_start[i + 1]
                point = vec3(zero, zero, zero)
                for q in range(begin, end):
                    point += lowest_point(parts, world.instance_part[q], -up, wobble, options.smooth)
                point = point / real(end - begin)
                slope = options.gravity_weight * hinge_slope(height, softness) / rate
                gradient += slope * join(world.plane_normal[plane], wp.cross(point, up))
                if options.newton == 1:
                    j = join(world.plane_normal[plane], wp.cross(point, up))
                    curvature += (slope / (height * rate)) * wp.outer(j, j)
            else:
                softness = contact_softness(world, options, options.gravity_weight, other)
                part_a = world.instance_part[own_instance]
                part_b = world.instance_part[other_instance]
                R_b = orthonormal(rotation(state.poses[other]))
                t_b = translation(state.poses[other])
                hit = fall_of(parts, part_a, part_b, R, t, R_b, t_b, g)
                back = wp.transpose(R)
                met = make_pair(part_a, part_b, back * R_b, back * (t_b - t - hit.height * g))
                point = hit.a
                if options.smooth == 1:
                    both = smoothed(parts, met, hit.normal, wobble)
                    point = both.a
                rate = wp.dot(hit.normal, back * g)
                slope = -options.gravity_weight * hinge_slope(height, softness) / rate
                gradient += slope * join(R * hit.normal, wp.cross(point, hit.normal))
                if options.newton == 1:
                    j = join(R * hit.normal, wp.cross(point, hit.normal))
                    curvature += (-slope / (height * rate)) * wp.outer(j, j)
            gravity = hinge(height, softness)
        state.collision[i] = collision
        state.share[i] = share
        state.gravity[i] = gravity
        scaled = vec6()
        for k in range(6):
            scaled += gradient[k] * prior.scale[6 * i + k]
        length = wp.length(scaled)
        if length > options.max_gradient and options.newton == 0:
            scaled = options.max_gradient / length * scaled
        state.gradient[i] = scaled
        if options.newton == 1:
            # in units of the scale: the prior is near the identity there, so the damping is in its units
            D = mat66()
            for k in range(6):
                column = vec6()
                for c in range(6):
                    x = vec6()
                    for q in range(6):
                        x[q] = curvature[c, q]
                    for q in range(6):
                        column[c] = column[c] + x[q] * prior.scale[6 * i + q][k]
                for c in range(6):
                    total = zero
                    for q in range(6):
                        total += prior.scale[6 * i + q][c] * column[q]
                    D[c, k] = total
                D[k, k] = D[k, k] + options.damping
            w = vec6()
            for k in range(6):
                w += (options.pose_weight * state.pose_slope[i] * prior.toward[i][k]) * prior.scale[6 * i + k]
            L = cholesky(D)
            y = solve(L, scaled)
            z = solve(L, w)
            state.newton[i] = y
            state.follow[i] = z
            state.follow_gradient[i] = wp.dot(w, y)
            state.follow_follow[i] = wp.dot(w, z)

    @wp.kernel(enable_backward=False, module=module)
    def measure(world: World, state: State, options: Options):
        """How deep each object is inside statics and inside other objects, how high it is, and above what."""
        i = wp.tid()
        inside = state.plane_depth[i]
        among = zero
        height = state.plane_height[i]
        support = int(-1)
        if height <= state.reach[i]:
            support = world.image.shape[0] + state.plane_best[i]
        for k in range(world.object_pair_start[i], world.object_pair_start[i + 1]):
            pair = world.object_pair[k]
            partner = world.pair_first[pair] + world.pair_second[pair] - i
            for r in range(world.pair_row[pair], world.pair_row[pair + 1]):
                if partner >= world.n_objects:
                    inside = wp.max(inside, state.row_depth[r])
                elif world.acts[partner] == 1:
                    among = wp.max(among, state.row_depth[r])
                drop = state.row_drop_a[r]
                if world.pair_second[pair] == i:
                    drop = state.row_drop_b[r]
                if drop < height:
                    height = drop
                    support = partner
        state.depth_static[i] = inside
        state.depth_object[i] = among
        state.height[i] = height
        state.support[i] = support

    return SimpleNamespace(**locals())
