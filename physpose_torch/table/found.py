"""What the methods that go by images alone share: the problem, matches and motion, metric scale, and a last check."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.config import TableConfig
from physpose_torch.errors import TableNotFoundError
from physpose_torch.geometry.body import Body
from physpose_torch.table.alignment import BORDER, Located
from physpose_torch.table.lucas_kanade import align_patches, gray
from physpose_torch.table.ransac import ransac_scale
from physpose_torch.table.roles import Matches
from physpose_torch.table.standing import standing_on
from physpose_torch.table.template import Template, eroded
from physpose_torch.table.two_view import motion_from_matches, motion_from_objects, refine_motion, triangulate
from physpose_torch.table.view import View, pixel_rays

__all__ = ["Found", "Problem", "check_near_objects", "located_matches", "object_points", "scale_on_objects"]

NEAR = 0.06
"""[m]; the lowest point of some object is no farther from the table than this."""
UPRIGHT = math.radians(10.0)
"""… that is tilted by no more than this from a face it can stand on."""
BELOW = 0.03
"""[m]; and no more than half of the objects are deeper in it than this."""
OUTLYING = 4.0
"""Standard deviations; a match farther than this from its epipolar line is wrong."""
PAIR = 0.05
"""Relative standard deviation of the distance of two points on an object, and largest of a pair that agrees on a scale."""
LEAST_SPREAD = 0.004
"""Relative standard deviation of a scale, however many pairs agree."""
LEAST_ON_OBJECTS = 6
"""Correspondences on objects; fewer give no scale."""


class Problem(NamedTuple):
    """What is given."""

    views: Sequence[View]
    """One or two."""
    bodies: Sequence[Body]
    measured: Sequence[Tensor]
    """(N, 4, 4) of each view, NaN where unknown [m]."""
    config: TableConfig
    gravity: Tensor | None
    """(3,) unit vector pointing down, view 0."""

    @property
    def centers(self) -> Tensor:
        """(N, 3) of the bodies' bounds, object frame [m]."""
        return torch.stack([b.center for b in self.bodies]) if self.bodies else torch.zeros(0, 3, dtype=torch.float64)

    @property
    def middle(self) -> Tensor:
        """(3,) mean of the objects' centres in view 0: the point under which a plane's covariance is given [m]."""
        here = self.measured[0].isfinite().flatten(1).all(1)
        return se3.apply(self.measured[0][here], self.centers[here][:, None])[:, 0].mean(0)


class Found(NamedTuple):
    """A plane that was found."""

    normal: Tensor
    """(3,) up, view 0."""
    offset: Tensor
    """() [m]."""
    covariance: Tensor
    """(3, 3) of two tilts [rad] and the height at the problem's middle [m]."""
    scale: float | None
    """Metres a unit of the reconstruction."""
    table: Matches | None
    """Matches on it."""
    motion: Tensor | None = None
    """T_view1_view0, its translation in units of the reconstruction."""
    unit: Tensor | None = None
    """() metres a unit of the motion's translation."""


def located_matches(
    problem: Problem, find_matches: Callable[[Tensor, Tensor], Matches]
) -> tuple[Located, Tensor]:
    """Sub-pixel matches that fit a motion of the camera, and that motion, with a baseline of length 1.

    Raises:
        TableNotFoundError: the images do not tell how the camera moved.
    """
    views = problem.views
    if len(views) < 2 or any(v.image is None for v in views):
        raise TableNotFoundError(f"method {problem.config.method!r} needs two images; use 'support' or 'auto' for one")
    matches = Located.of(find_matches(*(v.image for v in views)), [gray(v.image) for v in views])
    plain = Matches(matches.points_0, matches.points_1, torch.ones(len(matches.points_0)))
    motion, _ = motion_from_matches(plain, views[0].K, views[1].K)
    by_objects = motion_from_objects(*problem.measured)
    if (motion is None or len(matches.points_0) < LEAST_ON_OBJECTS) and by_objects is not None:
        motion = by_objects
    if motion is None:
        raise TableNotFoundError(
            f"only {len(matches.points_0)} matches between the two images, too few for the motion of the camera; "
            "take images that overlap, with texture, 10 to 20 degrees apart"
        )
    motion, distance = refine_motion(motion, views[0].K, views[1].K, *matches)
    _, residual = triangulate(motion, views[0].K, views[1].K, matches.points_0, matches.points_1)
    good = (distance.abs() < OUTLYING) & residual.isfinite()
    return Located(*(v[good] for v in matches)), motion


def object_points(
    problem: Problem, template: Template, pixels: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Metric surface points (M, 3) in view 0 that pixels (M, 2) show, which of the pixels they are, and of which objects.

    Where the template has colours, a pixel is first found in it; elsewhere the estimated pose is believed to the pixel.
    """
    view = problem.views[0]
    x, y = pixels.round().long().unbind(1)
    owner = template.owner[y, x]
    on = torch.zeros_like(owner, dtype=torch.bool)
    for k in range(len(problem.bodies)):
        on |= (owner == k) & eroded(template.owner == k, BORDER)[y, x]
    which = on.nonzero()[:, 0]
    at, owner = pixels[which], owner[which]
    colored = template.colored[owner]
    if bool(colored.any()):
        found = align_patches(gray(view.image), gray(template.color), at, at)
        at = torch.where((found.good & colored)[:, None], found.points, at)
        which, at, owner = (v[found.good | ~colored] for v in (which, at, owner))
    x, y = at.round().long().unbind(1)
    x, y = x.clamp(0, template.owner.shape[1] - 1), y.clamp(0, template.owner.shape[0] - 1)
    same = template.owner[y, x] == owner
    points = pixel_rays(view.K, at) * template.depth[y, x][:, None]
    return points[same], which[same], owner[same]


def scale_on_objects(problem: Problem, motion: Tensor, matches: Located, template: Template) -> tuple[Tensor, float]:
    """Metres a unit of the motion's translation, by how deep the objects are, and its relative standard deviation.

    Raises:
        TableNotFoundError: too few matches on objects.
    """
    K0, K1 = (v.K for v in problem.views)
    metric, which, owner = object_points(problem, template, matches.points_0)
    points, _ = triangulate(motion, K0, K1, matches.points_0[which], matches.points_1[which])
    good = points[:, 2] > 0
    if int(good.sum()) < LEAST_ON_OBJECTS:
        raise TableNotFoundError(
            f"only {int(good.sum())} matches on the objects, too few to tell the scale; are poses and intrinsics those of "
            "these images?"
        )
    ratio, owner = (metric[:, 2] / points[:, 2])[good], owner[good]
    # each object's depth is off by itself
    each = torch.stack([ratio[owner == k].median() for k in owner.unique()])
    scale = each.median() if len(each) > 2 else each.mean()
    own = problem.config.sigma_ray_fraction
    spread = (own**2 / len(each) + problem.config.sigma_depth_common**2) ** 0.5
    return scale, spread


def scale_of_points(problem: Problem, source: Tensor, pixels: Tensor, template: Template) -> tuple[Tensor, float]:
    """Metres a unit of a reconstruction, points (M, 3) of pixels (M, 2), by pairs of points on one object (paper, Sec. 3.2).

    Raises:
        TableNotFoundError: too few points on objects.
    """
    metric, which, owner = object_points(problem, template, pixels)
    scale, info = ransac_scale(source[which], metric, owner, tolerance=PAIR, seed=problem.config.seed)
    count = int(info.inliers.sum())
    if scale is None or count < LEAST_ON_OBJECTS:
        raise TableNotFoundError(
            f"only {count} of {len(which)} correspondences on the objects agree on a scale; are poses and intrinsics those of "
            "these images?"
        )
    if bool(template.colored[owner[info.inliers]].all()):
        return scale, max(PAIR / count**0.5, LEAST_SPREAD)
    # where the pose is believed to the pixel, distances on an object are off like its depth
    return scale, math.hypot(problem.config.sigma_ray_fraction, problem.config.sigma_depth_common)


def check_near_objects(problem: Problem, found: Sequence[Found], method: str) -> Found:
    """The plane that the most objects stand on, of several.

    Raises:
        TableNotFoundError: there is none that some object is near to and the others are above.
    """
    poses = problem.measured[0]
    here = poses.isfinite().flatten(1).all(1)
    best, most = None, -1.0
    for plane in found:
        feet = standing_on(problem.bodies, poses, plane.normal)
        height = (se3.apply(poses, feet.lowest[:, None])[:, 0] @ plane.normal - plane.offset)[here]
        slack = 2 * problem.config.sigma_ray_fraction * torch.linalg.vector_norm(poses[here, :3, 3], dim=1)
        near = ((height.abs() < NEAR + slack) & (feet.tilt[here] < UPRIGHT)).double().mean()
        if problem.gravity is not None:
            near = near - 2.0 * ((-plane.normal @ problem.gravity) < 0.9)
        if float((height < -BELOW - slack).double().mean()) > 0.5 or float(near) <= 0:
            continue
        if float(near) > most:
            best, most = plane, float(near)
    if best is None:
        raise TableNotFoundError(
            f"{method}: none of {len(found)} planes that the images show is one that the objects stand on; "
            "with poses of objects on the table, method 'joint' or 'support' can do without texture"
        )
    return best
