"""Poses before and after refinement, in which sinking, overlap and floating can be seen."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from physpose_torch.errors import InvalidInputError
from physpose_torch.viz import ink
from physpose_torch.viz.ellipsoids import UNSURE, checked_covariance, draw_ellipsoids
from physpose_torch.viz.scene import FAR, SceneView, cropped, place, side_view, surfaces_of, table_frame, table_rect
from physpose_torch.viz.shading import RED, Shadows, shade

if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

__all__ = ["before_after_picture"]

_COLUMN = 676  # width of a panel in the picture [px]


def before_after_picture(
    meshes: "Sequence[trimesh.Trimesh]",
    poses_before: Tensor,
    poses_after: Tensor,
    *,
    plane: object = None,
    K: Tensor,
    height: int,
    width: int,
    colors: Sequence[object] | None = None,
    titles: tuple[str, str] = ("before", "after"),
    captions: tuple[str, str] = ("", ""),
    covariance_before: Tensor | None = None,
    covariance_after: Tensor | None = None,
    sigmas: float = 2.0,
    path: str | Path | None = None,
) -> "Image":
    """Two columns, before and after, 1400 px wide: through the camera, from the side at table level, and close up.

    Red is what cannot be: surface below the table (through the camera it shines through the table, from the side it
    lies below the table's line) and, seen through the objects, the space that two objects share. Shadows tell what
    floats. The close-up shows the place that is deepest under the table before, at the same scale in both columns.

    Args:
        meshes: one an object, watertight where overlap is to be shown, in the object's frame [m].
        poses_before: T_camera_object, (N, 4, 4) [m].
        poses_after: the same for the right column.
        plane: the table in the camera frame: anything with `normal` and `offset`, or the pair (normal, offset [m]);
            None: no table, the camera's y axis points down.
        K: intrinsics (3, 3) [px], pixel centres at integers.
        height: of the camera's image [px].
        width: of the camera's image [px].
        colors: one matplotlib colour an object; None: the meshes' own, else a palette.
        titles: over the two columns.
        captions: under the two columns, e.g. `"deepest penetration 12.3 mm"`.
        covariance_before: (N, 6, 6) of ``poses_before``, order [t in the camera frame [m], log rotation in the object frame
            [rad]]: the ellipsoids in which the origins lie at ``sigmas`` standard deviations, translucent.
        covariance_after: the same of ``poses_after``.
        sigmas: of the ellipsoids.
        path: also write the picture there (.png).

    Returns:
        The picture, RGB.

    Raises:
        InvalidInputError: shapes or lengths do not fit together.
    """
    n = len(meshes)
    for name, poses in (("poses_before", poses_before), ("poses_after", poses_after)):
        if poses.shape != (n, 4, 4) or n == 0:
            raise InvalidInputError(f"{name} has shape {tuple(poses.shape)}, expected ({n}, 4, 4) for {n} > 0 meshes")
    if colors is not None and len(colors) != n:
        raise InvalidInputError(f"{len(colors)} colors for {n} meshes")

    unsure = (covariance_before, covariance_after)
    both = torch.stack([poses_before, poses_after]).detach().cpu().double()
    frame = table_frame(([0.0, -1.0, 0.0], 0.0) if plane is None else plane, both[1])
    surfaces = surfaces_of(meshes, colors)
    scenes = [place(surfaces, frame @ poses) for poses in both]
    points = torch.cat([s.vertices for s in scenes])
    low, high = points.amin(0), points.amax(0)
    rect = None if plane is None else table_rect(points)

    column, twice = _COLUMN, 2
    camera = SceneView(torch.linalg.inv(frame), torch.as_tensor(K).detach().cpu().double(), height, width)
    views = [(cropped(camera, points, column * twice), False)]

    x, down = low.new_tensor([[1.0, 0, 0], [0, 0, -1.0]])
    bottom = min(float(low[2]), 0.0) - 0.012 if plane is not None else float(low[2]) - 0.02
    top = float(high[2]) + 0.03
    half = max(float(high[0] - low[0]) / 2 + 0.03, (top - bottom) / 1.1)  # not too tall a panel
    views.append((side_view(x, down, float(low[0] + high[0]) / 2, half, bottom, top, column * twice), True))
    if plane is not None:
        deepest, of = scenes[0].vertices[:, 2].min(0)
        faces = scenes[0].faces[scenes[0].owner == scenes[0].owner[(scenes[0].faces == of).any(1)][:1]]
        body = scenes[0].vertices[faces.unique(), 0]
        depth = min(max(float(-deepest), 0.004), 0.1)
        zoom = max(0.075, 3.2 * depth)  # half the width shown
        centre = float(scenes[0].vertices[of, 0] + (body.amin() + body.amax()) / 2) / 2
        views.append((side_view(x, down, centre, zoom, -depth - 0.08 * zoom, 0.36 * zoom, column * twice), True))
    shadows = [Shadows(s) for s in scenes]
    panels = [[shade(v, s, sh, rect, side=side) for s, sh in zip(scenes, shadows, strict=True)] for v, side in views]
    for c, (covariance, name) in enumerate(zip(unsure, ("covariance_before", "covariance_after"), strict=True)):
        if covariance is not None:
            covariance = checked_covariance(covariance, n, name)
            for row, (view, _) in zip(panels, views, strict=True):
                small = view.shrunk(twice)
                row[c] = draw_ellipsoids(row[c], both[c], covariance, small, T_frame=frame, sigmas=sigmas)
    scales = [v.K[0, 0].item() / FAR / twice if side else None for v, side in views]
    note = f"{sigmas:g}σ of the origins" if any(c is not None for c in unsure) else None
    picture = _compose(panels, titles, captions, scales, note)
    if path is not None:
        ink.save(picture, path, optimize=True)
    return picture


def _compose(panels: list, titles: tuple, captions: tuple, scales: list[float | None], note: str | None) -> "Image":
    """Panels [row][column] (H, W, 3) with titles, captions, a scale bar where a row has a scale [px/m], and a legend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke
    from PIL import Image

    labels = ("seen by the camera", "from the side, at table level", "close-up at table level")
    margin, gap, head, foot = 18, 12, 46, 44 if any(captions) else 10
    column = panels[0][0].shape[1]
    total_w = 2 * margin + 2 * column + gap
    total_h = head + sum(row[0].shape[0] for row in panels) + gap * (len(panels) - 1) + foot
    canvas = np.ones((total_h, total_w, 3))
    figure = Figure(figsize=(total_w / 100, total_h / 100), dpi=100, facecolor="white")
    agg = FigureCanvasAgg(figure)
    ink = "#33332f"

    def text(x: float, y: float, value: str, **style: object) -> None:
        written = figure.text(x / total_w, 1 - y / total_h, value, color=style.pop("color", ink), **style)
        written.set_path_effects([withStroke(linewidth=2.5, foreground="white", alpha=0.75)])

    def box(x: float, y: float, w: float, h: float, **style: object) -> None:
        corner = (x / total_w, 1 - (y + h) / total_h)
        figure.add_artist(Rectangle(corner, w / total_w, h / total_h, transform=figure.transFigure, **style))

    for c in range(2):
        left, y = margin + c * (column + gap), head
        text(left + column / 2, head / 2, titles[c], ha="center", va="center", size=15, weight="bold")
        for row, label, scale in zip(panels, labels, scales, strict=False):
            h = row[c].shape[0]
            canvas[y : y + h, left : left + column] = row[c]
            box(left - 0.5, y - 0.5, column, h, fill=False, edgecolor="#c9c7c0", linewidth=0.8)
            text(left + 10, y + 9, label, ha="left", va="top", size=9.5, color="#6b6962")
            if scale is not None:
                unit = 0.05 if scale * 0.05 < column / 4 else 0.01
                x, bar = left + column - 14 - unit * scale, y + (24 if row is panels[1] else h - 14)
                box(x, bar, unit * scale, 2.5, color=ink, linewidth=0)
                text(x + unit * scale / 2, bar - 4, f"{unit * 100:.0f} cm", ha="center", va="bottom", size=8.5)
            y += h + gap
        text(left + column / 2, total_h - foot / 2 - 2, captions[c], ha="center", va="center", size=12.5)
    legend = head + panels[0][0].shape[0]
    box(margin + 10, legend - 22, 11, 11, facecolor=tuple(RED.tolist()), edgecolor="none")
    legend_text = "in the table or in another object" if len(panels) > 2 else "in another object"
    text(margin + 27, legend - 16.5, legend_text, ha="left", va="center", size=9.5)
    if note is not None:
        box(margin + 10, legend - 40, 11, 11, facecolor=UNSURE, edgecolor="none")
        text(margin + 27, legend - 34.5, note, ha="left", va="center", size=9.5)
    canvas = np.round(canvas * 127) / 127  # seven bits look the same and make a far smaller file
    figure.figimage(canvas, 0, 0, origin="upper", zorder=-1)
    agg.draw()
    return Image.fromarray(np.asarray(agg.buffer_rgba())[..., :3].copy())
