"""ONNX models of the user's own in the roles of the table estimator.

Images enter a graph as (1, C, H, W) float in RGB order, divided by 255, then less `mean` and divided by `std`. Pixels of a
graph are those of its own input, centres at integers; they are brought back by
x_image = (x_graph + ½) W_image / W_graph - ½.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.table.manifest import ModelRecord, read_manifest
from physpose_torch.table.roles import Boxes, Features, Matches, PointMaps

__all__ = ["Graph", "check_image", "load_models", "to_image"]

_NUMPY = {"float": "float32", "double": "float64", "bool": "bool"} | {t: t for t in ("float16", "int32", "int64")}
_GREY = (0.299, 0.587, 0.114)  # luma of ITU-R BT.601, as in OpenCV


class Graph:
    """An ONNX file under this package's names for its tensors.

    Runs by CUDA where the tensors are there and onnxruntime can, else on the CPU by as many threads as torch has at
    the first call.

    Args:
        record: the file and its tensors.
    """

    def __init__(self, record: ModelRecord) -> None:
        self.record = record
        self._sessions: dict[str, Any] = {}

    def __call__(self, **given: Tensor) -> dict[str, Tensor]:
        """Outputs on the inputs' device, floating ones as float32; inputs that the graph does not name are left out.

        Raises:
            DataError: the file is no ONNX model, lacks a named tensor, or does not take these inputs.
        """
        device = next(iter(given.values())).device
        session, record = self._session(device.type), self.record
        feed = {}
        for node in session.get_inputs():
            ours = next((n for n, theirs in record.inputs.items() if theirs == node.name), None)
            dtype = _NUMPY.get(node.type.removeprefix("tensor(").removesuffix(")"))
            if ours not in given or dtype is None or (given[ours].is_floating_point() and "float" not in dtype):
                about = f"as {ours} {given[ours].dtype}" if ours in given else "nothing"
                raise DataError(f"{record.file} wants {node.name} {node.type} but gets {about}; correct its inputs")
            feed[node.name] = given[ours].detach().cpu().numpy().astype(dtype)
        try:
            values = session.run(list(record.outputs.values()), feed)
            tensors = [torch.from_numpy(np.asarray(v)).to(device) for v in values]
        except Exception as error:  # onnxruntime's errors have no common base
            shapes = {name: value.shape for name, value in feed.items()}
            raise DataError(f"{record.file} cannot run on inputs of shapes {shapes}: {error}; check size") from error
        tensors = [t.float() if t.is_floating_point() else t for t in tensors]
        return dict(zip(record.outputs, tensors, strict=True))

    def _session(self, device: str) -> Any:
        if device in self._sessions:
            return self._sessions[device]
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.log_severity_level = 3  # errors
        # idle threads would take torch's cores
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        able = onnxruntime.get_available_providers()
        wanted = ["CUDAExecutionProvider"] if device == "cuda" and "CUDAExecutionProvider" in able else []
        try:
            providers = [*wanted, "CPUExecutionProvider"]
            # it would print, and try the same again
            session = onnxruntime.InferenceSession(str(self.record.file), options, providers, enable_fallback=0)
        except Exception as error:
            raise DataError(f"{self.record.file} is no ONNX model that can be run: {error}; export it anew") from error
        nodes = {"inputs": session.get_inputs(), "outputs": session.get_outputs()}
        for kind, names in (("inputs", self.record.inputs), ("outputs", self.record.outputs)):
            has = [node.name for node in nodes[kind]]
            if wrong := sorted(set(names.values()) - set(has)):
                raise DataError(f"{self.record.file} has no {kind} {wrong}, but {has}; correct the entry's {kind}")
        self._sessions[device] = session
        return session


def check_image(image: Tensor, name: str = "image") -> None:
    """Raises InvalidInputError unless an image is (H, W, 3) uint8."""
    if image.dtype != torch.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise InvalidInputError(f"{name} is {image.dtype} {tuple(image.shape)}, expected RGB, uint8 (H, W, 3)")


def to_image(points: Tensor, size: tuple[int, int], image: Tensor) -> Tensor:
    """Pixels (..., 2) of an image (H, W, 3), float64, from those of a copy resized to `size` (width, height)."""
    height, width = image.shape[:2]
    scale = torch.tensor([width / size[0], height / size[1]], dtype=torch.float64, device=points.device)
    return (points.double() + 0.5) * scale - 0.5


class _Model:
    """What all roles share: images into the graph, and tensors of known shape out of it."""

    def __init__(self, record: ModelRecord) -> None:
        self.record = record
        self._graph = Graph(record)

    def _prepare(self, image: Tensor, name: str = "image") -> tuple[Tensor, tuple[int, int]]:
        """The image as the graph wants it, (1, C, h, w), and its (w, h)."""
        check_image(image, name)
        record = self.record
        step = record.multiple_of
        size = record.size or (image.shape[1], image.shape[0])
        width, height = (max(step, step * round(n / step)) for n in size)
        x = image.permute(2, 0, 1)[None].float() / 255
        if record.channels == 1:
            x = (x * x.new_tensor(_GREY)[:, None, None]).sum(1, keepdim=True)
        if x.shape[2:] != (height, width):
            x = interpolate(x, (height, width), mode="bilinear", antialias=True)
        mean, std = (x.new_tensor(v)[:, None, None] for v in (record.mean, record.std))
        return (x - mean) / std, (width, height)

    def _shaped(self, outputs: dict[str, Tensor], name: str, *shape: int | None) -> Tensor:
        """An output without a batch dimension of one; None stands for any length."""
        tensor = outputs[name]
        if tensor.ndim == len(shape) + 1 and tensor.shape[0] == 1:
            tensor = tensor[0]
        if tensor.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, tensor.shape, strict=True)):
            expected = ", ".join("any" if n is None else str(n) for n in shape)
            raise DataError(
                f"{self.record.file}: {name} ({self.record.outputs[name]}) has shape {tuple(outputs[name].shape)}, "
                f"expected ({expected}), batched or not; name another tensor in the entry's outputs"
            )
        return tensor

    def _scores(self, outputs: dict[str, Tensor], like: Tensor) -> Tensor:
        """(K,), one for each row of `like`; ones where the graph has none."""
        ones = like.new_ones(len(like)).float()
        return self._shaped(outputs, "scores", len(like)).float() if "scores" in outputs else ones

    def _kept(self, scores: Tensor, *columns: Tensor) -> Tensor:
        """Which rows are good enough, and have no NaN or infinity, nor have the columns (K, D) beside them."""
        finite = torch.cat([scores[:, None], *columns], 1).isfinite().all(1)
        return (scores >= self.record.threshold) & finite


class _Extractor(_Model):
    """image → keypoints (K, 2) [px of the graph], descriptors (K, D), scores (K,)."""

    def __call__(self, image: Tensor) -> Features:
        x, size = self._prepare(image)
        outputs = self._graph(image=x)
        points = self._shaped(outputs, "keypoints", None, 2)
        descriptors = normalize(self._shaped(outputs, "descriptors", len(points), None).float(), dim=1)
        scores = self._scores(outputs, points)
        keep = self._kept(scores, points, descriptors)
        scale = (image.shape[0] * image.shape[1] / (size[0] * size[1])) ** 0.5
        points = to_image(points[keep], size, image)
        return Features(points, descriptors[keep], scores[keep], torch.full_like(scores[keep], scale))


class _Matcher(_Model):
    """points_0/1 (1, K, 2), descriptors_0/1 (1, K, D) → matches (M, 2), or (M, 3) with the batch first; scores (M,).

    This is how LightGlue is exported; points go in by its convention unless `normalised` is false.
    """

    def __call__(self, first: Features, second: Features) -> Matches:
        if len(first.points) == 0 or len(second.points) == 0:
            none = first.points.new_zeros(0, 2, dtype=torch.float64)
            return Matches(none, none, none[:, 0])
        points = [self._normalise(f.points)[None] for f in (first, second)]
        descriptors = [f.descriptors[None] for f in (first, second)]
        outputs = self._graph(
            points_0=points[0], points_1=points[1], descriptors_0=descriptors[0], descriptors_1=descriptors[1]
        )
        pairs = self._shaped(outputs, "matches", None, None).long()
        if pairs.shape[1] not in (2, 3):
            self._shaped(outputs, "matches", None, 2)  # raises
        pairs, scores = pairs[:, -2:], self._scores(outputs, pairs)
        if ((pairs < 0) | (pairs >= pairs.new_tensor([len(f.points) for f in (first, second)]))).any():
            raise DataError(f"{self.record.file}: matches point beyond the keypoints; name another tensor as matches")
        keep = scores >= self.record.threshold
        i, j = pairs[keep].unbind(1)
        return Matches(first.points[i].double(), second.points[j].double(), scores[keep].double().clamp(0, 1))

    def _normalise(self, points: Tensor) -> Tensor:
        if not self.record.normalised:
            return points.float()
        # as LightGlue does where it is not told the image's size
        size = points.new_tensor(self.record.size) if self.record.size else points.amax(0) - points.amin(0) + 1
        return ((points - size / 2) / (size.max() / 2)).float()


class _PairMatcher(_Model):
    """image_0, image_1 → points_0 (M, 2), points_1 (M, 2) [px of the graph], scores (M,)."""

    def __call__(self, image_0: Tensor, image_1: Tensor) -> Matches:
        (x_0, size_0), (x_1, size_1) = self._prepare(image_0, "image_0"), self._prepare(image_1, "image_1")
        outputs = self._graph(image_0=x_0, image_1=x_1)
        points_0 = self._shaped(outputs, "points_0", None, 2)
        points_1 = self._shaped(outputs, "points_1", len(points_0), 2)
        scores = self._scores(outputs, points_0).double()
        keep = self._kept(scores, points_0, points_1)
        points = to_image(points_0[keep], size_0, image_0), to_image(points_1[keep], size_1, image_1)
        return Matches(*points, scores[keep].clamp(0, 1))


class _Reconstructor(_Model):
    """image_0, image_1 → points_0/1 (h, w, 3), confidence_0/1 (h, w), resized to the images bilinearly."""

    def __call__(self, image_0: Tensor, image_1: Tensor) -> PointMaps:
        outputs = self._graph(
            image_0=self._prepare(image_0, "image_0")[0], image_1=self._prepare(image_1, "image_1")[0]
        )
        maps = {}
        for k, image in enumerate((image_0, image_1)):
            points = self._shaped(outputs, f"points_{k}", None, None, 3)
            confidence = self._shaped(outputs, f"confidence_{k}", *points.shape[:2])
            both = torch.cat([points, confidence[..., None]], 2).float().permute(2, 0, 1)[None]
            both = interpolate(both, tuple(image.shape[:2]), mode="bilinear")[0].permute(1, 2, 0)
            maps |= {f"points_{k}": both[..., :3], f"confidence_{k}": both[..., 3]}
        return PointMaps(**maps)


class _Detector(_Model):
    """image and tokens → boxes (B, 4), scores (B,) or (B, T), of which the best token's counts."""

    def __call__(self, image: Tensor, prompt: str) -> Boxes:
        record = self.record
        if prompt != record.prompt:
            raise InvalidInputError(
                f"prompt = {prompt!r}, but {record.name!r} finds {record.prompt!r} only; ask for that, "
                "or give the manifest an entry with this prompt and its input_ids"
            )
        x, size = self._prepare(image)
        given = {"image": x, "pixel_mask": x.new_ones(1, *x.shape[2:], dtype=torch.long)}
        if record.input_ids is not None:
            ids = torch.tensor([record.input_ids], device=x.device)
            given |= {"input_ids": ids, "attention_mask": torch.ones_like(ids), "token_type_ids": torch.zeros_like(ids)}
        outputs = self._graph(**given)
        boxes = self._shaped(outputs, "boxes", None, 4)
        scores = outputs["scores"]
        if scores.ndim > 1 and scores.shape[-2] == len(boxes):
            scores = scores.amax(-1)
        scores = self._scores({"scores": scores}, boxes)
        scores = scores.sigmoid() if record.logits else scores
        corners = boxes.view(-1, 2, 2).double()
        if record.box_format == "centre":  # shares of the whole width, from pixel edge to pixel edge
            centre, half = corners[:, 0], corners[:, 1] / 2
            corners = torch.stack([centre - half, centre + half], 1) * corners.new_tensor(size) - 0.5
        corners = to_image(corners, size, image).view(-1, 4)
        best = scores.argsort(descending=True, stable=True)
        best = best[self._kept(scores, corners)[best]]
        return Boxes(corners[best], scores[best])


def load_models(path: str | Path) -> dict[str, Callable]:
    """The models of a manifest by role; each keeps that role's protocol in `physpose_torch.table.roles`.

    A file is opened at its model's first call; where it is no ONNX model, lacks a named tensor or gives another shape
    than expected, that call raises DataError.

    Raises:
        DataError: as in `read_manifest`, or two models have one role.
    """
    kinds: dict[str, type[_Model]] = {
        "extractor": _Extractor,
        "matcher": _Matcher,
        "pair_matcher": _PairMatcher,
        "reconstructor": _Reconstructor,
        "detector": _Detector,
    }
    models: dict[str, _Model] = {}
    for record in read_manifest(path):
        if record.role in models:
            other = models[record.role].record.name
            raise DataError(f"{path}: {other!r} and {record.name!r} both are the {record.role}; keep one of them")
        if record.role in kinds:
            models[record.role] = kinds[record.role](record)
    return models
