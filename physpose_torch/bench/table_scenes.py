"""Scenes whose table is known: rendered pairs of YCB objects, generated photographs; and the errors of a pose estimator."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from physpose_torch import se3
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.table.view import View

__all__ = ["MODELS", "TableScene", "generated_scenes", "noisy_poses", "pair_scenes", "read_image", "ycbv_body"]

MODELS = ("models", "models_textured")
"""Meshes without colours and with."""
ALONG, ACROSS, TURN = 0.012, 0.002, math.radians(1.15)
"""Standard deviations of an estimate along its viewing ray and across it, per axis [m], and of its rotation, per axis [rad]."""
FEWEST, MOST = 2, 7
"""Objects in a generated scene."""


@dataclass(frozen=True, eq=False)
class TableScene:
    """Two images of objects on a table, and what is true of them."""

    dataset: str
    """Where it is from."""
    name: str
    """Unique within the data set."""
    key: int
    """Unique among all: what the draws of its errors are seeded by."""
    images: tuple[Tensor, Tensor]
    """(H, W, 3) uint8."""
    K: Tensor
    """(3, 3) of both [px]."""
    truth: tuple[Tensor, Tensor]
    """T_camera_object (N, 4, 4) in each view [m]."""
    plane: Plane
    """In view 0."""
    meshes: dict[str, trimesh.Trimesh] | None = None
    """Coloured meshes by label [m]; None: they are YCB's."""
    plain: dict[str, trimesh.Trimesh] | None = None
    """The same shapes in fewer triangles, to be decomposed; None: decompose ``meshes``."""
    obj_ids: tuple[int, ...] = ()
    """Of YCB objects."""
    root: Path | None = None
    """Folder of their :data:`MODELS`."""

    @cached_property
    def middle(self) -> Tensor:
        """(3,) centre of the objects' footprints: the mean of their origins, on the table [m]."""
        origin = self.truth[0][:, :3, 3].mean(0)
        return origin - (self.plane.normal @ origin - self.plane.offset) * self.plane.normal

    def bodies(self, models: str, *, decomposed: bool = False) -> list[Body]:
        """The objects with their colours (``models_textured``) or without; with convex parts (CoACD), or the hull alone."""
        if self.meshes is None:
            return [ycbv_body(self.root, k, models, decomposed) for k in self.obj_ids]
        found = []
        for name, mesh in self.meshes.items():
            body = Body.from_mesh((self.plain or self.meshes)[name], label=name) if decomposed else None
            colored = Body.from_hull(mesh, label=name)
            body = colored if body is None else replace(body, appearance=colored.appearance)
            found.append(body if models != "models" else replace(body, appearance=None))
        return found

    def views(self, count: int, draw: int, bias: float, *, seed: int = 0) -> list[View]:
        """The first one or two images with poses as estimated. One draw has the same errors whatever the rest."""
        rng = np.random.default_rng([seed, self.key, draw])
        poses = [noisy_poses(truth, rng, bias) for truth in self.truth]
        return [View(self.images[i], self.K, poses[i]) for i in range(count)]


def noisy_poses(T_camera_object: Tensor, rng: np.random.Generator, bias: float = 0.0) -> Tensor:
    """Poses (N, 4, 4) with the errors that table_pairs/README.md states, and all translations (1 + bias) times too long."""

    def draw(sigma: float, columns: int) -> Tensor:
        return torch.from_numpy(rng.normal(0.0, sigma, (len(T_camera_object), columns)))

    t = T_camera_object[:, :3, 3]
    ray = t / torch.linalg.vector_norm(t, dim=1, keepdim=True)
    moved = t + draw(ALONG, 1) * ray + (draw(ACROSS, 2)[:, None] @ tangent_basis(ray))[:, 0]
    return se3.from_rotation_translation(se3.exp_so3(draw(TURN, 3)) @ T_camera_object[:, :3, :3], (1 + bias) * moved)


def pair_scenes(data: Path) -> Iterator[TableScene]:
    """The rendered pairs in ``data/table_pairs``.

    Raises:
        DataError: there are none.
    """
    folders = sorted((data / "table_pairs").glob("scene_*"))
    if not folders:
        raise DataError(f"{data}: no table_pairs/scene_* in it; --skip-pairs leaves them out")
    for folder in folders:
        scene = json.loads((folder / "scene.json").read_text())
        truth = [_metres([o[f"T_cam{i}_obj"] for o in scene["objects"]]) for i in range(2)]
        plane = scene["plane_cam0"]
        normal = torch.tensor(plane["normal"], dtype=torch.float64)
        number = folder.name.removeprefix("scene_")
        yield TableScene(
            dataset="table_pairs",
            name=f"{number} {scene['table']}",
            key=int(number),
            images=(read_image(folder / "view0.png"), read_image(folder / "view1.png")),
            K=torch.tensor(scene["K"], dtype=torch.float64),
            truth=tuple(truth),
            plane=Plane(normal, 1e-3 * plane["offset_mm"]),
            obj_ids=tuple(o["obj_id"] for o in scene["objects"]),
            root=data / scene["dataset"],
        )


def generated_scenes(count: int, seed: int = 0) -> Iterator[TableScene]:
    """Generated photographs on all tables in turn, with two to seven objects. What cannot be arranged is left out."""
    from physpose_torch.household import household_meshes
    from physpose_torch.photograph import TABLES, household_pair

    plain = household_meshes()
    for k in range(seed, seed + count):
        table, objects = TABLES[k % len(TABLES)], FEWEST + k % (MOST - FEWEST + 1)
        try:
            pair = household_pair(k, table=table, objects=objects)
        except InvalidInputError:  # no camera sees that many
            continue
        yield TableScene(
            dataset="generated",
            name=f"{k} {table} {objects}",
            key=1000 + k,
            images=pair.images,
            K=pair.K,
            truth=pair.T_camera_object,
            plane=Plane(pair.normal, pair.offset),
            meshes=pair.meshes,
            plain=plain,
        )


@lru_cache(maxsize=64)
def ycbv_body(root: Path, obj_id: int, models: str, decomposed: bool = False) -> Body:
    """A YCB object; one that has no coloured mesh comes without colours."""
    path = root / models / f"obj_{obj_id:06d}.glb"
    if models == "models" or not path.is_file():
        path = root / "models" / f"obj_{obj_id:06d}.ply"
    make = Body.from_mesh if decomposed else Body.from_hull
    return make(path, label=str(obj_id), scale=1e-3)


def read_image(path: Path) -> Tensor:
    """(H, W, 3) uint8, RGB."""
    from PIL import Image

    with Image.open(path) as opened:
        return torch.from_numpy(np.array(opened.convert("RGB")))


def _metres(T: list) -> Tensor:
    T = torch.tensor(T, dtype=torch.float64)
    T[..., :3, 3] *= 1e-3
    # nine decimals of a rotation in the file
    U, _, Vh = torch.linalg.svd(T[..., :3, :3])
    return se3.from_rotation_translation(U @ Vh, T[..., :3, 3])
