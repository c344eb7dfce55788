"""``physpose eval``: BOP recall of a result file, and how many of its objects are inside the table."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from physpose_torch import se3
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import Estimates, PlaneRecord, read_estimates, read_planes
from physpose_torch.bop.metrics import evaluate
from physpose_torch.commands.common import table

__all__ = ["Eval"]

STANDING = 0.010
"""[m]; ground truths whose lowest vertex is nearer than this to the plane count as standing on it."""
INSIDE = 0.003
"""[m]."""


@dataclass(frozen=True)
class Eval:
    """Score a BOP result file by the BOP19 rules: MSSD and MSPD recall, overall, by object and by scene."""

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
    json: Path | None = None
    """Write the scores to this file."""
    quiet: bool = False
    """Print nothing."""

    def __call__(self) -> int:
        estimates = read_estimates(self.estimates)
        dataset = BopDataset(self.dataset, split=self.split, targets=self.targets)
        scores = evaluate(estimates, dataset, scenes=self.scenes or None)
        content = scores.to_dict()
        if self.planes is not None:
            content["inside_table"] = inside_table(estimates, dataset, read_planes(self.planes)[0], self.scenes)
        if self.json is not None:
            self.json.write_text(json.dumps(content, indent=2) + "\n")
        if not self.quiet:
            head = ["", "AR_MSSD", "AR_MSPD", "targets"]
            rows = [["all", f"{scores.ar_mssd:.3f}", f"{scores.ar_mspd:.3f}", str(scores.targets)]]
            for kind, group in (("scene", scores.per_scene), ("object", scores.per_object)):
                rows += [
                    [f"{kind} {k}", f"{r.ar_mssd:.3f}", f"{r.ar_mspd:.3f}", str(r.targets)] for k, r in group.items()
                ]
            print(table(head, rows))
            if "inside_table" in content:
                c = content["inside_table"]
                print(
                    f"\nTop-scored estimates of objects standing on the plane (ground truth within {1e3 * STANDING:.0f} mm): "
                    f"{c['count']}\nmore than {1e3 * INSIDE:.0f} mm inside the table: {100 * c['estimates']:.1f} % "
                    f"(ground truth itself {100 * c['ground_truth']:.1f} %); "
                    f"more than {1e3 * INSIDE:.0f} mm above it: {100 * c['above']:.1f} %"
                )
        for problem in estimates.problems:
            print(f"error: {problem.message}")
        return 1 if estimates.problems else 0


def inside_table(
    estimates: Estimates, dataset: BopDataset, planes: dict[tuple[int, int], PlaneRecord], scenes: tuple[int, ...] = ()
) -> dict[str, float]:
    """Share of objects with a mesh vertex more than 3 mm below the plane, among those that stand on it by ground truth."""
    best: dict[tuple[int, int, int], int] = {}
    keys = zip(estimates.scene_id.tolist(), estimates.im_id.tolist(), estimates.obj_id.tolist(), strict=True)
    for row, key in enumerate(keys):
        if (not scenes or key[0] in scenes) and (key not in best or estimates.score[row] > estimates.score[best[key]]):
            best[key] = row
    lowest_gt, lowest_est = [], []
    truth = {s: dataset.ground_truth(s) for s in {k[0] for k in best}}
    for (scene_id, im_id, obj_id), row in best.items():
        plane = planes.get((scene_id, im_id))
        gt = truth[scene_id]
        match = np.flatnonzero((gt.im_id == im_id) & (gt.obj_id == obj_id))
        if plane is None or len(match) != 1:  # several instances: which one is meant is not told
            continue
        vertices = dataset.vertices(obj_id)
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
    }
