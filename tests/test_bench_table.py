"""The table benchmark on tiny scenes: errors, coverage and counts are what they are said to be."""

import json
import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from physpose_torch import se3
from physpose_torch.bench import tables
from physpose_torch.bench.__main__ import main
from physpose_torch.bench.real_tables import RealFrame, depth_plane, seen_from
from physpose_torch.bench.table_scenes import ACROSS, ALONG, TURN, TableScene, noisy_poses, pair_scenes
from physpose_torch.bench.tables import describe_row, deviation, measure, summarise, tables_table
from physpose_torch.contacts import plane_variance
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.errors import DataError, TableNotFoundError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.scene import Scene
from physpose_torch.table.estimator import TableEstimate
from physpose_torch.table.view import pixel_rays

K = torch.tensor([[160.0, 0, 79.5], [0, 160.0, 59.5], [0, 0, 1]], dtype=torch.float64)
SPOTS = ((-0.15, 0.0, 0.02), (0.15, -0.05, 0.02), (0.0, 0.12, 0.02))
FOUND = {"failure": None, "crashed": False, "warnings": [], "wrong": False, "seconds": 1.0}


@pytest.fixture
def boxes(table):
    """Three boxes on the table, two grey images from one place."""
    poses = table.poses(*SPOTS)
    meshes = {name: trimesh.creation.box((0.1, 0.06, 0.04)) for name in ("a", "b", "c")}
    grey = torch.full((120, 160, 3), 128, dtype=torch.uint8)
    return TableScene("tiny", "boxes", 7, (grey, grey), K, (poses, poses), table.plane, meshes)


def estimate_of(plane, poses, warnings=()):
    nothing = {"method": "support", "scale": None, "inliers": 0, "warnings": warnings, "depth_factor": 1.0}
    none = torch.zeros(0, 3, dtype=torch.float64)
    standing = torch.ones(len(poses), dtype=torch.bool)
    covariance = plane.covariance
    return TableEstimate(plane, covariance, T_view1_view0=None, poses=poses, standing=standing, contacts=none, **nothing)


# ---- errors of the poses


def test_poses_have_the_errors_that_are_stated(table):
    truth = table.poses((0.2, 0.1, 0.0)).expand(20000, 4, 4)
    noisy = noisy_poses(truth, np.random.default_rng(0))
    ray = truth[0, :3, 3] / truth[0, :3, 3].norm()
    moved = noisy[:, :3, 3] - truth[:, :3, 3]
    across = moved @ tangent_basis(ray[None])[0].mT
    turned = se3.log_so3(noisy[:, :3, :3] @ truth[:, :3, :3].mT)
    assert float((moved @ ray).std()) == pytest.approx(ALONG, rel=0.03)
    assert across.std(0).tolist() == pytest.approx([ACROSS] * 2, rel=0.03)
    assert turned.std(0).tolist() == pytest.approx([TURN] * 3, rel=0.03)


def test_one_draw_has_the_same_errors_whatever_the_rest(boxes):
    (one,) = boxes.views(1, 3, 0.0)
    two = boxes.views(2, 3, 0.02)
    torch.testing.assert_close(two[0].poses[:, :3, 3], 1.02 * one.poses[:, :3, 3])
    torch.testing.assert_close(two[0].poses[:, :3, :3], one.poses[:, :3, :3])
    assert not torch.allclose(two[0].poses, two[1].poses)  # independent in the two views
    assert not torch.allclose(boxes.views(1, 4, 0.0)[0].poses, one.poses)


# ---- errors of the plane


def test_the_deviation_is_in_the_coordinates_of_the_covariance(boxes, table):
    bodies, poses = boxes.bodies("models"), boxes.truth[0]
    off = torch.tensor([2e-4, -1e-4, 3e-4], dtype=torch.float64)
    covariance = torch.outer(off, off)
    middle = poses[:, :3, 3].mean(0)
    normal = table.up - tangent_basis(table.up[None])[0].mT @ off[:2]
    normal = normal / normal.norm()
    true = Plane(normal, table.plane.offset - table.up @ middle + off[2] + normal @ middle)
    found = Plane(table.up, table.plane.offset, covariance)
    torch.testing.assert_close(deviation(estimate_of(found, poses), bodies, true), off, rtol=0, atol=1e-7)
    # by that covariance, one standard deviation is just how much higher the true plane is at each object
    who, act = torch.arange(3), torch.ones(3, dtype=torch.bool)
    variance = plane_variance(poses, Scene.tabletop(bodies, found), who, torch.zeros(3, dtype=torch.long), act)
    higher = (true.offset - poses[:, :3, 3] @ true.normal) - (found.offset - poses[:, :3, 3] @ found.normal)
    torch.testing.assert_close(variance.sqrt(), higher.abs(), rtol=1e-3, atol=1e-8)


def test_angle_and_offset_at_the_footprints(boxes, table):
    tilted = se3.exp_so3(torch.tensor([math.radians(2.0), 0, 0], dtype=torch.float64)) @ table.up
    lowered = Plane(tilted, tilted @ boxes.middle - 0.003, 1e-6 * torch.eye(3, dtype=torch.float64))
    bodies = boxes.bodies("models")
    row, _ = measure(lambda *_, **__: estimate_of(lowered, boxes.truth[0]), [], bodies, boxes.plane, boxes.middle)
    assert (row["angle_deg"], row["offset_mm"]) == (pytest.approx(2.0), pytest.approx(3.0))
    assert row["mahalanobis_squared"] > tables.THREE_SIGMA
    assert not row["wrong"]
    assert float(boxes.middle @ table.up) == pytest.approx(float(table.plane.offset))


@pytest.mark.parametrize(("warnings", "wrong"), [((), True), (("careful",), False)])
def test_wrong_is_confident_only_without_a_warning(boxes, warnings, wrong):
    far = Plane(boxes.plane.normal, boxes.plane.offset - 0.03, torch.eye(3, dtype=torch.float64))
    estimate = estimate_of(far, boxes.truth[0], warnings)
    row, _ = measure(lambda *_, **__: estimate, [], boxes.bodies("models"), boxes.plane, boxes.middle)
    assert row["wrong"] is wrong
    assert ("careful" in describe_row({"scene": "x", "draw": 0, "method": "auto", **row})) is not wrong


@pytest.mark.parametrize(("error", "crashed"), [(TableNotFoundError("too thin"), False), (ValueError("oh"), True)])
def test_no_plane_is_a_failure_and_anything_else_a_bug(boxes, error, crashed):
    def fail(*args, **kwargs):
        raise error

    row, estimate = measure(fail, [], [], boxes.plane, boxes.middle)
    assert estimate is None
    assert str(error) in row["failure"]
    assert row["crashed"] is crashed
    summary = summarise("auto", [{"method": "auto", **row}])
    assert (summary["failures"], summary["crashed"]) == (int(not crashed), int(crashed))
    assert "  -" in tables_table([summary])


def test_quantiles_and_coverage_are_of_what_was_found():
    rows = [
        {**FOUND, "angle_deg": a, "offset_mm": o, "mahalanobis_squared": m}
        for a, o, m in ((1.0, -2.0, 1.0), (2.0, 4.0, 14.0), (9.0, -30.0, 15.0))
    ]
    rows[2]["wrong"] = True
    summary = summarise("joint", [*rows, {**FOUND, "failure": "thin"}])
    assert (summary["angle_deg_median"], summary["offset_mm_median"]) == (2.0, 4.0)
    assert (summary["angle_deg_worst"], summary["offset_mm_worst"]) == (9.0, 30.0)
    assert summary["within_3_sigma"] == pytest.approx(2 / 3)
    assert (summary["estimates"], summary["failures"], summary["wrong"]) == (4, 1, 1)


# ---- scenes


def test_rendered_pairs_are_read_in_metres(tmp_path, table):
    folder = tmp_path / "table_pairs" / "scene_03"
    folder.mkdir(parents=True)
    T = table.at(0.1, 0.0, 0.02)
    T[:3, 3] *= 1000
    scene = {
        "dataset": "ycbv",
        "K": K.tolist(),
        "table": "wood",
        "objects": [{"obj_id": 5, "T_cam0_obj": T.tolist(), "T_cam1_obj": T.tolist()}],
        "plane_cam0": {"normal": table.up.tolist(), "offset_mm": 1000 * float(table.plane.offset)},
    }
    (folder / "scene.json").write_text(json.dumps(scene))
    for i in range(2):
        Image.new("RGB", (160, 120), (10 * i, 0, 0)).save(folder / f"view{i}.png")
    models = tmp_path / "ycbv" / "models"
    models.mkdir(parents=True)
    trimesh.creation.box((100, 60, 40)).export(models / "obj_000005.ply")
    (found,) = pair_scenes(tmp_path)
    assert (found.key, found.name) == (3, "03 wood")
    torch.testing.assert_close(found.truth[1][0], table.at(0.1, 0.0, 0.02))
    assert float(found.plane.offset) == pytest.approx(float(table.plane.offset))
    assert found.images[1][0, 0].tolist() == [10, 0, 0]
    (body,) = found.bodies("models_textured")  # without colours where there are none
    assert body.mesh.extents.tolist() == pytest.approx([0.1, 0.06, 0.04])


def test_data_without_pairs_is_an_error(tmp_path):
    with pytest.raises(DataError, match="skip-pairs"):
        list(pair_scenes(tmp_path))


# ---- real images: what is made of depth


@pytest.fixture
def frame(table, box):
    """A box on the table, seen by an exact depth camera."""
    y, x = torch.meshgrid(torch.arange(120), torch.arange(160), indexing="ij")
    rays = pixel_rays(K, torch.stack([x, y], -1).double())
    depth = table.plane.offset / (rays @ table.up)
    depth[55:65, 75:85] -= 0.03  # the box
    image = torch.stack([x, y, x + y], -1).to(torch.uint8)
    poses = table.poses((0.0, 0.0, 0.02))
    return RealFrame("made up", image, depth, K, (1,), poses, poses, (1,), table.plane)


def test_depth_tells_the_plane_around_the_objects(frame, box):
    plane, share = depth_plane(frame, [box])
    torch.testing.assert_close(plane.normal, frame.plane.normal)
    assert float(plane.offset) == pytest.approx(float(frame.plane.offset))
    assert share == 1.0


def test_seen_from_the_same_place_nothing_changes(frame):
    # but at the frame, and along the steps of depth, which are filled in
    seen = seen_from(frame, torch.eye(4, dtype=torch.float64)).int()
    off = (seen - frame.image.int()).abs().amax(-1)[2:-2, 2:-2]
    assert float((off <= 1).double().mean()) > 0.98


def test_seen_from_elsewhere_what_is_on_the_table_moves_with_it(frame, table):
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = -0.05  # a camera 5 cm to the right
    seen = seen_from(frame, T)
    column, row = 120, 30
    moved = 160 * 0.05 / float(frame.depth[row, column])
    assert float(seen[row, round(column - moved), 0]) == pytest.approx(column, abs=1.0)


# ---- the command


@pytest.fixture
def tiny(boxes, monkeypatch):
    monkeypatch.delenv("PHYSPOSE_DATA", raising=False)
    monkeypatch.setattr(tables, "generated_scenes", lambda count, seed: [boxes])


def test_the_command_prints_a_table_for_each_setting(tiny, tmp_path, capsys):
    out = tmp_path / "table.json"
    arguments = ["--methods", "support", "paper", "--draws", "3", "--views", "1", "--json", str(out)]
    assert main(["table", *arguments, "--gravity-sigma-deg", "0.5"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("within 3σ") == 2  # biases
    written = json.loads(out.read_text())
    assert [(s["method"], s["bias"], s["estimates"]) for s in written["tables"]] == [
        ("support", b, 3) for b in (0, 0.02)
    ]
    assert len(written["table_scenes"]) == 6
    found = [r for r in written["table_scenes"] if r["failure"] is None]
    assert found
    assert max(r["angle_deg"] for r in found) < 3.0


def test_refined_poses_are_nearer_to_the_truth(tiny, tmp_path, capsys):
    out = tmp_path / "table.json"
    arguments = ["--methods", "support", "--draws", "1", "--views", "1", "--bias", "0", "--downstream"]
    assert main(["table", *arguments, "--json", str(out)]) == 0
    assert "deepest in table" in capsys.readouterr().out
    (row,) = json.loads(out.read_text())["table_scenes"]
    errors = row["downstream"]
    assert errors["true"]["centre_mm"] < errors["input"]["centre_mm"]
    assert errors["true"]["deepest_mm"] < 2.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--draws", "0"], "--draws 0"),
        (["--bias", "2"], "--bias"),
        (["--gravity-sigma-deg", "-1"], "--gravity-sigma-deg"),
        (["--plot", "x.png"], "--plot"),
        (["--real"], "PHYSPOSE_DATA"),
    ],
)
def test_wrong_arguments_are_named(tiny, capsys, arguments, message):
    assert main(["table", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_bodies_are_made_with_parts_only_where_asked(boxes):
    hull, parts = boxes.bodies("models"), boxes.bodies("models", decomposed=True)
    assert all(isinstance(b, Body) and b.decomposition is None for b in hull)
    assert all(b.decomposition is not None for b in parts)
