"""A made-up arm of seven joints with a parallel gripper and an eye-in-hand camera, written as a URDF of primitives.

It is no real robot's description: its lengths, limits and masses were chosen for this project, so that it reaches
over a table and its shapes of all kinds are seen by the camera.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from physpose_torch.files import write_file
from physpose_torch.robot.gripper import Gripper

__all__ = ["LOOK_ALONG", "LOOK_DOWN", "demo_arm"]

LOOK_DOWN = (0.0, -0.2, 0.0, 1.7, 0.0, math.pi - 1.5, 0.0, 0.045)
"""Joint values [rad], [m] at which the camera looks straight down, fingers open."""
LOOK_ALONG = (0.0, -0.9, 0.0, 2.4, 0.0, 0.5 * math.pi + math.radians(35) - 1.5, 0.0, 0.045)
"""Joint values [rad], [m] at which the camera looks ahead and down by 35°, fingers open."""


class _Segment(NamedTuple):
    """A link that turns about an axis of the one before, and the cylinder or sphere around it."""

    link: str
    height: float
    """Of its joint above the one before [m]."""
    axis: str
    limits: tuple[float, float]
    radius: float
    length: float
    """Of the cylinder along z; 0 for a sphere [m]."""
    centre: float
    """Height of the shape's centre above its joint [m]."""
    mass: float


SEGMENTS = (
    _Segment("shoulder", 0.14, "0 0 1", (-2.9, 2.9), 0.07, 0.2, 0.1, 3.2),
    _Segment("upper_arm", 0.18, "0 1 0", (-1.9, 1.9), 0.06, 0.24, 0.09, 2.8),
    _Segment("upper_elbow", 0.22, "0 0 1", (-2.9, 2.9), 0.055, 0.18, 0.09, 1.9),
    _Segment("forearm", 0.16, "0 1 0", (-0.3, 2.6), 0.05, 0.22, 0.08, 1.7),
    _Segment("lower_elbow", 0.2, "0 0 1", (-2.9, 2.9), 0.045, 0.14, 0.07, 1.2),
    _Segment("wrist", 0.16, "0 1 0", (-2.1, 2.1), 0.048, 0.0, 0.0, 0.8),
    _Segment("hand", 0.07, "0 0 1", (-3.05, 3.05), 0.032, 0.03, -0.01, 0.6),
)
BASE = _Segment("base", 0.0, "", (0.0, 0.0), 0.085, 0.14, 0.07, 4.5)
CAMERA = (-0.075, 0.0, 0.025)
"""Optical centre in the hand's frame [m]; the image's upper edge is on the side of the hand's -x."""
HOUSING = (0.09, 0.03, 0.028)
"""Side lengths of the camera along its x, y and z [m]."""


def demo_arm(path: str | Path, *, gripper: Gripper | None = None) -> Path:
    """Write the arm's URDF and return its path.

    Seven revolute joints ``joint_1`` … ``joint_7``, then ``finger_joint`` (prismatic, each finger's distance from the
    middle; the other finger mimics it). Frames worth knowing: ``tip``, the gripper's frame, and ``camera``, an OpenCV camera
    frame (z forward) on the hand, whose link has the housing as its collision shape.

    Args:
        path: file to write.
        gripper: its dimensions; None: the default.

    Raises:
        DataError: the file cannot be written.
    """
    g = gripper or Gripper()
    robot = ElementTree.Element("robot", name="arm7")
    robot.append(ElementTree.Comment(" written by physpose_torch.robot.arm.demo_arm; not a real robot "))
    _link(robot, BASE.link, BASE.mass, [_round(BASE)])
    parent = BASE.link
    for i, segment in enumerate(SEGMENTS, start=1):
        shapes = [_round(segment)]
        if segment.link == "hand":
            shapes.append(("box", (g.palm_width, g.palm_length, g.palm_height), (0.0, 0.0, 0.5 * g.palm_height)))
        _link(robot, segment.link, segment.mass, shapes)
        _joint(
            robot, f"joint_{i}", "revolute", parent, segment.link, (0, 0, segment.height), segment.axis, segment.limits
        )
        parent = segment.link
    finger = (g.finger_width, g.finger_thickness, g.finger_length)
    travel = (0.0, 0.5 * g.opening)
    for name, side in (("finger", 1), ("other_finger", -1)):
        _link(robot, name, 0.04, [("box", finger, (0.0, side * 0.5 * finger[1], 0.5 * finger[2]))])
        joint = _joint(robot, f"{name}_joint", "prismatic", "hand", name, (0, 0, g.palm_height), f"0 {side} 0", travel)
        if side < 0:
            ElementTree.SubElement(joint, "mimic", joint="finger_joint", multiplier="1", offset="0")
    _link(robot, "tip", 0.0, [])
    _joint(robot, "tip_joint", "fixed", "hand", "tip", (0, 0, g.palm_height + g.finger_length))
    _link(robot, "camera", 0.09, [("box", HOUSING, (0.0, 0.0, -0.5 * HOUSING[2]))])
    _joint(robot, "camera_joint", "fixed", "hand", "camera", CAMERA, rpy=(0, 0, -0.5 * math.pi))
    ElementTree.indent(robot)
    write_file(path, ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True))
    return Path(path)


def _round(segment: _Segment) -> tuple[str, tuple[float, ...], tuple[float, float, float]]:
    kind = "cylinder" if segment.length else "sphere"
    return kind, (segment.radius, segment.length)[: 2 if segment.length else 1], (0.0, 0.0, segment.centre)


def _link(robot: ElementTree.Element, name: str, mass: float, shapes: Sequence) -> None:
    """A link with equal shapes to see and to collide with, and the inertia of the last one at its mass."""
    link = ElementTree.SubElement(robot, "link", name=name)
    for kind, size, centre in shapes:
        for tag in ("visual", "collision"):
            element = ElementTree.SubElement(link, tag)
            ElementTree.SubElement(element, "origin", xyz=_text(centre), rpy="0 0 0")
            geometry = ElementTree.SubElement(element, "geometry")
            keys = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}[kind]
            values = (size,) if kind == "box" else tuple((x,) for x in size)
            ElementTree.SubElement(geometry, kind, {k: _text(v) for k, v in zip(keys, values, strict=True)})
    if not shapes:
        return
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_text(shapes[-1][2]), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=_text((mass,)))
    xx, yy, zz = _inertia(shapes[-1][0], shapes[-1][1], mass)
    moments = {"ixx": xx, "iyy": yy, "izz": zz, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
    ElementTree.SubElement(inertial, "inertia", {k: _text((v,)) for k, v in moments.items()})


def _inertia(kind: str, size: tuple[float, ...], mass: float) -> tuple[float, float, float]:
    """Principal moments of a solid about its centre [kg m²]."""
    if kind == "sphere":
        return (0.4 * mass * size[0] ** 2,) * 3
    if kind == "cylinder":
        side = mass * (3 * size[0] ** 2 + size[1] ** 2) / 12
        return side, side, 0.5 * mass * size[0] ** 2
    x, y, z = (s * s for s in size)
    return mass * (y + z) / 12, mass * (x + z) / 12, mass * (x + y) / 12


def _joint(robot, name, kind, parent, child, xyz, axis="", limits=None, rpy=(0, 0, 0)) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_text(xyz), rpy=_text(rpy))
    if axis:
        ElementTree.SubElement(joint, "axis", xyz=axis)
    if limits is not None:
        strength = {"effort": "60", "velocity": "2"} if kind == "revolute" else {"effort": "40", "velocity": "0.1"}
        ElementTree.SubElement(joint, "limit", lower=_text(limits[:1]), upper=_text(limits[1:]), **strength)
    return joint


def _text(values: Sequence[float]) -> str:
    return " ".join(f"{x:.12g}" for x in values)
