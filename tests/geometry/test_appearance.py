"""A body of its convex hull, and the colours that a body keeps."""

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.body import Body
from physpose_torch.geometry.resting import hull_stands

RNG = np.random.default_rng(0)
IMAGE = Image.fromarray(RNG.integers(0, 256, (16, 24, 3), dtype=np.uint8))


def bowl():
    """Not convex: half of a hollow ball, 100 mm wide."""
    return trimesh.creation.revolve([[0.0, 0.0], [30.0, 5.0], [50.0, 40.0], [46.0, 40.0], [28.0, 9.0], [0.0, 4.0]])


def with_vertex_colors(mesh):
    mesh.visual.vertex_colors = np.random.default_rng(1).integers(0, 256, (len(mesh.vertices), 4), dtype=np.uint8)
    return mesh


def with_face_colors(mesh):
    mesh.visual.face_colors = np.random.default_rng(1).integers(0, 256, (len(mesh.faces), 4), dtype=np.uint8)
    return mesh


def with_texture(mesh, **options):
    uv = np.random.default_rng(1).uniform(size=(len(mesh.vertices), 2))
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, **(options or {"image": IMAGE}))
    return mesh


def makers():
    """Both ways from a mesh to a body."""
    return pytest.mark.parametrize("make", [Body.from_hull, Body.from_mesh], ids=["from_hull", "from_mesh"])


def test_the_hull_is_one_part_with_all_of_the_mesh_in_it():
    body = Body.from_hull(bowl(), label="bowl", scale=1e-3)
    assert body.parts.n_parts == body.parts.n_bodies == 1
    corners = body.parts.part(0)[0].numpy()
    normals = body.parts.face_normals[0].numpy()
    reach = (corners @ normals.T).max(0)
    assert ((body.mesh.vertices @ normals.T) <= reach + 1e-9).all()
    expected = trimesh.convex.convex_hull(bowl().vertices * 1e-3).volume
    assert trimesh.convex.convex_hull(corners).volume == pytest.approx(expected, rel=1e-9)
    assert expected > 1.5 * bowl().volume * 1e-9  # it is hollow


def test_the_mesh_beside_the_hull_is_the_one_that_was_given():
    body, mesh = Body.from_hull(bowl(), label="bowl", scale=1e-3), bowl()
    assert body.label == "bowl"
    assert np.allclose(body.mesh.bounds, mesh.bounds * 1e-3)
    assert body.mesh.volume == pytest.approx(mesh.volume * 1e-9)
    assert body.decomposition is None


def test_it_stands_as_the_decomposed_body_does():
    hull, parts = Body.from_hull(bowl(), label="bowl", scale=1e-3), Body.from_mesh(bowl(), label="bowl", scale=1e-3)
    assert parts.parts.n_parts > 1
    for a, b in zip(hull_stands(hull), hull_stands(parts), strict=True):
        assert np.allclose(a, b, atol=1e-12)


def test_symmetries_are_kept_and_must_be_rigid():
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    body = Body.from_hull(bowl(), label="bowl", scale=1e-3, symmetries=torch.stack([torch.eye(4), turn]))
    assert body.symmetries.dtype == torch.float64
    assert torch.equal(body.symmetries[1], turn.double())
    with pytest.raises(InvalidInputError, match="bowl: symmetries"):
        Body.from_hull(bowl(), label="bowl", symmetries=2 * torch.eye(4)[None])


def test_a_file_will_do(tmp_path):
    with_vertex_colors(bowl()).export(tmp_path / "bowl.ply")
    body = Body.from_hull(tmp_path / "bowl.ply", label="bowl", scale=1e-3)
    assert body.radius == pytest.approx(Body.from_hull(bowl(), label="bowl", scale=1e-3).radius, rel=1e-5)
    assert body.appearance.visual.kind == "vertex"
    with pytest.raises(DataError, match="can: no mesh file"):
        Body.from_hull(tmp_path / "can.ply", label="can")


def test_a_line_has_no_hull():
    line = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(DataError, match="straw: the mesh is flat"):
        Body.from_hull(line, label="straw")


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.5, 0.8)])
def test_a_flat_mesh_has_no_hull(normal):
    sheet = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.3, 0], [0, 0.3, 0]])
    T = trimesh.geometry.align_vectors([0, 0, 1], normal)
    sheet = trimesh.Trimesh(sheet @ T[:3, :3].T, [[0, 1, 2], [0, 2, 3]], process=False)
    with pytest.raises(DataError, match="paper: the mesh is flat"):
        Body.from_hull(sheet, label="paper")


def test_a_mesh_without_faces_or_with_nan_is_refused():
    with pytest.raises(DataError, match="nothing: the mesh has no faces"):
        Body.from_hull(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), label="nothing")
    bad = bowl()
    bad.vertices[3] = np.nan
    with pytest.raises(DataError, match="bad: the mesh has NaN"):
        Body.from_hull(trimesh.Trimesh(bad.vertices, bad.faces, process=False), label="bad")


@makers()
@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_colours_of_vertices_are_kept_in_metres(make, scale):
    mesh = with_vertex_colors(trimesh.creation.box(np.array([0.1, 0.06, 0.04]) / scale))
    body = make(mesh, label="box", scale=scale)
    assert body.appearance.visual.kind == "vertex"
    assert np.array_equal(body.appearance.visual.vertex_colors, mesh.visual.vertex_colors)
    assert np.allclose(body.appearance.vertices, mesh.vertices * scale)
    assert np.array_equal(body.appearance.faces, mesh.faces)
    assert np.allclose(body.appearance.bounds, body.mesh.bounds)


@makers()
def test_colours_of_faces_are_kept(make):
    mesh = with_face_colors(trimesh.creation.box((100, 60, 40)))
    body = make(mesh, label="box", scale=1e-3)
    assert body.appearance.visual.kind == "face"
    assert np.array_equal(body.appearance.visual.face_colors, mesh.visual.face_colors)
    assert np.allclose(body.appearance.triangles, mesh.triangles * 1e-3)


@makers()
@pytest.mark.parametrize("material", ["simple", "pbr"])
def test_a_texture_is_kept_where_it_was(make, material):
    """At a seam one corner has two places in the texture; what collides has one corner there, what is drawn has two."""
    mesh = trimesh.creation.box((100, 60, 40))
    mesh = trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)  # all edges are seams
    options = {"material": trimesh.visual.material.PBRMaterial(baseColorTexture=IMAGE)} if material == "pbr" else {}
    mesh = with_texture(mesh, **options)
    body = make(mesh, label="box", scale=1e-3)
    assert len(body.mesh.vertices) == 8
    assert len(body.appearance.vertices) == 36
    visual = body.appearance.visual
    assert visual.kind == "texture"
    assert np.array_equal(visual.uv, mesh.visual.uv)
    image = visual.material.baseColorTexture if material == "pbr" else visual.material.image
    assert np.array_equal(np.asarray(image), np.asarray(IMAGE))


@makers()
@pytest.mark.parametrize("kind", ["none", "no image", "no uv"])
def test_a_mesh_without_colours_has_no_appearance(make, kind):
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    if kind == "no image":
        with_texture(mesh, material=trimesh.visual.material.PBRMaterial(baseColorFactor=[0.3, 0.2, 0.1, 1.0]))
    elif kind == "no uv":
        mesh.visual = trimesh.visual.TextureVisuals(image=IMAGE)
    assert make(mesh, label="box").appearance is None


def test_bodies_of_known_shape_have_no_appearance(box, can):
    assert box.appearance is None
    assert can.appearance is None


@makers()
def test_what_is_kept_is_a_copy(make):
    mesh = with_vertex_colors(trimesh.creation.box((0.1, 0.06, 0.04)))
    body = make(mesh, label="box")
    before = body.appearance.visual.vertex_colors.copy()
    mesh.visual.vertex_colors[:] = 0
    mesh.vertices *= 2
    assert np.array_equal(body.appearance.visual.vertex_colors, before)
    assert np.allclose(body.appearance.extents, [0.1, 0.06, 0.04])


def test_a_textured_file_with_its_material_is_read(tmp_path):
    mesh = with_texture(trimesh.creation.box((100, 60, 40)))
    mesh.export(tmp_path / "box.obj")
    body = Body.from_hull(tmp_path / "box.obj", label="box", scale=1e-3)
    assert body.appearance.visual.kind == "texture"
    assert np.array_equal(np.asarray(body.appearance.visual.material.image.convert("RGB")), np.asarray(IMAGE))
    assert np.allclose(body.appearance.extents, [0.1, 0.06, 0.04])


def test_a_scene_with_one_textured_mesh_keeps_its_texture(tmp_path):
    """As GLB files are read."""
    with_texture(trimesh.creation.box((0.1, 0.06, 0.04))).export(tmp_path / "box.glb")
    body = Body.from_hull(tmp_path / "box.glb", label="box")
    assert body.appearance.visual.kind == "texture"
    assert np.allclose(body.appearance.extents, [0.1, 0.06, 0.04])
