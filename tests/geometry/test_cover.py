"""How well parts cover a mesh, on shapes whose errors are known."""

import numpy as np
import pytest
import trimesh

from physpose_torch.geometry.cover import Surface, clean_mesh, hull_of, measure_cover

CUBE = trimesh.creation.box((0.1, 0.1, 0.1))


def cube(size, centre=(0, 0, 0)):
    return trimesh.creation.box((size,) * 3).vertices + centre


@pytest.mark.parametrize(("size", "outward", "inward"), [(0.1, 0, 0), (0.104, 2e-3, 0), (0.096, 0, 2e-3)])
def test_errors_of_a_cube_too_large_and_too_small(size, outward, inward):
    errors = measure_cover([cube(size)], Surface(CUBE.triangles, solid=True), 5e-3)
    for name, expected in (("outward", outward), ("inward", inward)):  # up to sqrt(3) of it at edges and corners
        assert expected - 1e-9 <= errors[f"{name}_p95"] <= 1.42 * expected + 1e-9
        assert errors[f"{name}_max"] <= 3**0.5 * expected + 1e-3  # an upper bound, loose at edges


def test_faces_between_parts_do_not_count():
    halves = [CUBE.vertices * [0.52, 1, 1] + [x, 0, 0] for x in (-0.024, 0.024)]
    errors = measure_cover(halves, Surface(CUBE.triangles, solid=True), 1e-3)
    assert max(errors["outward_p95"], errors["inward_p95"]) < 1e-9


def test_a_part_left_out_shows():
    half = CUBE.vertices * [0.5, 1, 1] + [-0.025, 0, 0]
    errors = measure_cover([half], Surface(CUBE.triangles, solid=True), 1e-3)
    assert errors["outward_p95"] < 1e-9
    assert errors["inward_max"] == pytest.approx(0.05, abs=1e-3)


def test_signed_distance_against_a_box():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.1, 0.1, (500, 3))
    q = np.abs(points) - 0.05
    truth = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)
    np.testing.assert_allclose(Surface(CUBE.triangles, solid=True).signed_distance(points), truth, atol=1e-9)
    np.testing.assert_allclose(Surface(CUBE.triangles, solid=False).signed_distance(points), np.abs(truth), atol=1e-9)


def test_flap_of_a_scan_does_not_open_the_mesh():
    ball = trimesh.creation.icosphere(2, radius=0.05)
    a, b = ball.edges_unique[0]
    flap = [[a, b, len(ball.vertices)]]
    tip = ball.vertices[[a, b]].mean(0) * 1.01
    mesh = trimesh.Trimesh(np.vstack([ball.vertices, tip]), np.vstack([ball.faces, flap]), process=False)
    assert not mesh.is_watertight
    clean = clean_mesh(mesh, "scan")
    assert clean.is_watertight
    assert len(clean.faces) == len(ball.faces)


def test_flat_points_are_extruded():
    square = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
    vertices, _, equations = hull_of(square)
    assert len(vertices) == 8
    assert (square @ equations[:, :3].T + equations[:, 3]).max() <= 1e-12
