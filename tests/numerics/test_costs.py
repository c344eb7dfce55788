"""Costs, reports and refinements of scenes of all sizes, wherever they are: finite, repeatable, true where truth is known."""

import contextlib
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from extremes import DTYPES, directions, hunted, powers, ranges, ring, rotations, scenes, sizes
from hypothesis import given
from hypothesis import strategies as st

from physpose_torch import se3
from physpose_torch.calibrate import observe
from physpose_torch.config import PhysicsConfig, RefinerConfig, Smoothing
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.resting import resting_poses
from physpose_torch.losses import PhysicsLoss, acting
from physpose_torch.prior import make_prior
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene

PAPER = replace(RefinerConfig.paper(), steps=20)
CONFIGS = {"descent": RefinerConfig(), "lm": RefinerConfig.lm(), "paper": PAPER}
COSTS = {
    "default": PhysicsConfig(),
    "paper": PAPER.physics,
    "fcl": PhysicsConfig(backend="fcl"),
    "gumbel": PhysicsConfig(smoothing=Smoothing("gumbel")),
}
EYE = torch.eye(3, dtype=torch.float64)


def same(a, b) -> bool:
    return torch.equal(torch.nan_to_num(a, nan=-1.0), torch.nan_to_num(b, nan=-1.0))


@pytest.mark.parametrize("config", COSTS.values(), ids=COSTS)
@hunted(12)
@given(scene=scenes(), dtype=st.sampled_from(DTYPES), off=st.sampled_from([0.0, 1e-3, 1.0]))
def test_costs_and_their_gradients_are_finite_and_repeat(config, scene, dtype, off):
    poses, scene = scene
    poses = poses.to(dtype).requires_grad_()
    measured = poses.detach().clone()
    measured[:, :3, 3] += off

    def computed():
        terms = PhysicsLoss(config)(poses, scene, measured=measured)
        return *terms, *torch.autograd.grad(terms.total.sum(), poses)

    for x, y in zip(computed(), computed(), strict=True):
        assert x.dtype == dtype
        assert bool(x.isfinite().all())
        assert torch.equal(x, y)
    assert all(bool((x >= 0).all()) for x in computed()[:4])


@hunted(15)
@given(scene=scenes(most=2), dtype=st.sampled_from(DTYPES))
def test_collisions_are_what_they_are_near_the_camera(scene, dtype):
    """Bit for bit: only how two bodies lie to each other enters."""
    poses, scene = scene
    poses, scene = poses.to(dtype), Scene(scene.objects)
    near = poses.clone()
    near[:, :3, 3] -= poses[0, :3, 3]

    def collision(poses):
        poses = poses.clone().requires_grad_()
        terms = PhysicsLoss()(poses, scene)
        return terms.collision.detach(), torch.autograd.grad(terms.total.sum(), poses)[0]

    assert all(torch.equal(x, y) for x, y in zip(collision(poses), collision(near), strict=True))


def test_boxes_that_hardly_overlap_are_seen_to_far_from_the_camera():
    """In float32 a kilometre away, coordinates are known to 0.1 mm, and as deep are these upright boxes in one another."""
    body, rng = Body.box((0.5, 0.5, 0.5), label="box"), np.random.default_rng(0)
    up = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(200, 3))), dim=1)
    axes = torch.cat([tangent_basis(up), up[:, None]], dim=1)
    t = torch.from_numpy(rng.uniform(500, 1000, (200, 3)))
    T = se3.from_rotation_translation(axes.mT, t).repeat_interleave(2, 0)
    T[1::2, :3, 3] += 0.4999 * axes[:, 0]
    T = T.float()
    near = T.clone()
    near[:, :3, 3] -= T[::2, :3, 3].repeat_interleave(2, 0)
    scene = Scene([body] * 400, image=torch.arange(400) // 2, gravity=up)
    far, near = (PhysicsLoss()(x, scene).collision for x in (T, near))
    assert float((near > 0).double().mean()) > 0.5
    assert torch.equal(far, near)


@hunted(20)
@given(scene=scenes(), dtype=st.sampled_from(DTYPES))
def test_reports_are_finite_repeat_and_can_be_read(scene, dtype):
    poses, scene = scene
    report, again = (physics_report(poses.to(dtype), scene) for _ in range(2))
    for name in ("penetration_static", "penetration_object", "gap", "stability_margin"):
        assert same(getattr(report, name), getattr(again, name))
        assert getattr(report, name).dtype == dtype
    assert bool(report.penetration.isfinite().all())
    assert not bool((report.gap < 0).any())
    assert report.status == again.status
    assert str(report) == str(again)
    assert len(report.to_dict()["objects"]) == len(scene)


@hunted(25)
@given(
    size=sizes,
    away=ranges,
    R=rotations(),
    side=directions,
    share=st.floats(0.1, 1.0),
    backend=st.sampled_from(["warp", "fcl"]),
    dtype=st.sampled_from(DTYPES),
)
def test_depths_of_identical_and_nested_boxes_are_what_geometry_says(size, away, R, side, share, backend, dtype):
    """One in the middle of another of the same shape must move by half of both along the shortest side to come out."""
    outer, inner = (Body.box([x * size, x * 0.8 * size, x * 0.5 * size], label="box") for x in (1.0, share))
    T = se3.from_rotation_translation(R, side * away).to(dtype).expand(2, 4, 4)
    report = physics_report(T, Scene([outer, inner]), backend=backend)
    expected = 0.5 * (1 + share) * 0.5 * size
    error = 16 * torch.finfo(dtype).eps * size + 1e-12
    assert bool(((report.penetration_object.double() - expected).abs() <= error).all())


@hunted(20)
@given(size=sizes, away=ranges, R=rotations(), side=directions, depth=st.sampled_from([-0.1, -1e-3, 0.0, 1e-3, 0.05]))
def test_links_of_a_chain_hang_in_each_other_without_touching(size, away, R, side, depth):
    """Two rings, each through the other's hole; apart by half a hole, until one is pulled onto the other's bar."""
    link = ring(size)
    free = 3 / 4 * size  # from the middle of the one to that of the other, when their bars meet
    T = se3.from_rotation_translation(R, side * away)
    across = se3.from_rotation_translation(
        torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64),
        torch.tensor([free + depth * size, 0.0, 0.0], dtype=torch.float64),
    )
    apart = torch.stack([T, T @ across])
    # what T @ across rounds away far from the camera is part of the poses
    given_ = float(R[:, 0] @ (apart[1] - apart[0])[:3, 3])
    report = physics_report(apart, Scene([link, link]))
    error = (
        64 * torch.finfo(torch.float64).eps * size
        + float((apart[1] - apart[0] - (T @ across - T))[:3, 3].norm())
        + 1e-12
    )
    lateral = float(((apart[1] - apart[0])[:3, 3] - given_ * R[:, 0]).norm())
    expected = max(given_ - free, 0.0)
    if expected < size / 16:  # then out along the same way is the shortest
        assert float((report.penetration_object - expected).abs().max()) <= error + 2 * lateral
    terms = PhysicsLoss()(apart, Scene([link, link]))
    assert bool((terms.collision <= expected + error + 2 * lateral).all())


@hunted(15)
@given(size=sizes, up=directions, away=powers(-9, 9), heights=st.tuples(*[st.sampled_from([-0.2, 0.0, 1e-3, 0.3])] * 2))
def test_heights_of_boxes_over_a_plane_are_exact_to_rounding(size, up, away, heights):
    body = Body.box([size, size / 2, size / 4], label="box")
    x = torch.linalg.cross(up, EYE[int(up.abs().argmin())])
    x = x / x.norm()
    R = torch.stack([x, torch.linalg.cross(up, x), up], dim=1)
    base = away * up + 0.3 * away * x
    offset = up @ base
    places = [base + 3 * i * size * x + (size / 8 + h * size) * up for i, h in enumerate(heights)]
    poses = torch.stack([se3.from_rotation_translation(R, p) for p in places])
    report = physics_report(poses, Scene.tabletop([body, body], Plane(up, offset)))
    error = 16 * torch.finfo(torch.float64).eps * (2 * away + 4 * size) + 1e-12
    for i, h in enumerate(heights):
        depth, gap = max(-h * size, 0.0), max(h * size, 0.0)
        assert abs(float(report.penetration_static[i]) - depth) <= error
        if gap < 0.99:
            assert abs(float(report.gap[i]) - gap) <= error


@hunted(20)
@given(scene=scenes())
def test_what_estimates_say_is_positive_definite_at_any_distance(scene):
    poses, scene = scene
    for config in (PhysicsConfig(), PAPER.physics):
        prior = make_prior(poses, scene, acting(scene, None), None, config)
        assert bool((torch.linalg.eigvalsh(prior.precision) > 0).all())
        assert bool((torch.linalg.eigvalsh(torch.linalg.inv(prior.precision)) > 0).all())


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@hunted(8)
@given(scene=scenes(powers(-9, 2)), dtype=st.sampled_from(DTYPES))
def test_refinements_of_scenes_of_any_size_are_finite_repeat_and_leave_alone_exactly(config, scene, dtype):
    poses, scene = scene
    poses = poses.to(dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if bool((torch.linalg.vector_norm(poses[:, :3, 3].double(), dim=1) > 100).any()):
            with contextlib.suppress(InvalidInputError):  # what is small and farther than 100 m is refused
                PhysPoseRefiner(config)(poses, scene)
            return
        result, again = (PhysPoseRefiner(config)(poses, scene) for _ in range(2))
    assert result.poses.dtype == dtype
    assert torch.equal(result.poses, again.poses)
    se3.check_rigid(result.poses, "refined")
    kept = result.rejected | result.unsupported | result.doubted[scene.image]
    assert torch.equal(result.poses[kept], poses[kept])
    assert all(bool(x.isfinite().all()) for x in result.terms)
    variance = torch.linalg.eigvalsh(result.covariance.double())
    assert bool(
        (variance[:, 0] > -8 * torch.finfo(dtype).eps * variance[:, -1]).all()
    )  # in float32 it is rounded to that
    assert dtype == torch.float32 or bool((variance > 0).all())


@pytest.mark.parametrize("factor", [0.02, 1.0, 50.0, 1000.0])
def test_objects_of_a_millimetre_to_a_hundred_metres_come_to_rest(factor, table):
    """Boxes of 0.1 m times the factor, estimated 2 % too far away, which is inside the plane."""
    body = Body.box((0.1 * factor, 0.06 * factor, 0.04 * factor), label="box")
    plane = Plane(table.plane.normal, table.plane.offset * factor)
    poses = table.poses((0, 0, 0.02), (0.2, 0, 0.02))
    poses[:, :3, 3] *= 1.02 * factor
    result = PhysPoseRefiner()(poses, Scene.tabletop([body, body], plane))
    assert not bool(result.rejected.any())
    assert float(result.report.penetration.max()) < 5e-4 * max(1, factor)
    assert float(result.report.gap.max()) < 1e-3 * max(1, factor)


def test_what_is_small_and_far_away_is_refused_and_what_is_large_is_not(table):
    big, small = Body.box((20.0, 20.0, 20.0), label="house"), Body.box((0.2, 0.2, 0.2), label="box")
    T = table.at()[None].clone()
    T[:, :3, 3] = torch.tensor([0.0, 0.0, 300.0])
    PhysPoseRefiner()(T, Scene([big]))
    with pytest.raises(InvalidInputError, match=r"poses\[\.\.\., 0\] \(box\) is 300 m from the camera.*millimetres"):
        PhysPoseRefiner()(T, Scene([small]))


@hunted(15)
@given(size=sizes, away=powers(-3, 9), high=st.sampled_from([-0.1, 0.0, 0.2]))
def test_what_calibration_observes_is_how_much_too_high_a_box_is(size, away, high):
    body = Body.box([size, 0.9 * size, 0.8 * size], label="box")
    up = torch.tensor([0.0, -0.8, -0.6], dtype=torch.float64)
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    base = torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64) * away
    T = se3.from_rotation_translation(
        torch.stack([x, torch.linalg.cross(up, x), up], dim=1), base + (0.4 + high) * size * up
    )[None]
    observed = observe(T, Scene.tabletop([body], Plane(up, up @ base)))
    assert all(bool(c.isfinite().all()) for c in observed[:-1])
    if abs(high) * size < 0.25:
        error = 16 * torch.finfo(torch.float64).eps * (2 * away + 2 * size)
        assert abs(float(observed.rise[0]) - high * size) <= error
        assert float(observed.tilt[0]) < 1e-7


@hunted(20)
@given(size=sizes, extents=st.tuples(*[st.floats(0.3, 1.0)] * 3), slender=st.floats(0.02, 1.0))
def test_bodies_of_all_sizes_know_their_shape(size, extents, slender):
    lengths = [size * e for e in extents]
    body = Body.box(lengths, label="box")
    assert float(body.center_of_mass.abs().max()) < 1e-9 * size
    assert body.radius == pytest.approx(0.5 * np.linalg.norm(lengths))
    rest = resting_poses(body)
    assert len(rest.up) == 6
    for up, height in zip(rest.up, rest.height, strict=True):
        assert float(height) == pytest.approx(0.5 * lengths[int(up.abs().argmax())])
    can = Body.cylinder(0.5 * size * slender, size, label="can")
    assert can.parts.to_trimesh()[0].volume == pytest.approx(can.mesh.volume)
    assert float(can.upper[2]) == pytest.approx(0.5 * size)
    assert can.mesh.is_watertight
