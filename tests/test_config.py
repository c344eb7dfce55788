"""Options: what they refuse, and the paper's numbers."""

import dataclasses

import pytest

from physpose_torch.config import PhysicsConfig, RefinerConfig, Smoothing
from physpose_torch.errors import InvalidInputError


@pytest.mark.parametrize(
    ("make", "culprit"),
    [
        (lambda: Smoothing("sharp"), "sharp"),
        (lambda: Smoothing(noise=0.0), "noise"),
        (lambda: Smoothing(temperature=-1.0), "temperature"),
        (lambda: Smoothing(samples=0), "samples"),
        (lambda: PhysicsConfig(sigma_lateral=0.0), "sigma_lateral"),
        (lambda: PhysicsConfig(sigma_rotation=float("nan")), "sigma_rotation"),
        (lambda: PhysicsConfig(sigma_ray=0.0, sigma_ray_fraction=0.0), "sigma_ray"),
        (lambda: PhysicsConfig(collision_weight=-1.0), "collision_weight"),
        (lambda: PhysicsConfig(softness=-1e-3), "softness"),
        (lambda: PhysicsConfig(contact_tolerance=float("nan")), "contact_tolerance"),
        (lambda: PhysicsConfig(gravity="up"), "gravity"),
        (lambda: RefinerConfig(steps=-1), "steps"),
        (lambda: RefinerConfig(steps=1.5), "steps"),
        (lambda: RefinerConfig(learning_rate=0.0), "learning_rate"),
        (lambda: RefinerConfig(max_step=0.0), "max_step"),
        (lambda: RefinerConfig(tolerance=-1.0), "tolerance"),
        (lambda: RefinerConfig(optimizer="lbfgs"), "lbfgs"),
        (lambda: RefinerConfig(decay="linear"), "linear"),
    ],
)
def test_a_wrong_option_is_refused_by_name(make, culprit):
    with pytest.raises(InvalidInputError, match=culprit):
        make()


def test_the_paper_preset_has_the_numbers_of_the_paper():
    config = RefinerConfig.paper()
    physics = config.physics
    assert (physics.sigma_lateral, physics.sigma_ray, physics.sigma_ray_fraction) == (0.05, 0.49, 0.0)
    assert physics.sigma_rotation == 0.26
    assert physics.collision_weight == physics.gravity_weight == physics.pose_weight == 1.0
    assert physics.gravity == "paper"
    assert physics.softness == 0.0
    assert physics.smoothing.kind == "gaussian"
    assert (config.optimizer, config.learning_rate, config.steps, config.decay) == ("sgd", 1e-4, 3000, "none")
    assert config.max_gradient == 1.0


@pytest.mark.parametrize("config", [Smoothing(), PhysicsConfig(), RefinerConfig()], ids=lambda c: type(c).__name__)
def test_options_cannot_be_changed_and_compare_by_value(config):
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.seed = 1
    assert config == type(config)()
    assert hash(config) == hash(type(config)())
