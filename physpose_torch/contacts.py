"""Who touches whom in a scene, how deep, and how far each object is above its support."""

from typing import NamedTuple

import torch
from torch import Tensor

from physpose_torch.config import Smoothing
from physpose_torch.distance.autograd import drop_distance, signed_distance
from physpose_torch.distance.broadphase import instance_bounds, meeting_pairs, pairs_below
from physpose_torch.distance.plane import half_space_distance
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.scene import Scene

__all__ = ["Contacts", "Drops", "find_contacts", "find_drops", "find_static_gaps", "object_heights"]

SUPPORT_SLOPE = 0.3
"""Least n·g at which a contact carries an object; a wall that is grazed on the way down does not."""
FAR = 1e3
"""[m]; how far down the paper's gravity looks for a static part."""


class Contacts(NamedTuple):
    """Signed distances of the part pairs that may touch. Entities: N objects, then S static bodies, then L planes."""

    distance: Tensor
    """(E,) [m], differentiable."""
    pair: Tensor
    """(E,) which of the D pairs of bodies below each part pair belongs to."""
    pair_first: Tensor
    """(D,) entity, always a movable object."""
    pair_second: Tensor
    """(D,) entity."""
    moves_first: Tensor
    """(D,) bool: the pair acts on its first body (not so if the second one is an alternative that pushes nobody)."""
    moves_second: Tensor
    """(D,) bool, likewise; False for statics."""
    variance: Tensor
    """(D,) variance of the static's surface where the first body is [m²]; 0 but for planes with a covariance."""


class Drops(NamedTuple):
    """How far each object is above what would carry it."""

    height: Tensor
    """(N,) [m], differentiable; 0 in contact, infinite where nothing within reach would carry it."""
    support: Tensor
    """(N,) entity that would carry it, numbered as in :class:`Contacts`; -1: none."""
    touching: Tensor
    """(N,) bool: gravity is off because something already carries or touches it."""
    variance: Tensor
    """(N,) variance of the support's surface there [m²]; 0 but for planes with a covariance."""


def find_contacts(
    poses: Tensor,
    scene: Scene,
    *,
    acts: Tensor | None = None,
    margin: float = 0.0,
    smoothing: Smoothing | None = None,
    backend: str = "auto",
) -> Contacts:
    """Signed distances of all part pairs whose boxes come within ``margin``, and of all parts to their planes.

    Args:
        poses: T_camera_object (N, 4, 4) [m].
        scene: the scene.
        acts: (N,) bool, False for alternatives that feel the scene and push nobody; None: all act.
        margin: [m].
        smoothing, backend: see :func:`physpose_torch.distance.autograd.signed_distance`.
    """
    n, device = len(scene), poses.device
    acts = _all_act(scene, acts)
    T = scene.entity_poses(poses)
    entity = scene.instance_entity
    entity_pairs = _felt(scene.near_pairs(T, margin), acts, n)
    pairs = meeting_pairs(_bounds(T, scene), entity, scene.instance_start, entity_pairs, margin=margin)
    first, second = entity[pairs[:, 0]], entity[pairs[:, 1]]
    moves_first, moves_second = _moves(first, second, acts, n)
    distance = signed_distance(
        _gather(T, first, moves_first),
        _gather(T, second, moves_second | (second >= n)),  # a static's pose may ask for gradients
        scene.parts,
        scene.instance_part[pairs],
        smoothing=smoothing,
        backend=backend,
    ).distance

    instance, plane = _plane_instances(scene)
    below = _above_planes(T, scene, instance, plane, smoothing)

    n_entities = len(scene.entity_image)
    ends = torch.stack([torch.cat([first, entity[instance]]), torch.cat([second, plane + n_entities])], dim=1)
    bodies, pair = torch.unique(ends, dim=0, return_inverse=True)
    moves = _moves(bodies[:, 0], bodies[:, 1], acts, n)
    variance = poses.new_zeros(len(bodies))
    planar = (bodies[:, 1] >= n_entities).nonzero()[:, 0]
    variance[planar] = plane_variance(poses, scene, bodies[planar, 0], bodies[planar, 1] - n_entities, acts)
    index = (x.to(device) for x in (pair, bodies[:, 0], bodies[:, 1], *moves))
    return Contacts(torch.cat([distance, below]), *index, variance)


def object_heights(poses: Tensor, scene: Scene) -> Tensor:
    """Signed distances (E,) of whole objects to planes [m], in the order of ``scene.plane_pairs``."""
    pairs = scene.plane_pairs
    instance, plane = _plane_instances(scene)
    height = _above_planes(scene.entity_poses(poses), scene, instance, plane, None)
    count = scene.instance_start.diff()[pairs[:, 0]]
    pair = torch.repeat_interleave(torch.arange(len(pairs)), count).to(poses.device)
    return poses.new_full((len(pairs),), torch.inf).scatter_reduce(0, pair, height.detach(), "amin")


def find_drops(
    poses: Tensor,
    scene: Scene,
    *,
    acts: Tensor | None = None,
    reach: Tensor | float,
    smoothing: Smoothing | None = None,
    backend: str = "auto",
) -> Drops:
    """How far each object can fall before it meets a plane, a static body or another object.

    Among objects the gradient is the falling one's alone: gravity pulls it down, it does not lift what is below.

    Args:
        poses, scene, acts, smoothing, backend: as in :func:`find_contacts`.
        reach: longer falls [m] count as endless; one for all, or (N,).
    """
    n, device = len(scene), poses.device
    acts = _all_act(scene, acts)
    T = scene.entity_poses(poses)
    entity, gravity = scene.instance_entity, scene.gravity.to(poses)
    reach = torch.as_tensor(reach, dtype=poses.dtype, device=device).expand(n)

    instance, plane = _plane_instances(scene)
    who_plane = entity[instance]
    above = _above_planes(T, scene, instance, plane, smoothing)
    down = gravity[scene.image[who_plane].to(device)]
    slope = -(scene.plane_normal.to(poses)[plane] * down).sum(-1)
    above = torch.where(slope >= SUPPORT_SLOPE, above.clamp_min(0.0) / slope.clamp_min(SUPPORT_SLOPE), torch.inf)
    above = torch.where(above <= reach[who_plane.to(device)], above, torch.inf)

    # only what may stop an object before its plane does is looked at
    to_plane = _least(above.detach(), who_plane.to(device), n)[0].minimum(reach).cpu()
    falls = (scene.gravity != 0).any(-1)
    both_ways = scene.near_pairs(T, float(to_plane.max()) if n else 0.0)
    both_ways = torch.cat([both_ways, both_ways.flip(1)])
    both_ways = both_ways[both_ways[:, 0] < n]
    carries = torch.ones(len(scene.entity_image), dtype=torch.bool)
    carries[:n] = acts
    both_ways = both_ways[
        carries[both_ways[:, 1]] & falls[scene.image[both_ways[:, 0]]] & (to_plane[both_ways[:, 0]] > 0)
    ]
    far = torch.cat([to_plane, to_plane.new_zeros(len(scene.entity_image) - n)])
    pairs = pairs_below(_bounds(T, scene), entity, scene.instance_start, both_ways, reach=far)
    who, onto = entity[pairs[:, 0]], entity[pairs[:, 1]]
    down = gravity[scene.image[who].to(device)]
    fall = drop_distance(
        _gather(T, who, torch.ones_like(who, dtype=torch.bool)),
        _gather(T, onto, onto >= n),
        scene.parts,
        scene.instance_part[pairs],
        down,
        limit=float(reach.max()) if n else 0.0,
        smoothing=smoothing,
        backend=backend,
    )
    carried = (fall.normal * down).sum(-1) >= SUPPORT_SLOPE
    height = torch.where(carried & (fall.distance <= reach[who.to(device)]), fall.distance, torch.inf)

    height = torch.cat([height, above])
    who = torch.cat([who, who_plane]).to(device)
    onto = torch.cat([onto, plane + len(scene.entity_image)]).to(device)
    least, which = _least(height.detach(), who, n)
    found = least.isfinite()
    lowest = torch.cat([height, height.new_full((1,), torch.inf)])[torch.where(found, which, len(height))]
    support = torch.where(found, torch.cat([onto, onto.new_full((1,), -1)])[torch.where(found, which, len(onto))], -1)
    return Drops(lowest, support, least <= 0.0, _support_variance(poses, scene, support, acts))


def find_static_gaps(
    poses: Tensor,
    scene: Scene,
    contacts: Contacts,
    *,
    acts: Tensor | None = None,
    tolerance: float,
    smoothing: Smoothing | None = None,
    backend: str = "auto",
) -> Drops:
    """The paper's gravity: mean positive distance of an object's parts to the static part nearest below (Eq. 9).

    Args:
        poses, scene, acts, smoothing, backend: as in :func:`find_contacts`.
        contacts: those of the same poses, with a margin of at least ``tolerance``.
        tolerance: an object any part of which is nearer than this to anything [m] feels no gravity.
    """
    n, device = len(scene), poses.device
    T = scene.entity_poses(poses)
    entity, start = scene.instance_entity, scene.instance_start
    static_pairs = scene.near_pairs(T, FAR)
    static_pairs = static_pairs[static_pairs[:, 1] >= n]
    falls = (scene.gravity != 0).any(-1)
    static_pairs = static_pairs[falls[scene.image[static_pairs[:, 0]]]]
    gravity = scene.gravity.to(poses)
    with torch.no_grad():
        pairs = pairs_below(_bounds(T, scene), entity, start, static_pairs, reach=FAR)
        who = entity[pairs[:, 0]].to(device)
        down = gravity[scene.image.to(device)[who]]
        fall = drop_distance(
            T[who],
            T[entity[pairs[:, 1]].to(device)],
            scene.parts,
            scene.instance_part[pairs],
            down,
            limit=FAR,
            backend=backend,
        )
        height = torch.where((fall.normal * down).sum(-1) >= SUPPORT_SLOPE, fall.distance, torch.inf)
        slope = -(scene.plane_normal[scene.plane_pairs[:, 1]] * scene.gravity[scene.image[scene.plane_pairs[:, 0]]]).sum(-1)
        plane_pairs = scene.plane_pairs[slope >= SUPPORT_SLOPE]  # and so with gravity; a wall carries nothing
        # all parts of the object against each plane of its image: the nearest part decides which static part is B
        instance, plane = _plane_instances(scene, plane_pairs)
        above = _above_planes(T, scene, instance, plane, None)
        candidate_who = torch.cat([who, entity[instance].to(device)])
        n_instances = len(entity)
        candidate = torch.cat([pairs[:, 1], plane + n_instances]).to(device)
        least, which = _least(torch.cat([height, above.clamp_min(0.0)]), candidate_who, n)
        found = least.isfinite()
        below = torch.where(
            found, torch.cat([candidate, candidate.new_full((1,), -1)])[torch.where(found, which, -1)], -1
        )

    chosen = below[entity[: int(start[n])].to(device)].cpu()  # what each object's instance is measured against
    instance = torch.arange(int(start[n]))
    on_body = ((chosen >= 0) & (chosen < n_instances)).nonzero()[:, 0]
    on_plane = (chosen >= n_instances).nonzero()[:, 0]
    to_body = signed_distance(
        T[entity[on_body].to(device)],
        T[entity[chosen[on_body]].to(device)],
        scene.parts,
        scene.instance_part[torch.stack([on_body, chosen[on_body]], dim=1)],
        smoothing=smoothing,
        backend=backend,
    ).distance
    to_plane = _above_planes(T, scene, on_plane, chosen[on_plane] - n_instances, smoothing)
    gap = poses.new_zeros(len(instance))
    gap = gap.index_put((on_body.to(device),), to_body).index_put((on_plane.to(device),), to_plane).clamp_min(0.0)
    count = start.diff()[:n].to(poses)
    mean = poses.new_zeros(n).index_add(0, entity[: len(instance)].to(device), gap) / count
    # an alternative that pushes nobody does not hold anybody up either
    nearest = poses.new_full((n,), torch.inf)
    for who, felt in ((contacts.pair_first, contacts.moves_first), (contacts.pair_second, contacts.moves_second)):
        felt = felt[contacts.pair]
        nearest = nearest.scatter_reduce(0, who[contacts.pair][felt], contacts.distance.detach()[felt], "amin")
    height = torch.where(below >= 0, mean, torch.inf)
    entity_below = (
        torch.where(
            below >= n_instances,
            below - n_instances + len(scene.entity_image),
            torch.where(below >= 0, entity.to(device)[below.clamp(0, n_instances - 1)], -1),
        )
        if n_instances
        else below
    )
    touching = nearest < tolerance
    return Drops(height, entity_below, touching, _support_variance(poses, scene, entity_below, _all_act(scene, acts)))


def plane_variance(poses: Tensor, scene: Scene, who: Tensor, plane: Tensor, acts: Tensor) -> Tensor:
    """Variance (E,) of the height of planes at objects [m²]: the offset's, and the tilts' times the distance from the
    point under the centre of the image's objects that act, to which a plane's covariance refers."""
    if not scene.plane_uncertain:
        return poses.new_zeros(len(who))
    with torch.no_grad():
        origin = scene.centers(poses)
        image = scene.image.to(poses.device)
        weight = acts.to(poses)
        count = poses.new_zeros(scene.n_images).index_add(0, image, weight).clamp_min(1)
        middle = poses.new_zeros(scene.n_images, 3).index_add(0, image, weight[:, None] * origin) / count[:, None]
        who = who.to(poses.device)
        lever = tangent_basis(scene.plane_normal.to(poses)[plane]) @ (origin[who] - middle[image[who]])[:, :, None]
        jacobian = torch.cat([lever[:, :, 0], torch.ones_like(lever[:, :1, 0])], dim=1)
        return torch.einsum("ei,eij,ej->e", jacobian, scene.plane_covariance.to(poses)[plane], jacobian)


def _support_variance(poses: Tensor, scene: Scene, support: Tensor, acts: Tensor) -> Tensor:
    n_entities = len(scene.entity_image)
    who = (support >= n_entities).nonzero()[:, 0]
    variance = poses.new_zeros(len(support))
    variance[who] = plane_variance(poses, scene, who, (support[who] - n_entities).cpu(), acts)
    return variance


def _bounds(T: Tensor, scene: Scene):
    entity = scene.instance_entity
    with torch.no_grad():
        bounds = instance_bounds(
            scene.seen_from_first(T.detach())[entity.to(T.device)],
            scene.parts,
            scene.instance_part.to(T.device),
            scene.gravity.to(T)[scene.entity_image[entity].to(T.device)],
        )
    return type(bounds)(*(x.cpu() for x in bounds))


def _above_planes(T: Tensor, scene: Scene, instance: Tensor, plane: Tensor, smoothing: Smoothing | None) -> Tensor:
    """Signed distances (E,) of part instances to planes."""
    return half_space_distance(
        T[scene.instance_entity[instance].to(T.device)],
        scene.parts,
        scene.instance_part[instance].to(T.device),
        scene.plane_normal.to(T)[plane],
        scene.plane_offset.to(T)[plane],
        smoothing=smoothing,
    ).distance


def _all_act(scene: Scene, acts: Tensor | None) -> Tensor:
    return torch.ones(len(scene), dtype=torch.bool) if acts is None else acts


def _felt(entity_pairs: Tensor, acts: Tensor, n: int) -> Tensor:
    """Pairs without those of two alternatives that push nobody: neither would feel the other."""
    moves = _moves(entity_pairs[:, 0], entity_pairs[:, 1], acts, n)
    return entity_pairs[moves[0] | moves[1]]


def _moves(first: Tensor, second: Tensor, acts: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Whether a contact acts on its first and on its second entity."""
    static = second >= n
    second_acts = static | acts[second.clamp_max(n - 1)] if n else static
    return second_acts, acts[first] & ~static


def _gather(T: Tensor, index: Tensor, moves: Tensor) -> Tensor:
    index, moves = index.to(T.device), moves.to(T.device)
    return torch.where(moves[:, None, None], T[index], T.detach()[index])


def _plane_instances(scene: Scene, plane_pairs: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """(instance, plane) of every part of every object with the planes of its image."""
    pairs = scene.plane_pairs if plane_pairs is None else plane_pairs
    count = scene.instance_start.diff()[pairs[:, 0]]
    pair = torch.repeat_interleave(torch.arange(len(pairs)), count)
    within = torch.arange(len(pair)) - (count.cumsum(0) - count)[pair]
    return scene.instance_start[pairs[pair, 0]] + within, pairs[pair, 1]


def _least(value: Tensor, group: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Least value (n,) of each group, infinite where it is empty, and the index (n,) of its first bearer."""
    least = value.new_full((n,), torch.inf).scatter_reduce(0, group, value, "amin")
    index = torch.arange(len(value), device=value.device)
    bearer = value == least[group]
    first = torch.full((n,), len(value), device=value.device).scatter_reduce(0, group[bearer], index[bearer], "amin")
    return least, first.clamp_max(max(len(value) - 1, 0))
