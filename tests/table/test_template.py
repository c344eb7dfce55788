"""Templates show what a camera sees of objects: who, how deep, which point of the surface, in which colour."""

import math

import numpy as np
import pytest
import torch
import trimesh
from helpers import pose
from PIL import Image

from physpose_torch import se3
from physpose_torch.geometry.body import Body
from physpose_torch.table.template import eroded, grown, render_template
from physpose_torch.table.view import project

K = torch.tensor([[200.0, 0.0, 79.5], [0.0, 200.0, 59.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
SIZE = (120, 160)
Y, X = torch.meshgrid(torch.arange(SIZE[0]).double(), torch.arange(SIZE[1]).double(), indexing="ij")
RED, GREEN, BLUE = (200, 10, 20), (15, 180, 30), (25, 35, 220)


def at(x=0.0, y=0.0, z=0.5, turn=(0.0, 0.0, 0.0)):
    return pose(turn, (x, y, z))


def draw(bodies, *poses):
    return render_template(bodies, torch.stack(poses), K, SIZE)


def colored_box(**colors):
    """100 × 60 × 40 mm."""
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    for name, value in colors.items():
        setattr(mesh.visual, name, value)
    return Body.from_hull(mesh, label="coloured")


def printed_box(image, **options):
    """A box whose face towards the camera of :func:`at` bears an image, upright and all over."""
    front = np.array([[-0.05, -0.03, -0.02], [0.05, -0.03, -0.02], [0.05, 0.03, -0.02], [-0.05, 0.03, -0.02]])
    back = front + np.array([0.0, 0.0, 0.04])
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])  # v goes up, y down
    round_ = ((0, 1), (1, 2), (2, 3), (3, 0))
    faces = [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]]
    faces += [[a, b, b + 4] for a, b in round_] + [[a, b + 4, a + 4] for a, b in round_]
    visual = trimesh.visual.TextureVisuals(uv=np.concatenate([uv, uv]), image=image, **options)
    return Body.from_hull(trimesh.Trimesh(np.concatenate([front, back]), faces, visual=visual, process=False), label="print")


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.05, -0.03), (-0.08, 0.04)])
def test_depth_and_extent_of_a_box_are_those_of_its_front(box, shift):
    """Seen straight on, its front is 0.1 x 0.06 m at 0.48 m; of its sides nothing is in front of that."""
    seen = draw([box], at(*shift))
    left, right = (79.5 + 200 * (shift[0] + s * 0.05) / 0.48 for s in (-1, 1))
    top, bottom = (59.5 + 200 * (shift[1] + s * 0.03) / 0.48 for s in (-1, 1))
    front = (left <= X) & (right >= X) & (top <= Y) & (bottom >= Y)
    torch.testing.assert_close(seen.depth[front], torch.full_like(seen.depth[front], 0.48), atol=1e-9, rtol=0)
    assert torch.equal(seen.owner >= 0, seen.depth > 0)
    assert set(seen.owner.unique().tolist()) == {-1, 0}
    assert bool((seen.owner[front] == 0).all())
    sides = (seen.owner == 0) & ~front
    assert bool((seen.depth[sides] > 0.48).all())
    if shift == (0.0, 0.0):
        assert not sides.any()
    assert torch.equal(seen.outlines[0], seen.owner == 0)


def test_depth_of_a_tilted_box_is_that_of_its_planes(box):
    T = at(0.02, 0.01, 0.5, (0.5, 0.4, 0.2))
    seen = draw([box], T)
    on = seen.owner == 0
    rays = torch.stack([(X - 79.5) / 200, (Y - 59.5) / 200, torch.ones_like(X)], -1)[on]
    origin, direction = -(T[:3, 3] @ T[:3, :3]), rays @ T[:3, :3]  # object frame: slabs
    half = box.upper
    near = torch.minimum((half - origin) / direction, (-half - origin) / direction).amax(1)
    torch.testing.assert_close(seen.depth[on], near, atol=1e-7, rtol=0)
    assert int(on.sum()) > 1000


def test_points_and_normals_are_those_of_the_surface_in_the_object_frame(box):
    T = at(0.02, 0.01, 0.5, (0.5, 0.4, 0.2))
    seen = draw([box], T)
    on = seen.owner == 0
    point, normal = seen.point[on], seen.normal[on]
    torch.testing.assert_close(project(K, se3.apply(T, point)), torch.stack([X, Y], -1)[on], atol=1e-6, rtol=0)
    torch.testing.assert_close(se3.apply(T, point)[:, 2], seen.depth[on], atol=1e-9, rtol=0)
    assert float((point.abs() - box.upper).amax(1).abs().max()) < 1e-9  # on the surface
    axis = (point.abs() - box.upper).argmax(1)
    expected = torch.zeros_like(point)
    expected[torch.arange(len(point)), axis] = point.gather(1, axis[:, None])[:, 0].sign()
    inner = ((point.abs() - box.upper).abs() < 1e-9).sum(1) == 1  # not on an edge
    torch.testing.assert_close(normal[inner], expected[inner], atol=1e-12, rtol=0)
    assert bool(((normal @ T[:3, :3].mT * se3.apply(T, point)).sum(1) <= 1e-9).all())  # all face the camera


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_object_hides_the_farther_whatever_their_order(box, order):
    poses = [at(0.0, 0.0, 0.5), at(0.04, 0.0, 0.7)]
    seen = draw([box, box], *(poses[k] for k in order))
    near, far = order.index(0), order.index(1)
    assert int(seen.owner[60, 85]) == near
    assert float(seen.depth[60, 85]) == pytest.approx(0.48)
    alone = draw([box], poses[1])
    assert torch.equal(seen.outlines[far], alone.outlines[0])  # as if the other were not there
    assert torch.equal(seen.owner == far, alone.outlines[0] & ~seen.outlines[near])
    assert torch.equal(seen.owner == near, seen.outlines[near])
    assert bool((seen.owner == far).any())


def test_an_object_that_is_wholly_hidden_has_an_outline_all_the_same(box, can):
    seen = draw([can, box], at(z=0.9), at(z=0.4))
    assert not (seen.owner == 0).any()
    assert bool(seen.outlines[0].any())


@pytest.mark.parametrize(
    "where",
    [at(2.0), at(0.0, -2.0), at(z=-0.5), at(z=0.01), torch.full((4, 4), torch.nan, dtype=torch.float64)],
    ids=["right of it", "above it", "behind", "around", "NaN"],
)
def test_what_is_out_of_sight_has_no_outline(box, where):
    seen = draw([box, box], where, at())
    assert seen.outlines[0] is None
    assert seen.outlines[1] is not None
    assert set(seen.owner.unique().tolist()) == {-1, 1}
    assert seen.depth.isfinite().all()
    none = draw([box], where)
    assert not (none.owner >= 0).any()
    assert not none.depth.any()


def test_what_is_too_small_to_be_on_any_pixel_has_no_outline():
    crumb = Body.box((0.001, 0.001, 0.001), label="crumb")
    assert draw([crumb], at()).outlines == (None,)  # between four pixels
    assert int(draw([crumb], at(0.00125, 0.00125)).outlines[0].sum()) == 1


def test_what_is_in_sight_in_part_is_drawn_in_part(box):
    seen = draw([box], at(-0.19, 0.0, 0.5))
    assert bool(seen.outlines[0][:, 0].any())
    assert not seen.outlines[0][:, 60:].any()
    middle = render_template([box], at(-0.19, 0.0, 0.5)[None], K + torch.tensor([[0, 0, 40.0], [0, 0, 0], [0, 0, 0]]), SIZE)
    assert torch.equal(middle.owner[:, 40:], seen.owner[:, :-40])


def test_no_objects_are_an_empty_image():
    seen = render_template([], torch.zeros(0, 4, 4, dtype=torch.float64), K, SIZE)
    assert seen.owner.shape == SIZE
    assert not (seen.owner >= 0).any()
    assert seen.outlines == ()
    assert seen.colored.shape == (0,)


def test_colours_of_faces_are_flat():
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    toward = {(0, 0, -1): RED, (1, 0, 0): GREEN, (-1, 0, 0): BLUE}
    colors = np.array([[*toward.get(tuple(n.round().astype(int)), (1, 2, 3)), 255] for n in mesh.face_normals], dtype=np.uint8)
    seen = draw([colored_box(face_colors=colors)], at(0.0, 0.0, 0.5, (0.0, 0.6, 0.0)))
    on = seen.owner == 0
    for normal, color in toward.items():
        face = on & (seen.normal @ torch.tensor(normal, dtype=torch.float64) > 0.9)
        assert torch.equal(seen.color[face], torch.tensor(color, dtype=torch.uint8).expand(int(face.sum()), 3))
    assert bool((seen.color[on] == torch.tensor(RED)).all(1).any())
    assert seen.colored.tolist() == [True]


def test_colours_of_vertices_go_over_into_each_other():
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    left = mesh.vertices[:, 0] < 0
    colors = np.where(left[:, None], [[0, 0, 0, 255]], [[200, 100, 50, 255]]).astype(np.uint8)
    seen = draw([colored_box(vertex_colors=colors)], at())
    on = seen.owner == 0
    share = seen.point[on][:, :1] / 0.1 + 0.5
    expected = share * torch.tensor([200.0, 100.0, 50.0], dtype=torch.float64)
    assert float((seen.color[on].double() - expected).abs().max()) <= 0.5 + 1e-6


@pytest.mark.parametrize("material", ["simple", "pbr", "grey"])
def test_a_texture_is_upright_and_where_it_belongs(material):
    """Four fields of 0.05 x 0.03 m: red and green above, blue and white below."""
    picture = np.zeros((30, 50, 3), dtype=np.uint8)
    picture[:15, :25], picture[:15, 25:], picture[15:, :25], picture[15:, 25:] = RED, GREEN, BLUE, (240, 240, 240)
    image = Image.fromarray(picture)
    if material == "pbr":
        body = printed_box(None, material=trimesh.visual.material.PBRMaterial(baseColorTexture=image))
    else:
        body = printed_box(image.convert("L") if material == "grey" else image)
    seen = draw([body], at())
    assert seen.colored.tolist() == [True]
    expected = picture if material != "grey" else np.repeat(np.array(image.convert("L"))[..., None], 3, 2)
    for x, y, row, column in ((-0.03, -0.02, 2, 2), (0.03, -0.02, 2, 48), (-0.03, 0.02, 28, 2), (0.03, 0.02, 28, 48)):
        u, v = (project(K, torch.tensor([x, y, 0.48], dtype=torch.float64)).round().long()).tolist()
        assert seen.color[v, u].tolist() == expected[row, column].tolist()


def test_a_texture_is_interpolated_between_the_centres_of_its_pixels():
    """A ramp of 50 columns over 0.1 m: the colour tells where on the surface a pixel is to a fraction of a texel."""
    ramp = np.repeat(np.repeat((5 * np.arange(50))[None, :, None], 30, 0), 3, 2).astype(np.uint8)
    seen = draw([printed_box(Image.fromarray(ramp))], at())
    inner = (seen.owner == 0) & (seen.point[..., 0].abs() < 0.048)
    column = (seen.point[inner][:, 0] + 0.05) / 0.1 * 50 - 0.5
    assert float((seen.color[inner][:, 0].double() - 5 * column).abs().max()) < 0.6


def test_textures_repeat():
    picture = np.zeros((8, 8, 3), dtype=np.uint8)
    picture[:4, :4] = RED
    plain, moved = printed_box(Image.fromarray(picture)), printed_box(Image.fromarray(picture))
    moved.appearance.visual.uv = moved.appearance.visual.uv + np.array([2.0, -3.0])
    a, b = draw([plain], at()), draw([moved], at())
    inner = eroded(a.owner == 0, 2)
    assert torch.equal(a.color[inner], b.color[inner])
    assert int((a.color[inner] == torch.tensor(RED)).all(1).sum()) > 100


def test_an_object_without_colours_is_grey_beside_one_with_some(box):
    painted = colored_box(face_colors=np.tile(np.array([[*RED, 255]], dtype=np.uint8), (12, 1)))
    seen = draw([box, painted], at(-0.1), at(0.1))
    assert seen.colored.tolist() == [False, True]
    assert bool((seen.color[seen.owner == 0] == 128).all())
    assert bool((seen.color[seen.owner == 1] == torch.tensor(RED)).all())
    assert bool((seen.color[seen.owner < 0] == 128).all())


def test_colours_of_what_is_hidden_do_not_show():
    red, green = (
        colored_box(face_colors=np.tile(np.array([[*c, 255]], dtype=np.uint8), (12, 1))) for c in (RED, GREEN)
    )
    for bodies, poses in (([red, green], (at(z=0.4), at(0.03, 0.0, 0.6))), ([green, red], (at(0.03, 0.0, 0.6), at(z=0.4)))):
        seen = draw(bodies, *poses)
        for k, body in enumerate(bodies):
            color = torch.tensor(RED if body is red else GREEN, dtype=torch.uint8)
            assert bool((seen.color[seen.owner == k] == color).all())
        assert int(seen.owner[60, 80]) == bodies.index(red)


@pytest.mark.parametrize("radius", [1, 3, 6])
def test_grown_and_eroded_masks_are_those_of_a_disc(radius):
    """Distances between pixel centres; OpenCV's disc is an approximation, by less than a pixel."""
    mask = torch.zeros(60, 70, dtype=torch.bool)
    mask[30, 35] = True
    y, x = torch.meshgrid(torch.arange(60), torch.arange(70), indexing="ij")
    distance = ((y - 30.0) ** 2 + (x - 35.0) ** 2).sqrt()
    large, small = grown(mask, radius), eroded(~mask, radius)
    assert bool(large[distance <= radius - 0.7].all())
    assert not large[distance > radius + 0.7].any()
    assert torch.equal(small, ~large)
    assert bool(large[30, 35 + radius])
    assert not large[30, 35 + radius + 1]


def test_masks_of_radius_zero_stay_and_the_image_border_erodes_nothing():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[:10, :12] = True
    assert torch.equal(grown(mask, 0), mask)
    assert torch.equal(eroded(mask, 0), mask)
    inner = eroded(mask, 3)
    assert bool(inner[:7, :9].all())
    assert not inner[7:].any()
    assert not inner[:, 9:].any()
    assert bool(eroded(torch.ones(20, 30, dtype=torch.bool), 4).all())
    assert int(grown(mask, 3).sum()) > int(mask.sum()) > int(inner.sum())
    assert math.isclose(float(inner.double().sum()), 63)
