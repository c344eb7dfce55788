"""The motion between two cameras is found from poses and from matches, in spite of wrong ones; triangulation is exact."""

import math

import pytest
import torch
from helpers import pose, random_poses

from physpose_torch import se3
from physpose_torch.table.roles import Matches
from physpose_torch.table.two_view import motion_from_matches, motion_from_objects, refine_motion, triangulate
from physpose_torch.table.view import project

K0 = torch.tensor([[610.0, 0.0, 321.0], [0.0, 605.0, 236.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
K1 = torch.tensor([[910.0, 0.0, 487.0], [0.0, 918.0, 355.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
MOTION = pose((0.05, -0.24, 0.03), (0.21, -0.02, 0.06))


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scene(count=300, seed=0):
    """Points (count, 3) of a room before camera 0, which camera 1 sees, too."""
    generator = torch.Generator().manual_seed(seed)
    low, high = (torch.tensor(v, dtype=torch.float64) for v in ([40.0, 40.0, 0.5], [600.0, 440.0, 1.6]))
    pixel = low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    ones = torch.ones(count, 1, dtype=torch.float64)
    return torch.cat([pixel[:, :2], ones], 1) @ torch.linalg.inv(K0).mT * pixel[:, 2:]


def matched(points, *, motion=MOTION, noise=0.0, second=K1, seed=0):
    return project(K0, points), project(second, se3.apply(motion, points)) + noise * normal(len(points), 2, seed=seed)


def with_outliers(share, *, noise=0.5, count=300, second=K1, seed=0):
    p0, p1 = matched(scene(count, seed), noise=noise, second=second, seed=seed + 1)
    wrong = torch.arange(count) < share * count
    p1 = torch.where(wrong[:, None], p1 + 60 * normal(count, 2, seed=seed + 2), p1)
    return Matches(p0, p1, torch.ones(count)), wrong


def rotation_off(T, truth=MOTION):
    """[deg]"""
    return math.degrees(float(se3.log_so3(T[:3, :3].mT @ truth[:3, :3]).norm()))


def direction_off(T, truth=MOTION):
    """[deg]"""
    a, b = (torch.nn.functional.normalize(x[:3, 3], dim=0) for x in (T, truth))
    return math.degrees(float(torch.atan2(torch.linalg.cross(a, b).norm(), a @ b)))


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_objects_give_the_motion_exactly(count):
    first = random_poses(count) @ pose(translation=(0.0, 0.0, 0.1))
    torch.testing.assert_close(motion_from_objects(first, MOTION @ first), MOTION, atol=1e-12, rtol=0)


@pytest.mark.parametrize("count", [3, 4, 7])
@pytest.mark.parametrize("flipped", [0, 1, 2])
def test_one_object_upside_down_does_not_turn_the_camera(count, flipped):
    first = random_poses(count, spread=0.2)
    second = MOTION @ first
    second[flipped] = second[flipped] @ pose((2.0, 1.5, 0.0), (0.2, 0.0, 0.0))
    torch.testing.assert_close(motion_from_objects(first, second), MOTION, atol=1e-9, rtol=0)
    torch.testing.assert_close(motion_from_objects(second, first), se3.inverse(MOTION), atol=1e-9, rtol=0)


def test_noise_of_poses_is_averaged():
    one, many = [], []
    for seed in range(12):
        first = random_poses(8, seed=seed, spread=0.1)
        second = MOTION @ first
        second = second @ se3.from_rotation_translation(
            se3.exp_so3(0.02 * normal(8, 3, seed=seed)), torch.zeros(8, 3, dtype=torch.float64)
        )
        many.append(rotation_off(motion_from_objects(first, second)))
        one.append(rotation_off(motion_from_objects(first[:1], second[:1])))
    assert sum(many) < 0.55 * sum(one)


def test_the_motion_is_rigid_whatever_the_poses():
    T = motion_from_objects(random_poses(5, seed=1), random_poses(5, seed=2))
    se3.check_rigid(T, "motion")


@pytest.mark.parametrize("unseen", [((0,), ()), ((), (3,)), ((0, 1), (2,)), ((0, 1), (0, 3))])
def test_objects_that_one_view_does_not_see_do_not_count(unseen):
    first = random_poses(4)
    second = MOTION @ first
    second[[k for k in range(4) if k in (*unseen[0], *unseen[1])]] @= pose((1.0, 0.0, 0.0), (0.3, 0.0, 0.0))  # no use
    for poses, rows in ((first, unseen[0]), (second, unseen[1])):
        poses[list(rows)] = torch.nan
    torch.testing.assert_close(motion_from_objects(first, second), MOTION, atol=1e-12, rtol=0)


def test_without_a_common_object_there_is_no_motion():
    first, second = random_poses(2), random_poses(2)
    first[0], second[1] = torch.nan, torch.nan
    assert motion_from_objects(first, second) is None
    assert motion_from_objects(first[:0], second[:0]) is None


@pytest.mark.parametrize("second", [K0, K1], ids=["one camera", "two cameras"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.5])
def test_matches_give_rotation_and_direction_among_outliers(share, second):
    matches, wrong = with_outliers(share, noise=0.3, second=second)
    T, info = motion_from_matches(matches, K0, second)
    se3.check_rigid(T, "motion")
    assert rotation_off(T) < 0.3
    assert direction_off(T) < 2.0
    assert float(T[:3, 3].norm()) == pytest.approx(1.0)
    assert float(info.inliers[~wrong].double().mean()) > 0.9
    assert float(info.inliers[wrong].double().sum()) <= 0.1 * int(wrong.sum())
    assert info.residual.shape == wrong.shape


def test_the_same_matches_give_the_same_motion():
    matches, _ = with_outliers(0.5)
    (a, i), (b, j) = (motion_from_matches(matches, K0, K1) for _ in range(2))
    assert torch.equal(a, b)
    assert torch.equal(i.inliers, j.inliers)


@pytest.mark.parametrize("count", [0, 4, 11])
def test_few_matches_give_no_motion(count):
    p0, p1 = matched(scene(count))
    T, info = motion_from_matches(Matches(p0, p1, torch.ones(count)), K0, K1)
    assert T is None
    assert info.inliers.shape == info.residual.shape == (count,)
    assert not info.inliers.any()


def test_what_does_not_match_gives_no_motion_to_speak_of():
    points = project(K0, scene(60))
    T, info = motion_from_matches(Matches(points, points[torch.randperm(60)], torch.ones(60)), K0, K0)
    assert T is None or float(info.inliers.double().mean()) < 0.5


def test_refinement_improves_on_five_points_as_much_as_matches_allow():
    """Also where a few outliers are still among its inliers."""
    rough, fine = [], []
    for seed in range(6):
        matches, _ = with_outliers(0.3, seed=10 * seed)
        T, info = motion_from_matches(matches, K0, K1)
        p0, p1 = matches.points_0[info.inliers], matches.points_1[info.inliers]
        p1[:5] += 8.0
        covariance = 0.25 * torch.eye(2, dtype=torch.float64).expand(len(p0), 2, 2)
        p1[5:10] += 60.0
        better, distance = refine_motion(T, K0, K1, p0, p1, covariance)
        se3.check_rigid(better, "motion")
        assert float(better[:3, 3].norm()) == pytest.approx(1.0)
        assert 0.7 < float(distance[10:].std()) < 1.3  # whitened as they should be
        rough.append(rotation_off(T) + direction_off(T))
        fine.append(rotation_off(better) + direction_off(better))
    assert sum(fine) < sum(rough)
    assert max(fine) < 0.6


@pytest.mark.parametrize("second", [K0, K1], ids=["one camera", "two cameras"])
def test_refinement_from_afar_ends_at_the_truth_if_there_is_no_noise(second):
    p0, p1 = matched(scene(100), second=second)
    start = MOTION @ pose((0.02, -0.015, 0.02), (0.01, 0.015, -0.01))
    covariance = torch.eye(2, dtype=torch.float64).expand(100, 2, 2)
    T, distance = refine_motion(start, K0, second, p0, p1, covariance)
    assert rotation_off(T) < 1e-3
    assert direction_off(T) < 1e-2
    assert float(distance.abs().max()) < 1e-3
    for scale in (0.1, 7.0):  # of the baseline to start from
        other, _ = refine_motion(pose(translation=start[:3, 3] * (scale - 1)) @ start, K0, second, p0, p1, covariance)
        torch.testing.assert_close(other, T, atol=1e-4, rtol=0)


def test_distances_are_those_from_epipolar_lines_as_well_as_matches_are_known_across_them():
    p0, p1 = matched(scene(200), noise=2.0)
    root = torch.eye(2, dtype=torch.float64) + 0.8 * normal(200, 2, 2, seed=5)
    covariance = root @ root.mT + 0.01 * torch.eye(2, dtype=torch.float64)
    T, distance = refine_motion(MOTION, K0, K1, p0, p1, covariance)
    ones = torch.ones(200, 1, dtype=torch.float64)
    F = torch.linalg.inv(K1).mT @ se3.hat(T[:3, 3]) @ T[:3, :3] @ torch.linalg.inv(K0)
    line = torch.cat([p0, ones], 1) @ F.mT
    sigma = torch.einsum("mi,mij,mj->m", line[:, :2], covariance, line[:, :2]).sqrt()
    expected = (line * torch.cat([p1, ones], 1)).sum(1) / sigma
    torch.testing.assert_close(distance, expected, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("second", [K0, K1], ids=["one camera", "two cameras"])
def test_triangulation_of_exact_matches_is_exact(second):
    points = scene(50)
    found, residual = triangulate(MOTION, K0, second, *matched(points, second=second))
    torch.testing.assert_close(found, points, atol=1e-10, rtol=0)
    assert float(residual.max()) < 1e-7


def test_triangulated_points_lie_on_the_first_ray_and_miss_the_second_by_the_residual():
    points = scene(50)
    p0, p1 = matched(points, noise=3.0)
    found, residual = triangulate(MOTION, K0, K1, p0, p1)
    torch.testing.assert_close(project(K0, found), p0, atol=1e-9, rtol=0)
    assert torch.allclose(residual, (project(K1, se3.apply(MOTION, found)) - p1).norm(dim=1))
    assert float(residual.median()) > 0.3


def test_the_unit_of_the_baseline_is_that_of_the_points():
    points = scene(20)
    unit = MOTION.clone()
    unit[:3, 3] *= 5.0
    found, _ = triangulate(unit, K0, K1, *matched(points))
    torch.testing.assert_close(found, 5.0 * points, atol=1e-9, rtol=0)


def test_points_behind_either_camera_have_an_infinite_residual():
    points = scene(20)
    p0, p1 = matched(points)
    backwards = MOTION.clone()
    backwards[:3, 3] *= -1.0
    found, residual = triangulate(backwards, K0, K1, p0, p1)
    assert bool((found[:, 2] < 0).all())
    assert bool(residual.isinf().all())
    past = pose(translation=(0.02, 0.0, -2.0))  # beyond all points
    _, residual = triangulate(past, K0, K1, *matched(points, motion=past))
    assert bool(residual.isinf().all())
