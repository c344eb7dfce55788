"""``physpose refine`` over files read a few images at a time: killed, interrupted and resumed, it ends with the same result."""

import contextlib
import itertools
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
import tracemalloc

import pytest
from bop_files import HEADER, OFFSET_MM, UP, csv_row, standing, write_models, write_scene

from physpose_torch.__main__ import main
from physpose_torch.commands import batches as refining
from physpose_torch.commands import refine as module

IMAGES = 24
FEW_STEPS = ("--batch", "2", "--config.steps", "2")


@pytest.fixture
def dataset(tmp_path):
    """24 images of two boxes, 2 % too far away; their rows are shuffled, as in many submissions, and some are bad."""
    root = tmp_path / "data"
    write_models(root / "models")
    write_scene(root / "test", 2, {0: []}, width=640)
    rng = random.Random(0)
    rows = []
    for im, x in itertools.product(range(IMAGES), (-80, 80)):
        T = standing(x, rng.uniform(-20, 20), 50)
        T[:3, 3] *= 1.02
        rows.append(csv_row(2, im, 1, 0.9, T))
    for im, obj, score in ((4, 1, "nan"), (9, 77, 0.5), (40, 1, "nan"), (13, 1, "inf"), (41, 1, "")):
        rows.append(csv_row(2, im, obj, score, standing(0, 0, 50)))
    rows += ["gibberish", ""]
    rng.shuffle(rows)
    (root / "est.csv").write_text("\n".join([HEADER, *rows]))
    plane = {"normal": UP.tolist(), "offset_mm": OFFSET_MM}
    planes = {str(im): plane for im in range(50) if im != 17} | {"6": {"normal": [0, 0, 2], "offset_mm": -1}}
    (root / "planes.json").write_text(json.dumps({"2": planes}))
    return root


def arguments(root, *more, out="out.csv"):
    options = ["--dataset", root, "--planes", root / "planes.json", "--out", root / out, "--json", root / f"{out}.json"]
    return ["refine", *map(str, [root / "est.csv", *options, "--quiet", *FEW_STEPS, *more])]


def refine(root, *more, **options):
    return main(arguments(root, *more, **options))


def result(root, out="out.csv"):
    """Exit code 1's output but for time, and the summary but for seconds."""
    text = (root / out).read_bytes().decode()
    summary = json.loads((root / f"{out}.json").read_text())
    del summary["seconds_per_image"]
    return [re.sub(r",[0-9.]+(\s*)$", r"\1", line) for line in text.splitlines(keepends=True)], summary


@pytest.fixture
def undisturbed(dataset):
    assert refine(dataset, out="undisturbed.csv") == 1
    return result(dataset, "undisturbed.csv")


def left_over(root):
    """Files that no finished run leaves behind."""
    return sorted(p.name for p in root.iterdir() if p.name.endswith((".journal", ".tmp")))


@contextlib.contextmanager
def child(root, *more):
    """A process that refines; forked, so that it need not import anything."""
    pid = os.fork()
    if pid == 0:
        code = 3
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            code = refine(root, *more)
        finally:
            os._exit(code)
    yield pid
    with contextlib.suppress(ProcessLookupError, ChildProcessError):
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def records(root):
    """How many batches the journal has."""
    try:
        return (root / "out.csv.journal").read_bytes().count(b'{"rows"')
    except FileNotFoundError:
        return 0


def kill_and_resume(root, kills, rng):
    """Runs until one comes to its end, the first ones killed up to two batches and some milliseconds on; how many batches
    each kill found done."""
    found = []
    while True:
        with child(root, "--resume") as pid:
            goal = records(root) + rng.randrange(3)
            left = rng.uniform(0, 0.05)
            done, status = 0, 0
            while not done and (len(found) >= kills or left > 0):
                done, status = os.waitpid(pid, os.WNOHANG)
                time.sleep(0.001)
                left -= 0.001 * (records(root) >= goal)
            if done:
                assert os.waitstatus_to_exitcode(status) == 1
                return found
        found.append(records(root))


def test_batches_of_any_size_give_the_same_result(dataset, undisturbed):
    for batch in (1, 3, 16):
        assert refine(dataset, "--batch", batch) == 1
        assert result(dataset) == undisturbed
    assert left_over(dataset) == []


def test_the_order_of_the_rows_does_not_change_what_an_image_gets(dataset, undisturbed):
    header, *rows = (dataset / "est.csv").read_text().split("\n")
    (dataset / "est.csv").write_text("\n".join([header, *sorted(rows)]))
    assert refine(dataset) == 1
    assert sorted(line.strip() for line in result(dataset)[0]) == sorted(line.strip() for line in undisturbed[0])


def test_bad_rows_of_all_parts_are_listed_in_file_order(dataset, undisturbed):
    """Images with some usable row by the first of these, then those without any, then rows of no image."""
    assert refine(dataset) == 1
    problems = result(dataset)[1]["problems"]
    rows = [line.split(",") for line in (dataset / "est.csv").read_text().split("\n")]
    first = [int(r[1]) for r in rows[1:] if len(r) == 7]
    named = [int(re.search(r"image (\d+)", p)[1]) if "line" not in p else int(rows[int(re.search(r"line (\d+)", p)[1]) - 1][1])
             for p in problems[:-1]]  # fmt: skip
    assert sorted(named) == [4, 6, 9, 13, 17, 40, 41]
    assert named[:5] == sorted(named[:5], key=first.index)
    assert named[5:] == sorted(named[5:], key=first.index)
    assert "1 fields" in problems[-1]
    old, new = (dataset / "est.csv").read_text().split("\n"), (dataset / "out.csv").read_text().split("\n")
    for a, b, fields in zip(old, new, rows, strict=True):
        assert (a == b) == (len(fields) != 7 or fields[1] == "im_id" or int(fields[1]) in named)


def test_killed_at_random_moments_and_resumed_the_result_is_the_same(dataset, undisturbed):
    found = kill_and_resume(dataset, 12, random.Random(1))
    assert result(dataset) == undisturbed
    assert left_over(dataset) == []
    assert len(set(found)) > 4


@pytest.mark.slow
def test_a_hundred_kills_change_nothing(dataset, undisturbed):
    rng = random.Random(2)
    kills = 0
    while kills < 100:
        kills += len(kill_and_resume(dataset, 25, rng))
        assert result(dataset) == undisturbed
        assert left_over(dataset) == []
        (dataset / "out.csv").unlink()


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_a_real_process_that_is_stopped_keeps_what_is_done(dataset, undisturbed, sign):
    """Ctrl-C: a message, exit code 130. Either way nothing is written at --out, and --resume goes on."""
    command = [sys.executable, "-m", "physpose_torch", *arguments(dataset, "--config.steps", "200")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and records(dataset) < 2:
            time.sleep(0.01)
        process.send_signal(sign)
        message = process.stderr.read()
    if sign == signal.SIGINT:
        assert process.returncode == 130
        assert re.fullmatch(
            r"physpose: interrupted; \d+ of 27 images are done; the same command with --resume goes on\n", message
        )
    else:
        assert process.returncode == -signal.SIGKILL
    assert not (dataset / "out.csv").exists()
    assert left_over(dataset) == ["out.csv.journal"]
    assert refine(dataset, "--config.steps", "200") == 2
    assert refine(dataset, "--config.steps", "200", "--resume") == 1
    assert left_over(dataset) == []
    assert refine(dataset, "--config.steps", "200", out="again.csv") == 1
    assert result(dataset) == result(dataset, "again.csv")


def test_interrupted_while_the_result_is_written_nothing_is_refined_again(dataset, undisturbed, monkeypatch, capsys):
    (dataset / "out.csv").write_text("what was there before")

    def merged(self, lines):
        yield next(iter(lines))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module.Journal, "merged", merged)
        assert refine(dataset) == 130
    assert "27 of 27 images are done" in capsys.readouterr().err
    assert (dataset / "out.csv").read_text() == "what was there before"
    assert left_over(dataset) == ["out.csv.journal"]
    monkeypatch.setattr(refining, "_refine", None)
    assert refine(dataset, "--resume") == 1
    assert result(dataset) == undisturbed


def test_killed_while_the_result_is_written_nothing_is_left_behind_in_the_end(dataset, undisturbed, monkeypatch):
    def merged(self, lines):
        yield from itertools.islice(lines, 3)
        os.kill(os.getpid(), signal.SIGKILL)

    with monkeypatch.context() as patch:
        patch.setattr(module.Journal, "merged", merged)
        with child(dataset) as pid:
            assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL
    assert left_over(dataset) == [".out.csv.tmp", "out.csv.journal"]
    assert not (dataset / "out.csv").exists()
    assert refine(dataset, "--resume") == 1
    assert left_over(dataset) == []
    assert result(dataset) == undisturbed


def test_interrupted_before_anything_is_done_nothing_is_left(dataset, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(refining, "_refine", interrupt)
    assert refine(dataset, "--scenes", "2", "--every", "30") == 130
    assert capsys.readouterr().err == "physpose: interrupted\n"
    assert left_over(dataset) == []
    assert not (dataset / "out.csv").exists()


def stop_after(batches, monkeypatch):
    """Make the next run stop after so many batches."""
    count = itertools.count()
    refine_batch = refining._refine

    def stopping(*args):
        if next(count) == batches:
            raise KeyboardInterrupt
        return refine_batch(*args)

    monkeypatch.setattr(refining, "_refine", stopping)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda root: ["--every", "2"], r"--every \(it was 1, now 2\)"),
        (lambda root: ["--scenes", "2"], r"--scenes \(it was \[\], now \[2\]\)"),
        (lambda root: ["--config.steps", "3"], r"--config\.steps \(it was 2, now 3\)"),
        (lambda root: (root / "est.csv").open("a").write(" ") and [], r"estimates \(SHA-256\) \(it was \w+, now \w+\)"),
        (lambda root: (root / "planes.json").open("a").write(" ") and [], r"planes \(SHA-256\) \(it was \w+, now \w+\)"),
        (lambda root: ["--plane-sigma-mm", "1"], r"--plane-sigma-mm \(it was 2\.0, now 1\.0\)"),
    ],
    ids=["every", "scenes", "config", "estimates", "planes", "sigma"],
)
def test_a_run_with_other_files_or_options_is_not_resumed(dataset, monkeypatch, capsys, change, named):
    with monkeypatch.context() as patch:
        stop_after(1, patch)
        assert refine(dataset) == 130
    before = (dataset / "out.csv.journal").read_bytes()
    more = change(dataset)
    capsys.readouterr()
    assert refine(dataset, "--resume", *more) == 2
    message = capsys.readouterr().err
    assert re.search(rf"out\.csv\.journal: .* differs in {named}; restore .* or delete this file", message), message
    assert (dataset / "out.csv.journal").read_bytes() == before
    assert not (dataset / "out.csv").exists()


def test_batch_json_and_quiet_may_change_on_resume(dataset, undisturbed, monkeypatch):
    with monkeypatch.context() as patch:
        stop_after(3, patch)
        assert refine(dataset) == 130
    assert refine(dataset, "--resume", "--batch", "5") == 1
    assert result(dataset) == undisturbed


@pytest.mark.parametrize("stop", [1, 2, 4, 5])
def test_a_resumed_run_refines_the_batches_that_an_undisturbed_one_does(dataset, monkeypatch, stop):
    """Sums round differently in other batches."""
    refine_batch, noted = refining._refine, []

    def noting(images, *args):
        noted.append([i.im_id for i in images])
        return refine_batch(images, *args)

    monkeypatch.setattr(refining, "_refine", noting)
    assert refine(dataset, "--batch", "3") == 1
    undisturbed = list(noted)
    assert {len(b) for b in noted} == {2, 3}
    noted.clear()
    with monkeypatch.context() as patch:
        stop_after(stop, patch)
        assert refine(dataset, "--batch", "3") == 130
    assert refine(dataset, "--batch", "3", "--resume") == 1
    assert noted == undisturbed


def test_resume_without_an_earlier_run_begins(dataset, undisturbed):
    assert refine(dataset, "--resume") == 1
    assert result(dataset) == undisturbed


def test_progress_tells_rate_and_time_left_and_goes_on_where_it_was(dataset, monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    loud = [a for a in arguments(dataset) if a != "--quiet"]
    with monkeypatch.context() as patch:
        stop_after(2, patch)
        assert main(loud) == 130
    assert re.search(r"refine: +\d+%.* \d+/27 \[\d\d:\d\d<\S+, \S+(image/s|s/image)\]", capsys.readouterr().err)
    assert main([*loud, "--resume"]) == 1
    shown = re.findall(r" (\d+)/27 ", capsys.readouterr().err)
    assert int(shown[0]) >= 4
    assert shown[-1] == "27"


def test_the_summary_can_go_to_a_pipe(dataset, undisturbed):
    read, write = os.pipe()
    with open(read) as reader:
        assert refine(dataset, "--json", f"/dev/fd/{write}") == 1
        os.close(write)
        content = json.loads(reader.read())
    assert content["problems"] == undisturbed[1]["problems"]


def test_a_second_run_with_the_same_out_is_refused(dataset, undisturbed, monkeypatch, capsys):
    refine_batch, codes = refining._refine, []

    def second(*args):
        monkeypatch.setattr(refining, "_refine", refine_batch)
        codes.extend([refine(dataset), refine(dataset, "--resume")])
        return refine_batch(*args)

    monkeypatch.setattr(refining, "_refine", second)
    assert refine(dataset) == 1
    assert codes == [2, 2]
    assert capsys.readouterr().err.count("another physpose refine is writing there") == 2
    assert result(dataset) == undisturbed


def test_a_link_stays_and_its_file_is_written(dataset, undisturbed):
    (dataset / "elsewhere").mkdir()
    (dataset / "out.csv").symlink_to("elsewhere/real.csv")
    assert refine(dataset) == 1
    assert (dataset / "out.csv").is_symlink()
    assert (dataset / "elsewhere" / "real.csv").read_bytes() == (dataset / "out.csv").read_bytes()
    assert result(dataset) == undisturbed


def test_onto_itself(dataset, undisturbed):
    (dataset / "copy.csv").write_bytes((dataset / "est.csv").read_bytes())
    assert refine(dataset, out="est.csv") == 1
    assert [r[:4] for r in result(dataset, "est.csv")[0]] == [r[:4] for r in undisturbed[0]]
    assert left_over(dataset) == []


@pytest.mark.parametrize("content", ["\ufeff{0}\r\n{1}\r\n{2}\r\n", "{1}\r{2}", "{0}\n\n{1}\n\n{2}"])
def test_byte_order_marks_line_ends_and_headers_are_kept(dataset, content):
    rows = [csv_row(2, im, 1, 0.9, standing(0, 0, 45)) for im in (1, 2)]
    (dataset / "est.csv").write_bytes(content.format(HEADER, *rows).encode())
    assert refine(dataset) == 0
    new = (dataset / "out.csv").read_bytes().decode()
    changed = [line for line in re.split(r"[\r\n]+", new) if line.startswith("2,")]
    assert len(changed) == 2
    assert not set(changed) & set(rows)
    assert new == content.format(HEADER, *changed)


@pytest.mark.parametrize("out", ["/proc/out.csv", "/dev/null"])
@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="Linux only")
def test_what_cannot_be_written_is_told_by_its_path(dataset, out, capsys):
    args = ["refine", str(dataset / "est.csv"), "--dataset", str(dataset), "--out", out, "--quiet"]
    assert main(args) == 2
    assert f"error: {out}" in capsys.readouterr().err


@pytest.mark.parametrize("when", ["refining", "writing"])
def test_when_the_disk_is_full_nothing_is_half_written_and_resume_goes_on(dataset, undisturbed, capsys, when):
    """No file may have more bytes than 100, or than the result will have; the journal of two images is smaller."""
    few = ("--every", "13") if when == "writing" else ()
    size = (dataset / "est.csv").stat().st_size - 100 if when == "writing" else 100
    (dataset / "out.csv").write_text("what was there before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        assert refine(dataset, *few) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    message = capsys.readouterr().err
    assert re.search(r"out\.csv\S*: cannot be written \(File too large\)", message), message
    assert (dataset / "out.csv").read_text() == "what was there before"
    assert left_over(dataset) in ([], ["out.csv.journal"])
    assert refine(dataset, *few, "--resume") == 1
    assert left_over(dataset) == []
    if not few:
        assert result(dataset) == undisturbed


def write_large(root, rows):
    """A result file of scene 3, shuffled, ten rows an image."""
    row = csv_row(3, 0, 1, 0.9, standing(0, 0, 50)).split(",", 2)[2]
    with (root / "est.csv").open("w") as file:
        file.writelines(f"3,{k * 7919 % (rows // 10)},{row}\n" for k in range(rows))


def test_memory_does_not_grow_with_a_file_of_which_nothing_is_refined(dataset):
    """A row is 240 bytes of text, and was 1.6 kB in memory."""

    def peak(rows):
        write_large(dataset, rows)
        tracemalloc.start()
        try:
            assert refine(dataset, "--scenes", "5") == 0
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    few, many = peak(5_000), peak(50_000)
    assert (dataset / "out.csv").read_bytes() == (dataset / "est.csv").read_bytes()
    assert many - few < 45_000 * 100


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="Linux only")
@pytest.mark.parametrize("more", [("--scenes", "5"), ()], ids=["nothing chosen", "no plane anywhere"])
def test_a_process_needs_little_more_memory_for_a_million_rows_than_for_ten_thousand(dataset, more):
    """Prints the peak of each (pytest -s): where no image is chosen, and where all are read and found to have no plane."""
    (dataset / "planes.json").write_text("{}")
    code = (
        "import sys; from pathlib import Path; from physpose_torch.__main__ import main; code = main(sys.argv[1:])\n"
        "print(code, Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"
    )
    peaks = {}
    for rows in (10_000, 100_000, 1_000_000):
        write_large(dataset, rows)
        start = time.monotonic()
        command = [sys.executable, "-c", code, *arguments(dataset, *more)]
        printed = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True).stdout.split()
        assert int(printed[0]) == (0 if more else 1)
        peaks[rows] = int(printed[1]) / 1024
        print(f"\n{rows} rows: {peaks[rows]:.0f} MB, {time.monotonic() - start:.0f} s")
    assert (dataset / "out.csv").read_bytes() == (dataset / "est.csv").read_bytes()
    assert peaks[1_000_000] - peaks[10_000] < 150
