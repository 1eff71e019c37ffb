"""Summed-area tables and the exact integrals over the cells of a fractional lattice, with their derivatives.

Tables are float64 whatever the input: a float32 table loses the small differences that a box mean is made of
(docs/statvo.md, "Rounding"). A bilinear lookup at a fractional corner is the exact integral of the piecewise-constant image,
and torch's own `grid_sample` is that lookup.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

BLOCK_BYTES = {
    "cpu": 1 << 21,
    "cuda": 1 << 28,
}  # of looked-up values at a time: what a core's cache, a GPU's memory holds
SCATTER_BLOCKS = 32  # an image is scattered in at most so many blocks of rows: each needs a zeroed band of the table
SCATTER_MIN = 1 << 14  # queries a scatter block has at least


@dataclass(frozen=True)
class Lattice:
    """Vertical lines x_0 <= x_1 <= ... and horizontal lines y_0 <= y_1 <= ... of every query, whose cells are the boxes to sum.

    Args:
        xs, ys: two (one box) or three (quadrants) tensors each, (B, R, S) float64, in pixels; pixel j covers [j, j + 1].
        block: pixels that one entry of the table spans on each axis (approximate tables); 1 otherwise.
    """

    xs: tuple[Tensor, ...]
    ys: tuple[Tensor, ...]
    block: int = 1

    @staticmethod
    def around_pixels(
        half: Tensor,
        size: tuple[int, int],
        *,
        rows: slice,
        block: int = 1,
        coarse: bool = False,
        quadrants: bool = False,
    ) -> Lattice:
        """Windows centred on pixels, clipped to the image.

        Args:
            half: (B, 2, R, S) half-size in pixels (x, then y) of the queries in `rows`, >= 0, may be infinite.
            size: (H, W) of the image in pixels.
            rows: which rows of queries these are; several images stacked on each other start over at row 0.
            block: pixels per table entry.
            coarse: the queries are the table's own entries rather than pixels.
            quadrants: add the lines through the centre.
        """
        height, width = size
        step = block if coarse else 1
        stacked = -(-height // step)
        ticks = torch.arange(max(half.shape[3], rows.stop), device=half.device, dtype=torch.float64)
        u = ((ticks[: half.shape[3]] + 0.5) * step).expand(half.shape[0], half.shape[2], -1)
        v = ((ticks[rows] % stacked + 0.5) * step)[:, None].expand_as(u)
        lines = []
        for centre, reach, end in ((u, half[:, 0].double(), width), (v, half[:, 1].double(), height)):
            low, high = (centre - reach).clamp(0, end), (centre + reach).clamp(0, end)
            lines.append((low, centre, high) if quadrants else (low, high))
        return Lattice(lines[0], lines[1], block)

    def grid(self, height: int, width: int) -> Tensor:
        """(K, B, R, S, 2) normalised coordinates of all crossings in a table of (height + 1) x (width + 1); x fastest."""
        x = [line * (2 / (width * self.block)) - 1 for line in self.xs]
        y = [line * (2 / (height * self.block)) - 1 for line in self.ys]
        return torch.stack([torch.stack((a, b), -1) for b in y for a in x])


def row_blocks(rows: slice, columns: int, values: int, device: torch.device) -> Iterator[slice]:
    """Blocks of rows of queries such that `values` float64 of each query fit the block budget."""
    count = max(1, BLOCK_BYTES.get(device.type, 1 << 28) // (8 * values * columns))
    for start in range(rows.start, rows.stop, count):
        yield slice(start, min(start + count, rows.stop))


def scatter_blocks(rows: int, columns: int) -> Iterator[slice]:
    """Blocks of rows for `cell_sums_pull_back`: few, because each zeroes a band of the table."""
    count = max(-(-rows // SCATTER_BLOCKS), -(-SCATTER_MIN // columns))
    for start in range(0, rows, count):
        yield slice(start, min(start + count, rows))


def empty_table(like: Tensor, *, channels: int) -> Tensor:
    """(B, C, H + 1, W + 1) float64 zeros; write samples into `[..., 1:, 1:]`, then call `accumulate`.

    Args:
        like: any tensor of shape (B, ..., H, W) on the device.
    """
    shape = (like.shape[0], channels, like.shape[-2] + 1, like.shape[-1] + 1)
    return like.new_zeros(shape, dtype=torch.float64)


def accumulate(table: Tensor) -> Tensor:
    """Turn samples at `[..., 1:, 1:]` into their table, in place."""
    return table.cumsum_(3).cumsum_(2)


def summed_area_table(samples: Tensor) -> Tensor:
    """Summed-area table with a zero border.

    Args:
        samples: (B, C, H, W), any floating dtype.
    Returns: (B, C, H + 1, W + 1) float64; entry (i, j) is the sum over rows < i and columns < j.
    Gradients: `summed_area_table_adjoint`.
    Cost: two passes; 8 C bytes a pixel.
    Source: Crow 1984.
    """
    table = empty_table(samples, channels=samples.shape[1])
    table[:, :, 1:, 1:] = samples
    return accumulate(table)


def summed_area_table_adjoint(grad: Tensor) -> Tensor:
    """Adjoint of `summed_area_table`: cumulative sums from the other end.

    Args:
        grad: (B, C, H + 1, W + 1) float64 cotangent of the table; overwritten.
    Returns: (B, C, H, W) cotangent of the samples, a view of `grad`.
    """
    inner = grad[:, :, 1:, 1:]
    for channel in inner.unbind(1):  # one at a time: flipping copies
        channel.copy_(channel.flip(1, 2).cumsum_(1).cumsum_(2).flip(1, 2))
    return inner


def cell_sums(table: Tensor, lattice: Lattice) -> Tensor:
    """Exact integrals of the piecewise-constant image over the cells of a lattice.

    Args:
        table: (B, C, h + 1, w + 1) float64 from `summed_area_table`.
        lattice: of (B, R, S) queries.
    Returns: (B, Q, C, R, S) float64 with Q = 1 cell or 4 quadrants (left to right, top to bottom), each pixel weighted by its
        covered area (an approximate table spreads each entry evenly over its block).
    Gradients: `cell_sums_pull_back`, `edge_slopes`.
    Cost: 4 C reads a corner, 4 corners or 9, whatever the size of the box.
    Source: Crow 1984; the paper's Fig. 8 for the quadrants.
    """
    batch, channels, height, width = table.shape
    grid = lattice.grid(height - 1, width - 1)
    corners, _, rows, columns, _ = grid.shape
    if batch == 1:  # torch's kernel runs images in parallel: make each corner one
        values = _lookup(table.expand(corners, -1, -1, -1), grid[:, 0])
        values = values[None]
    else:
        values = _lookup(table, grid.transpose(0, 1).flatten(1, 2))
        values = values.view(batch, channels, corners, rows, columns).transpose(1, 2)
    return _cells(values, len(lattice.xs), len(lattice.ys))


def cell_sums_pull_back(
    to_sums: Tensor, table: Tensor, lattice: Lattice, to_table: Tensor
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Adjoint of `cell_sums` in the table (added to `to_table`) and in the lines.

    Args:
        to_sums: (B, Q, C, R, S) cotangent.
        table: (B, C, h + 1, w + 1), C even.
        lattice: as in `cell_sums`.
        to_table: accumulated in place, shape of table.
    Returns: cotangents of `lattice.xs` and of `lattice.ys`, each (B, R, S).
    Cost: about 5 C additions a corner, plus one zeroed band of the table for each horizontal line.
    """
    height, width = table.shape[2:]
    side = len(lattice.xs) - 1
    cells = to_sums.unflatten(1, (side, side))
    to_x = [torch.zeros_like(line) for line in lattice.xs]
    to_y = [torch.zeros_like(line) for line in lattice.ys]
    grid_x = torch.stack([line * (2 / ((width - 1) * lattice.block)) - 1 for line in lattice.xs], 1)  # (B, Kx, R, S)
    for j, line in enumerate(lattice.ys):
        low, high = _band(line, lattice.block, height)
        part = table[:, :, low:high]
        span = (high - low - 1) * lattice.block
        grid_y = ((line - low * lattice.block) * (2 / span) - 1)[:, None].expand_as(grid_x)
        grid = torch.stack((grid_x, grid_y), -1).flatten(1, 2)
        cotangent = _line_cotangent(cells, j).transpose(1, 2).flatten(2, 3)  # (B, C, Kx R, S)
        to_part, to_grid = _lookup_backward(cotangent, part, grid)
        to_table[:, :, low:high] += to_part
        to_grid = to_grid.view(*grid_x.shape, 2)
        to_y[j] += to_grid[..., 1].sum(1) * (2 / span)
        for i, slope in enumerate(to_grid[..., 0].unbind(1)):
            to_x[i] += slope * (2 / ((width - 1) * lattice.block))
    return tuple(to_x), tuple(to_y)


def edge_slopes(to_sums: Tensor, table: Tensor, lattice: Lattice) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """The cotangents of the lines alone, as `cell_sums_pull_back` gives them: for forward mode, where to_sums is contracted."""
    _, _, height, width = table.shape
    grid = lattice.grid(height - 1, width - 1)
    _, batch, rows, columns, _ = grid.shape
    cells = to_sums.unflatten(1, (len(lattice.ys) - 1, -1))
    lines = [_line_cotangent(cells, j) for j in range(len(lattice.ys))]
    cotangent = torch.stack(lines, 1).permute(0, 3, 1, 2, 4, 5).flatten(2, 4)
    _, to_grid = _lookup_backward(cotangent, table, grid.transpose(0, 1).flatten(1, 2), to_input=False)
    to_grid = to_grid.view(batch, len(lattice.ys), len(lattice.xs), rows, columns, 2)
    along_x, along_y = to_grid[..., 0].sum(1), to_grid[..., 1].sum(2)
    scale_x, scale_y = 2 / ((width - 1) * lattice.block), 2 / ((height - 1) * lattice.block)
    return tuple((along_x * scale_x).unbind(1)), tuple((along_y * scale_y).unbind(1))


def box_moments(samples: Tensor, valid: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """Mean and variance of the valid samples inside each cell.

    Args:
        samples: (B, H, W), finite everywhere; valid: (B, H, W) bool.
        lattice: of (B, R, S) queries.
    Returns: mean and variance, (B, Q, R, S) float64, 0 where a cell holds no sample. The variance is taken about the image's
        mean, which costs it nothing on a large offset, and is never negative.
    Cost: one table of 4 channels.
    """
    count = valid.double().sum((1, 2), keepdim=True).clamp(min=1)
    centre = torch.where(valid, samples.double(), 0.0).sum((1, 2), keepdim=True) / count
    moved = torch.where(valid, samples.double() - centre, 0.0)
    table = summed_area_table(torch.stack((moved, moved.square(), valid.double(), valid.double()), 1))
    first, second, area, _ = cell_sums(table, lattice).unbind(2)
    held = area > 0
    area = area.clamp(min=1e-12)
    mean = torch.where(held, first / area, 0.0)
    variance = torch.where(held, second / area - mean.square(), 0.0).clamp(min=0)
    return torch.where(held, mean + centre[:, None], 0.0), variance


def _lookup(table: Tensor, grid: Tensor) -> Tensor:
    return grid_sample(table, grid, mode="bilinear", padding_mode="border", align_corners=True)


def _lookup_backward(grad: Tensor, table: Tensor, grid: Tensor, *, to_input: bool = True) -> tuple[Tensor, Tensor]:
    """Adjoint of `_lookup`; on one image two halves of the channels run in parallel."""
    batch, channels = table.shape[:2]
    if batch == 1:
        table, grad = table.reshape(2, channels // 2, *table.shape[2:]), grad.reshape(2, channels // 2, *grad.shape[2:])
        grid = grid.expand(2, -1, -1, -1)
    to_table, to_grid = torch.ops.aten.grid_sampler_2d_backward(grad, table, grid, 0, 1, True, [to_input, True])
    if batch == 1:
        to_table = to_table.flatten(0, 1)[None] if to_input else to_table
        to_grid = to_grid.sum(0, keepdim=True)
    return to_table, to_grid


def _cells(values: Tensor, columns: int, rows: int) -> Tensor:
    """(B, K, C, R, S) table values at the crossings -> (B, Q, C, R, S) cell sums."""
    values = values.unflatten(1, (rows, columns))
    return values.diff(dim=1).diff(dim=2).flatten(1, 2)


def _line_cotangent(cells: Tensor, line: int) -> Tensor:
    """Adjoint of `_cells` at one horizontal line: (B, Qy, Qx, C, R, S) cell cotangents -> (B, Kx, C, R, S)."""
    row = torch.zeros_like(cells[:, 0])
    if line > 0:
        row += cells[:, line - 1]
    if line < cells.shape[1]:
        row -= cells[:, line]
    edge = torch.zeros_like(row[:, :1])
    return torch.cat((edge, row), 1) - torch.cat((row, edge), 1)


def _band(line: Tensor, block: int, height: int) -> tuple[int, int]:
    """Rows of the table that the lookups of one horizontal line touch; all of them where asking would stall a GPU."""
    if line.is_cuda:
        return 0, height
    low, high = (int(value) // block for value in torch.aminmax(line))
    return max(min(low, height - 2), 0), min(high + 2, height)
