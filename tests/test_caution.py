"""What keeps the refiner from making estimates worse: what images ask for, who pushes nobody, and who is left alone."""

import math
import warnings
from dataclasses import replace

import pytest
import torch

from physpose_torch import se3
from physpose_torch.agreement import Flush, agreed_scale, asked_depth, asked_tilt, look, scaled, weights
from physpose_torch.config import Caution, PhysicsConfig, RefinerConfig
from physpose_torch.conflicts import find_dubious, find_overlaps
from physpose_torch.contacts import find_drops
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.losses import PhysicsLoss, acting
from physpose_torch.prior import make_prior
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static

PHYSICS = PhysicsConfig()


def careful(**options) -> PhysPoseRefiner:
    """The default refiner with other caution."""
    return PhysPoseRefiner(RefinerConfig(caution=replace(Caution(), **options)))


def quietly(refiner, *args, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return refiner(*args, **options)


def farther(poses, factor):
    poses = poses.clone()
    poses[:, :3, 3] *= factor
    return poses


def looked(poses, scene, scores=None, physics=PHYSICS):
    acts = acting(scene, scores)
    prior = make_prior(poses, scene, acts, None, physics)
    return look(prior, scene, acts, "auto"), prior


def raised(table, by):
    """The table's plane, too high."""
    return Plane(table.plane.normal, table.plane.offset + by)


@pytest.fixture
def three(table, box, can):
    """Two cans and a box on the table, apart, and their true poses."""
    poses = table.poses((0, 0, 0.04), (0.12, 0.05, 0.04), (-0.15, 0, 0.02, (0, 0, 0.4)))
    return poses, Scene.tabletop([can, can, box], table.plane)


# ---- what an image asks for


@pytest.mark.parametrize("factor", [1.03, 0.98])
def test_objects_ask_for_the_depth_factor_that_they_lack(factor, three):
    poses, scene = three
    asked = asked_depth(*looked(farther(poses, factor), scene), torch.ones(3))
    assert asked.tolist() == pytest.approx([1 / factor - 1], abs=1.5e-3)


def test_a_gross_error_is_outvoted_and_a_sure_object_counts_more(three):
    poses, scene = three
    poses = farther(poses, 1.02)
    poses[1, :3, 3] *= 1.1
    assert asked_depth(*looked(poses, scene), torch.ones(3)).item() == pytest.approx(-0.02, abs=2.5e-3)
    # of two that contradict each other the one with the better score has its way
    pair, two = poses[:2], Scene(scene.objects[:2], scene.statics, gravity=scene.gravity)
    sure = asked_depth(*looked(pair, two), torch.tensor([1.0, 0.1])).item()
    other = asked_depth(*looked(pair, two), torch.tensor([0.1, 1.0])).item()
    assert sure == pytest.approx(-0.02, abs=3e-3)
    assert other < -0.08


def test_nothing_is_asked_for_without_a_common_factor_or_a_plane(three, can):
    poses, scene = three
    poses = farther(poses, 1.03)
    independent = replace(PHYSICS, sigma_depth_common=0.0)
    assert asked_depth(*looked(poses, scene, physics=independent), torch.ones(3)).item() == 0
    assert asked_depth(*looked(poses, Scene(scene.objects)), torch.ones(3)).item() == 0
    assert asked_depth(*looked(poses[:0], Scene((), n_images=2)), torch.ones(0)).tolist() == [0, 0]


@pytest.mark.parametrize("scores", [[0.0, 0.0, 0.0], [-1.0, 2.0, 0.5]])
def test_scores_that_are_no_shares_weigh_alike(scores, three):
    _, prior = looked(*three)
    assert weights(torch.tensor(scores), prior).tolist() == [1, 1, 1]


def test_objects_ask_for_the_tilt_that_the_plane_lacks(table, three):
    poses, scene = three
    heights, prior = looked(poses, scene)
    assert asked_tilt(heights, prior).item() == pytest.approx(0, abs=1e-6)
    turn = se3.exp_so3(torch.tensor([math.radians(8), 0, 0], dtype=torch.float64))
    wrong = Scene.tabletop(scene.objects, Plane(turn @ table.plane.normal, table.plane.offset))
    assert asked_tilt(*looked(poses, wrong)).item() == pytest.approx(math.radians(8), rel=1e-3)
    alone = Scene.tabletop(scene.objects[:1], table.plane)
    assert asked_tilt(*looked(poses[:1], alone)).isnan().all()


def test_estimates_that_agree_are_taken_to_be_accurate(three):
    poses, scene = three

    def scale(poses, least=0.2):
        return agreed_scale(*looked(poses, scene), sigma_contact=0.003, least=least).item()

    # three of a kind that has a quarter of the spread, expected of one image in five: 4³ · ¼ to one
    assert scale(poses) == pytest.approx(1 - 16 / 17 * (1 - 0.2**2))
    assert scale(poses, 0.6) == pytest.approx(1 - 16 / 17 * (1 - 0.6**2))
    assert scale(farther(poses, 1.02)) > 0.95


def test_only_depths_and_rotations_are_more_accurate_then(three):
    """How high objects are tells nothing of how well they are known across their rays."""
    _, prior = looked(*three)
    surer = torch.linalg.inv(scaled(prior, torch.tensor([0.25], dtype=torch.float64)).precision)
    usual = torch.linalg.inv(prior.precision)
    ray = torch.nn.functional.normalize(prior.ray, dim=1)
    across = torch.nn.functional.normalize(torch.linalg.cross(ray, ray.roll(1, 1)), dim=1)

    def along(axis, covariance):
        return torch.einsum("ni,nij,nj->n", axis, covariance[:, :3, :3], axis)

    torch.testing.assert_close(along(ray, surer), 0.25 * along(ray, usual))
    torch.testing.assert_close(along(across, surer), along(across, usual))
    torch.testing.assert_close(surer[:, 3:, 3:], 0.25 * usual[:, 3:, 3:])


def test_what_stands_stands_flush(table, box):
    """Joined by their information: of a tilt of 3°, σ_f² / (σ_f² + σ_R²) is left; the yaw and the place stay."""
    tilt, yaw = math.radians(3), 0.5
    rotation = se3.exp_so3(torch.tensor([0, 0, yaw], dtype=torch.float64))
    rotation = se3.exp_so3(torch.tensor([tilt, 0, 0], dtype=torch.float64)) @ rotation
    pose = table.at(0, 0, 0.021)
    pose[:3, :3] = table.T[:3, :3] @ rotation
    scene = Scene.tabletop([box], table.plane)
    heights, prior = looked(pose[None], scene)
    joined = Flush.of(heights).join(prior, 0.04)
    left = (table.T[:3, :3].mT @ joined.measured[0, :3, :3])[:, 2]
    share = 0.04**2 / (0.04**2 + PHYSICS.sigma_rotation**2)
    assert math.acos(float(left[2])) == pytest.approx(tilt * share, rel=1e-3)
    turned = se3.log_so3(prior.measured[0, :3, :3].mT @ joined.measured[0, :3, :3])
    assert abs(float((prior.measured[0, :3, :3] @ turned) @ table.up)) < 1e-4
    assert torch.equal(joined.measured[0, :3, 3], pose[:3, 3])
    assert torch.equal(Flush.of(heights).join(prior, math.inf).measured, prior.measured)


@pytest.mark.parametrize(("height", "tilt"), [(0.08, 3), (0.021, 15)])
def test_what_hangs_or_leans_is_not_laid_flush(height, tilt, table, box):
    pose = table.at(0, 0, height + 0.05 * math.sin(math.radians(tilt)), (0, math.radians(tilt), 0))
    heights, _ = looked(pose[None], Scene.tabletop([box], table.plane))
    assert not Flush.of(heights).stands.any()


# ---- who pushes nobody


def dubious(poses, scene, scores=None, limit=0.02, backend="auto"):
    scores = torch.ones(len(poses)) if scores is None else scores
    heights, prior = looked(poses, scene, scores)
    depth = asked_depth(heights, prior, scores)
    return find_dubious(heights, depth, prior, scene, scores, limit=limit, backend=backend).tolist()


def test_a_false_detection_between_two_objects_pushes_neither(table, box, can):
    poses = table.poses((-0.045, 0, 0.04), (0.045, 0, 0.04), (0, 0, 0.02))
    scene = Scene.tabletop([can, can, box], table.plane)
    assert dubious(poses, scene) == [False, False, True]
    assert dubious(poses, scene, limit=0.05) == [False, False, False]
    assert dubious(poses, scene, backend="fcl") == [False, False, True]
    result = quietly(PhysPoseRefiner(), poses, scene)
    assert result.rejected.tolist() == [False, False, True]
    assert torch.equal(result.poses[2], poses[2])
    assert float((result.poses[:2] - poses[:2])[:, :3, 3].norm(dim=1).max()) < 2e-3
    moved = quietly(careful(conflict=math.inf, release=math.inf, least_sigma=1.0), poses, scene)
    assert float((moved.poses[:2] - poses[:2])[:, :3, 3].norm(dim=1).min()) > 5e-3


def test_of_two_in_one_place_the_less_likely_one_gives_way(table, can):
    scene = Scene.tabletop([can, can], table.plane)
    poses = table.poses((0, 0, 0.04), (0.02, 0, 0.04))
    assert dubious(poses, scene, torch.tensor([0.9, 0.4])) == [False, True]
    assert dubious(poses, scene, torch.tensor([0.4, 0.9])) == [True, False]
    leaning = table.poses((0, 0, 0.04), (0.02, 0, 0.045, (0.5, 0, 0)))
    assert dubious(leaning, scene) == [False, True]


def test_where_nothing_tells_depths_overlaps_may_be_deeper(can):
    """Two cans behind each other, 25 mm in one another: 1 % of 0.8 m twice over may explain that."""
    first = torch.eye(4, dtype=torch.float64)
    first[2, 3] = 0.8
    second = first.clone()
    second[2, 3] += 0.035
    poses = torch.stack([first, second])
    assert dubious(poses, Scene([can, can])) == [False, False]
    assert any(dubious(poses, Scene([can, can], [Static(Plane(torch.tensor([0.0, -1, 0]), torch.tensor(-0.5)))])))


@pytest.mark.parametrize("backend", ["auto", "fcl"])
def test_overlaps_are_the_deepest_of_all_parts(backend, table, angle, box):
    poses = table.poses((0, 0, 0), (0.08, 0.015, 0.02), (0.5, 0, 0.02))
    scene = Scene.tabletop([angle, box, box], table.plane)
    pairs, depth = find_overlaps(poses, scene, torch.ones(3, dtype=torch.bool), backend)
    found = dict(zip(map(tuple, pairs.tolist()), depth.tolist(), strict=True))
    assert found[0, 1] == pytest.approx(float(physics_report(poses, scene).penetration_object[0]), abs=1e-9)
    assert found[0, 1] > 0.02
    assert found.get((0, 2), 0.0) == 0
    alone = torch.tensor([True, False, True])
    pairs, depth = find_overlaps(poses, scene, alone, backend)
    assert not len(pairs) or float(depth.max()) == 0


# ---- who is left alone


@pytest.fixture
def wild(table, can, three):
    """Three good estimates, 1 % too far, and a can on its head's edge, 9 cm deep in the table."""
    poses, scene = three
    bad = table.at(0.3, 0.05, -0.05, (1.0, 0, 0))
    poses = torch.cat([farther(poses, 1.01), bad[None]])
    return poses, Scene.tabletop([*scene.objects, can], table.plane)


def test_what_cannot_be_put_right_keeps_its_pose(wild):
    poses, scene = wild
    cautious = RefinerConfig(righting=0.0)
    result = PhysPoseRefiner(cautious)(poses, scene)
    assert result.rejected.tolist() == [False, False, False, True]
    assert torch.equal(result.poses[3], poses[3])
    assert result.status[3] == "rejected"
    assert result.report.status[3] == "penetrating"
    assert float(result.report.penetration[:3].max()) < 1e-3
    moved = PhysPoseRefiner(replace(cautious, caution=replace(Caution(), release=math.inf)))(poses, scene)
    assert not moved.rejected.any()
    assert float((moved.poses[3] - poses[3])[:3, 3].norm()) > 0.03


def test_a_pose_that_is_put_right_from_far_off_is_kept(table, three):
    """Standing, but 6 cm too deep along its ray: more than three σ, and right afterwards."""
    poses, scene = three
    poses = poses.clone()
    poses[0, :3, 3] *= 1 + 0.06 / float(poses[0, :3, 3].norm())
    result = PhysPoseRefiner()(poses, scene)
    assert not result.rejected.any()
    assert not result.doubted.any()
    assert float((table.where(result.poses[0]) - torch.tensor([0, 0, 0.04])).abs().max()) < 6e-3


def test_what_nothing_carries_stays(table, can, three):
    poses, scene = three
    hanging = torch.cat([farther(poses, 1.02), table.at(0.25, 0.1, 0.14)[None]])
    scene = Scene.tabletop([*scene.objects, can], table.plane)
    result = PhysPoseRefiner()(hanging, scene)
    assert result.unsupported.tolist() == [False, False, False, True]
    assert torch.equal(result.poses[3], hanging[3])
    assert result.status[3] == "unsupported"
    follows = careful(unsupported="follow")(hanging, scene)
    assert not follows.unsupported.any()
    ratio = follows.poses[3, :3, 3].norm() / hanging[3, :3, 3].norm()
    assert float(ratio) == pytest.approx(1 / 1.02, abs=4e-3)


def test_a_known_depth_bias_is_removed_from_what_stays(table, can):
    poses = table.poses((0, 0, 0.04), (0.25, 0.1, 0.16))
    config = RefinerConfig(PhysicsConfig(depth_factor=1 / 1.05))
    result = PhysPoseRefiner(config)(farther(poses, 1.05), Scene.tabletop([can, can], table.plane))
    assert result.unsupported.tolist() == [False, True]
    assert float((result.poses[1] - poses[1]).abs().max()) < 1e-12


def test_what_stays_is_moved_where_others_have_come_into_its_place(table, can, box):
    """A can above a box that rises into it: they are not left in one another."""
    poses = table.poses((0, 0, -0.055), (0, 0, 0.045), (0.2, 0, 0.04), (-0.2, 0, 0.04))
    scene = Scene.tabletop([box, can, can, can], table.plane)
    result = quietly(PhysPoseRefiner(), poses, scene)
    assert float(result.report.penetration_object.max()) < 6e-3


@pytest.mark.parametrize("by", [0.03, -0.035])
def test_an_image_that_contradicts_its_plane_is_left_alone(by, table, three):
    poses, scene = three
    wrong = Scene.tabletop(scene.objects, raised(table, by))
    with pytest.warns(UserWarning, match="image 0: its objects would have to be at 1?0?\\.[0-9]+ of their distances"):
        result = PhysPoseRefiner()(poses, wrong)
    assert torch.equal(result.poses, poses)
    assert result.doubted.tolist() == [True]
    assert "check plane, units" in result.doubts[0]
    assert not result.rejected.any()
    assert not result.unsupported.any()
    assert not result.righted.any()
    trusting = careful(doubt=math.inf)(poses, wrong)
    assert trusting.doubts == ("",)
    assert not torch.equal(trusting.poses, poses)


def test_an_unsure_plane_is_not_contradicted(table, three):
    poses, scene = three
    covariance = torch.diag(torch.tensor([0, 0, 0.02**2], dtype=torch.float64))
    high = raised(table, 0.03)
    result = PhysPoseRefiner()(poses, Scene.tabletop(scene.objects, Plane(high.normal, high.offset, covariance)))
    assert not result.doubted.any()


def test_a_tilted_plane_is_doubted(table, three):
    poses, scene = three
    turn = se3.exp_so3(torch.tensor([math.radians(9), 0, 0], dtype=torch.float64))
    normal = turn @ table.plane.normal
    wrong = Plane(normal, normal @ poses[:, :3, 3].mean(0) - 0.03)
    result = quietly(PhysPoseRefiner(), poses, Scene.tabletop(scene.objects, wrong))
    assert torch.equal(result.poses, poses)
    assert "9° askew" in result.doubts[0]


def test_gravity_the_wrong_way_and_mirrored_cameras_are_doubted(table, three):
    poses, scene = three
    upside = Scene.tabletop(scene.objects, Plane(-table.plane.normal, -table.plane.offset))
    assert quietly(PhysPoseRefiner(), poses, upside).doubted.all()
    mirrored = poses.clone()
    mirrored[:, 1, 3] *= -1
    result = quietly(PhysPoseRefiner(), mirrored, scene)
    assert result.doubted.all()
    assert torch.equal(result.poses, mirrored)


def test_an_object_that_is_alone_is_not_believed_against_its_plane(table, box):
    result = PhysPoseRefiner()(table.poses((0, 0, -0.03)), Scene.tabletop([box], table.plane))
    assert not result.doubted.any()
    assert float(result.report.penetration) < 1e-3


def test_only_the_image_in_doubt_is_left_alone(table, three):
    poses, scene = three
    wrong = Scene.tabletop(scene.objects, raised(table, 0.03))
    off = farther(poses, 1.01)
    both = quietly(PhysPoseRefiner(), torch.cat([off, off]), Scene.cat([wrong, scene]))
    alone = PhysPoseRefiner()(off, scene)
    assert both.doubted.tolist() == [True, False]
    assert torch.equal(both.poses[:3], off)
    assert torch.equal(both.poses[3:], alone.poses)


def test_without_caution_nobody_is_left_alone(wild):
    poses, scene = wild
    result = PhysPoseRefiner(RefinerConfig(caution=Caution.off()))(poses, scene)
    assert not (result.rejected | result.unsupported).any()
    assert not result.doubted.any()
    assert RefinerConfig.paper().caution == Caution.off()


def test_nothing_in_nothing_out():
    result = PhysPoseRefiner()(torch.zeros(0, 4, 4), Scene((), n_images=2))
    assert result.doubts == ("", "")
    assert result.status == []
    assert result.covariance.shape == (0, 6, 6)


def test_report_and_terms_are_those_of_the_poses_that_come_back(wild):
    poses, scene = wild
    scores = torch.tensor([0.9, 0.8, 0.7, 0.6])
    result = PhysPoseRefiner(RefinerConfig(righting=0.0))(poses, scene, scores=scores)
    assert result.rejected.any()
    report = physics_report(result.poses, scene, scores=scores)
    for name in ("penetration_static", "penetration_object", "gap", "support"):
        assert torch.equal(getattr(result.report, name), getattr(report, name))
    terms = PhysicsLoss()(result.poses, scene, measured=poses, scores=scores)
    for a, b in zip(result.terms, terms, strict=True):
        torch.testing.assert_close(a, b, atol=1e-9, rtol=1e-7)


def test_hypotheses_are_each_judged_by_themselves(wild):
    poses, scene = wild
    good = poses.clone()
    good[3] = poses[0]
    good[3, 0, 3] += 0.3
    both = quietly(PhysPoseRefiner(RefinerConfig(righting=0.0)), torch.stack([poses, good]), scene)
    assert both.rejected.tolist() == [[False] * 3 + [True], [False] * 4]
    assert both.doubted.shape == (2, 1)
    assert len(both.status) == 8


@pytest.mark.parametrize("backend", ["auto", "fcl"])
def test_supports_are_looked_for_no_farther_than_each_object_may_be_off(backend, table, can):
    poses = table.poses((0, 0, 0.06), (0.2, 0, 0.06), (0.2, 0, 0.155))
    scene = Scene.tabletop([can, can, can], table.plane)
    reach = torch.tensor([0.03, 0.01, 0.03])
    drops = find_drops(poses, scene, reach=reach, backend=backend)
    assert drops.height.tolist() == pytest.approx([0.02, math.inf, 0.015], abs=1e-9)
    assert drops.support.tolist() == [3, -1, 1]


def test_soft_contacts_among_objects(table, can):
    """ζ d² / 2w with w = ζσ²: 2 mm at σ = 2 mm cost half."""
    poses = table.poses((0, 0, 0.04), (0.058, 0, 0.04))
    scene = Scene.tabletop([can, can], table.plane)
    depth = float(physics_report(poses, scene).penetration_object[0])
    physics = PhysicsConfig(collision_weight=2000.0, sigma_contact=0.002, softness=0.0)
    for backend in ("auto", "fcl"):
        terms = PhysicsLoss(replace(physics, backend=backend))(poses, scene)
        assert float(2000 * terms.collision[0]) == pytest.approx(0.5 * (depth / 0.002) ** 2, rel=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Caution(conflict=0.0), "conflict"),
        (lambda: Caution(release=-1.0), "release"),
        (lambda: Caution(doubt=math.nan), "doubt"),
        (lambda: Caution(least_sigma=1.5), "least_sigma"),
        (lambda: Caution(unsupported="fall"), "unsupported"),
        (lambda: PhysicsConfig(sigma_flush=0.0), "sigma_flush"),
        (lambda: PhysicsConfig(sigma_contact=-1e-3), "sigma_contact"),
    ],
)
def test_options_out_of_range(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()


# ---- objects that are known


def test_known_objects_stay_and_the_others_fit_them(table, box, can):
    poses = table.poses((0, 0, 0.03), (0, 0, 0.095), (0.075, 0, 0.04))
    scene = Scene.tabletop([box, can, can], table.plane)
    result = PhysPoseRefiner()(poses, scene, refine_only=torch.tensor([False, True, True]))
    assert torch.equal(result.poses[0], poses[0])
    assert result.report.support.tolist()[1] == 0
    assert float(result.report.penetration_object.max()) < 3e-3
    assert float(result.report.gap[1]) < 1e-3
    # the same as with the known one given as a static body
    static = Scene([can, can], [Static(table.plane), Static(box, poses[0])], gravity=table.gravity)
    assert torch.equal(PhysPoseRefiner()(poses[1:], static).poses, result.poses[1:])
    assert torch.equal(result.covariance[0], torch.zeros(6, 6, dtype=torch.float64))
    assert bool((torch.linalg.eigvalsh(result.covariance[1:]) > 0).all())


def test_known_objects_with_hypotheses_alternatives_and_trajectories(table, box, can):
    poses = table.poses((0, 0, 0.03), (0.2, 0, 0.05), (0.2, 0.004, 0.05))
    scene = Scene([box, can, can], [Static(table.plane)], gravity=table.gravity, same_object=torch.tensor([0, 1, 1]))
    config = RefinerConfig(keep_trajectory=True)
    mask = torch.tensor([True, False, True])
    result = PhysPoseRefiner(config)(
        poses.expand(2, 3, 4, 4), scene, refine_only=mask, scores=torch.tensor([1.0, 0.9, 0.5])
    )
    # the alternative of what is known is known as well
    assert torch.equal(result.poses[:, 1:], poses[1:].expand(2, 2, 4, 4))
    assert float(result.report.gap[0, 0]) < 1e-3
    assert torch.equal(result.trajectory[-1], result.poses)
    assert torch.equal(result.trajectory[0, 0], poses)
    everyone = PhysPoseRefiner()(poses, scene, refine_only=torch.zeros(3, dtype=torch.bool))
    assert torch.equal(everyone.poses, poses)


@pytest.mark.parametrize("mask", [torch.tensor([True]), torch.tensor([1, 0]), torch.tensor([[True, False]])])
def test_masks_that_do_not_fit(mask, table, can):
    scene = Scene.tabletop([can, can], table.plane)
    with pytest.raises(InvalidInputError, match="refine_only"):
        PhysPoseRefiner()(table.poses((0, 0, 0.04), (0.2, 0, 0.04)), scene, refine_only=mask)


# ---- what refined poses are worth


def test_contact_tells_the_height_and_nothing_across(table, three):
    """Across the table's normal a pose is known to the contact's σ; about it, and along the table, as the estimate is."""
    poses, scene = three
    config = RefinerConfig(PhysicsConfig(softness=2e-3), caution=replace(Caution(), least_sigma=1.0))
    result = PhysPoseRefiner(config)(farther(poses, 1.005), scene)
    C = result.covariance
    assert torch.equal(C, C.mT) or float((C - C.mT).abs().max()) < 1e-15
    assert bool((torch.linalg.eigvalsh(C) > 0).all())
    up = table.up
    height = torch.einsum("i,nij,j->n", up, C[:, :3, :3], up).sqrt()
    side = C[:, 0, 0].sqrt()  # x of the camera lies in the table
    assert float(height.max()) < 3e-3
    assert side.tolist() == pytest.approx([PHYSICS.sigma_lateral] * 3, rel=0.3)


def test_what_is_left_alone_is_worth_what_the_estimate_was(wild):
    poses, scene = wild
    result = PhysPoseRefiner(RefinerConfig(righting=0.0))(poses, scene)
    prior = make_prior(poses, scene, acting(scene, None), None, PHYSICS)
    own = torch.linalg.inv(prior.precision)
    own[:, :3, :3] += PHYSICS.sigma_depth_common**2 * prior.ray[:, :, None] * prior.ray[:, None, :]
    torch.testing.assert_close(result.covariance[3], own[3])
    assert float(result.covariance[0].trace()) < float(own[0].trace())


def test_gradients_of_what_is_left_alone_are_its_own(wild):
    poses, scene = wild
    poses = poses.requires_grad_()
    result = PhysPoseRefiner(RefinerConfig(righting=0.0, gradient="implicit"))(poses, scene)
    (gradient,) = torch.autograd.grad(result.poses[3, :3, 3].sum(), poses, retain_graph=True)
    assert torch.equal(gradient[3, :3, 3], torch.ones(3, dtype=torch.float64))
    assert float(gradient[:3].abs().max()) == 0
    (gradient,) = torch.autograd.grad(result.poses[:3, :3, 3].sum(), poses)
    assert bool(gradient.isfinite().all())
    assert float(gradient[:3].abs().max()) > 0.1


def test_bodies_without_a_stable_pose(table):
    """A ball: nothing to stand flush on, no tilt to ask about."""
    import trimesh

    from physpose_torch.geometry.convex import ConvexParts

    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    ball = Body("ball", ConvexParts.from_hulls([mesh.vertices]), mesh)
    poses = table.poses((0, 0, 0.025), (0.1, 0, 0.025))
    result = PhysPoseRefiner()(poses, Scene.tabletop([ball, ball], table.plane))
    assert float(result.report.penetration.max()) < 1e-3
    assert float(result.report.gap.max()) < 1e-3


def test_known_objects_tell_the_depth_of_the_others(table, box, can):
    """Without a plane: a can that hangs 3 % too far away in a known box comes back along its ray, and gradients are those."""
    poses = table.poses((0, 0, 0.02), (0, 0, 0.08), (0.03, 0.01, 0.08))
    poses[1:, :3, 3] *= 1.015
    scene = Scene([box, can, can], gravity=table.gravity, same_object=torch.tensor([0, 1, 1]))
    mask = torch.tensor([False, True, True])
    refine = PhysPoseRefiner(RefinerConfig(gradient="implicit"))
    leaf = poses.clone().requires_grad_()
    result = refine(leaf, scene, refine_only=mask)
    assert torch.equal(result.poses[0].detach(), poses[0])
    assert float(result.report.penetration_object[1]) < 4e-3
    assert bool(result._solution.scene.has_static.all())
    (gradient,) = torch.autograd.grad(result.poses[1:, :3, 3].sum(), leaf)
    assert bool(gradient.isfinite().all())
    assert float(gradient[1:].abs().max()) > 0.1
