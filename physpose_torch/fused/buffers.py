"""A scene, its estimates and its poses as the structs of the kernels, in place in torch tensors."""

from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from physpose_torch.distance.warp import fill, wrap
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene

__all__ = ["FAR", "make_prior", "make_state", "make_world", "renew_rows"]

FAR = 1e30


def make_world(
    k: SimpleNamespace, scene: Scene, acts: Tensor, pairs: Tensor, dtype: torch.dtype, device: torch.device
) -> Any:
    """What stays; acts: (N,) bool, see :func:`physpose_torch.losses.acting`; pairs: (E, 2) entities that may meet."""
    n = len(scene)
    count = torch.bincount(scene.image, minlength=scene.n_images)
    first, second = pairs.unbind(1)
    felt = (second >= n) | acts[first] | acts[second.clamp_max(max(n - 1, 0))] if n else second >= n
    first, second = first[felt], second[felt]
    rows = scene.instance_start.diff()[first]
    pair = torch.arange(len(first))
    row_pair = torch.repeat_interleave(pair, rows)
    start = _starts(rows)
    slots = scene.instance_start.diff()[second[row_pair]]
    movable = second < n
    ends, sides = torch.cat([first, second[movable]]), torch.cat([pair, pair[movable]])
    planes = scene.plane_pairs
    world = k.World()
    world.n_objects = n
    return fill(
        world,
        {
            "image": (scene.entity_image, None),
            "instance_start": (scene.instance_start, None),
            "instance_part": (scene.instance_part, None),
            "gravity": (scene.gravity, k.vec3),
            "falls": ((scene.gravity != 0).any(-1).long(), None),
            "grounded": (((scene.gravity != 0).any(-1) & scene.has_static).long(), None),
            "acts": (acts.long(), None),
            "image_start": (_starts(count), None),
            "image_object": (torch.argsort(scene.image, stable=True), None),
            "pair_first": (first, None),
            "pair_second": (second, None),
            "pair_row": (start, None),
            "row_pair": (row_pair, None),
            "row_instance": (
                scene.instance_start[first[row_pair]] + torch.arange(len(row_pair)) - start[row_pair],
                None,
            ),
            "row_slot": (_starts(slots), None),
            "object_pair_start": (_starts(torch.bincount(ends, minlength=n)), None),
            "object_pair": (sides[torch.argsort(ends, stable=True)], None),
            "object_plane_start": (_starts(torch.bincount(planes[:, 0], minlength=n)), None),
            "object_plane": (planes[torch.argsort(planes[:, 0], stable=True), 1], None),
            "plane_normal": (scene.plane_normal, k.vec3),
            "plane_offset": (scene.plane_offset, None),
            "plane_covariance": (scene.plane_covariance, k.mat33),
            "center": (scene.object_center, k.vec3),
            "span": (scene.entity_span, None),
        },
        dtype,
        device,
    )


def make_prior(k: SimpleNamespace, prior: PosePrior, scale: Tensor, dtype: torch.dtype, device: torch.device) -> Any:
    """The flat estimates; scale: (N, 6, 6) L, steps are in units of it."""
    toward = (prior.precision[:, :3] * prior.ray[:, :, None]).sum(1)
    out = k.Prior()
    out.sigma_common = prior.sigma_common
    out.robust = 0.0 if prior.robust == float("inf") else prior.robust
    return fill(
        out,
        {
            "measured": (prior.measured, k.mat44),
            "precision": (prior.precision.reshape(-1, 6), k.vec6),
            "ray": (prior.ray, k.vec3),
            "toward": (toward, k.vec6),
            "curvature": ((toward[:, :3] * prior.ray).sum(1), None),
            "scale": (scale.reshape(-1, 6), k.vec6),
        },
        dtype,
        device,
    )


def make_state(
    k: SimpleNamespace, world: Any, scene: Scene, poses: Tensor, *, lm: bool
) -> tuple[Any, dict[str, Tensor]]:
    """What changes, in the dtype and on the device of ``poses``, and the tensors that it is made of, which keep it alive."""
    n, images = len(scene), scene.n_images
    entities, instances = len(scene.entity_image), len(scene.instance_entity)
    real = {"dtype": poses.dtype, "device": poses.device}
    whole = {"dtype": torch.int32, "device": poses.device}
    empty = torch.bincount(scene.image, minlength=images) == 0  # nothing to do
    shapes = {
        **dict.fromkeys(("lower", "upper"), (instances, 3)),
        **dict.fromkeys(("entity_lower", "entity_upper"), (entities, 3)),
        "moved": (entities,),
        "middle": (images, 3),
        **dict.fromkeys(
            ("farthest", "pose", "plane_cost", "plane_depth", "plane_height", "collision", "share", "gravity"), (n,)
        ),
        **dict.fromkeys(("depth_static", "depth_object", "height", "reach"), (n,)),
        **dict.fromkeys(("pose_slope", "follow_gradient", "follow_follow"), (n,)),
        **dict.fromkeys(("newton", "follow"), (n, 6)),
        "information": (images,),
        "plane_curvature": (n if lm else 0, 6, 6),
        **dict.fromkeys(("pose_gradient", "plane_gradient", "gradient"), (n, 6)),
    }
    counters = {
        "still": images,
        **dict.fromkeys(("plane_best", "plane_instance", "support"), n),
    }
    tensors = {name: torch.zeros(shape, **real) for name, shape in shapes.items()}
    tensors |= {name: torch.zeros(size, **whole) for name, size in counters.items()}
    tensors["poses"] = scene.entity_poses(poses).detach().to(**real).clone().contiguous()
    tensors["farthest"].fill_(FAR)  # nothing is at rest before it has moved
    tensors["done"] = empty.to(**whole)
    tensors["steps"] = torch.zeros(images, **whole)
    state = k.State()
    _set(k, state, tensors)
    renew_rows(k, state, tensors, world, lm=lm)
    return state, tensors


def renew_rows(k: SimpleNamespace, state: Any, tensors: dict[str, Tensor], world: Any, *, lm: bool) -> None:
    """Forget what was known of parts against each other: room for the pairs that the world names now."""
    rows, slots = len(world._tensors["row_pair"]), int(world._tensors["row_slot"][-1])
    real = {"dtype": tensors["poses"].dtype, "device": tensors["poses"].device}
    whole = {"dtype": torch.int32, "device": tensors["poses"].device}
    shapes = {
        **dict.fromkeys(("row_cost", "row_depth", "row_drop_a", "row_drop_b"), (rows,)),
        **dict.fromkeys(("row_force", "row_torque_a", "row_torque_b"), (rows, 3)),
        **dict.fromkeys(("row_curvature_a", "row_curvature_b"), (rows if lm else 0, 6, 6)),
        "slot_normal": (slots, 3),
    }
    new = {name: torch.zeros(shape, **real) for name, shape in shapes.items()}
    for name in ("row_count", "row_touches", "row_onto_a", "row_onto_b"):
        new[name] = torch.zeros(rows, **whole)
    for name, size in (("clear", rows), ("slot_clear", slots), ("slot_aside", slots)):
        new[name] = torch.full((size,), -FAR, **real)
    tensors.update(new)
    tensors["moved"].zero_()
    _set(k, state, new)


def _set(k: SimpleNamespace, state: Any, tensors: dict[str, Tensor]) -> None:
    kinds = {(3,): k.vec3, (6,): k.vec6, (4, 4): k.mat44, (6, 6): k.mat66}
    for name, tensor in tensors.items():
        setattr(state, name, wrap(tensor, kinds.get(tuple(tensor.shape[1:]))))


def _starts(count: Tensor) -> Tensor:
    return torch.cat([count.new_zeros(1), count.cumsum(0)])
