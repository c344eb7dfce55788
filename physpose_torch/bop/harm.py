"""Whether poses did harm: which objects end up farther from the ground truth than they were estimated."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.matching import gts_by_object, rows_by_object
from physpose_torch.bop.pose_error import mssd

__all__ = ["NOTABLE", "RESAMPLES", "Harm", "Matches", "Share", "harm", "match_acting", "mssd_of", "share"]

NOTABLE = 2e-3
"""[m]; an object whose MSSD grows by more than this is made worse, one whose MSSD falls by more is made better."""
RESAMPLES = 1000
"""Of the images, for an interval."""


class Matches(NamedTuple):
    """Estimates that act, each with the instance that it is held against; (n,) each, in the order of the rows."""

    rows: np.ndarray
    """int64, rows of the estimates."""
    gts: np.ndarray
    """int64, positions in the scene's `GroundTruth`."""
    image: np.ndarray
    """int64, a number for each image."""
    mssd: np.ndarray
    """Of the estimates as they are [m]."""


class Share(NamedTuple):
    """A share of objects, and the 95 % interval of it."""

    value: float
    low: float
    high: float


class Harm(NamedTuple):
    """What became of the objects that were matched."""

    objects: int
    """How many."""
    worse: Share | None
    """Whose MSSD grew by more than `NOTABLE`; None where there are no objects."""
    better: Share | None
    """Whose MSSD fell by more than `NOTABLE`."""


def match_acting(estimates: Estimates, dataset: BopDataset, acts: np.ndarray) -> Matches:
    """Match estimates that act with ground truth instances of their object in their image, targets or not.

    The pair of the smallest MSSD comes first, then the smallest among what is left: each instance and each estimate is
    matched once. Estimates without an instance, false positives say, are not matched. A match is of the estimates as they
    are and stays, however far they are moved.

    Args:
        estimates: rows of a result CSV.
        dataset: where ground truth and models are.
        acts: (rows,) bool, see :func:`physpose_torch.losses.acting`.
    """
    gts_of = gts_by_object(dataset, set(estimates.scene_id[acts].tolist()) & set(dataset.scene_ids))
    pairs: dict[int, list[tuple[int, int, int]]] = {}
    for key, listed in rows_by_object(estimates).items():
        found = [(row, key[0], gt) for row in listed.tolist() if acts[row] for gt in gts_of.get(key, np.empty(0)).tolist()]
        if found:
            pairs.setdefault(key[2], []).extend(found)
    matched: dict[int, tuple[int, float]] = {}
    for obj_id, found in pairs.items():
        rows, scenes, gts = np.array(found).T
        error = _errors(dataset, obj_id, scenes, gts, estimates.T_camera_object[rows])
        taken = set()
        for k in np.argsort(error, kind="stable").tolist():
            row, *instance = found[k]
            if row not in matched and (*instance,) not in taken:
                matched[row] = instance[1], float(error[k])
                taken.add((*instance,))
    rows = np.array(sorted(matched), dtype=np.int64)
    gts, error = np.array([matched[row] for row in rows.tolist()]).reshape(-1, 2).T
    ids = np.stack([estimates.scene_id[rows], estimates.im_id[rows]], axis=1)
    image = np.unique(ids, axis=0, return_inverse=True)[1].reshape(-1)
    return Matches(rows, gts.astype(np.int64), image, error)


def mssd_of(matches: Matches, estimates: Estimates, dataset: BopDataset, poses: Tensor) -> np.ndarray:
    """MSSD (n,) [m] of other poses, T_camera_object (rows, 4, 4) [m], to the instances that the estimates are matched with."""
    out = np.empty(len(matches.rows))
    obj_ids = estimates.obj_id[matches.rows]
    for obj_id in np.unique(obj_ids).tolist():
        of_object = np.flatnonzero(obj_ids == obj_id)
        rows = matches.rows[of_object]
        scenes, gts = estimates.scene_id[rows], matches.gts[of_object]
        out[of_object] = _errors(dataset, obj_id, scenes, gts, poses[rows])
    return out


def harm(matches: Matches, after: np.ndarray, *, chosen: np.ndarray | None = None, seed: int = 0) -> Harm:
    """Shares of the matched objects that were made worse and better.

    Args:
        matches: what is compared.
        after: (n,) MSSD of the new poses, see :func:`mssd_of` [m].
        chosen: (n,) bool, only these objects.
        seed: of the bootstrap.
    """
    chosen = np.ones(len(after), dtype=bool) if chosen is None else chosen
    grown, image = (after - matches.mssd)[chosen], matches.image[chosen]
    return Harm(len(grown), share(grown > NOTABLE, image, seed=seed), share(grown < -NOTABLE, image, seed=seed))


def share(hits: np.ndarray, image: np.ndarray, *, seed: int = 0) -> Share | None:
    """Share of objects, with a bootstrap interval over the images that have some; None without objects.

    Images are drawn with replacement, all scenes together, with all their objects: these are not independent. Where all
    objects are alike the interval is a point, which says less than it seems.

    Args:
        hits: (n,) bool.
        image: (n,) a number for each image.
        seed: of the draws.
    """
    if not len(hits):
        return None
    place = np.unique(image, return_inverse=True)[1]
    total = np.bincount(place)
    count = np.bincount(place, weights=hits)
    drawn = np.random.default_rng(seed).integers(len(total), size=(RESAMPLES, len(total)))
    low, high = np.quantile(count[drawn].sum(1) / total[drawn].sum(1), [0.025, 0.975]).tolist()
    return Share(float(np.mean(hits)), low, high)


def _errors(dataset: BopDataset, obj_id: int, scenes: np.ndarray, gts: np.ndarray, T_est: Tensor) -> np.ndarray:
    pairs = zip(scenes.tolist(), gts.tolist(), strict=True)
    T_gt = torch.stack([dataset.ground_truth(scene_id).T_camera_object[gt] for scene_id, gt in pairs])
    return mssd(T_est, T_gt, dataset.hull(obj_id), dataset.symmetries(obj_id)).numpy()
