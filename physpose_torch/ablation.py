"""What refined poses are compared with: plain baselines, and the same refiner with one thing changed."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from physpose_torch.config import Calibration, Caution, RefinerConfig
from physpose_torch.contacts import object_heights
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Plane
from physpose_torch.losses import acting
from physpose_torch.scene import Scene, Static

__all__ = [
    "Knowledge",
    "Variant",
    "as_estimated",
    "choose",
    "disturb",
    "list_variants",
    "scale_depth",
    "slide_onto_planes",
    "tilted",
    "with_exact_planes",
    "with_planes",
    "without_planes",
]

Knowledge = Literal["known", "none", "exact", "disturbed"]
"""What a variant is told of the planes: as in the file, nothing, that they are exact, or something a little wrong."""

MEGAPOSE_FACTOR = 0.976
"""What the depths of MegaPose on YCB-V must be multiplied by, measured beforehand against the ground truth."""

BASELINES = "Baselines"
TERMS = "Cost terms (paper, Table 3)"
SCENE = "Scene knowledge (paper, Table 2)"
CAUTION = "Caution (what keeps estimates from being made worse)"
CHOICES = "Other choices"


@dataclass(frozen=True)
class Variant:
    """One row of the table: poses by a refiner, or by a baseline."""

    name: str
    """What it is asked for by."""
    group: str
    """Heading that it stands under."""
    config: RefinerConfig | None = None
    """The refiner's; None: a baseline."""
    baseline: Callable[[Tensor, Scene], Tensor] | None = None
    """(poses (N, 4, 4), scene) → poses; None: the refiner."""
    knowledge: Knowledge = "known"
    """What it is told of the planes."""
    label: str = ""
    """What the table shows instead of the name, if there is more to say."""
    slow: bool = False
    """Takes minutes where others take seconds."""
    always: bool = False
    """Stands in every table."""

    @property
    def shown(self) -> str:
        return self.label or self.name

    @property
    def key(self) -> tuple:
        """Variants with the same key have the same poses."""
        return self.config, self.baseline, self.knowledge


# ---- baselines


def as_estimated(poses: Tensor, scene: Scene) -> Tensor:
    """The estimates (N, 4, 4) as they are."""
    return poses.clone()


def scale_depth(poses: Tensor, scene: Scene, *, factor: float) -> Tensor:
    """The estimates (N, 4, 4) with all translations multiplied by one factor."""
    poses = poses.clone()
    poses[:, :3, 3] *= factor
    return poses


def slide_onto_planes(poses: Tensor, scene: Scene) -> Tensor:
    """The estimates (N, 4, 4), each moved along its own viewing ray until its lowest point touches the plane.

    Up or down, however far; an object that would have to go behind the camera stays where it is. The ray goes to the centre
    of the body's bounds. Of several planes the one that is reached first counts.
    """
    poses = poses.clone()
    ray = scene.centers(poses)
    distance = torch.linalg.vector_norm(ray, dim=-1)
    who, plane = scene.plane_pairs.to(poses.device).unbind(1)
    slope = (scene.plane_normal.to(poses)[plane] * ray[who]).sum(-1) / distance[who]
    slide = -object_heights(poses, scene) / slope
    fits = slide.isfinite() & (distance[who] + slide > 0)
    who, slide = who[fits], slide[fits]
    nearest = poses.new_full((len(poses),), torch.inf).scatter_reduce(0, who, slide.abs(), "amin")
    first = slide.abs() == nearest[who]
    slide = poses.new_zeros(len(poses)).scatter_reduce(0, who[first], slide[first], "amax", include_self=False)
    poses[:, :3, 3] += (slide / distance)[:, None] * ray
    return poses


# ---- what is known of the planes, image by image


def without_planes(scene: Scene) -> Scene:
    """The scene of one image without planes, and so without gravity; static bodies stay."""
    return Scene(scene.objects, scene.static_bodies, same_object=scene.same_object)


def with_exact_planes(scene: Scene) -> Scene:
    """The scene of one image, its planes taken as exact."""
    return with_planes(scene, [Plane(p.shape.normal, p.shape.offset) for p in scene.planes])


def disturb(
    scene: Scene,
    poses: Tensor,
    *,
    tilt: float,
    offset: float,
    generator: torch.Generator,
    scores: Tensor | None = None,
) -> Scene:
    """The scene of one image with planes that are a little wrong, and say so.

    Each plane is tilted about two axes through its point under the objects' centre, to which ``Plane.covariance`` refers,
    and moved along its normal. The variances of that are added to those that the plane has already; gravity goes along.

    Args:
        scene: one image.
        poses: T_camera_object (N, 4, 4) [m], where the objects' centre is taken from.
        tilt: standard deviation about each axis [rad].
        offset: standard deviation of the height [m].
        generator: of the draws.
        scores: (N,), see :class:`~physpose_torch.losses.PhysicsLoss`; only objects that act count for the centre.
    """
    centers = scene.centers(poses)
    middle = centers[acting(scene, scores)].mean(0) if len(scene) else poses.new_zeros(3)
    added = torch.diag(torch.tensor([tilt**2, tilt**2, offset**2], dtype=torch.float64))
    planes = []
    for static in scene.planes:
        plane = static.shape
        draw = torch.randn(3, generator=generator, dtype=torch.float64)
        covariance = added if plane.covariance is None else added + plane.covariance
        exact = tilt == 0 and offset == 0 and plane.covariance is None
        wrong = tilted(plane, middle, tilt * draw[:2], offset * draw[2])
        planes.append(Plane(wrong.normal, wrong.offset, None if exact else covariance))
    return with_planes(scene, planes)


def tilted(plane: Plane, middle: Tensor, tilt: Tensor, offset: Tensor | float) -> Plane:
    """A plane turned about its point that is nearest to another point, and moved; its covariance stays as it is.

    Args:
        plane: in the camera frame.
        middle: (3,) that point [m].
        tilt: (2,) by how much it rises along two tangents [rad].
        offset: how far it moves along its new normal [m].
    """
    point = middle - (plane.normal @ middle - plane.offset) * plane.normal
    # rising along a tangent by the angle turns the normal back by it
    slope = torch.tan(tilt) @ tangent_basis(plane.normal[None])[0]
    normal = torch.nn.functional.normalize(plane.normal - slope, dim=0)
    return Plane(normal, normal @ point + offset, plane.covariance)


def with_planes(scene: Scene, planes: list[Plane]) -> Scene:
    """The scene of one image with other planes; gravity goes along where it is that of a single plane."""
    gravity = scene.gravity
    if len(planes) == 1 and bool((gravity != 0).any()):
        gravity = -planes[0].normal[None]
    return Scene(
        scene.objects,
        [*scene.static_bodies, *map(Static, planes)],
        gravity=gravity,
        same_object=scene.same_object,
    )


# ---- the rows


def list_variants(
    config: RefinerConfig,
    *,
    calibration: Calibration | None = None,
    planes: bool = True,
    disturbance: tuple[float, float] = (math.radians(1.5), 0.006),
) -> list[Variant]:
    """All rows of the table, in its order; the reference is the first that has the config itself.

    Args:
        config: what the rows are changes of. Changes that change nothing are left out.
        calibration: of the estimator; adds rows that use it.
        planes: whether planes are known at all.
        disturbance: standard deviations of tilt [rad] and height [m] of disturbed planes, for the labels.
    """
    physics = config.physics
    factor, source = (calibration.depth_factor, "C.json") if calibration else (MEGAPOSE_FACTOR, "MegaPose")
    rows = [
        Variant("input", BASELINES, baseline=as_estimated, always=True),
        Variant(
            "one depth factor",
            BASELINES,
            baseline=partial(scale_depth, factor=factor),
            label=f"depth × {factor:.3f} ({source})",
            always=True,
        ),
        Variant("slide onto the plane", BASELINES, baseline=slide_onto_planes, always=True),
        Variant("P + C + G", TERMS, config, label="P + C + G (reference)", always=True),
    ]
    if not planes:
        rows = [row for row in rows if row.baseline is not slide_onto_planes]

    def change(name: str, group: str = CHOICES, *, slow: bool = False, start: str | None = None, **of_physics) -> None:
        changed = replace(config, physics=replace(physics, **of_physics), start=start or config.start)
        label = ""
        if changed.solver == "lm" and not _lm_knows(changed):
            changed, label = with_solver(changed, "descent"), f"{name}, descent"
        if changed not in [row.config for row in rows]:
            rows.append(Variant(name, group, changed, label=label, slow=slow))

    change("without P", TERMS, pose_weight=0.0)
    change("without C", TERMS, collision_weight=0.0)
    change("without G", TERMS, gravity_weight=0.0)
    change("only P", TERMS, collision_weight=0.0, gravity_weight=0.0)
    # sliding out of planes is something of the collision cost already, and a robust pose cost does not take all of it back
    change("without C, start measured", TERMS, start="measured", collision_weight=0.0)
    change("only P, start measured", TERMS, start="measured", collision_weight=0.0, gravity_weight=0.0)

    tilted = f"{math.degrees(disturbance[0]):g}° {1000 * disturbance[1]:g} mm"
    rows.append(Variant("initial", SCENE, baseline=as_estimated, label="initial (= input)"))
    if planes:
        rows += [
            Variant("no plane", SCENE, config, knowledge="none", label="no plane (collisions only)"),
            Variant("plane disturbed", SCENE, config, knowledge="disturbed", label=f"plane disturbed {tilted}"),
            Variant("plane exact", SCENE, config, knowledge="exact", label="known plane, taken as exact"),
        ]
    rows.append(Variant("known scene", SCENE, config, label="known scene (= reference)"))

    def careless(name: str, caution: Caution) -> None:
        changed = replace(config, caution=caution)
        if changed not in [row.config for row in rows]:
            rows.append(Variant(name, CAUTION, changed))

    caution = config.caution
    careless("all push", replace(caution, conflict=math.inf))
    careless("none released", replace(caution, release=math.inf))
    careless("unsupported follow", replace(caution, unsupported="follow"))
    careless("usual accuracy", replace(caution, least_sigma=1.0))
    careless("no doubt", replace(caution, doubt=math.inf))
    careless("without caution", Caution.off())

    for form in ("support", "paper"):
        change(f"gravity {form}", gravity=form)
    change("not flush", sigma_flush=math.inf)
    change("strict contacts", sigma_contact=0.0)
    for kind in ("ring", "gaussian", "gumbel", "none"):
        change(f"smoothing {kind}", smoothing=replace(physics.smoothing, kind=kind), slow=kind == "gumbel")
    change("no common depth factor", sigma_depth_common=0.0)
    change("not robust", robust=math.inf)
    paper = RefinerConfig.paper()
    sigmas = ("sigma_lateral", "sigma_ray", "sigma_ray_fraction", "sigma_depth_common", "sigma_rotation")
    change("paper sigmas", **{name: getattr(paper.physics, name) for name in sigmas})
    for start in ("slide", "measured"):
        change(f"start {start}", start=start)
    for solver in ("descent", "lm"):
        if solver != config.solver and (solver == "descent" or _lm_knows(config)):
            rows.append(Variant(f"solver {solver}", CHOICES, with_solver(config, solver)))
    if config.righting:
        rows.append(Variant("without righting", CHOICES, replace(config, righting=0.0)))
    if config != paper:
        rows.append(Variant("paper preset", CHOICES, paper, slow=True))
    if calibration is not None:
        own = config.calibrated(calibration)
        rows.append(Variant("calibrated", CHOICES, own))
        if planes:
            rows.append(Variant("calibrated, plane disturbed", CHOICES, own, knowledge="disturbed"))
    return rows


def with_solver(config: RefinerConfig, solver: Literal["descent", "lm"]) -> RefinerConfig:
    """The same cost and start by another solver, with the step options that its preset has."""
    descent, lm = RefinerConfig(), RefinerConfig.lm()
    preset = lm if solver == "lm" else descent
    names = {f.name for f in fields(RefinerConfig) if getattr(descent, f.name) != getattr(lm, f.name)}
    return replace(config, **{name: getattr(preset, name) for name in names - {"physics"}})


def _lm_knows(config: RefinerConfig) -> bool:
    physics = config.physics
    kinds = ("ring", "gaussian", "none")
    return physics.gravity == "support" and physics.smoothing.kind in kinds


def choose(variants: list[Variant], names: tuple[str, ...] = (), *, slow: bool = False) -> list[Variant]:
    """Those with these names, and those that stand in every table; no names: all but the slow ones, or these, too.

    Raises:
        InvalidInputError: a name is unknown.
    """
    known = [v.name for v in variants]
    if unknown := [name for name in names if name not in known]:
        rows = ", ".join(repr(name) for name in known)
        raise InvalidInputError(f"--rows {' '.join(map(repr, unknown))}: no such row; there are {rows}")
    if names:
        return [v for v in variants if v.always or v.name in names]
    return [v for v in variants if slow or not v.slow]
