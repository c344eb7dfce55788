"""``physpose table`` and ``physpose refine --table`` on generated images, as a user would call them."""

import json
import math

import numpy as np
import pytest
import torch
from bop_files import HEADER, csv_row
from PIL import Image

from physpose_torch.__main__ import main
from physpose_torch.bop.formats import read_planes
from physpose_torch.bop.table import load_models, read_image, read_pairs, read_scene
from physpose_torch.errors import DataError, UnknownLabelError
from physpose_torch.household import household_meshes, perturb_like_estimator
from physpose_torch.photograph import household_pair


class Files:
    """A generated pair as files, in millimetres."""

    def __init__(self, folder) -> None:
        self.folder, self.pair = folder, household_pair(2, table="wood", objects=["box", "can", "bottle"], stacked=False)
        self.images = [folder / f"view{k}.png" for k in (0, 1)]
        for path, image in zip(self.images, self.pair.images, strict=True):
            Image.fromarray(image.numpy()).save(path)
        self.models = folder / "models"
        self.models.mkdir()
        for k, name in enumerate(self.pair.names, start=1):
            mesh = self.pair.meshes[name].copy()
            mesh.apply_scale(1000)
            mesh.export(self.models / f"obj_{k:06d}.ply")
        # convex, and of few faces: decomposed at once
        self.hulls = folder / "hulls"
        self.hulls.mkdir()
        shapes = household_meshes()
        for k, name in enumerate(self.pair.names, start=1):
            shapes[name].convex_hull.apply_scale(1000).export(self.hulls / f"obj_{k:06d}.ply")
        self.estimates = [
            perturb_like_estimator(T, seed=k, depth_bias=0.0, depth_sigma=0.015)
            for k, T in enumerate(self.pair.T_camera_object)
        ]
        for T in self.estimates:
            T[:, :3, 3] *= 1000
        self.scene = folder / "scene.json"
        self.content = {
            "K": self.pair.K.tolist(),
            "objects": [
                {"obj_id": k + 1, "T_cam0_est": self.estimates[0][k].tolist(), "T_cam1_est": self.estimates[1][k].tolist()}
                for k in range(3)
            ],
        }
        self.write(self.content)

    def write(self, content) -> None:
        self.scene.write_text(json.dumps(content))

    def arguments(self, *more: str) -> list[str]:
        return ["table", *map(str, self.images), "--scene", str(self.scene), "--models", str(self.models), *more]

    def errors(self, normal, offset_mm) -> tuple[float, float]:
        normal = torch.tensor(normal, dtype=torch.float64)
        angle = math.degrees(math.acos(min(1.0, float(normal @ self.pair.normal))))
        middle = self.pair.T_camera_object[0][:, :3, 3].mean(0)
        foot = middle - (middle @ self.pair.normal - self.pair.offset) * self.pair.normal
        return angle, 1e3 * float(foot @ normal) - offset_mm


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Files:
    return Files(tmp_path_factory.mktemp("pair"))


def test_a_table_is_written_as_planes_files_want_it(files, tmp_path, capsys):
    out, picture = tmp_path / "T.json", tmp_path / "T.png"
    more = ["--out", str(out), "--picture", str(picture), "--config.features", "sift"]
    assert main(files.arguments(*more)) == 0
    entry = json.loads(out.read_text())
    angle, height = files.errors(entry["normal"], entry["offset_mm"])
    assert angle < 0.5
    assert abs(height) < 4.0
    assert entry["method"] == "joint"
    assert entry["scale"] == pytest.approx(float(files.pair.T_view1_view0[:3, 3].norm()), rel=0.05)
    assert entry["warnings"] == []
    assert Image.open(picture).size[0] == files.pair.images[0].shape[1]
    assert "3 of 3 objects stand on it" in capsys.readouterr().out
    planes = tmp_path / "planes.json"
    planes.write_text(json.dumps({"1": {"2": entry}}))
    read, problems = read_planes(planes)
    assert not problems
    assert read[1, 2].sigma == pytest.approx(1e-3 * entry["sigma_mm"])


@pytest.mark.parametrize("method", ["support", "homography", "paper"])
def test_every_method_can_be_asked_for(files, tmp_path, method):
    out = tmp_path / "T.json"
    code = main(files.arguments("--out", str(out), "--method", method, "--quiet", "--config.features", "sift"))
    if code == 0:
        entry = json.loads(out.read_text())
        assert entry["method"] == method
        assert files.errors(entry["normal"], entry["offset_mm"])[0] < 5.0
    else:
        assert code == 2
        assert not out.exists()


def test_one_image_with_gravity(files, tmp_path):
    out = tmp_path / "T.json"
    down = [str(9.81 * x) for x in (-files.pair.normal).tolist()]
    code = main(
        ["table", str(files.images[0]), "--scene", str(files.scene), "--models", str(files.models), "--out", str(out),
         "--gravity", *down, "--quiet"]
    )  # fmt: skip
    assert code == 0
    entry = json.loads(out.read_text())
    assert entry["scale"] is None
    assert files.errors(entry["normal"], entry["offset_mm"])[0] < 1.0


def test_objects_may_be_missing_in_a_view(files, tmp_path):
    content = json.loads(json.dumps(files.content))
    del content["objects"][0]["T_cam1_est"]
    content["objects"][1]["T_cam0_est"] = None
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps(content))
    read = read_scene(scene)
    assert read.poses[0].isnan().any(-1).any(-1).tolist() == [False, True, False]
    assert read.poses[1].isnan().any(-1).any(-1).tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.pop("K"), "K is not a 3x3 matrix"),
        (lambda c: c.update(objects={}), "expected"),
        (lambda c: c["objects"][1].update(obj_id="5"), r"objects\[1\].*obj_id"),
        (lambda c: c["objects"][0].update(T_cam0_est=[[1, 2], [3, 4]]), r"objects\[0\]: T_cam0_est is not a 4x4"),
        (lambda c: c["objects"][0]["T_cam0_est"].__setitem__(0, [float("nan")] * 4), "finite"),
        (lambda c: c["objects"][2]["T_cam1_est"].__setitem__(0, [2.0, 0, 0, 0]), r"objects\[2\].*not rigid"),
        (lambda c: [r.__setitem__(3, r[3] / 1000) for r in c["objects"][0]["T_cam0_est"][:3]], "millimetres"),
    ],
)
def test_what_is_wrong_with_a_scene_file_is_named(files, tmp_path, change, words):
    content = json.loads(json.dumps(files.content))
    change(content)
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=words):
        read_scene(path)


def test_files_that_are_missing_or_no_images_are_named(files, tmp_path, capsys):
    broken = tmp_path / "no.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    for path, words in ((tmp_path / "gone.png", "no such image"), (broken, "cannot be read as an image")):
        with pytest.raises(DataError, match=words):
            read_image(path)
    assert main(["table", str(broken), *files.arguments()[3:], "--out", str(tmp_path / "T.json")]) == 2
    assert "no.png" in capsys.readouterr().err
    with pytest.raises(UnknownLabelError, match="object 7 has no mesh"):
        load_models(files.models, [1, 7])
    with pytest.raises(DataError, match="no such folder"):
        load_models(tmp_path / "models", [1])
    assert main(files.arguments("--out", str(tmp_path / "no" / "T.json"))) == 2


def test_intrinsics_of_another_size_are_refused(files, tmp_path, capsys):
    Image.open(files.images[0]).resize((160, 120)).save(tmp_path / "small.png")
    arguments = ["table", str(tmp_path / "small.png"), *files.arguments()[3:], "--out", str(tmp_path / "T.json")]
    assert main(arguments) == 2
    assert "principal point" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"48": {"1": 5}}, "expected"),
        ({"48": {"1": {"second": "2"}}}, "second is '2'"),
        ({"48": {"1": {"files": ["../secret.png"]}}}, "leaves the folder"),
        ({"48": {"1": {"gravity": [0, 0, 0]}}}, "image 1: gravity"),
        ({"48": {"1": {"gravity": "down"}}}, "image 1: gravity"),
        ({"48": {"1": {"gravity": [0, 1, float("nan")]}}}, "image 1: gravity|NaN"),
        ({"x": {}}, "ids as keys"),
    ],
)
def test_what_is_wrong_with_a_pairs_file_is_named(tmp_path, content, words):
    path = tmp_path / "pairs.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=words):
        read_pairs(path)


@pytest.fixture(scope="module")
def dataset(files, tmp_path_factory):
    """The pair as a BOP dataset without images, a result file, and a pairs file that names the images."""
    root = tmp_path_factory.mktemp("bop")
    scene = root / "test" / "000001"
    scene.mkdir(parents=True)
    camera = {str(k): {"cam_K": files.pair.K.flatten().tolist(), "depth_scale": 1.0} for k in (0, 1)}
    (scene / "scene_camera.json").write_text(json.dumps(camera))
    (root / "camera.json").write_text(json.dumps({"width": 640, "height": 480}))
    rows = [HEADER]
    for view in (0, 1):
        rows += [csv_row(1, view, k + 1, 0.9, T.numpy()) for k, T in enumerate(files.estimates[view])]
    (root / "estimates.csv").write_text("\n".join(rows) + "\n")
    for path in files.images:
        (root / path.name).write_bytes(path.read_bytes())
    pairs = {"1": {"0": {"second": 1, "files": ["view0.png", "view1.png"]}, "1": {"files": ["view1.png"]}}}
    (root / "pairs.json").write_text(json.dumps(pairs))
    return root


def run_refine(files, dataset, out, *more):
    arguments = [
        "refine", str(dataset / "estimates.csv"), "--dataset", str(dataset), "--models", str(files.hulls),
        "--out", str(out), "--json", str(out.with_suffix(".json")), "--quiet", *more,
    ]  # fmt: skip
    return main(arguments), json.loads(out.with_suffix(".json").read_text()) if out.exists() else None


def test_pairs_of_images_refine_without_planes(files, dataset, tmp_path):
    code, summary = run_refine(files, dataset, tmp_path / "out.csv", "--table", "auto", "--pairs", str(dataset / "pairs.json"))
    assert code == 0
    assert summary["refined"] == 2
    refined = [line.split(",") for line in (tmp_path / "out.csv").read_text().splitlines()[1:4]]
    true = files.pair.T_camera_object[0][:, :3, 3].numpy()
    moved = np.array([[float(x) for x in row[5].split()] for row in refined]) / 1000
    before = files.estimates[0][:, :3, 3].numpy() / 1000
    height = (moved - true) @ files.pair.normal.numpy()
    assert np.abs(height).mean() < 0.6 * np.abs((before - true) @ files.pair.normal.numpy()).mean()


def test_a_second_image_is_used_wherever_its_rows_are(files, dataset, tmp_path):
    """Though the images are read one at a time."""
    more = ("--table", "auto", "--pairs", str(dataset / "pairs.json"), "--config.steps", "2")
    poses = []
    for size in ("256", "1"):
        out = tmp_path / f"out{size}.csv"
        assert run_refine(files, dataset, out, "--batch", size, *more)[0] == 0
        poses.append([line.split(",")[:6] for line in out.read_text().splitlines()])
    assert poses[0] == poses[1]


def test_an_image_whose_table_is_not_found_keeps_its_poses(files, dataset, tmp_path, caplog):
    alone = tmp_path / "one.csv"  # one object in each image, no images: it could stand on several of its sides
    rows = (dataset / "estimates.csv").read_text().splitlines()
    box = 1 + files.pair.names.index("box")
    alone.write_text("\n".join([rows[0], *(r for r in rows[1:] if r.split(",")[2] == str(box))]) + "\n")
    out = tmp_path / "out.csv"
    code = main(
        ["refine", str(alone), "--dataset", str(dataset), "--models", str(files.hulls), "--out", str(out), "--table",
         "support", "--quiet"]
    )  # fmt: skip
    assert code == 1
    assert "gravity" in caplog.text
    assert out.read_text() == alone.read_text()


def test_gravity_tells_the_table_under_a_single_object(files, dataset, tmp_path):
    """Which of the box's sides is down, that is."""
    alone, pairs = tmp_path / "one.csv", tmp_path / "pairs.json"
    rows = (dataset / "estimates.csv").read_text().splitlines()
    box = 1 + files.pair.names.index("box")
    alone.write_text("\n".join([rows[0], *(r for r in rows[1:] if r.split(",")[:3] == ["1", "0", str(box)])]) + "\n")
    pairs.write_text(json.dumps({"1": {"0": {"gravity": (-9.81 * files.pair.normal).tolist()}}}))
    code = main(
        ["refine", str(alone), "--dataset", str(dataset), "--models", str(files.hulls), "--out", str(tmp_path / "out.csv"),
         "--table", "support", "--pairs", str(pairs), "--quiet"]
    )  # fmt: skip
    assert code == 0
    assert (tmp_path / "out.csv").read_text() != alone.read_text()


def test_pairs_without_table_are_refused(files, dataset, tmp_path, capsys):
    code, _ = run_refine(files, dataset, tmp_path / "out.csv", "--pairs", str(dataset / "pairs.json"))
    assert code == 2
    assert "--table auto" in capsys.readouterr().err
