"""Ways to keep a summed-area table precise, as pairs of functions with one signature; judged by `statvo_precision`.

`build(image)` takes a (1, H, W, 1) float32 image and returns a state; `box_mean(state, window)` returns the (N,) float64 means
of the piecewise-constant image over the N windows, exact integrals at fractional edges but for rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torch_ssao.ops import sat
from torch_ssao.ops.sat import Window

TILE = 32  # pixels; the float64 prefix tables take 16 / TILE bytes a pixel
FIXED_BITS = 38  # 2^38 levels times 4096^2 pixels fill 62 bits of an int64


@final
@dataclass(frozen=True)
class Candidate:
    """One way to build a table and to look means up in it.

    Args:
        name: for tables and plots.
        bytes_per_pixel: of the state, for one channel.
    """

    name: str
    bytes_per_pixel: float
    build: Callable[[Tensor], Any]
    box_mean: Callable[[Any, Window], Tensor]


def area(window: Window) -> Tensor:
    """(N,) pixels inside each window."""
    return ((window.x1 - window.x0) * (window.y1 - window.y0))[0]


def table_mean(table: Tensor, window: Window) -> Tensor:
    """The library's own lookup: values read in the table's dtype, combined in float64."""
    return sat.box_sum(table, window)[0, :, 0].double() / area(window)


def table_float32(image: Tensor) -> Tensor:
    """A table stored in float32. CPU torch accumulates its `cumsum` of float32 in float64; CUDA does not."""
    return pad(image, (0, 0, 1, 0, 1, 0)).cumsum(2).cumsum(1)


def table_accumulated_in_float32(image: Tensor) -> Tensor:
    """A table stored and accumulated in float32, one addition after the other (numpy, through the CPU)."""
    rows = np.cumsum(pad(image, (0, 0, 1, 0, 1, 0)).cpu().numpy(), axis=2, dtype=np.float32)
    return torch.from_numpy(np.cumsum(rows, axis=1, dtype=np.float32)).to(image.device)


class Centred(NamedTuple):
    mean: Tensor  # 0-d float32
    table: Any


def about_mean(build: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Centred]:
    """`build` applied to the image minus its mean."""

    def centred(image: Tensor) -> Centred:
        mean = image.mean(dtype=torch.float64).float()
        return Centred(mean, build(image - mean))

    return centred


def centred_mean(state: Centred, window: Window) -> Tensor:
    return table_mean(state.table, window) + state.mean.double()


class Tiles(NamedTuple):
    """Integral from the image's corner, in parts: inside the tile, the tiles left of it, all tile rows above."""

    local: Tensor  # (ny, T + 1, nx, T + 1) float32: integral of image - mean from the tile's corner
    mean: Tensor  # (ny, nx) float32
    left: Tensor  # (ny, T + 1, nx + 1) float64: over the tiles left of a tile, from its top to each pixel row of it
    above: Tensor  # (ny + 1, nx T + 1) float64: over the tile rows above, up to each pixel column


def tiled(image: Tensor) -> Tiles:
    """Float32 tables inside tiles, about the tile's mean; float64 sums from tile to tile."""
    _, height, width, _ = image.shape
    down, across = -(-height // TILE), -(-width // TILE)
    edge = (0, across * TILE - width, 0, down * TILE - height)
    padded = pad(image[None, ..., 0], edge, mode="replicate")[0] if max(edge) else image[..., 0]
    blocks = padded.reshape(down, TILE, across, TILE)
    row_sums = blocks.sum(3, dtype=torch.float64)  # (ny, T, nx)
    mean = (row_sums.sum(1) / TILE**2).float()
    residual = blocks - mean[:, None, :, None]
    local = image.new_zeros(down, TILE + 1, across, TILE + 1)
    local[:, 1:, :, 1:] = residual.cumsum(3).cumsum(1)
    left = pad(row_sums, (1, 0, 1, 0)).cumsum(2).cumsum(1)  # (ny, T + 1, nx + 1)
    above = pad(blocks.sum(1, dtype=torch.float64).view(down, across * TILE), (1, 0, 1, 0)).cumsum(1).cumsum(0)
    return Tiles(local, mean, left, above)


def tiled_mean(state: Tiles, window: Window) -> Tensor:
    columns = [_place(x[0], window.width) for x in (window.x0, window.x1)]
    rows = [_place(y[0], window.height) for y in (window.y0, window.y1)]
    (upper_left, upper_right), (lower_left, lower_right) = [[_integral(state, y, x) for x in columns] for y in rows]
    return ((lower_right - lower_left) - (upper_right - upper_left)) / area(window)


class _Place(NamedTuple):
    """A coordinate as tile, cell inside the tile and fraction inside the cell; `cell` and `tile` are int64."""

    tile: Tensor
    cell: Tensor
    fraction: Tensor
    offset: Tensor  # cell + fraction


def _place(position: Tensor, size: int) -> _Place:
    index = position.long().clamp(max=size - 1)
    tile = torch.div(index, TILE, rounding_mode="trunc")
    return _Place(tile, index - tile * TILE, position - index, position - tile * TILE)


def _integral(state: Tiles, y: _Place, x: _Place) -> Tensor:
    """(N,) float64 integral of the image over [0, x] x [0, y]."""
    across = state.mean.shape[1]
    line = across * (TILE + 1)
    row = y.tile * (TILE + 1) + y.cell  # of `local` and of `left`
    start = row * line + x.tile * (TILE + 1) + x.cell
    first, second = _lerp_pairs(state.local, start, x.fraction), _lerp_pairs(state.local, start + line, x.fraction)
    constant = state.mean.flatten().index_select(0, y.tile * across + x.tile) * (x.offset * y.offset)
    beside, flat = row * (across + 1) + x.tile, state.left.flatten()
    left = torch.lerp(flat.index_select(0, beside), flat.index_select(0, beside + across + 1), y.fraction)
    top = _lerp_pairs(state.above, y.tile * state.above.shape[1] + x.tile * TILE + x.cell, x.fraction)
    return torch.lerp(first, second, y.fraction) + constant + left + top


def _lerp_pairs(table: Tensor, start: Tensor, fraction: Tensor) -> Tensor:
    """Between each entry and its right neighbour, read together."""
    pair = table.reshape(-1).unfold(0, 2, 1).index_select(0, start).double()
    return torch.lerp(pair[:, 0], pair[:, 1], fraction)


class Fixed(NamedTuple):
    low: Tensor  # 0-d float64, the least value
    step: float  # a power of two
    table: Tensor  # (H + 1, W + 1) int64


def fixed_point(image: Tensor) -> Fixed:
    """Exact integer sums of the depth above its minimum, in 2^-38 of its range (rounded up to a power of two)."""
    wide = image[0, :, :, 0].double()
    low = wide.min()
    levels = 2.0 ** (FIXED_BITS - max(-300, int(np.ceil(np.log2(max(float(wide.max() - low), 1e-90))))))
    counts = ((wide - low) * levels).round().long()
    return Fixed(low, 1 / levels, pad(counts, (1, 0, 1, 0)).cumsum(1).cumsum(0))


def fixed_mean(state: Fixed, window: Window) -> Tensor:
    """Differences of neighbouring corners in integers, exact; only then their bilinear weights in float64."""
    lines = state.table.shape[1]
    pairs = state.table.reshape(-1).unfold(0, 2, 1)
    (left, to_left), (right, to_right) = (_cell(x[0], window.width) for x in (window.x0, window.x1))
    (upper, to_upper), (lower, to_lower) = (_cell(y[0], window.height) for y in (window.y0, window.y1))

    def read(row: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        first, second = (pairs.index_select(0, row * lines + column) for column in (left, right))
        return second[:, 0] - first[:, 0], first[:, 1] - first[:, 0], second[:, 1] - second[:, 0]

    top = read(upper)

    def below_top(row: Tensor) -> Tensor:
        width, at_left, at_right = (here - there for here, there in zip(read(row), top, strict=True))
        return width + at_right * to_right - at_left * to_left

    bottom = torch.lerp(below_top(lower), below_top(lower + 1), to_lower)
    return state.low + (bottom - below_top(upper + 1) * to_upper) * (state.step / area(window))


def _cell(position: Tensor, size: int) -> tuple[Tensor, Tensor]:
    index = position.long().clamp(max=size - 1)
    return index, position - index


CANDIDATES = (
    Candidate("float32", 4, table_float32, table_mean),
    Candidate("float32, accumulated in float32", 4, table_accumulated_in_float32, table_mean),
    Candidate("float32 - mean", 4, about_mean(table_float32), centred_mean),
    Candidate("float32 - mean, accumulated in float32", 4, about_mean(table_accumulated_in_float32), centred_mean),
    Candidate("tiled", 4 * (1 + 1 / TILE) ** 2 + 16 / TILE + 4 / TILE**2, tiled, tiled_mean),
    Candidate("float64", 8, sat.summed_area_table, table_mean),
    Candidate("int64 fixed point", 8, fixed_point, fixed_mean),
)
"""What `statvo_precision` compares; "float64" is the library's own table."""
