"""Method ``paper``: reconstruct from two views, scale by the objects, fit a plane to what is left (paper, Sec. 3.2)."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.errors import TableNotFoundError
from physpose_torch.table.alignment import CLEAR
from physpose_torch.table.found import Found, Problem, check_near_objects, located_matches, scale_of_points
from physpose_torch.table.ransac import ransac_plane
from physpose_torch.table.roles import Matches
from physpose_torch.table.template import grown, render_template
from physpose_torch.table.two_view import triangulate
from physpose_torch.table.view import pixel_rays

__all__ = ["fit_paper"]

TOLERANCE = 0.006
"""[m]; points this near to a plane are on it."""
CONFIDENT = 0.3
"""Pixels of a reconstruction with less than this share of the median confidence are outliers."""
MOST_POINTS = 20_000
"""Points of a dense map that the plane is fitted to."""
LEAST_ON_PLANE = 12
"""Fewer points than this agree on some plane by chance."""
PLANES = 3
"""Planes that are looked for: a floor may show more than the table does."""


def fit_paper(
    problem: Problem, find_matches: Callable[[Tensor, Tensor], Matches], models: Mapping[str, Callable]
) -> Found:
    """The table by a point cloud: dense where a reconstructor or a depth map is given, else triangulated matches.

    Raises:
        TableNotFoundError: no cloud, no scale, or no plane that the objects are near to.
    """
    view = problem.views[0]
    points, pixels, motion, table = _cloud(problem, find_matches, models)
    template = render_template(problem.bodies, problem.measured[0], view.K, view.size)
    scale, spread = scale_of_points(problem, points, pixels, template)
    points = points * scale
    x, y = pixels.round().long().unbind(1)
    free = ~grown(template.owner >= 0, CLEAR)[y, x]
    if "detector" in models and view.image is not None:
        boxes = models["detector"](view.image, "table").corners
        if len(boxes):
            low, high = boxes[0, :2].to(pixels), boxes[0, 2:].to(pixels)
            free &= ((pixels >= low) & (pixels <= high)).all(1)
    left = free.nonzero()[:, 0]
    found: list[Found] = []
    for _ in range(PLANES):
        model, info = ransac_plane(points[left], tolerance=TOLERANCE, seed=problem.config.seed)
        if model is None or int(info.inliers.sum()) < LEAST_ON_PLANE:
            break
        normal, offset = model
        on = left[info.inliers]
        matches = None if table is None else Matches(*(v[on] for v in table))
        covariance = _covariance(problem, points[on], normal, offset, spread)
        found.append(Found(normal, offset, covariance, float(scale), matches, motion, scale))
        left = left[~info.inliers]
    return check_near_objects(problem, found, "paper")


def _cloud(problem: Problem, find_matches, models) -> tuple[Tensor, Tensor, Tensor | None, Matches | None]:
    """Points (M, 3) in view 0, up to scale, the pixels (M, 2) that show them, the motion, and matches where it was these."""
    view = problem.views[0]
    if view.depth is not None:
        pixels = view.depth.nonzero().flip(1).double()
        pixels = pixels[:: max(1, len(pixels) // MOST_POINTS)]
        if not len(pixels):
            raise TableNotFoundError("View.depth of view 0 is empty")
        x, y = pixels.long().unbind(1)
        return pixel_rays(view.K, pixels) * view.depth[y, x][:, None], pixels, None, None
    if "reconstructor" in models and len(problem.views) == 2:
        maps = models["reconstructor"](*(v.image for v in problem.views))
        # as the paper: a depth map, seen by the camera that is known
        depth = maps.points_0[..., 2].double()
        sure = (maps.confidence_0 > CONFIDENT * maps.confidence_0.median()) & (depth > 0) & depth.isfinite()
        pixels = sure.nonzero().flip(1).double()
        pixels = pixels[:: max(1, len(pixels) // MOST_POINTS)]
        x, y = pixels.long().unbind(1)
        return pixel_rays(view.K, pixels) * depth[y, x][:, None], pixels, None, None
    matches, motion = located_matches(problem, find_matches)
    points, residual = triangulate(motion, view.K, problem.views[1].K, matches.points_0, matches.points_1)
    good = (residual < 2.0) & (points[:, 2] > 0)
    table = Matches(matches.points_0, matches.points_1, torch.ones(len(points)))
    return points[good], matches.points_0[good], motion, Matches(*(v[good] for v in table))


def _covariance(problem: Problem, points: Tensor, normal: Tensor, offset: Tensor, spread: float) -> Tensor:
    basis = tangent_basis(normal[None])[0]
    lever = (points - problem.middle) @ basis.mT
    lever = torch.cat([lever, torch.ones_like(lever[:, :1])], 1)
    variance = (points @ normal - offset).var() + 1e-8
    # neighbours err together: a cloud counts as a hundred points
    share = min(1.0, 100.0 / len(points))
    covariance = torch.linalg.inv(lever.mT @ lever * share / variance + 1e-6 * torch.eye(3, dtype=lever.dtype))
    covariance[2, 2] += (spread * offset) ** 2
    return covariance
