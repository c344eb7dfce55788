"""Thousands of objects in one image: the same results as if all were held against all, in time and memory that suffice."""

from dataclasses import replace

import pytest
import torch

import physpose_torch.scene
from physpose_torch.bench.growth import cake_image
from physpose_torch.config import PhysicsConfig, RefinerConfig
from physpose_torch.fused import FusedCost
from physpose_torch.losses import PhysicsLoss
from physpose_torch.prior import make_prior
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene


def crowd(objects: int, parts: int = 1):
    """Poses and a function that makes their scene anew: what a scene has worked out it keeps."""
    image = cake_image(parts, objects)
    return image.poses, lambda: Scene(image.scene.objects, image.scene.statics, gravity=image.scene.gravity)


@pytest.fixture
def all_against_all(monkeypatch):
    def switch():
        monkeypatch.setattr(physpose_torch.scene, "CROWD", 10**9)

    return switch


@pytest.mark.parametrize(
    "config",
    [RefinerConfig(), RefinerConfig.lm(), replace(RefinerConfig.paper(), steps=35)],
    ids=["descent", "lm", "paper"],
)
def test_a_crowd_is_refined_as_if_all_were_held_against_all(config, all_against_all):
    """Where bodies touch, the search may begin elsewhere and end a rounding apart."""
    poses, scene = crowd(120)
    found = PhysPoseRefiner(config)(poses, scene())
    all_against_all()
    expected = PhysPoseRefiner(config)(poses, scene())
    torch.testing.assert_close(found.poses, expected.poses, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.terms.total, expected.terms.total, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(found.report.penetration, expected.report.penetration, atol=1e-9, rtol=0)
    assert found.status == expected.status
    assert found.report.supporter == expected.report.supporter


def test_whom_an_object_of_a_crowd_comes_to_it_meets():
    """A can is pushed through the others, three times as far as is looked at once."""
    poses, scene = crowd(120)
    scene = scene()
    acts, config, eye = (
        torch.ones(120, dtype=torch.bool),
        RefinerConfig(),
        torch.eye(6, dtype=torch.float64).expand(120, 6, 6),
    )
    prior = make_prior(poses, scene, acts, None, config.physics)
    cost = FusedCost(prior, scene, acts, config, poses, eye)
    for step in range(65):
        cost.evaluate(step)
        cost.step[0, 0] = 0.0099
        cost.move()
    cost.evaluate(65)
    assert float(cost.poses[0, 0, 3] - poses[0, 0, 3]) == pytest.approx(65 * 0.0099)
    new = FusedCost(prior, scene, acts, config, cost.poses.clone(), eye)
    new.evaluate(0)
    rows = torch.arange(120)
    assert float(new.terms(rows).collision[0]) > 1e-3
    torch.testing.assert_close(cost.terms(rows).collision, new.terms(rows).collision, atol=1e-12, rtol=0)
    torch.testing.assert_close(cost.gradient, new.gradient, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("config", [PhysicsConfig(), PhysicsConfig(gravity="paper")], ids=["support", "paper"])
def test_a_crowd_costs_what_it_costs_if_all_are_held_against_all(config, all_against_all):
    poses, scene = crowd(110, parts=2)
    poses = poses.requires_grad_()
    found = PhysicsLoss(config)(poses, scene(), measured=poses.detach())
    gradient = torch.autograd.grad(found.total.sum(), poses)[0]
    all_against_all()
    expected = PhysicsLoss(config)(poses, scene(), measured=poses.detach())
    assert all(torch.equal(x, y) for x, y in zip(found, expected, strict=True))
    assert torch.equal(gradient, torch.autograd.grad(expected.total.sum(), poses)[0])


def test_near_pairs_are_entity_pairs_in_their_order():
    poses, scene = crowd(101)
    scene = Scene.cat([scene(), scene()])
    poses = torch.cat([poses, poses])
    every = scene.near_pairs(poses, float("inf"))
    assert torch.equal(every, scene.entity_pairs)
    near = {tuple(p) for p in scene.near_pairs(poses, 0.01).tolist()}
    assert [tuple(p) for p in every.tolist() if tuple(p) in near] == [
        tuple(p) for p in scene.near_pairs(poses, 0.01).tolist()
    ]
    assert 0 < len(near) < len(every)


@pytest.mark.parametrize("objects", [300, pytest.param(5000, marks=pytest.mark.slow)])
def test_a_crowd_comes_to_rest_and_repeats(objects):
    poses, scene = crowd(objects)
    result, again = (PhysPoseRefiner()(poses, scene()) for _ in range(2))
    assert torch.equal(result.poses, again.poses)
    before, after = physics_report(poses, scene()), physics_report(result.poses, scene())
    assert float(after.penetration.mean()) < 0.5 * float(before.penetration.mean())
    moved = ~(result.rejected | result.unsupported)
    assert float(moved.double().mean()) > 0.5
    assert len(result.status) == objects


def test_pairs_are_few_in_a_crowd():
    """Of 12.5 million pairs of 5000 objects on a table those are held against each other that are near."""
    poses, scene = crowd(5000)
    assert len(scene().near_pairs(poses, 0.25)) < 300_000


@pytest.mark.parametrize("images", [1000, pytest.param(5000, marks=pytest.mark.slow)])
def test_objects_of_many_images_are_refined_as_each_alone(images):
    single = [cake_image(1, 1, seed=i) for i in range(4)]
    chosen = [single[i % 4] for i in range(images)]
    result = PhysPoseRefiner()(torch.cat([x.poses for x in chosen]), Scene.cat([x.scene for x in chosen]))
    for i, image in enumerate(single):
        alone = PhysPoseRefiner()(image.poses, image.scene)
        assert torch.equal(result.poses[i::4], alone.poses.expand(len(result.poses[i::4]), 4, 4))
