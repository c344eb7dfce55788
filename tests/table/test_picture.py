"""The grid in the picture lies on the table, under the objects, and where the camera model says."""

import numpy as np
import pytest
import torch
from PIL import Image

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.table import picture
from physpose_torch.table.grid import grid_lines, table_grid
from physpose_torch.table.picture import table_picture
from physpose_torch.table.template import eroded, grown, render_template
from physpose_torch.table.view import pixel_rays, project
from physpose_torch.viz import ink

SIZE = (240, 320)
K = torch.tensor([[300.0, 0, 160], [0, 300.0, 118], [0, 0, 1]], dtype=torch.float64)
GREY = torch.full((*SIZE, 3), 90, dtype=torch.uint8)
BOX = Body.box((0.08, 0.08, 0.10), label="box")
CAN = Body.cylinder(0.04, 0.12, label="can")
NONE = torch.zeros(0, 3, dtype=torch.float64)


def camera(elevation, roll=0.0, distance=0.9):
    """T_camera_table of a camera that looks down at the table's origin by so many degrees."""
    e, r = np.radians([elevation, roll])
    up = [np.sin(r) * np.cos(e), -np.cos(r) * np.cos(e), -np.sin(e)]
    up = torch.tensor(up, dtype=torch.float64)
    x = torch.tensor([np.cos(r), np.sin(r), 0.0], dtype=torch.float64)
    R = torch.stack([x, torch.linalg.cross(up, x), up], 1)
    return se3.from_rotation_translation(R, torch.tensor([0.0, 0.0, distance], dtype=torch.float64))


def grid_coordinates(grid, points):
    """(..., 2) of points (..., 3) in the camera frame, in cells."""
    flat = se3.apply(se3.inverse(grid.T_camera_grid), points.reshape(-1, 3))[:, :2]
    return flat.view(*points.shape[:-1], 2) / grid.cell


@pytest.fixture
def scene(table):
    """Two objects on the table, and the picture's arguments."""
    poses = table.poses((-0.12, 0.0, 0.05), (0.14, 0.05, 0.06))
    return dict(K=K, plane=table.plane, bodies=[BOX, CAN], poses=poses)


def drawn(picture, image=GREY):
    """(H, W) bool: what the picture changed, without the legend."""
    changed = (np.asarray(picture).astype(int) != image.numpy()).any(2)
    changed[-30:, :150] = False
    return changed


def on_plane(plane, pixels):
    """Points (M, 3) where the rays of pixels (M, 2) meet the plane."""
    rays = pixel_rays(K, pixels)
    return rays * (plane.offset / (rays @ plane.normal))[:, None]


VIEWS = [(25, 0), (45, 12), (60, -8), (90, 0)]


@pytest.mark.parametrize(("elevation", "roll"), VIEWS)
def test_grid_lines_lie_on_the_plane_at_multiples_of_the_cell(elevation, roll):
    plane = Plane.from_pose(camera(elevation, roll))
    grid = table_grid(plane, NONE, K, SIZE)
    lines = grid_lines(grid, K, SIZE)
    assert len(lines.segments) > 12
    torch.testing.assert_close(lines.segments @ plane.normal, plane.offset.expand(len(lines.segments), 2))
    cells = grid_coordinates(grid, lines.segments)
    run = (cells[:, 1] - cells[:, 0]).abs()
    along = run.argmax(1, keepdim=True)
    assert (run.gather(1, 1 - along) < 1e-9).all()  # parallel to an axis
    index = cells[:, 0].gather(1, 1 - along)[:, 0]
    torch.testing.assert_close(index, index.round(), atol=1e-9, rtol=0)
    assert torch.equal(lines.strong, index.round().long() % 2 == 0)


@pytest.mark.parametrize(("elevation", "roll"), VIEWS)
def test_the_pixels_drawn_unproject_to_lines_of_the_grid(elevation, roll):
    plane = Plane.from_pose(camera(elevation, roll))
    grid = table_grid(plane, NONE, K, SIZE)
    image = np.asarray(table_picture(GREY, K, plane)).astype(int)
    bright = (image > 150).all(2)
    bright[-30:] = False
    y, x = (torch.from_numpy(a) for a in np.nonzero(bright))
    assert len(x) > 1000
    here = torch.stack([x, y], 1).double()
    cells = grid_coordinates(grid, on_plane(plane, here))
    away = []  # from the nearest line of either direction, in pixels
    for axis in range(2):
        spots = torch.cat([cells, torch.zeros_like(cells[:, :1])], 1)
        spots[:, axis] = spots[:, axis].round()
        away.append((project(K, se3.apply(grid.T_camera_grid, spots * grid.cell)) - here).norm(dim=1))
    arrow = (here - project(K, grid.T_camera_grid[:3, 3])).norm(dim=1) < 40  # the normal is not in the plane
    assert float(torch.minimum(*away)[~arrow].max()) < 1.5


def test_the_grid_is_centred_under_the_objects_and_aligned_with_the_camera(scene, table):
    meshes = [torch.tensor(np.asarray(b.mesh.vertices)) for b in scene["bodies"]]
    points = torch.cat([se3.apply(T, v) for T, v in zip(scene["poses"], meshes, strict=True)])
    grid = table_grid(table.plane, points, K, SIZE)
    middle = torch.tensor([0.01, 0.025, 0.0], dtype=torch.float64)  # of -0.16 to 0.18 and -0.04 to 0.09
    torch.testing.assert_close(table.where(grid.T_camera_grid), middle, atol=1e-9, rtol=0)
    torch.testing.assert_close(grid.T_camera_grid[:3, :3], table.T[:3, :3])
    torch.testing.assert_close(-grid.low, grid.high)


@pytest.mark.parametrize("width", [0.05, 0.17, 0.3, 0.5, 1.0, 2.0, 2.4])
def test_eight_to_twenty_five_cells_lie_across_the_objects(width, table):
    points = torch.stack([table.at(side * width / 2, 0.02 * side)[:3, 3] for side in (-1, 1)])
    grid = table_grid(table.plane, points, K, SIZE)
    assert width / grid.cell < 25
    assert width / grid.cell >= 8 or grid.cell == 0.02


def test_objects_hide_the_grid_and_what_is_under_the_table_does_not(scene, table):
    seen = render_template(scene["bodies"], scene["poses"], K, SIZE)
    inside = eroded(seen.owner >= 0, 4).numpy()
    assert inside.sum() > 800
    changed = drawn(table_picture(GREY, **scene))
    assert changed.mean() > 0.1
    assert changed[inside].mean() < 0.03  # but for the arrow, which may pass in front

    sunk = scene["poses"].clone()
    sunk[:, :3, 3] -= 0.13 * table.up
    seen = render_template(scene["bodies"], sunk, K, SIZE)
    assert drawn(table_picture(GREY, **{**scene, "poses": sunk}))[eroded(seen.owner >= 0, 4).numpy()].mean() > 0.95


@pytest.mark.parametrize("elevation", [-5.0, 0.0, 0.5, 3.0, 10.0])
@pytest.mark.parametrize("roll", [0, 30])
def test_no_line_is_above_the_horizon_of_a_grazing_plane(elevation, roll):
    T = camera(elevation, roll)
    T[:3, 3] -= 0.15 * T[:3, 2]
    plane = Plane.from_pose(T)
    grid = table_grid(plane, NONE, K, SIZE)
    segments = grid_lines(grid, K, SIZE).segments
    assert len(segments)
    assert (segments[..., 2] > picture.NEAR - 1e-9).all()
    assert (pixel_rays(K, project(K, segments)) @ plane.normal < 0).all()
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in SIZE), indexing="ij")
    pixels = torch.stack([x, y], -1)
    arrow = (pixels - project(K, grid.T_camera_grid[:3, 3])).norm(dim=-1) < 70  # its tip may be above
    above = pixel_rays(K, pixels) @ plane.normal >= 0
    assert not (drawn(table_picture(GREY, K, plane)) & (above & ~arrow).numpy()).any()


def test_lines_end_before_they_reach_the_camera():
    T = camera(20)
    T[:3, 3] = torch.tensor([0.0, 0.0, 0.05])
    wide = torch.tensor([1.0, 1.0], dtype=torch.float64)
    segments = grid_lines(picture.Grid(T, 0.05, -wide, wide), K, SIZE).segments
    assert len(segments) > 10
    assert segments[..., 2].min().item() == pytest.approx(picture.NEAR)


@pytest.mark.parametrize("offset", [0.0, 0.5, -1e-9])
def test_a_plane_through_or_above_the_camera_is_no_error(offset):
    plane = Plane(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), torch.tensor(offset, dtype=torch.float64))
    assert table_picture(GREY, K, plane).size == SIZE[::-1]
    behind = Plane(torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), torch.tensor(0.5, dtype=torch.float64))
    assert not drawn(table_picture(GREY, K, behind)).any()  # all of it is behind the camera


def test_the_grid_fades_out_with_distance_from_the_objects(scene, table):
    one = {**scene, "bodies": [BOX], "poses": table.poses((0.0, 0.0, 0.05))}
    shown = drawn(table_picture(torch.zeros_like(GREY), **one), torch.zeros_like(GREY))
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in SIZE), indexing="ij")
    spots = on_plane(table.plane, torch.stack([x, y], -1).view(-1, 2))
    beyond = se3.apply(se3.inverse(table.T), spots)[:, :2].abs().amax(1).view(SIZE).numpy() - 0.04
    seen = render_template([BOX], one["poses"], K, SIZE)
    free = ~grown(seen.owner >= 0, 4).numpy()
    free[:, 140:180] = False  # the arrow
    fade = picture.MARGIN * 0.02
    near, far, out = (shown[free & (beyond > a) & (beyond < b)].mean() for a, b in ((0, 0.02), (0.1, 0.11), (fade, 9)))
    assert near > 0.15
    assert far < near
    assert out == 0


def test_contacts_are_where_they_project_and_rings_where_hidden(scene, table):
    contacts = torch.stack([table.at(-0.15, -0.04)[:3, 3], table.at(0.0, -0.1)[:3, 3], table.at(-0.12, 0.035)[:3, 3]])
    with_dots = np.asarray(table_picture(GREY, **scene, contacts=contacts)).astype(int)
    without = np.asarray(table_picture(GREY, **scene)).astype(int)
    difference = np.abs(with_dots - without).sum(2)
    pixels = project(K, contacts).numpy()
    y, x = np.nonzero(difference)
    distance = np.hypot(x[:, None] - pixels[:, 0], y[:, None] - pixels[:, 1])
    assert distance.min(1).max() < 5  # nowhere else
    yellow = (with_dots[..., 0] > 180) & (with_dots[..., 1] > 150) & (with_dots[..., 2] < 110)
    for k, (u, v) in enumerate(pixels.round().astype(int)):
        near = distance[:, k] < 5
        assert near.sum() > 5
        assert np.abs([x[near].mean() - pixels[k, 0], y[near].mean() - pixels[k, 1]]).max() < 0.5
        assert bool(yellow[v, u]) == (k < 2)  # the third is under the box
    behind = torch.tensor([[0.0, 0.0, -1.0], [5.0, 0.0, 0.5]])
    assert np.array_equal(np.asarray(table_picture(GREY, **scene, contacts=behind)), without)


def test_outlines_tell_what_stands_on_the_table(scene):
    seen = render_template(scene["bodies"], scene["poses"], K, SIZE)
    image = np.asarray(table_picture(GREY, **scene, standing=torch.tensor([True, False]))).astype(int)
    orange = (image[..., 0] - image[..., 2] > 60) & (image[..., 0] > image[..., 1] + 25)
    teal = (image[..., 1] - image[..., 0] > 40) & (image[..., 2] - image[..., 0] > 40)
    for mask in (orange, teal):
        mask[-30:] = False
    for k, mask in enumerate((teal, orange)):
        border = (~eroded(seen.owner == k, 1) & (seen.owner == k)).numpy()
        assert mask[border].mean() > 0.6
        y, x = np.nonzero(mask)
        by, bx = np.nonzero(border)
        assert np.hypot(y[:, None] - by, x[:, None] - bx).min(1).max() < 2.5


@pytest.mark.parametrize("unit", [0.5, 1.0, 6.0])
def test_an_outline_is_as_wide_as_asked_for_and_nowhere_else(unit):
    mask = np.zeros((160, 200), bool)
    mask[:, 100:] = True
    row = ink.outline(np.full((160, 200, 3), 0.2), mask, "#ffffff", unit)[80, :, 0]
    alpha = (row - 0.2) / 0.8
    assert (alpha > 0.5).sum() == pytest.approx(1.6 * unit, abs=1)
    assert (alpha[: int(97 - 2 * unit)] == 0).all()
    assert (alpha[int(103 + 2 * unit) :] == 0).all()


def test_no_objects_no_image_and_objects_out_of_sight_are_fine(scene, table):
    assert drawn(table_picture(GREY, K, table.plane)).sum() > 1000
    blank = table_picture(None, K, table.plane, bodies=[BOX], poses=scene["poses"][:1], size=(200, 300))
    assert blank.size == (300, 200)
    assert table_picture(None, K, table.plane).size == (321, 237)
    poses = scene["poses"].clone()
    poses[0] = torch.nan
    poses[1, :3, 3] = torch.tensor([0.0, 0.0, -1.0])
    lost = table_picture(GREY, **{**scene, "poses": poses}, standing=torch.tensor([True, False]))
    assert np.array_equal(np.asarray(lost), np.asarray(table_picture(GREY, K, table.plane)))


def test_the_same_arguments_give_the_same_picture_also_on_disk(scene, tmp_path):
    a, b = (table_picture(GREY, **scene, title="t", caption="c", path=tmp_path / "a.png") for _ in range(2))
    assert np.array_equal(np.asarray(a), np.asarray(b))
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), np.asarray(a))


def test_title_and_caption_are_strips_beside_the_image(scene):
    plain, both = (
        table_picture(GREY, **scene),
        table_picture(GREY, **scene, title="table", caption="a long caption " * 6),
    )
    assert both.width == plain.width
    extra = both.height - plain.height
    head = round(46 * 0.5)
    assert extra == head + round(44 * 0.5)
    middle = np.asarray(both)[head : head + plain.height]
    assert np.abs(middle.astype(int) - np.asarray(plain)).max() <= 1 or (middle != np.asarray(plain)).mean() < 0.02
    for strip in (np.asarray(both)[:head], np.asarray(both)[head + plain.height :]):
        assert (strip < 128).any()
        assert (strip[:, [0, -1]] == 255).all()  # also a long caption fits


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(image=torch.zeros(240, 320, 3)), "View.image is torch.float32 .* uint8"),
        (dict(K=torch.eye(4)), r"View.K has shape \(4, 4\)"),
        (dict(plane=(torch.tensor([0.0, -1, 0]), -0.5)), "plane is a tuple, expected a Plane"),
        (dict(poses=None), r"poses is None, expected T_camera_object \(2, 4, 4\) for 2 bodies"),
        (dict(poses=torch.eye(4)[None]), r"poses has shape \(1, 4, 4\), expected T_camera_object \(2, 4, 4\)"),
        (dict(poses=torch.diag(torch.tensor([2.0, 2, 2, 1])).repeat(2, 1, 1)), "is not rigid"),
        (dict(standing=torch.ones(2)), r"standing is torch.float32 of shape \(2,\), expected torch.bool \(2,\)"),
        (dict(standing=torch.ones(3, dtype=torch.bool)), r"shape \(3,\), expected torch.bool \(2,\)"),
        (dict(contacts=torch.zeros(3)), r"contacts has shape \(3,\), expected finite points \(C, 3\)"),
        (dict(contacts=torch.full((1, 3), torch.nan)), "finite points"),
        (dict(size=(100, 100)), r"size = \(100, 100\), but the image is \(240, 320\)"),
        (dict(image=None, size=(10, 100)), r"size = \(10, 100\), expected \(height, width\) of at least 32"),
    ],
)
def test_bad_arguments_are_named(change, message, scene):
    arguments = {"image": GREY, **scene, **change}
    with pytest.raises(InvalidInputError, match=message):
        table_picture(arguments.pop("image"), arguments.pop("K"), arguments.pop("plane"), **arguments)
