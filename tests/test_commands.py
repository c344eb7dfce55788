"""The ``physpose`` command on a small BOP folder: what goes in comes out, better or untouched, and the exit code tells."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from bop_files import HEADER, OFFSET_MM, UP, csv_row, standing, write_models, write_scene

from physpose_torch.__main__ import main
from physpose_torch.bop.formats import read_estimates


def farther(T, factor):
    T = T.copy()
    T[:3, 3] *= factor
    return T


@pytest.fixture
def dataset(tmp_path):
    """Two images: a high box (1) beside a round one (4); and the low box (9) alone."""
    root = tmp_path / "data"
    write_models(root / "models")
    truth = {
        (2, 3): [(1, standing(-80, 0, 50)), (4, standing(60, 30, 15))],
        (2, 7): [(9, standing(0, 0, 35))],
    }
    write_scene(root / "test", 2, {im: [(o, T, 1.0) for o, T in rows] for (_, im), rows in truth.items()}, width=640)
    planes = {"2": {str(im): {"normal": UP.tolist(), "offset_mm": OFFSET_MM} for _, im in truth}}
    (root / "planes.json").write_text(json.dumps(planes))
    rows = [csv_row(s, im, o, 0.9, farther(T, 1.02)) for (s, im), objects in truth.items() for o, T in objects]
    (root / "est.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    return root


def refine(root, *more, estimates="est.csv", planes=True):
    args = ["refine", str(root / estimates), "--dataset", str(root), "--out", str(root / "out.csv"), "--quiet"]
    return main([*args, *(["--planes", str(root / "planes.json")] if planes else []), *map(str, more)])


def fields(path):
    return [line.split(",") for line in path.read_text().splitlines()]


def test_refining_brings_sunken_objects_onto_the_table(dataset):
    assert refine(dataset, "--json", dataset / "s.json", "--plane-sigma-mm", "0") == 0
    summary = json.loads((dataset / "s.json").read_text())
    assert summary["before"]["penetration_mean_mm"] > 5
    assert summary["after"]["penetration_mean_mm"] < 0.2
    assert summary["after"]["gap_mean_mm"] < 0.5
    assert summary["refined"] == summary["images"] == 2
    truth = standing(-80, 0, 50)[:3, 3]
    before, after = (
        read_estimates(dataset / f).T_camera_object[0, :3, 3].numpy() * 1e3 for f in ("est.csv", "out.csv")
    )
    assert np.linalg.norm(after - truth) < 0.35 * np.linalg.norm(before - truth)


def test_rows_order_ids_and_scores_are_kept_and_own_time_is_shared(dataset):
    refine(dataset)
    old, new = fields(dataset / "est.csv"), fields(dataset / "out.csv")
    assert [r[:4] for r in old] == [r[:4] for r in new]
    added = [float(b[6]) - float(a[6]) for a, b in zip(old[1:], new[1:], strict=True)]
    assert added[0] == pytest.approx(added[1])
    assert min(added) > 0


def test_unknown_time_stays_unknown(dataset):
    text = (dataset / "est.csv").read_text().replace(",0.5\n", ",-1\n")
    (dataset / "est.csv").write_text(text)
    refine(dataset)
    assert {r[6] for r in fields(dataset / "out.csv")[1:]} == {"-1"}


def test_the_same_input_gives_the_same_output_but_for_time(dataset):
    refine(dataset)
    first = [r[:6] for r in fields(dataset / "out.csv")]
    refine(dataset, "--batch", "1")
    second = [r[:6] for r in fields(dataset / "out.csv")]
    refine(dataset, "--batch", "1")
    assert second == [r[:6] for r in fields(dataset / "out.csv")]
    a, b = (np.array([list(map(float, r[5].split())) for r in rows[1:]]) for rows in (first, second))
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_what_is_left_as_it_was_is_listed_by_line_and_images_in_doubt_by_name(dataset, caplog, capsys):
    """The plane of the first image is 4 cm too high; a third row, 30 cm above the second image's plane, hangs there."""
    planes = json.loads((dataset / "planes.json").read_text())
    planes["2"]["3"]["offset_mm"] += 40
    (dataset / "planes.json").write_text(json.dumps(planes))
    with (dataset / "est.csv").open("a") as file:
        file.write(csv_row(2, 7, 1, 0.8, standing(150, 0, 350)) + "\n")
    args = ["refine", str(dataset / "est.csv"), "--dataset", str(dataset), "--planes", str(dataset / "planes.json")]
    assert main([*args, "--out", str(dataset / "out.csv"), "--json", str(dataset / "s.json")]) == 0
    old, new = fields(dataset / "est.csv"), fields(dataset / "out.csv")
    assert [r[:6] for r in old[1:3]] == [r[:6] for r in new[1:3]]
    assert old[3][:6] != new[3][:6]
    assert old[4][:6] == new[4][:6]
    summary = json.loads((dataset / "s.json").read_text())
    assert [(x["line"], x["why"], x["obj_id"]) for x in summary["left"]] == [
        (5, "unsupported", 1),
        (2, "doubted", 1),
        (3, "doubted", 4),
    ]
    assert (summary["rejected"], summary["unsupported"], summary["doubted"]) == (0, 1, 2)
    assert "of their distances" in summary["doubts"][0]
    assert any("scene 2 image 3: its objects would have to be" in r.getMessage() for r in caplog.records)
    text = capsys.readouterr().out
    assert "1 were left as estimated: they have nothing below them" in text
    assert "those moved" in text
    assert summary["after_moved"]["floating_3mm"] == 0 < summary["after"]["floating_3mm"]


def test_without_planes_only_collisions_act(dataset):
    """The estimates are apart from each other, so nothing may move, and their text stays as it was."""
    assert refine(dataset, planes=False) == 0
    assert [r[:6] for r in fields(dataset / "est.csv")] == [r[:6] for r in fields(dataset / "out.csv")]


@pytest.mark.parametrize(
    ("break_it", "named"),
    [
        (lambda rows: [rows[0].replace("0.9", "nan"), *rows[1:]], "score"),
        (lambda rows: [",".join(rows[0].split(",")[:5]), *rows[1:]], "line 2"),
        (lambda rows: ["2,3,77" + rows[0][5:], *rows[1:]], "77"),
    ],
    ids=["nan score", "missing fields", "unknown object"],
)
def test_an_image_with_a_bad_row_keeps_its_poses_is_named_and_fails_the_run(dataset, caplog, break_it, named):
    header, *rows = (dataset / "est.csv").read_text().splitlines()
    (dataset / "bad.csv").write_text("\n".join([header, *break_it(rows)]) + "\n")
    assert refine(dataset, estimates="bad.csv") == 1
    old, new = ((dataset / f).read_text().splitlines() for f in ("bad.csv", "out.csv"))
    assert old[:3] == new[:3]
    assert old[3] != new[3]
    assert any(named in r.getMessage() for r in caplog.records), caplog.text


def test_an_image_without_plane_keeps_its_poses_and_is_named(dataset, caplog):
    planes = json.loads((dataset / "planes.json").read_text())
    del planes["2"]["7"]
    (dataset / "planes.json").write_text(json.dumps(planes))
    assert refine(dataset) == 1
    old, new = ((dataset / f).read_text().splitlines() for f in ("est.csv", "out.csv"))
    assert old[3] == new[3]
    assert old[1] != new[1]
    assert "image 7" in caplog.text


def test_problems_are_told_in_file_order_whatever_is_refined_in_between(dataset):
    """Images 3 and 7 can be refined; 5 has an unknown object, 9 no plane, of 11 and 6 no row can be read, one row is lost."""
    header, *rows = (dataset / "est.csv").read_text().splitlines()
    lost = [csv_row(2, im, 1, "nan", standing(0, 0, 50)) for im in (11, 6)]
    alone = [csv_row(2, im, obj, 0.9, standing(0, 0, 50)) for im, obj in ((5, 77), (9, 1))]
    planes = json.loads((dataset / "planes.json").read_text())
    planes["2"] |= {im: planes["2"]["3"] for im in ("5", "11", "6")}
    (dataset / "planes.json").write_text(json.dumps(planes))
    (dataset / "bad.csv").write_text(
        "\n".join([header, alone[0], *rows[:2], lost[0], "gibberish", *alone[1:], lost[1], rows[2]])
    )
    for batch in (1, 2, 16):
        assert refine(dataset, "--json", dataset / "s.json", "--batch", batch, estimates="bad.csv") == 1
        summary = json.loads((dataset / "s.json").read_text())
        assert (summary["images"], summary["refined"], summary["rows"]) == (7, 2, 3)
        words = ["object 77", "image 9: no plane", "line 5: score", "line 8: score", "line 6: 1 fields"]
        assert len(summary["problems"]) == len(words)
        assert all(word in problem for word, problem in zip(words, summary["problems"], strict=True))
        old, new = ((dataset / f).read_text().splitlines() for f in ("bad.csv", "out.csv"))
        assert [a == b for a, b in zip(old, new, strict=True)] == [True, True, False, False, *[True] * 4, False]


def test_batches_are_of_usable_images_and_of_what_stands_between_them():
    from physpose_torch.commands.images import in_batches

    def numbers(usable, size):
        images = (SimpleNamespace(number=k, scene=object() if x else None) for k, x in enumerate(usable))
        return [[i.number for i in batch] for batch in in_batches(images, size)]

    assert numbers([1, 0, 1, 1, 0, 0, 1, 1, 0], 2) == [[0, 1, 2], [3, 4, 5, 6], [7, 8]]
    assert numbers([0, 0], 2) == [[0, 1]]
    assert numbers([1, 1], 2) == [[0, 1]]
    assert numbers([], 2) == []


def test_the_images_of_a_batch_are_made_after_the_one_before_is_refined(dataset, monkeypatch):
    """So memory does not grow with the file."""
    from physpose_torch.commands import batches as module
    from physpose_torch.commands import images as opening

    events, refine_batch, scenes = [], module._refine, opening.image_scenes

    def making(*args, **options):
        for image in scenes(*args, **options):
            events.append(("made", image.im_id))
            yield image

    def refining(images, *args):
        events.append(("refined", *(i.im_id for i in images)))
        return refine_batch(images, *args)

    monkeypatch.setattr(opening, "image_scenes", making)
    monkeypatch.setattr(module, "_refine", refining)
    assert refine(dataset, "--batch", "1", "--config.steps", "1") == 0
    assert events == [("made", 3), ("refined", 3), ("made", 7), ("refined", 7)]


def test_the_pose_form_of_a_plane_gives_the_same_result(dataset):
    refine(dataset)
    first = [r[:6] for r in fields(dataset / "out.csv")]
    R = np.stack([[1.0, 0, 0], np.cross(UP, [1.0, 0, 0]), UP], axis=1)
    entry = {"R": R.tolist(), "t": (UP * OFFSET_MM / 1000).tolist()}
    (dataset / "planes.json").write_text(json.dumps({"2": {"3": entry, "7": entry}}))
    refine(dataset)
    a, b = (
        np.array([list(map(float, r[5].split())) for r in rows[1:]]) for rows in (first, fields(dataset / "out.csv"))
    )
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_a_static_box_does_the_work_of_the_table(dataset):
    R = np.stack([[1.0, 0, 0], np.cross(UP, [1.0, 0, 0]), UP], axis=1)
    t = UP * (OFFSET_MM - 20) + [0, 0, 600] - UP * (UP @ [0, 0, 600])
    pose = {"R": R.ravel().tolist(), "t_mm": t.tolist()}
    statics = {"statics": [{"box_mm": [2000, 2000, 40], "label": "table", "poses": {"all": pose}}]}
    (dataset / "statics.json").write_text(json.dumps(statics))
    assert refine(dataset, "--statics", dataset / "statics.json", "--json", dataset / "s.json", planes=False) == 0
    summary = json.loads((dataset / "s.json").read_text())
    assert summary["before"]["penetration_mean_mm"] > 5
    assert summary["after"]["penetration_mean_mm"] < 0.2


def test_duplicates_are_refined_and_push_nobody(dataset):
    refine(dataset)
    alone = [r[5] for r in fields(dataset / "out.csv")[1:3]]
    header, *rows = (dataset / "est.csv").read_text().splitlines()
    twin = csv_row(2, 3, 1, 0.5, farther(standing(-78, 4, 50), 1.03))
    (dataset / "est.csv").write_text("\n".join([header, *rows, twin]) + "\n")
    refine(dataset)
    new = fields(dataset / "out.csv")
    a, b = (np.array([list(map(float, t.split())) for t in texts]) for texts in (alone, [r[5] for r in new[1:3]]))
    np.testing.assert_allclose(a, b, atol=1e-2)  # mm; the image comes to rest a step earlier or later
    height = np.array(list(map(float, new[4][5].split()))) @ UP - OFFSET_MM
    assert abs(height - 50) < 2


def test_scenes_and_every_leave_the_rest_untouched(dataset):
    assert refine(dataset, "--every", "2") == 0
    old, new = ((dataset / f).read_text().splitlines() for f in ("est.csv", "out.csv"))
    assert old[3] == new[3]
    assert old[1] != new[1]
    assert refine(dataset, "--scenes", "5") == 0
    assert (dataset / "out.csv").read_text() == (dataset / "est.csv").read_text()


def test_a_file_with_a_header_only_is_nothing_in_nothing_out(dataset):
    (dataset / "empty.csv").write_text(HEADER + "\n")
    assert refine(dataset, estimates="empty.csv") == 0
    assert (dataset / "out.csv").read_text() == HEADER + "\n"


def test_a_missing_file_is_one_clear_line_and_exit_code_2(dataset, capsys):
    assert refine(dataset, estimates="nowhere.csv") == 2
    message = capsys.readouterr().err
    assert "nowhere.csv" in message
    assert "Traceback" not in message


def test_a_calibration_corrects_the_depths_and_single_options_override_it(dataset, capsys):
    """Without planes nothing but the estimates acts on what stands alone: all that is left is the factor."""
    given = {"depth_factor": 0.9, "sigma_ray_fraction": 0.01, "sigma_lateral_mm": 2.0, "sigma_rotation_deg": 1.0}
    (dataset / "c.json").write_text(json.dumps(given))
    t = lambda path: np.array([list(map(float, r[5].split())) for r in fields(path)[1:]])  # noqa: E731
    assert refine(dataset, "--calibration", dataset / "c.json", planes=False) == 0
    np.testing.assert_allclose(t(dataset / "out.csv"), 0.9 * t(dataset / "est.csv"), atol=1e-3)
    factor = ("--config.physics.depth-factor", "0.95")
    assert refine(dataset, f"--calibration={dataset / 'c.json'}", *factor, planes=False) == 0
    np.testing.assert_allclose(t(dataset / "out.csv"), 0.95 * t(dataset / "est.csv"), atol=1e-3)
    (dataset / "c.json").write_text("{}")
    assert refine(dataset, "--calibration", dataset / "c.json") == 2
    assert "depth_factor" in capsys.readouterr().err
    assert refine(dataset, "--calibration", dataset / "missing.json") == 2


def test_calibrate_names_images_that_cannot_be_used_and_needs_planes(dataset, capsys):
    args = ["calibrate", str(dataset / "est.csv"), "--dataset", str(dataset), "--out", str(dataset / "c.json")]
    assert main(args) == 2
    assert "--planes" in capsys.readouterr().err
    assert main([*args, "--planes", str(dataset / "planes.json")]) == 2
    assert "needs" in capsys.readouterr().err  # three estimates


def test_the_paper_preset_sets_the_defaults_that_single_options_start_from():
    from physpose_torch.commands import parse

    args = ["refine", "e.csv", "--dataset", "d", "--out", "o.csv", "--preset", "paper", "--config.steps", "7"]
    config = parse(args).config
    assert (config.steps, config.optimizer, config.physics.gravity) == (7, "sgd", "paper")
    assert parse(args[:6]).config.optimizer == "adam"


def test_an_unknown_preset_is_refused(capsys):
    assert main(["demo", "--preset", "fancy"]) == 2
    assert "fancy" in capsys.readouterr().err


def test_decompose_reports_every_mesh_and_names_the_broken_one(dataset, capsys):
    (dataset / "models" / "obj_000050.ply").write_text("not a mesh")
    out = dataset / "parts.json"
    assert main(["decompose", str(dataset / "models"), "--json", str(out), "--workers", "1"]) == 1
    content = json.loads(out.read_text())
    assert set(content["meshes"]) == {"obj_000001.ply", "obj_000004.ply", "obj_000009.ply"}
    assert all(m["n_parts"] == 1 for m in content["meshes"].values())
    assert "obj_000050.ply" in content["failures"]
    assert "obj_000001.ply" in capsys.readouterr().out


@pytest.mark.data
def test_refining_real_images_raises_recall(ycbv, tmp_path):
    """The pudding and gelatin boxes, the wood block and the foam brick of every 15th image: quick to decompose."""
    estimates = read_estimates(ycbv / "estimates" / "megapose_ycbv-test.csv")
    keep = np.isin(estimates.obj_id, [7, 8, 16, 21])
    wanted = sorted({(s, i) for s, i in zip(estimates.scene_id[keep], estimates.im_id[keep], strict=True)})[::15]
    lines = [
        estimates.text[n - 1]
        for n, k, s, i in zip(estimates.line, keep, estimates.scene_id, estimates.im_id, strict=True)
        if k and (s, i) in wanted
    ]
    (tmp_path / "est.csv").write_text(HEADER + "\n" + "".join(lines))
    out = tmp_path / "out.csv"
    args = ["--dataset", str(ycbv), "--planes", str(ycbv / "table_planes.json")]
    assert main(["refine", str(tmp_path / "est.csv"), *args, "--out", str(out), "--quiet"]) == 0
    for name in ("est", "out"):
        main(["eval", str(tmp_path / f"{name}.csv"), *args, "--quiet", "--json", str(tmp_path / f"{name}.json")])
    before, after = (json.loads((tmp_path / f"{n}.json").read_text()) for n in ("est", "out"))
    assert after["ar_mssd"] > 1.1 * before["ar_mssd"]
    assert after["inside_table"]["estimates"] < 0.1 < 0.5 < before["inside_table"]["estimates"]


def test_demo_improves_every_figure(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "demo.png")]) == 0
    text = capsys.readouterr().out
    assert "before → after" in text
    assert (tmp_path / "demo.png").stat().st_size > 50_000

    from physpose_torch.demo import run_demo

    demo = run_demo(seed=1)
    assert float(demo.before.penetration.max()) > 0.01
    assert float(demo.after.penetration.max()) < 0.002
    gap = demo.after.gap
    assert bool(gap.isfinite().all())
    assert float(gap.max()) < 0.001
    assert float(demo.errors(demo.refinement.poses).mean()) < 0.6 * float(demo.errors(demo.estimates).mean())
    assert torch.equal(demo.refinement.poses, run_demo(seed=1).refinement.poses)
