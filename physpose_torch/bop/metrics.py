"""Pose errors and scores by the rules of BOP19: MSSD, MSPD, their recalls and average recalls.

Source: Hodaň et al., BOP Challenge 2020 on 6D Object Localization, sections 2.2 to 2.4; BOP toolkit, `pose_error.py`,
`pose_matching.py`, `eval_calc_scores.py`.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates
from physpose_torch.errors import DataError, InvalidInputError

__all__ = [
    "MSPD_THRESHOLDS",
    "MSSD_THRESHOLDS",
    "GroundTruthErrors",
    "Recall",
    "Scores",
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

_CHUNK = 30_000  # points in work at once: stays in the cache, and too few for torch to wake up other threads
_log = logging.getLogger("physpose_torch")


class Recall(NamedTuple):
    """Average recalls over some of the targets, and how many targets these are."""

    ar_mssd: float
    ar_mspd: float
    targets: int


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
    """Number of instances to be found, the denominator of all recalls."""
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

    def to_dict(self) -> dict[str, Any]:
        """The scores without the arrays by row, ready for JSON."""
        return {
            "ar_mssd": self.ar_mssd,
            "ar_mspd": self.ar_mspd,
            "targets": self.targets,
            "recall_mssd": dict(zip(MSSD_THRESHOLDS.tolist(), self.recall_mssd.tolist(), strict=True)),
            "recall_mspd": dict(zip(MSPD_THRESHOLDS.tolist(), self.recall_mspd.tolist(), strict=True)),
            "per_object": {key: recall._asdict() for key, recall in self.per_object.items()},
            "per_scene": {key: recall._asdict() for key, recall in self.per_scene.items()},
        }


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


def mssd(T_est: torch.Tensor, T_gt: torch.Tensor, vertices: torch.Tensor, symmetries: torch.Tensor) -> torch.Tensor:
    """Maximum symmetry-aware surface distance: min over symmetries S of max over x of ‖T_est x − T_gt S x‖.

    Args:
        T_est: T_camera_object, shape (..., 4, 4) [m].
        T_gt: T_camera_object, shape (..., 4, 4) [m].
        vertices: Model points x, object frame, shape (V, 3) [m]. The distance is convex in x, so the vertices of the
            convex hull are enough.
        symmetries: S, shape (S, 4, 4) [m].

    Returns:
        Shape (...) [m].
    """
    return _over_symmetries(T_est, T_gt, None, vertices, symmetries)[0]


def mspd(
    T_est: torch.Tensor, T_gt: torch.Tensor, K: torch.Tensor, vertices: torch.Tensor, symmetries: torch.Tensor
) -> torch.Tensor:
    """Maximum symmetry-aware projection distance: min over S of max over x of ‖proj(T_est x) − proj(T_gt S x)‖.

    Unlike for `mssd`, points inside the convex hull matter: the distance is not convex in x.

    Args:
        T_est: T_camera_object, shape (..., 4, 4) [m].
        T_gt: T_camera_object, shape (..., 4, 4) [m].
        K: Cameras, shape (..., 3, 3) [px].
        vertices: Model points x, object frame, shape (V, 3) [m].
        symmetries: S, shape (S, 4, 4) [m].

    Returns:
        Shape (...) [px]; infinite where a point lies in the plane of the camera's centre.
    """
    return _over_symmetries(T_est, T_gt, K, vertices, symmetries)[0]


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


def evaluate(
    estimates: Estimates, dataset: BopDataset, *, poses: Any = None, scenes: Iterable[int] | None = None
) -> Scores:
    """Score estimates by the rules of BOP19 (6D localization of a varying number of instances).

    For each target, as many estimates as there are instances to be found, those of highest score, are matched to the
    same number of most visible ground truths; ties go by order. Rows for what is no target do not count.

    Args:
        estimates: Rows of a result CSV.
        dataset: Where targets, ground truth, cameras and models are.
        poses: T_camera_object, shape (rows, 4, 4) [m], instead of those in `estimates`.
        scenes: Only the targets of these scenes.

    Raises:
        DataError: Ground truth, cameras or models of a target are missing.
        InvalidInputError: No target is left, or poses have the wrong shape.
    """
    poses = _poses(estimates, poses)
    scenes = None if scenes is None else {int(scene) for scene in scenes}
    targets = [target for target in dataset.targets if scenes is None or target.scene_id in scenes]
    if not targets:
        raise InvalidInputError(f"{dataset} has no targets in scenes {'(all)' if scenes is None else sorted(scenes)}")
    if missing := sorted({target.scene_id for target in targets} - set(dataset.scene_ids)):
        raise DataError(f"targets ask for scenes {missing}, not in {dataset.split_path}; choose scenes or targets")
    rows_of, gts_of = _groups(estimates), _gt_groups(dataset, {target.scene_id for target in targets})
    groups, pairs = [], {}
    for target in targets:
        rows = rows_of.get(target[:3], np.empty(0, np.int64))[: target.inst_count]
        gts = _most_visible(dataset, target, gts_of.get(target[:3], np.empty(0, np.int64)))
        start = len(pairs.setdefault(target.obj_id, []))
        pairs[target.obj_id] += [(target.scene_id, row, gt) for row in rows for gt in gts]
        groups.append((target, rows, gts, start))
    if len(estimates) and not any(pairs.values()):
        _log.warning("no row of %s belongs to a target of %s", estimates.path, dataset)
    errors = {obj_id: _pair_errors(dataset, obj_id, listed, poses) for obj_id, listed in pairs.items()}

    count, best = len(estimates), np.full((2, len(estimates)), np.nan)
    gt_ids = np.full((2, count, len(MSSD_THRESHOLDS)), -1, dtype=np.int64)
    hits = np.zeros((2, len(groups), len(MSSD_THRESHOLDS)))
    for index, (target, rows, gts, start) in enumerate(groups):
        if not len(rows):
            continue
        ids = dataset.ground_truth(target.scene_id).gt_id[gts]
        diameter = dataset.diameter(target.obj_id)
        for kind, unit, thresholds in ((0, diameter, MSSD_THRESHOLDS), (1, 1.0, MSPD_THRESHOLDS)):
            error = errors[target.obj_id][kind, start : start + len(rows) * len(gts)].reshape(len(rows), len(gts))
            best[kind, rows] = error.min(1)
            matched = match_greedily(error / unit, thresholds).T
            gt_ids[kind, rows] = np.where(matched >= 0, ids[matched], -1)
            hits[kind, index] = (matched >= 0).sum(0)
    wanted = np.array([target.inst_count for target in targets])

    def recall(chosen: np.ndarray) -> Recall:
        total = int(wanted[chosen].sum())
        return Recall(*(hits[:, chosen].sum(1).mean(1) / max(total, 1)).tolist(), total)

    def split(key: Callable) -> dict[int, Recall]:
        keys = np.array([key(target) for target in targets])
        return {int(value): recall(keys == value) for value in np.unique(keys)}

    whole = recall(np.ones(len(targets), dtype=bool))
    recalls = hits.sum(1) / max(whole.targets, 1)
    return Scores(
        ar_mssd=whole.ar_mssd,
        ar_mspd=whole.ar_mspd,
        recall_mssd=recalls[0],
        recall_mspd=recalls[1],
        targets=whole.targets,
        per_object=split(lambda target: target.obj_id),
        per_scene=split(lambda target: target.scene_id),
        mssd=best[0],
        mspd=best[1],
        gt_mssd=gt_ids[0],
        gt_mspd=gt_ids[1],
    )


def errors_against_gt(estimates: Estimates, dataset: BopDataset, *, poses: Any = None) -> GroundTruthErrors:
    """Compare each row with the nearest ground truth of its object, for reports; targets play no role.

    Args:
        estimates: Rows of a result CSV.
        dataset: Where ground truth and models are.
        poses: T_camera_object, shape (rows, 4, 4) [m], instead of those in `estimates`.
    """
    poses = _poses(estimates, poses)
    gts_of = _gt_groups(dataset, set(estimates.scene_id.tolist()) & set(dataset.scene_ids))
    pairs: dict[int, list[tuple[int, int, int]]] = {}
    for key, rows in _groups(estimates).items():
        pairs.setdefault(key[2], []).extend((key[0], row, gt) for row in rows for gt in gts_of.get(key, ()))
    gt_id, values = np.full(len(estimates), -1, dtype=np.int64), np.full((4, len(estimates)), np.nan)
    values[0] = np.inf
    for obj_id, listed in pairs.items():
        if not listed:
            continue
        vertices, symmetries = dataset.vertices(obj_id), dataset.symmetries(obj_id)
        T_est, T_gt = _pair_poses(dataset, listed, poses)
        error, index = _over_symmetries(T_est, T_gt, None, _hull(vertices), symmetries)
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


def _poses(estimates: Estimates, poses: Any) -> torch.Tensor:
    if poses is None:
        return estimates.T_camera_object
    poses = torch.as_tensor(poses).detach().to("cpu", torch.float64)
    if poses.shape != (len(estimates), 4, 4):
        raise InvalidInputError(f"poses have shape {tuple(poses.shape)}, expected ({len(estimates)}, 4, 4)")
    return poses


def _groups(estimates: Estimates) -> dict[tuple[int, int, int], np.ndarray]:
    """Rows by (scene, image, object), each in the order of falling score, ties in file order."""
    groups: dict[tuple[int, int, int], list[int]] = {}
    ids = (estimates.scene_id.tolist(), estimates.im_id.tolist(), estimates.obj_id.tolist())
    columns = list(zip(*ids, strict=True))
    for row in np.argsort(-estimates.score, kind="stable").tolist():
        groups.setdefault(columns[row], []).append(row)
    return {key: np.array(rows) for key, rows in groups.items()}


def _gt_groups(dataset: BopDataset, scenes: Iterable[int]) -> dict[tuple[int, int, int], np.ndarray]:
    """Positions in the scene's `GroundTruth` by (scene, image, object)."""
    groups: dict[tuple[int, int, int], list[int]] = {}
    for scene_id in sorted(scenes):
        gt = dataset.ground_truth(scene_id)
        for index, key in enumerate(zip(gt.im_id.tolist(), gt.obj_id.tolist(), strict=True)):
            groups.setdefault((scene_id, *key), []).append(index)
    return {key: np.array(rows) for key, rows in groups.items()}


def _most_visible(dataset: BopDataset, target: Any, gts: np.ndarray) -> np.ndarray:
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


def _pair_poses(dataset: BopDataset, pairs: list, poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    T_gt = [dataset.ground_truth(scene_id).T_camera_object[gt] for scene_id, _, gt in pairs]
    return poses[torch.tensor([row for _, row, _ in pairs])], torch.stack(T_gt)


def _pair_errors(dataset: BopDataset, obj_id: int, pairs: list, poses: torch.Tensor) -> np.ndarray:
    """MSSD [m] and MSPD [px at 640] of pairs (scene, row, index of ground truth), shape (2, pairs)."""
    if not pairs:
        return np.empty((2, 0))
    T_est, T_gt = _pair_poses(dataset, pairs, poses)
    images = [(scene_id, int(dataset.ground_truth(scene_id).im_id[gt])) for scene_id, _, gt in pairs]
    cameras = {image: dataset.camera(*image).K for image in set(images)}
    K = torch.stack([cameras[image] for image in images])
    width = torch.tensor([dataset.image_width(scene_id) for scene_id, _ in images], dtype=torch.float64)
    vertices, symmetries = dataset.vertices(obj_id), dataset.symmetries(obj_id)
    surface = mssd(T_est, T_gt, _hull(vertices), symmetries)
    projection = mspd(T_est, T_gt, K, vertices, symmetries) * (640 / width)
    return torch.stack([surface, projection]).numpy()


def _hull(vertices: torch.Tensor) -> torch.Tensor:
    try:
        return vertices[ConvexHull(vertices.numpy()).vertices]
    except (QhullError, ValueError):  # flat, or too few points
        return vertices


def _over_symmetries(
    T_est: torch.Tensor, T_gt: torch.Tensor, K: torch.Tensor | None, vertices: torch.Tensor, symmetries: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Least over symmetries of the greatest distance over vertices, and the index of that symmetry.

    Exact, but with hundreds of symmetries not by brute force: a few outlying vertices bound the maximum from below,
    and a symmetry is worked out in full only while its bound is lower than the least maximum found.
    """
    given = {"T_est": T_est.shape[-2:], "T_gt": T_gt.shape[-2:], "symmetries": symmetries.shape[1:]}
    if any(tuple(size) != (4, 4) for size in given.values()) or vertices.shape[1:] != (3,) or not len(vertices):
        sizes = ", ".join(f"{name} {tuple(size)}" for name, size in given.items())
        raise InvalidInputError(f"got {sizes}, vertices {tuple(vertices.shape)}; expected 4×4 transforms and (V, 3)")
    T_est, T_gt = torch.broadcast_tensors(T_est, T_gt)  # torch.broadcast_shapes would import sympy: 0.8 s
    shape = T_est.shape[:-2]
    T_est, T_gt = T_est.reshape(-1, 4, 4), T_gt.reshape(-1, 4, 4)
    if K is not None:
        K = K.expand(*shape, 3, 3).reshape(-1, 3, 3)
    count, index = len(T_est), torch.zeros(len(T_est), dtype=torch.long, device=T_est.device)
    everyone = torch.arange(count, device=T_est.device)
    if len(symmetries) == 1:
        return _farthest(T_est, T_gt @ symmetries[0], K, vertices).reshape(shape), index.reshape(shape)
    bound = torch.empty(count, len(symmetries), dtype=T_est.dtype, device=T_est.device)
    probe = vertices[_outlying(vertices)]
    for part in everyone.split(max(1, 100_000 // len(symmetries))):
        pair = part.repeat_interleave(len(symmetries))
        T_sym = (T_gt[part, None] @ symmetries).flatten(0, 1)
        far = _farthest(T_est[pair], T_sym, None if K is None else K[pair], probe)
        bound[part] = far.reshape(len(part), len(symmetries))
    best = torch.full_like(bound[:, 0], torch.inf)
    active = everyone
    while len(active):
        lower, candidate = bound[active].min(1)
        promising = lower < best[active]
        active, candidate = active[promising], candidate[promising]
        far = _farthest(T_est[active], T_gt[active] @ symmetries[candidate], None if K is None else K[active], vertices)
        bound[active, candidate] = torch.inf
        better = far < best[active]
        best[active[better]], index[active[better]] = far[better], candidate[better]
    return best.reshape(shape), index.reshape(shape)


def _farthest(T_a: torch.Tensor, T_b: torch.Tensor, K: torch.Tensor | None, points: torch.Tensor) -> torch.Tensor:
    """Greatest distance between a point under T_a and under T_b, in space or (with K) in the image, shape (P,)."""
    out = torch.empty(len(T_a), dtype=T_a.dtype, device=T_a.device)
    axes = points.mT.contiguous()
    for part in torch.arange(len(T_a), device=T_a.device).split(max(1, _CHUNK // len(points))):
        if K is None:
            shift = _transformed((T_a[part] - T_b[part])[:, :3], axes)
        else:
            pixels = []
            for T in (T_a[part], T_b[part]):
                x, y, z = _transformed(K[part] @ T[:, :3], axes)
                pixels.append((x / z, y / z))
            shift = [a - b for a, b in zip(*pixels, strict=True)]
        out[part] = sum(s.square() for s in shift).amax(1).sqrt()
    return torch.nan_to_num(out, nan=torch.inf)


def _transformed(P: torch.Tensor, axes: torch.Tensor) -> list[torch.Tensor]:
    """The three coordinates, (B, V) each, of points `axes` (3, V) under P (B, 3, 4)."""
    # No matmul: its threads wait for each other, eight times longer than the work takes where the machine is busy.
    rows = []
    for k in range(3):
        row = torch.addcmul(P[:, k, 3:], P[:, k, :1], axes[0])
        rows.append(row.addcmul_(P[:, k, 1:2], axes[1]).addcmul_(P[:, k, 2:3], axes[2]))
    return rows


def _outlying(points: torch.Tensor, *, count: int = 128) -> torch.Tensor:
    """Indices of the points that are farthest in evenly spread directions."""
    k = torch.arange(count, dtype=points.dtype, device=points.device) + 0.5
    z, angle = 1 - 2 * k / count, k * (torch.pi * (1 + 5**0.5))
    radius = (1 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)
    return (directions @ points.mT).argmax(1).unique()
