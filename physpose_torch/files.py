"""Files that are there as a whole or not at all, and the folder of the cache."""

import contextlib
import errno
import glob
import os
import re
import shutil
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import platformdirs

from physpose_torch.errors import DataError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

__all__ = [
    "TEMPORARY",
    "cache_folder",
    "one_at_a_time",
    "remove_abandoned",
    "replacing",
    "resolved",
    "streams",
    "write_file",
    "written",
]

ABANDONED = 3600.0
"""[s]; a temporary file of this age is that of a killed process."""
TEMPORARY = "." + "[0-9a-f]" * 32 + ".tmp"
"""How the names of :func:`replacing`'s temporary files end, as a pattern."""
_STREAM = re.compile(r"/dev/(fd/|std)|/proc/")


def resolved(path: Path) -> Path:
    """Where a path leads, links followed; nothing need be there.

    Raises:
        OSError: its links go round in a circle.
    """
    try:
        real = path.resolve()
        loops = real.is_symlink()  # Python 3.13 tells of no loop
    except RuntimeError:
        loops = True
    if loops:
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return real


@contextlib.contextmanager
def replacing(path: Path, *, temporary: Path | None = None) -> Iterator[BinaryIO]:
    """A binary file to write, which takes the place of ``path`` in one step once the block ends without an error.

    Of a link, the file that it points to is replaced; permissions are kept.

    Args:
        path: the file to create or replace; its folder must exist.
        temporary: where to write until then, in the same folder; None: a name that nobody else has.

    Raises:
        OSError: it cannot be written; nothing is left behind, and ``path`` is as it was.
    """
    path = resolved(path)
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, "it is read-only")
    if temporary is None:
        remove_abandoned(path.parent, f".{glob.escape(path.name[:40])}{TEMPORARY}")
        temporary = path.with_name(f".{path.name[:40]}.{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(OSError):  # there is no old one, or the file system has no permissions
            shutil.copymode(path, temporary)
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()


def streams(path: Path) -> bool:
    """Whether a path is written to directly and not replaced: a pipe, /dev/stdout, or else no regular file."""
    return bool(_STREAM.match(str(path.absolute()))) or (path.exists() and not path.is_file())


@contextlib.contextmanager
def written(path: str | os.PathLike) -> Iterator[None]:
    """Tell that a file cannot be written as a :class:`DataError` that names it."""
    try:
        yield
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error}); check the folder and its free space") from None


def write_file(path: str | os.PathLike, content: str | bytes) -> None:
    """Create or replace a file in one step; what is no regular file, a pipe or /dev/stdout say, is written to directly.

    Raises:
        DataError: it cannot be written; what was there before is kept.
    """
    path, data = Path(path), content.encode() if isinstance(content, str) else content
    with written(path):
        if streams(path):
            with open(path, "ab") as file:  # a file that /dev/stdout stands for is not emptied
                file.write(data)
        else:
            with replacing(path) as file:
                file.write(data)


def cache_folder(name: str) -> Path:
    """A folder in ``$PHYSPOSE_CACHE``, or else in the user's cache.

    Raises:
        OSError: there is no home folder that the latter could be in.
    """
    if given := os.environ.get("PHYSPOSE_CACHE"):
        return Path(given) / name
    try:
        folder = Path(platformdirs.user_cache_dir("physpose_torch"))
    except RuntimeError:
        folder = Path()
    if not folder.is_absolute():  # some versions of platformdirs take ~ for the name of a folder
        raise FileNotFoundError("this user has no home folder")
    return folder / name


@contextlib.contextmanager
def one_at_a_time(path: Path, *, patience: float, stop: threading.Event) -> Iterator[bool]:
    """Of several processes and threads that make the same file, one is in the block and the others wait; yields whether it did.

    They do so for ``patience`` [s], and until ``stop`` is set. Where there is no lock to be had nobody waits; that of a killed
    process is no lock, and goes with the next.
    """
    lock = path.with_name(f".{path.name}.lock")
    file, waited, end = None, False, time.monotonic() + patience
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        while fcntl is not None and file is None:
            file = open(lock, "ab")  # noqa: SIM115
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                held = os.path.samestat(os.fstat(file.fileno()), os.stat(lock))
            except (BlockingIOError, FileNotFoundError):  # who had it has it still, or has deleted it
                held = False
            if held:
                break
            file.close()
            file, waited = None, True
            if time.monotonic() > end or stop.wait(0.1):
                break
    try:
        yield waited
    finally:
        if file is not None:
            with contextlib.suppress(OSError):
                lock.unlink()
            file.close()


def remove_abandoned(folder: Path, pattern: str) -> None:
    """Remove temporary files and folders that processes left behind when they were killed."""
    for path in folder.glob(pattern):
        with contextlib.suppress(OSError):
            if time.time() - path.lstat().st_mtime > ABANDONED:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
