"""Convex decomposition: how many parts, how far off, and that nothing a child process or a disk does can break it."""

import logging
import os
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from physpose_torch.errors import BackendError, DataError, InvalidInputError
from physpose_torch.geometry import decompose as module
from physpose_torch.geometry.cover import MIN_THICKNESS, Surface
from physpose_torch.geometry.decompose import DecomposeOptions, decompose, decompose_many
from physpose_torch.geometry.hulls import fewest_parts


@pytest.fixture(autouse=True)
def cache_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "_warned", set())
    return tmp_path / "cache" / "decompose"


def box(extents=(0.1, 0.06, 0.04), centre=(0, 0, 0)):
    return trimesh.creation.box(extents, transform=trimesh.transformations.translation_matrix(centre))


def l_shape():
    """An L of two bars, one closed surface."""
    outline = np.array([[0, 0], [0.1, 0], [0.1, 0.03], [0.03, 0.03], [0.03, 0.1], [0, 0.1]])
    flat = [[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]]
    vertices = np.concatenate([np.c_[outline, np.zeros(6)], np.c_[outline, np.full(6, 0.03)]])
    sides = [[[i, (i + 1) % 6, (i + 1) % 6 + 6], [i, (i + 1) % 6 + 6, i + 6]] for i in range(6)]
    faces = (
        [[a, c, b] for a, b, c in flat]
        + [[a + 6, b + 6, c + 6] for a, b, c in flat]
        + [face for side in sides for face in side]
    )
    return trimesh.Trimesh(vertices, faces)


def depth_inside(hulls, points):
    """How deep each point lies in the union of the hulls [m]; negative outside."""
    equations = [ConvexHull(h).equations for h in hulls]
    return np.max([-(points @ e[:, :3].T + e[:, 3]).max(1) for e in equations], axis=0)


def assert_sound(hulls, limit=32):
    for hull in hulls:
        assert hull.dtype == np.float64
        assert hull.ndim == 2
        assert len(hull) <= limit
        qhull = ConvexHull(hull)
        assert qhull.volume > 0
        assert len(qhull.vertices) == len(hull)  # convex position


def test_box_is_one_part_with_its_eight_corners():
    mesh = box()
    hulls, report = decompose(mesh)
    assert (report.method, report.n_parts, len(hulls)) == ("convex", 1, 1)
    assert sorted(map(tuple, hulls[0].round(9))) == sorted(map(tuple, mesh.vertices.round(9)))
    assert max(report.outward_p95, report.inward_max) < 1e-8


def test_cylinder_is_one_part_and_keeps_its_support():
    mesh = trimesh.creation.cylinder(0.034, 0.1, sections=64)
    hulls, report = decompose(mesh)
    assert_sound(hulls)
    assert report.n_parts == 1
    assert report.outward_p95 < 1e-3
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    error = (mesh.vertices @ directions.T).max(0) - (hulls[0] @ directions.T).max(0)
    assert np.abs(error).max() < 1e-3


def test_l_shape_is_two_parts():
    mesh = l_shape()
    assert mesh.is_volume
    hulls, report = decompose(mesh)
    assert_sound(hulls)
    assert (report.method, report.n_parts) == ("coacd", 2)
    assert max(report.outward_p95, report.inward_p95) < 1e-3
    assert depth_inside(hulls, np.array([[0.07, 0.07, 0.015]]))[0] < -0.02  # the notch is free
    assert depth_inside(hulls, np.array([[0.08, 0.015, 0.015], [0.015, 0.08, 0.015]])).min() > 0.01


def test_torus_keeps_its_hole():
    hulls, report = decompose(trimesh.creation.torus(0.04, 0.012, major_sections=32, minor_sections=16))
    assert_sound(hulls)
    assert report.method == "coacd"
    assert report.outward_p95 < 2e-3
    assert depth_inside(hulls, np.zeros((1, 3)))[0] < -0.02


def test_open_bowl_keeps_its_hollow():
    bowl = trimesh.creation.icosphere(2, radius=0.05)
    bowl.update_faces(bowl.triangles_center[:, 2] < 0)
    assert not bowl.is_watertight
    hulls, report = decompose(bowl, DecomposeOptions(tolerance=8e-3, max_hulls=8))
    assert_sound(hulls, 32)
    assert report.method == "coacd"
    assert depth_inside(hulls, np.array([[0, 0, -0.01], [0.015, 0, -0.02]])).max() < -0.01


@pytest.mark.parametrize("damage", ["hole", "doubled", "unmerged"])
def test_damaged_box_is_still_one_part(damage):
    mesh = box()
    if damage == "hole":
        mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    elif damage == "doubled":
        mesh = trimesh.Trimesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:, ::-1]]), process=False)
    else:
        mesh = trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    hulls, report = decompose(mesh)
    assert (report.method, len(hulls), len(hulls[0])) == ("convex", 1, 8)


def test_thin_plate_has_a_volume():
    hulls, _ = decompose(box((0.1, 0.1, 1e-5)))
    assert_sound(hulls)
    assert np.ptp(hulls[0], axis=0).min() == pytest.approx(MIN_THICKNESS, rel=1e-3)


def test_no_more_vertices_than_asked_for():
    hulls, _ = decompose(trimesh.creation.icosphere(3, radius=0.02), DecomposeOptions(max_vertices=12))
    assert_sound(hulls, 12)


CRASH = [sys.executable, "-c", "import os; os.abort()"]
HANG = [sys.executable, "-c", "import time; time.sleep(60)"]


@pytest.mark.parametrize(("command", "reason"), [(CRASH, "ended with code"), (HANG, "stopped after")])
def test_failing_child_falls_back_to_the_hull_and_is_not_cached(monkeypatch, cache_folder, command, reason):
    monkeypatch.setattr(module, "_child_command", command)
    with pytest.warns(UserWarning, match=reason):
        hulls, report = decompose(l_shape(), DecomposeOptions(time_limit_s=1), name="bracket")
    assert (report.method, report.n_parts) == ("hull", 1)
    assert "bracket" in report.warning
    assert report.seconds < 20
    assert_sound(hulls)
    assert not list(cache_folder.rglob("*.npz"))
    monkeypatch.undo()
    monkeypatch.setenv("PHYSPOSE_CACHE", str(cache_folder.parent))
    assert decompose(l_shape()).report.method == "coacd"


def test_fallback_is_warned_of_once_per_mesh(monkeypatch):
    monkeypatch.setattr(module, "_child_command", CRASH)
    with pytest.warns(UserWarning, match="bracket") as caught:
        reports = [decompose(l_shape(), name="bracket").report for _ in range(2)]
    assert len(caught) == 1
    assert all("bracket" in report.warning for report in reports)  # but every report says so
    other = l_shape()
    other.apply_scale(1.1)
    with pytest.warns(UserWarning, match="other"):
        decompose(other, name="other")


def test_stopping_early_ends_the_children_promptly(monkeypatch, tmp_path):
    code = f"import os, time; open({str(tmp_path)!r} + '/pid', 'w').write(str(os.getpid())); time.sleep(60)"
    monkeypatch.setattr(module, "_child_command", [sys.executable, "-c", code])
    start, results = time.monotonic(), decompose_many({"box": box(), "l": l_shape()}, workers=2)
    assert next(results)[0] == "box"
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
        time.sleep(0.05)
    results.close()  # what Ctrl-C does to the loop over them
    assert time.monotonic() - start < 15
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_ctrl_c_while_merging_stops_it(monkeypatch):
    stop = threading.Event()
    stop.set()
    surface = Surface(l_shape().triangles, solid=True)
    with pytest.raises(BackendError, match="stopped"):
        fewest_parts([box().vertices] * 3, surface, tolerance=1e-3, max_hulls=8, max_vertices=32, stop=stop)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("tolerance", 0),
        ("tolerance", float("nan")),
        ("tolerance", "1 mm"),
        ("max_hulls", 0),
        ("max_hulls", 2.5),
        ("max_vertices", 3),
        ("max_faces", -1),
        ("time_limit_s", -1),
        ("seed", True),
    ],
)
def test_bad_option_is_named(field, value):
    with pytest.raises(InvalidInputError, match=f"{field} = {value!r}, expected"):
        DecomposeOptions(**{field: value})


def test_same_input_same_output():
    first, second = decompose(l_shape(), cache=False), decompose(l_shape(), cache=False)
    assert len(first.hulls) == len(second.hulls)
    for a, b in zip(first.hulls, second.hulls, strict=True):
        np.testing.assert_array_equal(a, b)


def test_second_call_reads_the_cache_whatever_the_order_of_triangles(monkeypatch):
    mesh = l_shape()
    first = decompose(mesh)
    monkeypatch.setattr(module, "_cut", None)  # calling it would fail
    order = np.random.default_rng(0).permutation(len(mesh.faces))
    soup = trimesh.Trimesh(mesh.triangles[order].reshape(-1, 3) + 1e-12, np.arange(3 * len(order)).reshape(-1, 3))
    second = decompose(soup)
    assert second.report == first.report
    np.testing.assert_array_equal(np.concatenate(first.hulls), np.concatenate(second.hulls))
    with pytest.raises(TypeError):
        decompose(mesh, DecomposeOptions(seed=1))


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 torn"])
def test_corrupt_cache_file_is_computed_anew(cache_folder, content):
    first = decompose(box())
    (file,) = cache_folder.glob("*.npz")
    file.write_bytes(content)
    second = decompose(box())
    np.testing.assert_array_equal(first.hulls[0], second.hulls[0])
    with np.load(file) as data:
        assert len(data["vertices"]) == 8


def test_unwritable_cache_works_and_says_so(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path / "file"))  # a file where a folder should be: fails for root too
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        assert decompose(box()).report.n_parts == 1
    assert "PHYSPOSE_CACHE" in caplog.text


def test_concurrent_writers_leave_one_good_file(cache_folder):
    start, results = threading.Barrier(4), []

    def work():
        start.wait()
        results.append(decompose(box()))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    assert [f.suffix for f in cache_folder.iterdir()] == [".npz"]
    assert decompose(box()).report.n_parts == 1


def test_many_meshes_and_a_bad_one_does_not_stop_the_others(tmp_path):
    box().export(tmp_path / "box.stl")
    meshes = {
        "box": tmp_path / "box.stl",
        "l": l_shape,
        "can": trimesh.creation.cylinder(0.03, 0.1),
        "bad": Path("no.ply"),
    }
    results = dict(decompose_many(meshes, workers=2))
    assert results.keys() == meshes.keys()
    assert isinstance(results.pop("bad"), Exception)
    assert {name: r.report.n_parts for name, r in results.items()} == {"box": 1, "l": 2, "can": 1}


def test_script_without_main_guard(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent("""
        import sys, trimesh
        from physpose_torch.geometry.decompose import decompose
        ring = trimesh.creation.annulus(0.02, 0.03, 0.02, sections=12)
        print(decompose(ring).report.method)
        """)
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.strip() == "coacd", done.stderr


@pytest.mark.parametrize(
    ("mesh", "error", "message"),
    [
        (trimesh.Trimesh(), DataError, "0 faces"),
        (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False), DataError, "NaN"),
        (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), DataError, "flat"),
        (box((100, 60, 40)), InvalidInputError, "scale=0.001"),
        (box((1e-4, 1e-4, 1e-4)), InvalidInputError, "metres"),
    ],
)
def test_bad_mesh_is_named(mesh, error, message):
    with pytest.raises(error, match=message) as caught:
        decompose(mesh, name="obj_000001.ply")
    assert "obj_000001.ply" in str(caught.value)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.timeout(1800)
def test_ycbv_models():
    data = os.environ.get("PHYSPOSE_DATA")
    if not data:
        pytest.skip("PHYSPOSE_DATA is not set")

    def loader(path):
        return lambda: trimesh.load_mesh(path, process=False).apply_scale(1e-3)

    meshes = {path.stem: loader(path) for path in sorted(Path(data, "ycbv", "models").glob("*.ply"))}
    assert len(meshes) == 21
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    for name, result in decompose_many(meshes):
        hulls, report = result
        assert_sound(hulls)
        assert report.method in ("convex", "coacd"), name
        assert report.outward_p95 < 1e-3, name
        assert report.inward_p95 < 1.2e-3, name
        assert len(hulls) <= 128, name
        support = (meshes[name]().vertices @ directions.T).max(0) - (np.concatenate(hulls) @ directions.T).max(0)
        assert np.abs(support).max() < 1e-3, name
