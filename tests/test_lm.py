"""The Gauss-Newton solver."""

import dataclasses

import pytest
import torch

from physpose_torch import (
    Body,
    InvalidInputError,
    PhysicsConfig,
    PhysPoseRefiner,
    Plane,
    RefinerConfig,
    Scene,
    Static,
    physics_report,
    se3,
)
from physpose_torch.losses import acting
from physpose_torch.prior import make_prior
from physpose_torch.solvers.descent import _principal_scale, make_cost

UP = torch.tensor([0.0, -0.8, -0.6], dtype=torch.float64)
TABLE = Plane(UP, torch.tensor(-0.5, dtype=torch.float64))
BOX = Body.box([0.06, 0.1, 0.08], label="box")
CAN = Body.cylinder(0.035, 0.11, label="can")


def standing(bodies, sink=0.0, spacing=0.2):
    """Poses (N, 4, 4) of bodies that stand on the table in a row, or are sunk into it along their rays [m]."""
    z = UP / UP.norm()
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    R = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
    foot = -0.5 * z + 0.7 * torch.linalg.cross(z, x) * -1.0
    poses = torch.eye(4, dtype=torch.float64).repeat(len(bodies), 1, 1)
    for k, body in enumerate(bodies):
        t = foot + 0.5 * float(body.upper[2] - body.lower[2]) * z + spacing * (k - 0.5 * (len(bodies) - 1)) * x
        poses[k, :3, :3], poses[k, :3, 3] = R, t * (1.0 + sink / t.norm())
    return poses


FAR_BELOW = Plane(UP, torch.tensor(-3.0, dtype=torch.float64))


@pytest.mark.parametrize("solver", ["lm", "descent"])
def test_without_pose_cost_contacts_alone_act(solver):
    scene, poses = Scene.tabletop([BOX, CAN], TABLE), standing([BOX, CAN], sink=0.02)
    config = RefinerConfig(PhysicsConfig(pose_weight=0.0), solver=solver, steps=20, righting=0.0)
    result = PhysPoseRefiner(config)(poses, scene)
    assert bool(result.poses.isfinite().all())
    assert float(result.report.penetration.max()) < 1e-3


@pytest.mark.parametrize("sigma_common", [0.0, 0.03])
def test_without_contacts_one_full_step_finds_the_minimum(sigma_common):
    """The pose cost is a quadratic, depth factor and all: from anywhere the step leads to the estimates."""
    scene = Scene([BOX, CAN, BOX], [Static(FAR_BELOW)])
    measured = standing([BOX, CAN, BOX])
    physics = PhysicsConfig(robust=float("inf"), sigma_depth_common=sigma_common)
    config = RefinerConfig(physics, solver="lm", damping=1e-9, max_step=10.0)
    generator = torch.Generator().manual_seed(0)
    shift = torch.randn(3, 6, generator=generator, dtype=torch.float64) * 0.02
    shift[:, 3:] = 0.0
    prior = make_prior(measured, scene, acting(scene, None), None, physics)
    start = se3.retract(measured, shift)
    cost = make_cost(prior, scene, acting(scene, None), config, start, _principal_scale(prior))
    cost.evaluate(0)
    cost.newton(1.0)
    cost.move()
    torch.testing.assert_close(cost.poses, measured, atol=1e-7, rtol=0.0)
    assert float((start - measured).abs().max()) > 0.01


def test_half_a_step_goes_half_the_way():
    scene, measured = Scene([BOX]), standing([BOX])
    physics = PhysicsConfig(robust=float("inf"))
    config = RefinerConfig(physics, solver="lm", damping=1e-9, max_step=10.0)
    prior = make_prior(measured, scene, acting(scene, None), None, physics)
    start = measured.clone()
    start[0, 0, 3] += 0.01
    cost = make_cost(prior, scene, acting(scene, None), config, start, _principal_scale(prior))
    cost.evaluate(0)
    cost.newton(0.5)
    cost.move()
    assert float(cost.poses[0, 0, 3] - measured[0, 0, 3]) == pytest.approx(0.005, abs=1e-7)


@pytest.mark.parametrize("sink", [0.005, 0.02, 0.03])
def test_sunken_objects_come_out_of_the_table(sink):
    bodies = [BOX, CAN, BOX, CAN]
    result = PhysPoseRefiner(RefinerConfig.lm())(standing(bodies, sink), Scene.tabletop(bodies, TABLE))
    assert float(result.report.penetration_static.max()) < 1e-3
    assert float(result.report.gap.max()) < 1e-3


def test_objects_inside_each_other_come_apart():
    bodies = [BOX, CAN]
    measured = standing(bodies, spacing=0.06)
    scene = Scene.tabletop(bodies, TABLE)
    before = physics_report(measured, scene)
    strict = dataclasses.replace(RefinerConfig.lm(), physics=PhysicsConfig(sigma_contact=0.0))
    result = PhysPoseRefiner(strict)(measured, scene)
    assert float(before.penetration_object.max()) > 4e-3
    # fifteen steps of blocks that know nothing of each other do not get all the way
    assert float(result.report.penetration_object.max()) < 0.4 * float(before.penetration_object.max())
    longer = PhysPoseRefiner(dataclasses.replace(strict, steps=40))(measured, scene)
    assert float(longer.report.penetration_object.max()) < 1e-3


def test_its_cost_is_no_higher_than_that_of_the_descent():
    bodies = [BOX, CAN, BOX, CAN, CAN]
    scene = Scene.tabletop(bodies, TABLE)
    measured = standing(bodies, 0.02, spacing=0.075)
    lm = PhysPoseRefiner(dataclasses.replace(RefinerConfig.lm(), steps=30))(measured, scene)
    descent = PhysPoseRefiner()(measured, scene)
    assert float(lm.terms.total.sum()) < 1.05 * float(descent.terms.total.sum()) + 0.01


def test_an_image_at_rest_stops_early():
    scene = Scene.tabletop([BOX], TABLE)
    result = PhysPoseRefiner(RefinerConfig.lm())(standing([BOX]), scene)
    assert bool(result.converged.all())
    assert int(result.steps.max()) < 10
    torch.testing.assert_close(result.poses, standing([BOX]), atol=1e-5, rtol=0.0)


def test_the_report_of_a_refinement_is_that_of_its_poses():
    bodies = [BOX, CAN, BOX]
    scene = Scene.tabletop(bodies, TABLE)
    for config in (RefinerConfig(), RefinerConfig.lm()):
        result = PhysPoseRefiner(config)(standing(bodies, 0.01, spacing=0.07), scene)
        again = physics_report(result.poses, scene)
        for name in ("penetration_static", "penetration_object", "gap"):
            torch.testing.assert_close(getattr(result.report, name), getattr(again, name), atol=1e-12, rtol=0.0)
        assert torch.equal(result.report.support, again.support)


@pytest.mark.parametrize("config", [RefinerConfig(), RefinerConfig.lm()], ids=["descent", "lm"])
def test_threads_change_no_bit(config, monkeypatch):
    monkeypatch.setattr("physpose_torch.fused.cost.LEAST_ROWS", 16)
    bodies = [BOX, CAN] * 5
    scene = Scene.cat([Scene.tabletop(bodies, TABLE)] * 4)
    measured = torch.cat([standing(bodies, 0.01 * k, spacing=0.055) for k in range(4)])
    threads, out = torch.get_num_threads(), []
    try:
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            out.append(PhysPoseRefiner(config)(measured, scene))
    finally:
        torch.set_num_threads(threads)
    for other in out[1:]:
        assert torch.equal(out[0].poses, other.poses)
        assert torch.equal(out[0].terms.total, other.terms.total)


def test_what_it_needs_is_said():
    for physics in (PhysicsConfig(backend="fcl"), PhysicsConfig(gravity="paper")):
        config = dataclasses.replace(RefinerConfig.lm(), physics=physics)
        with pytest.raises(InvalidInputError, match=r"lm.*warp"):
            PhysPoseRefiner(config)(standing([BOX]), Scene.tabletop([BOX], TABLE))
    with pytest.raises(InvalidInputError, match="solver"):
        RefinerConfig(solver="newton")
    with pytest.raises(InvalidInputError, match="damping"):
        RefinerConfig(damping=0.0)
