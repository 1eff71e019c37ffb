"""Summed-area tables with exact integrals over fractional windows, and their derivatives.

Tables are float64 whatever the input: a float32 table loses the small differences that a box mean is made of
(docs/statvo.md). Channels come last, so that one lookup reads one short run of memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


@dataclass(frozen=True)
class Window:
    """Axis-aligned windows in pixels, one per query, clipped to the image.

    Args:
        x0, x1, y0, y1: (B, N) float64 edges, 0 <= x0 <= x1 <= W and 0 <= y0 <= y1 <= H; pixel j covers [j, j + 1].
        height, width: image size.
    """

    x0: Tensor
    x1: Tensor
    y0: Tensor
    y1: Tensor
    height: int
    width: int

    @staticmethod
    def around_pixels(half: Tensor) -> Window:
        """Windows centred on the pixels of an image.

        Args:
            half: (B, 2, H, W) half-size in pixels (x, then y), >= 0, may be infinite.
        Returns: a Window of N = H * W queries in row order.
        """
        _, _, height, width = half.shape
        half = half.double()
        u = torch.arange(width, device=half.device, dtype=torch.float64) + 0.5
        v = (torch.arange(height, device=half.device, dtype=torch.float64) + 0.5)[:, None]
        half_x, half_y = half.unbind(1)
        return Window(
            (u - half_x).clamp(min=0).flatten(1),
            (u + half_x).clamp(max=width).flatten(1),
            (v - half_y).clamp(min=0).flatten(1),
            (v + half_y).clamp(max=height).flatten(1),
            height,
            width,
        )

    def corners(self) -> tuple[tuple[Tensor, Tensor, float], ...]:
        """(x, y, sign) of the four table lookups whose signed sum is the box sum."""
        return (self.x1, self.y1, 1.0), (self.x0, self.y1, -1.0), (self.x1, self.y0, -1.0), (self.x0, self.y0, 1.0)


def summed_area_table(samples: Tensor) -> Tensor:
    """Summed-area table with a zero border.

    Args:
        samples: (B, H, W, C), any floating dtype.
    Returns: (B, H + 1, W + 1, C) float64; entry (i, j) is the sum over rows < i and columns < j.
    Gradients: plain autograd, or `summed_area_table_adjoint`.
    Cost: two passes; 8 C bytes a pixel.
    Source: Crow 1984.
    """
    padded = torch.nn.functional.pad(samples.double(), (0, 0, 1, 0, 1, 0))
    return padded.cumsum(2).cumsum(1)


def summed_area_table_adjoint(grad: Tensor) -> Tensor:
    """Adjoint of `summed_area_table`: cumulative sums from the other end.

    Args:
        grad: (B, H + 1, W + 1, C) cotangent of the table.
    Returns: (B, H, W, C) cotangent of the samples.
    """
    inner = grad[:, 1:, 1:]
    return inner.flip(1).cumsum(1).flip(1).flip(2).cumsum(2).flip(2)


def box_sum(table: Tensor, window: Window) -> Tensor:
    """Exact integral of the piecewise-constant image over fractional windows.

    Args:
        table: (B, H + 1, W + 1, C) from `summed_area_table`.
        window: N windows per image.
    Returns: (B, N, C) float64 sums, weighted by the covered area of each pixel.
    Gradients: `box_sum_edges` and `box_sum_adjoint` give the derivative to the edges and to the table.
    Cost: 8 reads of 2 C values a window, whatever its size.
    Source: the bilinear lookup of a SAT at fractional corners is the exact integral (Leibniz).
    """
    upper, lower = _edge_rows(table, window, window.y0), _edge_rows(table, window, window.y1)
    return torch.lerp(lower.first.width, lower.second.width, lower.fraction) - torch.lerp(
        upper.first.width, upper.second.width, upper.fraction
    )


def box_sum_edges(table: Tensor, window: Window) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Derivative of the box sum with respect to the edges x0, x1, y0, y1: (minus) the sum over the strip at each edge.

    Args and Cost as for `box_sum`.
    Returns: four (B, N, C) tensors.
    """
    upper, lower = _edge_rows(table, window, window.y0), _edge_rows(table, window, window.y1)
    left, right = (
        torch.lerp(getattr(lower.first, side), getattr(lower.second, side), lower.fraction)
        - torch.lerp(getattr(upper.first, side), getattr(upper.second, side), upper.fraction)
        for side in ("left", "right")
    )
    return -left, right, upper.first.width - upper.second.width, lower.second.width - lower.first.width


def box_sum_adjoint(grad: Tensor, window: Window) -> Tensor:
    """Adjoint of `box_sum` in the table: scatter the four corners.

    Args:
        grad: (B, N, C) cotangent of the sums.
        window: the windows.
    Returns: (B, H + 1, W + 1, C) cotangent of the table.
    """
    batch, _, channels = grad.shape
    shape = (batch, window.height + 1, window.width + 1, channels)
    flat = grad.new_zeros(batch * shape[1] * shape[2], channels)
    for x, y, sign in window.corners():
        for index, weight in _taps(x, y, shape):
            flat = flat.index_add(0, index.flatten(), (grad * (sign * weight)[..., None]).flatten(0, 1))
    return flat.view(shape)


def _taps(x: Tensor, y: Tensor, shape: tuple[int, ...] | torch.Size) -> list[tuple[Tensor, Tensor]]:
    """The four table entries around fractional (x, y) with their bilinear weights."""
    (column, right), (row, below) = _split(x, shape[2] - 1), _split(y, shape[1] - 1)
    base = _base(shape, x.device) + row * shape[2] + column
    left, above = 1 - right, 1 - below
    return [
        (base, above * left),
        (base + 1, above * right),
        (base + shape[2], below * left),
        (base + shape[2] + 1, below * right),
    ]


class _Row(NamedTuple):
    """One table row at the two vertical edges of every window: all (B, N, C)."""

    width: Tensor  # row sum between x0 and x1
    left: Tensor  # slope of the row at x0
    right: Tensor  # slope of the row at x1


class _EdgeRows(NamedTuple):
    first: _Row
    second: _Row
    fraction: Tensor  # (B, N, 1), where the horizontal edge lies between the two rows


def _edge_rows(table: Tensor, window: Window, y: Tensor) -> _EdgeRows:
    """The two table rows around a horizontal edge."""
    batch, height, width, channels = table.shape
    neighbours = table.reshape(-1).unfold(0, 2 * channels, channels)  # entry and its right neighbour in one read
    row, fraction = _split(y, height - 1)
    start = _base(table.shape, table.device) + row * width
    edges = [_split(x, width - 1) for x in (window.x0, window.x1)]

    def read(start: Tensor) -> _Row:
        values, slopes = [], []
        for column, part in edges:
            pair = neighbours.index_select(0, (start + column).flatten()).view(batch, -1, 2, channels)
            slope = pair[:, :, 1] - pair[:, :, 0]
            values.append(torch.addcmul(pair[:, :, 0], slope, part[..., None]))
            slopes.append(slope)
        return _Row(values[1] - values[0], *slopes)

    return _EdgeRows(read(start), read(start + width), fraction[..., None])


def _split(position: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Cell index in [0, size - 1] and the fraction inside it."""
    cell = position.floor().clamp(max=size - 1)
    return cell.long(), position - cell


def _base(shape: tuple[int, ...] | torch.Size, device: torch.device) -> Tensor:
    """First row of each image in the flattened table, (B, 1)."""
    return (torch.arange(shape[0], device=device) * (shape[1] * shape[2]))[:, None]
