"""``physpose view`` shows the images of a result file, refined, and ends at Ctrl-C."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from bop_files import HEADER, OFFSET_MM, UP, csv_row, standing, write_models, write_scene
from corpus_dataset import png
from PIL import Image

from physpose_torch.__main__ import main
from physpose_torch.commands import parse
from physpose_torch.commands.view import BopImages
from physpose_torch.refiner import PhysPoseRefiner

pytest.importorskip("viser")


@pytest.fixture
def dataset(tmp_path):
    """Images 3 (with a picture) and 7 of scene 2, image 5 with an object that has no mesh: boxes a little inside a table."""
    root = tmp_path / "data"
    write_models(root / "models")
    folder = write_scene(root / "test", 2, {im: [(1, standing(0, 0, 50), 1.0)] for im in (3, 5, 7)}, width=640)
    (folder / "rgb").mkdir()
    Image.fromarray(np.full((480, 640, 3), 99, np.uint8)).save(folder / "rgb" / "000003.png")
    rows = [
        csv_row(2, 3, 1, 0.9, standing(-80, 0, 46)),
        csv_row(2, 3, 4, 0.8, standing(60, 30, 12)),
        csv_row(2, 5, 77, 0.8, standing(60, 30, 12)),
        csv_row(2, 7, 9, 0.7, standing(0, 0, 33)),
    ]
    (root / "est.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    entry = {"normal": UP.tolist(), "offset_mm": OFFSET_MM}
    (root / "planes.json").write_text(json.dumps({"2": {str(im): entry for im in (3, 5, 7)}}))
    return root


def arguments(root, *more):
    planes = root / "planes.json"
    return ["view", str(root / "est.csv"), "--dataset", str(root), "--planes", str(planes), *map(str, more)]


def opened(root, *more):
    command = parse(arguments(root, *more))
    refiner = PhysPoseRefiner(command.config.__class__(keep_trajectory=True))
    return BopImages(command.open(), refiner, scenes=command.scenes, every=command.every, images=command.images)


def test_images_are_those_of_the_file_and_are_refined(dataset):
    images = opened(dataset)
    assert images.names == [f"scene 2 image {im}" for im in (3, 5, 7)]
    first = images[0]
    assert first.image.shape == (480, 640, 3)
    assert float(first.K[0, 0]) == 600
    assert first.last > 5
    torch.testing.assert_close(first.trajectory[0], images.estimates.T_camera_object[:2])
    assert float(first.report(0).penetration.max()) == pytest.approx(0.004, abs=1e-5)
    assert float(first.report(first.last).penetration.max()) < 0.001
    last = images[2]
    assert last.image is None
    assert last.size == (480, 640)
    assert images[0] is first


def test_what_cannot_be_shown_says_why(dataset):
    bad = opened(dataset)[1]
    assert len(bad.scene) == 0
    assert "77" in bad.table(0)


@pytest.mark.parametrize(
    "picture", [b"no image", png(60_000, 60_000), png(640, 480, data=bytes(9)), None], ids=["text", "bomb", "cut", "pipe"]
)
def test_a_broken_picture_is_left_out_and_the_objects_are_shown(dataset, picture):
    path = dataset / "test" / "000002" / "rgb" / "000003.png"
    path.unlink()
    os.mkfifo(path) if picture is None else path.write_bytes(picture)
    first = opened(dataset)[0]
    assert first.image is None
    assert first.last > 5


@pytest.mark.parametrize("camera", ["{}", "[]", '{"3": {"cam_K": [1e999]}}', '{"3": null}'])
def test_without_a_camera_the_objects_are_shown(dataset, camera):
    (dataset / "test" / "000002" / "scene_camera.json").write_text(camera)
    first = opened(dataset)[0]
    assert (first.K, first.image) == (None, None)
    assert first.last > 5


@pytest.mark.parametrize(
    ("options", "left"),
    [
        (("--image", 7), [7]),
        (("--images", 3, 7), [3, 7]),
        (("--every", 2), [3, 7]),
        (("--scene", 2, "--image", 5), [5]),
    ],
)
def test_options_choose_among_the_images(dataset, options, left):
    images = opened(dataset, *options)
    assert [im for _, im in images.keys] == left
    assert [images[k].name for k in range(len(images))] == images.names


def test_a_calibration_sets_the_config(dataset, tmp_path):
    factor = json.dumps(
        {
            "depth_factor": 0.97,
            "sigma_ray_fraction": 0.01,
            "sigma_lateral_mm": 2,
            "sigma_rotation_deg": 2,
            "interval": {},
        }
    )
    (tmp_path / "c.json").write_text(factor)
    command = parse(arguments(dataset, "--calibration", tmp_path / "c.json"))
    assert command.config.physics.depth_factor == pytest.approx(0.97)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["view"], "needs a result file"),
        (["view", "est.csv"], "needs --dataset DIR"),
        (["view", "est.csv", "--demo"], "leave out est.csv"),
        (["view", "--demo", "--port", "70000"], "--port 70000"),
    ],
)
def test_contradictory_options_are_one_clear_line_and_exit_code_2(args, message, capsys):
    assert main(args) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_no_image_left_is_an_error(dataset, capsys):
    assert main(arguments(dataset, "--image", 1234)) == 2
    assert "no image" in capsys.readouterr().err


@pytest.mark.parametrize(("sign", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 130)])
def test_it_serves_until_ctrl_c_and_then_ends_well(dataset, sign, code):
    program = [sys.executable, "-m", "physpose_torch", *arguments(dataset, "--port", 0)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
    )
    try:
        for line in process.stdout:
            if "Ctrl-C ends" in line:
                break
        else:
            pytest.fail(process.stderr.read())
        assert "http://localhost:" in line
        process.send_signal(sign)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == code, error
    assert "Traceback" not in error


def test_without_viser_nothing_is_begun(dataset, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr("physpose_torch.demo.run_demo", lambda **options: pytest.fail("work has begun"))
    assert main(["view", "--demo"]) == 2
    assert 'pip install "physpose-torch[viz]"' in capsys.readouterr().err
