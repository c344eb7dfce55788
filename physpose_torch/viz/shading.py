"""How pictures are lit: soft shadows, contact shadows, and red where surface is inside something."""

import numpy as np
import torch
from torch import Tensor

from physpose_torch.render import RenderResult, fragments, overlap_length, render
from physpose_torch.viz.scene import FAR, PlacedScene, SceneView, orthographic

__all__ = ["LIGHT", "RED", "VISIBLE", "Shadows", "draw", "shade"]

RED = torch.tensor([0.86, 0.11, 0.12])
LIGHT = torch.nn.functional.normalize(torch.tensor([-0.50, -0.55, 1.25], dtype=torch.float64), dim=0)
VISIBLE = 2e-4  # an overlap shorter than this is contact [m]
_TABLE = torch.tensor([0.925, 0.915, 0.895])
_PAPER = torch.tensor([0.985, 0.985, 0.98])
_TAPS, _SOFT = 32, 8  # of the shadow's edge: samples, and radius in pixels of the shadow map


def _index(image: Tensor, pixels: Tensor, margin: int) -> Tensor:
    """Flat index into image (H, W) of pixels (M, 2), kept `margin` away from its border."""
    x = pixels[:, 0].round().clamp(margin, image.shape[1] - 1 - margin)
    y = pixels[:, 1].round().clamp(margin, image.shape[0] - 1 - margin)
    return (y * image.shape[1] + x).long()


class Shadows:
    """Where the light reaches, and how near to the table the lowest surface above each of its points is."""

    def __init__(self, scene: PlacedScene) -> None:
        from scipy.ndimage import gaussian_filter

        right = torch.nn.functional.normalize(torch.linalg.cross(LIGHT, LIGHT.new_tensor([0.0, 1, 0])), dim=0)
        self.sun, depth = self._map(scene, right, torch.linalg.cross(right, LIGHT), 0.03, 1400.0)
        self.depth = torch.where(depth > 0, depth - FAR, torch.inf).float()
        x, y = LIGHT.new_tensor([[1.0, 0, 0], [0, 1.0, 0]])
        self.below, depth = self._map(scene, x, y, 0.10, 800.0)  # right × down points up: seen from under the table
        height = torch.where(depth > 0, depth - FAR, torch.inf).clamp(min=0)
        self.contact = torch.from_numpy(
            0.65 * gaussian_filter(torch.exp(-height / 0.005).numpy(), 3.0)
            + 0.55 * gaussian_filter(torch.exp(-height / 0.035).numpy(), 11.0)
        ).float()

    @staticmethod
    def _map(scene: PlacedScene, right: Tensor, down: Tensor, margin: float, scale: float) -> tuple[SceneView, Tensor]:
        flat = scene.vertices @ torch.stack([right, down], 1)
        view = orthographic(right, down, flat.amin(0) - margin, flat.amax(0) + margin, scale)
        return view, draw(view, scene).depth

    def lit(self, points: Tensor) -> Tensor:
        """Share of the light that reaches points (M, 3), with a soft edge, float32."""
        pixels, depth = self.sun.project(points)
        centre, depth = _index(self.depth, pixels, _SOFT), (depth - 0.004 - FAR).float()
        flat, total = self.depth.view(-1), torch.zeros(len(points))
        for k in range(_TAPS):  # Vogel disc
            radius, angle = _SOFT * ((k + 0.5) / _TAPS) ** 0.5, k * 2.39996
            shift = round(radius * np.sin(angle)) * self.depth.shape[1] + round(radius * np.cos(angle))
            total += flat[centre + shift] > depth
        return total / _TAPS

    def touch(self, points: Tensor) -> Tensor:
        """Darkness 0..1 of the contact shadow at points (M, 3) of the table."""
        return self.contact.view(-1)[_index(self.contact, self.below.project(points)[0], 0)]


def draw(view: SceneView, scene: PlacedScene) -> RenderResult:
    vertices = scene.vertices @ view.T_view_table[:3, :3].T + view.T_view_table[:3, 3]
    return render(vertices, scene.faces, view.K, view.height, view.width)


def _mix(image: Tensor, color: Tensor, alpha: Tensor | float) -> Tensor:
    alpha = alpha[..., None] if isinstance(alpha, Tensor) else alpha
    return image + alpha * (color - image)


def shade(view: SceneView, scene: PlacedScene, shadows: Shadows, rect: Tensor | None, *, side: bool) -> np.ndarray:
    """One panel (H, W, 3) in 0..1, at twice the final size in each direction."""
    from scipy.ndimage import binary_erosion

    result = draw(view, scene)
    n_objects = int(scene.owner.max()) + 1
    eye, rays = view.rays()
    depth, face = result.depth.view(-1), result.face_id.view(-1)
    seen = face >= 0
    hit, weights = face[seen], result.barycentric.view(-1, 3)[seen][..., None].float()
    points = eye + rays[seen] * depth[seen, None]
    normal = torch.nn.functional.normalize((scene.normals[hit] * weights).sum(1), dim=1)
    to_eye = -torch.nn.functional.normalize(rays[seen].float(), dim=1)
    normal = normal * torch.where((normal * to_eye).sum(1, keepdim=True) < 0, -1.0, 1.0)
    lit, to_sun = shadows.lit(points + 0.003 * normal), LIGHT.float()
    shine = (normal * torch.nn.functional.normalize(to_eye + to_sun, dim=1)).sum(1).clamp(min=0) ** 40 * lit
    # a strong light from above left, a weak one from the camera, and some from everywhere
    light = 0.47 + 0.10 * normal[:, 2] + 0.46 * (normal @ to_sun).clamp(min=0) * lit
    light += 0.20 * (normal * to_eye).sum(1) + 0.22 * (-normal[:, 2]).clamp(min=0)  # and what the table returns
    sunken = (points[:, 2] < -VISIBLE) if rect is not None else torch.zeros(len(points), dtype=torch.bool)
    color = (scene.colors[hit] * weights).sum(1)
    color = torch.where(sunken[:, None], _mix(color, RED, 0.88), color)
    light = torch.where(sunken, 0.85 + 0.20 * (normal * to_eye).sum(1), light)  # the sun does not shine down there
    color = (color * light[:, None] + 0.10 * shine[:, None]).clamp(0, 1)

    image = _PAPER.repeat(len(face), 1)
    if rect is not None and side:
        image[(eye + rays * FAR)[:, 2] < 0] = _TABLE
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
    glow = torch.where(length > VISIBLE, 0.40 + 0.45 * (1 - torch.exp(-length / 0.006)), 0.0)
    image = _mix(image, RED, glow)
    if rect is not None and side:
        line = (eye + rays * FAR)[:, 2].abs() * (view.K[0, 0] / FAR) < 1.6
        image[line] = image.new_tensor([0.28, 0.27, 0.26])
    return image.view(view.height // 2, 2, view.width // 2, 2, 3).mean((1, 3)).numpy()


def _lay_table(image: Tensor, depth: Tensor, eye: Tensor, rays: Tensor, rect: Tensor, shadows: Shadows) -> Tensor:
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
