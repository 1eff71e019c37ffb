"""The fixed noise tile and the disk points."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torch_ssao import checks
from torch_ssao.ops import poisson_disk, tiled_noise
from torch_ssao.ops.sampling import _CURVE, TILE


def noise(height: int = TILE, width: int = TILE, frame: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.stack(tiled_noise(height, width, frame, dtype=dtype, device=torch.device("cpu")))


def star_discrepancy(points: np.ndarray) -> float:
    """Of points in the unit square, on a grid of boxes."""
    corners = np.linspace(0, 1, 33)[1:]
    inside = (points[:, 0, None] < corners)[:, :, None] & (points[:, 1, None] < corners)[:, None, :]
    return float(np.abs(inside.mean(0) - corners[:, None] * corners[None]).max())


def test_curve_visits_every_cell_by_unit_steps() -> None:
    order = _CURVE.flatten().argsort()
    rows, columns = order // TILE, order % TILE
    assert torch.equal(_CURVE.flatten().sort().values, torch.arange(TILE * TILE))
    assert ((rows.diff().abs() + columns.diff().abs()) == 1).all()


def test_noise_is_in_the_unit_interval_and_repeats() -> None:
    wide = noise(TILE + 5, 2 * TILE)
    assert ((wide >= 0) & (wide < 1)).all()
    assert torch.equal(wide[:, :TILE, :TILE], wide[:, :TILE, TILE:])
    assert torch.equal(wide[:, :5], wide[:, TILE:])


@pytest.mark.parametrize("frame", [0, 1, -7, 10**12])
def test_float32_and_float64_agree_and_calls_repeat(frame: int) -> None:
    assert torch.equal(noise(frame=frame, dtype=torch.float32).double(), noise(frame=frame))
    state = torch.get_rng_state()
    assert torch.equal(noise(frame=frame), noise(frame=frame))
    assert torch.equal(torch.get_rng_state(), state)


def test_tile_neighbourhoods_and_frames_fill_the_square() -> None:
    tile = noise()
    assert star_discrepancy(tile.reshape(2, -1).T.numpy()) < 0.004
    blocks = tile.unfold(1, 4, 4).unfold(2, 4, 4).reshape(2, -1, 16)
    worst = np.median([star_discrepancy(blocks[:, k].T.numpy()) for k in range(blocks.shape[1])])
    assert worst < 0.2  # 16 random points: 0.27
    frames = torch.stack([noise(3, 3, f)[:, 1, 2] for f in range(64)])
    assert star_discrepancy(frames.numpy()) < 0.08


def test_frames_differ() -> None:
    assert (noise(frame=0) != noise(frame=1)).all()


@pytest.mark.parametrize("count", [1, 2, 7, 16, 64, 200])
def test_disk_points_are_spaced_and_one_to_a_ring(count: int) -> None:
    points = poisson_disk(count, dtype=torch.float64)
    assert points.shape == (count, 2)
    square = points.square().sum(1)
    torch.testing.assert_close(square, (torch.arange(count).double() + 0.5) / count)
    gaps = torch.cdist(points, points) + 9 * torch.eye(count)
    assert gaps.min() >= 1.5 / math.sqrt(count)


def test_disk_points_integrate_a_segment() -> None:
    """Lifted to the hemisphere, the share of rotated points beyond a chord is the wall's occlusion."""
    exact = (math.acos(0.3) - 0.3 * math.sqrt(1 - 0.09)) / math.pi
    for count in (4, 16, 64):
        points = poisson_disk(count, dtype=torch.float64)
        turns = torch.arange(512).double() * (2 * math.pi / 512)
        along = points[:, 0, None] * turns.cos() - points[:, 1, None] * turns.sin()
        assert abs(float((along > 0.3).double().mean()) - exact) < 0.01


def test_disk_needs_a_point() -> None:
    with pytest.raises(checks.RangeError, match="count must be"):
        poisson_disk(0)
