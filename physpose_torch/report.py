"""What a robot would ask of a set of poses: how deep objects are in each other, how high above their support, if they stay."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from physpose_torch.contacts import find_contacts, find_drops
from physpose_torch.distance.autograd import chosen_backend
from physpose_torch.losses import acting, check_poses
from physpose_torch.scene import Scene
from physpose_torch.stability import BALANCE, Posed, stability_margin

__all__ = ["PhysicsReport", "measure", "physics_report", "report_of"]

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
    _carriers: tuple[str, ...] = field(repr=False)
    """Name of everything that ``support`` may be."""
    _posed: Posed = field(repr=False)
    """What stability is worked out of, when it is asked for."""

    @property
    def penetration(self) -> Tensor:
        """The deeper of the two penetrations [m]."""
        return torch.maximum(self.penetration_static, self.penetration_object)

    @cached_property
    def stability_margin(self) -> Tensor:
        """How far inside its support polygon the centre of mass is, seen along gravity [m]; worked out on first use.

        Negative outside, -inf where nothing carries the object, NaN without gravity. The object is judged where it stands
        after dropping by its gap; the centre of mass is that of uniform density; a carrier need not be stable itself.
        """
        with torch.inference_mode(False), torch.no_grad():
            return stability_margin(self._posed).reshape(self.gap.shape).to(self.gap)

    @property
    def stable(self) -> Tensor:
        """Bool: the object would not tip over. False where nothing carries it, and where gravity is not known."""
        return self.stability_margin > BALANCE

    @property
    def supporter(self) -> list[str]:
        """Label of what carries each object or would, ``plane``, or ``-`` for nothing; flat over (..., N)."""
        names = (*self._carriers, "-")  # -1 is the last
        return [names[i] for i in self.support.reshape(-1).tolist()]

    @property
    def status(self) -> list[str]:
        """One word for each object, flat over (..., N); the first that fits.

        ``penetrating``, ``free`` (no gravity), ``unsupported`` (nothing below), ``floating``, ``tipping`` (in contact, not
        stable) or ``resting``.
        """
        words = []
        columns = (self.penetration, self.gap, self.stable)
        for depth, gap, stable in zip(*(x.reshape(-1).tolist() for x in columns), strict=True):
            if depth > NOTABLE:
                words.append("penetrating")
            elif gap != gap:
                words.append("free")
            elif gap == float("inf"):
                words.append("unsupported")
            elif gap > NOTABLE:
                words.append("floating")
            else:
                words.append("resting" if stable else "tipping")
        return words

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain Python for JSON, lengths in metres, one entry an object (flat over (..., N)).

        Where there is no number (nothing below, no gravity) it is None; so is ``stable`` without gravity.
        """
        lengths = ("penetration_static", "penetration_object", "gap", "stability_margin")
        columns = {name: [_number(x) for x in getattr(self, name).reshape(-1).tolist()] for name in lengths}
        unknown = self.gap.isnan().reshape(-1).tolist()
        stable = self.stable.reshape(-1).tolist()
        columns = {
            "label": self._every_label(),
            **columns,
            "support": self.supporter,
            "stable": [None if u else s for u, s in zip(unknown, stable, strict=True)],
            "status": self.status,
        }
        return {"objects": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]}

    def __str__(self) -> str:
        words = {None: "-", True: "yes", False: "no"}
        rows = []
        for o in self.to_dict()["objects"]:
            lengths = (_mm(o[key]) for key in ("penetration_static", "penetration_object", "gap"))
            rows.append((o["label"], *lengths, o["support"], words[o["stable"]], o["status"]))
        header = ("object", "in static", "in object", "gap", "carried by", "stable", "status  [mm]")
        widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
        numbers = range(1, 4)
        lines = []
        for row in (header, *rows):
            cells = [
                c.rjust(w) if i in numbers else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
            ]
            lines.append("  ".join(cells).rstrip())
        return "\n".join(lines)

    def _every_label(self) -> Sequence[str]:
        return self.labels * (self.gap.numel() // max(len(self.labels), 1))


def _number(x: float) -> float | None:
    return x if math.isfinite(x) else None


def _mm(x: float | None) -> str:
    return "-" if x is None else f"{1e3 * x:.2f}"


def physics_report(
    poses: Tensor, scene: Scene, *, scores: Tensor | None = None, backend: str = "auto"
) -> PhysicsReport:
    """Measure poses without changing them.

    All is computed in float64, with the errors of :func:`~physpose_torch.distance.autograd.signed_distance` and, in relation to
    planes, of :func:`~physpose_torch.distance.plane.plane_distance`.

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
    in_static, in_object, height, support = measure(flat, many, acts, backend, cost)
    falls = (many.gravity != 0).any(-1)[many.image].to(flat.device)
    gap = torch.where(falls, height, torch.nan)
    support = torch.where(falls, support, -1)
    posed = Posed.of(flat, many, acts, gap, backend)
    copy = torch.arange(copies, device=flat.device).repeat_interleave(n)
    support = _own_numbers(support, copy, n, len(scene.static_bodies), len(scene.planes), copies)
    shape = poses.shape[:-2]
    in_static, in_object, gap = (x.reshape(shape).to(poses.dtype) for x in (in_static, in_object, gap))
    carriers = (*scene.labels, *(s.shape.label for s in scene.static_bodies), *("plane" for _ in scene.planes))
    return PhysicsReport(in_static, in_object, gap, support.reshape(shape), tuple(scene.labels), carriers, posed)


def _fused():
    from physpose_torch import fused  # which imports Warp

    return fused


def measure(
    poses: Tensor, scene: Scene, acts: Tensor, backend: str, cost: object | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """How deep flat poses (N, 4, 4) are in statics and in each other, how far they can drop, and onto which entity; (N,) each.

    Args:
        cost: see :func:`report_of`.
    """
    if hasattr(cost, "measure"):
        return cost.measure(reach=REACH)
    if chosen_backend(backend) == "warp" and _fused().remembers(scene, poses, REACH):
        return _fused().FusedMeasure(scene, acts, poses, REACH).measure(reach=REACH)
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
