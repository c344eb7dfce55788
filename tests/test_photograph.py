"""The generated photographs show what their ground truth says, to a twentieth of a pixel, and nothing impossible."""

from functools import cache

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from physpose_torch import photograph, printed, se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.household import HOUSEHOLD_COLORS, household_meshes
from physpose_torch.photograph import TABLES, household_pair
from physpose_torch.render import render

pytestmark = pytest.mark.slow  # half a minute of rendering each; the estimator's tests render some, too

SHAPES = household_meshes()
WELL = 0.004  # of the plate: what stands on it stands so far above the table [m]


@cache
def pair(seed, **options):
    return household_pair(seed, **options)


def project(K, points):
    pixels = points @ K.numpy().T
    return pixels[:, :2] / pixels[:, 2:]


def colors_at(image, pixels, sigma=0.0):
    """Bilinear samples (M, 3) at pixels (M, 2), of the image as seen a little out of focus."""
    image = gaussian_filter(image.numpy().astype(float), (sigma, sigma, 0))
    return np.stack([map_coordinates(image[..., c], pixels[:, ::-1].T, order=1) for c in range(3)], -1)


def objects_in_view(p, view):
    """Index of the object at each pixel, -1 on table and floor, and its depth (H, W)."""
    height, width = p.images[view].shape[:2]
    vertices, faces, owner, count = [], [], [], 0
    for k, (name, T) in enumerate(zip(p.names, p.T_camera_object[view], strict=True)):
        vertices.append(se3.apply(T, torch.from_numpy(np.array(SHAPES[name].vertices))))
        faces.append(torch.from_numpy(np.array(SHAPES[name].faces)) + count)
        owner.append(torch.full((len(faces[-1]),), k))
        count += len(vertices[-1])
    seen = render(torch.cat(vertices), torch.cat(faces), p.K, height, width)
    return torch.where(seen.face_id < 0, -1, torch.cat(owner)[seen.face_id]).numpy(), seen.depth.numpy()


def into_view1(p, points):
    return se3.apply(p.T_view1_view0, torch.from_numpy(points)).numpy()


def table_points(p, n=4000):
    """Points (M, 3) of the table, view 0's frame, near the objects but seen in both views with no object close by."""
    height, width = p.images[0].shape[:2]
    pixels = np.random.default_rng(0).uniform([5, height * 0.35], [width - 6, height - 6], (n, 2))
    rays = np.concatenate([pixels, np.ones((n, 1))], 1) @ np.linalg.inv(p.K.numpy()).T
    points = rays * (p.offset / (rays @ p.normal.numpy()))[:, None]
    middle = p.T_camera_object[0][:, :3, 3].mean(0).numpy()
    keep = np.linalg.norm(points - middle, axis=1) < 0.35  # the table may end further out
    for view in range(2):
        seen = project(p.K, points if view == 0 else into_view1(p, points))
        keep &= ((seen > 5) & (seen < [width - 6, height - 6])).all(1)
        objects = gaussian_filter((objects_in_view(p, view)[0] >= 0).astype(float), 4)
        keep &= map_coordinates(objects, seen[:, ::-1].T, order=1) < 1e-3
    return points[keep]


@pytest.mark.parametrize("table", ["wood", "print"])
def test_points_of_the_table_look_alike_in_both_views(table):
    p = pair(1, table=table)
    points = table_points(p)
    assert len(points) > 300
    a = colors_at(p.images[0], project(p.K, points), 1.0)
    b = colors_at(p.images[1], project(p.K, into_view1(p, points)), 1.0)
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > (0.97 if table == "print" else 0.99)
    assert np.median(np.abs(a - b)) < 3
    assert np.median(a / b) == pytest.approx(1.02 ** (1 / 2.2), abs=0.004)  # the exposures differ by 2 %
    shifted = colors_at(p.images[1], project(p.K, into_view1(p, points)) + np.array([4, 0]), 1.0)
    assert np.abs(a - shifted).mean() > 1.5 * np.abs(a - b).mean()  # and the test would see it if they did not


def test_points_of_the_objects_look_alike_in_both_views_and_as_their_meshes_are_coloured():
    p = pair(1, table="wood")
    both, own = [], []
    for k, name in enumerate(p.names):
        vertices = np.random.default_rng(0).permutation(len(p.meshes[name].vertices))[:4000]
        points = torch.from_numpy(p.meshes[name].vertices[vertices])
        keep, colors = np.ones(len(points), bool), []
        for view in range(2):
            at = se3.apply(p.T_camera_object[view][k], points).numpy()
            index, depth = objects_in_view(p, view)
            pixels = project(p.K, at)
            column, row = pixels.round().astype(int).T
            keep &= (index[row, column] == k) & (np.abs(depth[row, column] - at[:, 2]) < 0.002)
            colors.append(colors_at(p.images[view], pixels, 0.7))
        both.append([c[keep] for c in colors])
        own.append(p.meshes[name].visual.vertex_colors[vertices[keep], :3])
    a, b = (np.concatenate(c) for c in zip(*both, strict=True))
    assert len(a) > 2000
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.95
    assert np.median(np.abs(a - b)) < 5
    for name, (c, _), o in zip(p.names, both, own, strict=True):
        if name in ("box", "bottle"):  # strongly coloured
            assert np.corrcoef(c.ravel(), o.ravel())[0, 1] > 0.85


def linear_profile(image, row, column, reach=9):
    """Light along a row about a column, and the columns."""
    x = np.arange(round(column) - reach, round(column) + reach + 1)
    return (image[row, x].numpy().mean(1) / 255) ** 2.2, x


def edge_at(image, row, column):
    """Column of the step between a dark and a bright side, from the area under the profile (any symmetric blur)."""
    profile, x = linear_profile(image, row, column)
    if profile[0] > profile[-1]:
        return -edge_of(profile[::-1], -x[::-1])
    return edge_of(profile, x)


def edge_of(profile, x):
    dark, bright = profile[:4].mean(), profile[-4:].mean()
    return x[-1] + 0.5 - ((profile - dark) / (bright - dark)).sum()


@pytest.mark.parametrize("size", [(640, 480), (501, 377)])
@pytest.mark.parametrize("axis", [0, 1])
def test_pixel_centres_are_at_integers(size, axis):
    """A line on the table and an edge of a box, upright or level in the image, are where their points project to."""
    width, height = size
    K = torch.tensor([[0.95 * width, 0, 0.5 * width + 3.3], [0, 0.95 * width, 0.5 * height - 2.6], [0, 0, 1]]).double()
    _, (vertices, faces, normals, colors) = printed.coloured("box", np.random.default_rng(0))
    box = vertices, faces, normals, torch.full_like(colors, 0.95)
    top = np.zeros((*(printed.TOP_SIZE[::-1] / printed.TEXEL).round().astype(int), 3))
    top[:, top.shape[1] // 2 :] = 0.9  # bright where x > 0
    T_box = torch.eye(4, dtype=torch.float64)
    T_box[:3, 3] = torch.tensor([-0.2, 0.1, 0.105])
    T = torch.eye(4, dtype=torch.float64)
    s, c = np.sin(0.7), np.cos(0.7)
    roll = se3.exp_so3(torch.tensor([0.0, 0, 0.04 + axis * np.pi / 2], dtype=torch.float64))
    T[:3, :3] = roll @ torch.tensor([[1, 0, 0], [0, -s, -c], [0, c, -s]])
    T[:3, 3] = roll @ torch.tensor([0.06, 0.04, 0.8], dtype=torch.float64)
    ground = top, np.full((8, 8, 3), 0.1), np.zeros(2)
    rng = np.random.default_rng(0)
    image, _ = photograph._photograph(["box"], [box], T_box[None], [T.numpy()] * 2, K, height, width, ground, rng, 0.0)
    image = image.transpose(0, 1) if axis else image

    for line, tolerance in (
        ([[0, -0.20, 0], [0, -0.05, 0]], 0.01),
        ([[-0.279, 0.07, 0.06], [-0.279, 0.07, 0.16]], 0.02),  # front left of the box
    ):
        (x0, y0), (x1, y1) = project(K, se3.apply(T, torch.tensor(line).double()).numpy())[:, [axis, 1 - axis]]
        rows = np.arange(round(min(y0, y1)) + 2, round(max(y0, y1)) - 1)
        errors = [
            edge_at(image, row, x) - x for row, x in zip(rows, x0 + (rows - y0) / (y1 - y0) * (x1 - x0), strict=True)
        ]
        assert len(errors) > 25
        assert abs(np.mean(errors)) < tolerance  # half a sample off would be 0.25
        assert np.abs(errors).max() < 0.25  # one row, with two samples across a pixel


def test_the_same_arguments_give_the_same_images_and_others_do_not():
    options = dict(table="print", objects=3, width=160, height=120)
    a, b, c = (household_pair(seed, **options) for seed in (5, 5, 6))
    assert all(torch.equal(x, y) for x, y in zip(a.images, b.images, strict=True))
    assert torch.equal(a.T_camera_object[1], b.T_camera_object[1])
    assert not torch.equal(a.images[0], c.images[0])
    assert not torch.equal(a.images[0], a.images[1])


@pytest.fixture(scope="module")
def many():
    """Arrangements of all sizes, in small images."""
    small = dict(width=96, height=72)
    pairs = [household_pair(seed, objects=1 + seed, **small) for seed in range(7)]
    return pairs + [household_pair(seed, objects=k, stacked=False, **small) for seed, k in ((3, 7), (4, 4), (5, None))]


def test_every_object_stands_exactly_on_its_support_in_both_views(many):
    for p in many:
        normals = p.normal, p.T_view1_view0[:3, :3] @ p.normal
        offsets = p.offset, p.offset + float(normals[1] @ p.T_view1_view0[:3, 3])
        for T, normal, offset in zip(p.T_camera_object, normals, offsets, strict=True):
            heights = {
                name: p.meshes[name].vertices @ (T[k, :3, :3].T @ normal).numpy() + float(T[k, :3, 3] @ normal) - offset
                for k, name in enumerate(p.names)
            }
            for name, support in zip(p.names, p.supports, strict=True):
                if support == "table":
                    level = 0.0
                else:
                    level = WELL if support == "plate" else heights[support].max()
                assert heights[name].min() == pytest.approx(level, abs=1e-9), (name, support)


def test_both_views_show_the_same_objects_in_place(many):
    for p in many:
        torch.testing.assert_close(p.T_view1_view0 @ p.T_camera_object[0], p.T_camera_object[1])
        se3.check_rigid(p.T_camera_object[0], "T")
        assert p.normal.norm().item() == pytest.approx(1, abs=1e-12)
        elevation = np.degrees(np.arcsin(-p.normal[2].item()))
        assert 23 < elevation < 62
        assert 0.5 < p.T_camera_object[0][:, :3, 3].mean(0).norm().item() < 1.1


def test_subsets_are_physically_closed_and_of_the_size_asked_for(many):
    for k, p in enumerate(many[:7]):
        assert len(p.names) == 1 + k
        assert set(p.supports) <= {"table", *p.names}
        assert any(s != "table" for s in p.supports) == (len(p.names) > 1)
        assert list(p.meshes) == p.names
    for p, n in zip(many[7:], (7, 4, None), strict=True):
        assert set(p.supports) == {"table"}
        assert n is None or len(p.names) == n
    assert len({tuple(sorted(p.names)) for p in many}) > 6


def test_the_objects_asked_for_are_there_even_without_their_usual_support():
    p = household_pair(2, objects=["can", "mug", "banana", "bowl", "bottle"], width=96, height=72)
    assert set(p.names) == {"can", "mug", "banana", "bowl", "bottle"}
    assert set(p.supports) == {"table"}


def test_no_two_objects_interpenetrate(many):
    import trimesh

    for p in many:
        manager = trimesh.collision.CollisionManager()
        for name, T, support in zip(p.names, p.T_camera_object[0].numpy(), p.supports, strict=True):
            lift = 0.0 if support == "table" else 1e-4  # surfaces in contact also count as colliding
            T = T.copy()
            T[:3, 3] += lift * p.normal.numpy()
            manager.add_object(name, SHAPES[name], T)
        hit, names = manager.in_collision_internal(return_names=True)
        assert not hit, names


@pytest.mark.parametrize("seed", range(4))
def test_every_object_is_visible_in_both_views(seed):
    p = household_pair(seed, width=160, height=120)
    for view in range(2):
        together, _ = objects_in_view(p, view)
        for k, name in enumerate(p.names):
            vertices = se3.apply(p.T_camera_object[view][k], torch.from_numpy(np.array(SHAPES[name].vertices)))
            pixels = project(p.K, vertices.numpy())
            assert (pixels > 0).all()
            assert (pixels < [159, 119]).all()
            alone = render(vertices, torch.from_numpy(np.array(SHAPES[name].faces)), p.K, 120, 160).face_id >= 0
            assert (together == k).sum() >= 0.3 * alone.sum().item(), (view, name)


def test_the_baseline_is_the_one_asked_for_or_12_to_20_degrees(many):
    def azimuth(p):
        R, up = p.T_view1_view0[:3, :3].numpy(), p.normal.numpy()
        a, b = np.array([0, 0, 1.0]), R.T @ [0, 0, 1.0]  # both optical axes in view 0
        a, b = (v - (v @ up) * up for v in (a, b))
        return np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))

    assert all(11.9 < azimuth(p) < 20.1 for p in many)
    for degrees in (0.0, 5.0, 35.0):
        p = household_pair(1, objects=2, baseline_deg=degrees, width=96, height=72)
        assert azimuth(p) == pytest.approx(degrees, abs=1e-4)


def test_only_the_plain_table_has_no_texture():
    def texture(table):
        p = pair(1, table=table)
        image = gaussian_filter(p.images[0].numpy().astype(float), (2, 2, 0))  # without its noise
        local = image - gaussian_filter(image, (8, 8, 0))
        # the median passes over the few points at a shadow's edge
        return np.median(np.abs(colors_at(torch.from_numpy(local), project(p.K, table_points(p)))))

    spread = {table: texture(table) for table in TABLES}
    assert spread["plain"] < 0.5
    assert 1.3 * spread["plain"] < spread["laminate"] < 4
    assert min(spread["wood"], spread["checked"], spread["print"]) > 2.5


def test_noise_has_the_stated_size():
    options = dict(table="plain", objects=2, width=320, height=240)
    noisy, clean = (household_pair(3, noise=n, **options).images[0].float() for n in (1.7, 0.0))
    difference = (noisy - clean)[(clean > 110) & (clean < 150)]
    assert difference.std().item() == pytest.approx(1.7, rel=0.1)
    assert difference.mean().item() == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("name", HOUSEHOLD_COLORS)
def test_meshes_are_the_household_shapes_with_colours_two_millimetres_apart(name):
    mesh, _ = printed.coloured(name, np.random.default_rng(0))
    np.testing.assert_array_equal(mesh.bounds, SHAPES[name].bounds)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(SHAPES[name].volume, rel=1e-9)
    assert mesh.area == pytest.approx(SHAPES[name].area, rel=1e-9)
    assert mesh.edges_unique_length.max() <= 0.002
    assert mesh.visual.kind == "vertex"
    other, _ = printed.coloured(name, np.random.default_rng(1))
    assert not np.array_equal(mesh.visual.vertex_colors, other.visual.vertex_colors)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(table="oak"), "table = 'oak', expected one of wood, laminate"),
        (dict(objects=0), "objects = 0, expected 1 to 7"),
        (dict(objects=8), "objects = 8, expected 1 to 7"),
        (dict(objects=["can", "fork"]), r"objects = \['can', 'fork'\], expected .* out of \['mug'"),
        (dict(objects="can"), "objects = 'can', expected a list"),
        (dict(objects=["can", "can"]), "different names"),
        (dict(objects=[]), "expected a list"),
        (dict(baseline_deg=90), "baseline_deg = 90, expected 0 to 60"),
        (dict(width=10), "10 x 480, expected at least"),
        (dict(noise=-1.0), "noise = -1.0, expected 0 to 64"),
        (dict(seed=-1), "seed = -1, expected an integer"),
        (dict(width=1200, height=64), "no two cameras see all"),
    ],
)
def test_bad_arguments_are_named(options, message):
    with pytest.raises(InvalidInputError, match=message):
        household_pair(**options)
