"""Whether a gripper that was sent to an estimated pose gets hold of the object where it truly is, by geometry alone.

The paper's grasping test (end of its Sec. 4): handles lie 5 mm inside the surface, the gripper comes from above. The rules
are in :func:`judge_grasps`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import trimesh
from torch import Tensor

from physpose_torch import se3
from physpose_torch.distance.autograd import drop_distance, signed_distance
from physpose_torch.distance.plane import half_space_distance
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.robot.gripper import Gripper

__all__ = ["OUTCOMES", "GraspRules", "Handle", "Outcome", "grasp_pose", "judge_grasps"]

Outcome = Literal["held", "hits table", "hits object", "hits another", "misses", "off the pads", "slips"]
OUTCOMES: tuple[Outcome, ...] = ("held", "hits table", "hits object", "hits another", "misses", "off the pads", "slips")
SIDES = (1.0, -1.0)
"""Of the gripper's y axis: the two fingers."""
LEAST_HELD = 1e-4
"""[m]; fingers that come nearer than this to each other hold nothing."""
SAME = 1e-4
"""[m]; parts that a finger meets within this of the first one are met together."""


@dataclass(frozen=True)
class Handle:
    """Where to close a gripper on an object; object frame, metres."""

    name: str
    point: tuple[float, float, float]
    """Where the middle between the fingers' tips goes."""
    closing: tuple[float, float, float]
    """Unit vector along which the fingers close."""
    width: float
    """Of what is between the fingers there."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Axis that must point up for this handle to be of use."""


@dataclass(frozen=True)
class GraspRules:
    """When a grasp counts as one."""

    clearance: float = 0.01
    """The fingers open to the handle's width and this much more on each side [m], at most as far as they can."""
    descent: float = 0.25
    """The gripper comes straight down over this length [m]."""
    pad_margin: float = 0.001
    """A pad's outermost millimetres hold nothing [m]."""
    pad_tolerance: float = 0.0005
    """A pad has contact if it comes as near to the object as its whole finger does, within this [m]."""
    friction: float = 0.5
    """Coefficient of Coulomb friction between pad and object; its cone has the half angle atan(0.5) = 27°."""


def grasp_pose(handle: Handle, T_world_object: Tensor, up: Tensor) -> Tensor:
    """T_world_gripper (..., 4, 4) of a gripper that comes straight down on a handle.

    Its z axis is exactly ``-up``, its y axis the handle's closing direction with what points up or down left out; so a tilt
    in the object's pose moves the gripper and does not tilt it.

    Args:
        handle: the handle.
        T_world_object: (..., 4, 4) poses that the gripper believes in [m].
        up: (3,) unit vector, world frame.

    Raises:
        InvalidInputError: the closing direction is vertical.
    """
    up = up.to(T_world_object)
    closing = T_world_object[..., :3, :3] @ torch.tensor(handle.closing).to(up)
    closing = closing - (closing @ up)[..., None] * up
    length = torch.linalg.vector_norm(closing, dim=-1, keepdim=True)
    if bool((length < 1e-3).any()):
        raise InvalidInputError(
            f"handle {handle.name!r} closes along gravity; a gripper from above needs a horizontal direction"
        )
    y, z = closing / length, (-up).expand_as(closing)
    R = torch.stack([torch.linalg.cross(y, z), y, z], dim=-1)
    return se3.from_rotation_translation(R, se3.apply(T_world_object, torch.tensor([handle.point]).to(up))[..., 0, :])


def judge_grasps(
    T_world_gripper: Tensor,
    widths: Sequence[float],
    targets: Sequence[int],
    T_world_object: Tensor,
    bodies: Sequence[Body],
    plane: Plane,
    *,
    gripper: Gripper | None = None,
    rules: GraspRules | None = None,
) -> list[Outcome]:
    """What becomes of each of G attempts, none of which changes the scene for the others. The first that fits:

    1. ``hits table``, ``hits object``, ``hits another``: the open gripper, swept straight down over ``descent`` (the fingers'
       and the palm's boxes, lengthened upwards), overlaps the table, its own object's convex parts or another's.
    2. ``misses``: closing along ±y, one of the fingers meets nothing of its object before the fingers meet each other.
       ``hits another``: a finger meets another object before its own one.
    3. ``off the pads``: a finger touches its object somewhere else before the pad does. The pad is the inner face without a
       margin at its edges; so at least the margin of the finger must reach below the edge of the object.
    4. ``slips``: the angle between the closing axis and the object's surface normal at the contact, of either finger, is
       larger than atan(friction). With pads that press along the closing axis and resist turning, this is force closure.
    5. ``held``.

    What is not looked at: the object stays where it is until both fingers touch, though the first one pushes it by the
    error of the estimate (at most ``clearance``, or the object would have been hit on the way down); weight and tipping.

    Args:
        T_world_gripper: (G, 4, 4) where the gripper goes, see :func:`grasp_pose`; world may be the camera frame [m].
        widths: (G,) of the handles [m].
        targets: (G,) index of the object that each is meant for.
        T_world_object: (N, 4, 4) where the objects truly are [m].
        bodies: the N objects.
        plane: the table, world frame.
        gripper, rules: None: the defaults.

    Raises:
        InvalidInputError: lengths do not fit, a pose is not rigid, or a handle is wider than the gripper opens.
    """
    gripper, rules = gripper or Gripper(), rules or GraspRules()
    T = T_world_gripper.detach().double()
    _check(T, widths, targets, T_world_object, bodies, gripper)
    if len(T) == 0:
        return []
    parts = ConvexParts.cat([_gripper_parts(gripper, rules), *(b.parts for b in bodies)])
    n_objects = parts.n_parts - len(_PARTS)
    owner = torch.repeat_interleave(parts.part_start.diff()[1:])  # of each part of an object
    T_part = T_world_object.detach().double()[owner]
    opening = torch.tensor(widths, dtype=torch.float64) + 2 * rules.clearance
    T_finger = {side: T @ _beside(side * 0.5 * opening.clamp_max(gripper.opening), side) for side in SIDES}
    opening = opening.clamp_max(gripper.opening)
    target = torch.as_tensor(targets)
    own = owner == target[:, None]  # (G, parts)

    def against(T_a: Tensor, part: str, run) -> Tensor:
        """Whatever ``run`` says of one part of the gripper against all parts of the objects, (G, parts, …)."""
        first = torch.full((len(T_a) * n_objects,), _PARTS.index(part))
        second = torch.arange(n_objects).repeat(len(T_a)) + len(_PARTS)
        T_first, T_second = T_a.repeat_interleave(n_objects, 0), T_part.repeat(len(T_a), 1, 1)
        found = run(T_first, T_second, parts, torch.stack([first, second], 1))
        return [x.unflatten(0, (len(T_a), n_objects)) for x in (found.distance, found.normal)]

    hit = torch.zeros(len(T), n_objects, dtype=torch.bool)
    in_table = torch.zeros(len(T), dtype=torch.bool)
    for T_a, part in ((T_finger[1.0], "swept finger"), (T_finger[-1.0], "swept finger"), (T, "swept palm")):
        hit |= against(T_a, part, signed_distance)[0] < 0
        index = torch.full((len(T),), _PARTS.index(part))
        normal, offset = plane.normal.to(T).expand(len(T), 3), plane.offset.to(T).expand(len(T))
        in_table |= half_space_distance(T_a, parts, index, normal.detach(), offset.detach()).distance < 0

    touched, on_pad, normal_fits = [], [], []
    first_is_another = torch.zeros(len(T), dtype=torch.bool)
    for side in SIDES:
        inward = -side * T[:, :3, 1]

        def close(T_a, T_b, parts, pairs, inward=inward):
            return drop_distance(T_a, T_b, parts, pairs, inward.repeat_interleave(n_objects, 0), limit=gripper.opening)

        travel, _ = against(T_finger[side], "finger", close)
        pad, normal = against(T_finger[side], "pad", close)
        mine = torch.where(own, travel, torch.inf).amin(1)
        first_is_another |= torch.where(own, torch.inf, travel).amin(1) < mine.clamp_max(gripper.opening)
        pad = torch.where(own, pad, torch.inf)
        nearest = pad.amin(1)
        together = pad <= nearest[:, None] + SAME
        cosine = torch.where(together & pad.isfinite(), (normal @ inward[:, :, None])[..., 0], -1.0).amax(1)
        touched.append(mine)
        on_pad.append(nearest <= mine + rules.pad_tolerance)
        normal_fits.append(cosine >= math.cos(math.atan(rules.friction)))
    held = opening - touched[0] - touched[1] > LEAST_HELD
    outcomes: list[Outcome] = []
    for g in range(len(T)):
        if bool(in_table[g]):
            outcomes.append("hits table")
        elif bool((hit & own)[g].any()):
            outcomes.append("hits object")
        elif bool(hit[g].any()):
            outcomes.append("hits another")
        elif not bool(held[g]):
            outcomes.append("misses")
        elif bool(first_is_another[g]):
            outcomes.append("hits another")
        elif not all(bool(x[g]) for x in on_pad):
            outcomes.append("off the pads")
        elif not all(bool(x[g]) for x in normal_fits):
            outcomes.append("slips")
        else:
            outcomes.append("held")
    return outcomes


_PARTS = ("finger", "pad", "swept finger", "swept palm")


def _gripper_parts(g: Gripper, rules: GraspRules) -> ConvexParts:
    """Boxes of the gripper. Those of a finger lie on the +y side of a frame in its inner face, tip at z = 0; a gripper is
    symmetric, so the other finger is the same one turned by half a turn."""
    x, sweep = 0.5 * g.finger_width, rules.descent
    finger = [[-x, 0, -g.finger_length], [x, g.finger_thickness, 0]]
    m = rules.pad_margin
    pad = [[-x + m, 0, -g.pad_height + m], [x - m, 0.5 * g.finger_thickness, -m]]
    swept = [[-x, 0, -g.finger_length - sweep], [x, g.finger_thickness, 0]]
    a, b, top = 0.5 * g.palm_width, 0.5 * g.palm_length, g.finger_length + g.palm_height
    palm = [[-a, -b, -top - sweep], [a, b, -g.finger_length]]
    boxes = (trimesh.creation.box(bounds=bounds).vertices for bounds in (finger, pad, swept, palm))
    return ConvexParts.from_hulls(list(boxes))


def _beside(y: Tensor, side: float) -> Tensor:
    """(G, 4, 4): the frame in the inner face of a finger at y, in the gripper frame; half a turn about z on the other side."""
    T = torch.eye(4, dtype=torch.float64).repeat(len(y), 1, 1)
    T[:, 0, 0] = T[:, 1, 1] = side
    T[:, 1, 3] = y
    return T


def _check(T, widths, targets, T_world_object, bodies, gripper: Gripper) -> None:
    se3.check_rigid(T, "T_world_gripper")
    se3.check_rigid(T_world_object, "T_world_object")
    if T.ndim != 3 or not len(T) == len(widths) == len(targets):
        raise InvalidInputError(
            f"T_world_gripper {tuple(T.shape)}, {len(widths)} widths, {len(targets)} targets: expected (G, 4, 4), G and G"
        )
    if T_world_object.shape != (len(bodies), 4, 4):
        raise InvalidInputError(
            f"T_world_object has shape {tuple(T_world_object.shape)}, expected ({len(bodies)}, 4, 4)"
        )
    for width, target in zip(widths, targets, strict=True):
        if not 0 < width < gripper.opening:
            raise InvalidInputError(f"a handle is {width} m wide, expected more than 0 and less than {gripper.opening}")
        if not 0 <= target < len(bodies):
            raise InvalidInputError(f"target {target}: there are {len(bodies)} objects")
