"""The cost of leaving the estimates, robust, common depth factor eliminated; and which images have come to rest."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes
from physpose_torch.fused.world import world
from physpose_torch.prior import REWEIGHTINGS

__all__ = ["prior"]


@functools.cache
def prior(real: type) -> SimpleNamespace:
    """Functions and the kernel in ``wp.float32`` or ``wp.float64``."""
    s, w = shapes(real), world(real)
    vec3, mat33, mat44, rotation, translation = s.vec3, s.mat33, s.mat44, s.rotation, s.translation
    World, Prior, Options, State, vec6, join = w.World, w.Prior, w.Options, w.State, w.vec6, w.join
    module, zero, one, half, two = w.module, w.zero, w.one, w.half, w.two

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

    return SimpleNamespace(**locals())
