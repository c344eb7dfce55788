"""Part pairs out of images, with known distances: apart as they were found, exactly touching, and deep in each other."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from physpose_torch.bench.images import BenchImage, batch_of
from physpose_torch.bench.oracle import Polytope, oracle_distances
from physpose_torch.distance.autograd import signed_distance
from physpose_torch.distance.broadphase import instance_bounds, meeting_pairs
from physpose_torch.errors import DataError
from physpose_torch.geometry.convex import ConvexParts

__all__ = ["KINDS", "PartPairs", "make_part_pairs"]

KINDS = ("apart", "touching", "deep")
DEEPEST, LEAST_DEEP = 0.01, 1e-4
"""[m]; deep pairs are moved this far into each other."""


@dataclass(frozen=True, eq=False)
class PartPairs:
    """E part pairs of one kind, in the cameras' frames, and their distances."""

    kind: str
    parts: ConvexParts
    pairs: Tensor
    """(E, 2) part indices."""
    T_a: Tensor
    """(E, 4, 4) float64 [m]."""
    T_b: Tensor
    gravity: Tensor
    """(E, 3) unit vectors, pointing down."""
    distance: np.ndarray
    """(E,) [m]."""
    normal: np.ndarray
    """(E, 3) from a to b, in the frame of a."""

    def __len__(self) -> int:
        return len(self.pairs)

    def relative(self) -> tuple[np.ndarray, np.ndarray]:
        """R (E, 3, 3) and t (E, 3): pose of b in the frame of a [m]."""
        return _relative(self.T_a, self.T_b)

    def hulls(self) -> list[Polytope]:
        """Vertices and triangles of every part."""
        return _hulls(self.parts)

    def rows(self, rows: np.ndarray) -> "PartPairs":
        """Some of the pairs."""
        index = torch.as_tensor(rows, dtype=torch.long)
        tensors = (x[index] for x in (self.pairs, self.T_a, self.T_b, self.gravity))
        return PartPairs(self.kind, self.parts, *tensors, self.distance[rows], self.normal[rows])


def make_part_pairs(
    images: Sequence[BenchImage], count: int, *, oracle: Path | None, seed: int = 0
) -> tuple[list[PartPairs], list[str]]:
    """About a third of ``count`` pairs of each kind, and what there is to say about them.

    Drawn among the part pairs of different objects whose bounding boxes meet. Moving b along the normal by minus the
    distance makes them touch, whatever they were; moving it farther makes them overlap.

    Args:
        images: where the parts stand.
        count: number of pairs.
        oracle: file of the oracle; None: distances by the best backend, which then cannot be judged by them.
        seed: of the draw.

    Raises:
        DataError: no part pairs come near each other in these images.
    """
    found = _meeting(images)
    if len(found) == 0:
        raise DataError("no two parts of different objects come near each other in these images")
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(found))
    want = max(count // 3, 1)
    # most pairs whose boxes meet are apart, some are not: a few more than needed, at once
    base = _measured(found.rows(order[: int(1.3 * want) + 8]), oracle)
    while (base.distance > 0).sum() < want and len(base) < len(order):
        more = _measured(found.rows(order[len(base) : len(base) + want]), oracle)
        base = _joined(base, more)
    apart = base.rows((base.distance > 0).nonzero()[0][:want])
    base = base.rows(np.arange(min(want, len(base))))
    depth = np.exp(rng.uniform(np.log(LEAST_DEEP), np.log(DEEPEST), len(base)))
    made = [
        apart,
        _measured(_shifted(base, "touching", -base.distance), oracle),
        _measured(_shifted(base, "deep", -base.distance - depth), oracle),
    ]
    notes = []
    if sum(map(len, made)) < 3 * want:
        sizes = ", ".join(f"{len(p)} {p.kind}" for p in made)
        notes.append(f"only {len(found)} part pairs come near each other in these images: {sizes}")
    return [p for p in made if len(p)], notes


def _meeting(images: Sequence[BenchImage]) -> PartPairs:
    scene, poses, _ = batch_of(images)
    T, entity = scene.entity_poses(poses).detach(), scene.instance_entity
    bounds = instance_bounds(
        T[entity], scene.parts, scene.instance_part, scene.gravity[scene.entity_image[entity]].to(T)
    )
    pairs = meeting_pairs(bounds, entity, scene.instance_start, scene.entity_pairs)
    first, second = entity[pairs].unbind(1)
    gravity = scene.gravity[scene.entity_image[first]]
    down = torch.tensor([0.0, 1.0, 0.0], dtype=gravity.dtype)
    gravity = torch.where((gravity == 0).all(-1, keepdim=True), down, gravity)
    unknown = np.full(len(pairs), np.nan)
    part = scene.instance_part[pairs]
    return PartPairs("apart", scene.parts, part, T[first], T[second], gravity, unknown, np.stack([unknown] * 3, 1))


def _measured(pairs: PartPairs, oracle: Path | None) -> PartPairs:
    """The same pairs with their distances and normals."""
    R, t = pairs.relative()
    if oracle is not None:
        distance, normal = oracle_distances(oracle, pairs.hulls(), pairs.pairs.numpy(), R, t)
    else:
        result = signed_distance(pairs.T_a, pairs.T_b, pairs.parts, pairs.pairs)
        distance = result.distance.detach().numpy()
        normal = (result.normal[:, None] @ pairs.T_a[:, :3, :3])[:, 0].numpy()
    return PartPairs(pairs.kind, pairs.parts, pairs.pairs, pairs.T_a, pairs.T_b, pairs.gravity, distance, normal)


def _shifted(pairs: PartPairs, kind: str, along: np.ndarray) -> PartPairs:
    """The second parts moved along the normals by lengths (E,) [m]."""
    T_b = pairs.T_b.clone()
    shift = torch.from_numpy(along[:, None] * pairs.normal)
    T_b[:, :3, 3] += (pairs.T_a[:, :3, :3] @ shift[:, :, None])[:, :, 0]
    return PartPairs(kind, pairs.parts, pairs.pairs, pairs.T_a, T_b, pairs.gravity, pairs.distance, pairs.normal)


def _joined(a: PartPairs, b: PartPairs) -> PartPairs:
    tensors = (torch.cat([getattr(a, n), getattr(b, n)]) for n in ("pairs", "T_a", "T_b", "gravity"))
    arrays = (np.concatenate([getattr(a, n), getattr(b, n)]) for n in ("distance", "normal"))
    return PartPairs(a.kind, a.parts, *tensors, *arrays)


def _relative(T_a: Tensor, T_b: Tensor) -> tuple[np.ndarray, np.ndarray]:
    R = T_a[:, :3, :3].mT @ T_b[:, :3, :3]
    t = (T_a[:, :3, :3].mT @ (T_b - T_a)[:, :3, 3:])[:, :, 0]
    return R.numpy(), t.numpy()


def _hulls(parts: ConvexParts) -> list[Polytope]:
    return [tuple(x.numpy() for x in parts.part(p)) for p in range(parts.n_parts)]
