"""What a BOP folder holds is found; what it lacks is said clearly."""

import json
import logging

import numpy as np
import pytest
import torch
import trimesh
from bop_files import K, metres, random_pose, write_depth, write_mesh, write_models, write_scene
from PIL import Image
from scipy.spatial.transform import Rotation

from physpose_torch.bop.dataset import BopDataset, symmetry_transforms
from physpose_torch.errors import DataError, InvalidInputError, UnknownLabelError


def test_ids_with_gaps_and_units(bop_folder):
    dataset = BopDataset(bop_folder)
    assert dataset.object_ids == [1, 4, 9]
    assert dataset.scene_ids == [2, 11]
    assert dataset.images() == [(2, 3), (2, 40), (11, 3), (11, 40)]
    camera = dataset.camera(11, 40)
    assert camera.K.flatten().tolist() == K
    assert camera.depth_scale == pytest.approx(1e-4)
    gt = dataset.ground_truth(2)
    assert gt.im_id.tolist() == [3] * 6 + [40] * 5
    assert gt.gt_id.tolist() == [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 4]
    assert gt.obj_id.tolist() == [1, 1, 4, 9, 9, 9, 1, 1, 4, 9, 9]
    raw = json.loads((bop_folder / "test" / "000002" / "scene_gt.json").read_text())["40"][4]
    assert gt.T_camera_object[-1, :3, 3].tolist() == pytest.approx([x / 1000 for x in raw["cam_t_m2c"]])
    assert gt.T_camera_object[-1, :3, :3].flatten().tolist() == raw["cam_R_m2c"]
    assert dataset.diameter(1) == pytest.approx(np.linalg.norm([0.06, 0.04, 0.1]))
    assert dataset.vertices(1).abs().amax(0).tolist() == pytest.approx([0.03, 0.02, 0.05])
    assert dataset.model_path(9) == bop_folder / "models" / "obj_000009.ply"
    assert len(dataset.targets) == 12


@pytest.mark.parametrize(
    ("folders", "found"),
    [
        (["test"], "test"),
        (["test", "test_all", "train_pbr", "val"], "test"),
        (["test_primesense", "train_real", "val_primesense"], "test_primesense"),
        (["val", "train_pbr"], "val"),
        (["train_pbr"], "train_pbr"),
        (["test_primesense", "test_kinect", "train"], None),
        (["train_pbr", "train_real"], None),
        ([], None),
    ],
)
def test_the_split_is_found_or_the_choices_are_listed(tmp_path, rng, folders, found):
    write_models(tmp_path / "models")
    for name in folders:
        write_scene(tmp_path / name, 1, {1: [(1, random_pose(rng), 1.0)]})
    if found:
        assert BopDataset(tmp_path).split_path == tmp_path / found
        assert BopDataset(tmp_path, split=folders[-1]).split_path.name == folders[-1]
    else:
        with pytest.raises(DataError, match=", ".join(sorted(folders)) or "no folder with scenes"):
            BopDataset(tmp_path)
    with pytest.raises(DataError, match=r"no split 'tset'.*there are: "):
        BopDataset(tmp_path, split="tset")
    for escape in ("../elsewhere", "..", "/tmp", ""):
        with pytest.raises(InvalidInputError, match="expected the name of a folder"):
            BopDataset(tmp_path, split=escape)


def test_no_such_folder(tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        BopDataset(tmp_path / "none")


def test_an_unknown_object_is_named_with_folder_and_choices(bop_folder):
    with pytest.raises(UnknownLabelError, match=r"object 7 has no mesh obj_000007.ply in .*models; .*1, 4, 9") as error:
        BopDataset(bop_folder).model_path(7)
    assert isinstance(error.value, KeyError)


def test_eval_models_serve_errors_and_an_override_serves_physics(bop_folder, tmp_path):
    write_mesh(bop_folder / "models_eval" / "obj_000001.ply", [60, 40, 100])
    write_mesh(tmp_path / "mine" / "obj_000001.ply", [66, 40, 100])
    dataset = BopDataset(bop_folder, models=tmp_path / "mine")
    assert dataset.models_path == tmp_path / "mine"
    assert dataset.object_ids == [1]
    assert dataset.model_path(1).parent.name == "mine"
    assert dataset.model_path(1, evaluation=True).parent.name == "models_eval"
    assert dataset.vertices(1)[:, 0].max() == pytest.approx(0.03)
    with pytest.raises(DataError, match="no such folder"):
        _ = BopDataset(bop_folder, models=tmp_path / "none").models_path


@pytest.mark.parametrize(
    ("names", "physics", "errors"),
    [
        (["models_cad", "models_reconst", "models_eval"], "models_cad", "models_eval"),
        (["models", "models_fine"], "models", "models"),
        (["models_eval"], "models_eval", "models_eval"),
        (["models_reconst"], "models_reconst", "models_reconst"),
    ],
)
def test_models_folders_of_all_datasets(tmp_path, rng, names, physics, errors):
    write_scene(tmp_path / "test", 1, {1: [(1, random_pose(rng), 1.0)]})
    for name in names:
        write_mesh(tmp_path / name / "obj_000001.ply", [1, 1, 1])
    dataset = BopDataset(tmp_path)
    assert (dataset.models_path.name, dataset.eval_models_path.name) == (physics, errors)


def test_missing_parts_are_named_only_when_they_are_needed(tmp_path, rng, caplog):
    write_scene(tmp_path / "test", 1, {5: [(1, random_pose(rng), 1.0)]}, visib=False)
    (tmp_path / "test" / "000001" / "scene_camera.json").unlink()
    dataset = BopDataset(tmp_path)
    assert dataset.images() == [(1, 5)]
    assert np.isnan(dataset.ground_truth(1).visib_fract).all()
    with pytest.raises(DataError, match="no folder models/"):
        _ = dataset.object_ids
    with pytest.raises(DataError, match=r"scene_camera.json: cannot be read"):
        dataset.camera(1, 5)
    with pytest.raises(DataError, match=r"scene 7 is not in .*there are 1"):
        dataset.ground_truth(7)
    with pytest.raises(DataError, match="scene 1, image 5: no rgb image in"):
        dataset.image_path(1, 5)
    with pytest.raises(InvalidInputError, match="expected 'rgb', 'gray' or 'depth'"):
        dataset.image_path(1, 5, "../x")
    write_models(tmp_path / "models", info=False)
    dataset = BopDataset(tmp_path)
    with pytest.raises(DataError, match=r"models_info.json: no diameter of object 1"):
        dataset.diameter(1)
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        assert dataset.symmetries(4).shape == (1, 4, 4)


@pytest.mark.parametrize(
    ("name", "content", "call", "message"),
    [
        (
            "scene_gt.json",
            {"3": [{"obj_id": 1, "cam_R_m2c": [1], "cam_t_m2c": [1, 2, 3]}]},
            "gt",
            "entry 0: 'cam_R_m2c'",
        ),
        ("scene_gt.json", {"3": [{"cam_R_m2c": [1] * 9, "cam_t_m2c": [1, 2, 3]}]}, "gt", "image 3, entry 0: 'obj_id'"),
        ("scene_gt.json", {"3": 5}, "gt", "image 3: expected a list"),
        ("scene_gt.json", [1], "gt", "ids as keys"),
        ("scene_gt_info.json", {"3": [{}]}, "gt", "not one entry for each of the 6"),
        ("scene_gt_info.json", {"3": [{"visib_fract": "x"}] * 6}, "gt", "'visib_fract'"),
        ("scene_camera.json", {"3": {}}, "camera", "image 3: 'cam_K' is missing"),
        ("scene_camera.json", {"3": {"cam_K": [0] * 9}}, "camera", "expected a pinhole"),
        ("scene_camera.json", {"3": {"cam_K": K, "depth_scale": "x"}}, "camera", "'depth_scale'"),
        ("scene_camera.json", {"4": {"cam_K": K}}, "camera", "image 3: no such image; there are 4"),
    ],
)
def test_broken_scene_files_are_named_with_the_place(bop_folder, name, content, call, message):
    folder = bop_folder / "test" / "000002"
    (folder / name).write_text(json.dumps(content))
    if name == "scene_gt.json":
        (folder / "scene_gt_info.json").unlink()
    dataset = BopDataset(bop_folder)
    with pytest.raises(DataError, match=message) as error:
        dataset.ground_truth(2) if call == "gt" else dataset.camera(2, 3)
    assert "000002" in str(error.value)


def test_without_a_list_all_objects_visible_to_a_tenth_are_targets(bop_folder, rng):
    (bop_folder / "test_targets_bop19.json").unlink()
    visible = [(1, random_pose(rng), fraction) for fraction in (0.1, 0.0999, 0.9)] + [(4, random_pose(rng), 0.05)]
    write_scene(bop_folder / "test", 5, {8: visible})
    targets = [tuple(target) for target in BopDataset(bop_folder).targets]
    assert [target for target in targets if target[0] == 5] == [(5, 8, 1, 2)]


def test_targets_can_be_named_and_belong_to_their_split(bop_folder, rng, tmp_path):
    write_scene(bop_folder / "val", 1, {1: [(1, random_pose(rng), 1.0)]})
    assert BopDataset(bop_folder, split="val").targets == [(1, 1, 1, 1)]
    (bop_folder / "mine.json").write_text('[{"scene_id": 2, "im_id": 3, "obj_id": 1, "inst_count": 1}]')
    assert len(BopDataset(bop_folder, targets="mine.json").targets) == 1
    assert len(BopDataset(bop_folder, targets=bop_folder / "mine.json").targets) == 1
    with pytest.raises(DataError, match=r"none.json: cannot be read"):
        _ = BopDataset(bop_folder, targets="none.json").targets


def test_image_width_comes_from_the_option_an_image_the_camera_file_or_the_principal_point(bop_folder, caplog):
    assert BopDataset(bop_folder).image_width(2) == 720  # camera.json
    assert BopDataset(bop_folder, image_width=1920).image_width(2) == 1920
    folder = bop_folder / "test" / "000002" / "gray"
    folder.mkdir()
    (folder / "000001.png").write_text("no image")
    Image.new("L", (1280, 960)).save(folder / "000040.tif")
    dataset = BopDataset(bop_folder)
    assert dataset.image_width(2) == 1280
    assert dataset.image_width(11) == 720
    assert dataset.image_path(2, 40, "gray") == folder / "000040.tif"
    (bop_folder / "camera.json").unlink()
    assert BopDataset(bop_folder).image_width(11) == 1280  # an image of another scene
    (folder / "000040.tif").unlink()
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        assert BopDataset(bop_folder).image_width(11) == 640
    assert "taking them to be 640 px wide, as cx = 330.0 suggests" in caplog.text


def test_image_height_comes_with_the_width(bop_folder, caplog):
    assert BopDataset(bop_folder).image_size(2) == (720, 480)  # camera.json
    assert BopDataset(bop_folder, image_width=1440).image_size(2) == (1440, 960)
    (bop_folder / "camera.json").write_text('{"width": 1280}')
    assert BopDataset(bop_folder).image_size(2) == (1280, 960)
    (bop_folder / "camera.json").unlink()
    with caplog.at_level(logging.WARNING, "physpose_torch"):
        assert BopDataset(bop_folder).image_size(2) == (640, 480)  # cx = 330, cy = 236
    assert "480 px high (cy = 236.0)" in caplog.text
    camera = json.loads((bop_folder / "test" / "000002" / "scene_camera.json").read_text())
    for entry in camera.values():
        entry["cam_K"][2], entry["cam_K"][5] = 961.0, 537.0
    (bop_folder / "test" / "000002" / "scene_camera.json").write_text(json.dumps(camera))
    assert BopDataset(bop_folder).image_size(2) == (1920, 1080)


def test_a_depth_image_is_read_in_metres_and_unknown_is_zero(bop_folder):
    depth = np.array([[0, 0.5, 1.25], [0.0001, 6.5535, 0]])
    write_depth(bop_folder / "test" / "000002", 40, depth)
    dataset = BopDataset(bop_folder)
    assert dataset.has_image(2, 40, "depth")
    assert not dataset.has_image(2, 3, "depth")
    read = dataset.depth(2, 40)
    assert read.dtype == torch.float64
    np.testing.assert_allclose(read, depth, atol=1e-12)
    with pytest.raises(DataError, match="scene 2, image 3: no depth image"):
        dataset.depth(2, 3)


def test_a_mesh_has_faces_and_the_corners_of_its_hull(bop_folder):
    dataset = BopDataset(bop_folder)
    assert dataset.faces(1).shape == (192, 3)  # a box, each side cut into 32 triangles
    assert dataset.faces(1).max() < len(dataset.vertices(1)) == 98
    corners = dataset.hull(1)
    assert corners.abs().unique(dim=0).tolist() == [pytest.approx([0.03, 0.02, 0.05])]
    flat = trimesh.Trimesh([[0, 0, 0], [10, 0, 0], [0, 10, 0]], [[0, 1, 2]], process=False)
    flat.export(bop_folder / "models" / "obj_000004.ply")
    assert len(BopDataset(bop_folder).hull(4)) == 3


def test_discrete_symmetries_come_in_metres_after_the_identity(bop_folder):
    symmetries = BopDataset(bop_folder).symmetries(9)
    expected = torch.diag(torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64))
    expected[0, 3] = 0.004
    torch.testing.assert_close(symmetries, torch.stack([torch.eye(4, dtype=torch.float64), expected]))


def test_continuous_symmetries_are_steps_about_the_axis_and_combine_with_discrete_ones():
    flip = np.diag([1.0, -1, -1, 1])
    flip[:3, 3] = [1, 2, 3]
    axis, offset = np.array([1.0, 2, -2]), np.array([10.0, -20, 30])
    info = {
        "symmetries_discrete": [flip.flatten().tolist()],
        "symmetries_continuous": [{"axis": axis.tolist(), "offset": offset.tolist()}],
    }
    symmetries = symmetry_transforms(info)
    assert symmetries.shape == (2 * 315, 4, 4)  # ceil(π / 0.01) = 315
    expected = []
    for discrete in (np.eye(4), flip):
        for i in range(315):
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec(axis / 3 * 2 * np.pi * i / 315).as_matrix()
            T[:3, 3] = offset - T[:3, :3] @ offset
            expected.append(T @ discrete)
    torch.testing.assert_close(symmetries, metres(expected), atol=1e-13, rtol=0)
    assert symmetry_transforms(info, max_step=0.5).shape == (2 * 7, 4, 4)
    assert symmetry_transforms({}).shape == (1, 4, 4)


@pytest.mark.parametrize(
    "broken",
    [
        {"symmetries_discrete": [[1, 2, 3]]},
        {"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]},
        {"symmetries_continuous": [{"axis": [0, 0, 1]}]},
        {"symmetries_continuous": [3]},
    ],
)
def test_broken_symmetries_are_named_with_the_object(bop_folder, broken):
    (bop_folder / "models" / "models_info.json").write_text(json.dumps({"4": broken}))
    with pytest.raises(DataError, match=r"models_info.json, object 4: broken symmetry"):
        BopDataset(bop_folder).symmetries(4)


def test_an_unreadable_mesh_is_named(bop_folder):
    (bop_folder / "models" / "obj_000004.ply").write_text("no mesh")
    with pytest.raises(DataError, match=r"cannot read .*obj_000004.ply as a mesh"):
        BopDataset(bop_folder).vertices(4)


@pytest.mark.data
def test_the_ycbv_folder_is_read(ycbv):
    dataset = BopDataset(ycbv)
    assert dataset.object_ids == list(range(1, 22))
    assert dataset.scene_ids == list(range(48, 56))
    assert len(dataset.images()) == 600
    assert sum(target.inst_count for target in dataset.targets) == 2700
    assert dataset.image_width(48) == 640
    assert [len(dataset.symmetries(i)) for i in (1, 2, 13, 16, 18, 19)] == [2, 1, 315, 8, 315, 2]
    for obj_id in dataset.object_ids:  # official diameters and the meshes agree, so units are right
        size = dataset.vertices(obj_id)
        assert 0.5 * dataset.diameter(obj_id) < (size.amax(0) - size.amin(0)).norm() < 1.5 * dataset.diameter(obj_id)
