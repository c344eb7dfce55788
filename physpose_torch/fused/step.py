"""The step: Gauss-Newton's for all objects of an image, what it is solved with, and moving the objects by it."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.shapes import shapes
from physpose_torch.fused.world import world

__all__ = ["step"]


@functools.cache
def step(real: type) -> SimpleNamespace:
    """Functions and kernels in ``wp.float32`` or ``wp.float64``."""
    s, w = shapes(real), world(real)
    vec3, mat44, rotation, translation = s.vec3, s.mat44, s.rotation, s.translation
    World, Prior, Options, State, vec6, mat66 = w.World, w.Prior, w.Options, w.State, w.vec6, w.mat66
    module, zero, one, half = w.module, w.zero, w.one, w.half

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
    def newton(world: World, prior: Prior, state: State, options: Options, fraction: real, step: wp.array(dtype=vec6)):
        """The Gauss-Newton step: blocks of objects, joined by the depth factor of their image."""
        i = wp.tid()
        image = world.image[i]
        if state.done[image] == 1:
            return
        shift = zero
        if prior.sigma_common > zero and options.pose_weight > zero:
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
