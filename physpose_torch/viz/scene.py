"""Triangles of posed objects in the table frame, and the views that pictures show of them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "FAR",
    "PALETTE",
    "PlacedScene",
    "SceneView",
    "corner_colors",
    "corner_normals",
    "cropped",
    "orthographic",
    "place",
    "side_view",
    "surfaces_of",
    "table_frame",
    "table_rect",
]

PALETTE = ("#4c78a8", "#e0935a", "#6fae75", "#a98bc4", "#e3bf5b", "#5fb0b7", "#c98a9b", "#9a9a90")
FAR = 1e3  # an orthographic view is a perspective one from so far away [m]


class PlacedScene(NamedTuple):
    """Triangles of all objects in the table frame: z up, table at z = 0, x right and y away as the camera sees it."""

    vertices: Tensor
    faces: Tensor
    normals: Tensor  # (F, 3, 3) of each face's corners
    colors: Tensor  # (F, 3, 3)
    owner: Tensor  # (F,) object of each face


class SceneView(NamedTuple):
    T_view_table: Tensor
    K: Tensor
    height: int
    width: int

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (M, 2) and depth (M,) of points (M, 3) of the table frame."""
        p = points @ self.T_view_table[:3, :3].T + self.T_view_table[:3, 3]
        return (p @ self.K.T)[:, :2] / p[:, 2:], p[:, 2]

    def shrunk(self, factor: int) -> "SceneView":
        """The same view with so many times fewer pixels in each direction."""
        K = self.K.clone()
        K[:2, 2] += 0.5  # from pixel centres to corners, and back
        K[:2] /= factor
        K[:2, 2] -= 0.5
        return SceneView(self.T_view_table, K, self.height // factor, self.width // factor)

    def rays(self) -> tuple[Tensor, Tensor]:
        """Eye (3,) and directions (H·W, 3) with unit depth, table frame."""
        y, x = torch.meshgrid(torch.arange(self.height), torch.arange(self.width), indexing="ij")
        pixels = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3).double()
        R = self.T_view_table[:3, :3]
        return -R.T @ self.T_view_table[:3, 3], pixels @ torch.linalg.inv(self.K).T @ R


def orthographic(right: Tensor, down: Tensor, low: Tensor, high: Tensor, scale: float) -> SceneView:
    """View along right × down that shows the box low..high (2,) of the two image axes at `scale` pixels a metre."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.stack([right, down, torch.linalg.cross(right, down)])
    T[2, 3] = FAR
    width, height = ((high - low) * scale).round().long().tolist()
    f = scale * FAR
    K = torch.tensor([[f, 0, -low[0] * scale - 0.5], [0, f, -low[1] * scale - 0.5], [0, 0, 1]], dtype=torch.float64)
    return SceneView(T, K, max(height, 1), max(width, 1))


def cropped(camera: SceneView, points: Tensor, width: int) -> SceneView:
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
    return SceneView(camera.T_view_table, K, height, width)


def side_view(x: Tensor, down: Tensor, middle: float, half: float, bottom: float, top: float, width: int) -> SceneView:
    """From the side, `width` pixels for 2 · half metres; an even number of rows."""
    scale = width / (2 * half)
    top = bottom + round((top - bottom) * scale / 2) * 2 / scale
    return orthographic(x, down, x.new_tensor([middle - half, -top]), x.new_tensor([middle + half, -bottom]), scale)


def corner_normals(mesh: "trimesh.Trimesh", crease_deg: float = 50) -> np.ndarray:
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


def corner_colors(mesh: "trimesh.Trimesh", color: object, index: int) -> np.ndarray:
    """(F, 3, 3) colours: the given one, else the mesh's own (texture, vertices or faces), else from the palette."""
    from matplotlib.colors import to_rgb

    shape = (len(mesh.faces), 3, 3)
    if color is None and mesh.visual is not None and mesh.visual.defined:
        visual = mesh.visual.to_color() if mesh.visual.kind == "texture" else mesh.visual
        if visual.kind == "face":
            return np.broadcast_to(np.asarray(visual.face_colors)[:, None, :3] / 255.0, shape)
        return np.asarray(visual.vertex_colors)[mesh.faces, :3] / 255.0
    color = PALETTE[index % len(PALETTE)] if color is None else color
    return np.broadcast_to(to_rgb(color), shape)


def place(surfaces: list[tuple[Tensor, ...]], poses: Tensor) -> PlacedScene:
    """All surfaces (vertices, faces, normals, colours) at poses T_table_object."""
    columns, count = [], 0
    for k, ((vertices, faces, normals, colors), T) in enumerate(zip(surfaces, poses, strict=True)):
        R = T[:3, :3]
        owner = torch.full((len(faces),), k)
        columns.append((vertices @ R.T + T[:3, 3], faces + count, (normals @ R.T).float(), colors.float(), owner))
        count += len(vertices)
    return PlacedScene(*(torch.cat(c) for c in zip(*columns, strict=True)))


def table_frame(plane: object, poses: Tensor) -> Tensor:
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


def surfaces_of(
    meshes: "Sequence[trimesh.Trimesh]", colors: Sequence[object] | None = None
) -> list[tuple[Tensor, ...]]:
    """Vertices, faces, corner normals and corner colours of each mesh, for `place`."""
    return [
        tuple(
            torch.from_numpy(np.array(a))
            for a in (m.vertices, m.faces, corner_normals(m), corner_colors(m, colors[k] if colors else None, k))
        )
        for k, m in enumerate(meshes)
    ]


def table_rect(points: Tensor) -> Tensor:
    """Lower and upper corner (2, 2) of the table that is shown around points (V, 3) of the table frame, on its grid [m]."""
    low, high = points[:, :2].amin(0), points[:, :2].amax(0)
    return torch.stack([((low - 0.10) / 0.05).floor() * 0.05, ((high + 0.10) / 0.05).ceil() * 0.05])
