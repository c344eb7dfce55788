"""Which parts can touch: bounding boxes in a frame whose third axis is gravity, as tensors."""

from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.geometry.convex import ConvexParts

__all__ = ["Bounds", "instance_bounds", "meeting_pairs", "near_spheres", "pairs_below"]

MOST_CANDIDATES = 1 << 21
"""Pairs of spheres that are looked at at once."""


class Bounds(NamedTuple):
    """Axis-aligned boxes of part instances, (Q, 3) each, in each image's gravity frame [m]; z points down."""

    lower: Tensor
    upper: Tensor


def instance_bounds(T: Tensor, parts: ConvexParts, part: Tensor, gravity: Tensor) -> Bounds:
    """Boxes of part instances.

    Args:
        T: (Q, 4, 4) pose of each instance's body [m]; part: (Q,) which part; gravity: (Q, 3), zeros where unknown.
    """
    down = torch.where((gravity == 0).all(-1, keepdim=True), gravity.new_tensor([0.0, 0.0, 1.0]), gravity)
    axes = torch.cat([tangent_basis(down), down[:, None]], dim=1)
    local = parts.padded.to(T)[part]
    aligned = local @ (axes @ T[:, :3, :3]).mT + (axes @ T[:, :3, 3:]).mT
    return Bounds(aligned.amin(1), aligned.amax(1))


def near_spheres(center: Tensor, radius: Tensor, margin: float) -> Tensor:
    """Pairs (E, 2) of spheres that come within ``margin`` [m] of each other, the lesser index first, in order.

    They are sorted along the axis of their largest spread, and each is held against those that begin before it ends.

    Args:
        center: (M, 3) [m]; radius: (M,) [m]; on the CPU, float64.
    """
    center = center - center[:1]
    axis = int((center.amax(0) - center.amin(0)).argmax())
    reach = (radius + 0.5 * margin) * (1 + 1e-9)  # rounding makes no pair fewer
    low, order = (center[:, axis] - reach).sort()
    center, reach = center[order], reach[order]
    count = torch.searchsorted(low, center[:, axis] + reach, right=True) - torch.arange(1, len(low) + 1)
    total = torch.cat([count.new_zeros(1), count.cumsum(0)])
    found, begin = [order.new_zeros(0, 2)], 0
    while begin < len(low):
        end = max(int(torch.searchsorted(total, total[begin] + MOST_CANDIDATES, right=True)) - 1, begin + 1)
        first = torch.repeat_interleave(torch.arange(begin, end), count[begin:end])
        second = torch.arange(int(total[begin]), int(total[end])) - total[first] + first + 1
        near = ((center[first] - center[second]) ** 2).sum(1) <= (reach[first] + reach[second]) ** 2
        found.append(torch.stack([first[near], second[near]], dim=1))
        begin = end
    pairs = order[torch.cat(found)].sort(1).values
    return pairs[torch.argsort(pairs[:, 0] * len(low) + pairs[:, 1])]


def entity_bounds(bounds: Bounds, entity: Tensor, n_entities: int) -> Bounds:
    """Boxes of whole entities from those of their instances; ``entity`` (Q,) says whose each is."""
    index = entity[:, None].expand(-1, 3)
    infinite = bounds.lower.new_full((n_entities, 3), torch.inf)
    return Bounds(
        infinite.scatter_reduce(0, index, bounds.lower, "amin"),
        (-infinite).scatter_reduce(0, index, bounds.upper, "amax"),
    )


def meeting_pairs(
    bounds: Bounds, entity: Tensor, start: Tensor, entity_pairs: Tensor, *, margin: float = 0.0
) -> Tensor:
    """Pairs (E, 2) of part instances whose boxes come within ``margin`` [m] of each other, among the entity pairs."""
    return _two_level(bounds, entity, start, entity_pairs, lambda a, b, _: _overlap(a, b, 3, margin))


def pairs_below(
    bounds: Bounds, entity: Tensor, start: Tensor, entity_pairs: Tensor, *, reach: Tensor | float
) -> Tensor:
    """Pairs (E, 2) of part instances (a, b) such that a, falling by at most ``reach`` [m], may meet b.

    ``entity_pairs`` are ordered: (who falls, onto whom); ``reach`` is one length, or one for each entity.
    """
    reach = torch.as_tensor(reach, dtype=bounds.lower.dtype, device=bounds.lower.device).expand(len(start) - 1)

    def may_land(a: Bounds, b: Bounds, who: Tensor) -> Tensor:
        # z points down: b must reach deeper than a's top does, and not lie farther below a's bottom than the fall
        vertical = (b.upper[:, 2] > a.lower[:, 2]) & (b.lower[:, 2] < a.upper[:, 2] + reach[who])
        return _overlap(a, b, 2, 0.0) & vertical

    return _two_level(bounds, entity, start, entity_pairs, may_land)


def _overlap(a: Bounds, b: Bounds, axes: int, margin: float) -> Tensor:
    return (
        (a.lower[:, :axes] <= b.upper[:, :axes] + margin) & (b.lower[:, :axes] <= a.upper[:, :axes] + margin)
    ).all(-1)


def _two_level(bounds: Bounds, entity: Tensor, start: Tensor, entity_pairs: Tensor, test) -> Tensor:
    """Test whole entities, then the parts of those that pass."""
    whole = entity_bounds(bounds, entity, len(start) - 1)
    first, second = entity_pairs.unbind(1)
    near = test(Bounds(*(x[first] for x in whole)), Bounds(*(x[second] for x in whole)), first)
    pairs = part_pairs(start, entity_pairs[near])
    first, second = pairs.unbind(1)
    near = test(Bounds(*(x[first] for x in bounds)), Bounds(*(x[second] for x in bounds)), entity[first])
    return pairs[near]


def part_pairs(start: Tensor, entity_pairs: Tensor) -> Tensor:
    """All pairs (E, 2) of part instances of pairs of entities."""
    count = start.diff()
    count_a, count_b = count[entity_pairs[:, 0]], count[entity_pairs[:, 1]]
    total = count_a * count_b
    pair = torch.repeat_interleave(torch.arange(len(entity_pairs), device=start.device), total)
    within = torch.arange(len(pair), device=start.device) - (total.cumsum(0) - total)[pair]
    i = torch.div(within, count_b[pair].clamp_min(1), rounding_mode="floor")
    j = within - i * count_b[pair]
    return torch.stack([start[entity_pairs[pair, 0]] + i, start[entity_pairs[pair, 1]] + j], dim=1)
