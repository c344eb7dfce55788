"""Anti-aliased drawing on images, and the frame of title, legend and caption around them.

An image is (H, W, 3) float, 0 to 1, while it is drawn on. OpenCV, scipy, matplotlib (text) and pillow are imported on use.
"""

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from physpose_torch.errors import InvalidInputError
from physpose_torch.files import write_file

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["DARK", "SAMPLES", "SHIFT", "cover", "discs", "fixed", "framed", "lines", "mix", "outline", "rgb", "save"]

DARK = "#0b2545"
SHIFT = 4  # fractional bits of coordinates that OpenCV draws at
SAMPLES = 4  # samples per pixel and direction
_INK = "#33332f"


def rgb(color: str) -> np.ndarray:
    return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255


def mix(canvas: np.ndarray, color: str, alpha: np.ndarray) -> np.ndarray:
    return canvas + alpha[..., None] * (rgb(color) - canvas)


def cover(size: tuple[int, int], draw: Callable[[np.ndarray], object]) -> np.ndarray:
    """What share (H, W) of every pixel is covered by what `draw` sets to 255 in an image of `SAMPLES`² samples a pixel."""
    import cv2

    fine = np.zeros((size[0] * SAMPLES, size[1] * SAMPLES), np.uint8)
    draw(fine)
    return cv2.resize(fine, (size[1], size[0]), interpolation=cv2.INTER_AREA) / 255.0


def fixed(pixels: Tensor) -> np.ndarray:
    """Where pixels (..., 2) are in that image, as OpenCV wants it."""
    return (((pixels + 0.5) * SAMPLES - 0.5) * (1 << SHIFT)).round().numpy().astype(np.int64)


def lines(size: tuple[int, int], ends: Tensor, width: float) -> np.ndarray:
    """Cover (H, W) of lines between pixels (L, 2, 2)."""
    import cv2

    def draw(fine: np.ndarray) -> None:
        for a, b in fixed(ends).tolist():
            cv2.line(fine, a, b, 255, max(round(width * SAMPLES), 1), cv2.LINE_8, SHIFT)

    return cover(size, draw)


def discs(size: tuple[int, int], centres: Tensor, radius: float) -> np.ndarray:
    """Cover (H, W) of discs around pixels (M, 2)."""
    import cv2

    def draw(fine: np.ndarray) -> None:
        for at in fixed(centres).tolist():
            cv2.circle(fine, at, round(radius * SAMPLES * (1 << SHIFT)), 255, -1, cv2.LINE_8, SHIFT)

    return cover(size, draw)


def outline(canvas: np.ndarray, mask: np.ndarray, color: str, unit: float) -> np.ndarray:
    """The border of a mask (H, W) as a line, half of it inside."""
    import cv2
    from scipy.ndimage import gaussian_filter
    from scipy.special import ndtri

    mask = cv2.medianBlur(mask.astype(np.uint8), 3)  # scans have pinholes
    sigma = max(unit, 1.0)
    blurred = gaussian_filter(mask.astype(float), sigma, mode="nearest")
    distance = sigma * np.abs(ndtri(blurred.clip(1e-9, 1 - 1e-9)))  # of a straight border, exactly [px]
    canvas = mix(canvas, DARK, 0.35 * (0.5 + 1.5 * unit - distance).clip(0, 1))
    return mix(canvas, color, (0.5 + 0.8 * unit - distance).clip(0, 1))


def save(picture: "Image", path: str | Path, **options: Any) -> None:
    """Write an image file as a whole or not at all, in the format that its ending names. Options are pillow's.

    Raises:
        InvalidInputError: nothing is known that ends so.
        DataError: the file cannot be written; what was there before is kept.
    """
    from PIL import Image

    kind = Image.registered_extensions().get(Path(path).suffix.lower())
    if kind not in Image.SAVE:
        raise InvalidInputError(f"{path}: pictures are not written as {Path(path).suffix or 'files without ending'}; try .png")
    content = io.BytesIO()
    picture.save(content, kind, **options)
    write_file(path, content.getvalue())


def framed(
    canvas: np.ndarray,
    legend: Sequence[tuple[str | None, str]],
    title: str | None,
    caption: str | None,
    unit: float,
    notes: Sequence[tuple[str, Sequence[tuple[float, float]]]] = (),
) -> "Image":
    """The image (H, W, 3) uint8 with a legend, between a title and a caption.

    Args:
        legend: colour, or None, and text of each entry.
        unit: size of lines and letters; 1 suits an image 480 px high.
        notes: texts, each with the pixels (x, y) where its middle may be, best first; it is left out where it would cover
            the legend, another note or the border at all of them.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke
    from PIL import Image

    height, width = canvas.shape[:2]
    head, foot = (round(46 * unit) if title else 0), (round(44 * unit) if caption else 0)
    total = head + height + foot
    sheet = np.full((total, width, 3), 255, np.uint8)
    sheet[head : head + height] = canvas
    figure = Figure(figsize=(width / 100, total / 100), dpi=100, facecolor="white")
    agg = FigureCanvasAgg(figure)
    figure.figimage(sheet, 0, 0, origin="upper", zorder=-1)

    def text(x: float, y: float, value: str, size: float, **style: object) -> float:
        """Write, no wider than the picture; returns the width [px]."""
        written = figure.text(x / width, 1 - y / total, value, size=size * unit, va="center", color=_INK, **style)
        extent = written.get_window_extent(agg.get_renderer()).width
        if extent > 0.96 * width:
            written.set_size(size * unit * 0.96 * width / extent)
        return extent

    def box(x: float, y: float, w: float, h: float, **style: object) -> None:
        corner = (x / width, 1 - (y + h) / total)
        figure.add_artist(Rectangle(corner, w / width, h / total, transform=figure.transFigure, linewidth=0, **style))

    if title:
        text(width / 2, head / 2, title, 15, ha="center", weight="bold")
    if caption:
        text(width / 2, total - foot / 2, caption, 12.5, ha="center")
    taken = []
    if legend:
        margin, top, bottom = 8 * unit, head + height - 28 * unit, head + height - 8 * unit
        x, middle = margin + 7 * unit, (top + bottom) / 2
        for color, label in legend:
            if color is not None:
                box(x, middle - 1.5 * unit, 14 * unit, 3 * unit, facecolor=color, zorder=2)
                x += 19 * unit
            x += text(x, middle, label, 9, ha="left", zorder=3) + 12 * unit
        box(margin, top, x - 5 * unit - margin, bottom - top, facecolor="white", alpha=0.8, zorder=1)
        taken.append((margin, top - head, x - 5 * unit, bottom - head))
    for value, places in notes:
        written = figure.text(0, 0, value, size=8.5 * unit, ha="center", va="center", color="white", zorder=3)
        written.set_path_effects([withStroke(linewidth=2.2 * unit, foreground=DARK)])
        extent = written.get_window_extent(agg.get_renderer())
        w, h = extent.width / 2 + 2 * unit, extent.height / 2 + unit
        for x, y in places:
            inside = x - w >= 0 and y - h >= 0 and x + w <= width and y + h <= height
            if inside and all(x + w < a or x - w > c or y + h < b or y - h > d for a, b, c, d in taken):
                written.set_position((x / width, 1 - (head + y) / total))
                taken.append((x - w, y - h, x + w, y + h))
                break
        else:
            written.remove()
    agg.draw()
    return Image.fromarray(np.asarray(agg.buffer_rgba())[..., :3].copy())
