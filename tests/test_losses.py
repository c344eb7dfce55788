"""The three costs by hand-worked numbers, their gradients, and the Module that adds them up."""

import math

import pytest
import torch
from torch import nn

from physpose_torch import se3
from physpose_torch.config import PhysicsConfig, Smoothing
from physpose_torch.contacts import Contacts, Drops
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.losses import (
    PhysicsLoss,
    collision_loss,
    gravity_loss,
    pose_covariance,
    pose_loss,
    prior_loss,
    soft_hinge,
)
from physpose_torch.prior import PosePrior
from physpose_torch.scene import Scene, Static

EXACT = Smoothing("none")
HARD = {"softness": 0.0, "sigma_contact": 0.0, "smoothing": EXACT}


def rotation(*omega):
    return se3.from_rotation_translation(
        se3.exp_so3(torch.tensor(omega, dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)
    )


def random_poses(n, seed=0, spread=0.3):
    generator = torch.Generator().manual_seed(seed)
    xi = torch.randn(n, 6, generator=generator, dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64).expand(n, 4, 4)
    return se3.retract(T, xi * torch.tensor([spread, spread, spread, 2, 2, 2], dtype=torch.float64))


# ---- pose


def test_pose_loss_is_half_the_squared_mahalanobis_distance():
    """2 mm off at σ = 1 mm and 0.3 rad off at σ = 0.1 rad: ½ (2² + 3²) = 6.5."""
    T = rotation(0, 0, 0.3)[None]
    T[0, 0, 3] = 0.002
    precision = torch.diag(torch.tensor([1e6, 1e4, 1e4, 1.0, 1.0, 100.0], dtype=torch.float64))[None]
    assert pose_loss(T, rotation(0, 0, 0)[None], precision).tolist() == pytest.approx([6.5])


def test_pose_covariance_is_long_along_the_viewing_ray():
    """The body's centre on a ray of 3 : 4, 0.5 m away: 10 mm along it, 3 mm across."""
    config = PhysicsConfig(sigma_lateral=0.003, sigma_ray=0.006, sigma_ray_fraction=0.016, sigma_rotation=0.03)
    T = rotation(0, 0, math.pi / 2)[None]
    T[0, :3, 3] = torch.tensor([0.3, 0.0, 0.3], dtype=torch.float64)
    center = torch.tensor([[0.0, 0.0, 0.1]], dtype=torch.float64)
    covariance = pose_covariance(T, center, config)[0]
    ray, across = torch.tensor([[0.6, 0.0, 0.8], [0.8, 0.0, -0.6]], dtype=torch.float64)
    assert float(ray @ covariance[:3, :3] @ ray) == pytest.approx(0.01**2)
    assert float(across @ covariance[:3, :3] @ across) == pytest.approx(0.003**2)
    assert float(ray @ covariance[:3, :3] @ across) == pytest.approx(0, abs=1e-18)
    assert torch.allclose(covariance[3:, 3:], 0.03**2 * torch.eye(3, dtype=torch.float64))
    assert not bool(covariance[:3, 3:].any())


def anisotropic(n, seed=1):
    factor = torch.randn(n, 6, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return factor @ factor.mT + torch.eye(6, dtype=torch.float64)


@pytest.mark.parametrize("shape", [(), (1,), (3, 2)], ids=str)
def test_the_analytic_gradient_of_the_pose_loss_is_that_of_autograd(shape):
    count = math.prod(shape)
    T, measured = (random_poses(count, seed).reshape(*shape, 4, 4) for seed in (0, 1))
    precision = anisotropic(count).reshape(*shape, 6, 6)
    xi = torch.zeros(*shape, 6, dtype=torch.float64, requires_grad=True)
    moved = se3.retract(T, xi)
    e = se3.residual(moved, measured)
    plain = 0.5 * (e[..., None, :] @ precision @ e[..., :, None])[..., 0, 0]
    expected = torch.autograd.grad(plain.sum(), xi, retain_graph=True)[0]
    cost = pose_loss(moved, measured, precision)
    assert torch.allclose(cost, plain)
    assert torch.allclose(torch.autograd.grad(cost.sum(), xi)[0], expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-3, 3.0, math.pi - 1e-3, math.pi - 1e-6, math.pi])
def test_the_pose_gradient_is_finite_and_right_at_identity_and_up_to_a_half_turn(angle, dtype):
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0)
    measured = random_poses(1)
    T = (measured @ rotation(*(angle * axis).tolist())).to(dtype).requires_grad_()
    precision = torch.eye(6, dtype=dtype)[None]
    (gradient,) = torch.autograd.grad(pose_loss(T, measured.to(dtype), precision).sum(), T)
    assert gradient.dtype == dtype
    assert bool(gradient.isfinite().all())
    # isotropic: the gradient is the residual itself, θ about the axis (either way round at a half turn)
    tangent = se3.tangent_gradient(T.detach(), gradient)[0, 3:].double()
    expected = angle * axis
    off = min(float((tangent - expected).abs().max()), float((tangent + expected).abs().max() if angle > 3.1 else 9))
    assert off < (1e-6 if dtype == torch.float64 else 5e-3)


# ---- the prior: robust, and with a depth factor in common


def test_the_robust_cost_grows_like_a_logarithm():
    """The 6.5 of above is m² = 13; with ν = 4 it is ½ · 4 · log(1 + 13/4)."""
    T = rotation(0, 0, 0.3)[None]
    T[0, 0, 3] = 0.002
    precision = torch.diag(torch.tensor([1e6, 1e4, 1e4, 1.0, 1.0, 100.0], dtype=torch.float64))[None]
    image, ray, acts = torch.zeros(1, dtype=torch.long), torch.ones(1, 3), torch.ones(1, dtype=torch.bool)
    reach = torch.zeros(1)
    prior = PosePrior(rotation(0, 0, 0)[None], precision, ray, acts, reach, image, 1, 0.0, math.inf)
    assert prior_loss(T, prior).tolist() == pytest.approx([6.5])
    assert prior_loss(T, prior._replace(robust=4.0)).tolist() == pytest.approx([2 * math.log(4.25)])


def test_a_depth_error_in_common_costs_what_the_joint_gaussian_says(box, can):
    """Rays of 1 m and 0.5 m, σ = 1 % each and 2 % in common: the cost is ½ eᵀ (Σ + σ² r rᵀ)⁻¹ e over both objects."""
    sigmas = dict(sigma_ray_fraction=0.01, sigma_lateral=0.003, sigma_rotation=0.03, robust=float("inf"))
    config = PhysicsConfig(sigma_depth_common=0.02, **sigmas)
    measured = torch.stack([rotation(0, 0, 0), rotation(0.3, 0, 0)])
    measured[:, 2, 3] = torch.tensor([1.0, 0.5], dtype=torch.float64)
    T = se3.retract(measured, 0.02 * torch.randn(2, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    far_below = [Static(Plane(torch.tensor([0.0, -1.0, 0.0]), torch.tensor(-50.0)))]
    scene = Scene([box, can], far_below)
    loss = PhysicsLoss(config)
    alone = loss(T[:1], Scene([box], far_below), measured=measured[:1]).pose
    along = float(T[0, 2, 3]) - 1.0
    across = (T[0, :2, 3] / 0.003).square().sum() + (se3.log_so3(T[0, :3, :3]) / 0.03).square().sum()
    assert alone.tolist() == pytest.approx([0.5 * (along**2 / (0.01**2 + 0.02**2) + float(across))])

    xi = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    moved = se3.retract(T, xi)
    independent = PhysicsConfig(sigma_depth_common=0.0, **sigmas)
    joint = torch.block_diag(*pose_covariance(measured, scene.object_center, independent))
    ray = torch.cat([measured[:, :3, 3], torch.zeros(2, 3)], dim=1).flatten()
    e = se3.residual(moved, measured).flatten()
    expected = 0.5 * e @ torch.linalg.inv(joint + 0.02**2 * torch.outer(ray, ray)) @ e
    cost = loss(moved, scene, measured=measured).pose.sum()
    assert float(cost.detach()) == pytest.approx(float(expected.detach()))
    gradients = [torch.autograd.grad(x, xi, retain_graph=True)[0] for x in (expected, cost)]
    assert torch.allclose(*gradients, rtol=1e-6, atol=1e-6)


def test_without_anything_static_depth_errors_have_nothing_in_common(box, can):
    """Collisions alone would drive a scene away from the camera, where its rays are farther apart."""
    measured = torch.stack([rotation(0, 0, 0), rotation(0.3, 0, 0)])
    measured[:, 2, 3] = torch.tensor([1.0, 0.5], dtype=torch.float64)
    T = measured.clone()
    T[:, :3, 3] *= 1.01
    costs = [PhysicsLoss(PhysicsConfig(sigma_depth_common=s))(T, Scene([box, can]), measured=measured) for s in (0, 0.1)]
    torch.testing.assert_close(costs[0].pose, costs[1].pose)


def test_a_given_covariance_is_taken_as_it_is(table, box):
    loss = PhysicsLoss(PhysicsConfig(sigma_depth_common=0.02, robust=float("inf")))
    T, measured = table.poses((0, 0, 0.5)), table.poses((0, 0, 0.6))
    terms = loss(T, Scene([box]), measured=measured, measured_covariance=0.01 * torch.eye(6, dtype=torch.float64))
    assert terms.pose.tolist() == pytest.approx([0.5 * 0.1**2 / 0.01])


# ---- collision and gravity


def test_the_soft_hinge_is_quadratic_up_to_its_softness_and_linear_beyond():
    x = torch.tensor([-1.0, 0.0, 0.5, 2.0, 5.0], dtype=torch.float64, requires_grad=True)
    y = soft_hinge(x, 2.0)
    assert y.tolist() == pytest.approx([0.0, 0.0, 0.0625, 1.0, 4.0])
    assert torch.autograd.grad(y.sum(), x)[0].tolist() == pytest.approx([0.0, 0.0, 0.25, 1.0, 1.0])
    hard = soft_hinge(x, 0.0)
    assert hard.tolist() == [0.0, 0.0, 0.5, 2.0, 5.0]
    assert torch.autograd.grad(hard.sum(), x)[0].tolist() == [0.0, 0.0, 1.0, 1.0, 1.0]
    each = soft_hinge(x, torch.tensor([2.0, 2.0, 0.0, 2.0, 0.0]))
    assert each.tolist() == pytest.approx([0.0, 0.0, 0.5, 1.0, 5.0])


def contacts(distance, pair, first, second, n):
    first, second = torch.tensor(first), torch.tensor(second)
    movable = second < n
    return Contacts(
        torch.tensor(distance, dtype=torch.float64),
        torch.tensor(pair),
        first,
        second,
        torch.ones_like(movable),
        movable,
        torch.zeros(len(first), dtype=torch.float64),
    )


def test_collision_is_the_mean_over_the_colliding_part_pairs_of_a_pair_of_bodies():
    """Objects 0 and 1 overlap with parts 2 and 4 mm deep, a third pair is apart: 3 mm. Object 1 is 5 mm in a static."""
    given = contacts([-0.002, -0.004, 0.1, -0.005], [0, 0, 0, 1], [0, 1], [1, 2], n=2)
    printed, share = collision_loss(given, 2)
    assert printed.tolist() == pytest.approx([0.003, 0.008])
    # every pair once: half of the movable pair at each, all of the static's
    assert share.tolist() == pytest.approx([0.0015, 0.0065])


def test_gravity_is_the_drop_and_nothing_in_contact_or_out_of_reach():
    height = torch.tensor([0.007, 0.002, float("inf"), 0.0], dtype=torch.float64, requires_grad=True)
    touching = torch.tensor([False, True, False, False])
    cost = gravity_loss(Drops(height, torch.tensor([4, 4, -1, 4]), touching, torch.zeros(4)))
    assert cost.tolist() == [0.007, 0.0, 0.0, 0.0]
    gradient = torch.autograd.grad(cost.sum(), height)[0]
    assert gradient.tolist()[:3] == [1.0, 0.0, 0.0]


def test_a_movable_pair_counts_twice_as_printed_and_once_in_the_total(table, box):
    """Two boxes 4 mm inside each other, both 6 mm inside the table: C = 4 + 6 each; total 2·6 + 4, not 20."""
    config = PhysicsConfig(collision_weight=1000.0, **HARD)
    poses = table.poses((0, 0, 0.014), (0.096, 0, 0.014))
    terms = PhysicsLoss(config)(poses, Scene.tabletop([box, box], table.plane))
    assert terms.collision.tolist() == pytest.approx([0.010, 0.010], abs=1e-7)
    assert float(terms.total.sum()) == pytest.approx(16.0, abs=1e-3)
    assert terms.pose.tolist() == terms.gravity.tolist() == [0.0, 0.0]


def test_object_and_table_contacts_are_equally_stiff(table, box):
    """The force on an object is ζ per contact, whether it is with the table or with another object."""
    config = PhysicsConfig(collision_weight=1.0, gravity_weight=0.0, **HARD)
    gradients = []
    for scene, poses in [
        (Scene.tabletop([box], table.plane), table.poses((0, 0, 0.015))),
        (Scene([box, box]), table.poses((0, 0, 0.055), (0, 0, 0.02))),
    ]:
        leaf = poses.requires_grad_()
        PhysicsLoss(config)(leaf, scene).total.sum().backward()
        gradients.append(leaf.grad[:, :3, 3])
    assert torch.allclose(gradients[0][0], -table.up, atol=1e-9)
    assert torch.allclose(gradients[1], torch.stack([-table.up, table.up]), atol=1e-6)


def test_gravity_in_the_papers_form_by_hand(table, angle):
    """The L 8 mm up: parts at 8 and 38 mm, 23 mm on average; without part 2 it would be 8."""
    config = PhysicsConfig(gravity="paper", **HARD)
    terms = PhysicsLoss(config)(table.poses((0, 0, 0.008)), Scene.tabletop([angle], table.plane))
    assert terms.gravity.tolist() == pytest.approx([0.023], abs=1e-9)
    touching = PhysicsLoss(config)(table.poses((0, 0, 5e-5)), Scene.tabletop([angle], table.plane))
    assert touching.gravity.tolist() == [0.0]


def test_gravity_in_the_support_form_by_hand(table, angle, box):
    """The L 8 mm up costs 8 mm however tall it is; the box 5 mm over the L's foot costs 5, and pulls nothing up."""
    config = PhysicsConfig(gravity="support", gravity_weight=100.0, **HARD)
    scene = Scene.tabletop([angle, box], table.plane)
    leaf = table.poses((0, 0, 0.008), (0.081, 0.015, 0.008 + 0.03 + 0.005 + 0.02)).requires_grad_()
    terms = PhysicsLoss(config)(leaf, scene)
    assert terms.gravity.tolist() == pytest.approx([0.008, 0.005], abs=1e-7)
    assert terms.total.tolist() == pytest.approx([0.8, 0.5], abs=1e-4)
    terms.total.sum().backward()
    assert torch.allclose(leaf.grad[:, :3, 3], 100 * table.up.expand(2, 3), atol=1e-4)


def test_nothing_pulls_beyond_the_reach(table, box):
    scene = Scene.tabletop([box], table.plane)
    for height, cost in ((0.049, 0.049), (0.051, 0.0)):
        config = PhysicsConfig(gravity_reach=0.05, **HARD)
        leaf = table.poses((0, 0, 0.02 + height)).requires_grad_()
        terms = PhysicsLoss(config)(leaf, scene)
        terms.total.sum().backward()
        assert terms.gravity.tolist() == pytest.approx([cost])
        assert bool(leaf.grad.any()) == (cost > 0)


@pytest.mark.parametrize("form", ["support", "paper"])
def test_without_statics_there_is_no_gravity_cost(form, table, box):
    """In image 0 of two, which has none; image 1 has a table."""
    config = PhysicsConfig(gravity=form, **HARD)
    image = torch.tensor([0, 0, 1])
    scene = Scene([box] * 3, [Static(table.plane, image=1)], gravity=table.gravity, image=image)
    poses = table.poses((0, 0, 0.02), (0, 0, 0.07), (0, 0, 0.03))
    assert PhysicsLoss(config)(poses, scene).gravity.tolist() == pytest.approx([0.0, 0.0, 0.01])
    alone = Scene([box] * 2, gravity=table.gravity)
    assert PhysicsLoss(config)(poses[:2], alone).gravity.tolist() == [0.0, 0.0]


def test_an_uncertain_plane_pushes_and_pulls_less(table, box):
    """σ = 4 mm: a contact 3 mm off costs d²/2σ², as a Gaussian would, instead of ζ d; far off it is ζ again."""
    covariance = torch.diag(torch.tensor([0.0, 0.0, 0.004**2], dtype=torch.float64))
    config = PhysicsConfig(collision_weight=1000.0, gravity_weight=1000.0, **HARD)
    unsure = Scene.tabletop([box], Plane(table.plane.normal, table.plane.offset, covariance))
    sure = Scene.tabletop([box], table.plane)
    for height in (-0.003, 0.003):
        pose = table.poses((0, 0, 0.02 + height))
        assert float(PhysicsLoss(config)(pose, sure).total) == pytest.approx(3.0)
        assert float(PhysicsLoss(config)(pose, unsure).total) == pytest.approx(0.5 * (0.003 / 0.004) ** 2)
    leaf = table.poses((0, 0, 0.02 - 0.03)).requires_grad_()
    PhysicsLoss(config)(leaf, unsure).total.sum().backward()
    assert torch.allclose(leaf.grad[0, :3, 3], -1000.0 * table.up, atol=1e-6)


def test_weights_scale_and_zero_switches_off(table, box, can):
    poses, measured = table.poses((0, 0, 0.015), (0.2, 0, 0.05)), table.poses((0, 0, 0.02), (0.2, 0, 0.04))
    scene = Scene.tabletop([box, can], table.plane)
    one = PhysicsLoss(PhysicsConfig(**HARD))(poses, scene, measured=measured)
    config = PhysicsConfig(pose_weight=2.0, collision_weight=3.0, gravity_weight=5.0, **HARD)
    terms = PhysicsLoss(config)(poses, scene, measured=measured)
    assert torch.allclose(terms.total, 2 * one.pose + 3 * one.collision + 5 * one.gravity)
    for name in ("pose", "collision", "gravity"):
        weights = {f"{n}_weight": float(n == name) for n in ("pose", "collision", "gravity")}
        total = PhysicsLoss(PhysicsConfig(**weights, **HARD))(poses, scene, measured=measured).total
        assert torch.allclose(total, getattr(one, name))


# ---- alternatives


@pytest.mark.parametrize("form", ["support", "paper"])
@pytest.mark.parametrize("uncertain", [False, True], ids=["exact", "uncertain"])
@pytest.mark.parametrize("common", [0.0, 0.02], ids=["independent", "common"])
def test_adding_a_duplicate_changes_nothing_for_the_others(form, uncertain, common, table, box, can):
    """A second, lower-scored estimate of the box, right inside the can, under a floating box and askew."""
    covariance = torch.diag(torch.tensor([1e-4, 1e-4, 4e-6], dtype=torch.float64)) if uncertain else None
    plane = Static(Plane(table.plane.normal, table.plane.offset, covariance))
    loss = PhysicsLoss(PhysicsConfig(gravity=form, sigma_depth_common=common))
    rows = [(0, 0, 0.018), (0.08, 0, 0.05), (0.08, 0.1, 0.08, (0, 0, 0.3))]
    objects = [box, can, box]
    results = []
    for extra in (False, True):
        poses = table.poses(*rows, *([(0.07, 0.03, 0.03, (0.1, 0.2, 0))] if extra else [])).requires_grad_()
        scene = Scene(
            objects + [box] * extra,
            [plane],
            gravity=table.gravity,
            same_object=torch.tensor([0, 1, 2, 0][: 3 + extra]),
        )
        scores = torch.tensor([0.9, 0.5, 0.5, 0.8][: 3 + extra])
        shift = 0.01 * torch.linspace(-1, 1, 4)[: 3 + extra, None].expand(3 + extra, 6)
        terms = loss(poses, scene, measured=se3.retract(poses.detach(), shift.double()), scores=scores)
        (gradient,) = torch.autograd.grad(terms.total.sum(), poses)
        results.append((terms, gradient))
    (alone, without), (crowded, within) = results
    assert torch.equal(without, within[:3])
    for a, b in zip(alone, crowded, strict=True):
        assert torch.equal(a, b[:3])
    # and it feels the can itself
    assert float(crowded.collision[3].detach()) > 1e-3
    assert float(within[3].abs().max()) > 1


def test_the_best_scored_alternative_acts(table, box, can):
    scene = Scene([box, box, can], [Static(table.plane)], same_object=torch.tensor([0, 0, 1]))
    poses = table.poses((0.07, 0, 0.02), (0.0, 0.3, 0.02), (0, 0, 0.04))
    first = PhysicsLoss()(poses, scene, scores=torch.tensor([0.9, 0.1, 0.5])).collision
    second = PhysicsLoss()(poses, scene, scores=torch.tensor([0.1, 0.9, 0.5])).collision
    by_default = PhysicsLoss()(poses, scene).collision
    assert float(first[2]) > 0
    assert float(second[2]) == pytest.approx(0, abs=1e-12)
    assert torch.equal(by_default, first)
    assert float(second[0]) == float(first[0]) > 0  # the other one feels the can all the same


# ---- the Module


@pytest.mark.parametrize("leading", [(), (1,), (3,), (2, 2)], ids=str)
def test_hypotheses_cost_what_each_costs_alone(leading, table, box, can, angle):
    count = math.prod(leading)
    measured = table.poses((0, 0, 0.02), (0.06, 0, 0.045), (0.05, 0.02, 0.09))
    noise = torch.randn(count, 3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    poses = se3.retract(measured, 0.01 * noise)
    scene = Scene.tabletop([box, can, angle], table.plane)
    loss = PhysicsLoss()
    batch = loss(poses.reshape(*leading, 3, 4, 4), scene, measured=measured.expand(*leading, 3, 4, 4))
    each = [loss(p, scene, measured=measured) for p in poses]
    for i, term in enumerate(batch):
        assert term.shape == (*leading, 3)
        assert torch.allclose(term.reshape(-1, 3), torch.stack([e[i] for e in each]), atol=1e-12)


def test_a_batch_of_images_costs_what_each_costs_alone(table, box, can, angle):
    scenes = [
        Scene.tabletop([box, can], table.plane),
        Scene([], n_images=1),
        Scene([angle], [Static(box, table.at(0, 0, 0.02))], gravity=table.gravity),
        Scene([can, can]),
    ]
    poses = [
        table.poses((0, 0, 0.018), (0.07, 0, 0.045)),
        torch.zeros(0, 4, 4, dtype=torch.float64),
        table.poses((0, 0, 0.045)),
        table.poses((0, 0, 0), (0.05, 0, 0)),
    ]
    loss = PhysicsLoss()
    together = loss(torch.cat(poses), Scene.cat(scenes), measured=torch.cat(poses))
    apart = [loss(p, s, measured=p) for p, s in zip(poses, scenes, strict=True)]
    for i, term in enumerate(together):
        assert torch.allclose(term, torch.cat([a[i] for a in apart]), atol=1e-12)


@pytest.mark.parametrize("images", [0, 1, 3])
def test_no_objects_no_costs(images, table):
    scene = Scene([], [Static(table.plane, image=i) for i in range(images)], gravity=table.gravity, n_images=images)
    terms = PhysicsLoss()(torch.zeros(0, 4, 4), scene, measured=torch.zeros(0, 4, 4))
    assert all(term.shape == (0,) for term in terms)


def test_the_callers_dtype_comes_back(dtype, table, box):
    leaf = table.poses((0, 0, 0.015)).to(dtype).requires_grad_()
    loss = PhysicsLoss(PhysicsConfig(softness=1e-3))
    terms = loss(leaf, Scene.tabletop([box], table.plane), measured=leaf.detach())
    terms.total.sum().backward()
    assert all(term.dtype == dtype for term in terms)
    assert leaf.grad.dtype == dtype
    assert terms.collision.tolist() == pytest.approx([0.0045], abs=1e-6)  # 5 mm, less half the softness of 1 mm


def test_autocast_changes_nothing(table, box):
    pose = table.poses((0, 0, 0.015)).float()
    scene = Scene.tabletop([box], table.plane)
    measured = table.poses((0.01, 0, 0.02, (0.02, 0.03, 0.01))).float()
    plain = PhysicsLoss()(pose, scene, measured=measured)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = PhysicsLoss()(pose, scene, measured=measured)
    for a, b in zip(plain, cast, strict=True):
        assert a.dtype == b.dtype == torch.float32
        assert torch.equal(a, b)


def assert_camera_frame_invariant(loss, poses, scene, measured, covariance, T, atol):
    """A camera that moves by T⁻¹ sees everything move by T, and the costs stay what they are."""
    R = T[:3, :3]
    statics = []
    for s in scene.statics:
        if isinstance(s.shape, Plane):
            normal = R @ s.shape.normal
            moved = Plane(normal, s.shape.offset + normal @ T[:3, 3], s.shape.covariance)
            statics.append(Static(moved, image=s.image))
        else:
            statics.append(Static(s.shape, T @ s.T_camera_body, s.image))
    turned = Scene(scene.objects, statics, gravity=scene.gravity @ R.mT, image=scene.image)
    if covariance is not None:
        J = torch.block_diag(R, torch.eye(3, dtype=R.dtype))
        covariance_turned = J @ covariance @ J.mT
    else:
        covariance_turned = None
    leaves = [x.clone().requires_grad_() for x in (poses, T @ poses)]
    before = loss(leaves[0], scene, measured=measured, measured_covariance=covariance)
    after = loss(leaves[1], turned, measured=T @ measured, measured_covariance=covariance_turned)
    for a, b in zip(before, after, strict=True):
        assert torch.allclose(a, b, rtol=1e-6, atol=atol)
    a, b = (
        torch.autograd.grad(terms.total.sum(), leaf)[0] for terms, leaf in zip((before, after), leaves, strict=True)
    )
    assert torch.allclose(T[:3, :3] @ a[:, :3], b[:, :3], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("form", ["support", "paper"])
def test_where_the_camera_is_changes_nothing(form, table, box, can, angle):
    """All of the scene moves with T; so does an uncertain plane, tilted alike in all directions."""
    covariance = torch.diag(torch.tensor([1e-4, 1e-4, 4e-6], dtype=torch.float64))
    scene = Scene(
        [box, can, angle, can],
        [Static(Plane(table.plane.normal, table.plane.offset, covariance)), Static(box, table.at(0.2, 0, 0.02))],
        gravity=table.gravity,
        image=torch.tensor([0, 0, 0, 0]),
    )
    measured = table.poses((0, 0, 0.02), (0.07, 0, 0.045), (0.3, 0.1, 0.02), (0.22, 0, 0.085))
    noise = torch.randn(4, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    poses = se3.retract(measured, 0.01 * noise)
    loss = PhysicsLoss(PhysicsConfig(gravity=form, smoothing=EXACT))
    T = random_poses(1, seed=5)[0]
    assert_camera_frame_invariant(loss, poses, scene, measured, 1e-4 * anisotropic(4), T, atol=1e-8)
    # the default covariance knows where the camera is: it may turn about its centre
    T[:3, 3] = 0
    assert_camera_frame_invariant(loss, poses, scene, measured, None, T, atol=1e-8)


@pytest.mark.parametrize("form", ["support", "paper"])
def test_the_gradient_of_the_total_is_the_derivative_away_from_kinks(form, table, box, can, angle):
    """gradcheck over poses, a static body's pose and a plane; nothing flush, nothing at a distance of zero."""
    measured = table.poses(
        (0, 0, 0.018, (0.05, 0.08, 0.1)),
        (0.07, 0.01, 0.052, (0.06, -0.07, 0.2)),
        (0.31, 0.1, 0.012, (0.1, -0.07, 0.3)),
        (0.2, 0.01, 0.093, (0.2, 0.1, 0)),
    )
    static = table.at(0.2, 0, 0.02, (0.03, 0.04, 0))
    objects = [box, can, angle, can]
    loss = PhysicsLoss(PhysicsConfig(gravity=form, smoothing=EXACT, collision_weight=20.0, gravity_weight=10.0))
    shift = torch.randn(4, 6, generator=torch.Generator().manual_seed(7), dtype=torch.float64) * 1e-3

    def total(xi, xi_static, normal, offset):
        statics = [Static(Plane(normal, offset)), Static(box, se3.retract(static, xi_static))]
        scene = Scene(objects, statics, gravity=table.gravity)
        terms = loss(se3.retract(measured, xi), scene, measured=measured)
        return terms.total.sum()

    inputs = (
        shift.requires_grad_(),
        torch.zeros(6, dtype=torch.float64, requires_grad=True),
        table.plane.normal.clone().requires_grad_(),
        table.plane.offset.clone().requires_grad_(),
    )
    terms = loss(se3.retract(measured, shift), Scene(objects, [Static(table.plane), Static(box, static)],
                 gravity=table.gravity))  # fmt: skip
    assert int((terms.collision > 0).sum()) >= 2
    assert int((terms.gravity > 0).sum()) >= 1
    assert torch.autograd.gradcheck(total, inputs, eps=1e-7, atol=2e-3, rtol=1e-3, nondet_tol=1e-9)


def test_a_network_learns_through_it(table, box, can):
    """A layer predicts poses; physics alone, without labels, lifts them out of the table and of each other."""
    torch.manual_seed(0)
    scene = Scene.tabletop([box, can], table.plane)
    start = table.poses((0, 0, 0.005), (0.06, 0, 0.06)).float()
    network = nn.Linear(4, 12)
    nn.init.zeros_(network.weight)
    nn.init.zeros_(network.bias)
    loss = PhysicsLoss(PhysicsConfig(collision_weight=1.0, gravity_weight=1.0))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    costs = []
    for _ in range(40):
        poses = se3.retract(start, network(torch.ones(4)).reshape(2, 6))
        cost = loss(poses, scene).total.sum()
        costs.append(cost.item())
        optimizer.zero_grad()
        cost.backward()
        assert all(bool(p.grad.isfinite().all()) for p in network.parameters())
        optimizer.step()
    assert costs[-1] < 0.2 * costs[0]


@pytest.mark.parametrize("form", ["support", "paper"])
def test_gradients_stay_finite_from_wild_poses(form, dtype, table, box, can, angle):
    """Far away, behind the camera, at its very centre, upside down, in one place, edge on edge."""
    quarter = math.pi / 4
    rows = [
        table.at(),
        table.at(1e3, -1e3, 1e3),
        torch.eye(4, dtype=torch.float64),
        rotation(math.pi, 0, 0),
        table.at(0, 0, 0.02, (quarter, quarter, 0)),
        table.at(0, 0, 0.02),
        table.at(0, 0, 0.02),
        table.at(0, 0, -5.0),
        table.at(0, 0, 0.04 + 0.04),
    ]
    bodies = [box, can, angle, box, can, box, box, angle, can]
    scene = Scene.tabletop(bodies, table.plane)
    leaf = torch.stack(rows).to(dtype).requires_grad_()
    loss = PhysicsLoss(PhysicsConfig(gravity=form))
    terms = loss(leaf, scene, measured=torch.stack(rows[::-1]).to(dtype))
    terms.total.sum().backward()
    assert all(bool(term.isfinite().all()) for term in terms)
    assert bool(leaf.grad.isfinite().all())


@pytest.mark.parametrize(
    ("kind", "noise"), [("gaussian", 0.1), ("gumbel", 0.1), ("ring", 0.1), ("pose", 0.02)]
)
def test_smoothing_leaves_the_costs_alone_and_the_forces_honest(kind, noise, table, box, can):
    """Values are the hard distances; forces still push out of the table and apart, and turn a tilted box flat."""
    scene = Scene.tabletop([box, can], table.plane)
    poses = table.poses((0, 0, 0.019, (0, 0.05, 0)), (0.075, 0, 0.036))
    exact = PhysicsLoss(PhysicsConfig(smoothing=EXACT))(poses, scene)
    leaf = poses.clone().requires_grad_()
    smooth = PhysicsLoss(PhysicsConfig(smoothing=Smoothing(kind, noise=noise)))(leaf, scene)
    for a, b in zip(exact, smooth, strict=True):
        assert torch.allclose(a, b.detach(), atol=1e-9)
    smooth.total.sum().backward()
    force = -leaf.grad[:, :3, 3]
    assert float(force[0] @ table.up) > 0
    assert float(force[1] @ table.up) > 0
    assert bool(leaf.grad.isfinite().all())


# ---- what is refused


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"poses": lambda p: p * torch.tensor([1.0, math.nan])[:, None, None]}, r"poses\[1\] \(can\) contains NaN"),
        ({"poses": lambda p: p * 1000}, r"poses\[0\] \(box\)"),
        ({"poses": lambda p: p @ torch.diag(torch.tensor([5.0, 5, 5, 1])).double()}, r"\(box\) is not rigid.*scale="),
        ({"poses": lambda p: p.mT}, r"poses\[0\] \(box\).*transposed"),
        ({"poses": lambda p: p[:1]}, r"\(1, 4, 4\), expected \(\.\.\., 2, 4, 4\)"),
        ({"poses": lambda p: p[:, :3]}, r"\(2, 3, 4\)"),
        ({"poses": lambda p: p.long()}, "int64"),
        ({"poses": lambda p: p.numpy()}, "ndarray"),
        ({"measured": lambda p: p[:1]}, "measured has shape"),
        ({"measured": lambda p: p * math.nan}, r"measured\[0\] \(box\) contains NaN"),
        ({"measured_covariance": torch.eye(6).expand(3, 6, 6)}, r"measured_covariance has shape \(3, 6, 6\)"),
        ({"measured_covariance": torch.stack([torch.eye(6), -torch.eye(6)])}, r"\[1\] \(can\).*not positive definite"),
        ({"measured_covariance": torch.full((2, 6, 6), math.nan)}, r"\[0\] \(box\).*not positive definite"),
        ({"scores": torch.ones(3)}, r"scores have shape \(3,\)"),
        ({"scores": torch.tensor([0.5, math.nan])}, "finite"),
    ],
)  # fmt: skip
def test_a_wrong_input_is_refused_by_name(options, message, table, box, can):
    poses = table.poses((0, 0, 0.02), (0.2, 0, 0.04))
    options = {name: value(poses) if callable(value) else value for name, value in options.items()}
    options = {"poses": poses, "measured": poses, **options}
    with pytest.raises(InvalidInputError, match=message):
        PhysicsLoss()(options.pop("poses"), Scene.tabletop([box, can], table.plane), **options)


def test_measured_poses_must_have_the_hypotheses_of_the_poses(table, box):
    pose = table.poses((0, 0, 0.02))
    scene = Scene.tabletop([box], table.plane)
    with pytest.raises(InvalidInputError, match="measured"):
        PhysicsLoss()(pose[None].expand(2, 1, 4, 4), scene, measured=pose[None].expand(3, 1, 4, 4))
    one_for_all = PhysicsLoss()(pose.expand(2, 1, 4, 4), scene, measured=pose)
    assert one_for_all.pose.shape == (2, 1)


def test_an_unknown_backend_is_refused(table):
    scene = Scene([Body.box((0.1, 0.1, 0.1), label="a")] * 2)
    loss = PhysicsLoss(PhysicsConfig(backend="abacus"))
    with pytest.raises(InvalidInputError, match="abacus"):
        loss(table.poses((0, 0, 0), (0, 0, 0)), scene)


def test_the_module_prints_its_options():
    assert "collision_weight=7.0" in repr(PhysicsLoss(PhysicsConfig(collision_weight=7.0)))
