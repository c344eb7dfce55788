"""Cost against size, as a picture."""

import io
from pathlib import Path
from typing import Any

from physpose_torch.bench.loops import LOOPS
from physpose_torch.errors import InvalidInputError, MissingExtraError
from physpose_torch.files import write_file

__all__ = ["picture_format", "plot_costs"]

COLORS = ("#2563a8", "#d1671f", "#2f8f5b", "#8a4fa3", "#a3333d", "#6b6b6b")
MARKERS = ("o", "s", "^", "D", "v", "P")


def picture_format(path: Path) -> str:
    """What kind of picture a path's ending asks for; PNG without one.

    Raises:
        InvalidInputError: matplotlib cannot write this kind of file.
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
    except ImportError as error:
        raise MissingExtraError("--plot needs matplotlib; pip install matplotlib") from error
    kind, known = path.suffix[1:].lower() or "png", FigureCanvasAgg.get_supported_filetypes()
    if kind not in known:
        raise InvalidInputError(f"{path}: a picture's name ends in one of {', '.join(sorted(known))}")
    return kind


def plot_costs(path: Path, results: dict[str, Any]) -> None:
    """Log-log plots of whatever was measured: pairs in a call, images in a batch, growth with each size.

    Args:
        path: picture to write; its ending says the format, as :func:`picture_format` reads it.
        results: with any of the keys ``batches``, ``scenes`` and ``growth``, and ``machine``.

    Raises:
        InvalidInputError: nothing in the results has a size, or matplotlib cannot write this kind of file.
        DataError: the file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    panels = [
        draw for key, draw in (("batches", _batches), ("scenes", _scenes), ("growth", _growth)) if results.get(key)
    ]
    if not panels:
        raise InvalidInputError("nothing to plot: no cost against a size was measured")
    kind = picture_format(path)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    figure = Figure(figsize=(5.2 * len(panels), 5.0), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    for draw, axes in zip(panels, figure.subplots(1, len(panels), squeeze=False)[0], strict=True):
        draw(axes, results)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.grid(True, which="major", color="0.88", linewidth=0.8)
        axes.grid(True, which="minor", color="0.95", linewidth=0.5)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncol=2)
    machine = results.get("machine", {})
    threads = machine.get("torch_threads")
    where = machine.get("cpu") if machine.get("device") == "cpu" else machine.get("device")
    figure.supxlabel(
        f"{where}, {threads} torch thread{'s' if threads != 1 else ''}", fontsize=8, color="0.4", x=0.99, ha="right"
    )
    picture = io.BytesIO()
    figure.savefig(picture, format=kind)
    write_file(path, picture.getvalue())


def _batches(axes, results) -> None:
    """Time of a part pair against pairs in one call; the loops, whose cost has no such size, as lines."""
    rows = results["batches"]
    for i, (backend, of) in enumerate(_grouped(rows, ("backend",)).items()):
        _line(axes, i, [r["pairs"] for r in of], [r["us_per_pair"] for r in of], backend[0])
    loops = [r for r in results.get("pairs", []) if r["kind"].startswith("apart") and r["backend"] in LOOPS]
    for i, row in enumerate(loops):
        axes.axhline(
            row["us_per_pair"],
            color="0.45",
            linestyle=("--", ":")[i % 2],
            linewidth=1.2,
            label=f"{row['backend']}, a loop",
        )
    axes.set_xlabel("part pairs in one call")
    axes.set_ylabel("time per pair [µs]")
    axes.set_title("Signed distance", fontsize=11)


def _scenes(axes, results) -> None:
    keys = ("backend", "preset")
    groups = _grouped(results["scenes"], keys)
    telling = [i for i in range(len(keys)) if len({g[i] for g in groups}) > 1] or [0]
    for i, (group, of) in enumerate(groups.items()):
        name = ", ".join(group[k] for k in telling)
        images = [r["images"] for r in of]
        _line(axes, i, images, [r["ms_per_image"] for r in of], f"{name}: refinement")
        _line(axes, i, images, [r["ms_per_iteration"] / r["images"] for r in of], f"{name}: one iteration", dashed=True)
    axes.set_xlabel("images in a batch")
    axes.set_ylabel("time per image [ms]")
    axes.set_title("Refinement", fontsize=11)


def _growth(axes, results) -> None:
    rows = results["growth"]
    names = {"parts": "parts of an object", "objects": "objects in an image", "images": "images in a batch"}
    tested = list(dict.fromkeys(r["backend"] for r in rows))
    for (backend, varied), of in _grouped(rows, ("backend", "varied")).items():
        name = names[varied] if len(tested) == 1 else f"{backend}: {names[varied]}"
        times = [r["ms_per_iteration"] for r in of]
        _line(axes, list(names).index(varied), [r["size"] for r in of], times, name, dashed=backend != tested[0])
    largest = max(r["size"] for r in rows)
    least = min((r["ms_per_iteration"] for r in rows if r["ms_per_iteration"] > 0), default=1.0)
    if largest > 1:
        axes.plot([1, largest], [least, least * largest], color="0.6", linewidth=1, linestyle=":", label="proportional")
    axes.set_xlabel("size")
    axes.set_ylabel("time per iteration [ms]")
    base = {k: _commonest([r[k] for r in rows]) for k in names}
    title = "Growth of an iteration"
    about = f"else {base['parts']} parts, {base['objects']} objects, {base['images']} images; {', '.join(tested)}"
    axes.set_title(f"{title}\n", fontsize=11)
    axes.text(0.5, 1.02, about, transform=axes.transAxes, ha="center", fontsize=8.5, color="0.4")


def _line(axes, i: int, x: list[float], y: list[float], label: str, *, dashed: bool = False) -> None:
    points = [(a, b) for a, b in zip(x, y, strict=True) if b > 0]  # noise may turn a slope negative: no logarithm
    if not points:
        return
    color, marker = COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]
    style = {"linestyle": "--", "markerfacecolor": "white"} if dashed else {"linestyle": "-"}
    axes.plot(*zip(*points, strict=True), color=color, marker=marker, markersize=5, linewidth=1.6, label=label, **style)


def _grouped(rows: list[dict[str, Any]], keys: tuple[str, ...]) -> dict[tuple, list[dict[str, Any]]]:
    groups: dict[tuple, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[k] for k in keys), []).append(row)
    return groups


def _commonest(values: list[Any]) -> Any:
    return max(set(values), key=values.count)
