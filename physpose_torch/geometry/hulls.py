"""Hulls of few vertices that fit a surface, and the merging of many parts into as few as a tolerance allows."""

from __future__ import annotations

import heapq
import itertools
import threading
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from ..errors import BackendError
from .cover import MIN_THICKNESS, Surface, hull_of, measure_cover, sample

__all__ = ["few_vertices", "fewest_parts", "hand_out_extremes"]

TARGET = 0.98  # parts are chosen to this share of the tolerance, so that it holds for other samples of them too
SHAVE = 1.0  # a facet over a hollow may be moved inwards by this many tolerances


def inscribed(points: np.ndarray, max_vertices: int, tolerance: float = 1e-4) -> np.ndarray:
    """At most max_vertices vertices of the hull of points, whose own hull misses as little of it as may be.

    Farthest-point insertion: start at the extremes, add the vertex that lies farthest outside. The result is inscribed:
    it never stands out of the hull of points, the error is inward only.
    """
    vertices = hull_of(points)[0]
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
    return hull_of(vertices[chosen])[0]


def _missed(few: np.ndarray, points: np.ndarray) -> float:
    """How far points lie outside the hull of few [m]."""
    equations = hull_of(few)[2]
    return float((points @ equations[:, :3].T + equations[:, 3]).max())


def few_vertices(points: np.ndarray, max_vertices: int, tolerance: float) -> np.ndarray:
    """At most max_vertices vertices; where an inscribed hull misses much, the error is balanced inside and outside.

    The vertices are moved, by at most the tolerance, so that their support function fits that of points in the
    least-squares sense: each gets the directions in which it is the support. The six axes, where objects stand, weigh
    more.
    """
    vertices = inscribed(points, max_vertices)
    if _missed(vertices, points) <= tolerance / 2:
        return vertices
    k = np.arange(2000) + 0.5  # Fibonacci spiral
    height, turn = 1 - k / 1000, k * np.pi * (1 + 5**0.5)
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], 1)
    directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
    weight = np.concatenate([np.ones(2000), np.full(6, 20.0)])
    chunks = np.array_split(points, len(points) // 10_000 + 1)  # gigabytes, if a million points were asked at once
    target, moved = np.max([(directions @ chunk.T).max(1) for chunk in chunks], axis=0), vertices
    for _ in range(5):
        heights = directions @ moved.T
        owner, miss = heights.argmax(1), target - heights.max(1)
        step = moved - vertices
        for v in np.unique(owner):
            u, w = directions[owner == v], weight[owner == v]
            step[v] += np.linalg.solve((u.T * w) @ u + 0.1 * w.sum() * np.eye(3), u.T @ (w * miss[owner == v]))
        length = np.linalg.norm(step, axis=1, keepdims=True)
        moved = vertices + step * np.minimum(1, tolerance / np.maximum(length, 1e-12))
    return hull_of(moved)[0]


def _overhang(hull: tuple[np.ndarray, ...], surface: Surface, tolerance: float, n: int = 100):
    """Samples on a part's hull: facet, outward distance [m], and how far that facet may be shaved [m]; and the area.

    A facet that bounds the whole mesh is not shaved: objects stand on it.
    """
    _, triangles, equations = hull
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2
    points, facet = sample(triangles, area, n)
    beyond = (surface.extreme @ equations[:, :3].T + equations[:, 3]).max(0)
    slack = np.clip(beyond - 3 * tolerance, 0, SHAVE * tolerance)
    return facet, np.maximum(surface.signed_distance(points), 0), slack, area.sum()


def _excess(hull: tuple[np.ndarray, ...], surface: Surface, tolerance: float) -> np.ndarray:
    """Area [m^2] of a hull standing out by more than tolerance, and by how much altogether [m^3]."""
    facet, outward, slack, area = _overhang(hull, surface, tolerance)
    outward = np.maximum(outward - slack[facet], 0)
    return area * np.array([np.mean(outward > tolerance), np.mean(np.maximum(outward - tolerance / 2, 0))])


def _shave(part: np.ndarray, surface: Surface, tolerance: float) -> np.ndarray:
    """Move facets that stand out (the chord over a hollow) inwards, so that the error is shared by both sides."""
    hull = hull_of(part)
    facet, outward, slack, _ = _overhang(hull, surface, tolerance, 2000)
    depth = np.zeros(len(slack))
    for f in np.unique(facet):
        depth[f] = np.clip(np.percentile(outward[facet == f], 90) - 0.8 * tolerance, 0, slack[f])
    equations, centre = hull[2].copy(), hull[0].mean(0)
    equations[:, 3] += depth
    if depth.max() == 0 or (equations[:, :3] @ centre + equations[:, 3]).max() > -MIN_THICKNESS:
        return part
    support = part[(part @ surface.bounds[:, :3].T + surface.bounds[:, 3]).max(1) > -tolerance / 4]
    return hull_of(np.concatenate([HalfspaceIntersection(equations, centre).intersections, support]))[0]


def hand_out_extremes(parts: list[np.ndarray], surface: Surface, tolerance: float) -> list[np.ndarray]:
    """Give vertices of the mesh's own hull that simplification lost to the nearest part: the support stays exact.

    Those on the mesh's bounding box, on which objects stand, and those lost by more than tolerance; all of them would
    make parts bulge.
    """
    distance = np.full((len(surface.extreme), len(parts)), np.inf)
    for k, (_, triangles, equations) in enumerate(map(hull_of, parts)):
        gap = (surface.extreme @ equations[:, :3].T + equations[:, 3]).max(1)
        # at a sharp edge the planes are much nearer than the part is
        for v in np.flatnonzero(gap < 3 * tolerance):
            at = np.broadcast_to(surface.extreme[v], (len(triangles), 3))
            off = np.linalg.norm(trimesh.triangles.closest_point(triangles, at) - at, axis=1).min()
            distance[v, k] = off if gap[v] > 0 else 0.0
    nearest, distance = distance.argmin(1), distance.min(1)
    bounds = surface.extreme.min(0), surface.extreme.max(0)
    stands = (np.abs(surface.extreme[:, None] - np.stack(bounds)) < tolerance / 20).any((1, 2))
    lost = (distance > np.where(stands, tolerance / 20, tolerance)) & (distance < 3 * tolerance)
    return [np.concatenate([part, surface.extreme[lost & (nearest == k)]]) for k, part in enumerate(parts)]


class _Merge(NamedTuple):
    a: int
    b: int
    union: int


def _merge(
    parts: list[np.ndarray],
    surface: Surface,
    *,
    tolerance: float,
    max_hulls: int,
    max_vertices: int,
    stop: threading.Event,
    share: float = 0.12,
) -> tuple[dict[int, np.ndarray], list[_Merge]]:
    """Merge neighbours, least harm first, while at most `share` of the surface stands out by more than tolerance.

    No union is made that max_vertices vertices cannot tell within tolerance, unless there are too many parts.

    Returns:
        The vertices of every part, given or merged, by number, and the merges in their order.
    """
    hulls = dict(enumerate(map(hull_of, parts)))
    cost = {i: _excess(hull, surface, tolerance) for i, hull in hulls.items()}
    points, alive = {i: hull[0] for i, hull in hulls.items()}, set(hulls)
    budget = share * surface.area.sum() - sum(bad for bad, _ in cost.values())
    fresh, queue, merges = itertools.count(len(points)), [], []

    def propose(i: int, others: set[int]) -> None:
        if stop.is_set():
            raise BackendError("merging was stopped")
        low, high = points[i].min(0) - tolerance, points[i].max(0) + tolerance
        for j in sorted(others):
            if (points[j].max(0) > low).all() and (points[j].min(0) < high).all():
                union = hull_of(np.concatenate([points[i], points[j]]))
                both = _excess(union, surface, tolerance)
                bad, excess = both - cost[i] - cost[j]
                heapq.heappush(queue, (excess, bad, i, j, union[0], both))

    for i in sorted(alive):
        propose(i, {j for j in alive if j < i})
    while queue:
        _, bad, i, j, union, both = heapq.heappop(queue)
        if not {i, j} <= alive:
            continue
        if len(alive) <= max_hulls and (
            bad > max(budget, 0) or _missed(inscribed(union, max_vertices), union) > tolerance
        ):
            continue
        k = next(fresh)
        points[k], cost[k], budget = union, both, budget - bad
        alive -= {i, j}
        propose(k, alive)
        alive.add(k)
        merges.append(_Merge(i, j, k))
    return points, merges


def fewest_parts(
    parts: list[np.ndarray],
    surface: Surface,
    *,
    tolerance: float,
    max_hulls: int,
    max_vertices: int,
    stop: threading.Event,
) -> tuple[list[np.ndarray], dict[str, float]]:
    """The fewest merged parts whose final hulls stand out by no more than tolerance at the 95th percentile.

    Merging runs on past the tolerance; how many of the merges to keep is found by bisection, measuring the final hulls.
    If even max_hulls parts are not within tolerance, those are returned.

    Returns:
        The final hulls and their errors (:func:`measure_cover`).
    """
    points, merges = _merge(
        parts, surface, tolerance=tolerance, max_hulls=max_hulls, max_vertices=max_vertices, stop=stop
    )
    final: dict[int, np.ndarray] = {}

    def result(n_merges: int) -> tuple[list[np.ndarray], dict[str, float]]:
        alive = set(range(len(parts)))
        for merge in merges[:n_merges]:
            alive = alive - {merge.a, merge.b} | {merge.union}
        for i in alive - final.keys():
            if stop.is_set():
                raise BackendError("fitting was stopped")
            final[i] = few_vertices(_shave(points[i], surface, tolerance), max_vertices, tolerance)
        hulls = [final[i] for i in sorted(alive)]
        return hulls, measure_cover(hulls, surface, tolerance)

    low, high = max(0, len(parts) - max_hulls), len(merges)
    best = result(high)
    if best[1]["outward_p95"] <= TARGET * tolerance or low >= high:
        return best
    best = result(low)
    while high - low > 1:
        middle = (low + high) // 2
        found = result(middle)
        if found[1]["outward_p95"] <= TARGET * tolerance:
            low, best = middle, found
        else:
            high = middle
            if found[1]["outward_p95"] < best[1]["outward_p95"]:  # as long as nothing is within tolerance
                best = found
    return best
