"""python-fcl in a process of its own: whatever happens to that process, distances are the same and the run goes on."""

import atexit
import contextlib
import logging
import os
import random
import signal
import sys
import threading
import time

import pytest
import torch
from faults import ended, exit_code, forked
from test_fcl import PARTS, assert_exact, contacts

from physpose_torch.config import PhysicsConfig, RefinerConfig
from physpose_torch.distance import fcl_isolated as module
from physpose_torch.distance.autograd import backends, signed_distance
from physpose_torch.distance.fcl import fcl_distance
from physpose_torch.distance.fcl_isolated import isolated_distance
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene, Static

SAME = 1e-9
"""[m]; how far distances may be from those without a fault."""


@pytest.fixture(autouse=True)
def worker():
    """A new one for each test, which leaves no process behind."""
    module._workers.clear()
    yield lambda: module._workers[os.getpid()]._process
    for worker in module._workers.values():
        worker.end()
    module._workers.clear()


def faulty(monkeypatch, fault, *, limit=0.6):
    """Workers that do something before they answer their k-th query; ``k`` counts from 0 in each."""
    code = f"""
import itertools, os, signal, sys, time
from physpose_torch.distance import fcl_worker as w
answer, count = w.nearest_points, itertools.count()
def nearest_points(*query):
    k = next(count)
    {fault}
    return answer(*query)
w.nearest_points = nearest_points
w.main()
"""
    monkeypatch.setattr(module, "_command", [sys.executable, "-P", "-c", code])
    monkeypatch.setattr(module, "LIMIT_S", limit)


def queries(count, size=20):
    """Pairs of parts apart, touching and deep."""
    for seed in range(count):
        gap = (1e-2, 1e-6, 0.0, -1e-9, -1e-3, 1e-3)[seed % 6]
        yield contacts(gap, size, seed)[:3]


def assert_same(query):
    """Distances are, and normals unless parts touch; witness points, which may be any of many, face each other."""
    expected, found = fcl_distance(PARTS, *query), isolated_distance(PARTS, *query)
    clear = expected[0].abs() > 2e-6
    torch.testing.assert_close(found[1][clear], expected[1][clear], atol=SAME, rtol=0.0)
    assert_exact(PARTS, *query, expected[0], atol=SAME, of=lambda *_: found)


def test_without_a_fault_the_result_is_that_of_fcl_to_the_bit(worker):
    for query in queries(6):
        for a, b in zip(isolated_distance(PARTS, *query), fcl_distance(PARTS, *query), strict=True):
            assert torch.equal(a, b)
        process = worker()
    assert worker() is process  # one for all


def test_it_is_a_backend_like_the_others():
    assert "fcl-isolated" in backends()
    pairs, R, t = next(queries(1))
    T = torch.eye(4, dtype=torch.float64).repeat(len(pairs), 1, 1)
    T_b = T.clone()
    T_b[:, :3, :3], T_b[:, :3, 3] = R, t
    found = [signed_distance(T, T_b, PARTS, pairs, backend=name) for name in ("fcl", "fcl-isolated")]
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b)


FAULTS = {
    "abort": "os.abort()",
    "segmentation fault": "os.kill(os.getpid(), signal.SIGSEGV)",
    "kill": "os.kill(os.getpid(), signal.SIGKILL)",
    "exit": "os._exit(0)",
    "hang": "time.sleep(60)",
    "stopped": "os.kill(os.getpid(), signal.SIGSTOP)",
    "exception": "raise RuntimeError",
    "torn answer": "os.write(3, b'\\x80\\x04torn'); os._exit(0)",
    "other answer": "return None",
    "not a number": "return answer(*query) * float('nan')",
}


@pytest.mark.parametrize("fault", ["abort", "hang"])
def test_a_worker_that_fails_once_is_started_anew_and_nothing_is_said(monkeypatch, caplog, fault):
    faulty(monkeypatch, f"if k == 2: {FAULTS[fault]}")
    for query in queries(4):
        assert_same(query)
    assert not caplog.records


@pytest.mark.parametrize("fault", FAULTS)
def test_where_workers_fail_again_torch_answers_the_same_with_one_warning(monkeypatch, caplog, fault):
    faulty(monkeypatch, FAULTS[fault], limit=0.3)
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        for query in queries(3):
            assert_same(query)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == (fault != "not a number")
    if told:
        assert "python-fcl failed twice (" in told[0]


def test_workers_that_always_fail_are_not_started_for_ever(monkeypatch):
    faulty(monkeypatch, FAULTS["exit"])
    started, start = [], module._start
    monkeypatch.setattr(module, "_start", lambda: started.append(1) or start())
    for query in queries(6):
        assert_same(query)
    assert len(started) == 2 * module.GIVE_UP


def test_a_worker_that_cannot_be_started_means_torch(monkeypatch, caplog):
    monkeypatch.setattr(module, "_command", ["/no/such/program"])
    for query in queries(2):
        assert_same(query)
    assert len(caplog.records) == 1


def killed_at_random(runs, kills, rng):
    """Distances while another thread kills workers; how many."""
    stop, killed = threading.Event(), []

    def kill():
        while not stop.is_set() and len(killed) < kills:
            time.sleep(rng.uniform(0, 0.4))
            process = module._workers[os.getpid()]._process if module._workers else None
            if process is not None and process.pid not in killed:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGKILL)
                    killed.append(process.pid)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        for query in runs:
            assert_same(query)
            if len(killed) >= kills:
                break
    finally:
        stop.set()
        killer.join()
    return len(killed)


def test_killed_at_random_moments_the_distances_are_the_same():
    assert killed_at_random(queries(10_000), 5, random.Random(0)) == 5


@pytest.mark.slow
def test_hundreds_of_kills_change_nothing():
    killed = killed_at_random(queries(10_000), 200, random.Random(1))
    print(f"\nfcl's worker: {killed} killed at random moments, distances the same to {SAME} m each time")
    assert killed == 200


@pytest.mark.parametrize("when", ["if k == 3:", ""], ids=["now and then", "always"])
def test_a_refinement_ends_with_the_same_poses_though_its_workers_crash(monkeypatch, table, box, can, when):
    scene = Scene([box, can], [Static(table.plane)], gravity=table.gravity)
    poses = table.poses((0.0, 0.0, 0.015), (0.07, 0.0, 0.05))

    def refined(backend):
        config = RefinerConfig(PhysicsConfig(backend=backend), steps=4)
        return PhysPoseRefiner(config)(poses, scene).poses

    expected = refined("fcl")
    assert (expected - poses).abs().max() > 1e-3
    faulty(monkeypatch, f"{when} os.abort()")
    torch.testing.assert_close(refined("fcl-isolated"), expected, atol=SAME, rtol=0.0)


def test_a_worker_forgets_parts_that_are_gone(worker):
    pair, R, t = (x[:1] for x in next(queries(1)))
    isolated_distance(PARTS, pair, R, t)
    for _ in range(3):
        isolated_distance(ConvexParts.from_hulls([PARTS.part(int(p))[0].numpy() for p in pair[0]]), pair[:, [0, 0]] * 0, R, t)
    assert len(module._workers[os.getpid()]._sent) <= 2


def test_after_ctrl_c_in_a_query_its_answer_is_not_taken_for_the_next_one(monkeypatch, worker):
    faulty(monkeypatch, "if k == 1: os.kill(os.getppid(), signal.SIGINT); time.sleep(0.2)", limit=5.0)
    first, second = queries(2)
    isolated_distance(PARTS, *first)
    with pytest.raises(KeyboardInterrupt):
        isolated_distance(PARTS, *second)
    assert worker() is None
    assert_same(first)


def test_a_forked_process_has_a_worker_of_its_own(worker):
    first, second = queries(2)
    assert_same(first)
    process = worker()

    def work():
        assert_same(second)
        return int(module._workers[os.getpid()]._process.pid == process.pid)

    with forked(work) as pid:
        assert exit_code(pid) == 0
    assert_same(second)
    assert worker() is process




@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="Linux only")
def test_a_worker_ends_with_its_parent(tmp_path):
    def work():
        isolated_distance(PARTS, *next(queries(1)))
        (tmp_path / "pid").write_text(str(module._workers[os.getpid()]._process.pid))
        atexit._run_exitfuncs()
        time.sleep(60)

    with forked(work):
        while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
            time.sleep(0.01)
        assert ended(int((tmp_path / "pid").read_text()))


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="Linux only")
@pytest.mark.parametrize("busy", [False, True])
def test_a_worker_ends_when_its_parent_is_killed(monkeypatch, tmp_path, busy):
    """Also one that is hanging: after the time limit of its query."""
    faulty(monkeypatch, f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep({60 * busy})")
    monkeypatch.setattr(module, "LIMIT_S", -4.0)  # so that the worker's own limit, which is 5 s later, is one second

    def work():
        monkeypatch.setattr(threading.Timer, "start", lambda self: None)
        isolated_distance(PARTS, *next(queries(1)))
        time.sleep(60)

    with forked(work) as pid:
        while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
            time.sleep(0.01)
        time.sleep(0.1)
        os.kill(pid, signal.SIGKILL)
        assert exit_code(pid) == -signal.SIGKILL
    assert ended(int((tmp_path / "pid").read_text()))
