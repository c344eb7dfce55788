"""What is left between estimates and ground truth, by direction: along the viewing ray, across it, and in rotation."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.matching import given_poses, gts_by_object, rows_by_object
from physpose_torch.bop.pose_error import over_symmetries

__all__ = ["Distribution", "GroundTruthErrors", "distribution", "errors_against_gt"]


@dataclass(frozen=True, eq=False)
class GroundTruthErrors:
    """How each row differs from the ground truth of its object that is nearest by MSSD; NaN where there is none.

    Both poses are compared at the centre of the object's bounds, under the symmetry that gives the MSSD.
    """

    gt_id: np.ndarray
    """(rows,) int64, position in the image's list in scene_gt.json; -1 where there is none."""
    mssd: np.ndarray
    """(rows,) [m]."""
    along_ray: np.ndarray
    """(rows,) shift along the viewing ray [m], positive if the estimate is too far away."""
    across_ray: np.ndarray
    """(rows,) length of the shift across the viewing ray [m]."""
    rotation: np.ndarray
    """(rows,) angle [rad]; a continuous symmetry in steps of s can add s/2 (0.01 rad for BOP's steps)."""


class Distribution(NamedTuple):
    """Location, spread and histogram of some numbers, in their unit; NaN where there are none."""

    count: int
    median: float
    mean: float
    robust_sigma: float
    """1.4826 times the median absolute deviation: the standard deviation, if they were normally distributed."""
    p5: float
    """5th percentile."""
    p95: float
    """95th percentile."""
    edges: np.ndarray
    """(B + 1,) edges of the bins, even and round; a number on an edge counts above it."""
    counts: np.ndarray
    """(B,) int64."""
    below: int
    """How many are below the first edge."""
    above: int
    """How many are at or above the last edge."""

    def to_dict(self) -> dict[str, Any]:
        """Ready for JSON, null for NaN."""
        plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in self._asdict().items()}
        return {k: None if v != v else v for k, v in plain.items()}


def distribution(values: np.ndarray, *, bins: int = 15, finest: float = 0.1) -> Distribution:
    """Describe numbers; the histogram shows their bulk, what is beyond is only counted.

    The bulk is what is between the 2nd and the 98th percentile and within 4 robust sigma of the median: a few outliers
    would otherwise squeeze all others into one bin.

    Args:
        values: (n,) finite numbers of any unit.
        bins: About so many bins, as many as it takes for round edges.
        finest: No bin is narrower than this, in the unit of the numbers.
    """
    values = np.asarray(values, dtype=np.float64)
    if not len(values):
        return Distribution(0, *[np.nan] * 5, np.array([0.0, 1.0]), np.zeros(1, np.int64), 0, 0)
    low, p5, median, p95, high = np.percentile(values, [2, 5, 50, 95, 98]).tolist()
    sigma = 1.4826 * float(np.median(np.abs(values - median)))
    if sigma > 0:
        low, high = max(low, median - 4 * sigma), min(high, median + 4 * sigma)
    smallest = max((high - low) / bins, finest)
    power = 10.0 ** np.floor(np.log10(smallest))
    step, decimals = (
        next(k for k in (1, 2, 5, 10) if k * power >= 0.999 * smallest) * power,
        max(0, int(-np.log10(power)) + 1),
    )
    first, last = int(np.floor(low / step)), int(np.floor(high / step)) + 1
    edges = np.round(np.arange(first, last + 1) * step, decimals)
    place = np.searchsorted(edges, values, side="right") - 1
    inside = (place >= 0) & (place < len(edges) - 1)
    counts = np.bincount(place[inside], minlength=len(edges) - 1)
    below, above = int((place < 0).sum()), int((place >= len(edges) - 1).sum())
    return Distribution(len(values), median, float(values.mean()), sigma, p5, p95, edges, counts, below, above)


def errors_against_gt(
    estimates: Estimates, dataset: BopDataset, *, poses: Any = None, rows: np.ndarray | None = None
) -> GroundTruthErrors:
    """Compare each row with the nearest ground truth of its object, for reports; targets play no role.

    Args:
        estimates: Rows of a result CSV.
        dataset: Where ground truth and models are.
        poses: T_camera_object, shape (rows, 4, 4) [m], instead of those in `estimates`.
        rows: Only these, (rows,) bool; the others get NaN.
    """
    poses = given_poses(estimates, poses)
    wanted = np.ones(len(estimates), dtype=bool) if rows is None else np.asarray(rows, dtype=bool)
    gts_of = gts_by_object(dataset, set(estimates.scene_id[wanted].tolist()) & set(dataset.scene_ids))
    pairs: dict[int, list[tuple[int, int, int]]] = {}
    for key, listed in rows_by_object(estimates).items():
        of_object = pairs.setdefault(key[2], [])
        of_object += [(key[0], row, gt) for row in listed if wanted[row] for gt in gts_of.get(key, ())]
    gt_id, values = np.full(len(estimates), -1, dtype=np.int64), np.full((4, len(estimates)), np.nan)
    values[0] = np.inf
    for obj_id, listed in pairs.items():
        if not listed:
            continue
        vertices, symmetries = dataset.hull(obj_id), dataset.symmetries(obj_id)
        T_gt = torch.stack([dataset.ground_truth(scene_id).T_camera_object[gt] for scene_id, _, gt in listed])
        T_est = poses[torch.tensor([row for _, row, _ in listed])]
        error, index = over_symmetries(T_est, T_gt, None, vertices, symmetries)
        T_gt = T_gt @ symmetries[index]
        centre = (vertices.amin(0) + vertices.amax(0)) / 2
        at_gt = T_gt[:, :3, :3] @ centre + T_gt[:, :3, 3]
        shift = T_est[:, :3, :3] @ centre + T_est[:, :3, 3] - at_gt
        along = (shift * at_gt).sum(1) / at_gt.norm(dim=1)
        across = (shift - along[:, None] * torch.nn.functional.normalize(at_gt, dim=1)).norm(dim=1)
        chord = (T_est[:, :3, :3] - T_gt[:, :3, :3]).flatten(1).norm(dim=1)  # 2 √2 sin(angle / 2), exact near zero
        angle = 2 * torch.asin((chord / 8**0.5).clamp(max=1))
        for pair, (scene_id, row, gt) in enumerate(listed):
            if error[pair] < values[0, row]:
                values[:, row] = error[pair], along[pair], across[pair], angle[pair]
                gt_id[row] = dataset.ground_truth(scene_id).gt_id[gt]
    values[:, gt_id < 0] = np.nan
    return GroundTruthErrors(gt_id, *values)
