"""Where the objects are in the images: their colours found by Lucas–Kanade, and their outlines by colour statistics.

Pose estimators judge each object's depth by itself. Here all that the images say of the objects' sizes and places is measured
again, as evidence for the adjustment: a model's texture where the mesh has one, its outline in any case.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, pad

from physpose_torch.config import TableConfig
from physpose_torch.table.adjustment import State
from physpose_torch.table.evidence import (
    EpipolarMatches,
    ModelPoints,
    Outlines,
    PlaneMatches,
    SurfaceMatches,
    few,
    plane_terms,
)
from physpose_torch.table.lucas_kanade import align_patches, gray, sample
from physpose_torch.table.roles import Matches
from physpose_torch.table.template import Template, eroded, grown
from physpose_torch.table.view import View, pixel_rays, project

__all__ = [
    "Located", "corners", "find_outlines", "find_textures", "plane_matches", "predict_matches", "surface_matches"]

BORDER = 4
"""Pixels inside an object's outline that do not count as its own surface: estimates are off by as much."""
PATCH = 7
"""The same for patches of a template, which show nothing outside."""
CLEAR = 8
"""Pixels outside an object's outline that do not count as table: estimates are off, and there are shadows."""
INDEPENDENT = 20.0
"""Matches on one object count as this many at the most: a model's surface and texture are off in patches, not in points."""
INDEPENDENT_OUTLINE = 8.0
"""The same for points of one outline in one view."""
OUTLINE_STEP = 6
"""Pixels between points of an outline."""
OUTLINE_SIGMA = 1.0
"""[px], standard deviation of a point of an outline that has been found."""
EXPECTED = 0.4
"""Standard deviation of how far off an outline is, as a share of how far it is looked for."""
EDGE = 1.5
"""[px]; where colours change there is an edge this near …"""
LEAST_EDGE = 10.0
"""… of so many grey levels over two pixels."""
BLURRED = 2.0
"""[px²]; where colours change less clearly than with this variance, there is no telling."""
HISTOGRAM = 16
"""Bins a channel."""
TRUST = 0.4
"""Neighbouring pixels are alike: a line of them counts as this share of independent ones."""
LEAST_OUTLINE = 8
"""Points; fewer tell nothing."""


class Located(NamedTuple):
    """Matches to a fraction of a pixel, with what is known of the second point."""

    points_0: Tensor
    """(M, 2) [px]."""
    points_1: Tensor
    """(M, 2) [px]."""
    covariance: Tensor
    """(M, 2, 2) of the second [px²]."""

    @classmethod
    def of(cls, matches: Matches, grays: Sequence[Tensor]) -> "Located":
        """What of rough matches can be aligned."""
        found = align_patches(*grays, matches.points_0, matches.points_1)
        good = found.good
        return cls(matches.points_0[good], found.points[good], found.covariance[good])


def corners(image: Tensor, mask: Tensor, spacing: int, most: int = 1500) -> Tensor:
    """Points (M, 2) of a grey image (H, W) that can be found again (Shi and Tomasi 1994), where a mask allows [px]."""
    found = cv2.goodFeaturesToTrack(
        image.clamp(0, 255).to(torch.uint8).numpy(),
        most,
        0.0005,
        spacing,
        mask=mask.to(torch.uint8).numpy(),
        blockSize=7,
    )
    return torch.zeros(0, 2, dtype=torch.float64) if found is None else torch.from_numpy(found[:, 0]).double()


def find_textures(
    template: Template, image: Tensor, view: View, index: int, config: TableConfig
) -> ModelPoints | None:
    """Points of coloured objects, found in a view.

    Args:
        template: the objects as they should look in this view.
        image: grey image (H, W) of the view.
        view: the view.
        index: its number.
        config: standard deviation of surfaces.
    """
    drawn = gray(template.color)
    points = [
        corners(drawn, eroded(template.owner == k, PATCH), 5, 200)
        for k in range(len(template.colored))
        if bool(template.colored[k])
    ]
    points = torch.cat([torch.zeros(0, 2, dtype=torch.float64), *points])
    if not len(points):
        return None
    found = align_patches(drawn, image, points, points)
    points, pixels, covariance = points[found.good], found.points[found.good], found.covariance[found.good]
    x, y = points.round().long().unbind(1)
    owner = template.owner[y, x]
    sigma = float(view.K[0, 0]) * config.sigma_surface / template.depth[y, x]
    covariance = covariance + sigma[:, None, None] ** 2 * torch.eye(2, dtype=sigma.dtype)
    if not len(points):
        return None
    return ModelPoints(
        index, template.point[y, x], pixels, _whitening(covariance), owner, view.K, few(owner, INDEPENDENT)
    )


def predict_matches(state: State, template: Template, K0: Tensor, K1: Tensor, points_0: Tensor) -> tuple[Tensor, Tensor]:
    """Where points (M, 2) of view 0 are in view 1, and how offsets map (M, 2, 2), by the objects' surfaces and the plane."""
    x, y = points_0.round().long().unbind(1)
    owner = template.owner[y, x]
    on = owner >= 0
    R, t = state.poses[owner[on], :3, :3], state.poses[owner[on], :3, 3]
    normal = state.normal.expand(len(points_0), 3).clone()
    offset = state.offset.expand(len(points_0)).clone()
    normal[on] = (R @ template.normal[y, x][on][..., None])[..., 0]
    surface = (R @ template.point[y, x][on][..., None])[..., 0] + t
    offset[on] = (normal[on] * surface).sum(1)

    def transfer(points: Tensor) -> Tensor:
        rays = pixel_rays(K0, points)
        met = (offset / (normal * rays).sum(1))[:, None] * rays
        return project(K1, met @ state.T_view1_view0[:3, :3].mT + state.T_view1_view0[:3, 3])

    step = torch.eye(2, dtype=points_0.dtype)
    affine = torch.stack([(transfer(points_0 + s) - transfer(points_0 - s)) / 2 for s in step], 2)
    return transfer(points_0), affine


def plane_matches(
    state: State, plane: Tensor, matches: Located, templates: Sequence[Template], views: Sequence[View]
) -> list[EpipolarMatches | PlaneMatches]:
    """Terms of matches that are off the objects in both views; ``plane`` (3, 3) is the covariance of what is known of it."""
    free = _at(~grown(templates[0].owner >= 0, CLEAR), matches.points_0)
    free &= _at(~grown(templates[1].owner >= 0, CLEAR), matches.points_1)
    if not bool(free.any()):
        return []
    return list(plane_terms(state, plane, views[0].K, views[1].K, *(x[free] for x in matches)))


def surface_matches(
    state: State, matches: Located, templates: Sequence[Template], views: Sequence[View], config: TableConfig
) -> SurfaceMatches | None:
    """Matches that are on the same object in both views."""
    x, y = _pixel(matches.points_0, templates[0].owner)
    owner = templates[0].owner[y, x]
    inner = torch.zeros_like(owner, dtype=torch.bool)
    for k in owner[owner >= 0].unique().tolist():
        inner |= (owner == k) & eroded(templates[0].owner == k, BORDER)[y, x]
    x1, y1 = _pixel(matches.points_1, templates[1].owner)
    on = inner & (templates[1].owner[y1, x1] == owner)
    if not bool(on.any()):
        return None
    points_0, points_1, covariance = (v[on] for v in matches)
    x, y, owner = x[on], y[on], owner[on]
    baseline = torch.linalg.vector_norm(state.T_view1_view0[:3, 3])
    # a surface that is off along the ray of view 0 is off in view 1 by what the baseline makes of it
    depth = templates[0].depth[y, x]
    sigma = float(views[1].K[0, 0]) * config.sigma_surface * baseline / depth**2
    covariance = covariance + sigma[:, None, None] ** 2 * torch.eye(2, dtype=sigma.dtype)
    rays = pixel_rays(views[0].K, points_0)
    normal, surface = templates[0].normal[y, x], templates[0].point[y, x]
    weight = few(owner, INDEPENDENT)
    return SurfaceMatches(rays, points_1, surface, normal, _whitening(covariance), owner, views[1].K, weight)


def find_outlines(
    template: Template, image: Tensor, view: View, index: int, config: TableConfig, *, only: Sequence[int], reach: int
) -> Outlines | None:
    """Points of the objects' outlines, found in a view within ``reach`` [px].

    Along a line across the outline, pixels are like the object's inside up to where they are like what is around it (colour
    histograms, as in region-based tracking, Prisacariu and Reid 2012). Edges only confirm: the nearest strong one is often a
    rim or a label of the object itself.

    Args:
        template: the objects as they should be in this view.
        image: (H, W, 3) uint8, RGB.
        view: the view.
        index: its number.
        config: standard deviation of surfaces.
        only: which objects.
        reach: how far to look.
    """
    code = (image.long() * HISTOGRAM) // 256
    code = (code[..., 0] * HISTOGRAM + code[..., 1]) * HISTOGRAM + code[..., 2]
    channels = image.float().unbind(2)
    found = []
    for k in only:
        alone = template.outlines[k]
        line = None if alone is None else _outline(template, k, alone, reach)
        if line is None:
            continue
        point, pixel, outward = line
        odds = _odds(code, template.owner == k, alone, reach)
        shift, variance = _change(odds, pixel, outward, reach)
        # shadows change colours softly
        clear = (variance < BLURRED) & (_steepest(channels, pixel, outward, shift) > LEAST_EDGE)
        if int(clear.sum()) < LEAST_OUTLINE:
            continue
        point, pixel, outward, shift, variance = (v[clear] for v in (point, pixel, outward, shift, variance))
        surface = float(view.K[0, 0]) * config.sigma_surface / template.depth[template.owner == k].mean()
        sigma = (variance + OUTLINE_SIGMA**2 + surface**2).sqrt()[:, None]
        # the point was seen half a pixel inside the outline
        pixel = pixel + (shift - 0.5)[:, None] * outward
        found.append((point, pixel, outward / sigma, torch.full((len(point),), k)))
    if not found:
        return None
    points, pixels, across, owner = (torch.cat(column) for column in zip(*found, strict=True))
    return Outlines(index, points, pixels, across, owner, view.K, few(owner, INDEPENDENT_OUTLINE))


def _outline(template: Template, k: int, alone: Tensor, reach: int) -> tuple[Tensor, Tensor, Tensor] | None:
    """Points of an object's outline that are seen against something farther: object frame, pixel, outward normal."""
    lines, _ = cv2.findContours(alone.to(torch.uint8).numpy(), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    line = max(lines, key=len)[:, 0].astype(np.float64)
    if len(line) < 5 * OUTLINE_STEP:
        return None
    weight = np.exp(-0.5 * (np.arange(-6, 7) / 3.0) ** 2)
    weight /= weight.sum()
    wrapped = np.concatenate([line[-6:], line, line[:6]])
    smooth = np.stack([np.convolve(wrapped[:, i], weight, "valid") for i in (0, 1)], 1)
    tangent = np.roll(smooth, -2, 0) - np.roll(smooth, 2, 0)
    outward = np.stack([tangent[:, 1], -tangent[:, 0]], 1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True).clip(1e-9)
    # OpenCV runs round the pixels inside the outline, which lies half a pixel farther out
    pixel, outward = torch.from_numpy(line[::OUTLINE_STEP]), torch.from_numpy(outward[::OUTLINE_STEP])
    x, y = _pixel(pixel + 4 * outward, alone)
    if float(alone[y, x].double().mean()) > 0.5:
        outward = -outward
    height, width = alone.shape
    margin = reach + 4
    inside = ((pixel >= margin) & (pixel <= pixel.new_tensor([width - 1 - margin, height - 1 - margin]))).all(1)
    x, y = _pixel(pixel, alone)
    xi, yi = _pixel(pixel - 2 * outward, alone)
    xo, yo = _pixel(pixel + 3 * outward, alone)
    own = (template.owner[y, x] == k) & (template.owner[yi, xi] == k)
    # next to another object either may be off, and colours mix
    seen = inside & own & (template.owner[yo, xo] < 0)
    if int(seen.sum()) < LEAST_OUTLINE:
        return None
    return template.point[y, x][seen], (pixel + 0.5 * outward)[seen], outward[seen]


def _odds(code: Tensor, own: Tensor, alone: Tensor, reach: int) -> Tensor:
    """(H, W) logarithm of how much likelier each pixel's colour is inside the object than around it."""
    around = grown(alone, reach + 14) & ~grown(alone, 3)

    def histogram(mask: Tensor) -> Tensor:
        count = torch.bincount(code[mask], minlength=HISTOGRAM**3).float().reshape(1, 1, *(HISTOGRAM,) * 3)
        count = avg_pool3d(pad(count, (1,) * 6), 3, 1).flatten()
        return (count + 1e-3 * count.sum() / len(count) + 1e-6) / (count.sum() + 1e-6)

    inside = eroded(own, 2)
    return (histogram(inside).log() - histogram(around).log()).clamp(-2.5, 2.5)[code]


def _change(odds: Tensor, pixel: Tensor, outward: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """How far out (M,) the pixels change from the object to what is around it, and the variance [px²]."""
    step = torch.arange(-reach - 4, reach + 5, dtype=torch.float64) + 0.5
    along = sample(odds, pixel[:, None] + step[:, None] * outward[:, None]).double()
    # the outline between two samples: those before it inside, those after it outside
    total = torch.cat([torch.zeros_like(along[:, :1]), along.cumsum(1)], 1)
    shift = torch.cat([step - 0.5, step[-1:] + 0.5])
    near = shift.abs() <= reach
    score = TRUST * (2 * total - total[:, -1:]) - 0.5 * (shift / (EXPECTED * reach)) ** 2
    share = torch.softmax(score[:, near], 1)
    mean = share @ shift[near]
    return mean, (share * (shift[near] - mean[:, None]) ** 2).sum(1)


def _steepest(channels: Sequence[Tensor], pixel: Tensor, outward: Tensor, shift: Tensor) -> Tensor:
    """Largest change of a colour over two pixels across the outline, near a shift (M,)."""
    step = torch.arange(-EDGE, EDGE + 0.25, 0.5, dtype=torch.float64)
    at = pixel[:, None] + (shift[:, None, None] + step[:, None]) * outward[:, None]
    change = [sample(c, at + outward[:, None]) - sample(c, at - outward[:, None]) for c in channels]
    return torch.stack(change).abs().amax(0).amax(1)


def _whitening(covariance: Tensor) -> Tensor:
    return torch.linalg.inv(torch.linalg.cholesky(covariance))


def _pixel(points: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Columns and rows of the nearest pixels of an image (H, W, ...)."""
    x, y = points.round().long().unbind(-1)
    return x.clamp(0, image.shape[1] - 1), y.clamp(0, image.shape[0] - 1)


def _at(mask: Tensor, points: Tensor) -> Tensor:
    x, y = _pixel(points, mask)
    return mask[y, x]
