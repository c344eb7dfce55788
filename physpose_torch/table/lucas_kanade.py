"""Matches brought to sub-pixel accuracy: affine Lucas–Kanade, batched (Baker and Matthews 2004, inverse compositional).

Semi-dense descriptors know a match to a pixel or two. A plane that is triangulated from them is off by degrees; what limits
it is where the matches are, not which ones a RANSAC keeps. So each match is aligned with the pixels themselves, and says how
well it is known, and in which direction: along an edge it is not.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, grid_sample, pad

__all__ = ["Aligned", "align_patches", "gray", "sample"]

HALF_WINDOW = 8
"""Patches have 2 · 8 + 1 pixels a side, with weights that fall off towards their border."""
ITERATIONS = (12, 15)
"""At half and at full resolution."""
STILL = 0.01
"""[px]; a patch that moves less than this has arrived."""
BLUR = 0.8
"""[px] of the Gaussian that images are smoothed with, at each resolution: slopes of noise are no texture."""
LEAST_NOISE = 0.5
"""Grey levels of 255 that two smoothed images differ by; no camera has less noise."""
LEAST_SLOPE = 0.05
"""Grey levels a pixel; there is no less texture than this, so that no variance is infinite."""
FLOOR = 0.07
"""[px], standard deviation: what interpolation, lighting and surfaces that are not flat leave, however sharp the patch."""
LEAST_CORRELATION = 0.8
"""Patches that look less alike than this, after alignment, do not show the same thing."""
LARGEST_SHEAR = 0.6
"""A patch whose affine map strays farther than this from where it started has run away."""


class Aligned(NamedTuple):
    """Where patches of the first image are in the second."""

    points: Tensor
    """(M, 2) in the second image [px], float64."""
    affine: Tensor
    """(M, 2, 2) how offsets from the point in the first image map to offsets in the second."""
    covariance: Tensor
    """(M, 2, 2) of the points [px²]: large along an edge."""
    correlation: Tensor
    """(M,) of the two patches after alignment."""
    good: Tensor
    """(M,) bool: converged, alike, and within both images."""


def gray(image: Tensor) -> Tensor:
    """Luma (H, W) float32 between 0 and 255 of an image (H, W, 3) uint8 (ITU-R BT.601)."""
    return image.float() @ image.new_tensor([0.299, 0.587, 0.114], dtype=torch.float32)


def sample(image: Tensor, points: Tensor, mode: str = "bilinear") -> Tensor:
    """Values (...) of an image (H, W) at points (..., 2) [px], pixel centres at integers; the border goes on outside."""
    if mode == "bicubic":
        # torch's kernel (A = -0.75) puts a ramp at t + t (1 - t) (1 - 2 t) / 2; the cubic equation for t has this solution
        low = points.floor()
        points = low + (0.5 + (((points - low).to(image.dtype) * 4 - 2).asinh() / 3).sinh())
    size = points.new_tensor([image.shape[1] - 1, image.shape[0] - 1])
    grid = (2.0 * points / size - 1.0).to(image.dtype).reshape(1, 1, -1, 2)
    value = grid_sample(image[None, None], grid, mode=mode, padding_mode="border", align_corners=True)
    return value.reshape(points.shape[:-1])


def align_patches(
    image_0: Tensor,
    image_1: Tensor,
    points_0: Tensor,
    points_1: Tensor,
    *,
    affine: Tensor | None = None,
    deform: bool = True,
) -> Aligned:
    """Find where the patches around points of one image are in another, starting from a guess.

    Brightness may differ by a factor and an offset, patch by patch.

    Args:
        image_0, image_1: grey images (H, W), float32 between 0 and 255.
        points_0: (M, 2) where the patches are in the first image [px].
        points_1: (M, 2) about where they are in the second [px], right to a few pixels.
        affine: (M, 2, 2) about how offsets map; None: as they are.
        deform: look for the map, too. Where it is known, as from a plane, it is better left alone: a patch of wood has stripes
            that slide along each other.
    """
    count = len(points_0)
    start = torch.eye(2, dtype=torch.float64).expand(count, 2, 2) if affine is None else affine.double()
    start = start.to(points_0.device)
    where, map_ = points_1.double().clone(), start.clone()
    state = None
    for halvings, iterations in zip((1, 0), ITERATIONS, strict=True):
        images = [_smoothed(_halved(x, halvings)) for x in (image_0, image_1)]
        scale = 2.0**halvings
        # a pixel of the half-size image covers two: its centre lies between theirs
        first, second = ((x.double() + 0.5) / scale - 0.5 for x in (points_0, where))
        state = _align(*images, first, second, map_, iterations, deform)
        where, map_ = (state.points + 0.5) * scale - 0.5, state.affine
    size_0, size_1 = (where.new_tensor([x.shape[1] - 1, x.shape[0] - 1]) for x in (image_0, image_1))
    inside = ((where >= 0) & (where <= size_1)).all(1) & ((points_0 >= 0) & (points_0 <= size_0)).all(1)
    tame = (map_ - start).abs().flatten(1).amax(1) < LARGEST_SHEAR
    good = state.good & inside & tame & (state.correlation > LEAST_CORRELATION)
    return Aligned(where, map_, state.covariance, state.correlation, good)


def _halved(image: Tensor, halvings: int) -> Tensor:
    for _ in range(halvings):
        height, width = image.shape
        image = pad(image[None, None], (0, width % 2, 0, height % 2), mode="replicate")
        image = avg_pool2d(image, 2)[0, 0]
    return image


def _smoothed(image: Tensor) -> Tensor:
    radius = 3
    tap = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, device=image.device) / BLUR) ** 2)
    tap = tap / tap.sum()
    image = pad(image[None, None], (radius,) * 4, mode="replicate")
    return conv2d(conv2d(image, tap.reshape(1, 1, -1, 1)), tap.reshape(1, 1, 1, -1))[0, 0]


def _align(image_0: Tensor, image_1: Tensor, points_0: Tensor, points_1: Tensor, affine: Tensor, iterations: int, deform: bool):
    axis = torch.arange(-HALF_WINDOW, HALF_WINDOW + 1, dtype=torch.float64, device=points_0.device)
    offset = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).reshape(-1, 2)
    weight = torch.exp(-0.5 * (offset**2).sum(1) / (0.55 * HALF_WINDOW) ** 2).float()
    weight = weight / weight.sum()

    at = points_0[:, None] + offset
    template = sample(image_0, at, "bicubic")
    wide = pad(image_0[None, None], (1,) * 4, mode="replicate")[0, 0]
    slopes = (wide[1:-1, 2:] - wide[1:-1, :-2]) / 2, (wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2
    slope = torch.stack([sample(image, at, "bicubic") for image in slopes], -1)
    # how the patch changes with position and map; what a change of brightness or contrast would explain is projected out
    by_map = (slope[..., :, None] * offset.float()[:, None, :]).flatten(-2)
    steepest = torch.cat([slope, by_map / HALF_WINDOW], -1) if deform else slope
    flat = torch.stack([torch.ones_like(template), template - _mean(template, weight)], -1)
    inner = torch.einsum("mpi,p,mpj->mij", flat, weight, flat)
    inner = inner + 1e-6 * torch.eye(2, device=inner.device)
    along = torch.linalg.solve(inner, torch.einsum("mpi,p,mpj->mij", flat, weight, steepest))
    steepest = steepest - flat @ along
    normal = torch.einsum("mpi,p,mpj->mij", steepest, weight, steepest).double()
    # a patch with one direction, or none, must not run: about half a pixel of prior, in units of the camera's noise
    damping = LEAST_NOISE**2 / len(weight) * torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
    inverse = torch.linalg.inv(normal + damping)
    pull = (inverse.float() @ steepest.mT) * weight

    where, map_ = points_1.clone(), affine.clone()
    moving = torch.arange(len(where), device=where.device)
    for k in range(iterations):
        if not len(moving):
            break
        difference, _ = _difference(
            image_1, where[moving], map_[moving], offset, template[moving], weight, "bilinear" if k < 3 else "bicubic"
        )
        change = (pull[moving] @ difference[..., None])[..., 0].double()
        if deform:
            # inverse composition: the patch is warped back by what the template would have to move
            shear = change[:, 2:].reshape(-1, 2, 2) / HALF_WINDOW
            back = torch.linalg.inv(torch.eye(2, dtype=shear.dtype, device=shear.device) + shear.clamp(-0.3, 0.3))
            map_[moving] = map_[moving] @ back
        move = (map_[moving] @ change[:, :2, None])[:, :, 0]
        length = torch.linalg.vector_norm(move, dim=1, keepdim=True)
        where[moving] = where[moving] - move * (2.0 / length.clamp_min(2.0))
        moving = moving[(length[:, 0] > STILL) | (k < 4)]

    difference, correlation = _difference(image_1, where, map_, offset, template, weight, "bicubic")
    variance = _mean(difference**2, weight)[:, 0].double().clamp_min(LEAST_NOISE**2)
    # Both images' noise, smoothed, is in the difference. Of noise of density D, smoothing with s leaves a variance of
    # D / 4 pi s^2, and slopes of variance D / 8 pi s^4 along each axis, which look like texture and are none.
    true = normal - _noise_slopes(offset, weight, deform) * (variance / (4 * BLUR**2))[:, None, None]
    power, axes = torch.linalg.eigh(true)
    inverse = (axes @ ((1.0 / power.clamp_min(LEAST_SLOPE**2))[..., None] * axes.mT))[:, :2, :2]
    covariance = inverse * (4 * math.pi * BLUR**2 * float((weight**2).sum()) * variance)[:, None, None]
    covariance = map_ @ covariance @ map_.mT + FLOOR**2 * torch.eye(2, dtype=map_.dtype, device=map_.device)
    still = torch.ones(len(where), dtype=torch.bool, device=where.device)
    still[moving] = False
    return Aligned(where, map_, covariance, correlation, still)


def _noise_slopes(offset: Tensor, weight: Tensor, deform: bool) -> Tensor:
    """What slopes of variance one, independent in x and y, add to the normal matrix."""
    basis = torch.cat([torch.ones_like(offset[:, :1]), offset / HALF_WINDOW], 1)[:, : 3 if deform else 1]
    share = torch.einsum("pi,p,pj->ij", basis, weight.double(), basis)
    if not deform:
        return share * torch.eye(2, dtype=share.dtype, device=share.device)
    out = torch.zeros(6, 6, dtype=share.dtype, device=share.device)
    for k in (torch.tensor([0, 2, 3]), torch.tensor([1, 4, 5])):  # what goes with the slope along x, and along y
        out[k[:, None], k] = share
    return out


def _difference(image: Tensor, where: Tensor, map_: Tensor, offset, template, weight, mode: str) -> tuple[Tensor, Tensor]:
    """Patches of the second image, brought to the templates' mean and contrast, minus these; and their correlation."""
    patch = sample(image, where[:, None] + offset @ map_.mT, mode)
    patch, reference = patch - _mean(patch, weight), template - _mean(template, weight)
    power, own = _mean(patch**2, weight), _mean(reference**2, weight)
    product = _mean(patch * reference, weight)
    correlation = product / (power * own).clamp_min(1e-6).sqrt()
    gain = product / power.clamp_min(LEAST_NOISE**2)
    return gain * patch - reference, correlation[:, 0]


def _mean(patch: Tensor, weight: Tensor) -> Tensor:
    return (patch @ weight)[:, None]
