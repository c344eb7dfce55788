"""Smoothed gradients against the truth: the mean of the hard gradient over random rotations about the contact."""

import functools
import math

import numpy as np
import pytest
import torch
from helpers import ball, box, cylinder, pose, random_poses
from scipy.optimize import minimize

from physpose_torch import se3
from physpose_torch.config import Smoothing
from physpose_torch.distance.autograd import signed_distance
from physpose_torch.distance.smoothing import smoothed_points, tangent_basis, vertex_weights
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.convex import ConvexParts

SHAPES = {
    "cube": box(0.03, 0.03, 0.03),
    "slab": box(0.15, 0.15, 0.02),
    "table": box(0.5, 0.5, 0.02),
    "rod": box(0.08, 0.01, 0.01),
    "can": cylinder(0.03, 0.05),
    "ball": ball(0.04),
}
PARTS = ConvexParts.from_hulls(list(SHAPES.values()))
NOISE = 0.1
DEPTH = -1e-3
CORNER_DOWN = tuple(math.acos(3**-0.5) * np.array([1.0, -1.0, 0.0]) / 2**0.5)


def turned(*rotations):
    """Rotation vector of rotations applied one after another."""
    R = torch.eye(3, dtype=torch.float64)
    for r in rotations:
        R = se3.exp_so3(torch.tensor(r, dtype=torch.float64)) @ R
    return tuple(se3.log_so3(R).tolist())


QUARTER_X, EIGHTH_X, YAW = (math.pi / 2, 0, 0), (math.pi / 4, 0, 0), (0, 0, 1.2)

# body on another: its rotation and place over it, the other's rotation; then how much of the body's radius the lever
# may be off under (ring, gaussian with 4096 draws, gumbel with 1 mm); None: not compared, gumbel blurs a length and not
# an angle. (Two corners slip off each other: that turns the normal too, which only `pose` averages.)
CONTACTS = {
    "face: cube on an equal cube": ("cube", "cube", (0, 0, 0), (0, 0), (0, 0, 0), (0.05, 0.05, 0.05)),
    "face: two cubes, half off": ("cube", "cube", (0, 0, 0), (0.03, 0.01), (0, 0, 0), (0.07, 0.07, 0.07)),
    "face: cube amid a slab": ("cube", "slab", (0, 0, 0), (0, 0), (0, 0, 0), (0.05, 0.05, 0.05)),
    "face: cube aside on a slab": ("cube", "slab", (0, 0, 0.5), (0.1, 0.05), (0, 0, 0), (0.11, 0.11, 0.12)),
    "face: cube half over a slab's border": ("cube", "slab", (0, 0, 0.3), (0.15, 0.05), (0, 0, 0), (0.17, 0.17, 0.11)),
    "face: cube aside on a table": ("cube", "table", (0, 0, 0), (0.3, 0.2), (0, 0, 0), (0.06, 0.06, 0.06)),
    "face: cube tilted by 2 degrees": ("cube", "slab", (0.035, 0, 0), (0.05, 0.03), (0, 0, 0), (0.08, 0.08, None)),
    "face: cube tilted by 6 degrees": ("cube", "slab", (0.1, 0, 0), (0.05, 0.03), (0, 0, 0), (0.07, 0.08, None)),
    "edge-edge: two rods": ("rod", "rod", turned(EIGHTH_X, YAW), (0.02, 0.01), EIGHTH_X, (0.01, 0.01, 0.01)),
    "edge-face: cube on its edge": ("cube", "slab", EIGHTH_X, (0.05, 0.03), (0, 0, 0), (0.07, 0.07, 0.07)),
    "face-face: rod across a rod": ("rod", "rod", YAW, (0.02, 0.01), (0, 0, 0), (0.03, 0.03, 0.03)),
    "vertex-face: cube on its corner": ("cube", "slab", CORNER_DOWN, (0.05, 0.03), (0, 0, 0), (0.02, 0.02, 0.02)),
    "vertex-vertex: cube on a corner": ("cube", "cube", CORNER_DOWN, (1e-4, 1e-4), turned(CORNER_DOWN, (0, 0, 1)),
                                        (0.25, 0.25, None)),
    "curved: can on its end": ("can", "slab", (0, 0, 0), (0.05, 0.03), (0, 0, 0), (0.04, 0.04, 0.04)),
    "curved: can on its side": ("can", "slab", QUARTER_X, (0.05, 0.03), (0, 0, 0), (0.09, 0.09, 0.09)),
    "curved: can across a can": ("can", "can", turned(QUARTER_X, YAW), (0.01, 0.01), QUARTER_X, (0.02, 0.02, 0.02)),
    "curved: ball on a slab": ("ball", "slab", (0.3, 0.2, 0.1), (0.05, 0.03), (0, 0, 0), (0.03, 0.03, 0.06)),
    "curved: ball on a ball": ("ball", "ball", (0.3, 0.2, 0.1), (0.02, 0.03), (0, 0, 0), (0.06, 0.06, None)),
}


@functools.cache
def scene(name):
    """Poses (1, 4, 4) of the two bodies, one sunk into the other by a millimetre along z, and the pair."""
    a, b, rotation, place, other, _ = CONTACTS[name]
    pairs = torch.tensor([[list(SHAPES).index(a), list(SHAPES).index(b)]])
    T_b = pose(other)[None]
    low, high = 0.0, 0.3
    for _ in range(40):
        T_a = pose(rotation, (*place, 0.5 * (low + high)))[None]
        too_deep = float(signed_distance(T_a, T_b, PARTS, pairs).distance) < DEPTH
        low, high = (0.5 * (low + high), high) if too_deep else (low, 0.5 * (low + high))
    return T_a, T_b, pairs


def torque(T_a, T_b, pairs, smoothing, parts=PARTS):
    """(E, 3) gradient with respect to the rotation of body a [m]."""
    xi = torch.zeros(len(pairs), 6, dtype=torch.float64, requires_grad=True)
    distance = signed_distance(se3.retract(T_a, xi), T_b, parts, pairs, smoothing=smoothing).distance
    return torch.autograd.grad(distance.sum(), xi)[0][:, 3:]


@functools.cache
def truth(name, draws=1500):
    """Mean of the hard torque over relative rotations by NOISE about the contact, and its standard error."""
    T_a, T_b, pairs = scene(name)
    generator = torch.Generator().manual_seed(0)
    half = NOISE * 0.5**0.5 * torch.randn(draws, 2, 3, generator=generator, dtype=torch.float64)
    rotation = se3.exp_so3(torch.cat([half, -half]))
    contact = signed_distance(T_a, T_b, PARTS, pairs).point_a[0]

    def turn(T, R):
        t = (R @ (T[:, :3, 3] - contact)[:, :, None])[:, :, 0] + contact
        return se3.from_rotation_translation(R @ T[:, :3, :3], t)

    sample = torque(turn(T_a, rotation[:, 0]), turn(T_b, rotation[:, 1]), pairs.repeat(2 * draws, 1), None)
    pairwise = sample.unflatten(0, (2, draws)).mean(0)
    return pairwise.mean(0), float((pairwise.std(0) / draws**0.5).norm())


def lever_error(name, smoothing):
    T_a, T_b, pairs = scene(name)
    error = torque(T_a, T_b, pairs, smoothing)[0] - truth(name)[0]
    return float(error.norm() / PARTS.radius[pairs[0, 0]])


@pytest.mark.parametrize("name", CONTACTS)
def test_smoothed_torque_is_near_the_monte_carlo_truth(name):
    bounds = CONTACTS[name][-1]
    kinds = (Smoothing("ring"), Smoothing("gaussian", samples=4096), Smoothing("gumbel"))
    assert truth(name)[1] / float(PARTS.radius[scene(name)[2][0, 0]]) < 0.02
    for smoothing, bound in zip(kinds, bounds, strict=True):
        if bound is not None:
            assert lever_error(name, smoothing) < bound, smoothing.kind


@pytest.mark.parametrize("name", [name for name in CONTACTS if name.startswith("face: cube")])
def test_smoothing_is_much_nearer_the_truth_than_the_hard_gradient(name):
    assert lever_error(name, None) > 2 * lever_error(name, Smoothing("ring"))


@pytest.mark.parametrize("name", [name for name in CONTACTS if not name.startswith("vertex-vertex")])
def test_pose_smoothing_is_nearly_the_truth(name):
    """It turns the bodies about their origins, not about the contact: that slides round things on each other."""
    bound = 0.08 if name == "curved: ball on a ball" else 0.04
    assert lever_error(name, Smoothing("pose", samples=2000)) < bound


def test_few_gaussian_draws_are_noisy_but_not_biased_by_their_own_asymmetry():
    """Antithetic draws cancel where the contact is symmetric."""
    assert lever_error("face: cube amid a slab", Smoothing("gaussian", samples=8)) < 0.03
    assert lever_error("face: cube tilted by 2 degrees", Smoothing("gaussian", samples=16)) < 0.2


# --- weights of one body ----------------------------------------------------------------------------------------------


def one_body(name, normal):
    k = list(SHAPES).index(name)
    direction = torch.nn.functional.normalize(torch.tensor([normal], dtype=torch.float64), dim=-1)
    return PARTS.padded[k : k + 1], PARTS.padded_mask[k : k + 1], direction


@pytest.mark.parametrize(
    ("name", "normal", "bound"),
    [
        ("cube", (0, 0, -1), 1e-3), ("cube", (0.05, 0.02, -1), 0.06), ("cube", (0.0, 1.0, -1), 1e-3),
        ("cube", (1, 1, 1), 1e-3), ("can", (0, 0, 1), 0.03), ("can", (1, 0.01, 0), 0.03),
        ("can", (1.0, 0.2, 0.9), 0.03),
        ("ball", (0.3, -0.2, 0.8), 0.03), ("ball", (-1, 0.4, 0.2), 0.03),
    ],
)
def test_ring_weights_are_the_expectation_of_the_gaussian_ones(name, normal, bound):
    vertices, mask, n = one_body(name, normal)
    truth = vertex_weights(vertices, mask, n, Smoothing("gaussian", samples=400_000))
    ring = vertex_weights(vertices, mask, n, Smoothing("ring"))
    fine = vertex_weights(vertices, mask, n, Smoothing("ring", samples=512))
    radius = float((vertices[mask] - vertices[mask].mean(0)).norm(dim=-1).max())

    def mean(weights):
        return (tangent_basis(n) @ torch.einsum("ek,eki->ei", weights, vertices)[:, :, None])[:, :, 0]

    assert float((mean(ring) - mean(truth)).norm()) / radius < bound + 0.005
    assert float((mean(fine) - mean(truth)).norm()) / radius < 0.03  # six radii remain


@pytest.mark.parametrize("kind", ["gaussian", "gumbel", "ring"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 6])
def test_weights_are_a_distribution_over_the_vertices(kind, dtype, count):
    index = torch.arange(count) % PARTS.n_parts
    n = torch.nn.functional.normalize(random_poses(count, 1)[:, :3, 0], dim=-1).to(dtype)
    weights = vertex_weights(PARTS.padded[index].to(dtype), PARTS.padded_mask[index], n, Smoothing(kind))
    assert weights.dtype == dtype
    assert (weights >= 0).all()
    assert (weights[~PARTS.padded_mask[index]] == 0).all()
    torch.testing.assert_close(weights.sum(1), torch.ones(count, dtype=dtype))


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, -0.64, 0.48), (1e-9, 0, -1)])
def test_tangent_basis_is_orthonormal(normal):
    n = torch.nn.functional.normalize(torch.tensor([normal], dtype=torch.float64), dim=-1)
    frame = torch.cat([tangent_basis(n)[0], n])
    torch.testing.assert_close(frame @ frame.T, torch.eye(3, dtype=torch.float64), atol=1e-14, rtol=0.0)


# --- gumbel: the gradient of a smoothed distance ----------------------------------------------------------------------


def smoothed_distance(A, B, epsilon, start):
    """d_ε = max over unit n of -ε LSE(V_A n / ε) - ε LSE(-V_B n / ε) near ``start``, maximised numerically."""
    A, B = A.numpy(), B.numpy()

    def negative(x):
        n = x / np.linalg.norm(x)
        u, v = A @ n / epsilon, -B @ n / epsilon
        p, q = np.exp(u - u.max()), np.exp(v - v.max())
        value = epsilon * (u.max() + np.log(p.sum()) + v.max() + np.log(q.sum()))
        gradient = (A.T @ p) / p.sum() - (B.T @ q) / q.sum()
        return value, (gradient - n * (n @ gradient)) / np.linalg.norm(x)

    out = minimize(negative, start.numpy(), jac=True, method="BFGS", options={"gtol": 1e-13, "maxiter": 500})
    return -out.fun


def separate(name, lift):
    T_a, T_b, pairs = (x.clone() for x in scene(name))
    T_a[:, 2, 3] += lift
    return T_a, T_b, pairs


@pytest.mark.parametrize("lift", [0.0, 0.011], ids=["overlapping", "apart"])
@pytest.mark.parametrize("epsilon", [5e-4, 2e-3])
@pytest.mark.parametrize("name", [
    "face: two cubes, half off", "face: cube aside on a slab", "edge-edge: two rods", "vertex-face: cube on its corner",
    "curved: can across a can", "curved: ball on a ball", "face: cube tilted by 6 degrees",
])
def test_gumbel_gradient_is_that_of_the_smoothed_distance(name, epsilon, lift):
    T_a, T_b, pairs = separate(name, lift)
    (i, j), start = pairs[0].tolist(), signed_distance(T_a, T_b, PARTS, pairs).normal[0]

    def value(xi_a, xi_b):
        A = se3.apply(se3.retract(T_a[0], xi_a), PARTS.part(i)[0])
        B = se3.apply(se3.retract(T_b[0], xi_b), PARTS.part(j)[0])
        return smoothed_distance(A, B, epsilon, start)

    xi = [torch.zeros(1, 6, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    moved = (se3.retract(T, x) for T, x in zip((T_a, T_b), xi, strict=True))
    distance = signed_distance(*moved, PARTS, pairs, smoothing=Smoothing("gumbel", temperature=epsilon)).distance
    for k, gradient in enumerate(torch.autograd.grad(distance.sum(), xi)):
        for axis in range(6):
            step = torch.zeros(2, 6, dtype=torch.float64)
            step[k, axis] = h = 1e-5
            difference = (8 * (value(*step) - value(*-step)) - (value(*2 * step) - value(*-2 * step))) / (12 * h)
            assert float(gradient[0, axis]) == pytest.approx(difference, abs=1e-6)


def test_gumbel_weights_of_the_other_body_belong_to_the_opposite_direction():
    (A, mask, n), (B, mask_b, _) = one_body("cube", (0.1, 0.2, 1.0)), one_body("rod", (0, 0, 1))
    smoothing = Smoothing("gumbel", temperature=5e-3)
    normal, a, b = smoothed_points(A, mask, B + torch.tensor([0.0, 0, 0.05]), mask_b, n, smoothing)
    for x, V, m, sign in ((a, A, mask, 1.0), (b, B + torch.tensor([0.0, 0, 0.05]), mask_b, -1.0)):
        weights = torch.softmax((sign * V[0][m[0]] @ normal[0]) / 5e-3, dim=0)
        torch.testing.assert_close(x[0], weights @ V[0][m[0]], atol=1e-12, rtol=0.0)
    assert torch.linalg.cross((b - a)[0], normal[0]).norm() < 1e-10


# --- all kinds --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("smoothing", [
    Smoothing("gaussian", noise=1e-6), Smoothing("ring", noise=1e-6), Smoothing("gumbel", temperature=1e-6),
    Smoothing("pose", noise=1e-6, samples=4),
], ids=lambda s: s.kind)
@pytest.mark.parametrize("name", ["edge-edge: two rods", "vertex-face: cube on its corner", "curved: ball on a slab"])
def test_without_noise_the_gradient_is_the_hard_one(name, smoothing):
    T_a, T_b, pairs = scene(name)
    expected = torque(T_a, T_b, pairs, None)
    torch.testing.assert_close(torque(T_a, T_b, pairs, smoothing), expected, atol=2e-5, rtol=0.0)


@pytest.mark.parametrize("kind", ["gaussian", "gumbel", "ring", "pose"])
def test_the_value_is_never_smoothed_and_the_force_stays_a_unit_push(kind):
    T_a, T_b, pairs = (torch.cat(x) for x in zip(*(scene(name) for name in CONTACTS), strict=True))
    hard = signed_distance(T_a, T_b, PARTS, pairs)
    xi = [torch.zeros(len(pairs), 6, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    moved = (se3.retract(T, x) for T, x in zip((T_a, T_b), xi, strict=True))
    soft = signed_distance(*moved, PARTS, pairs, smoothing=Smoothing(kind))
    for x, y in zip(soft, hard, strict=True):
        torch.testing.assert_close(x, y, atol=1e-12, rtol=0.0)
    g_a, g_b = torch.autograd.grad(soft.distance.sum(), xi)
    # action is reaction: no net force, and no net torque about the camera
    torch.testing.assert_close(g_a[:, :3], -g_b[:, :3], atol=1e-12, rtol=0.0)
    force = g_a[:, :3].norm(dim=-1)
    assert (force <= 1 + 1e-12).all()
    if kind != "pose":  # a mean of unit normals is shorter
        torch.testing.assert_close(force, torch.ones_like(force), atol=1e-12, rtol=0.0)
        about = [
            torch.linalg.cross(T[:, :3, 3], g[:, :3]) + (T[:, :3, :3] @ g[:, 3:, None])[:, :, 0]
            for T, g in ((T_a, g_a), (T_b, g_b))
        ]
        torch.testing.assert_close(about[0], -about[1], atol=1e-9, rtol=0.0)


@pytest.mark.parametrize("kind", ["gaussian", "gumbel", "ring", "pose"])
def test_the_same_seed_gives_the_same_gradient(kind):
    T_a, T_b, pairs = scene("face: cube tilted by 2 degrees")
    first, second = (torque(T_a, T_b, pairs, Smoothing(kind, seed=3)) for _ in range(2))
    assert torch.equal(first, second)
    other = torque(T_a, T_b, pairs, Smoothing(kind, seed=4))
    assert torch.equal(first, other) == (kind in ("gumbel", "ring"))


def test_each_pair_is_smoothed_by_itself():
    names = list(CONTACTS)
    T_a, T_b, pairs = (torch.cat(x) for x in zip(*(scene(name) for name in names), strict=True))
    for kind in ("gaussian", "gumbel", "ring"):
        together = torque(T_a, T_b, pairs, Smoothing(kind))
        for k in range(len(names)):
            alone = torque(T_a[k : k + 1], T_b[k : k + 1], pairs[k : k + 1], Smoothing(kind))
            torch.testing.assert_close(together[k : k + 1], alone, atol=1e-6, rtol=0.0)


def test_unknown_kind_and_vanishing_noise_are_refused():
    with pytest.raises(InvalidInputError, match="smoothing kind 'blur'"):
        Smoothing("blur")
    for name in ("noise", "temperature", "samples"):
        with pytest.raises(InvalidInputError, match=f"Smoothing.{name} = 0"):
            Smoothing(**{name: 0})
