"""What commands write under kills, Ctrl-C and full disks: whole or not at all, what was there before is kept, a rerun gives the
same. ``refine`` has its own file, as it goes on where it stopped."""

import json
import os
import random
import re
import signal
import tempfile
import time
from pathlib import Path

import pytest
from bop_files import HEADER, OFFSET_MM, UP, csv_row, standing, write_models, write_scene
from faults import command, exit_code, files, forked, full_disk

from physpose_torch import files as files_module
from physpose_torch.__main__ import main
from physpose_torch.commands.common import check_output
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.viz import ink

OLD = "what was there before"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Eight images of three boxes, 2 % too far away."""
    root = tmp_path_factory.mktemp("faults") / "data"
    write_models(root / "models")
    rng, rows, truth = random.Random(0), [], {}
    for im in range(8):
        truth[im] = []
        for obj, x, height in ((1, -100, 50), (4, 0, 15), (9, 100, 35)):
            T = standing(x, rng.uniform(-40, 40), height)
            truth[im].append((obj, T.copy(), 1.0))
            T[:3, 3] *= rng.uniform(1.015, 1.025)
            rows.append(csv_row(2, im, obj, 0.9, T))
    write_scene(root / "test", 2, truth, width=640)
    (root / "est.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    plane = {"normal": UP.tolist(), "offset_mm": OFFSET_MM}
    (root / "planes.json").write_text(json.dumps({"2": {str(im): plane for im in range(8)}}))
    return root


COMMANDS = {
    "calibrate": ["--resamples", "20", "--batch", "2", "--out"],
    "report": ["--batch", "2", "--json"],
    "eval": ["--vsd-depth", "none", "--json"],
    "ablate": ["--rows", "input", "--json"],
    "refine": ["--config.steps", "2", "--json"],
}


def arguments(name, root, out):
    args = [name, root / "est.csv", "--dataset", root, "--planes", root / "planes.json", "--quiet", *COMMANDS[name], out]
    return [*args, "--out", out.with_suffix(".csv")] if name == "refine" else args


def run(name, root, out):
    return main([*map(str, arguments(name, root, out))])


def what_it_says(path):
    """All but the time it took."""
    return re.sub(r'"\w*(seconds|time|per_image)\w*": [-+.e\d]+', "", path.read_text()).replace(str(path), "OUT")


@pytest.fixture(params=COMMANDS)
def name(request):
    return request.param


@pytest.fixture
def undisturbed(name, dataset, tmp_path):
    assert run(name, dataset, tmp_path / "undisturbed.json") == 0
    return what_it_says(tmp_path / "undisturbed.json")


def test_on_a_full_disk_the_old_file_is_kept_and_named(name, dataset, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out" / "out.json"
    out.parent.mkdir()
    out.write_text(OLD)
    if name == "refine":  # its result has room, but not what it is told to say with --json
        monkeypatch.setattr("physpose_torch.commands.refine.Totals.summary", lambda *_: {"long": "x" * 200_000})
    with full_disk(100_000 if name == "refine" else 50):
        assert run(name, dataset, out) == 2
    assert re.search(r"error: \S*out\.json: cannot be written \(File too large\)", capsys.readouterr().err)
    assert out.read_text() == OLD
    assert not list(out.parent.glob(".*"))


def test_killed_while_it_writes_the_old_file_is_kept_and_a_rerun_gives_the_same(
    name, dataset, tmp_path, undisturbed, monkeypatch
):
    out = tmp_path / "out.json"
    out.write_text(OLD)
    replace = os.replace

    def killed(source, target):
        if str(target) == str(out):
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(files_module.os, "replace", killed)
        with forked(command(*arguments(name, dataset, out))) as pid:
            assert exit_code(pid) == -signal.SIGKILL
    assert out.read_text() == OLD
    with forked(command(*arguments(name, dataset, out), *(["--resume"] if name == "refine" else []))) as pid:
        assert exit_code(pid) == 0
    assert what_it_says(out) == undisturbed


def kill_and_rerun(name, dataset, tmp_path, undisturbed, kills, rng):
    """Kills at random moments, half of them over an old file; how many, and how many runs came to their end before."""
    out, killed, ended = tmp_path / "out.json", 0, 0
    start = time.monotonic()
    with forked(command(*arguments(name, dataset, out))) as pid:
        assert exit_code(pid) == 0
    length = time.monotonic() - start
    while killed < kills:
        before = rng.choice([None, OLD])
        out.unlink(missing_ok=True)
        if before:
            out.write_text(before)
        with forked(command(*arguments(name, dataset, out))) as pid:
            code = exit_code(pid, within=rng.uniform(0, 1.05 * length))
        if code is None:
            killed += 1
        else:
            ended += 1
            assert code == 0
        content = out.read_text() if out.exists() else None
        assert content == before or what_it_says(out) == undisturbed
        assert code is None or content != before
        for left in tmp_path.glob("out.csv.journal"):
            left.unlink()
    for left in tmp_path.glob(".*.tmp"):
        os.utime(left, (0, 0))
    assert run(name, dataset, out) == 0
    assert what_it_says(out) == undisturbed
    left = {"out.json", "undisturbed.json"} | ({"out.csv", "undisturbed.csv"} if name == "refine" else set())
    assert set(files(tmp_path)) == left
    return killed, ended


@pytest.mark.parametrize("name", ["calibrate"], indirect=True)
def test_killed_at_random_moments_a_calibration_is_whole_or_not_there(name, dataset, tmp_path, undisturbed):
    kill_and_rerun(name, dataset, tmp_path, undisturbed, 10, random.Random(0))


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_hundred_kills_of_each_leave_its_file_whole_or_not_there(name, dataset, tmp_path, undisturbed):
    killed, ended = kill_and_rerun(name, dataset, tmp_path, undisturbed, 100, random.Random(1))
    print(f"\n{name}: {killed} killed, {ended} came to their end before, same result, 0 files left behind")


@pytest.mark.parametrize(("denied", "message"), [("out.json", "is read-only"), ("folder", "lies in a read-only folder")])
def test_where_nothing_may_be_written_nothing_is_begun(name, dataset, tmp_path, monkeypatch, capsys, denied, message):
    folder = tmp_path / "folder"
    folder.mkdir()
    if denied == "out.json":
        (folder / denied).write_text(OLD)
    monkeypatch.setattr(os, "access", lambda path, _: os.path.basename(path) != denied)  # root may write all
    monkeypatch.setattr("physpose_torch.commands.images.ImageOptions.open", None)
    assert run(name, dataset, folder / "out.json") == 2
    assert re.search(rf"out\.(json|csv) {message}; name a file to write", capsys.readouterr().err)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="to be another user takes root")
def test_a_file_that_may_be_written_in_a_folder_that_may_not_is_refused_but_a_pipe_is_not():
    """The file would be replaced."""
    with tempfile.TemporaryDirectory(prefix="physpose_test_") as folder:
        folder = Path(folder)
        folder.chmod(0o755)
        (folder / "out.json").touch()
        os.mkfifo(folder / "pipe")
        for path in folder.iterdir():
            path.chmod(0o666)

        def work():
            os.setuid(65534)
            check_output(folder / "pipe", Path("/dev/null"))
            try:
                check_output(folder / "out.json")
            except DataError as error:
                return 0 if "out.json lies in a read-only folder" in str(error) else 1
            return 2

        with forked(work) as pid:
            assert exit_code(pid) == 0


def test_a_loop_of_links_is_no_output(name, dataset, tmp_path, monkeypatch, capsys):
    (tmp_path / "out.json").symlink_to("other")
    (tmp_path / "other").symlink_to("out.json")
    monkeypatch.setattr("physpose_torch.commands.images.ImageOptions.open", None)
    assert run(name, dataset, tmp_path / "out.json") == 2
    assert "out.json: cannot be written (Too many levels of symbolic links)" in capsys.readouterr().err


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", ["calibrate", "report"], indirect=True)
def test_when_asked_to_stop_it_says_so_and_nothing_is_written(name, dataset, tmp_path, monkeypatch, sign):
    out, log = tmp_path / "out.json", tmp_path / "stderr"
    out.write_text(OLD)

    def stop(*_):
        os.kill(os.getpid(), sign)
        time.sleep(60)

    monkeypatch.setattr(f"physpose_torch.commands.{name}.poses_of", stop)
    with forked(command(*arguments(name, dataset, out)), stderr=log) as pid:
        assert exit_code(pid, within=30) == 130
    assert log.read_text() == "physpose: interrupted\n"
    assert out.read_text() == OLD
    assert files(tmp_path) == ["out.json", "stderr"]


def test_who_handles_sigterm_goes_on_to_do_so(dataset, tmp_path):
    seen = []
    before = signal.signal(signal.SIGTERM, lambda *_: seen.append(1))
    try:
        assert run("eval", dataset, tmp_path / "out.json") == 0
        os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert seen == [1]


def test_after_a_command_sigterm_is_what_it_was(dataset, tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    assert run("eval", dataset, tmp_path / "out.json") == 0
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_calibration_can_go_to_a_pipe(dataset, tmp_path):
    inlet, outlet = os.pipe()
    with open(inlet) as reader:
        assert main([*map(str, arguments("calibrate", dataset, f"/dev/fd/{outlet}"))]) == 0
        os.close(outlet)
        assert json.loads(reader.read())["images"] == 8


@pytest.mark.parametrize("ending", [".png", ".jpg", ".gif"])
def test_a_picture_is_whole_or_not_there(tmp_path, ending):
    from PIL import Image

    path, picture = tmp_path / f"picture{ending}", Image.effect_noise((200, 200), 50).convert("RGB")
    path.write_text(OLD)
    with full_disk(2000), pytest.raises(DataError, match=f"picture{ending}: cannot be written"):
        ink.save(picture, path)
    assert path.read_text() == OLD
    ink.save(picture, path)
    with Image.open(path) as opened:
        assert opened.size == (200, 200)
    assert files(tmp_path) == [path.name]


@pytest.mark.parametrize("name", ["picture", "picture.xyz", "picture.csv"])
def test_a_picture_of_no_known_kind_is_refused(tmp_path, name):
    from PIL import Image

    with pytest.raises(InvalidInputError, match=rf"{name}: .*try \.png"):
        ink.save(Image.new("RGB", (4, 4)), tmp_path / name)


def test_the_demo_is_not_run_where_its_picture_cannot_be_written(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "no" / "demo.png")]) == 2
    assert "lies in no existing folder" in capsys.readouterr().err
