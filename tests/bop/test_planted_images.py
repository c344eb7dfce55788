"""Planted into the images of a file: reproducible image by image, rows and alternatives as if they had been read."""

import json

import numpy as np
import pytest
import torch
from bop_files import OFFSET_MM, UP, csv_row, standing, write_models, write_scene

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import read_estimates, read_planes
from physpose_torch.bop.metrics import evaluate
from physpose_torch.bop.planted import plant, true_images
from physpose_torch.bop.scenes import BodyLibrary, image_scenes, poses_of
from physpose_torch.planted import FAILURES

BY_LABEL = {f.label: f for f in FAILURES}
TRUTH = {
    3: [(1, standing(-80, 0, 50)), (4, standing(60, 30, 15)), (9, standing(60, 30, 65))],  # 9 stands on 4
    5: [(4, standing(-50, 0, 15)), (1, standing(0, -20, 50))],
    7: [(9, standing(0, 0, 35))],
}


@pytest.fixture
def read(tmp_path, write_csv):
    """(images, estimates, dataset): all as in the truth but for 5 mm, image 7 last in the file, and one alternative of 4."""
    root = tmp_path / "d"
    write_models(root / "models")
    write_scene(root / "test", 2, {im: [(o, T, 0.9) for o, T in rows] for im, rows in TRUTH.items()}, width=640)
    planes = {"2": {str(im): {"normal": UP.tolist(), "offset_mm": OFFSET_MM} for im in TRUTH}}
    (root / "planes.json").write_text(json.dumps(planes))
    rows = []
    for im, objects in TRUTH.items():
        for obj, T in objects:
            off = T.copy()
            off[0, 3] += 5
            rows.append(csv_row(2, im, obj, 0.8, off))
            if (im, obj) == (3, 4):
                rows.append(csv_row(2, im, obj, 0.3, off))
    estimates, dataset = read_estimates(write_csv(*rows)), BopDataset(root)
    library, known = BodyLibrary(dataset), read_planes(root / "planes.json")[0]

    def images(*wanted):
        keys = {(2, im) for im in wanted or TRUTH}
        return list(image_scenes(estimates, library, planes=known, wanted=keys))

    return images, estimates, dataset


def test_the_truth_of_an_image_is_matched_with_the_estimates_that_act(read):
    images, estimates, dataset = read
    known = true_images(images(), estimates, dataset)
    (first, image), (_, second), _ = known.images
    assert {body.label: obj_id for body, obj_id in known.obj_ids.items()} == {
        "obj_000001": 1,
        "obj_000004": 4,
        "obj_000009": 9,
    }
    assert first.rows.tolist() == [0, 1, 2, 3]
    assert image.truth.tolist() == [0, 1, -1, 2]
    assert [b.label for b in image.true_bodies] == ["obj_000001", "obj_000004", "obj_000009"]
    assert image.absent == ()
    assert [b.label for b in second.absent] == ["obj_000009"]
    shift = image.poses[[0, 1, 3], :3, 3] - image.true_poses[:, :3, 3]
    torch.testing.assert_close(shift, torch.tensor([[0.005, 0, 0]] * 3, dtype=torch.float64), atol=1e-9, rtol=0)


@pytest.mark.parametrize("label", BY_LABEL)
def test_an_images_failure_depends_on_the_seed_and_not_on_the_other_images(read, label):
    images, estimates, dataset = read
    failure, here = BY_LABEL[label], 5 if label != "missing supporter" else 3

    def planted(seed, *wanted):
        known = true_images(images(), estimates, dataset)  # the bodies at hand stay the same
        known = known._replace(images=[(i, e) for i, e in known.images if not wanted or i.im_id in wanted])
        found = plant(failure, known, estimates, seed=seed)
        (image,) = (i for i in found.images if i.im_id == here)
        poses, scores = poses_of([image], found.estimates)
        return poses, scores, image.scene.plane_normal, image.scene.plane_offset

    for a, b in zip(planted(1), planted(1, here), strict=True):
        assert torch.equal(a, b)
    if label not in ("missing supporter", "depth order", "plane too high", "outliers"):  # of few choices
        assert any(a.shape != b.shape or not torch.equal(a, b) for a, b in zip(planted(1), planted(2), strict=True))


@pytest.mark.parametrize("label", BY_LABEL)
def test_rows_belong_to_their_image_and_object_and_can_be_scored(read, label):
    images, estimates, dataset = read
    found = plant(BY_LABEL[label], true_images(images(), estimates, dataset), estimates)
    e = found.estimates
    assert np.concatenate([i.rows for i in found.images]).tolist() == list(range(len(e)))
    for image in found.images:
        assert set(e.im_id[image.rows].tolist()) == {image.im_id}
        labels = [f"obj_{obj:06d}" for obj in e.obj_id[image.rows].tolist()]
        assert image.scene.labels == labels
    kept = ~found.touched & (found.source >= 0)
    assert np.array_equal(e.obj_id[kept], estimates.obj_id[found.source[kept]])
    assert np.array_equal(e.im_id[kept], estimates.im_id[found.source[kept]])
    assert torch.equal(e.T_camera_object[kept], estimates.T_camera_object[found.source[kept]])
    assert evaluate(e, dataset).targets == 6


def test_only_images_that_a_failure_fits_are_there(read):
    images, estimates, dataset = read
    known = true_images(images(), estimates, dataset)
    where = {label: [i.im_id for i in plant(f, known, estimates).images] for label, f in BY_LABEL.items()}
    assert where["missing supporter"] == [3]
    assert where["false positive, low score"] == where["false positive, high score"] == [5, 7]
    assert where["duplicate"] == where["outliers"] == where["plane tilted"] == where["accurate"] == [3, 5, 7]
    gone = plant(BY_LABEL["missing supporter"], known, estimates)
    assert gone.estimates.obj_id.tolist() == [1, 9]  # with both estimates of 4


def test_high_and_low_scored_false_positives_differ_in_nothing_else(read):
    images, estimates, dataset = read
    known = true_images(images(), estimates, dataset)
    low, high = (plant(BY_LABEL[f"false positive, {s} score"], known, estimates) for s in ("low", "high"))
    assert torch.equal(low.estimates.T_camera_object, high.estimates.T_camera_object)
    assert np.array_equal(low.estimates.obj_id, high.estimates.obj_id)
    assert low.estimates.score[low.touched] == pytest.approx([0.4, 0.4])
    assert high.estimates.score[high.touched] == pytest.approx([0.8, 0.8])


def test_duplicates_are_not_told_how_many_there_are_but_found_out_by_their_overlap(read):
    images, estimates, dataset = read
    known = true_images(images(7), estimates, dataset)
    counts = {(2, 7, 9): 1}
    for seed in range(10):
        told = plant(BY_LABEL["duplicate"], known, estimates, counts=counts, seed=seed)
        without = plant(BY_LABEL["duplicate"], known, estimates, seed=seed)
        assert torch.equal(told.images[0].scene.same_object, without.images[0].scene.same_object)
        assert told.images[0].scene.same_object.tolist() == [0, 0]  # 1 % of the distance is not far enough


def test_counts_are_told_to_the_other_failures(read):
    """Two estimates of 9 far from each other: with one instance known they are alternatives, else not."""
    images, estimates, dataset = read
    known = true_images(images(7), estimates, dataset)
    ((image, e),) = known.images
    far = e.poses.clone()
    far[0, 0, 3] += 0.2
    scene = type(e.scene)([*e.scene.objects] * 2, e.scene.statics, gravity=e.scene.gravity)
    twice = e._replace(
        poses=torch.cat([e.poses, far]), scores=e.scores.repeat(2), scene=scene, truth=torch.tensor([0, -1])
    )
    image.rows = np.repeat(image.rows, 2)
    known = known._replace(images=[(image, twice)])
    for counts, same in ((None, [0, 1]), ({(2, 7, 9): 1}, [0, 0])):
        found = plant(BY_LABEL["plane too high"], known, estimates, counts=counts)
        assert found.images[0].scene.same_object.tolist() == same
