"""Summed-area tables: exact sums over lattices, exact derivatives of their lines, exact adjoints."""

from __future__ import annotations

import pytest
import torch

from torch_ssao.ops import sat
from torch_ssao.ops.sat import Lattice


def lattice(seed: int, shape: tuple[int, int, int], size: tuple[int, int], *, lines: int, block: int = 1) -> Lattice:
    """Random sorted lines of (B, R, S) queries inside an image."""
    generator = torch.Generator().manual_seed(seed)
    sides = []
    for extent in (size[1], size[0]):
        position = torch.rand(lines, *shape, generator=generator, dtype=torch.float64) * extent
        sides.append(tuple(position.sort(0).values))
    return Lattice(*sides, block)


def overlap(low: torch.Tensor, high: torch.Tensor, entries: int, block: int = 1) -> torch.Tensor:
    """Share of each table entry along one axis that [low, high] covers."""
    start = torch.arange(entries, dtype=torch.float64) * block
    covered = torch.minimum(high[..., None], start + block) - torch.maximum(low[..., None], start)
    return covered.clamp(min=0) / block


def direct(image: torch.Tensor, cells: Lattice) -> torch.Tensor:
    """Cell sums entry by entry."""
    height, width = image.shape[2:]
    sums = []
    for y0, y1 in zip(cells.ys[:-1], cells.ys[1:], strict=True):
        for x0, x1 in zip(cells.xs[:-1], cells.xs[1:], strict=True):
            across, down = overlap(x0, x1, width, cells.block), overlap(y0, y1, height, cells.block)
            sums.append(torch.einsum("bchw,brsh,brsw->bcrs", image, down, across))
    return torch.stack(sums, 1)


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("lines", [2, 3])
@pytest.mark.parametrize(("height", "width", "block"), [(11, 7, 1), (1, 9, 1), (9, 1, 1), (1, 1, 1), (5, 6, 2), (3, 2, 4)])
def test_cell_sums_are_exact_integrals(height: int, width: int, block: int, lines: int, batch: int) -> None:
    image = torch.rand(batch, 4, height, width, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    cells = lattice(2, (batch, 5, 10), (height * block, width * block), lines=lines, block=block)
    torch.testing.assert_close(
        sat.cell_sums(sat.summed_area_table(image), cells), direct(image, cells), atol=1e-12, rtol=0
    )


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("lines", [2, 3])
@pytest.mark.parametrize("block", [1, 2])
def test_pull_back_is_the_transpose_and_lines_match_differences(lines: int, batch: int, block: int) -> None:
    generator = torch.Generator().manual_seed(4)
    image = torch.rand(batch, 2, 8, 9, generator=generator, dtype=torch.float64)
    table = sat.summed_area_table(image)
    cells = lattice(5, (batch, 6, 7), (8 * block, 9 * block), lines=lines, block=block)
    sums = sat.cell_sums(table, cells)
    cotangent = torch.randn(sums.shape, generator=generator, dtype=torch.float64)
    to_table = torch.zeros_like(table)
    to_x, to_y = sat.cell_sums_pull_back(cotangent, table, cells, to_table)
    loss = (sums * cotangent).sum()
    torch.testing.assert_close((table * to_table).sum(), loss)
    for slopes, alone in zip((to_x, to_y), sat.edge_slopes(cotangent, table, cells), strict=True):
        for slope, other in zip(slopes, alone, strict=True):
            torch.testing.assert_close(slope, other)

    def moved(axis: int, line: int, step: float) -> torch.Tensor:
        sides = [list(cells.xs), list(cells.ys)]
        sides[axis][line] = sides[axis][line] + step
        return (sat.cell_sums(table, Lattice(tuple(sides[0]), tuple(sides[1]), block)) * cotangent).sum((1, 2))

    for axis, slopes in enumerate((to_x, to_y)):
        for line, slope in enumerate(slopes):
            numeric = (moved(axis, line, 1e-7) - moved(axis, line, -1e-7)) / 2e-7
            torch.testing.assert_close(slope, numeric, atol=1e-5, rtol=0)
    torch.testing.assert_close((image * sat.summed_area_table_adjoint(to_table)).sum(), loss)


def test_windows_are_clipped_and_survive_infinite_sizes() -> None:
    cells = Lattice.around_pixels(torch.full((1, 2, 3, 4), torch.inf), (3, 4), rows=slice(0, 3), quadrants=True)
    assert [line.unique().tolist() for line in cells.xs] == [[0.0], [0.5, 1.5, 2.5, 3.5], [4.0]]
    assert cells.ys[2].unique().tolist() == [3.0]


def test_blocks_of_rows_cover_all_rows_once() -> None:
    half = torch.rand(1, 2, 40, 12, generator=torch.Generator().manual_seed(0)) * 5
    parts = list(sat.row_blocks(slice(0, 40), 12, 2000, half.device))
    assert len(parts) > 1
    joined = [Lattice.around_pixels(half[:, :, part], (20, 12), rows=part) for part in parts]  # two stacked images
    whole = Lattice.around_pixels(half, (20, 12), rows=slice(0, 40))
    for axis in ("xs", "ys"):
        pieces = zip(*(getattr(piece, axis) for piece in joined), strict=True)
        for line, piece in zip(getattr(whole, axis), pieces, strict=True):
            assert torch.equal(line, torch.cat(piece, 1))


def test_moments_are_those_of_the_valid_samples() -> None:
    generator = torch.Generator().manual_seed(7)
    samples = torch.rand(1, 6, 8, generator=generator) + 1e4
    valid = torch.rand(1, 6, 8, generator=generator) > 0.3
    half = torch.full((1, 2, 6, 8), 1.5)  # 3 x 3 pixels
    mean, variance = sat.box_moments(samples, valid, Lattice.around_pixels(half, (6, 8), rows=slice(0, 6)))
    for row in range(6):
        for column in range(8):
            window = (0, slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2))
            inside = samples[window][valid[window]].double()
            assert abs(float(mean[0, 0, row, column] - inside.mean())) < 1e-9
            assert abs(float(variance[0, 0, row, column] - inside.var(correction=0))) < 1e-9


@pytest.mark.parametrize("offset", [0.0, 10.0, 1e4])
def test_variance_is_never_negative(offset: float) -> None:
    generator = torch.Generator().manual_seed(3)
    samples = (torch.randint(0, 2, (1, 256, 256), generator=generator) * 1e-3 + offset).float()
    valid = torch.rand(1, 256, 256, generator=generator) > 0.1
    for half in (0.3, 2.0, 300.0):
        windows = Lattice.around_pixels(torch.full((1, 2, 256, 256), half), (256, 256), rows=slice(0, 256), quadrants=True)
        _, variance = sat.box_moments(samples, valid, windows)
        assert bool((variance >= 0).all())
        assert float(variance.max()) > 1e-7
