"""A journal keeps what was committed, whatever tears it, and lets one run at a time write to it."""

import os
import resource
import signal
import subprocess
import sys

import pytest

from physpose_torch.bop import journal as module
from physpose_torch.bop.journal import Journal
from physpose_torch.errors import DataError

ABOUT = {"estimates": "abc", "--every": 2, "--config": {"steps": 40, "physics": {"softness": 0.001}}}
LINES = [b"head\n", b"one\r\n", b"two\r", b"\n", b"three"]
BATCHES = [([(2, "ONE\r\n"), (5, "THREE")], {"n": 1}), ([], {"n": 2}), ([(3, "{Zwölf},\r")], {"n": 3})]
MERGED = [b"head\n", b"ONE\r\n", "{Zwölf},\r".encode(), b"\n", b"THREE"]


def resumed(path):
    return Journal(path, resume=True)


def begin(journal, about=ABOUT):
    return [record["n"] for record in journal.begin(about, lines=len(LINES))]


@pytest.fixture
def path(tmp_path):
    """A journal of all batches."""
    path = tmp_path / "out.csv.journal"
    with resumed(path) as journal:
        assert begin(journal) == []
        for batch in BATCHES:
            journal.commit(*batch)
    return path


def test_rows_are_merged_with_the_line_ends_of_the_file(path):
    with resumed(path) as journal:
        assert begin(journal) == [1, 2, 3]
        assert list(journal.merged(LINES)) == MERGED


def test_torn_anywhere_what_was_committed_is_kept_and_the_rest_can_follow(path):
    """Cut at each byte, and with each byte of the last record broken."""
    content = path.read_bytes()
    last = content.rindex(b"3 {")
    torn = [content[:k] for k in range(len(content))]
    torn += [content[:k] + b"\0" + content[k + 1 :] for k in range(last, len(content))]
    seen = set()
    for text in torn:
        path.write_bytes(text)
        with resumed(path) as journal:
            done = len(begin(journal))
            assert done == journal.committed <= 2 or text == content[:-1]
            for batch in BATCHES[done:]:
                journal.commit(*batch)
            assert list(journal.merged(LINES)) == MERGED
        assert path.read_bytes() == content
        seen.add(done)
    assert seen == {0, 1, 2}


def test_a_journal_without_records_is_not_left_behind(tmp_path):
    path = tmp_path / "j"
    with resumed(path) as journal:
        assert path.exists()
        begin(journal)
    assert not path.exists()


def test_an_earlier_journal_is_refused_without_resume_and_kept(path):
    content = path.read_bytes()
    with pytest.raises(DataError, match=r"out\.csv\.journal: an earlier run .* --resume, or delete"):
        Journal(path)
    with resumed(path):
        pass  # not even begun
    assert path.read_bytes() == content


def test_what_differs_from_the_earlier_run_is_named(path):
    about = {**ABOUT, "--every": 3, "--config": {"steps": 40, "physics": {"softness": 0.002}}}
    with resumed(path) as journal, pytest.raises(DataError) as error:
        begin(journal, about)
    assert "--every (it was 2, now 3), --config.physics.softness (it was 0.001, now 0.002)" in str(error.value)
    assert "steps" not in str(error.value)


@pytest.mark.parametrize("content", ["precious\n", "precious", '{"a": 1}\n', "[1]\n"])
def test_a_foreign_file_is_not_touched(tmp_path, content):
    path = tmp_path / "out.csv.journal"
    path.write_text(content)
    for resume in (False, True):
        with pytest.raises(DataError, match="no journal"):
            Journal(path, resume=resume)
    assert path.read_text() == content


def test_two_runs_are_kept_apart_and_the_lock_of_a_killed_one_is_none(path):
    code = f"""
import sys, time
from pathlib import Path
from physpose_torch.bop.journal import Journal
j = Journal(Path({str(path)!r}), resume=True)
print("open", flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"open\n"
        for resume in (False, True):
            with pytest.raises(DataError, match="another physpose refine is writing there"):
                Journal(path, resume=resume)
        other.send_signal(signal.SIGKILL)
        other.wait()
    with resumed(path) as journal:
        assert len(begin(journal)) == 3
        with pytest.raises(DataError, match="another"):
            resumed(path)


def test_a_journal_that_its_run_deletes_while_another_waits_for_it_is_not_taken(tmp_path, monkeypatch):
    """The lock of a deleted file would keep nobody out."""
    path, lock = tmp_path / "j", module._lock

    def late(file, path):
        monkeypatch.setattr(module, "_lock", lock)
        path.unlink()
        lock(file, path)

    monkeypatch.setattr(module, "_lock", late)
    with resumed(path):
        assert path.exists()
        with pytest.raises(DataError, match="another"):
            resumed(path)


def test_a_full_disk_is_told_with_the_path_and_what_was_committed_is_kept(path):
    """The file may not grow beyond 20 bytes more."""
    content = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with resumed(path) as journal:
        begin(journal)
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(content) + 20, limits[1]))
        try:
            with pytest.raises(DataError, match=r"out\.csv\.journal: cannot be written \(File too large\)"):
                journal.commit([(1, "a row of more than twenty bytes\n")], {"n": 4})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert path.read_bytes() == content
        journal.commit([(1, "HEAD\n")], {"n": 4})
        assert next(iter(journal.merged(LINES))) == b"HEAD\n"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder in which root cannot write, either")
def test_a_folder_that_cannot_be_written_is_told():
    from pathlib import Path

    with pytest.raises(DataError, match=r"/proc/out\.csv\.journal: cannot be written"):
        resumed(Path("/proc/out.csv.journal"))
