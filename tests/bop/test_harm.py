"""Made worse means farther from the ground truth than estimated, by more than 2 mm of MSSD under symmetries."""

import numpy as np
import pytest
import torch
from bop_files import csv_row, standing, write_models, write_scene

from physpose_torch import se3
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import read_estimates
from physpose_torch.bop.harm import Harm, Matches, Share, harm, match_acting, mssd_of, share


def given(tmp_path, write_csv, truth, rows):
    """Dataset of one scene with {image: [(object, T)]}, and estimates of (image, object, score, T)."""
    write_models(tmp_path / "d" / "models")
    write_scene(tmp_path / "d" / "test", 2, {im: [(o, T, 1.0) for o, T in there] for im, there in truth.items()}, width=640)
    estimates = read_estimates(write_csv(*(csv_row(2, im, o, score, T) for im, o, score, T in rows)))
    return estimates, BopDataset(tmp_path / "d")


def turned(pose, axis, angle):
    """A pose (4, 4) turned about an axis of the object."""
    return se3.retract(pose, torch.tensor([0.0, 0, 0, *(angle * np.array(axis))], dtype=torch.float64))


def test_moved_by_3_mm_is_worse_by_1_mm_is_not_and_turning_a_round_object_is_nothing(tmp_path, write_csv):
    truth = [(1, standing(-80, 0, 50)), (4, standing(60, 30, 15)), (9, standing(0, -60, 35))]
    estimates, dataset = given(tmp_path, write_csv, {3: truth, 5: truth}, [(i, o, 0.9, T) for i in (3, 5) for o, T in truth])
    matches = match_acting(estimates, dataset, np.ones(6, dtype=bool))
    assert matches.rows.tolist() == [0, 1, 2, 3, 4, 5]
    assert matches.image.tolist() == [0, 0, 0, 1, 1, 1]
    assert matches.mssd == pytest.approx(np.zeros(6), abs=1e-9)
    poses = estimates.T_camera_object.clone()
    poses[0, 0, 3] += 0.003
    poses[2, 1, 3] += 0.001
    poses[3] = turned(poses[3], (0, 0, 1), np.pi / 2)  # the box that has no symmetry
    poses[1] = turned(poses[1], (0, 0, 1), 0.7)  # its continuous symmetry
    after = mssd_of(matches, estimates, dataset, poses)
    assert after[[0, 2]] == pytest.approx([0.003, 0.001])
    assert after[1] < 6e-4  # half a step of the symmetry's 315
    assert after[3] > 0.02
    found = harm(matches, after)
    assert (found.objects, found.worse.value, found.better.value) == (6, 2 / 6, 0)
    assert harm(matches, after, chosen=matches.rows != 0).worse.value == 1 / 5


def test_better_is_worse_the_other_way_round(tmp_path, write_csv):
    truth, off = standing(-80, 0, 50), standing(-80, 0, 50)
    off[0, 3] += 5
    estimates, dataset = given(tmp_path, write_csv, {3: [(1, truth)]}, [(3, 1, 0.9, off)])
    matches = match_acting(estimates, dataset, np.array([True]))
    assert matches.mssd == pytest.approx([0.005])
    poses = estimates.T_camera_object.clone()
    poses[0, 0, 3] -= 0.005
    found = harm(matches, mssd_of(matches, estimates, dataset, poses))
    assert (found.worse.value, found.better) == (0, Share(1, 1, 1))


def test_the_nearest_pair_is_matched_first_and_each_instance_and_estimate_once(tmp_path, write_csv):
    """Two instances at 0 and 100 mm; estimates at 8, 90 and 300 mm, one at 3 mm that does not act."""
    instances = [(1, standing(0, 0, 50)), (1, standing(100, 0, 50))]
    rows = [(3, 1, 0.5, standing(x, 0, 50)) for x in (90, 8, 300, 3)] + [(3, 4, 0.9, standing(0, 0, 15))]
    estimates, dataset = given(tmp_path, write_csv, {3: instances}, rows)
    acts = np.array([True, True, True, False, True])
    matches = match_acting(estimates, dataset, acts)
    assert matches.rows.tolist() == [0, 1]  # the third finds no instance left, object 4 is not there
    assert matches.gts.tolist() == [1, 0]
    assert matches.mssd == pytest.approx([0.010, 0.008], abs=1e-6)
    matches = match_acting(estimates, dataset, np.array([False, False, True, True, True]))
    assert (matches.rows.tolist(), matches.gts.tolist()) == ([2, 3], [1, 0])


def test_an_object_that_jumps_onto_its_twin_is_made_worse(tmp_path, write_csv):
    instances = [(1, standing(0, 0, 50)), (1, standing(100, 0, 50))]
    estimates, dataset = given(tmp_path, write_csv, {3: instances}, [(3, 1, 0.5, T) for _, T in instances])
    matches = match_acting(estimates, dataset, np.ones(2, dtype=bool))
    after = mssd_of(matches, estimates, dataset, estimates.T_camera_object[[1, 0]])
    assert after == pytest.approx([0.1, 0.1])


def test_nothing_matched_is_no_share(tmp_path, write_csv):
    estimates, dataset = given(tmp_path, write_csv, {3: [(1, standing(0, 0, 50))]}, [(3, 4, 0.5, standing(0, 0, 15))])
    matches = match_acting(estimates, dataset, np.ones(1, dtype=bool))
    assert [len(column) for column in matches] == [0, 0, 0, 0]
    after = mssd_of(matches, estimates, dataset, estimates.T_camera_object)
    assert harm(matches, after) == Harm(0, None, None)


def test_the_interval_of_a_share_covers_the_true_one_about_as_often_as_it_says():
    """Objects of an image share its fate: the images' own rate is 0.1 or 0.5."""
    rng, covered = np.random.default_rng(1), 0
    for trial in range(200):
        image = np.repeat(np.arange(60), rng.integers(1, 6, size=60))
        rate = rng.choice([0.1, 0.5], size=60)[image]
        found = share(rng.uniform(size=len(image)) < rate, image, seed=trial)
        assert found.low < found.value < found.high
        covered += found.low <= 0.3 <= found.high
    assert 0.88 <= covered / 200 <= 0.99


def test_intervals_are_over_images_not_objects_and_depend_on_the_seed_only():
    """Twenty objects in each of ten images, all of one image alike: as wide as for ten objects."""
    fate = np.arange(10) < 3
    single = share(fate, np.arange(10))
    many = share(np.repeat(fate, 20), np.repeat(np.arange(10), 20))
    assert many == single
    assert single.high - single.low > 0.4
    fate, image = np.arange(200) % 7 < 3, np.arange(200) % 41
    assert share(fate, image, seed=5) == share(fate, image, seed=5) != share(fate, image, seed=6)


def test_exactly_2_mm_is_not_worse():
    matches = Matches(np.arange(3), np.arange(3), np.arange(3), np.zeros(3))
    assert harm(matches, np.array([0.002, 0.0020001, 0.0])).worse.value == pytest.approx(1 / 3)
