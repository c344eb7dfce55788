"""Signed distances by python-fcl, which is asked only about parts that are proven to be apart.

What python-fcl 0.7.0.11 gets wrong (``tests/distance/test_fcl.py`` reproduces each): with a penetration below about
1e-8 m it aborts the whole process, at contact up to 3 % of the calls return a normal that is off by centimetres, without an
exception; reused results keep stale points; planes crash it. So fresh results only, planes never come here, and:

1. a separating axis proves two parts to be apart; fcl is asked, and its answer must meet the bound of its own normal
   (for every unit n the gap along n is at most the distance, so where both agree both are exact), or it is asked again
   with a tiny shift;
2. where the facets of the Minkowski difference say that the parts overlap, they say exactly how deep and along which
   normal; fcl then gives the witness points of the pair pulled apart along that normal.
"""

import logging
import weakref

import fcl
import numpy as np
import torch
from torch import Tensor

from physpose_torch.distance.sat import separating_axis
from physpose_torch.distance.support import gap_along
from physpose_torch.errors import BackendError
from physpose_torch.geometry.convex import ConvexParts

__all__ = ["fcl_distance"]

logger = logging.getLogger("physpose_torch")

TOLERANCE = 1e-5
"""[m]; how far witness points may be from facing each other along the normal. Away from contact fcl meets 1e-14."""
PULLS = (2e-3, 1e-2, 5e-2, 2e-1)
"""[m]; how far a pair is pulled apart along its normal before fcl is asked for witness points, and asked again."""

_REQUEST = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=True)
_shapes: "weakref.WeakKeyDictionary[ConvexParts, list]" = weakref.WeakKeyDictionary()


def fcl_distance(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Signed distances of pairs of parts, in the frame of part a.

    Args:
        parts: float64 parts on the CPU.
        pairs: (E, 2) indices of parts a and b.
        R: (E, 3, 3), t: (E, 3), pose of b in the frame of a [m].

    Returns:
        distance (E,), normal (E, 3) from a to b, witness points on a and on b (E, 3), in the frame of a [m].

    Raises:
        BackendError: fcl gave no finite answer.
    """
    center_a, center_b = parts.center[pairs[:, 0]], parts.center[pairs[:, 1]]
    across = (R @ center_b[:, :, None])[:, :, 0] + t - center_a
    normal = torch.nn.functional.normalize(across, dim=-1)
    gap = gap_along(parts, pairs, R, t, normal[:, None])[:, 0]
    unsure = (gap <= 0).nonzero()[:, 0]
    if len(unsure):
        gap[unsure], normal[unsure] = separating_axis(parts, pairs[unsure], R[unsure], t[unsure])

    overlap = gap <= 0
    distance, point_a, point_b = gap.clone(), torch.empty_like(t), torch.empty_like(t)
    miss = t.new_full((len(pairs),), torch.inf)
    todo = torch.arange(len(pairs))
    for pull in PULLS:
        # overlapping parts are always pulled apart, the others only if fcl was wrong about them where they are
        reach = (pull - distance[todo]).where(overlap[todo] | (pull > PULLS[0]), 0.0)
        a, b = _ask(parts, pairs[todo], R[todo], t[todo] + reach[:, None] * normal[todo])
        b = b - reach[:, None] * normal[todo]
        found = torch.nn.functional.normalize(b - a + reach[:, None] * normal[todo], dim=-1)
        bound = gap_along(parts, pairs[todo], R[todo], t[todo], found[:, None])[:, 0]
        better = bound > distance[todo]
        distance[todo] = torch.where(better, bound, distance[todo])
        normal[todo] = torch.where(better[:, None], found, normal[todo])
        # both points lie on the parts, so they prove the distance as soon as they face each other along the normal
        off = torch.linalg.vector_norm(b - a - distance[todo, None] * normal[todo], dim=-1)
        closer = off < miss[todo]
        chosen = todo[closer]
        point_a[chosen], point_b[chosen], miss[chosen] = a[closer], b[closer], off[closer]
        todo = (miss > TOLERANCE).nonzero()[:, 0]
        if len(todo) == 0:
            break
    else:
        logger.debug("fcl: %d of %d pairs have witness points up to %.1e m off", len(todo), len(pairs), float(miss.max()))
    return distance, normal, point_a, point_b


def _ask(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """fcl's nearest points of pairs that are apart, (E, 3) each, in the frame of part a."""
    shapes = _shapes.get(parts)
    if shapes is None:
        shapes = _shapes[parts] = [_convex(*(x.numpy() for x in parts.part(p))) for p in range(parts.n_parts)]
    points = np.empty((len(pairs), 2, 3))
    identity = fcl.Transform()
    for k, (a, b), rotation, translation in zip(range(len(pairs)), pairs.tolist(), R.numpy(), t.numpy(), strict=True):
        result = fcl.DistanceResult()
        fcl.distance(
            fcl.CollisionObject(shapes[a], identity),
            fcl.CollisionObject(shapes[b], fcl.Transform(rotation, translation)),
            _REQUEST,
            result,
        )
        points[k] = result.nearest_points
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=(1, 2))).nonzero()[0][0])
        raise BackendError(f"python-fcl gave no finite witness points for parts {pairs[bad].tolist()}")
    points = torch.from_numpy(points)
    return points[:, 0], points[:, 1]


def _convex(vertices: np.ndarray, faces: np.ndarray) -> "fcl.Convex":
    polygons = np.concatenate([np.full((len(faces), 1), 3), faces], axis=1).ravel()
    return fcl.Convex(np.ascontiguousarray(vertices), len(faces), polygons)

