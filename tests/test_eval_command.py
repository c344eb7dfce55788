"""``physpose eval``: what it prints and writes, for the truth, for planted errors, and for files with flaws."""

import json

import numpy as np
import pytest
import trimesh
from bop_files import HEADER, OBJECTS, K, csv_row, write_depth, write_models, write_scene
from PIL import Image

from physpose_torch.__main__ import main

UP = np.array([0.0, -1, 0])
TABLE = 100.0  # the table is this far under the camera's axis [mm]
HEIGHT = {1: 50, 4: 15, 9: 35}  # of an object's centre when it stands [mm]
TRUTH = {
    (2, 3): [(1, -80, 700), (4, 60, 650)],
    (2, 7): [(9, 0, 600)],
    (5, 1): [(1, 30, 800)],
}


def standing(obj_id, x, z, above=0.0):
    """T_camera_object [mm] of an object on the table, its z axis up."""
    T = np.eye(4)
    T[:3, :3] = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    T[:3, 3] = [x, TABLE - HEIGHT[obj_id] - above, z]
    return T


def farther(T, mm):
    T = T.copy()
    T[:3, 3] += T[:3, 3] / np.linalg.norm(T[:3, 3]) * mm
    return T


def rows(move=lambda T: T):
    return [csv_row(s, im, o, 0.9, move(standing(o, x, z))) for (s, im), all_ in TRUTH.items() for o, x, z in all_]


@pytest.fixture
def root(tmp_path):
    root = tmp_path / "data"
    write_models(root / "models")
    for scene in (2, 5):
        images = {
            im: [(o, standing(o, x, z), 1.0) for o, x, z in all_] for (s, im), all_ in TRUTH.items() if s == scene
        }
        write_scene(root / "test", scene, images, width=640)
    plane = {"normal": UP.tolist(), "offset_mm": -TABLE}
    planes = {"2": {"3": plane, "7": plane}, "5": {"1": plane}}
    (root / "planes.json").write_text(json.dumps(planes))
    return root


@pytest.fixture
def run(root, capsys):
    """Evaluate rows: exit code, what was printed, what was written."""

    def run(lines, *more):
        (root / "est.csv").write_text("\n".join([HEADER, *lines]) + "\n")
        out = root / "scores.json"
        code = main(["eval", str(root / "est.csv"), "--dataset", str(root), "--json", str(out), *map(str, more)])
        printed = capsys.readouterr()
        return code, printed.out + printed.err, json.loads(out.read_text()) if code < 2 else None

    return run


def depth_of(scene, im):
    """What the camera sees of the boxes, (H, W) [m]; the background is unknown."""
    boxes = [
        trimesh.creation.box(extents=OBJECTS[o][0]).apply_transform(standing(o, x, z)).apply_scale(1e-3)
        for o, x, z in TRUTH[scene, im]
    ]
    v, u = np.mgrid[:480, :640].reshape(2, -1)
    rays = np.stack([u, v, np.ones_like(u)], 1) @ np.linalg.inv(np.reshape(K, (3, 3))).T
    tracer = trimesh.ray.ray_pyembree.RayMeshIntersector(trimesh.util.concatenate(boxes))
    hits, index, _ = tracer.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    depth = np.zeros(480 * 640)
    depth[index] = hits[:, 2]
    return depth.reshape(480, 640)


def add_depth(root, *images):
    return [write_depth(root / "test" / f"{s:06d}", im, depth_of(s, im)) for s, im in images or TRUTH]


def column(text, name):
    """The numbers of a column of the table, by row."""
    lines = text.splitlines()
    head = next(k for k, line in enumerate(lines) if "AR_MSSD" in line)
    end = lines[head].index(name) + len(name)
    table = lines[head + 2 : lines.index("", head)]
    return {line[:10].strip(): line[:end].split()[-1] for line in table}


def test_the_truth_scores_one_in_every_column(root, run):
    add_depth(root)
    code, text, scores = run(rows())
    assert code == 0
    names = {"all", "scene 2", "scene 5", "object 1", "object 4", "object 9"}
    for name in ("AR_VSD", "AR_MSSD", "AR_MSPD"):
        assert column(text, name) == dict.fromkeys(names, "1.000")
    assert column(text, "targets")["all"] == "4"
    assert "AR 1.000, the mean of AR_VSD, AR_MSSD and AR_MSPD" in text
    assert "over all targets" in text
    assert "with depth" not in text
    assert [scores[k] for k in ("ar", "ar_vsd", "ar_mssd", "ar_mspd", "targets")] == [1, 1, 1, 1, 4]
    assert scores["per_object"]["1"] == {"ar_mssd": 1, "ar_mspd": 1, "targets": 2, "ar_vsd": 1, "vsd_targets": 2}
    assert scores["recall_vsd"]["0.05"]["0.5"] == scores["recall_mssd"]["0.05"] == scores["recall_mspd"]["5.0"] == 1
    assert scores["errors"]["rows"] == 4


def test_without_depth_images_there_is_no_vsd_and_a_line_says_what_to_do(run):
    code, text, scores = run(rows())
    assert code == 0
    assert "AR_VSD" not in text
    assert "No VSD: no image with targets has a depth image;\n--vsd-depth rendered" in text
    assert "No VSD" in scores["vsd_note"]
    assert max(map(len, text.splitlines())) <= 80
    assert (scores["ar"], scores["ar_vsd"], scores["recall_vsd"]) == (None, None, None)
    code, text, scores = run(rows(), "--vsd-depth", "none")
    assert "VSD" not in text
    assert scores["vsd_note"] == ""


def test_with_some_depth_images_it_says_over_how_many_targets(root, run):
    add_depth(root, (2, 3))
    code, text, scores = run(rows())
    assert code == 0
    for place in (text, scores["vsd_note"]):
        assert "VSD over 2 of 4 targets only, those of the 1 of 3 images" in place
    assert column(text, "AR_VSD") == {
        "all": "1.000", "scene 2": "1.000", "scene 5": "-", "object 1": "1.000", "object 4": "1.000", "object 9": "-",
    }  # fmt: skip
    assert column(text, "with depth")["all"] == "2"
    assert column(text, "with depth")["object 9"] == "0"
    assert "AR 1.000" not in text
    assert scores["ar"] is None
    assert scores["vsd"] == {"depth": "auto", "targets": 2, "images": 1}


def test_rendered_depth_says_so_everywhere(run):
    code, text, scores = run(rows(), "--vsd-depth", "rendered")
    assert code == 0
    assert "VSD on rendered depth" in text
    assert max(map(len, text.splitlines())) <= 80
    assert "VSD on rendered depth" in scores["vsd_note"]
    assert scores["vsd"]["depth"] == "rendered"
    assert column(text, "AR_VSD")["all"] == "1.000"
    assert scores["ar"] == 1


def test_a_planted_shift_along_the_ray_shows(run):
    code, text, scores = run(rows(lambda T: farther(T, 20)))
    assert code == 0
    along, across, rotation = (scores["errors"][k] for k in ("along_ray_mm", "across_ray_mm", "rotation_deg"))
    for figure in ("median", "mean", "p5", "p95"):
        assert along[figure] == pytest.approx(20, abs=1e-6)
        assert across[figure] == pytest.approx(0, abs=1e-6)
        assert rotation[figure] == pytest.approx(0, abs=1e-6)
    assert along["robust_sigma"] == pytest.approx(0, abs=1e-6)
    assert along["count"] == sum(along["counts"]) + along["below"] + along["above"] == 4
    assert along["edges"][0] <= 20.00001
    assert along["edges"][-1] >= 19.99999
    assert "Error along the viewing ray [mm]" in text
    assert "median 20.0, mean 20.0, robust σ 0.0, percentiles 5 to 95: 20.0 to 20.0" in text
    assert "-0.0" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_planted_turns_and_shifts_have_their_statistics(run):
    angle = iter(np.deg2rad([2.0, 30.0, 6.0, 4.0]))
    moves = iter([(3, 0), (6, 0), (-9, 0), (0, 0)])

    def move(T):
        a, T = next(angle), T.copy()
        T[:3, :3] = T[:3, :3] @ [[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]
        ray = T[:3, 3] / np.linalg.norm(T[:3, 3])
        side = np.cross(ray, [0, 0, 1])
        T[:3, 3] += side / np.linalg.norm(side) * next(moves)[0]
        return T

    _, _, scores = run(rows(move))
    rotation, across = scores["errors"]["rotation_deg"], scores["errors"]["across_ray_mm"]
    assert rotation["median"] == pytest.approx(5, abs=0.01)
    assert rotation["mean"] == pytest.approx(10.5, abs=0.3)  # the second is round: steps of its symmetry
    assert rotation["robust_sigma"] == pytest.approx(1.4826 * 2, abs=0.02)  # |3 1 1 25|
    assert across["median"] == pytest.approx(4.5, abs=1e-3)
    assert across["p95"] == pytest.approx(np.percentile([3, 6, 9, 0], 95), abs=1e-3)


def test_false_positives_are_counted_and_left_out_of_the_errors(run):
    lines = rows()
    lines[0] = csv_row(2, 3, 1, 0.9, standing(1, 400, 700))
    _, text, scores = run(lines)
    assert (scores["errors"]["rows"], scores["errors"]["left_out"]) == (3, 1)
    assert "3 scored rows\n(1 more are farther off than a diameter and left out)" in text
    assert scores["errors"]["along_ray_mm"]["p95"] == pytest.approx(0, abs=1e-6)


def test_rows_that_are_no_targets_do_no_harm(root, run):
    T = standing(1, 0, 700)
    foreign = [csv_row(2, 3, 77, 1, T), csv_row(2, 99, 1, 1, T), csv_row(8, 1, 1, 1, T)]
    off = [csv_row(2, 3, 1, 0.1, standing(1, 5000, 700))]
    add_depth(root)
    code, _, scores = run(rows() + foreign + off, "--planes", root / "planes.json")
    assert (code, scores["ar"], scores["errors"]["rows"]) == (0, 1, 4)
    code, text, scores = run(foreign)
    assert (code, scores["ar"], scores["errors"]["rows"]) == (0, 0, 0)
    assert scores["errors"]["along_ray_mm"]["median"] is None
    assert "0 scored rows" in text


@pytest.mark.parametrize("z", [-700, 0, 700])
def test_estimates_behind_the_camera_or_off_the_image_score_nothing(root, run, z):
    add_depth(root)
    code, text, scores = run([csv_row(2, 7, 9, 1, standing(9, 1500 if z > 0 else 0, z))])
    assert (scores["ar_vsd"], scores["ar_mssd"]) == (0, 0)
    assert code == ("error: " in text) == (z <= 0)  # not in front of the camera: no valid row


def test_what_is_in_the_table_is_counted(root, run):
    planes = ("--planes", root / "planes.json", "--vsd-depth", "none")
    _, text, scores = run(rows(), *planes)
    assert scores["inside_table"].pop("count") == 4
    assert set(scores["inside_table"].values()) == {0.0}
    assert "more than 3 mm inside the table: 0.0 %" in text
    _, _, scores = run(rows(lambda T: T - 5 * np.outer([*UP, 0], [0, 0, 0, 1])), *planes)
    assert scores["inside_table"]["estimates"] == 1
    _, _, scores = run(rows(lambda T: T + 5 * np.outer([*UP, 0], [0, 0, 0, 1])), *planes, "--scenes", "5")
    assert (scores["inside_table"]["above"], scores["inside_table"]["count"]) == (1, 1)


def test_chosen_scenes_alone_are_scored(root, run):
    add_depth(root, (5, 1))
    _, text, scores = run(rows(), "--scenes", "5")
    assert (scores["targets"], scores["ar"], scores["errors"]["rows"]) == (1, 1, 1)
    assert set(scores["per_scene"]) == {"5"}
    assert "scene 2" not in text


def test_unreadable_rows_and_planes_are_told_and_fail_the_run(root, run):
    code, text, scores = run([*rows(), csv_row(2, 3, 1, "nan", np.eye(4))])
    assert (code, scores["ar_mssd"]) == (1, 1)
    assert "error: " in text
    (root / "planes.json").write_text('{"2": {"3": {"normal": [0, 0, 0], "offset_mm": 1}}}')
    code, text, _ = run(rows(), "--planes", root / "planes.json")
    assert code == 1
    assert "error: " in text


def test_quiet_prints_nothing(root, run):
    add_depth(root)
    assert run(rows(), "--quiet")[:2] == (0, "")


def without_scale(root, path):
    file = root / "test" / "000002" / "scene_camera.json"
    content = json.loads(file.read_text())
    del content["3"]["depth_scale"]
    file.write_text(json.dumps(content))


def colour_of_other_size(root, path):
    (path.parents[1] / "rgb").mkdir()
    Image.new("RGB", (320, 240)).save(path.parents[1] / "rgb" / "000003.png")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (without_scale, ["scene_camera.json, image 3", "'depth_scale'", "add it"]),
        (lambda root, path: path.write_bytes(b"no image"), ["cannot be read as an image", "get the file again"]),
        (lambda root, path: path.write_bytes(path.read_bytes()[:900]), ["cannot be read as an image"]),
        (lambda root, path: Image.new("L", (640, 480)).save(path), ["mode L", "expected one channel of 16 bits"]),
        (lambda root, path: Image.new("RGB", (640, 480)).save(path), ["mode RGB", "16 bits"]),
        (colour_of_other_size, ["640×480 px", "320×240 px", "rgb"]),
    ],
    ids=["no scale", "no image", "cut off", "8 bits", "colour", "other size"],
)
def test_a_bad_depth_image_is_named_with_what_to_do(root, run, spoil, words):
    (path,) = add_depth(root, (2, 3))
    spoil(root, path)
    code, text, _ = run(rows())
    assert code == 2
    assert all(word in text for word in [*words, "000002"]), text
    assert "Traceback" not in text
    assert run(rows(), "--vsd-depth", "none")[0] == 0


@pytest.mark.data
def test_megapose_on_all_images(ycbv, tmp_path, capsys):
    out = tmp_path / "scores.json"
    estimates = ycbv / "estimates" / "megapose_ycbv-test.csv"
    assert main(["eval", str(estimates), "--dataset", str(ycbv), "--json", str(out)]) == 0
    text, scores = capsys.readouterr().out, json.loads(out.read_text())
    assert scores["ar_mssd"] == pytest.approx(0.562, abs=0.002)
    assert scores["ar_mspd"] == pytest.approx(0.700, abs=0.002)
    assert 0.5 < scores["ar_vsd"] < 0.8
    assert "VSD over 10 of 2700 targets only, those of the 2 of 600 images" in text
    assert scores["errors"]["along_ray_mm"]["median"] == pytest.approx(21, abs=1)
    assert scores["errors"]["across_ray_mm"]["median"] < 4
    assert max(map(len, text.splitlines())) <= 80
