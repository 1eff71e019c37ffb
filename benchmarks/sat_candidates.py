"""Ways to keep a summed-area table precise, as pairs of functions with one signature; judged by `statvo_precision`.

`build(image)` takes an (H, W) float32 image and returns a state; `box_mean(state, boxes)` returns the float64 means of the
piecewise-constant image over the boxes, exact integrals at fractional edges but for rounding.
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

TILE = 32  # pixels; the float64 prefix tables take 16 / TILE bytes a pixel
FIXED_BITS = 38  # 2^38 levels times 4096^2 pixels fill 62 bits of an int64


class Boxes(NamedTuple):
    """Rectangles in pixels inside an image, all (R, S) float64 and not empty; pixel j covers [j, j + 1]."""

    x0: Tensor
    x1: Tensor
    y0: Tensor
    y1: Tensor
    height: int
    width: int

    def map(self, change: Callable[[Tensor], Tensor]) -> Boxes:
        return Boxes(*(change(edge) for edge in self[:4]), self.height, self.width)

    @property
    def area(self) -> Tensor:
        return (self.x1 - self.x0) * (self.y1 - self.y0)


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
    box_mean: Callable[[Any, Boxes], Tensor]

    def means(self, state: Any, boxes: Boxes) -> Tensor:
        """(R, S) means, in the blocks of rows that the library itself works in: what fits a core's cache."""
        rows, columns = boxes.x0.shape
        blocks = sat.row_blocks(slice(0, rows), columns, 4, boxes.x0.device)
        return torch.cat([self.box_mean(state, boxes.map(lambda edge, at=at: edge[at])) for at in blocks])


def table_float64(image: Tensor) -> Tensor:
    return sat.summed_area_table(image[None, None])


def library_mean(table: Tensor, boxes: Boxes) -> Tensor:
    """The library's lookup."""
    lattice = sat.Lattice((boxes.x0[None], boxes.x1[None]), (boxes.y0[None], boxes.y1[None]))
    return sat.cell_sums(table, lattice)[0, 0, 0] / boxes.area


def gathered_mean(table: Tensor, boxes: Boxes) -> Tensor:
    """A lookup that reads in the table's dtype and combines in float64.

    `grid_sample` of a float32 table takes float32 coordinates, which at 4096 pixels are 1e-4 of a pixel coarse: a worse error.
    """
    flat, line = table.reshape(-1), table.shape[-1]
    pairs = flat.unfold(0, 2, 1)
    (left, to_left), (right, to_right) = (_cell(x.flatten(), boxes.width) for x in boxes[:2])

    def edge(y: Tensor) -> Tensor:
        row, part = _cell(y.flatten(), boxes.height)
        lines = []
        for start in (row * line, (row + 1) * line):
            first, second = (pairs.index_select(0, start + column).double() for column in (left, right))
            lines.append(
                torch.lerp(second[:, 0], second[:, 1], to_right) - torch.lerp(first[:, 0], first[:, 1], to_left)
            )
        return torch.lerp(lines[0], lines[1], part)

    return (edge(boxes.y1) - edge(boxes.y0)).view_as(boxes.x0) / boxes.area


def _cell(position: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Pixel index and the fraction inside it."""
    index = position.long().clamp(max=size - 1)
    return index, position - index


def table_float32(image: Tensor) -> Tensor:
    """A table stored in float32. CPU torch accumulates its `cumsum` of float32 in float64; CUDA does not."""
    return _table(image)


def _table(image: Tensor) -> Tensor:
    """Summed in place, like the library's, in the image's dtype."""
    table = image.new_zeros(image.shape[0] + 1, image.shape[1] + 1)
    table[1:, 1:] = image
    return table.cumsum_(1).cumsum_(0)


def table_accumulated_in_float32(image: Tensor) -> Tensor:
    """A table stored and accumulated in float32, one addition after the other (numpy, through the CPU)."""
    rows = np.cumsum(pad(image, (1, 0, 1, 0)).cpu().numpy(), axis=1, dtype=np.float32)
    return torch.from_numpy(np.cumsum(rows, axis=0, dtype=np.float32)).to(image.device)


class Centred(NamedTuple):
    mean: Tensor  # 0-d float32
    table: Tensor


def about_mean(build: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Centred]:
    """`build` applied to the image minus its mean."""

    def centred(image: Tensor) -> Centred:
        mean = image.mean(dtype=torch.float64).float()
        return Centred(mean, build(image - mean))

    return centred


def centred_mean(state: Centred, boxes: Boxes) -> Tensor:
    return gathered_mean(state.table, boxes) + state.mean.double()


class Tiles(NamedTuple):
    """Integral from the image's corner, in parts: inside the tile, the tiles left of it, all tile rows above."""

    local: Tensor  # (ny, T + 1, nx, T + 1) float32: integral of image - mean from the tile's corner
    mean: Tensor  # (ny, nx) float32
    left: Tensor  # (ny, T + 1, nx + 1) float64: over the tiles left of a tile, from its top to each pixel row of it
    above: Tensor  # (ny + 1, nx T + 1) float64: over the tile rows above, up to each pixel column


def tiled(image: Tensor) -> Tiles:
    """Float32 tables inside tiles, about the tile's mean; float64 sums from tile to tile."""
    height, width = image.shape
    down, across = -(-height // TILE), -(-width // TILE)
    edge = (0, across * TILE - width, 0, down * TILE - height)
    padded = pad(image[None], edge, mode="replicate")[0] if max(edge) else image
    blocks = padded.reshape(down, TILE, across, TILE)
    row_sums = blocks.sum(3, dtype=torch.float64)  # (ny, T, nx)
    mean = (row_sums.sum(1) / TILE**2).float()
    local = image.new_zeros(down, TILE + 1, across, TILE + 1)
    torch.sub(blocks, mean[:, None, :, None], out=local[:, 1:, :, 1:])
    local.cumsum_(3).cumsum_(1)
    left = pad(row_sums, (1, 0, 1, 0)).cumsum(2).cumsum(1)  # (ny, T + 1, nx + 1)
    above = _table(blocks.sum(1, dtype=torch.float64).view(down, across * TILE))
    return Tiles(local, mean, left, above)


def tiled_mean(state: Tiles, boxes: Boxes) -> Tensor:
    columns = [_place(x.flatten(), boxes.width) for x in boxes[:2]]
    rows = [_place(y.flatten(), boxes.height) for y in boxes[2:4]]
    (upper_left, upper_right), (lower_left, lower_right) = [[_integral(state, y, x) for x in columns] for y in rows]
    return ((lower_right - lower_left) - (upper_right - upper_left)).view_as(boxes.x0) / boxes.area


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
    wide = image.double()
    low = wide.min()
    levels = 2.0 ** (FIXED_BITS - max(-300, int(np.ceil(np.log2(max(float(wide.max() - low), 1e-90))))))
    counts = (wide - low).mul_(levels).round_().long()
    return Fixed(low, 1 / levels, _table(counts))


def fixed_mean(state: Fixed, boxes: Boxes) -> Tensor:
    """Differences of neighbouring corners in integers, exact; only then their bilinear weights in float64."""
    lines = state.table.shape[1]
    pairs = state.table.reshape(-1).unfold(0, 2, 1)
    (left, to_left), (right, to_right) = (_cell(x.flatten(), boxes.width) for x in boxes[:2])
    (upper, to_upper), (lower, to_lower) = (_cell(y.flatten(), boxes.height) for y in boxes[2:4])

    def read(row: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        first, second = (pairs.index_select(0, row * lines + column) for column in (left, right))
        return second[:, 0] - first[:, 0], first[:, 1] - first[:, 0], second[:, 1] - second[:, 0]

    top = read(upper)

    def below_top(row: Tensor) -> Tensor:
        width, at_left, at_right = (here - there for here, there in zip(read(row), top, strict=True))
        return width + at_right * to_right - at_left * to_left

    bottom = torch.lerp(below_top(lower), below_top(lower + 1), to_lower)
    total = bottom - below_top(upper + 1) * to_upper
    return state.low + total.view_as(boxes.x0) * state.step / boxes.area


CANDIDATES = (
    Candidate("float32", 4, table_float32, gathered_mean),
    Candidate("float32, accumulated in float32", 4, table_accumulated_in_float32, gathered_mean),
    Candidate("float32 - mean", 4, about_mean(table_float32), centred_mean),
    Candidate("float32 - mean, accumulated in float32", 4, about_mean(table_accumulated_in_float32), centred_mean),
    Candidate("tiled", 4 * (1 + 1 / TILE) ** 2 + 16 / TILE + 4 / TILE**2, tiled, tiled_mean),
    Candidate("float64, the library's", 8, table_float64, library_mean),
    Candidate("float64, other lookup", 8, table_float64, gathered_mean),
    Candidate("int64 fixed point", 8, fixed_point, fixed_mean),
)
"""What `statvo_precision` compares."""
