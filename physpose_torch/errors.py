"""What this package raises on purpose; each error is also the builtin that callers would expect."""

__all__ = [
    "BackendError",
    "DataError",
    "InvalidInputError",
    "MissingExtraError",
    "PhysPoseError",
    "TableNotFoundError",
    "UnknownLabelError",
]


class PhysPoseError(Exception):
    """Base of all errors that this package raises on purpose."""


class InvalidInputError(PhysPoseError, ValueError):
    """An argument has the wrong shape, type, unit or value; the message names it and the remedy."""


class DataError(PhysPoseError, ValueError):
    """A file or one of its rows cannot be used; the message names file, place and remedy."""


class UnknownLabelError(PhysPoseError, KeyError):
    """A label has no body (no mesh in the models folder, say)."""

    def __str__(self) -> str:  # KeyError would print the message in quotes
        return str(self.args[0]) if self.args else ""


class MissingExtraError(PhysPoseError, ImportError):
    """A feature needs an optional dependency; the message names the extra to install."""


class BackendError(PhysPoseError, RuntimeError):
    """A distance backend or a child process failed."""


class TableNotFoundError(PhysPoseError, RuntimeError):
    """The images and poses do not tell where the table is; the message says what was missing."""
