"""The broad phase never drops a pair that matters, and does drop those that do not."""

import numpy as np
import pytest
import torch
from helpers import assert_camera_frame_invariant, box, random_poses
from oracle import oracle_distance, oracle_drop

from physpose_torch import se3
from physpose_torch.distance.broadphase import (
    entity_bounds,
    instance_bounds,
    meeting_pairs,
    pairs_below,
    part_pairs,
)
from physpose_torch.geometry.convex import ConvexParts

DOWN = torch.nn.functional.normalize(torch.tensor([0.3, 0.8, -0.5], dtype=torch.float64), dim=0)


class Crowd:
    """Bodies of one to three boxes, strewn about; all of them see the same gravity."""

    def __init__(self, n, seed, spread, gravity=DOWN):
        rng = np.random.default_rng(seed)
        count = rng.integers(1, 4, size=n)
        hulls = [box(*rng.uniform(0.01, 0.05, 3)) + 0.06 * rng.normal(size=3) for _ in range(count.sum())]
        self.parts = ConvexParts.from_hulls(hulls)
        self.start = torch.tensor([0, *np.cumsum(count)])
        self.entity = torch.repeat_interleave(torch.arange(n), torch.as_tensor(count))
        self.T = random_poses(n, seed, spread)
        self.gravity = gravity
        self.entity_pairs = torch.combinations(torch.arange(n))

    def bounds(self, X=None):
        X = torch.eye(4, dtype=torch.float64) if X is None else X
        T, part = (X @ self.T)[self.entity], torch.arange(len(self.entity))
        return instance_bounds(T, self.parts, part, (X[:3, :3] @ self.gravity).expand(len(part), 3))

    def meeting(self, **kwargs):
        return self.as_set(meeting_pairs(self.bounds(), self.entity, self.start, self.entity_pairs, **kwargs))

    def vertices(self, q):
        vertices, faces = self.parts.part(q)
        return se3.apply(self.T[self.entity[q]], vertices).numpy(), faces.numpy()

    def all_part_pairs(self):
        return self.as_set(part_pairs(self.start, self.entity_pairs))

    @staticmethod
    def as_set(pairs):
        return {(int(a), int(b)) for a, b in pairs}


@pytest.mark.parametrize("gravity", [DOWN, torch.zeros(3, dtype=torch.float64)], ids=["gravity", "no gravity"])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_no_pair_that_the_oracle_finds_near_is_dropped(seed, margin, gravity):
    crowd = Crowd(8, seed, 0.12, gravity)
    found, every = crowd.meeting(margin=margin), crowd.all_part_pairs()
    near = {
        (a, b) for a, b in every if oracle_distance(*crowd.vertices(a), *crowd.vertices(b))[0] <= margin
    }
    assert near
    assert near <= found <= every
    assert len(found) < 0.7 * len(every)


def test_far_pairs_are_dropped():
    crowd = Crowd(6, 0, 5.0)
    assert crowd.meeting() == set()
    assert len(crowd.all_part_pairs()) > 10


def test_margin_is_a_length():
    """Two boxes 5 cm apart are found with a margin of 5 cm, and not with less."""
    parts = ConvexParts.from_hulls([box(0.05, 0.05, 0.05), box(0.05, 0.05, 0.05)])
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T[1, 0, 3] = 0.15
    index = torch.arange(2)
    bounds = instance_bounds(T, parts, index, torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=torch.float64))
    for margin, count in ((0.0, 0), (0.0499, 0), (0.0501, 1)):
        pairs = meeting_pairs(bounds, index, torch.arange(3), torch.tensor([[0, 1]]), margin=margin)
        assert len(pairs) == count


@pytest.mark.parametrize("reach", [0.02, 0.3])
@pytest.mark.parametrize("seed", range(2))
def test_no_pair_that_may_land_is_dropped(seed, reach):
    crowd = Crowd(7, seed, 0.15)
    ordered = torch.cat([crowd.entity_pairs, crowd.entity_pairs.flip(1)])
    found = crowd.as_set(pairs_below(crowd.bounds(), crowd.entity, crowd.start, ordered, reach=reach))
    every = crowd.as_set(part_pairs(crowd.start, ordered))
    drop = {
        (a, b): oracle_drop(*crowd.vertices(a), *crowd.vertices(b), crowd.gravity.numpy(), limit=1.0) for a, b in every
    }
    lands = {pair for pair, h in drop.items() if h <= reach}
    assert lands
    assert lands <= found
    assert len(found) < 0.6 * len(every)


def test_a_pair_is_ordered_by_who_falls():
    parts = ConvexParts.from_hulls([box(0.05, 0.05, 0.05), box(0.5, 0.5, 0.01)])
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T[1, 2, 3] = 0.2
    index, down = torch.arange(2), torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=torch.float64)
    bounds = instance_bounds(T, parts, index, down)
    both = torch.tensor([[0, 1], [1, 0]])
    assert pairs_below(bounds, index, torch.arange(3), both, reach=0.2).tolist() == [[0, 1]]
    assert pairs_below(bounds, index, torch.arange(3), both, reach=0.1).tolist() == []


def test_bounds_hold_all_vertices_and_touch_them():
    crowd = Crowd(5, 3, 0.2)
    bounds = crowd.bounds()
    height = [crowd.vertices(q)[0] @ DOWN.numpy() for q in range(crowd.parts.n_parts)]
    np.testing.assert_allclose(bounds.lower[:, 2], [h.min() for h in height], atol=1e-14)
    np.testing.assert_allclose(bounds.upper[:, 2], [h.max() for h in height], atol=1e-14)
    whole = entity_bounds(bounds, crowd.entity, 5)
    for e in range(5):
        assert torch.equal(whole.lower[e], bounds.lower[crowd.entity == e].amin(0))
        assert torch.equal(whole.upper[e], bounds.upper[crowd.entity == e].amax(0))


def test_heights_do_not_depend_on_the_camera():
    crowd = Crowd(5, 3, 0.2)

    def heights(X):
        bounds = crowd.bounds(X)
        return bounds.upper[:, 2] - bounds.lower[:, 2], bounds.lower[:, 2] - bounds.lower[0, 2]

    assert_camera_frame_invariant(heights, atol=1e-12)


def test_part_pairs_are_the_product_of_the_parts():
    pairs = part_pairs(torch.tensor([0, 2, 2, 5]), torch.tensor([[0, 2], [1, 2], [2, 0]]))
    expected = [(a, b) for a in (0, 1) for b in (2, 3, 4)] + [(a, b) for a in (2, 3, 4) for b in (0, 1)]
    assert [tuple(p) for p in pairs.tolist()] == expected


@pytest.mark.parametrize("n", [0, 1])
def test_few_entities_make_no_pairs(n):
    crowd = Crowd(1, 0, 0.1)
    start, entity = crowd.start[: n + 1], crowd.entity[: int(crowd.start[n])]
    bounds = type(crowd.bounds())(*(x[: len(entity)] for x in crowd.bounds()))
    none = torch.zeros(0, 2, dtype=torch.long)
    assert meeting_pairs(bounds, entity, start, none, margin=1.0).shape == (0, 2)
    assert pairs_below(bounds, entity, start, none, reach=1.0).shape == (0, 2)
