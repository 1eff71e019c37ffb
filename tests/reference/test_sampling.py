"""The points: stratified, uniform, per-pixel, and a standard error whose square is unbiased."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from torch_ssao import checks
from torch_ssao.reference import sampling

PIXELS = np.arange(4000)


def points(samples: int = 128, seed: int = 0, view: int = 0, pixels: NDArray[np.int64] = PIXELS):
    plan = sampling.sample_plan(samples)
    return plan, *sampling.disk_points(plan, sampling.stream_key(seed, view), pixels)


@pytest.mark.parametrize("samples", [2**k for k in range(3, 17)])
def test_plan_splits_all_samples(samples: int) -> None:
    plan = sampling.sample_plan(samples)
    assert plan.samples == samples == 2 * plan.cells * plan.net_points
    assert plan.cells >= 4  # the standard error's degrees of freedom


def test_the_default_plan_is_the_one_measured() -> None:
    plan = sampling.sample_plan(512)
    assert (plan.cells, plan.net_points) == (32, 8)


@pytest.mark.parametrize(("samples", "neighbours"), [(500, "256 or 512"), (9, "8 or 16"), (65535, "32768 or 65536")])
def test_other_counts_name_their_neighbours(samples: int, neighbours: str) -> None:
    with pytest.raises(checks.RangeError, match=f"samples must be a power of two, got {samples}: use {neighbours}"):
        sampling.sample_plan(samples)


@pytest.mark.parametrize("samples", [4, 0, -8, 1 << 17, 512.0, True, "512"])
def test_counts_out_of_range_are_refused(samples: object) -> None:
    with pytest.raises(checks.RangeError, match="samples must be a whole number between 8 and 65536"):
        sampling.sample_plan(samples)  # type: ignore[arg-type]


@pytest.mark.parametrize("samples", [8, 64, 512, 2048])
def test_each_net_fills_every_elementary_interval_once(samples: int) -> None:
    plan, u, v = points(samples, pixels=PIXELS[:50])
    for axis_bits in range(plan.net_bits + 1):  # 2^a x 2^(net_bits - a) intervals within a cell
        columns = (u * (1 << (plan.radial_bits + axis_bits))).astype(int)
        rows = (v * (1 << (plan.azimuth_bits + plan.net_bits - axis_bits))).astype(int)
        place = columns * (1 << 16) + rows
        halves = np.sort(place.reshape(50, 2, -1), axis=2)
        expected = plan.cells * plan.net_points
        assert all(len(np.unique(half)) == expected for pixel in halves for half in pixel)


def test_points_of_a_cell_stay_together() -> None:
    plan, u, v = points(128, pixels=PIXELS[:9])
    cell = (u * 2**plan.radial_bits).astype(int) * 2**plan.azimuth_bits + (v * 2**plan.azimuth_bits).astype(int)
    expected = np.broadcast_to(np.arange(plan.cells)[:, None], (9, 2, plan.cells, plan.net_points))
    np.testing.assert_array_equal(cell.reshape(expected.shape), expected)


def test_points_are_uniform_and_below_one() -> None:
    plan, u, v = points(64)
    for axis in (u, v):
        assert axis.dtype == np.float32
        assert axis.min() >= 0
        assert axis.max() < 1
        # Within a cell each point alone is uniform: 16 bins of its place in the finest stratum.
        fine = (axis.astype(np.float64) * 2**plan.net_bits * 8) % 1
        counts = np.histogram(fine, bins=16, range=(0, 1))[0]
        expected = fine.size / 16
        assert ((counts - expected) ** 2 / expected).sum() < 40  # chi-square, 15 degrees of freedom: p = 4e-4


def test_a_pixel_depends_on_its_index_alone() -> None:
    _, u, v = points(64)
    _, some_u, some_v = points(64, pixels=np.array([17, 3, 999]))
    np.testing.assert_array_equal(some_u, u[[17, 3, 999]])
    np.testing.assert_array_equal(some_v, v[[17, 3, 999]])


def test_pixels_views_and_seeds_differ() -> None:
    _, u, _ = points(64)
    _, other_seed, _ = points(64, seed=1)
    _, other_view, _ = points(64, view=1)
    assert len(np.unique(u, axis=0)) == len(u)
    for other in (other_seed, other_view):
        inside = (u * 1024) % 1, (other * 1024) % 1
        assert abs(np.corrcoef(inside[0].ravel(), inside[1].ravel())[0, 1]) < 5 / np.sqrt(u.size)


@pytest.mark.parametrize(
    "integrand",
    [
        lambda u, v: u + v < 0.7,
        lambda u, v: (u < 0.37) & (v > 0.1),
        lambda u, v: np.sqrt(u) * np.cos(6 * v),
        lambda u, v: u,
    ],
    ids=["diagonal", "corner", "smooth", "ramp"],
)
@pytest.mark.parametrize("samples", [8, 64, 512])
def test_mean_and_variance_are_unbiased(integrand, samples: int) -> None:
    plan, u, v = points(samples)
    grid = (np.arange(4096) + 0.5) / 4096
    exact = np.mean(integrand(grid[:, None], grid[None]), dtype=np.float64)
    mean, stated = sampling.standard_error(plan, integrand(u, v).astype(np.float32))
    error = mean - exact
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error)) + 1e-6
    true, claimed = np.mean(error**2), np.mean(stated**2)
    spread = np.hypot(np.std(error**2), np.std(stated**2)) / np.sqrt(len(error))
    assert abs(claimed - true) < 4 * spread + 1e-12


def test_errors_of_neighbouring_pixels_are_uncorrelated() -> None:
    plan, u, v = points(64)
    error = ((u + v < 0.7).mean(axis=1) - 0.245).astype(np.float64)
    assert plan.samples == 64
    assert abs(np.corrcoef(error[:-1], error[1:])[0, 1]) < 4 / np.sqrt(len(error))


def test_directions_are_cosine_weighted_about_any_normal() -> None:
    rng = np.random.default_rng(2)
    normals = rng.standard_normal((64, 3))
    normals = np.concatenate((normals / np.linalg.norm(normals, axis=1, keepdims=True), np.eye(3), -np.eye(3)))
    _, u, v = points(512, pixels=np.arange(len(normals)))
    along, cosine = sampling.directions(u, v, normals)
    np.testing.assert_allclose(np.linalg.norm(along, axis=2), 1, atol=1e-6)
    np.testing.assert_allclose(np.einsum("psi,pi->ps", along, normals), cosine, atol=1e-6)
    assert cosine.min() > 2e-4
    np.testing.assert_allclose(cosine.mean(axis=1), 2 / 3, atol=2e-3)  # E cos = 2/3 under a cosine density
    np.testing.assert_allclose(along.mean(axis=1), 2 / 3 * normals, atol=6e-3)
