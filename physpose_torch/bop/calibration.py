"""The file that ``physpose calibrate`` writes and ``physpose refine --calibration`` takes: millimetres and degrees."""

import json
import math
import os
from collections.abc import Mapping
from typing import Any

from physpose_torch.config import Calibration
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.files import write_file
from physpose_torch.reading import load_json, shown

__all__ = ["read_calibration", "write_calibration"]

_FIELDS = {
    "depth_factor": ("depth_factor", 1.0),
    "sigma_ray_fraction": ("sigma_ray_fraction", 1.0),
    "sigma_depth_common": ("sigma_depth_common", 1.0),
    "sigma_lateral_mm": ("sigma_lateral", 1e-3),
    "sigma_rotation_deg": ("sigma_rotation", math.pi / 180),
}
"""Name in the file → name of the field, and what its numbers are multiplied by."""


def write_calibration(path: str | os.PathLike, calibration: Calibration, **more: Any) -> None:
    """Write a calibration, and what else there is to say about it, as JSON; DataError if that cannot be done."""
    content = {name: getattr(calibration, field) / unit for name, (field, unit) in _FIELDS.items()}
    interval = {
        name: [x / unit for x in calibration.interval[field]]
        for name, (field, unit) in _FIELDS.items()
        if field in calibration.interval
    }
    write_file(path, json.dumps({**content, "interval": interval, **more}, indent=2) + "\n")


def read_calibration(path: str | os.PathLike) -> Calibration:
    """Read a calibration file; ``sigma_depth_common`` and ``interval`` may be missing, and unknown keys are left alone.

    Raises:
        DataError: the file is missing or broken, or a number is missing or impossible.
    """
    content = load_json(path)
    if not isinstance(content, Mapping):
        raise DataError(f"{path}: expected an object with {', '.join(_FIELDS)}; make it with physpose calibrate")
    values, interval = {}, {}
    for name, (field, unit) in _FIELDS.items():
        if name not in content and field == "sigma_depth_common":
            continue
        values[field] = _number(content.get(name), path, name) * unit
    bounds = content.get("interval") or {}
    if not isinstance(bounds, Mapping):
        raise DataError(f"{path}: interval is {shown(bounds)}, expected {{name: [low, high]}}")
    for name, pair in bounds.items():
        if name in _FIELDS:
            if not isinstance(pair, list) or len(pair) != 2:
                raise DataError(f"{path}: interval of {name} is {shown(pair)}, expected [low, high]")
            field, unit = _FIELDS[name]
            interval[field] = tuple(_number(x, path, f"interval of {name}") * unit for x in pair)
    try:
        return Calibration(**values, interval=interval)
    except InvalidInputError as error:
        raise DataError(f"{path}: {error}; make it with physpose calibrate") from error


def _number(value: Any, path: str | os.PathLike, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        raise DataError(f"{path}: {name} is {shown(value)}, expected a finite number; make it with physpose calibrate")
    return float(value)
