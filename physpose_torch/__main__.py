"""The ``physpose`` command."""

import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 only if all went well, 130 if it was stopped by Ctrl-C or SIGTERM."""
    try:
        with _terminated_as_interrupted():
            return _run(argv)
    except KeyboardInterrupt as interrupt:
        print("; ".join(["physpose: interrupted", *map(str, interrupt.args)]), file=sys.stderr)
        return 130


@contextlib.contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM ends the block as Ctrl-C does, unless somebody else handles it, or may; also where Ctrl-C is the way to end."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    terminated = threading.Event()

    def terminate(*_: object) -> None:
        terminated.set()
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if terminated.is_set():
        raise KeyboardInterrupt


def _run(argv: Sequence[str] | None) -> int:
    from physpose_torch.commands import parse
    from physpose_torch.errors import PhysPoseError

    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.WARNING)
    try:
        command = parse(list(sys.argv[1:] if argv is None else argv))
        return command()
    except PhysPoseError as error:
        print(f"physpose: error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader, head say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # of a folder that may not be looked into, say
        where = "" if error.filename is None else f"{error.filename}: "
        print(f"physpose: error: {where}{error.strerror or error}; check the path, and who may use it", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
