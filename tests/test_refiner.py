"""The refiner: what it moves and what it leaves alone, how images are batched, and in which modes it may be called."""

import dataclasses
import math

import pytest
import torch

from physpose_torch import se3
from physpose_torch.config import PhysicsConfig, RefinerConfig, Smoothing
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.losses import PhysicsLoss
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static

STRICT = RefinerConfig(PhysicsConfig(sigma_contact=0.0))
"""Objects are kept apart as far as anything."""


def short(steps=8, **options) -> PhysPoseRefiner:
    return PhysPoseRefiner(RefinerConfig(steps=steps, **options))


def motion(a, b):
    return torch.linalg.vector_norm((a - b)[..., :3, 3], dim=-1)


@pytest.fixture
def messy(table, box, can, angle):
    """Three images of 2, 0 and 1 objects, and one of 3 without a table: poses and scenes."""
    poses = [
        table.poses((0, 0, 0.017, (0, 0.03, 0)), (0.07, 0.01, 0.045, (0, 0, 0.5))),
        torch.zeros(0, 4, 4, dtype=torch.float64),
        table.poses((0, 0, 0.006)),
        table.poses((0, 0, 0), (0.055, 0, 0), (0.3, 0.1, 0)),
    ]
    scenes = [
        Scene.tabletop([box, can], table.plane),
        Scene.tabletop([], table.plane),
        Scene([angle], [Static(table.plane), Static(box, table.at(0.13, 0, 0.02))], gravity=table.gravity),
        Scene([can, can, box]),
    ]
    return poses, scenes


# ---- physics


def test_a_consistent_scene_stays_where_it_is(table, box, can, angle):
    """At rest, a stack, two boxes side by side: within 0.15 mm."""
    poses = table.poses(
        (0, 0, 0.02, (0, 0, 0.4)),
        (0.15, 0, 0.04),
        (0.15, 0, 0.1),
        (-0.2, 0.1, 0),
        (-0.2, -0.1, 0.02),
        (-0.0999, -0.1, 0.02),
    )
    result = PhysPoseRefiner()(poses, Scene.tabletop([box, can, box, angle, box, box], table.plane))
    assert float(motion(result.poses, poses).max()) < 1.5e-4
    assert float((result.poses - poses)[:, :3, :3].abs().max()) < 2e-3


def test_a_penetrating_pair_is_parted(table, box, can):
    """12 mm inside each other on a table: less than 0.5 mm is left where that is asked for, and both still stand on it."""
    poses = table.poses((0, 0, 0.02), (0.068, 0, 0.04))
    scene = Scene.tabletop([box, can], table.plane)
    result = PhysPoseRefiner(STRICT)(poses, scene)
    assert float(physics_report(poses, Scene([box, can])).penetration.max()) == pytest.approx(0.012, abs=1e-4)
    assert float(result.report.penetration.max()) < 5e-4
    assert float(PhysPoseRefiner()(poses, scene).report.penetration.max()) < 5e-3
    assert float(result.report.gap.max()) < 1e-3


@pytest.mark.parametrize("height", [0.004, 0.015, 0.03])
def test_a_floating_object_ends_in_contact(height, table, can):
    result = PhysPoseRefiner()(table.poses((0, 0, 0.04 + height)), Scene.tabletop([can], table.plane))
    assert float(result.report.gap) < (1e-3 if height < 0.03 else 3e-3)
    assert float(result.report.penetration) < 5e-4


@pytest.mark.parametrize("depth", [0.004, 0.03])
def test_a_sunk_object_comes_up(depth, table, box):
    result = PhysPoseRefiner()(table.poses((0, 0, 0.02 - depth)), Scene.tabletop([box], table.plane))
    assert float(result.report.penetration) < 5e-4
    assert float(result.report.gap) < 1e-3


def test_objects_move_along_their_viewing_rays(table, can):
    """A can 15 mm up is most likely nearer than it seems: it slides along the ray rather than straight down."""
    pose = table.poses((0.1, 0.1, 0.055))
    move = (PhysPoseRefiner()(pose, Scene.tabletop([can], table.plane)).poses - pose)[0, :3, 3]
    ray = torch.nn.functional.normalize(pose[0, :3, 3], dim=0)
    assert float(move @ ray) > 0.9 * float(move.norm()) > 0.01


def test_a_stack_stays_a_stack(table, box):
    """Three boxes, some of them sunk into each other, some floating: in the end each rests on the one below."""
    wide = Body.box((0.12, 0.12, 0.04), label="wide")
    poses = table.poses((0, 0, 0.017), (0.005, 0, 0.06), (0, 0.005, 0.096))
    result = PhysPoseRefiner(STRICT)(poses, Scene.tabletop([wide, box, box], table.plane))
    assert result.report.support.tolist() == [3, 0, 1]
    assert float(result.report.penetration.max()) < 5e-4
    assert float(result.report.gap.max()) < 1e-3


def test_what_hangs_too_high_or_without_gravity_is_left_alone(table, box):
    pose = table.poses((0, 0, 0.12))
    for scene in (Scene.tabletop([box], table.plane), Scene([box], [Static(table.plane)])):
        assert torch.allclose(PhysPoseRefiner()(pose, scene).poses, pose, atol=1e-12)


def test_an_uncertain_plane_moves_objects_less(table, box):
    pose = table.poses((0, 0, 0.012))
    moves = []
    for sigma in (0.0, 0.01, 0.03):
        covariance = torch.diag(torch.tensor([0.0, 0.0, sigma**2], dtype=torch.float64))
        scene = Scene.tabletop([box], Plane(table.plane.normal, table.plane.offset, covariance))
        moves.append(float(table.where(PhysPoseRefiner()(pose, scene).poses)[0, 2]) - 0.012)
    assert 0.0075 < moves[0] < 0.0085
    assert moves[0] > 1.1 * moves[1] > 1.5 * moves[2] > 0


def test_alternatives_end_where_each_would_alone_and_push_nobody(table, box, can):
    """Two estimates of one box beside a can: the can does not care about the second, which yields to the can."""
    rows = [(0, 0, 0.018), (0.075, 0, 0.045), (0.005, 0.01, 0.015)]
    scores = torch.tensor([0.9, 0.8, 0.4])
    statics = [Static(table.plane)]
    three = Scene([box, can, box], statics, gravity=table.gravity, same_object=torch.tensor([0, 1, 0]))
    two = Scene([box, can], statics, gravity=table.gravity)
    refiner = short(30)
    crowded = refiner(table.poses(*rows), three, scores=scores)
    alone = refiner(table.poses(*rows[:2]), two, scores=scores[:2])
    torch.testing.assert_close(crowded.poses[:2], alone.poses, atol=1e-9, rtol=0)  # sums run in another order
    assert float(motion(crowded.poses[2], table.at(*rows[2]))) > 1e-3


def test_a_covariance_says_who_yields(table, box):
    """Of two boxes inside each other, the one whose estimate is sure stays, the other one goes."""
    sure, unsure = ((s**2) * torch.eye(6, dtype=torch.float64) for s in (1e-4, 1e-2))
    poses = table.poses((0, 0, 0), (0.09, 0, 0))
    result = PhysPoseRefiner()(poses, Scene([box, box]), measured_covariance=torch.stack([sure, unsure]))
    moved = motion(result.poses, poses)
    assert float(moved[0]) < 2e-3
    assert float(moved[1]) > 7e-3


@pytest.mark.parametrize("kind", ["gaussian", "gumbel", "ring", "none"])
def test_every_smoothing_clears_the_table(kind, table, box):
    config = RefinerConfig(PhysicsConfig(smoothing=Smoothing(kind)))
    pose = table.poses((0, 0, 0.012, (0.05, 0.03, 0)))
    result = PhysPoseRefiner(config)(pose, Scene.tabletop([box], table.plane))
    assert float(result.report.penetration) < 1e-3
    assert float(result.report.gap) < 1e-3


# ---- batches


def test_a_batch_equals_the_loop_over_its_images(messy):
    poses, scenes = messy
    refiner = short(25)
    batch = refiner(torch.cat(poses), Scene.cat(scenes))
    each = [refiner(p, s) for p, s in zip(poses, scenes, strict=True)]
    assert torch.allclose(batch.poses, torch.cat([e.poses for e in each]), rtol=0, atol=1e-9)
    assert batch.steps.tolist() == [int(e.steps) for e in each]
    assert batch.converged.tolist() == [bool(e.converged) for e in each]
    for i, term in enumerate(batch.terms):
        assert torch.allclose(term, torch.cat([e.terms[i] for e in each]), atol=1e-6)
    assert batch.report.penetration.tolist() == pytest.approx(
        torch.cat([e.report.penetration for e in each]).tolist(), abs=1e-9
    )


@pytest.mark.parametrize("leading", [(1,), (3,), (2, 2)], ids=str)
def test_hypotheses_equal_the_loop_over_them(leading, messy):
    poses, scene = torch.cat(messy[0]), Scene.cat(messy[1])
    count = math.prod(leading)
    noise = torch.randn(count, len(poses), 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    many = se3.retract(poses, 2e-3 * noise)
    refiner = short(6, keep_trajectory=True)
    together = refiner(many.reshape(*leading, *poses.shape), scene)
    each = [refiner(p, scene) for p in many]
    assert together.poses.shape == (*leading, *poses.shape)
    assert torch.allclose(together.poses.reshape(many.shape), torch.stack([e.poses for e in each]), rtol=0, atol=1e-9)
    assert together.steps.shape == together.converged.shape == (*leading, 4)
    assert together.trajectory.shape == (7, *leading, *poses.shape)
    assert together.report.gap.shape == together.terms.total.shape == (*leading, len(poses))


def test_the_best_hypothesis_is_chosen_image_by_image(table, box):
    """Image 0 is estimated well by the first hypothesis, image 1 by the second."""
    scene = Scene.cat([Scene.tabletop([box], table.plane)] * 2)
    good, bad = table.at(0, 0, 0.02), table.at(0, 0, -0.02)
    hypotheses = torch.stack([torch.stack([good, bad]), torch.stack([bad, good])])
    result = short(2)(hypotheses, scene)
    cost = result.terms.total
    assert float(cost[0, 0]) < float(cost[1, 0])
    assert float(cost[1, 1]) < float(cost[0, 1])
    assert torch.equal(result.best(), torch.stack([result.poses[0, 0], result.poses[1, 1]]))
    single = short(2)(hypotheses[0], scene)
    assert torch.equal(single.best(), single.poses)


def test_each_image_stops_on_its_own(table, box):
    """In one image nothing acts on the object, one has work to do, one is empty."""
    scenes = [Scene([box]), Scene.tabletop([box], table.plane), Scene.tabletop([], table.plane)]
    running = []
    result = PhysPoseRefiner()(
        table.poses((0, 0, 0.02), (0, 0, 0.01)),
        Scene.cat(scenes),
        callback=lambda step, poses, terms: running.append(len(poses)),
    )
    steps = result.steps.tolist()
    assert steps[2] == 0
    assert steps[0] == 10 < steps[1]
    assert result.converged.tolist()[::2] == [True, True]
    assert running == [2] * steps[0] + [1] * (steps[1] - steps[0])


def test_no_objects_no_steps(table):
    for scene in (Scene([]), Scene([], n_images=3), Scene([], image=torch.zeros(0, dtype=torch.long))):
        result = PhysPoseRefiner(RefinerConfig(keep_trajectory=True))(torch.zeros(0, 4, 4), scene)
        assert result.poses.shape == (0, 4, 4)
        assert result.steps.tolist() == [0] * scene.n_images
        assert bool(result.converged.all())
        assert result.best().shape == (0, 4, 4)
        assert result.trajectory.shape == (1, 0, 4, 4)
    assert PhysPoseRefiner()(torch.zeros(2, 0, 4, 4), Scene([])).poses.shape == (2, 0, 4, 4)


# ---- what comes back


def test_the_trajectory_starts_at_the_estimate_and_ends_at_the_result(table, box):
    pose = table.poses((0, 0, 0.01))
    result = short(5, keep_trajectory=True)(pose, Scene.tabletop([box], table.plane))
    assert result.trajectory.shape == (6, 1, 4, 4)
    assert torch.equal(result.trajectory[0], pose)
    assert torch.equal(result.trajectory[-1], result.poses)
    assert bool((motion(result.trajectory[1:], result.trajectory[:-1]) > 0).all())
    assert short(5)(pose, Scene.tabletop([box], table.plane)).trajectory is None


def test_the_callback_sees_each_step_before_it_is_taken(table, box):
    seen = []
    pose = table.poses((0, 0, 0.01))
    result = short(4, keep_trajectory=True, start="measured")(
        pose, Scene.tabletop([box], table.plane), callback=lambda *args: seen.append(args)
    )
    assert [step for step, _, _ in seen] == [0, 1, 2, 3]
    for step, poses, terms in seen:
        assert torch.equal(poses, result.trajectory[step])
        assert terms.total.shape == (1,)
        assert not terms.total.requires_grad
        assert not poses.requires_grad


def test_terms_and_report_are_those_of_the_refined_poses(table, box, can):
    pose, scene = table.poses((0, 0, 0.01), (0.07, 0, 0.04)), Scene.tabletop([box, can], table.plane)
    result = short(4)(pose, scene)
    terms = PhysicsLoss()(result.poses, scene, measured=pose)
    for a, b in zip(result.terms, terms, strict=True):
        assert torch.allclose(a, b)
    report = physics_report(result.poses, scene)
    torch.testing.assert_close(result.report.gap, report.gap, atol=1e-14, rtol=0)
    torch.testing.assert_close(result.report.penetration, report.penetration, atol=1e-14, rtol=0)


def test_no_step_is_longer_than_the_cap(table, box):
    """With a prior as loose as that, uncapped steps would be metres."""
    config = RefinerConfig(keep_trajectory=True, steps=10, max_step=0.002, start="measured")
    loose = 100.0 * torch.eye(6, dtype=torch.float64)
    pose = table.poses((0, 0, -0.1))
    path = PhysPoseRefiner(config)(pose, Scene.tabletop([box], table.plane), measured_covariance=loose).trajectory
    assert float(motion(path[1:], path[:-1]).max()) == pytest.approx(0.002, rel=0.5)
    assert float(motion(path[1:], path[:-1]).max()) <= 0.002 + 1e-9


def test_the_same_input_gives_the_same_output(messy):
    poses, scene = torch.cat(messy[0]), Scene.cat(messy[1])
    refiner = PhysPoseRefiner(RefinerConfig(PhysicsConfig(smoothing=Smoothing("gaussian")), steps=6))
    first = refiner(poses, scene)
    torch.manual_seed(1)
    state = torch.random.get_rng_state()
    second = refiner(poses, scene)
    assert torch.equal(first.poses, second.poses)
    assert torch.equal(state, torch.random.get_rng_state())


def test_the_callers_dtype_comes_back_and_the_input_is_left_alone(dtype, table, box):
    pose = table.poses((0, 0, 0.012)).to(dtype)
    before = pose.clone()
    result = short(keep_trajectory=True)(pose, Scene.tabletop([box], table.plane))
    assert result.poses.dtype == result.trajectory.dtype == result.report.gap.dtype == result.terms.total.dtype == dtype
    assert torch.equal(pose, before)
    se3.check_rigid(result.poses, "refined")
    R = result.poses[:, :3, :3].double()
    assert torch.allclose(R.mT @ R, torch.eye(3, dtype=torch.float64), atol=1e-6 if dtype == torch.float32 else 1e-12)


# ---- modes


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode], ids=["no_grad", "inference_mode"])
def test_it_refines_where_gradients_are_off(mode, table, box, can):
    rows = [(0, 0, 0.01), (0.07, 0, 0.04)]
    plain = short()(table.poses(*rows), Scene.tabletop([box, can], table.plane))
    with mode():
        plane = Plane.from_pose(table.T.clone())
        slab = Body.box((0.1, 0.06, 0.04), label="box")
        covariance = None
        inside = short()(table.poses(*rows), Scene.tabletop([slab, can], plane), measured_covariance=covariance)
        assert torch.allclose(inside.poses, plain.poses, atol=1e-12)
        given = short()(
            table.poses(*rows),
            Scene([slab, can], [Static(plane), Static(slab, table.at(0.3, 0, 0.02))], gravity=table.gravity),
            measured_covariance=1e-4 * torch.eye(6, dtype=torch.float64).expand(2, 6, 6).clone(),
            scores=torch.tensor([0.1, 0.9]),
        )
    assert not given.poses.requires_grad
    # and what came out can be used in training
    leaf = inside.poses.clone().requires_grad_()
    PhysicsLoss()(leaf, Scene.tabletop([box, can], table.plane)).total.sum().backward()


def test_a_scene_refined_in_inference_mode_can_be_trained_on(table, box, can):
    poses = table.poses((0, 0, 0.01), (0.07, 0, 0.04))
    scene = Scene.tabletop([box, can], table.plane)
    with torch.inference_mode():
        short(2)(poses.clone(), scene)
        PhysicsLoss()(poses.clone(), scene)
    leaf = poses.clone().requires_grad_()
    PhysicsLoss()(leaf, scene, measured=poses).total.sum().backward()
    assert bool(leaf.grad.isfinite().all())


def test_it_refines_a_networks_output_without_a_graph(table, box):
    leaf = table.poses((0, 0, 0.01)).requires_grad_()
    result = short(2)(leaf * 1.0, Scene.tabletop([box], table.plane))
    assert not result.poses.requires_grad
    assert not result.terms.total.requires_grad
    assert leaf.grad is None


def test_autocast_changes_nothing(table, box):
    pose, scene = table.poses((0, 0, 0.01)).float(), Scene.tabletop([box], table.plane)
    plain = short()(pose, scene).poses
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(short()(pose, scene).poses, plain)


def test_a_static_that_requires_grad_is_left_in_peace(table, box):
    """A robot's link, say: refining must not keep a graph to it, nor fail."""
    T = table.at(0.09, 0, 0.02).requires_grad_()
    scene = Scene([box], [Static(box, T), Static(table.plane)], gravity=table.gravity)
    result = short(3)(table.poses((0, 0, 0.02)), scene)
    assert not result.poses.requires_grad
    assert T.grad is None


# ---- the paper's preset


def test_plain_descent_takes_the_papers_step(table, box):
    """One step by hand: 5 mm inside the table, gradient -n of the collision, nothing else yet: 0.1 mm up."""
    config = dataclasses.replace(RefinerConfig.paper(), steps=1)
    config = dataclasses.replace(config, physics=dataclasses.replace(config.physics, smoothing=Smoothing("ring")))
    pose = table.poses((0, 0, 0.015))
    result = PhysPoseRefiner(config)(pose, Scene.tabletop([box], table.plane))
    assert torch.allclose((result.poses - pose)[0, :3, 3], 1e-4 * table.up, atol=1e-9)
    # a gradient longer than 1 is shortened to 1
    strong = dataclasses.replace(config, physics=dataclasses.replace(config.physics, collision_weight=50.0))
    result = PhysPoseRefiner(strong)(pose, Scene.tabletop([box], table.plane))
    assert torch.allclose((result.poses - pose)[0, :3, 3], 1e-4 * table.up, atol=1e-9)


def test_the_papers_preset_heads_out_of_the_table_and_down_onto_it(table, box, can):
    config = dataclasses.replace(RefinerConfig.paper(), steps=30)
    poses = table.poses((0, 0, 0.01), (0.3, 0, 0.05))
    result = PhysPoseRefiner(config)(poses, Scene.tabletop([box, can], table.plane))
    height = table.where(result.poses)[:, 2] - table.where(poses)[:, 2]
    assert 2e-3 < float(height[0]) < 3e-3  # 0.1 mm a step, less what the prior holds back
    assert -3e-3 < float(height[1]) < -2e-3
    assert result.steps.tolist() == [30]


@pytest.mark.slow
def test_the_papers_preset_settles_a_scene(table, box, can):
    poses = table.poses((0, 0, 0.01), (0.3, 0, 0.05))
    result = PhysPoseRefiner(RefinerConfig.paper())(poses, Scene.tabletop([box, can], table.plane))
    assert float(result.report.penetration.max()) < 1e-3
    assert float(result.report.gap.max()) < 1e-3


# ---- what is refused


def test_a_wrong_input_is_refused_by_name(table, box, can):
    scene = Scene.tabletop([box, can], table.plane)
    poses = table.poses((0, 0, 0.02), (0.3, 0, 0.04))
    broken = poses.clone()
    broken[1, 0, 3] = math.nan
    in_millimetres = poses.clone()
    in_millimetres[:, :3, 3] *= 1000
    identity = torch.eye(6, dtype=torch.float64)
    for wrong, options, message in [
        (broken, {}, r"poses\[1\] \(can\) contains NaN"),
        (in_millimetres, {}, r"\(box\).* m from the camera.*millimetres"),
        (poses[:1], {}, r"\(1, 4, 4\), expected \(\.\.\., 2, 4, 4\)"),
        (poses, {"measured_covariance": -identity}, r"\(box\) is not positive definite"),
        (poses, {"measured_covariance": identity.expand(3, 6, 6)}, r"measured_covariance has shape \(3, 6, 6\)"),
        (poses, {"scores": torch.ones(1)}, "scores have shape"),
    ]:
        with pytest.raises(InvalidInputError, match=message):
            PhysPoseRefiner()(wrong, scene, **options)


def test_a_sunken_object_starts_where_its_viewing_ray_leaves_the_table(table, box):
    """10 cm along the ray into the table, far beyond what sixty steps could undo: the slide alone brings it back."""
    truth = table.poses((0.05, 0.02, 0.02))
    ray = torch.nn.functional.normalize(truth[0, :3, 3], dim=0)
    sunk = truth.clone()
    sunk[0, :3, 3] += 0.3 * ray
    scene = Scene.tabletop([box], table.plane)
    no_steps = PhysPoseRefiner(RefinerConfig(steps=0))(sunk, scene).poses
    torch.testing.assert_close(no_steps, truth, atol=1e-9, rtol=0)
    stay = PhysPoseRefiner(RefinerConfig(steps=0, start="measured"))(sunk, scene).poses
    assert torch.equal(stay, sunk)


def test_an_object_above_the_table_or_seen_along_it_does_not_start_elsewhere(table, box):
    above = table.poses((0, 0, 0.08))
    scene = Scene.tabletop([box], table.plane)
    assert torch.equal(PhysPoseRefiner(RefinerConfig(steps=0))(above, scene).poses, above)
    edge_on = Plane(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), torch.tensor(-0.02, dtype=torch.float64))
    ahead = torch.eye(4, dtype=torch.float64)[None].clone()
    ahead[0, :3, 3] = torch.tensor([0.0, 0.03, 0.8])
    assert torch.equal(PhysPoseRefiner(RefinerConfig(steps=0))(ahead, Scene.tabletop([box], edge_on)).poses, ahead)
