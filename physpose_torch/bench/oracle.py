"""Exact distances from the test oracle of the checkout, computed once for all backends.

The oracle is brute force, some milliseconds a pair, so two processes share the work. They import nothing but numpy.
"""

import importlib.util
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["find_oracle", "oracle_distances"]

WORKERS = 2
CHUNK = 64
FEW = 300
"""Fewer pairs than this are done sooner here than other processes start."""

Polytope = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) [m] and triangles (F, 3)."""


def find_oracle() -> Path | None:
    """The oracle's file; None where the package is installed without its tests."""
    path = Path(__file__).parents[2] / "tests" / "oracle.py"
    return path if path.is_file() else None


def oracle_distances(
    path: Path, hulls: Sequence[Polytope], pairs: np.ndarray, R: np.ndarray, t: np.ndarray, *, workers: int = WORKERS
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances and normals of pairs of polytopes.

    Args:
        path: the oracle's file.
        hulls: all polytopes.
        pairs: (E, 2) which two.
        R: (E, 3, 3), t: (E, 3), pose of b in the frame of a [m].
        workers: processes; with one, or few pairs, all is done in this one.

    Returns:
        distance (E,) [m] and unit normal (E, 3) from a to b, in the frame of a.
    """
    jobs = [(str(path), *(x[i : i + CHUNK] for x in (pairs, R, t))) for i in range(0, len(pairs), CHUNK)]
    if workers < 2 or len(pairs) < FEW:
        answers = [_chunk(hulls, *job) for job in jobs]
    else:
        answers = _share(hulls, jobs, workers)
    distance = np.concatenate([np.zeros(0), *(d for d, _ in answers)])
    return distance, np.concatenate([np.zeros((0, 3)), *(n for _, n in answers)])


def _share(hulls: Sequence[Polytope], jobs: list[tuple], workers: int) -> list[Any]:
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))  # numpy reads it when it is imported; matrices here are small
    try:
        context = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
        with ProcessPoolExecutor(workers, mp_context=context, initializer=_keep, initargs=(hulls,)) as pool:
            return list(pool.map(_kept_chunk, jobs))
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_hulls: Sequence[Polytope] = ()


def _keep(hulls: Sequence[Polytope]) -> None:
    """Send the polytopes to a worker once, not with every chunk."""
    global _hulls
    _hulls = hulls


def _kept_chunk(job: tuple) -> tuple[np.ndarray, np.ndarray]:
    return _chunk(_hulls, *job)


def _chunk(hulls: Sequence[Polytope], path: str, pairs: np.ndarray, R: np.ndarray, t: np.ndarray):
    measure = _load(path)
    distance, normal = np.empty(len(pairs)), np.empty((len(pairs), 3))
    for k, (a, b) in enumerate(pairs.tolist()):
        (VA, FA), (VB, FB) = hulls[a], hulls[b]
        distance[k], normal[k] = measure(VA, FA, VB @ R[k].T + t[k], FB)
    return distance, normal


@cache
def _load(path: str) -> Callable:
    spec = importlib.util.spec_from_file_location("physpose_test_oracle", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.oracle_distance
