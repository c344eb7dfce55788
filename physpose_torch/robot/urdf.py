"""What a URDF says about collision shapes and joints, read once, checked, in float64.

The XML is read here and not by pytorch-kinematics, whose loader leaves out ``<collision>``, keeps offsets in float32 and
says nothing useful about a broken file. Document types and entities are refused: a robot description needs none.
"""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.parsers import expat

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from physpose_torch import se3
from physpose_torch.errors import DataError
from physpose_torch.reading import read_bytes

__all__ = ["Collision", "Joint", "Mimic", "RobotModel", "read_urdf"]

JOINTS = ("revolute", "continuous", "prismatic", "fixed")
SIZES = {"box": ("size", 3), "cylinder": ("radius length", 2), "sphere": ("radius", 1)}


@dataclass(frozen=True, eq=False)
class Collision:
    """One ``<collision>`` of a link."""

    kind: Literal["box", "cylinder", "sphere", "mesh"]
    size: tuple[float, ...]
    """Side lengths of a box; radius and length of a cylinder along z; radius of a sphere [m]; scale x, y, z of a mesh."""
    T_link_shape: Tensor
    """(4, 4) float64 [m]."""
    filename: str = ""
    """Of a mesh, as it stands in the file."""


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another: q = multiplier · q_other + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class Joint:
    """One ``<joint>``."""

    name: str
    kind: Literal["revolute", "continuous", "prismatic", "fixed"]
    parent: str
    child: str
    T_parent_joint: Tensor
    """(4, 4) float64, at q = 0 [m]."""
    axis: tuple[float, float, float]
    """Unit vector in the joint frame."""
    lower: float
    upper: float
    """Limits [rad] or [m]; infinite for a continuous joint."""
    mimic: Mimic | None = None


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A tree of links."""

    name: str
    links: dict[str, tuple[Collision, ...]]
    """Collision shapes of each link, in the file's order."""
    joints: tuple[Joint, ...]
    root: str
    """The link that nothing carries: its frame is the base frame."""
    path: Path

    def children(self, link: str) -> list[Joint]:
        """Joints that hang on a link, in the file's order."""
        return [j for j in self.joints if j.parent == link]


def read_urdf(path: str | Path) -> RobotModel:
    """Read links, collision shapes and joints of a URDF file.

    Raises:
        DataError: no such file, or larger than 1 GiB; not XML, or with a document type; not a robot; names that are missing,
            unknown or used twice; numbers that are no numbers or not positive where they must be; a joint of type floating or
            planar; links that are no tree. The message names file, link or joint.
    """
    path = Path(path)
    text = read_bytes(path)
    _refuse_entities(text, path)
    robot = ElementTree.fromstring(text)
    if robot.tag != "robot":
        raise DataError(f"{path}: the root element is <{robot.tag}>, expected <robot>")
    if any(isinstance(e.tag, str) and "xacro" in e.tag for e in robot.iter()):
        raise DataError(f"{path} is a xacro file; expand it first: xacro {path.name} > robot.urdf")
    links: dict[str, tuple[Collision, ...]] = {}
    for element in robot.findall("link"):
        name = _name(element, path)
        if name in links:
            raise DataError(f"{path}: two links are named {name!r}")
        where = f"{path}: link {name!r}"
        links[name] = tuple(
            _collision(c, f"{where}, collision {i}") for i, c in enumerate(element.findall("collision"))
        )
    if not links:
        raise DataError(f"{path}: there is no <link> in it")
    joints: dict[str, Joint] = {}
    for element in robot.findall("joint"):
        joint = _joint(element, path)
        if joint.name in joints:
            raise DataError(f"{path}: two joints are named {joint.name!r}")
        for end in (joint.parent, joint.child):
            if end not in links:
                raise DataError(f"{path}: joint {joint.name!r} names the link {end!r}, which there is not")
        joints[joint.name] = joint
    _check_mimics(joints, path)
    root = _root(links, joints, path)
    return RobotModel(robot.get("name", path.stem), links, tuple(joints.values()), root, path)


def _refuse_entities(text: bytes, path: Path) -> None:
    """Raise if the text is not XML, or declares a document type: entities can read files and blow up."""

    def refuse(name, *_):
        raise DataError(f"{path} declares a document type ({name}); remove the <!DOCTYPE …> of the file")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(text, True)
    except DataError:
        raise
    except (expat.ExpatError, LookupError, ValueError) as error:  # not well-formed, or in an encoding that there is not
        raise DataError(f"{path} is not XML: {error}; expected a URDF file") from error


def _name(element: ElementTree.Element, path: Path) -> str:
    name = element.get("name")
    if not name:
        raise DataError(f"{path}: a <{element.tag}> has no name")
    return name


def _numbers(element: ElementTree.Element | None, key: str, count: int, where: str, default: str) -> tuple[float, ...]:
    text = default if element is None else element.get(key, default)
    try:
        values = tuple(float(x) for x in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise DataError(f'{where}: {key}="{text}", expected {count} finite number{"s" if count > 1 else ""}')
    return values


def _origin(element: ElementTree.Element, where: str) -> Tensor:
    origin = element.find("origin")
    xyz = torch.tensor(_numbers(origin, "xyz", 3, where, "0 0 0"), dtype=torch.float64)
    rpy = _numbers(origin, "rpy", 3, where, "0 0 0")  # about fixed axes: x, then y, then z
    return se3.from_rotation_translation(torch.from_numpy(Rotation.from_euler("xyz", rpy).as_matrix()), xyz)


def _collision(element: ElementTree.Element, where: str) -> Collision:
    geometry = element.find("geometry")
    shape = None if geometry is None else next((e for e in geometry if isinstance(e.tag, str)), None)
    if shape is None or shape.tag not in (*SIZES, "mesh"):
        found = "nothing" if shape is None else f"<{shape.tag}>"
        raise DataError(f"{where}: its <geometry> holds {found}, expected box, cylinder, sphere or mesh")
    T = _origin(element, where)
    if shape.tag == "mesh":
        filename = shape.get("filename", "")
        if not filename:
            raise DataError(f"{where}: the mesh has no filename")
        scale = _numbers(shape, "scale", 3, where, "1 1 1")
        if 0.0 in scale:
            raise DataError(f"{where}: scale = {scale}, expected factors other than 0")
        return Collision("mesh", scale, T, filename)
    keys, count = SIZES[shape.tag]
    if shape.tag == "box":
        size = _numbers(shape, "size", count, where, "")
    else:
        size = tuple(_numbers(shape, key, 1, where, "")[0] for key in keys.split())
    if min(size) <= 0:
        raise DataError(f"{where}: {shape.tag} with {keys} = {size}, expected positive lengths [m]")
    return Collision(shape.tag, size, T)


def _joint(element: ElementTree.Element, path: Path) -> Joint:
    name = _name(element, path)
    where = f"{path}: joint {name!r}"
    kind = element.get("type", "")
    if kind not in JOINTS:
        raise DataError(f"{where} has type {kind!r}, expected one of {', '.join(JOINTS)}")
    ends = [getattr(element.find(tag), "attrib", {}).get("link") for tag in ("parent", "child")]
    if None in ends:
        raise DataError(f"{where} needs a <parent link=…> and a <child link=…>")
    axis, lower, upper, mimic = (1.0, 0.0, 0.0), -math.inf, math.inf, None
    if kind != "fixed":
        axis = _numbers(element.find("axis"), "xyz", 3, where, "1 0 0")
        length = math.hypot(*axis)
        if length < 1e-9:
            raise DataError(f"{where}: its axis is zero")
        axis = tuple(x / length for x in axis)
        limit = element.find("limit")
        if kind in ("revolute", "prismatic"):
            if limit is None:
                raise DataError(f"{where} is {kind} and has no <limit>; without limits a joint is continuous")
            lower, upper = (_numbers(limit, key, 1, where, "0")[0] for key in ("lower", "upper"))
            if lower > upper:
                raise DataError(f"{where}: limits from {lower} to {upper}, expected lower <= upper")
        other = element.find("mimic")
        if other is not None:
            factor, offset = (_numbers(other, k, 1, where, d)[0] for k, d in (("multiplier", "1"), ("offset", "0")))
            mimic = Mimic(other.get("joint", ""), factor, offset)
    return Joint(name, kind, *ends, _origin(element, where), axis, lower, upper, mimic)


def _check_mimics(joints: dict[str, Joint], path: Path) -> None:
    for joint in joints.values():
        if joint.mimic is None:
            continue
        other = joints.get(joint.mimic.joint)
        if other is None or other.kind == "fixed" or other.mimic is not None:
            raise DataError(
                f"{path}: joint {joint.name!r} mimics {joint.mimic.joint!r}, expected a joint that moves and mimics none"
            )


def _root(links: dict, joints: dict[str, Joint], path: Path) -> str:
    """The one link that is nobody's child, from which all others are reached."""
    carrier: dict[str, str] = {}
    for joint in joints.values():
        if joint.child in carrier:
            raise DataError(
                f"{path}: link {joint.child!r} hangs on two joints, {carrier[joint.child]!r} and {joint.name!r}"
            )
        carrier[joint.child] = joint.name
    roots = [name for name in links if name not in carrier]
    if len(roots) != 1:
        found = ", ".join(map(repr, roots)) or "none, there is a loop"
        raise DataError(f"{path}: expected one link that hangs on no joint, found {found}")
    reached, front = set(), [roots[0]]
    while front:
        link = front.pop()
        reached.add(link)
        front += [j.child for j in joints.values() if j.parent == link]
    if len(reached) != len(links):
        lost = ", ".join(repr(x) for x in links if x not in reached)
        raise DataError(f"{path}: {lost} cannot be reached from {roots[0]!r}; the joints form a loop")
    return roots[0]
