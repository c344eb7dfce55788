"""RGB-D templates: what the objects look like at given poses, with depth, colours, and the surface point of every pixel.

Source: paper, Sec. 3.2, "RGBD template". Boundaries are left out where they are used, because half a pixel there is a
different surface.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from physpose_torch import se3
from physpose_torch.geometry.body import Body
from physpose_torch.render import render

__all__ = ["Template", "eroded", "grown", "render_template"]

MARGIN = 2
"""Pixels around an object's bounds in its crop."""


class _Surface(NamedTuple):
    """What is drawn of a body."""

    vertices: Tensor  # (V, 3) [m]
    faces: Tensor  # (F, 3)
    normals: Tensor  # (F, 3)
    colors: Tensor | None  # (F, 3, 3) of the faces' corners, 0 to 255; or None
    uv: Tensor | None  # (V, 2)
    texture: Tensor | None  # (3, h, w), 0 to 255


class Template(NamedTuple):
    """Objects at poses, as one camera sees them. Of pixels that show none, only ``owner`` tells."""

    owner: Tensor
    """(H, W) which object is seen; -1: none."""
    depth: Tensor
    """(H, W) z in the camera frame [m]; 0: none."""
    point: Tensor
    """(H, W, 3) the surface point, in the object's own frame [m]."""
    normal: Tensor
    """(H, W, 3) normal of the face there, in the object's own frame."""
    color: Tensor
    """(H, W, 3) uint8; grey where the object has no colours."""
    colored: Tensor
    """(N,) bool: which objects have colours."""
    outlines: tuple[Tensor | None, ...]
    """(H, W) bool of each object by itself, as if no other were there; None where it is out of sight."""


@lru_cache(maxsize=64)
def _surface(body: Body) -> _Surface:
    mesh = body.mesh if body.appearance is None else body.appearance
    vertices = torch.tensor(np.asarray(mesh.vertices), dtype=torch.float64)
    faces = torch.tensor(np.asarray(mesh.faces), dtype=torch.int64)
    a, b, c = vertices[faces].unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    colors = uv = texture = None
    if body.appearance is not None:
        visual = mesh.visual
        if visual.kind == "texture":
            material = visual.material
            image = getattr(material, "baseColorTexture", None) or material.image
            texture = torch.from_numpy(np.array(image.convert("RGB"))).permute(2, 0, 1).float()
            uv = torch.tensor(np.asarray(visual.uv), dtype=torch.float64)
        elif visual.kind == "face":
            colors = torch.tensor(np.asarray(visual.face_colors)[:, None, :3].repeat(3, 1), dtype=torch.float64)
        else:
            colors = torch.tensor(np.asarray(visual.vertex_colors)[:, :3], dtype=torch.float64)[faces]
    return _Surface(vertices, faces, normals, colors, uv, texture)


def render_template(bodies: Sequence[Body], poses: Tensor, K: Tensor, size: tuple[int, int]) -> Template:
    """Draw objects at poses (N, 4, 4) T_camera_object [m] into an image of (height, width); NaN poses are not drawn."""
    owner = torch.full(size, -1)
    depth = torch.full(size, torch.inf, dtype=torch.float64)
    point, normal = (torch.zeros(*size, 3, dtype=torch.float64) for _ in range(2))
    color = torch.full((*size, 3), 128, dtype=torch.uint8)
    outlines: list[Tensor | None] = []
    for k, (body, T) in enumerate(zip(bodies, poses, strict=True)):
        surface = _surface(body)
        seen = se3.apply(T, surface.vertices)
        box = _bounds(seen, K, size)
        if box is None:
            outlines.append(None)
            continue
        x0, y0, x1, y1 = box
        shifted = K.clone()
        shifted[:2, 2] -= torch.tensor([x0, y0], dtype=K.dtype)
        drawn = render(seen, surface.faces, shifted, y1 - y0, x1 - x0)
        hit = drawn.face_id >= 0
        alone = torch.zeros(size, dtype=torch.bool)
        alone[y0:y1, x0:x1] = hit
        outlines.append(alone if bool(hit.any()) else None)
        nearer = hit & (drawn.depth < depth[y0:y1, x0:x1])
        face, weight = drawn.face_id[nearer], drawn.barycentric[nearer]
        for image, value in (
            (owner, k),
            (depth, drawn.depth[nearer]),
            (point, (surface.vertices[surface.faces[face]] * weight[..., None]).sum(1)),
            (normal, surface.normals[face]),
        ):
            image[y0:y1, x0:x1][nearer] = value
        if body.appearance is not None:
            color[y0:y1, x0:x1][nearer] = _colors(surface, face, weight)
    colored = torch.tensor([body.appearance is not None for body in bodies], dtype=torch.bool)
    return Template(owner, torch.where(depth.isfinite(), depth, 0.0), point, normal, color, colored, tuple(outlines))


def _bounds(seen: Tensor, K: Tensor, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """The part of the image that points (V, 3) in the camera frame lie in; None if it is empty or behind the camera."""
    if not bool(seen.isfinite().all()) or float(seen[:, 2].min()) <= 1e-3:
        return None
    pixels = (seen @ K.mT)[:, :2] / seen[:, 2:]
    low, high = (pixels.amin(0) - MARGIN).floor(), (pixels.amax(0) + MARGIN).ceil()
    x0, y0 = low.clamp_min(0).long().tolist()
    x1, y1 = torch.minimum(high + 1, high.new_tensor([size[1], size[0]])).long().tolist()
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else None


def _colors(surface: _Surface, face: Tensor, weight: Tensor) -> Tensor:
    if surface.texture is not None:
        u, v = (surface.uv[surface.faces[face]] * weight[..., None]).sum(1).unbind(1)
        # textures repeat, and v goes up
        grid = torch.stack([2 * (u % 1.0) - 1, 1 - 2 * (v % 1.0)], -1).float()
        value = grid_sample(surface.texture[None], grid[None, None], align_corners=False, padding_mode="border")
        value = value[0, :, 0].mT
    else:
        value = (surface.colors[face] * weight[..., None]).sum(1)
    return value.round().clamp(0, 255).to(torch.uint8)


def grown(mask: Tensor, radius: int) -> Tensor:
    """A mask (H, W) with all that is within a radius [px]."""
    return _morphed(mask, radius, cv2.dilate)


def eroded(mask: Tensor, radius: int) -> Tensor:
    """A mask (H, W) without what is within a radius [px] of its border; that of the image does not count."""
    return _morphed(mask, radius, cv2.erode)


def _morphed(mask: Tensor, radius: int, how) -> Tensor:
    if radius <= 0:
        return mask
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return torch.from_numpy(how(mask.to(torch.uint8).numpy(), disc) > 0)
