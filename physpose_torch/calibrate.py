"""An estimator's depth bias and spread without labels: from what must be true of objects that stand on a known table.

An object that stands on one of its stable faces fixes two things: how high its centre is above the table, and which
direction is up. Over many images, what the estimates say instead tells how far off they are along the ray, across it and in
rotation. Which objects stand, and which are stacked, leaning or estimated wrongly, is not known and is part of the fit.
"""

import logging
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from physpose_torch.config import Calibration
from physpose_torch.contacts import SUPPORT_SLOPE, plane_variance
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.resting import nearest_rest
from physpose_torch.losses import acting, check_poses
from physpose_torch.scene import Scene

__all__ = ["Observations", "calibrate", "observe"]

LEAST_APART = math.radians(40.0)
"""Stable poses nearer to each other than this tell nothing about an estimate in between."""
WIDEST_TILT = math.radians(20.0)
"""An estimate tilted by more than this is not compared with a stable pose; some are upside down."""
WIDEST_HEIGHT = 0.3
"""[m]; nor one this far above or below the table."""
FACTORS = (0.7, 1.4)
"""Depth factors between which the fit looks."""
LATERAL_GUESS = 0.003
"""[m]; from one direction of view, errors along and across the ray look alike: a weak guess, by a factor of e, decides then."""
STARTS = 4
"""Best depth factors of a grid, from each of which a fit is tried."""
CONTACT = 0.0005
"""[m]; scans and tables are not flatter than this."""
NODES = 41
"""Values of an image's own depth factor over which the likelihood is summed, ± 4 σ."""
LEAST_OBSERVATIONS = 10
"""Fewer objects than this give no spread to speak of."""
LEAST_STANDING = 0.25
"""A smaller share of standing objects than this is told, and …"""
WIDEST_SCATTER = 0.08
"""… a larger σ along the ray, as a fraction of the range, than this."""

NAMES = ("depth_factor", "sigma_ray_fraction", "sigma_depth_common", "sigma_lateral", "sigma_rotation")
"""What is fitted, as logarithms; then the logits of the shares that stand on something else, or not as estimated."""
LIMITS = (*np.log([FACTORS, (1e-3, 0.3), (1e-4, 0.3), (5e-4, 0.1), (3e-3, 0.3)]).tolist(), (-6.0, 6.0), (-6.0, 6.0))

logger = logging.getLogger("physpose_torch")


class Observations(NamedTuple):
    """What is known of the objects that may stand on the table, one row each."""

    group: Tensor
    """(M,) long, which image; errors of one image may have a depth factor in common."""
    rise: Tensor
    """(M,) height of the centre above where it belongs, at the estimated translation [m]."""
    reach: Tensor
    """(M,) n·t: how the rise changes with the depth factor [m], negative."""
    slope: Tensor
    """(M,) sine of the angle between viewing ray and plane."""
    range: Tensor
    """(M,) distance of the centre from the camera [m]."""
    tilt: Tensor
    """(M,) angle between the estimated and the stable pose [rad]."""
    variance: Tensor
    """(M,) of the plane's height there [m²]."""
    images: int
    """All that were looked at; some have no row."""

    @classmethod
    def cat(cls, parts: Iterable["Observations"]) -> "Observations":
        """Observations of many batches."""
        parts = list(parts)
        start = np.cumsum([0, *(p.images for p in parts)]).tolist()
        columns = [torch.cat([p[k] for p in parts]) if parts else torch.zeros(0) for k in range(1, 7)]
        group = torch.cat([p.group + s for p, s in zip(parts, start, strict=False)]) if parts else torch.zeros(0)
        return cls(group.long(), *columns, start[-1])


def observe(poses: Tensor, scene: Scene, *, scores: Tensor | None = None) -> Observations:
    """What a scene's estimates say about objects that may stand on its planes.

    Args:
        poses: T̃_camera_object (N, 4, 4) [m], as the estimator gave them.
        scene: objects with planes and gravity, of one or many images. Planes that gravity does not point into are left out.
        scores: (N,), see :class:`~physpose_torch.losses.PhysicsLoss`; alternatives that act on nothing are not asked.

    Raises:
        InvalidInputError: shapes, NaN or non-rigid poses.
    """
    poses = check_poses(poses, scene).detach().double().cpu()
    if poses.ndim != 3:
        raise InvalidInputError(f"poses have shape {tuple(poses.shape)}, expected (N, 4, 4)")
    acts = acting(scene, scores)
    who, plane = scene.plane_pairs.unbind(1)
    normal, offset = scene.plane_normal.detach()[plane], scene.plane_offset.detach()[plane]
    level = (normal * scene.gravity.detach()[scene.image[who]]).sum(1) <= -SUPPORT_SLOPE
    keep = acts[who] & level
    who, plane, normal, offset = who[keep], plane[keep], normal[keep], offset[keep]
    variance = plane_variance(poses, scene, who, plane, acts)
    up = (poses[who, :3, :3].mT @ normal[:, :, None])[:, :, 0]
    tilt, _, height, apart = nearest_rest([scene.objects[i] for i in who.tolist()], up)
    center = scene.centers(poses)[who]
    level = (normal * center).sum(1)
    distance = torch.linalg.vector_norm(center, dim=1)
    rise = level - offset - height
    reach = (normal * poses[who, :3, 3]).sum(1)
    told = (tilt < WIDEST_TILT) & (apart > LEAST_APART) & (rise.abs() < WIDEST_HEIGHT)
    # of several planes an object is above, it is the nearest one's
    nearest = rise.new_full((len(scene),), torch.inf).scatter_reduce(0, who[told], rise[told].abs(), "amin")
    told &= rise.abs() <= nearest[who]
    columns = (scene.image[who], rise, reach, -level / distance, distance, tilt, variance)
    return Observations(*(x[told] for x in columns), scene.n_images)


def calibrate(
    observations: Observations,
    *,
    cluster: Tensor | None = None,
    resamples: int = 50,
    seed: int = 0,
    on_resample: Callable[[], None] = lambda: None,
) -> Calibration:
    """The estimator's depth factor and spread that explain the observations best (maximum likelihood).

    Each object stands as estimated, off by normal errors of the depth factor (its own and its image's), of the place across
    the ray, of rotation and of the plane; or it stands on something else, at any height; or it is leaning or wrong
    altogether, at any height and tilt. From one direction of view, errors along and across the ray look alike; there a weak
    guess decides (3 mm across, give or take a factor of e).

    Args:
        observations: of many images, see :func:`observe`.
        cluster: (images,) long; images of one number are not independent (frames of one video, say). None: all are.
        resamples: of the bootstrap that the 95 % intervals come from.
        seed: of the bootstrap.
        on_resample: called after each.

    Raises:
        InvalidInputError: fewer than 10 objects that may stand on a plane, or ``cluster`` has another length.
    """
    with torch.inference_mode(False), torch.enable_grad():
        o = Observations(*(x.clone() if isinstance(x, Tensor) else x for x in observations))
        return _calibrate(o, cluster, resamples, seed, on_resample)


def _calibrate(
    o: Observations, cluster: Tensor | None, resamples: int, seed: int, on_resample: Callable[[], None]
) -> Calibration:
    if cluster is not None and cluster.shape != (o.images,):
        raise InvalidInputError(f"cluster has shape {tuple(cluster.shape)}, expected ({o.images},), one number an image")
    if len(o.rise) < LEAST_OBSERVATIONS:
        raise InvalidInputError(
            f"only {len(o.rise)} of the estimates, in {o.images} images, may stand upright on a plane; a calibration needs "
            f"{LEAST_OBSERVATIONS} or more: more images, or planes in the frame of the poses"
        )
    weight = torch.ones(o.images, dtype=torch.float64)
    # several maxima: standing objects may be taken for stacked ones
    guesses = np.linspace(*np.log(FACTORS), 141)
    starts = [np.array([guess, *np.log([0.01, 0.005, LATERAL_GUESS, 0.04]), -1.0, -2.0]) for guess in guesses]
    starts.sort(key=lambda x: float(_surprise(torch.from_numpy(x), o, weight)))
    # a fit may leap away from where it starts
    fits = [starts[0], *(_fit(x, o, weight) for x in starts[:STARTS])]
    best = min(fits, key=lambda x: float(_surprise(torch.from_numpy(x), o, weight)))
    standing, scatter = 1 / (1 + np.exp(best[5:]).sum()), math.exp(best[1])
    if standing < LEAST_STANDING or scatter > WIDEST_SCATTER:
        logger.warning(
            "only %.0f %% of the objects stand on their planes after calibration, and they scatter by %.1f %% of their range; "
            "do planes and poses belong to the same images?",
            100 * standing,
            100 * scatter,
        )
    generator = np.random.default_rng(seed)
    cluster = np.arange(o.images) if cluster is None else np.unique(cluster.numpy(), return_inverse=True)[1]
    members = [np.flatnonzero(cluster == c) for c in range(cluster.max() + 1)]
    again = []
    for _ in range(resamples):
        drawn = generator.integers(len(members), size=len(members))
        images = np.concatenate([generator.choice(members[c], len(members[c])) for c in drawn])
        weight = torch.from_numpy(np.bincount(images, minlength=o.images).astype(np.float64))
        again.append(_fit(best, o, weight))
        on_resample()
    # log-normal: half of the values are as few as a percentile of so few would use
    spread = np.std(again, axis=0, ddof=1) if resamples > 1 else np.full(len(best), np.nan)
    low, high = np.exp(best - 1.96 * spread), np.exp(best + 1.96 * spread)
    interval = {name: (float(low[k]), float(high[k])) for k, name in enumerate(NAMES)} if resamples > 1 else {}
    return Calibration(**{name: float(np.exp(best[k])) for k, name in enumerate(NAMES)}, interval=interval)


def _fit(x: np.ndarray, o: Observations, weight: Tensor) -> np.ndarray:
    def surprise(x: np.ndarray) -> tuple[float, np.ndarray]:
        leaf = torch.tensor(x, requires_grad=True)
        value = _surprise(leaf, o, weight)
        value.backward()
        return value.item(), leaf.grad.numpy()

    return minimize(surprise, x, jac=True, method="L-BFGS-B", bounds=LIMITS).x


def _surprise(x: Tensor, o: Observations, weight: Tensor) -> Tensor:
    """Negative log-likelihood of the parameters; images count ``weight`` times."""
    factor, (own, common, lateral, rotation) = x[0].exp(), x[1:5].exp()
    stand, stack, wrong = torch.log_softmax(torch.cat([x.new_zeros(1), x[5:]]), 0)
    rise = o.rise + (factor - 1.0) * o.reach
    lever = o.slope * o.range * factor
    variance = (own * lever) ** 2 + lateral**2 * (1 - o.slope**2) + CONTACT**2
    # an image's plane, like its depth factor, is off for all of its objects alike: summed over
    together = ((common * lever) ** 2 + o.variance).sqrt()
    node = torch.linspace(-4.0, 4.0, NODES, dtype=x.dtype)
    shifted = rise[:, None] + node * together[:, None]
    height = -0.5 * (shifted**2 / variance[:, None] + torch.log(2 * math.pi * variance)[:, None])
    tilt = -0.5 * (o.tilt / rotation) ** 2 - 2 * torch.log(rotation)  # both over sin(tilt)
    anywhere = -math.log(2 * WIDEST_HEIGHT)
    any_tilt = -math.log(1 - math.cos(WIDEST_TILT))
    off = torch.logaddexp(stack + anywhere + tilt, wrong + anywhere + any_tilt)
    each = torch.logaddexp(stand + height + tilt[:, None], off[:, None].expand_as(height))
    image = x.new_zeros(o.images, NODES).index_add(0, o.group, each)
    guess = 0.5 * (x[3] - math.log(LATERAL_GUESS)) ** 2
    return guess - (weight * torch.logsumexp(image + torch.log_softmax(-0.5 * node**2, 0), 1)).sum()
