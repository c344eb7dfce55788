"""The picture shows red exactly where something is inside the table or another object, and nowhere else."""

import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from physpose_torch.errors import InvalidInputError
from physpose_torch.household import household_meshes, household_scene, perturb_like_estimator
from physpose_torch.viz import before_after, before_after_picture
from physpose_torch.viz.scene import corner_normals

K = torch.tensor([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]], dtype=torch.float64)
CAMERA = {"K": K, "height": 480, "width": 640}
PLANE = (torch.tensor([0.0, -0.8, -0.6], dtype=torch.float64), -0.5)  # 0.5 m under the camera, which looks down 37°


def red(picture):
    """Pixels (H, W) that are clearly red."""
    r, g, b = np.asarray(picture).astype(int).transpose(2, 0, 1)
    return (r > 1.9 * g) & (r > 1.9 * b) & (r > 110)


def halves(picture):
    """Red pixels in the left and the right column, without the legend's square (left)."""
    mask = red(picture)
    middle = mask.shape[1] // 2
    return int(mask[:, :middle].sum()) - 121, int(mask[:, middle:].sum())


def box_on_table(height=0.0, shift=0.0):
    """T_camera_object of a 10 cm box whose bottom is `height` above PLANE, `shift` to the right."""
    up = PLANE[0]
    x = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.stack([x, torch.linalg.cross(up, x), up], 1)
    ahead = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    T[:3, 3] = ahead * (PLANE[1] / (ahead @ up)) + (height + 0.05) * up + shift * x
    return T


BOX = trimesh.creation.box([0.1, 0.1, 0.1])
GREY = [(0.6, 0.6, 0.65)] * 2


@pytest.fixture(autouse=True)
def one_thread():
    """Many small operations: with busy neighbours, threads that wait for each other cost more than they bring."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(before_after, "_COLUMN", 140)


def test_household_picture_is_complete_fast_and_small(tmp_path):
    scene, meshes = household_scene(0), household_meshes()
    before = perturb_like_estimator(scene.T_camera_object, seed=0)
    started = time.process_time()
    picture = before_after_picture(
        [meshes[n] for n in scene.names],
        before,
        scene.T_camera_object,
        plane=(scene.normal, scene.offset),
        K=scene.K,
        height=scene.height,
        width=scene.width,
        captions=("deepest penetration 14.1 mm", "deepest penetration 0.0 mm"),
        path=tmp_path / "picture.png",
    )
    assert time.process_time() - started < 40  # CPU seconds, not to depend on who else works; 8 on two cores
    assert picture.mode == "RGB"
    assert 1200 <= picture.width <= 1600
    assert (tmp_path / "picture.png").stat().st_size < 400_000
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "picture.png")), np.asarray(picture))
    wrong, right = halves(picture)
    assert wrong > 20_000
    assert right == 0  # ground truth: exact contacts are no penetration


@pytest.mark.usefixtures("small")
def test_red_grows_with_depth_and_floating_is_not_red():
    areas = []
    for height in (-0.02, -0.01, 0.01):
        poses = torch.stack([box_on_table(height)]), torch.stack([box_on_table()])
        areas.append(halves(before_after_picture([BOX], *poses, plane=PLANE, colors=GREY[:1], **CAMERA)))
    deep, shallow, floating = (a for a, _ in areas)
    assert deep > 1.2 * shallow > 400
    assert floating == 0
    assert all(resting == 0 for _, resting in areas)


@pytest.mark.usefixtures("small")
def test_floating_opens_a_gap_over_the_table_line():
    # the close-up: rows of bare paper between the table's line and the box
    pictures = []
    for height in (0.01, 0.0):
        poses = torch.stack([box_on_table(height)]), torch.stack([box_on_table()])
        picture = before_after_picture([BOX], *poses, plane=PLANE, colors=["#333366"], **CAMERA)
        column = np.asarray(picture)[-44:, 18 + 70].mean(1)  # through the middle of the left close-up
        pictures.append((column > 248).sum())
    floating, resting = pictures
    assert floating >= resting + 4  # 1 cm of 15 cm across 140 px, less the line and the label


@pytest.mark.usefixtures("small")
def test_shared_space_of_two_objects_is_red_also_without_a_table():
    overlapping = torch.stack([box_on_table(), box_on_table(shift=0.08)])
    touching = torch.stack([box_on_table(), box_on_table(shift=0.1)])
    picture = before_after_picture([BOX, BOX], overlapping, touching, colors=GREY, **CAMERA)
    inside, beside = halves(picture)
    assert inside > 120
    assert beside == 0
    shown = before_after_picture([BOX, BOX], overlapping, touching, colors=GREY, plane=PLANE, **CAMERA)
    assert halves(shown)[0] > 120
    assert halves(shown)[1] == 0


@pytest.mark.usefixtures("small")
def test_options_and_repeatability(tmp_path):
    poses = torch.stack([box_on_table(-0.005)])
    first = before_after_picture([BOX], poses, poses, plane=PLANE, **CAMERA)
    plane = SimpleNamespace(normal=PLANE[0].float(), offset=torch.tensor(PLANE[1]))
    again = before_after_picture([BOX], poses.requires_grad_(), poses, plane=plane, **CAMERA)
    assert np.abs(np.asarray(first).astype(int) - np.asarray(again)).max() <= 2
    captioned = before_after_picture(
        [BOX], poses, poses, plane=PLANE, colors=["tab:green"], titles=("a", "b"), captions=("1 mm", "2 mm"), **CAMERA
    )
    assert captioned.height > first.height
    green = np.asarray(captioned).astype(int)
    assert ((green[..., 1] > 1.4 * green[..., 0]) & (green[..., 1] > 1.4 * green[..., 2])).sum() > 400


def test_bad_input_is_named():
    poses = torch.eye(4).repeat(2, 1, 1)
    with pytest.raises(InvalidInputError, match=r"poses_before has shape \(2, 4, 4\), expected \(1, 4, 4\)"):
        before_after_picture([BOX], poses, poses[:1], **CAMERA)
    with pytest.raises(InvalidInputError, match="poses_after"):
        before_after_picture([BOX] * 2, poses, poses[:1], **CAMERA)
    with pytest.raises(InvalidInputError, match="1 colors for 2 meshes"):
        before_after_picture([BOX] * 2, poses, poses, colors=["red"], **CAMERA)


def test_corner_normals_keep_creases_and_smooth_the_rest():
    np.testing.assert_allclose(corner_normals(BOX), np.repeat(BOX.face_normals[:, None], 3, 1), atol=1e-12)
    ball = trimesh.creation.icosphere(subdivisions=3)
    np.testing.assert_allclose(corner_normals(ball), ball.vertices[ball.faces], atol=0.02)


def test_import_is_light_and_pyplot_stays_out():
    code = (
        "import sys, torch, trimesh\n"
        "from physpose_torch.viz import before_after as viz\n"
        "assert 'matplotlib' not in sys.modules\n"
        "viz._COLUMN = 60\n"
        "T = torch.eye(4)[None].clone(); T[:, 2, 3] = 0.5\n"
        "viz.before_after_picture([trimesh.creation.box([.1] * 3)], T, T, K=torch.tensor("
        "[[600., 0, 320], [0, 600, 240], [0, 0, 1]]), height=480, width=640)\n"
        "assert 'matplotlib.figure' in sys.modules and 'matplotlib.pyplot' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.usefixtures("small")
def test_uncertainty_is_drawn_in_the_column_it_belongs_to_and_is_longest_along_the_ray():
    def unsure(picture):
        r, g, b = np.asarray(picture).astype(int).transpose(2, 0, 1)
        return (b > 1.25 * r) & (r > 1.15 * g)

    poses = torch.stack([box_on_table()])
    ray = torch.nn.functional.normalize(poses[0, :3, 3], dim=0)
    C = torch.eye(6, dtype=torch.float64)[None] * 0.002**2
    C[0, :3, :3] += (0.02**2 - 0.002**2) * torch.outer(ray, ray)
    options = dict(plane=PLANE, colors=GREY[:1], **CAMERA)
    bare = np.asarray(before_after_picture([BOX], poses, poses, **options))
    drawn = np.asarray(before_after_picture([BOX], poses, poses, covariance_after=C, **options))
    middle = bare.shape[1] // 2
    assert not unsure(bare).any()
    assert unsure(drawn)[:, middle:].sum() > 20
    legend = unsure(drawn)[:, :middle].sum()
    assert legend <= 121 + 20  # the square of the legend and nothing else
    both = np.asarray(before_after_picture([BOX], poses, poses, covariance_before=C, covariance_after=C, **options))
    assert unsure(both)[:, :middle].sum() > legend + 20
    # through the camera one looks along the ellipsoid, from the side it rises towards the camera
    y, _ = np.nonzero(unsure(drawn)[:, middle:])
    camera, beside = np.split(np.sort(y), [(np.diff(np.sort(y))).argmax() + 1])
    assert np.ptp(beside) > 2 * np.ptp(camera)
