"""The manifest by which a user names ONNX models of their own; models/README.md describes the format."""

import hashlib
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from physpose_torch.errors import DataError
from physpose_torch.reading import inside, load_json, shown

__all__ = ["ROLES", "ModelRecord", "read_manifest"]

ROLES: dict[str, tuple[set[str], set[str]]] = {  # inputs and outputs that an entry must name
    "extractor": ({"image"}, {"keypoints", "descriptors"}),
    "matcher": ({"points_0", "points_1", "descriptors_0", "descriptors_1"}, {"matches", "scores"}),
    "pair_matcher": ({"image_0", "image_1"}, {"points_0", "points_1"}),
    "reconstructor": ({"image_0", "image_1"}, {"points_0", "points_1", "confidence_0", "confidence_1"}),
    "detector": ({"image"}, {"boxes", "scores"}),
    "part": (set(), set()),  # of a model that has its own program, as XFeat has: listed, but not loaded
}
OPTIONAL: dict[str, set[str]] = {
    "extractor": {"scores"},
    "pair_matcher": {"scores"},
    "detector": {"input_ids", "attention_mask", "token_type_ids", "pixel_mask"},
}


@dataclass(frozen=True)
class ModelRecord:
    """One entry of a manifest, checked."""

    name: str
    role: str
    """A key of `ROLES`."""
    file: Path
    """Absolute."""
    inputs: dict[str, str]
    """This package's names → tensors of the graph."""
    outputs: dict[str, str]
    sha256: str | None = None
    source: str | None = None
    licence: str | None = None
    shapes: dict[str, list] | None = None
    """Of the graph's tensors; only for the reader."""
    size: tuple[int, int] | None = None
    """Width and height the graph wants; None: those of the image. For a matcher: those of the images."""
    multiple_of: int = 1
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)
    channels: int = 3
    threshold: float = 0.0
    """Smallest score that is kept."""
    normalised: bool = True
    """A matcher's points: LightGlue's (x - W / 2) / (max(W, H) / 2); False: pixels."""
    prompt: str | None = None
    """The one thing a detector finds."""
    input_ids: list[int] | None = None
    """The prompt's tokens."""
    box_format: str = "corners"
    """x_min, y_min, x_max, y_max in pixels of the graph; or "centre": x, y, width and height as shares of the image."""
    logits: bool = False
    """A detector's scores want a sigmoid."""


LARGEST_SIDE = 16_384
"""[px]; of what a graph wants."""


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e9  # NaN is not


_NAMES = (
    lambda v: isinstance(v, dict) and all(isinstance(n, str) for n in v.values()),
    "an object of our name: tensor name",
)
_NUMBERS = (
    lambda v: isinstance(v, list) and len(v) in (1, 3) and all(map(_is_number, v)),
    "1 or 3 numbers",
)
_TEXT = (lambda v: isinstance(v, str) and v != "", "a string")
_WHOLE = (lambda v: type(v) is int and 0 < v <= LARGEST_SIDE, f"an integer from 1 to {LARGEST_SIDE}")
_EXPECTED: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(["name", "file", "sha256", "source", "licence", "prompt"], _TEXT),
    "role": (lambda v: isinstance(v, str) and v in ROLES, " or ".join(ROLES)),
    "inputs": _NAMES,
    "outputs": _NAMES,
    "shapes": (lambda v: isinstance(v, dict), "an object of tensor name: shape"),
    "size": (lambda v: isinstance(v, list) and len(v) == 2 and all(map(_WHOLE[0], v)), "[width, height] in pixels"),
    "multiple_of": _WHOLE,
    "mean": _NUMBERS,
    "std": (lambda v: _NUMBERS[0](v) and 0 not in v, f"{_NUMBERS[1]} but 0"),
    "channels": (lambda v: v in (1, 3), "1 (grey) or 3 (RGB)"),
    "threshold": (_is_number, "a number"),
    "normalised": (lambda v: isinstance(v, bool), "true or false"),
    "logits": (lambda v: isinstance(v, bool), "true or false"),
    "input_ids": (lambda v: isinstance(v, list) and all(type(i) is int and abs(i) < 2**63 for i in v), "a list of integers"),
    "box_format": (lambda v: v in ("corners", "centre"), '"corners" or "centre"'),
}


def read_manifest(path: str | Path) -> list[ModelRecord]:
    """The models that a manifest names, after all checks that need no ONNX runtime.

    Raises:
        DataError: the manifest or one of its entries is not as described, a file is missing, lies outside the manifest's
            folder or has another checksum.
    """
    path = Path(path)
    content = load_json(path)
    entries = content.get("models") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise DataError(f'{path}: expected {{"models": [{{...}}, ...]}}; models/README.md has an example')
    records = [_read_entry(entry, f"{path}: models[{k}]", path.parent.resolve()) for k, entry in enumerate(entries)]
    names = [r.name for r in records]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise DataError(f"{path}: the name {twice[0]!r} is given to {names.count(twice[0])} models; rename all but one")
    return records


def _read_entry(entry: dict[str, Any], where: str, folder: Path) -> ModelRecord:
    if unknown := sorted(set(entry) - set(_EXPECTED)):
        raise DataError(f"{where} has unknown keys {unknown}, expected some of {list(_EXPECTED)}")
    needed = [f.name for f in fields(ModelRecord) if f.default is MISSING]
    if missing := [key for key in needed if entry.get(key) is None]:
        raise DataError(f"{where} lacks {missing}; every model needs {needed}")
    given = {key: value for key, value in entry.items() if value is not None}  # null is the same as nothing
    for key, value in given.items():
        holds, expected = _EXPECTED[key]
        if not holds(value):
            raise DataError(f"{where}: {key} = {shown(value)}, expected {expected}")
    if wrong := [key for key in ("mean", "std") if len(given.get(key, [0])) not in (1, given.get("channels", 3))]:
        raise DataError(f"{where}: {wrong[0]} has 3 numbers, but channels = 1; give one")
    role = given["role"]
    for kind, must in zip(("inputs", "outputs"), ROLES[role], strict=True):
        if missing := sorted(must - set(given[kind])):
            raise DataError(f"{where}: {kind} lack {missing}; a model in the role {role} has {sorted(must)}")
        if role != "part" and (unknown := sorted(set(given[kind]) - must - OPTIONAL.get(role, set()))):
            raise DataError(f"{where}: {kind} name {unknown}, unknown to the role {role}; expected {sorted(must)}")
    try:
        file = inside(folder, given["file"])
    except ValueError as error:
        raise DataError(f"{where}: file = {error}") from None
    if not file.is_file():
        raise DataError(f"{where}: {file} does not exist; correct file, or put the model there")
    if "sha256" in given:
        with file.open("rb") as stream:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
        if found != given["sha256"].lower():
            raise DataError(
                f"{file} has sha256 {found}, expected {given['sha256']}; get the file again, or correct {where}"
            )
    for key in ("size", "mean", "std"):
        if key in given:
            given[key] = tuple(given[key])
    return ModelRecord(**{**given, "file": file})
