"""The cost of losses.py and its gradient as Warp kernels: a few launches a step for all images, nothing on the host.

``boxes`` → ``priors`` → ``planes`` → ``rows`` → ``objects``, then ``move``. A row is a part of the first body of a pair of
bodies against all parts of the second: rows are fixed with the scene, so nothing is allocated, and every sum has its order.
"""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.contacts import SUPPORT_SLOPE
from physpose_torch.distance.kernels.drop import HITS
from physpose_torch.distance.kernels.pair import OPTIONS, pairs
from physpose_torch.distance.kernels.smooth import smooth
from physpose_torch.prior import REWEIGHTINGS

__all__ = ["cost_kernels"]

REACHED = {wp.float32: 1e-7, wp.float64: 1e-9}
"""[m]; parts nearer than this touch."""


@functools.cache
def cost_kernels(real: type) -> SimpleNamespace:
    """Structs and kernels in ``wp.float32`` or ``wp.float64``."""
    p, m = pairs(real), smooth(real)
    s = p.s
    vec3, mat33, mat44, Parts, Wobble = s.vec3, s.mat33, s.mat44, s.Parts, m.Wobble
    rotation, translation, orthonormal = s.rotation, s.translation, s.orthonormal
    make_pair, across = s.make_pair, s.across
    distance, fall, smoothed, moments, basis, Points = p.distance, p.fall, m.smoothed, m.moments, m.basis, m.Points
    vec6 = wp.types.vector(6, real)
    mat66 = wp.types.matrix((6, 6), real)
    module = wp.get_module(f"physpose_torch.fused.{real.__name__}")
    module.options |= OPTIONS
    zero, one, half, two = real(0.0), real(1.0), real(0.5), real(2.0)
    far = real(1e30)
    reached = real(REACHED[real])
    support_slope = real(SUPPORT_SLOPE)

    @wp.struct
    class World:
        """What stays: entities are N objects and then S static bodies, an instance is a part of an entity."""

        n_objects: wp.int32
        image: wp.array(dtype=wp.int32)
        instance_start: wp.array(dtype=wp.int32)
        instance_part: wp.array(dtype=wp.int32)
        gravity: wp.array(dtype=vec3)
        falls: wp.array(dtype=wp.int32)
        grounded: wp.array(dtype=wp.int32)
        """Whether anything static is known in each image; what rests on nothing known is not pulled together."""
        acts: wp.array(dtype=wp.int32)
        image_start: wp.array(dtype=wp.int32)
        image_object: wp.array(dtype=wp.int32)
        pair_first: wp.array(dtype=wp.int32)
        pair_second: wp.array(dtype=wp.int32)
        pair_row: wp.array(dtype=wp.int32)
        row_pair: wp.array(dtype=wp.int32)
        row_instance: wp.array(dtype=wp.int32)
        row_slot: wp.array(dtype=wp.int32)
        object_pair_start: wp.array(dtype=wp.int32)
        object_pair: wp.array(dtype=wp.int32)
        object_plane_start: wp.array(dtype=wp.int32)
        object_plane: wp.array(dtype=wp.int32)
        plane_normal: wp.array(dtype=vec3)
        plane_offset: wp.array(dtype=real)
        plane_covariance: wp.array(dtype=mat33)
        center: wp.array(dtype=vec3)
        span: wp.array(dtype=real)
        """Largest distance of a point of each entity from its origin."""

    @wp.struct
    class Prior:
        measured: wp.array(dtype=mat44)
        precision: wp.array(dtype=vec6)
        """Six rows an object, like ``scale``."""
        ray: wp.array(dtype=vec3)
        toward: wp.array(dtype=vec6)
        """H [ray, 0]."""
        curvature: wp.array(dtype=real)
        """[ray, 0]ᵀ H [ray, 0]."""
        scale: wp.array(dtype=vec6)
        sigma_common: real
        robust: real
        """0: not robust."""

    @wp.struct
    class Options:
        pose_weight: real
        collision_weight: real
        gravity_weight: real
        reach: real
        softness: real
        max_gradient: real
        max_step: real
        tolerance: real
        still_steps: wp.int32
        smooth: wp.int32
        """1: smoothed witness points, 0: hard ones, -1: none at all."""
        newton: wp.int32
        """Whether curvatures are needed as well."""
        damping: real

    @wp.struct
    class State:
        """What changes from step to step."""

        poses: wp.array(dtype=mat44)
        lower: wp.array(dtype=vec3)
        upper: wp.array(dtype=vec3)
        entity_lower: wp.array(dtype=vec3)
        entity_upper: wp.array(dtype=vec3)
        moved: wp.array(dtype=real)
        """No point of the entity has come farther than this since the start."""
        farthest: wp.array(dtype=real)
        done: wp.array(dtype=wp.int32)
        still: wp.array(dtype=wp.int32)
        steps: wp.array(dtype=wp.int32)
        middle: wp.array(dtype=vec3)
        pose: wp.array(dtype=real)
        pose_gradient: wp.array(dtype=vec6)
        pose_slope: wp.array(dtype=real)
        """Weight of the estimate in the robust cost."""
        information: wp.array(dtype=real)
        """Curvature of an image's cost in its depth factor."""
        plane_cost: wp.array(dtype=real)
        plane_gradient: wp.array(dtype=vec6)
        plane_curvature: wp.array(dtype=mat66)
        plane_depth: wp.array(dtype=real)
        plane_height: wp.array(dtype=real)
        plane_best: wp.array(dtype=wp.int32)
        plane_instance: wp.array(dtype=wp.int32)
        clear: wp.array(dtype=real)
        """A row's parts are this far apart less what their entities have moved in all."""
        slot_clear: wp.array(dtype=real)
        """Likewise each pair of parts; -1: they overlapped when last looked at."""
        slot_normal: wp.array(dtype=vec3)
        """The normal found then."""
        row_cost: wp.array(dtype=real)
        row_count: wp.array(dtype=wp.int32)
        row_depth: wp.array(dtype=real)
        row_force: wp.array(dtype=vec3)
        row_torque_a: wp.array(dtype=vec3)
        row_torque_b: wp.array(dtype=vec3)
        row_curvature_a: wp.array(dtype=mat66)
        row_curvature_b: wp.array(dtype=mat66)
        row_drop_a: wp.array(dtype=real)
        row_drop_b: wp.array(dtype=real)
        row_onto_a: wp.array(dtype=wp.int32)
        row_onto_b: wp.array(dtype=wp.int32)
        collision: wp.array(dtype=real)
        share: wp.array(dtype=real)
        gravity: wp.array(dtype=real)
        depth_static: wp.array(dtype=real)
        depth_object: wp.array(dtype=real)
        height: wp.array(dtype=real)
        support: wp.array(dtype=wp.int32)
        gradient: wp.array(dtype=vec6)
        newton: wp.array(dtype=vec6)
        """D⁻¹ gradient, D the curvature; in units of the scale."""
        follow: wp.array(dtype=vec6)
        """D⁻¹ w, w how the gradient changes with the depth factor."""
        follow_gradient: wp.array(dtype=real)
        follow_follow: wp.array(dtype=real)

    @wp.func
    def join(a: vec3, b: vec3):
        return vec6(a[0], a[1], a[2], b[0], b[1], b[2])

    @wp.func
    def hinge(x: real, softness: real):
        if x <= zero:
            return zero
        if x < softness:
            return x * x / (two * softness)
        return x - half * softness

    @wp.func
    def hinge_slope(x: real, softness: real):
        if x <= zero:
            return zero
        if x < softness:
            return x / softness
        return one

    @wp.func
    def log_so3(R: mat33):
        """Rotation vector with an angle in [0, π]."""
        q = wp.quat_from_matrix(R)
        sign = one
        if q[3] < zero:
            sign = -one
        v = sign * vec3(q[0], q[1], q[2])
        w = sign * q[3]
        n = wp.length(v)
        if n < real(1e-7):
            return two / wp.max(w, half) * v
        return two * wp.atan2(n, w) / n * v

    @wp.func
    def exp_so3(w: vec3):
        angle2 = wp.dot(w, w)
        a = one - angle2 / real(6.0) * (one - angle2 / real(20.0))
        b = half - angle2 / real(24.0) * (one - angle2 / real(30.0))
        if angle2 > real(1e-6):
            angle = wp.sqrt(angle2)
            a = wp.sin(angle) / angle
            b = (one - wp.cos(angle)) / angle2
        k = wp.skew(w)
        return wp.identity(n=3, dtype=real) + a * k + b * (k * k)

    @wp.func
    def times_inverse_jacobian(w: vec3, x: vec3):
        """J_r(w)⁻ᵀ x (Solà et al. 2018, Eq. 144)."""
        angle2 = wp.dot(w, w)
        factor = one / real(12.0) + angle2 / real(720.0)
        if angle2 >= real(1e-6):
            angle = wp.sqrt(angle2)
            factor = one / angle2 - half / (angle * wp.tan(half * angle))
        c = wp.cross(w, x)
        return x - half * c + factor * wp.cross(w, c)

    @wp.func
    def residual(prior: Prior, poses: wp.array(dtype=mat44), i: wp.int32):
        R = wp.transpose(rotation(prior.measured[i])) * rotation(poses[i])
        return join(translation(poses[i]) - translation(prior.measured[i]), log_so3(R))

    @wp.func
    def apply_precision(prior: Prior, i: wp.int32, e: vec6):
        out = vec6()
        for k in range(6):
            out[k] = wp.dot(prior.precision[6 * i + k], e)
        return out

    @wp.func
    def cholesky(D: mat66):
        """Lower triangle L of D = L Lᵀ; D is positive definite, for it is damped."""
        L = mat66()
        for r in range(6):
            for c in range(r + 1):
                total = D[r, c]
                for k in range(c):
                    total -= L[r, k] * L[c, k]
                if r == c:
                    L[r, r] = wp.sqrt(wp.max(total, real(1e-12)))
                else:
                    L[r, c] = total / L[c, c]
        return L

    @wp.func
    def solve(L: mat66, x: vec6):
        """(L Lᵀ)⁻¹ x."""
        y = vec6()
        for r in range(6):
            total = x[r]
            for k in range(r):
                total -= L[r, k] * y[k]
            y[r] = total / L[r, r]
        for q in range(6):
            r = 5 - q
            total = y[r]
            for k in range(r + 1, 6):
                total -= L[k, r] * y[k]
            y[r] = total / L[r, r]
        return y

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

    @wp.kernel(enable_backward=False, module=module)
    def priors(world: World, prior: Prior, state: State, step: wp.int32, options: Options):
        """Who has come to rest; then the pose costs of an image, its common depth factor eliminated."""
        image = wp.tid()
        if state.done[image] == 1:
            return
        first = world.image_start[image]
        last = world.image_start[image + 1]
        farthest = zero
        for k in range(first, last):
            farthest = wp.max(farthest, state.farthest[world.image_object[k]])
        if farthest <= options.tolerance:
            state.still[image] = state.still[image] + 1
        else:
            state.still[image] = 0
        if state.still[image] >= options.still_steps:
            state.done[image] = 1
            state.steps[image] = step
            return
        count = zero
        middle = vec3(zero, zero, zero)
        for k in range(first, last):
            i = world.image_object[k]
            if world.acts[i] == 1:
                count += one
                middle += rotation(state.poses[i]) * world.center[i] + translation(state.poses[i])
        state.middle[image] = middle / wp.max(count, one)
        factor = zero
        if prior.sigma_common > zero:
            rounds = int(1)
            if prior.robust > zero:
                rounds = REWEIGHTINGS
            # what the reweighting needs of each object is kept in its gradient's place
            for k in range(first, last):
                i = world.image_object[k]
                e = residual(prior, state.poses, i)
                own = wp.dot(e, apply_precision(prior, i, e))
                state.pose_gradient[i] = vec6(own, wp.dot(prior.toward[i], e), zero, zero, zero, zero)
            for _ in range(rounds):
                numerator = zero
                information = one / (prior.sigma_common * prior.sigma_common)
                for k in range(first, last):
                    i = world.image_object[k]
                    if world.acts[i] == 1:
                        kept = state.pose_gradient[i]
                        weight = one
                        if prior.robust > zero:
                            square = kept[0] - two * factor * kept[1] + factor * factor * prior.curvature[i]
                            weight = one / (one + wp.max(square, zero) / prior.robust)
                        numerator += weight * kept[1]
                        information += weight * prior.curvature[i]
                factor = numerator / information
        information = zero
        if prior.sigma_common > zero:
            information = one / (prior.sigma_common * prior.sigma_common)
        for k in range(first, last):
            i = world.image_object[k]
            e = residual(prior, state.poses, i)
            shift = factor * prior.ray[i]
            e = e - join(shift, vec3(zero, zero, zero))
            He = apply_precision(prior, i, e)
            cost = half * wp.dot(e, He)
            slope = one
            if prior.robust > zero:
                slope = one / (one + two * cost / prior.robust)
                cost = half * prior.robust * wp.log(one + two * cost / prior.robust)
            if prior.sigma_common > zero and world.acts[i] == 1:
                ratio = factor / prior.sigma_common
                cost += half * ratio * ratio / count
            turn = times_inverse_jacobian(vec3(e[3], e[4], e[5]), vec3(He[3], He[4], He[5]))
            state.pose[i] = cost
            state.pose_slope[i] = slope
            if world.acts[i] == 1:
                information += slope * prior.curvature[i]
            state.pose_gradient[i] = slope * join(vec3(He[0], He[1], He[2]), turn)
        state.information[image] = information

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
        best = far
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
            for q in range(world.instance_start[i], world.instance_start[i + 1]):
                part = world.instance_part[q]
                height = level + wp.dot(up, parts.vertices[s.farthest(parts, part, -up)])
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
            slope = -wp.dot(normal, world.gravity[image])
            if slope >= support_slope:
                above = wp.max(lowest, zero) / slope
                if above <= options.reach and above < best:
                    best = above
                    best_plane = plane
                    best_instance = lowest_instance
        state.plane_cost[i] = cost
        state.plane_depth[i] = depth
        state.plane_gradient[i] = gradient
        if options.newton == 1:
            state.plane_curvature[i] = curvature
        state.plane_height[i] = best
        state.plane_best[i] = best_plane
        state.plane_instance[i] = best_instance

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

    @wp.func
    def may_fall(world: World, state: State, options: Options, who: wp.int32, onto: wp.int32):
        """How far down it is worth looking for what carries an entity; 0: not at all."""
        if who >= world.n_objects or options.gravity_weight == zero:
            return zero
        if world.falls[world.image[who]] == 0:
            return zero
        if onto < world.n_objects:
            if world.acts[onto] == 0:
                return zero
        return wp.min(state.plane_height[who], options.reach)

    @wp.func
    def fall_of(parts: Parts, a: wp.int32, b: wp.int32, R_a: mat33, t_a: vec3, R_b: mat33, t_b: vec3, g: vec3):
        """The fall of part a onto part b along g, poses and g in one frame."""
        back = wp.transpose(R_a)
        return fall(parts, make_pair(parts, a, b, back * R_b, back * (t_b - t_a)), back * g)

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
        state.row_drop_a[r] = far
        state.row_drop_b[r] = far
        travelled = state.moved[a] + state.moved[b]
        # a fall is never shorter than the distance
        if state.clear[r] - travelled > wp.max(limit_a, limit_b):
            return
        low = state.lower[i]
        high = state.upper[i]
        clear = apart(low, high, state.entity_lower[b], state.entity_upper[b])
        if clear > wp.max(limit_a, limit_b):
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
            if known > wp.max(best_a, best_b):
                clear = wp.min(clear, known)
                continue
            low_b = state.lower[j]
            high_b = state.upper[j]
            gap = apart(low, high, low_b, high_b)
            part_b = world.instance_part[j]
            inside = int(0)
            normal = vec3(zero, zero, zero)
            if gap <= reached:
                both = make_pair(parts, part_a, part_b, R, t)
                hint = state.slot_normal[slot]
                if wp.dot(hint, hint) == zero:
                    hint = across(parts, both)
                overlapping = int(0)
                if state.slot_clear[slot] == -one:
                    overlapping = 1
                d = distance(parts, both, hint, overlapping, zero, wp.where(options.smooth == 0, 1, 0))
                gap = d.value
                state.slot_normal[slot] = d.normal
                if gap <= reached:
                    inside = 1
                    normal = R_a * d.normal
                if gap < zero:
                    point = Points()
                    point.a = d.a
                    point.b = d.b
                    if options.smooth == 1:
                        point = smoothed(parts, both, d.normal, wobble)
                    slope = hinge_slope(-gap, options.softness)
                    cost += hinge(-gap, options.softness)
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
            clear = wp.min(clear, wp.max(gap, zero))
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
                if hit.status == HITS:
                    if hit.height > zero:
                        if hit.height < best_a and wp.dot(R_a * hit.normal, g) >= support_slope:
                            best_a = hit.height
                            onto_a = j
                    elif inside == 1 and wp.dot(normal, g) >= support_slope:
                        best_a = zero
                        onto_a = j
            if gap >= zero and gap < best_b and lands(low_b, high_b, low, high, best_b):
                hit = fall_of(parts, part_b, part_a, R_b, t_b, R_a, t_a, g)
                if hit.status == HITS:
                    if hit.height > zero:
                        if hit.height < best_b and wp.dot(R_b * hit.normal, g) >= support_slope:
                            best_b = hit.height
                            onto_b = j
                    elif inside == 1 and -wp.dot(normal, g) >= support_slope:
                        best_b = zero
                        onto_b = j
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
                if first == i:
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
            if count > 0:
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
                if moves == 1:
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
        if height > zero and height <= options.reach and options.gravity_weight > zero and world.grounded[image] == 1:
            softness = options.softness
            if other < 0:
                plane = state.plane_best[i]
                softness = plane_softness(world, state, options, options.gravity_weight, i, plane)
                up = wp.transpose(R) * world.plane_normal[plane]
                point = lowest_point(parts, world.instance_part[own_instance], -up, wobble, options.smooth)
                rate = -wp.dot(world.plane_normal[plane], g)
                slope = options.gravity_weight * hinge_slope(height, softness) / rate
                gradient += slope * join(world.plane_normal[plane], wp.cross(point, up))
                if options.newton == 1:
                    j = join(world.plane_normal[plane], wp.cross(point, up))
                    curvature += (slope / (height * rate)) * wp.outer(j, j)
            else:
                part_a = world.instance_part[own_instance]
                part_b = world.instance_part[other_instance]
                R_b = orthonormal(rotation(state.poses[other]))
                t_b = translation(state.poses[other])
                hit = fall_of(parts, part_a, part_b, R, t, R_b, t_b, g)
                back = wp.transpose(R)
                met = make_pair(parts, part_a, part_b, back * R_b, back * (t_b - t - hit.height * g))
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
        if height <= options.reach:
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

    @wp.kernel(enable_backward=False, module=module)
    def newton(world: World, prior: Prior, state: State, options: Options, fraction: real, step: wp.array(dtype=vec6)):
        """The Gauss-Newton step: blocks of objects, joined by the depth factor of their image."""
        i = wp.tid()
        image = world.image[i]
        if state.done[image] == 1:
            return
        shift = zero
        if prior.sigma_common > zero:
            numerator = zero
            denominator = options.pose_weight * state.information[image]
            for k in range(world.image_start[image], world.image_start[image + 1]):
                j = world.image_object[k]
                if world.acts[j] == 1:
                    numerator += state.follow_gradient[j]
                    denominator -= state.follow_follow[j]
            shift = -numerator / denominator
        step[i] = fraction * (shift * state.follow[i] - state.newton[i])

    @wp.kernel(enable_backward=False, module=module)
    def move(world: World, prior: Prior, state: State, options: Options, step: wp.array(dtype=vec6)):
        """Move the objects by their steps, no farther than allowed, and clear these."""
        i = wp.tid()
        x = step[i]
        step[i] = vec6()
        if state.done[world.image[i]] == 1:
            return
        dt = vec3(wp.dot(prior.scale[6 * i], x), wp.dot(prior.scale[6 * i + 1], x), wp.dot(prior.scale[6 * i + 2], x))
        dw = vec3(
            wp.dot(prior.scale[6 * i + 3], x), wp.dot(prior.scale[6 * i + 4], x), wp.dot(prior.scale[6 * i + 5], x)
        )
        reach = wp.length(dt) + wp.length(dw) * world.span[i]
        state.farthest[i] = reach
        if reach > options.max_step:
            dt = options.max_step / reach * dt
            dw = options.max_step / reach * dw
        R = rotation(state.poses[i]) * exp_so3(dw)
        t = translation(state.poses[i]) + dt
        state.poses[i] = mat44(
            R[0, 0], R[0, 1], R[0, 2], t[0],
            R[1, 0], R[1, 1], R[1, 2], t[1],
            R[2, 0], R[2, 1], R[2, 2], t[2],
            zero, zero, zero, one,
        )  # fmt: skip
        # a little more than exact arithmetic asks for
        state.moved[i] = state.moved[i] + real(1.001) * wp.min(reach, options.max_step)

    return SimpleNamespace(**locals())
