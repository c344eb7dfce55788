"""A metric grid on a plane, around what stands there, and the part of it that a camera sees."""

from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.geometry.body import Plane
from physpose_torch.table.view import pixel_rays

__all__ = ["MARGIN", "NEAR", "Grid", "GridLines", "grid_lines", "plane_depth", "table_grid"]

NEAR = 0.05
"""Lines are clipped where they come nearer to the camera than this [m]."""
CELLS = ((0.40, 0.02), (1.25, 0.05), (torch.inf, 0.10))
"""Cells [m] for objects that together are less than so wide [m]: 8 to 25 cells across, fewer for a single small object."""
MARGIN = 6
"""The grid goes on for so many cells around the objects, and fades out on them."""


class Grid(NamedTuple):
    """Squares on a plane, around what stands there."""

    T_camera_grid: Tensor
    """(4, 4) [m]: origin on the plane, under the middle of the objects; z is the normal, x the camera's right."""
    cell: float
    """Side of a square [m]; lines are at its multiples."""
    low: Tensor
    """(2,) least x and y of what the objects cover [m]."""
    high: Tensor
    """(2,) greatest x and y [m]."""


class GridLines(NamedTuple):
    """The part of a grid that is in front of a camera and in its image."""

    segments: Tensor
    """(L, 2, 3) ends in the camera frame [m]."""
    strong: Tensor
    """(L,) bool: every other line."""


def table_grid(plane: Plane, points: Tensor, K: Tensor, size: tuple[int, int]) -> Grid | None:
    """The grid for objects with surface points (P, 3) in the camera frame [m]; around what is at the image's centre if P is 0.

    Args:
        plane: the table.
        points: of the objects.
        K: (3, 3) [px].
        size: height and width of the image [px].

    Returns:
        The grid; None where there are no objects and the plane is out of sight.
    """
    normal, offset = plane.normal.detach().cpu().double(), plane.offset.detach().cpu().double()
    axis = torch.eye(3, dtype=torch.float64)[0 if abs(float(normal[0])) < 0.9 else 1]
    x = torch.nn.functional.normalize(axis - (axis @ normal) * normal, dim=0)
    R = torch.stack([x, torch.linalg.cross(normal, x), normal], 1)
    if len(points):
        flat = points @ R[:, :2]
        low, high = flat.amin(0), flat.amax(0)
        middle = (low + high) / 2
    else:
        depth = plane_depth(plane, K, size)
        # a grazing view sees the table below the centre, and near the horizon it sees nothing of a grid
        near = depth <= max(6 * abs(float(offset)), 1.001 * float(depth.min()))
        if not bool((near & depth.isfinite()).any()):
            return None
        rows, columns = near.nonzero().unbind(1)
        best = ((rows - (size[0] - 1) / 2) ** 2 + (columns - (size[1] - 1) / 2) ** 2).argmin()
        z = depth[rows[best], columns[best]]
        middle = (z * pixel_rays(K, torch.stack([columns[best], rows[best]]).double())) @ R[:, :2]
        half = (z * size[1] / K[0, 0] / 4).clamp(0.1, 1.0).expand(2)
        low, high = middle - half, middle + half
    cell = next(c for limit, c in CELLS if float((high - low).max()) < limit)
    origin = R[:, :2] @ middle + offset * normal
    return Grid(se3.from_rotation_translation(R, origin), cell, low - middle, high - middle)


def grid_lines(grid: Grid, K: Tensor, size: tuple[int, int]) -> GridLines:
    """The lines of a grid that a camera K (3, 3) sees in an image of (height, width), clipped at its border."""
    first = (grid.low / grid.cell).floor().long() - MARGIN
    last = (grid.high / grid.cell).ceil().long() + MARGIN
    ends, strong = [], []
    for axis in range(2):
        at = torch.arange(int(first[axis]), int(last[axis]) + 1)
        line = torch.zeros(len(at), 2, 3, dtype=torch.float64)
        line[:, :, axis] = grid.cell * at[:, None].double()
        line[:, :, 1 - axis] = grid.cell * torch.stack([first[1 - axis], last[1 - axis]]).double()
        ends.append(line)
        strong.append(at % 2 == 0)
    segments, kept = _clipped(se3.apply(grid.T_camera_grid, torch.cat(ends).view(-1, 3)).view(-1, 2, 3), K, size)
    return GridLines(segments, torch.cat(strong)[kept])


def plane_depth(plane: Plane, K: Tensor, size: tuple[int, int]) -> Tensor:
    """(H, W) z of the plane at every pixel [m]; infinite above the horizon and where it is too near."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    slope = pixel_rays(K, torch.stack([x, y], -1)) @ plane.normal.detach().cpu().double()
    depth = plane.offset.detach().cpu().double() / slope
    return torch.where(depth.isfinite() & (depth > NEAR), depth, torch.inf)


def _clipped(segments: Tensor, K: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Segments (L, 2, 3) cut off at `NEAR` and a few pixels outside the image, and which (M,) of them are left."""
    height, width = size
    x, y, z = K  # a pixel times its depth
    a, b = segments.unbind(1)
    start, end = torch.zeros(len(a), dtype=torch.float64), torch.ones(len(a), dtype=torch.float64)
    for side, least in ((z, NEAR), (x + 8 * z, 0), ((width + 8) * z - x, 0), (y + 8 * z, 0), ((height + 8) * z - y, 0)):
        at, rise = a @ side - least, (b - a) @ side
        cut = -at / torch.where(rise == 0, 1.0, rise)
        start = torch.where(rise > 0, torch.maximum(start, cut), start)
        end = torch.where(rise < 0, torch.minimum(end, cut), end)
        end = torch.where((rise == 0) & (at < 0), -1.0, end)
    kept = (end > start).nonzero()[:, 0]
    a, b, start, end = a[kept], b[kept], start[kept, None], end[kept, None]
    return torch.stack([a + start * (b - a), a + end * (b - a)], 1), kept
