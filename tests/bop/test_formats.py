"""Result CSV, planes, statics and targets: what is read, what is kept, what is refused and how it is said."""

import json
import os

import numpy as np
import pytest
import torch
from bop_files import HEADER, csv_row, random_pose
from hypothesis import given, settings
from hypothesis import strategies as st

from physpose_torch.bop.formats import read_estimates, read_planes, read_statics, read_targets, write_estimates
from physpose_torch.errors import DataError, InvalidInputError

I9 = "1 0 0 0 1 0 0 0 1"
GOOD = f"48,1,2,0.5,{I9},10 20 800,0.25"


def test_rows_come_in_file_order_and_in_metres(write_csv, rng):
    poses = [random_pose(rng) for _ in range(3)]
    path = write_csv(*(csv_row(48 - i, i, 3 * i, 0.1 * i, T, time=-1) for i, T in enumerate(poses)))
    est = read_estimates(path)
    assert est.scene_id.tolist() == [48, 47, 46]
    assert est.im_id.tolist() == [0, 1, 2]
    assert est.obj_id.tolist() == [0, 3, 6]
    assert est.line.tolist() == [2, 3, 4]
    assert est.time.tolist() == [-1, -1, -1]
    assert est.score.tolist() == [0.0, 0.1, 0.2]
    assert est.T_camera_object.dtype == torch.float64
    expected = np.array(poses)
    expected[:, :3, 3] /= 1000
    np.testing.assert_allclose(est.T_camera_object, expected, atol=1e-12)
    assert len(est) == 3
    assert est.problems == ()


@pytest.mark.parametrize(
    "content",
    [
        f"{HEADER}\n{GOOD}\n{GOOD}\n",
        f"{GOOD}\n{GOOD}",
        f"\ufeff{HEADER}\r\n{GOOD}\r\n\r\n{GOOD}\r\n",
        f"\ufeff{GOOD}\n{GOOD}\n",
        f" scene_id , im_id,obj_id, score, R,t, time\n\n 48 , 1,2 , 0.5 ,  {I9} , 10  20\t800 , 0.25 \n   \n{GOOD}\n\n",
        f"{HEADER}\r{GOOD}\r{GOOD}",
    ],
)
def test_header_spaces_blank_lines_bom_and_line_ends_are_accepted_and_kept(tmp_path, content):
    path, out = tmp_path / "in.csv", tmp_path / "out.csv"
    path.write_bytes(content.encode())
    est = read_estimates(path)
    assert est.problems == ()
    assert est.obj_id.tolist() == [2, 2]
    assert est.time.tolist() == [0.25, 0.25]
    assert est.T_camera_object[:, :3, 3].tolist() == [[0.01, 0.02, 0.8]] * 2
    write_estimates(out, est, est.T_camera_object)
    assert out.read_bytes() == path.read_bytes()


def test_only_changed_rows_are_rewritten_and_read_back_exactly(write_csv, tmp_path, rng):
    rows = [csv_row(1, i, 5, "0.30000", random_pose(rng), time="1.50") for i in range(4)]
    est = read_estimates(write_csv(*rows))
    poses = est.T_camera_object.clone()
    poses[2, :3, 3] += torch.tensor([0.001, 1 / 3000, -0.0123])
    write_estimates(tmp_path / "out.csv", est, poses)
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert lines[0] == HEADER
    assert [lines[i] for i in (1, 2, 4)] == [rows[i] for i in (0, 1, 3)]
    assert lines[3] != rows[2]
    assert lines[3].split(",")[:4] == ["1", "2", "5", "0.30000"]
    assert lines[3].endswith(",1.50")
    np.testing.assert_allclose(read_estimates(tmp_path / "out.csv").T_camera_object, poses, atol=1e-15)


def test_added_time_goes_to_all_rows_of_the_image_and_unknown_time_stays(write_csv, tmp_path, rng):
    T = random_pose(rng)
    est = read_estimates(write_csv(*(csv_row(1, im, 5, 1, T, time) for im, time in ((1, 2.0), (2, -1), (1, 2.0)))))
    out = tmp_path / "out.csv"
    write_estimates(out, est, est.T_camera_object, time=np.array([0.5, 0.75, 0.5]))
    assert read_estimates(out).time.tolist() == [2.5, -1, 2.5]
    with pytest.raises(InvalidInputError, match="time differs within scene 1, image 1"):
        write_estimates(out, est, est.T_camera_object, time=np.array([0.5, 0.75, 0.6]))
    with pytest.raises(InvalidInputError, match="time has shape"):
        write_estimates(out, est, est.T_camera_object, time=np.array([0.5]))


BAD = {
    "fields": ("48,1,2,0.5,1 0 0", "5 fields, expected 7"),
    "too many fields": (GOOD + ",7", "8 fields, expected 7"),
    "scene": (GOOD.replace("48", "x"), "scene_id is 'x'"),
    "negative id": (GOOD.replace("48,1,2", "48,1,-2"), "obj_id is '-2'"),
    "huge id": (GOOD.replace("48,1,2", "48,1,99999999999999999999"), "obj_id"),
    "score": (GOOD.replace("0.5", "nan"), "score is 'nan', expected finite"),
    "R not numbers": (GOOD.replace("1 0 0 0 1", "1 0 0 0 one"), "R is"),
    "R count": (GOOD.replace(I9, "1 0 0"), "R has 3 numbers, expected 9"),
    "t count": (GOOD.replace("10 20 800", "10 20"), "t has 2 numbers"),
    "t inf": (GOOD.replace("800", "inf"), "t is '10 20 inf'"),
    "time": (GOOD.replace("0.25", ""), "time has 0 numbers"),
    "mirror": (GOOD.replace(I9, "1 0 0 0 1 0 0 0 -1"), "not a rotation: det = -1"),
    "scaled": (GOOD.replace(I9, "1.02 0 0 0 1.02 0 0 0 1.02"), "not a rotation: det = 1.061"),
    "zero": (GOOD.replace(I9, "0 0 0 0 0 0 0 0 0"), "not a rotation: det = 0"),
    "behind": (GOOD.replace("800", "-800"), "behind the camera"),
    "metres": (GOOD.replace("10 20 800", "0.01 0.02 0.8"), "is it in metres"),
    "far": (GOOD.replace("800", "800000"), "farther than 100 m"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_rows_are_reported_kept_verbatim_and_do_not_stop_the_others(tmp_path, name):
    bad, message = BAD[name]
    path, out = tmp_path / "in.csv", tmp_path / "out.csv"
    path.write_text(f"{HEADER}\n{GOOD}\n{bad}\n{GOOD}\n")
    est = read_estimates(path)
    assert est.line.tolist() == [2, 4]
    (problem,) = est.problems
    assert (problem.line, problem.im_id) == (3, 1)
    assert problem.scene_id == (None if name == "scene" else 48)
    assert f"{path}, line 3" in problem.message
    assert message in problem.message
    assert "correct or remove the row" in problem.message
    poses = est.T_camera_object.clone()
    poses[:, 2, 3] += 0.1
    write_estimates(out, est, poses)
    lines = out.read_text().splitlines()
    assert lines[2] == bad
    assert lines[1] == lines[3] == f"48,1,2,0.5,{' '.join(str(float(x)) for x in I9.split())},10.0 20.0 900.0,0.25"


def test_a_rotation_that_is_slightly_off_is_projected_but_its_text_is_kept(tmp_path):
    path, out = tmp_path / "in.csv", tmp_path / "out.csv"
    path.write_text(GOOD.replace(I9, "1.003 0.002 0 0 0.998 0 0.001 0 1"))
    est = read_estimates(path)
    R = est.T_camera_object[0, :3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-14, rtol=0)
    torch.testing.assert_close(R, torch.eye(3, dtype=torch.float64), atol=2e-3, rtol=0)
    write_estimates(out, est, est.T_camera_object)
    assert out.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        (b"", "empty"),
        (b"\xef\xbb\xbf \r\n", "empty"),
        (b"\xff\xfe\x00scene_id", "not UTF-8"),
        (b"%PDF-1.4 hello", "no BOP result CSV"),
        (b"scene_id,im_id,obj_id,score,R,t\n1,2,3,4,5,6\n", "the header is"),
        (b"scene_id;im_id;obj_id;score;R;t;time\n", "no BOP result CSV"),
        (
            f"{GOOD.replace('10 20 800', '0.01 0.02 0.8')}\n{GOOD.replace('800', '0.9')}\n".encode(),
            "multiply t by 1000",
        ),
    ],
)
def test_files_that_are_no_csv_in_millimetres_are_refused(tmp_path, content, message):
    path = tmp_path / "est.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=message) as error:
        read_estimates(path)
    assert str(path) in str(error.value)


def test_a_file_with_only_a_header_gives_nothing_and_is_written_back(tmp_path):
    path, out = tmp_path / "est.csv", tmp_path / "out.csv"
    path.write_text(HEADER)
    est = read_estimates(path)
    assert len(est) == 0
    assert est.T_camera_object.shape == (0, 4, 4)
    write_estimates(out, est, est.T_camera_object)
    assert out.read_text() == HEADER


def test_a_file_of_only_broken_rows_gives_no_rows_and_their_problems(tmp_path):
    path = tmp_path / "est.csv"
    path.write_text(f"{HEADER}\n{GOOD.replace('800', 'nan')}\n")
    est = read_estimates(path)
    assert len(est) == 0
    assert len(est.problems) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda T: T[:1], "expected \\(2, 4, 4\\)"),
        (lambda T: T * torch.nan, r"poses\[0\]: R is not a rotation"),
        (lambda T: T * 1.1, r"poses\[0\]: R is not a rotation: det = 1.331"),
        (lambda T: T + torch.nn.functional.pad(torch.full((3, 1), 900.0), (3, 0, 0, 1)), "farther than 100 m.*metres"),
    ],
)
def test_poses_that_cannot_be_meant_are_not_written(write_csv, tmp_path, change, message):
    est = read_estimates(write_csv(GOOD, GOOD))
    with pytest.raises(InvalidInputError, match=message):
        write_estimates(tmp_path / "out.csv", est, change(est.T_camera_object))
    assert not list(tmp_path.glob("*out*"))


def test_writing_replaces_in_one_step_and_leaves_nothing_behind(write_csv, tmp_path, monkeypatch):
    path = write_csv(GOOD)
    est = read_estimates(path)
    write_estimates(path, est, est.T_camera_object)  # onto itself
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    poses = est.T_camera_object.clone()
    poses[:, 2, 3] += 1
    with pytest.raises(DataError, match=r"est\.csv: cannot be written \(disk full\)"):
        write_estimates(path, est, poses)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    with pytest.raises(InvalidInputError, match="does not exist"):
        write_estimates(tmp_path / "no" / "out.csv", est, poses)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_whatever_the_file_holds_reading_gives_rows_problems_or_a_data_error(tmp_path_factory, data):
    field = st.sampled_from(
        ["48", "1", "", " ", "nan", "1e400", "0.5", I9, "10 20 800", "-1", "\ufeff", "\x00", "٣", "x"]
    )
    rows = data.draw(st.lists(st.lists(field, min_size=1, max_size=9).map(",".join) | st.just(GOOD), max_size=6))
    content = data.draw(st.sampled_from(["", HEADER + "\n"])) + data.draw(st.sampled_from(["\n", "\r\n"])).join(rows)
    path = tmp_path_factory.getbasetemp() / "fuzz.csv"
    path.write_bytes(content.encode())
    try:
        est = read_estimates(path)
    except DataError:
        return
    assert torch.isfinite(est.T_camera_object).all()
    write_estimates(path, est, est.T_camera_object)
    assert path.read_bytes() == content.encode()


NORMAL = [0.0, -0.6, -0.8]


def planes(tmp_path, entry):
    path = tmp_path / "planes.json"
    path.write_text(json.dumps({"48": {"1": entry, "36": {"normal": NORMAL, "offset_mm": -500}}}))
    return read_planes(path)


def test_a_plane_is_read_as_normal_and_offset_in_metres(tmp_path):
    found, problems = planes(tmp_path, {"normal": NORMAL, "offset_mm": -812.5, "sigma_deg": 1.5, "sigma_mm": 8, "x": 1})
    assert problems == []
    assert list(found) == [(48, 1), (48, 36)]
    record = found[48, 1]
    assert record.normal.tolist() == pytest.approx(NORMAL)
    assert record[1:] == (-0.8125, 1.5, 0.008)
    assert found[48, 36][2:] == (None, None)


@pytest.mark.parametrize("flat", [False, True])
def test_a_plane_is_read_from_the_pose_of_a_table_in_metres(tmp_path, flat):
    R = np.stack([np.cross([0, -0.8, 0.6], NORMAL), [0, -0.8, 0.6], NORMAL], axis=1)
    point = np.array([0.1, 0.2, 0.9])
    found, problems = planes(tmp_path, {"R": R.flatten().tolist() if flat else R.tolist(), "t": point.tolist()})
    assert problems == []
    assert found[48, 1].normal.tolist() == pytest.approx(NORMAL)
    assert found[48, 1].offset == pytest.approx(np.dot(NORMAL, point))


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"normal": [0, 0.6, 0.8], "offset_mm": 500}, "negate both"),
        ({"normal": [0, -0.6, -0.9], "offset_mm": -500}, "length 1.082"),
        ({"normal": NORMAL, "offset_mm": -0.5}, "in millimetres"),
        ({"normal": NORMAL, "offset_mm": float("nan")}, "offset_mm"),
        ({"normal": NORMAL, "offset_mm": True}, "offset_mm"),
        ({"normal": NORMAL, "offset_mm": 10**400}, "offset_mm"),
        ({"normal": NORMAL}, "'offset_mm' is None, expected 1 finite number"),
        ({"normal": NORMAL[:2], "offset_mm": -500}, "expected 3 finite numbers"),
        ({"normal": "up", "offset_mm": -500}, "expected 3 finite numbers"),
        ({"normal": NORMAL, "offset_mm": -500, "sigma_deg": 0}, "sigma_deg is 0, expected a positive"),
        ({"normal": NORMAL, "offset_mm": -500, "sigma_mm": "8"}, "sigma_mm"),
        ({"R": np.eye(3).tolist(), "t": [0, 0, 1]}, "negate both"),
        ({"R": (-np.eye(3)).tolist(), "t": [0, 0, 1]}, "not a rotation"),
        ({"R": np.diag([1.0, -1, -1]).tolist(), "t": [0, 0, 900]}, '"t" in metres'),
        ({}, "expected either"),
        (None, "expected either"),
        ([1, 2], "expected either"),
        ({"normal": NORMAL, "offset_mm": -500, "R": 1}, "expected either"),
    ],
)
def test_a_broken_plane_is_a_problem_of_its_image_only(tmp_path, entry, message):
    found, (problem,) = planes(tmp_path, entry)
    assert list(found) == [(48, 36)]
    assert problem[:3] == (None, 48, 1)
    assert "planes.json, scene 48, image 1: " in problem.message
    assert message in problem.message


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "empty"),
        ("[1]", "expected an object with ids as keys"),
        ('{"48": 3}', "scene 48: expected an object"),
        ('{"table": {}}', "key 'table' is not an id"),
        ('{"48": {"1": {}, "1": {}}}', "key '1' appears twice"),
        ('{"48": {"1": {}, "001": {}}}', "id 1 appears twice"),
        ('{"48": {', "no valid JSON"),
        ("[" * 100_000, "no valid JSON"),
        ("1" * 5000, "no valid JSON"),
    ],
)
def test_a_broken_planes_file_is_refused(tmp_path, content, message):
    path = tmp_path / "planes.json"
    path.write_text(content)
    with pytest.raises(DataError, match=message):
        read_planes(path)


def statics(tmp_path, *entries):
    (tmp_path / "sub").mkdir(exist_ok=True)
    (tmp_path / "sub" / "table.ply").write_text("ply")
    (tmp_path / "secret.ply").write_text("ply")
    path = tmp_path / "sub" / "statics.json"
    path.write_text(json.dumps({"statics": entries}))
    return read_statics(path)


POSE = {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "t_mm": [0, 100, 900]}


def test_statics_are_meshes_and_boxes_with_poses_in_metres(tmp_path):
    other = {"R": np.diag([1, -1, -1]).tolist(), "t_mm": [0, 0, 500]}
    mesh, box = statics(
        tmp_path,
        {"mesh": "table.ply", "poses": {"all": POSE, "48": {"all": other, "3": POSE}}},
        {"box_mm": [800, 600, 30], "label": "tray", "poses": {"48": {"1": POSE}}},
    )
    assert mesh.mesh == (tmp_path / "sub" / "table.ply").resolve()
    assert (mesh.label, mesh.scale, mesh.box) == ("table", 0.001, None)
    assert mesh.pose(7, 7)[:3, 3].tolist() == [0, 0.1, 0.9]
    assert mesh.pose(48, 7)[:3, 3].tolist() == [0, 0, 0.5]
    assert mesh.pose(48, 3)[:3, 3].tolist() == [0, 0.1, 0.9]
    assert (box.label, box.scale, box.mesh, box.box) == ("tray", 1.0, None, pytest.approx((0.8, 0.6, 0.03)))
    assert box.pose(48, 1) is not None
    assert box.pose(48, 2) is None


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"mesh": "../secret.ply", "poses": {"all": POSE}}, "leaves the folder"),
        ({"mesh": "/etc/passwd", "poses": {"all": POSE}}, "leaves the folder"),
        ({"mesh": "none.ply", "poses": {"all": POSE}}, "is not in"),
        ({"mesh": "table.ply", "scale": 0, "poses": {"all": POSE}}, "must be positive"),
        ({"box_mm": [1, 2], "poses": {"all": POSE}}, "expected 3 finite numbers"),
        ({"box_mm": [1, 2, -3], "poses": {"all": POSE}}, "must be positive"),
        ({"box_mm": [1, 2, 3]}, 'expected "poses"'),
        ({"box_mm": [1, 2, 3], "poses": {"48": 5}}, "expected"),
        ({"box_mm": [1, 2, 3], "poses": {"48": {"x": POSE}}}, "'48': 'x'"),
        ({"box_mm": [1, 2, 3], "poses": {"all": {"R": POSE["R"]}}}, "scene all, image all: 't_mm' is None"),
        ({"box_mm": [1, 2, 3], "poses": {"48": {"1": {**POSE, "R": [1] * 9}}}}, "image 1: R is not a rotation"),
        (7, "expected"),
    ],
)
def test_broken_statics_are_refused_by_number(tmp_path, entry, message):
    good = {"box_mm": [1, 2, 3], "poses": {"all": POSE}}
    with pytest.raises(DataError, match=r"statics.json, statics\[1\]") as error:
        statics(tmp_path, good, entry)
    assert message in str(error.value)


def test_targets_are_read_in_order(tmp_path):
    path = tmp_path / "targets.json"
    entries = [{"scene_id": 2, "im_id": 5, "obj_id": o, "inst_count": 1} for o in (9, 4)]
    path.write_text(json.dumps(entries))
    assert [tuple(target) for target in read_targets(path)] == [(2, 5, 9, 1), (2, 5, 4, 1)]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "expected a list"),
        ([{"scene_id": 2, "im_id": 5}], "entry 0: expected integers"),
        ([{"scene_id": 2, "im_id": 5, "obj_id": 1, "inst_count": 1.5}], "entry 0"),
        ([{"scene_id": 2, "im_id": 5, "obj_id": 1, "inst_count": 1}] * 2, "entry 1.*listed twice"),
    ],
)
def test_broken_targets_are_refused(tmp_path, content, message):
    path = tmp_path / "targets.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=message):
        read_targets(path)


@pytest.mark.data
def test_the_official_megapose_file_and_the_oracle_planes_are_read_and_written_back(ycbv, tmp_path):
    path = ycbv / "estimates" / "megapose_ycbv-test.csv"
    est = read_estimates(path)
    assert len(est) == 3196
    assert est.problems == ()
    write_estimates(tmp_path / "out.csv", est, est.T_camera_object)
    assert (tmp_path / "out.csv").read_bytes() == path.read_bytes()
    found, problems = read_planes(ycbv / "table_planes.json")
    assert len(found) == 600
    assert problems == []
