"""Shapes, poses and contacts whose answers are known by construction, and checks that many tests share."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from physpose_torch import se3
from physpose_torch.geometry.convex import ConvexParts

FEATURES = ("vertex", "edge", "face")


def box(x: float, y: float, z: float) -> np.ndarray:
    """Corners (8, 3) of a centred box with half side lengths x, y, z [m]."""
    return np.array(np.meshgrid([-x, x], [-y, y], [-z, z])).reshape(3, -1).T


def cylinder(radius: float, half_height: float, sides: int = 32) -> np.ndarray:
    """Vertices of a prism along z."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.concatenate([np.c_[ring, np.full(sides, z)] for z in (-half_height, half_height)])


def ball(radius: float, count: int = 60, seed: int = 0) -> np.ndarray:
    """Random points on a sphere."""
    x = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * x / np.linalg.norm(x, axis=1, keepdims=True)


def zoo(seed: int = 0, n_random: int = 10) -> ConvexParts:
    """One body of many parts: random hulls, boxes, prisms, a tetrahedron, a needle, a sheet and a crumb."""
    rng = np.random.default_rng(seed)
    hulls = [0.03 * rng.normal(size=(rng.integers(6, 40), 3)) * rng.uniform(0.3, 1, size=3) for _ in range(n_random)]
    hulls += [box(0.05, 0.03, 0.02), box(0.02, 0.02, 0.02), cylinder(0.03, 0.05, 16), cylinder(0.04, 0.01, 32)]
    hulls += [0.05 * rng.normal(size=(4, 3)), box(0.1, 0.001, 0.001), box(0.1, 0.08, 0.00025)]
    hulls += [box(0.001, 0.001, 0.001)]
    return ConvexParts.from_hulls(hulls)


def random_rotations(n: int, seed: int = 0) -> np.ndarray:
    return Rotation.random(n, random_state=seed).as_matrix().reshape(n, 3, 3)


def random_poses(n: int, seed: int = 0, spread: float = 0.05) -> Tensor:
    """(n, 4, 4) rigid transforms with normally distributed translations [m]."""
    t = spread * np.random.default_rng(seed).normal(size=(n, 3))
    return se3.from_rotation_translation(torch.as_tensor(random_rotations(n, seed)), torch.as_tensor(t))


def pose(rotation_vector=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)) -> Tensor:
    """(4, 4) float64 transform."""
    vectors = (torch.as_tensor(np.asarray(x, dtype=np.float64)) for x in (rotation_vector, translation))
    w, t = vectors
    return se3.from_rotation_translation(se3.exp_so3(w), t)


def contact(parts: ConvexParts, a: int, b: int, features: tuple[str, str], gap: float, rng: np.random.Generator):
    """Pose R, t of part b in the frame of part a, such that two features face each other at a known gap.

    A point of each feature and a direction in its normal cone are drawn, and b is turned so that the two directions
    oppose each other. So gap >= 0 is the signed distance, whatever the shapes; gap < 0 is a lower bound of it.

    Returns:
        R (3, 3), t (3,) and the unit normal (3,) from a to b.
    """
    (point_a, n), (point_b, m) = (_feature(parts, p, f, rng) for p, f in ((a, features[0]), (b, features[1])))
    R = _turn_onto(n, rng) @ _turn_onto(-m, rng).T
    return R, point_a + gap * n - R @ point_b, n


def _feature(parts: ConvexParts, p: int, feature: str, rng: np.random.Generator):
    vertices = parts.part(p)[0].numpy()
    if feature == "vertex":
        n = rng.normal(size=3)
        n /= np.linalg.norm(n)
        return vertices[(vertices @ n).argmax()], n
    normals = parts.face_normals[p].numpy()
    if feature == "edge":
        edges = parts.edge_vertices[p].numpy()
        k = rng.integers((edges[:, 0] != edges[:, 1]).sum())
        s = rng.uniform(0.1, 0.9, size=2)
        n = s[0] * normals[parts.edge_faces[p, k, 0]] + (1 - s[0]) * normals[parts.edge_faces[p, k, 1]]
        return vertices[edges[k]].T @ [s[1], 1 - s[1]], n / np.linalg.norm(n)
    n = normals[rng.integers(len(normals))]
    height = vertices @ n
    corners = vertices[height > height.max() - 1e-12]
    return rng.dirichlet(np.ones(len(corners))) @ corners, n


def _turn_onto(n: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random rotation whose third column is n."""
    x = np.cross(n, rng.normal(size=3))
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(n, x), n], axis=1)


def camera_motions(n: int = 4, seed: int = 0) -> Tensor:
    """(n, 4, 4) rigid motions of the camera: anything by way of rotation, metres by way of translation."""
    return random_poses(n, seed=1000 + seed, spread=1.0)


def assert_camera_frame_invariant(
    compute: Callable[[Tensor], Tensor | Iterable[Tensor]], *, atol: float = 1e-9, motions: Tensor | None = None
) -> None:
    """Moving camera, objects and statics together changes nothing.

    Args:
        compute: given a transform T_new_old (4, 4) that moves the whole scene, returns what does not depend on frames.
        atol: largest difference.
        motions: (n, 4, 4) motions to try.
    """
    def values(X: Tensor) -> tuple[Tensor, ...]:
        out = compute(X)
        return (out,) if isinstance(out, Tensor) else tuple(out)

    motions = camera_motions() if motions is None else motions
    expected = values(torch.eye(4, dtype=motions.dtype))
    for X in motions:
        for before, after in zip(expected, values(X), strict=True):
            torch.testing.assert_close(after, before, atol=atol, rtol=0.0)
