"""The rasteriser against an independent ray caster (embree), closed forms, and itself under re-chunking."""

import time

import numpy as np
import pytest
import torch
import trimesh

from physpose_torch.errors import InvalidInputError
from physpose_torch.render import fragments, overlap_length, render

K = torch.tensor([[300.0, 0, 159.5], [0, 310.0, 119.5], [0, 0, 1]], dtype=torch.float64)
H, W = 240, 320


def rays(k=K, height=H, width=W):
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], -1).double() @ torch.linalg.inv(k).T


def tensors(mesh):
    return torch.from_numpy(np.array(mesh.vertices)), torch.from_numpy(np.array(mesh.faces))


def random_scene(seed):
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(6):
        ball = trimesh.creation.icosphere(subdivisions=3, radius=rng.uniform(0.03, 0.12))
        ball.vertices *= 1 + 0.2 * rng.standard_normal((len(ball.vertices), 1))  # crumpled: many small steep faces
        ball.apply_translation(rng.uniform([-0.4, -0.3, 0.5], [0.4, 0.3, 1.2]))
        parts.append(ball)
    soup = rng.uniform([-0.6, -0.5, 0.4], [0.6, 0.5, 1.5], (40, 1, 3)) + rng.normal(scale=0.1, size=(40, 3, 3))
    parts.append(trimesh.Trimesh(soup.reshape(-1, 3), np.arange(120).reshape(-1, 3), process=False))
    return trimesh.util.concatenate(parts)


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_ray_casting(seed):
    mesh = random_scene(seed)
    out = render(*tensors(mesh), K, H, W)
    caster = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh, scale_to_box=True)
    direction = rays().reshape(-1, 3).numpy()
    point, ray, face = caster.intersects_location(np.zeros_like(direction), direction, multiple_hits=False)
    depth, face_id = np.zeros(H * W), np.full(H * W, -1)
    depth[ray], face_id[ray] = point[:, 2], face
    ours, ids = out.depth.numpy().ravel(), out.face_id.numpy().ravel()
    assert (depth > 0).sum() > 5000
    differ = (ids != face_id) | (np.abs(ours - depth) > 1e-6)
    assert differ.sum() <= 3  # embree's float32 decides a ray through an edge differently
    agree = ids == face_id
    np.testing.assert_allclose(ours[agree], depth[agree], atol=1e-6)


def test_barycentrics_lead_back_to_the_pixel():
    vertices, faces = tensors(random_scene(7))
    depth, face_id, weights = render(vertices, faces, K, H, W)
    seen = face_id >= 0
    point = (vertices[faces[face_id[seen]]] * weights[seen][..., None]).sum(-2)
    torch.testing.assert_close(weights[seen].sum(-1), torch.ones_like(weights[seen][:, 0]))
    torch.testing.assert_close(point, rays()[seen] * depth[seen][:, None], atol=1e-9, rtol=0)
    assert (weights[~seen] == 0).all()
    assert (depth[~seen] == 0).all()
    assert ((depth > 0) == seen).all()


def test_faces_across_the_near_plane_and_behind_the_camera_are_cut():
    # a floor 0.3 m below the camera that passes under it and 5 m behind it
    vertices = torch.tensor([[-9.0, 0.3, -5], [9, 0.3, -5], [9, 0.3, 20], [-9, 0.3, 20]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    out = render(vertices, faces, K, H, W, near=0.5)
    expected = 0.3 / rays()[..., 1]
    seen = (rays()[..., 1] > 0) & (expected >= 0.5) & (expected <= 20) & ((rays()[..., 0] * expected).abs() < 9)
    assert torch.equal(out.face_id >= 0, seen)
    torch.testing.assert_close(out.depth[seen], expected[seen])
    point = (vertices[faces[out.face_id[seen]]] * out.barycentric[seen][..., None]).sum(-2)
    torch.testing.assert_close(point[:, 2], expected[seen])
    behind = render(vertices - torch.tensor([0, 0, 30.0]), faces, K, H, W)
    assert (behind.face_id == -1).all()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_meshes_have_no_cracks_even_at_pixel_centres(dtype):
    # a jagged sheet whose vertices and edges lie exactly on pixel centres
    x, y = torch.meshgrid(torch.arange(0, 33, 4.0), torch.arange(0, 33, 4.0), indexing="ij")
    z = 1 + torch.rand(x.shape, generator=torch.Generator().manual_seed(0))
    vertices = torch.stack([x * z, y * z, z], -1).reshape(-1, 3).to(dtype)
    index = torch.arange(81).view(9, 9)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = torch.cat([torch.stack([a, b, c], -1).view(-1, 3), torch.stack([a, c, d], -1).view(-1, 3)])
    out = render(vertices, faces, torch.eye(3), 40, 40)
    assert (out.face_id[1:32, 1:32] >= 0).all()
    assert (out.face_id[34:] == -1).all()
    assert out.depth.dtype == out.barycentric.dtype == dtype


@pytest.mark.parametrize("chunk", [1, 97, 5000])
def test_result_does_not_depend_on_the_chunk(chunk):
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.2)
    ball.apply_translation([0, 0, 0.8])
    vertices, faces = tensors(ball)
    k = K / 8
    k[2, 2] = 1
    reference = render(vertices, faces, k, 30, 40)
    for a, b in zip(reference, render(vertices, faces, k, 30, 40, chunk=chunk), strict=True):
        assert torch.equal(a, b)


def test_nearer_surface_wins_whatever_the_order_of_faces():
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = torch.cat([square + torch.tensor([0, 0, z]) for z in (2.0, 1.0, 3.0)])
    faces = torch.cat([torch.tensor([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(3)])
    assert (render(vertices, faces, K, H, W).depth[100:140, 100:220] == 1).all()
    flipped = render(vertices, faces.flip(0), K, H, W)
    assert (flipped.depth[100:140, 100:220] == 1).all()
    same_place = render(vertices, torch.cat([faces[2:4], faces[2:4]]), K, H, W)
    assert (same_place.face_id < 2).all()  # ties go to the lower index


def test_fragments_give_the_thickness_of_a_solid():
    radius, distance = 0.2, 0.9
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    ball.apply_translation([0, 0, distance])
    pixel, face_id, depth, facing = fragments(*tensors(ball), K, H, W)
    direction = rays().reshape(-1, 3)
    balance = torch.zeros(H * W, dtype=torch.long).index_add_(0, pixel, facing.long())
    assert (balance != 0).sum() <= 2  # every ray that enters leaves
    along = -facing * depth * direction[pixel].norm(dim=1)
    chord = torch.zeros(H * W, dtype=torch.float64).index_add_(0, pixel, along)
    unit = direction / direction.norm(dim=1, keepdim=True)
    half = radius**2 - distance**2 * (1 - unit[:, 2] ** 2)
    inner = half > 1e-3
    torch.testing.assert_close(chord[inner], 2 * half[inner].sqrt(), atol=1e-3, rtol=0)
    assert int(face_id.max()) < len(ball.faces)


def test_overlap_of_two_balls_is_a_lens():
    radius, apart = 0.1, 0.15
    balls = [trimesh.creation.icosphere(subdivisions=5, radius=radius) for _ in range(2)]
    for ball, z in zip(balls, (0.8, 0.8 + apart), strict=True):
        ball.apply_translation([0, 0, z])
    owner = torch.arange(2).repeat_interleave(len(balls[0].faces))
    crossings = fragments(*tensors(trimesh.util.concatenate(balls)), K, H, W)
    length = overlap_length(crossings, owner, H * W).view(H, W)
    assert length[119, 159].item() == pytest.approx(2 * radius - apart, abs=5e-4)
    spot = (length > 0).sum().item() * (0.8 + apart / 2) ** 2 / (300 * 310)
    assert spot == pytest.approx(np.pi * (radius**2 - (apart / 2) ** 2), rel=0.05)
    balls[1].apply_translation([0, 0, 0.06])
    crossings = fragments(*tensors(trimesh.util.concatenate(balls)), K, H, W)
    assert (overlap_length(crossings, owner, H * W) == 0).all()


def test_nothing_to_draw():
    out = render(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long), K, 4, 5)
    assert out.depth.shape == (4, 5)
    assert out.barycentric.shape == (4, 5, 3)
    assert (out.face_id == -1).all()
    assert len(fragments(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long), K, 4, 5).pixel) == 0
    point = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]])  # a face without area
    assert (render(point, torch.tensor([[0, 1, 2]]), K, 4, 5).face_id == -1).all()


def test_bad_input_is_named():
    v, f = torch.zeros(3, 3), torch.tensor([[0, 1, 2]])
    with pytest.raises(InvalidInputError, match=r"vertices is .*\(3, 2\)"):
        render(v[:, :2], f, K, H, W)
    with pytest.raises(InvalidInputError, match=r"faces is torch\.float32"):
        render(v, f.float(), K, H, W)
    with pytest.raises(InvalidInputError, match=r"0\.\.3, but there are 3"):
        render(v, torch.tensor([[0, 1, 3]]), K, H, W)
    with pytest.raises(InvalidInputError, match="K has shape"):
        render(v, f, K[:2], H, W)
    with pytest.raises(InvalidInputError, match="near = 0"):
        render(v, f, K, H, W, near=0)
    with pytest.raises(InvalidInputError, match="at least 1"):
        fragments(v, f, K, 0, W)


def test_six_objects_of_8k_faces_render_fast():
    parts = []
    for k in range(6):
        ball = trimesh.creation.uv_sphere(radius=0.08, count=[64, 64])
        ball.apply_translation([0.16 * (k % 3 - 1), 0.16 * (k // 3) - 0.08, 0.8])
        parts.append(ball)
    vertices, faces = tensors(trimesh.util.concatenate(parts))
    assert len(faces) > 45_000
    k = K * 2
    k[2, 2] = 1
    started = time.perf_counter()
    out = render(vertices, faces, k, 480, 640)
    assert time.perf_counter() - started < 4  # 0.3 s on two quiet cores
    assert (out.face_id >= 0).sum() > 50_000
