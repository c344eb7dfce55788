"""Z-buffer rasterisation of triangle meshes in plain torch: depth, face ids and barycentrics on any device.

No GL, no display, no compiled extension. Triangles are cut at the near plane, turned into horizontal spans and then
into fragments, a bounded number at a time; the nearest fragment of a pixel wins by one integer minimum, so the result
does not depend on the order of execution.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch.errors import InvalidInputError

__all__ = ["Fragments", "RenderResult", "fragments", "overlap_length", "render"]

_EMPTY = torch.iinfo(torch.int64).max


class RenderResult(NamedTuple):
    """What each pixel sees first."""

    depth: Tensor
    """z of the surface in the camera frame, (H, W) [m]; 0 where nothing is seen."""
    face_id: Tensor
    """Row of `faces`, (H, W) int64; -1 where nothing is seen."""
    barycentric: Tensor
    """Weights of the face's three vertices at the point in space (perspective-correct), (H, W, 3); 0 where empty."""


class Fragments(NamedTuple):
    """Every crossing of a pixel's ray with a face, also the hidden ones, in no particular order."""

    pixel: Tensor
    """y * width + x, (M,) int64."""
    face_id: Tensor
    """Row of `faces`, (M,) int64."""
    depth: Tensor
    """z of the crossing in the camera frame, (M,) float64 [m]."""
    facing: Tensor
    """+1 where the ray enters through the face (counter-clockwise seen from the camera), -1 where it leaves, (M,)."""


def render(
    vertices: Tensor,
    faces: Tensor,
    K: Tensor,
    height: int,
    width: int,
    *,
    near: float = 1e-3,
    chunk: int = 500_000,
) -> RenderResult:
    """Depth, face and barycentrics of the nearest surface at every pixel centre (integer coordinates, OpenCV).

    Both sides of a face are drawn. Where two faces have the same depth (to float32), the one with the lower index
    wins. Not differentiable; `(vertices[faces[face_id]] * barycentric[..., None]).sum(-2)` is, with respect to
    `vertices`. Geometry is computed in float64 whatever the input; depths are exact to 16 eps of the farthest vertex's.

    Args:
        vertices: (V, 3) in the camera frame, z forward [m].
        faces: (F, 3) integer rows of `vertices`.
        K: intrinsics (3, 3) [px], last row (0, 0, 1).
        height: rows of the image.
        width: columns of the image.
        near: nothing nearer than this is drawn; faces reaching over it are cut [m].
        chunk: most face rows or fragments held at a time (some 300 bytes each).

    Returns:
        RenderResult with the dtype and device of `vertices`.

    Raises:
        InvalidInputError: a shape, dtype, index, size or the near plane is not usable.
    """
    _check(vertices, faces, K, height, width, near)
    with torch.no_grad():
        buffer = torch.full((height * width,), _EMPTY, dtype=torch.int64, device=vertices.device)
        for part in _rasterise(vertices, faces, K, height, width, near, chunk):
            # positive floats keep their order when read as integers: depth above, face id below
            key = (part.depth.float().view(torch.int32).long() << 32) | part.face_id
            buffer.scatter_reduce_(0, part.pixel, key, "amin")
        seen = (buffer != _EMPTY).nonzero()[:, 0]
        face = buffer[seen] & 0xFFFFFFFF
        depth, weights = _intersect(vertices, faces[face], K, seen % width, seen // width)
        face_id = torch.full((height * width,), -1, dtype=torch.int64, device=vertices.device)
        face_id[seen] = face
        out = vertices.new_zeros(height * width, 4)
        out[seen] = torch.cat([depth[:, None], weights], 1).to(vertices.dtype)
    out = out.view(height, width, 4)
    return RenderResult(out[..., 0].contiguous(), face_id.view(height, width), out[..., 1:].contiguous())


def fragments(
    vertices: Tensor, faces: Tensor, K: Tensor, height: int, width: int, *, near: float = 1e-3, chunk: int = 500_000
) -> Fragments:
    """All crossings of all pixels' rays with all faces: depth layers, thickness and overlap of solids follow.

    Arguments and errors as in `render`. A ray exactly through an edge crosses both faces of that edge.
    """
    _check(vertices, faces, K, height, width, near)
    with torch.no_grad():
        parts = list(_rasterise(vertices, faces, K, height, width, near, chunk))
    return Fragments(*(torch.cat(column) for column in zip(*parts, strict=True)))


def overlap_length(crossings: Fragments, owner: Tensor, n_pixels: int) -> Tensor:
    """How much of each pixel's ray is inside two solids at once, counting entries and exits along the ray.

    Args:
        crossings: from `fragments`, of closed surfaces wound outwards.
        owner: the solid that each face belongs to, (F,) int64.
        n_pixels: height * width.

    Returns:
        Extent along z in the camera frame, (n_pixels,) float64 [m]; 0 where solids are apart.
    """
    object_of = owner[crossings.face_id]
    low = torch.full((n_pixels,), _EMPTY, device=owner.device).scatter_reduce_(0, crossings.pixel, object_of, "amin")
    high = torch.full((n_pixels,), -1, device=owner.device).scatter_reduce_(0, crossings.pixel, object_of, "amax")
    several = (low < high)[crossings.pixel]
    pixel, depth, facing, object_of = (c[several] for c in (*crossings[::2], crossings.facing.long(), object_of))
    order = depth.argsort(stable=True)
    order = order[pixel[order].argsort(stable=True)]  # by pixel, then by depth
    pixel, depth, facing, object_of = pixel[order], depth[order], facing[order], object_of[order]
    inside = torch.zeros_like(pixel)
    first = torch.searchsorted(pixel, pixel)
    for k in object_of.unique():
        step = torch.where(object_of == k, facing, 0)
        count = step.cumsum(0)
        inside += (count - (count - step)[first]) > 0
    length = torch.zeros(n_pixels, dtype=depth.dtype, device=depth.device)
    run = torch.where((pixel[1:] == pixel[:-1]) & (inside[:-1] >= 2), depth[1:] - depth[:-1], 0.0)
    return length.index_add_(0, pixel[:-1], run)


def _check(vertices: Tensor, faces: Tensor, K: Tensor, height: int, width: int, near: float) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not vertices.is_floating_point():
        raise InvalidInputError(f"vertices is {vertices.dtype} {tuple(vertices.shape)}, expected floating (V, 3)")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.is_floating_point() or faces.dtype == torch.bool:
        raise InvalidInputError(f"faces is {faces.dtype} {tuple(faces.shape)}, expected integer (F, 3)")
    if K.shape != (3, 3):
        raise InvalidInputError(f"K has shape {tuple(K.shape)}, expected (3, 3)")
    if height < 1 or width < 1:
        raise InvalidInputError(f"the image is {width} x {height}, expected at least 1 x 1")
    if not near > 0:
        raise InvalidInputError(f"near = {near}, expected a positive depth in metres")
    if len(faces) and (int(faces.min()) < 0 or int(faces.max()) >= len(vertices)):
        raise InvalidInputError(
            f"faces refers to vertices {int(faces.min())}..{int(faces.max())}, but there are {len(vertices)}"
        )


def _clip(corners: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Cut triangles (F, 3, 3) at z = near: the visible pieces (T, 3, 3) and the face each comes from (T,)."""
    inside = corners[..., 2] >= near
    count = inside.sum(1)
    whole = (count == 3).nonzero()[:, 0]
    pieces, source = [corners[whole]], [whole]
    for n_inside in (1, 2):
        rows = (count == n_inside).nonzero()[:, 0]
        if not len(rows):
            continue
        # rotate the odd corner (alone on its side of the plane) to the front; the winding stays
        odd = (inside[rows] == (n_inside == 1)).long().argmax(1)
        a, b, c = (corners[rows, (odd + k) % 3] for k in range(3))
        ab, ac = _cut(a, b, near), _cut(a, c, near)
        if n_inside == 1:
            pieces.append(torch.stack([a, ab, ac], 1))
            source.append(rows)
        else:
            pieces += [torch.stack([ab, b, c], 1), torch.stack([ab, c, ac], 1)]
            source += [rows, rows]
    return torch.cat(pieces), torch.cat(source)


def _cut(a: Tensor, b: Tensor, near: float) -> Tensor:
    """Where the segments a–b meet z = near; computed from the front end, so that neighbours get the same point."""
    front = (a[:, 2:] > b[:, 2:]).expand_as(a)
    p, q = torch.where(front, a, b), torch.where(front, b, a)
    point = p + (q - p) * ((near - p[:, 2:]) / (q[:, 2:] - p[:, 2:]))
    point[:, 2] = near
    return point


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For counts (n,): the row (M,) and the position inside the row (M,) of each of their M = sum items."""
    row = torch.repeat_interleave(counts)
    start = counts.cumsum(0) - counts
    return row, torch.arange(len(row), device=counts.device) - start[row]


def _batches(counts: Tensor, chunk: int) -> Iterator[slice]:
    """Consecutive slices whose counts sum to at most `chunk` (a single larger item goes alone)."""
    total = counts.cumsum(0)
    begin, done = 0, 0
    while begin < len(counts):
        end = int(torch.searchsorted(total, done + chunk, right=True))
        end = max(end, begin + 1)
        yield slice(begin, end)
        begin, done = end, int(total[end - 1])


def _rasterise(
    vertices: Tensor, faces: Tensor, K: Tensor, height: int, width: int, near: float, chunk: int
) -> Iterator[Fragments]:
    """Fragments, at most about `chunk` at a time; at least one (perhaps empty) part."""
    K = K.to(vertices.device, torch.float64)
    corners, source = _clip(vertices.double()[faces.long()], near)
    homogeneous = corners @ K.mT
    xy = homogeneous[..., :2] / homogeneous[..., 2:]
    z = corners[..., 2]

    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    height_of_plane = (normal * corners[:, 0]).sum(1)  # normal · x on the face; 0 where it is seen edge on
    per_pixel = (normal @ torch.linalg.inv(K)) / height_of_plane[:, None]  # 1/z = per_pixel · (x, y, 1)
    low, high = xy.amin(1), xy.amax(1)
    size = torch.tensor([width, height], device=xy.device)
    good = per_pixel.isfinite().all(1) & (high >= 0).all(1) & (low <= size - 1).all(1)
    rows = torch.where(good, (high[:, 1].clamp(max=height - 1).floor() - low[:, 1].clamp(min=0).ceil()) + 1, 0.0)
    rows = rows.clamp(min=0).long()
    first_row = low[:, 1].clamp(min=0).ceil()
    # edges sorted from top to bottom: both faces of an edge then compute the very same crossing, and leave no crack
    a, b = xy, xy.roll(-1, 1)
    flip = ((a[..., 1] > b[..., 1]) | ((a[..., 1] == b[..., 1]) & (a[..., 0] > b[..., 0])))[..., None]
    a, b = torch.where(flip, b, a), torch.where(flip, a, b)
    slope = (b[..., 0] - a[..., 0]) / (b[..., 1] - a[..., 1])
    level = a[..., 1] == b[..., 1]
    facing = -height_of_plane.sign().to(torch.int8)
    z_low, z_high = z.amin(1), z.amax(1)

    empty = True
    for part in _batches(rows, chunk):
        triangle, position = _expand(rows[part])
        triangle = triangle + part.start
        y = first_row[triangle] + position
        ta, tb, up = a[triangle], b[triangle], y[:, None]
        crossing = ta[..., 0] + (up - ta[..., 1]) * slope[triangle]
        crossing = torch.where(up == tb[..., 1], tb[..., 0], torch.where(up == ta[..., 1], ta[..., 0], crossing))
        flat = level[triangle]
        hit = (up >= ta[..., 1]) & (up <= tb[..., 1]) & ~flat
        on = (up == ta[..., 1]) & flat
        left = torch.where(hit, crossing, torch.where(on, ta[..., 0], torch.inf)).amin(1)
        right = torch.where(hit, crossing, torch.where(on, tb[..., 0], -torch.inf)).amax(1)
        left, right = left.clamp(min=0).ceil(), right.clamp(max=width - 1).floor()
        spans = torch.where(right >= left, right - left + 1, 0.0).long()
        for piece in _batches(spans, chunk):
            row, position = _expand(spans[piece])
            row = row + piece.start
            tri = triangle[row]
            px, py = left[row] + position, y[row]
            inverse = per_pixel[tri, 0] * px + per_pixel[tri, 1] * py + per_pixel[tri, 2]
            depth = (1 / inverse).clamp(z_low[tri], z_high[tri])  # a face seen nearly edge on would run off
            depth = torch.where(inverse > 0, depth, z_high[tri])
            yield Fragments((py * width + px).long(), source[tri], depth, facing[tri])
            empty = False
    if empty:
        none = torch.zeros(0, dtype=torch.int64, device=vertices.device)
        yield Fragments(none, none, none.double(), none.to(torch.int8))


def _intersect(vertices: Tensor, faces: Tensor, K: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Depth (M,) and barycentrics (M, 3) where the rays of pixels (x, y) meet one face (M, 3) each, float64."""
    v = vertices.double()[faces.long()]
    pixels = torch.stack([x, y, torch.ones_like(x)], 1).double()
    ray = pixels @ torch.linalg.inv(K.to(vertices.device, torch.float64)).mT
    e1, e2 = v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]
    normal = torch.linalg.cross(e1, e2)
    point = ray * ((normal * v[:, 0]).sum(1) / (normal * ray).sum(1))[:, None]
    from_v0 = point - v[:, 0]
    w1 = (torch.linalg.cross(from_v0, e2) * normal).sum(1)
    w2 = (torch.linalg.cross(e1, from_v0) * normal).sum(1)
    weights = torch.stack([(normal * normal).sum(1) - w1 - w2, w1, w2], 1).clamp(min=0)
    weights = torch.nan_to_num(weights / weights.sum(1, keepdim=True), nan=1 / 3)
    return (weights * v[..., 2]).sum(1), weights
