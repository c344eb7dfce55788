"""What one would write without this package: a Python loop over part pairs, one library call each.

Shapes and transforms are made beforehand, so that only the loop itself is timed.
"""

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

from physpose_torch.bench.oracle import Polytope

__all__ = ["LOOPS", "coal_loop", "fcl_loop", "installed_loops"]

Loop = Callable[[], tuple[np.ndarray, np.ndarray]]
"""Runs over all pairs; returns distances (E,) [m] and normals (E, 3) from a to b, in the frame of a."""


def coal_loop(hulls: list[Polytope], pairs: np.ndarray, R: np.ndarray, t: np.ndarray) -> Loop:
    """coal.distance for every pair, as signed distance; a fresh result each."""
    import coal

    shapes = {p: _coal_shape(coal, *hulls[p]) for p in np.unique(pairs).tolist()}
    first = [shapes[a] for a, _ in pairs.tolist()]
    second = [shapes[b] for _, b in pairs.tolist()]
    identity = coal.Transform3s.Identity()
    poses = [coal.Transform3s(rotation, translation) for rotation, translation in zip(R, t, strict=True)]
    request = coal.DistanceRequest()
    request.enable_signed_distance = True

    def run() -> tuple[np.ndarray, np.ndarray]:
        distance, normal = np.empty(len(pairs)), np.empty((len(pairs), 3))
        for k in range(len(pairs)):
            result = coal.DistanceResult()
            distance[k] = coal.distance(first[k], identity, second[k], poses[k], request, result)
            normal[k] = result.normal
        return distance, normal

    return run


def fcl_loop(hulls: list[Polytope], pairs: np.ndarray, R: np.ndarray, t: np.ndarray) -> Loop:
    """fcl.distance for every pair. Only for pairs that are well apart: python-fcl aborts the process at contact."""
    import fcl

    shapes = {p: _fcl_shape(fcl, *hulls[p]) for p in np.unique(pairs).tolist()}
    first = [shapes[a] for a, _ in pairs.tolist()]
    second = [shapes[b] for _, b in pairs.tolist()]
    identity = fcl.Transform()
    poses = [fcl.Transform(rotation, translation) for rotation, translation in zip(R, t, strict=True)]
    request = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=True)

    def run() -> tuple[np.ndarray, np.ndarray]:
        distance, normal = np.empty(len(pairs)), np.empty((len(pairs), 3))
        for k in range(len(pairs)):
            result = fcl.DistanceResult()
            a, b = fcl.CollisionObject(first[k], identity), fcl.CollisionObject(second[k], poses[k])
            distance[k] = fcl.distance(a, b, request, result)
            point_a, point_b = result.nearest_points
            normal[k] = (point_b - point_a) / distance[k]
        return distance, normal

    return run


LOOPS: dict[str, tuple[str, Callable[..., Loop], bool]] = {
    "coal": ("coal", coal_loop, False),
    "python-fcl": ("fcl", fcl_loop, True),
}
"""Module, function, and whether it may only see pairs that are well apart."""


def installed_loops() -> list[str]:
    """Names in :data:`LOOPS` whose module is there."""
    return [name for name, (module, _, _) in LOOPS.items() if find_spec(module) is not None]


def _coal_shape(coal, vertices: np.ndarray, faces: np.ndarray):
    points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for v in vertices:
        points.append(v)
    for face in faces.tolist():
        triangles.append(coal.Triangle(*face))
    return coal.Convex(points, triangles)


def _fcl_shape(fcl, vertices: np.ndarray, faces: np.ndarray):
    polygons = np.concatenate([np.full((len(faces), 1), 3), faces], axis=1).ravel()
    return fcl.Convex(np.ascontiguousarray(vertices), len(faces), polygons)
