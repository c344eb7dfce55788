"""An estimator's bias and spread come back from its estimates alone; what does not stand on the table does not spoil them."""

import json
import math

import pytest
import torch
import trimesh

from physpose_torch import se3
from physpose_torch.__main__ import main
from physpose_torch.bop.calibration import read_calibration, write_calibration
from physpose_torch.calibrate import Observations, calibrate, observe
from physpose_torch.config import Calibration, PhysicsConfig, RefinerConfig
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.household import perturb_like_estimator
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene, Static

BODIES = [
    Body.box((0.06, 0.16, 0.21), label="box"),
    Body.box((0.10, 0.07, 0.05), label="brick"),
    Body.cylinder(0.035, 0.11, label="can"),
]


def images(count, *, seed=0, stacked=0.15, wrong=0.1, plane_sigma=0.0, objects=6):
    """Scenes seen from 15° to 75° above, each with the true poses (M, 4, 4); some objects stand on boxes, some are wrong."""
    g = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    out = []
    for _ in range(count):
        elevation = math.radians(15 + 60 * float(rand(1)))
        up = torch.tensor([0.0, -math.cos(elevation), -math.sin(elevation)], dtype=torch.float64)
        x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        T_table = se3.from_rotation_translation(
            torch.stack([x, torch.linalg.cross(up, x), up], 1),
            torch.tensor([0.0, 0.0, 0.6 + 0.6 * float(rand(1))], dtype=torch.float64),
        )
        chosen = [BODIES[int(k)] for k in torch.randint(len(BODIES), (objects,), generator=g)]
        rows = []
        for body in chosen:
            height = 0.5 * float((body.upper - body.lower)[2])
            if float(rand(1)) < stacked:
                height += 0.03 + 0.1 * float(rand(1))
            spot = torch.tensor([*(0.5 * (rand(2) - 0.5)).tolist(), height], dtype=torch.float64)
            turn = torch.tensor([0.0, 0.0, 6.3 * float(rand(1))], dtype=torch.float64)
            if float(rand(1)) < wrong:
                turn = 3 * rand(3)
            rows.append(T_table @ se3.from_rotation_translation(se3.exp_so3(turn), spot))
        plane = Plane.from_pose(T_table)
        covariance = None
        if plane_sigma:
            shift = plane_sigma * torch.randn((), generator=g, dtype=torch.float64)
            covariance = torch.diag(torch.tensor([0.0, 0.0, plane_sigma**2], dtype=torch.float64))
            plane = Plane(plane.normal, plane.offset + shift, covariance)
        out.append((Scene(chosen, [Static(plane)], gravity=-plane.normal), torch.stack(rows)))
    return out


def estimated(scenes, *, seed=1, common=0.0, **errors):
    """Estimates of all images with known errors, and the scene of them all."""
    g = torch.Generator().manual_seed(seed)
    poses = []
    for _, truth in scenes:
        T = perturb_like_estimator(truth, generator=g, **errors)
        T[:, :3, 3] *= 1 + common * torch.randn((), generator=g, dtype=torch.float64)
        poses.append(T)
    return torch.cat(poses), Scene.cat([scene for scene, _ in scenes])


TRUE = {"depth_bias": 0.035, "depth_sigma": 0.012, "lateral_sigma": 0.004, "rotation_sigma_deg": 3.0}


@pytest.fixture(scope="module")
def recovered():
    scenes = images(800)
    poses, scene = estimated(scenes, common=0.008, **TRUE)
    return calibrate(observe(poses, scene), resamples=12)


@pytest.mark.parametrize(
    ("name", "true"),
    [
        ("depth_factor", 1 / 1.035),
        ("sigma_ray_fraction", 0.012),
        ("sigma_depth_common", 0.008),
        ("sigma_lateral", 0.004),
        ("sigma_rotation", math.radians(3.0)),
    ],
)
def test_known_bias_and_spread_are_recovered_within_a_tenth_and_the_interval(recovered, name, true):
    found, (low, high) = getattr(recovered, name), recovered.interval[name]
    assert found == pytest.approx(true, rel=0.1 if name != "depth_factor" else 0.001)
    assert low < found < high
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    assert abs(true - centre) < 1.6 * half  # three standard deviations
    assert half < 0.2 * true


def test_intervals_shrink_with_more_images_and_hold_the_truth_mostly():
    hits, widths = 0, []
    for seed in range(5):
        poses, scene = estimated(images(60, seed=seed), seed=100 + seed, **TRUE)
        low, high = calibrate(observe(poses, scene), resamples=12).interval["depth_factor"]
        hits += low <= 1 / 1.035 <= high
        widths.append(high - low)
    assert hits >= 4
    few, scene = estimated(images(240), **TRUE)
    low, high = calibrate(observe(few, scene), resamples=20).interval["depth_factor"]
    assert high - low < 0.75 * sum(widths) / len(widths)


def test_a_plane_that_is_off_is_not_put_down_to_the_estimator():
    poses, scene = estimated(images(300, plane_sigma=0.006), **TRUE)
    found = calibrate(observe(poses, scene), resamples=0)
    assert found.sigma_ray_fraction == pytest.approx(0.012, rel=0.15)
    assert found.sigma_depth_common < 0.005
    assert found.interval == {}


def test_stacked_and_wrong_objects_do_not_pull_the_factor():
    poses, scene = estimated(images(200, stacked=0.35, wrong=0.2), **TRUE)
    assert calibrate(observe(poses, scene), resamples=0).depth_factor == pytest.approx(1 / 1.035, abs=0.002)


def test_images_of_one_cluster_are_not_counted_as_independent():
    """Each image ten times: more rows, no more knowledge."""
    scenes = images(30)
    poses, scene = estimated(scenes, **TRUE)
    one = observe(poses, scene)
    ten = Observations.cat([one] * 10)
    cluster = torch.arange(one.images).repeat(10)
    width = lambda c: c.interval["depth_factor"][1] - c.interval["depth_factor"][0]  # noqa: E731
    alone = width(calibrate(one, resamples=12))
    assert width(calibrate(ten, resamples=12)) < 0.6 * alone
    assert width(calibrate(ten, cluster=cluster, resamples=12)) > 0.75 * alone


def test_batches_of_images_say_what_all_of_them_say():
    scenes = images(9)
    poses, scene = estimated(scenes, **TRUE)
    start, parts = 0, []
    for one, truth in scenes:
        parts.append(observe(poses[start : start + len(truth)], one))
        start += len(truth)
    for a, b in zip(Observations.cat(parts), observe(poses, scene), strict=True):
        torch.testing.assert_close(torch.as_tensor(a), torch.as_tensor(b))


def test_the_camera_frame_does_not_matter_up_to_a_turn_about_its_centre():
    scenes = images(5)
    poses, scene = estimated(scenes, **TRUE)
    R = se3.exp_so3(torch.tensor([0.4, -0.8, 1.1], dtype=torch.float64))
    turn = se3.from_rotation_translation(R, torch.zeros(3, dtype=torch.float64))
    statics = [Static(Plane(R @ s.shape.normal, s.shape.offset), image=s.image) for s in scene.statics]
    moved = Scene(scene.objects, statics, gravity=scene.gravity @ R.mT, image=scene.image, n_images=scene.n_images)
    for a, b in zip(observe(poses, scene), observe(turn @ poses, moved), strict=True):
        torch.testing.assert_close(torch.as_tensor(a), torch.as_tensor(b), atol=1e-7, rtol=1e-6)


def test_alternatives_walls_and_scenes_without_planes_are_not_asked(table):
    brick = BODIES[1]
    poses = table.poses((0, 0, 0.025), (0.001, 0, 0.025))
    twins = Scene([brick, brick], [Static(table.plane)], gravity=table.gravity, same_object=torch.tensor([0, 0]))
    assert len(observe(poses, twins, scores=torch.tensor([0.2, 0.9])).rise) == 1
    wall = Plane(table.T[:3, 0], torch.tensor(-0.3))
    walled = Scene([brick], [Static(wall)], gravity=table.gravity)
    assert len(observe(poses[:1], walled).rise) == 0
    assert len(observe(poses[:1], Scene([brick])).rise) == 0
    ball = Body.from_mesh(trimesh.creation.icosphere(2, 0.04), label="ball", cache=False)
    rolling = Scene([ball], [Static(table.plane)], gravity=table.gravity)
    assert len(observe(poses[:1], rolling).rise) == 0


def test_too_little_to_go_by_is_said(table):
    scene = Scene.tabletop([BODIES[1]], table.plane)
    with pytest.raises(InvalidInputError, match="only 1 of the estimates"):
        calibrate(observe(table.poses((0, 0, 0.025)), scene))
    with pytest.raises(InvalidInputError, match=r"\(N, 4, 4\)"):
        observe(table.poses((0, 0, 0.025))[None], scene)


def test_planes_that_nothing_stands_on_are_said(caplog):
    poses, scene = estimated(images(20, stacked=0.0, wrong=0.0), **TRUE)
    g = torch.Generator().manual_seed(3)
    poses[:, :3, 3] *= 0.8 + 0.5 * torch.rand(len(poses), 1, generator=g, dtype=torch.float64)
    calibrate(observe(poses, scene), resamples=0)
    assert "belong to the same images" in caplog.text


# ---- what a refinement makes of it


GIVEN = Calibration(
    0.97, 0.011, 0.003, 0.05, 0.004, {"depth_factor": (0.96, 0.98), "sigma_lateral": (0.002, 0.004)}
)


def test_a_calibrated_config_takes_bias_and_spread_and_nothing_else():
    config = RefinerConfig.lm().calibrated(GIVEN)
    physics = config.physics
    assert (physics.depth_factor, physics.sigma_ray_fraction, physics.sigma_ray) == (0.97, 0.011, 0.0)
    assert (physics.sigma_lateral, physics.sigma_rotation, physics.sigma_depth_common) == (0.003, 0.05, 0.004)
    assert config.solver == "lm"
    assert physics.collision_weight == PhysicsConfig().collision_weight


@pytest.mark.parametrize("config", [RefinerConfig(steps=40, keep_trajectory=True), RefinerConfig.lm()])
def test_the_prior_is_centred_on_the_corrected_estimates(table, config):
    """Far from anything nothing but the prior acts."""
    physics = PhysicsConfig(depth_factor=0.97, gravity_reach=0.01)
    config = type(config)(**{**vars(config), "physics": physics})
    T = table.poses((0, 0, 0.3, (0.1, 0.2, 0.3)))
    result = PhysPoseRefiner(config)(T, Scene.tabletop([BODIES[1]], table.plane))
    expected = T.clone()
    expected[:, :3, 3] *= 0.97
    torch.testing.assert_close(result.poses, expected, atol=1e-9, rtol=0)
    if config.keep_trajectory:
        torch.testing.assert_close(result.trajectory[0], T)


def test_calibration_files_come_back_as_they_went(tmp_path):
    write_calibration(tmp_path / "c.json", GIVEN, images=3)
    content = json.loads((tmp_path / "c.json").read_text())
    assert content["sigma_lateral_mm"] == pytest.approx(3.0)
    assert content["sigma_rotation_deg"] == pytest.approx(math.degrees(0.05))
    assert content["interval"]["sigma_lateral_mm"] == pytest.approx([2.0, 4.0])
    assert content["images"] == 3
    again = read_calibration(tmp_path / "c.json")
    for name in ("depth_factor", "sigma_ray_fraction", "sigma_lateral", "sigma_rotation", "sigma_depth_common"):
        assert getattr(again, name) == pytest.approx(getattr(GIVEN, name))
    assert again.interval["sigma_lateral"] == pytest.approx((0.002, 0.004))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"depth_factor": None}, "depth_factor is None"),
        ({"depth_factor": "0.97"}, "depth_factor is '0.97'"),
        ({"depth_factor": -1}, "depth_factor"),
        ({"sigma_ray_fraction": float("nan")}, "NaN|nan"),
        ({"sigma_lateral_mm": 0}, "sigma_lateral"),
        ({"sigma_rotation_deg": True}, "sigma_rotation_deg is True"),
        ({"interval": [1, 2]}, "interval"),
        ({"interval": {"depth_factor": [1]}}, "interval of depth_factor"),
    ],
)
def test_broken_calibration_files_are_named(tmp_path, change, named):
    path = tmp_path / "c.json"
    good = {"depth_factor": 0.98, "sigma_ray_fraction": 0.01, "sigma_lateral_mm": 2.0, "sigma_rotation_deg": 2.0}
    path.write_text(json.dumps(good))
    assert read_calibration(path).sigma_depth_common == 0.0
    path.write_text(json.dumps({**good, **change}))
    with pytest.raises(DataError, match=named) as error:
        read_calibration(path)
    assert "c.json" in str(error.value)


@pytest.mark.data
def test_half_of_the_scenes_predicts_the_other(ycbv, tmp_path):
    """The factor of scenes 48-51 lies in the interval of 52-55, and far from 1."""
    found = []
    for scenes in (("48", "49", "50", "51"), ("52", "53", "54", "55")):
        out = tmp_path / f"{scenes[0]}.json"
        args = ["--dataset", str(ycbv), "--planes", str(ycbv / "table_planes.json"), "--models", str(hulls(tmp_path, ycbv))]
        estimates = str(ycbv / "estimates" / "megapose_ycbv-test.csv")
        args = ["calibrate", estimates, *args, "--out", str(out), "--scenes", *scenes, "--resamples", "10", "--quiet"]
        assert main([*args, "--every", "3"]) == 0
        found.append(read_calibration(out))
    low, high = found[1].interval["depth_factor"]
    assert low < found[0].depth_factor < high < 0.99


def hulls(tmp_path, ycbv):
    """The convex hulls of the models: as good for standing, and decomposed at once."""
    folder = tmp_path / "hulls"
    if not folder.is_dir():
        folder.mkdir()
        for path in sorted((ycbv / "models").glob("*.ply")):
            trimesh.load_mesh(path).convex_hull.export(folder / path.name)
    return folder


# ---- what a review found


def test_a_fit_does_not_leap_out_of_its_basin(table):
    """Few images from one viewpoint, a floor below the table, hardly any tilt: the likelihood is steep and has many maxima."""
    g = torch.Generator().manual_seed(0)
    floor = Plane(table.plane.normal, table.plane.offset - 0.15)
    scenes, poses = [], []
    for _ in range(12):
        spots = 0.4 * (torch.rand(6, 2, generator=g, dtype=torch.float64) - 0.5)
        turns = 0.01 * torch.randn(6, 3, generator=g, dtype=torch.float64)
        rows = [table.at(x, y, 0.025, turn) for (x, y), turn in zip(spots.tolist(), turns, strict=True)]
        poses.append(perturb_like_estimator(torch.stack(rows), generator=g, depth_bias=0.0, rotation_sigma_deg=0.0))
        scenes.append(Scene([BODIES[1]] * 6, [Static(table.plane), Static(floor)], gravity=table.gravity))
    seen = observe(torch.cat(poses), Scene.cat(scenes))
    assert len(seen.rise) == 72  # each with its nearest plane
    assert calibrate(seen, resamples=0).depth_factor == pytest.approx(1.0, abs=0.01)


def test_calibrating_works_in_inference_mode_and_checks_its_clusters():
    poses, scene = estimated(images(12), **TRUE)
    seen = observe(poses, scene)
    with torch.inference_mode():
        inside = calibrate(observe(poses, scene), resamples=2)
    assert inside == calibrate(seen, resamples=2)
    with pytest.raises(InvalidInputError, match="cluster"):
        calibrate(seen, cluster=torch.zeros(11, dtype=torch.long))


@pytest.mark.parametrize("factor", [0.0, 0.4, 2.5, float("inf"), float("nan")])
def test_a_depth_factor_that_is_a_unit_is_refused(factor):
    for make in (lambda: Calibration(factor, 0.01, 0.002, 0.03), lambda: PhysicsConfig(depth_factor=factor)):
        with pytest.raises(InvalidInputError, match="depth_factor"):
            make()


@pytest.mark.parametrize("out", ["missing/c.json", "."])
def test_where_nothing_can_be_written_nothing_is_begun(tmp_path, out, capsys):
    args = ["calibrate", "e.csv", "--dataset", "d", "--planes", "p.json", "--out", str(tmp_path / out)]
    assert main(args) == 2
    assert "name a file to write" in capsys.readouterr().err
