"""Contours of posed objects on the image that the poses were estimated from."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.table.picture import checked_size
from physpose_torch.table.template import Template, render_template
from physpose_torch.table.view import View
from physpose_torch.viz import ink
from physpose_torch.viz.ellipsoids import UNSURE, checked_covariance, draw_ellipsoids
from physpose_torch.viz.scene import SceneView

if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

__all__ = ["overlay_picture"]

AFTER, BEFORE = "#12c4b4", "#ff8a1f"
_PAPER, _FILL = (247, 246, 243), (221, 219, 213)


def overlay_picture(
    image: Tensor | np.ndarray | None,
    shapes: "Sequence[Body | trimesh.Trimesh]",
    poses: Tensor,
    K: Tensor,
    *,
    poses_before: Tensor | None = None,
    covariance: Tensor | None = None,
    covariance_before: Tensor | None = None,
    sigmas: float = 2.0,
    rotations: bool = False,
    labels: Sequence[str] | None = None,
    names: tuple[str, str] = ("estimated", "refined"),
    title: str | None = None,
    caption: str | None = None,
    size: tuple[int, int] | None = None,
    path: str | Path | None = None,
) -> "Image":
    """Draw the contours of posed objects into the image: blue-green, and orange for the poses before.

    A contour goes around what is seen of an object in front of the others at the same set of poses. Where the poses are
    right it lies on the object's edge in the image.

    Args:
        image: (H, W, 3) uint8, RGB; None: a plain background with the objects at ``poses``.
        shapes: N bodies, or meshes in the objects' frames [m].
        poses: T_camera_object (N, 4, 4) [m]; a row of NaN is not drawn.
        K: (3, 3) intrinsics [px], pixel centres at integers.
        poses_before: the same before refinement, to compare with.
        covariance: (N, 6, 6) of ``poses``, order [t in the camera frame [m], log rotation in the object frame [rad]]: the
            ellipsoids in which the origins lie at ``sigmas`` standard deviations, translucent.
        covariance_before: the same of ``poses_before``.
        sigmas: of the ellipsoids.
        rotations: also draw the objects' axes, and the ellipses that their tips sway in with the rotation's uncertainty.
        labels: N names to write where there is room; None: the bodies' labels. An empty sequence: none.
        names: what the legend calls the two sets of poses.
        title: over the image.
        caption: under the image.
        size: height and width [px] where there is no image; None: twice the principal point.
        path: also write the picture there (.png).

    Returns:
        The picture, RGB, as large as the image, and higher where there is a title or caption.

    Raises:
        InvalidInputError: shapes or lengths do not fit together, or poses are not rigid.
    """
    view = View(image, K, poses)
    size = checked_size(size, view)
    solids = [_Solid.of(shape, k) for k, shape in enumerate(shapes)]
    n = len(solids)
    _check_poses(view, n, "poses")
    before = None if poses_before is None else View(None, K, poses_before)
    if before is not None:
        _check_poses(before, n, "poses_before")
    if covariance_before is not None and before is None:
        raise InvalidInputError("covariance_before is given without poses_before, which it belongs to")
    if labels is None:
        labels = [solid.label for solid in solids]
    if len(labels) not in (0, n):
        raise InvalidInputError(f"{len(labels)} labels for {n} objects")

    seen = render_template(solids, view.measured, view.K, size)
    canvas = _background(seen, view.measured) if view.image is None else view.image.numpy() / 255.0
    unit = max(min(size) / 480, 0.5)  # of line widths [px]
    legend = []
    if before is not None:
        earlier = render_template(solids, before.measured, view.K, size)
        canvas = _contours(canvas, earlier, BEFORE, 0.8 * unit)
        legend.append((BEFORE, names[0]))
    canvas = _contours(canvas, seen, AFTER, unit)
    legend.append((AFTER, names[1]))

    camera = SceneView(torch.eye(4, dtype=torch.float64), view.K, *size)
    radius = torch.tensor([solid.radius for solid in solids], dtype=torch.float64) if rotations else None
    for given, of, name in ((covariance_before, before, "covariance_before"), (covariance, view, "covariance")):
        if given is None:
            continue
        drawn = of.measured.isfinite().flatten(1).all(1)
        unsure = checked_covariance(given, n, name)[drawn]
        r = None if radius is None else radius[drawn]
        canvas = draw_ellipsoids(canvas, of.measured[drawn], unsure, camera, radius=r, sigmas=sigmas, unit=unit)
        if legend[-1][0] != UNSURE:
            legend.append((UNSURE, f"{sigmas:g}σ"))

    drop = 0.0 if covariance is None and covariance_before is None else 15 * unit  # not on the ellipsoids
    notes = [(str(text), _places(seen, k, drop, unit)) for k, text in enumerate(labels) if text]
    picture = ink.framed(np.round(canvas * 255).astype(np.uint8), legend if n else [], title, caption, unit, notes)
    if path is not None:
        ink.save(picture, path, optimize=True)
    return picture


class _Solid:
    """What is drawn of an object, in the shape that `render_template` knows."""

    def __init__(self, mesh: "trimesh.Trimesh", appearance: "trimesh.Trimesh | None", label: str) -> None:
        self.mesh, self.appearance, self.label = mesh, appearance, label

    @classmethod
    def of(cls, shape: "Body | trimesh.Trimesh", k: int) -> "_Solid":
        if isinstance(shape, Body):
            return cls(shape.mesh, shape.appearance, shape.label)
        if not (hasattr(shape, "vertices") and hasattr(shape, "faces")):
            raise InvalidInputError(f"shapes[{k}] is a {type(shape).__name__}, expected a Body or a trimesh.Trimesh")
        return cls(shape, None, "")

    @property
    def radius(self) -> float:
        return float(np.linalg.norm(self.mesh.vertices, axis=1).max())


def _check_poses(view: View, n: int, name: str) -> None:
    shape = None if view.poses is None else tuple(view.poses.shape)
    if shape != (n, 4, 4):
        raise InvalidInputError(f"{name} has shape {shape}, expected T_camera_object ({n}, 4, 4) for {n} objects")


def _background(seen: Template, poses: Tensor) -> np.ndarray:
    """Light paper, and the objects lit from the camera in pale colours."""
    canvas = np.broadcast_to(np.array(_PAPER) / 255, (*seen.owner.shape, 3)).copy()
    hit = seen.owner >= 0
    owner = seen.owner[hit]
    normal = (poses[owner][:, :3, :3] @ seen.normal[hit][:, :, None])[:, :, 0]
    colored = seen.colored[owner].numpy()[:, None]
    color = np.where(colored, 0.5 * seen.color[hit].numpy() + 0.5 * np.array(_FILL), _FILL) / 255
    canvas[hit.numpy()] = color * (0.72 + 0.28 * normal[:, 2].abs().numpy())[:, None]
    return canvas


def _contours(canvas: np.ndarray, seen: Template, color: str, unit: float) -> np.ndarray:
    for k, alone in enumerate(seen.outlines):
        if alone is not None:
            canvas = ink.outline(canvas, (seen.owner == k).numpy(), color, unit)
    return canvas


def _places(seen: Template, k: int, drop: float, unit: float) -> list[tuple[float, float]]:
    """Where the name of an object may stand: on the middle of what is seen of it, over or under it [px]."""
    y, x = (seen.owner == k).nonzero().unbind(1)
    if len(x) < 30:
        return []
    middle, rise = float(x.double().mean()), 9 * unit
    return [
        (middle, float(y.double().mean()) + drop),
        (middle, float(y.min()) - rise),
        (middle, float(y.max()) + rise),
    ]
