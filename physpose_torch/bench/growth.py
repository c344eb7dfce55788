"""How cost and memory grow with the parts of an object, the objects of an image, and the images of a batch.

Generated scenes: cans, each cut into parts like a cake, crowded on a table. Every size runs in a process of its own,
so that its peak memory is its own.
"""

import math
import multiprocessing
import resource
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from physpose_torch import se3
from physpose_torch.bench.images import BenchImage, batch_of
from physpose_torch.bench.machine import seconds_of
from physpose_torch.bench.scenes import make_config, seconds_per_iteration
from physpose_torch.commands.common import table
from physpose_torch.distance.broadphase import instance_bounds, meeting_pairs
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.geometry.convex import ConvexParts
from physpose_torch.household import perturb_like_estimator
from physpose_torch.refiner import PhysPoseRefiner
from physpose_torch.scene import Scene

__all__ = ["GrowthCase", "bench_growth", "cake_body", "cake_image", "growth_table", "measure_growth", "sweep"]

RADIUS = 0.04
"""[m], of an object."""
HEIGHT = 0.04
"""[m]."""
ARC_POINTS = 12
"""Vertices of a part on the top rim: 24 to 26 in all."""
OVERLAP = 0.004
"""[m]; how far neighbours stand in each other, so that there is something to push apart."""
STEPS = 20


@dataclass(frozen=True)
class GrowthCase:
    """One size."""

    parts: int = 8
    """Convex parts of an object."""
    objects: int = 6
    """Objects in an image."""
    images: int = 4
    varied: str = "images"
    """Which of the three the sweep varies."""
    backend: str = "auto"
    device: str = "cpu"
    threads: int = 1
    seed: int = 0


def sweep(base: GrowthCase, parts: Sequence[int], objects: Sequence[int], images: Sequence[int]) -> list[GrowthCase]:
    """Vary one number at a time."""
    sizes = {"parts": parts, "objects": objects, "images": images}
    return [replace(base, **{name: n}, varied=name) for name, numbers in sizes.items() for n in numbers]


def bench_growth(
    cases: Sequence[GrowthCase],
    *,
    isolated: bool = True,
    on_row: Callable[[dict[str, Any]], None] = lambda row: None,
) -> list[dict[str, Any]]:
    """One row a size, with the exponent from the size before it.

    Args:
        cases: sizes, ascending within each sweep.
        isolated: a process for each; otherwise all here, and the memory of one is hidden by that of the ones before.
        on_row: called with each row as it is ready.
    """
    rows: list[dict[str, Any]] = []
    for case in cases:
        if isolated:
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(1, mp_context=context) as pool:
                row = pool.submit(measure_growth, case).result()
        else:
            row = measure_growth(case)
        before = rows[-1] if rows and rows[-1]["varied"] == case.varied else None
        row["exponent"] = _exponent(before, row)
        rows.append(row)
        on_row(row)
    return rows


def measure_growth(case: GrowthCase) -> dict[str, Any]:
    """Time and peak memory of one size.

    Memory on the CPU is the resident set: the peak while the scene is built and refined, less what the process held
    after it had refined a tiny scene (libraries and compiled kernels). On CUDA it is the peak of torch's allocator.
    """
    torch.set_num_threads(case.threads)
    device = torch.device(case.device)
    config = replace(make_config("default", case.backend), steps=STEPS)
    tiny = _batch(replace(case, parts=1, objects=2, images=1), device)
    _refine(tiny, config)
    _reset_peak(device)
    before = _resident()
    batch = _batch(case, device)
    _refine(batch, replace(config, steps=2))
    call = seconds_of(lambda: _refine(batch, config), device, repeats=3)
    iteration = seconds_per_iteration(batch, config, device, repeats=5)
    peak = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else max(_peak() - before, 0)
    return {
        **asdict(case),
        "size": getattr(case, case.varied),
        "part_pairs": _near_pairs(batch[0], batch[1].cpu()),
        "ms_per_iteration": 1e3 * iteration,
        "ms_per_call": 1e3 * call,
        "steps": STEPS,
        "peak_mib": peak / 2**20,
        "resident_before_mib": before / 2**20,
    }


@cache
def cake_body(parts: int) -> Body:
    """A can, 40 mm in radius and high, cut like a cake: its outline is the same whatever the number of parts."""
    ends = np.linspace(0, 2 * math.pi, parts + 1)
    hulls = []
    for start, end in pairwise(ends):
        angle = np.linspace(start, end, ARC_POINTS, endpoint=parts > 1)
        arc = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        outline = np.concatenate([arc, np.zeros((int(parts > 2), 2))])
        hulls.append(np.concatenate([np.c_[outline, np.full(len(outline), z)] for z in (-HEIGHT / 2, HEIGHT / 2)]))
    mesh = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=48)
    return Body(f"can in {parts} parts", ConvexParts.from_hulls(hulls), mesh)


def cake_image(parts: int, objects: int, *, seed: int = 0, overlap: float = OVERLAP) -> BenchImage:
    """Objects in a square on a table before a camera, neighbours overlapping, with the errors of an RGB estimator."""
    tilt = math.radians(40)
    up = torch.tensor([0.0, -math.cos(tilt), -math.sin(tilt)], dtype=torch.float64)
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    R = torch.stack([x, torch.linalg.cross(up, x), up], dim=1)
    T_camera_table = se3.from_rotation_translation(R, torch.tensor([0.0, 0.0, 0.8], dtype=torch.float64))
    side, spacing = math.ceil(math.sqrt(objects)), 2 * RADIUS - overlap
    k = torch.arange(objects, dtype=torch.float64)
    column, row = torch.remainder(k, side), torch.div(k, side, rounding_mode="floor")
    middle = (side - 1) / 2
    where = torch.stack([spacing * (column - middle), spacing * (row - middle), torch.full_like(k, HEIGHT / 2)], dim=1)
    turn = torch.stack([0 * k, 0 * k, k], dim=1)
    truth = T_camera_table @ se3.from_rotation_translation(se3.exp_so3(turn), where)
    scene = Scene.tabletop([cake_body(parts)] * objects, Plane.from_pose(T_camera_table))
    return BenchImage(scene, perturb_like_estimator(truth, seed=seed))


def _batch(case: GrowthCase, device: torch.device):
    images = [cake_image(case.parts, case.objects, seed=case.seed + i) for i in range(case.images)]
    scene, poses, _ = batch_of(images)
    return scene, poses.to(device), None


def _refine(batch, config):
    return PhysPoseRefiner(config)(batch[1], batch[0])


def _near_pairs(scene: Scene, poses: torch.Tensor) -> int:
    """Part pairs whose boxes meet at the estimates."""
    entity = scene.instance_entity
    gravity = scene.gravity[scene.entity_image[entity]]
    bounds = instance_bounds(poses[entity], scene.parts, scene.instance_part, gravity)
    return len(meeting_pairs(bounds, entity, scene.instance_start, scene.near_pairs(poses, 0.0)))


def _exponent(before: dict[str, Any] | None, row: dict[str, Any]) -> float | None:
    """p where cost grows like size^p from one size to the next."""
    if before is None or min(before["ms_per_iteration"], row["ms_per_iteration"]) <= 0:
        return None
    return math.log(row["ms_per_iteration"] / before["ms_per_iteration"]) / math.log(row["size"] / before["size"])


def _reset_peak(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # Linux: the high-water mark starts anew
    except OSError:
        return


def _status(key: str) -> int | None:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(x.split()[1]) for x in lines if x.startswith(key)), None)


def _peak() -> int:
    """Bytes of the largest resident set so far."""
    unit = 1 if sys.platform == "darwin" else 1024
    return _status("VmHWM:") or unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _resident() -> int:
    return _status("VmRSS:") or _peak()


def growth_table(rows: list[dict[str, Any]]) -> str:
    """The rows as text."""
    header = [
        "varied",
        "parts",
        "objects",
        "images",
        "part pairs",
        "ms/iteration",
        "grows like",
        "ms/call",
        "peak [MiB]",
    ]
    cells = []
    for r in rows:
        exponent = "" if r["exponent"] is None else f"n^{r['exponent']:.2f}"
        sizes = [str(r[k]) for k in ("parts", "objects", "images", "part_pairs")]
        times = [f"{r['ms_per_iteration']:.2f}", exponent, f"{r['ms_per_call']:.1f}", f"{r['peak_mib']:.0f}"]
        cells.append([r["varied"], *sizes, *times])
    return table(header, cells)
