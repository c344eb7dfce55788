"""RANSAC in torch: all samples at once, seeded, each estimator returns ``(model, info)`` (Fischler and Bolles 1981)."""

from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch.errors import InvalidInputError

__all__ = ["RansacInfo", "ransac_plane", "ransac_scale"]

SAMPLES = 1000
"""Models that are tried; enough for one inlier in five among three points, with 99.97 % certainty."""
MOST_DISTANCES = 1 << 24
"""Distances of points to models that are held at a time."""


class RansacInfo(NamedTuple):
    """How a model came about."""

    inliers: Tensor
    """(M,) bool."""
    residual: Tensor
    """(M,) of the final model, absolute, in its unit."""
    samples: int
    """Models that were tried."""


def ransac_plane(
    points: Tensor, *, tolerance: float, samples: int = SAMPLES, seed: int = 0
) -> tuple[tuple[Tensor, Tensor] | None, RansacInfo]:
    """The plane with the most points near it, fitted to these by least squares.

    Args:
        points: (M, 3).
        tolerance: largest distance of an inlier, in the unit of the points.
        samples: triples to draw.
        seed: of the draws.

    Returns:
        ``(normal (3,), offset ())`` with normal · x = offset and the origin on its upper side (offset < 0), or None where
        there are no three points that span one; and which points are near.

    Raises:
        InvalidInputError: shape or tolerance.
    """
    _check(points, 3, tolerance)
    points = points.double()
    origin = points.median(0).values if len(points) else points.new_zeros(3)
    points = points - origin  # nothing is lost far from the camera
    triples = _draw(len(points), 3, samples, seed).to(points.device)
    a, b, c = points[triples].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    area = torch.linalg.vector_norm(normal, dim=1)
    spanned = area > 1e-9 * points.abs().amax().clamp_min(1e-30) ** 2 if len(points) else area > 0
    normal, a = (normal / area[:, None])[spanned], a[spanned]
    nothing = RansacInfo(torch.zeros(len(points), dtype=torch.bool), points.new_full((len(points),), torch.inf), samples)
    if not len(normal):
        return None, nothing
    offset = (normal * a).sum(1)
    count = torch.cat(
        [
            ((points @ n.mT - o).abs() < tolerance).sum(0)
            for n, o in zip(_split(normal, len(points)), _split(offset, len(points)), strict=True)
        ]
    )
    best = count.argmax()
    normal, offset = normal[best], offset[best]
    for _ in range(3):
        near = (points @ normal - offset).abs() < tolerance
        if int(near.sum()) < 3:
            break
        middle = points[near].mean(0)
        normal = torch.linalg.svd(points[near] - middle, full_matrices=False)[2][-1]
        offset = normal @ middle
    residual = (points @ normal - offset).abs()
    offset = offset + normal @ origin
    if float(offset) > 0:
        normal, offset = -normal, -offset
    return (normal, offset), RansacInfo(residual < tolerance, residual, samples)


def ransac_scale(
    source: Tensor, target: Tensor, owner: Tensor, *, tolerance: float, samples: int = SAMPLES, seed: int = 0
) -> tuple[Tensor | None, RansacInfo]:
    """The factor that takes distances within each object from one reconstruction to another (paper, Sec. 3.2).

    A sample is a pair of correspondences on one object. Distances between points of one object do not know where the object
    is, so that wrong depths of whole objects do no harm.

    Args:
        source: (M, 3) points of an up-to-scale reconstruction.
        target: (M, 3) the same points, metric.
        owner: (M,) object of each.
        tolerance: largest relative difference of a pair's factor from the model's, of an inlier.
        samples: pairs to draw.
        seed: of the draws.

    Returns:
        The factor (), None without a pair; and info in which a *correspondence* is an inlier if most pairs with it are.
    """
    _check(source, 3, tolerance)
    if target.shape != source.shape or owner.shape != source.shape[:1]:
        raise InvalidInputError(
            f"target is {tuple(target.shape)}, owner {tuple(owner.shape)}, expected {tuple(source.shape)} and one a point"
        )
    if not bool(target.isfinite().all()):
        raise InvalidInputError("target contains NaN or infinity; leave these points out")
    source, target = source.double(), target.double()
    first, second = _pairs(owner, samples, seed)
    from_, to = ((x[first] - x[second]).norm(dim=1) for x in (source, target))
    usable = (from_ > 0) & (to > 0)
    first, second, ratio, length = first[usable], second[usable], (to / from_)[usable], to[usable]
    none = torch.zeros(len(source), dtype=torch.bool)
    if not len(ratio):
        return None, RansacInfo(none, source.new_full((len(source),), torch.inf), samples)
    # long pairs know the factor best
    weight = length / length.max()
    logarithm = ratio.log()
    votes = torch.cat(
        [
            (((logarithm[:, None] - model).abs() < tolerance) * weight[:, None]).sum(0)
            for model in _split(logarithm, len(ratio))
        ]
    )
    best = logarithm[votes.argmax()]
    for _ in range(5):
        near = (logarithm - best).abs() < tolerance
        best = (logarithm[near] * weight[near] ** 2).sum() / (weight[near] ** 2).sum()
    off = (logarithm - best).abs()
    near = (off < tolerance).double()
    total, good = torch.zeros(len(source)).double(), torch.zeros(len(source)).double()
    for end in (first, second):
        total.index_add_(0, end, torch.ones_like(near))
        good.index_add_(0, end, near)
    inliers = (total > 0) & (good > 0.5 * total)
    residual = source.new_full((len(source),), torch.inf)
    for end in (first, second):
        residual = residual.scatter_reduce(0, end, off, "amin")
    return best.exp(), RansacInfo(inliers, residual, samples)


def _draw(count: int, size: int, samples: int, seed: int) -> Tensor:
    """(samples, size) indices, different within a row."""
    if count < size:
        return torch.zeros(0, size, dtype=torch.int64)
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(samples, size, generator=generator)
    # the k-th of those that are left, moved past those taken
    out = torch.zeros(samples, 0, dtype=torch.int64)
    for k in range(size):
        new = (drawn[:, k] * (count - k)).long().clamp_max(count - k - 1)
        for taken in out.sort(1)[0].unbind(1):
            new = new + (new >= taken)
        out = torch.cat([out, new[:, None]], 1)
    return out


def _pairs(owner: Tensor, samples: int, seed: int) -> tuple[Tensor, Tensor]:
    """(samples,) and (samples,) correspondences, two different ones of one object each."""
    order = torch.argsort(owner, stable=True)
    _, count = torch.unique_consecutive(owner[order], return_counts=True)
    start = count.cumsum(0) - count
    start, count = start[count > 1], count[count > 1]
    if not len(count):
        none = torch.zeros(0, dtype=torch.int64)
        return none, none
    generator = torch.Generator().manual_seed(seed)
    which = torch.multinomial(count.double(), samples, replacement=True, generator=generator)
    drawn = torch.rand(samples, 2, generator=generator, dtype=torch.float64)
    first = (drawn[:, 0] * count[which]).long()
    other = (drawn[:, 1] * (count[which] - 1)).long()
    other = other + (other >= first)
    return order[start[which] + first], order[start[which] + other]


def _split(models: Tensor, points: int) -> tuple[Tensor, ...]:
    return models.split(max(1, MOST_DISTANCES // max(points, 1)))


def _check(points: Tensor, columns: int, tolerance: float) -> None:
    if points.ndim != 2 or points.shape[1] != columns or not points.is_floating_point():
        raise InvalidInputError(f"points are {points.dtype} {tuple(points.shape)}, expected floating (M, {columns})")
    if not bool(points.isfinite().all()):
        raise InvalidInputError("points contain NaN or infinity; leave them out")
    if not tolerance > 0:
        raise InvalidInputError(f"tolerance = {tolerance}, expected a positive number")
