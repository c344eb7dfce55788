"""``physpose table``: the table plane from one or two images."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro

from physpose_torch.bop.table import load_models, read_image, read_scene, write_table
from physpose_torch.commands.common import check_output
from physpose_torch.config import TableConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.geometry.body import Plane
from physpose_torch.table.estimator import TableEstimate, TableEstimator
from physpose_torch.table.view import View

__all__ = ["Table"]


@dataclass(frozen=True, kw_only=True)
class Table:
    """Estimate the plane of the table that objects stand on, from one or two images and the objects' estimated poses.

    Two images 10 to 20 degrees apart tell most; one must do if there is no other. The plane is that in the first image's
    camera. If the evidence is too thin, nothing is written and the exit code is 2.
    """

    view0: Annotated[Path, tyro.conf.Positional]
    """The image."""
    view1: Annotated[Path | None, tyro.conf.Positional] = None
    """A second image of the same scene."""
    scene: Path
    """JSON: {"K": 3x3, "objects": [{"obj_id": 5, "T_cam0_est": 4x4, "T_cam1_est": 4x4 or absent}]}, in mm."""
    models: Path
    """Folder of the meshes, obj_000005.ply or .glb, in mm. With colours, if there are some."""
    out: Path
    """JSON file to write: normal, offset_mm, sigma_deg, sigma_mm, scale, method, warnings; an entry for --planes."""
    method: Literal["auto", "joint", "support", "homography", "paper"] = "auto"
    """joint: all evidence in one least-squares problem. support: the objects' stable faces and bottoms, no image. homography:
    the table's homography between the images. paper: reconstruct, scale, fit a plane. auto: joint as far as it goes."""
    gravity: tuple[float, float, float] | None = None
    """Direction of gravity in the first camera (x right, y down, z forward), any length: a soft prior."""
    manifest: Path | None = None
    """ONNX models of your own for matching, reconstruction and detection; see models/README.md."""
    picture: Path | None = None
    """Write a picture of the plane's grid in the image, with the objects' contact points."""
    config: TableConfig = field(default_factory=TableConfig)
    """Single options."""
    quiet: bool = False
    """Print nothing."""

    def __call__(self) -> int:
        check_output(self.out, self.picture)
        content = read_scene(self.scene)
        images = [read_image(path) for path in (self.view0, self.view1) if path is not None]
        views = [View(image, content.K, poses) for image, poses in zip(images, content.poses, strict=False)]
        bodies = load_models(self.models, content.obj_ids)
        config = replace(self.config, method=self.method) if self.method != "auto" else self.config
        estimate = TableEstimator(config, models=self.manifest)(views, bodies, gravity=_unit(self.gravity))
        write_table(self.out, estimate)
        if self.picture is not None:
            from physpose_torch.table.picture import table_picture

            table_picture(
                images[0],
                content.K,
                estimate.plane,
                bodies=bodies,
                poses=estimate.poses,
                standing=estimate.standing,
                contacts=estimate.contacts,
                path=self.picture,
            )
        if not self.quiet:
            print(_described(estimate))
        return 0


def _unit(gravity: tuple[float, float, float] | None) -> torch.Tensor | None:
    if gravity is None:
        return None
    length = float(np.linalg.norm(gravity))
    if not (np.isfinite(length) and length > 0):
        raise InvalidInputError(f"--gravity {gravity}: expected three numbers, not all 0")
    return torch.tensor(gravity, dtype=torch.float64) / length


def _described(estimate: TableEstimate) -> str:
    plane: Plane = estimate.plane
    normal = " ".join(f"{x:.4f}" for x in plane.normal.tolist())
    lines = [
        f"normal    {normal}   known to {np.degrees(estimate.sigma_tilt):.2f} deg",
        f"offset    {1e3 * float(plane.offset):.1f} mm   its height at the objects to {1e3 * estimate.sigma_offset:.1f} mm",
        f"method    {estimate.method}: {int(estimate.standing.sum())} of {len(estimate.standing)} objects stand on it, "
        f"{estimate.inliers} matches lie on it",
    ]
    if estimate.T_view1_view0 is not None:
        lines.append(f"baseline  {1e3 * float(torch.linalg.vector_norm(estimate.T_view1_view0[:3, 3])):.1f} mm")
    lines += [f"warning   {warning}" for warning in estimate.warnings]
    return "\n".join(lines)
