"""Distances of bodies of all sizes, wherever they are: within the stated error, and the same wherever the camera is.

The stated error is in units of eps, that of the dtype, times what is computed with: how far the bodies are from each
other and how large they are, never how far they are from the camera.
"""

import numpy as np
import pytest
import torch
from extremes import DTYPES, directions, hunted, powers, ranges, rotations, shares, sizes, units
from helpers import ball, box, cylinder
from hypothesis import given
from hypothesis import strategies as st
from oracle import oracle_distance, oracle_drop

from physpose_torch import se3
from physpose_torch.config import Smoothing
from physpose_torch.distance.autograd import _orthonormal, drop_distance, signed_distance
from physpose_torch.distance.broadphase import near_spheres
from physpose_torch.distance.plane import plane_distance
from physpose_torch.geometry.body import Plane
from physpose_torch.geometry.convex import ConvexParts

BACKENDS = ["warp", "fcl"]
ERROR = 16
"""Of a distance, in eps times distance and sizes, …"""
LEAST = {
    ("warp", torch.float32): 2e-6,
    ("warp", torch.float64): 1e-12,
    ("fcl", torch.float32): 1e-10,
    ("fcl", torch.float64): 1e-10,
}
"""… and this [m]."""
SMOOTHINGS = [None, Smoothing(), Smoothing("gaussian"), Smoothing("gumbel"), Smoothing("pose", samples=2)]


@st.composite
def hulls(draw, size: float) -> np.ndarray:
    half = size / 2
    kind = draw(st.sampled_from(["box", "cube", "prism", "ball", "needle", "sheet", "tetrahedron"]))
    if kind == "box":
        return box(*(half * draw(shares) for _ in range(3)))
    if kind == "prism":
        return cylinder(half * draw(shares), half * draw(shares), 16)
    if kind == "tetrahedron":
        corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * half
        return corners * [draw(shares) for _ in range(3)]
    shapes = {
        "cube": box(half, half, half),
        "ball": ball(half, 30),
        "needle": box(half, half / 100, half / 100),
        "sheet": box(half, half * 0.8, half / 200),
    }
    return shapes[kind]


@st.composite
def couples(draw, away=ranges) -> tuple[ConvexParts, torch.Tensor, torch.Tensor]:
    """Two parts and three relative poses of them, T_a and T_b (3, 4, 4): one in the other, touching or far apart."""
    size = draw(sizes)
    other = size if draw(st.booleans()) else draw(sizes)
    parts = ConvexParts.from_hulls([draw(hulls(size)), draw(hulls(other))])
    rows = []
    for _ in range(3):
        base = torch.tensor(draw(units), dtype=torch.float64) * draw(away)
        apart = draw(st.sampled_from([0.0, 1e-9, 0.1, 0.5, 1.0, 3.0])) * (size + other)
        shift = apart * torch.tensor(
            draw(units | st.sampled_from([(1.0, 0.0, 0.0), (0.0, 0.5, 0.0)])), dtype=torch.float64
        )
        rows.append((se3.from_rotation_translation(draw(rotations()), base), draw(rotations()), base + shift))
    T_a = torch.stack([T for T, _, _ in rows])
    return parts, T_a, torch.stack([se3.from_rotation_translation(R, t) for _, R, t in rows])


PAIRS = torch.tensor([[0, 1]] * 3)


def relative(T_a, T_b):
    """Pose R, t of b in the frame of a, of poses in any dtype as they are."""
    R_a, R_b = (_orthonormal(T.double()[None, :3, :3])[0] for T in (T_a, T_b))
    return (R_a.T @ R_b).numpy(), (R_a.T @ (T_b.double() - T_a.double())[:3, 3]).numpy()


def scale(parts, T_a, T_b):
    """(E,) what errors are in proportion to [m]: how far apart the bodies are, and how large."""
    extent = torch.linalg.vector_norm(parts.padded, dim=-1).amax()
    return torch.linalg.vector_norm((T_b.double() - T_a.double())[:, :3, 3], dim=-1) + 2 * extent


@pytest.mark.parametrize("backend", BACKENDS)
@hunted(15)
@given(couple=couples(), dtype=st.sampled_from(DTYPES))
def test_distances_are_within_the_stated_error_of_the_oracle(backend, couple, dtype):
    parts, T_a, T_b = couple[0], couple[1].to(dtype), couple[2].to(dtype)
    found = signed_distance(T_a, T_b, parts, PAIRS, backend=backend)
    again = signed_distance(T_a, T_b, parts, PAIRS, backend=backend)
    assert all(
        torch.equal(x, y) and x.dtype == dtype and bool(x.isfinite().all()) for x, y in zip(found, again, strict=True)
    )
    (A, F), (B, G) = ([x.numpy() for x in parts.part(p)] for p in (0, 1))
    eps = torch.finfo(dtype).eps
    assert float((torch.linalg.vector_norm(found.normal.double(), dim=1) - 1).abs().max()) < 8 * eps
    for d, T, U, size in zip(found.distance.tolist(), T_a, T_b, scale(parts, T_a, T_b).tolist(), strict=True):
        R, t = relative(T, U)
        expected, _ = oracle_distance(A, F, B @ R.T + t, G)
        assert abs(d - expected) <= ERROR * eps * size + LEAST[backend, dtype]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("smoothing", SMOOTHINGS, ids=lambda s: s.kind if s else "none")
@hunted(4)
@given(couple=couples(), dtype=st.sampled_from(DTYPES), down=directions)
def test_far_from_the_camera_two_bodies_are_what_they_are_near_it(backend, smoothing, couple, dtype, down):
    """Bit for bit, gradients and falls too: only how they lie to each other enters."""
    parts, T_a, T_b = couple[0], couple[1].to(dtype), couple[2].to(dtype)
    near_a, near_b = T_a.clone(), T_b.clone()
    near_a[:, :3, 3] = 0
    near_b[:, :3, 3] -= T_a[:, :3, 3]

    def computed(*poses):
        poses = [T.clone().requires_grad_() for T in poses]
        d = signed_distance(*poses, parts, PAIRS, backend=backend, smoothing=smoothing)
        gravity = down.to(dtype).expand(3, 3)
        limit = 10 * float(scale(parts, T_a, T_b).max())
        h = drop_distance(*poses, parts, PAIRS, gravity, limit=limit, backend=backend, smoothing=smoothing)
        total = d.distance.sum() + torch.where(h.distance.isfinite(), h.distance, 0.0).sum()
        return [d.distance, d.normal, h.distance, h.normal, *torch.autograd.grad(total, poses)]

    far, near = computed(T_a, T_b), computed(near_a, near_b)
    assert all(torch.equal(x, y) for x, y in zip(far, near, strict=True))
    assert all(bool(x.isfinite().all()) for x in (*far[:2], *far[3:]))


@pytest.mark.parametrize("backend", BACKENDS)
@hunted(10)
@given(couple=couples(powers(-9, 2)), dtype=st.sampled_from(DTYPES), factor=st.sampled_from([2.0, 0.5]))
def test_distances_are_symmetric_and_grow_with_the_bodies(backend, couple, dtype, factor):
    parts, T_a, T_b = couple[0], couple[1].to(dtype), couple[2].to(dtype)
    found = signed_distance(T_a, T_b, parts, PAIRS, backend=backend)
    error = ERROR * torch.finfo(dtype).eps * scale(parts, T_a, T_b) + LEAST[backend, dtype]
    swapped = signed_distance(T_b, T_a, parts, PAIRS.flip(1), backend=backend)
    assert bool(((found.distance - swapped.distance).abs() <= error).all())
    larger = ConvexParts.from_hulls([factor * parts.part(p)[0].numpy() for p in (0, 1)])
    T_a, T_b = (torch.cat([torch.cat([T[:, :3, :3], factor * T[:, :3, 3:]], 2), T[:, 3:]], 1) for T in (T_a, T_b))
    grown = signed_distance(T_a, T_b, larger, PAIRS, backend=backend)
    assert bool(((grown.distance / factor - found.distance).abs() <= 2 * error).all())


@pytest.mark.parametrize("backend", BACKENDS)
@hunted(6)
@given(couple=couples(), dtype=st.sampled_from(DTYPES))
def test_a_body_falls_onto_another_as_far_as_the_oracle_says(backend, couple, dtype):
    parts, T_a, T_b = couple[0], couple[1].to(dtype)[:1], couple[2].to(dtype)[:1]
    size = float(scale(parts, T_a, T_b)[0])
    R, t = relative(T_a[0], T_b[0])
    down = torch.tensor(t / max(np.linalg.norm(t), 1e-300)) if np.linalg.norm(t) > 0 else torch.tensor([0.0, 0.0, 1.0])
    gravity = (T_a[0, :3, :3].double() @ down.double())[None].to(dtype)
    h = drop_distance(T_a, T_b, parts, PAIRS[:1], gravity, limit=3 * size, backend=backend)
    (A, F), (B, G) = ([x.numpy() for x in parts.part(p)] for p in (0, 1))
    B = B @ R.T + t
    along = (torch.tensor(_orthonormal(T_a.double()[:, :3, :3])[0].numpy()).T @ gravity[0].double()).numpy()
    expected = oracle_drop(A / size, F, B / size, G, along / np.linalg.norm(along), limit=3.0) * size
    eps = torch.finfo(dtype).eps
    fallen = A + min(float(h.distance[0]), 3 * size) * along / np.linalg.norm(along)
    # where it only grazes, the fall says little and the distance after it all
    after, _ = oracle_distance(fallen, F, B, G)
    error = 64 * eps * size + 1e3 * LEAST[backend, dtype]
    assert abs(float(h.distance[0]) - expected) <= error or abs(after) <= error


@hunted(30)
@given(size=sizes, away=ranges, up=directions, R=rotations(), side=units, dtype=st.sampled_from(DTYPES), data=st.data())
def test_heights_above_a_plane_are_exact_to_rounding(size, away, up, R, side, dtype, data):
    """Places and planes far away cannot be told apart by less than eps of how far away they are."""
    parts = ConvexParts.from_hulls([data.draw(hulls(size)) for _ in range(2)])
    t = torch.tensor(side, dtype=torch.float64) * away
    offset = up @ t + data.draw(st.sampled_from([-1.0, -0.5, 0.0, 1e-9, 0.3])) * size
    T = se3.from_rotation_translation(R, t).to(dtype).expand(2, 4, 4).clone().requires_grad_()
    plane = Plane(up.to(dtype), offset.to(dtype))
    for smoothing in (None, Smoothing(), Smoothing("gumbel")):
        found = plane_distance(T, parts, plane, smoothing=smoothing)
        (gradient,) = torch.autograd.grad(found.distance.sum(), T)
        assert all(x.dtype == dtype and bool(x.isfinite().all()) for x in (*found, gradient))
        exact = T.detach().numpy().astype(np.longdouble)
        for p, d in enumerate(found.distance.tolist()):
            points = parts.part(p)[0].numpy().astype(np.longdouble) @ exact[p, :3, :3].T + exact[p, :3, 3]
            expected = (points @ plane.normal.numpy().astype(np.longdouble)).min() - np.longdouble(float(plane.offset))
            magnitude = float(torch.linalg.vector_norm(T[p, :3, 3].detach().double())) + abs(float(plane.offset)) + size
            assert abs(float(d - expected)) <= ERROR * torch.finfo(dtype).eps * magnitude


@hunted(50)
@given(
    count=st.integers(1, 40),
    size=sizes,
    away=ranges,
    margin=st.sampled_from([0.0, 0.1, 1.0, np.inf]),
    seed=st.integers(0, 99),
)
def test_near_spheres_are_all_that_are_near(count, size, away, margin, seed):
    rng = np.random.default_rng(seed)
    center = torch.from_numpy(
        away * rng.normal(size=3) + size * rng.normal(size=(count, 3)) * rng.choice([0, 1, 1, 1], (count, 1))
    )
    radius = torch.from_numpy(size * rng.uniform(0, 0.5, count))
    found = near_spheres(center, radius, margin * size)
    i, j = torch.combinations(torch.arange(count)).unbind(1) if count > 1 else (torch.zeros(0, dtype=torch.long),) * 2
    gap = torch.linalg.vector_norm(center[i] - center[j], dim=1) - radius[i] - radius[j] - margin * size
    assert [tuple(p) for p in found.tolist()] == sorted(map(tuple, found.tolist()))
    certain = {p for p, g in zip(zip(i.tolist(), j.tolist(), strict=True), gap.tolist(), strict=True) if g <= 0}
    possible = {
        p for p, g in zip(zip(i.tolist(), j.tolist(), strict=True), gap.tolist(), strict=True) if g <= 1e-6 * size
    }
    assert certain <= set(map(tuple, found.tolist())) <= possible
