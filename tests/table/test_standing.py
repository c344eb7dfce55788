"""What objects would stand on: the table is the best guess for exact poses, feet are at rest on it, and nothing shifts it."""

import math

import numpy as np
import pytest
import torch
import trimesh
from helpers import box as corners
from helpers import camera_motions, pose

from physpose_torch import se3
from physpose_torch.config import TableConfig
from physpose_torch.geometry.body import Body
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.geometry.resting import hull_stands
from physpose_torch.table.standing import DISTINCT, FEET, plane_hypotheses, standing_on

CONFIG = TableConfig()


def angle(a, b):
    """[rad], also where it is tiny."""
    return float(torch.atan2(torch.linalg.cross(a, b).norm(), a @ b))


def heights(feet, k, T, plane):
    """Of object k's feet above a plane [m]."""
    return se3.apply(T, feet.points[k]) @ plane.normal - plane.offset


@pytest.fixture
def standing(box, can, angle_body, table):
    """Three bodies, and poses in which they stand."""
    poses = table.poses((-0.15, 0.0, 0.02), (0.1, 0.1, 0.04), (0.05, -0.12, 0.0, (0.0, 0.0, 0.8)))
    return [box, can, angle_body], poses


@pytest.fixture
def angle_body(angle):
    return angle


@pytest.fixture
def flat():
    """A mesh of which nothing is a surface: its corners are on a line."""
    line = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], [[0, 1, 2]], process=False)
    return Body("line", ConvexParts.from_hulls([corners(0.1, 0.15, 0.001)]), line)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.4, 0.3, 0.0)])
def test_a_planar_mesh_can_stand_on_nothing(turn):
    sheet = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.3, 0], [0, 0.3, 0]])
    sheet = trimesh.Trimesh(se3.apply(pose(turn), torch.from_numpy(sheet)).numpy(), [[0, 1, 2], [0, 2, 3]], process=False)
    assert hull_stands(Body("sheet", ConvexParts.from_hulls([corners(0.1, 0.15, 0.001)]), sheet)) is None


@pytest.mark.parametrize("known", [True, False], ids=["gravity", "no gravity"])
def test_the_best_hypothesis_of_exact_poses_is_the_table(standing, table, known):
    bodies, poses = standing
    best, *others = plane_hypotheses(bodies, poses, CONFIG, gravity=table.gravity if known else None)
    assert angle(best.normal, table.up) < 1e-6
    assert float(best.offset) == pytest.approx(float(table.plane.offset), abs=1e-9)
    assert all(best.score > other.score for other in others)


@pytest.mark.parametrize("which", [0, 1, 2], ids=["box", "can", "angle"])
def test_one_object_and_gravity_are_enough(standing, table, which):
    bodies, poses = standing
    best = plane_hypotheses([bodies[which]], poses[which : which + 1], CONFIG, gravity=table.gravity)[0]
    assert angle(best.normal, table.up) < 1e-6
    assert float(best.offset) == pytest.approx(float(table.plane.offset), abs=1e-9)


@pytest.mark.parametrize("turn", [(math.pi, 0.0, 0.0), (math.pi / 2, 0.0, 0.0), (0.0, math.pi / 2, 0.0)])
def test_an_object_may_lie_on_any_face(box, can, table, turn):
    R = se3.exp_so3(torch.tensor(turn, dtype=torch.float64))
    half = float((R[2].abs() * box.upper).sum())
    poses = torch.stack([table.at(0.1, 0.0, half, turn), table.at(-0.1, 0.0, 0.04)])
    best = plane_hypotheses([box, can], poses, CONFIG)[0]
    assert angle(best.normal, table.up) < 1e-6


def test_gravity_decides_where_objects_do_not(box, table):
    """A single box says nothing of which of its faces is below, if it is seen from above one of its edges."""
    T = table.at(0.0, 0.0, 0.02)[None]
    for turn in ((0.0, 0.0, 0.0), (math.pi / 2, 0.0, 0.0)):
        down = -(table.T[:3, :3] @ se3.exp_so3(torch.tensor(turn, dtype=torch.float64)))[:, 2]
        best = plane_hypotheses([box], T, CONFIG, gravity=down)[0]
        assert angle(best.normal, -down) < 1e-6


def test_a_wrong_gravity_does_not_bend_the_plane(standing, table):
    bodies, poses = standing
    down = se3.exp_so3(torch.tensor([0.04, 0.0, 0.03], dtype=torch.float64)) @ table.gravity
    best = plane_hypotheses(bodies, poses, CONFIG, gravity=down)[0]
    assert angle(best.normal, table.up) < 1e-6


def test_noisy_poses_are_off_by_no_more_than_one_object_is(standing, table):
    bodies, poses = standing
    for seed in range(6):
        noise = torch.randn(3, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        moved = se3.retract(poses, noise * poses.new_tensor([0.003] * 3 + [0.02] * 3))
        best = plane_hypotheses(bodies, moved, CONFIG)[0]
        assert angle(best.normal, table.up) < 0.08
        middle = moved[:, :3, 3].mean(0)
        assert abs(float((best.normal - table.up) @ middle - (best.offset - table.plane.offset))) < 0.02


def test_an_object_on_another_does_not_shift_the_plane(box, can, table):
    """A can on a box, and one beside it; most objects standing higher is no reason to cut through the lower ones."""
    poses = table.poses((0.0, 0.0, 0.02), (0.01, 0.0, 0.08), (0.15, 0.05, 0.04))
    best = plane_hypotheses([box, can, can], poses, CONFIG)[0]
    assert angle(best.normal, table.up) < 1e-6
    assert float(best.offset) == pytest.approx(float(table.plane.offset), abs=1e-9)


def test_the_table_under_a_pile_is_among_the_first_two_hypotheses(box, can, table):
    """Where two of three objects stand higher, poses alone cannot be sure; the fit decides."""
    poses = table.poses((0.0, 0.0, 0.02), (-0.02, 0.01, 0.06), (0.015, 0.0, 0.12))
    found = plane_hypotheses([box, box, can], poses, CONFIG, gravity=table.gravity)[:2]
    assert all(angle(h.normal, table.up) < 1e-6 for h in found)
    assert min(abs(float(h.offset - table.plane.offset)) for h in found) < 1e-9


@pytest.mark.parametrize("side", [-0.1, -0.05, 0.0, 0.05, 0.1])
@pytest.mark.parametrize("end", [1, -1])
def test_without_gravity_up_is_not_to_the_side_of_the_image(table, side, end):
    """A book on its end: what it could stand on best is beside it."""
    book = Body.box((0.16, 0.12, 0.02), label="book")
    best = plane_hypotheses([book], table.at(side, 0.0, 0.08, (0.0, end * math.pi / 2, 0.0))[None], CONFIG)[0]
    assert abs(float(best.normal[0])) < 1e-6
    assert float(best.normal[1]) < 0.5


def test_without_gravity_up_is_not_down_in_the_image_even_of_what_is_over_the_camera():
    book = Body.box((0.16, 0.02, 0.12), label="book")
    best = plane_hypotheses([book], pose(translation=(0.0, -0.5, 0.5))[None], CONFIG)[0]
    assert float(best.normal[1]) < 0.5


@pytest.mark.parametrize("which", range(4))
@pytest.mark.parametrize("below", [0.02, 0.05])
def test_one_object_in_the_air_is_outvoted(can, table, below, which):
    poses = table.poses((0.1, 0.0, 0.04), (0.0, 0.0, 0.04), (-0.1, 0.0, 0.04), (0.0, 0.12, 0.04))
    poses[which, :3, 3] += below * table.up
    tilted = torch.tensor([[0.004 * math.cos(k), 0.004 * math.sin(k), 0.0] for k in range(4)], dtype=torch.float64)
    tilted[which] = 0.0  # which alone would make it the best
    poses[:, :3, :3] = poses[:, :3, :3] @ se3.exp_so3(tilted)
    best = plane_hypotheses([can] * 4, poses, CONFIG, gravity=table.gravity)[0]
    assert float(best.offset) == pytest.approx(float(table.plane.offset), abs=0.003)


def test_hypotheses_are_distinct_ordered_and_of_objects_before_the_camera(standing):
    bodies, poses = standing
    found = plane_hypotheses(bodies, poses, CONFIG, most=8)
    assert len(found) > 2
    assert [h.score for h in found] == sorted((h.score for h in found), reverse=True)
    middle = poses[:, :3, 3].mean(0)
    for i, a in enumerate(found):
        assert float(a.normal.norm()) == pytest.approx(1.0)
        assert float(a.offset) < -0.05  # the camera is above it
        for b in found[:i]:
            apart = abs(float((a.offset - a.normal @ middle) - (b.offset - b.normal @ middle)))
            assert angle(a.normal, b.normal) >= DISTINCT[0] or apart >= DISTINCT[1]


@pytest.mark.parametrize("most", [0, 1, 2])
def test_there_are_no_more_hypotheses_than_asked_for(standing, most):
    assert len(plane_hypotheses(*standing, CONFIG, most=most)) == most


def test_hypotheses_move_with_the_camera_if_gravity_does(standing, table):
    bodies, poses = standing
    before = plane_hypotheses(bodies, poses, CONFIG, gravity=table.gravity)[0]
    for turn in ((0.1, 0.0, 0.05), (-0.2, 0.1, 0.0), (0.05, -0.1, 0.2)):
        X = pose(turn, (0.05, -0.04, 0.1))
        after = plane_hypotheses(bodies, X @ poses, CONFIG, gravity=X[:3, :3] @ table.gravity)[0]
        torch.testing.assert_close(after.normal, X[:3, :3] @ before.normal, atol=1e-9, rtol=0)
        torch.testing.assert_close(after.offset, before.offset + after.normal @ X[:3, 3], atol=1e-9, rtol=0)


def test_unknown_and_flat_objects_propose_nothing(standing, flat, table):
    bodies, poses = standing
    best = plane_hypotheses(bodies, poses, CONFIG)[0]
    more = torch.cat([poses, torch.full((1, 4, 4), torch.nan, dtype=torch.float64), table.at(0.0, 0.0, 0.3)[None]])
    again = plane_hypotheses([*bodies, bodies[0], flat], more, CONFIG)[0]
    assert torch.equal(best.normal, again.normal)
    assert torch.equal(best.offset, again.offset)
    assert best.score == again.score
    assert plane_hypotheses([flat], table.at()[None], CONFIG) == []
    assert plane_hypotheses(bodies[:1], torch.full((1, 4, 4), torch.nan, dtype=torch.float64), CONFIG) == []
    assert plane_hypotheses([], torch.zeros(0, 4, 4, dtype=torch.float64), CONFIG) == []


def test_feet_at_rest_are_on_the_plane(standing, table):
    bodies, poses = standing
    feet = standing_on(bodies, poses, table.up)
    assert feet.points.shape == (3, FEET, 3)
    assert float(feet.tilt.max()) < 1e-6
    for k, T in enumerate(poses):
        torch.testing.assert_close(heights(feet, k, T, table.plane), feet.rest[k], atol=1e-9, rtol=0)
        assert float(feet.rest[k].max()) < 1e-9  # these are flat below
        assert abs(float(se3.apply(T, feet.lowest[k : k + 1]) @ table.plane.normal - table.plane.offset)) < 1e-9


def test_feet_are_at_the_outermost_corners(box, can, table):
    feet = standing_on([box, can], table.poses((0.0, 0.0, 0.02), (0.1, 0.0, 0.04)), table.up)
    assert {tuple(p) for p in feet.points[0].mul(1000).round().int().tolist()} == {
        (x, y, -20) for x in (-50, 50) for y in (-30, 30)
    }
    assert torch.allclose(feet.points[1, :, :2].norm(dim=1), torch.tensor(0.03, dtype=torch.float64))
    directions = feet.points[1, :, :2] / 0.03
    apart = torch.arccos((directions @ directions.mT).clamp(-1, 1)).fill_diagonal_(9).amin(1)
    assert float(apart.min()) > math.radians(20)  # all round


def test_feet_are_below_even_where_a_body_is_wider_above(table):
    ring = np.array([[math.cos(a), math.sin(a)] for a in np.arange(16) * math.pi / 8])
    points = np.concatenate([np.c_[0.05 * ring, np.zeros(16)], np.c_[0.08 * ring, np.full(16, 0.06)]])
    cup = Body.from_hull(trimesh.convex.convex_hull(points), label="cup")
    feet = standing_on([cup], table.at()[None], table.up)
    assert torch.allclose(feet.points[0, :, :2].norm(dim=1), torch.tensor(0.05, dtype=torch.float64))
    assert float(feet.points[0, :, 2].abs().max()) < 1e-9


def test_feet_that_are_not_quite_on_the_ground_know_how_high_they_are(table):
    """A stool with one leg that is 1 mm short: it stands on three, and the fourth is above the plane."""
    legs = np.array([[-0.05, -0.05, 0.0], [0.05, -0.05, 0.0], [-0.05, 0.05, 0.0], [0.05, 0.05, 0.001]])
    top = np.array([[x, y, 0.1] for x in (-0.05, 0.05) for y in (-0.05, 0.05)])
    hull = trimesh.Trimesh(np.concatenate([legs, top])).convex_hull
    stool = Body("stool", ConvexParts.from_hulls([np.asarray(hull.vertices)]), hull)
    T = table.at(0.0, 0.0, 0.0)
    feet = standing_on([stool], T[None], table.up)
    up = hull_stands(stool).up
    best = up[(up @ [0.0, 0.0, 1.0]).argmax()]
    expected = feet.points[0] @ torch.from_numpy(best.copy())
    torch.testing.assert_close(feet.rest[0], expected - expected.min(), atol=1e-9, rtol=0)
    assert 0.0005 < float(feet.rest.max()) < 0.002


@pytest.mark.parametrize("tilt", [0.0, 0.05, 0.2, 0.5])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_tilt_is_the_angle_to_standing_and_lowest_is_the_lowest_point(box, table, tilt, axis):
    T = table.at(0.0, 0.0, 0.05, tuple(tilt * a for a in axis))
    feet = standing_on([box], T[None], table.up)
    assert float(feet.tilt) == pytest.approx(tilt, abs=1e-6)
    vertices = se3.apply(T, torch.from_numpy(np.array(box.mesh.vertices))) @ table.up
    assert float(se3.apply(T, feet.lowest) @ table.up) == pytest.approx(float(vertices.min()))
    feet_up = feet.points[0, :, 2]
    assert torch.allclose(feet_up, torch.tensor(-0.02, dtype=torch.float64))  # still those of the face below


def test_a_cube_on_its_edge_is_tilted_by_45_degrees(table):
    cube = Body.box((0.1, 0.1, 0.1), label="cube")
    feet = standing_on([cube], table.at(0.0, 0.0, 0.08, (math.pi / 4, 0.0, 0.0))[None], table.up)
    assert float(feet.tilt) == pytest.approx(math.pi / 4, abs=1e-6)


def test_flat_bodies_and_unknown_poses_have_no_feet(box, flat, table):
    poses = torch.stack([table.at(), torch.full((4, 4), torch.nan, dtype=torch.float64), table.at(0.0, 0.0, 0.02)])
    feet = standing_on([flat, box, box], poses, table.up)
    assert feet.tilt.isinf().tolist() == [True, True, False]
    assert feet.lowest.isnan().all(1).tolist() == [True, True, False]
    assert feet.points.isfinite().all()
    assert feet.rest.isfinite().all()
    assert [tuple(x.shape) for x in standing_on([], poses[:0], table.up)] == [(0, FEET, 3), (0, FEET), (0,), (0, 3)]


def test_a_body_in_two_places_is_the_same_body(box, table):
    feet = standing_on([box, box], table.poses((0.0, 0.0, 0.02), (0.2, 0.1, 0.02, (0.0, 0.0, 1.0))), table.up)
    torch.testing.assert_close(feet.points[0], feet.points[1])


def test_feet_do_not_depend_on_the_frame(standing, table):
    bodies, poses = standing
    expected = standing_on(bodies, poses, table.up)
    for X in camera_motions():
        for a, b in zip(expected, standing_on(bodies, X @ poses, X[:3, :3] @ table.up), strict=True):
            if a is not expected.tilt and a is not expected.lowest:  # arccos near 1 is rough; several are lowest
                torch.testing.assert_close(a, b, atol=1e-12, rtol=0)
