"""Convex parts: packing loses nothing, faces and edges are those of the polytope."""

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.convex import ConvexParts


def box(x, y, z):
    return np.array(np.meshgrid([-x, x], [-y, y], [-z, z])).reshape(3, -1).T


def prism(sides, radius=0.03, height=0.05):
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.concatenate([np.c_[ring, np.full(sides, z)] for z in (-height, height)])


def cloud(n, seed=0):
    return 0.05 * np.random.default_rng(seed).normal(size=(n, 3))


HULLS = {
    "box": (box(0.1, 0.2, 0.3), 8, 12, 6),
    "octagonal prism": (prism(8), 16, 24, 10),
    "32-sided prism": (prism(32), 64, 96, 34),
    "tetrahedron": (cloud(4), 4, 6, 4),
    "sheet": (box(0.1, 0.1, 1e-4), 8, 12, 6),
    "crumb": (box(1e-4, 1e-4, 1e-4), 8, 12, 6),
    "box far away": (box(0.1, 0.2, 0.3) + np.array([3.0, -2.0, 5.0]), 8, 12, 6),
}


def counts(parts, p=0):
    """Vertices, edges and faces of one part, its padding removed."""
    edges = {tuple(sorted(e)) for e in parts.edge_vertices[p].tolist()} - {(0, 0)}
    return int(parts.vertex_count[p]), len(edges), len(np.unique(parts.face_normals[p].numpy(), axis=0))


@pytest.mark.parametrize("name", HULLS)
def test_edges_and_faces_are_those_of_the_polytope(name):
    points, *expected = HULLS[name]
    vertices, edges, faces = counts(ConvexParts.from_hulls([points]))
    assert [vertices, edges, faces] == expected
    assert vertices - edges + faces == 2  # Euler


@pytest.mark.parametrize("n", [5, 12, 40, 200])
def test_random_hulls_obey_euler(n):
    parts = ConvexParts.from_hulls([cloud(n)])
    vertices, edges, faces = counts(parts)
    assert vertices - edges + faces == 2
    assert 2 * edges == 3 * faces  # triangles


def test_tables_of_mixed_parts_are_those_of_each_alone():
    parts = ConvexParts.from_hulls([points for points, *_ in HULLS.values()])
    assert [list(counts(parts, p)) for p in range(parts.n_parts)] == [expected for _, *expected in HULLS.values()]


@pytest.mark.parametrize("name", HULLS)
def test_face_normals_are_outward_unit_and_support_the_part(name):
    parts = ConvexParts.from_hulls([HULLS[name][0]])
    normals, vertices = parts.face_normals[0], parts.part(0)[0]
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals)).double(), atol=1e-14, rtol=0.0)
    height = vertices @ normals.T - parts.face_offsets[0]
    assert height.max() < 1e-14
    assert ((height > -1e-12).sum(0) >= 3).all()  # each holds three vertices or more
    assert ((vertices.mean(0) @ normals.T) < parts.face_offsets[0]).all()


@pytest.mark.parametrize("name", HULLS)
def test_each_edge_lies_in_both_of_its_faces(name):
    parts = ConvexParts.from_hulls([HULLS[name][0]])
    ends, sides = parts.part(0)[0][parts.edge_vertices[0]], parts.face_normals[0][parts.edge_faces[0]]
    height = torch.einsum("lsi,lei->lse", sides, ends)
    offset = parts.face_offsets[0][parts.edge_faces[0]]
    torch.testing.assert_close(height, offset[:, :, None].expand_as(height), atol=1e-14, rtol=0.0)
    assert (parts.edge_faces[0, :, 0] != parts.edge_faces[0, :, 1]).all()


def test_hardly_bent_edges_are_kept():
    """An angle of a microradian moves a metre by a micrometre: coplanar means far less than that."""
    points = box(0.1, 0.1, 0.05)
    points[points[:, 0] * points[:, 1] > 0, 2] += 1e-7
    assert counts(ConvexParts.from_hulls([points]))[1] > 12


def test_triangles_are_counter_clockwise_from_outside():
    for mesh in ConvexParts.from_hulls([points for points, *_ in HULLS.values()]).to_trimesh():
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume == pytest.approx(ConvexHull(mesh.vertices).volume)


def test_packing_returns_each_hull():
    hulls = [box(1, 2, 3), cloud(30, 1), prism(7)]
    parts = ConvexParts.from_hulls(hulls)
    assert parts.n_parts == 3
    assert parts.n_bodies == 1
    for p, hull in enumerate(hulls):
        on_hull = hull[ConvexHull(hull).vertices]
        assert {tuple(v) for v in parts.part(p)[0].numpy()} == {tuple(v) for v in on_hull}
        assert parts.part(p)[1].max() < len(on_hull)


def test_inner_points_are_dropped():
    assert ConvexParts.from_hulls([np.concatenate([box(1, 1, 1), 0.5 * cloud(50)])]).vertices.shape == (8, 3)


def test_cat_keeps_bodies_and_parts_in_order():
    one, two = ConvexParts.from_hulls([box(1, 2, 3), prism(5)]), ConvexParts.from_hulls([cloud(9)])
    both = ConvexParts.cat([one, two, one])
    assert both.part_start.tolist() == [0, 2, 3, 5]
    for p, (source, q) in enumerate([(one, 0), (one, 1), (two, 0), (one, 0), (one, 1)]):
        for x, y in zip(both.part(p), source.part(q), strict=True):
            assert torch.equal(x, y)
        assert counts(both, p) == counts(source, q)


def test_an_empty_set_has_no_parts():
    none = ConvexParts.cat([])
    assert (none.n_parts, none.n_bodies) == (0, 0)
    assert none.padded.shape == (0, 1, 3)
    assert none.face_normals.shape[0] == none.edge_vertices.shape[0] == none.padded_mask.shape[0] == 0
    assert none.lower.shape == none.upper.shape == (0, 3)
    assert ConvexParts.cat([none, ConvexParts.from_hulls([box(1, 1, 1)])]).n_parts == 1


def test_padding_repeats_a_vertex_and_the_mask_tells():
    parts = ConvexParts.from_hulls([cloud(4), box(1, 1, 1)])
    assert parts.padded.shape == (2, 8, 3)
    assert parts.padded_mask.sum(1).tolist() == [4, 8]
    for p in range(2):
        assert torch.equal(parts.padded[p][parts.padded_mask[p]], parts.part(p)[0])
        assert (parts.padded[p][~parts.padded_mask[p]] == parts.padded[p, 0]).all()


def test_bounds_hold_every_vertex():
    parts = ConvexParts.from_hulls([cloud(20), box(1, 2, 3) + np.array([5, 0, 0])])
    assert parts.lower[1].tolist() == [4, -2, -3]
    assert parts.upper[1].tolist() == [6, 2, 3]
    assert parts.center[1].tolist() == [5, 0, 0]
    assert float(parts.radius[1]) == pytest.approx(14**0.5)
    for p in range(2):
        assert ((parts.part(p)[0] - parts.center[p]).norm(dim=-1) <= parts.radius[p] + 1e-12).all()


def test_another_dtype_changes_coordinates_only():
    parts = ConvexParts.from_hulls([box(1, 2, 3), cloud(9)])
    coarse = parts.to(torch.float32)
    assert coarse.dtype == torch.float32
    assert coarse.faces.dtype == coarse.vertex_start.dtype == torch.long
    assert coarse.face_normals.dtype == torch.float32
    torch.testing.assert_close(coarse.vertices.double(), parts.vertices, atol=1e-6, rtol=0.0)
    assert parts.to(torch.float64) is parts
    assert parts.reference is parts
    assert coarse.reference.dtype == torch.float64
    assert ConvexParts.from_hulls([box(1, 1, 1)], dtype=torch.float32).dtype == torch.float32


@pytest.mark.parametrize(
    ("hulls", "message"),
    [
        ([], "at least one convex part"),
        ([box(1, 1, 1), box(1, 1, 0)], "convex part 1 has no volume"),
        ([np.linspace(0, 1, 9)[:, None] * [[1, 1, 1]]], "convex part 0 has no volume"),
        ([np.zeros((10, 3))], "no volume"),
        ([cloud(3)], "no volume"),
        ([np.zeros((0, 3))], "got \\(0, 3\\)"),
        ([np.zeros((5, 2))], "shape \\(V, 3\\), got \\(5, 2\\)"),
        ([np.full((8, 3), np.nan)], "finite"),
    ],
)
def test_what_is_no_solid_is_refused(hulls, message):
    with pytest.raises(InvalidInputError, match=message):
        ConvexParts.from_hulls(hulls)
