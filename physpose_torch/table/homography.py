"""Method ``homography``: the table moves the image by a homography, which tells its plane up to the length of the baseline."""

import cv2
import torch
from torch import Tensor

from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.table.alignment import CLEAR, Located
from physpose_torch.table.found import Found, Problem, check_near_objects, located_matches, scale_on_objects
from physpose_torch.table.ransac import RansacInfo
from physpose_torch.table.roles import Matches
from physpose_torch.table.template import grown, render_template
from physpose_torch.table.view import pixel_rays, project

__all__ = ["fit_homography", "plane_from_homography"]

TOLERANCE = 1.0
"""[px]; a match this near to where the homography puts it is on the plane."""
PLANES = 4
"""Planes that are looked for: a floor may show more than the table does."""
INDEPENDENT = 30.0
"""Matches count as this many at the most."""
LEAST = 8
"""Matches on a plane."""


def plane_from_homography(
    T_view1_view0: Tensor, K0: Tensor, K1: Tensor, matches: Located
) -> tuple[tuple[Tensor, Tensor, Tensor] | None, RansacInfo]:
    """The plane with the most matches on it, given how the cameras stand.

    Returns:
        ``(normal (3,), offset (), covariance (3, 3))`` in the unit of the motion's translation, the covariance that of
        normal / offset; None where there is none; and which matches are on it.
    """
    count = len(matches.points_0)
    none = RansacInfo(torch.zeros(count, dtype=torch.bool), torch.full((count,), torch.inf), 0)
    if count < LEAST:
        return None, none
    H, mask = cv2.findHomography(
        matches.points_0.numpy(), matches.points_1.numpy(), cv2.USAC_MAGSAC, 2 * TOLERANCE, maxIters=5000
    )
    if H is None or int(mask.sum()) < LEAST:
        return None, none
    R, t = T_view1_view0[:3, :3], T_view1_view0[:3, 3]
    rays, on = pixel_rays(K0, matches.points_0), torch.from_numpy(mask[:, 0] > 0)
    turned, ahead = rays @ R.mT, pixel_rays(K1, matches.points_1)
    # (R + t m') ray is along the ray of view 1: linear in m = normal / offset
    a, b = torch.linalg.cross(ahead, t.expand_as(ahead)), torch.linalg.cross(ahead, turned)
    m = torch.linalg.lstsq((a[on][:, :, None] * rays[on][:, None]).reshape(-1, 3), -b[on].reshape(-1, 1)).solution[:, 0]

    def off(m: Tensor) -> Tensor:
        return project(K1, turned + (rays @ m)[:, None] * t) - matches.points_1

    covariance = torch.eye(3, dtype=m.dtype)
    for _ in range(5):
        jacobian, residual = torch.func.jacfwd(off)(m), off(m)
        known = matches.covariance.diagonal(dim1=1, dim2=2).amax(1).sqrt()
        on = torch.linalg.vector_norm(residual, dim=1) < TOLERANCE + 2 * known
        if int(on.sum()) < LEAST:
            return None, none
        weight = torch.linalg.inv(matches.covariance[on])
        weighted = jacobian[on].mT @ weight
        covariance = torch.linalg.inv((weighted @ jacobian[on]).sum(0) + 1e-9 * torch.eye(3, dtype=m.dtype))
        m = m - covariance @ (weighted @ residual[on][..., None]).sum(0)[:, 0]
    size = torch.linalg.vector_norm(m)
    normal, offset = m / size, 1.0 / size
    # the camera is above the table
    info = RansacInfo(on, torch.linalg.vector_norm(off(m), dim=1), 5000)
    return (-normal, -offset, covariance), info


def fit_homography(problem: Problem, find_matches) -> Found:
    """The table by the homography that its texture moves by, scaled by the depth of the objects.

    Raises:
        TableNotFoundError: no motion, no plane with matches on it, or none that the objects are near to.
    """
    matches, motion = located_matches(problem, find_matches)
    K0, K1 = (v.K for v in problem.views)
    poses = problem.measured[0]
    template = render_template(problem.bodies, poses, K0, problem.views[0].size)
    scale, spread = scale_on_objects(problem, motion, matches, template)
    x, y = matches.points_0.round().long().unbind(1)
    rest = Located(*(v[~grown(template.owner >= 0, CLEAR)[y, x]] for v in matches))
    found: list[Found] = []
    for _ in range(PLANES):
        plane, info = plane_from_homography(motion, K0, K1, rest)
        if plane is None:
            break
        normal, offset, covariance = plane
        on = info.inliers
        # what a change of normal / offset makes of the tilts, and of the height at the middle
        basis = tangent_basis(normal[None])[0]
        metric = offset * scale
        foot = problem.middle + (metric - normal @ problem.middle) * normal
        change = -offset * torch.cat([basis, foot[None]])
        # neither tables, lenses nor the motion are perfect: hundreds of matches do not make it known to a hair
        covariance = covariance * max(1.0, float(on.sum()) / INDEPENDENT)
        spread_of_plane = change @ covariance @ change.mT
        spread_of_plane[2, 2] += (spread * metric) ** 2
        table = Matches(rest.points_0[on], rest.points_1[on], torch.ones(int(on.sum())))
        found.append(Found(normal, metric, spread_of_plane, float(scale), table, motion, scale))
        rest = Located(*(v[~on] for v in rest))
    return check_near_objects(problem, found, "homography")
