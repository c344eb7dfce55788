"""Planted failures are where they are said to be, and the rest of the image is as it was."""

import math

import pytest
import torch

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.planted import FAILURES, Estimated, choose_failures
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static

BY_LABEL = {f.label: f.plant for f in FAILURES}
COVARIANCE = torch.diag(torch.tensor([1e-4, 1e-4, 4e-6], dtype=torch.float64))


@pytest.fixture
def absent() -> Body:
    return Body.cylinder(0.05, 0.1, label="absent")


@pytest.fixture
def image(table, box, can, absent) -> Estimated:
    """A can on a box, a second estimate of the box, and a box far away; the estimates are 1 cm off along x."""
    plane = Plane(table.plane.normal, table.plane.offset, COVARIANCE)
    truth = table.poses((0, 0, 0.02), (0, 0, 0.08), (0.3, 0.1, 0.02))
    poses = truth[[0, 1, 0, 2]].clone()
    poses[:, 0, 3] += 0.01
    poses[2, 0, 3] += 0.003
    same = torch.tensor([0, 1, 0, 3])
    scene = Scene([box, can, box, box], [Static(plane)], gravity=table.gravity, same_object=same)
    scores = torch.tensor([0.9, 0.5, 0.7, 0.8], dtype=torch.float64)
    return Estimated(poses, scores, scene, truth, (box, can, box), torch.tensor([0, 1, -1, 2]), (absent,))


def seeded(label, image, seed=0):
    return BY_LABEL[label](image, torch.Generator().manual_seed(seed))


def apart(a, b) -> float:
    """Angle between rotations [rad]."""
    return float(torch.linalg.vector_norm(se3.log_so3(a[:3, :3].mT @ b[:3, :3])))


# ---- all of them


@pytest.mark.parametrize("label", BY_LABEL)
def test_planting_is_reproducible_and_the_seed_matters(image, label):
    first, again, other = seeded(label, image, 3), seeded(label, image, 3), seeded(label, image, 4)
    assert torch.equal(first.poses, again.poses)
    assert torch.equal(first.scores, again.scores)
    assert torch.equal(first.scene.plane_normal, again.scene.plane_normal)
    # one order to swap, one supporter, one height: nothing to draw
    if label not in ("depth order", "missing supporter", "plane too high"):
        same_plane = torch.equal(first.scene.plane_normal, other.scene.plane_normal)
        assert not (first.poses.shape == other.poses.shape and torch.equal(first.poses, other.poses) and same_plane)


@pytest.mark.parametrize("label", BY_LABEL)
def test_what_is_not_touched_is_as_it_was_and_the_input_is_not_written_to(image, label):
    before = image.poses.clone()
    planted = seeded(label, image)
    assert torch.equal(image.poses, before)
    kept = ~planted.touched
    assert (planted.source[kept] >= 0).all()
    assert torch.equal(planted.poses[kept], image.poses[planted.source[kept]])
    assert torch.equal(planted.scores[kept], image.scores[planted.source[kept]])
    for i, k in enumerate(planted.source.tolist()):
        assert k < 0 or planted.scene.objects[i] is image.scene.objects[k]
    assert len(planted.scene) == len(planted.poses) == len(planted.scores) == len(planted.touched)
    se3.check_rigid(planted.poses, "poses")


def test_failures_are_chosen_by_name_and_a_name_may_stand_for_two():
    assert [f.label for f in choose_failures(["wrong-plane", "false-positive"])] == [
        "false positive, low score",
        "false positive, high score",
        "plane too high",
        "plane tilted",
    ]
    assert len({f.label for f in FAILURES}) == len(FAILURES)
    with pytest.raises(InvalidInputError, match=r"--plant earthquake: no such failure; there are false-positive, dup"):
        choose_failures(["accurate", "earthquake"])


# ---- one by one


@pytest.mark.parametrize(("label", "score"), [("false positive, low score", 0.25), ("false positive, high score", 0.9)])
def test_a_false_positive_is_of_an_absent_body_with_its_centre_amid_those_that_act(image, absent, label, score):
    planted = seeded(label, image)
    assert planted.source.tolist() == [0, 1, 2, 3, -1]
    assert planted.touched.tolist() == [False] * 4 + [True]
    assert planted.scene.objects[-1] is absent
    assert float(planted.scores[-1]) == pytest.approx(score)
    middle = image.scene.centers(image.poses)[[0, 1, 3]].mean(0)
    torch.testing.assert_close(planted.scene.centers(planted.poses)[-1], middle)
    assert seeded(label, image._replace(absent=())) is None


def test_a_duplicate_is_near_an_object_that_acts_and_less_sure(image):
    sources = set()
    for seed in range(30):
        planted = seeded("duplicate", image, seed)
        body, centers = planted.scene.objects[-1], planted.scene.centers(planted.poses)
        (row,) = [
            i
            for i in (0, 1, 3)
            if image.scene.objects[i] is body and float((centers[i] - centers[-1]).norm()) < 0.05
        ]
        sources.add(row)
        assert float(planted.scores[-1]) == pytest.approx(float(image.scores[row]) / 2)
        assert float((centers[row] - centers[-1]).norm()) > 1e-4
        assert math.radians(0.1) < apart(planted.poses[row], planted.poses[-1]) < math.radians(15)
    assert sources == {0, 1, 3}


def test_the_supporter_goes_with_its_alternatives_and_what_it_carried_stays(image, box, table):
    planted = seeded("missing supporter", image)
    assert planted.source.tolist() == [1, 3]
    # in the truth the can stood on the box; now nothing but the table is below it
    report = physics_report(planted.poses, planted.scene)
    assert report.supporter == ["plane", "plane"]
    assert float(report.gap[0]) == pytest.approx(0.04, abs=1e-3)
    flat = image._replace(true_poses=table.poses((0, 0, 0.02), (0.15, 0, 0.04), (0.3, 0.1, 0.02)))
    assert seeded("missing supporter", flat) is None
    unknown = Scene(image.scene.objects, same_object=image.scene.same_object)
    assert seeded("missing supporter", image._replace(scene=unknown)) is None


def test_a_supporter_that_nobody_estimated_or_that_carries_nothing_estimated_cannot_go_missing(image):
    for truth in ([-1, 1, -1, 2], [0, -1, -1, 2]):
        assert seeded("missing supporter", image._replace(truth=torch.tensor(truth))) is None


def test_the_depths_of_two_neighbours_are_swapped_along_their_own_rays(image):
    planted = seeded("depth order", image)
    assert planted.source.tolist() == [0, 1, 3]  # without the box's second estimate
    assert planted.touched.tolist() == [True, True, False]
    before = image.scene.centers(image.poses)[[0, 1]]
    after = planted.scene.centers(planted.poses)[:2]
    torch.testing.assert_close(after.norm(dim=1), before.norm(dim=1).flip(0))
    normalize = torch.nn.functional.normalize
    torch.testing.assert_close(normalize(after, dim=1), normalize(before, dim=1))
    assert torch.equal(planted.poses[:2, :3, :3], image.poses[:2, :3, :3])


def test_objects_that_are_far_apart_in_the_image_or_alike_in_depth_have_no_order(box, table):
    plane = [Static(table.plane)]
    for places in (((-0.3, 0, 0.02), (0.3, 0.1, 0.02)), ((-0.03, 0, 0.02), (0.03, 0, 0.02))):
        poses = table.poses(*places)
        scene = Scene([box, box], plane, gravity=table.gravity)
        image = Estimated(poses, torch.ones(2), scene, poses, (box, box), torch.arange(2))
        assert seeded("depth order", image) is None


def test_three_in_ten_objects_are_outliers_far_along_the_ray_or_turned_by_60_degrees(image):
    shifts, turns, count, trials = [], [], 0, 300
    for seed in range(trials):
        planted = seeded("outliers", image, seed)
        before = image.scene.centers(image.poses)
        after = planted.scene.centers(planted.poses)
        for i in planted.touched.nonzero()[:, 0].tolist():
            old, new = before[planted.source[i]], after[i]
            angle = apart(image.poses[planted.source[i]], planted.poses[i])
            count += 1
            if angle > 1e-6:
                turns.append(math.degrees(angle))
                torch.testing.assert_close(new, old)
            else:
                shifts.append(float(new.norm() - old.norm()))
                torch.testing.assert_close(new / new.norm(), old / old.norm())
        alternative = planted.touched[planted.source == 0].any()
        assert (2 in planted.source.tolist()) != bool(alternative)
    assert count / (3 * trials) == pytest.approx(0.3, abs=0.04)
    assert len(shifts) / count == pytest.approx(0.5, abs=0.12)
    assert all(0.05 <= abs(s) <= 0.15 for s in shifts)
    assert min(shifts) < -0.1
    assert max(shifts) > 0.1
    assert all(60 <= t <= 180 + 1e-6 for t in turns)
    assert max(turns) > 150


def test_an_outlier_stays_in_front_of_the_camera(box, table):
    poses = torch.eye(4, dtype=torch.float64)[None].clone()
    poses[0, 2, 3] = 0.12
    scene = Scene([box], [Static(table.plane)], gravity=table.gravity)
    image = Estimated(poses, torch.ones(1), scene, poses, (box,), torch.zeros(1, dtype=torch.long))
    depths = [float(seeded("outliers", image, seed).poses[0, 2, 3]) for seed in range(200)]
    assert min(depths) >= 0.06 - 1e-12
    assert len(set(depths)) > 10


def test_a_plane_too_high_is_2_cm_higher_and_as_sure_as_before(image):
    planted = seeded("plane too high", image)
    plane, old = planted.scene.planes[0].shape, image.scene.planes[0].shape
    torch.testing.assert_close(plane.normal, old.normal)
    assert float(plane.offset - old.offset) == pytest.approx(0.02)
    assert torch.equal(plane.covariance, COVARIANCE)
    assert torch.equal(planted.poses, image.poses)
    assert not planted.touched.any()


def test_a_tilted_plane_turns_by_8_degrees_about_its_point_below_the_objects_and_gravity_goes_along(image):
    middle, ways = image.scene.centers(image.poses)[[0, 1, 3]].mean(0), []
    for seed in range(5):
        planted = seeded("plane tilted", image, seed)
        plane, old = planted.scene.planes[0].shape, image.scene.planes[0].shape
        assert math.degrees(math.acos(float(plane.normal @ old.normal))) == pytest.approx(8, abs=1e-4)
        below = middle - (old.normal @ middle - old.offset) * old.normal
        assert float(plane.normal @ below) == pytest.approx(float(plane.offset))
        torch.testing.assert_close(planted.scene.gravity[0], -plane.normal)
        assert torch.equal(plane.covariance, COVARIANCE)
        ways.append(plane.normal)
    assert not torch.isclose(ways[0], ways[1]).all()


def test_without_planes_none_can_be_wrong(image):
    bare = image._replace(scene=Scene(image.scene.objects, same_object=image.scene.same_object))
    assert seeded("plane too high", bare) is seeded("plane tilted", bare) is None


def test_accurate_poses_are_those_of_the_ground_truth_with_1_mm_and_half_a_degree(image):
    shifts, turns = [], []
    for seed in range(200):
        planted = seeded("accurate", image, seed)
        assert [b.label for b in planted.scene.objects] == ["box", "can", "box"]
        assert planted.touched.all()
        xi = se3.residual(planted.poses, image.true_poses)
        shifts.append(xi[:, :3])  # these bodies' origins are their centres
        turns.append(xi[:, 3:])
    assert torch.cat(shifts).std(0).tolist() == pytest.approx([1e-3] * 3, rel=0.1)
    assert torch.rad2deg(torch.cat(turns).std(0)).tolist() == pytest.approx([0.5] * 3, rel=0.1)
    assert torch.cat(shifts).mean(0).abs().max() < 2e-4


def test_bodies_turn_about_the_centre_of_their_bounds_not_about_their_origin(angle, table):
    poses = table.poses((0, 0, 0))
    scene = Scene([angle], [Static(table.plane)], gravity=table.gravity)
    image = Estimated(poses, torch.ones(1), scene, poses, (angle,), torch.zeros(1, dtype=torch.long))
    center = scene.centers(poses)[0]
    for seed in range(20):
        shift = scene.centers(seeded("accurate", image, seed).poses)[0] - center
        assert float(shift.norm()) < 0.005
    origins = torch.stack([seeded("accurate", image, seed).poses[0, :3, 3] - poses[0, :3, 3] for seed in range(200)])
    assert float(origins.std(0).max()) > 1.05e-3  # which swings along


def test_nothing_fits_an_image_without_estimates_and_truth(table, absent):
    none = torch.zeros((0, 4, 4), dtype=torch.float64)
    scene = Scene([], [Static(table.plane)], gravity=table.gravity)
    image = Estimated(none, torch.zeros(0), scene, none, (), torch.zeros(0, dtype=torch.long), (absent,))
    assert [seeded(label, image) for label in BY_LABEL] == [None] * len(BY_LABEL)
