"""A triangle mesh as few convex hulls of few vertices: CoACD in a child process, our own merging, a disk cache."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import BinaryIO, NamedTuple

import fast_simplification
import numpy as np
import trimesh

from ..errors import BackendError, DataError, InvalidInputError
from ..files import TEMPORARY, cache_folder, one_at_a_time, remove_abandoned, replacing
from .cover import Surface, clean_mesh, measure_cover
from .hulls import few_vertices, fewest_parts, hand_out_extremes

__all__ = ["DecomposeOptions", "DecomposeReport", "Decomposition", "decompose", "decompose_many"]

logger = logging.getLogger("physpose_torch")

ALGORITHM_VERSION = 3  # part of the cache key: raise it whenever results change
_LARGEST = 100_000_000  # bytes that a cache file may unpack to
FINENESS = (3.0, 2.0)  # CoACD's concavity thresholds to try, in tolerances
_warned: set[bytes] = set()  # meshes whose fallback has been reported
_unwritable: set[Path | None] = set()  # cache folders of which that has been reported
_LIMITS = {
    "tolerance": (Real, 1e-5, 1.0),
    "max_hulls": (Integral, 1, 10_000),
    "max_vertices": (Integral, 8, 1000),
    "max_faces": (Integral, 20, 10_000_000),
    "time_limit_s": (Real, 0.1, 1e6),
    "seed": (Integral, 0, 2**31 - 1),
}


@dataclass(frozen=True, kw_only=True)
class DecomposeOptions:
    """How finely a mesh is cut into convex parts."""

    tolerance: float = 1e-3
    """The parts may stand out of the mesh by this much [m] at the 95th percentile of their surface.

    Less error costs parts, and a solver's cost grows with their square. The 21 YCB-V models, by ``physpose decompose DIR
    --options.tolerance T``: T = 1 mm: 1 to 97 parts, median 16, outward p95 at most 0.98 mm, inward p95 at most 1.16 mm;
    2 mm: up to 103 parts, median 7, 1.96 and 1.50 mm; 4 mm: up to 25 parts, median 1, 4.97 and 2.51 mm (where
    no cut is better, one hull is kept beyond the tolerance). Shells (bowl, mug, pitcher) and clamps need most parts.
    """
    max_hulls: int = 128
    """Merging goes on past the tolerance until no more parts than this are left."""
    max_vertices: int = 32
    """No hull has more vertices than this."""
    max_faces: int = 2000
    """The mesh is simplified to this many triangles for CoACD; vertices are put back onto the full mesh afterwards."""
    time_limit_s: float = 120.0
    """CoACD is killed after this time [s] and the convex hull is taken instead (with a warning, and not cached). So it is if it
    crashes; if somebody else kills it, for want of memory say, it is tried once more before."""
    seed: int = 0
    """CoACD's random seed."""

    def __post_init__(self) -> None:
        for name, (kind, low, high) in _LIMITS.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, kind) or not low <= value <= high:  # NaN is not
                what = "an integer" if kind is Integral else "a number"
                raise InvalidInputError(f"DecomposeOptions.{name} = {value!r}, expected {what} from {low} to {high}")


class DecomposeReport(NamedTuple):
    """What came out, measured on the final hulls. Lengths in metres."""

    method: str
    """`convex`: one hull is within tolerance; `coacd`: cut and merged; `hull`: stated fallback, see `warning`."""
    n_parts: int
    outward_p95: float
    """How far the exposed surface of the parts stands out of the mesh, 95th percentile [m]."""
    outward_max: float
    inward_p95: float
    """Distance from the mesh surface to the union of the parts, zero where covered, 95th percentile [m]."""
    inward_max: float
    seconds: float
    warning: str | None = None


class Decomposition(NamedTuple):
    hulls: list[np.ndarray]
    """Vertices of each part, (V, 3) float64 [m], in convex position, V <= max_vertices."""
    report: DecomposeReport


_CHILD = """
import io, os, sys, threading, time
def watch():
    while os.getppid() == int(sys.argv[1]):
        time.sleep(0.2)
    os._exit(1)
if os.name == "posix":
    threading.Thread(target=watch, daemon=True).start()  # it ends by itself should the parent be killed
result = os.dup(1)
os.dup2(2, 1)  # what C code prints is not the result
import coacd, numpy
coacd.set_log_level("error")
with numpy.load(io.BytesIO(sys.stdin.buffer.read())) as data:
    parts = coacd.run_coacd(
        coacd.Mesh(data["vertices"], data["faces"]), threshold=float(data["threshold"]), seed=int(data["seed"]),
        preprocess_mode=str(data["preprocess_mode"]), preprocess_resolution=30, real_metric=True, merge=False,
        mcts_nodes=10, mcts_iterations=60)
parts = [vertices for vertices, _ in parts]
with open(result, "wb") as file:
    numpy.savez(file, vertices=numpy.concatenate(parts), counts=[len(p) for p in parts])
"""
_child_command = [sys.executable, "-P", "-c", _CHILD]  # a program text, not an import: works from scripts and notebooks
_OUTSIDE = {-getattr(signal, name, 0) for name in ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")} - {0}


class _KilledError(BackendError):
    """CoACD ran out of memory, or was killed by somebody else: no fault of the mesh."""


def _run_coacd(
    vertices: np.ndarray, faces: np.ndarray, *, deadline: float, stop: threading.Event, **settings
) -> list[np.ndarray]:
    """CoACD's parts as vertex arrays [m]; BackendError if the child crashes, is stopped, or runs past the deadline.

    A child that was killed from outside, or had no memory, gets a second chance. Nothing is written to disk.
    """
    try:
        return _ask_child(vertices, faces, deadline=deadline, stop=stop, **settings)
    except _KilledError as error:
        logger.warning("%s; it is tried once more", error)
        return _ask_child(vertices, faces, deadline=deadline, stop=stop, **settings)


def _ask_child(vertices, faces, *, deadline: float, stop: threading.Event, **settings) -> list[np.ndarray]:
    limit = max(deadline - time.monotonic(), 0)
    given = io.BytesIO()
    np.savez(given, vertices=vertices, faces=faces, **settings)
    try:
        child = subprocess.Popen(
            [*_child_command, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            start_new_session=True,  # Ctrl-C is for us, who then stop it
        )
    except OSError as error:
        raise _KilledError(f"CoACD's process cannot be started ({error.strerror})") from error
    # communicate() forgets what it has not written when its time is up
    pipe, child.stdin = child.stdin, None
    threading.Thread(target=_write, args=(pipe, given.getvalue()), daemon=True).start()
    try:
        while True:
            try:
                found, message = child.communicate(timeout=0.2)
                break
            except subprocess.TimeoutExpired:
                if stop.is_set() or time.monotonic() > deadline:
                    raise BackendError(f"CoACD was stopped after {limit:.0f} s") from None
    finally:  # also on KeyboardInterrupt
        child.kill()
        child.wait()
    if child.returncode != 0:
        tail = message.decode(errors="replace").strip().splitlines()[-1:]
        starved = any(word in message for word in (b"MemoryError", b"bad_alloc"))
        kind = _KilledError if starved or child.returncode in _OUTSIDE else BackendError
        raise kind(" ".join([f"CoACD's process ended with code {child.returncode}", *tail]))
    try:
        with np.load(io.BytesIO(found)) as data:
            return np.split(data["vertices"], np.cumsum(data["counts"])[:-1])
    except Exception as error:  # of any kind, see _load
        raise BackendError(f"CoACD's answer cannot be read ({error})") from error


def _write(pipe: BinaryIO, content: bytes) -> None:
    with contextlib.suppress(OSError), pipe:  # the child may have been killed
        pipe.write(content)


def _cut(
    mesh: trimesh.Trimesh, surface: Surface, options: DecomposeOptions, threshold: float, stop: threading.Event
) -> list[np.ndarray]:
    """CoACD's parts, their vertices put back onto the mesh (simplification and remeshing move them)."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if len(faces) > options.max_faces:
        vertices, faces = fast_simplification.simplify(vertices, faces, target_count=options.max_faces)
    deadline = time.monotonic() + options.time_limit_s
    settings = {"threshold": threshold, "seed": options.seed}
    # "off" neither inflates nor remeshes but needs a closed mesh; "auto" remeshes an open one
    modes = ["off", "auto"] if mesh.is_watertight else ["auto"]
    for mode in modes:
        try:
            parts = _run_coacd(vertices, faces, deadline=deadline, stop=stop, preprocess_mode=mode, **settings)
            return hand_out_extremes(
                [surface.snap(part, options.tolerance) for part in parts], surface, options.tolerance
            )
        except BackendError as error:
            if mode == modes[-1] or time.monotonic() > deadline or isinstance(error, _KilledError):
                raise
    raise AssertionError("unreachable")


def _cut_and_merge(mesh: trimesh.Trimesh, surface: Surface, options: DecomposeOptions, stop: threading.Event):
    """Cut finer until the final hulls are within tolerance, else return the best parts, their errors, and a warning or None.

    One coarse cut first: most models need no other, and time and parts grow with the square of fineness.
    """
    best, warning, limits = None, None, {k: getattr(options, k) for k in ("tolerance", "max_hulls", "max_vertices")}
    for fineness in FINENESS:
        try:
            parts = _cut(mesh, surface, options, fineness * options.tolerance, stop)
        except BackendError as error:
            if best is None or stop.is_set():
                raise
            if isinstance(error, _KilledError):
                warning = f"{error}; its parts are coarser than they could be"
            break
        found = fewest_parts(parts, surface, **limits, stop=stop)
        if best is None or found[1]["outward_p95"] < best[1]["outward_p95"]:
            best = found
        if best[1]["outward_p95"] <= options.tolerance or len(best[0]) >= options.max_hulls:
            break  # within tolerance, or short of parts, not of fineness
    return *best, warning


def _decompose(mesh, options: DecomposeOptions, cache: bool, name: str, stop: threading.Event) -> Decomposition:
    mesh = clean_mesh(mesh, name)
    path = _cache_path(mesh, options) if cache else None
    if path is None:
        return _work_out(mesh, options, name, stop)
    if found := _load(path):
        return found
    with one_at_a_time(path, patience=2 * options.time_limit_s, stop=stop) as waited:
        if waited and (found := _load(path)):
            return found
        result = _work_out(mesh, options, name, stop)
        if result.report.warning is None:  # neither a time-out nor a kill must stick
            _store(path, result)
        return result


def _work_out(mesh: trimesh.Trimesh, options: DecomposeOptions, name: str, stop: threading.Event) -> Decomposition:
    start = time.perf_counter()
    surface, warning = Surface(np.array(mesh.triangles), mesh.is_watertight), None
    whole = [few_vertices(mesh.vertices, options.max_vertices, options.tolerance)]
    method, parts, errors = "convex", whole, measure_cover(whole, surface, options.tolerance)
    if max(errors["outward_p95"], errors["inward_p95"]) > options.tolerance:
        try:
            cut_parts, cut_errors, warning = _cut_and_merge(mesh, surface, options, stop)
            if cut_errors["outward_p95"] < errors["outward_p95"]:  # else cutting was of no use
                method, parts, errors = "coacd", cut_parts, cut_errors
        except BackendError as error:
            if stop.is_set():
                raise
            method, warning = "hull", f"{error}; its convex hull is used instead"
    if warning is not None:
        warning = f"{name}: {warning}"
        if (content := _digest(mesh)) not in _warned:  # once per mesh, not on every call
            _warned.add(content)
            warnings.warn(warning, stacklevel=4)
    report = DecomposeReport(method, len(parts), **errors, seconds=time.perf_counter() - start, warning=warning)
    return Decomposition(parts, report)


def _digest(mesh: trimesh.Trimesh) -> bytes:
    """What tells a canonical mesh from others."""
    content = hashlib.sha256(np.round(mesh.vertices * 1e9).astype("<i8").tobytes())
    content.update(mesh.faces.astype("<i8").tobytes())
    return content.digest()


def _cache_path(mesh: trimesh.Trimesh, options: DecomposeOptions) -> Path | None:
    try:
        folder = cache_folder("decompose")
    except OSError as error:
        _not_cached(None, error)
        return None
    choices = {k: v for k, v in asdict(options).items() if k != "time_limit_s"}
    key = hashlib.sha256(json.dumps([ALGORITHM_VERSION, choices], sort_keys=True).encode())
    key.update(_digest(mesh))
    return folder / f"{key.hexdigest()}.npz"


def _load(path: Path) -> Decomposition | None:
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _LARGEST:
                raise ValueError("too large")
        with np.load(path, allow_pickle=False) as data:
            if torn := data.zip.testzip():
                raise DataError(f"{torn} is damaged")
            hulls = np.split(data["vertices"], np.cumsum(data["counts"])[:-1])
            found = Decomposition(hulls, DecomposeReport(**json.loads(str(data["report"]))))
        if len(hulls) != found.report.n_parts or not all(_sound(hull) for hull in hulls):
            raise DataError("it has other parts than it says")
        return found
    except (FileNotFoundError, NotADirectoryError):
        return None
    except Exception as error:  # of any kind: zipfile, zlib, struct and ast meet what was torn or written over
        logger.warning("cache file %s is unreadable (%s): computed anew", path, error)
        return None


def _sound(hull: np.ndarray) -> bool:
    return hull.dtype == np.float64 and hull.shape == (len(hull), 3) and len(hull) > 3 and bool((np.abs(hull) < 1e3).all())


def _store(path: Path, result: Decomposition) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(path.parent, f".*{TEMPORARY}")
        with replacing(path) as file:  # readers and other writers never see half a file
            np.savez_compressed(
                file,
                vertices=np.concatenate(result.hulls),
                counts=[len(h) for h in result.hulls],
                report=json.dumps(result.report._asdict()),
            )
    except OSError as error:
        _not_cached(path.parent, error)


def _not_cached(folder: Path | None, error: OSError) -> None:
    if folder not in _unwritable:  # once, not for every mesh
        _unwritable.add(folder)
        logger.warning("decompositions are not cached: %s (set PHYSPOSE_CACHE to a writable folder)", error)


def decompose(
    mesh: trimesh.Trimesh, options: DecomposeOptions | None = None, *, cache: bool = True, name: str = "mesh"
) -> Decomposition:
    """Cut a mesh into convex hulls.

    Args:
        mesh: triangles in metres; closed or not, merged or not.
        options: tolerances and limits.
        cache: look the result up, and keep it, in ``$PHYSPOSE_CACHE/decompose`` (default: the user's cache folder).
            The key is made of the triangles (rounded to 1e-9 m, in any order) and the options. Where it cannot be read or
            written there is a warning, once; what is damaged is computed anew; what another process is at is waited for.
        name: what errors and warnings call the mesh.

    Returns:
        Convex hulls of at most ``options.max_vertices`` vertices, each with a volume (a part flatter than
        ``MIN_THICKNESS`` is extruded to it), and a report of errors measured on them.

    Raises:
        DataError: no faces, NaN, or flat.
        InvalidInputError: larger than 10 m or smaller than 1 mm, as a mesh in millimetres is.

    Source: Wei et al., "Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and Tree Search",
    SIGGRAPH 2022 (CoACD).
    """
    return _decompose(mesh, options or DecomposeOptions(), cache, name, threading.Event())


def decompose_many(
    meshes: Mapping[str, trimesh.Trimesh | str | Path | Callable[[], trimesh.Trimesh]],
    options: DecomposeOptions | None = None,
    *,
    cache: bool = True,
    workers: int | None = None,
) -> Iterator[tuple[str, Decomposition | Exception]]:
    """Decompose many meshes at once, yielding ``(name, result)`` as each is done; a failed one yields its exception.

    Args:
        meshes: name to mesh [m], to a file in metres, or to a function that loads one.
        options: the same for all.
        cache: as in :func:`decompose`.
        workers: meshes at a time, by default one a core.
    """
    options, stop = options or DecomposeOptions(), threading.Event()

    def work(name, mesh):
        if isinstance(mesh, str | Path):
            mesh = trimesh.load_mesh(mesh, process=False)
        elif not isinstance(mesh, trimesh.Trimesh):
            mesh = mesh()
        return _decompose(mesh, options, cache, name, stop)

    executor = ThreadPoolExecutor(workers or os.cpu_count())
    jobs = {executor.submit(work, name, mesh): name for name, mesh in meshes.items()}
    try:
        for job in as_completed(jobs):
            error = job.exception()
            if error is not None and not isinstance(error, Exception):
                raise error
            yield jobs[job], error or job.result()
    finally:  # also when the caller stops early or presses Ctrl-C
        stop.set()
        executor.shutdown(cancel_futures=True)
