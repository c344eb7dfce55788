"""The estimated table, drawn into the image it was estimated from: one sees at once whether it lies where the table is.

Everything is computed from the camera model and `render_template`: no GL and no display. matplotlib (text) and pillow are
imported on use.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.table.grid import MARGIN, NEAR, Grid, grid_lines, plane_depth, table_grid
from physpose_torch.table.template import Template, render_template
from physpose_torch.table.view import SMALLEST, View, pixel_rays, project
from physpose_torch.viz import ink

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["checked_size", "table_picture"]

FINEST = (3.0, 8.0)
"""Where a cell is less high than this in the image [px], the lines are invisible; where it is more than that, clear."""
BRIGHT = 0.60
"""Lines are dark where the table is brighter than this on average (0 to 1), white elsewhere."""
TOUCHES = 0.006
"""A contact that lies deeper than this behind the surface seen there [m] is hidden."""

_STANDING, _OTHER, _CONTACT = "#12c4b4", "#ff8a1f", "#ffd83d"
_LIGHT, _PAPER, _FILL = "#ffffff", "#f7f6f3", "#dddbd5"


def table_picture(
    image: Tensor | np.ndarray | None,
    K: Tensor,
    plane: Plane,
    *,
    bodies: Sequence[Body] = (),
    poses: Tensor | None = None,
    standing: Tensor | None = None,
    contacts: Tensor | None = None,
    title: str | None = None,
    caption: str | None = None,
    size: tuple[int, int] | None = None,
    path: str | Path | None = None,
) -> "Image":
    """Draw a table as a metric grid into the image, with the objects' outlines and the points where they touch it.

    The grid is centred under the objects, fades out around them, and is hidden by what is in front of it; it covers what
    is under the table. Outlines are blue-green; orange where the object does not stand on the table. Contacts are dots;
    rings where an object hides them. An arrow shows the normal. Same arguments, same picture.

    Args:
        image: (H, W, 3) uint8, RGB; None: a plain background with the objects' shapes.
        K: (3, 3) intrinsics [px], pixel centres at integers.
        plane: the table, camera frame [m].
        bodies: N objects.
        poses: T_camera_object (N, 4, 4) [m]; a row of NaN is not drawn.
        standing: (N,) bool: which objects stand on the table; None: no distinction.
        contacts: (C, 3) where objects touch the table, camera frame [m].
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
    standing, contacts = _check(plane, bodies, view, standing, contacts)
    K, poses = view.K, view.measured
    if poses is None:
        poses = torch.zeros(0, 4, 4, dtype=torch.float64)
    seen = render_template(bodies, poses, K, size)
    surfaces = [
        se3.apply(T, torch.tensor(np.asarray(body.mesh.vertices)))
        for body, T, outline in zip(bodies, poses, seen.outlines, strict=True)
        if outline is not None
    ]
    grid = table_grid(plane, torch.cat(surfaces) if surfaces else torch.zeros(0, 3, dtype=torch.float64), K, size)

    if view.image is None:
        canvas = np.where((seen.owner >= 0).numpy()[..., None], ink.rgb(_FILL), ink.rgb(_PAPER))
    else:
        canvas = view.image.numpy() / 255.0
    unit = max(min(size) / 480, 0.5)  # of line widths [px]
    if grid is not None:
        shown = _shown(grid, plane, K, seen)
        canvas = _lay_grid(canvas, grid, K, shown, unit)
    order = sorted(range(len(bodies)), key=lambda k: standing is not None and not bool(standing[k]))
    for k in order:  # those that do not stand come last, for theirs are the outlines to be noticed
        color = _STANDING if standing is None or bool(standing[k]) else _OTHER
        canvas = ink.outline(canvas, (seen.owner == k).numpy(), color, unit)
    if grid is not None:
        canvas = _arrow(canvas, grid, K, shown, unit)
    canvas = _dots(canvas, contacts, K, seen, unit)

    legend = [] if grid is None else [(None, f"{100 * grid.cell:.0f} cm grid")]
    drawn = [k for k, outline in enumerate(seen.outlines) if outline is not None]
    if standing is not None and drawn:
        colors = {True: (_STANDING, "on the table"), False: (_OTHER, "not on it")}
        legend += [colors[value] for value in (True, False) if any(bool(standing[k]) == value for k in drawn)]
    picture = ink.framed(np.round(canvas * 255).astype(np.uint8), legend, title, caption, unit)
    if path is not None:
        ink.save(picture, path, optimize=True)
    return picture


def checked_size(size: tuple[int, int] | None, view: View) -> tuple[int, int]:
    """Height and width of a picture [px]: the image's, or what was asked for where there is no image.

    Raises:
        InvalidInputError: it is not the image's size, or too small to show anything.
    """
    if size is None:
        size = view.size
    elif view.image is not None and tuple(size) != view.size:
        raise InvalidInputError(
            f"size = {tuple(size)}, but the image is {view.size}; leave size out, it is for image=None"
        )
    if len(size) != 2 or min(size) < SMALLEST:
        raise InvalidInputError(f"size = {tuple(size)}, expected (height, width) of at least {SMALLEST} px")
    return int(size[0]), int(size[1])


def _check(
    plane: Plane, bodies: Sequence[Body], view: View, standing: Tensor | None, contacts: Tensor | None
) -> tuple[Tensor | None, Tensor]:
    n = len(bodies)
    if not isinstance(plane, Plane):
        raise InvalidInputError(f"plane is a {type(plane).__name__}, expected a Plane in the camera frame [m]")
    shape = None if view.poses is None else tuple(view.poses.shape)
    if shape != (n, 4, 4) and (n or shape):
        given = "is None" if shape is None else f"has shape {shape}"
        raise InvalidInputError(f"poses {given}, expected T_camera_object ({n}, 4, 4) for {n} bodies")
    if standing is not None:
        standing = torch.as_tensor(standing).detach().cpu()
        if standing.shape != (n,) or standing.dtype != torch.bool:
            raise InvalidInputError(
                f"standing is {standing.dtype} of shape {tuple(standing.shape)}, expected torch.bool ({n},), one an object"
            )
    if contacts is None:
        return standing, torch.zeros(0, 3, dtype=torch.float64)
    contacts = torch.as_tensor(contacts).detach().to("cpu", torch.float64)
    if contacts.ndim != 2 or contacts.shape[1] != 3 or not bool(contacts.isfinite().all()):
        raise InvalidInputError(
            f"contacts has shape {tuple(contacts.shape)}, expected finite points (C, 3) in the camera frame [m]"
        )
    return standing, contacts


def _shown(grid: Grid, plane: Plane, K: Tensor, seen: Template) -> np.ndarray:
    """(H, W) from 1 at the objects to 0 where the grid ends, is too fine to be seen, or is behind an object."""
    depth = plane_depth(plane, K, tuple(seen.owner.shape))
    hit = depth.isfinite()
    y, x = hit.nonzero().unbind(1)
    z = depth[hit]
    points = z[:, None] * pixel_rays(K, torch.stack([x, y], -1).double())
    spots = se3.apply(se3.inverse(grid.T_camera_grid), points)[:, :2]
    beside = torch.maximum(grid.low - spots, spots - grid.high).clamp_min(0).norm(dim=1) / (MARGIN * grid.cell)
    pixels = grid.cell * K[1, 1] * plane.offset.detach().cpu().double().abs() / z**2  # height of a cell
    clear = (1 - beside).clamp(0, 1) * ((pixels - FINEST[0]) / (FINEST[1] - FINEST[0])).clamp(0, 1)
    out = torch.zeros_like(depth)
    out[hit] = clear * clear * (3 - 2 * clear)
    covered = (seen.owner >= 0) & (seen.depth < depth)
    return out.numpy() * (1 - gaussian_filter(covered.double().numpy(), 0.5))


def _lay_grid(canvas: np.ndarray, grid: Grid, K: Tensor, shown: np.ndarray, unit: float) -> np.ndarray:
    """The lines over an image (H, W, 3)."""
    size = canvas.shape[:2]
    lines = grid_lines(grid, K, size)
    ends = project(K, lines.segments)
    weak, strong = (ink.lines(size, ends[lines.strong == s], (1.0 + 0.5 * s) * unit) for s in (0, 1))
    halo = ink.lines(size, ends[lines.strong], 3.5 * unit)
    grey, weight = canvas.mean(2), shown / max(shown.sum(), 1e-9)
    brightness = float((grey * weight).sum())
    contrast = float(((grey - brightness) ** 2 * weight).sum()) ** 0.5  # a chequered table has both dark and bright
    line, other = (ink.DARK, _LIGHT) if brightness > BRIGHT else (_LIGHT, ink.DARK)
    canvas = ink.mix(canvas, other, 0.08 * shown)
    canvas = ink.mix(canvas, other, min(0.2 + contrast, 0.6) * halo * shown)
    return ink.mix(canvas, line, np.maximum(0.5 * weak, 0.9 * strong) * shown)


def _arrow(canvas: np.ndarray, grid: Grid, K: Tensor, shown: np.ndarray, unit: float) -> np.ndarray:
    """The normal, at the crossing of lines nearest to the middle at which it can be seen."""
    size = canvas.shape[:2]
    length = float((0.2 * (grid.high - grid.low).max()).clamp(0.04, 0.15))
    first, last = (grid.low / grid.cell).ceil().long() - 2, (grid.high / grid.cell).floor().long() + 2
    nodes = torch.cartesian_prod(*(torch.arange(int(a), int(b) + 1) for a, b in zip(first, last, strict=True)))
    nodes = nodes[(nodes**2).sum(1).sort(stable=True).indices].double() * grid.cell
    foot = torch.cat([nodes, torch.zeros_like(nodes[:, :1])], 1)
    foot, tip = (se3.apply(grid.T_camera_grid, foot + foot.new_tensor([0, 0, h])) for h in (0.0, length))
    ahead = torch.minimum(foot[:, 2], tip[:, 2]) > NEAR
    foot, tip = project(K, foot[ahead]), project(K, tip[ahead])
    limit = foot.new_tensor([size[1], size[0]]) - 1
    inside = ((foot > 4) & (tip > 4) & (foot < limit - 4) & (tip < limit - 4)).all(1)
    foot, tip = foot[inside], tip[inside]
    column, row = foot.round().long().unbind(1)
    found = (torch.from_numpy(shown)[row, column] > 0.3).nonzero()[:, 0]
    if not len(found):
        return canvas
    foot, tip = foot[found[0]], tip[found[0]]
    along = tip - foot
    reach = float(along.norm())
    if reach < 4 * unit:  # seen from above: it comes towards the camera
        canvas = ink.mix(canvas, ink.DARK, ink.discs(size, foot[None], 4.5 * unit))
        return ink.mix(canvas, _LIGHT, ink.discs(size, foot[None], 3 * unit))
    along = along / reach
    across = along.flip(0) * along.new_tensor([-1.0, 1.0])
    head = min(9 * unit, 0.6 * reach)
    for color, grow in ((ink.DARK, 1.4 * unit), (_LIGHT, 0.0)):
        back, side = tip - (head + grow) * along, (0.42 * head + 1.3 * grow) * across
        corners = ink.fixed(torch.stack([tip + 1.8 * grow * along, back + side, back - side])).astype(np.int32)
        shaft = torch.stack([foot, tip - 0.8 * head * along])[None]
        cover = ink.cover(size, lambda fine, c=corners: cv2.fillPoly(fine, [c], 255, cv2.LINE_8, ink.SHIFT))
        cover = np.maximum(cover, ink.lines(size, shaft, 2.2 * unit + 2 * grow))
        canvas = ink.mix(canvas, color, np.maximum(cover, ink.discs(size, foot[None], 2.6 * unit + grow)))
    return canvas


def _dots(canvas: np.ndarray, contacts: Tensor, K: Tensor, seen: Template, unit: float) -> np.ndarray:
    """Contacts (C, 3) as dots, or rings where an object hides them."""
    size = canvas.shape[:2]
    contacts = contacts[contacts[:, 2] > NEAR]
    pixels = project(K, contacts)
    inside = ((pixels > -0.5) & (pixels < pixels.new_tensor([size[1], size[0]]) - 0.5)).all(1)
    contacts, pixels = contacts[inside], pixels[inside]
    column, row = pixels.round().long().unbind(1)
    hidden = (seen.owner[row, column] >= 0) & (seen.depth[row, column] < contacts[:, 2] - TOUCHES)
    outer, ring, hole, core = (ink.discs(size, pixels[hidden], r * unit) for r in (4.0, 3.3, 2.0, 1.4))
    canvas = ink.mix(canvas, ink.DARK, 0.45 * (outer - core))
    canvas = ink.mix(canvas, _CONTACT, 0.7 * (ring - hole))
    outer, inner = (ink.discs(size, pixels[~hidden], r * unit) for r in (4.0, 2.8))
    return ink.mix(ink.mix(canvas, ink.DARK, outer), _CONTACT, inner)
