"""Labelled strips and small plots, as palette PNGs below 150 kB."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

LIMIT = 150_000  # bytes


def strip(
    path: Path,
    rows: Sequence[Sequence[tuple[str, Tensor]]],
    *,
    title: str = "",
    low: float = 0.0,
    size: float = 2.4,
    names: Sequence[str] = (),
    boxes: Sequence[tuple[slice, slice]] = (),
) -> None:
    """Rows of grey images with captions; white is visibility 1, black is `low`."""
    across = max(len(row) for row in rows)
    tall, wide = rows[0][0][1].shape[-2:]
    figure = Figure(figsize=(size * across, (size * tall / wide + 0.3) * len(rows) + 0.3), dpi=100)
    figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    axes = figure.subplots(len(rows), across, squeeze=False)
    for number, (line, row) in enumerate(zip(axes, rows, strict=True)):
        for cell in line:
            cell.set_xticks([])
            cell.set_yticks([])
        for cell in line[len(row) :]:
            cell.axis("off")
        for cell, (caption, image) in zip(line, row, strict=False):
            plane = image.detach().cpu().double().numpy().reshape(image.shape[-2:])
            cell.imshow(plane, cmap="gray", vmin=low, vmax=1.0, interpolation="nearest")
            cell.set_title(caption, fontsize=8, pad=2)
        if names:
            line[0].set_ylabel(names[number], fontsize=8)
    if title:
        figure.suptitle(title, fontsize=9)
    save(path, figure)


def save(path: Path, figure: Figure) -> None:
    """Write a figure with as many palette colours as fit below the limit."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    whole = Image.open(buffer).convert("RGB")
    for colours in (256, 128, 64, 32, 24, 16):
        small = whole.quantize(colours, dither=Image.Dither.NONE)
        out = io.BytesIO()
        small.save(out, "PNG", optimize=True)
        if out.tell() < LIMIT:
            break
    else:
        raise ValueError(f"{path} takes {out.tell()} bytes even in 16 colours: make it smaller")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(out.getvalue())
    print(f"wrote {path} ({out.tell() // 1000} kB, {colours} colours)")


def crop(image: Tensor, rows: slice, columns: slice) -> Tensor:
    return image[..., rows, columns]


def curves(
    path: Path,
    panels: dict[str, dict[str, tuple[Sequence[float], Sequence[float]]]],
    *,
    x: str,
    y: str,
    log_x: bool = False,
) -> None:
    """Small plots of named lines side by side, by title."""
    figure = Figure(figsize=(1.2 + 4.2 * len(panels), 3.4), dpi=100, layout="constrained")
    styles = ("-o", "--s", ":^", "-.d", "-x", "--v")
    for axes, (title, lines) in zip(
        figure.subplots(1, len(panels), squeeze=False, sharey=True)[0], panels.items(), strict=True
    ):
        for (name, (at, values)), style in zip(lines.items(), np.resize(styles, len(lines)), strict=True):
            axes.plot(at, values, style, label=name, markersize=4)
        if log_x:
            axes.set_xscale("log", base=2)
            axes.set_xticks(sorted({a for at, _ in lines.values() for a in at}))
            axes.get_xaxis().set_major_formatter("{x:g}")
        axes.set_xlabel(x)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.set_title(title, fontsize=9)
    first = figure.axes[0]
    first.set_ylabel(y)
    first.legend(fontsize=8)
    save(path, figure)
