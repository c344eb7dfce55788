"""Options, as frozen dataclasses with a sentence under each field; the command line is made from them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from physpose_torch.errors import InvalidInputError

__all__ = ["STILL_STEPS", "Calibration", "Caution", "PhysicsConfig", "RefinerConfig", "Smoothing", "TableConfig"]

STILL_STEPS = 10
"""An image stops after this many steps of a descent on end without motion."""


def _check_positive(config: object, *names: str) -> None:
    for name in names:
        if not 0 < getattr(config, name) < math.inf:
            raise InvalidInputError(
                f"{type(config).__name__}.{name} = {getattr(config, name)}, expected a positive number"
            )


def _check_factor(config: object) -> None:
    if not 0.5 <= config.depth_factor <= 2.0:
        raise InvalidInputError(
            f"{type(config).__name__}.depth_factor = {config.depth_factor}, expected a number from 0.5 to 2; units belong "
            "into the poses"
        )


@dataclass(frozen=True)
class Smoothing:
    """Randomized smoothing of the distance gradient; the distance itself is never smoothed."""

    kind: Literal["gaussian", "gumbel", "ring", "pose", "none"] = "ring"
    """``gaussian``: the paper's sampling. ``gumbel``: closed form. ``ring``: the expectation of ``gaussian`` by fixed
    quadrature. ``pose``: averages the gradient over perturbed poses, the slow reference. ``none``: the exact gradient."""
    noise: float = 0.1
    """Standard deviation of the contact direction [rad], for ``gaussian``, ``ring`` and ``pose``."""
    temperature: float = 1e-3
    """Length ε of ``gumbel`` [m]: vertices this much behind the foremost one still count."""
    samples: int = 16
    """Draws of ``gaussian`` and ``pose``, directions on each ring of ``ring``."""
    seed: int = 0
    """Seed of the draws."""

    def __post_init__(self) -> None:
        if self.kind not in ("gaussian", "gumbel", "ring", "pose", "none"):
            raise InvalidInputError(f"smoothing kind {self.kind!r}: expected gaussian, gumbel, ring, pose or none")
        _check_positive(self, "noise", "temperature", "samples")
        if not isinstance(self.samples, int):
            raise InvalidInputError(f"Smoothing.samples = {self.samples}, expected an integer")


@dataclass(frozen=True)
class Calibration:
    """What an estimator's errors are like, by :func:`physpose_torch.calibrate.calibrate`; see also
    :meth:`RefinerConfig.calibrated`."""

    depth_factor: float
    """What estimated translations must be multiplied by."""
    sigma_ray_fraction: float
    """Standard deviation along the viewing ray, as a fraction of the range, of each estimate by itself."""
    sigma_lateral: float
    """Standard deviation across the viewing ray, per axis [m]."""
    sigma_rotation: float
    """Standard deviation of the rotation, per axis [rad]."""
    sigma_depth_common: float = 0.0
    """Standard deviation of the depth factor that the estimates of one image share, from image to image."""
    interval: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """95 % confidence interval of each of these numbers, by name."""

    def __post_init__(self) -> None:
        _check_factor(self)
        _check_positive(self, "sigma_ray_fraction", "sigma_lateral", "sigma_rotation")
        if not 0 <= self.sigma_depth_common < math.inf:
            raise InvalidInputError(f"Calibration.sigma_depth_common = {self.sigma_depth_common}, expected >= 0")


@dataclass(frozen=True)
class PhysicsConfig:
    """The cost of a set of poses: pose + collision + gravity (paper Eq. 1). Lengths in metres."""

    depth_factor: float = 1.0
    """What the estimates' translations are multiplied by first: the prior is centred there. An estimator's depth bias."""
    sigma_lateral: float = 0.002
    """Standard deviation of an estimate across its viewing ray [m]."""
    sigma_ray: float = 0.0
    """Standard deviation of an estimate along its viewing ray [m], a constant part."""
    sigma_ray_fraction: float = 0.01
    """The part of it that grows with range: RGB estimators misjudge size and depth by a factor."""
    sigma_depth_common: float = 0.02
    """Standard deviation of the depth factor that all estimates of one image share; 0: errors are independent. Objects in
    contact with the table then correct the depth of those that are not. Only where something static is known."""
    sigma_rotation: float = 0.026
    """Standard deviation of an estimate's rotation per axis [rad]: 1.5°. A looser one soaks up depth error as tilt."""
    sigma_flush: float = 0.04
    """Standard deviation per axis [rad] of the tilt at which things stand: 2.3°. An estimate of an object on a plane that is
    nearly in a stable pose is joined with that; infinite: it is not. By the refiner only."""
    robust: float = 4.0
    """ν of the robust pose cost ½ ν log(1 + m²/ν), m the Mahalanobis distance: an estimate that physics contradicts by
    more than √ν σ is believed less and less; infinite: the paper's ½ m²."""
    pose_weight: float = 1.0
    """Weight of the pose cost; 0 switches it off."""
    collision_weight: float = 700.0
    """Weight ζ_C of the collision cost [1/m]; 0 switches it off. Just above the largest force of a robust pose cost across
    the ray, ν^½ / 2σ = 500 / m: touching objects end apart, and one bad estimate does not shove good ones about."""
    gravity_weight: float = 200.0
    """Weight ζ_G of the gravity cost [1/m]; 0 switches it off. Well below ζ_C, so that a stack does not press through."""
    gravity: Literal["support", "paper"] = "support"
    """``support``: how far the object can drop before it meets a support, static or not. ``paper``: mean distance of its
    parts to the nearest static part below, which never vanishes for a tall object."""
    gravity_reach: float = 0.05
    """Objects higher than this above any support are left alone [m]: something unseen may carry them. ``support`` only."""
    contact_tolerance: float = 1e-4
    """An object nearer than this to anything [m] counts as touching it, which switches its gravity off (δ in the paper)."""
    softness: float = 5e-4
    """Penetrations and gaps below this [m] cost quadratically, so that contacts settle; 0 is the paper's hinge."""
    sigma_contact: float = 0.003
    """Standard deviation of the gap between two objects in contact [m]: scans, their convex parts and true poses agree no
    better. Contacts among objects are as soft, and some of what overlaps stays; 0: no softer than others, for robots that must
    not collide. Statics are as sure as their planes say."""
    smoothing: Smoothing = Smoothing()
    """Randomized smoothing of the distance gradients."""
    backend: str = "auto"
    """Distance backend: ``auto``, or a name in ``physpose_torch.distance.backends()``."""

    def __post_init__(self) -> None:
        _check_positive(self, "sigma_lateral", "sigma_rotation", "gravity_reach")
        _check_factor(self)
        if not self.sigma_flush > 0:
            raise InvalidInputError(
                f"PhysicsConfig.sigma_flush = {self.sigma_flush}, expected a positive angle [rad] or infinity"
            )
        if not self.robust > 0:
            raise InvalidInputError(f"PhysicsConfig.robust = {self.robust}, expected a positive number or infinity")
        for name in (
            "sigma_ray",
            "sigma_ray_fraction",
            "sigma_depth_common",
            "pose_weight",
            "collision_weight",
            "gravity_weight",
            "contact_tolerance",
            "softness",
            "sigma_contact",
        ):
            if not getattr(self, name) >= 0:
                raise InvalidInputError(f"PhysicsConfig.{name} = {getattr(self, name)}, expected a number >= 0")
        if self.sigma_ray == 0 and self.sigma_ray_fraction == 0:
            raise InvalidInputError("PhysicsConfig: sigma_ray and sigma_ray_fraction are both 0; give one of them")
        if self.gravity not in ("support", "paper"):
            raise InvalidInputError(f"PhysicsConfig.gravity = {self.gravity!r}, expected 'support' or 'paper'")


@dataclass(frozen=True)
class Caution:
    """How the refiner keeps from making estimates worse. Each of these can be switched off; see :meth:`off`."""

    conflict: float = 0.02
    """Of bodies that lie deeper in one another than this [m] where planes put them, the least likely ones push nobody: false
    detections, mostly. True poses of real data overlap by up to 14 mm. Infinite: all push."""
    release: float = 3.0
    """An estimate that would have to move by more than this many σ, and still would not come to rest, is released: it keeps
    its pose and is reported as rejected. Supports are not looked for farther down either. Infinite: never."""
    unsupported: Literal["stay", "follow"] = "stay"
    """What becomes of objects under which nothing known is within reach. ``stay``: they keep their poses. ``follow``: they
    share the depth factor of the others, which is right for what something unseen carries, and wrong for wrong estimates."""
    least_sigma: float = 0.2
    """Estimates that agree with the scene better than is usual are taken to be more accurate: their σ along the ray and in
    rotation shrink, image by image, down to this share. 1: they do not."""
    doubt: float = 2.0
    """An image is left as it is where its objects together contradict what is known of it by more than this many σ, in depth or
    in tilt: a wrong plane, wrong units, an estimator that is far off. Infinite: never."""

    def __post_init__(self) -> None:
        for name in ("conflict", "release", "doubt"):
            if not getattr(self, name) > 0:
                raise InvalidInputError(f"Caution.{name} = {getattr(self, name)}, expected a positive number or infinity")
        if not 0 < self.least_sigma <= 1:
            raise InvalidInputError(f"Caution.least_sigma = {self.least_sigma}, expected a share from 0 to 1, 1 included")
        if self.unsupported not in ("stay", "follow"):
            raise InvalidInputError(f"Caution.unsupported = {self.unsupported!r}, expected 'stay' or 'follow'")

    @classmethod
    def off(cls) -> "Caution":
        """None at all: every estimate is refined, and pushes, come what may."""
        return cls(math.inf, math.inf, "follow", 1.0, math.inf)


@dataclass(frozen=True)
class RefinerConfig:
    """How the cost is minimised."""

    physics: PhysicsConfig = PhysicsConfig()
    """The cost."""
    caution: Caution = Caution()
    """What keeps it from making estimates worse."""
    start: Literal["slide", "measured"] = "slide"
    """Where to start: ``slide``: estimates that lie in a plane start where their viewing ray leads out of it, which is where
    most of them end and brings grossly sunken ones within reach. ``measured``: at the estimates, as in the paper."""
    righting: float = math.radians(75)
    """An object that would fall over where it comes to rest, whatever carries it, is turned to the nearest stable pose that is
    no farther than this [rad] and refined once more; 0: never. Estimates that wrong are mostly of the wrong side."""
    solver: Literal["descent", "lm"] = "descent"
    """``descent``: a first-order torch.optim optimizer. ``lm``: damped Gauss-Newton steps (Levenberg-Marquardt)."""
    damping: float = 1.0
    """lm: added to the curvature; that of an estimate by itself is 1 or more in each direction."""
    optimizer: Literal["adam", "sgd"] = "adam"
    """torch.optim.Adam on steps scaled by each estimate's σ, or plain gradient descent (the paper's)."""
    steps: int = 40
    """Largest number of steps."""
    learning_rate: float = 0.2
    """Adam: first step, in σ. sgd: the paper's step on the cost's gradient. lm: fraction of the Gauss-Newton step."""
    decay: Literal["cosine", "none"] = "cosine"
    """Learning rate over the steps; without decay contacts bounce by about learning_rate · ζ."""
    max_gradient: float | None = None
    """Gradients (6) of an object longer than this are shortened to it, as in the paper."""
    max_step: float = 0.01
    """No step moves an object, or turns its rim, by more than this [m]."""
    tolerance: float = 2e-6
    """An image stops when none of its objects moved by more than this [m] in a step, for ten steps on end."""
    keep_trajectory: bool = False
    """Keep the poses of every step in the result."""
    gradient: Literal["none", "implicit"] = "none"
    """``implicit``: the refined poses carry gradients towards the estimates, by the implicit function theorem at the poses
    where the refinement ended, whatever the solver. ``none``: they are detached."""

    def __post_init__(self) -> None:
        _check_positive(self, "learning_rate", "max_step", "damping")
        if self.solver not in ("descent", "lm"):
            raise InvalidInputError(f"RefinerConfig.solver = {self.solver!r}, expected 'descent' or 'lm'")
        if not 0 <= self.righting <= math.pi:
            raise InvalidInputError(f"RefinerConfig.righting = {self.righting}, expected an angle from 0 to π [rad]")
        if not (isinstance(self.steps, int) and self.steps >= 0):
            raise InvalidInputError(f"RefinerConfig.steps = {self.steps}, expected an integer >= 0")
        if self.start not in ("slide", "measured"):
            raise InvalidInputError(f"RefinerConfig.start = {self.start!r}, expected 'slide' or 'measured'")
        if self.optimizer not in ("adam", "sgd") or self.decay not in ("cosine", "none"):
            raise InvalidInputError(
                f"RefinerConfig.optimizer = {self.optimizer!r}, decay = {self.decay!r}: "
                "expected 'adam' or 'sgd', and 'cosine' or 'none'"
            )
        if self.gradient not in ("none", "implicit"):
            raise InvalidInputError(f"RefinerConfig.gradient = {self.gradient!r}, expected 'none' or 'implicit'")
        if self.max_gradient is not None:
            _check_positive(self, "max_gradient")
        if not self.tolerance >= 0:
            raise InvalidInputError(f"RefinerConfig.tolerance = {self.tolerance}, expected a number >= 0 [m]")

    def calibrated(self, calibration: Calibration) -> "RefinerConfig":
        """The same with an estimator's own bias and spread in place of the usual ones, which need no guessing then."""
        c = calibration
        physics = replace(
            self.physics,
            depth_factor=c.depth_factor,
            sigma_ray=0.0,
            sigma_ray_fraction=c.sigma_ray_fraction,
            sigma_depth_common=c.sigma_depth_common,
            sigma_lateral=c.sigma_lateral,
            sigma_rotation=c.sigma_rotation,
        )
        return replace(self, physics=physics, caution=replace(self.caution, least_sigma=1.0))

    @classmethod
    def lm(cls) -> "RefinerConfig":
        """The default cost, minimised by fifteen Gauss-Newton steps instead of forty of Adam's."""
        return cls(solver="lm", steps=15, learning_rate=0.7)

    @classmethod
    def paper(cls) -> "RefinerConfig":
        """The paper's cost, weights and plain gradient descent (Sec. 3.1 and its public code)."""
        physics = PhysicsConfig(
            sigma_lateral=0.05,
            sigma_ray=0.49,
            sigma_ray_fraction=0.0,
            sigma_depth_common=0.0,
            sigma_rotation=0.26,
            sigma_flush=math.inf,
            sigma_contact=0.0,
            collision_weight=1.0,
            gravity_weight=1.0,
            gravity="paper",
            softness=0.0,
            robust=float("inf"),
            smoothing=Smoothing("gaussian"),
        )
        return cls(
            physics,
            caution=Caution.off(),
            start="measured",
            righting=0.0,
            optimizer="sgd",
            steps=3000,
            learning_rate=1e-4,
            decay="none",
            max_gradient=1.0,
            tolerance=0.0,
        )


@dataclass(frozen=True)
class TableConfig:
    """How the table plane is estimated from images and object poses. Lengths in metres, angles in radians."""

    method: Literal["auto", "joint", "support", "homography", "paper"] = "auto"
    """``joint``: least squares over all there is. ``support``: the objects' stable faces and bottoms, no image. ``homography``:
    the table's homography between the views. ``paper``: reconstruct, scale by the objects, fit a plane. ``auto``: joint, or
    support where there are no images to look at."""
    features: Literal["auto", "xfeat", "sift"] = "auto"
    """Which matches to start from. ``auto``: XFeat where it is installed (extra ``table``), else SIFT."""
    align: bool = True
    """Align the objects with the images, by their colours where the meshes have some and by their outlines."""
    sigma_lateral: float = 0.0025
    """Standard deviation of an estimated pose across its viewing ray, per axis [m]."""
    sigma_ray_fraction: float = 0.015
    """Standard deviation along the ray, as a fraction of the range."""
    sigma_rotation: float = math.radians(1.5)
    """Standard deviation of an estimated rotation, per axis [rad]."""
    sigma_depth_common: float = 0.025
    """Standard deviation of the depth factor that all estimates share; only images can tell it."""
    sigma_scale: float = 0.015
    """Standard deviation of the scale of everything that images tell: focal lengths and models are known no better. It is only
    added to what the result is said to be worth against the world. On the two real YCB-V frames images and ground truth
    differ by 1 to 3 %."""
    sigma_surface: float = 0.0007
    """Standard deviation of real surfaces from the meshes [m]."""
    sigma_contact: float = 0.001
    """Standard deviation of the gap between what stands and the table [m]: neither is flat."""
    sigma_gravity: float = math.radians(1.0)
    """Standard deviation of a known gravity direction, per axis [rad]."""
    widest_tilt: float = math.radians(4.0)
    """A plane that is known no better than this, per axis [rad], is refused …"""
    widest_offset: float = 0.025
    """… as is one whose height at the objects is known no better than this [m]."""
    seed: int = 0
    """Seed of RANSAC."""

    def __post_init__(self) -> None:
        if self.method not in ("auto", "joint", "support", "homography", "paper"):
            raise InvalidInputError(
                f"TableConfig.method = {self.method!r}, expected auto, joint, support, homography or paper"
            )
        if self.features not in ("auto", "xfeat", "sift"):
            raise InvalidInputError(f"TableConfig.features = {self.features!r}, expected auto, xfeat or sift")
        _check_positive(
            self,
            "sigma_lateral",
            "sigma_ray_fraction",
            "sigma_rotation",
            "sigma_depth_common",
            "sigma_scale",
            "sigma_surface",
            "sigma_contact",
            "sigma_gravity",
            "widest_tilt",
            "widest_offset",
        )
