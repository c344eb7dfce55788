"""BOP19's rules, each on an example that can be checked by hand, and all together against plain loops."""

import json
import logging
import math

import numpy as np
import pytest
import torch
from bop_files import OBJECTS, K, csv_row, metres, random_pose, write_models, write_scene

from physpose_torch.bop import pose_error
from physpose_torch.bop.dataset import BopDataset, symmetry_transforms
from physpose_torch.bop.formats import read_estimates
from physpose_torch.bop.metrics import (
    MSPD_THRESHOLDS,
    MSSD_THRESHOLDS,
    errors_against_gt,
    evaluate,
    match_greedily,
    mspd,
    mssd,
)
from physpose_torch.bop.residuals import distribution
from physpose_torch.errors import DataError, InvalidInputError

EYE = torch.eye(4, dtype=torch.float64)
K3 = torch.tensor(K, dtype=torch.float64).reshape(3, 3)


def at(x=0.0, y=0.0, z=1.0, turn_deg=0.0):
    """T_camera_object, turned about z [m]."""
    T = EYE.clone()
    a = math.radians(turn_deg)
    T[:2, :2] = torch.tensor([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]], dtype=T.dtype)
    T[:3, 3] = torch.tensor([x, y, z], dtype=T.dtype)
    return T


# The errors


def test_mssd_is_the_greatest_distance_of_a_vertex():
    vertices = torch.tensor([[0.1, 0, 0], [-0.2, 0, 0]], dtype=torch.float64)
    assert mssd(at(), at(x=0.03), vertices, EYE[None]) == pytest.approx(0.03)
    assert mssd(at(), at(turn_deg=90), vertices, EYE[None]) == pytest.approx(0.2 * math.sqrt(2))
    assert mssd(at(), at(turn_deg=180), vertices, EYE[None]) == pytest.approx(0.4)


def test_mspd_is_the_greatest_distance_of_a_vertex_in_the_image():
    vertices = torch.tensor([[0.0, 0, 0], [0, 0, 0.5]], dtype=torch.float64)
    assert mspd(at(), at(x=0.01), K3, vertices, EYE[None]) == pytest.approx(6.0)  # 600 px * 0.01 / 1
    assert mspd(at(), at(z=2), K3, vertices, EYE[None]) == pytest.approx(0.0, abs=1e-9)  # on the optical axis
    assert mspd(at(y=0.1), at(y=0.1, z=2), K3, vertices, EYE[None]) == pytest.approx(30.5)  # 610 (0.1 - 0.1 / 2)


def test_a_symmetric_pose_has_no_error_and_the_symmetry_acts_in_the_object_frame():
    half = at(z=0, turn_deg=180)
    half[0, 3] = 0.004  # about an axis beside the origin
    vertices = torch.tensor([[0.1, 0.05, 0], [-0.2, 0, 0.1], [0, 0.1, -0.3]], dtype=torch.float64)
    T_gt = metres(random_pose(np.random.default_rng(1)))
    symmetries = torch.stack([EYE, half])
    assert mssd(T_gt @ half, T_gt, vertices, symmetries) == pytest.approx(0, abs=1e-12)
    assert mspd(T_gt @ half, T_gt, K3, vertices, symmetries) == pytest.approx(0, abs=1e-9)
    assert mssd(T_gt @ half, T_gt, vertices, EYE[None]) > 0.1


def plain_error(T_est, T_gt, vertices, symmetries, K=None):
    errors = []
    for S in symmetries:
        a, b = (T[:3, :3] @ vertices.T + T[:3, 3:] for T in (T_est, T_gt @ S))
        if K is not None:
            a, b = ((K @ x)[:2] / (K @ x)[2] for x in (a, b))
        errors.append(np.linalg.norm(a - b, axis=0).max())
    return min(errors)


@pytest.mark.parametrize("obj_id", OBJECTS)
@pytest.mark.parametrize("noise", [1e-3, 0.05, 3.0])
def test_errors_equal_plain_loops_over_symmetries_and_vertices(obj_id, noise, rng, monkeypatch):
    symmetries = symmetry_transforms(OBJECTS[obj_id][1], max_step=0.05)
    angle = rng.uniform(0, 2 * np.pi, 2000)  # a drum: round, so that many symmetries are nearly as good as the best
    drum = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), rng.choice([-0.03, 0.03], 2000)], axis=1)
    vertices = torch.from_numpy(drum)
    T_gt = metres([random_pose(rng) for _ in range(8)])
    twist = torch.from_numpy(rng.normal(size=(8, 3)) * noise)
    hat = torch.zeros(8, 4, 4, dtype=torch.float64)
    for (i, j), k in {(1, 2): 0, (2, 0): 1, (0, 1): 2}.items():
        hat[:, i, j], hat[:, j, i] = -twist[:, k], twist[:, k]
    hat[:, :3, 3] = torch.from_numpy(rng.normal(size=(8, 3)) * 0.02)
    T_est = T_gt @ symmetries[torch.from_numpy(rng.integers(len(symmetries), size=8))] @ torch.matrix_exp(hat)
    arrays = [list(x.numpy()) for x in (T_est, T_gt)]
    points, group = vertices.numpy(), symmetries.numpy()
    surface = [plain_error(a, b, points, group) for a, b in zip(*arrays, strict=True)]
    image = [plain_error(a, b, points, group, K3.numpy()) for a, b in zip(*arrays, strict=True)]
    for probes in (128, 1):  # with one vertex the lower bounds are as bad as can be
        monkeypatch.setattr(pose_error._outlying, "__kwdefaults__", {"count": probes})
        np.testing.assert_allclose(mssd(T_est, T_gt, vertices, symmetries), surface, rtol=1e-10, atol=1e-14)
        np.testing.assert_allclose(mspd(T_est, T_gt, K3, vertices, symmetries), image, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 3])
def test_errors_keep_batch_shape_and_dtype(shape, dtype, count):
    T = EYE.to(dtype).expand(*shape, 4, 4).clone()
    T[..., 2, 3] = 1
    vertices, symmetries = torch.rand(7, 3, dtype=dtype), EYE.to(dtype).expand(count, 4, 4)
    for error in (mssd(T, T, vertices, symmetries), mspd(T, T, K3.to(dtype), vertices, symmetries)):
        assert error.shape == shape
        assert error.dtype == dtype
        assert (error == 0).all()


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(InvalidInputError, match=r"T_est \(3, 3\)"):
        mssd(EYE[:3, :3], EYE, torch.rand(5, 3), EYE[None])
    with pytest.raises(InvalidInputError, match=r"vertices \(0, 3\)"):
        mssd(EYE, EYE, torch.rand(0, 3), EYE[None])


# The matching


def test_an_error_equal_to_the_threshold_is_wrong():
    matched = match_greedily(np.array([[0.1]]), np.array([0.1, np.nextafter(0.1, 1)]))
    assert matched.tolist() == [[-1], [0]]


def test_matching_is_greedy_by_score_and_separate_at_each_threshold():
    # The first takes ground truth 0 although the second would need it; a wider threshold lets both pass.
    errors = np.array([[1.0, 2.0], [1.5, 9.0]])
    assert match_greedily(errors, np.array([0.5, 1.2, 5.0, 10.0])).tolist() == [[-1, -1], [0, -1], [0, -1], [0, 1]]
    assert match_greedily(errors[::-1], np.array([1.2, 1.6, 5.0])).tolist() == [[-1, 0], [0, -1], [0, 1]]


def test_one_ground_truth_is_found_once_and_ties_go_by_order():
    assert match_greedily(np.array([[0.1], [0.0]]), np.array([1.0])).tolist() == [[0, -1]]
    assert match_greedily(np.array([[0.1, 0.1]]), np.array([1.0])).tolist() == [[0]]
    assert match_greedily(np.empty((2, 0)), np.array([1.0])).tolist() == [[-1, -1]]
    assert match_greedily(np.array([[np.inf]]), np.array([1.0])).tolist() == [[-1]]


# The scores


def scene_of(tmp_path, instances, inst_count=None, width=640):
    """One image with instances of object 1, (T [mm], visib_fract) each, diameter 1000 mm to make thresholds round."""
    root = tmp_path / "one"
    write_models(root / "models")
    (root / "models" / "models_info.json").write_text('{"1": {"diameter": 1000}}')
    write_scene(root / "test", 1, {1: [(1, T, fraction) for T, fraction in instances]}, width=width)
    if inst_count:
        target = {"scene_id": 1, "im_id": 1, "obj_id": 1, "inst_count": inst_count}
        (root / "test_targets_bop19.json").write_text(json.dumps([target]))
    return BopDataset(root)


def mm(x=0.0, y=0.0, z=1000.0):
    T = np.eye(4)
    T[:3, 3] = [x, y, z]
    return T


def scores(write_csv, dataset, *rows, **options):
    return evaluate(read_estimates(write_csv(*(csv_row(1, 1, 1, score, T) for score, T in rows))), dataset, **options)


def test_recall_counts_thresholds_above_the_error(tmp_path, write_csv):
    result = scores(write_csv, scene_of(tmp_path, [(mm(), 1.0)]), (0.5, mm(z=1220)))
    assert result.mssd.tolist() == pytest.approx([0.22])
    assert result.recall_mssd.tolist() == [0] * 4 + [1] * 6
    assert result.ar_mssd == pytest.approx(0.6)
    assert result.gt_mssd.tolist() == [[-1] * 4 + [0] * 6]
    assert result.targets == 1
    assert result.per_object == {1: (pytest.approx(0.6), result.ar_mspd, 1, None)}
    assert result.per_scene == {1: (pytest.approx(0.6), result.ar_mspd, 1, None)}
    assert result.per_image == {(1, 1): (pytest.approx(0.6), result.ar_mspd, 1, None)}
    assert (result.vsd, result.ar_vsd, result.ar) == (None, None, None)
    assert json.loads(json.dumps(result.to_dict()))["ar_mssd"] == pytest.approx(0.6)


@pytest.mark.parametrize("width", [640, 1280, 320])
def test_pixels_count_relative_to_an_image_width_of_640(tmp_path, write_csv, width):
    dataset = scene_of(tmp_path, [(mm(), 1.0)], width=width)
    result = scores(write_csv, dataset, (0.5, mm(x=20)))
    nearest = 600 * 20 / (1000 - 50)  # the box is 100 mm deep: its front moves most, 12.6 px
    assert result.mspd.tolist() == pytest.approx([nearest * 640 / width])
    assert result.recall_mspd.sum() == np.sum(nearest * 640 / width < MSPD_THRESHOLDS)


def test_only_as_many_estimates_as_targets_count_those_of_highest_score(tmp_path, write_csv):
    dataset = scene_of(tmp_path, [(mm(), 1.0)], inst_count=1)
    result = scores(write_csv, dataset, (0.5, mm()), (0.6, mm(z=3000)), (0.4, mm()))
    assert result.ar_mssd == 0
    assert np.isnan(result.mssd).tolist() == [True, False, True]
    assert scores(write_csv, dataset, (0.6, mm()), (0.6, mm(z=3000))).ar_mssd == 1  # a tie: the first row counts
    assert scores(write_csv, dataset, (0.6, mm(z=3000)), (0.6, mm())).ar_mssd == 0


def test_only_the_most_visible_ground_truths_count(tmp_path, write_csv):
    instances = [(mm(), 0.3), (mm(x=300), 0.9), (mm(x=-300), 0.3)]
    dataset = scene_of(tmp_path, instances, inst_count=2)
    assert scores(write_csv, dataset, (0.5, mm(x=300)), (0.5, mm())).ar_mspd == 1  # a tie in visibility: the first
    assert scores(write_csv, dataset, (0.5, mm(x=300)), (0.5, mm(x=-300))).ar_mspd == 0.5
    result = scores(write_csv, dataset, (0.5, mm(x=300)))
    assert (result.targets, result.ar_mspd) == (2, 0.5)
    assert result.gt_mspd.tolist() == [[1] * 10]


def test_a_missing_estimate_is_a_miss_and_a_foreign_one_is_ignored(tmp_path, write_csv, caplog):
    dataset = scene_of(tmp_path, [(mm(), 1.0)])
    est = read_estimates(write_csv(csv_row(1, 2, 1, 1, mm()), csv_row(1, 1, 21, 1, mm()), csv_row(9, 1, 1, 1, mm())))
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        result = evaluate(est, dataset)
    assert (result.ar_mssd, result.ar_mspd, result.targets) == (0, 0, 1)
    assert np.isnan(result.mssd).all()
    assert "no row of" in caplog.text
    assert scores(write_csv, dataset).ar_mssd == 0  # nothing at all


def test_refined_poses_replace_those_of_the_file(tmp_path, write_csv):
    dataset = scene_of(tmp_path, [(mm(), 1.0)])
    est = read_estimates(write_csv(csv_row(1, 1, 1, 1, mm(z=3000))))
    assert evaluate(est, dataset).ar_mssd == 0
    assert evaluate(est, dataset, poses=metres([mm()])).ar_mssd == 1
    assert evaluate(est, dataset, poses=metres([mm()]).numpy()).ar_mssd == 1
    with pytest.raises(InvalidInputError, match=r"expected \(1, 4, 4\)"):
        evaluate(est, dataset, poses=EYE)


def test_targets_without_ground_truth_or_scene_are_refused(tmp_path, write_csv):
    dataset = scene_of(tmp_path, [(mm(), 1.0)], inst_count=2)
    with pytest.raises(
        DataError, match=r"scene 1, image 1, object 1: targets ask for 2 instances, scene_gt.json has 1"
    ):
        scores(write_csv, dataset, (1, mm()))
    path = dataset.path / "test_targets_bop19.json"
    path.write_text(path.read_text().replace('"scene_id": 1', '"scene_id": 8'))
    with pytest.raises(DataError, match=r"scenes \[8\], not in"):
        scores(write_csv, BopDataset(dataset.path), (1, mm()))
    with pytest.raises(InvalidInputError, match=r"no targets in scenes \[1\]"):
        scores(write_csv, BopDataset(dataset.path), (1, mm()), scenes=[1])


def plain_evaluate(rows, dataset, root):
    """BOP19 by plain loops from the raw files, in millimetres. `rows`: (scene, image, object, score, T)."""
    hits, wanted = np.zeros((2, 10)), 0
    for target in json.loads((root / "test_targets_bop19.json").read_text()):
        scene, im, obj, count = (target[key] for key in ("scene_id", "im_id", "obj_id", "inst_count"))
        wanted += count
        folder = root / "test" / f"{scene:06d}"
        gts = json.loads((folder / "scene_gt.json").read_text())[str(im)]
        info = json.loads((folder / "scene_gt_info.json").read_text())[str(im)]
        order = sorted(range(len(gts)), key=lambda i: -info[i]["visib_fract"])
        chosen = sorted([i for i in order if gts[i]["obj_id"] == obj][:count])
        ests = sorted((row for row in rows if row[:3] == (scene, im, obj)), key=lambda row: -row[3])[:count]
        vertices = dataset.vertices(obj).numpy() * 1000
        symmetries = dataset.symmetries(obj).numpy().copy()
        symmetries[:, :3, 3] *= 1000
        diameter = float(np.linalg.norm(OBJECTS[obj][0]))
        table = {}
        for e, (*_, T_est) in enumerate(ests):
            for g in chosen:
                T_gt = np.eye(4)
                T_gt[:3, :3] = np.reshape(gts[g]["cam_R_m2c"], (3, 3))
                T_gt[:3, 3] = gts[g]["cam_t_m2c"]
                surface = plain_error(T_est, T_gt, vertices, symmetries) / diameter
                table[e, g] = surface, plain_error(T_est, T_gt, vertices, symmetries, K3.numpy()) * 640 / 720
        for kind, thresholds in enumerate((MSSD_THRESHOLDS, MSPD_THRESHOLDS)):
            for h, threshold in enumerate(thresholds):
                taken = set()
                for e in range(len(ests)):
                    free = [(table[e, g][kind], g) for g in chosen if g not in taken and table[e, g][kind] < threshold]
                    if free:
                        taken.add(min(free)[1])
                hits[kind, h] += len(taken)
    return hits / wanted


def test_scores_equal_plain_loops_on_random_estimates(bop_folder, write_csv, rng, monkeypatch):
    dataset = BopDataset(bop_folder)
    monkeypatch.setattr(dataset, "symmetries", lambda obj: symmetry_transforms(OBJECTS[obj][1], max_step=0.1))
    rows = []
    for scene_id in dataset.scene_ids:
        gt = dataset.ground_truth(scene_id)
        for im, obj, T in zip(gt.im_id.tolist(), gt.obj_id.tolist(), gt.T_camera_object.numpy(), strict=True):
            for _ in range(rng.integers(0, 4)):
                T_est = T.copy()
                T_est[:3, 3] = (T[:3, 3] + rng.normal(size=3) * [0.004, 0.004, 0.02]) * 1000
                angle = rng.normal() * 0.15
                T_est[:3, :3] = T[:3, :3] @ at(turn_deg=math.degrees(angle)).numpy()[:3, :3]
                rows.append((scene_id, im, obj, float(rng.integers(4)) / 4, T_est))
    rng.shuffle(rows)
    rows = [tuple(row) for row in rows]
    result = evaluate(read_estimates(write_csv(*(csv_row(*row) for row in rows))), dataset)
    expected = plain_evaluate(rows, dataset, bop_folder)
    np.testing.assert_allclose(result.recall_mssd, expected[0], atol=1e-12)
    np.testing.assert_allclose(result.recall_mspd, expected[1], atol=1e-12)
    assert 0.2 < result.ar_mssd < 0.9  # neither trivial nor hopeless
    assert len(result.per_image) == 4
    for per in (result.per_object, result.per_scene, result.per_image):
        assert sum(part.targets for part in per.values()) == result.targets
        total = sum(part.ar_mssd * part.targets for part in per.values())
        assert total == pytest.approx(result.ar_mssd * result.targets)
    part = evaluate(read_estimates(write_csv(*(csv_row(*row) for row in rows))), dataset, scenes=[11])
    assert part.ar_mssd == pytest.approx(result.per_scene[11].ar_mssd)


# The errors for reports


def test_errors_are_split_along_and_across_the_ray_to_the_centre_and_turned_by_symmetry(bop_folder, write_csv):
    dataset = BopDataset(bop_folder)
    gt = dataset.ground_truth(2)
    T = gt.T_camera_object[3]  # object 9, of twofold symmetry
    ray = T[:3, 3] / T[:3, 3].norm()
    side = torch.linalg.cross(ray, torch.tensor([0.0, 1, 0], dtype=torch.float64))
    side /= side.norm()
    T_est = T @ dataset.symmetries(9)[1] @ at(z=0, turn_deg=5)
    T_est[:3, 3] = (T @ dataset.symmetries(9)[1])[:3, 3] + 0.01 * ray + 0.003 * side
    T_est[:3, 3] *= 1000
    est = read_estimates(write_csv(csv_row(2, 3, 9, 1, T_est.numpy()), csv_row(2, 3, 7, 1, T_est.numpy())))
    errors = errors_against_gt(est, dataset)
    assert errors.gt_id.tolist() == [3, -1]
    centre_moves = 0.004 * 2 * math.sin(math.radians(2.5))  # the axis of symmetry is beside the centre of the box
    assert errors.along_ray[0] == pytest.approx(0.01, abs=centre_moves + 1e-4)
    assert errors.across_ray[0] == pytest.approx(0.003, abs=centre_moves + 1e-4)
    assert math.degrees(errors.rotation[0]) == pytest.approx(5, abs=1e-9)
    assert 0.01 < errors.mssd[0] < 0.02
    assert all(np.isnan(x[1]) for x in (errors.mssd, errors.along_ray, errors.across_ray, errors.rotation))
    exact = errors_against_gt(est, dataset, poses=T.expand(2, 4, 4))
    assert max(exact.mssd[0], abs(exact.along_ray[0]), exact.across_ray[0], exact.rotation[0]) < 1e-12


def test_a_distribution_is_robust_and_its_histogram_shows_the_bulk_in_round_bins(rng):
    values = np.concatenate([rng.normal(20, 9, 980), np.full(20, 500.0)])
    d = distribution(values)
    assert d.median == np.median(values)
    assert d.robust_sigma == pytest.approx(9, rel=0.1)
    assert d.mean == pytest.approx(values.mean())
    assert (d.p5, d.p95) == tuple(np.percentile(values, [5, 95]))
    assert d.counts.sum() + d.below + d.above == d.count == 1000
    assert d.above >= 20
    assert np.diff(d.edges) == pytest.approx(5)
    assert (d.edges % 5 == 0).all()
    for k, count in enumerate(d.counts):
        assert count == ((values >= d.edges[k]) & (values < d.edges[k + 1])).sum()


@pytest.mark.parametrize("values", [[], [20.0], [0.0] * 9, [-3.0, 1e6], [1e-14, -1e-14]])
def test_a_distribution_of_few_or_equal_numbers_has_a_histogram_too(values):
    d = distribution(np.array(values))
    assert d.counts.sum() + d.below + d.above == d.count == len(values)
    assert np.diff(d.edges).min() >= 0.0999
    assert len(d.edges) < 20
    assert json.loads(json.dumps(d.to_dict(), allow_nan=False))["median"] == (np.median(values) if values else None)


def test_chosen_rows_alone_are_compared(bop_folder, write_csv):
    gt = BopDataset(bop_folder).ground_truth(2)
    T = gt.T_camera_object[0].numpy() * np.array([1, 1, 1, 1000.0])
    est = read_estimates(write_csv(csv_row(2, 3, 1, 1, T), csv_row(2, 3, 1, 1, T)))
    assert errors_against_gt(est, BopDataset(bop_folder), rows=np.array([False, True])).gt_id.tolist() == [-1, 0]


# The real data


@pytest.mark.data
def test_the_ground_truth_of_ycbv_scores_one(ycbv, write_csv):
    dataset = BopDataset(ycbv)
    rows = []
    for scene_id in dataset.scene_ids:
        gt = dataset.ground_truth(scene_id)
        T = gt.T_camera_object.numpy() * np.array([1, 1, 1, 1000.0])
        rows += [
            csv_row(scene_id, im, obj, 1, T[i]) for i, (im, obj) in enumerate(zip(gt.im_id, gt.obj_id, strict=True))
        ]
    est = read_estimates(write_csv(*rows))
    assert est.problems == ()
    result = evaluate(est, dataset)
    assert (result.ar_mssd, result.ar_mspd, result.targets) == (1, 1, 2700)
    assert result.mssd.max() < 1e-6


@pytest.mark.data
def test_megapose_on_ycbv_scores_what_is_known(ycbv):
    dataset = BopDataset(ycbv)
    est = read_estimates(ycbv / "estimates" / "megapose_ycbv-test.csv")
    result = evaluate(est, dataset)
    assert result.ar_mssd == pytest.approx(0.562, abs=0.002)
    assert result.ar_mspd == pytest.approx(0.700, abs=0.002)
    scaled = est.T_camera_object.clone()
    scaled[:, :3, 3] *= 0.976  # the baseline "one common depth factor"
    result = evaluate(est, dataset, poses=scaled)
    assert result.ar_mssd == pytest.approx(0.722, abs=0.002)
    assert result.ar_mspd == pytest.approx(0.713, abs=0.002)
    errors = errors_against_gt(est, dataset)
    assert 0.015 < np.median(errors.along_ray[result.mssd < 0.1]) < 0.03
