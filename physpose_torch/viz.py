"""Pictures of poses before and after refinement, in which sinking, overlap and floating can be seen.

Everything is drawn by `physpose_torch.render`: no GL and no display. matplotlib (text) and pillow are imported on use.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from physpose_torch.errors import InvalidInputError
from physpose_torch.render import RenderResult, fragments, overlap_length, render

if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

__all__ = ["before_after_picture"]

_PALETTE = ("#4c78a8", "#e0935a", "#6fae75", "#a98bc4", "#e3bf5b", "#5fb0b7", "#c98a9b", "#9a9a90")
_RED = torch.tensor([0.86, 0.11, 0.12])
_TABLE = torch.tensor([0.925, 0.915, 0.895])
_PAPER = torch.tensor([0.985, 0.985, 0.98])
_LIGHT = torch.nn.functional.normalize(torch.tensor([-0.50, -0.55, 1.25], dtype=torch.float64), dim=0)
_FAR = 1e3  # an orthographic view is a perspective one from so far away [m]
_TAPS, _SOFT = 32, 8  # of the shadow's edge: samples, and radius in pixels of the shadow map
_COLUMN = 676  # width of a panel in the picture [px]
_VISIBLE = 2e-4  # an overlap shorter than this is contact [m]


class _Scene(NamedTuple):
    """Triangles of all objects in the table frame: z up, table at z = 0, x right and y away as the camera sees it."""

    vertices: Tensor
    faces: Tensor
    normals: Tensor  # (F, 3, 3) of each face's corners
    colors: Tensor  # (F, 3, 3)
    owner: Tensor  # (F,) object of each face


class _View(NamedTuple):
    T_view_table: Tensor
    K: Tensor
    height: int
    width: int

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (M, 2) and depth (M,) of points (M, 3) of the table frame."""
        p = points @ self.T_view_table[:3, :3].T + self.T_view_table[:3, 3]
        return (p @ self.K.T)[:, :2] / p[:, 2:], p[:, 2]

    def rays(self) -> tuple[Tensor, Tensor]:
        """Eye (3,) and directions (H·W, 3) with unit depth, table frame."""
        y, x = torch.meshgrid(torch.arange(self.height), torch.arange(self.width), indexing="ij")
        pixels = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3).double()
        R = self.T_view_table[:3, :3]
        return -R.T @ self.T_view_table[:3, 3], pixels @ torch.linalg.inv(self.K).T @ R


def _ortho(right: Tensor, down: Tensor, low: Tensor, high: Tensor, scale: float) -> _View:
    """View along right × down that shows the box low..high (2,) of the two image axes at `scale` pixels a metre."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.stack([right, down, torch.linalg.cross(right, down)])
    T[2, 3] = _FAR
    width, height = ((high - low) * scale).round().long().tolist()
    f = scale * _FAR
    K = torch.tensor([[f, 0, -low[0] * scale - 0.5], [0, f, -low[1] * scale - 0.5], [0, 0, 1]], dtype=torch.float64)
    return _View(T, K, max(height, 1), max(width, 1))


def _corner_normals(mesh: "trimesh.Trimesh", crease_deg: float = 50) -> np.ndarray:
    """(F, 3, 3): the mean normal of the faces around each corner that are no crease away from the corner's own."""
    faces, unit = np.asarray(mesh.faces), np.asarray(mesh.face_normals)
    area = np.asarray(mesh.area_faces)
    order = np.argsort(faces.ravel(), kind="stable")
    count = np.bincount(faces.ravel(), minlength=len(mesh.vertices))
    start = np.cumsum(count) - count
    fan = count[faces.ravel()]
    corner = np.repeat(np.arange(faces.size), fan)
    position = np.arange(len(corner)) - np.repeat(np.cumsum(fan) - fan, fan)
    other = order[start[faces.ravel()][corner] + position] // 3
    smooth = (unit[other] * unit[corner // 3]).sum(1) > np.cos(np.radians(crease_deg))
    total = np.zeros((faces.size, 3))
    weighted = unit[other] * (area[other] * smooth)[:, None]
    for axis in range(3):
        total[:, axis] = np.bincount(corner, weighted[:, axis], faces.size)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return total.reshape(-1, 3, 3)


def _corner_colors(mesh: "trimesh.Trimesh", color: object, index: int) -> np.ndarray:
    """(F, 3, 3) colours: the given one, else the mesh's own (texture, vertices or faces), else from the palette."""
    from matplotlib.colors import to_rgb

    shape = (len(mesh.faces), 3, 3)
    if color is None and mesh.visual is not None and mesh.visual.defined:
        visual = mesh.visual.to_color() if mesh.visual.kind == "texture" else mesh.visual
        if visual.kind == "face":
            return np.broadcast_to(np.asarray(visual.face_colors)[:, None, :3] / 255.0, shape)
        return np.asarray(visual.vertex_colors)[mesh.faces, :3] / 255.0
    color = _PALETTE[index % len(_PALETTE)] if color is None else color
    return np.broadcast_to(to_rgb(color), shape)


def _place(surfaces: list[tuple[Tensor, ...]], poses: Tensor) -> _Scene:
    """All surfaces (vertices, faces, normals, colours) at poses T_table_object."""
    columns, count = [], 0
    for k, ((vertices, faces, normals, colors), T) in enumerate(zip(surfaces, poses, strict=True)):
        R = T[:3, :3]
        owner = torch.full((len(faces),), k)
        columns.append((vertices @ R.T + T[:3, 3], faces + count, (normals @ R.T).float(), colors.float(), owner))
        count += len(vertices)
    return _Scene(*(torch.cat(c) for c in zip(*columns, strict=True)))


def _index(image: Tensor, pixels: Tensor, margin: int) -> Tensor:
    """Flat index into image (H, W) of pixels (M, 2), kept `margin` away from its border."""
    x = pixels[:, 0].round().clamp(margin, image.shape[1] - 1 - margin)
    y = pixels[:, 1].round().clamp(margin, image.shape[0] - 1 - margin)
    return (y * image.shape[1] + x).long()


class _Shadows:
    """Where the light reaches, and how near to the table the lowest surface above each of its points is."""

    def __init__(self, scene: _Scene) -> None:
        from scipy.ndimage import gaussian_filter

        right = torch.nn.functional.normalize(torch.linalg.cross(_LIGHT, _LIGHT.new_tensor([0.0, 1, 0])), dim=0)
        self.sun, depth = self._map(scene, right, torch.linalg.cross(right, _LIGHT), 0.03, 1400.0)
        self.depth = torch.where(depth > 0, depth - _FAR, torch.inf).float()
        x, y = _LIGHT.new_tensor([[1.0, 0, 0], [0, 1.0, 0]])
        self.below, depth = self._map(scene, x, y, 0.10, 800.0)  # right × down points up: seen from under the table
        height = torch.where(depth > 0, depth - _FAR, torch.inf).clamp(min=0)
        self.contact = torch.from_numpy(
            0.65 * gaussian_filter(torch.exp(-height / 0.005).numpy(), 3.0)
            + 0.55 * gaussian_filter(torch.exp(-height / 0.035).numpy(), 11.0)
        ).float()

    @staticmethod
    def _map(scene: _Scene, right: Tensor, down: Tensor, margin: float, scale: float) -> tuple[_View, Tensor]:
        flat = scene.vertices @ torch.stack([right, down], 1)
        view = _ortho(right, down, flat.amin(0) - margin, flat.amax(0) + margin, scale)
        return view, _draw(view, scene).depth

    def lit(self, points: Tensor) -> Tensor:
        """Share of the light that reaches points (M, 3), with a soft edge, float32."""
        pixels, depth = self.sun.project(points)
        centre, depth = _index(self.depth, pixels, _SOFT), (depth - 0.004 - _FAR).float()
        flat, total = self.depth.view(-1), torch.zeros(len(points))
        for k in range(_TAPS):  # Vogel disc
            radius, angle = _SOFT * ((k + 0.5) / _TAPS) ** 0.5, k * 2.39996
            shift = round(radius * np.sin(angle)) * self.depth.shape[1] + round(radius * np.cos(angle))
            total += flat[centre + shift] > depth
        return total / _TAPS

    def touch(self, points: Tensor) -> Tensor:
        """Darkness 0..1 of the contact shadow at points (M, 3) of the table."""
        return self.contact.view(-1)[_index(self.contact, self.below.project(points)[0], 0)]


def _draw(view: _View, scene: _Scene) -> RenderResult:
    vertices = scene.vertices @ view.T_view_table[:3, :3].T + view.T_view_table[:3, 3]
    return render(vertices, scene.faces, view.K, view.height, view.width)


def _mix(image: Tensor, color: Tensor, alpha: Tensor | float) -> Tensor:
    alpha = alpha[..., None] if isinstance(alpha, Tensor) else alpha
    return image + alpha * (color - image)


def _shade(view: _View, scene: _Scene, shadows: _Shadows, rect: Tensor | None, *, side: bool) -> np.ndarray:
    """One panel (H, W, 3) in 0..1, at twice the final size in each direction."""
    from scipy.ndimage import binary_erosion

    result = _draw(view, scene)
    n_objects = int(scene.owner.max()) + 1
    eye, rays = view.rays()
    depth, face = result.depth.view(-1), result.face_id.view(-1)
    seen = face >= 0
    hit, weights = face[seen], result.barycentric.view(-1, 3)[seen][..., None].float()
    points = eye + rays[seen] * depth[seen, None]
    normal = torch.nn.functional.normalize((scene.normals[hit] * weights).sum(1), dim=1)
    to_eye = -torch.nn.functional.normalize(rays[seen].float(), dim=1)
    normal = normal * torch.where((normal * to_eye).sum(1, keepdim=True) < 0, -1.0, 1.0)
    lit, to_sun = shadows.lit(points + 0.003 * normal), _LIGHT.float()
    shine = (normal * torch.nn.functional.normalize(to_eye + to_sun, dim=1)).sum(1).clamp(min=0) ** 40 * lit
    # a strong light from above left, a weak one from the camera, and some from everywhere
    light = 0.47 + 0.10 * normal[:, 2] + 0.46 * (normal @ to_sun).clamp(min=0) * lit
    light += 0.20 * (normal * to_eye).sum(1) + 0.22 * (-normal[:, 2]).clamp(min=0)  # and what the table returns
    sunken = (points[:, 2] < -_VISIBLE) if rect is not None else torch.zeros(len(points), dtype=torch.bool)
    color = (scene.colors[hit] * weights).sum(1)
    color = torch.where(sunken[:, None], _mix(color, _RED, 0.88), color)
    light = torch.where(sunken, 0.85 + 0.20 * (normal * to_eye).sum(1), light)  # the sun does not shine down there
    color = (color * light[:, None] + 0.10 * shine[:, None]).clamp(0, 1)

    image = _PAPER.repeat(len(face), 1)
    if rect is not None and side:
        image[(eye + rays * _FAR)[:, 2] < 0] = _TABLE
    image[seen] = color
    owner = torch.where(seen, scene.owner[face.clamp(min=0)], -1).view(view.height, view.width)
    image = image.view(view.height, view.width, 3)
    edge = torch.zeros_like(owner, dtype=torch.bool)
    edge[:, 1:] |= owner[:, 1:] != owner[:, :-1]
    edge[1:] |= owner[1:] != owner[:-1]
    image = torch.where(edge[..., None], image * 0.55, image).view(-1, 3)

    moved = scene.vertices @ view.T_view_table[:3, :3].T + view.T_view_table[:3, 3]
    K = view.K.clone()
    K[:2, 2] += K.new_tensor([0.00314, 0.00271])  # no ray exactly through an edge of an aligned box
    crossings = fragments(moved, scene.faces, K, view.height, view.width)
    if rect is not None and not side:
        image = _lay_table(image, torch.where(seen, depth, torch.inf), eye, rays, rect, shadows)
    if side:
        for k in range(n_objects):  # the outline of what stands behind something else
            mask = np.zeros(len(face), dtype=bool)
            mask[crossings.pixel[scene.owner[crossings.face_id] == k].numpy()] = True
            mask = mask.reshape(view.height, view.width)
            hidden = torch.from_numpy(mask & ~binary_erosion(mask, iterations=2)).view(-1)
            hidden &= (owner.view(-1) != k) & seen
            image = _mix(image, image.new_tensor([0.15, 0.15, 0.2]), 0.35 * hidden.float())
    length = overlap_length(crossings, scene.owner, len(face)).float()
    glow = torch.where(length > _VISIBLE, 0.40 + 0.45 * (1 - torch.exp(-length / 0.006)), 0.0)
    image = _mix(image, _RED, glow)
    if rect is not None and side:
        line = (eye + rays * _FAR)[:, 2].abs() * (view.K[0, 0] / _FAR) < 1.6
        image[line] = image.new_tensor([0.28, 0.27, 0.26])
    return image.view(view.height // 2, 2, view.width // 2, 2, 3).mean((1, 3)).numpy()


def _lay_table(image: Tensor, depth: Tensor, eye: Tensor, rays: Tensor, rect: Tensor, shadows: _Shadows) -> Tensor:
    """The table with its 5 cm grid and shadows over `image` (M, 3); what is under it shines through."""
    distance = -eye[2] / rays[:, 2]
    points = eye + distance[:, None] * rays
    on = (distance > 0) & (points[:, :2] >= rect[0]).all(1) & (points[:, :2] <= rect[1]).all(1) & (distance < depth)
    points = points[on]
    cell = points[:, :2] / 0.05
    from_line = (cell - cell.round()).abs() * 0.05
    from_rim = torch.minimum(points[:, :2] - rect[0], rect[1] - points[:, :2])
    color = _TABLE.expand(len(points), 3)
    color = color * (1 - 0.055 * (from_line < 0.0006).any(1) - 0.16 * (from_rim < 0.0012).any(1))[:, None]
    shade = (1 - 0.26 * (1 - shadows.lit(points + points.new_tensor([0, 0, 0.002])))) * (
        1 - 0.5 * shadows.touch(points)
    )
    color = color * shade[:, None]
    image[on] = torch.where(depth[on, None].isfinite(), _mix(color, image[on], 0.55), color)
    return image


def _table_frame(plane: object, poses: Tensor) -> Tensor:
    """T_table_camera: z up out of the table, x to the camera's right, y away, origin under the objects."""
    up, offset = (plane.normal, plane.offset) if hasattr(plane, "normal") else plane
    up = torch.as_tensor(up, dtype=torch.float64).detach().cpu().reshape(3)
    offset = float(offset) / float(up.norm())
    up = up / up.norm()
    right = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    if abs(up[0]) > 0.9:
        right = torch.tensor([0, 1.0, 0], dtype=torch.float64)
    right = torch.nn.functional.normalize(right - (right @ up) * up, dim=0)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.stack([right, torch.linalg.cross(up, right), up])
    T[:3, 3] = -T[:3, :3] @ poses[:, :3, 3].mean(0)
    T[2, 3] = -offset
    return T


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

    both = torch.stack([poses_before, poses_after]).detach().cpu().double()
    frame = _table_frame(([0.0, -1.0, 0.0], 0.0) if plane is None else plane, both[1])
    surfaces = [
        tuple(
            torch.from_numpy(np.array(a))
            for a in (m.vertices, m.faces, _corner_normals(m), _corner_colors(m, colors[k] if colors else None, k))
        )
        for k, m in enumerate(meshes)
    ]
    scenes = [_place(surfaces, frame @ poses) for poses in both]
    points = torch.cat([s.vertices for s in scenes])
    low, high = points.amin(0), points.amax(0)
    rect = None
    if plane is not None:
        rect = torch.stack([((low[:2] - 0.10) / 0.05).floor() * 0.05, ((high[:2] + 0.10) / 0.05).ceil() * 0.05])

    column, twice = _COLUMN, 2
    camera = _View(torch.linalg.inv(frame), torch.as_tensor(K).detach().cpu().double(), height, width)
    views = [(_crop(camera, points, column * twice), False)]

    x, down = low.new_tensor([[1.0, 0, 0], [0, 0, -1.0]])
    bottom = min(float(low[2]), 0.0) - 0.012 if plane is not None else float(low[2]) - 0.02
    top = float(high[2]) + 0.03
    half = max(float(high[0] - low[0]) / 2 + 0.03, (top - bottom) / 1.1)  # not too tall a panel
    views.append((_side_view(x, down, float(low[0] + high[0]) / 2, half, bottom, top, column * twice), True))
    if plane is not None:
        deepest, of = scenes[0].vertices[:, 2].min(0)
        faces = scenes[0].faces[scenes[0].owner == scenes[0].owner[(scenes[0].faces == of).any(1)][:1]]
        body = scenes[0].vertices[faces.unique(), 0]
        depth = min(max(float(-deepest), 0.004), 0.1)
        zoom = max(0.075, 3.2 * depth)  # half the width shown
        centre = float(scenes[0].vertices[of, 0] + (body.amin() + body.amax()) / 2) / 2
        views.append((_side_view(x, down, centre, zoom, -depth - 0.08 * zoom, 0.36 * zoom, column * twice), True))
    shadows = [_Shadows(s) for s in scenes]
    panels = [[_shade(v, s, sh, rect, side=side) for s, sh in zip(scenes, shadows, strict=True)] for v, side in views]
    picture = _compose(
        panels, titles, captions, [v.K[0, 0].item() / _FAR / twice if side else None for v, side in views]
    )
    if path is not None:
        picture.save(path, optimize=True)
    return picture


def _crop(camera: _View, points: Tensor, width: int) -> _View:
    """The part of the camera's image around the projected points that are in front of it, `width` pixels wide."""
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    pixels, depth = camera.project(points)
    pixels = pixels[depth > 0.05]
    low, high = torch.zeros(2, dtype=torch.float64), size
    if len(pixels):
        pad = 0.06 * size[0]
        low, high = (pixels.amin(0) - pad).clamp(min=0), torch.minimum(pixels.amax(0) + pad, size)
    if not (high - low > 8).all():
        low, high = torch.zeros(2, dtype=torch.float64), size
    scale = width / float(high[0] - low[0])
    height = 2 * round(min(max(float(high[1] - low[1]) * scale, 0.5 * width), 0.9 * width) / 2)
    low[1] = float(low[1] + high[1]) / 2 - height / scale / 2
    K = camera.K.clone()
    K[:2, 2] -= low - 0.5  # from pixel centres to corners, and back
    K[:2] *= scale
    K[:2, 2] -= 0.5
    return _View(camera.T_view_table, K, height, width)


def _side_view(x: Tensor, down: Tensor, middle: float, half: float, bottom: float, top: float, width: int) -> _View:
    """From the side, `width` pixels for 2 · half metres; an even number of rows."""
    scale = width / (2 * half)
    top = bottom + round((top - bottom) * scale / 2) * 2 / scale
    return _ortho(x, down, x.new_tensor([middle - half, -top]), x.new_tensor([middle + half, -bottom]), scale)


def _compose(panels: list, titles: tuple, captions: tuple, scales: list[float | None]) -> "Image":
    """Panels [row][column] (H, W, 3) with titles, captions and a scale bar where a row has a scale [px/m]."""
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
    box(margin + 10, legend - 22, 11, 11, facecolor=tuple(_RED.tolist()), edgecolor="none")
    legend_text = "in the table or in another object" if len(panels) > 2 else "in another object"
    text(margin + 27, legend - 16.5, legend_text, ha="left", va="center", size=9.5)
    canvas = np.round(canvas * 127) / 127  # seven bits look the same and make a far smaller file
    figure.figimage(canvas, 0, 0, origin="upper", zorder=-1)
    agg.draw()
    return Image.fromarray(np.asarray(agg.buffer_rgba())[..., :3].copy())
