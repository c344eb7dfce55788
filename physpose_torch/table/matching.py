"""Matches between two images: SIFT, which needs no weights, beside what ONNX models find."""

import cv2
import torch
from torch import Tensor

from physpose_torch.table.roles import Features, Matches

__all__ = ["MutualNearest", "Sift", "join"]


class Sift:
    """SIFT (Lowe 2004) by OpenCV; an extractor.

    Args:
        most: keypoints.
        contrast: threshold; a plain table has none but weak ones.
    """

    def __init__(self, most: int = 4000, contrast: float = 0.015) -> None:
        self._sift = cv2.SIFT_create(most, contrastThreshold=contrast)

    def __call__(self, image: Tensor) -> Features:
        """Keypoints of an image (H, W, 3) uint8."""
        points, descriptors = self._sift.detectAndCompute(cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY), None)
        if descriptors is None:
            none = torch.zeros(0)
            return Features(none.reshape(0, 2), none.reshape(0, 128), none, none)
        where = torch.tensor([p.pt for p in points], dtype=torch.float64)
        # RootSIFT (Arandjelovic and Zisserman 2012): the Hellinger kernel
        descriptors = torch.from_numpy(descriptors)
        descriptors = (descriptors / descriptors.sum(1, keepdim=True).clamp_min(1e-9)).sqrt()
        scores = torch.tensor([p.response for p in points])
        return Features(where, descriptors, scores, torch.tensor([p.size for p in points]))


class MutualNearest:
    """Each the other's nearest neighbour, and clearly nearer than the second nearest (Lowe 2004); a matcher.

    Args:
        ratio: largest distance as a share of that to the second nearest.
        least: smallest cosine of two descriptors.
    """

    def __init__(self, ratio: float = 0.85, least: float = -1.0) -> None:
        self.ratio, self.least = ratio, least

    def __call__(self, first: Features, second: Features) -> Matches:
        """Matches of the keypoints of two images."""
        if len(first.points) < 2 or len(second.points) < 2:
            none = torch.zeros(0, 2, dtype=torch.float64)
            return Matches(none, none, none[:, 0])
        cosine = first.descriptors @ second.descriptors.mT
        best, which = cosine.topk(2, 1)
        distance = (2.0 - 2.0 * best).clamp_min(0.0).sqrt()
        mutual = cosine.argmax(0)[which[:, 0]] == torch.arange(len(cosine))
        keep = mutual & (distance[:, 0] <= self.ratio * distance[:, 1]) & (best[:, 0] >= self.least)
        points = first.points[keep].double(), second.points[which[keep, 0]].double()
        return Matches(*points, best[keep, 0].double().clamp(0.0, 1.0))


def join(*parts: Matches) -> Matches:
    """All matches of several sources."""
    return Matches(*(torch.cat(column) for column in zip(*parts, strict=True)))
