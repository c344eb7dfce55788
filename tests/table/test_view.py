"""A view takes images as they come, and says what is wrong with a camera, a pose or a depth map; pixels and rays."""

import numpy as np
import pytest
import torch
from helpers import random_poses

from physpose_torch.errors import InvalidInputError
from physpose_torch.table.matching import Sift
from physpose_torch.table.view import View, pixel_rays, project

K = torch.tensor([[61.0, 0.0, 33.5], [0.0, 59.0, 22.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
IMAGE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def with_entry(matrix, row, column, value):
    out = matrix.clone()
    out[row, column] = value
    return out


@pytest.mark.parametrize("give", [torch.from_numpy, np.asarray, np.asfortranarray], ids=["tensor", "numpy", "fortran"])
def test_a_tensor_and_an_array_are_the_same_image(give):
    view = View(give(IMAGE), K)
    assert view.image.dtype == torch.uint8
    assert view.image.shape == (48, 64, 3)
    assert np.array_equal(view.image.numpy(), IMAGE)
    assert view.size == (48, 64)


def test_an_image_whose_channels_were_turned_round_is_taken_as_it_is():
    """``cv2.imread(path)[..., ::-1]`` is how most people come by RGB."""
    assert np.array_equal(View(IMAGE[..., ::-1], K).image.numpy(), IMAGE[..., ::-1])


def test_a_grey_image_becomes_one_of_three_equal_channels_that_opencv_takes():
    view = View(IMAGE[..., 0], K)
    assert view.image.shape == (48, 64, 3)
    assert all(np.array_equal(view.image[..., c].numpy(), IMAGE[..., 0]) for c in range(3))
    three = View(np.repeat(IMAGE[..., :1], 3, 2), K)
    assert torch.equal(Sift()(view.image).points, Sift()(three.image).points)


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (IMAGE / 255.0, "float64.*multiply by 255"),
        (torch.from_numpy(IMAGE).float(), "float32.*multiply by 255"),
        (IMAGE.astype(np.int64), "int64"),
        (IMAGE[..., :2], r"\(48, 64, 2\)"),
        (IMAGE.transpose(2, 0, 1), r"\(3, 48, 64\)"),
        (IMAGE[None], r"\(1, 48, 64, 3\)"),
        (IMAGE[:31], "64 x 31 px.*32"),
        ("photo.png", "str"),
    ],
    ids=["float64", "float32", "int64", "two channels", "channels first", "batch", "tiny", "path"],
)
def test_what_is_no_rgb_image_of_bytes_is_refused(image, says):
    with pytest.raises(InvalidInputError, match=rf"View\.image.*{says}"):
        View(image, K)


@pytest.mark.parametrize(
    "bad",
    [
        K[:2],
        K[None],
        with_entry(K, 1, 0, 0.5),
        with_entry(K, 2, 0, 1e-3),
        with_entry(K, 2, 2, 2.0),
        with_entry(K, 0, 0, -61.0),
        with_entry(K, 1, 1, 0.0),
        with_entry(K, 0, 2, torch.nan),
    ],
    ids=["2 x 3", "batch", "skew below", "projective", "scaled", "negative focal", "no focal", "NaN"],
)
def test_what_are_no_intrinsics_is_refused(bad):
    with pytest.raises(InvalidInputError, match=r"View\.K"):
        View(None, bad)


@pytest.mark.parametrize("entry", [(0, 2, 64.0), (1, 2, 48.5), (0, 2, -1.0)])
def test_intrinsics_of_a_larger_image_are_refused(entry):
    bad = with_entry(K, *entry)
    with pytest.raises(InvalidInputError, match=r"principal point.*64 x 48 px"):
        View(IMAGE, bad)
    View(None, bad)  # no image, no rule


@pytest.mark.parametrize(
    "give", [torch.Tensor.tolist, torch.Tensor.numpy, torch.Tensor.float], ids=["list", "numpy", "float32"]
)
def test_intrinsics_are_kept_as_float64(give):
    view = View(IMAGE, give(K))
    assert view.K.dtype == torch.float64
    assert torch.equal(view.K, K)
    assert torch.equal(View(IMAGE, with_entry(K, 0, 1, 0.7)).K[0], K.new_tensor([61.0, 0.7, 33.5]))  # skew is allowed


def test_poses_are_kept_and_measured_in_float64(dtype):
    poses = random_poses(3).to(dtype)
    view = View(IMAGE, K, poses)
    assert view.poses is poses
    assert view.measured.dtype == torch.float64
    assert torch.equal(view.measured, poses.double())
    assert View(IMAGE, K).measured is None
    assert View(IMAGE, K, poses.numpy()).measured.shape == (3, 4, 4)
    assert View(IMAGE, K, poses[:0]).measured.shape == (0, 4, 4)


def test_a_row_of_nan_is_an_object_that_was_not_seen():
    poses = random_poses(3)
    poses[1] = torch.nan
    measured = View(IMAGE, K, poses).measured
    assert measured.isfinite().flatten(1).all(1).tolist() == [True, False, True]
    assert View(IMAGE, K, torch.full((2, 4, 4), torch.nan)).measured.isnan().all()


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda T: T.index_put_((torch.tensor(1), torch.tensor(0), torch.tensor(3)), T.new_tensor(torch.nan)), "NaN"),
        (lambda T: T[..., :3, :3].mul_(1.1), "not rigid"),
        (lambda T: T[1, :3, 0].neg_(), "not rigid"),
        (lambda T: T[1].copy_(T[1].mT.clone()), "transposed"),
    ],
    ids=["one NaN", "scaled", "mirrored", "transposed"],
)
def test_a_pose_that_is_not_rigid_is_refused(spoil, says):
    poses = random_poses(3)
    spoil(poses)
    with pytest.raises(InvalidInputError, match=rf"View\.poses.*{says}"):
        View(IMAGE, K, poses)


def test_the_row_of_a_bad_pose_is_named_as_it_was_given():
    poses = random_poses(4)
    poses[0] = torch.nan
    poses[2, :3, :3] *= 1.1
    with pytest.raises(InvalidInputError, match=r"View\.poses\[2\]"):
        View(IMAGE, K, poses)


@pytest.mark.parametrize(
    "poses", [torch.eye(4), torch.eye(4)[None].long(), torch.eye(3)[None], torch.eye(4)[None, None]],
    ids=["one", "integers", "3 x 3", "two batches"],
)
def test_poses_of_another_shape_or_kind_are_refused(poses):
    with pytest.raises(InvalidInputError, match=r"View\.poses"):
        View(IMAGE, K, poses)


def test_depth_is_zero_where_it_is_not_known():
    depth = np.full((48, 64), 0.8, dtype=np.float32)
    depth[0, :4] = [np.nan, np.inf, -0.5, 0.0]
    view = View(IMAGE, K, depth=depth)
    assert view.depth.dtype == torch.float64
    assert view.depth[0, :5].tolist() == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.8])
    assert int((view.depth > 0).sum()) == 48 * 64 - 4


@pytest.mark.parametrize("shape", [(64, 48), (48, 64, 1), (24, 32)])
def test_depth_of_another_shape_than_the_image_is_refused(shape):
    with pytest.raises(InvalidInputError, match=r"View\.depth.*\(48, 64\)"):
        View(IMAGE, K, depth=torch.ones(shape))
    if len(shape) == 2:
        assert View(None, K, depth=torch.ones(shape)).depth.shape == shape  # no image, no rule


def test_without_an_image_the_principal_point_is_in_the_middle():
    assert View(None, K).size == (45, 68)


def test_pixel_rays_and_project_invert_each_other(dtype):
    generator = torch.Generator().manual_seed(0)
    skewed = with_entry(K, 0, 1, 0.3)
    pixels = (torch.rand(2, 5, 2, generator=generator, dtype=torch.float64) * 60).to(dtype)
    depth = (0.3 + torch.rand(2, 5, 1, generator=generator, dtype=torch.float64)).to(dtype)
    for intrinsics in (K, skewed):
        rays = pixel_rays(intrinsics, pixels)
        assert rays.dtype == dtype
        assert torch.equal(rays[..., 2], torch.ones(2, 5, dtype=dtype))
        atol = 1e-9 if dtype == torch.float64 else 1e-4
        torch.testing.assert_close(project(intrinsics, depth * rays), pixels, rtol=0, atol=atol)
        points = depth * rays
        torch.testing.assert_close(pixel_rays(intrinsics, project(intrinsics, points)) * points[..., 2:], points)


def test_the_optical_axis_meets_the_principal_point_and_x_goes_right():
    points = torch.tensor([[0.0, 0.0, 0.5], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0]], dtype=torch.float64)
    expected = K.new_tensor([[33.5, 22.0], [39.6, 22.0], [33.5, 27.9]])
    torch.testing.assert_close(project(K, points), expected)
