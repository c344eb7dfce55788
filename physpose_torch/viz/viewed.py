"""One image as the viewer shows it: its objects at every step of a refinement, and what physics says of them."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from physpose_torch.errors import InvalidInputError
from physpose_torch.report import NOTABLE, PhysicsReport, physics_report
from physpose_torch.scene import Scene
from physpose_torch.viz.scene import table_frame

__all__ = ["ViewedImage"]

_SPACE = "\u00a0"  # browsers drop or wrap others, and columns would touch
_REMEMBERED = 200  # reports of different steps


@dataclass(frozen=True, eq=False)
class ViewedImage:
    """One image to look at."""

    name: str
    """What to call it."""
    scene: Scene
    """Of this image alone."""
    trajectory: Tensor
    """T_camera_object (T + 1, N, 4, 4) [m]: `Refinement.trajectory`, or one set of poses."""
    K: Tensor | None = None
    """(3, 3) intrinsics [px]; None: no camera is shown."""
    size: tuple[int, int] | None = None
    """Height and width of the image [px]; None: twice the principal point."""
    image: np.ndarray | None = None
    """(H, W, 3) uint8, RGB."""
    scores: Tensor | None = None
    """(N,), see :class:`~physpose_torch.losses.PhysicsLoss`."""
    problem: str = ""
    """Why there is nothing to see, if so."""
    _reports: dict[int, PhysicsReport] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.scene)
        if self.trajectory.ndim != 4 or self.trajectory.shape[1:] != (n, 4, 4) or len(self.trajectory) < 1:
            raise InvalidInputError(
                f"{self.name}: trajectory has shape {tuple(self.trajectory.shape)}, expected (T + 1, {n}, 4, 4) as the "
                "scene; of several hypotheses choose one, trajectory[:, k]"
            )
        if self.scene.n_images != 1:
            raise InvalidInputError(
                f"{self.name}: the scene has {self.scene.n_images} images, expected one; see Scene.select"
            )
        object.__setattr__(self, "trajectory", self.trajectory.detach().to("cpu", torch.float64))
        if self.K is not None:
            K = torch.as_tensor(self.K).detach().to("cpu", torch.float64)
            if K.shape != (3, 3):
                raise InvalidInputError(f"{self.name}: K has shape {tuple(K.shape)}, expected (3, 3) intrinsics [px]")
            size = self.size
            if self.image is not None:
                size = self.image.shape[:2]
            elif size is None:
                size = (round(2 * float(K[1, 2]) + 1), round(2 * float(K[0, 2]) + 1))
            object.__setattr__(self, "K", K)
            object.__setattr__(self, "size", tuple(size))

    @property
    def last(self) -> int:
        """The number of the last step."""
        return len(self.trajectory) - 1

    @cached_property
    def plane(self):
        """The table, or None."""
        return self.scene.planes[0].shape if self.scene.planes else None

    @cached_property
    def T_world_camera(self) -> Tensor:
        """(4, 4): the world's z points up, and z = 0 is the table, if there is one; its origin is under the objects."""
        end = self.trajectory[-1]
        if not len(end):
            end = torch.eye(4, dtype=torch.float64)[None]
        if self.plane is not None:
            return table_frame(self.plane, end)
        gravity = self.scene.gravity[0].detach()
        up = -gravity if bool(gravity.any()) else gravity.new_tensor([0.0, -1.0, 0.0])
        lowest = (end[:, :3, 3] @ up.double()).min()
        return table_frame((up, lowest), end)

    def poses(self, step: int) -> Tensor:
        """T_world_object (N, 4, 4) at a step [m]."""
        return self.T_world_camera @ self.trajectory[step]

    def report(self, step: int) -> PhysicsReport:
        """What physics says of the poses at a step."""
        if step not in self._reports:
            if len(self._reports) >= _REMEMBERED:
                self._reports.clear()
            self._reports[step] = physics_report(self.trajectory[step], self.scene, scores=self.scores)
        return self._reports[step]

    def penetrating(self, step: int) -> list[bool]:
        """Which objects are inside something by more than what the report's status calls contact."""
        return (self.report(step).penetration > NOTABLE).tolist()

    def table(self, step: int) -> str:
        """The report at a step, Markdown, lengths in mm."""
        if self.problem:
            return f"**{self.problem}**"
        rows = self.report(step).to_dict()["objects"]
        if not rows:
            return "no objects"
        lines = [
            f"| object | in{_SPACE}static | {_SPACE}in{_SPACE}object | {2 * _SPACE}gap | on | status |",
            "|---|---:|---:|---:|---|---|",
        ]
        for row in rows:
            depths = [_mm(row[key]) for key in ("penetration_static", "penetration_object", "gap")]
            cells = (row["label"], *depths, f"{2 * _SPACE}{row['support']}", f"{2 * _SPACE}{row['status']}")
            lines.append(f"| {' | '.join(cells)} |")
        return "\n".join([*lines, "", "lengths in mm"])


def _mm(x: float | None) -> str:
    return "–" if x is None else f"{1e3 * x:.1f}"
