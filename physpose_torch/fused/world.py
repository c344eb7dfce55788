"""What the kernels of the cost read and write: world, estimates, options, state; and what all of them compute with."""

import functools
from types import SimpleNamespace

import warp as wp

from physpose_torch.distance.kernels.pair import OPTIONS
from physpose_torch.distance.kernels.shapes import shapes

__all__ = ["world"]


@functools.cache
def world(real: type) -> SimpleNamespace:
    """Structs and functions in ``wp.float32`` or ``wp.float64``, and the one Warp module that all kernels are in."""
    s = shapes(real)
    vec3, mat33, mat44 = s.vec3, s.mat33, s.mat44
    vec6 = wp.types.vector(6, real)
    mat66 = wp.types.matrix((6, 6), real)
    module = wp.get_module(f"physpose_torch.fused.{real.__name__}")
    module.options |= OPTIONS
    zero, one, half, two = real(0.0), real(1.0), real(0.5), real(2.0)
    far = real(1e30)

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
        paper: wp.int32
        """Whether gravity is the paper's: the mean height of an object's parts above a plane, and none in contact."""
        margin: real
        """Parts nearer than this count as in contact then; else 0."""
        softness: real
        contact_variance: real
        """Of the gap between two objects in contact."""
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
        reach: wp.array(dtype=real)
        """How far down what carries each object is looked for."""
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
        """How far each object falls onto a plane; in the paper's form the mean height of its parts above one."""
        plane_best: wp.array(dtype=wp.int32)
        plane_instance: wp.array(dtype=wp.int32)
        clear: wp.array(dtype=real)
        """A row's parts are this far apart less what their entities have moved in all."""
        slot_clear: wp.array(dtype=real)
        """Likewise each pair of parts; -1: they overlapped when last looked at."""
        slot_aside: wp.array(dtype=real)
        """Likewise, but across gravity: neither falls onto the other."""
        slot_normal: wp.array(dtype=vec3)
        """The normal found then."""
        row_cost: wp.array(dtype=real)
        row_count: wp.array(dtype=wp.int32)
        row_depth: wp.array(dtype=real)
        row_touches: wp.array(dtype=wp.int32)
        """Whether any pair of a row's parts is nearer than the margin."""
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
    def contact_softness(world: World, options: Options, weight: real, other: wp.int32):
        """ζσ² of an object's contact with another entity, at least the usual softness: ζ d²/2w is d²/2σ² then."""
        if other < world.n_objects:
            return wp.max(options.softness, weight * options.contact_variance)
        return options.softness

    return SimpleNamespace(**locals())
