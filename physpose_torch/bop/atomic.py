"""Files that are there as a whole or not at all."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

__all__ = ["replacing"]


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
