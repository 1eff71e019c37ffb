"""A pyramid of selected pixels: far reads go to a coarser level, so that they stay near each other in memory.

A texel of level l stands for 2^l x 2^l pixels by one of them, never by their mean: no geometry is made up across edges, and
what a derivative reaches is that one pixel. It is one of the four texels of level l - 1 below it, in a rotated grid: the row
alternates with the column's parity and the column with the row's, so no row and no column of pixels is left out more than
another. Where that one is not valid, the first valid one of the other three is taken.

A read some pixels away takes level ceil(log2(distance / cap)), at most `LEVELS` - 1: it lies at most `cap` texels away.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

LEVELS = 6  # the coarsest texel is 32 pixels wide: with a cap of 32, reads reach 1,024 pixels


class Pyramid(NamedTuple):
    """Which pixel every texel stands for; none of it is differentiable."""

    pixel: Tensor  # (M,) flat pixels of the batch, level after level; the first are the pixels themselves
    start: Tensor  # (LEVELS,) first texel of each level
    cap: float  # furthest read, in texels of its level
    height: int
    width: int


def furthest_read(cap: float | None) -> float | None:
    """Distance in pixels that reads at most `cap` texels away reach at the coarsest level; None without a cap."""
    return None if cap is None else cap * 2 ** (LEVELS - 1)


def build_pyramid(valid: Tensor, cap: float) -> Pyramid:
    """Select the pixels of all levels.

    Args:
        valid: (B, H, W) bool.
        cap: furthest read, in texels of its level, > 0.
    Gradients: none.
    Cost: a third of the image, a few passes; 8 bytes a texel.
    """
    _, height, width = valid.shape
    pixel = torch.arange(valid.numel(), device=valid.device).view(valid.shape)
    levels, known, starts = [pixel.flatten()], valid, [0]
    for _ in range(LEVELS - 1):
        starts.append(starts[-1] + levels[-1].numel())
        pixel, known = _coarser(pixel, known)
        levels.append(pixel.flatten())
    return Pyramid(torch.cat(levels), torch.tensor(starts, device=valid.device), cap, height, width)


def texels_at(pyramid: Pyramid, image: Tensor, row: Tensor, column: Tensor, distance: Tensor) -> Tensor:
    """Texels that reads at whole pixels of the images take.

    Args:
        image, row, column: int64 that broadcast, inside the images; image has a dimension at least.
        distance: pixels from where the question is asked.
    Returns: int64 places in `Pyramid.pixel`.
    """
    level = torch.zeros_like(distance, dtype=torch.int32)
    for finer in range(LEVELS - 1):  # on a CPU faster than a search, and than a logarithm right on the bounds
        level += distance > pyramid.cap * 2**finer
    rows = ((pyramid.height - 1) >> level) + 1  # rounded up
    columns = ((pyramid.width - 1) >> level) + 1
    inside = (image * rows + (row.int() >> level)) * columns + (column.int() >> level)
    return _picked(pyramid.start, level) + inside


def pixels_of(pyramid: Pyramid, texels: Tensor) -> Tensor:
    """Flat pixels of the batch that texels stand for, of the same shape."""
    return _picked(pyramid.pixel, texels)


def _picked(table: Tensor, places: Tensor) -> Tensor:
    return table.index_select(0, places.flatten()).view(places.shape)  # on a CPU faster than indexing


def _coarser(pixel: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (B, h, w) of the next level, and whether they are valid."""
    _, height, width = pixel.shape
    row = torch.arange((height + 1) // 2, device=pixel.device)[:, None]
    column = torch.arange((width + 1) // 2, device=pixel.device)
    down, right = column % 2, row % 2  # the rotated grid
    chosen = chosen_known = None
    for turn in ((0, 0), (0, 1), (1, 0), (1, 1)):
        r, c = 2 * row + (down ^ turn[0]), 2 * column + (right ^ turn[1])
        inside = (r < height) & (c < width)
        r, c = r.clamp(max=height - 1), c.clamp(max=width - 1)
        candidate, candidate_known = pixel[:, r, c], known[:, r, c] & inside
        if chosen is None or chosen_known is None:
            chosen, chosen_known = candidate, candidate_known
            continue
        chosen = torch.where(chosen_known, chosen, torch.where(candidate_known, candidate, chosen))
        chosen_known = chosen_known | candidate_known
    return chosen, chosen_known  # type: ignore[return-value]
