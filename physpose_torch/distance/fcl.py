"""Signed distances by python-fcl, which is asked only about parts that are well apart, and whose answers are proven.

What python-fcl 0.7.0.11 gets wrong (``tests/distance/test_fcl.py`` reproduces each): with a penetration below about
1e-8 m it aborts the whole process; in contact, and up to millimetres away from it, about one call in a thousand is
wrong by up to centimetres, without an exception; reused results keep stale points; half-spaces crash it. So fresh
results only, planes never come here, and:

1. a separating axis proves two parts to be apart, or the facets of their Minkowski difference say exactly how deep they
   overlap and along which normal; parts that overlap, or nearly do, are pulled apart along it before fcl is asked for
   their witness points;
2. fcl's points lie on the parts, and for every unit n the gap along n is at most the distance: where the length
   between the points and the gap along them agree, both are exact. The few pairs that lack this proof go to
   :mod:`physpose_torch.distance.gjk`, so no query needs to be repeated with a jitter.
"""

import logging
import weakref
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from physpose_torch.distance.fcl_worker import make_shape, nearest_points
from physpose_torch.distance.gjk import closest_points
from physpose_torch.distance.sat import separating_axis
from physpose_torch.distance.support import gap_along
from physpose_torch.geometry.convex import ConvexParts

__all__ = ["fcl_distance"]

Ask = Callable[[ConvexParts, Tensor, Tensor, Tensor], tuple[Tensor, Tensor] | None]

logger = logging.getLogger("physpose_torch")

NEAR = 1e-6
"""[m]; fcl is not asked about parts nearer than this where they are."""
PULL = 2e-3
"""[m]; they are pulled this far apart along their normal first."""
PROVEN = 1e-10
"""[m]; how far witness points may be from facing each other along the normal. Well apart, fcl meets 1e-14."""

_shapes: "weakref.WeakKeyDictionary[ConvexParts, list]" = weakref.WeakKeyDictionary()


def fcl_distance(
    parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor, *, ask: Ask | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Signed distances of pairs of parts, in the frame of part a.

    Args:
        parts: float64 parts on the CPU.
        pairs: (E, 2) indices of parts a and b.
        R: (E, 3, 3), t: (E, 3), pose of b in the frame of a [m].
        ask: who asks fcl for the nearest points of such pairs that are apart, (E, 3) each, in the frame of a; None where it
            has no answer. Default: this process.

    Returns:
        distance (E,), normal (E, 3) from a to b, witness points on a and on b (E, 3), in the frame of a [m].
    """
    center_a, center_b = parts.center[pairs[:, 0]], parts.center[pairs[:, 1]]
    across = (R @ center_b[:, :, None])[:, :, 0] + t - center_a
    normal = torch.nn.functional.normalize(across, dim=-1)
    gap = gap_along(parts, pairs, R, t, normal[:, None])[:, 0]
    unsure = (gap <= NEAR).nonzero()[:, 0]
    if len(unsure):
        gap[unsure], normal[unsure] = separating_axis(parts, pairs[unsure], R[unsure], t[unsure])

    answer = _Answer(parts, pairs, R, t, gap, normal)
    shift = torch.where(gap <= NEAR, PULL - gap, 0.0)[:, None] * normal
    if (points := (ask or _ask)(parts, pairs, R, t + shift)) is not None:
        answer.consider(torch.arange(len(pairs)), *points, shift)
    todo = answer.unproven()
    if len(todo):
        shift = shift[todo]
        answer.consider(todo, *closest_points(parts, pairs[todo], R[todo], t[todo] + shift, answer.normal[todo]), shift)
        todo = answer.unproven()
        todo = todo[(answer.gap[todo] > 0) & (answer.gap[todo] <= NEAR)]
    if len(todo):  # a hair's breadth apart, and pulling them apart changed which features are nearest
        points = closest_points(parts, pairs[todo], R[todo], t[todo], answer.normal[todo])
        answer.consider(todo, *points, torch.zeros_like(t[todo]))
    if len(todo := answer.unproven()):
        worst = float(answer.error[todo].max())
        logger.debug("fcl: witness points of %d of %d pairs are up to %.1e m off", len(todo), len(pairs), worst)
    return answer.gap, answer.normal, answer.point_a, answer.point_b


@dataclass
class _Answer:
    """The best that is known of each pair: a gap that the distance is not below, points that it is not above."""

    parts: ConvexParts
    pairs: Tensor
    R: Tensor
    t: Tensor
    gap: Tensor
    normal: Tensor

    def __post_init__(self) -> None:
        self.point_a, self.point_b = torch.zeros_like(self.t), torch.zeros_like(self.t)
        self.error = torch.full_like(self.gap, torch.inf)

    def consider(self, rows: Tensor, point_a: Tensor, point_b: Tensor, shift: Tensor) -> None:
        """Take the points of pairs ``rows``, b's pulled off by ``shift``, where they are better than those so far."""
        point_b = point_b - shift
        across = point_b - point_a
        length = torch.linalg.vector_norm(across, dim=-1, keepdim=True)
        along = across / length.clamp_min(1e-300)
        bound = gap_along(self.parts, self.pairs[rows], self.R[rows], self.t[rows], along[:, None])[:, 0]
        better = (self.gap[rows] > 0) & (bound > self.gap[rows]) & (length[:, 0] > 0)  # overlaps are known exactly
        self.gap[rows] = torch.where(better, bound, self.gap[rows])
        self.normal[rows] = torch.where(better[:, None], along, self.normal[rows])
        error = torch.linalg.vector_norm(across - self.gap[rows, None] * self.normal[rows], dim=-1)
        closer = error < self.error[rows]
        rows = rows[closer]
        self.point_a[rows], self.point_b[rows], self.error[rows] = point_a[closer], point_b[closer], error[closer]

    def unproven(self) -> Tensor:
        return (self.error > PROVEN).nonzero()[:, 0]


def _ask(parts: ConvexParts, pairs: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """fcl's nearest points of pairs that are apart, (E, 3) each, in the frame of part a."""
    shapes = _shapes.get(parts)
    if shapes is None:
        shapes = _shapes[parts] = [make_shape(*(x.numpy() for x in parts.part(p))) for p in range(parts.n_parts)]
    points = torch.from_numpy(nearest_points(shapes, pairs.numpy(), R.numpy(), t.numpy()))
    return points[:, 0], points[:, 1]
