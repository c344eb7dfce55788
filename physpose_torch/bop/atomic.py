"""Files that are there as a whole or not at all."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from physpose_torch.errors import DataError

__all__ = ["replacing", "write_text", "written"]


@contextlib.contextmanager
def replacing(path: Path, *, temporary: Path | None = None) -> Iterator[BinaryIO]:
    """A binary file to write, which takes the place of ``path`` in one step once the block ends without an error.

    Args:
        path: the file to create or replace; its folder must exist.
        temporary: where to write until then, in the same folder; None: a name that nobody else has.

    Raises:
        OSError: it cannot be written; nothing is left behind, and ``path`` is as it was.
    """
    if temporary is None:
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()


@contextlib.contextmanager
def written(path: Path) -> Iterator[None]:
    """Tell that a file cannot be written as a :class:`DataError` that names it."""
    try:
        yield
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error}); check the folder and its free space") from None


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text file as a whole or not at all; of a link, the file it points to. A pipe or a device gets it as it comes.

    Raises:
        DataError: it cannot be written.
    """
    with written(Path(path)):
        path = Path(path).resolve()
        if path.exists() and not path.is_file():
            path.write_text(text)
            return
        with replacing(path) as file:
            file.write(text.encode())
