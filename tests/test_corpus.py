"""Whatever a file has become: a clear error, or its images listed and untouched; never a traceback, and no row is lost.

The slow variant prints how many were tried, and what came of them: ``pytest -m slow -s tests/test_corpus.py``.
"""

import collections
import json
import warnings

import numpy as np
import pytest
import torch
import trimesh
from bop_files import HEADER, OFFSET_MM, UP, csv_row, standing, write_models, write_scene
from corpus import mutated

from physpose_torch.__main__ import main
from physpose_torch.errors import PhysPoseError
from physpose_torch.geometry.body import Body
from physpose_torch.geometry.resting import resting_poses
from physpose_torch.robot.arm import LOOK_ALONG, demo_arm
from physpose_torch.robot.environment import RobotEnvironment

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


def test_a_mesh_is_told_what_is_wrong_with_it():
    whole = trimesh.creation.box((0.1, 0.06, 0.04))
    torn = trimesh.Trimesh(whole.vertices, np.where(whole.faces == 7, 9, whole.faces), process=False, validate=False)
    with pytest.raises(PhysPoseError, match="torn: a face names vertex 9, but the mesh has 8"):
        Body.from_hull(torn, label="torn")
    far = trimesh.Trimesh(np.where(whole.vertices > 0.04, 1e30, whole.vertices), whole.faces, process=False)
    with pytest.raises(PhysPoseError, match=r"torn: the mesh has coordinates up to 1e\+30 m"):
        Body.from_hull(far, label="torn")
