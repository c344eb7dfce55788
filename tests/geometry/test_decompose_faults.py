"""Convex decomposition under faults: kills, full disks, caches that cannot be used or are shared: the parts are the same."""

import contextlib
import json
import logging
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from faults import children, command, exit_code, files, forked, full_disk, gone
from test_decompose import CRASH, HANG, box, l_shape

from physpose_torch.__main__ import main
from physpose_torch.files import one_at_a_time
from physpose_torch.geometry import decompose as module
from physpose_torch.geometry.decompose import decompose

COACD = "run_coacd"
pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="Linux only")


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    monkeypatch.setattr(module, "_warned", set())
    monkeypatch.setattr(module, "_unwritable", set())


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Call it to use another, empty cache."""

    def use(name):
        monkeypatch.setenv("PHYSPOSE_CACHE", str(tmp_path / name))
        return tmp_path / name / "decompose"

    use("cache")
    return use


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A box (one part), and two brackets, which CoACD cuts within half a second each."""
    folder = tmp_path_factory.mktemp("faults") / "meshes"
    folder.mkdir()
    large = l_shape()
    large.apply_scale(1.3)
    for name, mesh in {"box": box(), "bracket": l_shape(), "large": large}.items():
        mesh.export(folder / f"{name}.stl")
    return folder


def arguments(meshes, out="out.json"):
    return ["decompose", meshes, "--scale", "1", "--json", meshes.parent / out, "--workers", "2", "--quiet"]


def run(meshes, **options):
    return main([*map(str, arguments(meshes, **options))])


def content(folder):
    """All that the files of a cache say but how long it took, by file; an error if one is not whole."""
    found = {}
    for path in folder.glob("*.npz"):
        with np.load(path, allow_pickle=False) as data:
            assert data.zip.testzip() is None
            report = json.loads(str(data["report"]))
            del report["seconds"]
            found[path.name] = (data["vertices"].tobytes(), data["counts"].tolist(), report)
    return found


def summary(path):
    """What --json says but how long it took."""
    told = json.loads(path.read_text())
    for report in told["meshes"].values():
        del report["seconds"]
    return told


@pytest.fixture(scope="module")
def undisturbed(meshes):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PHYSPOSE_CACHE", str(meshes.parent / "undisturbed"))
        assert run(meshes, out="undisturbed.json") == 0
    expected = content(meshes.parent / "undisturbed" / "decompose")
    assert sorted(report["method"] for _, _, report in expected.values()) == ["coacd", "coacd", "convex"]
    return expected, summary(meshes.parent / "undisturbed.json")


def age(folder):
    """Make all temporary files as old as those that count as abandoned."""
    for path in folder.rglob("*.tmp"):
        os.utime(path, (0, 0))


def kill_and_rerun(meshes, cache, undisturbed, kills, rng):
    """Kill so many runs, a few on each cache, and let one come to its end there. How many kills, ends, orphans that died by
    themselves, temporary files left, and entries that were found after kills."""
    count = dict.fromkeys(("killed", "ended", "orphans", "left", "entries"), 0)
    expected, told = undisturbed
    out, length = meshes.parent / "out.json", 0.0
    while count["killed"] < kills:
        folder, here = cache(str(count["ended"])), rng.randrange(3, 9) if length else 0
        out.unlink(missing_ok=True)
        code = None
        while code is None:
            start = time.monotonic()
            with forked(command(*arguments(meshes))) as pid:
                code = exit_code(pid, within=rng.uniform(0, length) if here else None)
                if code is None:
                    os.kill(pid, signal.SIGKILL)
                    code = exit_code(pid)  # it may have come to its end in between
                    if code == -signal.SIGKILL:
                        code = None
                        count["killed"], here = count["killed"] + 1, here - 1
            count["orphans"] += len(children(COACD, pid))
            assert gone(COACD, pid)
            found = content(folder)
            assert found.items() <= expected.items()
            assert not out.exists() or summary(out) == told
            count["entries"] += len(found) if code is None else 0
            count["left"] += len(list(folder.rglob("*.tmp")))
            age(folder)  # as if an hour had passed
        length = length or time.monotonic() - start
        count["ended"] += 1
        assert (code, found) == (0, expected)
        assert out.exists()
    (folder / next(iter(found))).unlink()
    assert run(meshes) == 0
    assert files(folder, "*.npz") == sorted(expected)
    assert files(meshes.parent, ".*.tmp") == []
    return count


def test_killed_at_random_moments_the_cache_is_never_torn_and_a_rerun_gives_the_same(cache, meshes, undisturbed):
    count = kill_and_rerun(meshes, cache, undisturbed, 10, random.Random(0))
    assert count["entries"] > 0
    assert count["orphans"] > 0


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_hundred_kills_and_more_change_nothing(cache, meshes, undisturbed):
    count = kill_and_rerun(meshes, cache, undisturbed, 120, random.Random(1))
    print(f"\ndecompose: {count}, same result after each, 0 files and 0 processes left behind")


def test_killed_while_an_entry_is_written_nothing_of_it_is_read_and_an_hour_later_it_is_removed(cache, monkeypatch):
    folder = cache("cache")

    def torn(file, **arrays):
        file.write(b"PK\x03\x04 the beginning of it")
        file.flush()
        os.kill(os.getpid(), signal.SIGKILL)

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", torn)
        with forked(lambda: decompose(box()).report.n_parts) as pid:
            assert exit_code(pid) == -signal.SIGKILL
    lock, torn = sorted(files(folder), key=len)
    assert lock.endswith(".lock")
    assert torn.endswith(".tmp")
    decompose(box())
    assert torn in files(folder)  # it may be that of a process that is writing now
    assert len(files(folder)) == 2
    age(folder)
    decompose(l_shape())
    assert [Path(name).suffix for name in files(folder)] == [".npz", ".npz"]


def test_a_lock_of_any_age_stays_while_somebody_has_it(cache):
    folder, held = cache("cache"), threading.Event()
    with one_at_a_time(folder / "made.npz", patience=0, stop=held):
        for path in folder.iterdir():
            os.utime(path, (0, 0))
        decompose(box())
        assert files(folder, ".made*") == [".made.npz.lock"]


def test_a_child_that_is_slow_to_start_gets_all_of_a_large_mesh(cache, monkeypatch):
    """More than a pipe holds, 64 KiB."""
    slow = module._CHILD.replace("import coacd, numpy", "time.sleep(0.5); import coacd, numpy")
    monkeypatch.setattr(module, "_child_command", [sys.executable, "-P", "-c", slow])
    mesh = l_shape()
    while len(mesh.faces) < 1500:
        mesh = mesh.subdivide()
    assert decompose(mesh, module.DecomposeOptions(time_limit_s=30, max_faces=10_000)).report.method == "coacd"


def test_the_child_of_a_killed_process_ends_by_itself(cache, monkeypatch):
    hang = module._CHILD.replace("import coacd, numpy", "time.sleep(60)")
    monkeypatch.setattr(module, "_child_command", [sys.executable, "-P", "-c", hang])
    with forked(lambda: decompose(l_shape()).report.n_parts) as pid:
        while not children("time.sleep(60)", pid):
            time.sleep(0.02)
        time.sleep(0.2)
        os.kill(pid, signal.SIGKILL)
        exit_code(pid)
    assert gone("time.sleep(60)", pid)


def kill_children(times, delay, stop):
    """Kill the CoACD children of this process, the first so many, some seconds after each was seen; returns how many."""
    killed = set()
    while len(killed) < times and not stop.is_set():
        for pid in set(children(COACD, os.getpid())) - killed:
            time.sleep(delay)
            with contextlib.suppress(ProcessLookupError):  # it was quicker
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
            break
        time.sleep(0.001)
    return len(killed)


def decompose_killing(mesh, times, delay):
    stop, count = threading.Event(), []
    killer = threading.Thread(target=lambda: count.append(kill_children(times, delay, stop)))
    killer.start()
    try:
        result = decompose(mesh)
    finally:
        stop.set()
        killer.join()
    return result, count


def kill_child_once(cache, kills, rng):
    """CoACD's child killed once in each of so many runs: how many still saw it in time."""
    expected, hit = np.concatenate(decompose(l_shape(), cache=False).hulls), 0
    for k in range(kills):
        folder = cache(f"child {k}")
        result, count = decompose_killing(l_shape(), 1, rng.uniform(0, 0.3))
        hit += sum(count)
        np.testing.assert_array_equal(np.concatenate(result.hulls), expected)
        assert result.report.warning is None
        assert len(content(folder)) == 1
    return hit


def test_a_child_that_is_killed_once_gets_a_second_chance_and_the_parts_are_the_same(cache):
    assert kill_child_once(cache, 2, random.Random(0)) > 0


@pytest.mark.slow
def test_a_hundred_killed_children_change_nothing(cache):
    hit = kill_child_once(cache, 100, random.Random(1))
    print(f"\nCoACD's child: {hit} killed, same parts each time")
    assert hit > 50


def test_a_child_that_is_killed_again_means_the_hull_for_now(cache):
    folder = cache("cache")
    with pytest.warns(UserWarning, match="code -9; its convex hull is used instead"):
        result, _ = decompose_killing(l_shape(), 10, 0.0)
    assert (result.report.method, result.report.n_parts) == ("hull", 1)
    assert files(folder) == []
    assert decompose(l_shape()).report.n_parts == 2


def test_a_kill_between_two_cuts_does_not_make_coarser_parts_stick(cache, monkeypatch):
    """The first cut is not fine enough here, and the second one is killed."""
    folder, ask = cache("cache"), module._ask_child

    def killed(*args, threshold, **settings):
        if threshold < 2.5e-3:
            raise module._KilledError("CoACD's process ended with code -9")
        return ask(*args, threshold=threshold, **settings)

    measure = module.fewest_parts
    monkeypatch.setattr(module, "_ask_child", killed)
    monkeypatch.setattr(
        module, "fewest_parts", lambda *a, **k: (lambda parts, e: (parts, e | {"outward_p95": 2e-3}))(*measure(*a, **k))
    )
    with pytest.warns(UserWarning, match="coarser than they could be"):
        report = decompose(l_shape(), name="bracket").report
    assert report.method == "coacd"
    assert report.warning.startswith("bracket: ")
    assert files(folder) == []


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_when_asked_to_stop_it_says_so_keeps_what_is_done_and_leaves_no_process(cache, meshes, monkeypatch, sign):
    folder, log = cache("cache"), meshes.parent / "stderr"
    monkeypatch.setattr(module, "_child_command", HANG)
    with forked(command(*arguments(meshes, out="stopped.json")), stderr=log) as pid:
        while not any(folder.glob("*.npz")):
            time.sleep(0.01)
        os.kill(pid, sign)
        start = time.monotonic()
        assert exit_code(pid) == 130
        assert time.monotonic() - start < 30
    assert log.read_text() == "physpose: interrupted\n"
    assert gone("time.sleep(60)", pid, within=0)
    assert len(content(folder)) == 1
    assert not (meshes.parent / "stopped.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_real_process_that_is_stopped_leaves_no_process_and_a_whole_cache(cache, meshes, undisturbed, sign):
    rng = random.Random(2)
    for k in range(5):
        folder = cache(f"cache {k}")
        args = [sys.executable, "-m", "physpose_torch", *map(str, arguments(meshes))]
        with subprocess.Popen(args, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
            while not folder.exists() and not children(COACD, process.pid):
                time.sleep(0.01)
            time.sleep(rng.uniform(0, 0.8))
            os.killpg(process.pid, sign)  # as a terminal does
            message = process.stderr.read()
        assert process.returncode in ((0, -sign) if sign == signal.SIGKILL else (0, 130))
        assert message == ("physpose: interrupted\n" if process.returncode == 130 else "")
        assert gone(COACD, process.pid)
        assert content(folder).items() <= undisturbed[0].items()
        assert run(meshes) == 0
        assert content(folder) == undisturbed[0]


@pytest.mark.parametrize("way", ["full", "a file in its place", "below a file", "no home", "not allowed"])
def test_without_a_usable_cache_the_parts_are_the_same_and_it_is_said_once(
    cache, meshes, undisturbed, tmp_path, monkeypatch, caplog, way
):
    folder, size = cache("other"), None
    if way == "full":
        size = 100
    elif way == "a file in its place":
        folder.parent.mkdir()
        folder.touch()
    elif way == "below a file":
        folder.parent.touch()
    elif way == "no home":
        monkeypatch.delenv("PHYSPOSE_CACHE")
        monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as it does for a user who has none
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.chdir(tmp_path)
    else:
        monkeypatch.setenv("PHYSPOSE_CACHE", "/proc/physpose")  # where root may not write, either
    before = files(tmp_path)
    parts = {}
    with caplog.at_level(logging.WARNING, "physpose_torch"), full_disk(size) if size else pytest.MonkeyPatch.context():
        for name, result in module.decompose_many({name: meshes / name for name in ("box.stl", "bracket.stl")}):
            parts[name] = result.report._replace(seconds=0)._asdict()
    assert parts == {name: undisturbed[1]["meshes"][name] | {"seconds": 0} for name in parts}
    assert caplog.text.count("set PHYSPOSE_CACHE to a writable folder") == 1
    assert len(caplog.records) == 1
    assert files(tmp_path) == before


def test_a_read_only_cache_is_read(cache, meshes, undisturbed, caplog, monkeypatch):
    monkeypatch.setenv("PHYSPOSE_CACHE", str(meshes.parent / "undisturbed"))
    monkeypatch.setattr(module, "replacing", None)
    monkeypatch.setattr(module, "_cut", None)
    assert run(meshes) == 0
    assert not caplog.records


def test_a_full_disk_for_the_report_is_told_by_its_path_and_the_old_one_is_kept(meshes, undisturbed, monkeypatch, capsys):
    monkeypatch.setenv("PHYSPOSE_CACHE", str(meshes.parent / "undisturbed"))
    out = meshes.parent / "out.json"
    out.write_text("what was there before")
    with full_disk(100):
        assert run(meshes) == 2
    assert f"{out}: cannot be written (File too large)" in capsys.readouterr().err
    assert out.read_text() == "what was there before"
    assert files(meshes.parent, ".*.tmp") == []


def tampered(data, rng):
    """A cache file with a fault: cut off, a few bytes written over, a piece gone or doubled, or its zeros."""
    kind, at = rng.randrange(5), rng.randrange(len(data))
    if kind == 0:
        return data[:at]
    if kind == 1:
        out = bytearray(data)
        for _ in range(rng.randrange(1, 4)):
            out[rng.randrange(len(out))] ^= rng.randrange(1, 256)
        return bytes(out)
    if kind == 2:
        return data[:at] + data[at + rng.randrange(1, 200) :]
    if kind == 3:
        return data[:at] + data[max(at - rng.randrange(1, 200), 0) :]
    return data[:at] + bytes(len(data) - at)


def try_damaged(cache, count, rng):
    """Damaged entries: the same parts come back each time; how many damages were noticed and mended."""
    folder = cache("cache")
    expected = decompose(box())
    (path,) = folder.glob("*.npz")
    good, noticed = path.read_bytes(), 0
    for _ in range(count):
        bad = tampered(good, rng)
        path.write_bytes(bad)
        np.testing.assert_array_equal(decompose(box()).hulls[0], expected.hulls[0])
        if path.read_bytes() != bad:
            noticed += 1
            assert len(content(folder)) == 1
    return noticed


def test_a_damaged_entry_is_computed_anew_and_replaced(cache, caplog):
    noticed = try_damaged(cache, 15, random.Random(0))
    assert noticed > 12
    assert caplog.text.count("computed anew") == noticed


@pytest.mark.slow
def test_a_thousand_damaged_entries_are_noticed_or_harmless(cache):
    noticed = try_damaged(cache, 1000, random.Random(1))
    print(f"\ncache: 1000 damaged entries, {noticed} noticed and replaced, same parts each time")


@pytest.mark.parametrize(
    "change",
    [
        lambda entry: entry | {"vertices": np.full_like(entry["vertices"], np.nan)},
        lambda entry: entry | {"vertices": entry["vertices"][:, :2]},
        lambda entry: entry | {"vertices": entry["vertices"].astype(np.float32)},
        lambda entry: entry | {"counts": np.array([3, 5])},
        lambda entry: entry | {"report": json.dumps({"method": "convex"})},
        lambda entry: entry | {"report": "[]"},
        lambda entry: {"vertices": entry["vertices"]},
    ],
    ids=["nan", "flat", "float32", "few", "short report", "other report", "no report"],
)
def test_an_entry_that_says_something_else_is_computed_anew_and_replaced(cache, caplog, change):
    folder = cache("cache")
    expected = decompose(box())
    (path,) = folder.glob("*.npz")
    before = content(folder)
    with np.load(path) as data:
        entry = dict(data)
    np.savez_compressed(path, **change(entry))
    np.testing.assert_array_equal(decompose(box()).hulls[0], expected.hulls[0])
    assert "computed anew" in caplog.text
    assert content(folder) == before


def fill_at_once(meshes, cache, undisturbed, processes, rounds):
    for k in range(rounds):
        folder = cache(f"shared {k}")
        with contextlib.ExitStack() as stack:
            work = [command(*arguments(meshes, out=f"{p}.json")) for p in range(processes)]
            pids = [stack.enter_context(forked(w, stderr=meshes.parent / f"stderr {p}")) for p, w in enumerate(work)]
            assert [exit_code(pid) for pid in pids] == [0] * processes
        for p in range(processes):
            assert (meshes.parent / f"stderr {p}").read_text() == ""
            assert summary(meshes.parent / f"{p}.json") == undisturbed[1]
        told = [json.loads((meshes.parent / f"{p}.json").read_text())["meshes"] for p in range(processes)]
        for mesh in told[0]:  # made once, by one of them
            assert len({report[mesh]["seconds"] for report in told}) == 1
        assert content(folder) == undisturbed[0]
        assert [name for name in files(folder) if not name.endswith(".npz")] == []


def test_two_processes_that_fill_one_cache_at_once_get_the_same(cache, meshes, undisturbed):
    fill_at_once(meshes, cache, undisturbed, 2, 1)


@pytest.mark.slow
def test_eight_processes_that_fill_one_cache_at_once_get_the_same(cache, meshes, undisturbed):
    fill_at_once(meshes, cache, undisturbed, 8, 4)
    print("\ncache: 4 rounds of 8 processes, same result in all 32, no warning, nothing left behind")


@pytest.mark.parametrize("answer", ["", "PK", "hello"])
def test_an_answer_that_cannot_be_read_means_the_hull_for_now(cache, monkeypatch, answer):
    folder = cache("cache")
    monkeypatch.setattr(module, "_child_command", [sys.executable, "-c", f"print({answer!r}, end='')"])
    with pytest.warns(UserWarning, match="answer cannot be read"):
        assert decompose(l_shape()).report.method == "hull"
    assert files(folder) == []


@pytest.mark.parametrize(
    ("child", "message"),
    [
        (["/no/such/program"], "cannot be started"),
        ([sys.executable, "-c", "raise MemoryError"], "MemoryError; its convex hull"),
        ([sys.executable, "-c", "import os; os.write(2, b'std::bad_alloc'); os.abort()"], "bad_alloc; its convex hull"),
    ],
    ids=["not started", "MemoryError", "bad_alloc"],
)
def test_a_child_for_which_there_is_no_room_means_the_hull_for_now(cache, monkeypatch, child, message):
    folder = cache("cache")
    monkeypatch.setattr(module, "_child_command", child)
    with pytest.warns(UserWarning, match=message):
        assert decompose(l_shape()).report.method == "hull"
    assert files(folder) == []


def test_a_crash_is_not_tried_twice(cache, monkeypatch):
    """CoACD's asserts depend on nothing but the mesh; the other way to prepare it is tried, though."""
    started = []
    popen = subprocess.Popen
    monkeypatch.setattr(module, "_child_command", CRASH)
    monkeypatch.setattr(module.subprocess, "Popen", lambda *a, **k: started.append(1) or popen(*a, **k))
    with pytest.warns(UserWarning, match="code -6"):
        decompose(l_shape())
    assert len(started) == 2
