"""The fused cost is the general one: terms, gradients and whole descents, whatever is in the images and whatever moved."""

from dataclasses import replace

import helpers
import numpy as np
import pytest
import torch
import trimesh

from physpose_torch import se3
from physpose_torch.config import PhysicsConfig, RefinerConfig, Smoothing
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.household import household_meshes, household_scene, perturb_like_estimator
from physpose_torch.losses import acting
from physpose_torch.prior import make_prior
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene, Static
from physpose_torch.solvers.descent import make_cost
from physpose_torch.solvers.general import STILL_STEPS, GeneralCost

pytest.importorskip("warp")
from physpose_torch.fused import FusedCost

TERMS = ("pose", "collision", "gravity", "total")
EYE = torch.eye(6, dtype=torch.float64)


# ---- what is compared


def make(kind, measured, scene, poses=None, config=None, *, scores=None, covariance=None, scale=None, dtype=None):
    """A cost of the given class where the descent would start with it, at ``poses``; measured: (N, 4, 4) float64."""
    config = config or RefinerConfig()
    acts = acting(scene, scores)
    prior = make_prior(measured, scene, acts, covariance, config.physics)
    poses = measured.clone() if poses is None else poses
    scale = EYE.expand(len(scene), 6, 6) if scale is None else scale
    if dtype is not None:
        floats = {name: getattr(prior, name).to(dtype) for name in ("measured", "precision", "ray")}
        prior, poses, scale = prior._replace(**floats), poses.to(dtype), scale.to(dtype)
    return kind(prior, scene, acts, config, poses, scale)


def values(cost):
    """All terms (4, N) and gradients (N, 6) at the last evaluation."""
    terms = cost.terms(torch.arange(len(cost.poses)))
    return torch.stack([getattr(terms, name) for name in TERMS]), cost.gradient.clone()


def evaluated(kind, *args, **options):
    cost = make(kind, *args, **options)
    cost.evaluate(0)
    return values(cost)


def assert_equal_values(actual, expected, tolerance):
    """Each term, and the gradient, to ``tolerance`` of the largest of its kind, or of 1."""
    for name, a, b in zip(TERMS, actual[0], expected[0], strict=True):
        size = max(1.0, float(b.abs().max()) if len(b) else 1.0)
        torch.testing.assert_close(a, b, atol=tolerance * size, rtol=0, msg=lambda m, name=name: f"{name}: {m}")
    size = max(1.0, float(expected[1].abs().max()) if len(expected[1]) else 1.0)
    torch.testing.assert_close(
        actual[1],
        expected[1],
        atol=tolerance * size,
        rtol=0,
        msg=lambda m: f"gradient: {m}\n{actual[1]}\n{expected[1]}",
    )


def assert_same_cost(measured, scene, poses=None, config=None, *, tolerance=1e-9, **options):
    """FusedCost equals GeneralCost; returns the values."""
    config = config or RefinerConfig()
    assert FusedCost.fits(config, scene)
    args = (measured, scene, poses, config)
    general = evaluated(GeneralCost, *args, **options)
    assert_equal_values(evaluated(FusedCost, *args, **options), general, tolerance)
    return general


def physics(**options) -> RefinerConfig:
    return RefinerConfig(PhysicsConfig(**options))


# ---- bodies and scenes


def block(x, y, z, at=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Corners of a box with these half side lengths [m]."""
    return helpers.box(x, y, z) + np.array(at)


def assemble(label, *hulls) -> Body:
    meshes = [trimesh.convex.convex_hull(h) for h in hulls]
    return Body(label, ConvexParts.from_hulls(hulls), trimesh.util.concatenate(meshes))


@pytest.fixture(scope="module")
def ring() -> Body:
    """A tub of eight staves and a bottom, 120 mm wide and 50 mm high, its origin under the bottom's centre."""
    staves = []
    for k in range(8):
        turn = trimesh.transformations.rotation_matrix(np.pi / 4 * k + 0.1, [0, 0, 1])[:3, :3]
        staves.append((block(0.004, 0.025, 0.025, at=[0.058, 0, 0.025 + 1e-4 * k])) @ turn.T)
    return assemble("ring", *staves, block(0.04, 0.04, 0.003, at=[0, 0, 0.002]))


@pytest.fixture(scope="module")
def remote() -> Body:
    """Two crossed slats, 0.3 m away from their body's origin."""
    far = [0.2, 0.2, 0.1]
    return assemble("remote", block(0.05, 0.01, 0.01, at=far), block(0.01, 0.04, 0.008, at=far))


@pytest.fixture(scope="module")
def bodies(box, can, angle, ring, remote):
    return box, can, angle, ring, remote


def clutter(table, bodies, count, seed, *, spread=0.12, height=0.14):
    """Bodies and poses (count, 4, 4) thrown onto the table: some in it, some in each other, some above."""
    rng = np.random.default_rng(seed)
    chosen = [bodies[k] for k in rng.integers(len(bodies), size=count)]
    where = rng.uniform([-spread, -spread, 0.0], [spread, spread, height], size=(count, 3))
    poses = table.poses(*((*xyz, turn) for xyz, turn in zip(where, rng.normal(size=(count, 3)), strict=True)))
    for i, body in enumerate(chosen):  # the place is that of the body's centre
        poses[i, :3, 3] -= poses[i, :3, :3] @ body.center
    return chosen, poses


def shaken(poses, seed, size=(0.004, 0.03)):
    noise = torch.randn(len(poses), 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return se3.retract(poses, noise * torch.tensor([size[0]] * 3 + [size[1]] * 3, dtype=torch.float64))


def covariances(count, seed=0):
    """(count, 6, 6) full, of the size of estimators' errors, translation and rotation correlated."""
    factor = torch.randn(count, 6, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    size = torch.tensor([0.003, 0.003, 0.01, 0.03, 0.05, 0.02], dtype=torch.float64)
    return size[:, None] * (factor @ factor.mT + 0.1 * EYE) * size


@pytest.fixture(scope="module")
def pile(table, bodies):
    """Six images: five, none, three, four, two and two objects, of which the last ones lack something."""
    tilted = se3.exp_so3(torch.tensor([0.03, -0.05, 0.0], dtype=torch.float64)) @ table.up
    sure, unsure = table.plane, Plane(tilted, float(tilted @ table.T[:3, 3]), 1e-4 * EYE[:3, :3])
    shelf = Static(Body.box((0.1, 0.3, 0.02), label="shelf"), table.at(0.05, 0, 0.04, (0, 0.05, 0.2)))
    objects, poses = zip(
        *(clutter(table, bodies, n, seed) for seed, n in enumerate((5, 0, 3, 4, 2, 2)) if n), strict=True
    )
    g = table.gravity
    scenes = [
        Scene(objects[0], [Static(sure)], gravity=g),
        Scene.tabletop([], sure),
        Scene(objects[1], [shelf, Static(unsure)], gravity=g, same_object=torch.tensor([0, 1, 0])),
        Scene(objects[2], [shelf], gravity=g),
        Scene(objects[3], gravity=g),
        Scene(objects[4], [Static(sure)]),
    ]
    return torch.cat(poses), Scene.cat(scenes)


# ---- 1. one evaluation


@pytest.mark.parametrize("seed", range(6))
def test_cluttered_tables(seed, table, bodies):
    """Three images of different sizes; poses and estimates differ."""
    made = [clutter(table, bodies, n, 10 * seed + n) for n in (6, 1, 4)]
    measured = torch.cat([poses for _, poses in made])
    scene = Scene.cat([Scene.tabletop(objects, table.plane) for objects, _ in made])
    terms, _ = assert_same_cost(measured, scene, shaken(measured, seed))
    assert bool((terms.amax(1) > 0).all())  # something hangs, something collides


@pytest.mark.parametrize("seed", range(3))
def test_images_of_every_kind_in_one_batch(seed, pile):
    """With and without planes, static bodies, gravity, objects and alternatives."""
    measured, scene = pile
    scores = torch.rand(len(scene), generator=torch.Generator().manual_seed(seed))
    assert_same_cost(measured, scene, shaken(measured, seed), scores=scores)


def test_gravity_without_statics_pulls_nothing(table, box):
    scene = Scene([box, box], gravity=table.gravity)
    terms, _ = assert_same_cost(table.poses((0, 0, 0.02), (0.01, 0.01, 0.07)), scene)
    assert not bool(terms[2].any())


def test_shelves_of_static_bodies(table, box, can, ring):
    """Objects over, in and beside a tilted shelf of two boards and a tub that does not move; no plane at all."""
    shelf = assemble("shelf", block(0.15, 0.1, 0.01), block(0.01, 0.1, 0.1, at=[0.14, 0, 0.1]))
    statics = [Static(shelf, table.at(0, 0, 0, (0.1, 0.05, 0.3))), Static(ring, table.at(-0.1, 0.1, 0.03, (0.2, 0, 0)))]
    scene = Scene([box, can, box, can, ring], statics, gravity=table.gravity)
    measured = table.poses(
        (0, 0, 0.05, (0.2, 0.1, 0)),
        (0.09, 0.05, 0.04),
        (0, 0.05, 0.09, (0, 0.3, 1)),
        (-0.1, 0.1, 0.1),
        (-0.1, -0.05, 0.02),
    )
    terms, _ = assert_same_cost(measured, scene, shaken(measured, 0))
    assert float(terms[2].max()) > 0 < float(terms[1].max())


@pytest.mark.parametrize("lean", [0.0, 0.2, 0.29, 0.31, 0.6])
def test_a_table_and_a_wall(lean, table, box, ring):
    """The wall carries from a slope of 0.3 on; both push."""
    wall = (1 - lean**2) ** 0.5 * table.T[:3, 0] + lean * table.up
    planes = [Static(table.plane), Static(Plane(wall, float(wall @ table.T[:3, 3]) - 0.05))]
    scene = Scene([box, ring, box], planes[::-1], gravity=table.gravity)
    measured = table.poses(
        (-0.02, 0, 0.03, (0.2, 0.1, 0.1)), (0, 0.15, 0.01, (0.1, 0, 0)), (0.01, -0.15, 0.07, (0, 0.2, 0.5))
    )
    terms, _ = assert_same_cost(measured, scene)
    assert float(terms[1].max()) > 0 < float(terms[2].max())


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)], ids=str)
def test_stacks_in_any_order(order, table, angle, can, ring):
    """Each falls onto the one below, whichever of the two comes first in the scene."""
    objects = [ring, angle, can]
    rows = [
        (0, 0, 0.004, (0.02, 0.01, 0)),
        (-0.02, -0.01, 0.061, (0.05, 0.03, 0.4)),
        (0.01, 0, 0.155, (0.04, -0.06, 0)),
    ]
    measured = table.poses(*(rows[k] for k in order))
    scene = Scene.tabletop([objects[k] for k in order], table.plane)
    terms, gradient = assert_same_cost(measured, scene)
    assert bool((terms[2] > 1e-3).all())
    downwards = gradient[:, :3] @ table.gravity
    assert bool((downwards < 0).all())


def test_exact_contact(table, box, can):
    """Faces that coincide: no force, no height, from whichever side rounding comes."""
    measured = table.poses((0, 0, 0.02), (0.1, 0, 0.02), (0, 0, 0.06), (0, 0.06, 0.04), (0.3, 0, 0.04))
    scene = Scene.tabletop([box, box, box, can, can], table.plane)
    terms, gradient = assert_same_cost(measured, scene)
    assert float(terms[1:3].max()) < 1e-12
    assert float(gradient.abs().max()) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_what_stands_exactly_on_something_is_carried_by_it(dtype, table, box, can):
    """300 cans on boxes, turned and shifted at random: whichever way distance, fall and boxes are rounded, none falls."""
    count = 300
    x, y, a, b, dx, dy = (np.random.default_rng(0).uniform(-1, 1, size=(count, 6)) * [0.5, 0.5, 3, 3, 0.02, 0.01]).T
    boxes = table.poses(*zip(x, y, [0.02] * count, [(0, 0, k) for k in a], strict=True))
    cans = table.poses(*zip(x + dx, y + dy, [0.08] * count, [(0, 0, k) for k in b], strict=True))
    scene = Scene.cat([Scene.tabletop([box, can], table.plane)] * count)
    terms, _ = evaluated(FusedCost, torch.stack([boxes, cans], dim=1).reshape(-1, 4, 4), scene, dtype=dtype)
    assert float(terms[1:3].max()) < 1e-9


def test_alternatives_feel_and_do_not_push(table, box, can, ring):
    """Of three estimates of one box the middle one acts; the others fall onto things, and nothing falls onto them."""
    scene = Scene(
        [box, can, box, ring, box, can],
        [Static(table.plane)],
        gravity=table.gravity,
        same_object=torch.tensor([0, 1, 0, 2, 0, 1]),
    )
    measured = table.poses(
        (0, 0, 0.025, (0.1, 0, 0)),
        (0.06, 0, 0.045, (0, 0.1, 0)),
        (0.005, 0.01, 0.03),
        (0.01, 0, 0.06, (0.1, 0.2, 0)),
        (0, -0.02, 0.12, (0.3, 0, 0.2)),
        (0.05, 0.02, 0.05, (0.1, 0, 0)),
    )
    for scores in (None, torch.tensor([0.2, 0.3, 0.9, 0.5, 0.1, 0.8])):
        assert_same_cost(measured, scene, shaken(measured, 1), scores=scores)


def test_planes_of_which_little_is_known(table, box, can, ring):
    """Two planes with full covariances in one image: contacts are softer where the tilt matters more."""
    full = covariances(2, 3)[:, :3, :3] * torch.tensor([1.0, 1.0, 0.2], dtype=torch.float64)[:, None] * 0.5
    full = full + full.mT
    tilted = se3.exp_so3(torch.tensor([0.3, 0.2, 0.0], dtype=torch.float64)) @ table.up
    planes = [Plane(table.plane.normal, table.plane.offset, full[0] + 1e-4 * EYE[:3, :3])]
    planes.append(Plane(tilted, float(tilted @ table.T[:3, 3]) - 0.02, full[1] + 1e-4 * EYE[:3, :3]))
    scene = Scene(
        [box, can, ring, box],
        [Static(p) for p in planes],
        gravity=table.gravity,
        same_object=torch.tensor([0, 1, 2, 0]),
    )
    measured = table.poses(
        (0.1, 0, 0.01, (0, 0.1, 0)), (-0.1, 0.1, 0.03, (0.2, 0, 0)), (0, -0.2, 0.02, (0, 0.1, 0)), (0.1, 0, 0.04)
    )
    assert_same_cost(measured, scene, shaken(measured, 2))


OPTIONS = {
    "default": {},
    "not robust": {"robust": float("inf")},
    "independent depths": {"sigma_depth_common": 0.0},
    "neither": {"robust": float("inf"), "sigma_depth_common": 0.0},
    "hard contacts": {"softness": 0.0},
    "no pose": {"pose_weight": 0.0},
    "no collision": {"collision_weight": 0.0},
    "no gravity": {"gravity_weight": 0.0},
    "all off": {"pose_weight": 0.0, "collision_weight": 0.0, "gravity_weight": 0.0},
    "short reach": {"gravity_reach": 0.01},
    "long reach": {"gravity_reach": 1.0},
    "constant ray": {"sigma_ray": 0.02, "sigma_ray_fraction": 0.0},
    "gaussian": {"smoothing": Smoothing("gaussian")},
    "seeded": {"smoothing": Smoothing("gaussian", noise=0.3, samples=5, seed=3)},
    "wide ring": {"smoothing": Smoothing("ring", noise=0.5, samples=7)},
    "exact gradient": {"smoothing": Smoothing("none")},
}


@pytest.mark.parametrize("name", OPTIONS)
def test_every_option_of_the_cost(name, pile):
    measured, scene = pile
    assert_same_cost(measured, scene, shaken(measured, 5), physics(**OPTIONS[name]))


@pytest.mark.parametrize("options", [{}, {"robust": float("inf")}], ids=str)
def test_full_covariances_of_the_estimates(options, pile):
    measured, scene = pile
    assert_same_cost(
        measured, scene, shaken(measured, 6), physics(**options), covariance=covariances(len(scene), seed=1)
    )


def test_gradients_are_scaled_then_clipped(pile):
    """In units of any scale, full ones too; the paper's largest gradient is that of the scaled one."""
    measured, scene = pile
    scale = torch.linalg.cholesky(covariances(len(scene), seed=2))
    _, free = assert_same_cost(measured, scene, shaken(measured, 7), scale=scale)
    length = free.norm(dim=1)
    limit = float(length.median())
    _, clipped = assert_same_cost(measured, scene, shaken(measured, 7), RefinerConfig(max_gradient=limit), scale=scale)
    torch.testing.assert_close(clipped.norm(dim=1), length.clamp_max(limit))


@pytest.mark.parametrize("short", [0.0, 1e-9, 1e-6, 1e-3, 0.1])
def test_rotations_by_nearly_half_a_turn(short, pile):
    """The residual's rotation vector is just below π, along every axis."""
    measured, scene = pile
    axes = torch.randn(len(scene), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    axes[:3] = EYE[:3, :3]
    axes = torch.nn.functional.normalize(axes, dim=1)
    turn = torch.cat([torch.zeros_like(axes), (torch.pi - short) * axes], dim=1)
    config = physics(collision_weight=0.0, gravity_weight=0.0)
    # at π itself both rotation vectors are right, and so the cost alone is compared
    if short == 0.0:
        args = (measured, scene, se3.retract(measured, turn), config)
        assert torch.allclose(evaluated(FusedCost, *args)[0][0], evaluated(GeneralCost, *args)[0][0], rtol=1e-7)
    else:
        assert_same_cost(measured, scene, se3.retract(measured, turn), config)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-8, 1e-4, 9.9e-4, 1.01e-3, 1e-2])
def test_small_rotations(size, pile):
    measured, scene = pile
    turn = torch.randn(len(scene), 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    turn = torch.cat([torch.zeros_like(turn), size * turn], dim=1)
    assert_same_cost(measured, scene, se3.retract(measured, turn), physics(collision_weight=0.0, gravity_weight=0.0))


def test_estimates_that_are_rotations_to_single_precision(pile):
    measured, scene = pile
    assert_same_cost(measured.float().double(), scene, shaken(measured, 8).float().double(), tolerance=1e-7)


# ---- 2. whole descents


@pytest.fixture
def general(monkeypatch):
    """A way to call a function with the general cost."""

    def run(function, *args, **options):
        with monkeypatch.context() as patch:
            patch.setattr(FusedCost, "fits", staticmethod(lambda config, scene: False))
            return function(*args, **options)

    return run


@pytest.fixture(scope="module")
def household():
    """Three generated tables as an estimator sees them, bodies by their hulls: poses and scene of (7, 0, 6 or 7) objects."""
    meshes = {k: m.convex_hull for k, m in household_meshes().items()}
    hulls = {k: Body(k, ConvexParts.from_hulls([m.vertices]), m) for k, m in meshes.items()}
    poses, scenes = [], []
    for seed in (0, 1):
        s = household_scene(seed)
        poses.append(perturb_like_estimator(s.T_camera_object, seed=seed))
        scenes.append(Scene.tabletop([hulls[name] for name in s.names], Plane(s.normal, s.offset)))
    return torch.cat(poses), Scene.cat([scenes[0], Scene([]), scenes[1]])


def assert_same_refinement(fused, expected, atol=1e-6):
    torch.testing.assert_close(fused.poses[..., :3, 3], expected.poses[..., :3, 3], atol=atol, rtol=0)
    torch.testing.assert_close(fused.poses[..., :3, :3], expected.poses[..., :3, :3], atol=20 * atol, rtol=0)
    assert fused.steps.tolist() == expected.steps.tolist()
    assert fused.converged.tolist() == expected.converged.tolist()


CONFIGS = {
    "adam": RefinerConfig(steps=30),
    "to the end": RefinerConfig(steps=60, tolerance=1e-5),
    "constant": RefinerConfig(steps=25, decay="none", start="measured"),
    "sgd": RefinerConfig(
        PhysicsConfig(collision_weight=1.0, gravity_weight=1.0, sigma_lateral=0.05, sigma_ray=0.5, sigma_rotation=0.26),
        optimizer="sgd",
        steps=25,
        learning_rate=1e-3,
        decay="none",
        max_gradient=1.0,
        start="measured",
    ),
    "capped": RefinerConfig(steps=20, max_step=5e-4, learning_rate=0.5),
    "no steps": RefinerConfig(steps=0),
    "one step": RefinerConfig(steps=1),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_descents_agree(name, household, general):
    refiner = PhysPoseRefiner(CONFIGS[name])
    assert_same_refinement(refiner(*household), general(refiner, *household))


def test_descents_of_odd_scenes_agree(pile, general):
    refiner = PhysPoseRefiner(RefinerConfig(steps=12))
    scores = torch.linspace(1, 2, len(pile[1]))
    options = {"scores": scores, "measured_covariance": covariances(len(pile[1]))}
    assert_same_refinement(refiner(*pile, **options), general(refiner, *pile, **options))


def test_trajectories_and_callbacks_agree(household, general):
    refiner = PhysPoseRefiner(RefinerConfig(steps=8, keep_trajectory=True))
    seen = [], []
    fused = refiner(*household, callback=lambda *args: seen[0].append(args))
    expected = general(refiner, *household, callback=lambda *args: seen[1].append(args))
    torch.testing.assert_close(fused.trajectory, expected.trajectory, atol=1e-6, rtol=0)
    assert [s[0] for s in seen[0]] == [s[0] for s in seen[1]] == list(range(8))
    for (step, poses, terms), (_, poses_, terms_) in zip(*seen, strict=True):
        torch.testing.assert_close(poses, poses_, atol=1e-6, rtol=0)
        for a, b in zip(terms, terms_, strict=True):
            torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
        if step:
            assert torch.equal(poses, fused.trajectory[step])
    # what the callback kept is not overwritten by later steps
    assert not torch.equal(seen[0][1][1], seen[0][2][1])
    assert not torch.equal(seen[0][1][2].total, seen[0][2][2].total)


def test_hypotheses_agree(household, general):
    poses, scene = household
    # not seed 1: it puts an object within 1e-11 of a tie between smoothing samples, where the machine's rounding decides
    many = torch.stack([poses, shaken(poses, 3), shaken(poses, 4)])[None]
    refiner = PhysPoseRefiner(RefinerConfig(steps=6))
    together = refiner(many, scene)
    assert_same_refinement(together, general(refiner, many, scene))
    assert together.steps.shape == (1, 3, 3)
    torch.testing.assert_close(together.poses[0, 1], refiner(many[0, 1], scene).poses, atol=1e-12, rtol=0)


def test_images_at_rest_are_left_alone_and_report_fewer_steps(table, box, general):
    """Nothing acts in the first image; the second one is empty; in two more a box is lifted, from less and less deep."""
    scenes = [Scene([box]), Scene([]), Scene.tabletop([box], table.plane), Scene.tabletop([box], table.plane)]
    poses = table.poses((0, 0, 0.02), (0, 0, 0.01), (0, 0, 0.0199, (0.01, 0, 0)))
    runs = []
    for call in (lambda f, *a, **k: f(*a, **k), general):
        sizes = []
        refiner = PhysPoseRefiner(RefinerConfig(keep_trajectory=True, tolerance=5e-5, steps=60))
        result = call(refiner, poses, Scene.cat(scenes), callback=lambda step, p, t, sizes=sizes: sizes.append(len(p)))
        runs.append((result, sizes))
    (fused, sizes), (expected, sizes_) = runs
    assert_same_refinement(fused, expected)
    assert sizes == sizes_
    steps = fused.steps.tolist()
    assert steps[:2] == [STILL_STEPS, 0]
    assert steps[2] > steps[3] >= STILL_STEPS
    path = fused.trajectory
    for i, image in ((0, 0), (2, 3)):
        assert torch.equal(path[steps[image] :, i], path[-1:, i].expand(len(path) - steps[image], 4, 4))


def test_a_finished_image_is_not_moved_by_what_is_left_in_its_step(table, box):
    """A step that an optimizer's momentum leaves for a finished image is dropped, and its gradient is zero."""
    scene = Scene.cat([Scene.tabletop([box], table.plane), Scene([box])])
    cost = make(FusedCost, table.poses((0, 0, 0.02), (0, 0, 0.02)), scene)
    for step in range(STILL_STEPS + 1):
        cost.evaluate(step)
        cost.step[0, 2] = 1e-3
        cost.move()
        assert not bool(cost.step.any())
    assert cost.done.tolist() == [False, True]
    assert cost.steps[1] == STILL_STEPS
    before = cost.poses.clone()
    cost.step.fill_(1e-3)
    cost.evaluate(STILL_STEPS + 1)
    cost.move()
    assert torch.equal(cost.poses[1], before[1])
    assert not torch.equal(cost.poses[0], before[0])
    assert not bool(cost.gradient[1].any())
    assert bool(cost.gradient[0].any())


def test_moves_agree(pile):
    """Steps in units of any scale, capped ones too."""
    measured, scene = pile
    scale = torch.linalg.cholesky(covariances(len(scene), seed=4))
    costs = [make(kind, measured, scene, scale=scale) for kind in (FusedCost, GeneralCost)]
    for seed in range(5):
        step = torch.randn(len(scene), 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        for cost in costs:
            cost.evaluate(seed)
            cost.step.copy_(10.0 ** (seed - 3) * step)
            cost.move()
    torch.testing.assert_close(costs[0].poses, costs[1].poses, atol=1e-12, rtol=0)


# ---- 3. what is skipped cannot matter


def walk(cost, fresh, lengths, seed, pull=None, tolerance=1e-12):
    """Random steps of the given lengths; before each the cost equals one that knows nothing of the past."""
    generator = torch.Generator().manual_seed(seed)
    start = cost.poses.clone()
    touching, hanging = [], []
    for step, (dt, dw) in enumerate(lengths):
        cost.evaluate(step)
        new = fresh(cost.poses.clone())
        new.evaluate(0)
        assert_equal_values(values(cost), values(new), tolerance)
        terms = values(new)[0]
        touching.append(terms[1] > 0)
        hanging.append(terms[2] > 0)
        move = torch.randn(len(start), 6, generator=generator, dtype=torch.float64)
        move = move * torch.tensor([dt] * 3 + [dw] * 3, dtype=torch.float64)
        home = start[:, :3, 3] - cost.poses[:, :3, 3]
        move[:, :3] += (2 * dt * torch.nn.functional.normalize(home, dim=1) if pull is None else pull(step)).clamp(
            -dt, dt
        )
        cost.step.copy_(move)
        cost.move()
    return torch.stack(touching), torch.stack(hanging)


WALKS = {
    "slow": [(2e-4, 2e-3)] * 100,
    "fast": [(1e-2, 0.2)] * 100,
    "turning": [(1e-6, 0.1)] * 60,
    "sliding": [(3e-3, 0.0)] * 60,
    "now and then": [(1e-5, 1e-4)] * 9 + [(1e-2, 0.3)] + [(1e-5, 1e-4)] * 20 + [(8e-3, 0.2)] * 3 + [(1e-4, 0)] * 30,
}


@pytest.mark.parametrize("name", WALKS)
def test_no_contact_is_missed_however_the_objects_move(name, table, bodies):
    """Contacts and falls come and go in a random walk; each evaluation equals one without a past."""
    objects, poses = clutter(table, bodies, 7, 3, spread=0.14)
    shelf = Static(Body.box((0.08, 0.2, 0.02), label="shelf"), table.at(-0.08, 0, 0.06, (0.05, 0.1, 0.2)))
    scene = Scene(
        objects, [Static(table.plane), shelf], gravity=table.gravity, same_object=torch.tensor([0, 1, 2, 3, 4, 5, 4])
    )
    config = RefinerConfig(max_step=0.05, tolerance=0.0)
    scene, poses = Scene.cat([scene, Scene(objects)]), torch.cat([poses, poses])

    def fresh(at):
        return make(FusedCost, poses, scene, at, config)

    touching, hanging = walk(fresh(poses), fresh, WALKS[name], seed=1)
    if name in ("fast", "turning", "sliding"):
        assert int((touching[1:] != touching[:-1]).sum()) > 5  # they do come and go
        assert int((hanging[1:] != hanging[:-1]).sum()) > 5


def test_a_bullet_is_noticed(table, box, angle):
    """A box at rest for long, its neighbours known to be clear; then it jumps into them in one step, and out again."""
    scene = Scene([box, angle, angle])
    poses = table.poses((0, 0, 0.3), (0.3, 0, 0.3), (0, 0.5, 0.3))
    config = RefinerConfig(max_step=1.0, tolerance=0.0)
    cost = make(FusedCost, poses, scene, None, config)
    jumps = [(0, 0, 0)] * 5 + [(0.28, 0, 0), (0, 0, 0), (-0.28, 0, 0), (0, 0, 0), (0, 0.48, 0), (0, -0.48, 0)] * 3
    hits = []
    for step, jump in enumerate(jumps):
        cost.evaluate(step)
        expected = evaluated(FusedCost, poses, scene, cost.poses.clone(), config)
        assert_equal_values(values(cost), expected, 1e-12)
        hits.append(bool(expected[0][1].any()))
        cost.step[0, :3] = table.T[:3, :3] @ torch.tensor(jump, dtype=torch.float64)
        cost.move()
    assert hits == [False] * 5 + [False, True, True, False, False, True] * 3


def test_a_swing_about_a_remote_origin_is_noticed(table, box, remote):
    """A body 0.3 m from its origin, which stays in place: it is the turn that brings it into the box."""
    scene = Scene([remote, box])
    start = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    start[:, 2, 3] = 0.8
    start[1, :3, 3] += torch.tensor([-0.2, 0.2, 0.1], dtype=torch.float64)
    config = RefinerConfig(max_step=1.0, tolerance=0.0)
    cost = make(FusedCost, start, scene, None, config)
    hits = []
    for step in range(90):
        cost.evaluate(step)
        expected = evaluated(FusedCost, start, scene, cost.poses.clone(), config)
        assert_equal_values(values(cost), expected, 1e-12)
        hits.append(bool(expected[0][1].any()))
        cost.step[0, 5] = 0.07
        cost.move()
    assert 5 < sum(hits) < 30


def test_a_support_that_slides_away_is_noticed(table, box):
    """Of two boxes in a stack the lower one leaves: the upper one hangs over the table then, and over it again later."""
    scene = Scene.tabletop([box, box], table.plane)
    poses = table.poses((0, 0, 0.02), (0.003, 0.002, 0.061, (0.01, 0, 0.1)))
    config = RefinerConfig(max_step=1.0, tolerance=0.0)
    cost = make(FusedCost, poses, scene, None, config)
    heights = []
    for step in range(60):
        cost.evaluate(step)
        expected = evaluated(FusedCost, poses, scene, cost.poses.clone(), config)
        assert_equal_values(values(cost), expected, 1e-12)
        heights.append(float(expected[0][2][1]))
        cost.step[0, :3] = (1 if step < 30 else -1) * 0.005 * table.T[:3, 0]
        cost.move()
    assert heights[0] < 2e-3 < 0.03 < heights[30]
    assert heights[-1] < 2e-3


# ---- 4. batches and dtypes


def test_an_image_does_not_depend_on_the_others(household, pile):
    """Bit by bit, through a whole descent, before and after other images in the batch."""
    refiner = PhysPoseRefiner(RefinerConfig(steps=12))
    alone = refiner(*household)
    poses, scene = torch.cat([pile[0], household[0], pile[0]]), Scene.cat([pile[1], household[1], pile[1]])
    crowd = refiner(poses, scene)
    rows = slice(len(pile[0]), len(pile[0]) + len(household[0]))
    torch.testing.assert_close(crowd.poses[rows], alone.poses, atol=1e-12, rtol=0)
    torch.testing.assert_close(crowd.terms.total[rows], alone.terms.total, atol=1e-9, rtol=0)
    assert crowd.steps[6:9].tolist() == alone.steps.tolist()
    torch.testing.assert_close(crowd.poses[: rows.start], crowd.poses[rows.stop :], atol=1e-12, rtol=0)


def test_an_evaluation_does_not_depend_on_the_others_bit_by_bit(household, pile):
    poses, scene = torch.cat([pile[0], household[0]]), Scene.cat([pile[1], household[1]])
    terms, gradient = evaluated(FusedCost, poses, scene)
    first, second = evaluated(FusedCost, *pile), evaluated(FusedCost, *household)
    assert torch.equal(terms, torch.cat([first[0], second[0]], dim=1))
    assert torch.equal(gradient, torch.cat([first[1], second[1]]))


def test_objects_of_images_may_be_interleaved(household):
    """Only the order within an image matters, to the smoothing's quadrature."""
    poses, scene = household
    order = torch.argsort(torch.rand(len(scene), generator=torch.Generator().manual_seed(3)))
    order = order[torch.argsort(scene.image[order], stable=True)]
    shuffled = scene.image[torch.randperm(len(scene), generator=torch.Generator().manual_seed(4))]
    order = torch.empty_like(order).index_copy(0, torch.argsort(shuffled, stable=True), torch.arange(len(scene)))
    gravity, statics, image = scene.gravity, scene.statics, scene.image[order]
    mixed = Scene([scene.objects[i] for i in order], statics, gravity=gravity, image=image, n_images=3)
    terms, gradient = evaluated(FusedCost, poses, scene)
    terms_, gradient_ = assert_same_cost(poses[order], mixed)
    assert_equal_values((terms_, gradient_), (terms[:, order], gradient[order]), 1e-9)


def test_the_same_twice(household):
    refiner = PhysPoseRefiner(RefinerConfig(PhysicsConfig(smoothing=Smoothing("gaussian")), steps=15))
    first = refiner(*household)
    torch.manual_seed(7)
    second = refiner(*household)
    assert torch.equal(first.poses, second.poses)
    assert torch.equal(first.terms.total, second.terms.total)


def test_single_precision_in_and_out(household):
    """What is computed is computed in double precision all the same."""
    poses, scene = household
    refiner = PhysPoseRefiner(RefinerConfig(steps=20))
    single, double = refiner(poses.float(), scene), refiner(poses.float().double(), scene)
    assert single.poses.dtype == single.terms.total.dtype == torch.float32
    assert torch.equal(single.poses, double.poses.float())


@pytest.mark.parametrize("change", [1e-14, 1e-10])
def test_a_hair_in_the_estimates_is_a_hair_in_the_result(change, household):
    """Else float32 inputs, another BLAS or a GPU would give other poses: the axes of isotropic covariances, along which
    Adam steps, must not be left to rounding."""
    poses, scene = household
    noise = torch.randn(len(poses), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = poses.clone()
    moved[:, :3, 3] += change * noise
    refiner = PhysPoseRefiner(RefinerConfig(steps=1))
    torch.testing.assert_close(refiner(moved, scene).poses, refiner(poses, scene).poses, atol=100 * change, rtol=0)


@pytest.mark.parametrize("name", ["default", "hard contacts", "independent depths", "exact gradient", "gaussian"])
def test_single_precision_costs_are_near(name, pile, household):
    """What a CUDA device computes: finite, and within what 24 bits allow a metre away."""
    for measured, scene in (pile, household):
        args = (measured, scene, shaken(measured, 9), physics(**OPTIONS[name]))
        double, single = evaluated(FusedCost, *args), evaluated(FusedCost, *args, dtype=torch.float32)
        assert single[0].dtype == single[1].dtype == torch.float32
        assert bool(single[0].isfinite().all())
        assert bool(single[1].isfinite().all())
        torch.testing.assert_close(single[0][0].double(), double[0][0], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(single[0][1:3].double(), double[0][1:3], rtol=0, atol=2e-6)
        error = (single[1].double() - double[1]).norm(dim=1) / double[1].norm(dim=1)
        assert float(error.median()) < 1e-3


def test_a_walk_in_single_precision_misses_nothing(table, bodies):
    objects, poses = clutter(table, bodies, 6, 4, spread=0.12)
    scene = Scene.tabletop(objects, table.plane)
    config = RefinerConfig(max_step=0.05, tolerance=0.0)
    cost = make(FusedCost, poses, scene, None, config, dtype=torch.float32)
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([2e-3] * 3 + [0.03] * 3)
    for step in range(60):
        cost.evaluate(step)
        new = evaluated(FusedCost, poses, scene, cost.poses.double(), config, dtype=torch.float32)
        torch.testing.assert_close(values(cost)[0][1:3], new[0][1:3], atol=2e-6, rtol=0)
        cost.step.copy_(size * torch.randn(len(objects), 6, generator=generator))
        cost.move()


# ---- 5. nothing in, nothing out


@pytest.mark.parametrize(
    "scene",
    [
        Scene([]),
        Scene([], n_images=3),
        Scene([], image=torch.zeros(0, dtype=torch.long)),
        Scene([], gravity=torch.tensor([0.0, 0.0, 1.0]), n_images=2),
        Scene([], [Static(Plane(torch.tensor([0.0, 0.0, -1.0]), -1.0))]),
        Scene([], [Static(Body.box((0.1, 0.1, 0.1), label="slab"), torch.eye(4))]),
    ],
    ids=["one image", "three images", "no image", "gravity", "plane", "static body"],
)
def test_no_objects(scene):
    nothing = torch.zeros(0, 4, 4, dtype=torch.float64)
    cost = make(FusedCost, nothing, scene)
    cost.evaluate(0)
    assert cost.done.tolist() == [True] * scene.n_images
    assert cost.steps.tolist() == [0] * scene.n_images
    assert [tuple(x.shape) for x in (cost.poses, cost.step, cost.gradient)] == [(0, 4, 4), (0, 6), (0, 6)]
    assert values(cost)[0].shape == (4, 0)
    cost.move()
    result = PhysPoseRefiner(RefinerConfig(keep_trajectory=True))(nothing, scene)
    assert result.poses.shape == (0, 4, 4)
    assert result.trajectory.shape == (1, 0, 4, 4)
    assert bool(result.converged.all())


def test_single_objects(table, box, ring):
    """Alone, on a table, over a static body; nothing to pair with."""
    slab = Static(box, table.at(0.01, 0, 0.02))
    pose = table.poses((0, 0, 0.045, (0.05, 0.02, 0)))
    for body in (box, ring):
        for statics in ([], [Static(table.plane)], [slab], [Static(table.plane), slab]):
            assert_same_cost(pose, Scene([body], statics, gravity=table.gravity), shaken(pose, 3))
            assert_same_cost(pose, Scene([body], statics), shaken(pose, 3))


def test_only_alternatives_of_one_object(table, box):
    """No pair of bodies that may touch, though all of them overlap."""
    scene = Scene([box] * 3, [Static(table.plane)], gravity=table.gravity, same_object=torch.zeros(3, dtype=torch.long))
    measured = table.poses((0, 0, 0.01), (0, 0.01, 0.03), (0.01, 0, 0.025))
    terms, _ = assert_same_cost(measured, scene, shaken(measured, 4))
    assert terms[1].tolist()[1:] == [0.0, 0.0]


# ---- which cost is chosen


@pytest.mark.parametrize(
    ("options", "kind"),
    [
        ({}, FusedCost),
        ({"smoothing": Smoothing("none")}, FusedCost),
        ({"smoothing": Smoothing("gumbel")}, GeneralCost),
        ({"smoothing": Smoothing("pose")}, GeneralCost),
        ({"gravity": "paper"}, FusedCost),
        ({"backend": "fcl"}, GeneralCost),
    ],
    ids=str,
)
def test_the_kernels_are_used_where_they_know_the_cost(options, kind, table, box):
    if options.get("backend") == "fcl":
        pytest.importorskip("fcl")
    scene, poses = Scene.tabletop([box], table.plane), table.poses((0, 0, 0.02))
    config = replace(RefinerConfig(), physics=PhysicsConfig(**options))
    assert isinstance(make(make_cost, poses, scene, None, config), kind)
