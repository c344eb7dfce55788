"""What a number was measured on: machine, threads and versions; and how a duration is measured."""

import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from physpose_torch.errors import InvalidInputError

__all__ = ["Duration", "describe_machine", "find_device", "seconds_of"]

PACKAGES = ("physpose-torch", "torch", "warp-lang", "numpy", "python-fcl", "coal")

Duration = float
"""Seconds."""


def find_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        InvalidInputError: there is no such device here.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InvalidInputError(f"--device {name}: {error}") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError(f"--device {name}: torch {torch.__version__} sees no CUDA device; use --device cpu")
    if device.type not in ("cpu", "cuda"):
        raise InvalidInputError(f"--device {name}: expected cpu or cuda")
    return device


def describe_machine(device: torch.device) -> dict[str, Any]:
    """Processor, threads, versions: plain values that JSON can hold."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_before": [round(x, 2) for x in os.getloadavg()] if hasattr(os, "getloadavg") else None,
        "torch_threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def seconds_of(
    run: Callable[[], Any],
    device: torch.device,
    *,
    repeats: int,
    patience: Duration = 20.0,
    least: Duration = 0.0,
) -> Duration:
    """Median duration of ``run``, which the caller has warmed up.

    Args:
        run: what to time.
        device: synchronised before and after.
        repeats: how often, if ``patience`` [s] is not used up before.
        patience: no new repeat after this.
        least: more repeats until they took this long together [s], for what is over in an instant.
    """
    times: list[float] = []
    begin = time.perf_counter()
    while True:
        times.append(_once(run, device))
        elapsed = time.perf_counter() - begin
        if elapsed > patience or (len(times) >= repeats and elapsed >= least):
            return statistics.median(times)


def _once(run: Callable[[], Any], device: torch.device) -> Duration:
    """A CUDA call returns before its work is done, so both ends are synchronised."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    start = time.perf_counter()
    run()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), platform.machine())


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
