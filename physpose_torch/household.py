"""Generated household objects and tabletop scenes with exact ground truth: for the demo, the tests and benchmarks.

Every mesh is made by code, watertight, in metres, z up in its own upright pose, **origin at the centre of its bounds**.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch

from physpose_torch.errors import InvalidInputError

if TYPE_CHECKING:
    import trimesh

__all__ = ["HOUSEHOLD_COLORS", "HouseholdScene", "household_meshes", "household_scene", "perturb_like_estimator"]

HOUSEHOLD_COLORS: dict[str, tuple[float, float, float]] = {
    "mug": (0.20, 0.45, 0.70),
    "bowl": (0.86, 0.52, 0.24),
    "box": (0.62, 0.50, 0.74),
    "can": (0.35, 0.62, 0.45),
    "bottle": (0.24, 0.62, 0.68),
    "plate": (0.84, 0.84, 0.80),
    "banana": (0.93, 0.79, 0.30),
}
"""Mean colour of each object, linear between 0 and 1; also the face colours of its mesh."""

_SEGMENTS = 48
_MIN_VISIBLE = 0.35  # share of an object's image hull that nearer objects must leave free
_PRISMS = ("bottle", "box", "can", "mug")  # widest over a common height, so the footprints' gap is the gap
_STACKS = tuple((top, "box") for top in ("can", "mug", "bottle", "banana")) + tuple(
    (top, "plate") for top in ("bowl", "mug", "can")
)
_WELL = 0.004  # height of the plate's flat inside [m]


def _strip(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Triangles (2n, 3) between two closed loops of n vertex indices."""
    a1, b1 = np.roll(a, -1), np.roll(b, -1)
    return np.concatenate([np.stack([a, a1, b1], 1), np.stack([a, b1, b], 1)])


def _loft(rings: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface through rings (R, S, 3), closed at both ends by a fan to a point."""
    n_rings, n_sides, _ = rings.shape
    vertices = np.concatenate([rings.reshape(-1, 3), start[None], end[None]])
    loops = np.arange(n_rings * n_sides).reshape(n_rings, n_sides)
    faces = [_strip(loops[i], loops[i + 1]) for i in range(n_rings - 1)]
    first, last = loops[0], loops[-1]
    faces.append(np.stack([np.full(n_sides, n_rings * n_sides), np.roll(first, -1), first], 1))
    faces.append(np.stack([np.full(n_sides, n_rings * n_sides + 1), last, np.roll(last, -1)], 1))
    return vertices, np.concatenate(faces)


def _revolve(profile: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Solid of revolution about z; the profile (r, z) runs from the axis, below and outside, back to the axis."""
    rz = np.asarray(profile)
    angle = np.arange(_SEGMENTS) * (2 * np.pi / _SEGMENTS)
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    rings = np.concatenate(
        [rz[1:-1, :1, None] * circle, np.broadcast_to(rz[1:-1, 1, None, None], (len(rz) - 2, _SEGMENTS, 1))], 2
    )
    return _loft(rings, np.array([0, 0, rz[0, 1]]), np.array([0, 0, rz[-1, 1]]))


def _mug() -> tuple[np.ndarray, np.ndarray]:
    """Hollow mug, handle along +x: the handle's tube is sewn into two holes of the wall, so it is one manifold."""
    low, high, step = 0.024, 0.070, 0.003
    wall = [low + k * step for k in range(-2, 3)] + [0.039, 0.047, 0.055] + [high + k * step for k in range(-2, 3)]
    outside = [(0.038, 0.0), (0.041, 0.003), *((0.041, z) for z in wall), (0.041, 0.0895), (0.040, 0.092)]
    inside = [(0.038, 0.092), (0.037, 0.0895), (0.037, 0.009), (0.033, 0.005)]
    vertices, faces = _revolve([(0, 0), *outside, *inside, (0, 0.005)])

    columns = (-1, 0, 1)
    loop = [(r, -1) for r in range(-2, 2)] + [(2, -1), (2, 0)] + [(r, 1) for r in range(2, -2, -1)] + [(-2, 1), (-2, 0)]
    row_low, row_high = 4, 12  # rings of the wall at z = low and z = high
    index = lambda row, column: row * _SEGMENTS + column % _SEGMENTS  # noqa: E731
    top = np.array([index(row_high + r, c) for r, c in loop])
    bottom = np.array([index(row_low - r, c) for r, c in loop])  # the tube turns over on its way down
    for centre in (row_low, row_high):
        patch = [index(centre + r, c) for r in range(-2, 3) for c in columns]
        faces = faces[~np.isin(faces, patch).all(1)]

    rest = np.array(loop, dtype=float)
    square = np.stack([vertices[top, 1], rest[:, 0] * step], 1)
    around = np.arctan2(rest[:, 0] / 2, rest[:, 1])
    ellipse = np.stack([0.0065 * np.cos(around), 0.0042 * np.sin(around)], 1)
    loops = [top]
    n_sections = 15
    for k in range(1, n_sections):
        turn = np.pi * k / n_sections
        blend = min(1.0, 3.5 * min(k, n_sections - k) / n_sections)
        section = (1 - blend) * square + blend * ellipse
        centre = np.array([0.0405 + 0.030 * np.sin(turn), 0, (low + high) / 2 + (high - low) / 2 * np.cos(turn)])
        normal = np.array([np.sin(turn), 0, np.cos(turn)])
        loops.append(np.arange(len(loop)) + len(vertices))
        vertices = np.concatenate([vertices, centre + section[:, :1] * [0, 1, 0] + section[:, 1:] * normal])
    loops.append(bottom)
    tube = np.concatenate([_strip(b, a) for a, b in pairwise(loops)])
    used, faces = np.unique(np.concatenate([faces, tube]), return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _banana() -> tuple[np.ndarray, np.ndarray]:
    """Bent and tapered, lying on its side: it touches the table along its whole curved length."""
    along = np.linspace(0, 1, 26)[1:-1]
    radius = 0.0045 + 0.0135 * (1 - np.abs(2 * along - 1) ** 3.5) ** 0.8
    bend = (along - 0.5) * np.radians(100)
    side = np.arange(16) * (2 * np.pi / 16)
    reach = 0.105 + radius[:, None] * np.cos(side)
    height = radius[:, None] * (1 + np.sin(side))
    rings = np.stack([reach * np.sin(bend)[:, None], reach * np.cos(bend)[:, None], height], 2)
    tip = 0.003 * np.stack([np.cos(bend), -np.sin(bend), 0 * bend], 1)
    return _loft(rings, rings[0].mean(0) - tip[0], rings[-1].mean(0) + tip[-1])


@cache
def _shapes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Vertices and faces of every object, about the centre of its bounds. Built once: do not write into them."""
    arc = np.linspace(np.radians(12), np.radians(82), 9)
    bowl_out = [(0.024 + 0.052 * np.sin(a), 0.058 * (1 - np.cos(a)) + 0.0055) for a in arc]
    bowl_in = [(r - 0.004 * np.sin(a), z + 0.004 * np.cos(a)) for (r, z), a in zip(bowl_out, arc, strict=True)]
    can = [(0.0315, 0), (0.034, 0.002), (0.034, 0.099), (0.0325, 0.102), (0.031, 0.102), (0.031, 0.099)]
    bottle = [(0.031, 0), (0.034, 0.003), (0.035, 0.010), (0.035, 0.115), (0.0335, 0.128), (0.029, 0.139)]
    neck = [(0.022, 0.147), (0.0135, 0.153), (0.0135, 0.160), (0.0165, 0.160), (0.0165, 0.184), (0.0145, 0.188)]
    plate = [(0.058, 0), (0.064, 0.002), (0.085, 0.010), (0.105, 0.0165), (0.1065, 0.018), (0.105, 0.0195)]
    solids = {
        "mug": _mug(),
        "bowl": _revolve([(0, 0), (0.031, 0), (0.033, 0.002), *bowl_out, *bowl_in[::-1], (0, bowl_in[0][1])]),
        "can": _revolve([(0, 0), *can, (0, 0.099)]),
        "bottle": _revolve([(0, 0), *bottle, *neck, (0, 0.188)]),
        "plate": _revolve([(0, 0), *plate, (0.084, 0.0135), (0.066, 0.0055), (0.062, _WELL), (0, _WELL)]),
        "banana": _banana(),
    }
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.079, 0.030, 0.105]
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    solids["box"] = corners, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return {name: (v - (v.min(0) + v.max(0)) / 2, f) for name, (v, f) in ((n, solids[n]) for n in HOUSEHOLD_COLORS)}


def household_meshes() -> "dict[str, trimesh.Trimesh]":
    """Seven everyday objects: mug, bowl, box, can, bottle, plate, banana.

    Watertight single manifolds of 12 to about 2000 faces, vertices in metres, z up when standing upright (the box
    stands on its smallest side, the banana lies), origin at the centre of the bounds, face colours from
    `HOUSEHOLD_COLORS`. The mug and the bowl are hollow, and a finger fits through the mug's handle.
    """
    import trimesh

    meshes = {}
    for name, (vertices, faces) in _shapes().items():
        mesh = trimesh.Trimesh(vertices.copy(), faces.copy(), process=False)
        mesh.visual.face_colors = [*(round(255 * c) for c in HOUSEHOLD_COLORS[name]), 255]
        meshes[name] = mesh
    return meshes


@dataclass(frozen=True)
class HouseholdScene:
    """A tabletop arrangement seen by an RGB camera, in which every contact is exact."""

    names: list[str]
    """Keys into `household_meshes()`, one an object."""
    T_camera_object: torch.Tensor
    """Ground truth, (N, 4, 4) float64 [m]."""
    normal: torch.Tensor
    """The table's unit normal, pointing up, camera frame, (3,) float64."""
    offset: float
    """The table is normal · x = offset [m]."""
    K: torch.Tensor
    """Intrinsics (3, 3) float64 [px], pixel centres at integers."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    supports: list[str]
    """What each object stands on: `"table"` or the name of another object."""
    touching: tuple[str, str]
    """Two neighbours on the table that (nearly) touch: the gap is 0 to 2 mm."""


def _rest_pose(name: str, lying: bool, yaw: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation (3, 3), footprint hull (n, 2) counter-clockwise about the origin, and height of the origin [m]."""
    from scipy.spatial import ConvexHull

    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    if lying:
        R = R @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    points = _shapes()[name][0] @ R.T
    flat = points[:, :2]
    return R, flat[ConvexHull(flat).vertices], -float(points[:, 2].min())


def _separation(p: np.ndarray, q: np.ndarray) -> float:
    """Gap along the best edge normal of two convex polygons (counter-clockwise); negative when they overlap [m]."""
    best = -np.inf
    for a, b in ((p, q), (q, p)):
        edge = a - a[np.arange(len(a)) - 1]
        normal = np.stack([edge[:, 1], -edge[:, 0]])
        gap = (b @ normal).min(0) - (a * normal.T).sum(1)
        best = max(best, float((gap / np.hypot(*normal)).max()))
    return best


def _slide(fixed: np.ndarray, moving: np.ndarray, direction: np.ndarray, gap: float) -> np.ndarray:
    """Where along `direction` the second polygon is `gap` from the first: its offset (2,) [m]."""
    near, far = 0.0, 0.5
    for _ in range(26):
        middle = (near + far) / 2
        near, far = (middle, far) if _separation(fixed, moving + middle * direction) < gap else (near, middle)
    return far * direction


def _arrange(rng: np.random.Generator) -> tuple[dict[str, np.ndarray], dict[str, str], tuple[str, str]] | None:
    """One attempt at poses T_table_object, supports and the touching pair; None where something does not fit."""
    stacks = [_STACKS[rng.integers(len(_STACKS))]]
    if rng.random() < 0.5:
        others = [s for s in _STACKS if s[0] != stacks[0][0] and s[1] != stacks[0][1]]
        stacks.append(others[rng.integers(len(others))])
    on = dict(stacks)
    names = list(HOUSEHOLD_COLORS)
    droppable = [n for n in ("bowl", "banana") if n not in on]
    if droppable and rng.random() < 0.3:
        names.remove(droppable[rng.integers(len(droppable))])
    standing = [n for n in names if n not in on]
    pair = tuple(rng.permutation([n for n in _PRISMS if n in standing])[:2].tolist())
    upright_box = "box" not in on.values() and rng.random() < 0.35

    rests = {n: _rest_pose(n, n == "box" and not upright_box, rng.uniform(-np.pi, np.pi)) for n in names}
    order = [pair[0], pair[1], *sorted((n for n in standing if n not in pair), key=lambda n: -np.ptp(rests[n][1]))]
    placed: dict[str, np.ndarray] = {}
    spots: dict[str, np.ndarray] = {}
    for name in order:
        for _ in range(80):
            footprint = rests[name][1]
            if name == pair[1]:
                direction = rng.normal(size=2)
                direction /= np.linalg.norm(direction)
                for side, n in ((-1, pair[1]), (1, pair[0])):  # a mug's handle must not be what touches
                    if n == "mug" and side * (rests[n][0][:2, 0] @ direction) > -0.3:
                        break
                else:
                    shift = _slide(rests[pair[0]][1], footprint, direction, rng.uniform(0, 0.0019))
                    spots[name] = spots[pair[0]] + shift
                    placed[name] = footprint + spots[name]
                    break
                continue
            spot = rng.uniform([-0.27, -0.20], [0.27, 0.22])
            if all(_separation(footprint + spot, other) > 0.006 for other in placed.values()):
                spots[name], placed[name] = spot, footprint + spot
                break
        else:
            return None

    poses = {}
    for name in names:
        R, _, height = rests[name]
        T = np.eye(4)
        T[:3, :3] = R
        if name in on:
            base = on[name]
            T[:2, 3] = spots[base]
            if base == "plate":
                T[:2, 3] += rng.uniform(-0.003, 0.003, 2)
                T[2, 3] = height + _WELL
            else:
                if name == "banana":
                    T[:3, :3] = rests[base][0] @ np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # along the box
                else:
                    T[:3, 3] += rests[base][0] @ np.array([rng.uniform(-0.02, 0.02), 0, rng.uniform(-0.04, 0.04)])
                T[2, 3] = height + 0.060
        else:
            T[:3, 3] = [*spots[name], height]
        poses[name] = T
    return poses, {n: on.get(n, "table") for n in names}, pair


def _in_view(T: dict[str, np.ndarray], K: np.ndarray, width: int, height: int, margin: float = 8) -> bool:
    """Whether every object lies inside the image and enough of it is not behind the image hulls of nearer ones."""
    from scipy.spatial import ConvexHull

    grid = np.stack(np.meshgrid(np.arange(8, width, 16), np.arange(8, height, 16)), -1).reshape(-1, 2)
    hulls = []
    for name, pose in T.items():
        camera = _shapes()[name][0] @ pose[:3, :3].T + pose[:3, 3]
        pixels = (camera @ K.T)[:, :2] / camera[:, 2:]
        if (pixels < margin).any() or (pixels > np.array([width, height]) - margin).any():
            return False
        hulls.append((np.linalg.norm(pose[:3, 3]), pixels))
    free = np.ones(len(grid), bool)
    for _, pixels in sorted(hulls, key=lambda hull: hull[0]):
        lines = ConvexHull(pixels).equations
        mask = ((grid @ lines[:, :2].T + lines[:, 2]) <= 0).all(1)
        if (mask & free).sum() < _MIN_VISIBLE * mask.sum():
            return False
        free &= ~mask
    return True


def household_scene(seed: int = 0) -> HouseholdScene:
    """A physically consistent tabletop of six or seven objects, seen from about 0.8 m away and 35° above.

    One or two objects stand on another (can on box, bowl on plate, ...), two neighbours have a gap of 0 to 2 mm,
    the others keep apart; nothing interpenetrates, nothing floats, every object is in view. Positions, yaws, stacks
    and, slightly, the camera depend on the seed alone.
    """
    rng = np.random.default_rng(seed)
    width, height = 640, 480
    K = np.array([[610.0, 0, 319.5], [0, 610.0, 239.5], [0, 0, 1]])
    while True:
        arranged = _arrange(rng)
        if arranged is None:
            continue
        poses, supports, touching = arranged
        elevation, distance = np.radians(rng.uniform(33, 37)), rng.uniform(0.78, 0.84)
        c, s = np.cos(elevation), np.sin(elevation)
        T_camera_table = np.eye(4)
        T_camera_table[:3, :3] = [[1, 0, 0], [0, -s, -c], [0, c, -s]]
        T_camera_table[:3, 3] = [0, 0, distance] - T_camera_table[:3, :3] @ [0, 0.0, 0.03]
        T_camera = {n: T_camera_table @ T for n, T in poses.items()}
        if _in_view(T_camera, K, width, height):
            break
    normal = T_camera_table[:3, 2]
    return HouseholdScene(
        names=list(T_camera),
        T_camera_object=torch.from_numpy(np.stack(list(T_camera.values()))),
        normal=torch.from_numpy(normal.copy()),
        offset=float(normal @ T_camera_table[:3, 3]),
        K=torch.from_numpy(K),
        width=width,
        height=height,
        supports=[supports[n] for n in T_camera],
        touching=touching,
    )


def perturb_like_estimator(
    T_camera_object: torch.Tensor,
    *,
    seed: int = 0,
    generator: torch.Generator | None = None,
    depth_bias: float = 0.024,
    depth_sigma: float = 0.01,
    lateral_sigma: float = 0.003,
    rotation_sigma_deg: float = 2.5,
) -> torch.Tensor:
    """Poses with the errors of an RGB pose estimator: mostly along the viewing ray, and with a common bias.

    The defaults are what a render-and-compare estimator shows on YCB-V. The ray goes to the object's origin, so the
    origin should be the centre of its bounds, as in `household_meshes`.

    Args:
        T_camera_object: true poses, (..., N, 4, 4) [m].
        seed: of a fresh CPU generator; ignored when `generator` is given.
        generator: draws the noise instead.
        depth_bias: common relative error of the distance (0.024: everything 2.4 % too far).
        depth_sigma: relative spread of the distance from object to object.
        lateral_sigma: standard deviation across the ray, per axis [m].
        rotation_sigma_deg: standard deviation of the rotation vector, per axis, object frame [deg].

    Returns:
        Perturbed poses (..., N, 4, 4), dtype and device of the input.

    Raises:
        InvalidInputError: the poses are not (..., 4, 4) floating point.
    """
    T = T_camera_object
    if T.shape[-2:] != (4, 4) or not T.is_floating_point():
        raise InvalidInputError(f"T_camera_object is {T.dtype} {tuple(T.shape)}, expected floating (..., N, 4, 4)")
    generator = torch.Generator().manual_seed(seed) if generator is None else generator
    noise = torch.randn((*T.shape[:-2], 7), generator=generator, device=generator.device, dtype=torch.float64).to(T)
    t = T[..., :3, 3]
    ray = t / t.norm(dim=-1, keepdim=True)
    across = noise[..., 1:4] * lateral_sigma
    across = across - (across * ray).sum(-1, keepdim=True) * ray
    x, y, z = (noise[..., 4:] * (rotation_sigma_deg * torch.pi / 180)).unbind(-1)
    o = torch.zeros_like(x)
    skew = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    out = T.clone()
    out[..., :3, 3] = t * (1 + depth_bias + depth_sigma * noise[..., :1]) + across
    out[..., :3, :3] = T[..., :3, :3] @ torch.linalg.matrix_exp(skew)
    return out
