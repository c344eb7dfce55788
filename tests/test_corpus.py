"""Whatever a file has become: a clear error, or its images listed and untouched; never a traceback, and no row is lost.

The slow variant prints how many were tried, and what came of them: ``pytest -m slow -s tests/test_corpus.py``.
"""

import collections
import json
import os
import re
import warnings

import numpy as np
import pytest
import torch
import trimesh
from bop_files import HEADER, OFFSET_MM, UP, csv_row, standing, write_models, write_scene
from corpus import mutated

from physpose_torch import reading
from physpose_torch.__main__ import main
from physpose_torch.errors import PhysPoseError
from physpose_torch.geometry.body import Body
from physpose_torch.geometry.resting import resting_poses
from physpose_torch.robot.arm import LOOK_ALONG, demo_arm
from physpose_torch.robot.environment import RobotEnvironment
from physpose_torch.robot.shapes import find_mesh

FEW = pytest.param(25, id="few")
MANY = pytest.param(1500, id="many", marks=pytest.mark.slow)
MESHES = ("ply", "obj", "stl", "glb", "off")


@pytest.fixture
def folder(tmp_path):
    """A dataset of two images, and the files that a refinement reads, by what they are."""
    write_models(tmp_path / "models")
    truth = {(2, 3): [(1, standing(-80, 0, 50)), (4, standing(60, 30, 15))], (2, 7): [(9, standing(0, 0, 35))]}
    write_scene(
        tmp_path / "test", 2, {im: [(o, T, 1.0) for o, T in rows] for (_, im), rows in truth.items()}, width=640
    )
    rows = [csv_row(s, im, o, 0.9, T) for (s, im), objects in truth.items() for o, T in objects]
    box = {
        "box_mm": [100, 100, 100],
        "label": "b",
        "poses": {"all": {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "t_mm": [0, 0, 3000]}},
    }
    plane = {"normal": UP.tolist(), "offset_mm": OFFSET_MM}
    files = {
        "estimates": "\n".join([HEADER, *rows]) + "\n",
        "planes": json.dumps({"2": {str(im): plane for _, im in truth}}),
        "statics": json.dumps({"statics": [box]}),
        "targets": json.dumps([{"scene_id": 2, "im_id": 3, "obj_id": 1, "inst_count": 1}]),
    }
    return tmp_path, {name: text.encode() for name, text in files.items()}


@pytest.mark.parametrize("count", [FEW, MANY])
@pytest.mark.parametrize("broken", ["estimates", "planes", "statics", "targets"])
def test_refine_refuses_lists_or_refines_and_loses_no_row(folder, broken, count, capsys, caplog):
    root, files = folder
    out = root / "out.csv"
    outcomes = collections.Counter()
    for seed in range(count):
        content = files | {broken: mutated(files[broken], seed)}
        for name, data in content.items():
            (root / f"{name}.txt").write_bytes(data)
        options = [x for name in ("planes", "statics", "targets") for x in (f"--{name}", str(root / f"{name}.txt"))]
        command = ["refine", str(root / "estimates.txt"), "--dataset", str(root), *options, "--out", str(out)]
        caplog.clear()
        try:
            code = main([*command, "--quiet", "--preset", "lm"])
        except SystemExit as stop:
            code = stop.code
        assert code in (0, 1, 2), f"seed {seed}"
        outcomes[code] += 1
        assert not list(root.glob("out.csv.*")), f"seed {seed}: something is left beside the result"
        if code == 2:
            assert not out.exists(), f"seed {seed}"
            continue
        assert code == 0 or caplog.records, f"seed {seed}: failed without saying why"
        old, new = (path.read_bytes().split(b"\n") for path in (root / "estimates.txt", out))
        assert len(old) == len(new), f"seed {seed}: rows were lost"
        out.unlink()
    assert sum(outcomes.values()) == count
    with capsys.disabled():
        if count > 100:
            names = {0: "refined", 1: "listed, untouched", 2: "refused"}
            told = ", ".join(f"{names[c]} {n}" for c, n in sorted(outcomes.items()))
            print(f"\n{broken}: {count} broken files: {told}; rows lost: 0")


def rows_of(change):
    """The text of a result file, by a change of its rows, each a list of seven fields."""

    def changed(text):
        rows = change([line.split(",") for line in text.split("\n")[1:-1]])
        return "\n".join([HEADER, *(",".join(row) for row in rows)]) + "\n"

    return changed


def metres(row):
    return [*row[:5], " ".join(str(float(x) / 1000) for x in row[5].split()), row[6]]


def huge(row):
    return [*row[:5], " ".join(f"{x}e30" for x in row[5].split()), row[6]]


SCRAMBLED = {
    "as it was": (0, lambda text: text),
    "columns in another order": (2, lambda text: "\n".join(",".join(x.split(",")[::-1]) for x in text.split("\n"))),
    "a header in another order": (2, lambda text: text.replace("obj_id,score", "score,obj_id")),
    "objects and scores swapped": (1, rows_of(lambda rows: [[*r[:2], r[3], r[2], *r[4:]] for r in rows])),
    "scenes and images swapped": (1, rows_of(lambda rows: [[r[1], r[0], *r[2:]] for r in rows])),
    "R and t swapped": (1, rows_of(lambda rows: [[*r[:4], r[5], r[4], r[6]] for r in rows])),
    "a column less": (1, rows_of(lambda rows: [r[:-1] for r in rows])),
    "a column more": (1, rows_of(lambda rows: [[*r, "0"] for r in rows])),
    "semicolons": (2, lambda text: text.replace(",", ";")),
    "decimal commas": (1, rows_of(lambda rows: [[x.replace(".", ",") for x in r] for r in rows])),
    "all in metres": (2, rows_of(lambda rows: [metres(r) for r in rows])),
    "one row in metres": (1, rows_of(lambda rows: [metres(rows[0]), *rows[1:]])),
    "huge values": (1, rows_of(lambda rows: [huge(r) for r in rows])),
    "one row twice": (0, rows_of(lambda rows: [rows[0], *rows])),
    "each row a hundred times": (0, rows_of(lambda rows: rows * 100)),
    "no row": (0, lambda text: HEADER + "\n"),
    "a header in the middle": (1, rows_of(lambda rows: [*rows[:1], HEADER.split(","), *rows[1:]])),
    "ids of twenty digits": (1, rows_of(lambda rows: [["9" * 20, *r[1:]] for r in rows])),
    "a million digits": (1, rows_of(lambda rows: [[*rows[0][:3], "1" * 10**6, *rows[0][4:]], *rows[1:]])),
    "all lines in one": (2, lambda text: text.replace("\n", ",")),
}


@pytest.mark.parametrize("kind", SCRAMBLED)
def test_scrambled_rows_are_refused_or_left_as_they_are(folder, kind, caplog, capsys):
    """A row of an image that is listed keeps its text, as does one that no image is told by."""
    root, files = folder
    code, change = SCRAMBLED[kind]
    text = change(files["estimates"].decode())
    (root / "est.csv").write_text(text)
    (root / "planes.json").write_bytes(files["planes"])
    options = ["--dataset", str(root), "--planes", str(root / "planes.json"), "--out", str(root / "out.csv")]
    assert main(["refine", str(root / "est.csv"), *options, "--json", str(root / "out.json"), "--quiet"]) == code
    told = capsys.readouterr().err
    assert max(map(len, told.split("\n"))) < 1000
    if code == 2:
        assert "est.csv" in told
        assert not (root / "out.csv").exists()
        return
    problems = json.loads((root / "out.json").read_text())["problems"]
    assert bool(problems) == bool(code)
    assert max(map(len, problems), default=0) < 1000
    named = {tuple(map(int, found)) for p in problems for found in re.findall(r"scene (\d+),? image (\d+)", p)}
    lines = {int(found) for p in problems for found in re.findall(r"line (\d+)", p)}
    old, new = text.split("\n"), (root / "out.csv").read_text().split("\n")
    assert len(old) == len(new)
    touched = {number for number, (a, b) in enumerate(zip(old, new, strict=True), 1) if a != b}
    assert bool(touched) == (code == 0 and kind != "no row") or kind.startswith(("one row", "a million", "a header"))
    listed = {number for number, row in enumerate(old, 1) if row.count(",") == 6 and tuple(map(str, row.split(",")[:2])) in
              {tuple(map(str, key)) for key in named}}  # fmt: skip
    assert not touched & (listed | lines)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "latin-1", "utf-8-sig", "cp037"])
@pytest.mark.parametrize("broken", ["estimates", "planes", "statics", "targets"])
def test_other_encodings_are_refused_and_named(folder, encoding, broken, capsys):
    root, files = folder
    for name, data in files.items():
        comment = data.replace(b"}", ', "é": 1}'.encode(), 1) if name != "estimates" else data.replace(b"0.9", "é".encode(), 1)
        text = (comment if name == broken else data).decode()
        (root / f"{name}.txt").write_bytes(text.encode(encoding if name == broken else "utf-8"))
    options = [x for name in ("planes", "statics", "targets") for x in (f"--{name}", str(root / f"{name}.txt"))]
    command = ["refine", str(root / "estimates.txt"), "--dataset", str(root), *options, "--out", str(root / "out.csv")]
    code = main([*command, "--quiet"])
    if encoding == "utf-8-sig":
        assert code == (broken == "estimates")
    else:
        assert code == 2
        assert re.search(rf"{broken}\.txt: (not UTF-8|no valid JSON|no BOP result)", capsys.readouterr().err)


@pytest.mark.parametrize("count", [FEW, MANY])
@pytest.mark.parametrize("kind", MESHES)
def test_meshes_are_refused_or_finite(tmp_path, kind, count, capsys):
    path = tmp_path / f"mesh.{kind}"
    trimesh.creation.box((0.1, 0.06, 0.04)).export(path)
    whole, outcomes = path.read_bytes(), collections.Counter()
    for seed in range(count):
        path.write_bytes(mutated(whole, seed))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of numpy and trimesh, while they read
            try:
                body = Body.from_hull(path, label="broken")
                assert np.isfinite(body.mesh.vertices).all(), f"seed {seed}"
                assert bool(resting_poses(body).height.isfinite().all()), f"seed {seed}"
                outcomes["read"] += 1
            except PhysPoseError:
                outcomes["refused"] += 1
    with capsys.disabled():
        if count > 100:
            print(f"\n{kind}: {count} broken files: {dict(outcomes)}")


@pytest.mark.parametrize("count", [FEW, MANY])
def test_robots_are_refused_or_finite(tmp_path, count, capsys):
    path = tmp_path / "arm.urdf"
    demo_arm(path)
    whole, outcomes = path.read_bytes(), collections.Counter()
    for seed in range(count):
        path.write_bytes(mutated(whole, seed))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                robot = RobotEnvironment.from_urdf(path, camera_link="camera", ignore_links=["camera"])
                statics, _ = robot(torch.tensor(LOOK_ALONG))
                outcomes["read"] += 1
            except PhysPoseError:
                outcomes["refused"] += 1
                continue
        assert all(bool(s.T_camera_body.isfinite().all()) for s in statics if s.T_camera_body is not None), (
            f"seed {seed}"
        )
    with capsys.disabled():
        if count > 100:
            print(f"\nurdf: {count} broken files: {dict(outcomes)}")


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "name", ["x" * 5000, "../" * 900 + "x", "pipe", "loop", "folder", "file:///dev/zero", "package://a", "\ud800"]
)
def test_meshes_of_a_robot_that_are_no_files_are_named(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    with pytest.raises(PhysPoseError, match="arm: no mesh"):
        find_mesh(name, tmp_path / "arm.urdf", where="arm")


@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", ["pipe", "loop", "device", "folder", "deep", "entities"])
def test_robots_that_are_no_files_are_refused_at_once(tmp_path, kind, monkeypatch):
    monkeypatch.setattr(reading, "PATIENCE", 0.05)
    path = tmp_path / "arm.urdf"
    make = {
        "pipe": lambda: os.mkfifo(path),
        "loop": lambda: path.symlink_to(path.name),
        "device": lambda: path.symlink_to("/dev/zero"),
        "folder": path.mkdir,
        "deep": lambda: path.write_text("<a>" * 200_000 + "</a>" * 200_000),
        "entities": lambda: path.write_text('<!DOCTYPE a [<!ENTITY b "bb">]><robot name="&b;"/>'),
    }
    make[kind]()
    with pytest.raises(PhysPoseError, match=r"arm\.urdf"):
        RobotEnvironment.from_urdf(path, camera_link="camera")


def test_a_mesh_is_told_what_is_wrong_with_it():
    whole = trimesh.creation.box((0.1, 0.06, 0.04))
    torn = trimesh.Trimesh(whole.vertices, np.where(whole.faces == 7, 9, whole.faces), process=False, validate=False)
    with pytest.raises(PhysPoseError, match="torn: a face names vertex 9, but the mesh has 8"):
        Body.from_hull(torn, label="torn")
    far = trimesh.Trimesh(np.where(whole.vertices > 0.04, 1e30, whole.vertices), whole.faces, process=False)
    with pytest.raises(PhysPoseError, match=r"torn: the mesh has coordinates up to 1e\+30 m"):
        Body.from_hull(far, label="torn")
