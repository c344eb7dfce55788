"""Files are there as a whole or not at all, whatever happens while they are written."""

import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest
from faults import exit_code, files, forked, full_disk

from physpose_torch import files as module
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.files import cache_folder, one_at_a_time, remove_abandoned, replacing, write_file

OLD, NEW = b"what was there before", b"0123456789" * 20_000


@pytest.fixture(params=[False, True], ids=["new", "old"])
def path(request, tmp_path):
    """A file to write, which is there already or not; ``before`` is what it has."""
    path = tmp_path / "out.json"
    if request.param:
        path.write_bytes(OLD)
    return path


def read(path):
    return path.read_bytes() if path.exists() else None


def test_it_is_written(path):
    for content in (NEW, "text: °\n", b""):
        write_file(path, content)
        assert path.read_bytes() == (content.encode() if isinstance(content, str) else content)
    assert files(path.parent) == ["out.json"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("after", [False, True])
def test_killed_at_any_step_it_is_the_old_file_or_the_new_one(path, monkeypatch, step, after):
    before, do = read(path), getattr(os, step)

    def killed(*args):
        if after:
            do(*args)
        os.kill(os.getpid(), signal.SIGKILL)

    with monkeypatch.context() as patch:
        patch.setattr(os, step, killed)
        with forked(lambda: write_file(path, NEW)) as pid:
            assert exit_code(pid) == -signal.SIGKILL
    assert read(path) == (NEW if (step, after) == ("replace", True) else before)
    write_file(path, OLD)
    assert path.read_bytes() == OLD
    for left in path.parent.glob(".*.tmp"):  # it may be somebody's who is writing now, but not an hour later
        os.utime(left, (0, 0))
    write_file(path, NEW)
    assert files(path.parent) == ["out.json"]


def kill_writers(path, kills, rng):
    """Kill processes that write the file over and over, at random moments; how many temporary files they left."""
    path.write_bytes(OLD)
    contents = [NEW, NEW[::-1] * 3, OLD]

    def work():
        for k in range(10**6):
            write_file(path, contents[k % 3])

    for _ in range(kills):
        with forked(work) as pid:
            assert exit_code(pid, within=rng.uniform(0.002, 0.05)) is None
        assert path.read_bytes() in contents
    left = list(path.parent.glob(".*.tmp"))
    for file in left:
        os.utime(file, (0, 0))
    write_file(path, NEW)
    assert files(path.parent) == ["out.json"]
    return len(left)


def test_a_name_may_be_as_long_as_names_can_be(tmp_path):
    path = tmp_path / ("°" * 125 + ".json")
    write_file(path, NEW)
    assert path.read_bytes() == NEW


def test_killed_at_random_moments_it_is_whole(tmp_path):
    assert kill_writers(tmp_path / "out.json", 20, random.Random(0)) > 0


@pytest.mark.slow
def test_a_thousand_kills_leave_it_whole(tmp_path):
    left = kill_writers(tmp_path / "out.json", 1000, random.Random(1))
    print(f"\nfiles: 1000 kills, whole after each; {left} temporary files left, all removed an hour later")


def test_on_a_full_disk_the_old_one_is_kept_and_the_file_is_named(path):
    before = read(path)
    with full_disk(1000), pytest.raises(DataError, match=r"out\.json: cannot be written \(File too large\); check"):
        write_file(path, NEW)
    assert read(path) == before
    assert not list(path.parent.glob(".*"))


@pytest.mark.parametrize("where", ["no/out.json", "file/out.json", "."])
def test_what_cannot_be_there_is_named(tmp_path, where):
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="cannot be written"):
        write_file(tmp_path / where, NEW)
    assert files(tmp_path) == ["file"]


def test_a_link_stays_and_so_do_permissions(tmp_path):
    (tmp_path / "real").write_bytes(OLD)
    (tmp_path / "real").chmod(0o640)
    (tmp_path / "link").symlink_to("real")
    write_file(tmp_path / "link", NEW)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == NEW
    assert (tmp_path / "real").stat().st_mode & 0o777 == 0o640
    assert files(tmp_path) == ["link", "real"]


def test_what_is_not_ours_is_not_swept(tmp_path):
    theirs, ours = tmp_path / ".out.json.backup.tmp", tmp_path / f".out.json.{'0' * 32}.tmp"
    for path in (theirs, ours):
        path.touch()
        os.utime(path, (0, 0))
    write_file(tmp_path / "out.json", NEW)
    assert files(tmp_path) == [theirs.name, "out.json"]


def test_where_there_are_no_permissions_it_is_written(path, monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(shutil, "copymode", refuse)
    write_file(path, NEW)
    assert path.read_bytes() == NEW


def test_a_loop_of_links_is_named_and_stays(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for name in ("a", "a/out.json"):
        with pytest.raises(DataError, match=f"{name}: cannot be written .*symbolic links"):
            write_file(tmp_path / name, NEW)
    assert (tmp_path / "a").is_symlink()


def test_a_read_only_file_is_not_replaced(tmp_path, monkeypatch):
    path = tmp_path / "out.json"
    path.write_bytes(OLD)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write all
    with pytest.raises(DataError, match="read-only"):
        write_file(path, NEW)
    assert path.read_bytes() == OLD


def test_a_pipe_is_written_to():
    inlet, outlet = os.pipe()
    content = []
    with open(inlet, "rb") as reader:
        thread = threading.Thread(target=lambda: content.append(reader.read()))
        thread.start()
        write_file(f"/dev/fd/{outlet}", NEW)
        os.close(outlet)
        thread.join()
    assert content == [NEW]


def test_a_named_pipe_stays(tmp_path):
    path, content = tmp_path / "pipe", []
    os.mkfifo(path)
    thread = threading.Thread(target=lambda: content.append(path.read_bytes()))
    thread.start()
    write_file(path, NEW)
    thread.join()
    assert content == [NEW]
    assert path.is_fifo()


def test_the_standard_output_may_be_a_file_that_goes_on_to_be_used(tmp_path):
    log = tmp_path / "log"
    log.write_bytes(b"before\n")
    code = "from physpose_torch.files import write_file; write_file('/dev/stdout', 'in\\n'); print('after')"
    with log.open("ab") as out:
        subprocess.run([sys.executable, "-c", code], stdout=out, check=True)
    assert log.read_text() == "before\nin\nafter\n"


def test_two_that_write_one_file_at_once_leave_one_of_the_two(tmp_path):
    path = tmp_path / "out.json"

    def work(content):
        for _ in range(50):
            write_file(path, content)
        return 0

    with forked(lambda: work(NEW)) as a, forked(lambda: work(OLD)) as b:
        while (code := exit_code(a, within=0)) is None:
            assert read(path) in (None, OLD, NEW)
        assert (code, exit_code(b)) == (0, 0)
    assert files(tmp_path) == ["out.json"]


def test_an_error_while_it_is_written_leaves_nothing(path):
    before = read(path)

    def write():
        with replacing(path) as file:
            file.write(NEW)
            raise InvalidInputError("no")

    with pytest.raises(InvalidInputError):
        write()
    assert read(path) == before
    assert not list(path.parent.glob(".*"))


def test_only_what_is_old_counts_as_abandoned(tmp_path):
    for name in (".a.tmp", ".b.tmp", "c"):
        (tmp_path / name).touch()
    (tmp_path / ".folder.tmp").mkdir()
    (tmp_path / ".folder.tmp" / "file").touch()
    for name in (".b.tmp", ".folder.tmp", "c"):
        os.utime(tmp_path / name, (time.time() - 2 * module.ABANDONED,) * 2)
    remove_abandoned(tmp_path, ".*.tmp")
    assert files(tmp_path) == [".a.tmp", "c"]
    assert not (tmp_path / ".folder.tmp").exists()


@pytest.mark.skipif(not os.path.isdir("/proc/self") or os.geteuid() != 0, reason="to be another user takes root")
def test_a_user_without_home_has_no_cache_folder_and_none_is_made(tmp_path, monkeypatch):
    for name in ("PHYSPOSE_CACHE", "HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)

    def work():
        os.setuid(54321)
        try:
            cache_folder("onnx")
        except FileNotFoundError as error:
            return 0 if str(error) == "this user has no home folder" else 1
        return 2

    with forked(work) as pid:
        assert exit_code(pid) == 0
    assert files(tmp_path) == []


def test_one_makes_a_file_and_the_others_wait_for_it(tmp_path):
    inside, most, never = [], [], threading.Event()

    def make():
        with one_at_a_time(tmp_path / "made", patience=60, stop=never):
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.02)
            inside.pop()

    threads = [threading.Thread(target=make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] * 8
    assert list(tmp_path.iterdir()) == []


def test_who_waits_loses_patience_or_is_stopped(tmp_path):
    stop = threading.Event()
    with one_at_a_time(tmp_path / "made", patience=0, stop=stop):
        start = time.monotonic()
        with one_at_a_time(tmp_path / "made", patience=0.2, stop=stop):
            assert time.monotonic() - start >= 0.2
        stop.set()
        with one_at_a_time(tmp_path / "made", patience=60, stop=stop):
            assert time.monotonic() - start < 30


def test_the_lock_of_a_killed_process_is_none(tmp_path):
    never = threading.Event()
    if (pid := os.fork()) == 0:
        with one_at_a_time(tmp_path / "made", patience=0, stop=never):
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
    assert len(list(tmp_path.iterdir())) == 1
    start = time.monotonic()
    with one_at_a_time(tmp_path / "made", patience=60, stop=never):
        assert time.monotonic() - start < 30
    assert list(tmp_path.iterdir()) == []


def test_where_there_is_no_lock_to_be_had_nobody_waits(tmp_path):
    (tmp_path / "file").touch()
    with one_at_a_time(tmp_path / "file" / "made", patience=60, stop=threading.Event()):
        pass
