"""What would fall over is turned to stand; what stands, leans on something or is held by something unseen stays as it is."""

import math

import numpy as np
import pytest
import torch
import trimesh

from physpose_torch.config import PhysicsConfig, RefinerConfig
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.geometry.resting import resting_poses
from physpose_torch.losses import PhysicsLoss
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene, Static

SOLVERS = [RefinerConfig(), RefinerConfig.lm()]


@pytest.fixture(scope="module")
def slab() -> Body:
    """A book: 120 × 160 × 30 mm."""
    return Body.box((0.12, 0.16, 0.03), label="slab")


def up_of(table, T):
    """Angle between the object's z axis and the table's normal [rad]."""
    return float(torch.arccos((T[..., :3, 2] @ table.up).clamp(-1, 1)))


def balanced_on_an_edge(table, angle, extents=(0.12, 0.16, 0.03)):
    """A slab on its long edge, tilted so that its mass is beside it: nothing holds it."""
    x, _, z = (0.5 * e for e in extents)
    return table.at(0, 0, x * math.sin(angle) + z * math.cos(angle), (0, angle, 0))


# ---- stable poses


def test_a_box_stands_on_its_six_faces_the_lowest_first(slab):
    rest = resting_poses(slab)
    assert len(rest.up) == 6
    torch.testing.assert_close(rest.height.sort().values, torch.tensor([0.015] * 2 + [0.06] * 2 + [0.08] * 2).double())
    assert float(rest.height[0]) == pytest.approx(0.015)
    torch.testing.assert_close(rest.apart, torch.full((6,), math.pi / 2, dtype=torch.float64))
    torch.testing.assert_close(rest.up.abs().sum(1), torch.ones(6, dtype=torch.float64))


def test_a_can_stands_on_its_ends_and_a_ball_nowhere(can):
    rest = resting_poses(can)
    assert sorted(rest.up[:, 2].tolist()) == pytest.approx([-1, 1])
    ball = Body("ball", can.parts, trimesh.creation.icosphere(3, 0.04))
    assert len(resting_poses(ball).up) == 0


def test_a_face_that_the_mass_is_not_above_is_none_to_stand_on(angle):
    """An L: its foot, its back, both sides, and the hull's slope; not the top of its post."""
    ups = resting_poses(angle).up
    post_down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    mass = torch.from_numpy(angle.mesh.center_mass)
    assert float(mass[0]) > 0.03  # beside the post's 30 mm
    assert float((ups @ post_down).max()) < 0.99
    assert float((ups @ -post_down).max()) == pytest.approx(1.0)


def test_stable_poses_are_where_a_dense_search_finds_the_least_heights():
    """Local minima over all directions of how high the mass is, of random hulls."""
    for seed in range(4):
        points = np.random.default_rng(seed).normal(size=(14, 3)) * [0.05, 0.04, 0.03]
        mesh = trimesh.convex.convex_hull(points)
        body = Body("rock", Body.box((0.1, 0.1, 0.1), label="").parts, mesh)
        v = mesh.vertices - mesh.center_mass
        height = lambda u, v=v: -(u @ v.T).min(1)  # noqa: E731
        for up in resting_poses(body).up.numpy():
            near = np.random.default_rng(1).normal(size=(400, 3)) * 0.02 + up
            near /= np.linalg.norm(near, axis=1, keepdims=True)
            assert height(up[None])[0] <= height(near).min() + 1e-12


# ---- righting


@pytest.mark.parametrize("config", SOLVERS, ids=["descent", "lm"])
@pytest.mark.parametrize("degrees", [25, 50])
def test_what_would_fall_over_is_turned_to_its_nearest_stable_pose(table, slab, config, degrees):
    T = balanced_on_an_edge(table, math.radians(degrees))[None]
    result = PhysPoseRefiner(config)(T, Scene.tabletop([slab], table.plane))
    assert result.righted.tolist() == [True]
    nearest = 0 if degrees < 45 else 90
    assert math.degrees(up_of(table, result.poses[0])) == pytest.approx(nearest, abs=3)
    assert float(result.report.penetration.max()) < 1e-3
    # the estimate's centre is 24 mm too high for lying flat; so few steps of lm do not quite bring it down
    assert float(result.report.gap.max()) < (1e-3 if config.solver == "descent" else 5e-3)
    assert bool(result.report.stable.all())
    # it stays where it was seen
    assert float((table.where(result.poses) - table.where(T))[..., :2].norm()) < 0.03


@pytest.mark.parametrize("config", SOLVERS, ids=["descent", "lm"])
def test_what_stands_or_is_askew_by_little_is_not_touched_by_it(table, slab, can, config):
    T = table.poses((0, 0, 0.015), (0.2, 0, 0.04, (0.1, 0, 0)), (-0.2, 0, 0.012, (0, 0.05, 0.4)))
    scene = Scene.tabletop([slab, can, slab], table.plane)
    with_it = PhysPoseRefiner(config)(T, scene)
    without = PhysPoseRefiner(type(config)(**{**vars(config), "righting": 0.0}))(T, scene)
    assert not with_it.righted.any()
    torch.testing.assert_close(with_it.poses, without.poses, atol=0, rtol=0)


def test_what_leans_on_something_stays(table, slab):
    """Against a static wall, and against a heavy neighbour."""
    tilt = math.radians(60)
    T = balanced_on_an_edge(table, tilt)
    corner = table.where(T)[0] - 0.06 * math.cos(tilt) - 0.015 * math.sin(tilt)
    wall = Body.box((0.05, 0.4, 0.3), label="wall")
    pose = table.at(float(corner) - 0.025, 0, 0.15)
    config = RefinerConfig()
    held = PhysPoseRefiner(config)(T[None], Scene([slab], [Static(table.plane), Static(wall, pose)], gravity=table.gravity))
    alone = PhysPoseRefiner(config)(T[None], Scene.tabletop([slab], table.plane))
    other_way = table.at(-float(corner) + 0.025, 0, 0.15)
    beside = Scene([slab], [Static(table.plane), Static(wall, other_way)], gravity=table.gravity)
    assert not held.righted.any()
    assert alone.righted.all()
    assert abs(math.degrees(up_of(table, held.poses[0])) - 60) < 6
    assert PhysPoseRefiner(config)(T[None], beside).righted.numel() == 1


@pytest.mark.parametrize(("height", "degrees", "limit"), [(0.10, 40, 75), (0.0, 40, 30), (0.0, 40, 0)])
def test_what_hangs_high_or_is_beyond_the_limit_stays(table, slab, height, degrees, limit):
    T = balanced_on_an_edge(table, math.radians(degrees))
    T[:3, 3] += height * table.up
    config = RefinerConfig(righting=math.radians(limit))
    result = PhysPoseRefiner(config)(T[None], Scene.tabletop([slab], table.plane))
    assert not result.righted.any()
    assert abs(math.degrees(up_of(table, result.poses[0])) - degrees) < 8


def test_without_gravity_nothing_falls(table, slab):
    T = balanced_on_an_edge(table, 0.7)
    result = PhysPoseRefiner()(T[None], Scene([slab], [Static(table.plane)]))
    assert not result.righted.any()


def test_who_would_be_turned_into_a_neighbour_is_not(table, slab):
    """Wedged between two bricks that do not carry it: lying flat it would be inside both."""
    T = balanced_on_an_edge(table, math.radians(40))
    brick = Body.box((0.02, 0.3, 0.02), label="kerb")
    spots = [table.at(x, 0, 0.01) for x in (-0.055, 0.055)]
    statics = [Static(table.plane), *(Static(brick, p) for p in spots)]
    result = PhysPoseRefiner()(T[None], Scene([slab], statics, gravity=table.gravity))
    if not result.righted.any():
        assert abs(math.degrees(up_of(table, result.poses[0])) - 40) < 15
    assert float(result.report.penetration.max()) < 0.003


@pytest.mark.parametrize("config", [RefinerConfig(keep_trajectory=True), RefinerConfig.lm()], ids=["descent", "lm"])
def test_other_images_of_the_batch_are_not_changed_and_hypotheses_are_alone(table, slab, can, config):
    fallen = balanced_on_an_edge(table, 0.7)
    upright = table.at(0, 0.01, 0.038, (0.05, 0.02, 0))
    one, two = Scene.tabletop([slab], table.plane), Scene.tabletop([can], table.plane)
    refiner = PhysPoseRefiner(config)
    both = refiner(torch.stack([fallen, upright]), Scene.cat([one, two]))
    a, b = refiner(fallen[None], one), refiner(upright[None], two)
    assert both.righted.tolist() == [True, False]
    torch.testing.assert_close(both.poses, torch.cat([a.poses, b.poses]), atol=1e-12, rtol=0)
    torch.testing.assert_close(both.steps, torch.cat([a.steps, b.steps]))
    for name in ("pose", "collision", "gravity", "total"):
        each = torch.cat([getattr(a.terms, name), getattr(b.terms, name)])
        torch.testing.assert_close(getattr(both.terms, name), each, atol=1e-9, rtol=0)
    hypotheses = refiner(torch.stack([fallen[None], balanced_on_an_edge(table, 0.02)[None]]), one)
    assert hypotheses.righted.tolist() == [[True], [False]]
    torch.testing.assert_close(hypotheses.poses[0], a.poses, atol=1e-12, rtol=0)
    if config.keep_trajectory:
        torch.testing.assert_close(both.trajectory[-1], both.poses)
        torch.testing.assert_close(both.trajectory[0], torch.stack([fallen, upright]))
        assert int(both.steps.max()) <= len(both.trajectory)


def test_the_callers_dtype_comes_back(table, slab):
    T = balanced_on_an_edge(table, 0.7)[None].float()
    result = PhysPoseRefiner()(T, Scene.tabletop([slab], table.plane))
    assert result.righted.tolist() == [True]
    assert result.poses.dtype == torch.float32


@pytest.mark.parametrize("config", SOLVERS, ids=["descent", "lm"])
@pytest.mark.parametrize("extents", [(0.3, 0.3, 0.02), (0.2, 0.25, 0.05), (0.12, 0.12, 0.03)])
@pytest.mark.parametrize("lift", [0.0, 0.015])
def test_what_is_righted_comes_to_rest_and_does_not_hang_in_the_air(table, config, extents, lift):
    """A large board's centre is far higher on its edge than lying."""
    T = balanced_on_an_edge(table, math.radians(40), extents)
    T[:3, 3] += lift * table.up
    board = Body.box(extents, label="board")
    result = PhysPoseRefiner(config)(T[None], Scene.tabletop([board], table.plane))
    assert result.righted.all()
    assert float(result.report.gap.max()) < 5e-3
    assert math.degrees(up_of(table, result.poses[0])) < 2


def test_turning_costs_what_the_estimate_says(table, slab):
    """So of two hypotheses the one that needed no turning is the better."""
    good = table.at(0, 0, 0.015)
    good[:3, 3] *= 1.02
    hypotheses = torch.stack([good, balanced_on_an_edge(table, math.radians(35))])[:, None]
    scene = Scene.tabletop([slab], table.plane)
    result = PhysPoseRefiner()(hypotheses, scene)
    assert result.righted.tolist() == [[False], [True]]
    expected = PhysicsLoss()(result.poses, scene, measured=hypotheses)
    torch.testing.assert_close(result.terms.pose, expected.pose)
    torch.testing.assert_close(result.terms.total, expected.total)
    torch.testing.assert_close(result.best(), result.poses[0])


def test_what_leans_on_a_vertical_plane_stays(table, slab):
    tilt = math.radians(60)
    T = balanced_on_an_edge(table, tilt)
    x = table.T[:3, 0]
    reach = 0.06 * math.cos(tilt) + 0.015 * math.sin(tilt)
    wall = Plane(x, x @ T[:3, 3] - reach)
    held = Scene([slab], [Static(table.plane), Static(wall)], gravity=table.gravity)
    assert not PhysPoseRefiner()(T[None], held).righted.any()


@pytest.mark.parametrize("change", [{"steps": 0}, {"physics": PhysicsConfig(gravity_weight=0.0)}])
def test_without_gravity_in_the_cost_or_without_steps_nothing_is_righted(table, slab, change):
    T = balanced_on_an_edge(table, 0.7)[None]
    assert not PhysPoseRefiner(RefinerConfig(**change))(T, Scene.tabletop([slab], table.plane)).righted.any()


def test_a_mesh_without_volume_stands_nowhere(table, box):
    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]], [[0, 1, 2]], process=False)
    body = Body("sheet", box.parts, sheet)
    assert len(resting_poses(body).up) == 0
    assert not PhysPoseRefiner()(balanced_on_an_edge(table, 0.7)[None], Scene.tabletop([body], table.plane)).righted.any()


def test_upside_down_is_turned_too_where_nothing_nearer_is_stable(table):
    """A cone on its tip, and a limit of half a turn."""
    mesh = trimesh.creation.cone(radius=0.05, height=0.08, sections=24)
    mesh.apply_translation(-mesh.bounds.mean(0))
    cone = Body("cone", ConvexParts.from_hulls([np.array(mesh.vertices)]), mesh)
    T = table.poses((0, 0, 0.04, (math.pi, 0, 0)))
    result = PhysPoseRefiner(RefinerConfig(righting=math.pi))(T, Scene.tabletop([cone], table.plane))
    assert result.righted.all()
    assert math.degrees(up_of(table, result.poses[0])) < 3
