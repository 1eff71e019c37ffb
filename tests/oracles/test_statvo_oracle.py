"""The oracle against cases small enough to work out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from oracles.statvo import statvo_visibility
from support.statvo_images import EPS, constant_normal, psi_by_table, run

EVERY_LAYERING = [("adaptive", 1), ("adaptive", 2), ("adaptive", 8), ("adaptive", 16), ("uniform", 3)]


@pytest.mark.parametrize(("layering", "layers"), EVERY_LAYERING)
@pytest.mark.parametrize("quadrants", [False, True])
def test_frontal_plane_is_open(layering: str, layers: int, quadrants: bool) -> None:
    options: dict[str, Any] = {"layering": layering, "layers": layers, "quadrants": quadrants, "radius": 0.37}
    camera = (12.0, 10.0, 4.2, 5.1)
    assert (run(np.full((9, 11), 2.3), camera=camera, orthographic=False, **options) == 1.0).all()
    assert (run(np.full((9, 11), 2.3), camera=camera, orthographic=True, **options) == 1.0).all()


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("degrees", [20.0, 60.0, 80.0])
@pytest.mark.parametrize("sat_scale", [1, 2, 4])
def test_tilted_plane_is_open(sat_scale: int, degrees: float, orthographic: bool) -> None:
    angle = np.deg2rad(degrees)
    normal = np.array([0.6 * np.sin(angle), 0.8 * np.sin(angle), -np.cos(angle)])
    fx, fy, cx, cy = 40.0, 35.0, 5.3, 4.4
    x, y = (np.arange(11) + 0.5 - cx)[None, :] / fx, (np.arange(9) + 0.5 - cy)[:, None] / fy
    # The plane through (0, 0, 5): n . p = 5 n_z.
    if orthographic:
        depth = 5.0 - (normal[0] * x + normal[1] * y) / normal[2]
    else:
        depth = 5.0 * normal[2] / (normal[0] * x + normal[1] * y + normal[2])
    assert (depth > 0).all()
    normals = np.broadcast_to(normal[:, None, None], (3, 9, 11))
    for layering, layers in EVERY_LAYERING:
        options: dict[str, Any] = {"layering": layering, "layers": layers, "orthographic": orthographic, "radius": 0.4}
        options["sat_scale"] = sat_scale
        assert (run(depth, normal=normals, camera=(fx, fy, cx, cy), **options) == 1.0).all()
    # Aligned with the view instead, clipped windows at the border see the nearer side of the plane only.
    assert run(depth, camera=(fx, fy, cx, cy), radius=0.4, orthographic=orthographic).min() < 1.0


@pytest.mark.parametrize("fill", [-0.5, 0.0, 0.25, 0.5, 1.0, 1.25, 1.5, 2.0])
@pytest.mark.parametrize(("slope", "contrast", "height"), [(1.0, 1.0, 1.0), (2.0, 1.0, 0.5), (0.5, 2.0, 1.5)])
def test_psi_of_a_pit(fill: float, slope: float, contrast: float, height: float) -> None:
    # 3x3 whole pixels, the centre at 10 and eight neighbours nearer by `step`: the mean is nearer by 8/9 of it.
    step = fill * height * 1.5 * 9 / 8
    depth = np.full((7, 7), 10.0 - step)
    depth[3, 3] = 10.0
    got = run(depth, slope=slope, contrast=contrast, height=height)[3, 3]
    assert got == pytest.approx((1.0 - psi_by_table(fill, slope)) ** contrast, abs=1e-12)


def test_two_adaptive_layers_in_a_pit() -> None:
    # Neighbours that see the pit lie above their mean (upper layer), the pit and all others do not.
    # At the pit: 8 samples at height 0.6 in the upper layer, 1 at height 0 in the lower one.
    depth = np.full((7, 7), 9.4)
    depth[3, 3] = 10.0
    got = run(depth, layers=2)
    assert got[3, 3] == pytest.approx(1.0 - 8 / 9 * 0.6 / 1.5, abs=1e-12)
    rest = np.ones((7, 7), dtype=bool)
    rest[3, 3] = False
    assert (got[rest] == 1.0).all()
    # The next rounds find nothing left to split.
    np.testing.assert_array_equal(run(depth, layers=8), got)


def test_uniform_slices_separate_three_depths() -> None:
    # Depths 10, 11 and 13 in a row; window of 3 pixels. Three slices of thickness 1: 10 | 11 | 13 (clamped).
    got = run([[10.0, 11.0, 13.0]], layers=3, layering="uniform", slope=0.5)
    # At 11: heights 1, 0, -2. At 13 (which sees 11 and 13): heights 2, 0.
    expected = [1.0, 1.0 - psi_by_table(1 / 1.5, 0.5) / 3, 1.0 - psi_by_table(2 / 1.5, 0.5) / 2]
    np.testing.assert_allclose(got[0], expected, atol=1e-12)
    # Two slices of thickness 1.5: 10 and 11 together, 13 alone. At 11 the first has mean 10.5; at 13 it has 11 alone.
    got = run([[10.0, 11.0, 13.0]], layers=2, layering="uniform", slope=0.5)
    np.testing.assert_allclose(got[0], [1.0, 1.0 - 2 / 3 * 0.5 / 1.5, expected[2]], atol=1e-12)


def test_farthest_depth_joins_the_last_uniform_slice() -> None:
    # Thickness 1: 12.4 is in the third slice, and so is 13, on its far edge. At 13 they have mean height 0.3.
    got = run([[10.0, 12.4, 13.0]], layers=3, layering="uniform")
    # At 12.4: 10 has height 2.4 (psi = 0.4 for a box of 1.5), the other slice has height -0.3.
    np.testing.assert_allclose(got[0], [1.0, 1.0 - 0.4 / 3, 1.0 - 0.3 / 1.5], atol=1e-12)


def test_partial_pixels_count_by_area() -> None:
    # Half-size 1: a whole centre and half of each neighbour, of which the right one is invalid.
    # Mean height at the middle: 0.3 * 0.5 / 1.5.
    got = run([[9.7, 10.0, 9.0]], valid=[[True, True, False]], radius=1.0)
    np.testing.assert_allclose(got[0], [1.0, 1.0 - 0.1, 1.0], atol=1e-12)
    # Half-size 0.75, one quarter pixel of the neighbour: mean height 0.4 * 0.25 / (1 + 0.25), box height 0.75.
    got = run([[9.6, 10.0]], radius=0.75)
    np.testing.assert_allclose(got[0], [1.0, 1.0 - 0.08 / 0.75], atol=1e-12)


def test_window_follows_depth_and_focal_lengths() -> None:
    # Half-size (3 * 0.5 / 2, 8 * 0.5 / 2) = (0.75, 2) pixels at depth 2: the second column always weighs 1/4.
    depth = [[2.0, 1.9], [2.0, 1.9], [2.0, 1.9]]
    got = run(depth, camera=(3.0, 8.0, 1.0, 1.5), radius=0.5, orthographic=False)
    np.testing.assert_allclose(got[:, 0], 1.0 - 0.1 * 0.2 / 0.5, atol=1e-12)


def test_mean_position_moves_sideways_at_the_border() -> None:
    # Window [0, 1.5]: weights 1 and 1/2 at x = 0.5 and 1.5, so the mean lies 1/3 to the right of the centre.
    normal = constant_normal((0.6, 0.0, -0.8), 1, 3)
    got = run(np.full((1, 3), 10.0), normal=normal, radius=1.0)
    # At the other border it lies 1/3 to the left, below the tangent plane.
    np.testing.assert_allclose(got[0], [1.0 - 0.6 / 3, 1.0, 1.0], atol=1e-12)
    # Pinhole: the same shift in pixels is z / fx as long in space; half-size fx R / z = 1.
    got = run(np.full((1, 3), 10.0), normal=normal, radius=2.0, camera=(5.0, 5.0, 0.3, 0.2), orthographic=False)
    np.testing.assert_allclose(got[0], [1.0 - 0.6 * (10.0 / 5.0) / 3 / 2.0, 1.0, 1.0], atol=1e-12)


def test_quadrants_are_averaged_by_hand() -> None:
    # Each quarter of a 3x3 window holds 1/4 centre, 1/2 + 1/2 edges and 1 corner: 2.25 in all.
    # One corner is nearer by 0.9.
    depth = np.full((5, 5), 10.0)
    depth[1, 1] = 9.1
    assert run(depth, quadrants=True)[2, 2] == pytest.approx(1.0 - psi_by_table(0.9 / 2.25 / 1.5, 1.0) / 4, abs=1e-12)
    # Nearer by 4.5, the quarter reads height 2 (psi = 2/3) where the whole window reads 0.5 (psi = 1/3).
    depth[1, 1] = 5.5
    assert run(depth, quadrants=True)[2, 2] == pytest.approx(1.0 - (2 / 3) / 4, abs=1e-12)
    assert run(depth, quadrants=False)[2, 2] == pytest.approx(1.0 - 1 / 3, abs=1e-12)


def test_deeper_peeled_layers_join_the_window_and_the_partition() -> None:
    # A single pixel with samples at 10 and 11, seen with a normal turned away so that the deeper one lies above.
    away = constant_normal((0.0, 0.0, 1.0), 1, 1)
    depth = np.array([[[10.0]], [[11.0]]])
    assert run(depth, normal=away, radius=1.0)[0, 0] == pytest.approx(1.0 - 0.5)
    # Two layers: each sample on its own; the deeper has height 1, which fills the box, and half the weight.
    assert run(depth, normal=away, radius=1.0, layers=2)[0, 0] == pytest.approx(1.0 - 0.5)
    assert run(depth, normal=away, radius=1.0, layers=2, height=0.5, slope=0.25)[0, 0] == pytest.approx(1.0 - 0.75 / 2)
    assert run(depth, normal=away, radius=1.0, layers=1, height=0.5, slope=0.25)[0, 0] == pytest.approx(0.0)
    # An invalid nearest surface: open, whatever lies behind it.
    assert run(depth, [[[False]], [[True]]], away, radius=1.0)[0, 0] == 1.0


def test_layers_below_the_minimum_area_are_skipped() -> None:
    # The deeper of two samples fills half the box; a window of half-size r pixels holds 4 r^2 of each.
    away = constant_normal((0.0, 0.0, 1.0), 1, 1)
    for quadrants, below, above in ((False, 4.9e-4, 5.1e-4), (True, 9.9e-4, 1.01e-3)):
        for radius, expected in ((below, 1.0), (above, 0.75)):
            depth = np.array([[[10.0]], [[10.0 + 0.5 * radius]]])
            got = run(depth, normal=away, radius=radius, layers=2, layering="uniform", quadrants=quadrants)
            assert got[0, 0] == pytest.approx(expected, abs=1e-9)


def test_heights_within_rounding_of_the_distance_count_as_zero() -> None:
    # Centre at (3, 4, 12), distance 13; tolerance 8 * 1e-3 * 13 = 0.104. The mean of two samples is at half their gap.
    away = constant_normal((0.0, 0.0, 1.0), 1, 1)
    options: dict[str, Any] = {"normal": away, "camera": (1.0, 1.0, -2.5, -3.5), "radius": 1.0, "eps": 1e-3}
    for gap, expected in ((0.2, 1.0), (0.206, 1.0), (0.21, 1.0 - 0.105)):
        assert run(np.array([[[12.0]], [[12.0 + gap]]]), **options)[0, 0] == pytest.approx(expected, abs=1e-12)


def test_depths_within_rounding_of_the_mean_go_to_the_lower_layer() -> None:
    # At 9.85 the window mean is 9.925, above by 0.075; 8 eps z is 0.0788 for eps = 1e-3 and 0.0709 for 9e-4.
    # Not split, the pixel at 10 reads height 0.075, within the height tolerance of 0.08 for eps = 1e-3: open.
    # Split, it reads 0.15 with half the weight; the box is 0.1 high, so psi = 0.5.
    options: dict[str, Any] = {"radius": 1.0, "height": 0.1, "slope": 1.0, "layers": 2, "camera": (2.0, 2.0, 0.0, 0.0)}
    assert run([[9.85, 10.0]], eps=1e-3, **options)[0, 1] == 1.0
    assert run([[9.85, 10.0]], eps=9e-4, **options)[0, 1] == pytest.approx(1.0 - 0.5 * 0.5, abs=1e-12)
    assert run([[9.85, 10.0]], eps=9e-4, **(options | {"layers": 1}))[0, 1] == pytest.approx(0.25, abs=1e-12)


@pytest.mark.parametrize(("layering", "layers"), EVERY_LAYERING)
@pytest.mark.parametrize("quadrants", [False, True])
def test_invalid_pixels_are_open_and_never_occlude(layering: str, layers: int, quadrants: bool) -> None:
    rng = np.random.default_rng(3)
    depth, valid = rng.uniform(2.0, 4.0, (2, 9, 11)), rng.random((2, 9, 11)) < 0.7
    options: dict[str, Any] = {
        "layering": layering,
        "layers": layers,
        "quadrants": quadrants,
        "camera": (6.0, 5.0, 5.0, 4.0),
    }
    options |= {"orthographic": False, "radius": 1.0}
    expected = run(depth, valid, **options)
    assert (expected[~valid[0]] == 1.0).all()
    assert expected[valid[0]].min() < 0.9
    for junk in (1e-3, 1e9, np.nan, np.inf, -1.0, 0.0):
        np.testing.assert_array_equal(run(np.where(valid, depth, junk), valid, **options), expected)
    for junk in (np.nan, np.inf, -1.0, 0.0):
        np.testing.assert_array_equal(run(np.where(valid, depth, junk), None, **options), expected)
    assert (run(depth, np.zeros_like(valid), **options) == 1.0).all()


def test_constant_depth_puts_every_sample_in_the_first_uniform_slice() -> None:
    # With a tilted normal a constant depth is not open, and one layer must give what seven do.
    normal, depth = constant_normal((0.5, 0.2, -0.7), 4, 5), np.full((4, 5), 3.0)
    one, seven = (run(depth, normal=normal, layers=m, layering="uniform") for m in (1, 7))
    assert one.min() < 0.9
    np.testing.assert_array_equal(one, seven)


def test_batch_items_have_their_own_camera() -> None:
    rng = np.random.default_rng(4)
    depth, valid = rng.uniform(2.0, 4.0, (2, 2, 5, 6)), rng.random((2, 2, 5, 6)) < 0.8
    normal = np.stack([constant_normal((0.1, 0.2, -1.0), 5, 6), constant_normal((-0.3, 0.0, -1.0), 5, 6)])
    cameras = (np.array([6.0, 9.0]), np.array([5.0, 7.0]), np.array([3.0, 2.0]), np.array([2.5, 4.0]))
    options: dict[str, Any] = {"radius": 0.8, "height": 1.0, "slope": 1.0, "contrast": 1.3, "layers": 4, "eps": EPS}
    both = statvo_visibility(depth, valid, normal, *cameras, False, **options)
    assert both.shape == (2, 5, 6)
    for b in range(2):
        one = run(depth[b], valid[b], normal[b], tuple(c[b] for c in cameras), orthographic=False, **options)
        np.testing.assert_array_equal(both[b], one)


def test_refuses_unknown_layering_and_layer_counts() -> None:
    with pytest.raises(ValueError, match="layering"):
        run([[1.0]], layering="median")
    with pytest.raises(ValueError, match="layers"):
        run([[1.0]], layers=3)
    with pytest.raises(ValueError, match="layers"):
        run([[1.0]], layers=0, layering="uniform")
    with pytest.raises(ValueError, match="sat_scale"):
        run([[1.0]], sat_scale=0)
