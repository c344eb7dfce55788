"""A triangle mesh as few convex hulls of few vertices: CoACD in a child process, our own merging, a disk cache."""

from __future__ import annotations

import hashlib
import heapq
import itertools
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import fast_simplification
import numpy as np
import platformdirs
import trimesh
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError, cKDTree

from ..errors import BackendError, DataError, InvalidInputError

__all__ = ["DecomposeOptions", "DecomposeReport", "Decomposition", "decompose", "decompose_many"]

logger = logging.getLogger("physpose_torch")

ALGORITHM_VERSION = 2  # part of the cache key: raise it whenever results change
SHAVE = 1.0  # a facet over a hollow may be moved inwards by this many tolerances
MIN_THICKNESS = 2e-4  # [m] a part flatter than this is extruded to it, so that every hull has a volume


@dataclass(frozen=True, kw_only=True)
class DecomposeOptions:
    """How finely a mesh is cut into convex parts."""

    tolerance: float = 1e-3
    """The parts may stand out of the mesh by this much [m] at the 95th percentile of their surface."""
    max_hulls: int = 64
    """Merging goes on past the tolerance until no more parts than this are left."""
    max_vertices: int = 32
    """No hull has more vertices than this."""
    max_faces: int = 2000
    """The mesh is simplified to this many triangles for CoACD; vertices are put back onto the full mesh afterwards."""
    time_limit_s: float = 120.0
    """CoACD is killed after this time [s] and the convex hull is taken instead (with a warning, and not cached)."""
    seed: int = 0
    """CoACD's random seed."""


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


class _Surface:
    """Distances to a mesh: a KD-tree over samples proposes triangles, the nearest of them is measured exactly."""

    def __init__(self, triangles: np.ndarray, solid: bool, n_samples: int = 20_000):
        self.triangles, self.solid = triangles, solid
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        self.area = np.linalg.norm(cross, axis=1) / 2
        self.normals = cross / np.maximum(2 * self.area, 1e-30)[:, None]
        samples, self.owner = _sample(triangles, self.area, n_samples)
        # centroids too: a sliver may get no sample
        self.owner = np.concatenate([self.owner, np.arange(len(triangles))])
        self.extreme, _, self.bounds = _hull(triangles.reshape(-1, 3))
        self.tree = cKDTree(np.concatenate([samples, triangles.mean(1)]))

    def _candidates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        owner = self.owner[self.tree.query(points, k=4)[1]]
        flat = np.repeat(points, owner.shape[1], axis=0)
        return owner, trimesh.triangles.closest_point(self.triangles[owner.ravel()], flat).reshape(*owner.shape, 3)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Distance to the surface [m], negative inside a closed mesh."""
        owner, closest = self._candidates(points)
        offset = points[:, None] - closest
        distance = np.linalg.norm(offset, axis=-1)
        nearest = distance.min(1)
        if not self.solid:
            return nearest
        # at an edge several triangles are nearest: the sign is that of the one seen least obliquely
        height = np.einsum("pkc,pkc->pk", offset, self.normals[owner])
        height[distance > nearest[:, None] + 1e-7] = 0.0
        side = height[np.arange(len(points)), np.abs(height).argmax(1)]
        return np.where(side < 0, -nearest, nearest)

    def snap(self, points: np.ndarray) -> np.ndarray:
        """The nearest point of the surface."""
        closest = self._candidates(points)[1]
        best = np.linalg.norm(points[:, None] - closest, axis=-1).argmin(1)
        return closest[np.arange(len(points)), best]


def _sample(triangles: np.ndarray, area: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """n points spread evenly over the triangles, the same ones every time (systematic sampling, R2 sequence)."""
    edges = np.cumsum(area)
    owner = np.searchsorted(edges, (np.arange(n) + 0.5) / n * edges[-1]).clip(max=len(triangles) - 1)
    u, v = (np.arange(1, n + 1)[:, None] * [0.7548776662466927, 0.5698402909980532] % 1.0).T
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = triangles[owner].transpose(1, 0, 2)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), owner


def _hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices in convex position (V, 3), triangles (F, 3, 3) and half-spaces (F, 4) of the hull of points.

    Points flatter than MIN_THICKNESS are extruded along their thin directions first.
    """
    for axis in np.linalg.eigh(np.cov(points.T))[1].T:  # thinnest first
        height = points @ axis
        if np.ptp(height) < MIN_THICKNESS:
            middle = points + (height.mean() - height)[:, None] * axis
            points = np.concatenate([middle - MIN_THICKNESS / 2 * axis, middle + MIN_THICKNESS / 2 * axis])
    hull = ConvexHull(points)
    return points[hull.vertices], points[hull.simplices], hull.equations


def _inscribed(points: np.ndarray, max_vertices: int, tolerance: float = 1e-4) -> np.ndarray:
    """At most max_vertices vertices of the hull of points, whose own hull misses as little of it as may be.

    Farthest-point insertion: start at the extremes, add the vertex that lies farthest outside. The result is inscribed:
    it never stands out of the hull of points, the error is inward only.
    """
    vertices = _hull(points)[0]
    chosen = list(dict.fromkeys(np.concatenate([vertices.argmin(0), vertices.argmax(0)]).tolist()))
    while len(chosen) < min(max_vertices, len(vertices)):
        try:
            equations = ConvexHull(vertices[chosen]).equations if len(chosen) > 3 else None
        except QhullError:
            equations = None
        if equations is None:  # not yet a volume: add what is farthest from the affine span
            base = vertices[chosen] - vertices[chosen[0]]
            rank = np.linalg.matrix_rank(base, tol=1e-3 * np.ptp(vertices, axis=0).max())
            span = np.linalg.svd(base)[2][:rank]
            offset = vertices - vertices[chosen[0]]
            outside = np.linalg.norm(offset - offset @ span.T @ span, axis=1)
            outside[chosen] = -1
        else:
            outside = (vertices @ equations[:, :3].T + equations[:, 3]).max(1)
            if outside.max() < tolerance:
                break
            outside[chosen] = -np.inf
        chosen.append(int(outside.argmax()))
    return _hull(vertices[chosen])[0]


def _overhang(hull: tuple[np.ndarray, ...], surface: _Surface, tolerance: float, n: int = 100):
    """Samples on a part's hull: facet, outward distance [m], and how far that facet may be shaved [m]; and the area.

    A facet that bounds the whole mesh is not shaved: objects stand on it.
    """
    _, triangles, equations = hull
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2
    points, facet = _sample(triangles, area, n)
    beyond = (surface.extreme @ equations[:, :3].T + equations[:, 3]).max(0)
    slack = np.clip(beyond - 3 * tolerance, 0, SHAVE * tolerance)
    return facet, np.maximum(surface.signed_distance(points), 0), slack, area.sum()


def _excess(part: np.ndarray, surface: _Surface, tolerance: float) -> np.ndarray:
    """Area [m^2] of a part's hull standing out by more than tolerance, and by how much altogether [m^3]."""
    facet, outward, slack, area = _overhang(_hull(part), surface, tolerance)
    outward = np.maximum(outward - slack[facet], 0)
    return area * np.array([np.mean(outward > tolerance), np.mean(np.maximum(outward - tolerance / 2, 0))])


def _shave(part: np.ndarray, surface: _Surface, tolerance: float) -> np.ndarray:
    """Move facets that stand out (the chord over a hollow) inwards, so that the error is shared by both sides."""
    hull = _hull(part)
    facet, outward, slack, _ = _overhang(hull, surface, tolerance, 2000)
    depth = np.zeros(len(slack))
    for f in np.unique(facet):
        depth[f] = np.clip(np.percentile(outward[facet == f], 90) - 0.8 * tolerance, 0, slack[f])
    equations, centre = hull[2].copy(), hull[0].mean(0)
    equations[:, 3] += depth
    if depth.max() == 0 or (equations[:, :3] @ centre + equations[:, 3]).max() > -MIN_THICKNESS:
        return part
    support = part[(part @ surface.bounds[:, :3].T + surface.bounds[:, 3]).max(1) > -tolerance / 4]
    return _hull(np.concatenate([HalfspaceIntersection(equations, centre).intersections, support]))[0]


def _anchor(parts: list[np.ndarray], surface: _Surface, tolerance: float) -> list[np.ndarray]:
    """Give each vertex of the mesh's own hull that simplification lost to the nearest part: the support stays exact."""
    gap = np.stack([(surface.extreme @ e[:, :3].T + e[:, 3]).max(1) for e in (_hull(p)[2] for p in parts)], 1)
    nearest, gap = gap.argmin(1), gap.min(1)
    lost = (gap > tolerance / 20) & (gap < 3 * tolerance)
    return [np.concatenate([p, surface.extreme[lost & (nearest == k)]]) for k, p in enumerate(parts)]


def _missed(few: np.ndarray, points: np.ndarray) -> float:
    """How far points lie outside the hull of few [m]."""
    equations = _hull(few)[2]
    return float((points @ equations[:, :3].T + equations[:, 3]).max())


def _merge(
    parts: list[np.ndarray], surface: _Surface, options: DecomposeOptions, tolerance: float, share: float = 0.03
) -> list[np.ndarray]:
    """Merge neighbours, least harm first, while at most `share` of the surface stands out by more than tolerance.

    No union is made that max_vertices vertices cannot tell within options.tolerance, unless there are too many parts.
    """
    parts = dict(enumerate(_hull(part)[0] for part in parts))
    cost = {i: _excess(part, surface, tolerance) for i, part in parts.items()}
    budget = share * surface.area.sum() - sum(bad for bad, _ in cost.values())
    fresh, queue = itertools.count(len(parts)), []

    def propose(i: int, others: list[int]) -> None:
        low, high = parts[i].min(0) - tolerance, parts[i].max(0) + tolerance
        for j in others:
            if j != i and (parts[j].max(0) > low).all() and (parts[j].min(0) < high).all():
                union = _hull(np.concatenate([parts[i], parts[j]]))[0]
                both = _excess(union, surface, tolerance)
                bad, excess = both - cost[i] - cost[j]
                heapq.heappush(queue, (excess, bad, i, j, union, both))

    for i in parts:
        propose(i, [j for j in parts if j < i])
    while queue:
        _, bad, i, j, union, both = heapq.heappop(queue)
        if i not in parts or j not in parts:
            continue
        if len(parts) <= options.max_hulls and (
            bad > max(budget, 0) or _missed(_inscribed(union, options.max_vertices), union) > options.tolerance
        ):
            continue
        k = next(fresh)
        parts[k], cost[k], budget = union, both, budget - bad
        del parts[i], parts[j]
        propose(k, list(parts))
    return list(parts.values())


def _few(points: np.ndarray, options: DecomposeOptions) -> np.ndarray:
    """At most max_vertices vertices; where an inscribed hull misses much, the error is balanced inside and outside.

    The vertices are moved, by at most the tolerance, so that their support function fits that of points in the
    least-squares sense: each gets the directions in which it is the support. The six axes, where objects stand, weigh
    more.
    """
    vertices = _inscribed(points, options.max_vertices)
    if _missed(vertices, points) <= options.tolerance / 2:
        return vertices
    k = np.arange(2000) + 0.5  # Fibonacci spiral
    height, turn = 1 - k / 1000, k * np.pi * (1 + 5**0.5)
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], 1)
    directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
    weight = np.concatenate([np.ones(2000), np.full(6, 20.0)])
    target, moved = (directions @ points.T).max(1), vertices
    for _ in range(5):
        heights = directions @ moved.T
        owner, miss = heights.argmax(1), target - heights.max(1)
        step = moved - vertices
        for v in np.unique(owner):
            u, w = directions[owner == v], weight[owner == v]
            step[v] += np.linalg.solve((u.T * w) @ u + 0.1 * w.sum() * np.eye(3), u.T @ (w * miss[owner == v]))
        length = np.linalg.norm(step, axis=1, keepdims=True)
        moved = vertices + step * np.minimum(1, options.tolerance / np.maximum(length, 1e-12))
    return _hull(moved)[0]


_CHILD = """
import signal, sys
import coacd, numpy
if hasattr(signal, "alarm"):
    signal.alarm(int(sys.argv[2]))  # it ends by itself should the parent be killed
coacd.set_log_level("error")
with numpy.load(sys.argv[1] + "/in.npz") as data:
    parts = coacd.run_coacd(
        coacd.Mesh(data["vertices"], data["faces"]), threshold=float(data["threshold"]), seed=int(data["seed"]),
        preprocess_mode=str(data["preprocess_mode"]), preprocess_resolution=30, real_metric=True, merge=False,
        mcts_nodes=10, mcts_iterations=60)
parts = [vertices for vertices, _ in parts]
numpy.savez(sys.argv[1] + "/out.npz", vertices=numpy.concatenate(parts), counts=[len(p) for p in parts])
"""
_child_command = [sys.executable, "-P", "-c", _CHILD]  # a program text, not an import: works from scripts and notebooks


def _run_coacd(
    vertices: np.ndarray, faces: np.ndarray, *, deadline: float, stop: threading.Event, **settings
) -> list[np.ndarray]:
    """CoACD's parts as vertex arrays [m]; BackendError if the child crashes, is stopped, or runs past the deadline."""
    limit = max(deadline - time.monotonic(), 0)
    with tempfile.TemporaryDirectory(prefix="physpose_", ignore_cleanup_errors=True) as folder:
        np.savez(f"{folder}/in.npz", vertices=vertices, faces=faces, **settings)
        child = subprocess.Popen(
            [*_child_command, folder, str(int(limit) + 5)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )
        try:
            while True:
                try:
                    _, message = child.communicate(timeout=0.2)
                    break
                except subprocess.TimeoutExpired:
                    if stop.is_set() or time.monotonic() > deadline:
                        raise BackendError(f"CoACD was stopped after {limit:.0f} s") from None
        finally:  # also on KeyboardInterrupt
            child.kill()
            child.wait()
        if child.returncode != 0:
            tail = message.decode(errors="replace").strip().splitlines()[-1:]
            raise BackendError(f"CoACD's process ended with code {child.returncode} {' '.join(tail)}")
        with np.load(f"{folder}/out.npz") as data:
            return np.split(data["vertices"], np.cumsum(data["counts"])[:-1])


def _canonical(mesh: trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    """The same mesh whatever the loader did: vertices merged at 1e-9 m, doubled triangles removed, all sorted."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    if len(vertices) == 0 or len(faces) == 0:
        raise DataError(f"{name} has {len(vertices)} vertices and {len(faces)} faces; expected a triangle mesh")
    corners = vertices[faces].reshape(-1, 3)
    if not np.isfinite(corners).all():
        raise DataError(f"{name} has NaN or infinite vertices; repair the mesh")
    size = np.ptp(corners, axis=0).max()
    if not 1e-3 <= size <= 10:
        raise InvalidInputError(
            f"{name} is {size:.4g} m large, expected 0.001 to 10: vertices are in metres; pass scale=0.001 "
            "(or mesh.apply_scale(0.001)) for a mesh in millimetres"
        )
    grid, index = np.unique(np.round(corners * 1e9).astype(np.int64), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    faces = np.take_along_axis(faces, (faces.argmin(1)[:, None] + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    distinct, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(first[(np.diff(distinct) > 0).all(1)])]
    clean = trimesh.Trimesh(grid * 1e-9, faces, process=False)
    clean.remove_unreferenced_vertices()
    if len(faces) == 0 or np.linalg.eigvalsh(np.cov(clean.vertices.T))[0] < (1e-3 * MIN_THICKNESS) ** 2:
        raise DataError(f"{name} is flat: it has no volume to decompose; give it a thickness")
    if clean.is_watertight and (not clean.is_winding_consistent or clean.volume < 0):
        clean.fix_normals()
    return clean


def _inside(points: np.ndarray, equations: np.ndarray) -> np.ndarray:
    return (points @ equations[:, :3].T + equations[:, 3]).max(1) <= 0


def _measure(parts: list[np.ndarray], surface: _Surface, tolerance: float, n: int = 20_000) -> dict[str, float]:
    """Outward and inward error [m] of the final hulls at n sample points each."""
    hulls = [_hull(part) for part in parts]
    triangles = np.concatenate([h[1] for h in hulls])
    owner = np.repeat(np.arange(len(hulls)), [len(h[1]) for h in hulls])
    union = _Surface(triangles, solid=False, n_samples=n)
    points, triangle = _sample(triangles, union.area, n)
    covered = np.any([_inside(points, h[2]) & (owner[triangle] != k) for k, h in enumerate(hulls)], axis=0)
    outward = surface.signed_distance(points[~covered])
    outward = np.maximum(outward[outward > -tolerance], 0)  # what is deeper is a cut through the body, not its surface
    points, _ = _sample(surface.triangles, surface.area, n)
    missed = ~np.any([_inside(points, h[2]) for h in hulls], axis=0)
    inward = np.zeros(n)
    if missed.any():
        inward[missed] = union.signed_distance(points[missed])
    return {
        "outward_p95": float(np.percentile(outward, 95)),
        "outward_max": float(outward.max()),
        "inward_p95": float(np.percentile(inward, 95)),
        "inward_max": float(inward.max()),
    }


def _cut(
    mesh: trimesh.Trimesh, surface: _Surface, options: DecomposeOptions, threshold: float, stop: threading.Event
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
            return _anchor([surface.snap(part) for part in parts], surface, options.tolerance)
        except BackendError:
            if mode == modes[-1] or time.monotonic() > deadline:
                raise
    raise AssertionError("unreachable")


def _cut_and_merge(mesh: trimesh.Trimesh, surface: _Surface, options: DecomposeOptions, stop: threading.Event):
    """Cut finer and merge more strictly until the final hulls are within tolerance, else return the best parts.

    One coarse cut first: most models need no other, and time and parts grow with the square of fineness.
    """
    best, cuts = None, {}
    for fineness, strictness in ((3.0, 1.0), (3.0, 0.7), (2.0, 0.7)):
        tolerance = strictness * options.tolerance  # merging judges by fewer samples than the final measure
        try:
            if fineness not in cuts:
                cuts[fineness] = _cut(mesh, surface, options, fineness * options.tolerance, stop)
        except BackendError:
            if best is None:
                raise
            break
        merged = _merge(cuts[fineness], surface, options, tolerance)
        parts = [_few(_shave(part, surface, tolerance), options) for part in merged]
        errors = _measure(parts, surface, options.tolerance)
        if best is None or errors["outward_p95"] < best[1]["outward_p95"]:
            best = parts, errors
        if errors["outward_p95"] <= options.tolerance or len(parts) >= options.max_hulls:
            break
    return best


def _decompose(mesh, options: DecomposeOptions, cache: bool, name: str, stop: threading.Event) -> Decomposition:
    start = time.perf_counter()
    mesh = _canonical(mesh, name)
    path = _cache_path(mesh, options) if cache else None
    if path and (found := _load(path)):
        return found
    surface, warning = _Surface(np.array(mesh.triangles), mesh.is_watertight), None
    whole = [_few(mesh.vertices, options)]
    method, parts, errors = "convex", whole, _measure(whole, surface, options.tolerance)
    if max(errors["outward_p95"], errors["inward_p95"]) > options.tolerance:
        try:
            cut_parts, cut_errors = _cut_and_merge(mesh, surface, options, stop)
            if cut_errors["outward_p95"] < errors["outward_p95"]:  # else cutting was of no use
                method, parts, errors = "coacd", cut_parts, cut_errors
        except BackendError as error:
            method, warning = "hull", f"{name}: {error}; its convex hull is used instead"
            warnings.warn(warning, stacklevel=3)
    report = DecomposeReport(method, len(parts), **errors, seconds=time.perf_counter() - start, warning=warning)
    result = Decomposition(parts, report)
    if path and warning is None:  # a time-out must not stick
        _store(path, result)
    return result


def _cache_path(mesh: trimesh.Trimesh, options: DecomposeOptions) -> Path:
    folder = os.environ.get("PHYSPOSE_CACHE") or platformdirs.user_cache_dir("physpose_torch")
    choices = {k: v for k, v in asdict(options).items() if k != "time_limit_s"}
    key = hashlib.sha256(json.dumps([ALGORITHM_VERSION, choices], sort_keys=True).encode())
    key.update(np.round(mesh.vertices * 1e9).astype("<i8").tobytes())
    key.update(mesh.faces.astype("<i8").tobytes())
    return Path(folder) / "decompose" / f"{key.hexdigest()}.npz"


def _load(path: Path) -> Decomposition | None:
    try:
        with np.load(path, allow_pickle=False) as data:
            hulls = np.split(data["vertices"], np.cumsum(data["counts"])[:-1])
            return Decomposition(hulls, DecomposeReport(**json.loads(str(data["report"]))))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        logger.warning("cache file %s is unreadable (%s): computed anew", path, error)
        return None


def _store(path: Path, result: Decomposition) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            np.savez_compressed(
                file,
                vertices=np.concatenate(result.hulls),
                counts=[len(h) for h in result.hulls],
                report=json.dumps(result.report._asdict()),
            )
        os.replace(file.name, path)  # atomic: readers and other writers never see half a file
    except OSError as error:
        logger.warning("decomposition is not cached: %s (set PHYSPOSE_CACHE to a writable folder)", error)


def decompose(
    mesh: trimesh.Trimesh, options: DecomposeOptions | None = None, *, cache: bool = True, name: str = "mesh"
) -> Decomposition:
    """Cut a mesh into convex hulls.

    Args:
        mesh: triangles in metres; closed or not, merged or not.
        options: tolerances and limits.
        cache: look the result up, and keep it, in ``$PHYSPOSE_CACHE/decompose`` (default: the user's cache folder).
            The key is made of the triangles (rounded to 1e-9 m, in any order) and the options.
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
