"""The table in two real YCB-V images, by MegaPose's estimates, against the depth camera and against the ground truth.

Two references: the plane that RANSAC finds in the depth image around the objects, and that of table_planes.json, which is
derived from the ground truth of the poses. They differ by 4 to 6 mm (ycbv/SOURCE.md).

These data have no second images. Two views are therefore half made up: the second image is the first, seen by its depth
image (smoothed) from 15° farther around the objects; what the first does not show is inpainted. The poses in it are those of
the first, moved: their errors are the same in both, so that the second view tells nothing new of depths.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.bench.table_scenes import read_image, ycbv_body
from physpose_torch.bench.tables import NEEDS_TWO, TableOptions, describe_row, measure, plane_errors
from physpose_torch.bop.dataset import BopDataset
from physpose_torch.bop.formats import read_estimates, read_planes
from physpose_torch.commands.common import progress, table
from physpose_torch.errors import DataError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.render import render
from physpose_torch.table.estimator import TableEstimator
from physpose_torch.table.ransac import ransac_plane
from physpose_torch.table.view import View, pixel_rays, project

__all__ = ["RealFrame", "depth_plane", "load_frame", "run_real", "seen_from"]

FRAMES = ((51, 1), (54, 1))
"""Scene and image: the only ones with images."""
ASIDE = math.radians(15.0)
"""Between the two views, around the objects."""
TOLERANCE = 0.005
"""[m]; a point of the depth image nearer than this to the plane is on it."""
AROUND = 0.25
"""[m]; how far from the objects' middle the table is looked for."""
CLEAR = 12
"""[px]; objects are this much thicker than in truth: depth at their rims is of neither."""
STEP = 0.02
"""[m]; neighbouring pixels that differ by more than this are of different surfaces."""


class RealFrame(NamedTuple):
    """An image and what is known of it. Objects are those with an estimate, the best-scored one each."""

    name: str
    image: Tensor
    """(H, W, 3) uint8."""
    depth: Tensor
    """(H, W), 0 where unknown [m]."""
    K: Tensor
    obj_ids: tuple[int, ...]
    poses: Tensor
    """T_camera_object (N, 4, 4), estimated [m]."""
    truth: Tensor
    """(M, 4, 4) of all annotated objects [m]."""
    true_ids: tuple[int, ...]
    plane: Plane
    """By the ground truth."""


def run_real(
    results: dict[str, Any], options: TableOptions, estimators: dict[str, TableEstimator], data: Path | None
) -> None:
    """Both images, one view and two, every method and kind of mesh.

    Raises:
        DataError: the images are not there.
    """
    if data is None or not (data / "ycbv").is_dir():
        raise DataError("--real: needs --data or PHYSPOSE_DATA with ycbv/ in it")
    root = data / "ycbv"
    results["real"] = []
    runs = [(m, v) for m in options.models for v in options.views]
    with progress(len(FRAMES) * len(runs), "real images", "run") as bar:
        for scene_id, im_id in FRAMES:
            frame = load_frame(root, scene_id, im_id)
            by_depth, share = depth_plane(frame, [ycbv_body(root, i, "models") for i in frame.true_ids])
            angle, offset = plane_errors(by_depth, frame.plane, _under(frame, frame.plane))
            print(
                f"\n{frame.name}: the depth's plane is {angle:.2f}° and {offset:.1f} mm from the ground truth's; "
                f"{100 * share:.0f} % of the depth around the objects is on it"
            )
            rows = []
            for models, count in runs:
                bodies = [ycbv_body(root, i, models) for i in frame.obj_ids]
                views = [View(frame.image, frame.K, frame.poses)]
                if count == 2:
                    T_view1_view0 = _aside(frame, by_depth)
                    image = seen_from(frame, T_view1_view0)
                    views.append(View(image, frame.K, T_view1_view0 @ frame.poses))
                for method, estimator in estimators.items():
                    if count == 1 and method in NEEDS_TWO:
                        continue
                    row, estimate = measure(estimator, views, bodies, by_depth, _under(frame, by_depth))
                    row |= {"scene": frame.name, "models": models, "views": count, "method": method, "draw": 0}
                    if estimate is not None:
                        row["against_truth"] = plane_errors(estimate.plane, frame.plane, _under(frame, frame.plane))
                    rows.append(row)
                bar.update()
            results["real"] += rows
            print(real_table(rows), flush=True)
            for row in rows:
                if row["failure"] or row["warnings"]:
                    print(f"  {row['views']} view(s), {row['models']}, {describe_row(row)}")


def load_frame(root: Path, scene_id: int, im_id: int) -> RealFrame:
    """One image of the data set with its best-scored estimates."""
    dataset = BopDataset(root)
    files = sorted((root / "estimates").glob("*.csv"))
    if not files:
        raise DataError(f"{root / 'estimates'}: no estimates (*.csv) in it")
    estimates = read_estimates(files[0])
    here = np.flatnonzero((estimates.scene_id == scene_id) & (estimates.im_id == im_id))
    best: dict[int, int] = {}
    for row in here[np.argsort(-estimates.score[here], kind="stable")]:
        best.setdefault(int(estimates.obj_id[row]), int(row))
    truth = dataset.ground_truth(scene_id)
    annotated = truth.im_id == im_id
    record = read_planes(root / "table_planes.json")[0][scene_id, im_id]
    return RealFrame(
        f"scene {scene_id}, image {im_id}",
        read_image(dataset.image_path(scene_id, im_id)),
        dataset.depth(scene_id, im_id),
        dataset.camera(scene_id, im_id).K,
        tuple(sorted(best)),
        torch.stack([estimates.T_camera_object[best[k]] for k in sorted(best)]),
        truth.T_camera_object[torch.from_numpy(annotated)],
        tuple(truth.obj_id[annotated].tolist()),
        Plane(record.normal, record.offset),
    )


def depth_plane(frame: RealFrame, bodies: list[Body]) -> tuple[Plane, float]:
    """The plane around the objects in the depth image, and the share of the pixels there that are on it.

    Args:
        frame: the image.
        bodies: in the order of the ground truth, whose outlines are left out.

    Raises:
        DataError: there is no plane.
    """
    height, width = frame.depth.shape
    free = ~_dilated(_silhouettes(bodies, frame.truth, frame.K, height, width))
    points = _points(frame)
    middle = frame.truth[:, :3, 3].mean(0)
    near = torch.linalg.vector_norm(points - middle, dim=-1) < AROUND
    some = points[free & (frame.depth > 0) & near]
    plane, info = ransac_plane(some, tolerance=TOLERANCE)
    if plane is None:
        raise DataError(f"{frame.name}: the depth image shows no plane near the objects")
    return Plane(*plane), float(info.inliers.double().mean())


def seen_from(frame: RealFrame, T_view1_view0: Tensor) -> Tensor:
    """The image as another camera would see it, by the depth image; (H, W, 3) uint8."""
    height, width = frame.depth.shape
    smooth = cv2.bilateralFilter(frame.depth.numpy().astype(np.float32), 9, 0.01, 3.0)
    points = _points(frame._replace(depth=torch.where(frame.depth > 0, torch.from_numpy(smooth).double(), 0.0)))
    index = torch.arange(height * width).view(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = torch.cat([torch.stack(f, -1).view(-1, 3) for f in ((a, c, b), (b, c, d))])
    z = points.view(-1, 3)[:, 2][faces]
    faces = faces[(z.amin(1) > 0) & (z.amax(1) - z.amin(1) < STEP)]
    found = render(se3.apply(T_view1_view0, points.view(-1, 3)), faces, frame.K, height, width)
    there = _points(frame._replace(depth=found.depth)).view(-1, 3)
    source = project(frame.K, se3.apply(se3.inverse(T_view1_view0), there))
    x, y = source.view(height, width, 2).nan_to_num(-1.0).float().unbind(-1)
    image = cv2.remap(frame.image.numpy(), x.numpy(), y.numpy(), cv2.INTER_LINEAR)
    holes = (found.face_id < 0).numpy().astype(np.uint8)
    return torch.from_numpy(cv2.inpaint(image, holes, 3, cv2.INPAINT_TELEA))


def real_table(rows: list[dict[str, Any]]) -> str:
    """The rows as text."""
    header = ["method", "views", "models", "depth: angle [deg]", "offset [mm]", "truth: angle [deg]", "offset [mm]"]
    header += ["σ [deg]", "σ [mm]", "depth factor", "on table", "s"]
    cells = []
    for r in rows:
        cells.append([r["method"], str(r["views"]), r["models"]])
        if r["failure"] is not None:
            cells[-1] += ["failed", *["-"] * 7, f"{r['seconds']:.1f}"]
            continue
        numbers = [r["angle_deg"], r["offset_mm"], *r["against_truth"], r["sigma_tilt_deg"], r["sigma_offset_mm"]]
        cells[-1] += [f"{x:.2f}" if i % 2 == 0 else f"{x:.1f}" for i, x in enumerate(numbers)]
        cells[-1] += [f"{r['depth_factor']:.3f}", str(r["inliers"]), f"{r['seconds']:.1f}"]
    return table(header, cells)


def _aside(frame: RealFrame, plane: Plane) -> Tensor:
    """T_view1_view0 of a camera that went around the objects by ASIDE."""
    middle = frame.poses[:, :3, 3].mean(0)
    R = se3.exp_so3(ASIDE * plane.normal)
    return se3.from_rotation_translation(R, middle - R @ middle)


def _points(frame: RealFrame) -> Tensor:
    """(H, W, 3) of the depth image [m]."""
    height, width = frame.depth.shape
    pixels = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    return pixel_rays(frame.K, torch.stack(pixels, -1).double()) * frame.depth[..., None]


def _silhouettes(bodies: list[Body], poses: Tensor, K: Tensor, height: int, width: int) -> np.ndarray:
    seen = np.zeros((height, width), dtype=bool)
    for body, T in zip(bodies, poses, strict=True):
        vertices = se3.apply(T, torch.from_numpy(np.array(body.mesh.vertices)))
        seen |= (render(vertices, torch.from_numpy(np.array(body.mesh.faces)), K, height, width).face_id >= 0).numpy()
    return seen


def _dilated(mask: np.ndarray) -> Tensor:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * CLEAR + 1, 2 * CLEAR + 1))
    return torch.from_numpy(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _under(frame: RealFrame, plane: Plane) -> Tensor:
    """(3,) the centre of the objects' footprints on a plane [m]."""
    origin = frame.truth[:, :3, 3].mean(0)
    return origin - (plane.normal @ origin - plane.offset) * plane.normal
