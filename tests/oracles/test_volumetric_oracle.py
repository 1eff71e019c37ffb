"""The point-sampled volumes on images small enough to work out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from oracles.volumetric_obscurance import SHAPES, Answer, radical_inverse, volumetric_visibility


def run(depth: Any, valid: Any = None, *, shape: str, **options: Any) -> Answer:
    """One image (H, W) of a unit-scale orthographic camera, seen along every normal."""
    z = np.asarray(depth, dtype=np.float64)[None, None]
    mask = np.ones(z.shape, dtype=bool) if valid is None else np.asarray(valid, dtype=bool)[None, None]
    normal = np.zeros((1, 3, *z.shape[2:]))
    normal[:, 2] = -1.0
    return volumetric_visibility(z, mask, normal, 1.0, 1.0, 0.0, 0.0, True, shape=shape, **options)


def corner() -> np.ndarray[Any, Any]:
    """Depth 10, but for columns from 5 on, which are 20 nearer: a wall half a pixel from column 4."""
    depth = np.full((9, 9), 40.0)
    depth[:, 5:] = 20.0
    return depth


def middle(answer: Answer) -> tuple[float, float]:
    """Means over column 4 of the visibility and of the share kept, of the rows whose volumes end within the image."""
    return float(answer.visibility[0, 2:7, 4].mean()), float(answer.kept[0, 2:7, 4].mean())


@pytest.mark.parametrize("shape", ["box", "prism"])
def test_a_wall_fills_the_part_of_the_box_behind_it(shape: str) -> None:
    # From the middle of column 4 the wall is 0.5 away: with R = 2 it takes 1.5 of 4 pixels.
    seen, kept = middle(run(corner(), shape=shape, radius=2.0))
    assert kept == 1.0
    assert seen == pytest.approx(1.0 - 1.5 / 4.0, abs=4e-3)
    # A box twice as high as the wall: half of that part.
    seen, _ = middle(run(corner(), shape=shape, radius=2.0, height=20.0, samples=512))
    assert seen == pytest.approx(1.0 - 1.5 / 4.0 / 2.0, abs=4e-3)


def test_a_wall_takes_a_cap_of_the_ball() -> None:
    seen, kept = middle(run(corner(), shape="ball", radius=2.0, samples=512))
    assert kept == 1.0
    s = 0.25
    assert seen == pytest.approx(1.0 - (1 - s) ** 2 * (2 + s) / 4, abs=4e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_points_off_the_screen_are_dropped(shape: str) -> None:
    # Column 4 is the last but one of six that remain: half a pixel of floor and one of wall are left to its right.
    seen, kept = middle(run(corner()[:, :6], shape=shape, radius=2.0, samples=512))
    if shape == "ball":
        assert kept == pytest.approx(1.0 - 0.25**2 * 2.75 / 4, abs=3e-3)  # the cap beyond 3/4 of the radius
    else:
        assert kept == pytest.approx(3.5 / 4.0, abs=3e-3)
        assert seen == pytest.approx(1.0 - 1.0 / 3.5, abs=4e-3)
    assert seen > middle(run(corner(), shape=shape, radius=2.0, samples=512))[0] + 0.01


@pytest.mark.parametrize("shape", SHAPES)
def test_invalid_pixels_are_open_and_hold_nothing(shape: str) -> None:
    depth, valid = corner(), np.ones((9, 9), dtype=bool)
    valid[:, 5:] = False
    for junk in (20.0, np.nan, np.inf, -1.0):
        depth[:, 5:] = junk
        answer = run(depth, valid if junk == 20.0 else None, shape=shape, radius=2.0)
        assert (answer.visibility == 1.0).all()


def test_seeds_make_the_points() -> None:
    first, again, other = (run(corner(), shape="ball", radius=2.0, seed=seed).visibility for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert [radical_inverse(i, 2) for i in range(5)] == [0.0, 0.5, 0.25, 0.75, 0.125]
    assert radical_inverse(5, 3) == pytest.approx(2 / 3 + 1 / 9)


def test_stored_depth_instead_of_tangent_planes_occludes_a_slope() -> None:
    # A plane of slope 1 in steps of a pixel, R = 2 pixels: the steps alone occlude, the fewer the larger the radius.
    depth = np.tile(10.0 + np.arange(24.0), (18, 1))[None, None]
    normal = np.zeros((1, 3, 18, 24))
    normal[:, 0], normal[:, 2] = np.sqrt(0.5), -np.sqrt(0.5)
    options: dict[str, Any] = {"shape": "prism", "samples": 512}
    steps = []
    for radius in (2.0, 8.0):
        args = depth, np.ones(depth.shape, dtype=bool), normal, 1.0, 1.0, 0.0, 0.0, True
        assert (volumetric_visibility(*args, radius=radius, **options).visibility == 1.0).all()
        answer = volumetric_visibility(*args, radius=radius, planar=False, **options)
        steps.append(1.0 - answer.visibility[answer.kept == 1.0].mean())
    # A step stands over the slope by up to 1 / (2 sqrt 2), on the mean over a pixel by a quarter of that.
    assert steps[0] == pytest.approx(1 / (8 * np.sqrt(2)) / 2.0, rel=0.05)
    assert steps[1] == pytest.approx(1 / (8 * np.sqrt(2)) / 8.0, rel=0.25)


def test_refuses_unknown_shapes() -> None:
    with pytest.raises(ValueError, match="shape"):
        run(corner(), shape="cone", radius=1.0)
