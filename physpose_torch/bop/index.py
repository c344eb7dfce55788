"""Where the rows of each image are in a result file, so that a file of any size is read a few images at a time."""

import hashlib
import os
import re
from array import array
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from physpose_torch.bop.formats import Estimates, make_estimates, no_result_file, parse_rows, refuse_metres
from physpose_torch.errors import DataError
from physpose_torch.reading import opened

__all__ = ["EstimatesIndex"]

_BLOCK = 1 << 18  # bytes read at a time
_LINE = re.compile(rb"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+")
_LONGEST = 16_000_000  # bytes of a line
_IDS = 10**9  # more than any id
_NOBODY = -1  # whose lines without scene and image are


class EstimatesIndex:
    """An index of a BOP result CSV. Rows of one image may be anywhere in the file.

    The file is read once from one end to the other, and kept open; an index that was pickled opens it anew. Memory is 16 bytes
    a line and 24 an image, several times that while the index is made; never the rows themselves.

    Args:
        path: the CSV; what :func:`~physpose_torch.bop.formats.read_estimates` accepts. A pipe is copied to disk first.
        on_bytes: called with the number of bytes of each block that has been read.

    Raises:
        DataError: as :func:`~physpose_torch.bop.formats.read_estimates`.
    """

    path: Path
    """The file."""
    digest: str
    """SHA-256 of its content, hexadecimal."""
    keys: np.ndarray
    """(images, 2) int64, scene_id and im_id: first the images with usable rows by the first of these, then those without by
    their first row."""
    usable: int
    """How many images have usable rows."""
    unplaced: list[str]
    """What is wrong with rows that do not tell their image."""

    def __init__(self, path: str | os.PathLike, *, on_bytes: Callable[[int], object] = lambda count: None) -> None:
        self.path = Path(path)
        self._file = _opened(self.path)
        try:
            self._stamp = self._stat()
            self._scan(on_bytes)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "EstimatesIndex":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def lines(self) -> int:
        """How many lines the file has."""
        return len(self._offset) - 1

    def choose(self, scenes: Iterable[int] = (), every: int = 1) -> np.ndarray:
        """Numbers of the images, in order: only of these scenes, if any, and only every n-th."""
        scenes = list(scenes)
        chosen = np.isin(self.keys[:, 0], scenes) if scenes else np.ones(len(self.keys), dtype=bool)
        return np.flatnonzero(chosen)[::every]

    def names(self, images: np.ndarray) -> list[tuple[int, int]]:
        """(scene_id, im_id) of the images with these numbers."""
        return [(scene, image) for scene, image in self.keys[images].tolist()]

    def numbers(self, keys: Iterable[tuple[int, int]]) -> np.ndarray:
        """Numbers of the images of these (scene_id, im_id), ascending; those that the file does not name are left out."""
        wanted = np.array([s * _IDS + i for s, i in keys], dtype=np.int64)
        every = self.keys[:, 0] * _IDS + self.keys[:, 1]
        return np.flatnonzero(np.isin(every, wanted)) if len(wanted) else wanted

    def read(self, images: np.ndarray) -> Estimates:
        """All rows of the images with these numbers, in file order.

        Raises:
            DataError: the file was changed since the index was made.
        """
        if self._file is None:
            self._file = _opened(self._real)
        spans = [self._order[self._start[i] : self._start[i + 1]] for i in np.unique(images)]
        lines = np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *spans]))
        text = []
        for start, end in zip(self._offset[lines].tolist(), self._offset[lines + 1].tolist(), strict=True):
            self._file.seek(start)
            text.append(self._file.read(end - start).decode(errors="replace"))
        self._check()
        rows, problems, _ = parse_rows(self.path, zip((lines + 1).tolist(), text, strict=True), started=True)
        return make_estimates(self.path, rows, problems, text, lines + 1)

    def __getstate__(self) -> dict[str, Any]:
        """Without the open file: another process opens it when it first reads."""
        if not self.path.is_file():
            raise DataError(f"{self.path}: is a pipe, which other processes cannot read; save it to a file")
        return self.__dict__ | {"_file": None, "_real": self.path.resolve()}

    def __iter__(self) -> Iterator[bytes]:
        """All lines of the file, line ends included.

        Raises:
            DataError: the file was changed since the index was made.
        """
        for lines in _blocks(self._file, self.path):
            self._check()
            yield from lines

    def _scan(self, on_bytes: Callable[[int], object]) -> None:
        offset, key, usable = array("q", [0]), array("q"), bytearray()
        shallow, deep = array("d"), 0
        self.unplaced, digest = [], hashlib.sha256()
        blank, result_file, bad = True, False, []  # bad: the first one
        for block in _blocks(self._file, self.path):
            text = []
            for line in block:
                try:
                    text.append(line.decode())
                except UnicodeDecodeError as error:
                    where = offset[-1] + error.start
                    raise DataError(f"{self.path}: not UTF-8 text (byte {where}); save it as UTF-8") from None
                offset.append(offset[-1] + len(line))
                digest.update(line)
            blank = blank and not "".join(text).strip("\ufeff \t\r\n")
            first = len(key)
            started = result_file or bool(bad)
            rows, problems, header = parse_rows(self.path, enumerate(text, start=first + 1), started=started)
            result_file = result_file or header or bool(rows)
            bad = bad or problems[:1]
            depths = [row[6][2] for row in rows if row[6][2] > 0]
            deep += len(depths)
            shallow.extend(depth for depth in depths if depth < 10)
            estimates = make_estimates(self.path, rows, problems, ())
            of = np.full(len(text), _NOBODY, dtype=np.int64)
            good = np.zeros(len(text), dtype=bool)
            of[estimates.line - first - 1] = estimates.scene_id * _IDS + estimates.im_id
            good[estimates.line - first - 1] = True
            for problem in estimates.problems:
                if problem.scene_id is None or problem.im_id is None:
                    self.unplaced.append(problem.message)
                else:
                    of[problem.line - first - 1] = problem.scene_id * _IDS + problem.im_id
            key.frombytes(of.tobytes())
            usable += good.tobytes()
            on_bytes(sum(map(len, block)))
        if blank:
            raise DataError(f"{self.path}: the file is empty")
        if not result_file:
            raise no_result_file(self.path, bad)
        refuse_metres(self.path, shallow, deep)
        self.digest = digest.hexdigest()
        self._offset = np.frombuffer(offset, dtype=np.int64)
        self._sort(np.frombuffer(key, dtype=np.int64), np.frombuffer(usable, dtype=bool))

    def _sort(self, key: np.ndarray, usable: np.ndarray) -> None:
        """Which images there are, and the lines of each, from the key of each line."""
        readable = _by_appearance(key[usable])
        placed = np.flatnonzero(key != _NOBODY)
        every = _by_appearance(key[placed])
        keys = np.concatenate([readable, every[~np.isin(every, readable)]])
        self.usable = len(readable)
        self.keys = np.stack([keys // _IDS, keys % _IDS], axis=1)
        by_key = np.argsort(keys)
        image = by_key[np.searchsorted(keys, key[placed], sorter=by_key)]
        self._order = placed[np.argsort(image, kind="stable")]
        self._start = np.concatenate([[0], np.cumsum(np.bincount(image, minlength=len(keys)))])

    def _stat(self) -> tuple[int, int]:
        stat = os.fstat(self._file.fileno())
        return stat.st_size, stat.st_mtime_ns

    def _check(self) -> None:
        if self._stat() != self._stamp:
            raise DataError(f"{self.path}: the file was changed while it was being read; start again")


def _by_appearance(key: np.ndarray) -> np.ndarray:
    """Each key once, in the order of their first appearance."""
    unique, first = np.unique(key, return_index=True)
    return unique[np.argsort(first)]


def _opened(path: Path) -> BinaryIO:
    try:
        return opened(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path") from None


def _blocks(file: BinaryIO, path: Path) -> Iterator[list[bytes]]:
    """The lines of a file, line ends included, a few hundred kilobytes at a time."""
    file.seek(0)
    rest, at = b"", 0
    while block := file.read(max(_BLOCK, len(rest))):
        block = rest + block
        if len(rest) > _LONGEST:
            raise DataError(f"{path}: a line of more than {_LONGEST // 1_000_000} MB; is this a result file?")
        cut = max(block.rfind(b"\n"), block.rfind(b"\r", 0, -1)) + 1  # a \r at the end may be half of a \r\n
        at, rest = file.tell(), block[cut:]
        yield _LINE.findall(block[:cut])
        file.seek(at)  # rows may have been read in between
    if rest:
        yield _LINE.findall(rest)
