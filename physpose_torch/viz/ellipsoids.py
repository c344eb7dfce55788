"""How sure a pose is, as what can be seen: an ellipsoid around the origin, and how far the tips of the axes sway."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.viz import ink
from physpose_torch.viz.scene import SceneView

__all__ = [
    "UNSURE",
    "Ellipses",
    "Ellipsoids",
    "checked_covariance",
    "draw_ellipsoids",
    "pose_ellipsoids",
    "swaying_axes",
]

UNSURE = "#7a2be0"
"""Colour of uncertainty; red is taken."""
_HALO = "#ffffff"  # around outlines, which may lie on anything
_CORNERS = 96


class Ellipsoids(NamedTuple):
    """The points ``center + half_axes @ u`` with |u| ≤ 1, of M ellipsoids."""

    center: Tensor
    """(M, 3) [m]."""
    half_axes: Tensor
    """(M, 3, 3), the columns are the principal half axes, longest first [m]; a flat one has a column of zeros."""


class Ellipses(NamedTuple):
    """The outlines of M ellipsoids in an image: the points ``center + half_axes @ u`` with |u| = 1."""

    center: Tensor
    """(M, 2) [px]; not the image of the ellipsoid's centre, for a camera sees near parts larger."""
    half_axes: Tensor
    """(M, 2, 2) [px]."""
    seen: Tensor
    """(M,) bool: the whole ellipsoid is in front of the camera; the others have no outline."""


def checked_covariance(covariance: Tensor, n: int, name: str = "covariance") -> Tensor:
    """The covariance (n, 6, 6), float64 on the CPU.

    Raises:
        InvalidInputError: it has another shape, is not finite, or has a negative variance.
    """
    covariance = torch.as_tensor(covariance).detach().to("cpu", torch.float64)
    if covariance.shape != (n, 6, 6) or not bool(covariance.isfinite().all()):
        raise InvalidInputError(
            f"{name} has shape {tuple(covariance.shape)}, expected finite ({n}, 6, 6), order [t in the camera frame, "
            "log rotation in the object frame], for as many poses"
        )
    covariance = 0.5 * (covariance + covariance.mT)
    least = torch.linalg.eigvalsh(covariance)[:, :1]
    bad = (least < -1e-9 * covariance.diagonal(dim1=1, dim2=2).abs().amax(1, keepdim=True)).any(1)
    if bool(bad.any()):
        row = int(bad.nonzero()[0, 0])
        raise InvalidInputError(f"{name}[{row}] has a negative variance ({float(least[row]):.3g}); is it a precision?")
    return covariance


def pose_ellipsoids(poses: Tensor, covariance: Tensor, *, sigmas: float = 2.0) -> Ellipsoids:
    """Where the origins of objects may be: the surfaces at so many standard deviations.

    At 2σ an ellipsoid holds the origin with a probability of 74 %, if errors are Gaussian.

    Args:
        poses: T_camera_object (N, 4, 4) [m].
        covariance: (N, 6, 6), order [t in the camera frame [m], log rotation in the object frame [rad]].
        sigmas: how many standard deviations.

    Returns:
        N ellipsoids in the camera frame.

    Raises:
        InvalidInputError: shapes do not fit, a variance is negative, or ``sigmas`` is not positive.
    """
    if not (math.isfinite(sigmas) and sigmas > 0):
        raise InvalidInputError(f"sigmas = {sigmas}, expected a positive number of standard deviations")
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InvalidInputError(f"poses has shape {tuple(poses.shape)}, expected T_camera_object (N, 4, 4)")
    poses = poses.detach().to("cpu", torch.float64)
    covariance = checked_covariance(covariance, len(poses))
    return Ellipsoids(poses[:, :3, 3], sigmas * _root(covariance[:, :3, :3]))


def swaying_axes(
    poses: Tensor, covariance: Tensor, length: Tensor, *, sigmas: float = 2.0
) -> tuple[Tensor, Ellipsoids]:
    """How far the tips of an object's axes sway with its rotation, to first order.

    Args:
        poses: T_camera_object (N, 4, 4) [m].
        covariance: (N, 6, 6), see :func:`pose_ellipsoids`.
        length: (N,) of the axes [m].
        sigmas: how many standard deviations.

    Returns:
        The axes (3 N, 2, 3), from origin to tip in the camera frame [m], x, y and z of one object after another; and the
        flat ellipsoids that the tips sway in.
    """
    poses = poses.detach().to("cpu", torch.float64)
    covariance = checked_covariance(covariance, len(poses))[:, None, 3:, 3:]
    R, origin = poses[:, :3, :3], poses[:, :3, 3]
    tips = origin[:, None] + length.to(poses)[:, None, None] * R.mT
    moves = -length.to(poses)[:, None, None, None] * R[:, None] @ se3.hat(torch.eye(3, dtype=torch.float64))
    spread = (moves @ covariance @ moves.mT).flatten(0, 1)
    axes = torch.stack([origin[:, None].expand_as(tips), tips], 2)
    return axes.flatten(0, 1), Ellipsoids(tips.flatten(0, 1), sigmas * _root(spread))


def seen_by(ellipsoids: Ellipsoids, view: SceneView, T_frame: Tensor | None = None) -> Ellipses:
    """Outlines of ellipsoids as a pinhole camera sees them, exact: the dual quadric's image is the dual conic.

    Args:
        ellipsoids: in any frame.
        view: the camera.
        T_frame: that frame in the view's table frame, T_table_frame (4, 4); None: they are given in it.
    """
    T = view.T_view_table if T_frame is None else view.T_view_table @ T_frame
    center, half = se3.apply(T, ellipsoids.center), T[:3, :3] @ ellipsoids.half_axes
    dual = view.K @ (half @ half.mT - center[:, :, None] * center[:, None]) @ view.K.mT
    seen = (dual[:, 2, 2] < 0) & (center[:, 2] > 0)
    dual = dual / torch.where(seen, -dual[:, 2, 2], 1.0)[:, None, None]
    middle = -dual[:, :2, 2]
    return Ellipses(middle, _root(dual[:, :2, :2] + middle[:, :, None] * middle[:, None]), seen)


def draw_ellipsoids(
    canvas: np.ndarray,
    poses: Tensor,
    covariance: Tensor,
    view: SceneView,
    *,
    T_frame: Tensor | None = None,
    radius: Tensor | None = None,
    sigmas: float = 2.0,
    unit: float = 1.0,
) -> np.ndarray:
    """The uncertainty of poses over an image (H, W, 3), translucent.

    Args:
        canvas: as large as the view.
        poses: T_camera_object (N, 4, 4) [m].
        covariance: (N, 6, 6), see :func:`pose_ellipsoids`.
        view: the camera.
        T_frame: T_table_camera, where the view is given in a table's frame; None: in the poses' own.
        radius: (N,) of the objects [m]: axes of this length are drawn, with the ellipses that their tips sway in; None: none.
        sigmas: how many standard deviations.
        unit: width of lines [px].
    """
    size = canvas.shape[:2]
    if radius is not None:
        axes, tips = swaying_axes(poses, covariance, radius, sigmas=sigmas)
        if T_frame is not None:
            axes = se3.apply(T_frame, axes)
        ends, depth = view.project(axes.reshape(-1, 3))
        ahead = (depth > 1e-3).view(-1, 2).all(1)
        canvas = ink.mix(canvas, UNSURE, 0.8 * ink.lines(size, ends.view(-1, 2, 2)[ahead], unit))
        canvas = _lay(canvas, seen_by(tips, view, T_frame), unit)
    return _lay(canvas, seen_by(pose_ellipsoids(poses, covariance, sigmas=sigmas), view, T_frame), 1.2 * unit)


def _lay(canvas: np.ndarray, ellipses: Ellipses, unit: float) -> np.ndarray:
    import cv2

    angle = torch.arange(_CORNERS, dtype=torch.float64) * (2 * math.pi / _CORNERS)
    around = torch.stack([angle.cos(), angle.sin()])
    corners = (ellipses.center[:, :, None] + ellipses.half_axes @ around).mT[ellipses.seen]
    # what is far outside of the image would overflow OpenCV's fixed-point numbers
    corners = [ink.fixed(c).astype(np.int32) for c in corners if float(c.abs().max()) < 1e5]
    size = canvas.shape[:2]

    def fill(fine: np.ndarray) -> None:
        for polygon in corners:
            cv2.fillPoly(fine, [polygon], 255, cv2.LINE_8, ink.SHIFT)

    def draw(fine: np.ndarray, width: float) -> None:
        for polygon in corners:
            thick = max(round(width * ink.SAMPLES), 1)
            cv2.polylines(fine, [polygon], True, 255, thick, cv2.LINE_8, ink.SHIFT)

    canvas = ink.mix(canvas, _HALO, 0.6 * ink.cover(size, lambda fine: draw(fine, 2.8 * unit)))
    canvas = ink.mix(canvas, UNSURE, 0.28 * ink.cover(size, fill))
    return ink.mix(canvas, UNSURE, ink.cover(size, lambda fine: draw(fine, unit)))


def _root(covariance: Tensor) -> Tensor:
    """The principal axes (..., K, K) of covariances, columns as long as their standard deviations, longest first."""
    variance, axes = torch.linalg.eigh(covariance)
    return (axes * variance.clamp_min(0).sqrt()[..., None, :]).flip(-1)
