"""Box means of float32 depth keep their precision at full image sizes, and what would not.

The bound: 1e-6 of the local spread (max - min in the window) plus 1e-7 of the mean depth in the window, for windows of 1 to 4096
pixels. Expected means are direct float64 sums over the window of the depth minus its offset: no table.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from torch_ssao.ops import sat

SIDES = (1.0, 3.0, 17.0, 65.0, 257.0, 1025.0, 4096.0, 1.37, 5.3, 33.37, 400.9)
OFFSETS = (0.0, 10.0, 1e4)


class Boxes(NamedTuple):
    """(N,) float64 edges in pixels."""

    x0: Tensor
    x1: Tensor
    y0: Tensor
    y1: Tensor

    @property
    def area(self) -> Tensor:
        return (self.x1 - self.x0) * (self.y1 - self.y0)


class Case(NamedTuple):
    depth: Tensor  # (H, W) float32
    boxes: Boxes
    mean: Tensor  # (N,) float64
    bound: Tensor  # (N,) float64


def windows(size: int, sides: tuple[float, ...], each: int) -> Boxes:
    """Around pixel centres, half of them in the corner where the table is largest."""
    place = torch.rand(2, len(sides), each, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    place[..., ::2] = 1 - place[..., ::2] / 16
    centre = (place * size).floor().clamp(max=size - 1) + 0.5
    half = torch.tensor(sides, dtype=torch.float64)[:, None] / 2
    (x0, y0), (x1, y1) = (centre - half).clamp(min=0).flatten(1), (centre + half).clamp(max=size).flatten(1)
    return Boxes(x0, x1, y0, y1)


def overlap(low: Tensor, high: Tensor, size: int) -> Tensor:
    cell = torch.arange(size, dtype=torch.float64)
    return (torch.minimum(high[:, None], cell + 1) - torch.maximum(low[:, None], cell)).clamp(min=0)


def local_spread(image: Tensor, boxes: Boxes) -> Tensor:
    """max - min of up to 64 x 64 pixels in the middle of each window: never more than of the window."""
    found = []
    for x0, x1, y0, y1 in torch.stack(boxes, 1).tolist():
        x, y = int((x0 + x1) / 2), int((y0 + y1) / 2)
        part = image[
            max(int(y0), y - 32) : min(-int(-y1 // 1), y + 32), max(int(x0), x - 32) : min(-int(-x1 // 1), x + 32)
        ]
        found.append(part.max() - part.min())
    return torch.stack(found)


def case(size: int, offset: float, sides: tuple[float, ...] = SIDES, each: int = 12) -> Case:
    unit = torch.rand(size, size, generator=torch.Generator().manual_seed(size), dtype=torch.float64)
    depth = (unit + offset).float()
    residual, boxes = depth.double() - offset, windows(size, sides, each)
    rows = overlap(boxes.y0, boxes.y1, size) @ residual
    mean = (rows * overlap(boxes.x0, boxes.x1, size)).sum(1) / boxes.area
    return Case(depth, boxes, mean + offset, 1e-6 * local_spread(residual, boxes) + 1e-7 * (mean + offset))


def error_over_bound(table: Tensor, at: Case) -> Tensor:
    """Of the library's lookup in a (1, 1, H + 1, W + 1) float64 table."""
    x0, x1, y0, y1 = (edge[None, None] for edge in at.boxes)
    sums = sat.cell_sums(table, sat.Lattice((x0, x1), (y0, y1)))[0, 0, 0, 0]
    return (sums / at.boxes.area - at.mean).abs() / at.bound


def stored_in_float32(depth: Tensor) -> Tensor:
    """The table of a plain float32 `cumsum` on a CPU, where torch accumulates in float64 and rounds what it stores."""
    return torch.nn.functional.pad(depth, (1, 0, 1, 0)).cumsum(1).cumsum(0).double()[None, None]


def accumulated_in_float32(depth: Tensor) -> Tensor:
    """The table when the additions round as well, as CUDA's do: numpy adds one after the other in the given dtype."""
    rows = np.cumsum(torch.nn.functional.pad(depth, (1, 0, 1, 0)).numpy(), axis=1, dtype=np.float32)
    return torch.from_numpy(np.cumsum(rows, axis=0, dtype=np.float32)).double()[None, None]


@pytest.mark.parametrize("offset", OFFSETS)
def test_float64_table_meets_the_bound(offset: float) -> None:
    at = case(1024, offset)
    assert error_over_bound(sat.summed_area_table(at.depth[None, None]), at).max() < 1


@pytest.mark.slow
@pytest.mark.parametrize("offset", OFFSETS)
def test_float64_table_meets_the_bound_at_4096(offset: float) -> None:
    at = case(4096, offset)
    assert error_over_bound(sat.summed_area_table(at.depth[None, None]), at).max() < 1


@pytest.mark.parametrize("table", [stored_in_float32, accumulated_in_float32])
def test_a_float32_table_misses_the_bound_a_hundredfold(table: Callable[[Tensor], Tensor]) -> None:
    """The tests above have teeth."""
    for offset in OFFSETS:
        at = case(1024, offset)
        assert error_over_bound(table(at.depth), at).max() > 100


@pytest.mark.parametrize(
    ("table", "least", "most"), [(stored_in_float32, 5.5, 5.9), (accumulated_in_float32, 50.0, 60.0)]
)
def test_size_of_the_damage(table: Callable[[Tensor], Tensor], least: float, most: float) -> None:
    """Depth in [1e4, 1e4 + 1] at 1024 x 1024: the worst of all 17 x 17 means is off by many times the depth range."""
    unit = torch.rand(1024, 1024, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    depth = (unit + 1e4).float()
    corners = table(depth)[0, 0]
    sums = corners[17:, 17:] - corners[:-17, 17:] - corners[17:, :-17] + corners[:-17, :-17]
    direct = torch.nn.functional.avg_pool2d((depth.double() - 1e4)[None], 17, stride=1)[0]
    assert least < (sums / 17**2 - 1e4 - direct).abs().max() < most


def test_expected_means_are_direct_sums() -> None:
    """The judge itself, against a loop over pixels."""
    at = case(40, 10.0, sides=(1.0, 5.3, 17.0, 400.9), each=3)
    for n, (x0, x1, y0, y1) in enumerate(torch.stack(at.boxes, 1).tolist()):
        total = 0.0
        for i in range(40):
            for j in range(40):
                covered = max(0.0, min(x1, j + 1) - max(x0, j)) * max(0.0, min(y1, i + 1) - max(y0, i))
                total += covered * float(at.depth[i, j])
        assert abs(total / ((x1 - x0) * (y1 - y0)) - float(at.mean[n])) < 1e-12
