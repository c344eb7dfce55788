"""A pose collection goes in, and comes out with refined poses and otherwise as it was."""

import copy
import subprocess
import sys

import pandas as pd
import pytest
import torch
from standins import Collection, concatenate

from physpose_torch.adapters.happypose import HappyPoseRefiner
from physpose_torch.adapters.surroundings import Surroundings
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError, UnknownLabelError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.report import physics_report
from physpose_torch.scene import Scene, Static

TWO_IMAGES = (  # image, label, x, y, height of the centre above the table [m]
    (0, "box", 0.00, 0.00, 0.010),
    (1, "can", 0.05, 0.02, 0.055),
    (0, "can", 0.12, 0.00, 0.045),
    (1, "box", -0.10, 0.00, 0.012),
    (0, "box", -0.15, 0.03, 0.030),
)


@pytest.fixture(scope="module")
def bodies(box, can):
    return {"box": box, "can": can}


@pytest.fixture
def predictions(table):
    return of_rows(table, TWO_IMAGES)


def of_rows(table, rows, dtype=torch.float32, **columns):
    """A collection as MegaPose's pipeline returns it, with a tensor and a column more than asked for."""
    infos = pd.DataFrame(
        {
            "label": [row[1] for row in rows],
            "batch_im_id": [row[0] for row in rows],
            "pose_score": [0.9 - 0.1 * i for i in range(len(rows))],
            "note": [f"row {i}" for i in range(len(rows))],
            **columns,
        }
    )
    poses = table.poses(*(row[2:] for row in rows)).to(dtype)
    return Collection(infos, poses=poses, boxes_rend=torch.arange(4.0 * len(rows)).reshape(-1, 4))


def objects(predictions, bodies):
    return [bodies[label] for label in predictions.infos["label"]]


def test_objects_come_to_rest_on_the_table_and_on_nothing_else(table, bodies, predictions):
    refined, extra = HappyPoseRefiner(bodies, surroundings=table.plane).refine_poses(predictions)
    image = torch.tensor(predictions.infos["batch_im_id"].tolist())
    statics = [Static(table.plane, image=i) for i in range(2)]
    scene = Scene(objects(refined, bodies), statics, gravity=table.gravity, image=image)
    before, after = (physics_report(c.poses.double(), scene) for c in (predictions, refined))
    assert before.penetration_static.max() > 0.005
    assert after.penetration_static.max() < 0.001
    assert after.penetration_object.max() < 0.002
    assert after.gap.max() < 0.0015
    assert extra["report"].penetration_static.max() < 0.001


def test_the_signature_is_that_of_a_depth_refiner(table, bodies, predictions):
    refine = HappyPoseRefiner(bodies, surroundings=table.plane)
    images = {"masks": None, "depth": torch.ones(2, 4, 4), "K": torch.eye(3).expand(2, 3, 3)}
    refined, extra = refine.refine_poses(predictions, **images)
    torch.testing.assert_close(refined.poses, refine(predictions).poses, atol=0, rtol=0)
    assert isinstance(extra, dict)
    assert extra["time"] > 0


def test_extra_data_says_which_row_and_image_is_which(table, bodies, predictions):
    refined, extra = HappyPoseRefiner(bodies, surroundings=table.plane).refine_poses(predictions)
    rows, refinement = extra["rows"], extra["refinement"]
    torch.testing.assert_close(refined.poses[rows], refinement.poses, atol=0, rtol=0)
    named = [extra["images"][i] for i in refinement.image.tolist()]
    assert named == predictions.infos["batch_im_id"].iloc[rows.tolist()].tolist()
    assert refinement.steps.shape == (2,)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_all_else_is_preserved(kind, table, bodies):
    predictions = of_rows(table, TWO_IMAGES, kind, instance_id=range(5), visib_fract=0.5)
    predictions.meta = {"run": 7}
    predictions.infos.index = [10, 11, 12, 13, 14]
    refined = HappyPoseRefiner(bodies, surroundings=table.plane)(predictions)
    pd.testing.assert_frame_equal(refined.infos, predictions.infos)
    assert list(refined.tensors) == list(predictions.tensors)
    torch.testing.assert_close(refined.boxes_rend, predictions.boxes_rend, atol=0, rtol=0)
    assert refined.meta == {"run": 7}
    assert refined.poses.dtype == kind
    assert refined.poses.device == predictions.poses.device
    assert type(refined) is Collection


def test_the_input_is_not_changed_nor_shared(table, bodies, predictions):
    before = copy.deepcopy((predictions.infos, predictions.poses, predictions.boxes_rend))
    refined = HappyPoseRefiner(bodies, surroundings=table.plane)(predictions)
    refined.to(torch.float64)
    refined.poses += 1
    refined.boxes_rend += 1
    refined.infos["note"] = "changed"
    pd.testing.assert_frame_equal(predictions.infos, before[0])
    assert torch.equal(predictions.poses, before[1])
    assert torch.equal(predictions.boxes_rend, before[2])


def test_the_order_of_rows_does_not_matter(table, bodies, predictions):
    refine = HappyPoseRefiner(bodies, surroundings=table.plane)
    order = [3, 0, 4, 2, 1]
    torch.testing.assert_close(refine(predictions[order]).poses, refine(predictions).poses[order], atol=2e-5, rtol=0)


@pytest.mark.parametrize("config", [RefinerConfig(), RefinerConfig.lm()], ids=["default", "lm"])
def test_grouping_equals_refining_each_image_alone(config, table, bodies, predictions):
    refine = HappyPoseRefiner(bodies, surroundings=table.plane, config=config)
    together = refine(predictions)
    for image in (0, 1):
        rows = (predictions.infos["batch_im_id"] == image).to_numpy().nonzero()[0].tolist()
        torch.testing.assert_close(together.poses[rows], refine(predictions[rows]).poses, atol=2e-5, rtol=0)


def test_it_is_the_refiner_of_the_same_scene(table, bodies, predictions):
    """Poses in the collection's order, one image: nothing but the layer itself."""
    rows = [0, 2, 4]
    scene = Scene.tabletop(objects(predictions[rows], bodies), table.plane)
    expected = PhysPoseRefiner()(predictions.poses[rows], scene).poses
    refined = HappyPoseRefiner(bodies, surroundings=table.plane)(predictions[rows])
    torch.testing.assert_close(refined.poses, expected, atol=1e-6, rtol=0)


def test_objects_of_different_images_do_not_push_each_other(table, bodies):
    """One box inside the other, in two images; in one image they must part."""
    rows = ((0, "box", 0, 0, 0.02), (1, "box", 0.04, 0, 0.02))
    apart = HappyPoseRefiner(bodies, duplicates=False)(of_rows(table, rows))
    torch.testing.assert_close(apart.poses, of_rows(table, rows).poses, atol=1e-5, rtol=0)
    pair = HappyPoseRefiner(bodies, duplicates=False)(of_rows(table, [(0, *row[1:]) for row in rows]))
    assert (pair.poses[:, :3, 3] - apart.poses[:, :3, 3]).norm(dim=1).max() > 0.005


@pytest.mark.parametrize("column", ["view_id", "im_id"])
def test_scene_and_view_name_the_image_where_batches_have_been_joined(column, table, bodies):
    """Predictions of many batches of one image each: ``batch_im_id`` is 0 everywhere."""
    parts = []
    for view, row in ((5, (0, "box", 0, 0, 0.02)), (6, (0, "box", 0.04, 0, 0.02))):
        parts.append(of_rows(table, [row], **{"scene_id": 48, column: view}))
    refined, extra = HappyPoseRefiner(bodies).refine_poses(concatenate(parts))
    assert extra["images"] == [(48, 5), (48, 6)]
    torch.testing.assert_close(refined.poses, concatenate(parts).poses, atol=1e-5, rtol=0)


def test_columns_of_the_callers_choice_name_the_image(table, bodies, predictions):
    predictions.infos["photo"] = ["b", "a", "b", "a", "b"]
    expected = HappyPoseRefiner(bodies)(predictions)
    del predictions.infos["batch_im_id"]
    refined, extra = HappyPoseRefiner(bodies, group_by="photo").refine_poses(predictions)
    assert extra["images"] == ["b", "a"]
    torch.testing.assert_close(refined.poses, expected.poses, atol=0, rtol=0)


def test_without_any_such_column_all_rows_are_of_one_image(table, bodies, predictions):
    del predictions.infos["batch_im_id"]
    assert HappyPoseRefiner(bodies).refine_poses(predictions)[1]["images"] == [0]


def test_each_image_can_have_its_own_table(table, bodies):
    rows = ((0, "box", 0, 0, 0.01), (1, "box", 0, 0, 0.01))
    raised = Plane(table.plane.normal, table.plane.offset + 0.02)
    planes = {0: table.plane, 1: raised}
    heights = {}
    for name, surroundings in {"mapping": planes, "function": lambda key: planes[key]}.items():
        refined = HappyPoseRefiner(bodies, surroundings=surroundings)(of_rows(table, rows))
        heights[name] = table.where(refined.poses)[:, 2].tolist()
        assert heights[name] == pytest.approx([0.02, 0.04], abs=1e-3)
    assert heights["mapping"] == heights["function"]


def test_an_image_without_a_table_gets_collisions_only(table, bodies):
    rows = ((0, "box", 0, 0, 0.01), (1, "box", 0, 0, 0.01))
    refined = HappyPoseRefiner(bodies, surroundings={0: table.plane, 1: None})(of_rows(table, rows))
    assert table.where(refined.poses)[:, 2].tolist() == pytest.approx([0.02, 0.01], abs=1e-3)


def test_static_bodies_and_gravity_are_taken_as_a_robot_gives_them(table, bodies):
    """A board 20 mm thick on the table: a box that was estimated inside it ends up on it."""
    board = Static(Body.box((0.4, 0.4, 0.02), label="board"), table.at(0, 0, 0.01))
    rows = ((0, "box", 0, 0, 0.03), (1, "box", 0, 0, 0.03))
    for pair in (([board], table.gravity), Surroundings([board], table.gravity)):
        refined = HappyPoseRefiner(bodies, surroundings=pair)(of_rows(table, rows))
        assert table.where(refined.poses)[:, 2].tolist() == pytest.approx([0.04, 0.04], abs=1e-3)


def test_hypotheses_of_one_instance_do_not_push_each_other(table, bodies):
    """The detector's box in two places 85 mm apart, overlapping but not deeply; the better one stays where it is."""
    rows = ((0, "box", 0, 0, 0.02), (0, "box", 0.085, 0, 0.02))
    one = of_rows(table, rows, instance_id=[0, 0], hypothesis_id=[0, 1])
    two = of_rows(table, rows, instance_id=[0, 1])
    refine = HappyPoseRefiner(bodies, surroundings=table.plane)
    kept, extra = refine.refine_poses(one)
    assert (kept.poses[0, :3, 3] - one.poses[0, :3, 3]).norm() < 1e-3
    assert extra["report"].penetration_object[0] < 1e-3
    pushed = refine(two)
    assert (pushed.poses[:, :3, 3] - two.poses[:, :3, 3]).norm(dim=1).max() > 4e-3


def test_instances_are_counted_anew_for_each_label(table, bodies):
    """Instance 0 of the cans and instance 0 of the boxes are two objects, in each other's way."""
    rows = ((0, "box", 0, 0, 0.02), (0, "can", 0.07, 0, 0.04))
    predictions = of_rows(table, rows, instance_id=[0, 0])
    refined, extra = HappyPoseRefiner(bodies, surroundings=table.plane).refine_poses(predictions)
    assert (refined.poses[:, :3, 3] - predictions.poses[:, :3, 3]).norm(dim=1).max() > 2e-3
    assert extra["report"].penetration_object.max() < 5e-3


@pytest.mark.parametrize("options", [{"pose_score": [0.2, 0.8]}, {"score": [0.2, 0.8], "pose_score": [0.5, 0.5]}])
def test_the_score_says_which_hypothesis_acts(options, table, bodies):
    """A can 10 mm into the second hypothesis of a box, clear of the first: it has to move only if the second one acts."""
    rows = ((0, "box", -0.04, 0, 0.02), (0, "box", 0.03, 0, 0.02), (0, "can", 0.1, 0, 0.04))
    moved = {}
    for which in (0, 1):
        columns = {name: [*(values if which else values[::-1]), 0.9] for name, values in options.items()}
        predictions = of_rows(table, rows, instance_id=[0, 0, 0], **columns)
        refine = HappyPoseRefiner(bodies, surroundings=table.plane, score=next(iter(options)))
        moved[which] = float((refine(predictions).poses - predictions.poses)[2, :3, 3].norm())
    assert moved[0] < 1e-3
    assert moved[1] > 2e-3


def test_detections_of_one_object_under_two_instances_are_found(table, bodies):
    rows = ((0, "can", 0, 0, 0.04), (0, "can", 0.01, 0, 0.04))
    predictions = of_rows(table, rows, instance_id=[0, 1])
    for duplicates in (True, False):
        refine = HappyPoseRefiner(bodies, surroundings=table.plane, duplicates=duplicates)
        refined, extra = refine.refine_poses(predictions)
        assert (refined.poses - predictions.poses)[:, :3, 3].norm(dim=1).max() < 1e-3
        # two cans in one place contradict each other, and the worse one gives way
        assert extra["refinement"].rejected.tolist() == [False, not duplicates]


def test_a_stray_hypothesis_does_not_make_one_of_two(table, bodies):
    """Two cans 10 mm into each other must part, though a worse hypothesis of a third one lies deep in both of them."""
    rows = ((0, "can", 0.3, 0, 0.04), (0, "can", 0, 0, 0.04), (0, "can", -0.025, 0, 0.04), (0, "can", 0.025, 0, 0.04))
    predictions = of_rows(table, rows, instance_id=[0, 0, 1, 2])
    refined = HappyPoseRefiner(bodies, surroundings=table.plane)(predictions)
    assert (refined.poses[2, :3, 3] - refined.poses[3, :3, 3]).norm() > 0.055


def test_missing_instance_numbers_are_objects_of_their_own(table, bodies):
    rows = ((0, "can", 0, 0, 0.04), (0, "can", 0.05, 0, 0.04))
    for missing in (None, float("nan"), pd.NA):
        predictions = of_rows(table, rows, instance_id=pd.Series([missing] * 2, dtype=object))
        refined = HappyPoseRefiner(bodies, surroundings=table.plane)(predictions)
        assert (refined.poses[0, :3, 3] - refined.poses[1, :3, 3]).norm() > 0.055


def test_an_unknown_label_is_named_with_the_known_ones(table, bodies, predictions):
    predictions.infos.loc[3, "label"] = "mug"
    with pytest.raises(UnknownLabelError, match=r"row 3.*'mug'.*'box', 'can'"):
        HappyPoseRefiner(bodies)(predictions)


def test_unknown_labels_are_left_alone_on_request(table, bodies, predictions):
    predictions.infos.loc[3, "label"] = "mug"
    predictions.poses[3] = torch.nan  # whatever it is, nobody asks
    rest = [0, 1, 2, 4]
    refine = HappyPoseRefiner(bodies, surroundings=table.plane, unknown="keep")
    refined, extra = refine.refine_poses(predictions)
    assert refined.poses[3].isnan().all()
    assert sorted(extra["rows"].tolist()) == rest
    torch.testing.assert_close(refined.poses[rest], refine(predictions[rest]).poses, atol=2e-5, rtol=0)


def test_of_nothing_but_unknown_labels_nothing_changes(table, predictions):
    refined, extra = HappyPoseRefiner({}, unknown="keep").refine_poses(predictions)
    assert torch.equal(refined.poses, predictions.poses)
    assert extra["images"] == []


@pytest.mark.parametrize(
    "empty",
    [
        concatenate([]),
        Collection(pd.DataFrame(), poses=torch.Tensor(), TCO=torch.Tensor()),
        Collection(pd.DataFrame({"label": []}), poses=torch.zeros(0, 4, 4)),
    ],
    ids=["no tensors", "shapeless", "no rows"],
)
def test_an_empty_collection_is_ordinary(empty, table, bodies):
    refined, extra = HappyPoseRefiner(bodies, surroundings=table.plane).refine_poses(empty)
    assert len(refined) == 0
    assert refined is not empty
    assert list(refined.tensors) == list(empty.tensors)
    assert extra["refinement"].poses.shape == (0, 4, 4)
    assert extra["images"] == []


def test_it_works_in_inference_mode_and_with_what_was_made_in_it(table, bodies):
    refine = HappyPoseRefiner(bodies, surroundings=table.plane)
    expected = refine(of_rows(table, TWO_IMAGES)).poses
    with torch.inference_mode():
        predictions = of_rows(table, TWO_IMAGES)
        inside = refine(predictions).poses
    torch.testing.assert_close(inside, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(refine(predictions).poses, expected, atol=1e-6, rtol=0)


def test_gradients_flow_only_where_the_config_asks_for_them(table, bodies, predictions):
    predictions.poses = predictions.poses.double().requires_grad_()
    plain = HappyPoseRefiner(bodies, surroundings=table.plane)(predictions)
    assert not plain.poses.requires_grad
    config = RefinerConfig(gradient="implicit")
    through = HappyPoseRefiner(bodies, surroundings=table.plane, config=config)(predictions)
    torch.testing.assert_close(through.poses.detach(), plain.poses, atol=1e-9, rtol=0)
    (gradient,) = torch.autograd.grad(through.poses[2, :3, 3].sum(), predictions.poses)
    assert gradient.isfinite().all()
    assert gradient[2].abs().max() > 1e-3


def test_bodies_may_go_by_their_own_labels(table, bodies, predictions):
    named = HappyPoseRefiner(bodies, surroundings=table.plane)(predictions)
    listed = HappyPoseRefiner(bodies.values(), surroundings=table.plane)(predictions)
    assert torch.equal(named.poses, listed.poses)


def break_poses(p):
    p.poses = p.poses[:, :3]


def scale_poses(p):
    p.poses[2, :3, 3] *= 1000


def bend_poses(p):
    p.poses[4, :3, :3] *= 1.1


def drop_label(p):
    del p.infos["label"]


def drop_a_view(p):
    p.infos["scene_id"] = 1
    p.infos["view_id"] = [1.0, 2.0, float("nan"), 4.0, 5.0]


def drop_a_score(p):
    p.infos.loc[1, "pose_score"] = float("nan")


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (break_poses, {}, r"predictions\.poses.*\(5, 3, 4\).*\(5, 4, 4\)"),
        (scale_poses, {}, r"can.*metres"),
        (bend_poses, {}, r"predictions\.poses\[4\] \(box\) is not rigid"),
        (drop_label, {}, r"no column 'label'.*'batch_im_id'"),
        (drop_a_view, {}, r"'view_id'.*row 2.*group_by"),
        (drop_a_score, {}, r"'pose_score'.*score="),
        (None, {"score": "confidence"}, r"no column 'confidence'"),
        (None, {"group_by": ["label", "photo"]}, r"no column 'photo'"),
        (None, {"surroundings": {7: None}}, r"no image 0, only 7"),
        (None, {"surroundings": [Static]}, r"image 0.*list.*statics, gravity"),
        (None, {"surroundings": lambda key: ([], torch.zeros(2))}, r"image 0.*gravity"),
        (None, {"unknown": "ignore"}, r"'ignore'.*'raise' or 'keep'"),
    ],
)
def test_errors_name_the_culprit(spoil, options, message, bodies, predictions):
    if spoil:
        spoil(predictions)
    with pytest.raises(InvalidInputError, match=message):
        HappyPoseRefiner(bodies, **options)(predictions)


def test_a_static_of_another_image_is_refused(table, bodies, predictions):
    with pytest.raises(InvalidInputError, match="surroundings of image 0"):
        HappyPoseRefiner(bodies, surroundings=([Static(table.plane, image=1)], table.gravity))(predictions)


def test_what_is_no_collection_or_body_is_refused(box, can):
    with pytest.raises(InvalidInputError, match=r"Tensor.*PandasTensorCollection"):
        HappyPoseRefiner([box])(torch.eye(4)[None])
    with pytest.raises(InvalidInputError, match=r"str.*expected a Body"):
        HappyPoseRefiner({"box": "box.ply"})
    with pytest.raises(InvalidInputError, match="two of them are called 'box'"):
        HappyPoseRefiner([box, Body.box((1, 1, 1), label="box")])


def test_importing_the_adapters_loads_neither_pandas_nor_the_other_projects():
    modules = ["happypose", "megapose", "foundationpose", "datasets", "surroundings"]
    code = "; ".join(f"import physpose_torch.adapters.{name}" for name in modules)
    code += "; import sys; print([m for m in ('pandas', 'happypose', 'megapose', 'warp', 'coacd', 'cv2') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert run.stdout.strip() == "[]"
