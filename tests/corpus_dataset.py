"""A dataset of ten tiny images with every file that a command reads, and every command that reads some of them."""

import json
import struct
import zlib

import numpy as np
from bop_files import HEADER, OFFSET_MM, UP, K, csv_row, standing, write_depth, write_models, write_scene
from PIL import Image

from physpose_torch.__main__ import main
from physpose_torch.errors import MissingExtraError
from physpose_torch.table.estimator import TableEstimator

WIDTH, HEIGHT = 80, 64
IMAGES = range(10)


def write_everything(root):
    """Into a folder; the names of files are those of options, where there is one."""
    truth = {im: [(1, standing(-80, 4 * im, 50)), (4, standing(60, 30, 15))] for im in IMAGES}
    write_models(root / "models")
    scene = write_scene(root / "test", 2, {im: [(o, T, 1.0) for o, T in rows] for im, rows in truth.items()})
    small = (np.reshape(K, (3, 3)) * [[0.125], [0.125], [1]]).flatten().tolist()
    rng = np.random.default_rng(0)
    (scene / "rgb").mkdir()
    picture = Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    for im in IMAGES[:2]:
        picture.save(scene / "rgb" / f"{im:06d}.png")
        write_depth(scene, im, np.full((HEIGHT, WIDTH), 0.6))
    picture.save(root / "second.png")
    rows = [csv_row(2, im, o, 0.9, T) for im, objects in truth.items() for o, T in objects]
    plane = {"normal": UP.tolist(), "offset_mm": OFFSET_MM}
    pose = {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "t_mm": [0, 0, 3000]}
    (root / "estimates.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    contents = {
        root / "planes.json": {"2": {str(im): plane for im in IMAGES}},
        root / "targets.json": [{"scene_id": 2, "im_id": im, "obj_id": 1, "inst_count": 1} for im in IMAGES[:3]],
        root / "pairs.json": {"2": {"0": {"second": 1, "files": ["second.png", "second.png"], "gravity": [0, 0.8, 0.6]}}},
        root / "statics.json": {
            "statics": [
                {"box_mm": [100, 100, 100], "label": "box", "poses": {"all": pose}},
                {"mesh": "models/obj_000001.ply", "scale": 0.001, "poses": {"2": {"1": pose}}},
            ]
        },
        root / "calibration.json": {
            "depth_factor": 0.98,
            "sigma_ray_fraction": 0.01,
            "sigma_depth_common": 0.01,
            "sigma_lateral_mm": 2.0,
            "sigma_rotation_deg": 3.0,
            "interval": {"depth_factor": [0.97, 0.99]},
        },
        root / "camera.json": {"width": WIDTH, "height": HEIGHT},
        scene / "scene_camera.json": {str(im): {"cam_K": small, "depth_scale": 0.1} for im in IMAGES},
        root / "scene.json": {
            "K": np.reshape(small, (3, 3)).tolist(),
            "objects": [{"obj_id": o, "T_cam0_est": T.tolist(), "T_cam1_est": T.tolist()} for o, T in truth[0]],
        },
    }
    for path, content in contents.items():
        path.write_text(json.dumps(content))


def files_of(root):
    """What can be broken, by its name."""
    scene = root / "test" / "000002"
    found = {path.stem: path for path in [*root.glob("*.*"), *scene.glob("*.json"), *root.glob("models/*.json")]}
    return found | {
        "mesh": root / "models" / "obj_000001.ply",
        "rgb": scene / "rgb" / "000000.png",
        "depth": scene / "depth" / "000000.png",
        "models": root / "models",
        "split": root / "test",
        "folder": scene,
    }


def without_export(monkeypatch):
    """Let matches be by SIFT alone: XFeat's export takes ten seconds."""

    def missing(*_):
        raise MissingExtraError("not in this test")

    monkeypatch.setattr(TableEstimator, "_xfeat", missing)


def commands(root):
    """Arguments by a name of the command; whatever they write is called ``out.*``."""

    def given(*names):
        return [x for name in names for x in (f"--{name}", root / f"{name}.json")]

    start = [root / "estimates.csv", "--dataset", root]
    few = ["--config.steps", "2", "--quiet"]
    some = ["--every", "5", *few]
    return {
        "refine": [*start, *given("planes", "statics", "targets", "calibration"), "--out", root / "out.csv", *few],
        "refine --table auto": [*start, *given("pairs"), "--out", root / "out.csv", *some],
        "report": [*start, *given("planes", "statics", "targets"), "--json", root / "out.json"],
        "eval": [*start, *given("planes", "targets"), "--json", root / "out.json"],
        "eval --vsd-depth rendered": [*start, *given("planes"), "--json", root / "out.json"],
        "calibrate": [*start, *given("planes"), "--out", root / "out.json", "--resamples", "2"],
        "ablate": [*start, *given("planes", "calibration"), "--rows", "calibrated", "--json", root / "out.json", *some],
        "table": [root / "second.png", *given("scene"), "--models", root / "models", "--out", root / "out.json"],
        "decompose": [root / "models", "--json", root / "out.json", "--quiet"],
    }


def run(root, name):
    """The exit code; 0, 1 or 2, and with 2 nothing is written. Any other exception is the test's."""
    try:
        code = main([*name.split(), *map(str, commands(root)[name])])
    except SystemExit as stop:  # of tyro
        code = stop.code
    assert code in (0, 1, 2)
    written = sorted(path.name for path in root.iterdir() if "out." in path.name)
    assert len(written) <= (code != 2), f"{name} left {written}"
    for path in written:
        (root / path).unlink()
    return code


def png(width, height, *, depth=8, colour=2, data=b"", more=()):
    """A PNG file whose header says so, whatever follows; checksums are right."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = [(b"IHDR", head), *more, (b"IDAT", zlib.compress(data)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*c) for c in chunks)
