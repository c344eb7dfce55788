"""What a long run has done so far, on disk, so that a killed run goes on where it stopped."""

import contextlib
import errno
import json
import logging
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from physpose_torch.errors import DataError
from physpose_torch.files import written

try:
    import fcntl
except ImportError:  # Windows: two runs with one --out are not kept apart
    fcntl = None

__all__ = ["Journal"]

logger = logging.getLogger("physpose_torch")
_KIND = "journal of physpose refine"
_HEAD = json.dumps({"kind": _KIND})[:-1].encode()


class Journal:
    """An append-only file: a line that says what the run is about, then for each batch of images the rows that were
    rewritten, ``NUMBER TEXT``, and a line of JSON that commits them. What a kill tears is not committed, and cut off.

    While it is open, nobody else can open it (flock: the lock of a killed run is no longer there). On leaving the block it
    stays for a later run, unless it is new and nothing was committed.

    Args:
        path: the file.
        resume: go on with an existing journal; if there is none, begin.

    Raises:
        DataError: it cannot be written, is in use, is no journal, or is there though ``resume`` is not asked for.
    """

    path: Path
    committed: int
    """How many records there are."""

    def __init__(self, path: Path, *, resume: bool = False) -> None:
        self.path, self.committed = path, 0
        with written(path):
            self._file = _locked(path)
        try:
            self._head = self._read_head()
            self._new = not self._head
            if self._head and not resume:
                raise DataError(
                    f"{path}: an earlier run stopped before its end; go on with --resume, or delete this file to begin anew"
                )
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        if self._new and not self.committed:
            self.remove()
        self._file.close()

    def begin(self, about: Mapping[str, Any], *, lines: int) -> Iterator[dict[str, Any]]:
        """The records of earlier runs, in order; to be read to the end before new ones are committed.

        Args:
            about: whatever decides the result, JSON; a journal that is about something else is not resumed.
            lines: how many lines the result file has; memory is 8 bytes each.

        Raises:
            DataError: it is about something else, or cannot be written.
        """
        head = json.dumps({"kind": _KIND, **about})
        self._at = np.full(lines + 1, -1, dtype=np.int64)  # byte offset of each line's text
        if self._new:
            self._end = 0
            self._append(head.encode() + b"\n")
            self._end = len(head) + 1
            _sync_folder(self.path.parent)
            return iter(())
        before, now = json.loads(self._head), json.loads(head)
        if before != now:
            raise DataError(
                f"{self.path}: --resume goes on with the same files and options only, but this run differs in "
                f"{_differences(before, now)}; restore them, or delete this file to begin anew"
            )
        self._end = len(self._head)
        return self._replay()

    def commit(self, rows: Sequence[tuple[int, str]], record: Mapping[str, Any]) -> None:
        """Keep the new (line number, text) of rows and a record of them; they are on disk when this returns.

        Raises:
            DataError: the disk is full, say; what was committed before is kept.
        """
        end = "\r\n"
        lines = [f"{number} {text.rstrip(end)}\n".encode() for number, text in rows]
        crc = 0
        for line in lines:
            crc = zlib.crc32(line, crc)
        lines.append(json.dumps({"rows": len(rows), "crc": crc, **record}).encode() + b"\n")
        self._append(b"".join(lines))
        at = self._end
        for (number, _), line in zip(rows, lines, strict=False):
            self._at[number] = at + line.index(b" ") + 1
            at += len(line)
        self._end += sum(map(len, lines))
        self.committed += 1

    def merged(self, lines: Iterable[bytes]) -> Iterator[bytes]:
        """The lines of the result file, those that were rewritten with their new text and the line ends they have."""
        with open(self.path, "rb") as file:
            for at, line in zip(self._at[1:], lines, strict=True):
                if at < 0:
                    yield line
                else:
                    file.seek(at)
                    yield file.readline()[:-1] + line[len(line.rstrip(b"\r\n")) :]

    def remove(self) -> None:
        """Delete the file: the run is over."""
        self._new = False  # what is there after this is another run's
        if fcntl is None:
            self._file.close()
        with contextlib.suppress(FileNotFoundError):
            self.path.unlink()

    def _read_head(self) -> bytes:
        """The first line; nothing if the journal is new, or its run was killed before it began."""
        with open(self.path, "rb") as file:
            head = file.readline()
        if not head.endswith(b"\n") and _HEAD.startswith(head[: len(_HEAD)]):
            return b""
        try:
            about = json.loads(head)
        except ValueError:
            about = None
        if not isinstance(about, dict) or about.get("kind") != _KIND:
            raise DataError(f"{self.path}: is no journal of physpose refine; move it away, or choose another --out")
        return head

    def _replay(self) -> Iterator[dict[str, Any]]:
        at = end = self._end
        places: dict[int, int] = {}
        crc = 0
        with open(self.path, "rb") as file:
            file.seek(at)
            for line in file:
                if not line.endswith(b"\n"):
                    break
                if line.startswith(b"{"):
                    record = _record(line, len(places), crc)
                    if record is None:
                        break
                    self._at[list(places)] = list(places.values())
                    self.committed += 1
                    end, places, crc = at + len(line), {}, 0
                    yield record
                else:
                    number, _, _ = line.partition(b" ")
                    if not number.isdigit() or not 0 < int(number) < len(self._at):
                        break
                    places[int(number)] = at + len(number) + 1
                    crc = zlib.crc32(line, crc)
                at += len(line)
        self._end = end  # the next commit cuts off what is torn

    def _append(self, data: bytes) -> None:
        with written(self.path):
            self._file.truncate(self._end)
            self._file.seek(self._end)
            view = memoryview(data)
            try:
                while view:
                    view = view[self._file.write(view) :]
                os.fsync(self._file.fileno())
            except OSError:
                with contextlib.suppress(OSError):
                    self._file.truncate(self._end)
                raise


def _locked(path: Path) -> BinaryIO:
    while True:
        file = open(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+b", buffering=0)  # noqa: SIM115
        try:
            _lock(file, path)
            if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                return file
        except FileNotFoundError:
            pass  # the run that had it came to its end and deleted it in between
        except BaseException:
            file.close()
            raise
        file.close()


def _lock(file: BinaryIO, path: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise DataError(f"{path}: another physpose refine is writing there; wait for it, or choose another --out") from None
        logger.warning("%s: cannot be locked (%s); start no second run with this --out", path, error.strerror)


def _record(line: bytes, rows: int, crc: int) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if record.get("rows") == rows and record.get("crc") == crc else None


def _differences(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "") -> str:
    """The entries in which two nested dictionaries differ, with both values."""
    told = []
    for key in {**before, **now}:
        a, b = before.get(key), now.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            told += [_differences(a, b, f"{prefix}{key}.")] if a != b else []
        elif a != b:
            told.append(f"{prefix}{key} (it was {a}, now {b})")
    return ", ".join(told)


def _sync_folder(folder: Path) -> None:
    """Make a new file's name last through a power cut, where folders can be synced."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
