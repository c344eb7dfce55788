"""The paper's gravity in the kernels: the same as the general cost, wherever its switches and choices lie."""

from dataclasses import replace

import pytest
import torch

from physpose_torch import se3
from physpose_torch.config import PhysicsConfig, RefinerConfig, Smoothing
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.losses import acting
from physpose_torch.prior import make_prior
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static
from physpose_torch.solvers.descent import descend, make_cost
from physpose_torch.solvers.general import GeneralCost

pytest.importorskip("warp")
from test_fused import (
    EYE,
    assert_equal_values,
    assert_same_cost,
    bodies,
    clutter,
    covariances,
    evaluated,
    general,
    household,
    make,
    remote,
    ring,
    shaken,
    values,
    walk,
)

from physpose_torch.fused import FusedCost

__all__ = ["bodies", "general", "household", "remote", "ring"]  # fixtures


def paper(**options) -> RefinerConfig:
    """The default cost, the paper's gravity."""
    return RefinerConfig(PhysicsConfig(gravity="paper", **options))


PRESET = RefinerConfig.paper()
OPTIONS = {
    "preset": PRESET.physics,
    "default": PhysicsConfig(gravity="paper"),
    "no tolerance": PhysicsConfig(gravity="paper", contact_tolerance=0.0),
    "wide tolerance": PhysicsConfig(gravity="paper", contact_tolerance=0.02),
    "soft": replace(PRESET.physics, softness=0.05),
    "no gravity": PhysicsConfig(gravity="paper", gravity_weight=0.0),
    "gravity alone": PhysicsConfig(gravity="paper", pose_weight=0.0, collision_weight=0.0),
    "short reach": PhysicsConfig(gravity="paper", gravity_reach=1e-3),
    "ring": replace(PRESET.physics, smoothing=Smoothing("ring")),
    "exact gradient": replace(PRESET.physics, smoothing=Smoothing("none")),
}


def wall_of(table, *, turn=(0.0, 0.0, 0.0), back=0.1, covariance=None) -> Plane:
    """A wall beside the table, leaning by ``turn``."""
    normal = se3.exp_so3(torch.tensor(turn, dtype=torch.float64)) @ table.T[:3, 0]
    return Plane(normal, float(normal @ table.T[:3, 3]) - back, covariance)


@pytest.fixture(scope="module")
def room(table, bodies):
    """Seven images: tables with clutter, a floor and a wall, alternatives, an uncertain floor, and what lacks something."""
    rooms = [clutter(table, bodies, n, seed) for seed, n in enumerate((6, 5, 4, 5, 2, 2))]
    tilted = se3.exp_so3(torch.tensor([0.03, -0.05, 0.0], dtype=torch.float64)) @ table.up
    unsure = Plane(tilted, float(tilted @ table.T[:3, 3]) - 0.01, 1e-4 * EYE[:3, :3])
    full = covariances(1, 3)[0, :3, :3]
    floor, g = Static(table.plane), table.gravity
    scenes = [
        Scene(rooms[0][0], [floor], gravity=g),
        Scene.tabletop([], table.plane),
        Scene(rooms[1][0], [Static(wall_of(table)), floor], gravity=g),
        Scene(rooms[2][0], [floor], gravity=g, same_object=torch.tensor([0, 1, 0, 0])),
        Scene(
            rooms[3][0],
            [Static(unsure), Static(wall_of(table, turn=(0, -0.4, 0), covariance=full + full.mT + 1e-4 * EYE[:3, :3]))],
            gravity=g,
        ),
        Scene(rooms[4][0], gravity=g),
        Scene(rooms[5][0], [floor]),
    ]
    return torch.cat([poses for _, poses in rooms]), Scene.cat(scenes)


# ---- 1. one evaluation


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("seed", range(2))
def test_images_of_every_kind(name, seed, room):
    measured, scene = room
    scores = torch.rand(len(scene), generator=torch.Generator().manual_seed(seed))
    assert_same_cost(measured, scene, shaken(measured, seed), RefinerConfig(OPTIONS[name]), scores=scores)


def test_the_room_has_what_it_is_meant_to_have(room):
    """Objects that are pulled, that collide, and that are only near something."""
    measured, scene = room
    terms, _ = assert_same_cost(measured, scene, None, PRESET)
    wide, _ = assert_same_cost(measured, scene, None, paper(contact_tolerance=0.02))
    pulled = terms[2] > 0
    assert int(pulled.sum()) >= 5
    assert int((terms[1] > 0).sum()) >= 5
    assert bool((pulled & (wide[2] == 0)).any())
    assert float(terms[2].max()) > 0.05


@pytest.mark.parametrize("seed", range(4))
def test_cluttered_tables(seed, table, bodies):
    made = [clutter(table, bodies, n, 10 * seed + n, spread=0.2, height=0.4) for n in (6, 1, 4)]
    measured = torch.cat([poses for _, poses in made])
    scene = Scene.cat([Scene.tabletop(objects, table.plane) for objects, _ in made])
    terms, _ = assert_same_cost(measured, scene, shaken(measured, seed), PRESET)
    assert float(terms[2].max()) > 0.1


@pytest.mark.parametrize("gap", [-1e-3, 0.0, 0.9e-4, 1.1e-4, 5e-4, 0.01])
def test_the_switch_is_at_the_tolerance(gap, table, box):
    """Over the table, beside another object and on top of one: pulled beyond 0.1 mm."""
    at = [
        table.poses((0, 0, 0.02 + gap), (0.4, 0, 0.2)),
        table.poses((0, 0, 0.2), (0.001, 0.06 + gap, 0.21)),
        table.poses((0, 0, 0.2), (0.01, 0, 0.24 + gap, (0, 0, 0.3))),
    ]
    scene = Scene.tabletop([box, box], table.plane)
    for k, poses in enumerate(at):
        terms, _ = assert_same_cost(poses, scene, None, PRESET)
        assert bool(terms[2, 0] > 0) == (gap > 1e-4), k
        assert bool(terms[2, 1] > 0) == (gap > 1e-4 or k == 0), k


@pytest.mark.parametrize("scores", [[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]], ids=str)
def test_an_alternative_that_pushes_nobody_holds_nobody_up(scores, table, box, can):
    """A can stands on one alternative of a box; the other one hangs elsewhere."""
    scene = Scene([box, box, can], [Static(table.plane)], gravity=table.gravity, same_object=torch.tensor([0, 0, 1]))
    poses = table.poses((0, 0, 0.2), (0, 0.3, 0.2), (0, 0, 0.26 + 5e-5))
    terms, _ = assert_same_cost(poses, scene, None, PRESET, scores=torch.tensor(scores))
    assert bool(terms[2, 2] > 0) == (scores[0] == 0.0)


@pytest.mark.parametrize("height", [0.03, 0.08, 0.5, 3.0])
def test_the_mean_height_of_the_parts(height, table, ring):
    """A tub of nine parts upright: the bottom 1 mm below the staves' lower ends."""
    poses = table.poses((0, 0, height))
    terms, gradient = assert_same_cost(poses, Scene.tabletop([ring], table.plane), None, paper(pose_weight=0.0))
    staves = sum(1e-4 * k for k in range(8))
    torch.testing.assert_close(float(terms[2, 0]), height + (staves - 0.001) / 9 - 2.5e-4, atol=1e-9, rtol=0)
    torch.testing.assert_close(gradient[0, :3], 200 * table.up, atol=1e-9, rtol=0)


@pytest.mark.parametrize("softness", [0.0, 0.3])
def test_gradients_are_differences_of_the_cost(softness, room):
    """Without collisions an object's cost depends on its own pose alone, so that all may move at once."""
    measured, scene = room
    config = RefinerConfig(replace(OPTIONS["exact gradient"], softness=softness, collision_weight=0.0))
    poses, step = shaken(measured, 3), 1e-6
    terms, gradient = evaluated(FusedCost, measured, scene, poses, config)
    assert int((terms[2] > 0).sum()) >= 5
    for k in range(6):
        ends = [
            evaluated(
                FusedCost, measured, scene, se3.retract(poses, sign * step * EYE[k].expand(len(poses), 6)), config
            )
            for sign in (1, -1)
        ]
        difference = (ends[0][0][3] - ends[1][0][3]) / (2 * step)
        torch.testing.assert_close(gradient[:, k], difference, atol=1e-5, rtol=1e-5)


# ---- 2. descents


@pytest.mark.parametrize("smoothing", ["gaussian", "none"])
def test_descents_of_the_preset_agree(smoothing, household, room, general):
    physics = replace(PRESET.physics, smoothing=Smoothing(smoothing))
    refiner = PhysPoseRefiner(replace(PRESET, physics=physics, steps=30, learning_rate=1e-3, keep_trajectory=True))
    for poses, scene in (household, room):
        options = {"scores": torch.linspace(1, 2, len(scene))}
        fused, expected = refiner(poses, scene, **options), general(refiner, poses, scene, **options)
        torch.testing.assert_close(fused.trajectory, expected.trajectory, atol=1e-9, rtol=0)
        assert fused.steps.tolist() == expected.steps.tolist()
        for a, b in zip(fused.terms, expected.terms, strict=True):
            torch.testing.assert_close(a, b, atol=1e-8, rtol=1e-8)


def test_adam_with_the_papers_gravity_agrees(household, general):
    refiner = PhysPoseRefiner(replace(paper(), steps=20))
    fused, expected = refiner(*household), general(refiner, *household)
    torch.testing.assert_close(fused.poses, expected.poses, atol=1e-6, rtol=0)


def test_what_is_reported_after_the_papers_descent_is_what_is(room):
    """The supports of the report are not the paper's, and what the descent remembers does not mislead it."""
    measured, scene = room
    acts = acting(scene, None)
    config = replace(PRESET, steps=20, learning_rate=1e-3)
    result = descend(make_prior(measured, scene, acts, None, config.physics), scene, acts, config)
    report = physics_report(result.poses, scene)
    seen = result.cost.measure(reach=1.0)
    torch.testing.assert_close(seen.depth_static, report.penetration_static, atol=1e-9, rtol=0)
    torch.testing.assert_close(seen.depth_object, report.penetration_object, atol=1e-9, rtol=0)
    some = report.gap.isfinite()
    torch.testing.assert_close(seen.height[some], report.gap[some], atol=1e-9, rtol=0)


# ---- 3. what is skipped cannot matter


@pytest.mark.parametrize("tolerance", [0.0, 1e-4, 0.01])
@pytest.mark.parametrize(
    "lengths", [[(2e-4, 2e-3)] * 40, [(1e-2, 0.2)] * 40, [(3e-3, 0.0)] * 40], ids=["slow", "fast", "sliding"]
)
def test_no_touch_is_missed_however_the_objects_move(lengths, tolerance, table, bodies):
    objects, poses = clutter(table, bodies, 6, 3, spread=0.12)
    scene = Scene(
        objects,
        [Static(table.plane), Static(wall_of(table))],
        gravity=table.gravity,
        same_object=torch.tensor([0, 1, 2, 3, 4, 3]),
    )
    config = replace(paper(contact_tolerance=tolerance), max_step=0.05, tolerance=0.0)
    _, hanging = walk(
        make(FusedCost, poses, scene, None, config),
        lambda at: make(FusedCost, poses, scene, at, config),
        lengths,
        seed=1,
    )
    if lengths[0][0] > 1e-3 and tolerance < 0.01:
        assert int((hanging[1:] != hanging[:-1]).sum()) > 5  # they come and go


def test_a_walk_agrees_with_the_general_cost(table, bodies):
    objects, poses = clutter(table, bodies, 5, 8, spread=0.1, height=0.2)
    scene = Scene.tabletop(objects, table.plane)
    config = replace(paper(contact_tolerance=2e-3), max_step=0.05, tolerance=0.0)
    walk(
        make(FusedCost, poses, scene, None, config),
        lambda at: make(GeneralCost, poses, scene, at, config),
        [(4e-3, 0.05)] * 25,
        seed=2,
        tolerance=1e-9,
    )


# ---- 4. when the kernels are used


def test_an_image_does_not_depend_on_the_others(household, room):
    config = PRESET
    poses, scene = torch.cat([room[0], household[0]]), Scene.cat([room[1], household[1]])
    terms, gradient = evaluated(FusedCost, poses, scene, None, config)
    first = evaluated(FusedCost, *room, None, config)
    second = evaluated(FusedCost, *household, None, config)
    assert torch.equal(terms, torch.cat([first[0], second[0]], dim=1))
    assert torch.equal(gradient, torch.cat([first[1], second[1]]))


def test_single_precision_is_near(room):
    args = (room[0], room[1], shaken(room[0], 9), PRESET)
    double, single = evaluated(FusedCost, *args), evaluated(FusedCost, *args, dtype=torch.float32)
    torch.testing.assert_close(single[0][1:3].double(), double[0][1:3], rtol=0, atol=2e-6)


def test_static_bodies_and_gauss_newton_are_left_to_the_general_path(table, box):
    floor, slab = Static(table.plane), Static(Body.box((0.1, 0.1, 0.02), label="slab"), table.at(0, 0, 0.01))
    poses = table.poses((0, 0, 0.1))
    for statics, kind in (([], FusedCost), ([floor], FusedCost), ([floor, slab], GeneralCost), ([slab], GeneralCost)):
        scene = Scene([box], statics, gravity=table.gravity)
        assert isinstance(make(make_cost, poses, scene, None, PRESET), kind)
    assert not FusedCost.fits(replace(PRESET, solver="lm"), Scene.tabletop([box], table.plane))


def test_nothing_in_nothing_out(table):
    nothing = torch.zeros(0, 4, 4, dtype=torch.float64)
    for scene in (Scene([]), Scene.tabletop([], table.plane), Scene([], n_images=3)):
        cost = make(FusedCost, nothing, scene, None, PRESET)
        cost.evaluate(0)
        assert bool(cost.done.all())
        assert_equal_values(values(cost), evaluated(GeneralCost, nothing, scene, None, PRESET), 0.0)
