"""One array an object goes in, and one of the same kind comes out."""

import numpy as np
import pytest
import torch

from physpose_torch.adapters.foundationpose import refine_numpy
from physpose_torch.errors import InvalidInputError, UnknownLabelError
from physpose_torch.geometry.body import Body
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene, Static


@pytest.fixture
def poses(table):
    """A box 10 mm inside the table, and a can 5 mm above it, as ``register`` returns them."""
    return {"box": table.at(0, 0, 0.01).numpy().astype(np.float32), "can": table.at(0.15, 0, 0.045).numpy()}


def test_objects_come_to_rest_and_come_back_as_they_came(poses, table, box, can):
    refined = refine_numpy(poses, [box, can], surroundings=table.plane)
    assert list(refined) == ["box", "can"]
    for label, height in (("box", 0.02), ("can", 0.04)):
        assert type(refined[label]) is np.ndarray
        assert refined[label].dtype == poses[label].dtype
        assert refined[label].shape == (4, 4)
        assert float(table.where(torch.from_numpy(refined[label]))[2]) == pytest.approx(height, abs=1e-3)


def test_a_list_of_pairs_comes_back_as_one(poses, table, box, can):
    pairs = [("can", poses["can"]), ("box", poses["box"]), ("box", table.at(-0.15, 0, 0.03).float())]
    refined = refine_numpy(pairs, {"box": box, "can": can}, surroundings=table.plane)
    assert [label for label, _ in refined] == ["can", "box", "box"]
    assert [type(pose) for _, pose in refined] == [np.ndarray, np.ndarray, torch.Tensor]
    assert refined[2][1].dtype == torch.float32
    heights = [float(table.where(torch.as_tensor(pose))[2]) for _, pose in refined]
    assert heights == pytest.approx([0.04, 0.02, 0.02], abs=1e-3)


def test_it_is_the_refiner_of_the_same_scene(poses, table, box, can):
    measured = torch.stack([torch.from_numpy(pose).double() for pose in poses.values()])
    expected = PhysPoseRefiner()(measured, Scene.tabletop([box, can], table.plane)).poses
    refined = refine_numpy(poses, [box, can], surroundings=table.plane)
    np.testing.assert_allclose(refined["can"], expected[1].numpy(), atol=1e-9)
    np.testing.assert_allclose(refined["box"], expected[0].numpy(), atol=1e-6)


def test_the_order_of_labels_does_not_matter(poses, table, box, can):
    one = refine_numpy(poses, [box, can], surroundings=table.plane)
    other = refine_numpy(dict(reversed(poses.items())), [can, box], surroundings=table.plane)
    assert list(other) == ["can", "box"]
    for label in one:
        np.testing.assert_allclose(one[label], other[label], atol=2e-5)


def test_the_input_is_not_changed_even_if_it_cannot_be(poses, table, box, can):
    before = {label: pose.copy() for label, pose in poses.items()}
    for pose in poses.values():
        pose.flags.writeable = False
    refine_numpy(poses, [box, can], surroundings=table.plane)
    for label in poses:
        np.testing.assert_array_equal(poses[label], before[label])


def test_without_surroundings_only_collisions_act(table, box):
    alone = {"box": table.at(0, 0, 0.01).numpy()}
    np.testing.assert_allclose(refine_numpy(alone, [box])["box"], alone["box"], atol=1e-6)
    boxes = [("box", table.at(0, 0, 0.02).numpy()), ("box", table.at(0.09, 0, 0.02).numpy())]
    (_, a), (_, b) = refine_numpy(boxes, [box])
    assert np.linalg.norm(a[:3, 3] - b[:3, 3]) > 0.095


def test_static_bodies_and_gravity_may_be_given(table, box):
    board = Static(Body.box((0.4, 0.4, 0.02), label="board"), table.at(0, 0, 0.01))
    refined = refine_numpy({"box": table.at(0, 0, 0.03).numpy()}, [box], surroundings=([board], table.gravity))
    assert float(table.where(torch.from_numpy(refined["box"]))[2]) == pytest.approx(0.04, abs=1e-3)


def test_of_two_estimates_of_one_object_the_better_one_acts(table, box, can):
    """A can stands in one of them and clear of the other, which overlaps it deeply."""
    pairs = [
        ("box", table.at(0, 0, 0.02).numpy()),
        ("box", table.at(0.015, 0, 0.02).numpy()),
        ("can", table.at(0.085, 0, 0.04).numpy()),
    ]
    moved = {}
    for scores in ((0.9, 0.1, 0.5), (0.1, 0.9, 0.5)):
        refined = refine_numpy(pairs, [box, can], surroundings=table.plane, scores=scores)
        moved[scores[0]] = np.linalg.norm(refined[2][1][:3, 3] - pairs[2][1][:3, 3])
    assert moved[0.9] < 1e-3
    assert moved[0.1] > 1.5e-3


@pytest.mark.parametrize("empty", [{}, []])
def test_no_objects_are_ordinary(empty, table, box):
    refined = refine_numpy(empty, [box], surroundings=table.plane)
    assert refined == empty
    assert type(refined) is type(empty)


def test_an_unknown_label_is_named_with_the_known_ones(poses, box):
    with pytest.raises(UnknownLabelError, match="'can'; there are 'box'"):
        refine_numpy(poses, [box])


BAD = {
    "a list": ([[1.0]], "list.*numpy array"),
    "a batch": (np.eye(4)[None], r"\(1, 4, 4\).*expected \(4, 4\)"),
    "integers": (np.eye(4, dtype=int), "int64"),
    "a failed registration": (np.eye(4), "identity.*empty mask"),
    "millimetres": (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 700], [0, 0, 0, 1]]), "metres"),
    "NaN": (np.full((4, 4), np.nan), "NaN"),
    "a scaled pose": (np.diag([2.0, 2, 2, 1]), "not rigid"),
}


@pytest.mark.parametrize("name", BAD)
def test_poses_that_are_none_are_named(name, poses, box, can):
    pose, message = BAD[name]
    with pytest.raises(InvalidInputError, match=message) as caught:
        refine_numpy({**poses, "box": pose}, [box, can])
    assert "box" in str(caught.value)


@pytest.mark.parametrize("poses", [np.eye(4), [np.eye(4)], [("box",)], "box"])
def test_other_structures_are_refused(poses, box):
    with pytest.raises(InvalidInputError, match="expected a dict label → "):
        refine_numpy(poses, [box])


@pytest.mark.parametrize("scores", [[0.5], [0.5, float("nan")], {"box": 0.5}])
def test_scores_must_fit(scores, poses, box, can):
    with pytest.raises(InvalidInputError, match="scores"):
        refine_numpy(poses, [box, can], scores=scores)
