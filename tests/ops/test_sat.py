"""Summed-area tables: exact sums, exact edge derivatives, exact adjoints."""

from __future__ import annotations

import pytest
import torch

from torch_ssao.ops import sat
from torch_ssao.ops.sat import Window


def windows(seed: int, count: int, height: int, width: int) -> Window:
    generator = torch.Generator().manual_seed(seed)
    x = (torch.rand(2, count, 2, generator=generator, dtype=torch.float64) * width).sort(-1).values
    y = (torch.rand(2, count, 2, generator=generator, dtype=torch.float64) * height).sort(-1).values
    return Window(x[..., 0], x[..., 1], y[..., 0], y[..., 1], height, width)


def overlap(low: torch.Tensor, high: torch.Tensor, size: int) -> torch.Tensor:
    """Length of [low, high] inside each unit cell."""
    cell = torch.arange(size, dtype=torch.float64)
    return (torch.minimum(high[..., None], cell + 1) - torch.maximum(low[..., None], cell)).clamp(min=0)


@pytest.mark.parametrize(("height", "width"), [(11, 7), (1, 9), (9, 1), (1, 1)])
def test_box_sum_is_the_exact_integral(height: int, width: int) -> None:
    image = torch.rand(2, height, width, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    window = windows(2, 50, height, width)
    sums = sat.box_sum(sat.summed_area_table(image), window)
    weight_x, weight_y = overlap(window.x0, window.x1, width), overlap(window.y0, window.y1, height)
    expected = torch.einsum("bhwc,bnh,bnw->bnc", image, weight_y, weight_x)
    torch.testing.assert_close(sums, expected, atol=1e-12, rtol=0)


def test_edge_derivatives_match_differences() -> None:
    image = torch.rand(2, 8, 9, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    table = sat.summed_area_table(image)
    window = windows(5, 40, 8, 9)
    edges = (window.x0, window.x1, window.y0, window.y1)

    def at(index: int, step: float) -> torch.Tensor:
        moved = [edge + step if i == index else edge for i, edge in enumerate(edges)]
        return sat.box_sum(table, Window(*moved, 8, 9))

    for index, strip in enumerate(sat.box_sum_edges(table, window)):
        numeric = (at(index, 1e-7) - at(index, -1e-7)) / 2e-7
        torch.testing.assert_close(strip, numeric, atol=1e-6, rtol=0)


def test_adjoints_are_transposes() -> None:
    generator = torch.Generator().manual_seed(4)
    image = torch.rand(2, 6, 5, 3, generator=generator, dtype=torch.float64)
    window = windows(6, 30, 6, 5)
    table = sat.summed_area_table(image)
    cotangent = torch.randn(2, 30, 3, generator=generator, dtype=torch.float64)
    pulled = sat.box_sum_adjoint(cotangent, window)
    left = (sat.box_sum(table, window) * cotangent).sum()
    torch.testing.assert_close((table * pulled).sum(), left)
    torch.testing.assert_close((image * sat.summed_area_table_adjoint(pulled)).sum(), left)


def test_window_is_clipped_and_survives_infinite_sizes() -> None:
    half = torch.full((1, 2, 3, 4), torch.inf)
    window = Window.around_pixels(half)
    assert window.x0.unique().tolist() == [0.0]
    assert window.x1.unique().tolist() == [4.0]
    assert window.y1.unique().tolist() == [3.0]


@pytest.mark.parametrize("offset", [0.0, 10.0, 1e4])
def test_float32_depth_with_offset_keeps_its_box_means(offset: float) -> None:
    depth = (torch.rand(1, 512, 512, 1, generator=torch.Generator().manual_seed(0)) + offset).float()
    half = torch.full((1, 2, 512, 512), 8.5)
    window = Window.around_pixels(half)
    means = sat.box_sum(sat.summed_area_table(depth), window)[..., 0] / 17**2
    # The direct sum of the window, with the offset removed first: nothing to lose.
    residual = (depth.double() - offset)[0, :, :, 0]
    direct = torch.nn.functional.avg_pool2d(residual[None], 17, stride=1)[0] + offset
    inside = means.view(512, 512)[8:-8, 8:-8]
    assert (inside - direct).abs().max() < 1e-6 + 1e-7 * offset
