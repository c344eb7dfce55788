"""A camera on a robot: kinematics by hand, gravity, tables, batches, gradients, and refinement among links."""

import math

import numpy as np
import pytest
import torch
from robot_files import TWO_JOINTS

from physpose_torch import se3
from physpose_torch.config import PhysicsConfig, RefinerConfig, Smoothing
from physpose_torch.contacts import find_contacts, plane_variance
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.losses import PhysicsLoss
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.robot.arm import LOOK_ALONG, LOOK_DOWN, demo_arm
from physpose_torch.robot.environment import RobotEnvironment
from physpose_torch.robot.gripper import Gripper
from physpose_torch.scene import Scene, Static

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
EXACT = Smoothing("none")
ONE = '<robot name="r"><link name="a"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link></robot>'


@pytest.fixture
def two(write):
    return RobotEnvironment.from_urdf(write(), camera_link="camera")


@pytest.fixture
def arm(tmp_path):
    table = Plane(UP, torch.tensor(0.0, dtype=torch.float64))
    return RobotEnvironment.from_urdf(
        demo_arm(tmp_path / "arm.urdf"), camera_link="camera", table=table, ignore_links=["camera"]
    )


def by_label(statics, image=0):
    return {s.shape.label: s.T_camera_body for s in statics if isinstance(s.shape, Body) and s.image == image}


# ---- kinematics


def test_links_are_where_a_drawing_puts_them(two):
    """The arm turned left by 90° and drawn out by 0.2 m: its end is 0.5 m along y, 0.1 m up; the camera looks down on it."""
    poses = two.link_poses(torch.tensor([math.pi / 2, 0.2]))
    assert poses["slider"][:3, 3].tolist() == pytest.approx([0, 0.5, 0.1], abs=1e-6)
    assert poses["slider"][:3, 0].tolist() == pytest.approx([0, 1, 0], abs=1e-6)
    T = two.camera_pose(torch.tensor([math.pi / 2, 0.2]))
    assert T[:3, 3].tolist() == pytest.approx([0, 0.5, 0.3], abs=1e-6)
    assert T[:3, 2].tolist() == pytest.approx([0, 0, -1], abs=1e-6)
    assert T[:3, 0].tolist() == pytest.approx([0, 1, 0], abs=1e-6)


def test_statics_and_gravity_are_seen_from_the_camera(two):
    statics, gravity = two([math.pi / 2, 0.2])
    assert gravity.tolist() == pytest.approx([0, 0, 1], abs=1e-12)  # it looks straight down
    where = by_label(statics)
    assert list(where) == ["base", "upper", "slider"]  # the camera has no shape
    # the base's origin is 0.5 m back along the arm and 0.3 m below
    assert where["base"][:3, 3].tolist() == pytest.approx([-0.5, 0, 0.3], abs=1e-12)
    assert where["slider"][:3, 3].tolist() == pytest.approx([0, 0, 0.2], abs=1e-12)


def test_q_by_name_is_q_by_number(two):
    by_number = two.camera_pose([0.4, 0.1])
    assert two.joint_names == ["turn", "slide"]
    assert torch.allclose(two.camera_pose({"slide": 0.1, "turn": 0.4}), by_number, atol=1e-15)
    batch = two.camera_pose({"slide": torch.tensor([0.1, 0.2], dtype=torch.float64), "turn": 0.4})
    assert torch.allclose(batch[0], by_number, atol=1e-8)


def test_dtype_of_q_comes_back(two, dtype):
    statics, gravity = two(torch.tensor([0.4, 0.1], dtype=dtype))
    assert {gravity.dtype, *(s.T_camera_body.dtype for s in statics)} == {dtype}


def test_kinematics_are_those_of_pytorch_kinematics_own_loader(arm):
    import pytorch_kinematics as pk

    chain = pk.build_chain_from_urdf(arm.model.path.read_bytes())
    q = torch.tensor([0.3, -0.4, 0.5, 1.2, -0.6, 0.7, 0.8, 0.02])
    assert chain.get_joint_parameter_names() == [*arm.joint_names, "other_finger_joint"]
    found = chain.forward_kinematics(torch.cat([q, q[-1:]]))
    for name, T in arm.link_poses(q.double()).items():
        assert torch.allclose(found[name].get_matrix()[0].double(), T, atol=1e-6)


def test_a_joint_that_mimics_follows(arm):
    poses = arm.link_poses([0, 0, 0, 0, 0, 0, 0, 0.03])
    apart = poses["finger"][:3, 3] - poses["other_finger"][:3, 3]
    assert apart.tolist() == pytest.approx([0, 0.06, 0], abs=1e-12)
    assert "other_finger_joint" not in arm.joint_names


def test_a_robot_without_joints_and_a_camera_on_its_base(write):
    env = RobotEnvironment.from_urdf(write(ONE), camera_link="a", T_link_camera=torch.eye(4))
    statics, gravity = env(torch.zeros(0, dtype=torch.float64))
    assert torch.equal(statics[0].T_camera_body, torch.eye(4, dtype=torch.float64))
    assert gravity.tolist() == [0, 0, -1]
    assert len(env(torch.zeros(3, 0))[0]) == 3


def test_the_arm_of_the_demo_looks_where_it_says(arm):
    statics, gravity = arm(LOOK_DOWN)
    assert gravity.tolist() == pytest.approx([0, 0, 1], abs=1e-9)
    _, gravity = arm(LOOK_ALONG)
    down = math.radians(35)
    assert gravity.tolist() == pytest.approx([0, math.cos(down), math.sin(down)], abs=1e-9)
    for q in (LOOK_DOWN, LOOK_ALONG):
        statics, _ = arm(q)
        plane = next(s.shape for s in statics if isinstance(s.shape, Plane))
        height = -float(plane.offset)  # of the camera, which is the origin
        assert height == pytest.approx(float(arm.camera_pose(q)[2, 3]))
        assert 0.5 < height < 0.7
    assert len(arm.joint_names) == 8
    assert bool((arm.limits[:, 0] < arm.limits[:, 1]).all())


def test_the_arm_of_the_demo_does_not_run_into_itself_or_the_table(arm):
    for q in (LOOK_DOWN, LOOK_ALONG):
        statics, _ = arm(q)
        bodies = [s for s in statics if isinstance(s.shape, Body) and s.shape.label != "base"]
        scene = Scene([s.shape for s in bodies], [s for s in statics if isinstance(s.shape, Plane)])
        contacts = find_contacts(torch.stack([s.T_camera_body for s in bodies]), scene)
        inside = contacts.distance < 0
        first, second = contacts.pair_first[contacts.pair][inside], contacts.pair_second[contacts.pair][inside]
        labels = [s.shape.label for s in bodies]
        # neighbours share a joint; the fingers end in the palm, and the wrist's ball fills the space around it
        near = {(a, b) for a, b in zip(first.tolist(), second.tolist(), strict=True) if abs(a - b) > 1}
        assert {(labels[a], labels[b]) for a, b in near} <= {("hand", "other_finger"), ("lower_elbow", "hand")}


def test_the_hand_of_the_demo_arm_is_the_gripper(tmp_path):
    gripper = Gripper(opening=0.06, finger_length=0.07)
    env = RobotEnvironment.from_urdf(demo_arm(tmp_path / "a.urdf", gripper=gripper), camera_link="tip")
    assert env.bodies["finger"].mesh.extents.tolist() == pytest.approx([0.018, 0.009, 0.07])
    assert env.limits[-1].tolist() == [0, 0.03]
    where = env.link_poses([0.0] * 8)
    assert float((where["tip"] - where["finger"])[2, 3]) == pytest.approx(0.07)


# ---- what stands around


def test_a_table_of_the_base_frame_is_under_its_points_in_the_camera_frame(two):
    normal = torch.nn.functional.normalize(torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64), dim=0)
    env = RobotEnvironment(two.model, camera_link="camera", table=Plane(normal, torch.tensor(0.03).double()))
    q = torch.tensor([0.7, 0.3], dtype=torch.float64)
    plane = env(q).statics[-1].shape
    on_table = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    on_table = on_table - (on_table @ normal - 0.03)[:, None] * normal
    seen = se3.apply(se3.inverse(env.camera_pose(q)), on_table)
    assert torch.allclose(seen @ plane.normal, plane.offset, atol=1e-12)


def test_the_uncertainty_of_a_table_does_not_depend_on_the_camera(two, box):
    """The variance of the table's height at an object is the same in the base frame and in every camera."""
    covariance = torch.tensor([[4e-4, 1e-4, 0], [1e-4, 1e-4, 0], [0, 0, 1e-6]], dtype=torch.float64)
    table = Plane(UP, torch.tensor(0.0).double(), covariance)
    env = RobotEnvironment(two.model, camera_link="camera", table=table)
    T_base = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T_base[:, :3, 3] = torch.tensor([[0.5, 0.1, 0.02], [0.2, -0.3, 0.02]])
    index, acts = torch.tensor([0, 1]), torch.ones(2, dtype=torch.bool)
    expected = plane_variance(T_base, Scene([box, box], [Static(table)]), index, 0 * index, acts)
    for q in ([0.0, 0.0], [0.9, 0.2], [-2.0, 0.4]):
        statics = [s for s in env(q).statics if isinstance(s.shape, Plane)]
        T = se3.inverse(env.camera_pose(q)) @ T_base
        assert torch.allclose(plane_variance(T, Scene([box, box], statics), index, 0 * index, acts), expected)


def test_fixtures_stand_still_in_the_base_frame(two, box):
    T_base_box = se3.from_rotation_translation(torch.eye(3).double(), torch.tensor([0.4, 0.3, 0.2]).double())
    env = RobotEnvironment(two.model, camera_link="camera", fixtures=[(box, T_base_box)])
    for q in ([0.0, 0.0], [1.0, 0.4]):
        T = by_label(env(q).statics)["box"]
        assert torch.allclose(env.camera_pose(q) @ T, T_base_box)


def test_a_robot_may_hang_upside_down(two):
    env = RobotEnvironment(two.model, camera_link="camera", gravity_base=(0, 0, 1))
    assert torch.equal(env([0.3, 0.1]).gravity, -two([0.3, 0.1]).gravity)


def test_links_may_be_left_out(two):
    env = RobotEnvironment(two.model, camera_link="camera", ignore_links=["slider", "camera"])
    assert list(by_label(env([0, 0]).statics)) == ["base", "upper"]


# ---- hand–eye


def test_the_hand_eye_transform_moves_all_and_may_be_given_for_each_image(two):
    X = se3.from_rotation_translation(
        se3.exp_so3(torch.tensor([0.2, -0.1, 0.3]).double()), torch.tensor([0.01, 0.02, 0.03]).double()
    )
    q = torch.tensor([[0.2, 0.1], [0.5, 0.3]], dtype=torch.float64)
    plain, gravity = two(q)
    for given in (X, X.expand(2, 4, 4)):
        moved, moved_gravity = two(q, T_link_camera=given)
        for a, b in zip(plain, moved, strict=True):
            assert torch.allclose(b.T_camera_body, se3.inverse(X) @ a.T_camera_body)
        assert torch.allclose(moved_gravity, gravity @ X[:3, :3])
    fixed = RobotEnvironment(two.model, camera_link="camera", T_link_camera=X)
    assert torch.equal(fixed(q)[1], moved_gravity)


# ---- batches


def test_a_batch_of_images_is_each_image_alone(arm, box):
    q = torch.tensor([LOOK_DOWN, LOOK_ALONG], dtype=torch.float64)
    statics, gravity = arm(q)
    assert gravity.shape == (2, 3)
    poses, scenes = [], []
    for i in range(2):
        alone = arm(q[i])
        assert torch.allclose(alone.gravity, gravity[i])
        for name, T in by_label(alone.statics).items():
            assert torch.allclose(by_label(statics, i)[name], T)
        T_base = se3.from_rotation_translation(
            se3.exp_so3(torch.tensor([0.1, 0.05, 0.2]).double()), torch.tensor([0.6, 0.0, 0.015]).double()
        )
        poses.append(se3.inverse(arm.camera_pose(q[i])) @ T_base)
        scenes.append(Scene([box], alone.statics, gravity=alone.gravity))
    whole = Scene([box, box], statics, gravity=gravity, image=torch.tensor([0, 1]))
    refined = PhysPoseRefiner()(torch.stack(poses), whole)
    for i in range(2):
        assert torch.allclose(PhysPoseRefiner()(poses[i][None], scenes[i]).poses[0], refined.poses[i], atol=1e-6)
    assert float(refined.report.penetration.max()) < 1e-3


# ---- gradients


def slanted(write):
    """The two joints on a base that leans, over a table that leans: whatever moves the camera changes every distance."""
    text = TWO_JOINTS.replace('<origin xyz="0 0 0.05"/>', '<origin xyz="0 0 0.05" rpy="0.25 -0.15 0.3"/>')
    normal = torch.nn.functional.normalize(torch.tensor([0.15, -0.2, 1.0], dtype=torch.float64), dim=0)
    return RobotEnvironment.from_urdf(
        write(text), camera_link="camera", table=Plane(normal, torch.tensor(-0.2).double())
    )


@pytest.mark.parametrize("form", ["support", "paper"])
@pytest.mark.parametrize("term", ["collision", "gravity", "total"])
def test_the_gradient_in_joints_and_hand_eye_is_the_finite_difference(write, form, term):
    """Objects stay where the camera sees them: one in the base, one above it, one above the table."""
    env = slanted(write)
    q0 = torch.tensor([0.4, 0.25], dtype=torch.float64)
    xi0 = torch.tensor([0.01, -0.02, 0.03, 0.05, -0.1, 0.2], dtype=torch.float64)
    where = torch.tensor([[0.13, 0.02, 0.04], [-0.04, 0.03, 0.17], [0.5, 0.3, -0.15]], dtype=torch.float64)
    R = se3.exp_so3(torch.tensor([0.2, 0.1, 0.3]).double()).expand(3, 3, 3)
    eye = torch.eye(4, dtype=torch.float64)
    T_base_camera = env.camera_pose(q0, T_link_camera=se3.retract(eye, xi0))
    poses = se3.inverse(T_base_camera) @ se3.from_rotation_translation(R, where)
    bodies = [Body.box(e, label="box") for e in ((0.07, 0.05, 0.06), (0.05, 0.03, 0.04), (0.05, 0.03, 0.04))]
    loss = PhysicsLoss(PhysicsConfig(gravity=form, smoothing=EXACT, collision_weight=20.0, gravity_weight=10.0))

    def terms(q, xi):
        statics, gravity = env(q, T_link_camera=se3.retract(eye, xi))
        return loss(poses, Scene(bodies, statics, gravity=gravity))

    at = terms(q0, xi0)
    assert float(at.collision[0]) > 1e-3
    assert float(at.gravity[1:].min()) > 1e-3
    q, xi = q0.clone().requires_grad_(), xi0.clone().requires_grad_()
    gradients = torch.autograd.grad(getattr(terms(q, xi), term).sum(), (q, xi))
    step = 1e-6
    for which, found in enumerate(gradients):
        assert float(found.abs().min()) > 1e-3 if which == 0 else float(found.abs().max()) > 1e-3
        for k in range(len(found)):
            e = step * torch.eye(len(found), dtype=torch.float64)[k]
            ends = [terms(*((q0 + s * e, xi0) if which == 0 else (q0, xi0 + s * e))) for s in (1, -1)]
            expected = float(getattr(ends[0], term).sum() - getattr(ends[1], term).sum()) / (2 * step)
            assert float(found[k]) == pytest.approx(expected, abs=1e-4 * float(found.abs().max())), (which, k)


def test_joint_values_are_found_by_descending_the_physics(two):
    """A wrong encoder value puts the arm into a box that is known to be clear of it; the gradient in q takes it out."""
    true = torch.tensor([0.4, 0.25], dtype=torch.float64)
    upper = two.link_poses(true)["upper"]
    T_base = upper @ se3.from_rotation_translation(torch.eye(3).double(), torch.tensor([0.2, 0.075, 0.0]).double())
    box = Body.box((0.06, 0.06, 0.06), label="box")
    q = torch.tensor([0.55, 0.25], dtype=torch.float64, requires_grad=True)
    depths = []
    optimizer = torch.optim.Adam([q], lr=0.01)
    for _ in range(30):
        # the box's pose is known in the base frame, the camera moves with q
        T = se3.inverse(two.camera_pose(q)) @ T_base
        statics, gravity = two(q)
        cost = PhysicsLoss()(T[None], Scene([box], statics, gravity=gravity)).collision.sum()
        depths.append(float(cost.detach()))
        optimizer.zero_grad()
        if cost.requires_grad and float(cost.detach()) > 0:
            cost.backward()
            optimizer.step()
    assert depths[0] > 5e-3
    assert depths[-1] < 1e-4


# ---- refinement


@pytest.mark.parametrize(
    ("preset", "left"), [("default", 1.5e-3), ("lm", 4e-3), pytest.param("paper", 1.5e-3, marks=pytest.mark.slow)]
)
def test_an_object_inside_a_link_is_pushed_out(two, box, preset, left):
    """A box that lies on the arm, estimated 12 mm too low."""
    statics, gravity = two([0.4, 0.25])
    T_camera_arm = by_label(statics)["upper"]
    true = torch.tensor([0.15, 0.0, 0.04 + 0.02], dtype=torch.float64)
    sunk = T_camera_arm @ se3.from_rotation_translation(torch.eye(3).double(), true - 0.012 * UP)
    scene = Scene([box], statics, gravity=gravity)
    config = {"default": RefinerConfig(), "lm": RefinerConfig.lm(), "paper": RefinerConfig.paper()}[preset]
    before, after = physics_report(sunk[None], scene), PhysPoseRefiner(config)(sunk[None], scene)
    assert float(before.penetration_static) == pytest.approx(0.012, abs=3e-4)  # the prism is a little thicker
    assert float(after.report.penetration_static) < left
    moved = se3.inverse(T_camera_arm) @ after.poses[0]
    assert float(moved[2, 3]) > 0.06 - left


def test_an_object_is_set_on_the_table_that_the_robot_knows(arm, box):
    statics, gravity = arm(LOOK_ALONG)
    T_base = torch.eye(4, dtype=torch.float64)
    T_base[:3, 3] = torch.tensor([0.8, 0.0, 0.02])
    truth = se3.inverse(arm.camera_pose(LOOK_ALONG)) @ T_base
    estimate = truth.clone()
    estimate[:3, 3] *= 1.03
    refined = PhysPoseRefiner()(estimate[None], Scene([box], statics, gravity=gravity))
    height = (arm.camera_pose(LOOK_ALONG) @ refined.poses[0])[2, 3]
    assert float(height) == pytest.approx(0.02, abs=2e-3)
    assert refined.report.supporter == ["plane"]


# ---- errors


@pytest.mark.parametrize(
    ("q", "message"),
    [
        ([0.1], r"shape \(1,\), expected \(2,\) or \(I, 2\) for 'turn', 'slide'"),
        (torch.zeros(1, 2, 2), "expected"),
        ([math.nan, 0.0], "NaN"),
        ([30.0, 0.0], "'turn' at 30 is beyond its limits -3 to 3; angles are in radians"),
        ([0.0, -0.1], "'slide' at -0.1 is beyond"),
        ({"turn": 0.1}, "missing: 'slide'"),
        ({"turn": 0.1, "slide": 0.1, "lift": 0.2}, "unknown: 'lift'"),
        ({"turn": torch.zeros(2), "slide": torch.zeros(3)}, "shapes"),
    ],
)
def test_joint_values_that_do_not_fit_are_named(two, q, message):
    with pytest.raises(InvalidInputError, match=message):
        two(q)


def test_encoders_may_be_off_by_a_little_beyond_the_limits(two):
    assert len(two([3.01, -0.001]).statics) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera_link": "eye"}, "no link 'eye' in .*it has 'base', 'upper', 'slider', 'camera'"),
        ({"ignore_links": ["arm"]}, "ignore_links: there is no link 'arm'"),
        ({"ignore_links": "base"}, "is a string"),
        ({"T_link_camera": torch.eye(3)}, "T_link_camera has shape"),
        ({"T_link_camera": 2 * torch.eye(4)}, "T_link_camera"),
        ({"T_link_camera": torch.eye(4).expand(2, 4, 4)}, r"expected \(4, 4\)"),
        ({"gravity_base": (0, 0, -9.81)}, "unit vector"),
        ({"table": Body.box((1, 1, 1), label="t")}, "bodies go into fixtures"),
        ({"fixtures": [(Body.box((1, 1, 1), label="t"), torch.eye(3))]}, "fixture 't'"),
    ],
)
def test_arguments_that_do_not_fit_the_robot_are_named(write, options, message):
    with pytest.raises(InvalidInputError, match=message):
        RobotEnvironment.from_urdf(write(), **{"camera_link": "camera", **options})


def test_a_hand_eye_transform_for_another_number_of_images_is_named(two):
    with pytest.raises(InvalidInputError, match=r"expected \(4, 4\) or \(2, 4, 4\)"):
        two(torch.zeros(2, 2), T_link_camera=torch.eye(4).expand(3, 4, 4))


def test_the_demo_arm_needs_a_folder(tmp_path):
    with pytest.raises(DataError, match="cannot be written"):
        demo_arm(tmp_path / "none" / "arm.urdf")


def test_numpy_values_are_fine(two):
    assert torch.equal(two(np.array([0.1, 0.2])).gravity, two([0.1, 0.2]).gravity)


# ---- Transform3d


def test_a_transform3d_is_as_good_as_its_matrices(two, box):
    from pytorch_kinematics import Transform3d

    q = torch.tensor([0.4, 0.25], dtype=torch.float64)
    T = two.camera_pose(q)
    statics, gravity = two(q, T_link_camera=Transform3d(matrix=torch.eye(4).double()))
    inside = statics[1].T_camera_body @ se3.from_rotation_translation(
        torch.eye(3).double(), torch.tensor([0.15, 0.05, 0]).double()
    )
    scene = Scene([box], statics, gravity=gravity)
    wrapped = Transform3d(matrix=inside[None])
    assert torch.equal(
        PhysicsLoss()(wrapped, scene, measured=wrapped).total,
        PhysicsLoss()(inside[None], scene, measured=inside[None]).total,
    )
    assert torch.equal(PhysPoseRefiner()(wrapped, scene).poses, PhysPoseRefiner()(inside[None], scene).poses)
    assert torch.equal(physics_report(wrapped, scene).penetration, physics_report(inside[None], scene).penetration)
    static = Static(box, Transform3d(matrix=T[None]))
    assert torch.equal(static.T_camera_body, T)
    with pytest.raises(InvalidInputError, match=r"\(2, 4, 4\)"):
        Static(box, Transform3d(matrix=T.expand(2, 4, 4).contiguous()))
