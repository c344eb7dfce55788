"""How well the table's plane is found from one or two images with noisy poses, and what poses gain by it.

Angle: between the normals. Offset: signed distance of the centre of the objects' footprints (the mean of their true origins,
on the true table) from the estimated plane. Within 3σ: the squared Mahalanobis distance of (two tilts, height at the objects'
middle) by the plane's covariance is below 14.16, the quantile of χ² with three degrees of freedom that three standard
deviations are in one dimension. Confidently wrong: more than 5° or 25 mm off, without a warning.
"""

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from physpose_torch import se3
from physpose_torch.bench.table_scenes import TableScene, generated_scenes, pair_scenes
from physpose_torch.bop.pose_error import mssd
from physpose_torch.commands.common import progress, table
from physpose_torch.config import TableConfig
from physpose_torch.contacts import object_heights
from physpose_torch.distance.smoothing import tangent_basis
from physpose_torch.errors import InvalidInputError, TableNotFoundError
from physpose_torch.geometry.body import Body, Plane
from physpose_torch.refiner import PhysPoseRefiner, silent_doubts
from physpose_torch.scene import Scene
from physpose_torch.table.estimator import TableEstimate, TableEstimator
from physpose_torch.table.view import View

__all__ = ["TableOptions", "deviation", "measure", "plane_errors", "run_tables", "summarise"]

THREE_SIGMA = 14.16
"""χ² with three degrees of freedom is below this with probability 0.9973."""
WRONG_ANGLE, WRONG_OFFSET = 5.0, 25.0
"""[deg] and [mm]; farther off is wrong."""
NEEDS_TWO = ("homography", "paper")
"""Methods that one image gives nothing to do."""
WITHOUT_DATA = 5
"""Generated scenes where there are no others and none are asked for: one for each table."""
SURFACE = 500
"""Vertices of an object that the surface distance is measured at."""

Method = Literal["support", "homography", "paper", "joint", "auto"]


@dataclass(frozen=True)
class TableOptions:
    """What is estimated how often."""

    draws: int = 20
    """Draws of the poses' errors, each scene."""
    generated: int = 0
    """Generated scenes; 0: five if there is no data, else none."""
    skip_pairs: bool = False
    """Leave out table_pairs/."""
    methods: tuple[Method, ...] = ("support", "homography", "paper", "joint", "auto")
    """Of the table estimator. homography and paper are left out where there is one view."""
    bias: tuple[float, ...] = (0.0, 0.02)
    """Relative errors of all distances together."""
    views: tuple[Literal[1, 2], ...] = (1, 2)
    """Images."""
    features: Literal["auto", "sift", "xfeat"] = "auto"
    """Which matches."""
    models: tuple[Literal["models", "models_textured"], ...] = ("models",)
    """Meshes without colours, with colours, or both."""
    gravity_sigma_deg: float | None = None
    """The direction of gravity is given, disturbed by this much per axis [deg]. Default: it is not given."""
    downstream: bool = False
    """Also refine the poses of view 0 with the plane that was found, and with the true one. Decomposes the meshes."""
    real: bool = False
    """The two real YCB-V images with depth, instead of all this; see bench/real_tables.py."""


def run_tables(results: dict[str, Any], options: TableOptions, data: Path | None, seed: int) -> None:
    """Every data set, kind of mesh, number of views and bias: a table each."""
    _check(options)
    if data is None and os.environ.get("PHYSPOSE_DATA"):
        data = Path(os.environ["PHYSPOSE_DATA"])
    estimators = {m: TableEstimator(_config(m, options)) for m in options.methods}
    if options.real:
        from physpose_torch.bench.real_tables import run_real

        return run_real(results, options, estimators, data)
    scenes = [] if data is None or options.skip_pairs else list(pair_scenes(data))
    count = options.generated or (0 if scenes else WITHOUT_DATA)
    scenes += generated_scenes(count, seed)
    groups = [
        (dataset, models, views, bias)
        for dataset in dict.fromkeys(s.dataset for s in scenes)
        for models in options.models
        for views in options.views
        for bias in options.bias
    ]
    results["table_scenes"], results["tables"] = [], []
    for dataset, models, views, bias in groups:
        chosen = [s for s in scenes if s.dataset == dataset]
        what = {"dataset": dataset, "models": models, "views": views, "bias": bias}
        given = {m: e for m, e in estimators.items() if views == 2 or m not in NEEDS_TWO}
        rows = []
        with progress(
            len(chosen) * options.draws, f"{dataset}, {models}, {views} view(s), bias {bias:g}", "draw"
        ) as bar:
            for scene in chosen:
                bodies = scene.bodies(models, decomposed=options.downstream)
                for draw in range(options.draws):
                    for row in _one_draw(scene, bodies, draw, views, bias, given, options, seed):
                        rows.append({**what, **row})
                        results["table_scenes"].append(rows[-1])
                    bar.update()
        print(f"\n{dataset}, {len(chosen)} scenes × {options.draws} draws; {models}, {views} view(s), bias {bias:g}")
        summary = [{**what, **summarise(m, [r for r in rows if r["method"] == m])} for m in given]
        results["tables"] += summary
        print(tables_table(summary), flush=True)
        if options.downstream:
            print(f"\nthe same, refined\n{downstream_table(rows, list(given))}")
        for row in rows:
            if row["crashed"] or row["wrong"]:
                print(f"  {'crashed' if row['crashed'] else 'wrong'}: {describe_row(row)}")


def measure(
    estimator: Callable[..., TableEstimate],
    views: Sequence[View],
    bodies: Sequence[Body],
    plane: Plane,
    middle: Tensor,
    gravity: Tensor | None = None,
) -> tuple[dict[str, Any], TableEstimate | None]:
    """What an estimator found, against the true plane at a point on it; and the estimate, None where it failed."""
    row: dict[str, Any] = {"failure": None, "crashed": False, "warnings": [], "wrong": False}
    start = time.perf_counter()
    try:
        estimate = estimator(views, bodies, gravity=gravity)
    except TableNotFoundError as error:
        return {**row, "failure": str(error), "seconds": time.perf_counter() - start}, None
    except Exception as error:  # a bug: the others are measured all the same, and it is told
        failure = f"{type(error).__name__}: {error}"
        return {**row, "failure": failure, "crashed": True, "seconds": time.perf_counter() - start}, None
    found = estimate.plane
    angle, offset = plane_errors(found, plane, middle)
    off = deviation(estimate, bodies, plane)
    row |= {
        "seconds": time.perf_counter() - start,
        "angle_deg": angle,
        "offset_mm": offset,
        "mahalanobis_squared": float(off @ torch.linalg.pinv(estimate.covariance, hermitian=True) @ off),
        "sigma_tilt_deg": math.degrees(estimate.sigma_tilt),
        "sigma_offset_mm": 1e3 * estimate.sigma_offset,
        "depth_factor": estimate.depth_factor,
        "inliers": estimate.inliers,
        "standing": int(estimate.standing.sum()),
        "used": estimate.method,
        "warnings": list(estimate.warnings),
        "wrong": not estimate.warnings and (angle > WRONG_ANGLE or abs(offset) > WRONG_OFFSET),
    }
    return row, estimate


def plane_errors(found: Plane, plane: Plane, middle: Tensor) -> tuple[float, float]:
    """Angle between the normals [deg], and signed distance from the plane that was found to a point of the true one [mm]."""
    sine = torch.linalg.vector_norm(torch.linalg.cross(found.normal, plane.normal))
    angle = math.degrees(math.atan2(float(sine), float(found.normal @ plane.normal)))
    return angle, 1e3 * float(found.normal @ middle - found.offset)


def deviation(estimate: TableEstimate, bodies: Sequence[Body], plane: Plane) -> Tensor:
    """(3,) of the true plane from the estimated one in the coordinates of its covariance: two tilts [rad], height [m]."""
    centers = torch.stack([b.center for b in bodies])
    middle = se3.apply(estimate.poses, centers[:, None])[:, 0].mean(0)
    found = estimate.plane
    tilt = -(tangent_basis(found.normal[None])[0] @ plane.normal)
    height = (plane.offset - plane.normal @ middle) - (found.offset - found.normal @ middle)
    return torch.cat([tilt, height[None]])


def summarise(method: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of the rows of one method: quantiles of errors, coverage, failures."""
    found = [r for r in rows if r["failure"] is None]
    out: dict[str, Any] = {"method": method, "estimates": len(rows)}
    for key in ("angle_deg", "offset_mm"):
        errors = np.abs([r[key] for r in found]) if found else np.array([math.nan])
        out |= {
            f"{key}_{name}": float(np.quantile(errors, q))
            for name, q in (("median", 0.5), ("p90", 0.9), ("worst", 1.0))
        }
    inside = [r["mahalanobis_squared"] <= THREE_SIGMA for r in found]
    return out | {
        "within_3_sigma": float(np.mean(inside)) if found else math.nan,
        "failures": sum(r["failure"] is not None and not r["crashed"] for r in rows),
        "crashed": sum(r["crashed"] for r in rows),
        "warned": sum(bool(r["warnings"]) for r in rows),
        "wrong": sum(r["wrong"] for r in rows),
        "seconds_median": float(np.median([r["seconds"] for r in rows])) if rows else math.nan,
    }


def tables_table(summary: Sequence[dict[str, Any]]) -> str:
    """The summaries as text."""
    header = ["method", "angle [deg]", "90 %", "worst", "|offset| [mm]", "90 %", "worst", "within 3σ [%]"]
    header += ["failed", "warned", "confidently wrong", "s"]
    cells = []
    for s in summary:
        angle, offset = ([s[f"{k}_{q}"] for q in ("median", "p90", "worst")] for k in ("angle_deg", "offset_mm"))
        counts = [s["failures"] + s["crashed"], s["warned"], s["wrong"]]
        numbers = [*_numbers(angle, 2), *_numbers(offset, 1), *_numbers([100 * s["within_3_sigma"]], 0)]
        cells.append([s["method"], *numbers, *(f"{c}/{s['estimates']}" for c in counts), f"{s['seconds_median']:.1f}"])
    return table(header, cells)


def downstream_table(rows: Sequence[dict[str, Any]], methods: Sequence[str]) -> str:
    """Errors of poses as estimated, refined with the plane that was found, and with the true one, where one was found."""
    header = ["method", "draws", "centre [mm]", "found", "true", "surface [mm]", "found", "true"]
    header += ["deepest in table [mm]", "found", "true"]
    cells = []
    for method in methods:
        of = [r["downstream"] for r in rows if r["method"] == method and "downstream" in r]
        keys = [(which, k) for k in ("centre_mm", "surface_mm", "deepest_mm") for which in ("input", "found", "true")]
        means = [float(np.mean([d[which][k] for d in of])) if of else math.nan for which, k in keys]
        cells.append([method, str(len(of)), *_numbers(means, 1)])
    return table(header, cells)


def describe_row(row: dict[str, Any]) -> str:
    """One estimate in words."""
    where = f"{row['method']}, scene {row['scene']}, draw {row['draw']}"
    if row["failure"] is not None:
        return f"{where}: {row['failure']}"
    sigma = f"± {row['sigma_tilt_deg']:.2f}°, {row['sigma_offset_mm']:.1f} mm"
    return f"{where}: {row['angle_deg']:.2f}°, {row['offset_mm']:.1f} mm {sigma}; {'; '.join(row['warnings'])}".rstrip(
        "; "
    )


def _one_draw(scene: TableScene, bodies, draw, views, bias, estimators, options, seed):
    """A row for each method."""
    given = scene.views(views, draw, bias, seed=seed)
    gravity = None
    if options.gravity_sigma_deg is not None:
        rng = np.random.default_rng([seed, scene.key, draw, 1])
        turn = torch.from_numpy(rng.normal(0.0, math.radians(options.gravity_sigma_deg), 3))
        gravity = -se3.exp_so3(turn) @ scene.plane.normal
    with_truth: dict[str, dict[str, float]] = {}
    for method, estimator in estimators.items():
        row, estimate = measure(estimator, given, bodies, scene.plane, scene.middle, gravity)
        if options.downstream and estimate is not None:
            truth = Scene.tabletop(bodies, scene.plane)
            if not with_truth:
                with silent_doubts():
                    refined = PhysPoseRefiner()(given[0].poses, truth).poses
                with_truth = {"input": _errors(given[0].poses, scene, truth), "true": _errors(refined, scene, truth)}
            with silent_doubts():
                refined = PhysPoseRefiner()(given[0].poses, Scene.tabletop(bodies, estimate.plane)).poses
            row["downstream"] = {**with_truth, "found": _errors(refined, scene, truth)}
        yield {"scene": scene.name, "draw": draw, "method": method, **row}


def _errors(poses: Tensor, scene: TableScene, truth: Scene) -> dict[str, float]:
    """Means over the objects, and the depth of the deepest in the true table."""
    centre, surface = [], []
    for T, T_true, body in zip(poses, scene.truth[0], truth.objects, strict=True):
        vertices = torch.from_numpy(np.asarray(body.mesh.vertices))
        some = vertices[:: max(1, len(vertices) // SURFACE)]
        surface.append(float(mssd(T, T_true, some, torch.eye(4, dtype=T.dtype)[None])))
        a, b = (se3.apply(X, body.center[None])[0] for X in (T, T_true))
        centre.append(float(torch.linalg.vector_norm(a - b)))
    deepest = -float(object_heights(poses, truth).min())
    errors = {"centre_mm": np.mean(centre), "surface_mm": np.mean(surface), "deepest_mm": max(deepest, 0.0)}
    return {k: 1e3 * float(v) for k, v in errors.items()}


def _numbers(values: Sequence[float], digits: int) -> list[str]:
    return ["-" if math.isnan(x) else f"{x:.{digits}f}" for x in values]


def _config(method: str, options: TableOptions) -> TableConfig:
    sigma = options.gravity_sigma_deg
    known = {"sigma_gravity": math.radians(sigma)} if sigma else {}
    return TableConfig(method=method, features=options.features, **known)


def _check(options: TableOptions) -> None:
    if options.draws < 1 or options.generated < 0:
        raise InvalidInputError(f"--draws {options.draws}, --generated {options.generated}: expected at least 1 and 0")
    for name in ("methods", "bias", "views", "models"):
        if not getattr(options, name):
            raise InvalidInputError(f"--{name}: name at least one")
    if any(not -0.5 < b < 0.5 for b in options.bias):
        raise InvalidInputError(f"--bias {options.bias}: expected fractions, 0.02 for two percent")
    if options.gravity_sigma_deg is not None and not 0 <= options.gravity_sigma_deg < 45:
        raise InvalidInputError(f"--gravity-sigma-deg {options.gravity_sigma_deg}: expected 0 to 45 degrees")
