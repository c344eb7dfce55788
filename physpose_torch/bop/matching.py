"""Which estimates are compared with which ground truths, by the rules of BOP19 for a varying number of instances.

Source: Hodaň et al., BOP Challenge 2020 on 6D Object Localization, section 2.4; BOP toolkit, `pose_matching.py`.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates, Target
from physpose_torch.errors import DataError, InvalidInputError

__all__ = ["TargetGroup", "given_poses", "gts_by_object", "match_greedily", "rows_by_object", "target_groups"]

Key = tuple[int, int, int]


class TargetGroup(NamedTuple):
    """A target with what competes for it."""

    target: Target
    rows: np.ndarray
    """(E,) rows of the estimates by falling score, at most as many as there are instances to be found."""
    gts: np.ndarray
    """(G,) the most visible instances, positions in the scene's `GroundTruth`."""


def target_groups(
    estimates: Estimates, dataset: BopDataset, *, scenes: Iterable[int] | None = None
) -> list[TargetGroup]:
    """The targets of a dataset, each with its estimates and ground truths; ties in score or visibility go by order.

    Args:
        estimates: Rows of a result CSV; rows for what is no target are left out.
        dataset: Where targets and ground truth are.
        scenes: Only the targets of these scenes.

    Raises:
        DataError: Ground truth of a target is missing.
        InvalidInputError: No target is left.
    """
    scenes = None if scenes is None else {int(scene) for scene in scenes}
    targets = [target for target in dataset.targets if scenes is None or target.scene_id in scenes]
    if not targets:
        raise InvalidInputError(f"{dataset} has no targets in scenes {'(all)' if scenes is None else sorted(scenes)}")
    if missing := sorted({target.scene_id for target in targets} - set(dataset.scene_ids)):
        raise DataError(f"targets ask for scenes {missing}, not in {dataset.split_path}; choose scenes or targets")
    rows_of, gts_of = rows_by_object(estimates), gts_by_object(dataset, {target.scene_id for target in targets})
    none = np.empty(0, np.int64)
    groups = []
    for target in targets:
        rows = rows_of.get(target[:3], none)[: target.inst_count]
        groups.append(TargetGroup(target, rows, _most_visible(dataset, target, gts_of.get(target[:3], none))))
    return groups


def match_greedily(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Match estimates to ground truths at each threshold: one after the other takes the lowest error still free.

    Args:
        errors: Shape (E, G), the estimates in the order of falling score.
        thresholds: Shape (H,); an error must be strictly lower.

    Returns:
        Shape (H, E) int64, the index of the ground truth, -1 if none.
    """
    rows, free = np.arange(len(thresholds)), np.ones((len(thresholds), errors.shape[1]), dtype=bool)
    matched = np.full((len(thresholds), len(errors)), -1, dtype=np.int64)
    if not errors.size:
        return matched
    for index, error in enumerate(errors):
        open_error = np.where(free, error, np.inf)
        best = open_error.argmin(1)
        found = open_error[rows, best] < thresholds
        matched[found, index] = best[found]
        free[rows[found], best[found]] = False
    return matched


def given_poses(estimates: Estimates, poses: Any) -> torch.Tensor:
    """The poses to judge, (rows, 4, 4) float64 [m]: those given, or else those of the file.

    Raises:
        InvalidInputError: There is not one pose for each row.
    """
    if poses is None:
        return estimates.T_camera_object
    poses = torch.as_tensor(poses).detach().to("cpu", torch.float64)
    if poses.shape != (len(estimates), 4, 4):
        raise InvalidInputError(f"poses have shape {tuple(poses.shape)}, expected ({len(estimates)}, 4, 4)")
    return poses


def rows_by_object(estimates: Estimates) -> dict[Key, np.ndarray]:
    """Rows by (scene, image, object), each in the order of falling score, ties in file order."""
    groups: dict[Key, list[int]] = {}
    ids = (estimates.scene_id.tolist(), estimates.im_id.tolist(), estimates.obj_id.tolist())
    columns = list(zip(*ids, strict=True))
    for row in np.argsort(-estimates.score, kind="stable").tolist():
        groups.setdefault(columns[row], []).append(row)
    return {key: np.array(rows) for key, rows in groups.items()}


def gts_by_object(dataset: BopDataset, scenes: Iterable[int]) -> dict[Key, np.ndarray]:
    """Positions in the scene's `GroundTruth` by (scene, image, object)."""
    groups: dict[Key, list[int]] = {}
    for scene_id in sorted(scenes):
        gt = dataset.ground_truth(scene_id)
        for index, key in enumerate(zip(gt.im_id.tolist(), gt.obj_id.tolist(), strict=True)):
            groups.setdefault((scene_id, *key), []).append(index)
    return {key: np.array(rows) for key, rows in groups.items()}


def _most_visible(dataset: BopDataset, target: Target, gts: np.ndarray) -> np.ndarray:
    place = f"scene {target.scene_id}, image {target.im_id}, object {target.obj_id}"
    if len(gts) < target.inst_count:
        counts = f"targets ask for {target.inst_count} instances, scene_gt.json has {len(gts)}"
        raise DataError(f"{place}: {counts}; do targets and ground truth belong together?")
    if len(gts) == target.inst_count:
        return gts
    visible = dataset.ground_truth(target.scene_id).visib_fract[gts]
    if np.isnan(visible).any():
        raise DataError(f"{place}: scene_gt_info.json does not tell which of {len(gts)} instances are the most visible")
    return np.sort(gts[np.argsort(-visible, kind="stable")[: target.inst_count]])
