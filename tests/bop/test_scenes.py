"""From a result file to scenes: one at a time, in file order, the unusable ones with their reasons."""

import numpy as np
import pytest
import torch
from bop_files import csv_row, random_pose

from physpose_torch.bop import BopDataset, PlaneRecord, read_estimates
from physpose_torch.bop.scenes import BodyLibrary, image_scenes, poses_of

PLANE = PlaneRecord(torch.tensor([0.0, -0.8, -0.6], dtype=torch.float64), -0.5)


@pytest.fixture
def library(bop_folder):
    return BodyLibrary(BopDataset(bop_folder), cache=False)


@pytest.fixture
def estimates(write_csv, rng):
    """Images 7, 3 and 5 of scene 2, the rows of 7 not all together; object 77 is unknown."""
    rows = [(7, 1), (3, 77), (7, 4), (5, 9), (7, 1)]
    return read_estimates(
        write_csv(*(csv_row(2, im, obj, 0.9 - 0.1 * k, random_pose(rng)) for k, (im, obj) in enumerate(rows)))
    )


def test_an_image_and_its_bodies_are_made_when_they_are_asked_for(estimates, library):
    images = image_scenes(estimates, library)
    assert library._made == {}
    first = next(images)
    assert first.name == "scene 2 image 7"
    assert first.scene.labels == ["obj_000001", "obj_000004", "obj_000001"]
    assert set(library._made) == {1, 4}


def test_images_come_in_file_order_and_the_unusable_ones_say_why(estimates, library):
    planes = {(2, im): PLANE for im in (3, 7)}
    images = list(image_scenes(estimates, library, planes=planes))
    assert [i.im_id for i in images] == [7, 3, 5]
    assert [i.rows.tolist() for i in images] == [[0, 2, 4], [1], [3]]
    assert [i.scene is None for i in images] == [False, True, True]
    assert images[0].problems == []
    assert "object 77" in images[1].problems[0]
    assert "no plane" in images[2].problems[0]
    assert torch.equal(images[0].scene.gravity, -PLANE.normal[None])


def test_only_wanted_images_are_made_and_broken_ones_keep_their_reasons(estimates, library):
    images = list(
        image_scenes(estimates, library, wanted={(2, 3), (2, 5)}, broken={(2, 3): ["line 3: no"], (2, 7): ["x"]})
    )
    assert [(i.im_id, i.problems, i.scene is None) for i in images] == [(3, ["line 3: no"], True), (5, [], False)]


def test_counts_make_alternatives_of_the_rows_beyond_them(estimates, library):
    alone, counted = (
        next(image_scenes(estimates, library, counts=counts)).scene.same_object.tolist()
        for counts in (None, {(2, 7, 1): 1, (2, 5, 1): 1})
    )
    assert alone == [0, 1, 2]
    assert counted == [0, 1, 0]


def test_poses_and_scores_follow_the_images(estimates, library):
    images = [i for i in image_scenes(estimates, library) if i.scene is not None][::-1]
    poses, scores = poses_of(images, estimates)
    assert torch.equal(poses, estimates.T_camera_object[[3, 0, 2, 4]])
    np.testing.assert_array_equal(scores, estimates.score[[3, 0, 2, 4]])
    assert [len(x) for x in poses_of([], estimates)] == [0, 0]
