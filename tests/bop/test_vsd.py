"""VSD on squares that can be counted by hand, and on random scenes against rays traced by Embree."""

import logging
import math

import numpy as np
import pytest
import torch
import trimesh
from bop_files import OBJECTS, csv_row, metres, random_pose, write_depth, write_models, write_scene
from scipy.spatial.transform import Rotation

from physpose_torch.bop import vsd as module
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import read_estimates
from physpose_torch.bop.metrics import evaluate
from physpose_torch.bop.vsd import VISIBILITY_TOLERANCE, VSD_TAUS, VSD_THRESHOLDS, vsd
from physpose_torch.errors import DataError, InvalidInputError

K = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]], dtype=torch.float64)
# at a distance of 1 m it covers the pixels 40 to 59 in both directions
SQUARE = torch.tensor([[-0.105, -0.105, 0], [0.095, -0.105, 0], [0.095, 0.095, 0], [-0.105, 0.095, 0]]).double()
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])
UNKNOWN = torch.zeros(100, 120, dtype=torch.float64)


def at(x=0.0, y=0.0, z=1.0):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([x, y, z])
    return T


def square(est, gt=None, depth=UNKNOWN, diameter=1.0, **options):
    gt = at() if gt is None else gt
    return vsd(est[None], gt[None], depth, K, SQUARE, FACES, diameter, **options)[0, 0]


def known(*parts):
    """A test depth of rectangles (rows, columns, z)."""
    depth = UNKNOWN.clone()
    for rows, columns, z in parts:
        depth[rows, columns] = z
    return depth


# By hand


def test_a_pose_has_no_discrepancy_to_itself():
    assert square(at()).tolist() == [0] * 10
    assert square(at(), depth=known((slice(None), slice(None), 1.0))).tolist() == [0] * 10


@pytest.mark.parametrize("step", [1, 5, 19, 20, 40])
def test_a_square_shifted_in_its_plane_misses_what_is_not_covered_twice(step):
    overlap = max(0, 20 - step)
    expected = 1 - overlap / (40 - overlap)
    assert square(at(x=step / 100)).tolist() == pytest.approx([expected] * 10)
    assert square(at(y=-step / 100)).tolist() == pytest.approx([expected] * 10)


def test_a_square_shifted_along_the_ray_is_wrong_up_to_the_tolerance_that_it_exceeds():
    # 1.1 m away it covers 18 × 18 pixels, each 0.1 m × (length of its ray at z = 1) too far: 0.1 to 0.1005 m
    error = square(at(z=1.1))
    assert error.tolist() == pytest.approx([1, 1] + [1 - 18 * 18 / 400] * 8)


def test_distance_is_measured_from_the_centre_of_the_camera_not_along_its_axis():
    corner = math.hypot(0.1, 0.1, 1)  # the ray of pixel (40, 40), the longest
    error = square(at(z=1.1), taus=np.array([0.1, 0.1001, 0.1 * corner + 1e-9]))
    assert error[0] == 1
    assert 1 > error[1] > error[2] == pytest.approx(1 - 324 / 400)


def test_a_pixel_as_far_off_as_the_tolerance_is_wrong():
    dot = SQUARE * 0.01  # one pixel, the principal point: its ray is the axis
    errors = vsd(at(z=1.25)[None], at()[None], UNKNOWN, K, dot, FACES, 1.0)[0, 0]
    assert errors.tolist() == [1] * 5 + [0] * 5  # 0.25 is wrong at τ = 0.25
    assert vsd(at(z=1.25)[None], at()[None], UNKNOWN, K, dot, FACES, 0.5)[0, 0].tolist() == [1] * 10


def test_what_another_object_hides_does_not_count():
    # its left half is hidden; the estimate, 5 pixels to the right, shows 15 columns, 10 of them right
    occluded = known((slice(40, 60), slice(40, 60), 1.0), (slice(0, 100), slice(0, 50), 0.5))
    assert square(at(x=0.05), depth=occluded).tolist() == pytest.approx([1 - 10 / 15] * 10)
    # 5 pixels to the left the estimate shows the columns 50 to 54
    assert square(at(x=-0.05), depth=occluded).tolist() == pytest.approx([1 - 5 / 10] * 10)


def test_where_the_ground_truth_is_visible_an_estimate_behind_it_is_too():
    behind = at(z=1.1)  # 18 × 18 pixels, all of them behind the test depth
    depth = known((slice(None), slice(None), 1.0))
    assert square(behind, depth=depth)[-1] == pytest.approx(1 - 324 / 400)
    # what sticks out is hidden by the table at 1 m: 13 of the 20 columns are in both, nothing more in the union
    out = behind @ at(x=0.055, z=0.0)
    columns = [u for u in range(120) if -0.105 + 0.055 < (u - 50) / 100 * 1.1 < 0.095 + 0.055 and u < 60]
    assert square(out, depth=depth)[-1] == pytest.approx(1 - 18 * len(columns) / 400)


@pytest.mark.parametrize(("gap", "shown"), [(0.0149, True), (0.0151, False)])
def test_a_surface_is_visible_up_to_15_mm_behind_the_test_depth(gap, shown):
    assert VISIBILITY_TOLERANCE == 0.015
    dot = SQUARE * 0.01
    errors = vsd(at()[None], at()[None], known((slice(None), slice(None), 1 - gap)), K, dot, FACES, 1.0)
    assert errors[0, 0].tolist() == [0.0 if shown else 1.0] * 10  # nothing visible of either: wrong


def test_without_depth_everything_is_visible():
    half = known((slice(0, 100), slice(0, 50), 0.5))  # right of it: unknown
    assert square(at(x=0.05), depth=half).tolist() == pytest.approx([1 - 10 / 15] * 10)
    assert square(at(x=0.05)).tolist() == pytest.approx([1 - 15 / 25] * 10)


def test_recall_counts_errors_below_the_threshold_not_at_it():
    from physpose_torch.bop.matching import match_greedily

    error = square(at(x=0.05))[0]  # 1 - 300 / 500
    assert error == 0.4 == VSD_THRESHOLDS[7]
    assert (match_greedily(np.array([[error]]), VSD_THRESHOLDS) >= 0).sum() == 2


# Off the image


@pytest.mark.parametrize(
    "T",
    [at(z=-1), at(x=5), at(x=-5), at(y=5), at(y=-5), at(z=0), at(z=1e-4), at(z=1e9), at(x=1e12), at(x=1e300, z=1e-2)],
)
def test_an_estimate_off_the_image_or_behind_the_camera_is_wrong(T):
    assert square(T).tolist() == [1] * 10
    assert square(at(), gt=T).tolist() == [1] * 10
    assert square(T, gt=T).tolist() == [1] * 10 or T[2, 3] > 1e6  # too far to be seen twice alike, or nothing seen


def test_a_pose_half_in_front_of_the_camera_is_drawn():
    box = trimesh.creation.box(extents=[0.2, 0.2, 0.2])
    vertices, faces = torch.from_numpy(np.array(box.vertices)), torch.from_numpy(np.array(box.faces))
    inside = at(z=0.02)  # the camera is in the box, and sees its far side everywhere
    assert vsd(inside[None], inside[None], UNKNOWN, K, vertices, faces, 0.3)[0, 0].tolist() == [0] * 10
    far_side = at(z=0.22)  # its front is where the far side of the other is
    assert vsd(far_side[None], inside[None], UNKNOWN, K, vertices, faces, 0.3)[0, 0, -1] < 0.5


def test_all_pairs_of_poses_come_back_and_wrong_shapes_are_named():
    T = torch.stack([at(), at(x=0.05), at(x=0.1)])
    errors = vsd(T, T[:2], UNKNOWN, K, SQUARE, FACES, 1.0)
    assert errors.shape == (3, 2, 10)
    assert errors[:, :, 0] == pytest.approx(np.array([[0, 0.4], [0.4, 0], [1 - 10 / 30, 0.4]]))
    assert vsd(T[:0], T, UNKNOWN, K, SQUARE, FACES, 1.0).shape == (0, 3, 10)
    with pytest.raises(InvalidInputError, match=r"T_est \(4, 4\)"):
        vsd(T[0], T, UNKNOWN, K, SQUARE, FACES, 1.0)
    with pytest.raises(InvalidInputError, match="diameter 0"):
        vsd(T, T, UNKNOWN, K, SQUARE, FACES, 0)


# Against rays


def traced(meshes, K, size):
    """Distances (H, W) of the nearest of some meshes in the camera frame, by Embree; 0 where there is none."""
    v, u = np.mgrid[: size[0], : size[1]].reshape(2, -1)
    rays = np.stack([u, v, np.ones_like(u)], 1) @ np.linalg.inv(K).T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    out = np.zeros(len(rays))
    mesh = trimesh.util.concatenate(meshes)
    hits, index, _ = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh).intersects_location(
        np.zeros_like(rays), rays, multiple_hits=False
    )
    out[index] = np.linalg.norm(hits, axis=1)
    return out.reshape(size)


def plain_vsd(est, gt, test, diameter):
    """The formulas of the paper on whole images of distances."""
    visible_gt = (gt > 0) & ((gt - test <= 0.015) | (test == 0))
    visible_est = (est > 0) & ((est - test <= 0.015) | (test == 0) | visible_gt)
    both, any_of_them = visible_gt & visible_est, visible_gt | visible_est
    if not any_of_them.any():
        return np.ones(10)
    return np.array([((~both | (np.abs(est - gt) / diameter >= t)) & any_of_them).sum() for t in VSD_TAUS]) / (
        any_of_them.sum()
    )


@pytest.mark.parametrize("seed", range(6))
def test_errors_equal_those_of_traced_rays_with_occluders_and_holes(seed):
    pytest.importorskip("embreex")
    rng = np.random.default_rng(seed)
    size, K = (150, 200), np.array([[300.0, 0, 95], [0, 320, 80], [0, 0, 1]])
    model = trimesh.creation.annulus(0.03, 0.06, 0.08) if seed % 2 else trimesh.creation.icosphere(3, 0.06)
    model = model if seed % 2 else model.apply_scale([1, 0.6, 1.3])
    if seed == 5:
        model.update_faces(np.arange(len(model.faces)) % 7 > 0)  # an open surface: backs show through
    T_gt = np.eye(4)
    T_gt[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T_gt[:3, 3] = rng.uniform([-0.1, -0.08, 0.5], [0.1, 0.08, 0.7])
    T_est = np.stack([T_gt] * 4)
    T_est[:, :3, 3] += rng.normal(size=(4, 3)) * [0.01, 0.01, 0.03]
    T_est[2:, :3, :3] = T_gt[:3, :3] @ Rotation.from_rotvec(rng.normal(size=(2, 3)) * 0.6).as_matrix()
    place = trimesh.transformations.translation_matrix(T_gt[:3, 3] * 0.8 + rng.normal(size=3) * 0.02)
    occluder = trimesh.creation.box(extents=[0.04, 0.03, 0.05], transform=place)
    wall = trimesh.creation.box(extents=[9, 9, 0.01]).apply_translation([0, 0, 0.68])
    alone = [traced([model.copy().apply_transform(T)], K, size) for T in [T_gt, *T_est]]
    test = traced([model.copy().apply_transform(T_gt), occluder, wall], K, size)
    test[rng.uniform(size=size) < 0.1] = 0
    v, u = np.mgrid[: size[0], : size[1]]
    ray = np.linalg.norm(np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T, axis=-1)
    diameter = 0.1
    expected = np.stack([plain_vsd(est, alone[0], test, diameter) for est in alone[1:]])
    arrays = (T_est, T_gt[None], test / ray, K, np.array(model.vertices), np.array(model.faces))
    errors = vsd(*(torch.from_numpy(np.array(x)) for x in arrays), diameter)[:, 0]
    border = 0.01  # Embree computes in float32
    np.testing.assert_allclose(errors, expected, atol=border)
    assert 0.05 < errors.mean() < 0.95
    assert len(np.unique(errors.round(3))) > 8


# Speed and memory


def solid(name):
    mesh = {"sphere": trimesh.creation.icosphere(3, 0.06), "ring": trimesh.creation.annulus(0.03, 0.06, 0.08)}[name]
    return torch.from_numpy(np.array(mesh.vertices)), torch.from_numpy(np.array(mesh.faces))


@pytest.mark.parametrize("name", ["sphere", "ring"])
def test_faces_left_out_are_those_that_are_not_seen(name, rng):
    vertices, faces = solid(name)
    surface = module._surface(vertices, faces)
    assert surface.closed
    for _ in range(10):
        T = metres(random_pose(rng))
        quick, slow = (module._view(T, s, K * 5, (500, 500)) for s in (surface, surface._replace(closed=False)))
        np.testing.assert_allclose(quick.distance, slow.distance, atol=1e-12)


def test_only_closed_surfaces_wound_outwards_lose_their_backs():
    vertices, faces = solid("ring")
    assert not module._surface(vertices, faces[:, [0, 2, 1]]).closed
    assert not module._surface(vertices, faces[1:]).closed
    assert not module._surface(SQUARE, FACES).closed
    two = torch.cat([vertices, vertices + 1])
    assert module._surface(two, torch.cat([faces, faces + len(vertices)])).closed
    assert not module._surface(two, torch.cat([faces, faces[:, [0, 2, 1]] + len(vertices)])).closed


def test_a_large_image_costs_what_the_object_covers(monkeypatch):
    sizes, draw = [], module.fragments

    def counting(points, faces, K, height, width, **options):
        sizes.append((height, width))
        return draw(points, faces, K, height, width, **options)

    monkeypatch.setattr(module, "fragments", counting)
    depth = torch.zeros(3000, 4000, dtype=torch.float64)
    shifted = torch.tensor([[1.0, 0, 3000], [0, 1, 1500], [0, 0, 1]], dtype=torch.float64) @ K
    errors = vsd(at(x=0.05)[None], at()[None], depth, shifted, SQUARE, FACES, 1.0)
    assert errors[0, 0].tolist() == pytest.approx([0.4] * 10)
    assert sizes == [(20, 20), (20, 20)]


def test_an_object_that_fills_a_large_image_is_drawn_in_pieces(monkeypatch):
    monkeypatch.setattr(module, "_LARGE", 0)
    monkeypatch.setattr(module, "fragments", None)
    assert square(at(x=0.05)).tolist() == pytest.approx([0.4] * 10)


# Datasets


SIZE = (480, 640)


def place(x, y, z):
    T = np.eye(4)
    T[:3, 3] = [x, y, z]
    return T


TRUTH = {
    (1, 1): [
        (1, place(-60, 0, 700)),
        (9, place(60, 10, 650)),
        (9, place(-30, 20, 500)),
    ],  # the last hides most of the first
    (1, 5): [(1, place(0, 0, 800)), (4, place(100, 0, 800))],
    (6, 1): [(4, place(0, 0, 900))],
}


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "boxes"
    write_models(root / "models")
    for scene in (1, 6):
        images = {im: [(o, T, 1.0) for o, T in rows] for (s, im), rows in TRUTH.items() if s == scene}
        write_scene(root / "test", scene, images, width=640)
    return root


def true_depth(scene, im):
    """What the camera sees of the boxes, upright ones: (H, W) [m]; the background is 2 m away."""
    meshes = [
        trimesh.creation.box(extents=OBJECTS[o][0]).apply_transform(T).apply_scale(1e-3) for o, T in TRUTH[scene, im]
    ]
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    matrix = np.array([600.0, 0, 330, 0, 610, 236, 0, 0, 1]).reshape(3, 3)
    ray = np.linalg.norm(np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(matrix).T, axis=-1)
    z = traced(meshes, matrix, SIZE) / ray
    return np.where(z > 0, z, 2.0)


def with_depth(root, *images):
    for scene, im in images:
        write_depth(root / "test" / f"{scene:06d}", im, true_depth(scene, im))
    return BopDataset(root)


def truth_csv(write_csv, move=lambda T: T):
    rows = [csv_row(s, im, o, 1, move(T)) for (s, im), objects in TRUTH.items() for o, T in objects]
    return read_estimates(write_csv(*rows))


@pytest.mark.parametrize("depth", ["auto", "rendered"])
def test_ground_truth_scores_one_everywhere(folder, write_csv, depth):
    dataset = with_depth(folder, *TRUTH) if depth == "auto" else BopDataset(folder)
    seen = []
    scores = evaluate(truth_csv(write_csv), dataset, vsd_depth=depth, on_image=lambda: seen.append(1))
    assert len(seen) == 3
    assert (scores.ar, scores.ar_vsd, scores.vsd.targets, scores.vsd.images) == (1, 1, 6, 3)
    assert (scores.vsd.recall == 1).all()
    assert scores.vsd.depth == depth
    assert (scores.vsd.vsd == 0).all()
    for per in (scores.per_object, scores.per_scene, scores.per_image):
        assert all(recall.ar_vsd == 1 for recall in per.values())
    content = scores.to_dict()
    assert content["vsd"] == {"depth": depth, "targets": 6, "images": 3}
    assert content["recall_vsd"][0.05] == dict.fromkeys(VSD_THRESHOLDS.tolist(), 1.0)
    assert content["per_object"][9]["vsd_targets"] == 2


def test_rendered_and_measured_depth_agree_where_there_is_nothing_else(folder, write_csv):
    def move(T):
        return place(*(T[:3, 3] + [3, -2, 12]))

    estimates = truth_csv(write_csv, move)
    rendered = evaluate(estimates, BopDataset(folder), vsd_depth="rendered")
    measured = evaluate(estimates, with_depth(folder, *TRUTH), vsd_depth="auto")
    np.testing.assert_allclose(rendered.vsd.vsd, measured.vsd.vsd, atol=0.02)
    assert 0.2 < rendered.ar_vsd < 0.95
    assert rendered.ar == pytest.approx((rendered.ar_vsd + rendered.ar_mssd + rendered.ar_mspd) / 3)
    for per in (rendered.per_object, rendered.per_scene, rendered.per_image):
        mean = sum(recall.ar_vsd * recall.targets for recall in per.values()) / rendered.targets
        assert mean == pytest.approx(rendered.ar_vsd)
    assert rendered.vsd.recall.mean() == pytest.approx(rendered.ar_vsd)


def test_with_some_depth_images_vsd_is_over_their_targets(folder, write_csv):
    dataset = with_depth(folder, (1, 5))
    estimates = truth_csv(write_csv)
    scores = evaluate(estimates, dataset, vsd_depth="auto")
    assert (scores.ar_vsd, scores.ar, scores.vsd.targets, scores.vsd.images, scores.targets) == (1, None, 2, 1, 6)
    assert scores.per_scene[1].ar_vsd == 1
    assert scores.per_scene[6].ar_vsd is None
    assert scores.vsd.per_scene == {1: 2}
    assert scores.vsd.per_object == {1: 1, 4: 1}
    assert [(key, r.ar_vsd) for key, r in scores.per_image.items()] == [((1, 1), None), ((1, 5), 1), ((6, 1), None)]
    assert np.isnan(scores.vsd.vsd[:, 0]).tolist() == [True, True, True, False, False, True]
    assert evaluate(estimates, dataset, vsd_depth="auto", scenes=[6]).vsd is None
    assert evaluate(estimates, dataset).vsd is None


def test_a_missing_estimate_lowers_vsd_and_a_foreign_one_does_no_harm(folder, write_csv):
    dataset = with_depth(folder, (1, 5))
    rows = [
        csv_row(1, 5, 1, 1, place(0, 0, 800)),
        csv_row(1, 5, 77, 1, place(0, 0, 800)),
        csv_row(8, 1, 1, 1, place(0, 0, 800)),
    ]
    scores = evaluate(read_estimates(write_csv(*rows)), dataset, vsd_depth="auto")
    assert scores.ar_vsd == 0.5
    assert evaluate(read_estimates(write_csv()), dataset, vsd_depth="auto").ar_vsd == 0
    assert evaluate(read_estimates(write_csv()), BopDataset(folder), vsd_depth="rendered").ar_vsd == 0


def test_instances_are_matched_by_vsd_greedily(folder, write_csv):
    dataset = with_depth(folder, (1, 1))
    swapped = [csv_row(1, 1, 9, 1, place(-30, 20, 500)), csv_row(1, 1, 9, 1, place(60, 10, 650))]
    assert evaluate(read_estimates(write_csv(*swapped)), dataset, vsd_depth="auto").per_object[9].ar_vsd == 1
    twice = [csv_row(1, 1, 9, 1, place(60, 10, 650))] * 2
    assert evaluate(read_estimates(write_csv(*twice)), dataset, vsd_depth="auto").per_object[9].ar_vsd == 0.5


def test_a_mesh_without_faces_is_named(folder, write_csv):
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(9, 3))).export(folder / "models" / "obj_000004.ply")
    with pytest.raises(DataError, match=r"obj_000004.ply: the mesh has no faces"):
        evaluate(truth_csv(write_csv), BopDataset(folder), vsd_depth="rendered")


def test_an_unknown_kind_of_depth_is_refused(folder, write_csv):
    with pytest.raises(InvalidInputError, match="vsd_depth is 'gt'"):
        evaluate(truth_csv(write_csv), BopDataset(folder), vsd_depth="gt")


def test_rendered_depth_of_unknown_size_warns(folder, write_csv, caplog):
    (folder / "camera.json").unlink()
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        assert evaluate(truth_csv(write_csv), BopDataset(folder), vsd_depth="rendered").ar == 1
    assert "480 px high" in caplog.text


@pytest.mark.data
def test_two_frames_of_ycbv_have_depth(ycbv, write_csv):
    dataset = BopDataset(ycbv)
    estimates = read_estimates(ycbv / "estimates" / "megapose_ycbv-test.csv")
    scores = evaluate(estimates, dataset, vsd_depth="auto", scenes=[51, 54])
    assert (scores.vsd.targets, scores.vsd.images, scores.ar) == (10, 2, None)
    assert scores.per_image[51, 1].ar_vsd == pytest.approx(0.612, abs=0.01)
    assert scores.per_image[54, 1].ar_vsd == pytest.approx(0.710, abs=0.01)
    scaled = estimates.T_camera_object.clone()
    scaled[:, :3, 3] *= 0.976  # the common depth factor of these estimates
    better = evaluate(estimates, dataset, poses=scaled, vsd_depth="auto", scenes=[51, 54])
    assert better.ar_vsd > scores.ar_vsd + 0.05
    rows = []
    for scene in (51, 54):
        gt = dataset.ground_truth(scene)
        of_image = np.flatnonzero(gt.im_id == 1)
        T = gt.T_camera_object.numpy() * np.array([1, 1, 1, 1000.0])
        rows += [csv_row(scene, 1, gt.obj_id[k], 1, T[k]) for k in of_image]
    assert evaluate(read_estimates(write_csv(*rows)), dataset, vsd_depth="auto", scenes=[51, 54]).ar_vsd == 1
