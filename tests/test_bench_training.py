"""The training benchmark on tiny sizes: its data, its losses and its measures are what they are said to be."""

import json
import math

import pytest
import torch

from physpose_torch import se3
from physpose_torch.bench import training
from physpose_torch.bench.__main__ import main
from physpose_torch.bench.pose_network import (
    PoseNet,
    PoseTrainer,
    point_loss,
    predict,
    surface_points,
    symmetric_truth,
)
from physpose_torch.bench.training import evaluate, training_table
from physpose_torch.bench.training_scenes import AXIAL, CROP, LABELS, household_symmetries, pose_samples
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.household import household_meshes, household_scene

MESHES = household_meshes()


@pytest.fixture(scope="module")
def bodies():
    """Hulls: nothing is decomposed here. What stands in a bowl or on a plate is inside it, then."""
    return {name: Body.from_hull(mesh, label=name) for name, mesh in MESHES.items()}


@pytest.fixture(scope="module")
def data(bodies):
    return pose_samples(range(3), bodies, draws=2, crop=16, seed=5)


@pytest.fixture(scope="module")
def points(bodies):
    return surface_points(bodies)


def turned_about_z(T, angle):
    turn = torch.tensor([0, 0, angle], dtype=T.dtype)
    return se3.retract(T, torch.cat([torch.zeros(3, dtype=T.dtype), turn]).expand(len(T), 6))


# ---- data


def test_samples_are_the_scenes_under_other_coarse_poses(data):
    assert len(data) == 6
    for s in range(6):
        true = household_scene(s // 2)
        rows = data.rows([s])
        assert [LABELS[i] for i in data.label[rows].tolist()] == true.names == data.scenes[s].labels
        assert torch.equal(data.truth[rows], true.T_camera_object.float())
    assert not torch.equal(data.coarse[data.rows([0])], data.coarse[data.rows([1])])
    chosen = [4, 0]
    assert data.scene(chosen).labels == [LABELS[i] for i in data.label[data.rows(chosen)].tolist()]
    assert data.scene(chosen).n_images == 2


def test_the_same_seed_gives_the_same_samples_and_another_does_not(data, bodies):
    again, other = (pose_samples(range(3), bodies, draws=2, crop=16, seed=s) for s in (5, 6))
    assert torch.equal(again.images, data.images)
    assert torch.equal(again.coarse, data.coarse)
    assert not torch.equal(other.coarse, data.coarse)


def test_a_crop_rendered_at_the_true_pose_lies_on_the_photograph(bodies):
    """Without errors the visible mask is inside the rendered one, and most of that; with them it is not."""
    exact = {"lateral_sigma": 0.0, "depth_sigma": 0.0, "rotation_sigma_deg": 0.0}
    true, off = (pose_samples([1, 2], bodies, draws=1, crop=32, **noise) for noise in (exact, {}))
    true_bias = true.coarse[:, 2, 3] / true.truth[:, 2, 3]
    assert torch.allclose(true_bias, torch.full_like(true_bias, 1.024))  # the estimator's common bias stays

    def outside(samples):
        visible, rendered = samples.images[:, 1], samples.images[:, 4]
        return float(((visible - rendered).clamp(min=0).sum((1, 2)) / visible.sum((1, 2))).mean())

    assert outside(true) < 0.08  # 2.4 % too far is 5 % too little area
    assert outside(off) > outside(true) + 0.02


def test_crops_hold_the_whole_object(data):
    rendered = data.images[:, 4]
    border = torch.cat([rendered[:, 0], rendered[:, -1], rendered[:, :, 0], rendered[:, :, -1]], dim=1)
    assert not bool(border.any())
    assert bool((rendered.amax((1, 2)) == 1).all())
    radius = torch.tensor([torch.tensor(MESHES[LABELS[i]].vertices).norm(dim=1).max() for i in data.label.tolist()])
    assert torch.allclose(data.side * data.coarse[:, 2, 3], 2 * CROP * radius.float(), rtol=1e-5)


@pytest.mark.parametrize("name", LABELS)
def test_symmetries_map_the_mesh_onto_itself(name):
    vertices = torch.tensor(MESHES[name].vertices)
    symmetries = household_symmetries(name)
    assert torch.equal(symmetries[0], torch.eye(4, dtype=torch.float64))
    for S in symmetries:
        nearest = torch.cdist(se3.apply(S, vertices), vertices).amin(1)
        assert float(nearest.max()) < 1e-7  # cdist squares
    assert len(symmetries) == {"box": 4}.get(name, 48 if name in AXIAL else 1)


@pytest.mark.parametrize("arguments", [{"seeds": []}, {"seeds": [0], "draws": 0}, {"seeds": [0], "crop": 4}], ids=str)
def test_samples_of_nothing_are_refused(arguments, bodies):
    with pytest.raises(InvalidInputError, match="expected at least 1, 1 and 8"):
        pose_samples(arguments.pop("seeds"), bodies, **arguments)


# ---- network and losses


def test_a_new_network_is_the_identity(data):
    network = PoseNet(crop=16)
    torch.testing.assert_close(predict(network, data), data.coarse, atol=1e-6, rtol=0)


def test_a_step_across_is_in_units_of_the_crop_and_a_step_in_depth_keeps_the_pixel(data):
    network = PoseNet(crop=16)
    with torch.no_grad():
        network.head[-1].bias[:3] = torch.tensor([1.0, 0.0, 0.5])
    poses = predict(network, data)
    pixel, before = (T[:, :2, 3] / T[:, 2:3, 3] for T in (poses, data.coarse))
    torch.testing.assert_close(pixel[:, 0] - before[:, 0], 0.1 * data.side, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(pixel[:, 1], before[:, 1], atol=1e-6, rtol=0)
    torch.testing.assert_close(poses[:, 2, 3] / data.coarse[:, 2, 3], torch.full((len(poses),), math.exp(0.05)))


def test_the_supervised_loss_is_blind_to_turns_about_an_axis_and_to_nothing_else(data, points):
    truth, label = data.truth, data.label
    axial = torch.tensor([LABELS[i] in AXIAL for i in label.tolist()])
    loss = point_loss(turned_about_z(truth, 0.7), truth, label, points)
    assert bool((loss[axial] < 2e-6).all())
    assert bool((loss[~axial] > 5e-3).all())
    moved = truth.clone()
    moved[:, 0, 3] += 0.01
    assert torch.allclose(point_loss(moved, truth, label, points), torch.tensor(0.01))


def test_the_symmetric_truth_is_the_nearest_turn(data):
    """Against all turns by 1°."""
    poses = turned_about_z(data.coarse, 1.234)
    best = symmetric_truth(poses, data.truth, data.label)[:, :3, :3]
    trace = (best * poses[:, :3, :3]).sum((1, 2))
    axial = torch.tensor([LABELS[i] in AXIAL for i in data.label.tolist()])
    for degree in range(360):
        other = turned_about_z(data.truth, math.radians(degree))[:, :3, :3]
        assert bool((trace >= (other * poses[:, :3, :3]).sum((1, 2)) - 1e-5)[axial].all())
    assert torch.equal(best[~axial], data.truth[~axial][:, :3, :3])


# ---- measures


def test_measures_of_known_errors(data, bodies):
    """Along the ray by 10 mm, then across it by 4 mm, then about an axis that does not count."""
    truth = evaluate(data.truth, data, bodies)
    assert all(truth[key] == pytest.approx(0, abs=0.02) for key in ("ray_mm", "lateral_mm", "rotation_deg", "mssd_mm"))
    assert truth["gap_mm"] < 0.05
    ray = torch.nn.functional.normalize(data.truth[:, :3, 3], dim=1)
    across = torch.nn.functional.normalize(torch.linalg.cross(ray, torch.tensor([0.0, 1, 0]).expand_as(ray)), dim=1)
    moved = data.truth.clone()
    moved[:, :3, 3] += 0.01 * ray + 0.004 * across
    errors = evaluate(moved, data, bodies)
    assert errors["ray_mm"] == pytest.approx(10, abs=0.01)
    assert errors["lateral_mm"] == pytest.approx(4, abs=0.01)
    assert errors["mssd_mm"] == pytest.approx(math.hypot(10, 4), abs=0.01)
    assert errors["rotation_deg"] == pytest.approx(0, abs=0.05)


def test_lifted_objects_float_and_lowered_ones_sink(data, bodies):
    up = torch.cat([s.planes[0].shape.normal.expand(len(s), 3) for s in data.scenes]).float()
    values = []
    for height in (0.01, -0.01):
        moved = data.truth.clone()
        moved[:, :3, 3] += height * up  # all together: what stands on another stays on it
        values.append(evaluate(moved, data, bodies))
    lifted, lowered = values
    still = evaluate(data.truth, data, bodies)
    # what stands on the table is 10 mm above it; what stands on something stays there, and some are in another's hull
    assert lifted["gap_share"] > 40
    assert lowered["inside_mm"] > still["inside_mm"] + 4
    assert lowered["gap_share"] == 0


# ---- training


def test_training_learns_and_physics_makes_it_sink_less(data, points, bodies):
    trainer = PoseTrainer(steps=25, batch=2)
    rows = range(len(data))
    plain, physical = (predict(trainer(data, points, rows, weight=w, seed=3), data) for w in (0.0, 1.0))
    coarse, plain, physical = (evaluate(poses, data, bodies) for poses in (data.coarse, plain, physical))
    assert plain["mssd_mm"] < coarse["mssd_mm"] - 2
    assert physical["inside_mm"] < plain["inside_mm"] - 0.5


def test_training_is_reproducible_and_physics_of_unlabelled_scenes_counts(data, points):
    trainer = PoseTrainer(steps=3, batch=2)
    labelled, rest = range(2), range(2, 6)
    state = torch.get_rng_state()
    one, again, more = (
        trainer(data, points, labelled, weight=0.1, seed=3, unlabelled=u).state_dict() for u in ((), (), rest)
    )
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(one[k], again[k]) for k in one)
    assert any(not torch.equal(one[k], more[k]) for k in one)


# ---- the command


def test_the_command_prints_one_table_and_writes_every_seed(bodies, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("physpose_torch.demo.household_bodies", lambda: bodies)
    out = tmp_path / "training.json"
    small = {"seeds": 2, "scenes": 3, "test-scenes": 2, "labelled": 1, "steps": 2, "weights": 0.1, "seed": 7, "json": out}
    assert main(["training", *(word for k, v in small.items() for word in (f"--{k}", str(v)))]) == 0
    text = capsys.readouterr().out
    rows = json.loads(out.read_text())["training"]
    names = [
        "labels",
        "labels, then refined",
        "labels + 0.1 physics",
        "few labels",
        "few labels + 0.1 physics on all",
    ]
    assert [r["name"] for r in rows] == ["coarse poses", *names, *names]
    assert [r["seed"] for r in rows] == [None, *[7] * 5, *[8] * 5]
    assert text.count("coarse poses") == 1
    assert text.count(" ± ") == 5 * len(training.MEASURES)


def test_the_table_shows_mean_and_standard_deviation():
    zero = dict.fromkeys(training.MEASURES, 0.0)
    rows = [{"name": "a", **zero, "mssd_mm": 1.0}, {"name": "b", **zero}, {"name": "a", **zero, "mssd_mm": 4.0}]
    first, second = training_table(rows).splitlines()[2:]
    assert first.split()[0] == "a"
    assert first.endswith("2.50 ± 2.12")
    assert "±" not in second


@pytest.mark.parametrize(
    "arguments",
    ["--seeds 0", "--labelled 9 --scenes 4", "--weights 0", "--weights nan", "--plot x.png", "--device cuda"],
)
def test_what_cannot_be_is_refused(arguments, capsys):
    assert main(["training", *arguments.split()]) == 2
    assert "error" in capsys.readouterr().err
