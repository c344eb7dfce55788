"""Procedural surfaces for the generated photographs: printed objects, table tops and floors.

An object's colours are those of its vertices, two millimetres apart; a table or a floor is a texture. All of it follows
from the random generator alone.
"""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from physpose_torch.household import HOUSEHOLD_COLORS, _shapes

if TYPE_CHECKING:
    import trimesh

__all__ = ["GAMMA", "TEXEL", "TOP_SIZE", "coloured", "table_and_floor"]

TOP_SIZE = np.array([1.4, 1.0])
"""Of the table's top along x and y [m]."""
TEXEL = 1 / 1400
"""Of the table's texture [m]."""
GAMMA = 2.2
"""An sRGB value is the linear one to the power of 1 / GAMMA."""

_EDGE = 0.002  # longest edge of a coloured mesh: its texture has no finer detail [m]
_SPLITS = (  # of a triangle 0 1 2 with middles 3 4 5 of its edges, of which the first none to three are used
    [[0, 1, 2]],
    [[0, 3, 2], [3, 1, 2]],
    [[3, 1, 4], [0, 3, 4], [0, 4, 2]],
    [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]],
)
_WORDS = ("TOMATO", "CRUNCH", "NOVA", "ORIGINAL", "SOUP", "LEMON", "KAKAO", "MILLS", "FRESH", "SUPREME", "RICE", "No7")
_WORDS += ("EXTRA", "40%", "BIO", "ALPINE", "HONEY")
_INKS = ["#b42026", "#183e78", "#ecbe28", "#f0ece0", "#226e3e", "#1e1e22", "#de7024", "#78326e", "#4696be", "#c4b48c"]
_INKS = np.array([[int(ink[k : k + 2], 16) for k in (1, 3, 5)] for ink in _INKS]) / 255


@cache
def _fine(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and corner normals (F, 3, 3) of an object, edges halved until none is longer than `_EDGE`.

    Neighbours halve their common edge alike, so that the surface stays closed.
    """
    import trimesh

    from physpose_torch.viz.scene import corner_normals

    vertices, faces = _shapes()[name]
    normals = corner_normals(trimesh.Trimesh(vertices, faces, process=False))
    while True:
        ends = np.sort(np.stack([faces, np.roll(faces, -1, 1)], 2), 2)
        long = np.linalg.norm(vertices[ends[..., 0]] - vertices[ends[..., 1]], axis=2) > _EDGE
        if not long.any():
            return vertices, faces, normals
        key, inverse = np.unique(ends[long] @ [len(vertices), 1], return_inverse=True)
        middle = np.zeros_like(faces)
        middle[long] = len(vertices) + inverse
        count = long.sum(1)  # the long edges to the front
        turn = (np.where(count == 2, long.argmin(1) + 1, long.argmax(1))[:, None] + np.arange(3)) % 3
        index = np.concatenate([np.take_along_axis(a, turn, 1) for a in (faces, middle)], 1)
        normals = np.concatenate(
            [np.take_along_axis(a, turn[..., None], 1) for a in (normals, (normals + np.roll(normals, -1, 1)) / 2)], 1
        )
        vertices = np.concatenate([vertices, vertices[np.stack(np.divmod(key, len(vertices)), 1)].mean(1)])
        split = [(count == k, pattern) for k, pattern in enumerate(_SPLITS)]
        faces = np.concatenate([index[rows][:, pattern].reshape(-1, 3) for rows, pattern in split])
        normals = np.concatenate([normals[rows][:, pattern].reshape(-1, 3, 3) for rows, pattern in split])


def _noise(rng: np.random.Generator, h: int, w: int, *cells: tuple[int, int], fade: float = 0.6) -> np.ndarray:
    """Sum of smooth noises (h, w, 1), one for each cell size (rows, columns); periodic where the cells divide h, w."""
    total, weight = np.zeros((h, w, 1), np.float32), 1.0
    for a, b in cells:
        grid = np.pad(rng.standard_normal((-(-h // a), -(-w // b))), 2, mode="wrap")
        large = torch.from_numpy(grid)[None, None].float()
        large = torch.nn.functional.interpolate(large, scale_factor=(a, b), mode="bicubic")[0, 0].numpy()
        total += weight * large[2 * a : 2 * a + h, 2 * b : 2 * b + w, None]
        weight *= fade
    return total


def _label(rng: np.random.Generator, h: int, w: int) -> np.ndarray:
    """A printed label (h, w, 3): bands, a picture, discs, words and small print."""
    import cv2

    ink = 255 * _INKS[rng.permutation(len(_INKS))]
    image = np.full((h, w, 3), ink[0], np.uint8)
    a, b = sorted(rng.uniform(0, 1, 2))
    image[int(h * a) : int(h * b)] = ink[1]
    y, x = int(h * rng.uniform(0.05, 0.5)), int(w * rng.uniform(0, 0.6))
    ph, pw = int(h * rng.uniform(0.25, 0.45)), int(w * rng.uniform(0.25, 0.4))
    blotches = np.tanh(2 * _noise(rng, ph, pw, (24, 24), (12, 12), (6, 6)))
    image[y : y + ph, x : x + pw] = (ink[2] + ink[3]) / 2 + blotches * (ink[2] - ink[3]) / 2
    for k in range(rng.integers(2, 6)):
        at = (int(rng.uniform(0, w)), int(rng.uniform(0, h)))
        cv2.circle(image, at, int(min(h, w) * rng.uniform(0.04, 0.16)), ink[4 + k % 3].tolist(), -1, cv2.LINE_AA)
    n = min(max(h // 30, 3), 10)
    for k, row in enumerate(rng.permutation(n)):
        share = rng.uniform(0.5, 0.8) if k < 2 else rng.uniform(0.2, 0.4)
        word = _WORDS[rng.integers(len(_WORDS))]
        scale = max(min(share * w / (19 * len(word)), h / 110), 0.45)
        at = (int(rng.uniform(0.02, 0.98 - share) * w), int((row + 1) * h / (n + 0.3)))
        color = ink[rng.integers(3, 7)].tolist()
        cv2.putText(image, word, at, cv2.FONT_HERSHEY_DUPLEX, scale, color, max(round(3 * scale), 1), cv2.LINE_AA)
    y, x = int(h * rng.uniform(0.6, 0.85)), int(w * rng.uniform(0, 0.8))
    bars = np.repeat(rng.integers(0, 2, 14), 5)[: w - x]
    image[y : y + h // 10, x : x + len(bars)] = np.where(bars, 25, 235)[None, :, None]
    return np.clip(image / 255 * (1 + 0.03 * _noise(rng, h, w, (20, 20), (8, 8))), 0.02, 0.95)


def coloured(name: str, rng: np.random.Generator) -> "tuple[trimesh.Trimesh, tuple[Tensor, ...]]":
    """An object with printed, painted or nearly plain surface; also as vertices, faces, normals and colours."""
    import trimesh
    from scipy.ndimage import map_coordinates

    vertices, faces, normals = _fine(name)
    low, high = vertices.min(0), vertices.max(0)
    x, y, z = (vertices - [low[0] + 0.041 if name == "mug" else 0, 0, 0]).T  # from the axis
    r = np.hypot(x, y)
    wave = rng.normal(0, 1, (3, 12)) * np.geomspace(60, 900, 12)
    mottle = np.sin(vertices @ wave + rng.uniform(0, 6.3, 12)) @ np.full(12, 0.4)
    ink = _INKS[rng.permutation(len(_INKS))]
    color = np.tile(np.array(HOUSEHOLD_COLORS[name]) * rng.uniform(0.9, 1.08, 3), (len(vertices), 1))

    def put(rows: np.ndarray, u: np.ndarray, v: np.ndarray) -> None:
        """Print a new label over u (to the right) and v (up) [m], two texels a millimetre."""
        u, v = ((a[rows] - a[rows].min()) * 2000 for a in (u, v))
        label = _label(rng, int(v.max()) + 2, int(u.max()) + 2)
        for c in range(3):
            color[rows, c] = map_coordinates(label[..., c], [v.max() - v, u], order=1, mode="nearest")

    around = np.arctan2(-y, -x) * r.clip(0.03, 0.036)  # seam at +x, where the mug has its handle
    if name == "box":
        side = np.abs(vertices / high)
        axis = side.argmax(1)
        for k, (u, v) in enumerate(((y, z), (x, z), (x, y))):
            for sign in (-1, 1):
                put((axis == k) & (vertices[:, k] * sign > 0), u * sign * (1, -1, 1)[k], v)
    elif name == "can":
        color[:] = 0.62 + 0.10 * np.sin(r * 1400)[:, None] * (r < 0.0285)[:, None]
        put((np.abs(z) < 0.046) & (r > 0.033), around, z)
    elif name == "bottle":
        color[:] = ink[0]
        color[z > 0.064] = ink[1]
        put((z > -0.075) & (z < 0.018), around, z)
    elif name == "mug":
        color[r < 0.0385] = 0.86
        color[(np.abs(z) > 0.034) & (r > 0.037)] = ink[1]
        put((np.abs(z) < 0.026) & (np.abs(r - 0.041) < 2e-4) & (x < 0.03), around, z)
    elif name == "bowl":
        color[np.abs(z - 0.016) < 0.004] = ink[0]
    elif name == "plate":
        color[np.abs(r - 0.096) < 0.003] = ink[0]
    else:
        color *= (1 - 0.55 * np.clip((mottle - 1.3) * 1.5, 0, 1))[:, None] * [1, 0.92, 0.8]
        tip = np.clip((np.abs(np.arctan2(x, y - low[1] + 0.068)) - 0.78) * 12, 0, 1)[:, None]
        color += tip * (np.array([0.25, 0.20, 0.10]) - color)
    color *= 1 + (0.008 if name in ("plate", "bowl", "bottle") else 0.014) * mottle[:, None]
    rgb = (color.clip(0.02, 0.97) * 255).round().astype(np.uint8)
    mesh = trimesh.Trimesh(vertices.copy(), faces.copy(), process=False, vertex_colors=rgb)
    return mesh, tuple(torch.from_numpy(a) for a in (vertices, faces, normals, rgb[faces] / np.float32(255)))


def table_and_floor(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reflectance (linear) of the table's top (rows along y) and of the floor, and the table's centre (2,) [m]."""
    w, h = (TOP_SIZE / TEXEL).round().astype(int)
    if kind == "wood":
        dark, light = np.array([[0.42, 0.25, 0.13], [0.80, 0.60, 0.38]]) * rng.uniform(0.75, 1.1)
        bend = 14 * _noise(rng, h, w, (200, 980), (70, 490))
        rows = (np.arange(h)[:, None, None] + bend).round().astype(int)
        columns = np.arange(w)[None, :, None]
        grain = _noise(rng, h, w, (64, 700), (28, 490), (12, 280), (5, 140), (3, 70), fade=0.85)
        grain = grain[np.clip(rows, 0, h - 1), columns, 0]
        board = np.arange(h) // rng.integers(150, 260)  # boards are cut from different places
        grain = np.stack([np.roll(row, 397 * b) for row, b in zip(grain, board, strict=True)])
        grain += 0.7 * rng.standard_normal(board.max() + 1)[board][:, None, None]
        top = dark + (light - dark) * np.clip(0.66 + 0.13 * grain, 0, 1.2)
        top[np.flatnonzero(np.diff(board))] *= 0.55
    elif kind == "checked":
        cell, rim = rng.integers(42, 60), 0.8
        wave = [np.abs((np.arange(n) / cell) % 2 - 1) for n in (h, w)]
        a, b = (np.clip((v - 0.5) * cell / rim + 0.5, 0, 1) for v in wave)
        cloth = np.array([0.90, 0.88, 0.84])
        dye = _INKS[rng.choice([0, 1, 4, 7])] * 0.8 + 0.15
        top = cloth + (dye - cloth) * ((a[:, None] + b[None]) / 2)[..., None]
        top = top * (1 + 0.02 * _noise(rng, h, w, (3, 3), (70, 70)))
    elif kind == "print":
        top = np.full((h, w, 3), 0.85)
        for _ in range(60):
            ph, pw = (int(a) for a in rng.uniform([200, 160], [420, 320]))
            y, x = rng.integers(-100, h - 100), rng.integers(-100, w - 60)
            page = np.rot90(_label(rng, ph, pw)[::-1], rng.integers(4))[max(-y, 0) :, max(-x, 0) :]
            part = top[max(y, 0) :, max(x, 0) :][: page.shape[0], : page.shape[1]]
            part[:] = page[: part.shape[0], : part.shape[1]]
    else:
        tone = rng.uniform(0.62, 0.80) + rng.normal(0, 0.02, 3)
        top = np.tile(tone, (h, w, 1))
        if kind == "laminate":
            top *= 1 + 0.011 * _noise(rng, h, w, (84, 84), (32, 32), (12, 12), (5, 5), fade=0.9)
    n = 1024
    floor = np.array([0.46, 0.45, 0.43]) * rng.uniform(0.8, 1.1) + rng.normal(0, 0.015, 3)
    style = rng.integers(3)
    if style == 0:  # carpet
        floor = floor * (1 + 0.06 * _noise(rng, n, n, (128, 128), (8, 8), (2, 2), fade=1.2))
    else:  # tiles or boards
        a, b = ((128, 128), (32, 256))[style - 1]
        floor = floor * (1 + 0.07 * _noise(rng, n, n, (32, 32), (16, 16), (4, (4, 32)[style - 1]), fade=0.9))
        tile = 1 + 0.06 * rng.standard_normal((n // a, n // b))
        floor *= np.repeat(np.repeat(tile, a, 0), b, 1)[..., None]
        floor[::a], floor[:, ::b] = floor[::a] * 0.6, floor[:, ::b] * 0.6
    return (
        np.clip(top, 0.02, 0.95) ** GAMMA,
        np.clip(floor, 0.02, 0.9) ** GAMMA,
        rng.uniform([-0.2, -0.1], [0.2, 0.1]),
    )
