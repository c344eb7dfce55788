"""Warp's kernel cache under faults: read-only, full, damaged, shared or killed while it is filled, distances are the same."""

import contextlib
import logging
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from faults import files, full_disk

from physpose_torch.distance import warp as module
from physpose_torch.errors import BackendError

CPU = torch.device("cpu")
PROGRAM = """
import torch
from physpose_torch import Body, Scene, signed_distance
parts = Scene([Body.box((0.1, 0.06, 0.04), label="a"), Body.cylinder(0.03, 0.08, label="b")]).parts
generator = torch.Generator().manual_seed(0)
T = torch.eye(4, dtype=torch.float64).repeat(2, 50, 1, 1)
T[:, :, :3, 3] = 0.1 * torch.rand(2, 50, 3, generator=generator, dtype=torch.float64)
d = signed_distance(T[0], T[1], parts, torch.tensor([[0, 1]] * 50), backend="warp").distance
print(d.numpy().tobytes().hex())
"""
LOOKS_ELSEWHERE = "set WARP_CACHE_PATH to a writable folder"


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Kernels in an empty folder, with no temporary one in use yet; Warp's own is back at the end."""
    module.initialise()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    module._temporary.cache_clear()
    yield tmp_path
    if module._temporary.cache_info().currsize:
        shutil.rmtree(module._temporary(), ignore_errors=True)
    module._temporary.cache_clear()


def fake_module(fails, error=None):
    """A module that cannot be loaded the first times; ``places`` tells from where it was tried."""
    fake = SimpleNamespace(places=[], get_module_identifier=lambda: "wp_fake", mark_modified=lambda: None)

    def load(device):
        fake.places.append(wp.config.kernel_cache_dir)
        if len(fake.places) <= fails:
            raise error
        return object()

    fake.load = load
    return fake


@pytest.mark.parametrize("error", [OSError(30, "Read-only file system"), RuntimeError("damaged")], ids=["OSError", "other"])
def test_where_it_cannot_be_used_a_temporary_folder_is_with_one_warning(elsewhere, caplog, error):
    fakes = [fake_module(1, error), fake_module(0)]
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        for fake in fakes:
            module.load(fake, CPU)
    assert fakes[0].places[0] == str(elsewhere)
    assert fakes[0].places[1] == fakes[1].places[0] == module._temporary()
    assert len(caplog.records) == 1
    assert LOOKS_ELSEWHERE in caplog.text


def test_what_cannot_be_compiled_anywhere_is_an_error(elsewhere):
    fake = fake_module(9, RuntimeError("syntax error"))
    with pytest.raises(BackendError, match="could not compile the distance kernels for cpu: syntax error"):
        module.load(fake, CPU)
    assert len(fake.places) == 2


def test_on_a_full_disk_nothing_is_compiled_as_the_compiler_would_abort_the_process(elsewhere):
    fake = fake_module(0)
    with full_disk(100_000), pytest.raises(BackendError, match=r"File too large; set WARP_CACHE_PATH to .* room"):
        module.load(fake, CPU)
    assert fake.places == []
    assert files(elsewhere) == []
    module.load(fake, CPU)


def test_what_is_compiled_already_is_loaded_from_a_full_disk(elsewhere, caplog):
    (elsewhere / "wp_fake").mkdir()
    fake = fake_module(0)
    with full_disk(0):
        module.load(fake, CPU)
    assert fake.places == [str(elsewhere)]
    assert not caplog.records


def start(cache, *, before="", **env):
    """A process that prints distances, with a kernel cache in a folder."""
    env = {**os.environ, "WARP_CACHE_PATH": str(cache), "PYTHONPATH": os.pathsep.join(p for p in sys.path if p), **env}
    env = {key: value for key, value in env.items() if value is not None}
    return subprocess.Popen(
        [sys.executable, "-c", before + PROGRAM],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env,
    )  # fmt: skip


def result(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return out, err


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A cache that has been filled, and the distances."""
    folder = tmp_path_factory.mktemp("kernels")
    return folder, result(start(folder))[0]


@contextlib.contextmanager
def small_disk(folder, kilobytes):
    """A real one, where one may be mounted."""
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(["mount", *options], capture_output=True).returncode:
        pytest.skip("nothing may be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["below /proc", "a file", "a relative home", "full at once", "full while compiling", "torn"])
def test_in_a_real_process_the_distances_are_the_same(compiled, tmp_path, way):
    cache, more = tmp_path / "cache", {}
    with contextlib.ExitStack() as stack:
        if way == "below /proc":
            cache = Path("/proc/physpose")
        elif way == "a file":
            cache.touch()
        elif way == "a relative home":
            more = {"WARP_CACHE_PATH": None, "HOME": "nowhere", "XDG_CACHE_HOME": None}
        elif way.startswith("full"):
            stack.enter_context(small_disk(cache, 100 if way == "full at once" else 300))
        else:
            shutil.copytree(compiled[0], cache)
            for path in cache.rglob("*.o"):
                os.truncate(path, 20_000)
        out, err = result(start(cache, **more))
    assert out == compiled[1]
    assert err.count(LOOKS_ELSEWHERE) == 1
    assert not Path("nowhere").exists()


@pytest.mark.slow
def test_four_processes_that_fill_it_at_once_get_the_same(compiled, tmp_path):
    found = [result(p) for p in [start(tmp_path / "cache") for _ in range(4)]]
    assert {out for out, _ in found} == {compiled[1]}
    assert not any(LOOKS_ELSEWHERE in err for _, err in found)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_killed_while_it_is_filled_it_is_never_half_filled(compiled, tmp_path):
    """Kills at random moments from when something lies in the cache on."""
    rng, killed = random.Random(0), 0
    for _ in range(6):
        shutil.rmtree(tmp_path / "cache", ignore_errors=True)
        process = start(tmp_path / "cache")
        while not any((tmp_path / "cache").rglob("*.cpp")) and process.poll() is None:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 8))
        killed += process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.communicate()
        out, err = result(start(tmp_path / "cache"))
        assert out == compiled[1]
        assert LOOKS_ELSEWHERE not in err
    print(f"\nkernels: {killed} of 6 processes killed while they compiled, same distances after each")
