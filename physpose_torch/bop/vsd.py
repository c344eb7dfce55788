"""Visible surface discrepancy (VSD): how much of what is visible of an object differs between two poses of it.

Both poses are rendered and compared with the test depth of the image, pixel by pixel. Indistinguishable views have the
same VSD, so it needs no symmetries.

Source: Hodaň et al., BOP Challenge 2020 on 6D Object Localization, section 2.2; BOP toolkit, `pose_error.vsd` with the
step cost, and `visibility.py` in the mode `bop19`. Unlike there, surfaces are drawn from 1 mm in front of the camera on.
"""

from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.matching import TargetGroup
from physpose_torch.errors import InvalidInputError
from physpose_torch.render import fragments, render

__all__ = ["VISIBILITY_TOLERANCE", "VSD_TAUS", "VSD_THRESHOLDS", "VsdDepth", "target_vsd", "vsd"]

VISIBILITY_TOLERANCE = 0.015
"""δ [m]: a surface is visible unless it is farther than this behind the test depth."""
VSD_TAUS = np.arange(1, 11) / 20
"""τ, fractions of the object's diameter from which on a pixel's distance is wrong: 0.05 to 0.5."""
VSD_THRESHOLDS = np.arange(1, 11) / 20
"""θ, below which a VSD is correct: 0.05 to 0.5."""

VsdDepth = Literal["auto", "rendered", "none"]
"""Where the test depth is from: the dataset's depth images where there are some, the rendered ground truth, or no VSD."""

_NEAR = 1e-3
_LARGE = 1_000_000  # [px]
_ROUNDING = 1e-6  # [px], wider than the renderer's rounding


class _Surface(NamedTuple):
    vertices: torch.Tensor
    faces: torch.Tensor
    closed: bool
    """Every ray meets a front first, so that backs need not be drawn."""


class _View(NamedTuple):
    """What the camera sees of an object alone: a cut-out of the image."""

    left: int
    top: int
    distance: np.ndarray
    """(h, w) distance from the camera's centre [m], 0 where nothing is seen; (0, 0) if all of it is off the image."""

    def window(self) -> tuple[slice, slice]:
        """Where in the image it is."""
        height, width = self.distance.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


_NOTHING = _View(0, 0, np.zeros((0, 0)))


def vsd(
    T_est: torch.Tensor,
    T_gt: torch.Tensor,
    depth: torch.Tensor,
    K: torch.Tensor,
    vertices: torch.Tensor,
    faces: torch.Tensor,
    diameter: float,
    *,
    taus: np.ndarray = VSD_TAUS,
) -> np.ndarray:
    """VSD of each estimate against each ground truth of one object in one image.

    With V the visible part of a rendering S (distances from the camera's centre): V_gt = where S_gt − test ≤ δ or the
    test depth is unknown; V_est likewise, and also where S_est is anything inside V_gt. The error is the share of
    V_est ∪ V_gt that is not in both, or where |S_est − S_gt| / diameter ≥ τ; it is 1 if both are empty.

    Args:
        T_est: T_camera_object, shape (E, 4, 4) [m].
        T_gt: T_camera_object, shape (G, 4, 4) [m].
        depth: The test depth: z in the camera frame, shape (H, W) [m], 0 where it is unknown.
        K: Camera, shape (3, 3) [px], pixel centres at integers.
        vertices: Vertices of the model, object frame, shape (V, 3) [m].
        faces: Its triangles, shape (F, 3).
        diameter: Diameter of the object [m].
        taus: Misalignment tolerances τ, shape (T,), fractions of the diameter.

    Returns:
        Shape (E, G, T) float64.

    Raises:
        InvalidInputError: Poses or depth have the wrong shape, or the diameter is not positive.
    """
    if T_est.shape[1:] != (4, 4) or T_gt.shape[1:] != (4, 4) or depth.ndim != 2 or not diameter > 0:
        shapes = f"T_est {tuple(T_est.shape)}, T_gt {tuple(T_gt.shape)}, depth {tuple(depth.shape)}"
        raise InvalidInputError(f"got {shapes}, diameter {diameter}; expected (E, 4, 4), (G, 4, 4), (H, W), > 0")
    surface, K = _surface(vertices, faces), K.double()
    test = depth.numpy() * _rays(K, *depth.shape)
    truth = [_view(T, surface, K, depth.shape) for T in T_gt]
    return _matrix(T_est, truth, test, surface, K, diameter, np.asarray(taus))


def target_vsd(
    dataset: BopDataset,
    groups: list[TargetGroup],
    poses: torch.Tensor,
    *,
    depth: VsdDepth,
    on_image: Callable[[], Any] | None = None,
) -> list[np.ndarray | None]:
    """VSD of the estimates of each target at all `VSD_TAUS`.

    Args:
        dataset: Where models, cameras, depth images and ground truth are.
        groups: The targets, with their rows and ground truths.
        poses: T_camera_object of all rows, shape (rows, 4, 4) [m].
        depth: `auto`: the dataset's depth images. `rendered`: all annotated objects of the image, rendered in their
            ground-truth poses; the background is unknown.
        on_image: Called after each image.

    Returns:
        For each target (E, G, T), or None where there is no test depth.

    Raises:
        DataError: A depth image, a mesh or a camera is broken or missing.
    """
    if depth not in ("auto", "rendered", "none"):
        raise InvalidInputError(f"vsd_depth is {depth!r}, expected 'auto', 'rendered' or 'none'")
    surfaces: dict[int, _Surface] = {}

    def surface(obj_id: int) -> _Surface:
        if obj_id not in surfaces:
            surfaces[obj_id] = _surface(dataset.vertices(obj_id), dataset.faces(obj_id))
        return surfaces[obj_id]

    of_image: dict[tuple[int, int], list[int]] = {}
    for index, group in enumerate(groups if depth != "none" else ()):
        of_image.setdefault(group.target[:2], []).append(index)
    errors: list[np.ndarray | None] = [None] * len(groups)
    for image, indices in of_image.items():
        if depth == "rendered" or dataset.has_image(*image, "depth"):
            gt, K = dataset.ground_truth(image[0]), dataset.camera(*image).K
            if depth == "rendered":
                size = dataset.image_size(image[0])[::-1]
                wanted: Iterable[int] = np.flatnonzero(gt.im_id == image[1]).tolist()
            else:
                z = dataset.depth(*image).numpy()
                size = z.shape
                wanted = sorted({int(k) for i in indices if len(groups[i].rows) for k in groups[i].gts})
            views = {k: _view(gt.T_camera_object[k], surface(int(gt.obj_id[k])), K, size) for k in wanted}
            test = _nearest(views.values(), size) if depth == "rendered" else z * _rays(K, *size)
            for i in indices:
                target, rows, gts = groups[i]
                T_est = poses[torch.from_numpy(rows)]
                truth = [views[k] for k in gts.tolist()] if len(rows) else [_NOTHING] * len(gts)
                args = surface(target.obj_id), K, dataset.diameter(target.obj_id), VSD_TAUS
                errors[i] = _matrix(T_est, truth, test, *args)
        if on_image is not None:
            on_image()
    return errors


def _matrix(
    T_est: torch.Tensor,
    truth: list[_View],
    test: np.ndarray,
    surface: _Surface,
    K: torch.Tensor,
    diameter: float,
    taus: np.ndarray,
) -> np.ndarray:
    """Errors (E, G, T) against what is seen of the ground truths, given the distances of the test depth."""
    errors = np.ones((len(T_est), len(truth), len(taus)))
    visible_gt = [_visible(view, test) for view in truth]
    for e, T in enumerate(T_est):
        view = _view(T, surface, K, test.shape)
        visible = _visible(view, test)
        for g, gt in enumerate(truth):
            errors[e, g] = _discrepancy(view, visible, gt, visible_gt[g], diameter, taus)
    return errors


def _visible(view: _View, test: np.ndarray) -> np.ndarray:
    """Where the object is seen and not hidden; where the test depth is unknown, it counts as visible."""
    there = test[view.window()]
    return (view.distance > 0) & ((view.distance - there <= VISIBILITY_TOLERANCE) | (there == 0))


def _discrepancy(
    est: _View, visible_est: np.ndarray, gt: _View, visible_gt: np.ndarray, diameter: float, taus: np.ndarray
) -> np.ndarray:
    """VSD (T,) of one estimate; `visible_est` without the part that is visible only because the ground truth is."""
    rows, columns = (
        slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(est.window(), gt.window(), strict=True)
    )
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return np.ones(len(taus))
    in_est, in_gt = (
        (slice(rows.start - v.top, rows.stop - v.top), slice(columns.start - v.left, columns.stop - v.left))
        for v in (est, gt)
    )
    own, seen = visible_est[in_est], visible_gt[in_gt]
    union = int(visible_est.sum()) + int(visible_gt.sum()) - int((own & seen).sum())
    if union == 0:
        return np.ones(len(taus))
    both = seen & (est.distance[in_est] > 0)
    apart = np.abs(est.distance[in_est][both] - gt.distance[in_gt][both]) / diameter
    right = (apart < taus[:, None]).sum(1)
    return (union - right) / union


def _surface(vertices: torch.Tensor, faces: torch.Tensor) -> _Surface:
    """A mesh, and whether it is closed and wound outwards, part by part."""
    import trimesh  # only needed here, and slow to import
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    closed = bool(mesh.is_watertight and mesh.is_winding_consistent)
    if closed:
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        volume = (a * torch.linalg.cross(b, c)).sum(1).numpy()
        i, j = mesh.edges.T
        part = connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape=(len(vertices),) * 2))[1]
        volume = np.bincount(part[faces[:, 0].numpy()], weights=volume, minlength=part.max() + 1)
        closed = bool((volume >= 0).all())
    return _Surface(vertices.double(), faces.long(), closed)


def _view(T: torch.Tensor, surface: _Surface, K: torch.Tensor, size: tuple[int, int]) -> _View:
    """Render an object alone, within the bounds of its projection and with the faces that matter."""
    points = surface.vertices @ T[:3, :3].mT + T[:3, 3]
    faces, left, top = surface.faces, 0, 0
    height, width = size
    nearest, farthest = points[:, 2].aminmax()
    if not farthest > _NEAR:  # behind the camera
        return _NOTHING
    if nearest > _NEAR:
        x, y, z = (points @ K.mT).unbind(1)
        x, y = x / z, y / z
        bounds = [b for v in (x, y) for b in ((v.amin() - _ROUNDING).ceil(), (v.amax() + _ROUNDING).floor())]
        if not all(bool(b.isfinite()) for b in bounds):
            return _NOTHING
        left, right, top, bottom = (int(b.clamp(-1, 2**31)) for b in bounds)
        left, top, right, bottom = max(left, 0), max(top, 0), min(right, width - 1), min(bottom, height - 1)
        width, height = right + 1 - left, bottom + 1 - top
        if width < 1 or height < 1:
            return _NOTHING
        faces = faces[_drawn(x, y, faces, surface.closed)]
    elif max(size) < 1:
        return _NOTHING
    K = K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    return _View(left, top, _depth(points, faces, K, height, width) * _rays(K, height, width))


def _depth(points: torch.Tensor, faces: torch.Tensor, K: torch.Tensor, height: int, width: int) -> np.ndarray:
    """Least z (height, width) [m], 0 where nothing is seen."""
    if height * width > _LARGE:  # slower, but bounded in memory
        return render(points, faces, K, height, width, near=_NEAR).depth.numpy()
    found = fragments(points, faces, K, height, width, near=_NEAR)
    depth = torch.full((height * width,), torch.inf, dtype=torch.float64)
    depth.scatter_reduce_(0, found.pixel, found.depth, "amin")
    return torch.where(depth.isfinite(), depth, 0.0).view(height, width).numpy()


def _drawn(x: torch.Tensor, y: torch.Tensor, faces: torch.Tensor, closed: bool) -> torch.Tensor:
    """(F,) whether a face may cover the centre of a pixel and is not the back of a closed surface."""
    # Scanned meshes have more faces than an object has pixels: this halves the time.
    xs, ys = ([v[corner] for corner in faces.unbind(1)] for v in (x, y))
    keep = torch.ones(len(faces), dtype=torch.bool)
    for a, b, c in (xs, ys):
        low, high = torch.minimum(torch.minimum(a, b), c), torch.maximum(torch.maximum(a, b), c)
        keep &= (low - _ROUNDING).ceil() <= (high + _ROUNDING).floor()
    if closed:  # counter-clockwise fronts have a negative area where y points down
        area = (xs[1] - xs[0]) * (ys[2] - ys[0]) - (xs[2] - xs[0]) * (ys[1] - ys[0])
        keep &= area <= _ROUNDING
    return keep


def _rays(K: torch.Tensor, height: int, width: int) -> np.ndarray:
    """Distance from the camera's centre over z, (height, width)."""
    inverse = torch.linalg.inv(K.double()).numpy()
    u, v = np.arange(width), np.arange(height)[:, None]
    x, y = (row[0] * u + row[1] * v + row[2] for row in inverse[:2])
    return np.sqrt(x * x + y * y + 1)


def _nearest(views: Iterable[_View], size: tuple[int, int]) -> np.ndarray:
    """Distances (H, W) of the nearest of several objects, 0 where there is none."""
    out = np.full(size, np.inf)
    for view in views:
        part = out[view.window()]
        np.minimum(part, view.distance, out=part, where=view.distance > 0)
    return np.where(np.isfinite(out), out, 0.0)
