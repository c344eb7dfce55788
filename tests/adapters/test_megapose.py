"""MegaPose's example folders are read as MegaPose writes them, and written as it reads them."""

import json

import pytest
import torch
import trimesh

from physpose_torch.adapters.datasets import bodies_from_folder
from physpose_torch.adapters.megapose import ObjectData, read_camera_data, read_object_data, write_object_data
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene

HALF = 0.5**0.5
QUARTER_TURN_ABOUT_X = [HALF, 0.0, 0.0, HALF]  # x, y, z, w
ROWS = [
    {"label": "mug", "TWO": [QUARTER_TURN_ABOUT_X, [0.1, -0.2, 0.7]], "bbox_modal": [384, 234, 522, 455]},
    {"label": "box", "TWO": [[0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.5]], "visib_fract": 0.8},
]


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "object_data.json"
    path.write_text(json.dumps(ROWS))
    return path


def test_the_scalar_of_a_quaternion_comes_last_and_lengths_are_metres(path):
    data = read_object_data(path)
    assert data.labels == ("mug", "box")
    expected = torch.tensor([[1, 0, 0, 0.1], [0, 0, -1, -0.2], [0, 1, 0, 0.7], [0, 0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(data.poses[0], expected)
    torch.testing.assert_close(data.poses[1, :3, :3], torch.eye(3, dtype=torch.float64))


def test_new_poses_are_written_with_whatever_else_was_there(path, tmp_path, table):
    poses = table.poses((0.1, 0, 0.04, (0.3, 2.0, -1.0)), (0, 0.2, 0.02, (3.1, 0, 0)))
    out = tmp_path / "outputs" / "refined.json"
    write_object_data(out, read_object_data(path).with_poses(poses.float()))
    again = read_object_data(out)
    torch.testing.assert_close(again.poses, poses, atol=1e-6, rtol=0)
    content = json.loads(out.read_text())
    assert [set(row) for row in content] == [set(row) for row in ROWS]
    assert content[0]["bbox_modal"] == ROWS[0]["bbox_modal"]
    assert content[1]["visib_fract"] == ROWS[1]["visib_fract"]
    assert json.loads(path.read_text()) == ROWS


def test_poses_of_ones_own_are_written_too(tmp_path, table):
    data = ObjectData(("box",), table.at(turn=(1, 2, 3))[None])
    write_object_data(tmp_path / "a.json", data)
    torch.testing.assert_close(read_object_data(tmp_path / "a.json").poses, data.poses, atol=1e-12, rtol=0)


def test_detections_have_no_poses(path):
    path.write_text(json.dumps([{"label": "mug", "bbox_modal": [0, 0, 1, 1]}]))
    data = read_object_data(path)
    assert (data.labels, data.poses) == (("mug",), None)
    write_object_data(path, data)
    assert json.loads(path.read_text()) == [{"label": "mug", "bbox_modal": [0, 0, 1, 1]}]


def test_an_empty_list_is_ordinary(path):
    path.write_text("[]")
    data = read_object_data(path)
    assert data.poses.shape == (0, 4, 4)
    write_object_data(path, data.with_poses(data.poses))
    assert json.loads(path.read_text()) == []


def test_an_example_folder_is_refined_in_a_few_lines(tmp_path, table):
    """Meshes in mm, an estimate 10 mm inside the table: the file that comes out has it on the table."""
    (tmp_path / "meshes" / "box").mkdir(parents=True)
    trimesh.creation.box(extents=(100, 60, 40)).export(tmp_path / "meshes" / "box" / "model.ply")
    write_object_data(tmp_path / "outputs" / "object_data.json", ObjectData(("box",), table.at(z=0.01)[None]))

    data = read_object_data(tmp_path / "outputs" / "object_data.json")
    bodies = bodies_from_folder(tmp_path / "meshes", labels=data.labels)
    scene = Scene.tabletop([bodies[label] for label in data.labels], table.plane)
    refined = PhysPoseRefiner()(data.poses, scene)
    write_object_data(tmp_path / "outputs" / "refined.json", data.with_poses(refined.poses))

    pose = read_object_data(tmp_path / "outputs" / "refined.json").poses[0]
    assert float(table.where(pose)[2]) == pytest.approx(0.02, abs=1e-3)


def test_cameras_are_read(tmp_path):
    path = tmp_path / "camera_data.json"
    content = {"K": [[605.9, 0, 319.6], [0, 605.1, 247.3], [0, 0, 1]], "resolution": [480, 640]}
    path.write_text(json.dumps(content))
    camera = read_camera_data(path)
    assert camera.K.tolist() == content["K"]
    assert camera.resolution == (480, 640)
    assert camera.T_world_camera is None
    path.write_text(json.dumps({**content, "TWC": [QUARTER_TURN_ABOUT_X, [1, 2, 3]]}))
    assert read_camera_data(path).T_world_camera[:3, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"label": "mug"}, "list of objects, got a dict"),
        ([{"TWO": ROWS[0]["TWO"]}], "row 0.*'label'"),
        ([ROWS[0], {"label": "box"}], r"row 1 \(box\).*no pose 'TWO'"),
        ([{"label": "box", "TWO": None}], r"row 0 \(box\): TWO = None"),
        ([{"label": "box", "TWO": [[0, 0, 0, 2], [0, 0, 0]]}], "unit quaternion"),
        ([{"label": "box", "TWO": [[0, 0, 1], [0, 0, 0]]}], "unit quaternion"),
        ([{"label": "box", "TWO": [[0, 0, 0, 1], [0, 0, "x"]]}], "unit quaternion"),
    ],
)
def test_broken_object_files_are_named_with_their_row(content, message, path):
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=f"object_data.json.*{message}"):
        read_object_data(path)


@pytest.mark.parametrize(
    "content", [[], {"resolution": [480, 640]}, {"K": [[1, 0], [0, 1]]}, {"K": [[1, 0, 0]] * 3, "resolution": [480]}]
)
def test_broken_camera_files_are_named(content, path):
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"object_data\.json.*expected"):
        read_camera_data(path)


def test_a_missing_file_and_no_json_are_named(tmp_path):
    with pytest.raises(DataError, match="nowhere"):
        read_object_data(tmp_path / "nowhere.json")
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(DataError, match="broken"):
        read_camera_data(tmp_path / "broken.json")


def test_poses_must_fit_the_labels(path, table):
    data = read_object_data(path)
    with pytest.raises(InvalidInputError, match=r"\(1, 4, 4\), expected \(2, 4, 4\)"):
        data.with_poses(table.at()[None])
    with pytest.raises(InvalidInputError, match="not rigid"):
        data.with_poses(torch.stack([table.at(), table.at() @ torch.diag(torch.tensor([2.0, 2, 2, 1]).double())]))
