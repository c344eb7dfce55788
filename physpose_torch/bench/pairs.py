"""Time and error of every distance backend, and of plain library loops, on the same part pairs."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from physpose_torch.bench.loops import LOOPS, Loop, installed_loops
from physpose_torch.bench.machine import seconds_of
from physpose_torch.bench.part_pairs import PartPairs
from physpose_torch.commands.common import table
from physpose_torch.config import Smoothing
from physpose_torch.distance.autograd import backends, drop_distance, signed_distance

__all__ = ["batches_table", "bench_batches", "bench_pairs", "errors_of", "pairs_table"]

WELL_APART = 1e-3
"""[m]; python-fcl is asked directly only about pairs that a separating axis proves to be farther apart than this."""
TOLERANCE = {"float64": 1e-9, "float32": 1e-5}
"""[m]; a distance smaller than this may have either sign."""
DROP_LIMIT = 0.05
"""[m], as the default ``gravity_reach``."""
REPEATS = 5
LEAST = 0.3
"""[s]; what is faster is repeated more often."""
CALLS = (1, 10, 100, 1000, 10000)
"""Pairs in one call."""


def bench_pairs(
    sets: list[PartPairs],
    device: torch.device,
    *,
    judged: bool,
    names: tuple[str, ...] = (),
    on_row: Callable[[dict[str, Any]], None] = lambda row: None,
) -> list[dict[str, Any]]:
    """One row for each backend, dtype and kind of pairs.

    A backend gets all pairs of a kind in one call of ``signed_distance``, poses in, distances and witness points out.
    The loops get shapes and transforms ready-made, and only the loop is timed. Times are medians after a warm-up.

    Args:
        sets: pairs by kind, see :func:`~physpose_torch.bench.part_pairs.make_part_pairs`.
        device: where the backends' tensors are.
        judged: whether the pairs' distances are the oracle's, so that errors mean something.
        names: these backends only; empty: all that are installed, and the loops.
        on_row: called with each row as it is ready.
    """
    rows = []
    for row in _rows(sets, device, judged, names):
        on_row(row)
        rows.append(row)
    return rows


def _rows(sets, device, judged, names) -> Iterator[dict[str, Any]]:
    for backend in [b for b in backends() if not names or b in names]:
        for dtype in (torch.float64, torch.float32):
            for pairs in sets:
                yield _backend_row(pairs, backend, dtype, device, judged)
            yield from _further_rows(sets[0], backend, dtype, device)
    for name in [x for x in installed_loops() if not names or x in names]:
        for pairs in sets:
            row = _loop_row(pairs, name, judged)
            if row is not None:
                yield row


def bench_batches(
    pairs: PartPairs,
    device: torch.device,
    *,
    names: tuple[str, ...] = (),
    on_row: Callable[[dict[str, Any]], None] = lambda row: None,
) -> list[dict[str, Any]]:
    """Time of a pair, float64, by the number of pairs in a call: what a call costs however small it is."""
    rows = []
    for backend in [b for b in backends() if not names or b in names]:
        for count in [n for n in CALLS if n <= 3 * len(pairs)]:
            T_a, T_b, _, parts, index = _tensors(pairs.rows(np.arange(count) % len(pairs)), torch.float64, device)

            def run(T_a=T_a, T_b=T_b, parts=parts, index=index, backend=backend):
                return signed_distance(T_a, T_b, parts, index, backend=backend)

            run()
            seconds = seconds_of(run, device, repeats=REPEATS, least=LEAST)
            rows.append(_row(backend, "float64", pairs.kind, count, seconds))
            on_row(rows[-1])
    return rows


def errors_of(distance: np.ndarray, truth: np.ndarray, tolerance: float) -> dict[str, Any]:
    """What is wrong with distances (E,) [m]: largest and 99.9th percentile error, wrong signs, NaNs.

    A sign is wrong where it differs and the true distance is at least ``tolerance`` [m] from zero. NaNs (and infinities)
    are counted on their own and left out of the rest.
    """
    finite = np.isfinite(distance)
    error = np.abs(distance - truth)[finite]
    wrong = (np.sign(distance) != np.sign(truth)) & (np.abs(truth) > tolerance) & finite
    return {
        "error_max_m": float(error.max()) if len(error) else None,
        "error_p999_m": float(np.quantile(error, 0.999)) if len(error) else None,
        "wrong_signs": int(wrong.sum()),
        "nan": int((~finite).sum()),
    }


def _backend_row(pairs: PartPairs, backend: str, dtype: torch.dtype, device: torch.device, judged: bool) -> dict:
    T_a, T_b, _, parts, index = _tensors(pairs, dtype, device)

    def run():
        return signed_distance(T_a, T_b, parts, index, backend=backend).distance

    distance = run().double().cpu().numpy()  # compiles, fills the caches of the parts: the warm-up
    row = _row(backend, _name(dtype), pairs.kind, len(pairs), seconds_of(run, device, repeats=REPEATS, least=LEAST))
    return row | (errors_of(distance, pairs.distance, TOLERANCE[_name(dtype)]) if judged else {})


def _further_rows(pairs: PartPairs, backend: str, dtype: torch.dtype, device: torch.device) -> Iterator[dict]:
    """What else a refinement asks for, timed only: gradients through smoothed witness points, and falls."""
    T_a, T_b, gravity, parts, index = _tensors(pairs, dtype, device)
    leaf_a, leaf_b, smoothing = T_a.clone().requires_grad_(), T_b.clone().requires_grad_(), Smoothing()

    def gradient():
        distance = signed_distance(leaf_a, leaf_b, parts, index, backend=backend, smoothing=smoothing).distance
        return torch.autograd.grad(distance.sum(), (leaf_a, leaf_b))

    def drop():
        with torch.no_grad():
            return drop_distance(T_a, T_b, parts, index, gravity, limit=DROP_LIMIT, backend=backend)

    for kind, run in (("gradient", gradient), ("drop", drop)):
        run()
        yield _row(backend, _name(dtype), kind, len(pairs), seconds_of(run, device, repeats=REPEATS, least=LEAST))


def _loop_row(pairs: PartPairs, name: str, judged: bool) -> dict[str, Any] | None:
    _, make, well_apart = LOOPS[name]
    if well_apart:
        pairs = pairs.rows(np.flatnonzero(_proven_gap(pairs) > WELL_APART))
    if len(pairs) == 0:
        return None
    loop: Loop = make(pairs.hulls(), pairs.pairs.numpy(), *pairs.relative())
    distance, _ = loop()
    kind = f"{pairs.kind} > 1 mm" if well_apart else pairs.kind
    row = _row(name, "float64", kind, len(pairs), seconds_of(loop, torch.device("cpu"), repeats=REPEATS, least=LEAST))
    return row | (errors_of(distance, pairs.distance, TOLERANCE["float64"]) if judged else {})


def _proven_gap(pairs: PartPairs) -> np.ndarray:
    """Width (E,) of the slab along each pair's normal that separates its parts [m]: they are at least this far apart."""
    padded = pairs.parts.padded.double()
    R, t = (torch.from_numpy(x) for x in pairs.relative())
    normal = torch.from_numpy(pairs.normal)
    a, b = pairs.pairs.unbind(1)
    top = torch.einsum("evi,ei->ev", padded[a], normal).amax(1)
    low = torch.einsum("evi,ei->ev", padded[b] @ R.mT + t[:, None], normal).amin(1)
    return (low - top).numpy()


def _tensors(pairs: PartPairs, dtype: torch.dtype, device: torch.device):
    poses = (x.to(device, dtype) for x in (pairs.T_a, pairs.T_b, pairs.gravity))
    return *poses, pairs.parts.to(device=device, dtype=dtype), pairs.pairs.to(device)


def _row(backend: str, dtype: str, kind: str, count: int, seconds: float) -> dict[str, Any]:
    return {
        "backend": backend,
        "dtype": dtype,
        "kind": kind,
        "pairs": count,
        "us_per_pair": 1e6 * seconds / count,
        "pairs_per_second": count / seconds,
    }


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def pairs_table(rows: list[dict[str, Any]]) -> str:
    """The rows as text; a dash where nothing was judged."""
    header = [
        "backend",
        "dtype",
        "pairs",
        "number",
        "µs/pair",
        "pairs/s",
        "max error [m]",
        "99.9 % [m]",
        "wrong",
        "NaN",
    ]
    cells = []
    for row in rows:
        errors = ["-"] * 4
        if row.get("error_max_m") is not None:
            errors = [f"{row['error_max_m']:.1e}", f"{row['error_p999_m']:.1e}"]
        if "nan" in row:
            errors = [*errors[:2], str(row["wrong_signs"]), str(row["nan"])]
        cells.append(
            [
                row["backend"],
                row["dtype"],
                row["kind"],
                str(row["pairs"]),
                f"{row['us_per_pair']:.2f}",
                f"{row['pairs_per_second']:.0f}",
                *errors,
            ]
        )
    return table(header, cells)


def batches_table(rows: list[dict[str, Any]]) -> str:
    """Rows of :func:`bench_batches` as text."""
    header = ["backend", "pairs in a call", "µs/pair", "µs/call"]
    numbers = [(r["backend"], r["pairs"], r["us_per_pair"]) for r in rows]
    return table(header, [[b, str(n), f"{us:.2f}", f"{us * n:.1f}"] for b, n, us in numbers])
