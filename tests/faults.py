"""What the tests of faults share: processes that are killed, what they leave behind, and disks that are full."""

import contextlib
import os
import resource
import signal
import sys
import time
from pathlib import Path

from physpose_torch.__main__ import main


@contextlib.contextmanager
def forked(work, *, stderr=os.devnull):
    """The pid of a process that does ``work()``, whose value is its exit code; forked, so that it need not import anything.
    It is killed at the end of the block."""
    pid = os.fork()
    if pid == 0:
        code = 3
        try:
            os.dup2(os.open(stderr, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
            sys.stderr = open(2, "w", buffering=1)  # noqa: SIM115
            code = work()
        finally:
            os._exit(code)
    try:
        yield pid
    finally:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def command(*args):
    """A command's work for :func:`forked`."""
    return lambda: main([*map(str, args)])


def exit_code(pid, *, within=None):
    """A child's exit code (negative: by that signal); None if it still runs after so many seconds."""
    end = None if within is None else time.monotonic() + within
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if end is not None and time.monotonic() > end:
            return None
        time.sleep(0.002)


def children(text, parent):
    """Pids of living processes that were started with a text, and their parent's pid last, as arguments."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            words = path.read_bytes().split(b"\0")
            if words[-2:] == [str(parent).encode(), b""] and any(text.encode() in word for word in words):
                found.append(int(path.parent.name))
    return found


def ended(pid, *, within=4.0):
    """Whether a process comes to its end in a while; nobody need have waited for it."""
    limit = time.monotonic() + within
    while True:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        if time.monotonic() > limit:
            return False
        time.sleep(0.01)


def gone(text, parent, *, within=10.0):
    """Whether no such child is left in a while."""
    end = time.monotonic() + within
    while children(text, parent):
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


@contextlib.contextmanager
def full_disk(size=0):
    """No file may grow beyond a size [bytes]."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def files(folder, pattern="*"):
    """Names of files in a folder and those below it, hidden ones too."""
    return sorted(str(p.relative_to(folder)) for p in Path(folder).rglob(pattern) if p.is_file())
