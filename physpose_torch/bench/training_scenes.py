"""What a small pose refiner trains on: crops of rendered household scenes, and the object as it would look at a coarse pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.household import (
    HOUSEHOLD_COLORS,
    HouseholdScene,
    household_meshes,
    household_scene,
    perturb_like_estimator,
)
from physpose_torch.render import render
from physpose_torch.scene import Scene

if TYPE_CHECKING:
    import trimesh

__all__ = ["AXIAL", "LABELS", "PoseSamples", "household_symmetries", "pose_samples"]

LABELS = tuple(HOUSEHOLD_COLORS)
"""Names of the objects; a sample's label is a row of it."""
AXIAL = ("bowl", "can", "bottle", "plate")
"""Solids of revolution about their z axis. The box has half turns, too, but every coarse pose is nearest to the truth."""

CROP = 1.25
"""Side of a crop over the object's diameter."""
BLUR = 2
"""Samples per pixel and direction of a rendered crop."""
AMBIENT = 0.35
LIGHT = (-0.4, -0.8, -0.45)
"""Towards the light, camera frame, when the coarse pose is rendered; the photograph's is off by some 15°."""


@dataclass(frozen=True, eq=False)
class PoseSamples:
    """Scenes under draws of the coarse estimate; the M objects of all S samples stand in one sequence."""

    scenes: tuple[Scene, ...]
    """Of each sample; the table plane is the true one."""
    start: Tensor
    """(S + 1,) long: sample s has the objects ``start[s]:start[s + 1]``."""
    label: Tensor
    """(M,) long, rows of :data:`LABELS`."""
    truth: Tensor
    """T_camera_object (M, 4, 4) [m], float32."""
    coarse: Tensor
    """T_camera_object (M, 4, 4) [m], float32."""
    images: Tensor
    """(M, 5, C, C): the photograph's crop and the object's visible mask in it, as a detector gives it; grey, depth over the
    object's radius, and mask, rendered at the coarse pose."""
    side: Tensor
    """(M,) extent of each crop at a depth of 1 m [m]."""

    def __len__(self) -> int:
        return len(self.scenes)

    def rows(self, samples: Sequence[int]) -> Tensor:
        """(K,) long: the objects of some samples, one sample after the other."""
        return torch.cat([torch.arange(int(self.start[s]), int(self.start[s + 1])) for s in samples])

    def scene(self, samples: Sequence[int]) -> Scene:
        """One scene of some samples; its objects are those of :meth:`rows`."""
        return Scene.cat([self.scenes[s] for s in samples])


def pose_samples(
    seeds: Sequence[int],
    bodies: Mapping[str, Body],
    *,
    draws: int = 4,
    crop: int = 32,
    seed: int = 0,
    lateral_sigma: float = 0.005,
    depth_sigma: float = 0.02,
    rotation_sigma_deg: float = 5.0,
) -> PoseSamples:
    """Photographs of household scenes, and crops at coarse poses.

    Args:
        seeds: of the scenes.
        bodies: of all names in :data:`LABELS`; what scenes are made of.
        draws: coarse estimates of each scene; the samples of a scene stand one after the other.
        crop: pixels of a crop's side.
        seed: of light, table and coarse estimates.
        lateral_sigma, depth_sigma, rotation_sigma_deg: errors of the coarse estimates, wider than what a good estimator is
            left with; see :func:`~physpose_torch.household.perturb_like_estimator`, whose common bias of depth is kept.

    Raises:
        InvalidInputError: no seeds, no draws or no pixels.
    """
    if not len(seeds) or draws < 1 or crop < 8:
        raise InvalidInputError(f"{len(seeds)} scenes, {draws} draws, crops of {crop} px: expected at least 1, 1 and 8")
    meshes = {name: _Mesh.of(name, mesh) for name, mesh in household_meshes().items()}
    generator = torch.Generator().manual_seed(seed)
    noise = {"lateral_sigma": lateral_sigma, "depth_sigma": depth_sigma, "rotation_sigma_deg": rotation_sigma_deg}
    scenes, labels, truths, coarses, images, sides = [], [], [], [], [], []
    for scene_seed in seeds:
        true = household_scene(scene_seed)
        plane = Plane(true.normal, torch.tensor(true.offset, dtype=torch.float64))
        scene = Scene.tabletop([bodies[n] for n in true.names], plane)
        own = [meshes[n] for n in true.names]
        photograph, owner = _photograph(true, own, generator)
        for _ in range(draws):
            coarse = perturb_like_estimator(true.T_camera_object, generator=generator, **noise)
            scenes.append(scene)
            truths.append(true.T_camera_object)
            coarses.append(coarse)
            labels += [LABELS.index(n) for n in true.names]
            image, side = _crops(photograph, owner, coarse, own, true.K, crop)
            images.append(image)
            sides.append(side)
    count = torch.tensor([0, *(len(s) for s in scenes)])
    truth, coarse = (torch.cat(T).float() for T in (truths, coarses))
    return PoseSamples(
        tuple(scenes),
        count.cumsum(0),
        torch.tensor(labels),
        truth,
        coarse,
        torch.cat(images),
        torch.cat(sides),
    )


def household_symmetries(name: str) -> Tensor:
    """(S, 4, 4) float64 rotations that leave an object's mesh as it is, the identity first."""
    if name == "box":
        turns = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)
        return se3.from_rotation_translation(torch.diag_embed(turns), torch.zeros(4, 3, dtype=torch.float64))
    steps = 48 if name in AXIAL else 1  # their meshes are prisms of 48 sides
    angle = torch.arange(steps, dtype=torch.float64) * (2 * torch.pi / steps)
    about_z = torch.stack([0 * angle, 0 * angle, angle], dim=1)
    return se3.from_rotation_translation(se3.exp_so3(about_z), torch.zeros_like(about_z))


class _Mesh(NamedTuple):
    """What is rendered, object frame [m], float64."""

    vertices: Tensor
    faces: Tensor
    normals: Tensor
    """Of the faces."""
    albedo: float
    radius: float
    """Largest distance of a vertex from the origin [m]."""

    @classmethod
    def of(cls, name: str, mesh: "trimesh.Trimesh") -> "_Mesh":
        vertices, faces, normals = (torch.tensor(np.asarray(x)) for x in (mesh.vertices, mesh.faces, mesh.face_normals))
        radius = float(torch.linalg.vector_norm(vertices, dim=1).max())
        return cls(vertices, faces, normals, sum(HOUSEHOLD_COLORS[name]) / 3, radius)


def _lit(normals: Tensor, light: Tensor) -> Tensor:
    return AMBIENT + (1 - AMBIENT) * (normals @ functional.normalize(light, dim=0)).clamp(min=0)


def _photograph(true: HouseholdScene, meshes: Sequence["_Mesh"], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Grey (H, W) of all objects on a plain table, and which of them is seen (H, W), -1 for the table.

    The light and the table's grey are drawn.
    """
    draw = torch.rand(4, generator=generator, dtype=torch.float64)
    light = functional.normalize(torch.tensor(LIGHT, dtype=torch.float64), dim=0) + 0.5 * (draw[:3] - 0.5)
    table = (0.25 + 0.5 * draw[3]) * _lit(true.normal, light)
    K = true.K.expand(len(meshes), 3, 3)
    grey, _, owner = _render(meshes, true.T_camera_object, K, true.height, true.width, light)
    return torch.where(owner >= 0, grey, table), owner


def _render(
    meshes: Sequence["_Mesh"], poses: Tensor, K: Tensor, height: int, width: int, light: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Shaded grey, depth [m] and object (H, W) of meshes at poses T_camera_object, each with its own intrinsics (N, 3, 3)."""
    points, faces, shades, n = [], [], [], 0
    for mesh, T, intrinsics in zip(meshes, poses, K, strict=True):
        points.append(se3.apply(T, mesh.vertices) @ intrinsics.mT)  # the last row is 0 0 1: depths stay
        faces.append(mesh.faces + n)
        shades.append(mesh.albedo * _lit(mesh.normals @ T[:3, :3].mT, light))
        n += len(mesh.vertices)
    seen = render(torch.cat(points), torch.cat(faces), torch.eye(3, dtype=torch.float64), height, width)
    who = torch.repeat_interleave(torch.tensor([len(f) for f in faces]))
    hit = seen.face_id >= 0
    return torch.where(hit, torch.cat(shades)[seen.face_id], 0.0), seen.depth, torch.where(hit, who[seen.face_id], -1)


def _crops(
    photograph: Tensor, owner: Tensor, poses: Tensor, meshes: Sequence["_Mesh"], K: Tensor, crop: int
) -> tuple[Tensor, Tensor]:
    """Images (N, 5, C, C) about the objects' origins at coarse poses, and their extents (N,) at a depth of 1 m [m]."""
    radius = torch.tensor([mesh.radius for mesh in meshes], dtype=torch.float64)
    depth = poses[:, 2, 3]
    side = 2 * CROP * radius / depth
    middle = (poses[:, :3, 3] @ K.mT)[:, :2] / depth[:, None]
    pixels = BLUR * crop
    to_crop = torch.eye(3, dtype=torch.float64).repeat(len(meshes), 1, 1)
    to_crop[:, 0, 0] = to_crop[:, 1, 1] = pixels / (side * K[0, 0])
    to_crop[:, :2, 2] = 0.5 * (pixels - 1) - to_crop[:, :1, 0] * middle
    to_crop[:, 1, 2] += pixels * torch.arange(len(meshes))  # one above the other, in one call: each is inside its crop
    light = torch.tensor(LIGHT, dtype=torch.float64)
    grey, z, seen = (
        x.view(-1, pixels, pixels) for x in _render(meshes, poses, to_crop @ K, pixels * len(meshes), pixels, light)
    )
    relative = torch.where(seen >= 0, (z - depth[:, None, None]) / radius[:, None, None], 0.0)
    rendered = functional.avg_pool2d(torch.stack([grey, relative, (seen >= 0).double()], dim=1), BLUR)
    cut = [
        _cut_out(torch.stack([photograph, (owner == i).double()]), middle[i], side[i] * K[0, 0], crop)
        for i in range(len(meshes))
    ]
    return torch.cat([torch.stack(cut), rendered], dim=1).float(), side.float()


def _cut_out(image: Tensor, middle: Tensor, side: Tensor, crop: int) -> Tensor:
    """(B, C, C) of a square about a pixel, each the mean of 3 × 3 samples; the image's border goes on outside."""
    fine = 3 * crop
    along = ((torch.arange(fine, dtype=torch.float64) + 0.5) / fine - 0.5) * side
    size = torch.tensor([image.shape[2], image.shape[1]], dtype=torch.float64)
    x, y = ((2 * (middle[k] + along) + 1) / size[k] - 1 for k in range(2))
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)[None]
    cut = functional.grid_sample(image[None], grid, padding_mode="border", align_corners=False)
    return functional.avg_pool2d(cut, 3)[0]
