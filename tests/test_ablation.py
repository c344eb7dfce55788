"""``physpose ablate``: its rows, baselines and disturbed planes are what they say, and differences come with an interval."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from bop_files import HEADER, OFFSET_MM, UP, csv_row, metres, standing, write_models, write_scene

from physpose_torch.__main__ import main
from physpose_torch.ablation import (
    choose,
    disturb,
    list_variants,
    scale_depth,
    slide_onto_planes,
    tilted,
    with_exact_planes,
    with_solver,
    without_planes,
)
from physpose_torch.bop.ablation import Disturbance, difference, prepare, restricted
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import read_estimates, read_planes
from physpose_torch.bop.metrics import Recall, evaluate
from physpose_torch.bop.scenes import BodyLibrary, image_scenes
from physpose_torch.config import Calibration, PhysicsConfig, RefinerConfig
from physpose_torch.contacts import object_heights, plane_variance
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Plane
from physpose_torch.scene import Scene, Static

ALWAYS = {"input", "one depth factor", "slide onto the plane", "P + C + G"}
CALIBRATION = Calibration(0.98, sigma_ray_fraction=0.01, sigma_lateral=0.002, sigma_rotation=0.02)


@pytest.fixture
def dataset(tmp_path):
    """Three images of boxes on a table, the estimates 2 % too far away."""
    root = tmp_path / "data"
    write_models(root / "models")
    truth = {
        3: [(1, standing(-80, 0, 50)), (4, standing(60, 30, 15))],
        5: [(4, standing(-50, 0, 15))],
        7: [(9, standing(0, 0, 35))],
    }
    write_scene(root / "test", 2, {im: [(o, T, 1.0) for o, T in rows] for im, rows in truth.items()}, width=640)
    planes = {"2": {str(im): {"normal": UP.tolist(), "offset_mm": OFFSET_MM} for im in truth}}
    (root / "planes.json").write_text(json.dumps(planes))
    rows = []
    for im, objects in truth.items():
        for obj, T in objects:
            T[:3, 3] *= 1.02
            rows.append(csv_row(2, im, obj, 0.9, T))
    (root / "est.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    return root


def ablate(root, *more, planes=True):
    """Exit code and JSON content."""
    args = ["ablate", str(root / "est.csv"), "--dataset", str(root), "--json", str(root / "a.json")]
    code = main([*args, *(["--planes", str(root / "planes.json")] if planes else []), *map(str, more)])
    return code, json.loads((root / "a.json").read_text()) if (root / "a.json").is_file() else None


# ---- the rows


@pytest.mark.parametrize("config", [RefinerConfig(), RefinerConfig.lm(), RefinerConfig.paper()])
def test_every_refined_row_but_the_reference_changes_something_and_names_are_unique(config):
    rows = list_variants(config, calibration=CALIBRATION)
    names = [row.name for row in rows]
    assert len(set(names)) == len(names)
    same = {row.name for row in rows if row.config == config and row.knowledge == "known"}
    assert same == {"P + C + G", "known scene"}
    assert {row.name for row in rows if row.always} == ALWAYS
    assert all(len(row.shown) <= 27 for row in rows)


def test_each_row_changes_what_its_name_says_and_nothing_else():
    config = RefinerConfig(PhysicsConfig(gravity_reach=0.07))
    rows = {row.name: row.config for row in list_variants(config, calibration=CALIBRATION)}
    assert rows["without C"].physics.collision_weight == 0
    assert rows["without C"].physics.gravity_weight == config.physics.gravity_weight
    assert (rows["only P"].physics.collision_weight, rows["only P"].physics.gravity_weight) == (0, 0)
    assert (rows["only P"].start, rows["only P, start measured"].start) == (config.start, "measured")
    assert rows["only P, start measured"].physics == rows["only P"].physics
    assert rows["smoothing gumbel"].physics.smoothing.kind == "gumbel"
    assert rows["paper sigmas"].physics.sigma_ray == RefinerConfig.paper().physics.sigma_ray
    assert rows["paper sigmas"].physics.collision_weight == config.physics.collision_weight
    assert rows["solver lm"].physics == config.physics
    assert rows["solver lm"].steps == RefinerConfig.lm().steps
    assert rows["paper preset"] == RefinerConfig.paper()
    assert rows["calibrated"] == config.calibrated(CALIBRATION)
    assert rows["without righting"].righting == 0
    assert with_solver(RefinerConfig.lm(), "descent") == RefinerConfig()


def test_what_lm_does_not_know_is_left_to_the_descent_and_says_so():
    rows = {row.name: row for row in list_variants(RefinerConfig.lm())}
    for name in ("gravity paper", "smoothing gumbel"):
        assert rows[name].config.solver == "descent"
        assert rows[name].shown == f"{name}, descent"
    assert rows["without C"].config.solver == "lm"


def test_rows_about_planes_and_calibration_are_there_only_with_them():
    names = {row.name for row in list_variants(RefinerConfig(), planes=False)}
    assert not names & {"slide onto the plane", "no plane", "plane disturbed", "plane exact", "calibrated"}
    assert {"input", "P + C + G", "without C", "initial", "known scene"} <= names
    with_both = {row.name: row for row in list_variants(RefinerConfig(), calibration=CALIBRATION)}
    assert with_both["one depth factor"].shown == "depth × 0.980 (C.json)"
    assert with_both["calibrated, plane disturbed"].knowledge == "disturbed"


def test_slow_rows_run_only_if_named_or_asked_for():
    rows = list_variants(RefinerConfig())
    slow = {row.name for row in rows if row.slow}
    assert slow == {"smoothing gumbel", "paper preset"}
    assert not slow & {row.name for row in choose(rows)}
    assert slow <= {row.name for row in choose(rows, slow=True)}
    assert {row.name for row in choose(rows, ("paper preset",))} == {*ALWAYS, "paper preset"}
    with pytest.raises(InvalidInputError, match=r"'withuot C'.*there are 'input'.*'without C'"):
        choose(rows, ("without G", "withuot C"))


# ---- baselines


def test_sliding_puts_the_lowest_point_of_each_object_on_the_plane_along_its_ray(table, box, can):
    poses = table.poses((0, 0, -0.03, (0.3, 0, 0.2)), (0.1, 0.05, 0.2, (0, 0.5, 0)), (-0.1, 0, 0.04))
    scene = Scene.tabletop([box, box, can], table.plane)
    slid = slide_onto_planes(poses, scene)
    assert float(object_heights(slid, scene).abs().max()) < 1e-12
    assert torch.equal(slid[:, :3, :3], poses[:, :3, :3])
    # boxes and cylinders have their centre at the origin
    assert float(torch.linalg.cross(slid[:, :3, 3], poses[:, :3, 3]).norm(dim=-1).max()) < 1e-12
    further = slid[:, :3, 3].norm(dim=-1) > poses[:, :3, 3].norm(dim=-1)
    assert further.tolist() == [False, True, False]
    vertices = torch.tensor(np.array(box.mesh.vertices)) @ slid[0, :3, :3].mT + slid[0, :3, 3]
    assert float((vertices @ table.plane.normal).min() - table.plane.offset) == pytest.approx(0, abs=1e-12)


def test_sliding_never_goes_behind_the_camera(box):
    """The plane hangs above the camera's axis: the ray meets it only behind."""
    up = torch.tensor([0.0, -0.6, 0.8], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, 2, 3] = 0.8
    scene = Scene([box], [Static(Plane(up, torch.tensor(-0.5)))])
    assert torch.equal(slide_onto_planes(pose, scene), pose)
    assert torch.equal(slide_onto_planes(pose, Scene([box])), pose)


def test_one_depth_factor_multiplies_all_translations(table, box):
    poses = table.poses((0, 0, 0.02), (0.1, 0.05, 0.2))
    scaled = scale_depth(poses, Scene.tabletop([box, box], table.plane), factor=0.5)
    assert torch.equal(scaled[:, :3, 3], 0.5 * poses[:, :3, 3])
    assert torch.equal(scaled[:, :3, :3], poses[:, :3, :3])


# ---- knowledge of the planes


def test_disturbed_planes_have_the_stated_spread_and_covariance(table, box):
    scene, poses = Scene.tabletop([box, box], table.plane), table.poses((0.2, 0.1, 0.02), (0, 0.1, 0.3))
    middle = table.at(0.1, 0.1)[:3, 3]
    generator = torch.Generator().manual_seed(3)
    spread = []
    for _ in range(400):
        other = disturb(scene, poses, tilt=0.02, offset=0.006, generator=generator)
        plane = other.planes[0].shape
        torch.testing.assert_close(other.gravity[0], -plane.normal)
        height = (plane.offset - plane.normal @ middle) / (plane.normal @ table.up)
        slope = (table.T[:3, :3].mT @ plane.normal)[:2]
        spread.append([*slope.tolist(), float(height)])
    assert np.std(spread, axis=0) == pytest.approx([0.02, 0.02, 0.006], rel=0.15)
    assert np.mean(spread, axis=0) == pytest.approx([0, 0, 0], abs=0.004)
    torch.testing.assert_close(plane.covariance.diag(), torch.tensor([4e-4, 4e-4, 3.6e-5], dtype=torch.float64))


def test_the_covariance_of_disturbed_planes_tells_how_far_off_they_are_at_each_object(table, box):
    """400 draws: the height of the plane at an object spreads as its variance there says."""
    poses = table.poses((0.2, 0.1, 0.02), (-0.1, 0.1, 0.02), (0, -0.2, 0.02))
    scene, generator = Scene.tabletop([box] * 3, table.plane), torch.Generator().manual_seed(1)
    heights = []
    for _ in range(400):
        other = disturb(scene, poses, tilt=0.03, offset=0.004, generator=generator)
        heights.append(object_heights(poses, other))
    variance = plane_variance(poses, other, torch.arange(3), torch.zeros(3, dtype=torch.long), torch.ones(3) > 0)
    # boxes also turn against a tilted plane: a little more than the point below their centre
    ratio = torch.stack(heights).var(0) / variance
    assert ratio.tolist() == pytest.approx([1, 1, 1], abs=0.35)


def test_disturbing_by_nothing_changes_nothing_and_known_variances_are_added(table, box):
    known = Plane(table.plane.normal, table.plane.offset, 1e-6 * torch.eye(3, dtype=torch.float64))
    poses, generator = table.poses((0, 0, 0.02)), torch.Generator().manual_seed(0)
    for plane in (table.plane, known):
        same = disturb(Scene.tabletop([box], plane), poses, tilt=0, offset=0, generator=generator).planes[0].shape
        torch.testing.assert_close(same.normal, plane.normal)
        torch.testing.assert_close(same.offset, plane.offset)
        assert (same.covariance is None) == (plane.covariance is None)
    more = disturb(Scene.tabletop([box], known), poses, tilt=0, offset=0.002, generator=generator).planes[0].shape
    assert float(more.covariance[2, 2]) == pytest.approx(5e-6)


def test_a_tilted_plane_turns_about_the_point_below_and_rises_along_its_new_normal(table):
    middle = table.at(0.2, 0.1, 0.3)[:3, 3]
    known = Plane(table.plane.normal, table.plane.offset, 1e-6 * torch.eye(3, dtype=torch.float64))
    plane = tilted(known, middle, torch.tensor([0.1, 0.0], dtype=torch.float64), 0.01)
    assert float(torch.arccos(plane.normal @ known.normal)) == pytest.approx(0.1)
    assert float(plane.offset - plane.normal @ table.at(0.2, 0.1)[:3, 3]) == pytest.approx(0.01)
    assert torch.equal(plane.covariance, known.covariance)


def test_exact_and_absent_planes_leave_all_else_as_it_is(table, box, can):
    plane = Plane(table.plane.normal, table.plane.offset, 1e-6 * torch.eye(3, dtype=torch.float64))
    wall = Static(can, table.at(0.3, 0, 0.04))
    same = torch.tensor([0, 0])
    scene = Scene([box, box], [Static(plane), wall], gravity=table.gravity, same_object=same)
    exact, absent = with_exact_planes(scene), without_planes(scene)
    assert exact.planes[0].shape.covariance is None
    assert torch.equal(exact.planes[0].shape.offset, plane.offset)
    torch.testing.assert_close(exact.gravity, scene.gravity)
    assert not absent.planes
    assert not absent.gravity.any()
    for other in (exact, absent):
        assert [s.shape for s in other.static_bodies] == [can]
        assert torch.equal(other.same_object, same)


def test_an_images_disturbed_plane_depends_on_the_seed_and_on_nothing_else(dataset):
    estimates, (planes, _) = read_estimates(dataset / "est.csv"), read_planes(dataset / "planes.json")
    library = BodyLibrary(BopDataset(dataset))

    def offsets(seed, only=None):
        images = [i for i in image_scenes(estimates, library, planes=planes) if only in (None, i.im_id)]
        (batch,) = prepare(images, estimates, Disturbance(0.02, 0.005, seed))
        return batch.scene("disturbed").plane_offset

    assert torch.equal(offsets(0), offsets(0))
    assert not torch.isclose(offsets(0), offsets(1)).any()
    assert torch.equal(offsets(4)[2], offsets(4, only=7)[0])


# ---- scores


def test_only_targets_of_the_images_at_hand_are_scored_as_they_are_in_the_whole(dataset):
    whole, estimates = BopDataset(dataset), read_estimates(dataset / "est.csv")
    part = restricted(whole, {(2, 3), (2, 7)})
    assert {t[:3] for t in part.targets} == {(2, 3, 1), (2, 3, 4), (2, 7, 9)}
    scores, all_scores = evaluate(estimates, part), evaluate(estimates, whole)
    assert scores.targets == 3
    assert scores.per_image == {k: v for k, v in all_scores.per_image.items() if k != (2, 5)}


def test_the_interval_of_a_difference_covers_a_planted_one_about_as_often_as_it_says():
    rng, covered = np.random.default_rng(0), 0
    for trial in range(200):
        before = {(1, i): Recall(rng.uniform(), 0.5, int(rng.integers(1, 6))) for i in range(60)}
        after = {
            k: Recall(r.ar_mssd + 0.03 + 0.1 * rng.normal() / math.sqrt(r.targets), 0.5, r.targets)
            for k, r in before.items()
        }
        found = difference(SimpleNamespace(per_image=after), SimpleNamespace(per_image=before), "ar_mssd", seed=trial)
        assert found.low < found.value < found.high
        covered += found.low <= 0.03 <= found.high
    assert 0.88 <= covered / 200 <= 0.99
    assert difference(SimpleNamespace(per_image=after), SimpleNamespace(per_image=before), "ar_mspd") == (0, 0, 0)


# ---- the command


def test_the_table_has_all_rows_and_the_reference_differs_from_itself_by_nothing(dataset, capsys):
    code, content = ablate(dataset, "--preset", "lm")
    assert code == 0
    rows = {row["name"]: row for row in content["rows"]}
    expected = [row.name for row in choose(list_variants(RefinerConfig.lm()))]
    assert list(rows) == expected
    assert content["skipped"] == ["smoothing gumbel", "paper preset"]
    none = {"value": 0, "low": 0, "high": 0}
    for name in ("P + C + G", "known scene"):
        assert rows[name]["difference_mssd"] == rows[name]["difference_mspd"] == none
    assert rows["input"]["ar_mssd"] == rows["initial"]["ar_mssd"] < rows["P + C + G"]["ar_mssd"]
    assert rows["input"]["difference_mssd"]["value"] == pytest.approx(
        rows["input"]["ar_mssd"] - rows["P + C + G"]["ar_mssd"]
    )
    assert rows["input"]["inside_static_3mm"] == 1
    assert rows["slide onto the plane"]["inside_static_3mm"] == rows["P + C + G"]["inside_static_3mm"] == 0
    assert rows["without C"]["config"]["physics"]["collision_weight"] == 0
    assert rows["not robust"]["config"]["physics"]["robust"] == "inf"
    assert rows["no plane"]["inside_static_3mm"] == 1  # judged by the plane that it was not told of
    assert content["images"] == {"in_file": 3, "looked_at": 3, "refined": 3, "share": 1}
    assert (content["targets"], content["options"]["preset"], content["options"]["disturb_mm"]) == (4, "lm", 6.0)
    assert not any(row["error"] for row in content["rows"])
    text = capsys.readouterr().out
    assert all(row["label"] in text and row["group"] in text for row in content["rows"])
    assert max(map(len, text.splitlines())) <= 120


def test_rows_are_selected_by_name_and_the_images_by_every(dataset, capsys):
    code, content = ablate(dataset, "--preset", "lm", "--rows", "without C", "plane disturbed", "--every", 2)
    assert code == 0
    assert {row["name"] for row in content["rows"]} == {*ALWAYS, "without C", "plane disturbed"}
    assert (content["images"]["looked_at"], content["targets"], content["skipped"]) == (2, 3, [])
    assert main(["ablate", "x.csv", "--dataset", "d", "--rows", "nonsense"]) == 2
    assert "'nonsense': no such row; there are 'input'" in capsys.readouterr().err


def test_the_same_run_gives_the_same_numbers_but_for_time(dataset):
    contents = [ablate(dataset, "--preset", "lm", "--rows", "plane disturbed", "--quiet")[1] for _ in range(2)]
    for content in contents:
        for row in content["rows"]:
            del row["ms_per_image"]
    assert contents[0] == contents[1]


def test_a_calibration_adds_rows_and_brings_its_own_depth_factor(dataset):
    numbers = {"depth_factor": 1 / 1.02, "sigma_ray_fraction": 0.005, "sigma_lateral_mm": 2, "sigma_rotation_deg": 1}
    (dataset / "c.json").write_text(json.dumps(numbers))
    code, content = ablate(dataset, "--preset", "lm", "--rows", "calibrated", "--calibration", dataset / "c.json")
    assert code == 0
    rows = {row["name"]: row for row in content["rows"]}
    assert rows["calibrated"]["config"]["physics"]["depth_factor"] == pytest.approx(1 / 1.02)
    assert rows["one depth factor"]["label"] == "depth × 0.980 (C.json)"
    assert rows["one depth factor"]["ar_mssd"] == 1  # that is all that is wrong with these estimates


def test_an_image_without_plane_is_kept_in_all_rows_and_listed(dataset, caplog, capsys):
    planes = json.loads((dataset / "planes.json").read_text())
    del planes["2"]["7"]
    (dataset / "planes.json").write_text(json.dumps(planes))
    code, content = ablate(dataset, "--preset", "lm", "--rows", "without C")
    assert code == 1
    assert "image 7: no plane" in caplog.text
    assert len(content["problems"]) == 1
    assert content["images"] == {"in_file": 3, "looked_at": 3, "refined": 2, "share": 1}
    assert content["targets"] == 4
    assert "1 of them kept" in capsys.readouterr().out
    # the others are perfect, so what is missing is what image 7 was missing before
    rows = {row["name"]: row for row in content["rows"]}
    kept = evaluate(read_estimates(dataset / "est.csv"), BopDataset(dataset)).per_image[2, 7].ar_mssd
    assert rows["P + C + G"]["ar_mssd"] <= (3 + kept) / 4 + 1e-12


def test_a_row_that_fails_says_why_and_the_others_go_on(dataset, capsys):
    code, content = ablate(dataset, "--preset", "lm", "--config.physics.backend", "fcl", "--rows", "solver descent")
    assert code == 1
    rows = {row["name"]: row for row in content["rows"]}
    assert "needs the warp backend" in rows["P + C + G"]["error"]
    assert rows["input"]["error"] is rows["solver descent"]["error"] is None
    assert rows["solver descent"]["ar_mssd"] > rows["input"]["ar_mssd"]
    assert rows["input"]["difference_mssd"] is None
    text = capsys.readouterr().out
    assert "failed: solver 'lm' needs the warp backend" in text
    assert max(map(len, text.splitlines())) <= 120


def test_without_planes_only_collisions_are_compared(dataset):
    code, content = ablate(dataset, "--preset", "lm", "--rows", "without C", planes=False)
    assert code == 0
    rows = {row["name"]: row for row in content["rows"]}
    assert set(rows) == {"input", "one depth factor", "P + C + G", "without C"}
    assert rows["input"]["inside_static_3mm"] is rows["input"]["above_support_3mm"] is None


def test_baselines_of_a_file_are_exact(dataset):
    """Sliding and scaling back undo an error that is along the rays only."""
    estimates, (planes, _) = read_estimates(dataset / "est.csv"), read_planes(dataset / "planes.json")
    images = list(image_scenes(estimates, BodyLibrary(BopDataset(dataset)), planes=planes))
    (batch,) = prepare(images, estimates, Disturbance(0, 0, 0))
    truth = metres(np.stack([standing(-80, 0, 50), standing(60, 30, 15), standing(-50, 0, 15), standing(0, 0, 35)]))
    torch.testing.assert_close(scale_depth(batch.measured, batch.scene(), factor=1 / 1.02), truth)
    torch.testing.assert_close(slide_onto_planes(batch.measured, batch.scene()), truth, atol=2e-5, rtol=0)


# ---- what is made worse


def test_rows_tell_whom_they_made_worse_than_the_input_and_by_how_much_recall_changed(dataset):
    """All estimates are 2 % too far away, by at least 10 mm: the right factor makes all better, the wrong one all worse."""
    numbers = {"depth_factor": 1 / 1.02, "sigma_ray_fraction": 0.005, "sigma_lateral_mm": 2, "sigma_rotation_deg": 1}
    for factor, worse in ((1 / 1.02, 0), (1.02, 1)):
        (dataset / "c.json").write_text(json.dumps(numbers | {"depth_factor": factor}))
        more = ("--preset", "lm", "--rows", "without C", "--calibration", dataset / "c.json", "--quiet")
        rows = {row["name"]: row for row in ablate(dataset, *more)[1]["rows"]}
        made = [rows["one depth factor"][key] for key in ("made_worse", "made_better")]
        assert [m["value"] for m in made] == [worse, 1 - worse]
        assert [(m["low"], m["high"]) for m in made] == [(worse, worse), (1 - worse, 1 - worse)]
        assert rows["one depth factor"]["objects"] == 4
    assert rows["input"]["made_worse"] == rows["input"]["made_better"] == {"value": 0, "low": 0, "high": 0}
    assert rows["input"]["change_mssd"] == {"value": 0, "low": 0, "high": 0}
    gain = rows["P + C + G"]["ar_mssd"] - rows["input"]["ar_mssd"]
    assert rows["P + C + G"]["change_mssd"]["value"] == pytest.approx(gain)
    assert rows["P + C + G"]["change_mssd"]["value"] == pytest.approx(-rows["input"]["difference_mssd"]["value"])


def test_an_image_that_is_not_refined_does_not_count_as_unharmed(dataset):
    planes = json.loads((dataset / "planes.json").read_text())
    del planes["2"]["3"]  # that of two objects
    (dataset / "planes.json").write_text(json.dumps(planes))
    _, content = ablate(dataset, "--preset", "lm", "--rows", "without C", "--quiet")
    assert {row["objects"] for row in content["rows"]} == {2}


# ---- planted failures


def test_each_planted_failure_is_a_block_of_rows_compared_with_its_own_input(dataset, capsys):
    code, content = ablate(dataset, "--preset", "lm", "--plant", "wrong-plane", "outliers", "accurate")
    assert code == 0
    assert "rows" not in content
    blocks = {block["label"]: block for block in content["planted"]}
    assert list(blocks) == ["outliers", "plane too high", "plane tilted", "accurate"]
    for block in blocks.values():
        assert (block["images"], block["targets"]) == (3, 4)
        rows = {row["name"]: row for row in block["rows"]}
        assert set(rows) == ALWAYS
        for row in rows.values():
            assert row["change_mssd"]["value"] == pytest.approx(row["ar_mssd"] - rows["input"]["ar_mssd"])
            assert "inside_static_3mm" not in row
        assert rows["input"]["made_worse"]["value"] == 0
    high = {row["name"]: row for row in blocks["plane too high"]["rows"]}
    plain = evaluate(read_estimates(dataset / "est.csv"), BopDataset(dataset))
    assert high["input"]["ar_mssd"] == plain.ar_mssd
    assert high["P + C + G"]["others_made_worse"] == high["P + C + G"]["made_worse"]
    true = {row["name"]: row for row in blocks["accurate"]["rows"]}
    assert blocks["accurate"]["rows_planted"] == blocks["accurate"]["rows_planted_acting"] == true["input"]["objects"] == 4
    assert true["input"]["ar_mssd"] == 1
    assert true["one depth factor"]["made_worse"]["value"] == 1  # 2.4 % of the distance
    assert (true["input"]["others_objects"], true["input"]["others_made_worse"]) == (0, None)
    text = capsys.readouterr().out
    assert all(f"{block['label']}: {block['what']}; in 3 of 3 images, 4 targets" in text for block in blocks.values())
    assert "differences to the planted input" in text
    assert max(map(len, text.splitlines())) <= 120


def test_rows_that_are_asked_for_are_run_on_planted_failures_too_and_runs_repeat(dataset):
    more = ("--preset", "lm", "--plant", "false-positive", "--rows", "without C", "--quiet", "--seed", 5)
    contents = [ablate(dataset, *more)[1] for _ in range(2)]
    for content in contents:
        for block in content["planted"]:
            assert {row["name"] for row in block["rows"]} == {*ALWAYS, "without C"}
            assert block["rows_planted"] == block["rows_planted_acting"] == 3
            for row in block["rows"]:
                del row["ms_per_image"]
    assert contents[0] == contents[1]
    assert [block["label"] for block in contents[0]["planted"]] == [
        "false positive, low score",
        "false positive, high score",
    ]


def test_a_failure_that_fits_no_image_says_so(dataset, caplog):
    code, content = ablate(dataset, "--preset", "lm", "--plant", "missing-supporter", "accurate", "--quiet")
    assert code == 1
    assert [(block["label"], block["images"], len(block["rows"])) for block in content["planted"]] == [
        ("missing supporter", 0, 0),
        ("accurate", 3, 4),
    ]
    assert "missing supporter: fits none of 3 images (an object that carries another one is not estimated)" in caplog.text
    assert len(content["problems"]) == 1


def test_a_failure_that_is_unknown_is_refused_with_those_there_are(dataset, capsys):
    with pytest.raises(SystemExit) as stopped:
        ablate(dataset, "--plant", "earthquake")
    assert stopped.value.code == 2
    assert "missing-supporter" in capsys.readouterr().err
