"""An ellipsoid in a picture holds what the covariance says it holds, and its axes point where the covariance's do."""

import math

import numpy as np
import pytest
import torch

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.viz import pose_ellipsoids
from physpose_torch.viz.ellipsoids import UNSURE, draw_ellipsoids, seen_by, swaying_axes
from physpose_torch.viz.scene import FAR, SceneView, orthographic

K = torch.tensor([[500.0, 0, 160], [0, 480.0, 120], [0, 0, 1]], dtype=torch.float64)
CAMERA = SceneView(torch.eye(4, dtype=torch.float64), K, 240, 320)
ROLL = se3.exp_so3(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64))


def pose(x=0.05, y=-0.04, z=0.8):
    return se3.from_rotation_translation(ROLL, torch.tensor([x, y, z], dtype=torch.float64))[None]


def covariance(sigmas=(0.03, 0.01, 0.004), R=ROLL, rotation=(0.04, 0.02, 0.01)):
    C = torch.zeros(1, 6, 6, dtype=torch.float64)
    C[0, :3, :3] = R @ torch.diag(torch.tensor(sigmas, dtype=torch.float64) ** 2) @ R.T
    C[0, 3:, 3:] = torch.diag(torch.tensor(rotation, dtype=torch.float64) ** 2)
    return C


def directions(n=2000):
    u = torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(u, dim=1)


def test_half_axes_are_the_covariances_principal_axes_longest_first():
    ellipsoid = pose_ellipsoids(pose(), covariance(), sigmas=2.0)
    axes = ellipsoid.half_axes[0]
    torch.testing.assert_close(axes.norm(dim=0), torch.tensor([0.06, 0.02, 0.008], dtype=torch.float64))
    torch.testing.assert_close((axes / axes.norm(dim=0) * ROLL).sum(0).abs(), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(ellipsoid.center, pose()[:, :3, 3])


def test_two_sigma_hold_three_quarters_of_gaussian_errors():
    C = covariance()
    draws = torch.linalg.cholesky(C[0, :3, :3]) @ torch.randn(
        3, 40000, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    inside = torch.linalg.solve(pose_ellipsoids(pose(), C).half_axes[0], draws).norm(dim=0) <= 1
    assert float(inside.double().mean()) == pytest.approx(0.7385, abs=0.01)


@pytest.mark.parametrize("view", ["perspective", "orthographic"])
def test_the_outline_is_that_of_the_projected_surface(view):
    if view == "orthographic":
        x, down = torch.tensor([[1.0, 0, 0], [0, 0, -1.0]], dtype=torch.float64)
        low, high = torch.tensor([[-0.2, -1.0], [0.3, -0.6]], dtype=torch.float64)
        camera = orthographic(x, down, low, high, 900.0)
    else:
        camera = CAMERA
    ellipsoid = pose_ellipsoids(pose(), covariance())
    ellipse = seen_by(ellipsoid, camera)
    assert ellipse.seen.all()
    surface = ellipsoid.center + directions() @ ellipsoid.half_axes[0].T
    pixels = camera.project(surface)[0]
    reach = torch.linalg.solve(ellipse.half_axes[0], (pixels - ellipse.center).T).norm(dim=0)
    assert float(reach.max()) == pytest.approx(1.0, abs=2e-3)  # all inside, and some on the border
    assert float(reach.max()) <= 1 + 1e-6
    around = torch.atan2(*(pixels - ellipse.center).T.flip(0))
    rim = reach > 0.97
    assert len(torch.histc(around[rim], 12, -math.pi, math.pi).nonzero()) == 12  # on all sides
    if view == "orthographic":
        assert camera.T_view_table[2, 3] == FAR


def test_what_is_not_wholly_in_front_of_the_camera_is_not_drawn():
    poses = torch.cat([pose(z=0.8), pose(z=0.03), pose(z=-0.8)])
    C = covariance().repeat(3, 1, 1)
    assert seen_by(pose_ellipsoids(poses, C), CAMERA).seen.tolist() == [True, False, False]
    blank = np.ones((240, 320, 3))
    assert (draw_ellipsoids(blank, poses[1:], C[1:], CAMERA) == blank).all()


def test_the_drawn_ellipse_is_as_long_and_as_turned_as_the_covariance():
    canvas = draw_ellipsoids(np.ones((240, 320, 3)), pose(0, 0), covariance((0.03, 0.006, 1e-4), _about_z(30)), CAMERA)
    y, x = np.nonzero(canvas[..., 1] < 0.8)
    spread = np.cov(np.stack([x / 500, y / 480]))
    variance, axes = np.linalg.eigh(spread)
    assert math.degrees(math.atan2(axes[1, 1], axes[0, 1])) % 180 == pytest.approx(30, abs=1.5)
    assert 2 * math.sqrt(variance[1]) == pytest.approx(0.06 / 0.8, rel=0.06)  # a filled ellipse has σ = half axis / 2
    assert np.array([x.mean(), y.mean()]) == pytest.approx([160, 120], abs=0.6)


def test_covariances_of_the_camera_frame_are_turned_with_it_into_the_tables():
    """Through the table's frame it is the same picture."""
    T = se3.from_rotation_translation(_about_z(70), torch.tensor([0.2, 0.3, -0.1], dtype=torch.float64))
    moved = SceneView(se3.inverse(T), K, 240, 320)
    blank = np.ones((240, 320, 3))
    there = draw_ellipsoids(blank, pose(), covariance(), moved, T_frame=T, radius=torch.tensor([0.05]))
    here = draw_ellipsoids(blank, pose(), covariance(), CAMERA, radius=torch.tensor([0.05]))
    assert (here != blank).any()
    np.testing.assert_allclose(there, here, atol=0.05)


def test_tips_sway_as_far_as_the_rotation_turns_them():
    """To first order: where draws of the rotation take the tips has the covariance of the ellipsoids."""
    C, length = covariance(rotation=(0.05, 0.02, 0.01)), torch.tensor([0.1], dtype=torch.float64)
    axes, tips = swaying_axes(pose(), C, length, sigmas=1.0)
    xi = torch.randn(40000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    turned = ROLL @ se3.exp_so3(xi * C[0, 3:, 3:].diagonal().sqrt())
    for k in range(3):
        torch.testing.assert_close(axes[k, 1], pose()[0, :3, 3] + 0.1 * ROLL[:, k])
        drawn = torch.cov((0.1 * turned[:, :, k]).T)
        torch.testing.assert_close(drawn, tips.half_axes[k] @ tips.half_axes[k].T, atol=3e-7, rtol=0.03)
        assert float(tips.half_axes[k].norm(dim=0).min()) < 1e-9  # flat


def test_bad_covariances_are_named():
    with pytest.raises(InvalidInputError, match=r"covariance has shape \(1, 3, 3\), expected finite \(1, 6, 6\)"):
        pose_ellipsoids(pose(), covariance()[:, :3, :3])
    with pytest.raises(InvalidInputError, match="negative variance"):
        pose_ellipsoids(pose(), -covariance())
    with pytest.raises(InvalidInputError, match="sigmas"):
        pose_ellipsoids(pose(), covariance(), sigmas=0)
    with pytest.raises(InvalidInputError, match="poses has shape"):
        pose_ellipsoids(pose()[0], covariance())


def test_uncertainty_is_not_red():
    r, g, b = (int(UNSURE[k : k + 2], 16) for k in (1, 3, 5))
    assert b > r > g


def _about_z(degrees):
    return se3.exp_so3(torch.tensor([0, 0, math.radians(degrees)], dtype=torch.float64))
