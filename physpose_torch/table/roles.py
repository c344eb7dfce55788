"""What the table estimator asks of the models it uses: small protocols, one a role. Any callable that keeps them will do.

Images are (H, W, 3) uint8 tensors, RGB. Pixels are (x, y) with pixel centres at integers, as everywhere in this package.
"""

from typing import NamedTuple, Protocol

from torch import Tensor

__all__ = [
    "Boxes",
    "Detector",
    "Extractor",
    "Features",
    "Matcher",
    "Matches",
    "PairMatcher",
    "PointMaps",
    "Reconstructor",
]


class Features(NamedTuple):
    """Keypoints of one image."""

    points: Tensor
    """(K, 2) [px]."""
    descriptors: Tensor
    """(K, D) float32, of unit length."""
    scores: Tensor
    """(K,) how reliable each is; higher is better."""
    scales: Tensor
    """(K,) side of what the descriptor looks at, relative to that at full resolution."""


class Matches(NamedTuple):
    """Pairs of pixels that show the same point."""

    points_0: Tensor
    """(M, 2) in the first image [px], float64."""
    points_1: Tensor
    """(M, 2) in the second image [px], float64."""
    scores: Tensor
    """(M,) between 0 and 1; higher is better."""


class PointMaps(NamedTuple):
    """A dense reconstruction of two images, up to scale, as DUSt3R and MASt3R make it."""

    points_0: Tensor
    """(H, W, 3) what each pixel of the first image sees, in the frame of the first camera, any unit."""
    points_1: Tensor
    """(H, W, 3) what each pixel of the second image sees, in the frame of the *first* camera, the same unit."""
    confidence_0: Tensor
    """(H, W) of the first map; higher is better."""
    confidence_1: Tensor
    """(H, W) of the second map."""


class Boxes(NamedTuple):
    """What a detector found, the best first."""

    corners: Tensor
    """(B, 4) x_min, y_min, x_max, y_max [px]."""
    scores: Tensor
    """(B,) between 0 and 1."""


class Extractor(Protocol):
    """Keypoints and descriptors of one image."""

    def __call__(self, image: Tensor) -> Features: ...


class Matcher(Protocol):
    """Which keypoints of two images belong together."""

    def __call__(self, first: Features, second: Features) -> Matches: ...


class PairMatcher(Protocol):
    """Matches straight from two images."""

    def __call__(self, image_0: Tensor, image_1: Tensor) -> Matches: ...


class Reconstructor(Protocol):
    """Dense point maps from two images."""

    def __call__(self, image_0: Tensor, image_1: Tensor) -> PointMaps: ...


class Detector(Protocol):
    """Boxes of what a word names."""

    def __call__(self, image: Tensor, prompt: str) -> Boxes: ...
