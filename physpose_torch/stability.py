"""Whether objects would stay where they are: the centre of mass over the polygon of what carries an object, or beside it."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.contacts import SUPPORT_SLOPE
from physpose_torch.distance.autograd import signed_distance
from physpose_torch.distance.broadphase import instance_bounds, pairs_below
from physpose_torch.distance.plane import half_space_distance
from physpose_torch.scene import Scene

__all__ = ["BALANCE", "Posed", "stability_margin"]

TOLERANCE = 5e-3
"""[m]; what is this near along gravity may touch: a face of 60 mm that lies 5° askew lifts its far edge by as much."""
TILT = math.radians(5)
"""A point counts as support if the object would come to stand on it when tilted by up to this [rad]. Estimates, and even
true poses and tables of real data, disagree by a few degrees, and this makes all corners of a face that is meant to lie
flat count. Of a ball only a spot of radius r · tan(TILT) counts."""
BALANCE = 1e-6
"""[m]; a margin below this is balance on a point or an edge, not a stand."""
DIRECTIONS = 64
"""Sides towards which an object is tilted; a multiple of 4. Polygons of fewer corners come out exact, others within the
sagitta of an arc of 360° / 64, which is 0.1 % of its radius."""
ROUNDING = 1e-6
"""[m]; edges that run along the border of a face touch it."""
MOST_NUMBERS = 1 << 16
"""Distances of edges to faces that are computed at once."""


class Posed(NamedTuple):
    """A flat scene as it was when it was measured: later changes of poses or planes in place are not seen."""

    scene: Scene
    T: Tensor
    """(N + S, 4, 4) poses of objects and static bodies, float64 [m]."""
    plane_normal: Tensor
    """(L, 3)."""
    plane_offset: Tensor
    """(L,) [m]."""
    acts: Tensor
    """(N,) bool, on the CPU: False for alternatives, which carry nobody."""
    gap: Tensor
    """(N,) how far each object can drop [m]; NaN without gravity, infinite without anything below."""
    backend: str

    @classmethod
    def of(cls, poses: Tensor, scene: Scene, acts: Tensor, gap: Tensor, backend: str) -> "Posed":
        """Keep poses (N, 4, 4) of a scene with what else :func:`stability_margin` needs."""
        T = scene.entity_poses(poses.detach().double()).detach().clone()
        normal, offset = (x.detach().to(T).clone() for x in (scene.plane_normal, scene.plane_offset))
        return cls(scene, T, normal, offset, acts.cpu(), gap.detach().double(), backend)


class _Contacts(NamedTuple):
    """Points that may carry an object."""

    who: Tensor
    """(Q,) object."""
    point: Tensor
    """(Q, 3) in the camera frame, of the object dropped onto its support [m]."""
    height: Tensor
    """(Q,) height above what it would carry there [m], 0 in contact or inside."""


def stability_margin(
    posed: Posed, *, only: Tensor | None = None, tolerance: float = TOLERANCE, tilt: float = TILT
) -> Tensor:
    """Distance (N,) of each centre of mass, seen along gravity, to the border of the support polygon [m].

    Positive inside the polygon, negative outside, -inf where nothing carries the object, NaN without gravity.

    The object is judged where it lands when it drops by its gap. What carries it are planes, static bodies and other
    objects, at contacts whose normal has n·g ≥ ``SUPPORT_SLOPE``; a carrier need not be stable itself. Contact patches
    are those of the convex parts: edges of the one clipped against the other, within ``TOLERANCE``. Which of these points
    are corners of the polygon is found by tilting the object to all sides, see ``TILT``. Friction is taken to be enough.

    Args:
        posed: the scene.
        only: (N,) bool, which objects to look at; the others get NaN.
        tolerance, tilt: instead of ``TOLERANCE`` [m] and ``TILT`` [rad].
    """
    n, scene = len(posed.scene), posed.scene
    gravity = scene.gravity.to(posed.T)[scene.image.to(posed.T.device)]
    falls = (gravity != 0).any(-1)
    if only is not None:
        falls = falls & only.to(falls.device)
    margin = torch.where(falls, -torch.inf, torch.nan).to(posed.T)
    if not n:
        return margin
    fall = torch.where(posed.gap.isfinite(), posed.gap, 0.0)
    dropped = posed.T.clone()
    dropped[:n, :3, 3] += fall[:, None] * gravity
    contacts = [look(posed, dropped, gravity, falls, tolerance) for look in (_on_planes, _on_bodies)]
    who, point, height = (torch.cat(x) for x in zip(*contacts, strict=True))
    if not len(who):
        return margin
    center = torch.stack([body.center_of_mass for body in scene.objects]).to(posed.T)
    center = se3.apply(dropped[:n], center[:, None])[:, 0]
    axes = _level_axes(posed.T[:n], gravity)
    level = (axes[who] @ (point - center[who])[:, :, None])[:, :, 0]
    carried = torch.bincount(who, minlength=n) > 0
    return torch.where(carried & falls, _polygon_margin(who, level, height, n, tilt), margin)


def _level_axes(T: Tensor, gravity: Tensor) -> Tensor:
    """Two horizontal unit vectors (N, 2, 3) that turn with the object: what is measured along them knows no camera."""
    along = (T[:, :3, :3] * gravity[:, :, None]).sum(1)
    axis = along.abs().argmin(1)
    x = T[torch.arange(len(T), device=T.device), :3, axis]
    x = torch.nn.functional.normalize(x - (x * gravity).sum(-1, keepdim=True) * gravity, dim=-1)
    return torch.stack([x, torch.linalg.cross(-gravity, x)], dim=1)


def _polygon_margin(who: Tensor, point: Tensor, height: Tensor, n: int, tilt: float) -> Tensor:
    """Signed distance (N,) of the origin to the border of the polygon of points (Q, 2) at heights (Q,), per object."""
    angle = torch.arange(DIRECTIONS, device=point.device, dtype=point.dtype) * (2 * math.pi / DIRECTIONS) + 0.01
    side = torch.stack([angle.cos(), angle.sin()], dim=1)
    corner = torch.stack([_farthest(who, point, point @ u - height / math.tan(tilt), n) for u in side], dim=1)
    # a lower point may stand in for a farther, higher one: corners in order of the hull, which is what carries
    along = corner @ side.mT
    corner = torch.gather(corner, 1, along.argmax(1)[:, :, None].expand(-1, -1, 2))

    edge = corner.roll(-1, 1) - corner
    length = torch.linalg.vector_norm(edge, dim=-1)
    outward = torch.stack([edge[..., 1], -edge[..., 0]], dim=-1) / length.clamp_min(BALANCE)[..., None]
    inside = torch.where(length > BALANCE, (outward * corner).sum(-1), torch.inf).amin(1)
    inside = torch.where((length > BALANCE).any(1), inside, -torch.inf)
    along = (-(corner * edge).sum(-1) / (length**2).clamp_min(BALANCE**2)).clamp(0.0, 1.0)
    outside = torch.linalg.vector_norm(corner + along[..., None] * edge, dim=-1).amin(1)
    return torch.where(inside > 0, inside, -outside)


def _farthest(who: Tensor, point: Tensor, score: Tensor, n: int) -> Tensor:
    """The point (N, 2) of each object with the highest score, the first among equals; 0 for objects without points."""
    best = score.new_full((n,), -torch.inf).scatter_reduce(0, who, score, "amax")
    bearer = (score == best[who]).nonzero()[:, 0]
    first = torch.full((n,), len(who), device=who.device).scatter_reduce(0, who[bearer], bearer, "amin")
    return torch.cat([point, point.new_zeros(1, 2)])[first]


def _on_planes(posed: Posed, dropped: Tensor, gravity: Tensor, wanted: Tensor, tolerance: float) -> _Contacts:
    """Where edges of the objects' parts are near planes."""
    scene, device = posed.scene, dropped.device
    pairs = scene.plane_pairs.to(device)
    slope = -(posed.plane_normal[pairs[:, 1]] * gravity[pairs[:, 0]]).sum(-1)
    pairs = pairs[(slope >= SUPPORT_SLOPE) & wanted[pairs[:, 0]]]
    start = scene.instance_start.to(device)
    pair, instance = _spread(start[pairs[:, 0]], start.diff()[pairs[:, 0]])
    who, plane = pairs[pair].unbind(1)
    part = scene.instance_part.to(device)[instance]
    normal, offset = posed.plane_normal[plane], posed.plane_offset[plane]
    near = half_space_distance(dropped[who], scene.parts, part, normal, offset).distance <= tolerance
    who, plane, part = who[near], plane[near], part[near]
    row, ends = _edges(scene, part, (gravity[who][:, None] @ dropped[who, :3, :3])[:, 0])
    who, normal, offset = who[row], posed.plane_normal[plane][row], posed.plane_offset[plane][row]
    a, b = (se3.apply(dropped[who], x[:, None])[:, 0] for x in ends.unbind(1))
    slope = -(normal * gravity[who]).sum(-1)
    return _clipped(who, a, b, normal[:, None], offset[:, None], slope[:, None], tolerance)


def _on_bodies(posed: Posed, dropped: Tensor, gravity: Tensor, wanted: Tensor, tolerance: float) -> _Contacts:
    """Where edges of the objects' parts are near parts of other bodies below, and the other way round."""
    scene, device, n = posed.scene, dropped.device, len(posed.scene)
    carries = torch.ones(len(scene.entity_image), dtype=torch.bool)
    carries[:n] = posed.acts
    reach = torch.zeros(len(scene.entity_image), dtype=torch.float64)
    reach[:n] = posed.gap.cpu() + tolerance
    pairs = scene.near_pairs(posed.T, float(torch.where(reach.isfinite(), reach, 0.0).max()))
    pairs = torch.cat([pairs, pairs.flip(1)])
    pairs = pairs[(pairs[:, 0] < n) & carries[pairs[:, 1]]]
    pairs = pairs[wanted.cpu()[pairs[:, 0]]]
    pairs = pairs[reach[pairs[:, 0]].isfinite()]  # with gravity, and something below
    entity = scene.instance_entity
    down = torch.cat([gravity, gravity.new_zeros(len(scene.entity_image) - n, 3)])
    frame = scene.gravity.to(posed.T)[scene.entity_image.to(device)]
    bounds = instance_bounds(
        posed.T[entity.to(device)], scene.parts, scene.instance_part.to(device), frame[entity.to(device)]
    )
    bounds = type(bounds)(*(x.cpu() for x in bounds))
    instances = pairs_below(bounds, entity, scene.instance_start, pairs, reach=reach)
    who, onto = entity[instances].to(device).unbind(1)
    part = scene.instance_part[instances]
    found = signed_distance(dropped[who], posed.T[onto], scene.parts, part, backend=posed.backend)
    slope = (found.normal * down[who]).sum(-1)
    keep = (slope >= SUPPORT_SLOPE) & (found.distance <= tolerance)
    who, onto, part, slope = who[keep], onto[keep], part.to(device)[keep], slope[keep]
    height = found.distance[keep].clamp_min(0.0) / slope
    nearest = _Contacts(who, found.point_a[keep], height)
    above, below = part.unbind(1)
    down = gravity[who]
    contacts = [
        nearest,
        _on_parts(scene, who, dropped[who], above, posed.T[onto], below, -down, tolerance),
        _on_parts(scene, who, posed.T[onto], below, dropped[who], above, down, tolerance),
    ]
    return _Contacts(*(torch.cat(x) for x in zip(*contacts, strict=True)))


def _on_parts(
    scene: Scene, who: Tensor, T: Tensor, part: Tensor, T_onto: Tensor, onto: Tensor, towards: Tensor, tolerance: float
) -> _Contacts:
    """Where edges of parts at poses T (D, 4, 4) are inside other parts, or near them as seen from ``towards`` (D, 3)."""
    T_onto_part = se3.inverse(T_onto) @ T
    row, ends = _edges(scene, part, -(towards[:, None] @ T[:, :3, :3])[:, 0])
    towards = (towards[:, None] @ T_onto[:, :3, :3])[:, 0]
    a, b = (se3.apply(T_onto_part[row], x[:, None])[:, 0] for x in ends.unbind(1))
    # most edges are far from the other part
    parts = scene.parts.reference
    lower, upper = (x.to(T)[onto] for x in (parts.lower, parts.upper))
    shift = tolerance * towards
    lower, upper = (lower + shift.clamp_max(0.0) - ROUNDING), (upper + shift.clamp_min(0.0) + ROUNDING)
    near = ((torch.maximum(a, b) >= lower[row]) & (torch.minimum(a, b) <= upper[row])).all(-1)
    row, a, b = row[near], a[near], b[near]
    normals, offsets = (x.to(T) for x in (parts.face_normals, parts.face_offsets))
    out = []
    for rows in torch.split(torch.arange(len(row), device=T.device), max(MOST_NUMBERS // normals.shape[1], 1)):
        r = row[rows]
        faces, offset = normals[onto[r]], offsets[onto[r]]
        slope = (faces @ towards[r][:, :, None])[:, :, 0]
        found = _clipped(r, a[rows], b[rows], faces, offset, slope, tolerance)
        out.append(_Contacts(who[found.who], se3.apply(T_onto[found.who], found.point[:, None])[:, 0], found.height))
    if not out:
        return _Contacts(who[:0], T.new_zeros(0, 3), T.new_zeros(0))
    return _Contacts(*(torch.cat(x) for x in zip(*out, strict=True)))


def _edges(scene: Scene, part: Tensor, facing: Tensor) -> tuple[Tensor, Tensor]:
    """Edges of those faces of parts (D,) that look towards ``facing`` (D, 3): which of the D, and their ends (E, 2, 3).

    All in the body frame [m].
    """
    parts, device = scene.parts.reference, part.device
    facets = parts.facets
    start = facets.edge_start.to(device)
    row, edge = _spread(start[part], start.diff()[part])
    edge = facets.edges.to(device)[edge]
    sides = facets.normals.to(device)[edge[:, 2:] + facets.start.to(device)[part[row], None]]
    seen = ((sides @ facing[row][:, :, None])[:, :, 0] > 0).any(1)
    row, edge = row[seen], edge[seen]
    return row, parts.vertices.to(device)[edge[:, :2] + parts.vertex_start.to(device)[part[row], None]]


def _clipped(
    who: Tensor, a: Tensor, b: Tensor, normals: Tensor, offsets: Tensor, slope: Tensor, tolerance: float
) -> _Contacts:
    """Both ends of what of segments a-b (E, 3) lies in convex bodies given by faces (E, F, 3), (E, F).

    Faces with ``slope`` (E, F), normal · towards, of ``SUPPORT_SLOPE`` or more carry: they are moved outwards by
    ``tolerance`` along ``towards``. The others are walls and stay.
    """
    carrying = slope >= SUPPORT_SLOPE
    grown = offsets + tolerance * torch.where(carrying, slope, 0.0) + ROUNDING
    above_a, above_b = ((normals @ x[:, :, None])[:, :, 0] for x in (a, b))
    first, change = above_a - grown, above_b - above_a
    crossing = -first / torch.where(change == 0, 1.0, change)
    begin = torch.where(change < 0, crossing, 0.0).amax(1).clamp_min(0.0)
    end = torch.where(change > 0, crossing, 1.0).amin(1).clamp_max(1.0)
    hits = (begin <= end) & ((change != 0) | (first <= 0)).all(1)
    who, a, b, above_a, change = (x[hits] for x in (who, a, b, above_a, change))
    offsets, slope, carrying = (x[hits] for x in (offsets, slope, carrying))
    points, heights = [], []
    for t in (begin[hits, None], end[hits, None]):
        points.append(a + t * (b - a))
        height = (above_a + t * change - offsets) / torch.where(carrying, slope, 1.0)
        heights.append(torch.where(carrying, height, 0.0).amax(1).clamp_min(0.0))
    return _Contacts(who.repeat(2), torch.cat(points), torch.cat(heights))


def _spread(start: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """For every i the ``count[i]`` numbers from ``start[i]`` on, one range after another: the i of each, and the number."""
    owner = torch.repeat_interleave(count)
    within = torch.arange(len(owner), device=count.device) - (count.cumsum(0) - count)[owner]
    return owner, start[owner] + within
