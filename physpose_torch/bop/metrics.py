"""Scores by the rules of BOP19: recalls of MSSD, MSPD and VSD, and their averages.

Source: Hodaň et al., BOP Challenge 2020 on 6D Object Localization, sections 2.2 to 2.4; BOP toolkit,
`eval_calc_scores.py`.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates
from physpose_torch.bop.matching import TargetGroup, given_poses, match_greedily, target_groups
from physpose_torch.bop.pose_error import mspd, mssd
from physpose_torch.bop.residuals import GroundTruthErrors, errors_against_gt
from physpose_torch.bop.vsd import VSD_TAUS, VSD_THRESHOLDS, VsdDepth, target_vsd

__all__ = [
    "MSPD_THRESHOLDS",
    "MSSD_THRESHOLDS",
    "VSD_TAUS",
    "VSD_THRESHOLDS",
    "GroundTruthErrors",
    "Recall",
    "Scores",
    "VsdScore",
    "errors_against_gt",
    "evaluate",
    "match_greedily",
    "mspd",
    "mssd",
]

MSSD_THRESHOLDS = np.arange(1, 11) / 20
"""Fractions of the object's diameter below which an MSSD is correct: 0.05 to 0.5."""
MSPD_THRESHOLDS = np.arange(5.0, 51.0, 5.0)
"""Pixels of an image 640 px wide below which an MSPD is correct: 5 to 50."""

_log = logging.getLogger("physpose_torch")


class Recall(NamedTuple):
    """Average recalls over some of the targets, and how many targets these are."""

    ar_mssd: float
    ar_mspd: float
    targets: int
    ar_vsd: float | None = None
    """Over those targets that have a test depth (`VsdScore` counts them); None where none has."""


@dataclass(frozen=True, eq=False)
class VsdScore:
    """The VSD part of `Scores`, over the targets that have a test depth."""

    depth: VsdDepth
    """Where the test depth is from: `auto` for the dataset's depth images, or `rendered`."""
    ar: float
    """Mean of `recall`."""
    recall: np.ndarray
    """(10, 10) recall at each of `VSD_TAUS` (rows) and `VSD_THRESHOLDS`."""
    targets: int
    """Number of instances to be found in images with a test depth."""
    images: int
    """Number of images with a test depth, among those with targets."""
    per_object: dict[int, int]
    """`targets` by obj_id, where there are some."""
    per_scene: dict[int, int]
    """`targets` by scene_id, where there are some."""
    vsd: np.ndarray
    """(rows, 10) lowest VSD to a ground truth that counts, at each of `VSD_TAUS`; NaN where not scored."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of an estimator on a dataset; the arrays by row are in the order of the estimates.

    A row has NaN (and -1) where it was not scored: its object is no target there, or better rows fill all places.
    """

    ar_mssd: float
    """Mean of `recall_mssd`."""
    ar_mspd: float
    """Mean of `recall_mspd`."""
    recall_mssd: np.ndarray
    """(10,) recall at each of `MSSD_THRESHOLDS`."""
    recall_mspd: np.ndarray
    """(10,) recall at each of `MSPD_THRESHOLDS`."""
    targets: int
    """Number of instances to be found, the denominator of all recalls but that of VSD."""
    per_object: dict[int, Recall]
    """By obj_id."""
    per_scene: dict[int, Recall]
    """By scene_id."""
    mssd: np.ndarray
    """(rows,) lowest MSSD to a ground truth that counts [m]."""
    mspd: np.ndarray
    """(rows,) lowest MSPD to a ground truth that counts [px at an image width of 640]."""
    gt_mssd: np.ndarray
    """(rows, 10) int64, the ground truth (gt_id) matched at each MSSD threshold, -1 if none."""
    gt_mspd: np.ndarray
    """(rows, 10) int64, the ground truth (gt_id) matched at each MSPD threshold, -1 if none."""
    per_image: dict[tuple[int, int], Recall]
    """By (scene_id, im_id)."""
    vsd: VsdScore | None = None
    """None if VSD was not asked for, or no image has a test depth."""

    @property
    def ar_vsd(self) -> float | None:
        """Average recall of VSD over the targets that have a test depth; None if none has."""
        return None if self.vsd is None else self.vsd.ar

    @property
    def ar(self) -> float | None:
        """BOP's average recall, the mean of those of VSD, MSSD and MSPD; None unless VSD is over all targets."""
        if self.vsd is None or self.vsd.targets < self.targets:
            return None
        return (self.vsd.ar + self.ar_mssd + self.ar_mspd) / 3

    def to_dict(self) -> dict[str, Any]:
        """The scores without the arrays by row and without single images, ready for JSON."""
        content: dict[str, Any] = {
            "ar": self.ar,
            "ar_vsd": self.ar_vsd,
            "ar_mssd": self.ar_mssd,
            "ar_mspd": self.ar_mspd,
            "targets": self.targets,
            "recall_mssd": _by(MSSD_THRESHOLDS, self.recall_mssd.tolist()),
            "recall_mspd": _by(MSPD_THRESHOLDS, self.recall_mspd.tolist()),
            "recall_vsd": None,
            "per_object": {key: recall._asdict() for key, recall in self.per_object.items()},
            "per_scene": {key: recall._asdict() for key, recall in self.per_scene.items()},
        }
        if self.vsd is not None:
            content["recall_vsd"] = _by(VSD_TAUS, [_by(VSD_THRESHOLDS, row) for row in self.vsd.recall.tolist()])
            content["vsd"] = {"depth": self.vsd.depth, "targets": self.vsd.targets, "images": self.vsd.images}
            for kind, counts in (("per_object", self.vsd.per_object), ("per_scene", self.vsd.per_scene)):
                for key, recall in content[kind].items():
                    recall["vsd_targets"] = counts.get(key, 0)
        return content


def evaluate(
    estimates: Estimates,
    dataset: BopDataset,
    *,
    poses: Any = None,
    scenes: Iterable[int] | None = None,
    vsd_depth: VsdDepth = "none",
    on_image: Callable[[], Any] | None = None,
) -> Scores:
    """Score estimates by the rules of BOP19 (6D localization of a varying number of instances).

    For each target, as many estimates as there are instances to be found, those of highest score, are matched to the
    same number of most visible ground truths; ties go by order. Rows for what is no target do not count.

    Args:
        estimates: Rows of a result CSV.
        dataset: Where targets, ground truth, cameras and models are.
        poses: T_camera_object, shape (rows, 4, 4) [m], instead of those in `estimates`.
        scenes: Only the targets of these scenes.
        vsd_depth: What VSD compares with. `none`: no VSD. `auto`: the dataset's depth images, for the targets whose
            image has one. `rendered`: all annotated objects of the image in their ground-truth poses, background
            unknown; such a VSD tells nothing about the sensor, and does not compare with official figures.
        on_image: Called whenever VSD is done with an image, for a progress bar.

    Raises:
        DataError: Ground truth, cameras, models or depth images of a target are missing or broken.
        InvalidInputError: No target is left, or poses have the wrong shape.
    """
    poses = given_poses(estimates, poses)
    groups = target_groups(estimates, dataset, scenes=scenes)
    if len(estimates) and not any(len(group.rows) for group in groups):
        _log.warning("no row of %s belongs to a target of %s", estimates.path, dataset)
    point_errors = _point_errors(dataset, groups, poses)
    vsd_errors = target_vsd(dataset, groups, poses, depth=vsd_depth, on_image=on_image)

    count, best = len(estimates), np.full((2, len(estimates)), np.nan)
    best_vsd = np.full((count, len(VSD_TAUS)), np.nan)
    gt_ids = np.full((2, count, len(MSSD_THRESHOLDS)), -1, dtype=np.int64)
    hits = np.zeros((2, len(groups), len(MSSD_THRESHOLDS)))
    vsd_hits = np.zeros((len(groups), len(VSD_TAUS), len(VSD_THRESHOLDS)))
    for index, (target, rows, gts) in enumerate(groups):
        if not len(rows):
            continue
        ids = dataset.ground_truth(target.scene_id).gt_id[gts]
        diameter = dataset.diameter(target.obj_id)
        for kind, unit, thresholds in ((0, diameter, MSSD_THRESHOLDS), (1, 1.0, MSPD_THRESHOLDS)):
            error = point_errors[index][kind]
            best[kind, rows] = error.min(1)
            matched = match_greedily(error / unit, thresholds).T
            gt_ids[kind, rows] = np.where(matched >= 0, ids[matched], -1)
            hits[kind, index] = (matched >= 0).sum(0)
        if (errors := vsd_errors[index]) is not None:
            best_vsd[rows] = errors.min(1)
            for tau in range(len(VSD_TAUS)):
                vsd_hits[index, tau] = (match_greedily(errors[..., tau], VSD_THRESHOLDS) >= 0).sum(1)
    wanted = np.array([group.target.inst_count for group in groups])
    covered = np.array([errors is not None for errors in vsd_errors])

    def recall(chosen: np.ndarray) -> Recall:
        total, with_depth = int(wanted[chosen].sum()), chosen[covered[chosen]]
        ar_mssd, ar_mspd = (hits[:, chosen].sum(1).mean(1) / max(total, 1)).tolist()
        total_vsd = max(int(wanted[with_depth].sum()), 1)
        ar_vsd = float(vsd_hits[with_depth].sum(0).mean() / total_vsd) if len(with_depth) else None
        return Recall(ar_mssd, ar_mspd, total, ar_vsd)

    whole = recall(np.arange(len(groups)))
    by_object, by_scene = (_places(groups, key) for key in ("obj_id", "scene_id"))
    by_image = _places(groups, "scene_id", "im_id")
    vsd = None
    if whole.ar_vsd is not None:
        counts = [{k: int(wanted[p[covered[p]]].sum()) for k, p in by.items()} for by in (by_object, by_scene)]
        counts = [{k: n for k, n in count.items() if n} for count in counts]
        targets, images = int(wanted[covered].sum()), sum(bool(covered[p].any()) for p in by_image.values())
        vsd_recall = vsd_hits.sum(0) / max(targets, 1)
        vsd = VsdScore(vsd_depth, whole.ar_vsd, vsd_recall, targets, images, *counts, best_vsd)
    recalls = hits.sum(1) / max(whole.targets, 1)
    return Scores(
        ar_mssd=whole.ar_mssd,
        ar_mspd=whole.ar_mspd,
        recall_mssd=recalls[0],
        recall_mspd=recalls[1],
        targets=whole.targets,
        per_object={key: recall(places) for key, places in by_object.items()},
        per_scene={key: recall(places) for key, places in by_scene.items()},
        mssd=best[0],
        mspd=best[1],
        gt_mssd=gt_ids[0],
        gt_mspd=gt_ids[1],
        per_image={key: recall(places) for key, places in by_image.items()},
        vsd=vsd,
    )


def _by(thresholds: np.ndarray, values: list) -> dict[float, Any]:
    return dict(zip(thresholds.tolist(), values, strict=True))


def _places(groups: list[TargetGroup], *keys: str) -> dict[Any, np.ndarray]:
    """Indices of the groups by one or several ids, ascending."""
    places: dict[Any, list[int]] = {}
    for index, group in enumerate(groups):
        key = tuple(getattr(group.target, key) for key in keys)
        places.setdefault(key if len(keys) > 1 else key[0], []).append(index)
    return {key: np.array(places[key]) for key in sorted(places)}


def _point_errors(dataset: BopDataset, groups: list[TargetGroup], poses: torch.Tensor) -> list[np.ndarray]:
    """MSSD [m] and MSPD [px at 640] of each group, (2, E, G); all groups of an object at once."""
    errors = [np.empty((2, len(group.rows), len(group.gts))) for group in groups]
    for obj_id, places in _places(groups, "obj_id").items():
        T_est, T_gt, K, width = [], [], [], []
        for target, rows, gts in (groups[place] for place in places):
            pairs = len(rows) * len(gts)
            if pairs:
                T_est.append(poses[torch.from_numpy(rows.repeat(len(gts)))])
                T_gt.append(dataset.ground_truth(target.scene_id).T_camera_object[gts].repeat(len(rows), 1, 1))
                K.append(dataset.camera(target.scene_id, target.im_id).K.expand(pairs, 3, 3))
                width.append(torch.full((pairs,), dataset.image_width(target.scene_id), dtype=torch.float64))
        if not T_est:
            continue
        T_est, T_gt = torch.cat(T_est), torch.cat(T_gt)
        symmetries = dataset.symmetries(obj_id)
        surface = mssd(T_est, T_gt, dataset.hull(obj_id), symmetries)
        pixels = mspd(T_est, T_gt, torch.cat(K), dataset.vertices(obj_id), symmetries) * (640 / torch.cat(width))
        both, start = torch.stack([surface, pixels]).numpy(), 0
        for place in places:
            size = errors[place][0].size
            errors[place][:] = both[:, start : start + size].reshape(errors[place].shape)
            start += size
    return errors
