"""Estimates that cannot stand as they are estimated: refined once more, turned to the nearest way in which they can."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.contacts import SUPPORT_SLOPE, plane_variance
from physpose_torch.distance.autograd import signed_distance
from physpose_torch.distance.broadphase import instance_bounds, meeting_pairs
from physpose_torch.geometry.resting import nearest_rest
from physpose_torch.losses import PhysicsTerms, prior_loss
from physpose_torch.prior import PosePrior
from physpose_torch.report import PhysicsReport, report_of
from physpose_torch.scene import Scene
from physpose_torch.solvers.descent import Descent
from physpose_torch.stability import BALANCE, Posed, stability_margin

__all__ = ["Righting", "find_fallen", "right_fallen"]

ASKEW = math.radians(12.0)
"""An object less far from a stable pose than this is left as it is: true poses of real data are off by half as much."""
TOLERANCE = 8e-3
"""[m]; and a support counts as far as this, and …"""
TILT = math.radians(7.0)
"""… if a tilt by so much brings it into play: poses that have come to rest in the refinement are a few degrees askew."""
DEEPER = 3e-3
"""[m]; an object that by being righted runs into something by more than this is not righted, and …"""
HIGHER = 0.015
"""… [m]; nor is one that ends higher above its support by more than this."""
DROP = 0.01
"""[m]; what is left to gravity of a righted object's way down, and three σ of the plane: its estimated depth is kept as far
as that goes."""
LEAST_SLOPE = 0.2
"""Sine of the least angle between viewing ray and level at which an object is brought down along its ray."""
NEAR = 0.02
"""[m]; an object higher above its support than this is held by something unseen."""


class Righting(NamedTuple):
    """Objects that would fall over, and how they would stand."""

    rows: Tensor
    """(K,) indices of the objects."""
    turn: Tensor
    """(K, 3, 3) rotation in the camera frame, about the object's centre, that makes each stand."""


def find_fallen(
    poses: Tensor, scene: Scene, acts: Tensor, gap: Tensor, bedded: Tensor, *, limit: float, backend: str
) -> Righting:
    """Objects of a refined scene that nothing keeps from falling over, with a stable pose within reach.

    All that carries the object has a say in whether it is stable, and what touches something beside it above its centre of
    mass may lean on that and stays. Otherwise, where the centre of mass is beside the support, the estimate must be wrong,
    and the stable pose that is nearest to it is the likeliest.

    Args:
        poses: (N, 4, 4) [m], at rest.
        scene: the flat scene.
        acts: (N,) bool.
        gap: (N,) how far each can drop [m].
        bedded: (N,) how deep each is in the plane that carries it [m]. A plane that is not well known is soft, and a body in
            it would seem to stand firmly; so it is judged where it would just touch.
        limit: largest turn [rad].
        backend: distance backend.
    """
    up = -scene.gravity.to(poses)[scene.image.to(poses.device)]
    local = (poses[:, :3, :3].mT @ up[:, :, None])[:, :, 0]
    tilt, target, *_ = nearest_rest(scene.objects, local)
    doubtful = (tilt > ASKEW) & (tilt <= limit) & (gap <= NEAR)  # NaN without gravity
    if bool(doubtful.any()):
        # most images have nothing to look at
        part, here = scene.select(scene.image[doubtful.cpu()].unique())
        at = here.to(poses.device)
        posed = Posed.of(poses[at], part, acts[here], (gap - bedded)[at], backend)
        margin = stability_margin(posed, only=doubtful[at], tolerance=TOLERANCE, tilt=TILT)
        falls = doubtful[at] & (margin <= BALANCE)
        falls &= ~_leans(poses[at], part, acts[here], falls, backend)
        doubtful = torch.zeros_like(doubtful).index_put((at,), falls)
    rows = doubtful.nonzero()[:, 0]
    now = (poses[rows, :3, :3] @ target[rows][:, :, None])[:, :, 0]
    axis = torch.linalg.cross(now, up[rows])
    level = torch.linalg.cross(up[rows], now.roll(1, 1) + 0.5)  # upside down, any level axis will do
    axis = torch.where(axis.norm(dim=1, keepdim=True) > 1e-9, axis, level)
    axis = torch.nn.functional.normalize(axis, dim=1) * tilt[rows, None]
    return Righting(rows, se3.exp_so3(axis))


def _leans(poses: Tensor, scene: Scene, acts: Tensor, falls: Tensor, backend: str) -> Tensor:
    """Which of the objects (N,) touch something beside them, higher than their centre of mass: it may hold them."""
    n, device = len(scene), poses.device
    leans = torch.zeros(n, dtype=torch.bool, device=device)
    if not bool(falls.any()):
        return leans
    holds = torch.ones(len(scene.entity_image), dtype=torch.bool)
    holds[:n] = acts
    T, entity = scene.entity_poses(poses), scene.instance_entity
    pairs = scene.near_pairs(T, TOLERANCE)
    pairs = torch.cat([pairs, pairs.flip(1)])
    pairs = pairs[pairs[:, 0] < n]
    pairs = pairs[falls.cpu()[pairs[:, 0]] & holds[pairs[:, 1]]]
    down = scene.gravity.to(poses)[scene.entity_image.to(device)]
    bounds = instance_bounds(T[entity.to(device)], scene.parts, scene.instance_part.to(device), down[entity.to(device)])
    bounds = type(bounds)(*(x.cpu() for x in bounds))
    instances = meeting_pairs(bounds, entity, scene.instance_start, pairs, margin=TOLERANCE)
    who, other = entity[instances].to(device).unbind(1)
    part = scene.instance_part[instances]
    found = signed_distance(T[who], T[other], scene.parts, part, backend=backend)
    mass = torch.stack([body.center_of_mass for body in scene.objects]).to(poses)
    mass = se3.apply(poses, mass[:, None])[:, 0]
    beside = ((found.normal * down[who]).sum(-1).abs() < SUPPORT_SLOPE) & (found.distance <= TOLERANCE)
    above = ((found.point_a - mass[who]) * down[who]).sum(-1) < 0
    leans[who[beside & above]] = True
    normal, offset = scene.plane_normal.to(poses), scene.plane_offset.to(poses)
    for i, plane in scene.plane_pairs.tolist():
        if bool(falls[i]) and abs(float((normal[plane] @ down[i]).detach())) < SUPPORT_SLOPE:
            corners = se3.apply(poses[i], scene.objects[i].parts.vertices.to(poses))
            beside = corners @ normal[plane] - offset[plane] <= TOLERANCE
            leans[i] |= bool((beside & ((corners - mass[i]) @ down[i] < 0)).any())
    return leans


def right_fallen(
    result: Descent,
    report: PhysicsReport,
    prior: PosePrior,
    scene: Scene,
    acts: Tensor,
    solve: Callable[[PosePrior, Scene, Tensor], Descent],
    *,
    pose_weight: float,
    first_plane: int,
    limit: float,
    backend: str,
) -> tuple[Descent, Tensor, Tensor]:
    """Refine the images in which objects would fall over once more, from estimates that stand.

    Where a righted object then runs deeper into something than it did, or hangs higher, its image stays as it was.

    Args:
        result: of the flat scene's first refinement.
        report: at its poses, of the N objects in this order.
        prior: of the flat estimates.
        scene: the flat scene.
        acts: (N,) bool.
        solve: the solver.
        pose_weight: of the cost; what a turn costs by the estimates as they were shows in the result's terms.
        first_plane: the least number in the report's ``support`` that means a plane.
        limit: largest turn [rad].
        backend: distance backend.

    Returns:
        The result with these images replaced, which objects (N,) were righted, and the estimates (N, 4, 4), theirs as they
        stand.
    """
    righted = torch.zeros(len(scene), dtype=torch.bool, device=result.poses.device)
    gap, in_static, depth, support = (
        x.reshape(-1) for x in (report.gap, report.penetration_static, report.penetration, report.support)
    )
    bedded = torch.where(support >= first_plane, in_static, 0.0)
    fallen, turn = find_fallen(result.poses, scene, acts, gap, bedded, limit=limit, backend=backend)
    if not len(fallen):
        return result, righted, prior.measured
    righted[fallen] = True
    images = scene.image[fallen.cpu()].unique()
    part, rows = scene.select(images)
    at = rows.to(righted.device)
    upright = _turned(prior.measured, result.poses, scene, acts, fallen, turn)
    own = prior.of(rows, part)
    again = solve(own._replace(measured=upright[at]), part, acts[rows])
    pose = prior_loss(again.poses, own)
    total = again.terms.total + pose_weight * (pose - again.terms.pose)
    again = again._replace(terms=again.terms._replace(pose=pose, total=total))
    after = report_of(again.poses, part, part, acts[rows], backend, again.cost)
    refused = (after.penetration - depth[at] > DEEPER) | ~(after.gap - gap[at] <= HIGHER)
    bad = part.image.to(at.device)[refused & righted[at]].unique().cpu()
    good = torch.ones(part.n_images, dtype=torch.bool).index_fill(0, bad, False)
    keep = good[part.image].to(at.device)
    righted[at[~keep]] = False
    standing = torch.where(righted[:, None, None], upright, prior.measured)
    return _merged(result, again, images, good, at, keep), righted, standing


def _turned(measured: Tensor, poses: Tensor, scene: Scene, acts: Tensor, rows: Tensor, turn: Tensor) -> Tensor:
    """Estimates (N, 4, 4), those of ``rows`` with the refined orientation turned, about the centres of their bounds.

    Those that would hang in the air are moved along their viewing rays until gravity can do the rest.
    """
    center = scene.object_center.to(poses)[rows, :, None]
    upright = measured[rows].clone()
    middle = upright[:, :3, :3] @ center + upright[:, :3, 3:]
    upright[:, :3, :3] = turn @ poses[rows, :3, :3]
    down = scene.gravity.to(poses)[scene.image[rows.cpu()].to(poses.device)]
    reach = []
    for T in (poses[rows], upright):  # how far the objects reach down from their centres
        bodies = [scene.objects[i] for i in rows.tolist()]
        reach.append(
            torch.stack(
                [
                    ((body.parts.vertices.to(T) - c[:, 0]) @ (R.mT @ g)).amax()
                    for body, c, R, g in zip(bodies, center, T[:, :3, :3], down, strict=True)
                ]
            )
        )
    ray = torch.nn.functional.normalize(middle[:, :, 0], dim=1)
    slope = (ray * down).sum(1, keepdim=True)
    along = torch.where(slope > LEAST_SLOPE, ray / slope.clamp_min(LEAST_SLOPE), down)
    who, plane = scene.plane_pairs.to(poses.device).unbind(1)
    sigma = plane_variance(poses, scene, who, plane, acts).sqrt()
    sigma = poses.new_zeros(len(poses)).scatter_reduce(0, who, sigma, "amax")[rows]
    fall = (reach[0] - reach[1] - DROP - 3 * sigma).clamp_min(0.0)
    middle = middle + (fall[:, None] * along)[:, :, None]
    upright[:, :3, 3:] = middle - upright[:, :3, :3] @ center
    return measured.index_copy(0, rows, upright)


def _merged(first: Descent, again: Descent, images: Tensor, good: Tensor, at: Tensor, keep: Tensor) -> Descent:
    """The first result, with those of the images done again that are good, and the steps of both."""
    poses = first.poses.index_copy(0, at[keep], again.poses[keep])
    terms = PhysicsTerms(*(a.index_copy(0, at[keep], b[keep]) for a, b in zip(first.terms, again.terms, strict=True)))
    steps = first.steps.index_add(0, images, again.steps)
    converged = first.converged.index_copy(0, images[good], again.converged[good])
    trajectory = first.trajectory
    if trajectory is not None:
        more = trajectory[-1].expand(len(again.trajectory), *trajectory.shape[1:]).clone()
        more[:, at[keep]] = again.trajectory[:, keep]
        trajectory = torch.cat([trajectory, more])
    return Descent(poses, terms, steps, converged, trajectory, None)
