"""The generated objects are sound solids of the stated size; every generated scene is physically consistent."""

import time

import numpy as np
import pytest
import torch
import trimesh

from physpose_torch.errors import InvalidInputError
from physpose_torch.household import (
    HOUSEHOLD_COLORS,
    household_meshes,
    household_scene,
    perturb_like_estimator,
)

MESHES = household_meshes()
SEEDS = range(50)


@pytest.fixture(scope="module")
def scenes():
    return [household_scene(seed) for seed in SEEDS]


@pytest.mark.parametrize("name", MESHES)
def test_meshes_are_single_watertight_solids_centred_on_their_bounds(name):
    mesh = MESHES[name]
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.euler_number == (0 if name == "mug" else 2)  # the mug's handle is a true one: genus 1
    assert len(mesh.faces) <= 3000
    np.testing.assert_allclose(mesh.bounds.sum(0), 0, atol=1e-12)
    np.testing.assert_allclose(mesh.visual.main_color[:3] / 255, HOUSEHOLD_COLORS[name], atol=0.003)
    rng = np.random.default_rng(0)
    points = rng.uniform(*mesh.bounds, (4000, 3))
    inside = mesh.contains(points).mean()  # the surface encloses the volume it claims: no self-overlap
    expected = mesh.volume / np.prod(mesh.extents)
    assert inside == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / len(points)) + 1e-9)


def test_volumes_match_the_closed_forms():
    can, box = MESHES["can"], MESHES["box"]
    assert can.volume == pytest.approx(np.pi * 0.034**2 * 0.099, rel=0.02)
    assert box.volume == pytest.approx(0.158 * 0.060 * 0.210, rel=1e-9)
    wall = np.pi * (0.041**2 * 0.092 - 0.037**2 * 0.087)
    handle = np.pi * 0.0065 * 0.0042 * np.pi * (0.030 + 0.023) / 2
    assert MESHES["mug"].volume == pytest.approx(wall + handle, rel=0.04)


@pytest.mark.parametrize("name", ["mug", "bowl", "plate", "banana"])
def test_shapes_are_truly_non_convex(name):
    assert MESHES[name].volume < 0.8 * MESHES[name].convex_hull.volume


def test_mug_is_hollow_and_its_handle_has_a_hole():
    mug = MESHES["mug"]
    top, bottom = mug.bounds[1, 2], mug.bounds[0, 2]
    axis = mug.bounds[0, 0] + 0.041
    gap = [axis + 0.053, 0, 0]
    inside = [[axis, 0, top - 0.01], [axis + 0.039, 0, 0.0], [axis, 0, bottom + 0.002], [axis + 0.070, 0, 0.001], gap]
    assert mug.contains(inside).tolist() == [False, True, True, True, False]


def _heights(scene, index):
    T = scene.T_camera_object[index].numpy()
    points = MESHES[scene.names[index]].vertices @ T[:3, :3].T + T[:3, 3]
    return points @ scene.normal.numpy() - scene.offset


def test_every_contact_is_exact(scenes):
    for scene in scenes:
        for i, support in enumerate(scene.supports):
            low = _heights(scene, i).min()
            if support == "table":
                assert abs(low) < 1e-6
            elif support == "plate":
                assert low == pytest.approx(0.004, abs=1e-6)
            else:
                top = _heights(scene, scene.names.index(support)).max()
                assert low == pytest.approx(top, abs=1e-6)


def test_nothing_interpenetrates_and_the_touching_pair_touches(scenes):
    for seed, scene in zip(SEEDS, scenes, strict=True):
        manager = trimesh.collision.CollisionManager()
        for i, name in enumerate(scene.names):
            T = scene.T_camera_object[i].numpy().copy()
            if scene.supports[i] != "table":
                T[:3, 3] += 1e-4 * scene.normal.numpy()  # surfaces in contact also count as colliding
            manager.add_object(name, MESHES[name], T)
        hit, names = manager.in_collision_internal(return_names=True)
        assert not hit, f"seed {seed}: {names}"

        i, j = (scene.names.index(n) for n in scene.touching)
        single = trimesh.collision.CollisionManager()
        single.add_object("i", MESHES[scene.names[i]], scene.T_camera_object[i].numpy())
        gap = single.min_distance_single(MESHES[scene.names[j]], scene.T_camera_object[j].numpy())
        assert 0 <= gap <= 0.002, f"seed {seed}: {scene.touching} are {gap} m apart"


def test_scenes_are_in_view_of_a_camera_above_the_table(scenes):
    for scene in scenes:
        torch.testing.assert_close(scene.normal.norm(), torch.ones((), dtype=torch.float64))
        assert -scene.offset == pytest.approx(0.8 * np.sin(np.radians(35)), abs=0.1)  # the camera's height
        tilt = np.degrees(np.arcsin(-scene.normal[2].item()))
        assert tilt == pytest.approx(35, abs=3)
        R = scene.T_camera_object[:, :3, :3]
        torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R))
        assert (torch.linalg.det(R) > 0).all()
        for name, T in zip(scene.names, scene.T_camera_object.numpy(), strict=True):
            points = (MESHES[name].vertices @ T[:3, :3].T + T[:3, 3]) @ scene.K.numpy().T
            pixels = points[:, :2] / points[:, 2:]
            assert (pixels >= 0).all()
            assert (pixels < [scene.width, scene.height]).all()


def test_scenes_vary_with_the_seed_and_only_with_it(scenes):
    again = household_scene(3)
    assert again.names == scenes[3].names
    assert torch.equal(again.T_camera_object, scenes[3].T_camera_object)
    assert len({scene.T_camera_object[0, 0, 3].item() for scene in scenes}) == len(scenes)
    assert {6, 7} == {len(scene.names) for scene in scenes}
    stacks = {(n, s) for scene in scenes for n, s in zip(scene.names, scene.supports, strict=True) if s != "table"}
    assert {("can", "box"), ("bowl", "plate")} <= stacks
    assert all(any(s != "table" for s in scene.supports) for scene in scenes)
    assert len({scene.touching for scene in scenes}) >= 4


def test_scene_generation_is_fast(scenes):
    started = time.perf_counter()
    for seed in range(20):
        household_scene(seed)
    assert (time.perf_counter() - started) / 20 < 0.1  # 16 ms on two quiet cores


def test_estimator_noise_has_the_stated_statistics():
    T = household_scene(0).T_camera_object[:1].repeat(20000, 1, 1)
    noisy = perturb_like_estimator(T, seed=1, depth_bias=0.03, depth_sigma=0.01, lateral_sigma=0.004)
    t, moved = T[:, :3, 3], noisy[:, :3, 3] - T[:, :3, 3]
    ray = t / t.norm(dim=-1, keepdim=True)
    along = (moved * ray).sum(-1)
    assert (along / t.norm(dim=-1)).mean().item() == pytest.approx(0.03, abs=5e-4)
    assert (along / t.norm(dim=-1)).std().item() == pytest.approx(0.01, rel=0.03)
    across = moved - along[:, None] * ray
    assert across.square().sum(-1).mean().sqrt().item() == pytest.approx(0.004 * 2**0.5, rel=0.03)
    relative = T[:, :3, :3].mT @ noisy[:, :3, :3]
    angle = torch.arccos(((relative.diagonal(dim1=1, dim2=2).sum(-1)) - 1) / 2)
    assert angle.square().mean().sqrt().rad2deg().item() == pytest.approx(2.5 * 3**0.5, rel=0.03)
    identity = relative @ relative.mT
    torch.testing.assert_close(identity, torch.eye(3, dtype=torch.float64).expand_as(identity))


def test_estimator_noise_follows_its_seed_and_keeps_dtype():
    T = household_scene(0).T_camera_object
    assert torch.equal(perturb_like_estimator(T, seed=5), perturb_like_estimator(T, seed=5))
    assert not torch.equal(perturb_like_estimator(T, seed=5), perturb_like_estimator(T, seed=6))
    generator = torch.Generator().manual_seed(5)
    assert torch.equal(perturb_like_estimator(T, generator=generator), perturb_like_estimator(T, seed=5))
    assert perturb_like_estimator(T.float()).dtype == torch.float32
    zero = perturb_like_estimator(T, depth_bias=0, depth_sigma=0, lateral_sigma=0, rotation_sigma_deg=0)
    torch.testing.assert_close(zero, T)
    with pytest.raises(InvalidInputError, match="expected floating"):
        perturb_like_estimator(T[..., :3, :])
