"""Strategies for shapes, scenes and poses far beyond a tabletop: 1 mm to 100 m large, 1e-9 to 1e9 m away, however they lie."""

import os
from collections.abc import Callable

import numpy as np
import torch
import trimesh
from helpers import box
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from physpose_torch import se3
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.scene import Scene, Static

DTYPES = (torch.float32, torch.float64)


def hunted(examples: int) -> Callable:
    """So many examples, always the same; with ``PHYSPOSE_EXAMPLES=n`` n others, drawn anew. To shrink one takes minutes."""
    more = os.environ.get("PHYSPOSE_EXAMPLES")
    return settings(
        max_examples=int(more) if more else examples,
        derandomize=not more,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        print_blob=True,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture],
    )


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    """Lengths [m] of all magnitudes from 10^low to 10^high."""
    return st.floats(low, high).map(lambda x: 10.0**x)


sizes = powers(-3, 2)
"""1 mm to 100 m."""
ranges = powers(-9, 9)
"""1e-9 to 1e9 m."""
shares = st.floats(0.05, 1.0)
units = st.tuples(*[st.floats(-1, 1)] * 3)
turns = st.tuples(*[st.floats(-3.2, 3.2)] * 3) | st.sampled_from(
    [(0.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2), (np.pi, 0.0, 0.0)]
)
directions = units.filter(lambda x: np.linalg.norm(x) > 0.1).map(
    lambda x: torch.tensor(x, dtype=torch.float64) / np.linalg.norm(x)
)


def ring(size: float) -> Body:
    """A link of a chain: a square of four bars, an eighth of its size thick, about z."""
    half, bar = size / 2, size / 8
    middle = half - bar / 2
    along_x, along_y = box(half, bar / 2, bar / 2), box(bar / 2, half, bar / 2)
    shifts = np.array([[0, middle, 0], [0, -middle, 0], [middle, 0, 0], [-middle, 0, 0]])
    parts = ConvexParts.from_hulls(
        [bar + x for bar, x in zip((along_x, along_x, along_y, along_y), shifts, strict=True)]
    )
    return Body("link", parts, trimesh.util.concatenate(parts.to_trimesh()))


@st.composite
def bodies(draw, size: float) -> Body:
    """A box, a can, or a link of a chain, its largest extent about ``size`` [m]."""
    kind = draw(st.sampled_from(["box", "can", "link"]))
    if kind == "box":
        return Body.box([size * draw(shares) for _ in range(3)], label="box")
    if kind == "can":
        return Body.cylinder(size / 2 * draw(shares), size * draw(shares), label="can")
    return ring(size)


@st.composite
def rotations(draw) -> torch.Tensor:
    return se3.exp_so3(torch.tensor(draw(turns), dtype=torch.float64))


@st.composite
def poses(draw, count: int, size: float, away: st.SearchStrategy[float] = ranges) -> torch.Tensor:
    """(count, 4, 4) of bodies about one place: in the same pose, a hair apart, in one another, or beside each other."""
    base = torch.tensor(draw(units), dtype=torch.float64)
    base = base / base.norm().clamp_min(1e-3) * draw(away)
    spread = size * draw(st.sampled_from([0.0, 1e-9, 0.1, 1.0, 10.0]))
    alike = draw(st.booleans())
    R = draw(rotations())
    rows = []
    for _ in range(count):
        t = base + spread * torch.tensor(draw(units), dtype=torch.float64)
        rows.append(se3.from_rotation_translation(R if alike else draw(rotations()), t))
    return torch.stack(rows)


@st.composite
def scenes(draw, away: st.SearchStrategy[float] = ranges, most: int = 4) -> tuple[torch.Tensor, Scene]:
    """Estimates and scene of one image: up to ``most`` bodies of about one size; a plane, a static body, both or neither."""
    size, count = draw(sizes), draw(st.integers(1, most))
    objects = [draw(bodies(size)) for _ in range(count)]
    if draw(st.booleans()):
        objects = objects[:1] * count
    T = draw(poses(count, size, away))
    up = draw(directions)
    statics, known = [], draw(st.booleans())
    if draw(st.booleans()):
        offset = up @ T[0, :3, 3] + size * draw(st.sampled_from([-10.0, -0.5, 0.0, 0.3]))
        covariance = torch.diag(torch.tensor([1e-3, 1e-3, 2e-3], dtype=torch.float64) ** 2)
        statics.append(Static(Plane(up, offset, draw(st.sampled_from([None, covariance])))))
    if draw(st.booleans()):
        shift = torch.tensor([*draw(units), *draw(units)], dtype=torch.float64)
        shift[:3] *= size
        statics.append(Static(draw(bodies(size)), se3.retract(T[0], shift)))
    return T, Scene(objects, statics, gravity=-up if known or len(statics) else None)
