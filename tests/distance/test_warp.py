"""The Warp backend: exact wherever parts are, whatever they look like, in both dtypes, and one operator to torch."""

import itertools
import json
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from multiprocessing import get_context

import numpy as np
import pytest
import torch
from helpers import FEATURES, ball, box, contact, cylinder, pose, random_poses, zoo
from oracle import oracle_distance, oracle_drop
from scipy.optimize import linprog

from physpose_torch import se3
from physpose_torch.config import Smoothing
from physpose_torch.distance.autograd import drop_distance, signed_distance
from physpose_torch.distance.smoothing import smoothed_points, smoothing_nodes, tangent_basis
from physpose_torch.distance.support import DistanceResult, gap_along
from physpose_torch.errors import PhysPoseError
from physpose_torch.geometry.convex import ConvexParts

PARTS = zoo()
ATOL = {torch.float64: 1e-9, torch.float32: 1e-5}
PROOF = 10.0
"""Normals and witness points, of which a distance loses the square of what they are off, may be this much worse."""
DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
EYE = torch.eye(4, dtype=torch.float64)
DOWN = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def at(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):
    """(1, 4, 4)."""
    return pose(turn, (x, y, z))[None]


def contacts(gap, count, seed=0, parts=PARTS, spread=0.3):
    """Poses (count, 4, 4) in a camera frame and pairs of parts, every kind of feature on every other, at the gap."""
    rng = np.random.default_rng(seed)
    kinds = itertools.cycle(itertools.product(FEATURES, FEATURES))
    pairs = rng.integers(parts.n_parts, size=(count, 2))
    gaps = np.broadcast_to(gap, count)
    R, t, _ = zip(
        *(contact(parts, a, b, next(kinds), g, rng) for (a, b), g in zip(pairs, gaps, strict=True)), strict=True
    )
    T_a = random_poses(count, seed + 1, spread=spread)
    T_b = T_a @ se3.from_rotation_translation(*(torch.as_tensor(np.array(x)) for x in (R, t)))
    return T_a, T_b, torch.as_tensor(pairs)


def frames(T_a, T_b):
    """Rotations and origins (E, 3, 3), (E, 3) of a, and b's pose R, t in the frame of a, of the nearest rigid poses."""
    T_a, T_b = T_a.detach().double(), T_b.detach().double()
    R_a, R_b = (U @ V for U, _, V in (torch.linalg.svd(T[:, :3, :3]) for T in (T_a, T_b)))
    return R_a, T_a[:, :3, 3], R_a.mT @ R_b, (R_a.mT @ (T_b - T_a)[:, :3, 3:])[:, :, 0]


def polytopes(parts, pair, R, t):
    (VA, FA), (VB, FB) = ([x.numpy() for x in parts.part(p)] for p in pair)
    return VA, FA, VB @ R.T + t, FB


def exact(parts, pairs, T_a, T_b):
    """(E,) distances by the oracle."""
    _, _, R, t = frames(T_a, T_b)
    rows = zip(pairs.tolist(), R.numpy(), t.numpy(), strict=True)
    return torch.tensor([float(oracle_distance(*polytopes(parts, *row))[0]) for row in rows], dtype=torch.float64)


def outside(parts, part, x):
    """How far points (E, 3) in the frames of their parts lie outside of them."""
    return ((parts.face_normals[part] @ x[:, :, None])[:, :, 0] - parts.face_offsets[part]).amax(1).clamp_min(0.0)


def errors(parts, pairs, T_a, T_b, result=None):
    """What is wrong with distances, by a proof that needs no oracle, (E,) each [m].

    ``gap``: the gap along the normal is a lower bound of the distance. ``points``: witness points on the two parts are an
    upper bound where these are apart; where they overlap they lie across from each other.
    """
    result = signed_distance(T_a, T_b, parts, pairs, backend="warp") if result is None else result
    distance, normal, a, b = (x.detach().double() for x in result)
    R_a, origin, R, t = frames(T_a, T_b)
    normal, a, b = ((x[:, None] @ R_a)[:, 0] for x in (normal, a - origin, b - origin))
    length = normal.norm(dim=1, keepdim=True)
    gap = gap_along(parts, pairs, R, t, (normal / length)[:, None])[:, 0]
    apart = b - a
    return {
        "unit": (length[:, 0] - 1.0).abs(),
        "gap": (gap - distance).abs(),
        "points": torch.maximum((apart.norm(dim=1) - distance.abs()).abs(), ((apart * normal).sum(1) - distance).abs()),
        "outside": torch.maximum(
            outside(parts, pairs[:, 0], a), outside(parts, pairs[:, 1], ((b - t)[:, None] @ R)[:, 0])
        ),
    }


def assert_exact(parts, pairs, T_a, T_b, expected=None, atol=None):
    """Distances prove themselves, and agree with the expected ones in value and sign."""
    result = signed_distance(T_a, T_b, parts, pairs, backend="warp")
    atol = atol or ATOL[T_a.dtype]
    for x in result:
        assert x.isfinite().all()
        assert x.dtype == T_a.dtype
    wrong = []
    for name, error in errors(parts, pairs, T_a, T_b, result).items():
        limit = (1e-6 if T_a.dtype == torch.float32 else 1e-12) if name == "unit" else PROOF * atol
        if bool((error > limit).any()):
            k = int(error.argmax())
            wrong.append(f"{name} {float(error[k]):.1e} of pair {k} (in all {int((error > limit).sum())})")
    if expected is not None:
        error = (result.distance.double() - expected).abs()
        flipped = (result.distance.double().sign() != expected.sign()) & (expected.abs() > atol)
        if bool((error > atol).any()) or bool(flipped.any()):
            k = int(error.argmax())
            wrong.append(f"distance {float(error[k]):.1e} of pair {k} (in all {int((error > atol).sum())})")
    assert not wrong, "; ".join(wrong)
    return result


def rounded(T_a, T_b, dtype):
    return T_a.to(dtype), T_b.to(dtype)


# --- accuracy ---------------------------------------------------------------------------------------------------------


@DTYPES
@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.2])
def test_distance_is_exact_when_parts_touch_or_are_apart(gap, dtype):
    T_a, T_b, pairs = contacts(gap, 450)
    if dtype == torch.float64:
        expected = torch.full((450,), gap, dtype=torch.float64)
    else:  # of the rounded poses; where they overlap, proving a depth takes the oracle
        T_a, T_b = rounded(T_a, T_b, dtype)
        expected = signed_distance(T_a.double(), T_b.double(), PARTS, pairs, backend="warp").distance
    assert_exact(PARTS, pairs, T_a, T_b, expected)


@DTYPES
@pytest.mark.parametrize("depth", [-1e-12, -1e-9, -1e-7, -1e-6, -1e-4, -1e-3, -5e-3, -3e-2])
def test_distance_agrees_with_the_oracle_when_parts_overlap(depth, dtype):
    T_a, T_b, pairs = contacts(depth, 72, seed=1)
    T_a, T_b = rounded(T_a, T_b, dtype)
    assert_exact(PARTS, pairs, T_a, T_b, exact(PARTS, pairs, T_a, T_b))


@DTYPES
def test_distance_agrees_with_the_oracle_anywhere(dtype):
    rng = np.random.default_rng(2)
    pairs = torch.as_tensor(rng.integers(PARTS.n_parts, size=(300, 2)))
    T_a, T_b = random_poses(300, seed=2), random_poses(300, seed=3)
    T_b[::4, :3, :3] = T_a[::4, :3, :3]
    spread = rng.choice([0.0, 1e-3, 0.02, 0.05, 0.2], size=(300, 1))
    T_b[:, :3, 3] = T_a[:, :3, 3] + torch.as_tensor(spread * rng.normal(size=(300, 3)))
    T_a, T_b = rounded(T_a, T_b, dtype)
    expected = exact(PARTS, pairs, T_a, T_b)
    assert 50 < (expected < 0).sum() < 250
    assert_exact(PARTS, pairs, T_a, T_b, expected)


@DTYPES
def test_the_middle_of_the_bounds_need_not_be_inside(dtype):
    """Corners cut off boxes: nothing may be concluded from the centre of their bounds."""
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    parts = ConvexParts.from_hulls(
        [0.05 * corner * x for x in ((1, 1, 1), (1, 0.4, 1), (0.3, 1, 0.5))] + [ball(0.03, 20)]
    )
    T_a, T_b, pairs = contacts(np.repeat([-1e-4, -2e-3, -5e-3, -1e-2], 60), 240, seed=18, parts=parts)
    T_a, T_b = rounded(T_a, T_b, dtype)
    assert_exact(parts, pairs, T_a, T_b, exact(parts, pairs, T_a, T_b), atol=10 * ATOL[dtype])


def test_float32_near_contact_keeps_the_distance():
    """A stalled search between 1 and 100 micrometres must not pass for an answer: it was off by up to 80 µm."""
    parts = zoo(n_random=20)
    for gap, seed in ((1e-6, 42), (1e-5, 35), (1e-4, 28)):
        T_a, T_b, pairs = contacts(gap, 2000, seed, parts)
        expected = signed_distance(T_a, T_b, parts, pairs, backend="warp").distance
        torch.testing.assert_close(expected, torch.full_like(expected, gap), atol=1e-9, rtol=0.0)
        T_a, T_b = rounded(T_a, T_b, torch.float32)
        expected = signed_distance(T_a.double(), T_b.double(), parts, pairs, backend="warp").distance
        assert_exact(parts, pairs, T_a, T_b, expected)


# --- degenerate parts -------------------------------------------------------------------------------------------------


def squeezed(hull, scale):
    """The one part of a hull, stretched by factors (3,): its triangles are known even where it is nearly flat."""
    parts = ConvexParts.from_hulls([hull])
    return with_geometry(parts, parts.vertices * torch.as_tensor(scale, dtype=torch.float64), parts.faces)


def with_geometry(parts, vertices, faces):
    rest = {f.name: getattr(parts, f.name) for f in fields(parts) if f.init}
    start = {"vertex_start": torch.tensor([0, len(vertices)]), "face_start": torch.tensor([0, len(faces)])}
    return ConvexParts(**rest | start | {"vertices": vertices, "faces": faces})


def split_vertex(hull):
    """A part whose first vertex is there twice, joined by two triangles without area."""
    parts = ConvexParts.from_hulls([hull])
    u, v, w = parts.faces[0].tolist()
    rows, m = [], len(parts.vertices)
    for face in parts.faces.tolist():
        turned = [face[k:] + face[:k] for k in range(3)]
        if [u, v, w] in turned:
            rows += [[u, m, w], [m, v, w]]
        elif any(t[:2] == [v, u] for t in turned):
            x = next(t[2] for t in turned if t[:2] == [v, u])
            rows += [[v, m, x], [m, u, x]]
        else:
            rows.append(face)
    return with_geometry(parts, torch.cat([parts.vertices, parts.vertices[u : u + 1]]), torch.tensor(rows))


def repeated_vertices(hull):
    """A part that lists all its vertices twice."""
    parts = ConvexParts.from_hulls([hull])
    return with_geometry(parts, parts.vertices.repeat(2, 1), parts.faces)


CUBE, BRICK = box(0.05, 0.05, 0.05), box(0.05, 0.03, 0.02)
DEGENERATE = {
    "sheet of 1 µm": squeezed(box(1, 1, 1), (0.05, 0.04, 5e-7)),
    "sheet of 1 nm": squeezed(box(1, 1, 1), (0.05, 0.04, 5e-10)),
    "flat disc of 1 µm": squeezed(cylinder(1, 1, 24), (0.05, 0.05, 5e-7)),
    "flat ball of 1 µm": squeezed(ball(1, 40), (0.05, 0.05, 5e-7)),
    "flat ball of 1 nm": squeezed(ball(1, 40), (0.05, 0.05, 5e-10)),
    "needle of 1 µm": squeezed(box(1, 1, 1), (0.1, 5e-7, 5e-7)),
    "needle of 1 nm": squeezed(box(1, 1, 1), (0.1, 5e-10, 5e-10)),
    "round needle": squeezed(ball(1, 40), (0.1, 1e-6, 1e-6)),
    "coincident vertices": split_vertex(BRICK),
    "coincident vertices, random": split_vertex(ball(0.04, 14, seed=3)),
    "every vertex twice": repeated_vertices(ball(0.04, 20)),
    "vertices 1 pm apart": ConvexParts.from_hulls([np.concatenate([CUBE, CUBE + 1e-12])]),
    "smallest tetrahedron": ConvexParts.from_hulls([1e-4 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])]),
}
PLAIN = ConvexParts.from_hulls([CUBE, BRICK, ball(0.04, 30), cylinder(0.03, 0.05, 16)])


@DTYPES
@pytest.mark.parametrize("name", DEGENERATE)
def test_distance_is_exact_for_degenerate_parts(name, dtype):
    parts = ConvexParts.cat([DEGENERATE[name], PLAIN])
    for gap, count in (
        (1e-2, 36),
        (1e-4, 36),
        (1e-6, 36),
        (1e-9, 36),
        (0.0, 36),
        (-1e-9, 18),
        (-1e-4, 18),
        (-1e-2, 18),
    ):
        T_a, T_b, pairs = contacts(gap, count, seed=4, parts=PLAIN)
        pairs = pairs + 1
        rng = np.random.default_rng(5)
        for k in range(count):
            a, b = (0, int(rng.integers(parts.n_parts))) if k % 2 else (int(rng.integers(parts.n_parts)), 0)
            kinds = (FEATURES[k % 3], FEATURES[k // 3 % 3])
            R, t, _ = contact(parts, a, b, kinds, gap, rng)
            T_b[k] = T_a[k] @ se3.from_rotation_translation(torch.as_tensor(R), torch.as_tensor(t))
            pairs[k] = torch.tensor([a, b])
        A, B = rounded(T_a, T_b, dtype)
        result = signed_distance(A, B, parts, pairs, backend="warp")
        atol = ATOL[dtype]
        wrong = {k: float(e.max()) for k, e in errors(parts, pairs, A, B, result).items() if k in ("gap", "points")}
        assert max(wrong.values()) <= PROOF * atol, f"gap {gap}: {wrong}"
        # the gap along the normal proves that it is not too large; the oracle tells if it is too small
        short = exact(parts, pairs, A, B) - result.distance.double()
        assert float(short.max()) <= atol, (
            f"gap {gap}: too small by {float(short.max()):.1e}, pair {int(short.argmax())}"
        )


ROUND = ConvexParts.from_hulls([ball(0.05, 240), ball(0.03, 300, seed=1), ball(0.05, 240)])
QUARTER = (0.0, 0.0, np.pi / 2)
SHAPES = ConvexParts.from_hulls([BRICK, box(0.005, 0.005, 0.005), cylinder(0.03, 0.05), CUBE, box(0.5, 0.5, 0.01)])
SPIN = (0.3, -0.2, 0.7)
KNOWN = {
    "identical boxes in one place": (0, 0, at(), -0.04),
    "identical cubes in one place": (3, 3, at(), -0.1),
    "parallel boxes, face to face": (0, 0, at(0, 0, 0.04), 0.0),
    "parallel boxes, face to face, shifted": (0, 0, at(0.02, 0.013, 0.04), 0.0),
    "parallel boxes, edge to edge": (0, 0, at(0.1, 0.06, 0.01), 0.0),
    "parallel boxes, corner to corner": (0, 0, at(0.1, 0.06, 0.04), 0.0),
    "parallel boxes, edges apart": (0, 0, at(0.103, 0.064, 0.01), 0.005),
    "parallel boxes, corners apart": (0, 0, at(0.102, 0.063, 0.046), 0.007),
    "parallel boxes, overlapping by one corner": (0, 0, at(0.099, 0.059, 0.039), -0.001),
    "box across a box": (0, 0, at(0.02, 0, 0.039, turn=QUARTER), -0.001),
    "small box inside a large one": (1, 0, at(0.01, 0, 0.002), -0.023),
    "large box around a small one": (0, 1, at(turn=QUARTER), -0.025),
    "cylinders end to end": (2, 2, at(0, 0, 0.1), 0.0),
    "identical cylinders in one place": (2, 2, at(), -0.06 * np.cos(np.pi / 32)),
    "cylinders side by side, edge to edge": (2, 2, at(0.06), 0.0),
    "box on a table, off its middle": (0, 4, at(0.3, 0.2, -0.03), 0.0),
    "box on a table, along its edge": (0, 4, at(0.55, 0.2, -0.03), 0.0),
    "box sunk into a table": (0, 4, at(0, 0, -0.02), -0.01),
}


@DTYPES
@pytest.mark.parametrize("turned", [False, True], ids=["upright", "turned"])
@pytest.mark.parametrize("name", KNOWN)
def test_distance_is_exact_where_the_answer_is_not_unique(name, turned, dtype):
    a, b, T_a_b, expected = KNOWN[name]
    T_a = at(0.2, -0.1, 0.7, turn=SPIN) if turned else at()
    # b with a, and swapped
    pairs = torch.tensor([[a, b], [b, a]])
    T_a, T_b = rounded(torch.cat([T_a, T_a @ T_a_b]), torch.cat([T_a @ T_a_b, T_a]), dtype)
    atol = 1e-12 if dtype == torch.float64 else 1e-6
    assert_exact(SHAPES, pairs, T_a, T_b, torch.tensor([expected, expected], dtype=torch.float64), atol)


@DTYPES
def test_distance_of_round_parts_with_many_faces(dtype):
    """More faces than the kernel remembers culling vertices of."""
    assert int(ROUND.facets.start.diff().min()) > 256
    turns = torch.cat([at(turn=x) for x in ((0, 0, 0), SPIN, (1.0, 2.0, -0.5))])
    shifts = torch.cat([at(*x) for x in ((0, 0, 0), (0.01, 0, 0.02), (0.05, 0.04, 0.03), (0.0999, 0, 0), (0.2, 0, 0))])
    T_b = (turns[:, None] @ shifts).flatten(0, 1)
    pairs = torch.tensor([[0, 1], [0, 2], [1, 0]]).repeat_interleave(len(T_b), 0)
    T_b = T_b.repeat(3, 1, 1)
    T_a, T_b = rounded(random_poses(1, 3).expand_as(T_b), random_poses(1, 3) @ T_b, dtype)
    result = assert_exact(ROUND, pairs, T_a, T_b)
    sat = [k for k in range(len(pairs)) if k % 5 in (0, 3)]  # the oracle takes its time
    _, _, R, t = frames(T_a, T_b)
    from physpose_torch.distance.sat import separating_axis

    depth, _ = separating_axis(ROUND, pairs[sat], R[sat], t[sat])
    inside = depth <= 0
    assert inside.sum() >= 9
    torch.testing.assert_close(result.distance.double()[sat][inside], depth[inside], atol=ATOL[dtype], rtol=0.0)


@DTYPES
@pytest.mark.parametrize("size", [1e-2, 100.0], ids=["1 mm", "10 m"])
def test_distance_is_exact_at_any_size(size, dtype):
    """Parts of about 0.1 m scaled; float32 rounds the huge ones' vertices alone by half a micrometre."""
    parts = ConvexParts.from_hulls([size * PARTS.part(p)[0].numpy() for p in (0, 1, 2, 10, 11, 12)])
    for gap, count in ((0.01, 90), (1e-4, 90), (0.0, 90), (-1e-4, 36), (-0.01, 36)):
        T_a, T_b, pairs = contacts(gap * size, count, seed=6, parts=parts, spread=0.3 * size)
        T_a, T_b = rounded(T_a, T_b, dtype)
        expected = exact(parts, pairs, T_a, T_b) if gap <= 0 else None
        assert_exact(parts, pairs, T_a, T_b, expected, atol=ATOL[dtype] * max(1.0, size / 10))


@pytest.mark.parametrize("gap", [1e-3, 0.0, -1e-3])
def test_nothing_is_lost_far_from_the_origin(gap):
    T_a, T_b, pairs = contacts(gap, 90, seed=7)
    near = signed_distance(T_a, T_b, PARTS, pairs, backend="warp").distance
    shift = torch.tensor([1000.0, -700.0, 300.0], dtype=torch.float64)
    for T in (T_a, T_b):
        T[:, :3, 3] += shift
    far = signed_distance(T_a, T_b, PARTS, pairs, backend="warp").distance
    torch.testing.assert_close(far, near, atol=1e-11, rtol=0.0)
    A, B = rounded(T_a, T_b, torch.float32)  # 60 µm are lost in the poses, nothing more
    expected = signed_distance(A.double(), B.double(), PARTS, pairs, backend="warp").distance
    result = signed_distance(A, B, PARTS, pairs, backend="warp").distance
    torch.testing.assert_close(result.double(), expected, atol=1e-5, rtol=0.0)


def test_float32_parts_are_exact_in_float64_too():
    """The parts' own dtype is a matter of storage: what is computed is the distance of these vertices."""
    coarse = PARTS.to(torch.float32)
    T_a, T_b, pairs = contacts(-1e-3, 90, seed=8)
    expected = signed_distance(T_a, T_b, coarse.reference, pairs, backend="warp").distance
    found = signed_distance(T_a, T_b, coarse, pairs, backend="warp").distance
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=0.0)


# --- drop distance ----------------------------------------------------------------------------------------------------


def falling(count, seed=0, parts=PARTS):
    """Pairs of parts, b somewhere below a, and gravity of any direction."""
    rng = np.random.default_rng(seed)
    pairs = torch.as_tensor(rng.integers(parts.n_parts, size=(count, 2)))
    T_a = random_poses(count, seed, spread=0.3)
    gravity = torch.nn.functional.normalize(torch.as_tensor(rng.normal(size=(count, 3))), dim=-1)
    T_b = random_poses(count, seed + 7, spread=0.03)
    T_b[:, :3, 3] += T_a[:, :3, 3] + gravity * torch.as_tensor(rng.uniform(-0.05, 0.4, size=(count, 1)))
    return T_a, T_b, pairs, gravity


def drop_by_program(parts, pair, R, t, g):
    """Least signed height at which A, moved along g, shares a point with B, by linear programming; None: at none."""
    VA, _, VB, _ = polytopes(parts, pair, R, t)
    m, n = len(VA), len(VB)
    scale = 0.1  # the solver's tolerances are absolute
    equal = np.zeros((5, m + n + 1))
    equal[:3, :m], equal[:3, m : m + n], equal[:3, -1] = VA.T / scale, -VB.T / scale, g
    equal[3, :m] = equal[4, m : m + n] = 1.0
    bounds = [(0, None)] * (m + n) + [(None, None)]
    out = linprog(np.r_[np.zeros(m + n), 1.0], A_eq=equal, b_eq=[0, 0, 0, 1, 1], bounds=bounds)
    return scale * out.x[-1] if out.status == 0 else None


def drop_errors(parts, pairs, T_a, T_b, gravity, drop):
    """What is wrong with finite drops: the normal gives a lower bound, the witness points an upper one, (E,) each [m]."""
    h, normal, a, b = (x.detach().double() for x in drop)
    R_a, origin, R, t = frames(T_a, T_b)
    g = torch.nn.functional.normalize(gravity.double(), dim=-1)
    normal, g, a, b = ((x[:, None] @ R_a)[:, 0] for x in (normal, g, a - origin, b - origin))
    gap = gap_along(parts, pairs, R, t, normal[:, None])[:, 0]
    out = {
        "normal": (gap - h * (normal * g).sum(1)).abs(),  # that much before the fall, none after it
        "points": (b - a - h[:, None] * g).norm(dim=1),
        "outside": torch.maximum(
            outside(parts, pairs[:, 0], a), outside(parts, pairs[:, 1], ((b - t)[:, None] @ R)[:, 0])
        ),
    }
    lands = h.isfinite() & (h > 0)
    assert ((normal * g).sum(1)[lands] > 0).all()
    return {k: e[lands] for k, e in out.items()}


@DTYPES
def test_drop_distance_agrees_with_the_oracle(dtype):
    T_a, T_b, pairs, gravity = falling(50)
    T_a, T_b = rounded(T_a, T_b, dtype)
    drop = drop_distance(T_a, T_b, PARTS, pairs, gravity.to(dtype), limit=2.0, backend="warp")
    R_a, _, R, t = frames(T_a, T_b)
    g = (gravity.to(dtype).double()[:, None] @ R_a)[:, 0].numpy()
    rows = zip(pairs.tolist(), R.numpy(), t.numpy(), g, strict=True)
    expected = [oracle_drop(*polytopes(PARTS, *row), down, limit=2.0) for *row, down in rows]
    expected = torch.tensor(expected, dtype=torch.float64)
    assert (expected == 0).sum() >= 3
    assert 10 < expected.isfinite().sum() < 45
    assert torch.equal(drop.distance.isfinite(), expected.isfinite())
    meets = expected.isfinite()
    torch.testing.assert_close(drop.distance[meets].double(), expected[meets], atol=3 * ATOL[dtype], rtol=0.0)


@DTYPES
def test_drop_distance_proves_itself_on_thousands_of_falls(dtype):
    T_a, T_b, pairs, gravity = falling(1500, seed=1)
    T_a, T_b = rounded(T_a, T_b, dtype)
    gravity = gravity.to(dtype)
    drop = drop_distance(T_a, T_b, PARTS, pairs, gravity, limit=2.0, backend="warp")
    assert not any(x.isnan().any() for x in drop)
    atol = ATOL[dtype]
    for name, error in drop_errors(PARTS, pairs, T_a, T_b, gravity, drop).items():
        assert float(error.max()) <= atol, name
    R_a, _, R, t = frames(T_a, T_b)
    g = torch.nn.functional.normalize((gravity.double()[:, None] @ R_a)[:, 0], dim=-1).numpy()
    overlap = signed_distance(T_a, T_b, PARTS, pairs, backend="warp").distance <= 0
    seen = {"lands": 0, "overlaps": 0, "never": 0}
    for k in range(0, 1500, 3):
        height = drop_by_program(PARTS, pairs[k].tolist(), R[k].numpy(), t[k].numpy(), g[k])
        found = float(drop.distance[k])
        if bool(overlap[k]):
            assert found == 0.0, k
            seen["overlaps"] += 1
        elif height is None or height < -1e-6:
            assert found == np.inf, k
            seen["never"] += 1
        elif height > 1e-6:
            assert found == pytest.approx(height, abs=2e-6 + atol), k
            seen["lands"] += 1
    assert min(seen.values()) >= 20, seen


TURNS = {"upright": (0.0, 0.0, 0.0), "on its side": (np.pi / 2, 0.0, 0.0), "askew": SPIN}
STACKS = ConvexParts.from_hulls([CUBE, BRICK, box(0.5, 0.5, 0.02), cylinder(0.03, 0.05), box(0.01, 0.01, 0.01)])


@DTYPES
@pytest.mark.parametrize("world", TURNS)
@pytest.mark.parametrize("height", [0.3, 0.01, 1e-5])
def test_aligned_stacks_fall_straight(height, world, dtype):
    """The ray goes through corners, edges or the middle of faces of the difference of two boxes."""
    halves = {0: (0.05, 0.05, 0.05), 1: (0.05, 0.03, 0.02), 2: (0.5, 0.5, 0.02), 3: (0.03, 0.03, 0.05), 4: (0.01,) * 3}
    X, rows = at(0.1, -0.2, 0.9, turn=TURNS[world]), []
    for a, b in itertools.product(halves, halves):
        for x, y in ((0, 0), (0.02, 0), (0, 0.02), (0.02, 0.02), (0.01, -0.015), (-0.02, 0.02)):
            rows.append((a, b, at(x, y, halves[a][2] + halves[b][2] + height)))
    pairs = torch.tensor([row[:2] for row in rows])
    T_a, T_b = rounded(X.expand(len(rows), 4, 4), X @ torch.cat([row[2] for row in rows]), dtype)
    gravity = (X[:, :3, :3] @ DOWN).expand(len(rows), 3).to(dtype)
    drop = drop_distance(T_a, T_b, STACKS, pairs, gravity, limit=1.0, backend="warp")
    # they all lie over each other but for the crumb's two half widths, which at (0.02, ·) only touch the crumb
    shadow = np.array(
        [[abs(v) < halves[a][k] + halves[b][k] - 1e-9 for k, v in enumerate(T[0, :2, 3].tolist())] for a, b, T in rows]
    ).all(1)
    assert shadow.sum() > 140
    shadow = torch.as_tensor(shadow)
    expected = torch.full((int(shadow.sum()),), height, dtype=torch.float64)
    torch.testing.assert_close(
        drop.distance[shadow].double(), expected, atol=1e-12 if dtype == torch.float64 else 2e-6, rtol=0.0
    )
    tilt = (drop.normal - gravity).norm(dim=1)[shadow]
    assert float(tilt.max()) < (1e-9 if dtype == torch.float64 else 1e-3)
    grazing = drop.distance[~shadow]
    assert (grazing.isinf() | ((grazing.double() - height).abs() < 1e-5)).all()
    for name, error in drop_errors(STACKS, pairs, T_a, T_b, gravity, drop).items():
        assert float(error.max()) <= ATOL[dtype], name


@DTYPES
def test_overlapping_or_touching_parts_drop_by_nothing(dtype):
    for gap in (0.0, -1e-9, -1e-5, -1e-3, -0.02):
        T_a, T_b, pairs = contacts(gap, 180, seed=9)
        T_a, T_b = rounded(T_a, T_b, dtype)
        gravity = torch.nn.functional.normalize(torch.randn(180, 3, generator=torch.Generator().manual_seed(0)), dim=1)
        drop = drop_distance(T_a, T_b, PARTS, pairs, gravity.to(dtype), limit=1.0, backend="warp")
        distance = signed_distance(T_a, T_b, PARTS, pairs, backend="warp").distance
        inside = distance < -(1e-10 if dtype == torch.float64 else 1e-6)
        assert (drop.distance[inside] == 0).all(), gap
        if gap == 0.0:  # what only touches is there, or slides off
            assert ((drop.distance < 1e-3) | drop.distance.isinf()).all()
        assert inside.sum() >= 150 or gap > -1e-5


@DTYPES
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_parts_fall_onto_boxes(name, dtype):
    parts = ConvexParts.cat([DEGENERATE[name], PLAIN])
    n = 120
    T_a, T_b, pairs, gravity = falling(n, seed=10, parts=parts)
    pairs = torch.stack([torch.zeros(n, dtype=torch.long), torch.arange(n) % parts.n_parts], dim=1)
    pairs[::2] = pairs[::2].flip(1)
    T_a, T_b = rounded(T_a, T_b, dtype)
    gravity = gravity.to(dtype)
    drop = drop_distance(T_a, T_b, parts, pairs, gravity, limit=2.0, backend="warp")
    assert drop.distance.isfinite().sum() >= 15
    for key, error in drop_errors(parts, pairs, T_a, T_b, gravity, drop).items():
        assert key == "outside" or float(error.max()) <= PROOF * ATOL[dtype], f"{key} {float(error.max()):.1e}"
    inside = signed_distance(T_a, T_b, parts, pairs, backend="warp").distance < -1e-6
    assert (drop.distance[inside] == 0).all()
    R_a, _, R, t = frames(T_a, T_b)
    g = torch.nn.functional.normalize((gravity.double()[:, None] @ R_a)[:, 0], dim=-1).numpy()
    for k in range(0, n, 2):
        height = drop_by_program(parts, pairs[k].tolist(), R[k].numpy(), t[k].numpy(), g[k])
        if height is not None and height > 1e-5:
            assert float(drop.distance[k]) == pytest.approx(height, abs=2e-6 + ATOL[dtype]), k
        elif height is None:
            assert float(drop.distance[k]) == np.inf, k


@DTYPES
def test_what_misses_has_passed_or_is_beyond_the_limit_falls_for_ever(dtype):
    cases = [
        (at(0.6, 0, 0.1), 1.0, np.inf),  # past its side
        (at(0.5501, 0, 0.1), 1.0, np.inf),
        (at(0.5499, 0, 0.1), 1.0, 0.06),
        (at(0, 0, -0.3), 1.0, np.inf),  # b is above
        (at(0, 0, 0.34), 0.29, np.inf),
        (at(0, 0, 0.34), 0.31, 0.30),
        (at(0, 0, 0.03), 0.31, 0.0),  # overlaps
        (at(0, 0, -0.03), 0.31, 0.0),
    ]
    pair = torch.tensor([[1, 2]])
    for T_b, limit, expected in cases:
        A, B = rounded(at(), T_b, dtype)
        A.requires_grad_()
        drop = drop_distance(A, B, STACKS, pair, DOWN[None].to(dtype), limit=limit, backend="warp")
        assert float(drop.distance.detach()) == pytest.approx(expected, abs=1e-6)
        drop.distance.nan_to_num(posinf=0.0).sum().backward()
        assert A.grad.isfinite().all()
        assert bool((A.grad != 0).any()) == (0 < expected < np.inf)


@DTYPES
def test_sliding_along_a_wall_stays_bounded(dtype):
    """Boxes side by side with nothing, or next to nothing, between them: n · g = 0."""
    for gap in (0.0, 1e-12, 1e-9, 1e-7, 1e-6, -1e-12, -1e-9):
        for turn in TURNS.values():
            X = at(turn=turn)
            A, B = rounded(X, X @ at(0.1 + gap, 0.01, 0.005), dtype)
            A.requires_grad_()
            g = (X[:, :3, :3] @ DOWN).to(dtype)
            drop = drop_distance(A, B, STACKS, torch.tensor([[1, 1]]), g, limit=1.0, backend="warp")
            assert float(drop.distance.detach()) in (0.0, np.inf)
            drop.distance.nan_to_num(posinf=0.0).sum().backward()
            assert float(A.grad.abs().max()) <= 1e3


def test_gradient_of_a_drop_is_that_of_its_finite_differences():
    T_a, T_b, pairs, gravity = falling(60, seed=1)

    def height(xi_a, xi_b, rows=slice(None)):
        args = se3.retract(T_a, xi_a)[rows], se3.retract(T_b, xi_b)[rows], PARTS, pairs[rows], gravity[rows]
        return drop_distance(*args, limit=2.0, backend="warp")

    zero, step = torch.zeros(60, 6, dtype=torch.float64), 1e-6 * torch.eye(6, dtype=torch.float64)
    base = height(zero, zero)
    around = {
        (k, i, s): height(*((s * step[i]).expand(60, 6) if k == m else zero for m in range(2)))
        for k in range(2)
        for i in range(6)
        for s in (-1, 1)
    }
    rate = (base.normal * gravity).sum(-1)
    same = (base.distance > 0) & base.distance.isfinite() & (rate > 0.1)
    for x in around.values():
        same &= x.distance.isfinite() & ((x.normal - base.normal).norm(dim=-1) < 1e-4)
    assert same.sum() >= 8
    xi = [zero.clone().requires_grad_() for _ in range(2)]
    for k, gradient in enumerate(torch.autograd.grad(height(*xi).distance[same].sum(), xi)):
        difference = [(around[k, i, 1].distance - around[k, i, -1].distance) / 2e-6 for i in range(6)]
        torch.testing.assert_close(gradient[same], torch.stack(difference, 1)[same], atol=1e-4, rtol=1e-4)


# --- smoothing --------------------------------------------------------------------------------------------------------


def gradients(T_a, T_b, parts, pairs, smoothing, backend="warp"):
    A, B = T_a.clone().requires_grad_(), T_b.clone().requires_grad_()
    out = signed_distance(A, B, parts, pairs, backend=backend, smoothing=smoothing)
    return torch.autograd.grad(out.distance.sum(), (A, B)), out


def gradients_in_torch(T_a, T_b, parts, pairs, normal, smoothing):
    """The gradient as the fcl backend makes it from the same normal."""
    T_a_b = se3.inverse(T_a) @ T_b
    (A, mask_a), (B, mask_b) = ((parts.padded[p], parts.padded_mask[p]) for p in pairs.unbind(1))
    local = (normal[:, None] @ T_a[:, :3, :3])[:, 0]
    _, a, b = smoothed_points(A, mask_a, se3.apply(T_a_b, B), mask_b, local, smoothing)
    b = se3.apply(se3.inverse(T_a_b), b[:, None])[:, 0]
    one = torch.ones(len(a), 1, dtype=a.dtype)
    top = [s * normal[:, :, None] * torch.cat([x, one], 1)[:, None] for x, s in ((a, -1.0), (b, 1.0))]
    return [torch.cat([x, torch.zeros_like(x[:, :1])], 1) for x in top]


def margin(T_a, T_b, parts, pairs, normal, smoothing):
    """(E,) least lead of the foremost vertex over the next one, of all directions [m]: at a tie rounding decides."""
    nodes, _ = smoothing_nodes(smoothing)
    out = torch.full((len(pairs),), torch.inf, dtype=torch.float64)
    for part, T, n, spin in ((pairs[:, 0], T_a, normal, 1.0), (pairs[:, 1], T_b, normal, -1.0)):
        # both wobble in the frame of a
        n = spin * (n[:, None] @ T_a[:, :3, :3])[:, 0]
        wobble = nodes[None] if smoothing.kind == "gaussian" else nodes[:, :2] @ tangent_basis(n)
        directions = (n[:, None] + smoothing.noise * wobble) @ (T_a[:, :3, :3].mT @ T[:, :3, :3])
        height = directions @ parts.padded[part].mT
        height = height.masked_fill(~parts.padded_mask[part][:, None], -torch.inf)
        best = height.topk(2, dim=2).values
        out = torch.minimum(out, (best[..., 0] - best[..., 1]).amin(1))
    return out


SMOOTHED = [
    Smoothing("ring"), Smoothing("ring", noise=0.5, samples=7), Smoothing("ring", noise=0.01, samples=64),
    Smoothing("gaussian"), Smoothing("gaussian", noise=0.6, samples=5, seed=3), Smoothing("gaussian", samples=300),
]  # fmt: skip
CROWDED = ConvexParts.from_hulls([ball(0.05, 400), ball(0.03, 97, seed=1), cylinder(0.04, 0.01, 200), BRICK])


@pytest.mark.parametrize("smoothing", SMOOTHED, ids=lambda s: f"{s.kind}-{s.noise}-{s.samples}")
@pytest.mark.parametrize("parts", [PARTS, CROWDED], ids=["zoo", "crowded"])
def test_smoothed_gradients_are_those_of_the_torch_path(parts, smoothing):
    for gap in (1e-2, 1e-4, -1e-3, -1e-2):
        T_a, T_b, pairs = contacts(gap, 90, seed=11, parts=parts)
        found, out = gradients(T_a, T_b, parts, pairs, smoothing)
        expected = gradients_in_torch(T_a, T_b, parts, pairs, out.normal, smoothing)
        clear = margin(T_a, T_b, parts, pairs, out.normal, smoothing) > 1e-12
        assert clear.double().mean() > 0.8
        for x, y in zip(found, expected, strict=True):
            torch.testing.assert_close(x[clear], y[clear], atol=4e-9, rtol=0.0)


@pytest.mark.parametrize(
    "smoothing", [Smoothing("ring"), Smoothing("gaussian"), Smoothing("gumbel")], ids=lambda s: s.kind
)
def test_smoothed_gradients_are_those_of_the_fcl_backend(smoothing):
    T_a, T_b, pairs = contacts(-2e-3, 120, seed=12)
    (warp, a), (fcl, b) = (gradients(T_a, T_b, PARTS, pairs, smoothing, name) for name in ("warp", "fcl"))
    same = (a.normal - b.normal).norm(dim=1) < 1e-12
    if smoothing.kind != "gumbel":
        same &= margin(T_a, T_b, PARTS, pairs, a.normal, smoothing) > 1e-12
    assert same.sum() > 40
    for x, y in zip(warp, fcl, strict=True):
        torch.testing.assert_close(x[same], y[same], atol=1e-9, rtol=0.0)


@pytest.mark.parametrize("smoothing", [Smoothing("ring"), Smoothing("gaussian")], ids=lambda s: s.kind)
def test_float32_smoothing_is_that_of_float64(smoothing):
    T_a, T_b, pairs = contacts(-2e-3, 120, seed=13)
    T_a, T_b = rounded(T_a, T_b, torch.float32)
    (coarse, _), (fine, _) = (
        gradients(A, B, PARTS, pairs, smoothing) for A, B in ((T_a, T_b), (T_a.double(), T_b.double()))
    )
    for x, y in zip(coarse, fine, strict=True):
        assert x.isfinite().all()
        error = (x.double() - y).abs().amax((1, 2))
        # a draw may fall to the other side of a border between two vertices
        assert float(error.quantile(0.9)) < 1e-4
        assert float(error.max()) < 0.02


@DTYPES
@pytest.mark.parametrize("gap", [0.0, 1e-3, -1e-3])
def test_smoothed_gradients_are_finite_and_near_their_part(gap, dtype):
    """Two edges along each other have no spread across: what float32 leaves of that determinant was NaN."""
    T_a, T_b, pairs = contacts(gap, 900, seed=16)
    for smoothing in SMOOTHED[:4]:
        for gradient in gradients(*rounded(T_a, T_b, dtype), PARTS, pairs, smoothing)[0]:
            assert gradient.isfinite().all()
            lever = gradient[:, :3, :3].norm(dim=(1, 2))  # of a unit force
            assert float(lever.max()) < 4 * float(PARTS.radius.max())


@pytest.mark.parametrize("kind", ["gumbel", "pose"])
def test_other_kinds_of_smoothing_work_on_it(kind):
    T_a, T_b, pairs = contacts(-2e-3, 30, seed=14)
    found, out = gradients(T_a, T_b, PARTS, pairs, Smoothing(kind, samples=4))
    expected, reference = gradients(T_a, T_b, PARTS, pairs, Smoothing(kind, samples=4), "fcl")
    torch.testing.assert_close(out.distance, reference.distance, atol=1e-9, rtol=0.0)
    same = (out.normal - reference.normal).norm(dim=1) < 1e-12
    for x, y in zip(found, expected, strict=True):
        assert x.isfinite().all()
        assert float((x - y).abs().amax((1, 2))[same].median()) < 1e-9


@pytest.mark.parametrize("smoothing", [Smoothing("ring"), Smoothing("gaussian")], ids=lambda s: s.kind)
def test_smoothed_drops_use_the_points_at_the_meeting(smoothing):
    T_a, T_b, pairs, gravity = falling(120, seed=15)
    A = T_a.clone().requires_grad_()
    drop = drop_distance(A, T_b, PARTS, pairs, gravity, limit=2.0, backend="warp", smoothing=smoothing)
    rate = (drop.normal * gravity).sum(-1)
    lands = drop.distance.isfinite() & (drop.distance > 0) & (rate > 0.01)
    assert lands.sum() > 20
    gradient = torch.autograd.grad(drop.distance[lands].sum(), A)[0][lands]
    fallen = T_a.clone()
    fallen[:, :3, 3] += drop.distance.detach().nan_to_num(posinf=0.0)[:, None] * gravity
    args = (fallen[lands], T_b[lands], PARTS, pairs[lands], drop.normal[lands], smoothing)
    clear = margin(*args) > 1e-9  # the fall itself is rounded
    expected = gradients_in_torch(*args)[0] / rate[lands, None, None]
    assert clear.sum() > 20
    torch.testing.assert_close(gradient[clear], expected[clear], atol=1e-7, rtol=1e-7)


# --- as a function of torch -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gap", [0.02, 1e-3, -1e-3, -8e-3])
def test_gradient_is_that_of_finite_differences(gap):
    T_a, T_b, pairs = contacts(gap, 40, seed=3)
    step = 1e-5 * torch.randn(8, 40, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    base = signed_distance(T_a, T_b, PARTS, pairs, backend="warp")
    keep = torch.ones(40, dtype=torch.bool)  # the features that face each other stay the same
    for x in step:
        moved = signed_distance(se3.retract(T_a, x), T_b, PARTS, pairs, backend="warp")
        keep &= (moved.point_a - base.point_a).norm(dim=-1) < 1e-3
        keep &= (moved.normal - base.normal).norm(dim=-1) < 1e-2
    assert keep.sum() >= 8
    T_a, T_b, pairs = T_a[keep], T_b[keep], pairs[keep]

    def distance(xi_a, xi_b):
        return signed_distance(se3.retract(T_a, xi_a), se3.retract(T_b, xi_b), PARTS, pairs, backend="warp").distance

    xi = [torch.zeros(len(pairs), 6, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(distance, xi, eps=1e-7, atol=1e-5, nondet_tol=0.0)


def both(T_a, T_b, pairs, gravity=None):
    """Both operators, on the same arguments."""
    gravity = DOWN.to(T_a).expand(len(pairs), 3) if gravity is None else gravity
    yield signed_distance(T_a, T_b, PARTS, pairs, backend="warp")
    yield drop_distance(T_a, T_b, PARTS, pairs, gravity, limit=5.0, backend="warp")


def landing(count=8):
    """Pairs that surely meet on their way down."""
    pairs = torch.arange(count)[:, None] + torch.tensor([0, 1])
    T_a, T_b = random_poses(count, 5), random_poses(count, 5)
    T_b[:, 2, 3] += 0.5
    return T_a, T_b, pairs


def test_second_derivatives_are_refused():
    T_a, T_b, pairs = landing()
    for out in both(T_a.requires_grad_(), T_b, pairs):
        (gradient,) = torch.autograd.grad(out.distance.square().sum(), T_a, create_graph=True)
        with pytest.raises(RuntimeError, match="once_differentiable"):
            gradient.sum().backward()


def test_only_the_distance_carries_a_gradient():
    T_a, T_b, pairs = landing()
    for out in both(T_a.requires_grad_(), T_b, pairs):
        assert isinstance(out, DistanceResult)
        assert out.distance.requires_grad
        assert not any(x.requires_grad for x in out[1:])


@pytest.mark.parametrize("which", [0, 1])
def test_one_pose_alone_may_ask_for_a_gradient(which):
    T = list(landing())
    pairs = T.pop()
    expected = [
        torch.autograd.grad(out.distance.sum(), T[which]) for out in both(*(x.requires_grad_() for x in T), pairs)
    ]
    T = [x.detach().clone().requires_grad_(k == which) for k, x in enumerate(T)]
    for out, (gradient,) in zip(both(*T, pairs), expected, strict=True):
        assert bool((gradient != 0).any())
        assert torch.equal(torch.autograd.grad(out.distance.sum(), T[which])[0], gradient)


@DTYPES
def test_no_pairs_give_no_distances(dtype):
    T = torch.zeros(0, 4, 4, dtype=dtype, requires_grad=True)
    for out in both(T, T, torch.zeros(0, 2, dtype=torch.long)):
        assert [tuple(x.shape) for x in out] == [(0,), (0, 3), (0, 3), (0, 3)]
        assert all(x.dtype == dtype for x in out)
        (gradient,) = torch.autograd.grad(out.distance.sum(), T)
        assert gradient.shape == (0, 4, 4)


def test_layout_in_memory_does_not_matter():
    T_a, T_b, pairs = landing()
    g = torch.nn.functional.normalize(DOWN + 0.2 * torch.rand(8, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    expected = list(both(T_a, T_b, pairs, g))
    shuffled = T_a.mT.contiguous().mT, torch.stack([T_b, T_b], -1)[..., 0], pairs.T.contiguous().T, g.T.contiguous().T
    assert not any(x.is_contiguous() for x in shuffled)
    for x, y in zip(both(*shuffled), expected, strict=True):
        assert all(torch.equal(u, v) for u, v in zip(x, y, strict=True))
    for x, y in zip(both(T_a[:1].expand(8, 4, 4), T_b, pairs), both(T_a[:1].repeat(8, 1, 1), T_b, pairs), strict=True):
        assert torch.equal(x.distance, y.distance)


@pytest.mark.parametrize("kind", [torch.int32, torch.int16])
def test_any_integer_indexes_a_part(kind):
    T_a, T_b, pairs = landing()
    for x, y in zip(both(T_a, T_b, pairs.to(kind)), both(T_a, T_b, pairs), strict=True):
        assert torch.equal(x.distance, y.distance)


WRONG = {
    "gravity for one pair": lambda T, p, g: (T, T, p, g[:1]),
    "one gravity for all": lambda T, p, g: (T, T, p, g[0]),
    "too few poses": lambda T, p, g: (T[:4], T, p, g),
    "too few poses of b": lambda T, p, g: (T, T[:4], p, g),
    "a part that is not there": lambda T, p, g: (T, T, p + 1000, g),
    "a negative part": lambda T, p, g: (T, T, p - 1000, g),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_never_reach_the_kernel(name, monkeypatch):
    """It would read and write memory that is not its own."""

    def launch(*_):
        pytest.fail("launched")

    monkeypatch.setattr("physpose_torch.distance.warp.launch", launch)
    T, _, pairs = landing()
    T_a, T_b, pairs, gravity = WRONG[name](T, pairs, DOWN.expand(8, 3))
    with pytest.raises((PhysPoseError, IndexError)):
        drop_distance(T_a, T_b, PARTS, pairs, gravity, limit=1.0, backend="warp")
    if "gravity" not in name:
        with pytest.raises((PhysPoseError, IndexError)):
            signed_distance(T_a, T_b, PARTS, pairs, backend="warp")


def test_poses_of_two_dtypes_meet_in_the_better_one_and_half_precision_in_float32():
    T, _, pairs = landing()
    assert signed_distance(T, T.float(), PARTS, pairs, backend="warp").distance.dtype == torch.float64
    assert signed_distance(T.half(), T.half(), PARTS, pairs, backend="warp").distance.dtype == torch.float32


@DTYPES
def test_same_input_same_bits_and_each_pair_by_itself(dtype):
    T_a, T_b, pairs = contacts(np.tile([0.0, 1e-3, -1e-3, 1e-2], 30), 120, seed=16)
    T_a, T_b = rounded(T_a, T_b, dtype)

    def run(rows):
        A = T_a[rows].clone().requires_grad_()
        out = []
        gravity = DOWN.to(dtype).expand(len(A), 3)
        for smoothing in (None, Smoothing("ring"), Smoothing("gaussian")):
            args = (A, T_b[rows], PARTS, pairs[rows])
            for x in (
                signed_distance(*args, backend="warp", smoothing=smoothing),
                drop_distance(*args, gravity, limit=1.0, backend="warp", smoothing=smoothing),
            ):
                gradient = torch.autograd.grad(x.distance.nan_to_num(posinf=0.0).sum(), A)[0]
                out += [*(y.detach() for y in x), gradient]
        return out

    every, order = torch.arange(120), torch.randperm(120, generator=torch.Generator().manual_seed(1))
    first = run(every)
    assert all(torch.equal(x, y) for x, y in zip(first, run(every), strict=True))
    assert all(torch.equal(x[order], y) for x, y in zip(first, run(order), strict=True))
    for k in range(0, 120, 17):
        assert all(torch.equal(x[k : k + 1], y) for x, y in zip(first, run(every[k : k + 1]), strict=True))


def test_swapping_the_bodies_swaps_the_answer():
    for gap in (0.02, 0.0, -1e-9, -1e-3):
        T_a, T_b, pairs = contacts(gap, 90, seed=17)
        one, other = (
            signed_distance(*x, backend="warp") for x in ((T_a, T_b, PARTS, pairs), (T_b, T_a, PARTS, pairs.flip(1)))
        )
        torch.testing.assert_close(one.distance, other.distance, atol=1e-9, rtol=0.0)


def test_works_in_inference_mode_and_under_autocast():
    T_a, T_b, pairs = (x.float() if x.is_floating_point() else x for x in landing())
    expected = [x.distance for x in both(T_a, T_b, pairs)]
    for mode in (torch.no_grad(), torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16)):
        with mode:
            for x, y in zip(both(T_a.clone(), T_b, pairs), expected, strict=True):
                assert torch.equal(x.distance, y)


def test_sets_of_parts_do_not_get_mixed_up():
    """Structs are kept for each set; a set that has gone leaves nothing behind."""
    import gc

    from physpose_torch.distance import warp as module

    T = torch.cat([at(), at(0, 0, 1)])
    gc.collect()
    before = len(module._structs)
    for k in range(1, 6):
        parts = ConvexParts.from_hulls([box(0.1, 0.1, 0.01 * k)])
        distance = signed_distance(T[:1], T[1:], parts, torch.tensor([[0, 0]]), backend="warp").distance
        assert float(distance) == pytest.approx(1 - 0.02 * k, abs=1e-12)
    del parts
    gc.collect()
    assert len(module._structs) <= before


# --- one operator to torch --------------------------------------------------------------------------------------------


def operator_arguments(dtype, n=5):
    T_a, T_b, pairs = (x[:n] for x in landing())
    start = (*rounded(T_a, T_b, dtype), True, pairs, PARTS.handle, "ring", 0.1, 16, 0)
    return {
        "signed_distance": start,
        "drop_distance": (*start, DOWN.to(dtype).expand(n, 3).contiguous(), 5.0),
    }


@DTYPES
@pytest.mark.parametrize("name", ["signed_distance", "drop_distance"])
def test_operators_keep_the_rules_of_torch(name, dtype):
    signed_distance(at(), at(), PARTS, torch.tensor([[0, 1]]), backend="warp")  # registers them
    operator = getattr(torch.ops.physpose_torch, name).default
    arguments = operator_arguments(dtype)[name]
    torch.library.opcheck(operator, arguments)
    with torch._subclasses.FakeTensorMode() as mode:
        fake = operator(*(mode.from_tensor(x) if isinstance(x, torch.Tensor) else x for x in arguments))
    for x, y in zip(fake, operator(*arguments), strict=True):
        assert (x.shape, x.dtype, x.stride()) == (y.shape, y.dtype, y.stride())


@pytest.mark.parametrize("smoothing", [None, Smoothing("ring")], ids=["hard", "ring"])
def test_compiled_code_sees_one_opaque_operator(smoothing):
    from torch._dynamo.backends.common import aot_autograd

    T_a, T_b, pairs = landing()
    gravity = DOWN.expand(8, 3)
    names = []

    def keep(graph, _):
        names.extend(str(node.target) for node in graph.graph.nodes if "physpose_torch" in str(node.target))
        return graph

    def cost(A, B):
        near = signed_distance(A, B, PARTS, pairs, smoothing=smoothing)
        drop = drop_distance(A, B, PARTS, pairs, gravity, limit=5.0, smoothing=smoothing)
        return near.distance.square().sum() + drop.distance.square().sum() + near.point_a.sum()

    torch._dynamo.reset()
    values = []
    for f in (
        cost,
        torch.compile(cost, fullgraph=True, backend="aot_eager"),
        torch.compile(cost, fullgraph=True, backend=aot_autograd(fw_compiler=keep, bw_compiler=keep)),
    ):
        A, B = T_a.clone().requires_grad_(), T_b.clone().requires_grad_()
        value = f(A, B)
        values.append((value.detach(), *torch.autograd.grad(value, (A, B))))
    for other in values[1:]:
        assert all(torch.equal(x, y) for x, y in zip(values[0], other, strict=True))
    assert sorted(names) == ["physpose_torch.drop_distance.default", "physpose_torch.signed_distance.default"]


def test_importing_the_package_does_not_import_warp():
    names = "signed_distance, drop_distance, Scene, PhysPoseRefiner, Smoothing, ConvexParts"
    program = f"from physpose_torch import {names}\nimport physpose_torch.distance.autograd\n"
    program += "import json, sys; print(json.dumps([m for m in sys.modules if m.split('.')[0] == 'warp']))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert json.loads(run.stdout.splitlines()[-1]) == []


# --- real parts -------------------------------------------------------------------------------------------------------

REAL = {
    "apart": (3000, (1e-6, 0.1)),
    "touching": (3000, 0.0),
    "1 nm apart": (3000, 1e-9),
    "1 nm deep": (3000, -1e-9),
    "shallow": (4000, (-1e-3, -1e-6)),
    "deep": (4000, (-0.03, -1e-3)),
}
"""Pairs, and the gap of the features that face each other, or its range (logarithmic) [m]."""


def oracle_chunk(rows):
    return [float(oracle_distance(*row)[0]) for row in rows]


@pytest.mark.slow
@pytest.mark.data
def test_real_part_pairs_agree_with_the_oracle(ycbv, monkeypatch, capsys):
    from physpose_torch.geometry.body import Body

    monkeypatch.delenv("PHYSPOSE_CACHE")  # decomposing 21 objects anew takes an hour
    bodies = [Body.from_mesh(p, label=p.stem, scale=1e-3) for p in sorted((ycbv / "models").glob("*.ply"))]
    parts = ConvexParts.cat([b.parts for b in bodies])
    hulls = [[x.numpy() for x in parts.part(p)] for p in range(parts.n_parts)]
    rng = np.random.default_rng(0)
    total, lines, failed = 0, [], []
    # spawned: torch's threads do not survive a fork
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for name, (count, gap) in REAL.items():
            sign = -1.0 if np.min(gap) < 0 else 1.0
            gaps = sign * np.exp(rng.uniform(*np.sort(np.log(np.abs(gap))), count)) if np.ndim(gap) else gap
            poses = contacts(gaps, count, seed=total, parts=parts)
            for dtype in (torch.float64, torch.float32):
                (T_a, T_b), pairs = rounded(*poses[:2], dtype), poses[2]
                result = signed_distance(T_a, T_b, parts, pairs, backend="warp")
                if dtype == torch.float64:
                    _, _, R, t = frames(T_a, T_b)
                    rows = [
                        (*hulls[a], hulls[b][0] @ r.T + x, hulls[b][1])
                        for (a, b), r, x in zip(pairs.tolist(), R.numpy(), t.numpy(), strict=True)
                    ]
                    chunks = [rows[k : k + 100] for k in range(0, count, 100)]
                    expected = torch.as_tensor(np.concatenate(list(pool.map(oracle_chunk, chunks))))
                    total += count
                    reference = expected
                else:  # of the rounded poses, by what has just been checked
                    reference = signed_distance(T_a.double(), T_b.double(), parts, pairs, backend="warp").distance
                found = {
                    "distance": (result.distance.double() - reference).abs(),
                    **errors(parts, pairs, T_a, T_b, result),
                }
                found["sign"] = torch.where(
                    result.distance.sign() != reference.sign(), torch.minimum(found["distance"], reference.abs()), 0.0
                )
                worst = {k: float(e.max()) for k, e in found.items()}
                many = {k: int((e > ATOL[dtype]).sum()) for k, e in found.items()}
                line = f"{name:12s}{str(dtype)[6:]:9s}{count:6d} pairs  "
                lines.append(line + "  ".join(f"{k} {worst[k]:.1e} ({many[k]})" for k in found))
                finite = all(bool(x.isfinite().all()) for x in result)
                failed += [
                    f"{line}: {k} {v:.1e}"
                    for k, v in worst.items()
                    if k != "unit" and v > ATOL[dtype] * (1.0 if k == "distance" else PROOF)
                ]
                failed += [] if finite else [f"{line}: not finite"]
    with capsys.disabled():
        print("\n" + "\n".join(lines))
    assert total >= 20_000
    assert not failed, "\n".join(failed)
