"""Contours lie where the objects' silhouettes are, in front of what is behind them, and nowhere else."""

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.render import render
from physpose_torch.viz import overlay_picture

SIZE = (480, 640)
K = torch.tensor([[600.0, 0, 320], [0, 600.0, 236], [0, 0, 1]], dtype=torch.float64)
GREY = np.full((*SIZE, 3), 90, dtype=np.uint8)
BOX = Body.box((0.08, 0.08, 0.10), label="box")
CAN = Body.cylinder(0.04, 0.12, label="can")
AFTER, BEFORE = 2, 0  # the channels that blue-green and orange are strongest against the other


def where(picture, color, size=SIZE):
    """(H, W) bool: pixels on a grey image that are clearly of a colour; the legend is left out."""
    values = np.asarray(picture)[: size[0]].astype(int)
    near = values[..., color] - values[..., 2 - color] > 60
    near[-30:, :200] = False
    return near


def silhouette(body, T):
    vertices = torch.tensor(np.array(body.mesh.vertices)) @ T[:3, :3].T + T[:3, 3]
    seen = render(vertices, torch.tensor(np.array(body.mesh.faces)), K, *SIZE)
    return (seen.face_id >= 0).numpy(), seen.depth.numpy()


def border(mask):
    """Pixels next to one on the other side of a mask's edge."""
    out = np.zeros_like(mask)
    for axis in (0, 1):
        change = np.diff(mask.astype(int), axis=axis) != 0
        first = [slice(None)] * 2
        first[axis] = slice(0, -1)
        second = [slice(None)] * 2
        second[axis] = slice(1, None)
        out[tuple(first)] |= change
        out[tuple(second)] |= change
    return out


def near(mask, radius):
    from scipy.ndimage import binary_dilation

    return binary_dilation(mask, iterations=radius)


@pytest.fixture
def poses(table):
    return table.poses((-0.12, 0.0, 0.05), (0.14, 0.05, 0.06))


def test_contours_lie_on_the_edges_of_the_silhouettes_and_nowhere_else(poses):
    picture = overlay_picture(GREY, [BOX, CAN], poses, K, labels=())
    line = where(picture, AFTER)
    edges = border(silhouette(BOX, poses[0])[0]) | border(silhouette(CAN, poses[1])[0])
    assert line.sum() > 600
    assert not (line & ~near(edges, 2)).any()
    assert (edges & ~near(line, 2)).sum() < 0.01 * edges.sum()  # corners are rounded
    untouched = ~near(edges, 6)
    untouched[-30:, :200] = False
    assert (np.asarray(picture)[untouched] == 90).all()


def test_a_contour_is_hidden_by_what_is_in_front_of_it(table):
    poses = table.poses((0.0, 0.12, 0.05), (0.0, 0.0, 0.06))  # the box behind the can
    line = where(overlay_picture(GREY, [BOX, CAN], poses, K, labels=()), AFTER)
    (behind, far), (front, close) = silhouette(BOX, poses[0]), silhouette(CAN, poses[1])
    overlap = behind & front
    assert overlap.sum() > 300
    assert (close[overlap] < far[overlap]).all()
    hidden = border(behind) & front & ~near(border(front), 4)
    assert hidden.sum() > 20
    assert not line[hidden].any()


def test_poses_before_have_their_own_colour(table, poses):
    moved = poses.clone()
    moved[0, 0, 3] -= 0.03
    before, after = (where(overlay_picture(GREY, [BOX, CAN], poses, K, poses_before=moved, labels=()), c)
                     for c in (BEFORE, AFTER))  # fmt: skip
    edge = border(silhouette(BOX, moved[0])[0]) & ~near(border(silhouette(BOX, poses[0])[0]), 3)
    assert edge.sum() > 60
    assert before[near(edge, 1)].sum() > 60
    assert not after[edge].any()
    assert not (before & ~near(border(silhouette(BOX, moved[0])[0]) | border(silhouette(CAN, moved[1])[0]), 2)).any()
    assert not where(overlay_picture(GREY, [BOX, CAN], poses, K, labels=()), BEFORE).any()


def test_without_an_image_the_objects_are_drawn_on_plain_paper(poses):
    picture = np.asarray(overlay_picture(None, [BOX, CAN], poses, K, size=SIZE, labels=()))
    assert picture.shape == (*SIZE, 3)
    box = silhouette(BOX, poses[0])[0]
    assert picture[5, 320].tolist() == [247, 246, 243]
    inside = box & ~near(border(box), 4)
    assert (picture[inside] < 225).all()
    assert picture[inside].std() > 1  # lit, not flat


def test_meshes_do_as_well_as_bodies(poses):
    first = overlay_picture(GREY, [BOX, CAN], poses, K, labels=("a", "b"))
    again = overlay_picture(GREY, [BOX.mesh, CAN.mesh], poses.float(), K, labels=("a", "b"))
    assert np.abs(np.asarray(first).astype(int) - np.asarray(again)).mean() < 0.05


def test_labels_are_written_on_the_objects_and_only_where_there_is_room(poses):
    bare, named = (np.asarray(overlay_picture(GREY, [BOX, CAN], poses, K, labels=x)).astype(int) for x in ((), None))
    y, x = np.nonzero((bare != named).any(2))
    assert len(x) > 40
    for body, T in zip((BOX, CAN), poses, strict=True):
        rows, columns = np.nonzero(silhouette(body, T)[0])
        on = (abs(x - columns.mean()) < 25) & (abs(y - rows.mean()) < 12)
        assert on.sum() > 20
    long = np.asarray(overlay_picture(GREY, [BOX, CAN], poses, K, labels=("w" * 200, ""))).astype(int)
    np.testing.assert_array_equal(long, bare)


def test_ellipsoids_are_drawn_around_the_poses_they_belong_to(poses):
    C = 1e-4 * torch.eye(6, dtype=torch.float64).repeat(2, 1, 1)
    bare = np.asarray(overlay_picture(GREY, [BOX, CAN], poses, K, labels=())).astype(int)
    unsure = np.asarray(overlay_picture(GREY, [BOX, CAN], poses, K, labels=(), covariance=C)).astype(int)
    changed = (bare != unsure).any(2)
    changed[-30:, :250] = False
    pixels = (poses[:, :3, 3] @ K.T)[:, :2] / poses[:, 2:3, 3]
    y, x = np.nonzero(changed)
    distance = np.hypot(x[:, None] - pixels[:, 0].numpy(), y[:, None] - pixels[:, 1].numpy()).min(1)
    assert distance.max() < 2 * 0.01 * 600 / float(poses[:, 2, 3].min()) + 3
    assert changed.sum() > 150
    axes = overlay_picture(GREY, [BOX, CAN], poses, K, labels=(), covariance=C, rotations=True)
    assert (np.asarray(axes).astype(int) != unsure).any(2).sum() > 100


def test_an_unseen_object_is_left_out(poses, tmp_path):
    missing = poses.clone()
    missing[1] = torch.nan
    picture = overlay_picture(GREY, [BOX, CAN], missing, K, title="t", caption="c", path=tmp_path / "a.png")
    assert picture.height > SIZE[0]
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), np.asarray(picture))
    line = where(overlay_picture(GREY, [BOX, CAN], missing, K, labels=()), AFTER)
    assert line.any()
    assert not line[near(silhouette(CAN, poses[1])[0], 3)].any()


def test_bad_input_is_named(poses):
    with pytest.raises(InvalidInputError, match=r"poses has shape \(2, 4, 4\), expected T_camera_object \(1, 4, 4\)"):
        overlay_picture(GREY, [BOX], poses, K)
    with pytest.raises(InvalidInputError, match="poses_before has shape"):
        overlay_picture(GREY, [BOX, CAN], poses, K, poses_before=poses[:1])
    with pytest.raises(InvalidInputError, match="1 labels for 2 objects"):
        overlay_picture(GREY, [BOX, CAN], poses, K, labels=("a",))
    with pytest.raises(InvalidInputError, match=r"shapes\[0\] is a str"):
        overlay_picture(GREY, ["mug.ply", trimesh.creation.box()], poses, K)
    with pytest.raises(InvalidInputError, match="without poses_before"):
        overlay_picture(GREY, [BOX, CAN], poses, K, covariance_before=torch.eye(6).repeat(2, 1, 1))
    with pytest.raises(InvalidInputError, match=r"covariance has shape \(6, 6\)"):
        overlay_picture(GREY, [BOX, CAN], poses, K, covariance=torch.eye(6))
