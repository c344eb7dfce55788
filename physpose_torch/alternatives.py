"""Which estimates are alternatives of one physical object rather than objects of their own."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.geometry.body import Body
from physpose_torch.scene import Scene

__all__ = ["find_alternatives", "overlap_share"]

DEEP = 0.25
"""Share of a body inside another one of its kind from which on the two cannot both be there."""
SHRINK = 0.7
"""Sample points of a part: its centre, and its vertices moved towards the centre by this factor."""


def find_alternatives(
    poses: Tensor, scene: Scene, scores: Tensor, *, counts: Mapping[tuple[int, str], int] | None = None
) -> Tensor:
    """Numbers (N,) for ``Scene(same_object=...)``: equal for rows that estimate one physical object.

    In the order of their scores, a row is an alternative of a better row of its image and label when their parts overlap
    deeply and their centres are nearer than half the body's smallest extent; and, where it is known how many instances of
    the label there are, once that many are taken (then of the nearest one). Two cans that touch are two cans.

    Args:
        poses: T_camera_object (N, 4, 4) [m].
        scene: its objects and images; its own ``same_object`` is ignored.
        scores: (N,).
        counts: (image, label) → number of instances, where known.
    """
    poses = poses.detach().double().cpu()
    counts = counts or {}
    rows_of: dict[tuple[int, str], list[int]] = {}
    images = scene.image.tolist()
    for i in torch.argsort(scores.double().cpu(), descending=True, stable=True).tolist():
        rows_of.setdefault((images[i], scene.objects[i].label), []).append(i)
    group = list(range(len(scene)))
    for key, rows in rows_of.items():
        if len(rows) > 1:
            leaders = _leaders([scene.objects[i] for i in rows], poses[rows], counts.get(key))
            for i, leader in zip(rows, leaders, strict=True):
                group[i] = rows[leader]
    return torch.tensor(group, dtype=torch.long)


def _leaders(bodies: Sequence[Body], poses: Tensor, known: int | None) -> list[int]:
    """For each of the rows of one label, the best first, the row that it is an alternative of, or itself."""
    centers = se3.apply(poses, torch.stack([body.center for body in bodies])[:, None])[:, 0]
    distance = torch.linalg.vector_norm(centers[:, None] - centers, dim=2).tolist()
    leaders, distinct = [0], [0]
    for i, body in enumerate(bodies[1:], start=1):
        nearest = min(distinct, key=distance[i].__getitem__)
        if (known is not None and len(distinct) >= known) or (
            distance[i][nearest] < 0.5 * float((body.upper - body.lower).min())
            and overlap_share(body, poses[i], poses[nearest]) > DEEP
        ):
            leaders.append(nearest)
        else:
            leaders.append(i)
            distinct.append(i)
    return leaders


def overlap_share(body: Body, T_a: Tensor, T_b: Tensor) -> float:
    """Share of the body's sample points at pose T_a (4, 4) that lie inside its parts at pose T_b (4, 4)."""
    parts = body.parts
    inner = parts.center[:, None] + SHRINK * (parts.padded - parts.center[:, None])
    points = torch.cat([parts.center, inner[parts.padded_mask]])
    points = se3.apply(se3.inverse(T_b) @ T_a, points)
    # only points in a part's bounds are held against its faces: all together would be hundreds of megabytes
    bounded = (points[:, None] >= parts.lower) & (points[:, None] <= parts.upper)
    point, part = bounded.all(2).nonzero().unbind(1)
    height = (parts.face_normals[part] @ points[point, :, None])[:, :, 0]
    inside = (height <= parts.face_offsets[part]).all(1)
    return len(point[inside].unique()) / len(points)
