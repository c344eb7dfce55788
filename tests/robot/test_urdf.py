"""Reading URDF files: what is in them, and what is wrong with them."""

import math

import pytest
import torch

from physpose_torch.errors import DataError
from physpose_torch.robot.urdf import read_urdf

LINKS = '<link name="a"/><link name="b"/>'
ENDS = '<parent link="a"/><child link="b"/>'


def test_links_joints_and_shapes_are_as_written(write):
    model = read_urdf(write())
    assert (model.name, model.root) == ("two", "base")
    assert [len(x) for x in model.links.values()] == [1, 1, 2, 0]
    cylinder = model.links["upper"][0]
    assert (cylinder.kind, cylinder.size) == ("cylinder", (0.04, 0.3))
    assert cylinder.T_link_shape[:3, 2].tolist() == pytest.approx([1, 0, 0])  # its axis, pitched onto x
    turn, slide, mount = model.joints
    assert (turn.kind, turn.axis, turn.lower, turn.upper) == ("revolute", (0, 0, 1), -3, 3)
    assert slide.T_parent_joint[:3, 3].tolist() == [0.3, 0, 0]
    assert mount.T_parent_joint[:3, :3].diag().tolist() == pytest.approx([1, -1, -1])


def test_roll_pitch_and_yaw_turn_about_fixed_axes(write):
    path = write(
        f'<robot name="r">{LINKS}<joint name="j" type="fixed">{ENDS}<origin rpy="0.3 -0.4 1.1"/></joint></robot>'
    )

    def turn(axis, angle):
        c, s, i, j = math.cos(angle), math.sin(angle), (axis + 1) % 3, (axis + 2) % 3
        R = torch.eye(3, dtype=torch.float64)
        R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
        return R

    expected = turn(2, 1.1) @ turn(1, -0.4) @ turn(0, 0.3)
    assert torch.allclose(read_urdf(path).joints[0].T_parent_joint[:3, :3], expected, atol=1e-15)


def test_a_continuous_joint_has_no_limits(write):
    path = write(f'<robot name="r">{LINKS}<joint name="j" type="continuous">{ENDS}<axis xyz="0 1 0"/></joint></robot>')
    joint = read_urdf(path).joints[0]
    assert (joint.lower, joint.upper) == (-math.inf, math.inf)


def robot(inside, joint=""):
    return f'<robot name="r">{inside}{joint}</robot>'


def joint(inside="", kind="revolute", ends=ENDS, name="j"):
    return f'<joint name="{name}" type="{kind}">{ends}{inside}</joint>'


def shape(geometry, origin=""):
    return robot(f'<link name="a"><collision>{origin}<geometry>{geometry}</geometry></collision></link>')


LIMIT = '<limit lower="0" upper="1"/>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not xml", "is not XML"),
        ("<robot><link name='a'></robot>", "is not XML: mismatched tag"),
        ("<sdf/>", "root element is <sdf>"),
        ('<!DOCTYPE robot [<!ENTITY a "aaaa">]><robot><link name="a"/></robot>', "document type"),
        ('<!DOCTYPE robot SYSTEM "file:///etc/passwd"><robot><link name="a"/></robot>', "document type"),
        ('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="x"/></robot>', "xacro"),
        ("<robot/>", "no <link>"),
        (robot("<link/>"), "a <link> has no name"),
        (robot('<link name="a"/><link name="a"/>'), "two links are named 'a'"),
        (robot(LINKS, joint(LIMIT) + joint(LIMIT)), "two joints are named 'j'"),
        (robot(LINKS, joint(LIMIT, ends='<parent link="a"/><child link="c"/>')), "joint 'j' names the link 'c'"),
        (robot(LINKS, joint(LIMIT, ends='<parent link="a"/>')), "joint 'j' needs a <parent"),
        (robot(LINKS, joint(kind="floating")), "type 'floating', expected one of revolute"),
        (robot(LINKS, joint(kind="planar")), "type 'planar'"),
        (robot(LINKS, joint()), "has no <limit>"),
        (robot(LINKS, joint('<limit lower="2" upper="1"/>')), "limits from 2.0 to 1.0"),
        (robot(LINKS, joint(f'{LIMIT}<axis xyz="0 0 0"/>')), "its axis is zero"),
        (robot(LINKS, joint(f'{LIMIT}<axis xyz="0 nan 0"/>')), 'xyz="0 nan 0", expected 3 finite numbers'),
        (robot(LINKS, joint(f'{LIMIT}<mimic joint="k"/>')), "mimics 'k'"),
        (robot(LINKS, joint(f'{LIMIT}<mimic joint="j"/>')), "mimics 'j'"),
        (robot(LINKS), "expected one link that hangs on no joint, found 'a', 'b'"),
        (robot(LINKS, joint(LIMIT) + joint(LIMIT, name="k")), "hangs on two joints, 'j' and 'k'"),
        (robot(LINKS, joint(LIMIT) + joint(LIMIT, name="k", ends='<parent link="b"/><child link="a"/>')), "a loop"),
        (
            robot(
                '<link name="r"/>' + LINKS,
                joint(LIMIT) + joint(LIMIT, name="k", ends='<parent link="b"/><child link="a"/>'),
            ),
            "'a', 'b' cannot be reached from 'r'",
        ),
        (shape(""), "holds nothing"),
        (shape("<capsule/>"), "<capsule>, expected box, cylinder, sphere or mesh"),
        (shape('<box size="1 1"/>'), 'size="1 1", expected 3 finite numbers'),
        (shape('<box size="1 1 inf"/>'), "expected 3 finite"),
        (shape('<box size="1 0 1"/>'), "expected positive lengths"),
        (shape('<sphere radius="-1"/>'), "expected positive lengths"),
        (shape('<cylinder radius="1"/>'), 'length="", expected 1 finite number'),
        (shape("<mesh/>"), "mesh has no filename"),
        (shape('<mesh filename="a.stl" scale="1 0 1"/>'), "factors other than 0"),
        (shape('<box size="1 1 1"/>', '<origin xyz="0 0 x"/>'), "link 'a', collision 0: xyz=\"0 0 x\""),
    ],
)
def test_what_is_wrong_is_named(write, text, message):
    path = write(text)
    with pytest.raises(DataError) as error:
        read_urdf(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match=r"none\.urdf: cannot be read"):
        read_urdf(tmp_path / "none.urdf")
