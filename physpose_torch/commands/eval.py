"""``physpose eval``: BOP recall of a result file, its errors by direction, and how many objects are inside the table."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from physpose_torch import se3
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates, PlaneRecord, read_estimates, read_planes
from physpose_torch.bop.metrics import Recall, Scores, evaluate
from physpose_torch.bop.residuals import Distribution, distribution, errors_against_gt
from physpose_torch.bop.vsd import VsdDepth
from physpose_torch.commands.common import check_output, progress, table
from physpose_torch.files import write_file

__all__ = ["Eval"]

STANDING = 0.010
"""[m]; ground truths whose lowest vertex is nearer than this to the plane count as standing on it."""
INSIDE = 0.003
"""[m]."""
DIRECTIONS = {
    "along_ray_mm": "Error along the viewing ray [mm], positive: too far away",
    "across_ray_mm": "Error across the viewing ray [mm]",
    "rotation_deg": "Error of rotation [deg]",
}
BAR = 48


@dataclass(frozen=True)
class Eval:
    """Score a BOP result file by the BOP19 rules: VSD, MSSD and MSPD recall, overall, by object and by scene."""

    estimates: Annotated[Path, tyro.conf.Positional]
    """Result file: scene_id,im_id,obj_id,score,R,t,time (t in mm)."""
    dataset: Path
    """BOP dataset folder with ground truth."""
    split: str | None = None
    """Split of the dataset, if it has several."""
    targets: Path | None = None
    """Targets file; default: the dataset's."""
    planes: Path | None = None
    """Table planes; with them, also the share of objects inside the table."""
    scenes: tuple[int, ...] = ()
    """Only these scenes."""
    vsd_depth: VsdDepth = "auto"
    """What VSD compares with. auto: the dataset's depth images, where it has some; rendered: the ground truth of all
    annotated objects, which is not what BOP does; none: no VSD."""
    json: Path | None = None
    """Write all figures to this file."""
    quiet: bool = False
    """Print nothing."""

    def __call__(self) -> int:
        check_output(self.json)
        estimates = read_estimates(self.estimates)
        dataset = BopDataset(self.dataset, split=self.split, targets=self.targets)
        planes, bad_planes = read_planes(self.planes) if self.planes is not None else ({}, [])
        scenes = self.scenes or None
        images = {t[:2] for t in dataset.targets if scenes is None or t.scene_id in scenes}
        still = self.quiet or self.vsd_depth == "none"
        with progress(len(images), "VSD", "image", quiet=still) as bar:
            scores = evaluate(estimates, dataset, scenes=scenes, vsd_depth=self.vsd_depth, on_image=bar.update)
        note = vsd_note(scores, self.vsd_depth, len(images))
        errors, counts = errors_by_direction(estimates, dataset, scores)
        content = {**scores.to_dict(), "vsd_note": note.replace("\n", " ")}
        content["errors"] = {**counts, **{name: d.to_dict() for name, d in errors.items()}}
        if self.planes is not None:
            content["inside_table"] = inside_table(estimates, dataset, planes, self.scenes)
        if self.json is not None:
            write_file(self.json, json.dumps(content, indent=2) + "\n")
        if not self.quiet:
            print(score_table(scores), *([note] if note else []), sep="\n\n")
            print("", errors_text(errors, counts), sep="\n")
            if "inside_table" in content:
                print("", inside_text(content["inside_table"]), sep="\n")
        problems = [*estimates.problems, *bad_planes]
        for problem in problems:
            print(f"error: {problem.message}")
        return 1 if problems else 0


def vsd_note(scores: Scores, depth: VsdDepth, images: int) -> str:
    """What VSD is over, or why there is none; empty if it was not asked for."""
    if depth == "none":
        return ""
    if scores.vsd is None:
        return (
            "No VSD: no image with targets has a depth image;\n"
            "--vsd-depth rendered compares with the ground truth, rendered, instead"
        )
    if depth == "rendered":
        return (
            "VSD on rendered depth: the ground truth of all annotated objects, the rest\n"
            "unknown; do not compare AR_VSD and AR with figures on sensor depth"
        )
    if scores.vsd.targets == scores.targets:
        return "VSD on the dataset's depth images, over all targets"
    return (
        f"VSD over {scores.vsd.targets} of {scores.targets} targets only, those of the {scores.vsd.images} of {images} "
        "images\nwith a depth image; so no AR of all three errors"
    )


def score_table(scores: Scores) -> str:
    """Average recalls overall, by scene and by object."""
    with_vsd = scores.vsd is not None
    partial = with_vsd and scores.vsd.targets < scores.targets

    def cells(name: str, recall: Recall, vsd_targets: int) -> list[str]:
        numbers = [recall.ar_vsd] * with_vsd + [recall.ar_mssd, recall.ar_mspd]
        row = [name, *("-" if number is None else f"{number:.3f}" for number in numbers), str(recall.targets)]
        return row + [str(vsd_targets)] * partial

    head = ["", *["AR_VSD"] * with_vsd, "AR_MSSD", "AR_MSPD", "targets", *["with depth"] * partial]
    vsd_targets, by_scene, by_object = 0, {}, {}
    if scores.vsd is not None:
        vsd_targets, by_scene, by_object = scores.vsd.targets, scores.vsd.per_scene, scores.vsd.per_object
    rows = [cells("all", Recall(scores.ar_mssd, scores.ar_mspd, scores.targets, scores.ar_vsd), vsd_targets)]
    for kind, group, counts in (("scene", scores.per_scene, by_scene), ("object", scores.per_object, by_object)):
        rows += [cells(f"{kind} {key}", recall, counts.get(key, 0)) for key, recall in group.items()]
    text = table(head, rows)
    if scores.ar is None:
        return text
    return f"{text}\n\nAR {scores.ar:.3f}, the mean of AR_VSD, AR_MSSD and AR_MSPD"


def errors_by_direction(
    estimates: Estimates, dataset: BopDataset, scores: Scores
) -> tuple[dict[str, Distribution], dict[str, int]]:
    """Errors of the scored rows along and across the ray [mm] and in rotation [deg], and how many rows these are.

    A row farther than a diameter (MSSD) from every ground truth of its object is no measurement of it but a false
    positive; such rows are counted and left out.
    """
    scored = ~np.isnan(scores.mssd)
    errors = errors_against_gt(estimates, dataset, rows=scored)
    diameter = {int(k): dataset.diameter(int(k)) for k in np.unique(estimates.obj_id[scored])}
    limit = np.array([diameter.get(int(k), 0.0) for k in estimates.obj_id])
    near = scored & (errors.mssd < limit)
    values = (1e3 * errors.along_ray[near], 1e3 * errors.across_ray[near], np.rad2deg(errors.rotation[near]))
    found = {name: distribution(value) for name, value in zip(DIRECTIONS, values, strict=True)}
    return found, {"rows": int(near.sum()), "left_out": int(scored.sum() - near.sum())}


def errors_text(errors: dict[str, Distribution], counts: dict[str, int]) -> str:
    """The errors as text histograms for 80 columns."""
    text = f"Errors against the nearest ground truth: {counts['rows']} scored rows"
    if counts["left_out"]:
        text += f"\n({counts['left_out']} more are farther off than a diameter and left out)"
    return "\n\n".join([text, *(_histogram(DIRECTIONS[name], d) for name, d in errors.items() if d.count)])


def _histogram(title: str, d: Distribution) -> str:
    numbers = (f"{round(x, 1) + 0.0:.1f}" for x in (d.median, d.mean, d.robust_sigma, d.p5, d.p95))  # + 0: never -0.0
    figures = "median {}, mean {}, robust σ {}, percentiles 5 to 95: {} to {}".format(*numbers)
    edges = [f"{edge:g}" for edge in d.edges.tolist()]
    rows = [(f"{a} to {b}", n) for a, b, n in zip(edges[:-1], edges[1:], d.counts.tolist(), strict=True)]
    rows = [(f"below {edges[0]}", d.below), *rows, (f"{edges[-1]} and more", d.above)]
    rows = rows[d.below == 0 : len(rows) - (d.above == 0)]
    width, most = max(len(name) for name, _ in rows), max(n for _, n in rows)
    lines = [f"{name:>{width}}  {n:>6}  {_bar(n / most)}".rstrip() for name, n in rows]
    return "\n".join([title, "  " + figures, *lines])


def _bar(share: float) -> str:
    eighths = int(np.ceil(8 * BAR * share))  # whatever is there is seen
    return "█" * (eighths // 8) + " ▏▎▍▌▋▊▉"[eighths % 8].strip()


def inside_table(
    estimates: Estimates, dataset: BopDataset, planes: dict[tuple[int, int], PlaneRecord], scenes: tuple[int, ...] = ()
) -> dict[str, float]:
    """Share of objects with a mesh vertex more than 3 mm below the plane, among those that stand on it by ground truth."""
    best: dict[tuple[int, int, int], int] = {}
    known = set(dataset.scene_ids)
    keys = zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), estimates.obj_id.tolist(), strict=True)
    for row, key in enumerate(keys):
        if key[0] not in known or (scenes and key[0] not in scenes):
            continue
        if key not in best or estimates.score[row] > estimates.score[best[key]]:
            best[key] = row
    lowest_gt, lowest_est = [], []
    truth = {s: dataset.ground_truth(s) for s in {k[0] for k in best}}
    for (scene_id, im_id, obj_id), row in best.items():
        plane = planes.get((scene_id, im_id))
        gt = truth[scene_id]
        match = np.flatnonzero((gt.im_id == im_id) & (gt.obj_id == obj_id))
        if plane is None or len(match) != 1:  # several instances: which one is meant is not told
            continue
        vertices = dataset.hull(obj_id)
        for T, out in ((gt.T_camera_object[match[0]], lowest_gt), (estimates.T_camera_object[row], lowest_est)):
            out.append(float((se3.apply(T, vertices) @ plane.normal).min()) - plane.offset)
    gt_height, est_height = torch.tensor(lowest_gt), torch.tensor(lowest_est)
    standing = gt_height.abs() < STANDING
    share = lambda x: float(x[standing].double().mean()) if bool(standing.any()) else 0.0  # noqa: E731
    return {
        "count": int(standing.sum()),
        "estimates": share(est_height < -INSIDE),
        "above": share(est_height > INSIDE),
        "ground_truth": share(gt_height < -INSIDE),
        "ground_truth_above": share(gt_height > INSIDE),
    }


def inside_text(c: dict[str, Any]) -> str:
    """The figures of `inside_table` in words."""
    limit = f"more than {1e3 * INSIDE:.0f} mm"
    return (
        f"Best-scored estimates of objects standing on the plane: {c['count']}\n"
        f"(ground truth within {1e3 * STANDING:.0f} mm of it)\n"
        f"{limit} inside the table: {100 * c['estimates']:.1f} % (ground truth itself {100 * c['ground_truth']:.1f} %)\n"
        f"{limit} above it: {100 * c['above']:.1f} % (ground truth itself {100 * c['ground_truth_above']:.1f} %)"
    )
