"""The rules of grasping on shapes where it is plain what must happen, and the benchmark that counts it."""

import json
import math

import numpy as np
import pytest
import torch
import trimesh

from physpose_torch import se3
from physpose_torch.bench.__main__ import main
from physpose_torch.bench.grasp import GraspOptions, bootstrap, household_handles, run_grasps, summarise, wilson
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.household import household_meshes
from physpose_torch.robot.grasp import GraspRules, Handle, grasp_pose, judge_grasps
from physpose_torch.robot.gripper import Gripper

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
TABLE = Plane(UP, torch.tensor(0.0, dtype=torch.float64))
BLOCK = Body.box((0.06, 0.04, 0.1), label="block")
HANDLE = Handle("top", (0.0, 0.0, 0.045), (0.0, 1.0, 0.0), 0.04)  # 5 mm below the top


def at(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):
    R = se3.exp_so3(torch.tensor(turn, dtype=torch.float64))
    return se3.from_rotation_translation(R, torch.tensor([x, y, z], dtype=torch.float64))


TRUE = at(z=0.05)


def outcome(estimate, true=TRUE, *, handle=HANDLE, others=(), body=BLOCK, **options):
    """What becomes of a grasp at an estimated pose, beside other bodies at their poses."""
    T = grasp_pose(handle, estimate, UP)[None]
    poses = torch.stack([true, *(T for _, T in others)])
    return judge_grasps(T, [handle.width], [0], poses, [body, *(b for b, _ in others)], TABLE, **options)[0]


def moved(x=0.0, y=0.0, z=0.0):
    return at(x, y, 0.05 + z)


# ---- where the gripper goes


def test_the_gripper_comes_straight_down_on_the_handle_whatever_the_tilt():
    T = grasp_pose(HANDLE, at(0.1, 0.2, 0.3, (0.3, 0.2, 0.5)), UP)
    assert T[:3, 2].tolist() == [0, 0, -1]
    assert float(T[2, 1]) == 0
    expected = se3.apply(at(0.1, 0.2, 0.3, (0.3, 0.2, 0.5)), torch.tensor([HANDLE.point], dtype=torch.float64))[0]
    assert torch.allclose(T[:3, 3], expected)
    assert float(torch.linalg.det(T[:3, :3])) == pytest.approx(1)


def test_a_handle_that_closes_along_gravity_is_refused():
    with pytest.raises(InvalidInputError, match="closes along gravity"):
        grasp_pose(HANDLE, at(turn=(math.pi / 2, 0, 0)), UP)


# ---- rules, one after another


def test_the_true_pose_is_held():
    assert outcome(TRUE) == "held"


@pytest.mark.parametrize(
    ("z", "expected"), [(0.0038, "held"), (0.0042, "off the pads"), (0.0048, "off the pads"), (0.006, "misses")]
)
def test_too_high_by_more_than_the_tips_reach_below_the_edge_fails(z, expected):
    """Tips 5 mm inside, of which the lowest millimetre holds nothing."""
    assert outcome(moved(z=z)) == expected


@pytest.mark.parametrize(("z", "expected"), [(-0.039, "held"), (-0.041, "hits object")])
def test_too_low_fails_when_the_palm_comes_down_on_the_object(z, expected):
    """Fingers of 45 mm, of which 5 are inside: the palm has 40 mm left."""
    assert outcome(moved(z=z)) == expected


@pytest.mark.parametrize(
    ("y", "expected"), [(0.0098, "held"), (-0.0098, "held"), (0.0102, "hits object"), (-0.0102, "hits object")]
)
def test_sideways_by_more_than_the_clearance_comes_down_on_the_object(y, expected):
    assert outcome(moved(y=y)) == expected


@pytest.mark.parametrize(("x", "expected"), [(0.037, "held"), (0.0385, "off the pads"), (0.04, "misses")])
def test_along_the_face_a_pad_must_overlap_the_object(x, expected):
    """The face ends 30 mm from its middle, a pad 8 mm from the finger's."""
    assert outcome(moved(x=x)) == expected


def test_the_table_is_hit_before_anything_else():
    low = Body.box((0.06, 0.04, 0.01), label="tile")
    handle = Handle("top", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.04)
    assert outcome(at(z=0.005), at(z=0.005), body=low, handle=handle) == "held"
    assert outcome(at(z=-0.001), at(z=0.005), body=low, handle=handle) == "hits table"


def test_a_neighbour_in_the_fingers_way_is_hit_coming_down_or_closing():
    wall = Body.box((0.2, 0.02, 0.1), label="wall")  # lower than the palm comes
    beside = at(y=0.02 + 0.01 + 0.0185, z=0.05)  # its face is 18.5 mm from the block's; a finger needs 10 + 9 mm
    assert outcome(TRUE, others=[(wall, beside)]) == "hits another"
    assert outcome(TRUE, others=[(wall, at(y=0.0495, z=0.05))]) == "held"
    sheet = Body.box((0.02, 0.001, 0.1), label="sheet")  # stands between finger and block
    assert outcome(TRUE, others=[(sheet, at(y=0.02 + 0.005, z=0.06))]) == "hits another"


def test_something_above_is_hit_within_the_descent_only():
    shelf = Body.box((0.3, 0.3, 0.01), label="shelf")
    assert outcome(TRUE, others=[(shelf, at(z=0.3))]) == "hits another"
    assert outcome(TRUE, others=[(shelf, at(z=0.3))], rules=GraspRules(descent=0.05)) == "held"


@pytest.mark.parametrize(("friction", "expected"), [(0.5, "slips"), (0.6, "held")])
def test_faces_that_lean_more_than_the_friction_cone_slip(friction, expected):
    """A block turned by 28°: its corners are what the pads touch, with the faces' normals 28° off; tan 28° = 0.53."""
    turned = at(z=0.05, turn=(0, 0, math.radians(28)))
    wide = Handle("top", HANDLE.point, (-math.sin(math.radians(-28)), math.cos(math.radians(-28)), 0.0), 0.065)
    gripper = Gripper(finger_width=0.004)
    small = Body.box((0.1, 0.04, 0.1), label="block")
    rules = GraspRules(friction=friction, pad_tolerance=0.002)
    assert outcome(turned, turned, handle=wide, body=small, rules=rules, gripper=gripper) == expected


@pytest.mark.parametrize(("angle", "expected"), [(20, "held"), (30, "slips")])
def test_a_wedge_is_held_while_its_slope_is_within_the_friction_cone(angle, expected):
    """Upright faces that lean inwards towards the top by some angle; atan(0.5) is 26.6°."""
    lean = 0.1 * math.tan(math.radians(angle))
    half = 0.005 + lean
    corners = np.array(
        [[x, y * (half if z < 0 else 0.005), z] for x in (-0.03, 0.03) for y in (-1, 1) for z in (-0.05, 0.05)]
    )
    wedge = Body.from_hull(trimesh.Trimesh(corners).convex_hull, label="wedge")
    handle = Handle("top", (0.0, 0.0, 0.03), (0.0, 1.0, 0.0), 2 * (0.005 + 0.02 * math.tan(math.radians(angle))))
    assert outcome(TRUE, handle=handle, body=wedge, rules=GraspRules(clearance=0.004, pad_tolerance=0.001)) == expected


def test_attempts_are_judged_alone_as_together():
    poses = [TRUE, moved(z=0.0042), moved(y=0.02), moved(z=0.006)]
    T = torch.stack([grasp_pose(HANDLE, p, UP) for p in poses])
    together = judge_grasps(T, [0.04] * 4, [0] * 4, TRUE[None], [BLOCK], TABLE)
    assert together == [outcome(p) for p in poses] == ["held", "off the pads", "hits object", "misses"]


def test_the_world_may_be_any_frame():
    X = at(0.3, -0.2, 0.7, (0.5, -0.4, 1.0))
    up = X[:3, :3] @ UP
    plane = Plane(up, up @ X[:3, 3])
    for estimate in (TRUE, moved(z=0.0042), moved(y=0.02)):
        T = grasp_pose(HANDLE, X @ estimate, up)[None]
        assert judge_grasps(T, [0.04], [0], (X @ TRUE)[None], [BLOCK], plane) == [outcome(estimate)]


def test_no_attempt_no_outcome():
    assert judge_grasps(torch.zeros(0, 4, 4), [], [], TRUE[None], [BLOCK], TABLE) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((TRUE[None], [0.04, 0.04], [0], TRUE[None], [BLOCK]), "2 widths"),
        ((TRUE[None], [0.09], [0], TRUE[None], [BLOCK]), "0.09 m wide"),
        ((TRUE[None], [0.04], [1], TRUE[None], [BLOCK]), "target 1"),
        ((TRUE[None], [0.04], [0], TRUE[None], [BLOCK, BLOCK]), r"expected \(2, 4, 4\)"),
        ((2 * TRUE[None], [0.04], [0], TRUE[None], [BLOCK]), "T_world_gripper"),
    ],
)
def test_arguments_that_do_not_fit_are_named(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        judge_grasps(*arguments, TABLE)


@pytest.mark.parametrize("options", [{"opening": 0.0}, {"finger_length": float("nan")}, {"pad_height": 0.05}])
def test_a_gripper_that_cannot_be_is_refused(options):
    with pytest.raises(InvalidInputError, match=next(iter(options))):
        Gripper(**options)


# ---- the benchmark


def hulls():
    """The household objects with one part each: nothing to decompose."""
    return {name: Body.from_hull(mesh, label=name) for name, mesh in household_meshes().items()}


@pytest.mark.parametrize("name", ["can", "bottle", "box", "bowl", "mug", "banana"])
def test_handles_lie_inside_the_surface_that_the_fingers_close_on(name):
    """From the handle the surface is half the handle's width away along the closing direction, both ways."""
    mesh = household_meshes()[name]
    for handle in household_handles()[name]:
        assert np.linalg.norm(handle.closing) == pytest.approx(1)
        point, closing = np.array(handle.point), np.array(handle.closing)
        hits = [mesh.ray.intersects_location([point], [s * closing])[0] for s in (1, -1)]
        width = sum(np.linalg.norm(h - point, axis=1).min() for h in hits)
        assert handle.width - 2.5e-3 < width < handle.width + 1e-3  # a banana is wider above its handle
        assert mesh.contains([point])[0]


def test_exact_estimates_are_all_held(monkeypatch, capsys):
    """Without errors every trial is a success, by the choice of trials; a refiner may then not break one."""
    monkeypatch.setattr("physpose_torch.bench.grasp.perturb_like_estimator", lambda T, **_: T.clone())
    results = {}
    run_grasps(results, GraspOptions(seeds=2, views=("top",), bias=(0.0,)), 0, hulls())
    by_method = {s["method"]: s for s in results["grasp_summary"]}
    assert by_method["initial"]["held"] == 1
    assert by_method["initial"]["trials"] >= 4
    assert by_method["refined"]["held"] > 0.9
    assert abs(by_method["initial"]["height_mm_median"]) < 1e-9
    assert "refined against initial" in capsys.readouterr().out


def test_estimates_too_near_are_missed_above_and_refinement_gets_some_of_them(capsys):
    results = {}
    run_grasps(results, GraspOptions(seeds=3, views=("top",), bias=(-0.024,)), 0, hulls())
    by_method = {s["method"]: s for s in results["grasp_summary"]}
    assert by_method["initial"]["height_mm_median"] > 10
    assert by_method["initial"]["outcomes"]["misses"] > 0.5 * by_method["initial"]["trials"]
    assert by_method["refined"]["held"] > by_method["initial"]["held"]
    assert abs(by_method["refined"]["height_mm_median"]) < 5
    rows = [r for r in results["grasps"] if r["method"] == "refined"]
    again = {}
    run_grasps(again, GraspOptions(seeds=1, views=("top",), bias=(-0.024,)), 1, hulls())
    assert [r for r in again["grasps"] if r["method"] == "refined"] == [r for r in rows if r["seed"] == 1]


def test_the_command_writes_every_trial(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("physpose_torch.bench.grasp.household_bodies", hulls)
    out = tmp_path / "grasp.json"
    assert main(["grasp", "--seeds", "1", "--views", "top", "--bias", "0.024", "--json", str(out)]) == 0
    written = json.loads(out.read_text())
    assert len(written["grasps"]) == sum(s["trials"] for s in written["grasp_summary"])
    assert "held [%]" in capsys.readouterr().out


@pytest.mark.parametrize("options", [["--seeds", "0"], ["--inside", "0.5"], ["--bias", "0.9"], ["--plot", "a.png"]])
def test_options_out_of_range_are_named(monkeypatch, options, capsys):
    monkeypatch.setattr("physpose_torch.bench.grasp.household_bodies", hulls)
    assert main(["grasp", *options]) == 2
    assert options[0] in capsys.readouterr().err


def test_wilsons_interval_is_that_of_the_book():
    """10 of 20: 0.2993 to 0.7007; 0 of 10: 0 to 0.2775 (Newcombe 1998)."""
    assert wilson(10, 20) == pytest.approx((0.2993, 0.7007), abs=1e-4)
    assert wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)


def test_the_interval_over_scenes_is_wider_where_trials_of_a_scene_go_together():
    rng = np.random.default_rng(0)
    alone = rng.integers(0, 2, 400).tolist()
    together = [4 * x for x in alone[:100]]
    width = [np.diff(bootstrap(won, tried))[0] for won, tried in ((alone, [1] * 400), (together, [4] * 100))]
    assert width[1] == pytest.approx(2 * width[0], rel=0.15)


def test_a_summary_counts_outcomes():
    row = {"seed": 0, "object": "can", "method": "m", "height_mm": 1.0, "sideways_mm": 2.0}
    (s,) = summarise([{**row, "outcome": o} for o in ("held", "held", "slips", "misses")])
    assert (s["held"], s["trials"], s["outcomes"]["held"], s["outcomes"]["slips"]) == (0.5, 4, 2, 1)
