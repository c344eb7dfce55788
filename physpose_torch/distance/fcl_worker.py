"""Nearest points by python-fcl, which is raw here: :mod:`physpose_torch.distance.fcl` guards it.

``python -m physpose_torch.distance.fcl_worker`` answers over pipes, for :mod:`physpose_torch.distance.fcl_isolated`. It
imports numpy and fcl, but not torch.
"""

import os
import pickle
import signal
import sys
from collections.abc import Sequence

import fcl
import numpy as np

__all__ = ["main", "make_shape", "nearest_points"]

GRACE_S = 5
"""A worker whose parent was killed ends by itself this long [s] after the time limit of its query."""
_REQUEST = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=True)


def make_shape(vertices: np.ndarray, faces: np.ndarray) -> "fcl.Convex":
    """A convex part: vertices (V, 3) [m] and triangles (F, 3)."""
    polygons = np.concatenate([np.full((len(faces), 1), 3), faces], axis=1).ravel()
    return fcl.Convex(np.ascontiguousarray(vertices), len(faces), polygons)


def nearest_points(shapes: Sequence["fcl.Convex"], pairs: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(E, 2, 3) nearest points of pairs (E, 2) of shapes that are apart, in the frame of the first [m]."""
    points = np.empty((len(pairs), 2, 3))
    identity = fcl.Transform()
    for k, (a, b), rotation, translation in zip(range(len(pairs)), pairs.tolist(), R, t, strict=True):
        result = fcl.DistanceResult()
        fcl.distance(
            fcl.CollisionObject(shapes[a], identity),
            fcl.CollisionObject(shapes[b], fcl.Transform(rotation, translation)),
            _REQUEST,
            result,
        )
        points[k] = result.nearest_points
    return points


def main() -> None:
    """Answer pickled queries (limit [s], handles of living sets, handle, parts or None, pairs, R, t) to their end."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what C code prints is no answer
    shapes: dict[int, list] = {}
    while True:
        try:
            limit, alive, handle, parts, pairs, R, t = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        if hasattr(signal, "alarm"):
            signal.alarm(int(limit) + GRACE_S)
        if parts is not None:
            shapes[handle] = [make_shape(*part) for part in parts]
        for gone in shapes.keys() - alive:
            del shapes[gone]
        pickle.dump(nearest_points(shapes[handle], pairs, R, t), answers)
        answers.flush()
        if hasattr(signal, "alarm"):
            signal.alarm(0)


if __name__ == "__main__":
    main()
