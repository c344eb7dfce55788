"""``physpose refine --engine ray``: on a cluster the result is that of one process, whoever dies on the way."""

import contextlib
import json
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
from bop_files import HEADER, OFFSET_MM, UP, csv_row, standing, write_models, write_scene

from physpose_torch.__main__ import main
from physpose_torch.commands.batches import Batch
from physpose_torch.commands.engines import ATTEMPTS, refine_on_ray
from physpose_torch.errors import PhysPoseError

ray = pytest.importorskip("ray", reason="needs the extra: pip install 'physpose-torch[ray]'")
pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="looks for workers in /proc")
MOST = 12


@pytest.fixture(scope="module")
def cluster():
    """Two workers on this machine."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import the tests
    ray.init(num_cpus=2, include_dashboard=False, logging_level="ERROR", log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture
def dataset(tmp_path):
    """40 images of one to twelve boxes side by side, 2 % too far away, and some that cannot be refined."""
    write_models(tmp_path / "models")
    write_scene(tmp_path / "test", 2, {0: []}, width=640)
    rng, rows = random.Random(0), []
    for im in range(40):
        for x in range(rng.choice([1, 2, MOST])):
            T = standing(-900 + 150 * x, rng.uniform(-20, 20), 50)
            T[:3, 3] *= 1.02
            rows.append(csv_row(2, im, 1, 0.9, T))
    rows += [csv_row(2, 7, 77, 0.9, standing(0, 0, 50)), csv_row(2, 50, 1, "nan", standing(0, 0, 50)), "gibberish"]
    rng.shuffle(rows)
    (tmp_path / "est.csv").write_text("\n".join([HEADER, *rows]))
    plane = {"normal": UP.tolist(), "offset_mm": OFFSET_MM}
    (tmp_path / "planes.json").write_text(json.dumps({"2": {str(im): plane for im in range(50) if im != 17}}))
    return tmp_path


def arguments(root, out, *more):
    options = ["--dataset", root, "--planes", root / "planes.json", "--out", root / out, "--json", root / f"{out}.json"]
    return ["refine", *map(str, [root / "est.csv", *options, "--quiet", "--batch", "2", *more])]


def result(root, out):
    """All columns but time, and the summary but for seconds."""
    summary = json.loads((root / f"{out}.json").read_text())
    del summary["seconds_per_image"]
    return [line.rsplit(",", 1)[0] for line in (root / out).read_text().splitlines()], summary


@pytest.fixture
def alone(dataset):
    """What one process makes of it."""
    assert main(arguments(dataset, "alone.csv")) == 1
    return result(dataset, "alone.csv")


def workers():
    """Process ids of Ray's workers that refine."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if b"_refine_on_worker" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return found


def journal_of(root, out="out.csv"):
    with contextlib.suppress(FileNotFoundError):
        return (root / f"{out}.journal").read_bytes().count(b'{"rows"')
    return 0


def test_the_result_is_that_of_one_process(dataset, alone, cluster):
    assert main(arguments(dataset, "out.csv", "--engine", "ray")) == 1
    assert result(dataset, "out.csv") == alone
    assert len(alone[1]["problems"]) == 4


def test_a_worker_that_is_killed_loses_nothing(dataset, alone, cluster):
    killed = []

    def kill():
        while not killed or (len(killed) < 3 and running.is_alive()):
            if journal_of(dataset) >= 1 + 4 * len(killed) and (found := workers()):
                os.kill(found[0], signal.SIGKILL)
                killed.append(found[0])
            time.sleep(0.005)

    running, killer = threading.main_thread(), threading.Thread(target=kill, daemon=True)
    killer.start()
    code = main(arguments(dataset, "out.csv", "--engine", "ray", "--config.steps", "40"))
    assert code == 1
    assert len(killed) >= 1
    assert result(dataset, "out.csv") == alone


class _Fatal:
    """Refines nothing, and kills the worker that gets batch 3, as often as the files allow."""

    def __init__(self, folder, times):
        self.folder, self.times, self.index = folder, times, self

    def names(self, numbers):
        return [(0, int(n)) for n in numbers]

    def __call__(self, numbers):
        begun = sum(p.name.startswith(f"{numbers[0]}-") for p in self.folder.iterdir())
        (self.folder / f"{numbers[0]}-{begun}").touch()
        if numbers[0] == 3 and begun < self.times:
            os.kill(os.getpid(), signal.SIGKILL)
        return Batch([(int(numbers[0]), "done")], {})


@pytest.mark.slow
def test_a_batch_whose_worker_dies_is_begun_again(tmp_path, cluster, caplog):
    found = list(refine_on_ray(_Fatal(tmp_path, ATTEMPTS - 1), [np.array([n]) for n in range(6)]))
    assert [b.rows for b in found] == [[[n, "done"]] for n in range(6)]
    assert "a worker died; batch 3 is begun again" in caplog.messages


class _Wrong(_Fatal):
    def __call__(self, numbers):
        raise self.times


@pytest.mark.parametrize(
    ("error", "told"), [(ValueError("no such thing"), "no such thing"), (OSError("no disk"), "on .*: no disk")], ids=str
)
def test_what_is_wrong_on_a_worker_is_told_in_a_line(tmp_path, cluster, error, told):
    with pytest.raises(PhysPoseError, match=f"^--engine ray.*{told}"):
        list(refine_on_ray(_Wrong(tmp_path, error), [np.array([n]) for n in range(2)]))


def test_a_batch_that_kills_every_worker_is_left_alone_and_the_others_are_not(tmp_path, cluster):
    found = list(refine_on_ray(_Fatal(tmp_path, 99), [np.array([n]) for n in range(6)]))
    assert [b.rows for b in found] == [[[n, "done"]] if n != 3 else [] for n in range(6)]
    assert found[3].record["problems"] == [f"scene 0 image 3: killed its worker {ATTEMPTS} times; try --engine local"]
    assert found[3].record["images"] == 1
    assert found[3].record["refined"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("first", [[], ["--engine", "ray"]], ids=["local, then ray", "ray, then local"])
def test_a_run_that_was_stopped_goes_on_with_another_engine(dataset, alone, cluster, monkeypatch, first):
    commit, then = refining_journal().commit, [] if first else ["--engine", "ray"]

    def stopping(self, *args):
        if self.committed == 5:
            raise KeyboardInterrupt
        commit(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(refining_journal(), "commit", stopping)
        assert main(arguments(dataset, "out.csv", *first)) == 130
    assert journal_of(dataset) == 5
    assert main(arguments(dataset, "out.csv", "--resume", *then)) == 1
    assert result(dataset, "out.csv") == alone


def refining_journal():
    from physpose_torch.bop.journal import Journal

    return Journal


@pytest.mark.slow
def test_a_file_that_changes_meanwhile_is_told(dataset, cluster, capsys, monkeypatch):
    commit = refining_journal().commit

    def changing(self, *args):
        (dataset / "est.csv").write_text((dataset / "est.csv").read_text() + "\n")
        commit(self, *args)

    monkeypatch.setattr(refining_journal(), "commit", changing)
    assert main(arguments(dataset, "out.csv", "--engine", "ray")) == 2
    assert "est.csv: the file was changed while it was being read; start again" in capsys.readouterr().err
    assert not (dataset / "out.csv").exists()


def test_workers_cannot_read_a_pipe(dataset, cluster, capsys):
    read, write = os.pipe()
    os.write(write, (dataset / "est.csv").read_bytes()[:20000])
    os.close(write)
    args = arguments(dataset, "out.csv", "--engine", "ray")
    args[1] = f"/dev/fd/{read}"
    assert main(args) == 2
    assert "is a pipe, which other processes cannot read; save it to a file" in capsys.readouterr().err


def test_without_ray_the_extra_is_named(dataset, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(arguments(dataset, "out.csv", "--engine", "ray")) == 2
    assert "pip install 'physpose-torch[ray]'" in capsys.readouterr().err


@pytest.mark.parametrize("more", [["--workers", "2"], ["--engine", "ray", "--workers", "0"]])
def test_workers_are_a_positive_number_and_rays(dataset, more, capsys):
    assert main(arguments(dataset, "out.csv", *more)) == 2
    assert "expected a positive number, and --engine ray" in capsys.readouterr().err


def test_nothing_chosen_needs_no_cluster(dataset, monkeypatch):
    monkeypatch.setattr(ray, "init", None)
    args = arguments(dataset, "out.csv", "--engine", "ray", "--scenes", "5")
    assert main(args) == 1  # a row of no image
    assert (dataset / "out.csv").read_bytes() == (dataset / "est.csv").read_bytes()


def test_the_benchmark_tells_rates_and_differences(dataset, cluster, capsys):
    from physpose_torch.bench.__main__ import main as bench

    args = ["engines", dataset / "est.csv", "--dataset", dataset, "--planes", dataset / "planes.json", "--preset", "lm"]
    assert bench([*map(str, args), "--batch", "8", "--workers", "2", "--json", str(dataset / "bench.json")]) == 0
    here, there = json.loads((dataset / "bench.json").read_text())["engines"]
    assert (here["workers"], there["workers"]) == (0, 2)
    assert there["images_per_second"] > 0
    assert (there["rows_that_differ"], there["difference_mm"]) == (0, 0.0)
    assert "Ray, 2 workers" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_when_asked_to_stop_it_says_so_and_leaves_no_process(dataset, sign):
    long = ("--config.steps", "2000", "--config.tolerance", "0")
    command = [sys.executable, "-m", "physpose_torch", *arguments(dataset, "out.csv", "--engine", "ray", *long)]
    environment = {**os.environ, "RAY_ADDRESS": "local"}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and journal_of(dataset) < 2:
            time.sleep(0.01)
        process.send_signal(sign)
        message = process.stderr.read()
    assert process.returncode == 130
    assert "images are done; the same command with --resume goes on" in message
    assert not workers()
    assert not (dataset / "out.csv").exists()


@pytest.mark.slow
def test_machines_come_and_go_and_the_result_is_the_same(dataset):
    """Four machines, of which one loses a worker and another is lost altogether, while a fifth one joins."""
    from ray.cluster_utils import Cluster

    assert main(arguments(dataset, "alone.csv", "--batch", "1")) == 1
    machines = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    lost = [machines.add_node(num_cpus=1) for _ in range(3)][-1]
    machines.wait_for_nodes()
    events = [
        lambda: os.kill(random.choice(workers()), signal.SIGKILL),
        lambda: machines.remove_node(lost, allow_graceful=False),
        lambda: machines.add_node(num_cpus=1),
    ]
    environment = {**os.environ, "RAY_ADDRESS": machines.address, "RAY_USAGE_STATS_ENABLED": "0"}
    command = [sys.executable, "-m", "physpose_torch", *arguments(dataset, "out.csv", "--batch", "1", "--engine", "ray")]
    try:
        with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
            while events and process.poll() is None:
                if journal_of(dataset) >= 4 * (4 - len(events)) and workers():
                    with contextlib.suppress(IndexError):  # in a moment without work
                        events[0]()
                        del events[0]
                time.sleep(0.01)
            message = process.stderr.read()
    finally:
        machines.shutdown()
    assert not events, message
    assert process.returncode == 1, message
    assert result(dataset, "out.csv") == result(dataset, "alone.csv")
