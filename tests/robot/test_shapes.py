"""Collision shapes as convex parts: exact boxes, round shapes inside their polyhedra, meshes wherever they lie."""

import math

import numpy as np
import pytest
import torch
import trimesh

from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.robot.shapes import find_mesh, link_body
from physpose_torch.robot.urdf import read_urdf


def body_of(path, **options):
    return link_body(read_urdf(path), "a", **{"meshes": "hull", **options})


def support(body, directions):
    """(D,) largest reach of the parts along each direction."""
    return (directions @ body.parts.vertices.numpy().T).max(1)


def directions(n=4000):
    x = np.random.default_rng(0).normal(size=(n, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def test_a_box_is_exact_and_where_its_origin_says(one_link):
    body = body_of(one_link('<box size="0.1 0.2 0.3"/>', f'<origin xyz="1 2 3" rpy="0 0 {math.pi / 2}"/>'))
    assert body.lower.tolist() == pytest.approx([0.9, 1.95, 2.85])
    assert body.upper.tolist() == pytest.approx([1.1, 2.05, 3.15])
    assert (body.label, body.parts.n_parts) == ("a", 1)


def test_a_sphere_lies_within_its_polyhedron_and_nearly_fills_it(one_link):
    reach = support(body_of(one_link('<sphere radius="0.1"/>')), directions())
    assert reach.min() >= 0.1 - 1e-12
    assert reach.max() <= 0.1 * 1.019
    inner = body_of(one_link('<sphere radius="0.1"/>')).parts.face_offsets
    assert float(inner.min()) == pytest.approx(0.1, abs=1e-12)  # some face touches it


def test_a_cylinder_lies_within_its_prism_and_nearly_fills_it(one_link):
    body = body_of(one_link('<cylinder radius="0.1" length="0.4"/>'))
    d = directions()
    true = 0.1 * np.linalg.norm(d[:, :2], axis=1) + 0.2 * abs(d[:, 2])
    assert (support(body, d) >= true - 1e-12).all()
    assert (support(body, d) <= true + 0.1 * 0.005).all()
    assert float(body.upper[2]) == pytest.approx(0.2)


def test_several_shapes_of_a_link_are_parts_of_one_body(write):
    body = link_body(read_urdf(write()), "slider")
    assert body.parts.n_parts == 2
    assert float(body.upper[0]) == pytest.approx(0.11)
    assert link_body(read_urdf(write()), "camera") is None


@pytest.fixture
def wedge(tmp_path):
    """A tetrahedron that a mirror changes, in millimetres."""
    mesh = trimesh.Trimesh(
        [[0, 0, 0], [100, 0, 0], [0, 200, 0], [0, 0, 300]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )
    (tmp_path / "meshes").mkdir()
    mesh.export(tmp_path / "meshes" / "wedge.stl")
    return "meshes/wedge.stl"


def test_a_mesh_is_scaled_along_each_axis(one_link, wedge):
    body = body_of(one_link(f'<mesh filename="{wedge}" scale="0.001 0.002 0.001"/>', '<origin xyz="0 0 1"/>'))
    assert body.upper.tolist() == pytest.approx([0.1, 0.4, 1.3])


@pytest.mark.parametrize("meshes", ["hull", "decompose"])
def test_a_mirrored_mesh_is_not_inside_out(one_link, wedge, meshes):
    body = body_of(one_link(f'<mesh filename="{wedge}" scale="-0.001 0.001 0.001"/>'), meshes=meshes)
    assert float(body.lower[0]) == pytest.approx(-0.1)
    assert body.mesh.volume == pytest.approx(0.1 * 0.2 * 0.3 / 6)


def test_an_angled_mesh_keeps_its_notch_unless_its_hull_is_asked_for(one_link, tmp_path):
    bounds = ([[0, 0, 0], [0.09, 0.03, 0.03]], [[0, 0, 0.03], [0.03, 0.03, 0.09]])
    trimesh.util.concatenate([trimesh.creation.box(bounds=b) for b in bounds]).export(tmp_path / "l.stl")
    path = one_link('<mesh filename="l.stl"/>')
    volume = [sum(p.volume for p in body_of(path, meshes=m).parts.to_trimesh()) for m in ("decompose", "hull")]
    assert volume[0] < 0.8 * volume[1]


@pytest.mark.parametrize(
    ("filename", "packages"),
    [
        ("meshes/wedge.stl", None),
        ("package://my_robot/meshes/wedge.stl", None),  # beside the URDF
        ("package://elsewhere/wedge.stl", {"elsewhere": "meshes"}),
        ("file://{folder}/meshes/wedge.stl", None),
    ],
)
def test_meshes_are_found_by_every_kind_of_name(write, wedge, tmp_path, filename, packages):
    packages = {k: tmp_path / v for k, v in packages.items()} if packages else None
    found = find_mesh(filename.format(folder=tmp_path), write(), packages)
    assert found.samefile(tmp_path / "meshes" / "wedge.stl")


def test_a_package_around_the_urdf_is_found(tmp_path):
    for folder in ("my_robot/urdf", "my_robot/meshes"):
        (tmp_path / folder).mkdir(parents=True)
    mesh = tmp_path / "my_robot/meshes/a.stl"
    mesh.write_bytes(b"")
    assert find_mesh("package://my_robot/meshes/a.stl", tmp_path / "my_robot/urdf/r.urdf").samefile(mesh)


@pytest.mark.parametrize(
    ("geometry", "error", "message"),
    [
        ('<mesh filename="none.stl"/>', DataError, "link 'a', collision 0: no mesh 'none.stl', looked for"),
        ('<mesh filename="package://p/none.stl"/>', DataError, "packages={'name': folder}"),
        ('<mesh filename="https://a.b/c.stl"/>', DataError, "not a local file"),
        ('<mesh filename="robot.urdf"/>', DataError, "cannot read"),
        ('<box size="100 1 1"/>', DataError, "link 'a' is 100 m large"),
        ('<mesh filename="meshes/wedge.stl"/>', DataError, 'scale="0.001 0.001 0.001"'),
    ],
)
def test_a_shape_that_cannot_be_used_is_named(one_link, wedge, geometry, error, message):
    with pytest.raises(error) as caught:
        body_of(one_link(geometry))
    assert message in str(caught.value)


def test_an_unknown_treatment_of_meshes_is_refused(one_link):
    with pytest.raises(InvalidInputError, match="'decompose' or 'hull'"):
        body_of(one_link('<sphere radius="1"/>'), meshes="convex")


def test_parts_are_in_float64_whatever_the_default(one_link):
    assert body_of(one_link('<sphere radius="1"/>')).parts.dtype == torch.float64
