"""Gradients through the refiner: against finite differences of whole refinements, and finite wherever it starts."""

import math

import pytest
import torch

from physpose_torch import se3
from physpose_torch.config import Caution, PhysicsConfig, RefinerConfig, Smoothing
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene, Static

SIGMA = torch.tensor([0.002] * 3 + [0.026] * 3, dtype=torch.float64)
"""Units in which Jacobians are compared [m, rad]."""
H = (1e-5, 1e-4)


def refiner(steps=2000, **options):
    """Runs until nothing moves: what is differentiated is the place of rest. How accurate estimates seem is held fixed."""
    options = {"tolerance": 1e-12, "righting": 0.0, "caution": Caution.off()} | options
    return PhysPoseRefiner(RefinerConfig(steps=steps, gradient="implicit", **options))


def implicit_jacobian(refine, poses, scene, rows, **options):
    """(rows, 6 N) of refined tangent coordinates ``rows`` with respect to measured ones."""
    leaf = poses.clone().requires_grad_()
    refined = refine(leaf, scene, **options).poses
    coordinates = se3.residual(refined, refined.detach()).reshape(-1)
    out = []
    for row in rows:
        (gradient,) = torch.autograd.grad(coordinates[row], leaf, retain_graph=True)
        out.append(se3.tangent_gradient(poses, gradient).reshape(-1))
    return torch.stack(out)


def difference_jacobian(refine, poses, scene, rows, **options):
    """The same by central differences; all refinements at once, as hypotheses."""
    size = 6 * len(poses)
    h = torch.tensor([H[0]] * 3 + [H[1]] * 3, dtype=torch.float64).repeat(len(poses))
    steps = torch.diag(h).reshape(size, len(poses), 6)
    here = refine(poses, scene, **options).poses
    ahead, behind = (
        se3.residual(refine(se3.retract(poses, sign * steps), scene, **options).poses, here).reshape(size, size)
        for sign in (1, -1)
    )
    return ((ahead - behind) / (2 * h[:, None])).T[list(rows)]


def in_sigmas(jacobian, rows):
    unit = SIGMA.repeat(jacobian.shape[1] // 6)
    return jacobian / unit[list(rows)][:, None] * unit


def assert_agree(refine, poses, scene, rows, atol, **options):
    found = in_sigmas(implicit_jacobian(refine, poses, scene, rows, **options), rows)
    expected = in_sigmas(difference_jacobian(refine, poses, scene, rows, **options), rows)
    assert float(expected.abs().max()) > 0.3
    torch.testing.assert_close(found, expected, atol=atol, rtol=0)


@pytest.fixture
def pushed(table, box, can):
    """A box 8 mm in the table, and a can that leans and overlaps with it."""
    poses = table.poses((0, 0, 0.012, (0.02, -0.03, 0.01)), (0.072, 0.01, 0.045, (0.01, 0.02, 0)))
    return poses, Scene.tabletop([box, can], table.plane)


def test_gradients_are_those_of_the_place_of_rest(pushed):
    """Contacts with the table and between the two, as they turn and slide with the estimates."""
    assert_agree(refiner(), *pushed, range(12), atol=0.02)


def test_where_contacts_are_soft_they_agree_better(pushed):
    soft = PhysicsConfig(softness=2e-3)
    assert_agree(refiner(physics=soft), *pushed, (0, 2, 4, 7, 11), atol=1e-3)


def test_given_covariances_and_bias_are_part_of_it(pushed):
    poses, scene = pushed
    covariance = torch.diag(torch.tensor([2e-3, 3e-3, 1e-2, 0.02, 0.03, 0.02], dtype=torch.float64) ** 2).expand(
        2, 6, 6
    )
    physics = PhysicsConfig(depth_factor=0.98, softness=2e-3, sigma_contact=0.0)
    assert_agree(refiner(physics=physics), poses, scene, (1, 2, 8), atol=0.02, measured_covariance=covariance)


def test_other_solvers_rest_at_the_same_place_with_the_same_gradient(pushed):
    poses, scene = pushed
    physics = PhysicsConfig(softness=2e-3)
    by_lm = refiner(3000, physics=physics, solver="lm", learning_rate=0.5)
    rows = (0, 2, 9)
    a, b = (in_sigmas(implicit_jacobian(r, poses, scene, rows), rows) for r in (refiner(physics=physics), by_lm))
    torch.testing.assert_close(a, b, atol=1e-3, rtol=0)


@pytest.mark.slow
def test_autograd_costs_have_the_same_gradient(pushed):
    """Gumbel smoothing has no kernel: its cost goes through autograd."""
    poses, scene = pushed
    one, alone = poses[:1], Scene.tabletop(scene.objects[:1], scene.planes[0].shape)
    physics = PhysicsConfig(softness=2e-3, smoothing=Smoothing("gumbel"))
    assert_agree(refiner(150, physics=physics), one, alone, (0, 2, 4), atol=0.02)


def test_what_nothing_touches_is_passed_through(table, box):
    """Refined is measured there, and so is the gradient the identity."""
    poses = table.poses((0, 0, 0.3, (0.1, 0.2, 0.3)))
    found = implicit_jacobian(refiner(20), poses, Scene([box]), range(6))
    torch.testing.assert_close(found, torch.eye(6, dtype=torch.float64), atol=1e-5, rtol=0)


def test_height_on_a_table_comes_from_the_table(table, box):
    """What the estimate says along the normal is overruled, across it it counts."""
    poses = table.poses((0, 0, 0.01))
    physics = PhysicsConfig(sigma_depth_common=0.0, collision_weight=1e6, softness=1e-4, robust=math.inf)
    leaf = poses.clone().requires_grad_()
    refined = refiner(physics=physics)(leaf, Scene.tabletop([box], table.plane)).poses
    (gradient,) = torch.autograd.grad(table.up @ refined[0, :3, 3], leaf)
    assert float(gradient.abs().max()) < 0.01


def test_images_and_hypotheses_do_not_know_each_other(table, box, can):
    rows = table.poses((0, 0, 0.012), (0.07, 0, 0.045)), table.poses((0.02, 0.01, 0.01, (0.05, 0, 0)))
    scenes = Scene.tabletop([box, can], table.plane), Scene.tabletop([can], table.plane)
    refine = refiner(200)

    def gradient(poses, scene):
        leaf = poses.clone().requires_grad_()
        out = refine(leaf, scene).poses
        weight = torch.linspace(1, 2, 16, dtype=torch.float64).reshape(4, 4)
        return torch.autograd.grad((out * weight).sum(), leaf)[0]

    alone = torch.cat([gradient(p, s) for p, s in zip(rows, scenes, strict=True)])
    together = gradient(torch.cat(rows), Scene.cat([scenes[0], Scene([]), scenes[1]]))
    torch.testing.assert_close(together, alone, atol=1e-8, rtol=0)
    many = gradient(torch.cat(rows).expand(2, 1, 3, 4, 4).contiguous(), Scene.cat(scenes))
    torch.testing.assert_close(many[1, 0], alone, atol=1e-8, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "config", [RefinerConfig(gradient="implicit"), RefinerConfig(gradient="implicit", solver="lm")]
)
def test_gradients_are_finite_from_anywhere(table, box, can, dtype, config):
    generator = torch.Generator().manual_seed(3)
    scene = Scene.cat([Scene.tabletop([box, can, box], table.plane)] * 6)
    size = torch.tensor([0.2] * 3 + [2.0] * 3, dtype=torch.float64)
    wild = torch.randn(18, 6, generator=generator, dtype=torch.float64) * size
    wild[:3] = 0.0  # in each other, exactly
    poses = se3.retract(table.at(0, 0, 0).expand(18, 4, 4), wild).to(dtype).requires_grad_()
    refined = PhysPoseRefiner(config)(poses, scene).poses
    assert refined.dtype == dtype
    (refined[:, :3] ** 2).sum().backward()
    assert poses.grad.dtype == dtype
    assert bool(poses.grad.isfinite().all())
    assert float(poses.grad.abs().max()) < 1e3


def test_an_object_that_was_turned_stands_however_it_was_estimated(table, box):
    """On its edge, it would fall onto its side; which side that is does not change with a little more tilt."""
    poses = table.poses((0, 0, 0.035, (0.0, 0.7, 0.0))).requires_grad_()
    result = refiner(100, righting=math.radians(75))(poses, Scene.tabletop([box], table.plane))
    assert result.righted.tolist() == [True]
    coordinates = se3.residual(result.poses, result.poses.detach())
    (gradient,) = torch.autograd.grad(coordinates[0, 3:].sum(), poses, retain_graph=True)
    assert float(se3.tangent_gradient(poses.detach(), gradient)[0, 3:].abs().max()) == 0.0
    (gradient,) = torch.autograd.grad(table.T[:3, 0] @ result.poses[0, :3, 3], poses)
    sideways = se3.tangent_gradient(poses.detach(), gradient)[0, :3]
    assert float(sideways @ table.T[:3, 0]) == pytest.approx(1.0, abs=0.05)


def test_estimates_can_be_learned_through_the_refiner(table, box):
    """Where a neighbour pushes it, a box ends where it should, by moving the estimate of the other one."""
    wall = Static(Body.box((0.02, 0.3, 0.2), label="wall"), table.at(0.3, 0, 0.1))
    scene = Scene([box, box], [Static(table.plane), wall], gravity=table.gravity)
    poses = table.poses((0, 0, 0.02), (0.08, 0, 0.02))
    wanted = table.at(-0.02, 0, 0.02)[:3, 3]
    shift = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    refine = refiner(100)
    errors = []
    for _ in range(8):
        moved = poses.clone()
        moved[:, :3, 3] = poses[:, :3, 3] + shift
        error = ((refine(moved, scene).poses[0, :3, 3] - wanted) ** 2).sum()
        errors.append(float(error.detach()) ** 0.5)
        (gradient,) = torch.autograd.grad(error, shift)
        with torch.no_grad():
            shift -= 0.4 * gradient
    assert errors[-1] < 0.1 * errors[0]


def test_without_being_asked_poses_are_detached(pushed):
    poses, scene = pushed
    leaf = poses.clone().requires_grad_()
    assert not PhysPoseRefiner()(leaf, scene).poses.requires_grad
    with torch.no_grad():
        assert not refiner(2)(leaf, scene).poses.requires_grad
    assert not refiner(2)(poses, scene).poses.requires_grad
    with pytest.raises(InvalidInputError, match="gradient = 'exact'"):
        RefinerConfig(gradient="exact")


def test_no_objects_have_no_gradient():
    leaf = torch.zeros(0, 4, 4, dtype=torch.float64, requires_grad=True)
    refined = refiner(2)(leaf, Scene([])).poses
    refined.sum().backward()
    assert leaf.grad.shape == (0, 4, 4)
