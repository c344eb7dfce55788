"""What a robot would ask of a set of poses: how deep objects are inside each other, how high above their support."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from physpose_torch.contacts import find_contacts, find_drops
from physpose_torch.distance.autograd import chosen_backend
from physpose_torch.losses import acting, check_poses
from physpose_torch.scene import Scene

__all__ = ["PhysicsReport", "physics_report", "report_of"]

REACH = 1.0
"""[m]; supports farther below than this are not looked for."""
NOTABLE = 1e-3
"""[m]; penetrations and gaps above this show in the status."""


@dataclass(frozen=True, eq=False)
class PhysicsReport:
    """Physical plausibility of each object, measured on convex parts; tensors are (..., N)."""

    penetration_static: Tensor
    """Deepest penetration into a static body or plane [m], 0 without any."""
    penetration_object: Tensor
    """Deepest penetration into another object [m], 0 without any; alternatives of one object are not counted."""
    gap: Tensor
    """How far the object can drop before it meets a support [m]; 0 in contact, NaN without gravity, inf: none below."""
    support: Tensor
    """What carries it or would: object index, or N + index of a static (bodies first, then planes); -1: nothing."""
    labels: tuple[str, ...]
    """Label of each object."""

    @property
    def penetration(self) -> Tensor:
        """The deeper of the two penetrations [m]."""
        return torch.maximum(self.penetration_static, self.penetration_object)

    @property
    def status(self) -> list[str]:
        """``penetrating``, ``floating``, ``resting``, ``unsupported`` or ``free`` (no gravity), flat over (..., N)."""
        words = []
        for depth, gap in zip(self.penetration.reshape(-1).tolist(), self.gap.reshape(-1).tolist(), strict=True):
            if depth > NOTABLE:
                words.append("penetrating")
            elif gap != gap:
                words.append("free")
            elif gap == float("inf"):
                words.append("unsupported")
            else:
                words.append("floating" if gap > NOTABLE else "resting")
        return words

    def __str__(self) -> str:
        rows = [f"{'object':20s} {'in static':>10s} {'in object':>10s} {'gap':>8s}  status   [mm]"]
        columns = (self.penetration_static, self.penetration_object, self.gap)
        values = [x.reshape(-1).tolist() for x in columns]
        repeat = len(values[0]) // max(len(self.labels), 1)
        for label, deep, inside, gap, status in zip(self.labels * repeat, *values, self.status, strict=True):
            rows.append(f"{label:20s} {1e3 * deep:10.2f} {1e3 * inside:10.2f} {1e3 * gap:8.2f}  {status}")
        return "\n".join(rows)


def physics_report(
    poses: Tensor, scene: Scene, *, scores: Tensor | None = None, backend: str = "auto"
) -> PhysicsReport:
    """Measure poses without changing them.

    Args:
        poses: T_camera_object, (..., N, 4, 4) [m].
        scene: the N objects, statics and gravity.
        scores: (N,), see :class:`physpose_torch.losses.PhysicsLoss`.
        backend: distance backend.

    Raises:
        InvalidInputError: shapes, NaN or non-rigid poses.
    """
    poses = check_poses(poses, scene)
    copies = poses.shape[:-3].numel()
    with torch.inference_mode(False), torch.no_grad():
        flat = poses.detach().clone().double()
        many = scene if copies == 1 else Scene.cat([scene] * copies)
        report = report_of(flat, scene, many, acting(scene, scores).repeat(copies), backend)
    lengths = ("penetration_static", "penetration_object", "gap")
    return replace(report, **{name: getattr(report, name).to(poses.dtype) for name in lengths})


def report_of(
    poses: Tensor, scene: Scene, many: Scene, acts: Tensor, backend: str, cost: object | None = None
) -> PhysicsReport:
    """The report of checked float64 poses (..., N, 4, 4).

    Args:
        scene: the scene; many: as many of it in one as there are poses.
        acts: (M,) bool, which of the objects in ``many`` act.
        cost: a :class:`~physpose_torch.fused.FusedCost` at these poses, which knows most of it already.
    """
    flat, n, copies = poses.reshape(-1, 4, 4), len(scene), poses.shape[:-3].numel()
    if hasattr(cost, "measure"):
        measured = cost.measure(reach=REACH)
    elif chosen_backend(backend) == "warp" and _fused().remembers(many):
        measured = _fused().FusedMeasure(many, acts, flat).measure(reach=REACH)
    else:
        measured = _measure(flat, many, acts, backend)
    in_static, in_object, height, support = measured
    falls = (many.gravity != 0).any(-1)[many.image].to(flat.device)
    gap = torch.where(falls, height, torch.nan)
    support = torch.where(falls, support, -1)
    copy = torch.arange(copies, device=flat.device).repeat_interleave(n)
    support = _own_numbers(support, copy, n, len(scene.static_bodies), len(scene.planes), copies)
    shape = poses.shape[:-2]
    in_static, in_object, gap = (x.reshape(shape).to(poses.dtype) for x in (in_static, in_object, gap))
    return PhysicsReport(in_static, in_object, gap, support.reshape(shape), tuple(scene.labels))


def _fused():
    from physpose_torch import fused  # which imports Warp

    return fused


def _measure(poses: Tensor, scene: Scene, acts: Tensor, backend: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    contacts = find_contacts(poses, scene, acts=acts, backend=backend)
    depth = (-contacts.distance).clamp_min(0.0)
    first, second = contacts.pair_first[contacts.pair], contacts.pair_second[contacts.pair]
    static = second >= len(scene)
    felt_first, felt_second = contacts.moves_first[contacts.pair], contacts.moves_second[contacts.pair]
    in_static, in_object = poses.new_zeros(len(scene)), poses.new_zeros(len(scene))
    in_static = in_static.scatter_reduce(0, first[static], depth[static], "amax")
    for who, felt in ((first, felt_first), (second, felt_second)):
        among = ~static & felt
        in_object = in_object.scatter_reduce(0, who[among], depth[among], "amax")
    drops = find_drops(poses, scene, acts=acts, reach=REACH, backend=backend)
    return in_static, in_object, drops.height, drops.support


def _own_numbers(support: Tensor, copy: Tensor, n: int, bodies: int, planes: int, copies: int) -> Tensor:
    """Entity numbers of a scene repeated ``copies`` times, as numbers of the one scene."""
    body = n * copies
    plane = body + bodies * copies
    own = torch.where(support >= plane, support - plane - copy * planes + n + bodies, support - copy * n)
    own = torch.where((support >= body) & (support < plane), support - body - copy * bodies + n, own)
    return torch.where(support < 0, -1, own)
