"""Rigid motions, pose errors, pictures, tables and robots at all scales: finite, in the caller's dtype, exact to rounding."""

import math

import numpy as np
import pytest
import roma
import torch
from extremes import DTYPES, bodies, directions, hunted, poses, powers, ranges, rotations, sizes, turns, units
from hypothesis import given
from hypothesis import strategies as st

from physpose_torch import se3
from physpose_torch.alternatives import find_alternatives
from physpose_torch.bop.pose_error import mspd, mssd
from physpose_torch.bop.vsd import vsd
from physpose_torch.config import PhysicsConfig
from physpose_torch.contacts import Contacts, Drops
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.losses import collision_loss, gravity_loss, pose_covariance, pose_loss
from physpose_torch.render import render
from physpose_torch.robot.arm import LOOK_ALONG, demo_arm
from physpose_torch.robot.environment import RobotEnvironment
from physpose_torch.scene import Scene
from physpose_torch.table.alignment import Located
from physpose_torch.table.homography import plane_from_homography
from physpose_torch.table.ransac import ransac_plane, ransac_scale
from physpose_torch.table.view import pixel_rays, project

K = torch.tensor([[600.0, 0, 31.5], [0, 600.0, 23.5], [0, 0, 1]], dtype=torch.float64)


def eps(dtype) -> float:
    return torch.finfo(dtype).eps


@hunted(60)
@given(turn=turns, small=st.sampled_from([1.0, 1e-3, 1e-8, 1e-16, 0.0]), dtype=st.sampled_from(DTYPES))
def test_rotation_vectors_come_back_from_rotations(turn, small, dtype):
    """Near π a rotation knows its axis and its sign no better than by the root of eps."""
    w = small * torch.tensor(turn, dtype=torch.float64)
    angle = float(w.norm())
    w = (w * (min(angle, 3.1) / angle if angle else 1.0)).to(dtype)
    R = se3.exp_so3(w)
    assert R.dtype == dtype
    assert float((R.double() - roma.rotvec_to_rotmat(w.double())).abs().max()) < 16 * eps(dtype)
    back = se3.log_so3(R)
    assert float((back.double() - w.double()).abs().max()) < 64 * eps(dtype)
    J = se3.right_jacobian_inverse(w)
    assert bool(J.isfinite().all())
    step = 1e-6 * torch.eye(3, dtype=torch.float64)
    moved = [se3.log_so3(roma.rotvec_to_rotmat(w.double()) @ se3.exp_so3(s * d)) for d in step for s in (1, -1)]
    slope = torch.stack([(a - b) / 2e-6 for a, b in zip(moved[::2], moved[1::2], strict=True)], dim=1)
    assert float((J.double() - slope).abs().max()) < 1e-3 if float(w.norm()) < 3.0 else True


@hunted(40)
@given(T=poses(3, 1.0), xi=st.tuples(units, units), dtype=st.sampled_from(DTYPES))
def test_motions_and_their_inverses_cancel_to_rounding(T, xi, dtype):
    T = T.to(dtype)
    xi = torch.tensor([*xi[0], *xi[1]], dtype=dtype).expand(3, 6)
    size = torch.linalg.vector_norm(T[:, :3, 3].double(), dim=1) + 4
    eye = (se3.inverse(T) @ T).double() - torch.eye(4, dtype=torch.float64)
    assert bool((eye.abs().amax((1, 2)) <= 16 * eps(dtype) * size).all())
    moved = se3.retract(T, xi)
    se3.check_rigid(moved, "moved")
    back = se3.residual(moved, T)
    assert back.dtype == dtype
    assert bool(((back[:, :3] - xi[:, :3]).abs().double().amax(1) <= 4 * eps(dtype) * size).all())
    assert float((back[:, 3:] - xi[:, 3:]).abs().max()) <= 64 * eps(dtype)
    x = torch.tensor([[1.0, -2.0, 0.5]], dtype=dtype)
    error = (se3.apply(se3.inverse(T), se3.apply(T, x)) - x).double().abs().amax((1, 2))
    assert bool((error <= 32 * eps(dtype) * size).all())


@hunted(30)
@given(T=poses(2, 1.0), xi=st.tuples(units, units), sigma=powers(-6, 3), dtype=st.sampled_from(DTYPES))
def test_pose_costs_are_half_the_squared_mahalanobis_distance(T, xi, sigma, dtype):
    """In relation to how far the poses are from each other, not from the camera; gradients finite."""
    T = T.to(dtype)
    moved = se3.retract(T, torch.tensor([*xi[0], *xi[1]], dtype=dtype).expand(2, 6)).requires_grad_()
    precision = torch.eye(6, dtype=dtype).expand(2, 6, 6) / sigma**2
    cost = pose_loss(moved, T, precision)
    (gradient,) = torch.autograd.grad(cost.sum(), moved)
    assert cost.dtype == dtype
    assert bool(gradient.isfinite().all())
    t = (moved.detach() - T)[:, :3, 3].double()
    w = roma.rotmat_to_rotvec(T[:, :3, :3].double().mT @ moved.detach()[:, :3, :3].double())
    expected = 0.5 * ((t**2).sum(1) + (w**2).sum(1)) / sigma**2
    assert bool(((cost.double() - expected).abs() <= 1e3 * eps(dtype) * (1 + (t**2).sum(1)) / sigma**2).all())


@hunted(30)
@given(T=poses(2, 1.0), dtype=st.sampled_from(DTYPES))
def test_covariances_of_estimates_are_finite_and_longest_along_the_ray(T, dtype):
    config = PhysicsConfig()
    covariance = pose_covariance(T.to(dtype), torch.zeros(2, 3, dtype=dtype), config)
    assert covariance.dtype == dtype
    assert bool(covariance.isfinite().all())
    trace = covariance[:, :3, :3].double().diagonal(dim1=1, dim2=2).sum(1)
    distance = torch.linalg.vector_norm(T.to(dtype)[:, :3, 3].double(), dim=1)
    ray = (0.01 * distance).clamp(1e-3 * 0.002, 1e5 * 0.002)
    there = distance > 1e-11  # what is in the camera is in no direction
    torch.testing.assert_close(trace[there], 2 * 0.002**2 + ray[there] ** 2, rtol=32 * eps(dtype), atol=1e-12)


@hunted(30)
@given(depth=st.lists(powers(-9, 9), min_size=1, max_size=5), signs=st.integers(0, 31), dtype=st.sampled_from(DTYPES))
def test_sums_of_depths_and_heights_are_what_they_are(depth, signs, dtype):
    """Two bodies with these part distances; an object at this height."""
    d = torch.tensor([x * (-1) ** (signs >> i & 1) for i, x in enumerate(depth)], dtype=dtype)
    zero, one, yes = torch.zeros(1, dtype=torch.long), torch.ones(1, dtype=torch.long), torch.ones(1, dtype=torch.bool)
    contacts = Contacts(d, torch.zeros(len(d), dtype=torch.long), zero, one, yes, yes, torch.zeros(1, dtype=dtype))
    printed, share = collision_loss(contacts, 2)
    inside = -d[d < 0].double()
    expected = float(inside.mean()) if len(inside) else 0.0
    assert printed.dtype == dtype
    assert float(share.double().sum()) == pytest.approx(expected, rel=16 * eps(dtype))
    for height, cost in ((float(d.abs()[0]), float(d.abs()[0])), (math.inf, 0.0)):
        drops = Drops(torch.tensor([height], dtype=dtype), zero, ~yes, torch.zeros(1, dtype=dtype))
        assert float(gravity_loss(drops)) == pytest.approx(cost, rel=4 * eps(dtype))


@hunted(30)
@given(T=poses(2, 1.0), size=sizes, seed=st.integers(0, 99), dtype=st.sampled_from(DTYPES))
def test_pose_errors_are_relative_to_the_object(T, size, seed, dtype):
    """MSSD knows how far apart the poses are to rounding, wherever both are; MSPD is finite, or infinite beside the camera."""
    T = T.to(dtype)
    points = size * torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(dtype)
    eye = torch.eye(4, dtype=dtype)[None]
    found = mssd(T[:1], T[1:], points, eye)
    exact = (T[0] - T[1]).numpy().astype(np.longdouble)
    expected = np.linalg.norm(
        (points.numpy().astype(np.longdouble) @ exact[:3, :3].T + exact[:3, 3]).astype(float), axis=1
    ).max()
    reach = float(torch.linalg.vector_norm((T[0] - T[1])[:3, 3].double())) + 5 * size
    assert found.dtype == dtype
    assert abs(float(found[0]) - expected) <= 32 * eps(dtype) * reach
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=dtype))[None]
    assert float(mssd(T[:1], T[1:], points, torch.cat([eye, half_turn]))[0]) <= float(found[0])
    pixels = mspd(T[:1], T[1:], K.to(dtype)[None], points, eye)
    assert float(pixels[0]) >= 0
    assert float(mspd(T[:1], T[:1], K.to(dtype)[None], points, eye)[0]) in (0.0, math.inf)


def test_an_mspd_beyond_all_numbers_is_infinite():
    T = torch.eye(4, dtype=torch.float32)[None].clone()
    beside = T.clone()
    T[:, 2, 3], beside[:, 0, 3], beside[:, 2, 3] = 1.0, 1e9, 1e-38
    points = torch.zeros(1, 3)
    assert float(mspd(T, beside, K.float()[None], points, torch.eye(4)[None])[0]) == math.inf


@hunted(25)
@given(data=st.data(), size=sizes, away=ranges, up=directions, dtype=st.sampled_from(DTYPES))
def test_pictures_of_anything_anywhere_are_finite_and_repeat(data, size, away, up, dtype):
    """Pixels show depths that the object has, to rounding; what is behind the camera shows nothing."""
    body = data.draw(bodies(size))
    T = data.draw(poses(1, size, st.just(away)))[0]
    vertices = se3.apply(T, torch.as_tensor(np.asarray(body.mesh.vertices))).to(dtype)
    faces = torch.as_tensor(np.asarray(body.mesh.faces))
    drawn, again = (render(vertices, faces, K, 48, 64) for _ in range(2))
    assert all(torch.equal(x, y) for x, y in zip(drawn, again, strict=True))
    assert drawn.depth.dtype == drawn.barycentric.dtype == dtype
    assert bool(drawn.depth.isfinite().all())
    assert bool(drawn.barycentric.isfinite().all())
    seen = drawn.face_id >= 0
    z = vertices[:, 2].double()
    slack = 16 * eps(dtype) * float(z.abs().max())
    assert bool((drawn.depth[seen].double() >= max(float(z.min()), 1e-3) - slack).all())
    assert bool((drawn.depth[seen].double() <= float(z.max()) + slack).all())
    if float(z.max()) < 1e-3:
        assert not bool(seen.any())


@hunted(20)
@given(size=sizes, away=powers(-2, 9), dtype=st.sampled_from(DTYPES))
def test_a_wall_is_seen_at_its_depth_at_any_distance(size, away, dtype):
    z = away + size
    corners = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64) * z
    vertices = (corners + torch.tensor([0.0, 0.0, z], dtype=torch.float64)).to(dtype)
    drawn = render(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), K, 48, 64)
    assert bool((drawn.face_id >= 0).all())
    assert float((drawn.depth.double() - float(vertices[0, 2])).abs().max()) <= 16 * eps(dtype) * z
    assert float((drawn.barycentric.double().sum(-1) - 1).abs().max()) <= 8 * eps(dtype)


@hunted(8)
@given(T=poses(2, 1.0), size=sizes)
def test_visible_surface_discrepancies_are_shares(T, size):
    mesh = Body.box([size, size, size], label="box").mesh
    arguments = (
        torch.zeros(48, 64),
        K,
        torch.as_tensor(np.asarray(mesh.vertices)),
        torch.as_tensor(np.asarray(mesh.faces)),
    )
    found, again = (vsd(T, T, *arguments, 2 * size) for _ in range(2))
    assert np.array_equal(found, again)
    assert bool(((found >= 0) & (found <= 1)).all())


@hunted(30)
@given(up=directions, size=sizes, away=ranges, seed=st.integers(0, 999))
def test_planes_through_points_are_found_wherever_they_are(up, size, away, seed):
    """Its normal is as good as the points' spread, its offset to rounding of where they are."""
    generator = torch.Generator().manual_seed(seed)
    points = size * (torch.rand(60, 3, generator=generator, dtype=torch.float64) - 0.5)
    base = away * torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    points = points - (points @ up)[:, None] * up
    outliers = size * torch.randn(20, 3, generator=generator, dtype=torch.float64)
    cloud = torch.cat([points, outliers]) + base
    rounded = torch.finfo(torch.float64).eps * (away + size)
    tolerance = max(1e-6 * size, 8 * rounded)
    found, info = ransac_plane(cloud, tolerance=tolerance)
    if tolerance > 1e-3 * size:  # beyond 1e12 sizes there is no plane left
        assert found is None or bool(found[0].isfinite().all())
        return
    normal, offset = found
    assert bool(info.inliers[:60].all())
    assert float(torch.linalg.cross(normal, up).norm()) < 50 * tolerance / size
    assert abs(float(offset - normal @ base)) < 100 * tolerance


@hunted(20)
@given(size=sizes, factor=powers(-6, 6), away=powers(-3, 3), seed=st.integers(0, 999))
def test_scales_are_found_whatever_the_units(size, factor, away, seed):
    generator = torch.Generator().manual_seed(seed)
    source = away + size * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    owner = torch.arange(40) % 3
    found, info = ransac_scale(source, factor * source, owner, tolerance=0.01)
    rounded = torch.finfo(torch.float64).eps * (1 + away / size)
    assert float(found) == pytest.approx(factor, rel=max(1e-12, 1e3 * rounded))
    assert bool(info.inliers.all())


@hunted(8)
@given(size=powers(-2, 2), tilt=st.floats(0.3, 1.0), seed=st.integers(0, 99))
def test_a_homography_tells_its_plane_in_units_of_the_baseline(size, tilt, seed):
    """The same picture of a table a centimetre or a hundred metres away: only the unit differs."""
    camera = torch.tensor([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]], dtype=torch.float64)
    up = torch.tensor([0.0, -math.cos(tilt), -math.sin(tilt)], dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.rand(80, 2, generator=generator, dtype=torch.float64) * torch.tensor([600.0, 400.0]) + 20
    rays = pixel_rays(camera, pixels)
    offset = -size
    below = rays @ up < -0.1
    points = rays[below] * (offset / (rays[below] @ up))[:, None]
    motion = se3.from_rotation_translation(
        se3.exp_so3(torch.tensor([0.02, 0.1, 0.01], dtype=torch.float64)),
        size * torch.tensor([0.2, -0.02, 0.05], dtype=torch.float64),
    )
    matches = Located(
        pixels[below],
        project(camera, se3.apply(motion, points)),
        0.01 * torch.eye(2, dtype=torch.float64).expand(len(points), 2, 2),
    )
    found, _ = plane_from_homography(motion, camera, camera, matches)
    normal, at, covariance = found
    assert float(torch.linalg.cross(normal, up).norm()) < 1e-6
    assert float(at) == pytest.approx(offset, rel=1e-6)
    assert bool((torch.linalg.eigvalsh(covariance) > 0).all())


@hunted(25)
@given(T=poses(4, 0.1), size=sizes)
def test_alternatives_are_the_same_ones_far_from_the_camera(T, size):
    """Where the difference of the poses is exact; who is an alternative of whom does not hang on where the camera is."""
    body = Body.box([size, size / 2, size / 3], label="box")
    near = T.clone()
    near[:, :3, 3] -= T[0, :3, 3]
    scores = torch.tensor([0.9, 0.8, 0.7, 0.6], dtype=torch.float64)
    # lengths near those that decide may be rounded to either side
    if float(T[:, :3, 3].abs().max()) * 1e-15 < 1e-9 * size:
        assert torch.equal(*(find_alternatives(x, Scene([body] * 4), scores) for x in (T, near)))
    found = find_alternatives(T[:1].expand(4, 4, 4), Scene([body] * 4), scores)
    assert found.tolist() == [0, 0, 0, 0]


@hunted(10)
@given(q=st.lists(st.floats(-0.3, 0.3), min_size=8, max_size=8), away=ranges, side=units, dtype=st.sampled_from(DTYPES))
def test_a_camera_on_a_robot_is_where_its_joints_say(arm, q, away, side, dtype):
    """Also if its mount is given as absurdly far off: finite, rigid, and back again."""
    q = torch.tensor(q, dtype=dtype) + torch.tensor(LOOK_ALONG, dtype=dtype)
    limits = arm.limits.to(dtype)
    q = q.clamp(limits[:, 0], limits[:, 1]).requires_grad_()
    mount = se3.from_rotation_translation(torch.eye(3, dtype=dtype), away * torch.tensor(side, dtype=dtype))
    T = arm.camera_pose(q, T_link_camera=mount)
    assert T.dtype == dtype
    se3.check_rigid(T, "camera")
    expected = arm.camera_pose(q.double()) @ mount.double()
    size = 2 + float(mount[:3, 3].double().norm())
    assert float((T.double() - expected).abs().max()) <= 64 * eps(dtype) * size
    statics, gravity = arm(q, T_link_camera=mount)
    assert gravity.dtype == dtype
    assert all(bool(s.T_camera_body.isfinite().all()) for s in statics if s.T_camera_body is not None)
    (slope,) = torch.autograd.grad(sum(s.T_camera_body.sum() for s in statics if s.T_camera_body is not None), q)
    assert bool(slope.isfinite().all())


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    table = Plane(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64))
    urdf = demo_arm(tmp_path_factory.mktemp("robot") / "arm.urdf")
    return RobotEnvironment.from_urdf(urdf, camera_link="camera", table=table, ignore_links=["camera"])


@hunted(20)
@given(T=poses(1, 1.0), R=rotations(), size=sizes, dtype=st.sampled_from(DTYPES))
def test_parts_and_planes_keep_dtype_and_values(T, R, size, dtype):
    body = Body.box([size, size / 2, size / 4], label="box")
    parts = ConvexParts.cat([body.parts, body.parts]).to(dtype)
    assert parts.dtype == dtype
    assert float((parts.upper.double() - body.upper).abs().max()) <= eps(dtype) * size
    assert float((torch.linalg.vector_norm(parts.face_normals.double(), dim=-1) - 1).abs().max()) <= 4 * eps(dtype)
    table = se3.from_rotation_translation(R.to(dtype), T[0, :3, 3].to(dtype))
    plane = Plane.from_pose(table)
    assert plane.normal.dtype == dtype
    exact = float(table[:3, 2].double() @ table[:3, 3].double())
    assert abs(float(plane.offset) - exact) <= 8 * eps(dtype) * float(table[:3, 3].double().norm())
