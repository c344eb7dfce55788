"""Which estimates are alternatives of one object, and which are twins that stand side by side."""

import pytest
import torch

from physpose_torch import se3
from physpose_torch.alternatives import find_alternatives, overlap_share
from physpose_torch.geometry.body import Body
from physpose_torch.scene import Scene


def groups(poses, bodies, scores=None, image=None, **options):
    scores = torch.linspace(0.9, 0.1, len(bodies)) if scores is None else torch.tensor(scores)
    return find_alternatives(poses, Scene(bodies, image=image), scores, **options).tolist()


def test_deep_duplicates_are_alternatives_of_the_best_scored_one(table, can, box):
    poses = table.poses((0, 0, 0.04), (0.01, 0, 0.05), (0, 0, 0.03), (0.005, 0, 0.04))
    assert groups(poses, [can, can, box, can]) == [0, 0, 2, 0]
    assert groups(poses, [can, can, box, can], scores=[0.1, 0.2, 0.9, 0.3]) == [3, 3, 2, 3]


@pytest.mark.parametrize("gap", [0.0, -0.005, 0.001])
def test_two_cans_that_touch_are_two_cans(gap, table, can):
    """Also when an estimator has pushed them 5 mm into each other."""
    assert groups(table.poses((0, 0, 0.04), (0.06 + gap, 0, 0.04)), [can, can]) == [0, 1]


def test_twins_of_which_each_has_a_duplicate_stay_two(table, can):
    poses = table.poses((0, 0, 0.04), (0.06, 0, 0.04), (0.008, 0.005, 0.045), (0.055, 0, 0.035))
    assert groups(poses, [can] * 4) == [0, 1, 0, 1]


def test_flat_twins_on_top_of_each_other_are_two(table):
    """Their centres are as near as one of them is thick."""
    plate = Body.box((0.2, 0.2, 0.02), label="plate")
    assert groups(table.poses((0, 0, 0.01), (0, 0, 0.03)), [plate, plate]) == [0, 1]
    assert groups(table.poses((0, 0, 0.01), (0, 0, 0.014)), [plate, plate]) == [0, 0]


def test_deep_overlap_alone_does_not_make_one_of_two(table, box):
    """30 mm along a box of 100 × 60 × 40 mm: their centres are farther apart than half its smallest side."""
    assert groups(table.poses((0, 0, 0.02), (0.03, 0, 0.02)), [box, box]) == [0, 1]
    assert groups(table.poses((0, 0, 0.02), (0.015, 0, 0.02)), [box, box]) == [0, 0]


def test_nested_shells_are_not_taken_for_one(table):
    """Corners of two Ls that share a box of space but none of their parts: two objects."""
    import numpy as np
    import trimesh

    from physpose_torch.geometry.convex import ConvexParts

    bars = [
        trimesh.creation.box(bounds=[[0, 0, 0], [0.1, 0.01, 0.1]]),
        trimesh.creation.box(bounds=[[0, 0, 0], [0.01, 0.1, 0.1]]),
    ]
    body = Body("L", ConvexParts.from_hulls([np.array(b.vertices) for b in bars]), trimesh.util.concatenate(bars))
    assert groups(table.poses((0, 0, 0.0), (0.02, 0.02, 0.0)), [body, body]) == [0, 1]


def test_labels_and_images_are_never_mixed(table, can):
    other = Body.cylinder(0.03, 0.08, label="other can")
    poses = table.poses((0, 0, 0.04), (0, 0, 0.04))
    assert groups(poses, [can, other]) == [0, 1]
    assert groups(poses, [can, can], image=torch.tensor([0, 1])) == [0, 1]


def test_beyond_a_known_count_a_row_belongs_to_the_nearest_better_one(table, can):
    poses = table.poses((0, 0, 0.04), (0.3, 0, 0.04), (0.2, 0, 0.04), (0.09, 0, 0.04))
    assert groups(poses, [can] * 4) == [0, 1, 2, 3]
    assert groups(poses, [can] * 4, counts={(0, "can"): 2}) == [0, 1, 1, 0]
    assert groups(poses, [can] * 4, counts={(0, "can"): 1}) == [0, 0, 0, 0]
    assert groups(poses, [can] * 4, counts={(0, "can"): 9, (1, "can"): 1}) == [0, 1, 2, 3]


def test_a_count_does_not_part_deep_duplicates(table, can):
    """Three instances expected, but two of the rows cannot both be there."""
    poses = table.poses((0, 0, 0.04), (0.005, 0, 0.04), (0.3, 0, 0.04))
    assert groups(poses, [can] * 3, counts={(0, "can"): 3}) == [0, 0, 2]


def test_the_groups_fit_into_a_scene_and_end_the_collision(table, can):
    from physpose_torch.report import physics_report

    poses = table.poses((0, 0, 0.04), (0.01, 0, 0.04), (0.06, 0, 0.04))
    same = find_alternatives(poses, Scene([can] * 3), torch.tensor([0.9, 0.8, 0.7]))
    assert same.dtype == torch.long
    report = physics_report(poses, Scene([can] * 3, same_object=same))
    assert report.penetration_object[0] < 1e-6
    assert report.penetration_object[1] == pytest.approx(0.01, abs=1e-3)  # it feels the twin, and does not push it
    assert report.penetration_object[2] < 1e-6


def test_an_empty_scene_has_no_groups():
    assert groups(torch.zeros(0, 4, 4), []) == []


def test_a_body_is_wholly_inside_itself_and_not_at_all_beside_itself(table, can, angle):
    for body in (can, angle):
        assert overlap_share(body, table.at(), table.at()) == 1.0
        assert overlap_share(body, table.at(), table.at(0.2)) == 0.0


def test_the_share_is_that_of_all_points_held_against_all_faces(table, can, angle):
    """Points outside of a part's bounds are left out beforehand; that must not change who is inside."""
    generator = torch.Generator().manual_seed(0)
    for body in (can, angle):
        parts = body.parts
        inner = parts.center[:, None] + 0.7 * (parts.padded - parts.center[:, None])
        points = torch.cat([parts.center, inner[parts.padded_mask]])
        for _ in range(20):
            shift = (0.02 * torch.randn(2, 3, generator=generator)).tolist()
            T = table.at(*shift[0], turn=[20 * x for x in shift[1]])
            moved = se3.apply(se3.inverse(table.at()) @ T, points)
            height = torch.einsum("pfi,ki->kpf", parts.face_normals, moved)
            inside = (height <= parts.face_offsets).all(2).any(1)
            assert overlap_share(body, T, table.at()) == pytest.approx(float(inside.double().mean()), abs=1e-12)
