"""Generated photographs of household objects on a table, two views each, with exact ground truth.

For the table estimator's tests and benchmarks and for demonstrations: what is to be found in the images (features of
the table and of the objects, edges, shadows, blur, noise) is there, and what is to be found from them is known.
Everything is matt, so a point has one colour in both views, up to exposure and noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.household import HOUSEHOLD_COLORS, _arrange, _in_view, _rest_pose, _separation, _shapes
from physpose_torch.printed import GAMMA, TEXEL, TOP_SIZE, coloured, table_and_floor
from physpose_torch.render import fragments, render

if TYPE_CHECKING:
    import trimesh

    from physpose_torch.viz.scene import PlacedScene
    from physpose_torch.viz.shading import Shadows

__all__ = ["TABLES", "HouseholdPair", "household_pair"]

TABLES = ("wood", "laminate", "plain", "checked", "print")
"""Strong grain; faint mottling; no texture at all; a cloth whose pattern repeats; magazines."""

_THICK, _FLOOR, _WALL = 0.030, -0.72, 4.5  # its slab, height of the floor, distance of the wall [m]
_TILE = 3.072  # the floor's texture repeats after this, in 1024 texels [m]
_SUPER = 2  # samples per pixel and direction
_TRIES = 60  # arrangements, each with as many cameras


@dataclass(frozen=True)
class HouseholdPair:
    """Two photographs of one tabletop, and everything that is true about it. Cameras as in OpenCV."""

    names: list[str]
    """Objects, keys of `meshes`."""
    meshes: "dict[str, trimesh.Trimesh]"
    """The objects as rendered: shape and frame of `household_meshes()` [m], subdivided, with (sRGB) vertex colours."""
    images: tuple[Tensor, Tensor]
    """(H, W, 3) uint8 sRGB each."""
    K: Tensor
    """Intrinsics of both views, (3, 3) float64 [px], pixel centres at integers, no distortion."""
    T_camera_object: tuple[Tensor, Tensor]
    """Ground truth in each view, (N, 4, 4) float64 [m]."""
    T_view1_view0: Tensor
    """Points of view 0's camera frame into view 1's, (4, 4) float64 [m]."""
    normal: Tensor
    """The table's unit normal, pointing up, camera frame of view 0, (3,) float64."""
    offset: float
    """The table is normal · x = offset in view 0 [m]."""
    supports: list[str]
    """What each object stands on: `"table"` or the name of another object."""
    table: str
    """The table's texture, one of `TABLES`."""


def household_pair(
    seed: int = 0,
    *,
    table: str = "wood",
    objects: int | Sequence[str] | None = None,
    stacked: bool = True,
    baseline_deg: float | None = None,
    width: int = 640,
    height: int = 480,
    noise: float = 1.7,
) -> HouseholdPair:
    """Photograph household objects on a table twice, 12° to 20° apart around the objects.

    Objects stand as in `household_scene`, some upside down, each at least 30 % visible in both views. The camera is
    0.55 to 1 m away and 25° to 60° above the table; a textured floor 0.72 m below is a second plane. Same arguments,
    same images.

    Args:
        seed: decides everything below that is not given.
        table: one of `TABLES`.
        objects: how many (1 to 7), or which; six or seven if None.
        stacked: True: where possible, at least one object stands on another. False: all stand on the table.
        baseline_deg: azimuth between the views, 0 to 60 [deg].
        width: of the images [px].
        height: of the images [px].
        noise: standard deviation at middle grey, before rounding [grey levels]; grows with brightness.

    Raises:
        InvalidInputError: an argument is not one of the above, or no camera sees all objects.
    """
    _check(seed, table, objects, baseline_deg, width, height, noise)
    rng = np.random.default_rng([seed, 20])
    f, (cx, cy) = rng.uniform(600, 620), rng.uniform(-6, 6, 2)  # of an image 640 wide
    K = np.array([[f, 0, 319.5 + cx], [0, f, 320 * height / width - 0.5 + cy], [0, 0, 1]])
    for _ in range(_TRIES):
        arranged = _choose(rng, objects, stacked)
        cameras = arranged and _cameras(rng, arranged[0], K, round(640 * height / width), baseline_deg)
        if cameras:
            break
    else:
        raise InvalidInputError(
            f"no two cameras see all of objects = {objects!r} with baseline_deg = {baseline_deg} in {width} x {height}; "
            "ask for fewer objects, a smaller baseline or a less elongated image"
        )
    poses, supports = arranged
    scale = width / 640
    K = torch.from_numpy(np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]]) @ K)
    meshes, surfaces = {}, []
    for name in poses:
        meshes[name], surface = coloured(name, np.random.default_rng([seed, 21, list(HOUSEHOLD_COLORS).index(name)]))
        surfaces.append(surface)
    T_table_object = torch.from_numpy(np.stack(list(poses.values())))
    images = _photograph(
        list(poses), surfaces, T_table_object, cameras, K, height, width, table_and_floor(table, rng), rng, noise
    )
    T0, T1 = (torch.from_numpy(T) for T in cameras)
    return HouseholdPair(
        names=list(poses),
        meshes=meshes,
        images=images,
        K=K,
        T_camera_object=(T0 @ T_table_object, T1 @ T_table_object),
        T_view1_view0=T1 @ se3.inverse(T0),
        normal=T0[:3, 2].clone(),
        offset=float(T0[:3, 2] @ T0[:3, 3]),
        supports=[supports[n] for n in poses],
        table=table,
    )


def _check(
    seed: int, table: str, objects: object, baseline: float | None, width: int, height: int, noise: float
) -> None:
    known = list(HOUSEHOLD_COLORS)
    if not isinstance(seed, int) or seed < 0:
        raise InvalidInputError(f"seed = {seed!r}, expected an integer of at least 0")
    if table not in TABLES:
        raise InvalidInputError(f"table = {table!r}, expected one of {', '.join(TABLES)}")
    if isinstance(objects, int):
        if not 1 <= objects <= len(known):
            raise InvalidInputError(f"objects = {objects}, expected 1 to {len(known)}, or names out of {known}")
    elif objects is not None:
        unknown = [n for n in objects if n not in known] if not isinstance(objects, str) else [objects]
        if unknown or not objects or len(set(objects)) < len(objects):
            raise InvalidInputError(f"objects = {objects!r}, expected a list of different names out of {known}")
    if baseline is not None and not 0 <= baseline <= 60:
        raise InvalidInputError(f"baseline_deg = {baseline}, expected 0 to 60 degrees; None draws 12 to 20")
    if min(width, height) < 64:
        raise InvalidInputError(f"the image is {width} x {height}, expected at least 64 x 64 pixels")
    if not 0 <= noise < 64:
        raise InvalidInputError(f"noise = {noise}, expected 0 to 64 grey levels; 1.7 is usual, 0 switches it off")


def _choose(
    rng: np.random.Generator, objects: int | Sequence[str] | None, stacked: bool
) -> tuple[dict[str, np.ndarray], dict[str, str]] | None:
    """Poses T_table_object and supports of the objects asked for; None where they do not fit."""
    from scipy.spatial import ConvexHull

    arranged = _arrange(rng)
    if arranged is None:
        return None
    poses, on, _ = arranged
    count = objects if isinstance(objects, int) else 0
    names = set(poses) if objects is None else set() if count else set(objects)
    if len(poses) < count or not names <= set(poses):
        return None
    candidates = rng.permutation([n for n in poses if stacked and count > 1 and on[n] != "table"]).tolist()[:1]
    while len(names) < count:  # an object comes with its support
        n = candidates.pop() if candidates else list(poses)[rng.integers(len(poses))]
        more = names | {n} | ({on[n]} - {"table"} if stacked else set())
        names = more if len(more) <= count else names
    poses, on = {n: T for n, T in poses.items() if n in names}, {n: s for n, s in on.items() if n in names}
    flipped = np.diag([1.0, -1, -1, 1])  # footprint and height stay
    for n in poses:
        if n in ("mug", "bowl", "can", "box") and n not in on.values() and on[n] == "table" and rng.random() < 0.25:
            poses[n] = poses[n] @ flipped
    for n in [n for n in poses if on[n] != "table" and not (stacked and on[n] in names)]:
        flat = [(_shapes()[m][0] @ T[:3, :3].T + T[:3, 3])[:, :2] for m, T in poses.items() if m != n]
        taken = [p[ConvexHull(p).vertices] for p in flat]
        for _ in range(100):
            R, footprint, up = _rest_pose(n, False, rng.uniform(-np.pi, np.pi))
            spot = rng.uniform([-0.30, -0.24], [0.30, 0.24])
            if all(_separation(footprint + spot, other) > 0.006 for other in taken):
                poses[n] = np.vstack([np.column_stack([R, [*spot, up]]), [0, 0, 0, 1]])
                on[n] = "table"
                break
        else:
            return None
    return poses, on


def _cameras(
    rng: np.random.Generator, poses: dict[str, np.ndarray], K: np.ndarray, height: int, baseline: float | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """T_camera_table of two views of an image 640 pixels wide in which all objects are seen; None if none is found."""
    spots = np.stack([T[:3, 3] for T in poses.values()])
    middle = np.array([*(spots.min(0) + spots.max(0))[:2] / 2, 0.04])
    for _ in range(_TRIES):
        azimuth, elevation, distance = rng.uniform([-180, 25, 0.55], [180, 60, 1.0])
        turn = rng.choice([-1, 1]) * (rng.uniform(12, 20) if baseline is None else baseline)
        second = azimuth + turn, elevation + rng.uniform(-4, 4), distance * rng.uniform(0.95, 1.05)
        views = []
        for a, e, d in ((azimuth, elevation, distance), second):
            angles = np.radians([a, e, rng.normal(0, 2.5)])
            (sa, se, sr), (ca, ce, cr) = np.sin(angles), np.cos(angles)
            R = np.array([[-sa, ca, 0], [ca * se, sa * se, -ce], [-ca * ce, -sa * ce, -se]])
            R = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1.0]]) @ R
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R, [0, 0, d] - R @ (middle + rng.normal(0, 0.012, 3))
            views.append(T)
        seen = ({n: V @ T for n, T in poses.items()} for V in views)
        if all(_in_view(s, K, 640, height) and _least_visible(s, K, height) > 0.32 for s in seen):
            return tuple(views)
    return None


def _least_visible(T_camera: dict[str, np.ndarray], K: np.ndarray, height: int) -> float:
    """Smallest share of an object's silhouette that nothing hides."""
    shapes = [_shapes()[n] for n in T_camera]
    points = np.concatenate([v @ T[:3, :3].T + T[:3, 3] for (v, _), T in zip(shapes, T_camera.values(), strict=True)])
    start = np.cumsum([0] + [len(v) for v, _ in shapes])
    faces = torch.from_numpy(np.concatenate([f + s for (_, f), s in zip(shapes, start, strict=False)]))
    owner = torch.from_numpy(np.repeat(np.arange(len(shapes)), [len(f) for _, f in shapes]))
    small = torch.from_numpy(np.diag([0.25, 0.25, 1]) @ K)
    f = fragments(torch.from_numpy(points), faces, small, height // 4, 160)
    nearest = torch.full((40 * height,), torch.inf, dtype=torch.float64).scatter_reduce_(0, f.pixel, f.depth, "amin")
    key = owner[f.face_id] * 40 * height + f.pixel
    alone, seen = (k.unique() // (40 * height) for k in (key, key[f.depth <= nearest[f.pixel]]))
    n = len(shapes)
    return float((seen.bincount(minlength=n) / alone.bincount(minlength=n)).min())


def _look_up(texture: Tensor, uv: Tensor, texels: Tensor) -> Tensor:
    """Bilinear samples (M, 3) of texture (H, W, 3) at uv (M, 2) in 0..1, each averaged over about so many texels."""
    level, out = texels.clamp(1, 8).log2().round(), torch.zeros(len(uv), 3)
    image = texture.float().permute(2, 0, 1)[None]
    for k in range(4):
        image = torch.nn.functional.avg_pool2d(image, 2) if k else image
        rows = (level == k).nonzero()[:, 0]
        grid = (uv[rows] * 2 - 1).float()[None, None]
        out[rows] = torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=False)[0, :, 0].T
    return out


def _light(points: Tensor, normals: Tensor, shadows: "Shadows") -> Tensor:
    """Light (M,) that reaches matt surface: a soft sun, more from above than from below, less near the table."""
    from physpose_torch.viz.shading import LIGHT

    sun = (normals @ LIGHT.float()).clamp(min=0)
    sun = sun * shadows.lit(points + 0.003 * normals)
    corner = 1 - 0.45 * torch.exp(-points[:, 2].clamp(min=0) / 0.012).float() * (1 - normals[:, 2].clamp(min=0))
    return (0.42 + 0.10 * normals[:, 2]) * corner + 0.56 * sun


def _lit_table(top: np.ndarray, centre: np.ndarray, shadows: "Shadows") -> Tensor:
    """The table's reflectance times its light: both views see the same, for it is matt."""
    from scipy.ndimage import gaussian_filter

    h, w = top.shape[0] // 2, top.shape[1] // 2
    y, x = np.meshgrid(*((np.arange(n) + 0.5) * 2 * TEXEL for n in (h, w)), indexing="ij")
    corner = centre - TOP_SIZE / 2
    spots = torch.from_numpy(np.stack([x + corner[0], y + corner[1], 0 * x], -1).reshape(-1, 3))
    up = torch.tensor([0.0, 0, 1]).expand(len(spots), 3)
    light = _light(spots, up, shadows) - 0.52 * 0.9 * shadows.touch(spots)
    light = torch.from_numpy(gaussian_filter(light.view(h, w).numpy(), 1.5))[None, None]
    light = torch.nn.functional.interpolate(light, size=top.shape[:2], mode="bilinear")[0, 0]
    return torch.from_numpy(top).float() * light[..., None]


def _photograph(
    names: list[str],
    surfaces: list[tuple[Tensor, ...]],
    T_table_object: Tensor,
    cameras: Sequence[np.ndarray],
    K: Tensor,
    height: int,
    width: int,
    ground: tuple[np.ndarray, np.ndarray, np.ndarray],
    rng: np.random.Generator,
    noise: float,
) -> tuple[Tensor, ...]:
    """One image (H, W, 3) uint8 for each of the cameras T_camera_table."""
    import trimesh
    from scipy.ndimage import gaussian_filter

    from physpose_torch.viz.scene import place
    from physpose_torch.viz.shading import Shadows

    top, floor, centre = ground
    coarse = [tuple(map(torch.from_numpy, _shapes()[n])) for n in names]
    blank = [torch.zeros(len(f), 3, 3, dtype=torch.float64) for _, f in coarse]
    shadows = Shadows(place([(*c, b, b) for c, b in zip(coarse, blank, strict=True)], T_table_object))
    lit_top = _lit_table(top, centre, shadows)
    slab = trimesh.creation.box(bounds=[[*(centre - TOP_SIZE / 2), -_THICK], [*(centre + TOP_SIZE / 2), 0]])
    sides = np.abs(slab.face_normals[:, 2]) < 0.5
    paint = np.broadcast_to(top.mean((0, 1)) ** (1 / GAMMA), (8, 3, 3))
    rim = (slab.vertices, slab.faces[sides], np.repeat(slab.face_normals[sides][:, None], 3, 1), paint)
    rim = tuple(torch.from_numpy(np.array(a)) for a in rim)
    poses = torch.cat([T_table_object, torch.eye(4, dtype=torch.float64)[None]])
    scene = place([*surfaces, rim], poses)
    images = []
    for k, T in enumerate(cameras):
        image = _expose(scene, torch.from_numpy(T), K, height, width, lit_top, torch.from_numpy(floor), centre, shadows)
        image = gaussian_filter(image.numpy(), (0.5, 0.5, 0))
        image = 255 * np.clip(image * (1.01, 0.99)[k % 2], 0, 1) ** (1 / GAMMA)
        image += noise * np.sqrt(0.3 + 0.7 * image / 128) * rng.standard_normal(image.shape)
        images.append(torch.from_numpy(image.round().clip(0, 255).astype(np.uint8)))
    return tuple(images)


def _expose(
    scene: "PlacedScene",
    T: Tensor,
    K: Tensor,
    height: int,
    width: int,
    top: Tensor,
    floor: Tensor,
    centre: np.ndarray,
    shadows: "Shadows",
) -> Tensor:
    """Linear image (H, W, 3), the mean of `_SUPER`² samples a pixel."""
    from physpose_torch.viz.scene import SceneView

    s = _SUPER
    K = (
        torch.tensor([[s, 0, (s - 1) / 2], [0, s, (s - 1) / 2], [0, 0, 1]], dtype=torch.float64) @ K
    )  # x + (k + ½)/s - ½
    view = SceneView(T, K, height * s, width * s)
    eye, rays = view.rays()
    a, b, c = scene.vertices[scene.faces].unbind(1)
    front = ((torch.linalg.cross(b - a, c - a) * (a - eye)).sum(1) < 0).nonzero()[:, 0]
    result = render(se3.apply(T, scene.vertices), scene.faces[front], K, view.height, view.width)
    face, depth = result.face_id.view(-1), result.depth.view(-1)
    image = torch.zeros(len(face), 3)
    pixel = K[0, 0] * eye[2] ** 0.5  # a pixel's extent on the table is depth^1.5 over this (mean of its two axes)

    far = -eye[2] / rays[:, 2]  # the top needs no triangles
    uv = (eye[:2] + rays[:, :2] * far[:, None] - torch.from_numpy(centre)) / torch.from_numpy(TOP_SIZE) + 0.5
    on_top = (far > 0) & ((uv - 0.5).abs().amax(1) <= 0.5) & ((face < 0) | (far < depth))
    rows = on_top.nonzero()[:, 0]
    image[rows] = _look_up(top, uv[rows], far[rows] ** 1.5 / pixel / TEXEL)

    rows = ((face >= 0) & ~on_top).nonzero()[:, 0]
    hit, weights = front[face[rows]], result.barycentric.view(-1, 3)[rows, :, None].float()
    normal = torch.nn.functional.normalize((scene.normals[hit] * weights).sum(1), dim=1)
    light = _light(eye + rays[rows] * depth[rows, None], normal, shadows)
    image[rows] = (scene.colors[hit] * weights).sum(1) ** GAMMA * light[:, None]

    rows = ((face < 0) & ~on_top).nonzero()[:, 0]
    far = (_FLOOR - eye[2]) / rays[rows, 2]
    spot = (eye + rays[rows] * far[:, None])[:, :2]
    wall = (far < 0) | (spot.abs().amax(1) > _WALL)
    beside = ((spot - torch.from_numpy(centre)).abs() - torch.from_numpy(TOP_SIZE / 2)).amax(1)
    under = (0.45 + 0.55 * torch.sigmoid(beside / 0.12)).float()  # the table's own shadow
    color = _look_up(floor, (spot / _TILE) % 1, far.clamp(min=0) ** 1.5 / pixel * 1024 / _TILE) * 0.8 * under[:, None]
    image[rows] = torch.where(wall[:, None], torch.tensor([0.36, 0.37, 0.38]), color)
    return image.view(height, s, width, s, 3).mean((1, 3))
