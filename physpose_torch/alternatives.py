"""Which estimates are alternatives of one physical object rather than objects of their own."""

from collections.abc import Mapping

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
    group = list(range(len(scene)))
    leaders: dict[tuple[int, str], list[int]] = {}
    centers = se3.apply(poses, scene.object_center[:, None])[:, 0]
    for i in torch.argsort(scores.double().cpu(), descending=True, stable=True).tolist():
        key = (int(scene.image[i]), scene.objects[i].label)
        better = leaders.setdefault(key, [])
        if not better:
            better.append(i)
            continue
        body = scene.objects[i]
        distance = torch.linalg.vector_norm(centers[better] - centers[i], dim=1)
        nearest = better[int(distance.argmin())]
        near = float(distance.min()) < 0.5 * float((body.upper - body.lower).min())
        known = counts.get(key)
        if (known is not None and len(better) >= known) or (
            near and overlap_share(body, poses[i], poses[nearest]) > DEEP
        ):
            group[i] = nearest
        else:
            better.append(i)
    return torch.tensor(group, dtype=torch.long)


def overlap_share(body: Body, T_a: Tensor, T_b: Tensor) -> float:
    """Share of the body's sample points at pose T_a (4, 4) that lie inside its parts at pose T_b (4, 4)."""
    parts = body.parts
    inner = parts.center[:, None] + SHRINK * (parts.padded - parts.center[:, None])
    points = torch.cat([parts.center, inner[parts.padded_mask]])
    points = se3.apply(se3.inverse(T_b) @ T_a, points)
    height = torch.einsum("pfi,ki->kpf", parts.face_normals, points)
    top = torch.einsum("pfi,pki->pfk", parts.face_normals, parts.padded).amax(2)
    return float((height <= top).all(2).any(1).double().mean())
