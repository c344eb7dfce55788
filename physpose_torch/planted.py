"""Failures planted into the estimates of an image: false detections, missing supporters, gross errors, wrong planes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.ablation import tilted, with_planes
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.household import perturb_like_estimator
from physpose_torch.losses import acting
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene

__all__ = ["FAILURES", "Estimated", "Failure", "FailureName", "Planted", "choose_failures"]

FailureName = Literal[
    "false-positive", "duplicate", "missing-supporter", "depth-order", "outliers", "wrong-plane", "accurate"
]

CARRIED = 0.01
"""[m]; what is not higher above an object in the ground truth is carried by it. Annotations float by up to 6 mm."""
ORDER = 0.02
"""[m]; two objects whose distances differ by less have no order along the ray."""
OUTLIERS = 0.3
"""Share of objects."""
FAR = (0.05, 0.15)
"""[m]; how far an outlier is off along its ray."""
TURNED = (60.0, 180.0)
"""[deg]; how far an outlier is turned."""
TOO_HIGH = 0.02
"""[m]"""
TILT = 8.0
"""[deg]"""
NOISE = (0.001, 0.5)
"""[m], [deg]; standard deviations on each axis of accurate poses."""


class Estimated(NamedTuple):
    """The estimates of one image, and the truth about it."""

    poses: Tensor
    """T_camera_object (N, 4, 4) float64 [m]."""
    scores: Tensor
    """(N,)."""
    scene: Scene
    """The N objects, with statics, gravity and alternatives."""
    true_poses: Tensor
    """T_camera_object (G, 4, 4) float64 [m]."""
    true_bodies: tuple[Body, ...]
    """G."""
    truth: Tensor
    """(N,) long, which of the G each estimate is matched with; -1: none."""
    absent: tuple[Body, ...] = ()
    """Bodies that are neither in this image nor estimated in it."""


class Planted(NamedTuple):
    """The same image with a failure."""

    poses: Tensor
    """T_camera_object (M, 4, 4) float64 [m]."""
    scores: Tensor
    """(M,)."""
    scene: Scene
    """The M objects, statics and gravity; who is an alternative of whom is not known yet."""
    source: Tensor
    """(M,) long, the estimate that each comes from; -1: made here."""
    touched: Tensor
    """(M,) bool: made or moved here."""


Plant = Callable[[Estimated, torch.Generator], Planted | None]


@dataclass(frozen=True)
class Failure:
    """Something that goes wrong with estimators, and how it is planted."""

    name: FailureName
    """What it is asked for by; a name may stand for several."""
    label: str
    """What it is called in a table."""
    what: str
    """What is planted, in a sentence."""
    plant: Plant
    """(estimates, generator) → the same with the failure; None where it does not fit the image."""
    counted: bool = True
    """Whether it may be known how many instances of each object there are, where a targets file tells."""


def false_positive(image: Estimated, generator: torch.Generator, *, sure: bool) -> Planted | None:
    """Add a body that is not there, turned at random, its centre in the middle of the centres of the others."""
    if not len(image.poses) or not image.absent:
        return None
    body = image.absent[_below(len(image.absent), generator)]
    middle = image.scene.centers(image.poses)[acting(image.scene, image.scores)].mean(0)
    R = _any_turn(generator)
    pose = se3.from_rotation_translation(R, middle - R @ body.center.to(R))
    return _added(image, body, pose, image.scores.max() if sure else image.scores.min() / 2)


def duplicate(image: Estimated, generator: torch.Generator) -> Planted | None:
    """Add a second estimate of an object that acts, with an estimator's noise (no bias) and half of its score."""
    rows = acting(image.scene, image.scores).nonzero()[:, 0]
    if not len(rows):
        return None
    row = int(rows[_below(len(rows), generator)])
    body = image.scene.objects[row]
    at_center = _about_centers(image.poses[row : row + 1], [body])
    noisy = perturb_like_estimator(at_center, generator=generator, depth_bias=0.0)
    return _added(image, body, _about_centers(noisy, [body], back=True)[0], image.scores[row] / 2)


def missing_supporter(image: Estimated, generator: torch.Generator) -> Planted | None:
    """Remove all estimates of an object that, by the ground truth, carries another one that is estimated, too."""
    statics, gravity = image.scene.statics, image.scene.gravity
    if not bool((gravity != 0).any()) or not len(image.true_bodies):
        return None
    report = physics_report(image.true_poses, Scene(image.true_bodies, statics, gravity=gravity))
    carrier = torch.where(report.gap < CARRIED, report.support, -1)[image.truth.clamp_min(0)]
    carrier = carrier[(image.truth >= 0) & (carrier >= 0) & (carrier < len(image.true_bodies))].unique()
    rows = torch.isin(image.truth, carrier).nonzero()[:, 0]
    if not len(rows):
        return None
    row = rows[_below(len(rows), generator)]
    return _kept(image, image.scene.same_object != image.scene.same_object[row])


def depth_order(image: Estimated, generator: torch.Generator) -> Planted | None:
    """Swap the distances of two neighbours along their rays, orientations as they are; their alternatives are left out.

    Neighbours are two that act, whose bounding spheres overlap in the image, at distances that differ by at least 2 cm.
    """
    rows = acting(image.scene, image.scores).nonzero()[:, 0]
    centers = image.scene.centers(image.poses)[rows]
    distance = torch.linalg.vector_norm(centers, dim=-1)
    bodies = [image.scene.objects[i] for i in rows.tolist()]
    radius = torch.tensor([float(torch.linalg.vector_norm(b.upper - b.lower)) / 2 for b in bodies], dtype=torch.float64)
    angle = torch.asin((radius / distance).clamp(max=1.0))
    ray = centers / distance[:, None]
    apart = torch.arccos((ray @ ray.mT).clamp(-1, 1))
    order = (distance[:, None] - distance).abs() >= ORDER
    pairs = ((apart < angle[:, None] + angle) & order).triu(1).nonzero()
    if not len(pairs):
        return None
    pair = pairs[_below(len(pairs), generator)]
    poses = image.poses.clone()
    poses[rows[pair], :3, 3] += (distance[pair.flip(0)] - distance[pair])[:, None] * ray[pair]
    return _moved(image, poses, rows[pair])


def outliers(image: Estimated, generator: torch.Generator) -> Planted | None:
    """Make 30 % of the objects that act grossly wrong, either along the ray or in orientation; their alternatives are left out.

    Over many images the share is 30 %: of three objects it is one, and sometimes none.
    """
    rows = acting(image.scene, image.scores).nonzero()[:, 0]
    if not len(rows):
        return None
    count = int(OUTLIERS * len(rows) + float(torch.rand((), generator=generator, dtype=torch.float64)))
    chosen = rows[torch.randperm(len(rows), generator=generator)[:count]]
    poses, centers = image.poses.clone(), image.scene.centers(image.poses)
    for row in chosen.tolist():
        if _below(2, generator):
            distance = float(torch.linalg.vector_norm(centers[row]))
            shift = _between(*FAR, generator) * (1 - 2 * _below(2, generator))
            shift = abs(shift) if shift < -0.5 * distance else shift  # nothing is at or behind the camera
            poses[row, :3, 3] += shift / distance * centers[row]
        else:
            body = [image.scene.objects[row]]
            at_center = _about_centers(poses[row : row + 1], body)
            at_center[0, :3, :3] = at_center[0, :3, :3] @ _turn(TURNED, generator)
            poses[row] = _about_centers(at_center, body, back=True)[0]
    return _moved(image, poses, chosen)


def wrong_plane(image: Estimated, generator: torch.Generator, *, offset: float = 0.0, tilt: float = 0.0) -> Planted | None:
    """Raise each plane [m] or tilt it [rad] about its point under the objects, any way; it is as sure of itself as before."""
    if not len(image.poses) or not image.scene.planes:
        return None
    middle = image.scene.centers(image.poses)[acting(image.scene, image.scores)].mean(0)
    planes = []
    for static in image.scene.planes:
        way = _between(0.0, 2 * math.pi, generator)
        # tilted() adds two slopes, so the tilt's own tangent is split between them
        slope = torch.atan(math.tan(tilt) * torch.tensor([math.cos(way), math.sin(way)], dtype=torch.float64))
        planes.append(tilted(static.shape, middle, slope, offset))
    kept = _kept(image, torch.ones(len(image.poses), dtype=torch.bool))
    return kept._replace(scene=with_planes(kept.scene, planes))


def accurate(image: Estimated, generator: torch.Generator) -> Planted | None:
    """All estimates replaced by ground truth poses with 1 mm and 0.5° of noise on each axis, all of score 1."""
    if not len(image.true_bodies):
        return None
    noise = torch.randn((len(image.true_bodies), 6), generator=generator, dtype=torch.float64)
    noise *= torch.tensor([NOISE[0]] * 3 + [math.radians(NOISE[1])] * 3, dtype=torch.float64)
    noisy = se3.retract(_about_centers(image.true_poses, image.true_bodies), noise)
    poses = _about_centers(noisy, image.true_bodies, back=True)
    made = torch.full((len(poses),), -1)
    scene = Scene(image.true_bodies, image.scene.statics, gravity=image.scene.gravity)
    return Planted(poses, torch.ones(len(poses), dtype=torch.float64), scene, made, torch.ones(len(poses)) > 0)


FAILURES = (
    Failure(
        "false-positive",
        "false positive, low score",
        "a body that is not there in the middle of the others, with half of the lowest score",
        partial(false_positive, sure=False),
    ),
    Failure(
        "false-positive",
        "false positive, high score",
        "a body that is not there in the middle of the others, with the highest score",
        partial(false_positive, sure=True),
    ),
    Failure(
        "duplicate",
        "duplicate",
        "a second estimate of one object, with an estimator's noise; how many there are is not told",
        duplicate,
        counted=False,
    ),
    Failure(
        "missing-supporter", "missing supporter", "an object that carries another one is not estimated", missing_supporter
    ),
    Failure("depth-order", "depth order", "two neighbours with their distances along the ray swapped", depth_order),
    Failure("outliers", "outliers", "30 % of the objects 5 to 15 cm off along the ray, or turned by 60° or more", outliers),
    Failure(
        "wrong-plane",
        "plane too high",
        "the plane 2 cm too high, with the σ that is stated",
        partial(wrong_plane, offset=TOO_HIGH),
    ),
    Failure(
        "wrong-plane",
        "plane tilted",
        "the plane tilted by 8°, with the σ that is stated",
        partial(wrong_plane, tilt=math.radians(TILT)),
    ),
    Failure("accurate", "accurate", "ground truth poses with 1 mm and 0.5° of noise on each axis", accurate),
)
"""All there are."""


def choose_failures(names: Sequence[str]) -> list[Failure]:
    """Those with these names, in the order of `FAILURES`.

    Raises:
        InvalidInputError: a name is unknown.
    """
    known = get_args(FailureName)
    if unknown := [name for name in names if name not in known]:
        raise InvalidInputError(f"--plant {' '.join(unknown)}: no such failure; there are {', '.join(known)}")
    return [f for f in FAILURES if f.name in names]


# ---- images with rows added, removed and moved


def _added(image: Estimated, body: Body, pose: Tensor, score: Tensor) -> Planted:
    n = len(image.poses)
    scene = Scene([*image.scene.objects, body], image.scene.statics, gravity=image.scene.gravity)
    source = torch.cat([torch.arange(n), torch.tensor([-1])])
    poses, scores = torch.cat([image.poses, pose[None]]), torch.cat([image.scores, score[None]])
    return Planted(poses, scores, scene, source, source < 0)


def _kept(image: Estimated, keep: Tensor) -> Planted:
    source = keep.nonzero()[:, 0]
    objects = [image.scene.objects[i] for i in source.tolist()]
    scene = Scene(objects, image.scene.statics, gravity=image.scene.gravity)
    return Planted(image.poses[source], image.scores[source], scene, source, torch.zeros(len(source), dtype=torch.bool))


def _moved(image: Estimated, poses: Tensor, rows: Tensor) -> Planted:
    """With other poses of some rows, and without the alternatives of these, which would be better estimates."""
    touched = torch.zeros(len(poses), dtype=torch.bool)
    touched[rows] = True
    same = image.scene.same_object
    kept = _kept(image._replace(poses=poses), touched | ~torch.isin(same, same[touched]))
    return kept._replace(touched=touched[kept.source])


def _about_centers(poses: Tensor, bodies: Sequence[Body], *, back: bool = False) -> Tensor:
    """Poses (K, 4, 4) of bodies as those of frames at the centres of their bounds, or back."""
    shift = torch.stack([b.center for b in bodies]).to(poses) * (-1 if back else 1)
    poses = poses.clone()
    poses[:, :3, 3] += (poses[:, :3, :3] @ shift[:, :, None])[:, :, 0]
    return poses


# ---- draws


def _below(n: int, generator: torch.Generator) -> int:
    return int(torch.randint(n, (), generator=generator))


def _between(low: float, high: float, generator: torch.Generator) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def _turn(degrees: tuple[float, float], generator: torch.Generator) -> Tensor:
    """A rotation (3, 3) about a random axis."""
    axis = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    return se3.exp_so3(math.radians(_between(*degrees, generator)) * axis)


def _any_turn(generator: torch.Generator) -> Tensor:
    """A rotation (3, 3), any as likely as any other."""
    q, r = torch.linalg.qr(torch.randn((3, 3), generator=generator, dtype=torch.float64))
    q = q * r.diagonal().sign()
    return q * torch.linalg.det(q)
