"""Approximate tables (sat_scale) by hand, and every option against supersampled windows that are exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from support.statvo_images import Floats, constant_normal, psi_by_table, run

# Sub-pixels a side: every window below has its edges on multiples of 1/8 pixel, so supersampling it is exact.
SUB = 8
# A pinhole's windows about blocks are as large as the block's mean depth says, which is on no grid: no adaptive layers.
EXACT_CASES = [
    (scale, layering, layers, orthographic)
    for scale in (1, 2, 4)
    for layering, layers in (("adaptive", 1), ("adaptive", 2), ("adaptive", 4), ("uniform", 3))
    for orthographic in (False, True)
    if scale == 1 or orthographic or layering == "uniform" or layers == 1
]


def test_a_block_that_mixes_near_and_far_is_their_mean() -> None:
    # Blocks: four pixels of mean depth 9.5 about x = 1, four of depth 10 about x = 3. Windows are 3 pixels wide.
    depth = [[9.0, 10.0, 10.0, 10.0]] * 2
    got = run(depth, sat_scale=2)
    # The far pixels see, of the near block, 4 pixels (x up to 3, beside 2 of the other), 2 (beside 4), none.
    expected = [1.0, 1.0 - 4 / 6 * 0.5 / 1.5, 1.0 - 2 / 6 * 0.5 / 1.5, 1.0]
    np.testing.assert_allclose(got, [expected] * 2, atol=1e-12)
    # Full resolution keeps the near column apart: the last but one pixel does not see it.
    assert run(depth)[0, 2] == 1.0


def test_two_layers_of_blocks() -> None:
    # As above, a box of 0.375: the near block reads s = 4/3, psi = 2/3. One layer: s = 2/6 * 0.5 / 0.375.
    depth = [[9.0, 10.0, 10.0, 10.0]] * 2
    for layering in ("adaptive", "uniform"):
        got = run(depth, sat_scale=2, layers=2, layering=layering, height=0.25)
        np.testing.assert_allclose(got[0, 1:3], [1.0 - 4 / 6 * 2 / 3, 1.0 - 2 / 6 * 2 / 3], atol=1e-12)
    assert run(depth, sat_scale=2, layers=1, height=0.25)[0, 2] == pytest.approx(1.0 - 2 / 6 * 4 / 3, abs=1e-12)
    # Uniform slices are cut between block means 9.5 and 10, not between pixels: 9.8 falls into the farther of two.
    depth = [[9.0, 10.0, 9.8, 9.8, 10.0, 10.0]] * 2
    got = run(depth, sat_scale=2, layers=2, layering="uniform", height=0.1)
    # At x = 4.5, window [3, 6]: half of the block at 9.8 and the block at 10, mean 0.2 / 3 of a box of 0.15.
    assert got[0, 4] == pytest.approx(1.0 - 0.2 / 3 / 0.15, abs=1e-12)


def test_counts_and_positions_are_carried_across_the_mask() -> None:
    # Only the left column of the first block counts: 2 pixels about x = 0.5, spread evenly over its four.
    depth, valid = [[9.0, 5.0, 10.0, 10.0]] * 2, [[True, False, True, True]] * 2
    got = run(depth, valid, sat_scale=2)
    # At x = 2.5: half of the block, so 1 pixel at height 1, and 4 at 0.
    np.testing.assert_allclose(got[0], [1.0, 1.0, 1.0 - 1 / 5 / 1.5, 1.0], atol=1e-12)
    # Turned aside, heights follow the mean positions: -2 * 0.6 + 1 * 0.8 and 0.5 * 0.6.
    tilted = constant_normal((0.6, 0.0, -0.8), 2, 4)
    got = run(depth, valid, tilted, sat_scale=2)
    assert got[0, 2] == pytest.approx(1.0 - (1 * -0.4 + 4 * 0.3) / 5 / 1.5, abs=1e-12)
    # At x = 3.5 the window holds the last block alone, whose mean lies half a pixel to the left.
    assert got[0, 3] == 1.0
    # A block without valid pixels is no sample, whatever its depth.
    empty = run(depth, [[False, False, True, True]] * 2, sat_scale=2)
    assert (empty == 1.0).all()


def test_sizes_that_the_scale_does_not_divide() -> None:
    # One row of five in blocks of 4 x 4: densities 4/16 on columns 0 to 3, and 1/16 from column 4 on.
    # At x = 3.5, window [2, 5]: masses 8 and 1; at x = 4.5, window [3, 5]: 4 and 1 (what sticks out is never counted).
    np.testing.assert_allclose(
        run([[10.0, 10.0, 10.0, 10.0, 9.1]], sat_scale=4)[0], [1.0, 1.0, 1.0, 1.0 - 0.9 / 9 / 1.5, 1.0], atol=1e-12
    )
    got = run([[10.0, 10.0, 10.0, 10.0, 10.9]], sat_scale=4)[0]
    np.testing.assert_allclose(got, [1.0, 1.0, 1.0, 1.0, 1.0 - 0.9 * 4 / 5 / 1.5], atol=1e-12)
    # Positions are means of the pixels that exist: x = 4.5 and not the block's centre at 6.
    tilted = constant_normal((0.6, 0.0, -0.8), 1, 5)
    got = run(np.full((1, 5), 10.0), normal=tilted, sat_scale=4)[0]
    # At x = 3.5: means at x = 2 (mass 8) and 4.5 (mass 1) are to the left on average; at x = 0.5 one at x = 2.
    np.testing.assert_allclose(got[[0, 3]], [1.0 - 0.6 * 1.5 / 1.5, 1.0], atol=1e-12)
    # At x = 2.5, window [1, 4]: the first block alone, its mean half a pixel to the left.
    assert got[2] == 1.0


def test_windows_of_blocks_that_stick_out() -> None:
    # The last block is centred at (6, 2), off the image: with R = 0.9 its window misses it and cannot split.
    depth = [[10.0, 10.0, 10.0, 10.0, 9.1]]
    options: dict[str, Any] = {"sat_scale": 4, "layers": 2, "slope": 1.0}
    # At x = 3.5, window [2.6, 4.4]: masses 1.4 * 4 and 0.4, one layer of mean height 0.06 in a box of 0.45.
    assert run(depth, radius=0.9, height=0.5, **options)[0, 3] == pytest.approx(1.0 - 0.06 / 0.45, abs=1e-12)
    # With R = 2.5 it reaches [3.5, 5], sees the farther block and goes to the upper layer: s = 1.8, psi = 0.2.
    # At x = 3.5, window [1, 5]: masses 12 and 1.
    assert run(depth, radius=2.5, height=0.2, **options)[0, 3] == pytest.approx(1.0 - 0.2 / 13, abs=1e-12)


def test_windows_of_blocks_follow_their_mean_depth() -> None:
    # fx = 4, R = 0.8: a block of mean depth 2 reaches 1.6 pixels from x = 1 and sees x < 2.6; at 4, 0.8 pixels.
    # The far block reaches from 2.2 to 3.8, sees itself alone and stays below; the near one sees both, and is above.
    depth = [[1.5, 2.5, 4.0, 4.0]] * 2
    options: dict[str, Any] = {"camera": (4.0, 4.0, 2.0, 1.0), "orthographic": False, "radius": 0.8, "sat_scale": 2}
    # At the pixel of depth 2.5, half-size 1.28 about x = 1.5: 0.22 to 2.78, so masses 1.78 and 0.78, heights 0.5, -1.5.
    split = run(depth, layers=2, **options)
    assert split[0, 1] == pytest.approx(1.0 - 1.78 / 2.56 * 0.5 / 0.8, abs=1e-12)
    # Unsplit, their mean lies below the pixel.
    assert run(depth, layers=1, **options)[0, 1] == 1.0


def test_deeper_peeled_layers_are_blocks_of_their_own() -> None:
    # 2 x 2 pixels: nearest surface at 10, one deeper sample at 12; the block behind has count 1 and depth 12.
    away = constant_normal((0.0, 0.0, 1.0), 2, 2)
    depth = np.stack([np.full((2, 2), 10.0), np.full((2, 2), 12.0)])
    valid = np.stack([np.ones((2, 2), dtype=bool), np.array([[True, False], [False, False]])])
    got = run(depth, valid, away, radius=2.0, sat_scale=2)
    np.testing.assert_allclose(got, 1.0 - 2.0 * (1 / 5) / 2.0, atol=1e-12)


def test_the_minimum_area_is_in_pixels() -> None:
    # One valid pixel a block and peel: density 1/4, so a window of half-size r holds r^2 of each of two samples.
    away = constant_normal((0.0, 0.0, 1.0), 2, 2)
    valid = [[[True, False], [False, False]]] * 2
    for radius, expected in ((0.99e-3, 1.0), (1.01e-3, 0.75)):
        depth = np.stack([np.full((2, 2), 10.0), np.full((2, 2), 10.0 + 0.5 * radius)])
        got = run(depth, valid, away, radius=radius, layers=2, layering="uniform", sat_scale=2)
        assert got[0, 0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("sat_scale", [2, 4])
@pytest.mark.parametrize("quadrants", [False, True])
def test_images_constant_in_blocks_do_not_notice_the_scale(sat_scale: int, quadrants: bool) -> None:
    # View-aligned, heights do not depend on where in a block a sample lies; uniform slices neither.
    rng = np.random.default_rng(8)
    grow = np.ones((1, sat_scale, sat_scale))
    depth = np.kron(rng.uniform(2.0, 4.0, (2, 4, 3)), grow)
    valid = np.kron(rng.random((2, 4, 3)) < [[[0.9]], [[0.4]]], grow) > 0
    options: dict[str, Any] = {"camera": (6.0, 5.0, 5.0, 4.0), "orthographic": False, "radius": 1.3, "height": 0.5}
    for layers in (1, 3):
        expected = run(depth, valid, layers=layers, layering="uniform", quadrants=quadrants, **options)
        options["sat_scale"] = sat_scale
        got = run(depth, valid, layers=layers, layering="uniform", quadrants=quadrants, **options)
        np.testing.assert_allclose(got, expected, atol=1e-12)
        del options["sat_scale"]
        assert got.std() > 0.02


def block_means(pixels: Floats, valid: npt.NDArray[np.bool_], scale: int) -> tuple[Floats, Floats]:
    """Mean position (L, rows, columns, 3) of each block and its mass a pixel, by padding and reshaping."""
    peels, height, width = valid.shape
    pad = [(0, 0), (0, -height % scale), (0, -width % scale)]
    weight = np.pad(valid.astype(np.float64), pad)
    rows, columns = weight.shape[1] // scale, weight.shape[2] // scale

    def summed(image: Floats) -> Floats:
        return image.reshape(peels, rows, scale, columns, scale, -1).sum(axis=(2, 4))

    count = summed(weight)
    total = summed(np.pad(pixels, [*pad, (0, 0)]) * weight[..., None])
    return total / np.maximum(count, 1.0), count[..., 0] / scale**2


def supersampled(
    depth: Floats,
    valid: npt.NDArray[np.bool_],
    normal: Floats | None,
    camera: tuple[float, ...],
    orthographic: bool,
    *,
    radius: float,
    slope: float,
    layers: int,
    layering: str,
    quadrants: bool,
    sat_scale: int,
) -> Floats:
    """The same definition on an image of SUB x SUB sub-pixels, with layers as nested lists of sample masks."""
    fx, fy, cx, cy = camera
    _, height, width = depth.shape
    v, u = (np.indices((height * SUB, width * SUB)) + 0.5) / SUB
    y, x = np.indices((height, width)) + 0.5
    across = np.ones_like(depth) if orthographic else depth
    pixels = np.stack([(x - cx) / fx * across, (y - cy) / fy * across, depth], axis=-1)
    low, share = block_means(pixels, valid, sat_scale)
    grow = sat_scale * SUB
    points, mass = (a.repeat(grow, 1).repeat(grow, 2)[:, : height * SUB, : width * SUB] for a in (low, share))
    big_depth, big_valid = points[..., 2], mass > 0

    def inside(x: float, y: float, z: float) -> Any:
        k = 1.0 if orthographic else z
        return (abs(u - x) < fx * radius / k) & (abs(v - y) < fy * radius / k)

    def split(node: npt.NDArray[np.bool_]) -> list[npt.NDArray[np.bool_]]:
        upper = np.zeros_like(node)
        for p, i, j in np.ndindex(share.shape):
            here = (p, slice(i * grow, i * grow + grow), slice(j * grow, j * grow + grow))
            if node[here].all():
                z = float(low[p, i, j, 2])
                near = node & inside((j + 0.5) * sat_scale, (i + 0.5) * sat_scale, z)
                if near.any():
                    upper[here] = z < np.average(big_depth[near], weights=mass[near]) - 1e-12
        return [node & upper, node & ~upper]

    if layering == "adaptive":
        nodes = [big_valid]
        for _ in range({1: 0, 2: 1, 4: 2}[layers]):
            nodes = [child for node in nodes for child in split(node)]
    else:
        edges = np.linspace(low[share > 0][:, 2].min(), low[share > 0][:, 2].max(), layers + 1)[1:-1]
        nodes = [big_valid & (np.searchsorted(edges, big_depth, side="right") == m) for m in range(layers)]
    everywhere = np.ones_like(u, dtype=bool)
    result = np.ones((height, width))
    for i, j in zip(*np.nonzero(valid[0]), strict=True):
        sides = [(u < j + 0.5), (u > j + 0.5)], [(v < i + 0.5), (v > i + 0.5)]
        parts = [a & b for a in sides[0] for b in sides[1]] if quadrants else [everywhere]
        n = np.array([0.0, 0.0, -1.0]) if normal is None else normal[:, i, j]
        window, answers = inside(j + 0.5, i + 0.5, float(depth[0, i, j])), []
        for part in parts:
            chosen = [node & window & part for node in nodes]
            heights = [np.average((points[c] - pixels[0, i, j]) @ n, weights=mass[c]) for c in chosen if c.any()]
            masses = [mass[c].sum() for c in chosen if c.any()]
            if masses:
                answers.append(np.average([psi_by_table(h / radius, slope) for h in heights], weights=masses))
        result[i, j] = 1.0 - np.mean(answers)
    return result


@pytest.mark.parametrize("quadrants", [False, True])
@pytest.mark.parametrize("aligned", ["view", "surface"])
@pytest.mark.parametrize(("sat_scale", "layering", "layers", "orthographic"), EXACT_CASES)
def test_equals_supersampled_windows(
    sat_scale: int, layering: str, layers: int, orthographic: bool, aligned: str, quadrants: bool
) -> None:
    # Powers of two as depths keep the window edges of the pinhole on the sub-pixel grid.
    rng = np.random.default_rng(5)
    depth = rng.choice([1.0, 2.0, 4.0], (2, 6, 7))
    valid = rng.random((2, 6, 7)) < [[[0.9]], [[0.3]]]
    slant = rng.normal(size=(3, 6, 7)) - [[[0.0]], [[0.0]], [[2.0]]]
    normal = None if aligned == "view" else slant / np.linalg.norm(slant, axis=0)
    camera = (5.0, 6.0, 2.9, 3.7)
    radius = 0.5 if not orthographic else 0.375
    if orthographic:
        depth = depth / 4.0 + rng.choice([0.0, 0.1], depth.shape)
        camera = (5.0, 7.0, 2.9, 3.7)
    options: dict[str, Any] = {"radius": radius, "slope": 0.7, "layers": layers, "layering": layering}
    options |= {"quadrants": quadrants, "sat_scale": sat_scale}
    expected = supersampled(depth, valid, normal, camera, orthographic, **options)
    got = run(depth, valid, normal, camera, orthographic=orthographic, **options)
    np.testing.assert_allclose(got, expected, atol=1e-12)
    # In blocks of 4 the mean of one layer lies below every pixel that has any.
    assert sat_scale == 4 or got.std() > 0.02
