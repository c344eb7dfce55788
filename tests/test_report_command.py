"""``physpose report`` on a small BOP folder: every row measured, nothing changed, and what it says is what is there."""

import json

import numpy as np
import pytest
import torch
from bop_files import HEADER, csv_row, write_models, write_scene

from physpose_torch.__main__ import main

TILT = np.deg2rad(40)
UP = np.array([0.0, -np.cos(TILT), -np.sin(TILT)])
OFFSET_MM = -400.0


def standing(x, y, height, lean=0.0):
    """T_camera_object [mm] of an object on the table: its origin at a height, leaning by an angle about its x axis."""
    X = np.array([1.0, 0, 0])
    c, s = np.cos(lean), np.sin(lean)
    R = np.stack([X, np.cross(UP, X), UP], axis=1)
    T = np.eye(4)
    T[:3, 3] = R @ [x, y, height] + UP * OFFSET_MM + [0, 0, 600] - UP * (UP @ [0, 0, 600])
    T[:3, :3] = R @ [[1, 0, 0], [0, c, -s], [0, s, c]]
    return T


@pytest.fixture
def dataset(tmp_path):
    """Two images. In one, a high box (1) 4 mm inside the table, a flat one (4) 5 mm above it, a bad estimate of the high
    one; in the other a box (9) on its edge."""
    root = tmp_path / "data"
    write_models(root / "models")
    write_scene(root / "test", 2, {im: [(1, standing(0, 0, 50), 1.0)] for im in (3, 7)}, width=640)
    rows = [
        csv_row(2, 3, 1, 0.9, standing(-80, 0, 46)),
        csv_row(2, 7, 9, 0.7, standing(0, 0, 25 * 2**0.5 + 20, np.pi / 4)),
        csv_row(2, 3, 4, 0.8, standing(60, 30, 20)),
        csv_row(2, 3, 1, 0.2, standing(-79, 1, 48)),
    ]
    (root / "est.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    write_planes(root, 3, 7)
    return root


def write_planes(root, *images):
    entry = {"normal": UP.tolist(), "offset_mm": OFFSET_MM}
    (root / "planes.json").write_text(json.dumps({"2": {str(im): entry for im in images}}))


def report(root, *more, estimates="est.csv", planes=True):
    args = ["report", str(root / estimates), "--dataset", str(root), "--json", str(root / "out.json")]
    code = main([*args, *(["--planes", str(root / "planes.json")] if planes else []), *map(str, more)])
    found = json.loads((root / "out.json").read_text()) if (root / "out.json").exists() else None
    return code, found


def many(root, count):
    """The first image ``count`` times, as images 10, 11, ..."""
    header, *rows = (root / "est.csv").read_text().splitlines()
    images = range(10, 10 + count)
    lines = [row.replace("2,3,", f"2,{im},", 1) for im in images for row in rows if row.startswith("2,3,")]
    (root / "many.csv").write_text("\n".join([header, *lines]) + "\n")
    write_planes(root, *images)


def test_every_row_is_measured_in_millimetres(dataset):
    code, found = report(dataset, "--quiet")
    assert code == 0
    assert found["images"] == 2
    rows = {row["row"]: row for row in found["rows"]}
    assert sorted(rows) == [0, 1, 2, 3]
    assert [(rows[i]["scene_id"], rows[i]["im_id"], rows[i]["obj_id"], rows[i]["score"]) for i in range(4)] == [
        (2, 3, 1, 0.9),
        (2, 7, 9, 0.7),
        (2, 3, 4, 0.8),
        (2, 3, 1, 0.2),
    ]
    assert rows[0]["penetration_static_mm"] == pytest.approx(4, abs=0.01)
    assert (rows[0]["status"], rows[0]["stable"], rows[0]["support"]) == ("penetrating", True, "plane")
    assert rows[0]["stability_margin_mm"] == pytest.approx(20, abs=0.01)
    assert rows[2]["gap_mm"] == pytest.approx(5, abs=0.01)
    assert rows[2]["status"] == "floating"
    assert rows[1]["stable"] is False
    assert [rows[i]["alternative"] for i in range(4)] == [False, False, False, True]


def test_no_file_is_changed(dataset):
    before = {p: p.read_bytes() for p in dataset.rglob("*") if p.is_file()}
    report(dataset)
    assert {p: p.read_bytes() for p in before} == before


def test_a_few_images_are_told_object_by_object(dataset, capsys):
    assert report(dataset)[0] == 0
    text = capsys.readouterr().out
    lines = [line.split() for line in text.splitlines()]
    assert ["2/3", "1", "0.900", "4.0", "0.0", "0.0", "plane", "yes", "penetrating"] in lines
    assert ["4", "0.800", "0.0", "0.0", "5.0", "plane", "yes", "floating"] in lines
    assert any(line[-1:] == ["alternative"] for line in lines)
    assert "1 pose is an alternative" in text
    assert "nan" not in text.lower()


def test_many_images_are_a_summary_without_alternatives(dataset, capsys):
    many(dataset, 4)
    code, found = report(dataset, estimates="many.csv")
    assert code == 0
    assert len(found["rows"]) == 12
    text = capsys.readouterr().out
    lines = {words[0]: words[1:] for words in map(str.split, text.splitlines()) if len(words) == 11}
    #                  poses, static, object, above [%]; penetration; gap; stable, unsupported [%]
    assert lines["1"] == ["4", "100", "0", "0", "4.0", "4.0", "0.0", "0.0", "100", "0"]
    assert lines["4"][:4] == ["4", "0", "0", "100"]
    assert lines["all"][:4] == ["8", "50", "0", "50"]
    assert "4 poses are alternatives of a better one; left out" in text


@pytest.mark.parametrize("count", [1, 4], ids=["few", "many"])
def test_without_planes_it_says_what_is_unknown_instead_of_nan(dataset, capsys, count):
    many(dataset, count)
    code, found = report(dataset, estimates="many.csv", planes=False)
    assert code == 0
    text = capsys.readouterr().out
    assert "gravity is unknown" in text
    assert "nan" not in text.lower()
    assert "carried by" not in text
    for row in found["rows"]:
        assert row["gap_mm"] is row["stable"] is row["stability_margin_mm"] is None
        assert row["status"] == "free"


def test_batches_do_not_matter(dataset):
    many(dataset, 5)
    _, together = report(dataset, "--quiet", estimates="many.csv")
    for size in (1, 2):
        _, found = report(dataset, "--quiet", "--batch", size, estimates="many.csv")
        assert found == together


def test_an_image_that_cannot_be_measured_is_named_and_fails_the_run(dataset, caplog):
    header, *rows = (dataset / "est.csv").read_text().splitlines()
    bad = csv_row(2, 5, 77, 0.9, standing(0, 0, 50))
    (dataset / "bad.csv").write_text("\n".join([header, bad, *rows]) + "\n")
    write_planes(dataset, 3, 5)
    code, found = report(dataset, "--quiet", estimates="bad.csv")
    assert code == 1
    assert found["images"] == 1
    assert {row["im_id"] for row in found["rows"]} == {3}
    assert [row["row"] for row in found["rows"]] == [1, 3, 4]
    assert "77" in caplog.text
    assert "image 7: no plane" in caplog.text


def test_a_batch_that_fails_is_measured_image_by_image(dataset, monkeypatch, caplog):
    from physpose_torch.commands import report as module
    from physpose_torch.errors import InvalidInputError

    measure = module._rows

    def fails_at_7(images, *args):
        if any(i.im_id == 7 for i in images):
            raise InvalidInputError("cannot be")
        return measure(images, *args)

    monkeypatch.setattr(module, "_rows", fails_at_7)
    code, found = report(dataset, "--quiet")
    assert code == 1
    assert {row["im_id"] for row in found["rows"]} == {3}
    assert found["problems"] == ["scene 2 image 7: cannot be"]
    assert "image 7: cannot be" in caplog.text


def test_statics_carry_by_their_label(dataset):
    """A board 4 mm below the table's plane carries what is inside the plane no less, and the plane is left out."""
    R = np.stack([[1.0, 0, 0], np.cross(UP, [1.0, 0, 0]), UP], axis=1)
    board = standing(0, 0, -10)[:3, 3]
    pose = {"R": R.ravel().tolist(), "t_mm": board.tolist()}
    statics = {"statics": [{"box_mm": [2000, 2000, 40], "label": "board", "poses": {"all": pose}}]}
    (dataset / "statics.json").write_text(json.dumps(statics))
    _, found = report(dataset, "--quiet", "--statics", dataset / "statics.json")
    assert [row["support"] for row in found["rows"] if row["obj_id"] == 4] == ["board"]


def test_nothing_in_is_nothing_out(dataset, capsys):
    (dataset / "empty.csv").write_text(HEADER + "\n")
    code, found = report(dataset, estimates="empty.csv")
    assert code == 0
    assert found == {"images": 0, "rows": [], "problems": []}
    assert "0 images, 0 poses" in capsys.readouterr().out


def test_a_missing_file_is_one_clear_line_and_exit_code_2(dataset, capsys):
    assert report(dataset, estimates="nowhere.csv")[0] == 2
    message = capsys.readouterr().err
    assert "nowhere.csv" in message
    assert "Traceback" not in message


def test_it_says_what_the_library_says(dataset):
    from physpose_torch.bop.dataset import BopDataset
    from physpose_torch.bop.formats import read_estimates
    from physpose_torch.bop.scenes import BodyLibrary
    from physpose_torch.geometry.body import Plane
    from physpose_torch.report import physics_report
    from physpose_torch.scene import Scene

    estimates = read_estimates(dataset / "est.csv")
    plane = Plane(torch.as_tensor(UP), torch.tensor(OFFSET_MM / 1000, dtype=torch.float64))
    scene = Scene.tabletop([BodyLibrary(BopDataset(dataset)).model(9)], plane)
    (expected,) = physics_report(estimates.T_camera_object[[1]], scene).to_dict()["objects"]
    (row,) = (row for row in report(dataset, "--quiet")[1]["rows"] if row["obj_id"] == 9)
    for key in ("penetration_static", "gap", "stability_margin"):
        assert row[f"{key}_mm"] == pytest.approx(1e3 * expected[key], abs=1e-3)
