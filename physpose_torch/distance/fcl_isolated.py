"""Signed distances by python-fcl in a process of its own: should it crash or hang, the run goes on with the same result."""

import atexit
import contextlib
import logging
import os
import pickle
import subprocess
import sys
import threading
import weakref

import torch
from torch import Tensor

from physpose_torch.distance.fcl import fcl_distance
from physpose_torch.errors import BackendError
from physpose_torch.geometry.convex import ConvexParts

__all__ = ["isolated_distance"]

logger = logging.getLogger("physpose_torch")

LIMIT_S = 10.0
"""[s]; a worker that has not answered then is killed."""
LIMIT_EACH_S = 1e-3
"""[s]; that much more for each pair. One takes 30 µs."""
GIVE_UP = 3
"""After so many queries in a row that failed no worker is started any more."""
_command = [sys.executable, "-P", "-m", "physpose_torch.distance.fcl_worker"]


def isolated_distance(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As :func:`physpose_torch.distance.fcl.fcl_distance`, with python-fcl in a worker process.

    A worker that crashes, or does not answer in time, is killed, and another one asked once more. Should that one fail,
    too, torch answers (:mod:`~physpose_torch.distance.sat`, :mod:`~physpose_torch.distance.gjk`): distances are the same to
    1e-9 m, and where several witness points (faces that face each other) or normals (corners that touch) are true, others may
    be given. Of the first time there is a warning.
    """
    worker = _workers.setdefault(os.getpid(), _Worker())  # a fork has no part in its parent's
    return fcl_distance(parts, pairs, R, t, ask=worker.ask)


class _Worker:
    """A process that is started when it is asked, and again when it has failed."""

    def __init__(self) -> None:
        self._lock, self._process, self._failures, self._warned = threading.Lock(), None, 0, False
        self._sent: weakref.WeakSet[ConvexParts] = weakref.WeakSet()

    def ask(self, parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor] | None:
        """fcl's nearest points, (E, 3) each, in the frame of part a; None: two workers failed."""
        with self._lock:
            if self._failures >= GIVE_UP:
                return None
            for _ in range(2):
                try:
                    points = self._answer(parts, pairs, R, t)
                except Exception as error:  # of any kind: what comes out of a torn pipe is anything
                    why = error
                else:
                    self._failures = 0
                    return points
            self._failures += 1
            if not self._warned:
                self._warned = True
                logger.warning("python-fcl failed twice (%s); torch answers in its place, slower but as exact", why)
            return None

    def _answer(self, parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        if self._process is None:
            self._process = _start()
        process, limit = self._process, LIMIT_S + LIMIT_EACH_S * len(pairs)
        late = threading.Event()
        timer = threading.Timer(limit, lambda: (late.set(), process.kill()))
        timer.daemon = True
        timer.start()
        try:
            new = None
            if parts not in self._sent:
                new = [tuple(x.numpy() for x in parts.part(p)) for p in range(parts.n_parts)]
                self._sent.add(parts)
            alive = {sent.handle for sent in self._sent}
            query = (limit, alive, parts.handle, new, pairs.numpy(), R.numpy(), t.numpy())
            pickle.dump(query, process.stdin)
            process.stdin.flush()
            points = torch.from_numpy(pickle.load(process.stdout))
        except (EOFError, BrokenPipeError) as error:
            code = self.end()
            what = f"no answer within {limit:.0f} s" if late.is_set() else f"its process ended with code {code}"
            raise BackendError(what) from error
        except BaseException:  # Ctrl-C, say: its answer would be taken for that to the next query
            self.end()
            raise
        finally:
            timer.cancel()
        return points[:, 0], points[:, 1]

    def end(self) -> int | None:
        """Kill the process, if there is one; returns its exit code."""
        process, self._process = self._process, None
        self._sent.clear()
        if process is None:
            return None
        process.kill()
        code = process.wait()
        process.stdout.close()
        with contextlib.suppress(OSError):  # what was not written yet cannot be any more
            process.stdin.close()
        return code


def _start() -> subprocess.Popen:
    return subprocess.Popen(
        _command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        start_new_session=True,  # Ctrl-C is for us
    )


_workers: dict[int, _Worker] = {}
atexit.register(lambda: os.getpid() in _workers and _workers[os.getpid()].end())
