"""Signed and drop distances as differentiable functions of poses."""

import math

import numpy as np
import pytest
import torch
from helpers import FEATURES, assert_camera_frame_invariant, box, contact, random_poses, zoo
from oracle import oracle_distance, oracle_drop

from physpose_torch import se3
from physpose_torch.config import Smoothing
from physpose_torch.distance import autograd
from physpose_torch.distance.autograd import backends, drop_distance, signed_distance
from physpose_torch.distance.support import DistanceResult
from physpose_torch.errors import InvalidInputError, MissingExtraError
from physpose_torch.geometry.convex import ConvexParts

PARTS = zoo(n_random=6)
BOXES = ConvexParts.from_hulls([box(0.05, 0.03, 0.02), box(0.5, 0.5, 0.01)])
SMOOTHINGS = [None, *(Smoothing(kind) for kind in ("gaussian", "gumbel", "ring", "pose"))]
EYE = torch.eye(4, dtype=torch.float64)


def pair_of_bodies(gap, count, seed=0, parts=PARTS):
    """Poses of bodies (count, 4, 4) in a camera frame, and pairs of parts with random contacts at the gap."""
    rng = np.random.default_rng(seed)
    pairs = rng.integers(parts.n_parts, size=(count, 2))
    poses = []
    for k, (a, b) in enumerate(pairs):
        R, t, _ = contact(parts, a, b, (FEATURES[k % 3], FEATURES[k // 3 % 3]), gap, rng)
        poses.append(se3.from_rotation_translation(torch.as_tensor(R), torch.as_tensor(t)))
    T_a = random_poses(count, seed + 1, spread=0.3)
    return T_a, T_a @ torch.stack(poses), torch.as_tensor(pairs)


def smooth_only(T_a, T_b, pairs, parts=PARTS, step=1e-5):
    """Pairs whose gradient does not jump within a small step: finite differences mean something there."""
    xi = step * torch.randn(8, len(pairs), 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    base = signed_distance(T_a, T_b, parts, pairs)
    keep = torch.ones(len(pairs), dtype=torch.bool)
    for x in xi:
        moved = signed_distance(se3.retract(T_a, x), T_b, parts, pairs)
        keep &= (moved.point_a - base.point_a).norm(dim=-1) < 1e-3
        keep &= (moved.normal - base.normal).norm(dim=-1) < 1e-2
    return keep


@pytest.mark.parametrize("gap", [0.02, 2e-3, -1e-3, -8e-3])
def test_gradient_is_that_of_the_distance_apart_and_under_overlap(gap):
    T_a, T_b, pairs = pair_of_bodies(gap, 24, seed=3)
    keep = smooth_only(T_a, T_b, pairs)
    assert keep.sum() >= 6
    T_a, T_b, pairs = T_a[keep], T_b[keep], pairs[keep]
    xi_a, xi_b = (torch.zeros(len(pairs), 6, dtype=torch.float64, requires_grad=True) for _ in range(2))

    def distance(xi_a, xi_b):
        return signed_distance(se3.retract(T_a, xi_a), se3.retract(T_b, xi_b), PARTS, pairs).distance

    assert torch.autograd.gradcheck(distance, (xi_a, xi_b), eps=1e-7, atol=1e-5, nondet_tol=0.0)


def test_gradient_is_danskins_outer_product():
    T_a, T_b, pairs = pair_of_bodies(-2e-3, 20)
    T_a.requires_grad_(), T_b.requires_grad_()
    out = signed_distance(T_a, T_b, PARTS, pairs)
    g_a, g_b = torch.autograd.grad(out.distance.sum(), (T_a, T_b))
    for g, T, x, sign in ((g_a, T_a, out.point_a, -1.0), (g_b, T_b, out.point_b, 1.0)):
        local = se3.apply(se3.inverse(T), x[:, None])[:, 0]
        expected = sign * out.normal[:, :, None] * torch.cat([local, torch.ones(len(x), 1)], dim=1)[:, None]
        torch.testing.assert_close(g[:, :3], expected, atol=1e-12, rtol=0.0)
        assert (g[:, 3] == 0).all()


@pytest.mark.parametrize("gap", [0.02, 1e-4, 0.0, -1e-9, -1e-3])
def test_swapping_the_bodies_swaps_the_answer(gap):
    T_a, T_b, pairs = pair_of_bodies(gap, 60)
    one, other = signed_distance(T_a, T_b, PARTS, pairs), signed_distance(T_b, T_a, PARTS, pairs.flip(1))
    torch.testing.assert_close(one.distance, other.distance, atol=1e-9, rtol=0.0)
    unique = smooth_only(T_a, T_b, pairs)  # elsewhere several normals are equally right
    assert unique.any() or gap <= 0
    torch.testing.assert_close(one.normal[unique], -other.normal[unique], atol=1e-6, rtol=0.0)
    torch.testing.assert_close(one.point_a[unique], other.point_b[unique], atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("smoothing", SMOOTHINGS, ids=lambda s: "hard" if s is None else s.kind)
def test_moving_the_camera_changes_nothing(smoothing):
    T_a, T_b, pairs = pair_of_bodies(-2e-3, 30)
    keep = smooth_only(T_a, T_b, pairs)
    T_a, T_b, pairs = T_a[keep], T_b[keep], pairs[keep]

    def compute(X):
        A, B = (X @ T_a).requires_grad_(), (X @ T_b).requires_grad_()
        out = signed_distance(A, B, PARTS, pairs, smoothing=smoothing)
        gradient = torch.autograd.grad(out.distance.sum(), A)[0]
        local = X[:3, :3].T @ gradient[:, :3, :3]
        return out.distance, out.normal @ X[:3, :3], se3.apply(se3.inverse(X), out.point_a), local

    # a normal is good to 1e-8; the fusion of two smoothed points multiplies that
    assert_camera_frame_invariant(compute, atol=1e-7 if smoothing is None else 1e-5)


def test_nothing_is_lost_far_from_the_origin():
    T_a, T_b, pairs = pair_of_bodies(-1e-3, 60)
    near = signed_distance(T_a, T_b, PARTS, pairs).distance
    shift = torch.tensor([1000.0, -700.0, 300.0], dtype=torch.float64)
    T_a[:, :3, 3] += shift
    T_b[:, :3, 3] += shift
    torch.testing.assert_close(signed_distance(T_a, T_b, PARTS, pairs).distance, near, atol=1e-11, rtol=0.0)


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_comes_back_and_float32_costs_only_its_rounding(dtype, n):
    T_a, T_b, pairs = pair_of_bodies(-1e-3, n)
    A, B = T_a.to(dtype).requires_grad_(), T_b.to(dtype)
    out = signed_distance(A, B, PARTS, pairs, smoothing=Smoothing("ring"))
    out.distance.sum().backward()
    assert A.grad.dtype == dtype
    for x in out:
        assert x.dtype == dtype
        assert x.device == A.device
    reference = signed_distance(T_a, T_b, PARTS, pairs).distance
    atol = 1e-6 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(out.distance.double(), reference, atol=atol, rtol=0.0)


def test_parts_may_have_another_dtype_than_the_poses():
    T_a, T_b, pairs = pair_of_bodies(-1e-3, 5)
    coarse = PARTS.to(torch.float32)
    expected = signed_distance(T_a, T_b, PARTS, pairs).distance
    torch.testing.assert_close(signed_distance(T_a, T_b, coarse, pairs).distance, expected, atol=1e-7, rtol=0.0)
    assert coarse.reference is coarse.reference


@pytest.mark.parametrize("kind", [None, "gaussian", "gumbel", "ring", "pose"])
def test_no_pairs_give_no_distances(kind):
    T = torch.zeros(0, 4, 4, dtype=torch.float64, requires_grad=True)
    pairs = torch.zeros(0, 2, dtype=torch.long)
    smoothing = None if kind is None else Smoothing(kind)
    out = signed_distance(T, T, PARTS, pairs, smoothing=smoothing)
    assert [tuple(x.shape) for x in out] == [(0,), (0, 3), (0, 3), (0, 3)]
    out.distance.sum().backward()
    assert T.grad.shape == (0, 4, 4)
    fall = drop_distance(T, T, PARTS, pairs, torch.zeros(0, 3, dtype=torch.float64), limit=1.0, smoothing=smoothing)
    assert fall.distance.shape == (0,)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_works_without_gradients(mode):
    T_a, T_b, pairs = pair_of_bodies(-1e-3, 5)
    expected = signed_distance(T_a, T_b, PARTS, pairs).distance
    with mode():
        assert torch.equal(signed_distance(T_a, T_b, PARTS, pairs).distance, expected)
        assert torch.equal(signed_distance(T_a.clone(), T_b, PARTS, pairs, smoothing=Smoothing()).distance, expected)


def test_autocast_costs_no_precision():
    T_a, T_b, pairs = pair_of_bodies(-1e-3, 5)
    T_a, T_b = T_a.float().requires_grad_(), T_b.float()

    def run():
        out = signed_distance(T_a, T_b, PARTS, pairs, smoothing=Smoothing())
        return out.distance, torch.autograd.grad(out.distance.sum(), T_a)[0]

    expected = run()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for x, y in zip(run(), expected, strict=True):
            assert torch.equal(x, y)


def test_second_derivatives_are_refused():
    T_a, T_b, pairs = pair_of_bodies(-1e-3, 3)
    T_a.requires_grad_()
    cost = signed_distance(T_a, T_b, PARTS, pairs).distance.square().sum()
    gradient, = torch.autograd.grad(cost, T_a, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_only_the_distance_carries_a_gradient():
    T_a, T_b, pairs = pair_of_bodies(-1e-3, 3)
    out = signed_distance(T_a.requires_grad_(), T_b, PARTS, pairs)
    assert out.distance.requires_grad
    assert not any(x.requires_grad for x in out[1:])


@pytest.mark.parametrize(
    ("T", "pairs"),
    [((2, 4, 4), (3, 2)), ((3, 4, 4), (3, 3)), ((3, 3, 3), (3, 2)), ((3, 4, 4), (3,))],
)
def test_wrong_shapes_are_named(T, pairs):
    with pytest.raises(InvalidInputError, match="expected \\(E, 4, 4\\)"):
        signed_distance(torch.zeros(T), torch.zeros(T), PARTS, torch.zeros(pairs, dtype=torch.long))


def test_unknown_or_missing_backend_is_named(monkeypatch):
    T_a, T_b, pairs = pair_of_bodies(-1e-3, 1)
    with pytest.raises(InvalidInputError, match=r"'magic'.*fcl"):
        signed_distance(T_a, T_b, PARTS, pairs, backend="magic")
    assert "fcl" in backends()
    monkeypatch.setattr(autograd, "backends", list)
    with pytest.raises(MissingExtraError, match="python-fcl"):
        signed_distance(T_a, T_b, PARTS, pairs)


# --- drop distance ----------------------------------------------------------------------------------------------------

DOWN = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)  # the camera stands upside up, z is not up


def falling(count, seed=0, parts=PARTS):
    """Pairs of parts, b somewhere below a, and gravity of any direction."""
    rng = np.random.default_rng(seed)
    pairs = torch.as_tensor(rng.integers(parts.n_parts, size=(count, 2)))
    T_a = random_poses(count, seed, spread=0.3)
    gravity = torch.nn.functional.normalize(torch.as_tensor(rng.normal(size=(count, 3))), dim=-1)
    T_b = random_poses(count, seed + 7, spread=0.03)
    T_b[:, :3, 3] += T_a[:, :3, 3] + gravity * torch.as_tensor(rng.uniform(0.0, 0.4, size=(count, 1)))
    return T_a, T_b, pairs, gravity


def test_drop_distance_agrees_with_the_oracle():
    T_a, T_b, pairs, gravity = falling(60)
    drop = drop_distance(T_a, T_b, PARTS, pairs, gravity, limit=2.0)
    expected = []
    for k, (a, b) in enumerate(pairs.tolist()):
        (VA, FA), (VB, FB) = (PARTS.part(p) for p in (a, b))
        VA, VB = se3.apply(T_a[k], VA), se3.apply(T_b[k], VB)
        expected.append(oracle_drop(VA.numpy(), FA.numpy(), VB.numpy(), FB.numpy(), gravity[k].numpy(), limit=2.0))
    expected = torch.tensor(expected, dtype=torch.float64)
    assert 10 < expected.isfinite().sum() < 55
    assert (expected == 0).sum() >= 3
    assert torch.equal(drop.distance.isfinite(), expected.isfinite())
    meets = expected.isfinite()
    torch.testing.assert_close(drop.distance[meets], expected[meets], atol=1e-7, rtol=0.0)
    lands = meets & (expected > 0)
    landed = drop.point_a + drop.distance[:, None] * gravity
    torch.testing.assert_close(landed[lands], drop.point_b[lands], atol=1e-8, rtol=0.0)
    assert ((drop.normal * gravity).sum(-1)[lands] > 0).all()


def test_gradient_of_a_drop_is_that_of_its_finite_differences():
    T_a, T_b, pairs, gravity = falling(60, seed=1)
    # finite differences need the meeting features to stay the same
    steps = torch.cat([torch.eye(6), -torch.eye(6)]).double() * 1e-5
    drop = drop_distance(T_a, T_b, PARTS, pairs, gravity, limit=2.0)
    around = [drop_distance(se3.retract(T_a, x.expand(60, 6)), T_b, PARTS, pairs, gravity, limit=2.0) for x in steps]
    same = (drop.distance > 0) & drop.distance.isfinite() & ((drop.normal * gravity).sum(-1) > 0.1)
    for x in around:
        same &= x.distance.isfinite() & ((x.normal - drop.normal).norm(dim=-1) < 1e-3)
    assert same.sum() >= 8
    for moving in ("a", "b"):
        xi = torch.zeros(60, 6, dtype=torch.float64, requires_grad=True)
        T = {"a": T_a, "b": T_b} | {moving: se3.retract({"a": T_a, "b": T_b}[moving], xi)}
        value = drop_distance(T["a"], T["b"], PARTS, pairs, gravity, limit=2.0).distance
        gradient, = torch.autograd.grad(value[same].sum(), xi)
        if moving == "b":
            moved = (se3.retract(T_b, x.expand(60, 6)) for x in steps)
            around = [drop_distance(T_a, T, PARTS, pairs, gravity, limit=2.0) for T in moved]
        difference = torch.stack([(around[i].distance - around[i + 6].distance) / 2e-5 for i in range(6)], dim=1)
        torch.testing.assert_close(gradient[same], difference[same], atol=2e-3, rtol=2e-3)


def shelf(height, x=0.0, **kwargs):
    """A box that falls along +z onto a table ``height`` below it."""
    T_a, T_b = EYE.clone(), EYE.clone()
    T_b[0, 3], T_b[2, 3] = x, 0.03 + height
    args = (T_a[None].requires_grad_(), T_b[None], BOXES, torch.tensor([[0, 1]]), DOWN[None])
    return args[0], drop_distance(*args, **{"limit": 1.0} | kwargs)


@pytest.mark.parametrize("height", [0.5, 1e-2, 1e-6, 1e-10])
def test_a_box_falls_straight_onto_a_table(height):
    T, drop = shelf(height)
    assert float(drop.distance.detach()) == pytest.approx(height, abs=2e-9)
    torch.testing.assert_close(drop.normal[0], DOWN, atol=1e-9, rtol=0.0)
    drop.distance.sum().backward()
    torch.testing.assert_close(T.grad[0, :3, 3], -DOWN, atol=1e-9, rtol=0.0)


def test_what_touches_or_overlaps_drops_by_nothing():
    for height in (0.0, -1e-9, -5e-3):
        assert float(shelf(height)[1].distance.detach()) == 0.0
    T, drop = shelf(-5e-3)
    drop.distance.sum().backward()
    assert (T.grad == 0).all()  # it is nought all around


def test_what_misses_or_is_beyond_the_limit_falls_for_ever():
    for height, kwargs in ((0.1, {"x": 0.6}), (-0.2, {}), (0.3, {"limit": 0.29})):
        T, drop = shelf(height, **kwargs)
        assert float(drop.distance.detach()) == math.inf
        drop.distance.nan_to_num(posinf=0.0).sum().backward()
        assert T.grad is None or (T.grad == 0).all()
    assert float(shelf(0.3, limit=0.31)[1].distance.detach()) == pytest.approx(0.3)


def test_a_grazing_drop_has_a_bounded_gradient():
    """Sliding down along a wall: n·g = 0."""
    T_a, T_b = EYE[None].clone().requires_grad_(), EYE[None].clone()
    T_b[0, 0, 3] = 0.1
    drop = drop_distance(T_a, T_b, BOXES, torch.tensor([[0, 0]]), DOWN[None], limit=1.0)
    assert float(drop.distance.detach()) in (0.0, math.inf)
    drop.distance.nan_to_num(posinf=0.0).sum().backward()
    assert T_a.grad.isfinite().all()
    assert float(T_a.grad.abs().max()) <= 1.0 / autograd.GRAZING


def test_result_is_a_named_tuple_in_the_callers_dtype():
    T, drop = shelf(0.1, smoothing=Smoothing())
    assert isinstance(drop, DistanceResult)
    T32 = T.detach().float()
    out = drop_distance(T32, T32 @ EYE.float(), BOXES, torch.tensor([[0, 1]]), DOWN[None].float(), limit=1.0)
    assert all(x.dtype == torch.float32 for x in out)


def test_oracle_knows_two_cubes():
    """The oracle's own anchor: what it says about cubes is known without it."""
    vertices, faces = (x.numpy() for x in ConvexParts.from_hulls([box(0.5, 0.5, 0.5)]).part(0))
    for shift, distance in (((1.5, 0, 0), 0.5), ((1.3, 1.4, 0), 0.5), ((0.9, 0.2, 0), -0.1), ((1, 0, 0), 0.0)):
        found = oracle_distance(vertices, faces, vertices + np.array(shift), faces)[0]
        assert found == pytest.approx(distance, abs=1e-12)
    down = np.array([0.0, 0.0, -1.0])
    assert oracle_drop(vertices + np.array([0.3, 0, 3]), faces, vertices, faces, down) == pytest.approx(2.0, abs=1e-9)
    assert oracle_drop(vertices + np.array([1.3, 0, 3]), faces, vertices, faces, down) == np.inf
