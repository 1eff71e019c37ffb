"""Pictures: visibility as linear 8-bit grey, signed errors in colour with a bar."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from torch_ssao import checks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ERROR_SPAN = 0.5
"""Errors are coloured from -0.5 to 0.5, the same in all pictures, so that they can be compared."""
ERROR_COLOURS = "RdBu_r"


def grey_png(visibility: Tensor) -> bytes:
    """PNG of a (H, W) or (1, H, W) visibility: linear 8-bit grey, round(255 visibility), no gamma; white is open.

    Raises: ShapeError for more than one image.
    """
    from PIL import Image, PngImagePlugin

    plane = _plane(visibility)
    levels = np.rint(255 * np.clip(np.nan_to_num(plane, nan=1.0), 0, 1)).astype(np.uint8)
    text = PngImagePlugin.PngInfo()
    text.add_text("Description", "ambient visibility, linear 8-bit grey, 255 = open")
    buffer = io.BytesIO()
    Image.fromarray(levels).save(buffer, "PNG", pnginfo=text, optimize=True)
    return buffer.getvalue()


def error_png(prediction: Tensor, target: Tensor, valid: Tensor) -> bytes:
    """PNG of prediction - target, all (1, H, W): red too open, blue too dark, white right, grey sees nothing."""
    from matplotlib.figure import Figure

    error = np.where(_plane(valid) > 0, _plane(prediction) - _plane(target), np.nan)
    height, width = error.shape
    figure = Figure(figsize=(6.0, 5.2 * height / width + 0.2), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    axes.set_facecolor("0.6")
    shown = axes.imshow(error, cmap=ERROR_COLOURS, vmin=-ERROR_SPAN, vmax=ERROR_SPAN, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    bar = figure.colorbar(shown, ax=axes, shrink=0.92, aspect=24, pad=0.02, extend="both")
    bar.set_label("estimate - reference (visibility)")
    return figure_png(figure)


def figure_png(figure: Figure) -> bytes:
    """PNG of a matplotlib figure, without a time stamp."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def write(path: Path, content: bytes) -> None:
    """Write a file in one step: it is there whole or not at all."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        if error.filename is None:  # a disk that fills up while a file is written
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def _plane(image: Tensor) -> np.ndarray:
    plane = image.detach().cpu().double().numpy()
    if plane.ndim == 3 and plane.shape[0] == 1:
        plane = plane[0]
    if plane.ndim != 2:
        raise checks.ShapeError(f"image must have shape (H, W) or (1, H, W), got {tuple(image.shape)}: pass one image")
    return plane
