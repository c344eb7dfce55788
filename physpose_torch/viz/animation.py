"""A refinement as a moving picture: through the camera and from the side, with how deep and how high at each step."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from physpose_torch.errors import InvalidInputError
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene
from physpose_torch.viz import ink
from physpose_torch.viz.scene import SceneView, cropped, place, side_view, surfaces_of, table_frame, table_rect
from physpose_torch.viz.shading import RED, Shadows, shade

if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

__all__ = ["Animation", "trajectory_animation"]

_INK, _PALE, _BLUE = "#33332f", "#c9c7c0", "#4c78a8"
_HEAD, _MARGIN, _GAP, _FOOT = 30, 12, 10, 66  # above, around and between the panels, and below them [px]


@dataclass(frozen=True, eq=False)
class Animation:
    """A moving picture."""

    frames: "list[Image]"
    """RGB, all of one size."""
    milliseconds: list[int]
    """How long each is shown."""
    steps: list[int]
    """The step of the refinement that each shows."""
    penetration: Tensor
    """(frames,) the largest of all objects [m]."""
    gap: Tensor
    """(frames,) the largest that is known [m]; 0 without gravity."""

    def save(self, path: str | Path) -> None:
        """Write a GIF that repeats without end."""
        first, *rest = self._quantised()
        moving = {"save_all": True, "append_images": rest, "duration": self.milliseconds, "loop": 0, "disposal": 1}
        ink.save(first, path, optimize=False, **moving)

    def _quantised(self) -> "list[Image]":
        """One palette for all frames: what stands still keeps its colour, and costs nothing."""
        from PIL import Image

        some = np.stack([np.asarray(frame) for frame in self.frames[:: max(len(self.frames) // 4, 1)]])
        colors, count = np.unique(some.reshape(-1, 3) & 0xFC, axis=0, return_counts=True)  # six bits a channel
        # the wide backgrounds must not take all the palette, nor a rare colour as much as they
        colors = np.repeat(colors + 2, np.ceil(np.sqrt(count)).astype(int), axis=0)
        palette = Image.fromarray(colors[None]).quantize(256, Image.Quantize.MEDIANCUT, kmeans=4)
        return [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in self.frames]


def trajectory_animation(
    trajectory: Tensor,
    scene: Scene,
    *,
    K: Tensor,
    height: int,
    width: int,
    image: int = 0,
    meshes: "Sequence[trimesh.Trimesh] | None" = None,
    colors: Sequence[object] | None = None,
    frames: int = 24,
    column: int = 400,
    milliseconds: int = 90,
    pause: int = 2000,
    title: str = "refinement",
    path: str | Path | None = None,
) -> Animation:
    """The refinement of one image: camera on the left, side view on the right, numbers and their course below.

    Red is what cannot be, as in :func:`~physpose_torch.viz.before_after_picture`. The first frame is shown for half of
    ``pause`` and the last one for all of it; then it begins again. Frames are spread over the steps so that about as much
    moves between any two of them.

    Args:
        trajectory: T_camera_object (T + 1, N, 4, 4) [m]: `Refinement.trajectory`, kept by
            ``RefinerConfig(keep_trajectory=True)``; of one hypothesis.
        scene: the scene that was refined.
        K: intrinsics (3, 3) [px], pixel centres at integers.
        height: of the camera's image [px].
        width: of the camera's image [px].
        image: which of the scene's images.
        meshes: one an object of that image, object frame [m]; None: the bodies' own, with their colours.
        colors: one matplotlib colour an object; None: the meshes' own, else a palette.
        frames: how many, at most.
        column: width of each of the two panels [px].
        milliseconds: that a frame is shown.
        pause: that the last one is shown [ms].
        title: over the panels.
        path: also write the animation there (.gif).

    Returns:
        The frames and what they show.

    Raises:
        InvalidInputError: there is no trajectory, it has hypotheses, or shapes and lengths do not fit together.
    """
    trajectory, scene = _checked(trajectory, scene, image, frames, column)
    chosen = _spread(trajectory, frames)
    poses = trajectory[chosen]
    if meshes is None:
        meshes = [body.mesh if body.appearance is None else body.appearance for body in scene.objects]
    for name, given in (("meshes", meshes), ("colors", colors)):
        if given is not None and len(given) != len(scene):
            raise InvalidInputError(f"{len(given)} {name} for {len(scene)} objects")
    report = physics_report(poses, scene)
    penetration = report.penetration.amax(1)
    gap = torch.where(report.gap.isfinite(), report.gap, 0.0).amax(1)

    plane = scene.planes[0].shape if scene.planes else None
    frame = table_frame(([0.0, -1.0, 0.0], 0.0) if plane is None else plane, poses[-1])
    surfaces = surfaces_of(meshes, colors)
    placed = [place(surfaces, frame @ T) for T in poses]
    points = torch.cat([s.vertices for s in placed])
    rect = None if plane is None else table_rect(points)
    camera = SceneView(torch.linalg.inv(frame), torch.as_tensor(K).detach().cpu().double(), height, width)
    views = [(cropped(camera, points, 2 * column), False)]
    views.append((_beside(points, 2 * column, views[0][0].height, plane is not None), True))
    panels = []
    for s in placed:
        shadows = Shadows(s)
        panels.append([shade(view, s, shadows, rect, side=side) for view, side in views])

    pictures = _compose(panels, chosen, len(trajectory) - 1, penetration, gap, title, falls=bool(scene.gravity.any()))
    shown = [milliseconds] * len(pictures)
    shown[0], shown[-1] = max(pause // 2, milliseconds), pause
    animation = Animation(pictures, shown, chosen, penetration, gap)
    if path is not None:
        animation.save(path)
    return animation


def _checked(trajectory: Tensor, scene: Scene, image: int, frames: int, column: int) -> tuple[Tensor, Scene]:
    """The trajectory (T + 1, M, 4, 4), float64 on the CPU, and the scene of one image."""
    if trajectory is None:
        raise InvalidInputError("there is no trajectory; refine with RefinerConfig(keep_trajectory=True)")
    if trajectory.ndim == 5:
        raise InvalidInputError(
            f"trajectory has shape {tuple(trajectory.shape)} with {trajectory.shape[1]} hypotheses; choose one, "
            "trajectory[:, k]"
        )
    if trajectory.ndim != 4 or trajectory.shape[1:] != (len(scene), 4, 4) or len(trajectory) < 1:
        raise InvalidInputError(
            f"trajectory has shape {tuple(trajectory.shape)}, expected (T + 1, {len(scene)}, 4, 4) as the scene"
        )
    if not 0 <= image < scene.n_images:
        raise InvalidInputError(f"image = {image}, but the scene has {scene.n_images} images")
    if frames < 2 or column < 32:
        raise InvalidInputError(f"frames = {frames}, column = {column}: expected at least 2 frames of 32 px")
    part, rows = scene.select(torch.tensor([image]))
    if len(part) == 0:
        raise InvalidInputError(f"image {image} of the scene is empty; there is nothing to show")
    return trajectory.detach().to("cpu", torch.float64)[:, rows], part


def _spread(trajectory: Tensor, frames: int) -> list[int]:
    """Steps to show, first and last among them: half by time, half by how far the fastest object has moved."""
    last = len(trajectory) - 1
    if last < frames:
        return list(range(last + 1))
    moved = trajectory[:, :, :3, 3].diff(dim=0).norm(dim=-1).amax(1).cumsum(0)
    way = torch.cat([moved.new_zeros(1), moved])
    time = torch.linspace(0, 1, last + 1, dtype=way.dtype)
    clock = time if float(way[-1]) == 0 else 0.5 * time + 0.5 * way / way[-1]
    wanted = torch.linspace(0, 1, frames, dtype=way.dtype)
    return sorted(set(torch.searchsorted(clock, wanted).clamp(0, last).tolist()) | {0, last})


def _beside(points: Tensor, width: int, height: int, table: bool) -> SceneView:
    """The view from the side at table level that shows all points, in a panel of given size."""
    low, high = points.amin(0), points.amax(0)
    bottom = min(float(low[2]), 0.0) - 0.012 if table else float(low[2]) - 0.02
    top = float(high[2]) + 0.03
    half = max(float(high[0] - low[0]) / 2 + 0.03, (top - bottom) / 2 * width / height)
    spare = 2 * half * height / width - (top - bottom)  # more of the air than of what is under the table
    x, down = low.new_tensor([[1.0, 0, 0], [0, 0, -1.0]])
    middle = float(low[0] + high[0]) / 2
    view = side_view(x, down, middle, half, bottom - 0.3 * spare, top + 0.7 * spare, width)
    return view._replace(height=height)


def _compose(
    panels: list, steps: list[int], last: int, penetration: Tensor, gap: Tensor, title: str, *, falls: bool
) -> "list[Image]":
    """Frames of two panels (H, W, 3) each, with their numbers and the course of these."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle
    from PIL import Image

    h, w = panels[0][0].shape[:2]
    total_w, total_h = 2 * _MARGIN + 2 * w + _GAP, _HEAD + h + _FOOT
    figure = Figure(figsize=(total_w / 100, total_h / 100), dpi=100, facecolor="white")
    agg = FigureCanvasAgg(figure)

    def text(x: float, y: float, value: str, **style: object) -> object:
        return figure.text(x / total_w, 1 - y / total_h, value, **{"color": _INK, "va": "center", **style})

    text(_MARGIN, _HEAD / 2, title, size=11, weight="bold")
    lefts = (_MARGIN, _MARGIN + w + _GAP)
    for left in lefts:
        corner = ((left - 0.5) / total_w, 1 - (_HEAD + h + 0.5) / total_h)
        figure.add_artist(
            Rectangle(
                corner, w / total_w, h / total_h, transform=figure.transFigure, fill=False, edgecolor=_PALE, lw=0.8
            )
        )
    for left, label in zip(lefts, ("seen by the camera", "from the side, at table level"), strict=True):
        text(left + 8, _HEAD + 11, label, size=8, color="#6b6962")

    red = tuple(RED.tolist())
    curves = [("largest penetration", 1e3 * penetration.numpy(), red)]
    if falls:
        curves.append(("largest gap", 1e3 * gap.numpy(), _BLUE))
    top = _HEAD + h
    step_text = text(total_w - _MARGIN, _HEAD / 2, "", size=10, ha="right")
    values = []
    for k, (name, _, color) in enumerate(curves):
        y = top + 22 + 24 * k
        text(_MARGIN, y, name, size=9.5, color=color)
        values.append(text(_MARGIN + 0.57 * w, y, "", size=11, ha="right", weight="bold", color=color))
    left, bottom, tall = _MARGIN + 0.62 * w, 14, _FOOT - 24
    axes = figure.add_axes((left / total_w, bottom / total_h, (total_w - _MARGIN - left) / total_w, tall / total_h))
    most = max(max(float(c.max()) for _, c, _ in curves), 1e-3)
    axes.set(xlim=(-0.01 * max(last, 1), 1.01 * max(last, 1)), ylim=(-0.08 * most, 1.15 * most))
    axes.axis("off")
    axes.axhline(0, color=_PALE, lw=0.8)
    dots = []
    for _, values_mm, color in curves:
        axes.plot(steps, values_mm, color=color, lw=1.3)
        dots.append(axes.plot([steps[0]], [values_mm[0]], "o", color=color, ms=5, clip_on=False)[0])

    frames = []
    for i, row in enumerate(panels):
        step_text.set_text(f"step {steps[i]} of {last}")
        for (_, values_mm, _), value, dot in zip(curves, values, dots, strict=True):
            value.set_text(f"{values_mm[i]:.1f} mm")
            dot.set_data([steps[i]], [values_mm[i]])
        agg.draw()
        sheet = np.asarray(agg.buffer_rgba())[..., :3].copy()
        for left, panel in zip(lefts, row, strict=True):
            below = sheet[_HEAD : _HEAD + h, left : left + w]
            ink = below < 250  # the labels of the panels
            below[:] = np.where(ink.any(2, keepdims=True), below, np.round(panel * 255).astype(np.uint8))
        frames.append(Image.fromarray(sheet))
    return frames
