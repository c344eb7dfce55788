"""Bodies of other people's objects have the size, the labels and the symmetries that those say."""

import numpy as np
import pytest
import torch
import trimesh
from standins import Continuous, Discrete, RigidObject, RigidObjectDataset

from physpose_torch import se3
from physpose_torch.adapters.datasets import bodies_from_folder, bodies_from_rigid_objects
from physpose_torch.errors import DataError, InvalidInputError

FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])


def mesh_file(folder, name="box.ply", extents=(100, 60, 40), center=(0, 0, 0)):
    """A box around a centre, in whatever unit."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    box = trimesh.creation.box(extents=extents, transform=trimesh.transformations.translation_matrix(center))
    box.export(path)
    return path


def size(body):
    return (body.upper - body.lower).tolist()


def flip_about(center):
    """Half a turn about the vertical axis through a point, in the point's unit."""
    pose = FLIP.copy()
    pose[:2, 3] = 2 * np.array(center[:2])
    return pose


@pytest.mark.parametrize("wrap", [RigidObjectDataset, list, iter], ids=["dataset", "list", "iterator"])
def test_all_objects_become_bodies_in_metres(wrap, tmp_path):
    things = [
        RigidObject("in mm", mesh_file(tmp_path, "a.ply"), "mm"),
        RigidObject("in m", mesh_file(tmp_path, "b.obj", (0.1, 0.06, 0.04)), "m"),
        RigidObject("half", mesh_file(tmp_path, "c.ply"), "mm", scaling_factor=0.5),
    ]
    bodies = bodies_from_rigid_objects(wrap(things))
    assert list(bodies) == ["in mm", "in m", "half"]
    assert [body.label for body in bodies.values()] == list(bodies)
    for label, expected in (("in mm", (0.1, 0.06, 0.04)), ("in m", (0.1, 0.06, 0.04)), ("half", (0.05, 0.03, 0.02))):
        assert size(bodies[label]) == pytest.approx(expected, abs=1e-6)
        assert bodies[label].symmetries is None


def test_units_count_where_there_is_no_scale(tmp_path):
    class Thing:
        label, mesh_path, mesh_units = "box", str(mesh_file(tmp_path)), "mm"

    assert size(bodies_from_rigid_objects([Thing()])["box"]) == pytest.approx((0.1, 0.06, 0.04), abs=1e-6)
    Thing.mesh_units = "inch"
    with pytest.raises(InvalidInputError, match=r"box.*'inch'.*'m' or 'mm'"):
        bodies_from_rigid_objects([Thing()])
    del Thing.mesh_units
    with pytest.raises(InvalidInputError, match=r"box.*'scale' nor 'mesh_units'"):
        bodies_from_rigid_objects([Thing()])


@pytest.mark.parametrize(("units", "factor"), [("mm", 1.0), ("m", 0.001)])
def test_symmetries_map_the_mesh_onto_itself_in_metres(units, factor, tmp_path):
    """A box that is not centred: half a turn about its vertical axis has a translation, in the units of the mesh."""
    extents, center = np.array([100, 60, 40]) * factor, np.array([30, 10, 5]) * factor
    path = mesh_file(tmp_path, "box.ply", extents, center)
    thing = RigidObject("box", path, units, discrete=[Discrete(flip_about(center))])
    body = bodies_from_rigid_objects([thing])["box"]
    assert body.symmetries.shape == (2, 4, 4)
    torch.testing.assert_close(body.symmetries[0], torch.eye(4, dtype=torch.float64))
    corners = torch.tensor(np.array(body.mesh.vertices))
    for T in body.symmetries:
        moved = se3.apply(T, corners)
        assert torch.cdist(moved, corners).amin(1).max() < 1e-8


@pytest.mark.parametrize(("units", "factor"), [("mm", 1.0), ("m", 0.001)])
def test_continuous_symmetries_are_those_of_bop(units, factor, tmp_path):
    """A turned part: any angle about an axis that is not the origin's, each combined with the discrete ones."""
    center = factor * np.array([20.0, 0.0, 0.0])
    path = tmp_path / "can.ply"
    can = trimesh.creation.cylinder(30 * factor, 80 * factor, sections=64)
    can.apply_translation(center)
    can.export(path)
    upside_down = np.diag([1.0, -1.0, -1.0, 1.0])
    thing = RigidObject("can", path, units, [Discrete(upside_down)], [Continuous([0, 0, 1], center.tolist())])
    body = bodies_from_rigid_objects([thing], max_symmetry_step=0.1)["can"]
    assert len(body.symmetries) == 2 * 32
    axis = torch.tensor([[0.02, 0.0, 0.0], [0.02, 0.0, 0.04]], dtype=torch.float64)
    moved = se3.apply(body.symmetries, axis)
    assert (moved[..., :2] - axis[:, :2]).abs().max() < 1e-9
    assert (moved[..., 2].abs() - axis[:, 2]).abs().max() < 1e-9


def test_the_dataset_is_not_changed(tmp_path):
    center = (0.03, 0.01, 0.005)
    path, pose = mesh_file(tmp_path, extents=(0.1, 0.06, 0.04), center=center), flip_about(center)
    thing = RigidObject("box", path, "m", [Discrete(pose)])
    bodies_from_rigid_objects([thing])
    np.testing.assert_array_equal(thing.symmetries_discrete[0].pose, pose)


def test_symmetries_that_happypose_has_rescaled_are_noticed(tmp_path):
    thing = RigidObject("box", mesh_file(tmp_path, center=(30, 10, 5)), "mm", [Discrete(flip_about((30, 10, 5)))])
    thing.make_symmetry_poses()
    with pytest.raises(DataError, match=r"box: symmetry 1 moves the centre.*63 mm.*batched.*symmetries=False"):
        bodies_from_rigid_objects([thing])
    assert bodies_from_rigid_objects([thing], symmetries=False)["box"].symmetries is None


def test_only_the_labels_asked_for_are_made(tmp_path):
    things = [RigidObject("box", mesh_file(tmp_path), "mm"), RigidObject("gone", tmp_path / "gone.ply", "mm")]
    assert list(bodies_from_rigid_objects(things, labels={"box"})) == ["box"]
    with pytest.raises(DataError, match=r"gone\.ply"):
        bodies_from_rigid_objects(things)


def test_decomposition_options_are_handed_on(tmp_path):
    things = [RigidObject("box", mesh_file(tmp_path), "mm")]
    with pytest.raises(InvalidInputError, match="no_such_option"):
        bodies_from_rigid_objects(things, no_such_option=1)
    with pytest.raises(InvalidInputError, match="no_such_option"):
        bodies_from_folder(tmp_path, no_such_option=1)


@pytest.mark.parametrize(
    ("things", "message"),
    [
        (7, "int.*RigidObjectDataset"),
        (["box"], r"objects\[0\] is a str without 'label'"),
        ([RigidObject("box", "a.ply"), RigidObject("box", "a.ply")], "a.ply"),
    ],
)
def test_what_are_no_objects_is_refused(things, message):
    with pytest.raises(ValueError, match=message):
        bodies_from_rigid_objects(things)


def test_labels_must_differ(tmp_path):
    path = mesh_file(tmp_path)
    with pytest.raises(InvalidInputError, match="two objects are called 'box'"):
        bodies_from_rigid_objects([RigidObject("box", path, "mm"), RigidObject("box", path, "mm")])


@pytest.mark.parametrize(
    ("discrete", "continuous"),
    [([Discrete(np.eye(3))], []), ([object()], []), ([], [Continuous([0, 0, 0])]), ([], [Continuous([0, 0, 1], [0])])],
)
def test_broken_symmetries_are_named(discrete, continuous, tmp_path):
    thing = RigidObject("box", mesh_file(tmp_path), "mm", discrete, continuous)
    with pytest.raises(DataError, match="box: broken symmetry"):
        bodies_from_rigid_objects([thing])


@pytest.mark.parametrize("name", ["{}/{}.ply", "{}/anything.OBJ", "{}.ply", "{}.obj"])
def test_both_layouts_of_example_folders_are_read(name, tmp_path):
    for label in ("mug", "box"):
        path = tmp_path / name.format(label, label)
        mesh_file(path.parent, path.name.lower()).rename(path)
    (tmp_path / "readme.txt").write_text("not a mesh")
    bodies = bodies_from_folder(tmp_path)
    assert list(bodies) == ["box", "mug"]
    assert size(bodies["mug"]) == pytest.approx((0.1, 0.06, 0.04), abs=1e-6)
    assert list(bodies_from_folder(str(tmp_path), labels=["mug"])) == ["mug"]


def test_meshes_in_metres_are_read_as_such(tmp_path):
    mesh_file(tmp_path, extents=(0.1, 0.06, 0.04))
    assert size(bodies_from_folder(tmp_path, mesh_units="m")["box"]) == pytest.approx((0.1, 0.06, 0.04), abs=1e-6)
    with pytest.raises(InvalidInputError, match=r"0\.0001 m large"):
        bodies_from_folder(tmp_path)
    with pytest.raises(InvalidInputError, match="'cm'"):
        bodies_from_folder(tmp_path, mesh_units="cm")
    mesh_file(tmp_path, extents=(100.0, 60.0, 40.0))
    with pytest.raises(InvalidInputError, match="100 m large"):
        bodies_from_folder(tmp_path, mesh_units="m")


def test_folders_that_leave_it_open_are_refused(tmp_path):
    with pytest.raises(DataError, match="no mesh in it"):
        bodies_from_folder(tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        bodies_from_folder(tmp_path / "meshes")
    mesh_file(tmp_path, "mug/a.ply")
    mesh_file(tmp_path, "mug/b.obj")
    with pytest.raises(DataError, match=r"two meshes for 'mug'.*a\.ply.*b\.obj"):
        bodies_from_folder(tmp_path)
