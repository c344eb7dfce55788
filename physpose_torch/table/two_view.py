"""How two cameras stand to each other, from objects seen by both or from matches; points from both."""

import cv2
import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.table.ransac import RansacInfo
from physpose_torch.table.roles import Matches
from physpose_torch.table.view import pixel_rays, project

__all__ = ["motion_from_matches", "motion_from_objects", "refine_motion", "triangulate"]

EPIPOLAR = 1.5
"""[px]; a match farther than this from its epipolar line is wrong."""
LEAST_MATCHES = 12
"""Fewer matches than this tell nothing of a motion."""


def motion_from_objects(first: Tensor, second: Tensor) -> Tensor | None:
    """T_view1_view0 (4, 4) that takes the objects' poses (N, 4, 4) in one view to those in the other, in the mean.

    Rows that are NaN in either do not count. None if no object is left.
    """
    both = first.isfinite().flatten(1).all(1) & second.isfinite().flatten(1).all(1)
    if not bool(both.any()):
        return None
    first, second = first[both], second[both]
    # median, then mean of what agrees: one object that is estimated upside down must not turn the camera
    each = second[:, :3, :3] @ first[:, :3, :3].mT
    apart = se3.log_so3(each[:, None].mT @ each).norm(dim=-1)
    typical = apart.median(1)[0].argmin()
    agree = apart[typical] < max(0.1, 3 * float(apart[typical].median()))
    U, _, Vh = torch.linalg.svd(each[agree].mean(0))
    R = U @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(U @ Vh).sign())], dtype=U.dtype)) @ Vh
    shift = second[:, :3, 3] - first[:, :3, 3] @ R.mT
    return se3.from_rotation_translation(R, shift[agree].median(0)[0] if int(agree.sum()) > 2 else shift[agree].mean(0))


def motion_from_matches(matches: Matches, K0: Tensor, K1: Tensor) -> tuple[Tensor | None, RansacInfo]:
    """T_view1_view0 (4, 4) with a translation of length 1, from an essential matrix (Nistér's five points, MAGSAC++).

    The same matches give the same motion: OpenCV's USAC draws from a generator of its own with a fixed seed.

    Returns:
        The motion, None where there is none to be found; and which matches agree with it.
    """
    count = len(matches.points_0)
    nothing = RansacInfo(torch.zeros(count, dtype=torch.bool), torch.full((count,), torch.inf), 0)
    if count < LEAST_MATCHES:
        return None, nothing
    rays = [pixel_rays(K, p)[:, :2].numpy() for K, p in ((K0, matches.points_0), (K1, matches.points_1))]
    focal = float((K0[0, 0] + K0[1, 1] + K1[0, 0] + K1[1, 1]) / 4)
    found, mask = cv2.findEssentialMat(
        *rays, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=EPIPOLAR / focal, maxIters=5000
    )
    if found is None or mask is None:
        return None, nothing
    best = None
    for E in found.reshape(-1, 3, 3):  # several are stacked where five points allow several
        votes, R, t, _ = cv2.recoverPose(E, *rays, np.eye(3), mask=mask.copy())
        if best is None or votes > best[0]:
            best = votes, R, t
    votes, R, t = best
    if votes < LEAST_MATCHES:
        return None, nothing
    T = se3.from_rotation_translation(torch.from_numpy(R).double(), torch.from_numpy(t[:, 0]).double())
    points, residual = triangulate(T, K0, K1, matches.points_0, matches.points_1)
    good = torch.from_numpy(mask[:, 0] > 0) & (residual < 2 * EPIPOLAR) & (points[:, 2] > 0)
    return T, RansacInfo(good, residual, 5000)


def refine_motion(
    T_view1_view0: Tensor, K0: Tensor, K1: Tensor, points_0: Tensor, points_1: Tensor, covariance: Tensor
) -> tuple[Tensor, Tensor]:
    """A motion with a baseline of length 1, fitted to matches (M, 2), (M, 2) by their distances from epipolar lines.

    Five points know a motion roughly; all of them, each as well as it is located, know it much better.

    Args:
        T_view1_view0: to start from; its translation's length does not matter.
        K0, K1: intrinsics.
        points_0, points_1: matches [px].
        covariance: (M, 2, 2) of the second points [px²].

    Returns:
        The motion, and the distances (M,) in standard deviations.
    """
    rays = pixel_rays(K0, points_0)
    ahead = pixel_rays(K1, points_1)
    to_pixels = torch.linalg.inv(K1).mT[:2]
    T = T_view1_view0.clone()
    T[:3, 3] /= torch.linalg.vector_norm(T[:3, 3]).clamp_min(1e-12)

    def distance(step: Tensor) -> Tensor:
        R = T[:3, :3] @ (torch.eye(3, dtype=T.dtype) + se3.hat(step[:3]))
        t = T[:3, 3] + step[3:] @ tangent_basis(T[None, :3, 3])[0]
        line = torch.linalg.cross(t.expand_as(rays), rays @ R.mT)
        slope = line @ to_pixels.mT
        variance = (slope[:, None] @ covariance @ slope[..., None])[:, 0, 0]
        return (ahead * line).sum(1) / variance.clamp_min(1e-30).sqrt()

    zero = T.new_zeros(5)
    for scale in (8.0, 4.0, 2.0, 1.0, 1.0, 1.0):
        r, J = distance(zero), torch.func.jacfwd(distance)(zero)
        weight = 5.0 / (4.0 + (r / scale) ** 2)
        normal = J.mT @ (weight[:, None] * J) + 1e-6 * torch.eye(5, dtype=T.dtype)
        step = -torch.linalg.solve(normal, J.mT @ (weight * r)).clamp(-0.1, 0.1)
        shift = T[:3, 3] + step[3:] @ tangent_basis(T[None, :3, 3])[0]
        T = se3.from_rotation_translation(T[:3, :3] @ se3.exp_so3(step[:3]), shift / torch.linalg.vector_norm(shift))
    return T, distance(zero)


def triangulate(T_view1_view0: Tensor, K0: Tensor, K1: Tensor, points_0: Tensor, points_1: Tensor) -> tuple[Tensor, Tensor]:
    """Points (M, 3) in view 0 that both pixels (M, 2) see, and how far off they project in view 1 [px]; linear, on ray 0."""
    rays = pixel_rays(K0, points_0)
    turned = rays @ T_view1_view0[:3, :3].mT
    t = T_view1_view0[:3, 3]
    ahead = pixel_rays(K1, points_1)
    # cross(ahead, depth * turned + t) = 0
    a, b = torch.linalg.cross(ahead, turned), torch.linalg.cross(ahead, t.expand_as(ahead))
    depth = -(a * b).sum(1) / (a * a).sum(1).clamp_min(1e-18)
    points = depth[:, None] * rays
    seen = points @ T_view1_view0[:3, :3].mT + t
    residual = torch.linalg.vector_norm(project(K1, seen) - points_1, dim=1)
    residual = torch.where((depth > 0) & (seen[:, 2] > 0), residual, torch.inf)
    return points, residual
