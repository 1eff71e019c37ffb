"""One picture for several techniques: the reference, the best of each beside it, and their errors below."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from torch_ssao.report.images import ERROR_COLOURS, ERROR_SPAN, figure_png
from torch_ssao.report.rows import Row, predict

if TYPE_CHECKING:
    from torch_ssao.report.measurement import Measurement

DPI = 100
GAP, HEAD = 8, 34
"""Pixels between pictures, and above them for two lines of text."""
GREYS, ERRORS = 128, 65
"""Colours of the file, at most 256."""
LEAST = 200
"""Pixels: smaller pictures are enlarged by a whole number, or the text over them would not fit."""


def best_of_each(measurement: Measurement) -> list[Row]:
    """The row of least RMSE on the judged views of each technique, fitted ones before untuned ones."""
    best = []
    for technique in measurement.techniques:
        own = [row for row in measurement.rows if row.technique == technique]
        best.append(min(own, key=lambda row: (not row.is_fitted, row.validation.rmse)))
    return best


def overview_png(measurement: Measurement) -> bytes:
    """PNG of the first judged view, a pixel of each picture a pixel of the file (or a few, of small pictures).

    Above: reference and the best model of each technique, visibility in linear grey, 255 = open, to two levels. Below:
    estimate minus reference, red too open, blue too dark. The numbers are those of the report's table, of all judged views.
    """
    from matplotlib.figure import Figure

    target = measurement.truth.visibility[0, 0].double().cpu().numpy()
    valid = measurement.truth.valid[0, 0].cpu().numpy()
    rows = best_of_each(measurement)
    zoom = -(-LEAST // target.shape[1])
    height, width = (zoom * side for side in target.shape)
    wide, high = (len(rows) + 1) * (width + GAP) + GAP, 2 * height + HEAD + 2 * GAP
    figure = Figure(figsize=(wide / DPI, high / DPI), dpi=DPI)

    def place(left: float, top: float, across: float, down: float) -> Any:
        """Axes at a rectangle of pixels."""
        return figure.add_axes((left / wide, 1 - (top + down) / high, across / wide, down / high))

    def show(column: int, image: np.ndarray, title: str, note: str) -> None:
        axes = place(GAP + column * (width + GAP), HEAD, width, height)
        axes.imshow(np.clip(image, 0, 1), cmap="gray", vmin=0, vmax=1, interpolation="nearest", aspect="auto")
        axes.set_axis_off()
        for text, size, up in ((note, 7, 3), (title, 9, 15)):
            axes.text(0, 1 + up / height, text, transform=axes.transAxes, fontsize=size, va="bottom")

    show(0, target, "ray-traced reference", f"{measurement.settings.samples} rays a pixel")
    for column, row in enumerate(rows, 1):
        image = predict(row.module, measurement.gbuffer[0])[0, 0].double().cpu().numpy()
        state = "fitted" if row.is_fitted else "untuned"
        note = f"RMSE {row.validation.rmse:.3f}, {row.timing.median_ms:.3g} ms"
        show(column, image, f"{row.label}, {state}", note)
        axes = place(GAP + column * (width + GAP), HEAD + GAP + height, width, height)
        _show_error(axes, np.where(valid, image - target, np.nan))
    _show_bar(place(GAP + 0.12 * width, HEAD + GAP + 1.5 * height, 0.76 * width, 10))
    return _with_palette(figure_png(figure))


def _with_palette(content: bytes) -> bytes:
    """The PNG with `GREYS` greys and `ERRORS` error colours: a third of the size, and grey is off by two levels at most."""
    from matplotlib import colormaps
    from PIL import Image

    grey = np.linspace(0, 255, GREYS)[:, None].repeat(3, 1)
    colours = 255 * colormaps[ERROR_COLOURS](np.linspace(0, 1, ERRORS))[:, :3]
    palette = np.rint(np.concatenate((grey, colours)))
    pixels = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
    used, where = np.unique(pixels.reshape(-1, 3), axis=0, return_inverse=True)
    # Pillow's own matching is approximate: white would become a light grey.
    nearest = ((used[:, None].astype(float) - palette) ** 2).sum(2).argmin(1).astype(np.uint8)
    picture = Image.fromarray(nearest[where.reshape(pixels.shape[:2])], "P")
    picture.putpalette(palette.astype(np.uint8).tobytes())
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _show_error(axes: Any, error: np.ndarray) -> None:
    from matplotlib import colormaps

    colours = colormaps[ERROR_COLOURS].with_extremes(bad="0.6")
    axes.imshow(error, cmap=colours, vmin=-ERROR_SPAN, vmax=ERROR_SPAN, interpolation="nearest", aspect="auto")
    axes.set_axis_off()


def _show_bar(axes: Any) -> None:
    axes.imshow(
        np.linspace(-1, 1, 256)[None], cmap=ERROR_COLOURS, aspect="auto", extent=(-ERROR_SPAN, ERROR_SPAN, 0, 1)
    )
    axes.set_yticks([])
    axes.set_xticks(
        [-ERROR_SPAN, 0, ERROR_SPAN], [f"-{ERROR_SPAN}\ntoo dark", "0", f"{ERROR_SPAN}\ntoo open"], fontsize=7
    )
    axes.set_title("estimate - reference", fontsize=8)
