"""Half-spaces: exact in closed form, differentiable in poses and plane."""

import pytest
import torch
from helpers import assert_camera_frame_invariant, random_poses, zoo

from physpose_torch import se3
from physpose_torch.config import Smoothing
from physpose_torch.distance.plane import half_space_distance, plane_distance
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Plane
from physpose_torch.geometry.convex import ConvexParts

PARTS = zoo(n_random=4)
P = PARTS.n_parts
UP = torch.nn.functional.normalize(torch.tensor([0.2, -0.9, -0.4], dtype=torch.float64), dim=0)
PLANE = Plane(UP, torch.tensor(0.02, dtype=torch.float64))
SMOOTHINGS = [None, Smoothing("gaussian"), Smoothing("gumbel"), Smoothing("ring"), Smoothing("pose")]


@pytest.mark.parametrize("smoothing", SMOOTHINGS, ids=lambda s: "hard" if s is None else s.kind)
def test_distance_is_that_of_the_lowest_vertex_whatever_the_smoothing(smoothing):
    T = random_poses(P, seed=1)
    out = plane_distance(T, PARTS, PLANE, smoothing=smoothing)
    expected = torch.stack([(se3.apply(T[p], PARTS.part(p)[0]) @ UP).min() - 0.02 for p in range(P)])
    assert (expected < 0).any()
    assert (expected > 0).any()
    torch.testing.assert_close(out.distance, expected, atol=1e-14, rtol=0.0)
    torch.testing.assert_close(out.normal, -UP.expand(P, 3))
    torch.testing.assert_close(out.point_b - out.point_a, out.distance[:, None] * out.normal, atol=1e-14, rtol=0.0)
    torch.testing.assert_close(out.point_b @ UP, torch.full((P,), 0.02, dtype=torch.float64), atol=1e-14, rtol=0.0)


def test_gradient_is_that_of_the_distance_in_poses_and_plane():
    T = random_poses(P, seed=2)
    xi = torch.zeros(P, 6, dtype=torch.float64, requires_grad=True)
    normal = (1.0 * UP).requires_grad_()
    offset = torch.tensor(0.02, dtype=torch.float64, requires_grad=True)

    def distance(xi, normal, offset):
        plane = Plane(torch.nn.functional.normalize(normal, dim=0), offset)
        return plane_distance(se3.retract(T, xi), PARTS, plane).distance

    assert torch.autograd.gradcheck(distance, (xi, normal, offset), eps=1e-7, atol=1e-6)


def test_gradient_is_the_outer_product_of_normal_and_smoothed_point():
    """Under smoothing the gradient is that of the plane distance of a convex combination of the vertices."""
    T = random_poses(P, seed=2).requires_grad_()
    smoothing = Smoothing("ring")
    distance = plane_distance(T, PARTS, PLANE, smoothing=smoothing).distance
    gradient, = torch.autograd.grad(distance.sum(), T)
    torch.testing.assert_close(gradient[:, :3, 3], UP.expand(P, 3))
    local = torch.einsum("pij,i->pj", gradient[:, :3, :3], UP)  # n ⊗ x, so nᵀ(n ⊗ x) = x
    torch.testing.assert_close(gradient[:, :3, :3], UP[:, None] * local[:, None], atol=1e-14, rtol=0.0)
    outside = (PARTS.face_normals @ local[:, :, None])[:, :, 0] - PARTS.face_offsets
    assert outside.max() < 1e-12


def test_smoothing_without_noise_is_hard():
    T = random_poses(P, seed=3)
    hard = gradient_of(T, None)
    for smoothing in (
        Smoothing("gumbel", temperature=1e-9), Smoothing("ring", noise=1e-9), Smoothing("gaussian", noise=1e-9)
    ):
        torch.testing.assert_close(gradient_of(T, smoothing), hard, atol=1e-9, rtol=0.0)


def gradient_of(T, smoothing):
    T = T.clone().requires_grad_()
    return torch.autograd.grad(plane_distance(T, PARTS, PLANE, smoothing=smoothing).distance.sum(), T)[0]


def test_a_plane_is_a_very_large_box():
    """The smoothed gradient of a body on a plane is that of the same body on a slab that reaches far."""
    from helpers import box

    from physpose_torch.distance.autograd import signed_distance

    parts = ConvexParts.from_hulls([box(0.05, 0.03, 0.02), box(5.0, 5.0, 0.1)])
    T = random_poses(1, spread=0.0)
    T[0, :3, :3] = se3.exp_so3(torch.tensor([0.03, -0.02, 0.4], dtype=torch.float64))
    T_slab = torch.eye(4, dtype=torch.float64)[None].clone()
    T_slab[:, 2, 3] = -0.1
    up = Plane(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64))
    T[0, 2, 3] = -float(plane_distance(T, ConvexParts.from_hulls([box(0.05, 0.03, 0.02)]), up).distance) - 1e-3
    T.requires_grad_()
    for smoothing in (None, Smoothing("ring"), Smoothing("gumbel"), Smoothing("gaussian")):
        one = plane_distance(T, ConvexParts.from_hulls([box(0.05, 0.03, 0.02)]), up, smoothing=smoothing).distance
        other = signed_distance(T, T_slab, parts, torch.tensor([[0, 1]]), smoothing=smoothing).distance
        torch.testing.assert_close(one, other, atol=1e-12, rtol=0.0)
        (g_one,), (g_other,) = (torch.autograd.grad(d.sum(), T) for d in (one, other))
        torch.testing.assert_close(g_one, g_other, atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_moving_the_camera_changes_nothing(dtype):
    T = random_poses(P, seed=4)

    def compute(X):
        down = X[:3, :3] @ UP
        plane = Plane(down, PLANE.offset + down @ X[:3, 3])
        return plane_distance((X @ T).to(dtype), PARTS, plane).distance.double()

    assert_camera_frame_invariant(compute, atol=1e-12 if dtype == torch.float64 else 2e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_pairs_one_by_one_are_any_parts_and_planes_in_any_order(count, dtype):
    index = torch.randint(P, (count,), generator=torch.Generator().manual_seed(0))
    T = random_poses(count, seed=5).to(dtype)
    normal = torch.nn.functional.normalize(random_poses(count, seed=6)[:, :3, 0], dim=-1).to(dtype)
    offset = torch.linspace(-0.1, 0.1, count, dtype=dtype)
    out = half_space_distance(T, PARTS, index, normal, offset, smoothing=Smoothing())
    assert all(x.dtype == dtype and len(x) == count for x in out)
    for k in range(count):
        vertices = se3.apply(T[k].double(), PARTS.part(int(index[k]))[0])
        lowest = (vertices @ normal[k].double()).min() - offset[k].double()
        assert float(out.distance[k]) == pytest.approx(float(lowest), abs=1e-6 if dtype == torch.float32 else 1e-14)


def test_autocast_costs_no_precision():
    T = random_poses(P).float()
    expected = plane_distance(T, PARTS, PLANE, smoothing=Smoothing()).distance
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(plane_distance(T, PARTS, PLANE, smoothing=Smoothing()).distance, expected)


def test_one_pose_for_each_part_is_asked_for():
    with pytest.raises(InvalidInputError, match=f"expected \\({P}, 4, 4\\)"):
        plane_distance(random_poses(2), PARTS, PLANE)
