"""Bodies and planes: sizes, units, meshes good and bad."""

import math

import numpy as np
import pytest
import torch
import trimesh

from physpose_torch import se3
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.body import Body, Plane


def test_a_box_has_its_size_one_part_and_its_centre_at_the_origin():
    body = Body.box((0.1, 0.06, 0.04), label="box")
    assert body.parts.n_parts == body.parts.n_bodies == 1
    assert torch.allclose(body.upper, torch.tensor([0.05, 0.03, 0.02], dtype=torch.float64))
    assert torch.allclose(body.center, torch.zeros(3, dtype=torch.float64))
    assert body.radius == pytest.approx(math.sqrt(0.05**2 + 0.03**2 + 0.02**2))
    assert len(body.parts.part(0)[0]) == 8
    assert "100 × 60 × 40 mm" in repr(body)


def test_a_cylinder_is_one_prism_that_reaches_its_radius_and_height():
    body = Body.cylinder(0.03, 0.08, label="can")
    vertices = body.parts.part(0)[0]
    assert body.parts.n_parts == 1
    assert torch.allclose(vertices[:, :2].norm(dim=1), torch.tensor(0.03, dtype=torch.float64))
    assert torch.allclose(vertices[:, 2].abs(), torch.tensor(0.04, dtype=torch.float64))
    # 32 sides: its volume is short of π r² h by less than 1 %
    volume = trimesh.convex.convex_hull(vertices.numpy()).volume
    assert 0.99 < volume / (math.pi * 0.03**2 * 0.08) < 1.0


@pytest.mark.parametrize("as_path", [True, False], ids=["path", "trimesh"])
def test_a_mesh_in_millimetres_becomes_metres_and_is_left_as_it_was(as_path, tmp_path):
    mesh = trimesh.creation.box((100.0, 60.0, 40.0))
    before = mesh.vertices.copy()
    source = tmp_path / "box.ply"
    if as_path:
        mesh.export(source)
    body = Body.from_mesh(source if as_path else mesh, label="box", scale=1e-3)
    assert torch.allclose(body.upper - body.lower, torch.tensor([0.1, 0.06, 0.04], dtype=torch.float64))
    assert body.parts.n_parts == 1
    assert torch.allclose(body.parts.lower[0], body.lower, atol=1e-6)
    assert body.decomposition.method == "convex"
    assert np.array_equal(mesh.vertices, before)


def test_a_mesh_with_holes_is_still_a_body():
    closed = trimesh.creation.box((0.1, 0.06, 0.04)).subdivide().subdivide()
    torn = trimesh.Trimesh(closed.vertices, closed.faces[3:], process=False)
    assert not torn.is_watertight
    body = Body.from_mesh(torn, label="torn")
    assert body.parts.n_parts == 1
    assert torch.allclose(body.upper - body.lower, torch.tensor([0.1, 0.06, 0.04], dtype=torch.float64), atol=1e-6)


def test_the_centre_of_mass_of_a_watertight_mesh_is_that_of_its_volume(angle):
    """A hollow box open at the top: its bounds know nothing of where the walls are."""
    outer = trimesh.creation.box(bounds=[[-0.05, -0.05, 0], [0.05, 0.05, 0.1]])
    inner = trimesh.creation.box(bounds=[[-0.04, -0.04, 0.02], [0.04, 0.04, 0.09]])
    inner.invert()
    tin = Body("tin", Body.box((0.1, 0.1, 0.1), label="tin").parts, trimesh.util.concatenate([outer, inner]))
    solid, hollow = 0.1**3, 0.08 * 0.08 * 0.07
    expected = (solid * 0.05 - hollow * 0.055) / (solid - hollow)
    assert tin.center_of_mass.tolist() == pytest.approx([0, 0, expected], abs=1e-9)
    foot, post = 0.09, 0.06
    x = (foot * 0.045 + post * 0.015) / (foot + post)
    z = (foot * 0.015 + post * 0.06) / (foot + post)
    assert angle.center_of_mass.tolist() == pytest.approx([x, 0.015, z], abs=1e-9)


def test_the_centre_of_mass_of_a_mesh_with_holes_is_that_of_its_parts(angle):
    torn = trimesh.Trimesh(angle.mesh.vertices, angle.mesh.faces[1:], process=False)
    body = Body("torn", angle.parts, torn)
    assert not torn.is_volume
    assert torch.allclose(body.center_of_mass, angle.center_of_mass)
    inside_out = angle.mesh.copy()
    inside_out.invert()
    assert torch.allclose(Body("inverted", angle.parts, inside_out).center_of_mass, angle.center_of_mass)


def test_symmetries_are_kept_and_checked():
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    both = torch.stack([torch.eye(4, dtype=torch.float64), half_turn])
    assert torch.equal(Body.from_mesh(mesh, label="box", symmetries=both).symmetries, both)
    with pytest.raises(InvalidInputError, match="box: symmetries"):
        Body.from_mesh(mesh, label="box", symmetries=2 * both)


def test_a_mesh_that_must_be_in_millimetres_is_refused_with_the_remedy():
    with pytest.raises(InvalidInputError, match=r"box is 100 m large.*scale=0\.001.*scale=1\.0"):
        Body.from_mesh(trimesh.creation.box((100.0, 60.0, 40.0)), label="box", cache=False)


@pytest.mark.parametrize(("size", "scale"), [(1e-3, None), (1.0, 1e-3), (100.0, 1.0), (1e5, 1e-3)])
def test_meshes_of_a_millimetre_to_a_hundred_metres_become_bodies(size, scale):
    extents = torch.tensor([1.0, 0.6, 0.4], dtype=torch.float64) * size * (scale or 1.0)
    mesh = trimesh.creation.box([size, 0.6 * size, 0.4 * size])
    body = Body.from_mesh(mesh, label="box", scale=scale, cache=False)
    assert body.parts.n_parts == 1
    torch.testing.assert_close(body.parts.upper[0], 0.5 * extents, atol=2e-9, rtol=1e-6)
    torch.testing.assert_close(body.upper, 0.5 * extents)


@pytest.mark.parametrize("options", [{}, {"tolerance": 0.2}])
def test_a_large_mesh_is_cut_as_finely_as_a_small_one_and_says_how_well(options):
    """An L of 60 m, to 0.4 % of that or to what is given, in metres."""
    outline = np.array([[0, 0], [60, 0], [60, 20], [20, 20], [20, 60], [0, 60]])
    flat = [[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]]
    faces = [[a, c, b] for a, b, c in flat] + [[a + 6, b + 6, c + 6] for a, b, c in flat]
    for i in range(6):
        k = (i + 1) % 6
        faces += [[i, k, k + 6], [i, k + 6, i + 6]]
    mesh = trimesh.Trimesh(np.concatenate([np.c_[outline, np.full(6, z)] for z in (0, 20)]), faces)
    body = Body.from_mesh(mesh, label="L", scale=1.0, cache=False, **options)
    assert body.parts.n_parts == 2
    assert body.decomposition.outward_p95 < options.get("tolerance", 0.24)
    assert float(body.parts.upper[:, 0].max()) == pytest.approx(60.0, abs=0.3)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Body.box((0.1, 0.1), label="tin"), InvalidInputError, "tin.*three positive"),
        (lambda: Body.box((0.1, -0.1, 0.1), label="tin"), InvalidInputError, "tin.*three positive"),
        (lambda: Body.cylinder(0.0, 0.1, label="tin"), InvalidInputError, "tin.*positive"),
        (lambda: Body.cylinder(0.1, math.nan, label="tin"), InvalidInputError, "tin.*positive"),
        (lambda: Body.from_mesh("no/such/file.ply", label="tin"), DataError, "tin.*no/such/file.ply"),
        (lambda: Body.from_mesh(trimesh.creation.box(), label="tin", scale=-1.0), InvalidInputError, "tin: scale"),
        (lambda: Body.from_mesh(trimesh.creation.box(), label="tin", hulls=3), InvalidInputError, "tin.*max_hulls"),
        (lambda: Body.from_mesh(trimesh.Trimesh(), label="tin"), DataError, "tin.*no faces"),
        (
            lambda: Body.from_mesh(trimesh.creation.box([40.0] * 3), label="tin", scale=1.0, tolerance=1e-3),
            InvalidInputError,
            "tin is 40 m large: tolerance 0.001 m, expected 0.0016 or more",
        ),
        (lambda: Body.from_mesh(42, label="tin"), InvalidInputError, "tin.*int"),
    ],
)
def test_a_bad_body_is_refused_with_its_label(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_file_that_is_no_mesh_is_refused_with_its_name(tmp_path):
    (tmp_path / "noise.ply").write_bytes(b"not a mesh")
    with pytest.raises(DataError, match=r"tin.*noise\.ply"):
        Body.from_mesh(tmp_path / "noise.ply", label="tin")


def test_a_mesh_with_nan_is_refused():
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    vertices = mesh.vertices.copy()
    vertices[3, 1] = np.nan
    with pytest.raises(DataError, match=r"tin.*NaN"):
        Body.from_mesh(trimesh.Trimesh(vertices, mesh.faces, process=False, validate=False), label="tin")


def test_a_plane_from_a_pose_holds_the_points_of_its_xy_plane(table):
    plane = Plane.from_pose(table.T)
    points = se3.apply(table.T, torch.tensor([[0.3, -0.2, 0.0], [1.0, 2.0, 0.0]], dtype=torch.float64))
    assert torch.allclose(points @ plane.normal, plane.offset.expand(2))
    assert float(table.at(0, 0, 0.1)[:3, 3] @ plane.normal - plane.offset) == pytest.approx(0.1)


def test_a_plane_takes_plain_numbers():
    plane = Plane([0.0, 0.0, 1.0], 0.25)
    assert plane.normal.dtype == plane.offset.dtype == torch.float64
    assert plane.offset.shape == ()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane([0.0, 0.0, 2.0], 0.1), "length 2"),
        (lambda: Plane([0.0, 1.0], 0.1), r"normal.*\(3,\)"),
        (lambda: Plane([0.0, 0.0, 1.0], math.nan), "offset"),
        (lambda: Plane([0.0, 0.0, 1.0], [0.1]), "offset"),
        (lambda: Plane([0.0, 0.0, 1.0], 0.1, torch.eye(2)), "covariance"),
        (lambda: Plane([0.0, 0.0, 1.0], 0.1, -torch.eye(3)), "covariance"),
    ],
)
def test_a_bad_plane_is_refused(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()
