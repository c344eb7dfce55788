"""Milliseconds of whole refinements, by number of images in the batch.

Three figures, because each alone would flatter:

- **new scene**: a call on a scene that was just put together, as ``physpose refine`` and most callers do it, with
  everything that is derived from it on first use. ``Scene.cat`` itself is left out and stated beside it.
- **same scene**: the call once more, as in a video of the same objects.
- **per iteration**: (time of N steps - time of N/4 steps) / (3N/4) on the same scene, with ``tolerance=0`` so that no
  image stops. So it holds no preparation and no final report, and every iteration holds the full batch. Total time
  divided by steps would count the former in, and later steps that hold few images.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from physpose_torch.bench.images import BenchImage, batch_of
from physpose_torch.bench.machine import seconds_of
from physpose_torch.commands import PRESETS
from physpose_torch.commands.common import table
from physpose_torch.config import RefinerConfig
from physpose_torch.errors import InvalidInputError
from physpose_torch.refiner import PhysPoseRefiner, silent_doubts

__all__ = ["bench_scenes", "make_config", "scenes_table", "seconds_per_iteration"]

SLOW = ("fcl", "fcl-isolated")
"""Backends that work pair by pair in Python, about a second an image."""
SLOW_LIMIT = 16
"""More images than this are left out for them unless asked for."""
MOST_STEPS = 60
"""Iterations are timed over at most this many steps: the paper's preset takes 3000."""
PATIENCE = 10.0
"""[s] after which the slope is not measured again."""
TIMES = ("ms_per_image", "ms_per_image_same_scene", "ms_per_iteration", "ms_scene_per_image")


def make_config(preset: str, backend: str) -> RefinerConfig:
    """The preset with a backend.

    Raises:
        InvalidInputError: unknown preset.
    """
    if preset not in PRESETS:
        raise InvalidInputError(f"preset {preset!r}: expected one of {', '.join(PRESETS)}")
    config = PRESETS[preset]()
    return replace(config, physics=replace(config.physics, backend=backend))


def bench_scenes(
    images: Sequence[BenchImage],
    counts: Sequence[int],
    configs: Sequence[tuple[str, RefinerConfig]],
    device: torch.device,
    *,
    repeats: int = 3,
    patience: float = 20.0,
    keep_slow: bool = False,
    on_row: Callable[[dict[str, Any]], None] = lambda row: None,
) -> tuple[list[dict[str, Any]], list[str]]:
    """One row for each configuration and number of images; and notes on what was left out.

    Every repeat takes other images, as far as there are enough; times are medians over the repeats, and what else is told
    (objects, steps, cost, penetration, gap) is that of the first batch.

    Args:
        images: to be cycled through.
        counts: images in a batch.
        configs: preset's name and configuration.
        device: of the poses.
        repeats: batches per row.
        patience: [s]; ends a row earlier. A single call that takes longer is not repeated, so the iteration is not timed.
        keep_slow: also run backends in :data:`SLOW` on more than :data:`SLOW_LIMIT` images.
        on_row: called with each row as it is ready.
    """
    rows, notes = [], []
    for preset, config in configs:
        for count in counts:
            backend = config.physics.backend
            if backend in SLOW and count > SLOW_LIMIT and not keep_slow:
                notes.append(f"{backend} with {count} images left out: minutes; --keep-slow runs it")
                continue
            rows.append(_row(images, count, preset, config, device, repeats, patience))
            on_row(rows[-1])
    return rows, notes


def _row(images, count, preset, config, device, repeats, patience) -> dict[str, Any]:
    samples: list[dict[str, float]] = []
    first = _batch(images, count, 0, device)
    _refine(first, replace(config, steps=min(config.steps, 2)))  # compiles, and loads what is loaded lazily
    begin = time.perf_counter()
    while len(samples) < repeats and (not samples or time.perf_counter() - begin < patience):
        samples.append(_sample(images, count, len(samples), config, device, patience))
    # times are medians; the rest is that of the first batch, the same for every configuration
    median = {key: statistics.median(s[key] for s in samples) if key in TIMES else x for key, x in samples[0].items()}
    return {
        "images": count,
        "backend": config.physics.backend,
        "preset": preset,
        "threads": torch.get_num_threads(),
        "repeats": len(samples),
        "step_limit": config.steps,
        **median,
    }


def _sample(images, count, repeat, config, device, patience) -> dict[str, float]:
    start = time.perf_counter()
    batch = _batch(images, count, repeat, device)
    scene_seconds = time.perf_counter() - start
    results = []
    new = seconds_of(lambda: results.append(_refine(batch, config)), device, repeats=1)
    same = iteration = math.nan
    if new < patience:
        same = seconds_of(lambda: _refine(batch, config), device, repeats=1)
        iteration = seconds_per_iteration(batch, config, device, repeats=3)
    result, report = results[0], results[0].report
    gap = report.gap[report.gap.isfinite()]
    return {
        "objects": float(len(batch[0])),
        "ms_per_image": 1e3 * new / count,
        "ms_per_image_same_scene": 1e3 * same / count,
        "ms_per_iteration": 1e3 * iteration,
        "ms_scene_per_image": 1e3 * scene_seconds / count,
        "steps_mean": float(result.steps.double().mean()),
        "cost_per_object": float(result.terms.total.mean()) if len(batch[0]) else 0.0,
        "penetration_mean_mm": 1e3 * float(report.penetration.mean()) if len(batch[0]) else 0.0,
        "gap_mean_mm": 1e3 * float(gap.mean()) if len(gap) else 0.0,
    }


def seconds_per_iteration(batch, config: RefinerConfig, device: torch.device, *, repeats: int = 1) -> float:
    """Slope of time over steps with every image running, median of the repeats; the caller has warmed up."""
    many = min(config.steps, MOST_STEPS)
    few = many // 4
    if many <= few:
        return math.nan
    slopes: list[float] = []
    begin = time.perf_counter()
    while len(slopes) < repeats and (not slopes or time.perf_counter() - begin < PATIENCE):
        short, long = (  # one right after the other: what else the machine does slows both
            seconds_of(lambda n=n: _refine(batch, replace(config, steps=n, tolerance=0.0)), device, repeats=1)
            for n in (few, many)
        )
        slopes.append((long - short) / (many - few))
    return statistics.median(slopes)


def _refine(batch, config: RefinerConfig):
    scene, poses, scores = batch
    with silent_doubts():
        return PhysPoseRefiner(config)(poses, scene, scores=scores)


def _batch(images, count, repeat, device):
    chosen = [images[(repeat * count + i) % len(images)] for i in range(count)]
    scene, poses, scores = batch_of(chosen)
    return scene, poses.to(device), scores


def scenes_table(rows: list[dict[str, Any]]) -> str:
    """The rows as text."""
    header = ["images", "backend", "preset", "objects", "steps", "ms/iteration", "ms/image", "same scene"]
    header += ["Scene.cat", "cost/object", "inside [mm]", "gap [mm]", "repeats"]
    cells = []
    for r in rows:
        numbers = [r["objects"], r["steps_mean"]]
        times = ["ms_per_iteration", "ms_per_image", "ms_per_image_same_scene", "ms_scene_per_image"]
        quality = ["cost_per_object", "penetration_mean_mm", "gap_mean_mm"]
        cells.append(
            [
                str(r["images"]),
                *(r[k] for k in ("backend", "preset")),
                *(f"{x:.0f}" for x in numbers),
                *("-" if math.isnan(r[k]) else f"{r[k]:.2f}" for k in [*times, *quality]),
                str(r["repeats"]),
            ]
        )
    return table(header, cells)
