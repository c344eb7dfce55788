"""An image with its camera and the objects that a pose estimator saw in it; pinhole projection."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.errors import InvalidInputError

__all__ = ["View", "pixel_rays", "project"]

SMALLEST = 32
"""An image with a side shorter than this [px] shows nothing."""


@dataclass(frozen=True, eq=False)
class View:
    """One image of the scene.

    Poses are those of the same objects, in the same order, in every view. A row of NaN is an object that the estimator did
    not see in this view.
    """

    image: Tensor | None
    """(H, W, 3) uint8, RGB; a numpy array will do. None: there is none, only poses."""
    K: Tensor
    """(3, 3) intrinsics [px], pixel centres at integers."""
    poses: Tensor | None = None
    """T_camera_object (N, 4, 4) [m], estimated. None: none in this view."""
    depth: Tensor | None = None
    """(H, W) z of what each pixel sees [m], 0 where unknown: of a depth camera, or predicted. Method ``paper`` takes it
    instead of a reconstruction."""

    def __post_init__(self) -> None:
        K = torch.as_tensor(self.K, dtype=torch.float64)
        if K.shape != (3, 3) or not bool(K.isfinite().all()):
            raise InvalidInputError(f"View.K has shape {tuple(K.shape)}, expected finite (3, 3) intrinsics [px]")
        last, skew = K[2].tolist(), float(K[1, 0])
        if last != [0.0, 0.0, 1.0] or skew != 0 or not (float(K[0, 0]) > 0 and float(K[1, 1]) > 0):
            raise InvalidInputError(f"View.K = {K.tolist()}, expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]], fx, fy > 0")
        object.__setattr__(self, "K", K.cpu())
        if self.image is not None:
            object.__setattr__(self, "image", _checked_image(self.image))
            height, width = self.image.shape[:2]
            if not (0 < float(K[0, 2]) < width and 0 < float(K[1, 2]) < height):
                raise InvalidInputError(
                    f"View.K has its principal point at ({float(K[0, 2]):.1f}, {float(K[1, 2]):.1f}) px, outside of an image "
                    f"of {width} x {height} px; intrinsics and image are of different sizes"
                )
        if self.poses is not None:
            poses = torch.as_tensor(self.poses)
            if poses.is_floating_point() and poses.ndim == 3:
                unseen = poses.isnan().flatten(1).all(1)[:, None, None]
                se3.check_rigid(torch.where(unseen, torch.eye(*poses.shape[1:]).to(poses), poses), "View.poses")
            else:
                raise InvalidInputError(
                    f"View.poses is {poses.dtype} of shape {tuple(poses.shape)}, expected floating (N, 4, 4) transforms"
                )
            object.__setattr__(self, "poses", poses)
        if self.depth is not None:
            depth = torch.as_tensor(self.depth).detach().to("cpu", torch.float64)
            expected = None if self.image is None else tuple(self.image.shape[:2])
            if depth.ndim != 2 or (expected is not None and tuple(depth.shape) != expected):
                raise InvalidInputError(
                    f"View.depth has shape {tuple(depth.shape)}, expected {expected or '(H, W)'} as the image, in metres"
                )
            object.__setattr__(self, "depth", torch.where(depth.isfinite() & (depth > 0), depth, 0.0))

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the image [px]."""
        if self.image is not None:
            return self.image.shape[0], self.image.shape[1]
        # no image: twice the principal point is as good a guess as any
        return round(2 * float(self.K[1, 2]) + 1), round(2 * float(self.K[0, 2]) + 1)

    @property
    def measured(self) -> Tensor | None:
        """The poses (N, 4, 4), float64 on the CPU, where all of this is computed."""
        return None if self.poses is None else self.poses.detach().to("cpu", torch.float64)


def pixel_rays(K: Tensor, points: Tensor) -> Tensor:
    """Directions (..., 3) with z = 1 of pixels (..., 2), camera frame."""
    ones = torch.ones_like(points[..., :1])
    return torch.cat([points, ones], -1) @ torch.linalg.inv(K).to(points).mT


def project(K: Tensor, points: Tensor) -> Tensor:
    """Pixels (..., 2) of points (..., 3) in the camera frame."""
    image = points @ K.to(points).mT
    return image[..., :2] / image[..., 2:]


def _checked_image(image: Tensor | np.ndarray) -> Tensor:
    try:
        # torch takes no negative strides, as of an image whose channels were turned round
        image = torch.as_tensor(np.ascontiguousarray(image) if isinstance(image, np.ndarray) else image)
    except (TypeError, ValueError):
        raise InvalidInputError(f"View.image is a {type(image).__name__}, expected (H, W, 3) uint8, RGB") from None
    if image.ndim == 2:
        image = image[..., None].expand(*image.shape, 3)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != torch.uint8:
        hint = "; multiply by 255 and convert" if image.is_floating_point() else ""
        raise InvalidInputError(
            f"View.image is {image.dtype} of shape {tuple(image.shape)}, expected (H, W, 3) uint8, RGB{hint}"
        )
    if min(image.shape[:2]) < SMALLEST:
        raise InvalidInputError(f"View.image is {image.shape[1]} x {image.shape[0]} px, expected at least {SMALLEST} a side")
    return image.cpu()
