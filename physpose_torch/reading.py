"""Reading what may be anything: files that data names, of any size, kind and content, each with an error that names it."""

import contextlib
import json
import os
import reprlib
import select
import stat
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from physpose_torch.errors import DataError

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["inside", "load_json", "opened", "read_bytes", "read_pixels", "read_size", "read_text", "shown"]

LARGEST = 1 << 30
"""[bytes]; what is read as a whole is not larger."""
MOST_PIXELS, LONGEST_SIDE = 150_000_000, 30_000
"""A picture that claims to be larger is not decoded; OpenCV counts pixels of a row in 16 bits."""
PATIENCE = 5.0
"""[s]; this long a pipe is waited for that nobody writes to."""

_repr = reprlib.Repr()
_repr.maxstring = _repr.maxother = _repr.maxlong = 200
_repr.maxlist = _repr.maxtuple = _repr.maxdict = 16


def shown(value: Any) -> str:
    """A value for a message: ``repr``, cut where it is long or deep."""
    return _repr.repr(value)


def opened(path: str | os.PathLike, most: int | None = None) -> BinaryIO:
    """A regular file, to read. A pipe is copied to disk first.

    Args:
        path: of the file.
        most: it may not be larger than this [bytes].

    Raises:
        OSError: it cannot be opened.
        DataError: it is neither, is too large, or a pipe that nobody writes to.
    """
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0)))  # noqa: SIM115
    kind = os.fstat(file.fileno()).st_mode
    if not stat.S_ISREG(kind):
        with file as pipe:
            if not stat.S_ISFIFO(kind):
                raise DataError(f"{path}: is neither a file nor a pipe; name a file")
            file = _copied(pipe, path, most)
    if most is not None and os.fstat(file.fileno()).st_size > most:
        file.close()
        raise DataError(f"{path}: more than {most / 1e9:.1f} GB are too much to be read at once; is it the right file?")
    return file


def _copied(pipe: BinaryIO, path: str | os.PathLike, most: int | None) -> BinaryIO:
    """What comes out of a pipe, as a file; of more than ``most`` bytes only the beginning, as the pipe may have no end."""
    copy = tempfile.TemporaryFile()  # noqa: SIM115
    copy.write(_first(pipe, path))
    os.set_blocking(pipe.fileno(), True)
    while (most is None or copy.tell() <= most) and (block := pipe.read(1 << 20)):
        copy.write(block)
    copy.seek(0)
    return copy


def _first(file: BinaryIO, path: str | os.PathLike) -> bytes:
    """What had to be read from a pipe to learn that somebody writes to it; a slow writer may take its time."""
    poll = select.poll()
    poll.register(file, select.POLLIN)
    if poll.poll(1000 * PATIENCE):
        return b""
    try:
        if first := os.read(file.fileno(), 1):
            return first
    except BlockingIOError:
        return b""
    raise DataError(f"{path}: is a pipe that nobody writes to; start what writes to it first, or name a file")


def read_bytes(path: str | os.PathLike) -> bytes:
    """A whole file.

    Raises:
        DataError: it is missing, larger than 1 GiB, or no file.
    """
    try:
        with opened(path, LARGEST) as file:
            return file.read()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path") from None


def read_text(path: str | os.PathLike) -> str:
    """A whole text file.

    Raises:
        DataError: it is missing, empty, larger than 1 GiB, not UTF-8, or no file.
    """
    data = read_bytes(path)
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    if not text.strip("\ufeff \t\r\n"):
        raise DataError(f"{path}: the file is empty")
    return text


def load_json(path: str | os.PathLike) -> Any:
    """Parse a JSON file (UTF-8, byte order mark allowed).

    Raises:
        DataError: The file is missing, empty, not UTF-8, no JSON, or has a key twice in one object.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(result := dict(pairs)) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise DataError(f"{path}: key {shown(twice)} appears twice in one object; keep one of them")
        return result

    try:
        return json.loads(read_text(path).lstrip("\ufeff"), object_pairs_hook=unique)
    except DataError:
        raise
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: no valid JSON: {error}") from None


def inside(folder: Path, name: str) -> Path:
    """Where a path leads that a data file in a folder names, links followed; nothing need be there.

    Raises:
        ValueError: it leaves the folder, or is no path.
    """
    try:
        path, folder = (folder / name).resolve(), folder.resolve()
        path.is_file()  # raises if it is too long
    except (OSError, RuntimeError, ValueError) as error:  # too long; a loop of links; a null byte
        raise ValueError(f"{shown(name)} is no path ({_reason(error)}); correct it") from None
    if not path.is_relative_to(folder):
        raise ValueError(f"{shown(name)} leaves the folder {folder}; put the file there")
    return path


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


@contextlib.contextmanager
def _picture(path: str | os.PathLike) -> "Iterator[Image]":
    """Pillow's image, without its warning of large ones: there is a limit of our own."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        with Image.open(path) as image:
            yield image


def read_size(path: str | os.PathLike) -> tuple[int, int] | None:
    """Width and height of an image file [px]; None if it is not one, or unreasonably large."""
    try:
        if not Path(path).is_file():
            return None
        with _picture(path) as image:
            reasonable = image.width * image.height <= MOST_PIXELS and max(image.size) <= LONGEST_SIDE
            return image.size if reasonable else None
    except Exception:  # whatever Pillow's many plugins raise
        return None


def read_pixels(path: str | os.PathLike) -> tuple[str, np.ndarray]:
    """An image file as Pillow's mode and (H, W) or (H, W, C) values; RGB where it has colours.

    Raises:
        DataError: it is missing, no image, broken, or unreasonably large.
    """
    from PIL import UnidentifiedImageError

    if not Path(path).is_file():
        raise DataError(f"{path}: no such image file")
    try:
        with _picture(path) as image:
            if image.width * image.height > MOST_PIXELS or max(image.size) > LONGEST_SIDE:
                raise DataError(f"{path}: {image.width} x {image.height} px is no photograph")
            return image.mode, np.array(image if image.mode.startswith(("I", "F")) else image.convert("RGB"))
    except DataError:
        raise
    except UnidentifiedImageError:
        raise DataError(f"{path}: cannot be read as an image (of no known format); get the file again") from None
    except Exception as error:  # whatever Pillow's many plugins raise
        raise DataError(f"{path}: cannot be read as an image ({_reason(error)}); get the file again") from None
