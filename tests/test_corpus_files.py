"""Files that are none: loops of links, pipes, devices, folders, bombs; pictures of all kinds; paths that lead out; caches that
were tampered with. All end in an exit code and a message, soon and with little memory.
"""

import contextlib
import json
import os
import resource
import shutil
import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from corpus import nested
from corpus_dataset import HEIGHT, WIDTH, files_of, png, run, without_export, write_everything
from PIL import Image

from physpose_torch import reading as module
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import read_statics
from physpose_torch.bop.table import read_image, read_pairs
from physpose_torch.errors import DataError
from physpose_torch.geometry.decompose import decompose
from physpose_torch.robot.urdf import read_urdf

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="links, pipes and limits of Linux"),
    pytest.mark.timeout(30),
]


def sparse(path):
    with path.open("wb") as file:
        file.truncate(20 << 30)


STRANGE = {
    "loop": lambda path: path.symlink_to(path.name),
    "folder": lambda path: path.mkdir(),
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "nowhere": lambda path: path.symlink_to("nowhere"),
    "missing": lambda path: None,
    "empty": lambda path: path.write_bytes(b""),
    "zeros": lambda path: path.write_bytes(bytes(1000)),
    "20 GB": sparse,
    "deep": lambda path: path.write_text("[" * 100_000 + "]" * 100_000),
    "deep enough": lambda path: path.write_text(json.dumps({"2": {"0": nested(900)}})),
    "digits": lambda path: path.write_text('{"2": {"0": ' + "9" * 100_000 + "}}"),
    "long digits": lambda path: path.write_text('{"2": {"0": ' + "9" * 4000 + "}}"),
    "one line": lambda path: path.write_text("1," * 1_000_000),
    "latin-1": lambda path: path.write_bytes('{"é": {}}'.encode("latin-1")),
    "utf-16": lambda path: path.write_bytes('{"2": {}}'.encode("utf-16")),
}
READ_BY = {
    "estimates": "refine",
    "planes": "report",
    "statics": "report",
    "targets": "report",
    "pairs": "refine --table auto",
    "calibration": "refine",
    "camera": "eval --vsd-depth rendered",
    "scene_camera": "eval",
    "scene_gt": "eval",
    "scene_gt_info": "eval",
    "models_info": "eval",
    "scene": "table",
    "mesh": "report",
    "rgb": "eval",
    "depth": "eval",
    "second": "table",
    "models": "decompose",
    "split": "eval",
    "folder": "eval",
}
HARMLESS = {"camera", "scene_gt_info", "models_info", "rgb", "depth"}
"""Without these a command does with less."""


@pytest.fixture(autouse=True)
def limits(monkeypatch):
    """Two gigabytes more than now."""
    monkeypatch.setattr(module, "PATIENCE", 0.05)
    without_export(monkeypatch)
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (2 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("whole")
    write_everything(root)
    return root


@pytest.fixture
def data(whole, tmp_path):
    """A copy to break, and its files by name."""
    root = tmp_path / "data"
    shutil.copytree(whole, root)
    return root, files_of(root)


@pytest.mark.parametrize("broken", READ_BY)
def test_what_is_no_file_is_refused_or_listed_at_once(data, broken, capsys, caplog):
    root, files = data
    path, name = files[broken], READ_BY[broken]
    assert path.exists()
    kept = root.parent / "kept"
    path.rename(kept)
    for kind, make in STRANGE.items():
        make(path)
        caplog.clear()
        code = run(root, name)
        told = capsys.readouterr()
        assert code or broken in HARMLESS, f"{kind}: nothing is wrong?"
        assert code == 0 or caplog.records or "error" in told.out + told.err, f"{kind}: not a word"
        assert len(told.err) < 3000, f"{kind}: {len(told.err)} characters"
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink(missing_ok=True)
    kept.rename(path)
    assert run(root, name) in (0, 1)


def test_a_pipe_that_nobody_writes_to_is_named(tmp_path):
    os.mkfifo(tmp_path / "planes.json")
    with pytest.raises(DataError, match=r"planes\.json: is a pipe that nobody writes to"):
        module.load_json(tmp_path / "planes.json")


def test_a_pipe_with_a_writer_is_read_however_slow_it_is(tmp_path):
    """It is opened at once, and written to long after the patience is over."""
    os.mkfifo(tmp_path / "planes.json")
    read, write = os.pipe()
    child = os.posix_spawn(
        "/bin/sh", ["sh", "-c", f"exec 3<>{tmp_path}/planes.json; echo; sleep 0.3; echo '{{\"a\": 1}}' >&3"], os.environ,
        file_actions=[(os.POSIX_SPAWN_DUP2, write, 1)],
    )  # fmt: skip
    os.read(read, 1)
    assert module.load_json(tmp_path / "planes.json") == {"a": 1}
    os.waitpid(child, 0)


@pytest.mark.parametrize("read", [module.load_json, read_urdf])
def test_a_pipe_without_end_is_left_soon_and_a_large_file_is_not_read(tmp_path, monkeypatch, read):
    monkeypatch.setattr(module, "LARGEST", 5_000_000)
    monkeypatch.setattr(module, "PATIENCE", 5.0)
    path = tmp_path / "file"
    os.mkfifo(path)
    writer = os.posix_spawn("/bin/sh", ["sh", "-c", f"head -c 100M /dev/zero > {path}"], os.environ)
    with pytest.raises(DataError, match=r"file: more than 0\.0 GB are too much"):
        read(path)
    assert os.waitstatus_to_exitcode(os.waitpid(writer, 0)[1]) != 0  # it could not write all of it
    path.unlink()
    sparse(path)
    with pytest.raises(DataError, match="too much"):
        read(path)


PICTURES = {
    "1 x 1": png(1, 1, data=bytes(4)),
    "nothing": png(0, 0),
    "declared 60000 x 60000": png(60000, 60000),
    "declared 2^31 x 2^31": png(2**31 - 1, 2**31 - 1),
    "a row of 10^8": png(100_000_000, 1, depth=1, colour=0),
    "cut": png(WIDTH, HEIGHT, data=bytes(500)),
    "text that unpacks to 400 MB": png(2, 2, more=[(b"zTXt", b"a\0\0" + zlib.compress(bytes(400_000_000)))]),
    "another checksum": png(WIDTH, HEIGHT).replace(b"IDAT", b"IDBT"),
    "text": b"no image",
}


@pytest.mark.parametrize("kind", PICTURES)
def test_broken_pictures_are_refused(data, kind, capsys):
    root, files = data
    for name in ("rgb", "depth", "second"):
        files[name].write_bytes(PICTURES[kind])
    with pytest.raises(DataError, match=r"depth/000000\.png"):
        BopDataset(root).depth(2, 0)
    if kind != "1 x 1":
        with pytest.raises(DataError, match=r"second\.png: .*(read as an image|no photograph)"):
            read_image(files["second"])
    assert run(root, "table") == 2
    assert "second.png" in capsys.readouterr().err or kind == "1 x 1"
    assert run(root, "eval") == 2


@pytest.mark.filterwarnings("error")
def test_of_a_large_picture_pillow_says_nothing(tmp_path, monkeypatch):
    path = tmp_path / "x.png"
    path.write_bytes(png(WIDTH, HEIGHT, data=bytes((3 * WIDTH + 1) * HEIGHT)))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 0.6 * WIDTH * HEIGHT)
    assert module.read_pixels(path)[1].shape[:2] == (HEIGHT, WIDTH)
    assert module.read_size(path) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr", "LAB", "I", "F", "I;16"])
def test_pictures_of_every_mode_are_colours_or_refused(tmp_path, mode):
    path = tmp_path / "x.tif"
    Image.new(mode, (WIDTH, HEIGHT)).save(path)
    if mode in ("I", "F", "I;16"):
        with pytest.raises(DataError, match=r"x\.tif: has 16 bits or more a pixel"):
            read_image(path)
    else:
        assert read_image(path).shape == (HEIGHT, WIDTH, 3)


OUTSIDE = ["../secret", "a/../../secret", "/etc/passwd", "link", "loop", "x" * 300, "x" * 5000, "\0", "\ud800", "", ".", "pipe"]


@pytest.mark.parametrize("name", OUTSIDE)
def test_paths_in_data_files_stay_in_their_folder(tmp_path, name):
    folder = tmp_path / "data"
    folder.mkdir()
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "secret", file_type="ply")
    (folder / "link").symlink_to(tmp_path / "secret")
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")
    pose = {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "t_mm": [0, 0, 500]}
    (folder / "statics.json").write_text(json.dumps({"statics": [{"mesh": name, "poses": {"all": pose}}]}))
    with pytest.raises(DataError, match=r"statics\.json, statics\[0\]"):
        read_statics(folder / "statics.json")
    (folder / "pairs.json").write_text(json.dumps({"2": {"3": {"files": [name]}}}))
    try:
        path = read_pairs(folder / "pairs.json")[2, 3].files[0]
    except DataError as error:
        assert "pairs.json, scene 2, image 3" in str(error)  # noqa: PT017
    else:
        assert path.is_relative_to(folder.resolve())
        with pytest.raises(DataError, match="no such image"):
            read_image(path)


def test_a_folder_that_is_a_link_is_followed(data):
    """As in many BOP set-ups; who made the link is the user."""
    root, _ = data
    (root / "models").rename(root.parent / "elsewhere")
    (root / "models").symlink_to(root.parent / "elsewhere")
    assert run(root, "eval") == 0
    assert run(root, "decompose") == 0


@contextlib.contextmanager
def unprivileged():
    """Whoever may not read what belongs to root; the user, if that is not root."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.parametrize("broken", READ_BY)
def test_what_may_not_be_read_is_named(whole, broken, capsys, caplog):
    with tempfile.TemporaryDirectory(prefix="physpose_test_") as folder:
        root = Path(folder) / "data"
        shutil.copytree(whole, root)
        Path(folder).chmod(0o755)
        for each in (root, *root.rglob("*")):
            each.chmod(0o777)
        path = files_of(root)[broken]
        path.chmod(0)
        with unprivileged():
            code = run(root, READ_BY[broken])
        path.chmod(0o777)
    told = capsys.readouterr()
    assert code or broken in HARMLESS
    assert code == 0 or caplog.records or "error" in told.out + told.err


@pytest.mark.parametrize("name", ["report", "eval", "calibrate", "decompose", "table", "ablate"])
def test_a_full_disk_leaves_nothing_half_written(data, name, monkeypatch, capsys):
    """No file may have a byte."""
    root, _ = data
    assert run(root, name) == 0
    capsys.readouterr()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        assert run(root, name) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "json: cannot be written (File too large)" in capsys.readouterr().err


BAD_CACHES = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[:200]),
    "text": lambda path: path.write_text("no archive"),
    "empty": lambda path: path.write_bytes(b""),
    "flipped": lambda path: path.write_bytes(bytes(b ^ (i % 97 == 0) for i, b in enumerate(path.read_bytes()))),
    "pickle": lambda path: saved(path, vertices=np.array([{"a": print}], dtype=object)),
    "NaN": lambda path: saved(path, vertices=np.full((8, 3), np.nan)),
    "huge": lambda path: saved(path, vertices=np.full((8, 3), 1e300)),
    "two columns": lambda path: saved(path, vertices=np.zeros((12, 2))),
    "integers": lambda path: saved(path, vertices=np.zeros((8, 3), dtype=int)),
    "other counts": lambda path: saved(path, counts=np.array([4, 40])),
    "negative counts": lambda path: saved(path, counts=np.array([12, -4])),
    "a report of text": lambda path: saved(path, report="[]"),
    "another report": lambda path: saved(path, report=json.dumps({"method": "convex"})),
    "a bomb": lambda path: saved(path, vertices=np.zeros((5_000_000, 3))),
}


def saved(path, **changed):
    with np.load(path) as whole:
        np.savez_compressed(path, **{**whole, **changed})


@pytest.mark.parametrize("kind", BAD_CACHES)
def test_a_cache_that_was_tampered_with_is_computed_anew(tmp_path, monkeypatch, kind, caplog):
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path))
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    whole = decompose(box)
    (path,) = tmp_path.glob("decompose/*.npz")
    BAD_CACHES[kind](path)
    again = decompose(box)
    assert np.array_equal(again.hulls[0], whole.hulls[0])
    assert "computed anew" in caplog.text
    caplog.clear()
    assert decompose(box).report == again.report
    assert not caplog.text
