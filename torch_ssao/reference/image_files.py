"""A renderer's own ambient-occlusion pass as a target: PNG, TIFF or JPEG (Pillow) and EXR (OpenEXR)."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ssao import checks

GREY = ("V", "Y", "A", "R")
"""EXR channels that are looked for, in this order, when none is named; "ao.V" counts as "V"."""


def load_image(path: str | Path, *, channel: str | int | None = None, srgb: bool = False) -> Tensor:
    """Visibility from an image file, for `fitting.fit` and `fitting.select`.

    Args:
        path: .exr, or what Pillow reads: 8 and 16 bit, 65535 or 255 = 1.
        channel: name of an EXR channel ("AO.V"), or index of a band of other files; None for the first of `GREY`, or the
            first band.
        srgb: whether the values are sRGB-encoded and to be linearised. Renderers write AO passes as EXR linear; a PNG
            saved through a view transform is not.
    Returns: (1, 1, H, W) float32, not clamped: a reader sees values above 1 rather than losing them.
    Raises: SceneError for a file that cannot be read or lacks the channel; MissingExtraError without Pillow or OpenEXR.
    Cost: the file's pixels in memory once or twice.
    """
    file = Path(path)
    if not file.is_file():
        raise checks.SceneError(
            f"path must be an image file, got {str(path)!r}, which is not there: check its spelling"
        )
    try:
        values = _exr(file, channel) if file.suffix.lower() == ".exr" else _picture(file, channel)
    except (OSError, RuntimeError, SyntaxError) as error:
        raise checks.SceneError(f"path {str(path)!r} cannot be read as an image ({error}): write it anew") from error
    if srgb:
        values = np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))[None, None]


def _picture(file: Path, channel: str | int | None) -> NDArray[Any]:
    _require("PIL", "pillow", "scenes")
    from PIL import Image

    with Image.open(file) as image:
        values = np.asarray(image.convert("RGB") if image.mode in ("P", "CMYK") else image)
    bands = values[..., None] if values.ndim == 2 else values
    index = 0 if channel is None else channel
    if not isinstance(index, int) or not 0 <= index < bands.shape[2]:
        raise checks.SceneError(
            f"channel must be an index below {bands.shape[2]} in {file.name}, got {channel!r}: 0 is grey or red"
        )
    band = bands[..., index]
    if band.dtype == np.uint8:
        return band / np.float32(255)
    if band.dtype.kind in "iu":  # Pillow gives 16-bit greys as uint16 or int32
        return band / np.float32(65535)
    return band.astype(np.float32)


def _exr(file: Path, channel: str | int | None) -> NDArray[Any]:
    _require("OpenEXR", "OpenEXR", "exr")
    import OpenEXR

    with OpenEXR.File(str(file), separate_channels=True) as opened:
        channels = {name: np.array(found.pixels) for name, found in opened.channels().items()}
    name = _choose(channels) if channel is None else channel
    if name not in channels:
        raise checks.SceneError(
            f"channel must be one of {', '.join(channels)} in {file.name}, got {channel!r}: pass one"
        )
    return channels[name]  # type: ignore[index]


def _choose(channels: Mapping[str, Any]) -> str:
    ranked = [name for wanted in GREY for name in channels if name.split(".")[-1] == wanted]
    return ranked[0] if ranked else next(iter(channels))


def _require(module: str, package: str, extra: str) -> None:
    if importlib.util.find_spec(module) is None:
        raise checks.MissingExtraError(
            f"load_image needs {package}, which is not installed: run pip install torch_ssao[{extra}]"
        )
