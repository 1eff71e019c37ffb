"""Closed forms of pits, corners and round things against ray casting, one another, their limits, and their errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from support import monte_carlo as mc
from support import pits
from torch_ssao import checks
from torch_ssao.scenes import closed_forms as cf

UP = (0.0, 0.0, 1.0)
TOLERANCE = 6e-4
RADII = (math.inf, 2.0, 0.8, 0.35)
WEIGHTINGS = ("cosine", "uniform")
ASKED: list[dict[str, Any]] = [{"falloff": f, "weighting": w} for w in WEIGHTINGS for f in cf.FALLOFFS]
BOX, TRENCH, ROUND = (1.0, 1.6, 0.7), (1.0, math.inf, 0.7), (0.5, 0.6)
Case = tuple[Callable[..., Any], tuple[Any, ...], tuple[float, ...], tuple[float, ...], list[mc.Occluder]]


def _in_bowl(polar_deg: float, half_angle_deg: float) -> Case:
    """A point of a bowl of radius 0.6, its normal, and the bowl."""
    sine, cosine = math.sin(math.radians(polar_deg)), math.cos(math.radians(polar_deg))
    place, normal = (0.6 * sine, 0.0, 0.6 - 0.6 * cosine), (-sine, 0.0, cosine)
    return cf.bowl, (polar_deg, half_angle_deg, 0.6), place, normal, pits.bowl(0.6, half_angle_deg)[:1]


CASES: dict[str, Case] = {
    # name: closed form, its arguments, the point, its normal, the occluders
    "rectangle above": (
        lambda **q: cf.parallel_rectangle(0.4, (-0.3, 0.8), (0.1, 0.5), **q),
        (),
        (0, 0, 0),
        UP,
        [mc.plane((0, 0, 0.4), UP, lambda p: pits.within(0, -0.3, 0.8, p) & pits.within(1, 0.1, 0.5, p))],
    ),
    "rectangle upright": (
        lambda **q: cf.upright_rectangle(0.3, 0.5, (-0.2, 0.9), **q),
        (),
        (0.3, 0, 0),
        UP,
        [mc.plane((0, 0, 0), (1, 0, 0), lambda p: pits.within(1, -0.2, 0.9, p) & pits.within(2, 0, 0.5, p))],
    ),
    "rectangle aside": (
        lambda **q: cf.upright_rectangle(0.1, 0.5, (0.2, 0.9), **q),
        (),
        (0.1, 0, 0),
        UP,
        [mc.plane((0, 0, 0), (1, 0, 0), lambda p: pits.within(1, 0.2, 0.9, p) & pits.within(2, 0, 0.5, p))],
    ),
    "corner": (cf.room_corner, (0.2, 0.5), (0.2, -0.5, 0), UP, pits.corner()),
    "corner near": (cf.room_corner, (0.02, 0.1), (0.02, -0.1, 0), UP, pits.corner()),
    "trench floor": (cf.trench_floor, (0.2, 1.0, 0.7), (-0.3, 0, 0), UP, pits.box(*TRENCH)),
    "trench wall": (cf.trench_wall, (0.25, 1.0, 0.7), (-0.5, 0, 0.25), (1, 0, 0), pits.box(*TRENCH)),
    "pit floor": (cf.pit_floor, (0.2, 0.9, *BOX), (-0.3, 0.1, 0), UP, pits.box(*BOX)),
    "pit floor in a corner": (cf.pit_floor, (0.97, 0.02, *BOX), (0.47, -0.78, 0), UP, pits.box(*BOX)),
    "pit wall": (cf.pit_wall, (0.5, 0.25, *BOX), (-0.5, -0.3, 0.25), (1, 0, 0), pits.box(*BOX)),
    "pit end wall": (cf.pit_wall, (0.1, 0.6, 1.6, 1.0, 0.7), (-0.4, 0.8, 0.6), (0, -1, 0), pits.box(*BOX)),
    "round pit floor": (cf.round_pit_floor, (0.3, *ROUND), (0.3, 0, 0), UP, pits.round_pit(*ROUND)),
    "round pit centre": (cf.round_pit_floor, (0.0, *ROUND), (0, 0, 0), UP, pits.round_pit(*ROUND)),
    "round pit by the wall": (cf.round_pit_floor, (0.48, *ROUND), (0, 0.48, 0), UP, pits.round_pit(*ROUND)),
    "round pit wall": (cf.round_pit_wall, (0.2, *ROUND), (-0.5, 0, 0.2), (1, 0, 0), pits.round_pit(*ROUND)),
    "round pit wall low": (cf.round_pit_wall, (0.01, *ROUND), (-0.5, 0, 0.01), (1, 0, 0), pits.round_pit(*ROUND)),
    "bowl": _in_bowl(40.0, 75.0),
    "bowl, lowest point": _in_bowl(0.0, 60.0),
    "bowl, near the rim": _in_bowl(85.0, 90.0),
    "cavity": _in_bowl(110.0, 140.0),
    "cylinder": (cf.lying_cylinder, (0.4, 0.5), (0.4, 0, 0), UP, pits.lying_cylinder(0.5)),
    "cylinder near": (cf.lying_cylinder, (0.1, 0.5), (-0.1, 0, 0), UP, pits.lying_cylinder(0.5)),
    "cylinder thin": (cf.lying_cylinder, (0.5, 0.1), (0.5, 0, 0), UP, pits.lying_cylinder(0.1)),
    "disk above": (cf.disk_above, (0.2, 0.5, 0.3), (0.2, 0, 0), UP, pits.disk(0.5, 0.3)),
    "disk aside": (cf.disk_above, (0.7, 0.5, 0.3), (0.7, 0, 0), UP, pits.disk(0.5, 0.3)),
    "disk on the axis": (cf.disk_above, (0.0, 0.5, 0.3), (0, 0, 0), UP, pits.disk(0.5, 0.3)),
}


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("case", CASES)
def test_closed_form_against_ray_casting(case: str, weighting: str) -> None:
    form, arguments, origin, normal, occluders = CASES[case]
    cast = mc.distances(origin, normal, occluders, weighting=weighting, seed=list(CASES).index(case), log2_rays=15)
    for radius in RADII:
        for falloff in cf.FALLOFFS:
            answer = float(form(*arguments, radius=radius, falloff=falloff, weighting=weighting))
            assert answer == pytest.approx(mc.attenuated(cast, radius, falloff), abs=TOLERANCE), (radius, falloff)


def test_room_corner_volumetric() -> None:
    counted = mc.free_volume((0.2, 0.3, 0.0), UP, lambda p: (p[:, 0] < 0) | (p[:, 1] < 0), radius=0.8, seed=3)
    assert float(cf.room_corner(0.2, 0.3, radius=0.8, weighting="volumetric")) == pytest.approx(counted, abs=3e-4)


def test_textbook_values() -> None:
    assert cf.room_corner(0.3, 0.7) == pytest.approx(0.25, abs=1e-15)
    assert cf.room_corner(0.0, 0.0) == pytest.approx(0.25, abs=1e-11)
    assert cf.trench_floor(1.0, 2.0, 1.0) == pytest.approx(math.sqrt(0.5), abs=1e-15)
    assert cf.trench_floor(1.0, 2.0, 2.0) == pytest.approx(1 / math.sqrt(5), abs=1e-15)
    assert cf.trench_wall(0.0, 1.0, 1.0) == pytest.approx(0.5 - 0.5 * math.sqrt(0.5), abs=1e-11)
    assert cf.pit_floor(0.5, 0.5, 1.0, 1.0, 1e-9) == pytest.approx(1.0, abs=1e-8)
    assert cf.pit_wall(0.5, 0.7, *BOX) == pytest.approx(0.5, abs=1e-12)
    assert cf.round_pit_floor(0.0, 1.0, 2.0) == pytest.approx(0.2, abs=1e-15)
    assert cf.round_pit_wall(0.7, 1.0, 0.7) == pytest.approx(0.5, abs=1e-15)
    assert cf.bowl([0.0, 30.0, 90.0], 90.0, 1.0) == pytest.approx(0.5, abs=1e-15)
    assert cf.bowl(20.0, 120.0, 3.0) == pytest.approx(0.25, abs=1e-15)
    assert cf.bowl(20.0, 120.0, 3.0, radius=2.0) == pytest.approx(1 - 2**2 / (4 * 3**2), abs=1e-13)
    assert cf.lying_cylinder([0.0, 1.0, 2.0], 1.0) == pytest.approx([0.0, 0.5, 0.8], abs=1e-15)
    assert cf.disk_above(0.0, 1.0, 2.0) == pytest.approx(0.8, abs=1e-15)


@pytest.mark.parametrize("asked", ASKED, ids=lambda a: f"{a['falloff']} {a['weighting']}")
def test_forms_agree_with_one_another(asked: dict[str, Any]) -> None:
    x, far = np.array([1e-6, 1e-3, 0.05, 0.3, 0.5]), math.inf
    for radius in (far, 0.9, 0.05):
        q = asked | {"radius": radius}
        both = cf.finite_wall(x, 0.7, **q) + cf.finite_wall(1.0 - x, 0.7, **q) - 1.0
        np.testing.assert_allclose(cf.trench_floor(x, 1.0, 0.7, **q), both, rtol=0, atol=1e-12)
        long = cf.pit_floor(x, 4e9, 1.0, 8e9, 0.7, **q)
        np.testing.assert_allclose(cf.trench_floor(x, 1.0, 0.7, **q), long, rtol=0, atol=1e-9)
        long = cf.pit_wall(4e9, x, 1.0, 8e9, 0.7, **q)
        np.testing.assert_allclose(cf.trench_wall(x, 1.0, 0.7, **q), long, rtol=0, atol=1e-9)
        np.testing.assert_allclose(cf.upright_rectangle(x, far, (-far, far), **q), cf.wall(x, **q), rtol=0, atol=1e-12)
        plate = cf.parallel_rectangle(x, (-far, far), (-far, far), **q)
        np.testing.assert_allclose(plate, cf.ceiling(x, **q), rtol=0, atol=1e-12)
        if radius < far:
            np.testing.assert_allclose(cf.disk_above(0.3, 50.0, x, **q), cf.ceiling(x, **q), rtol=0, atol=1e-9)
    # The largest radii tend to the closed forms of an infinite one.
    for name, arguments in (
        ("disk_above", (x, 0.4, 1e-3)),
        ("bowl", (90 * x, 60.0, 1.0)),
        ("bowl", (200 * x, 110.0, 1.0)),
        ("lying_cylinder", (x, 0.4)),
        ("round_pit_floor", (x, 0.5, 0.3)),
        ("round_pit_wall", (0.6 * x, 0.5, 0.3)),
        ("pit_floor", (x, 2 * x, 1.0, 1.6, 0.5)),
        ("pit_wall", (2 * x, x, 1.0, 1.6, 0.5)),
    ):
        form = getattr(cf, name)
        finite, infinite = form(*arguments, radius=1e10, **asked), form(*arguments, weighting=asked["weighting"])
        np.testing.assert_allclose(finite, infinite, rtol=0, atol=2e-9, err_msg=name)


def test_mouths_replace_walls() -> None:
    """Seen from inside a pit the sky is the mouth: two ways to the same number, for both weightings."""
    width, length, depth = BOX
    x, y, z = np.meshgrid([0.1, 0.5], [0.2, 1.5], [0.05, 0.6], indexing="ij")
    for weighting in WEIGHTINGS:
        mouth = 1 - cf.parallel_rectangle(depth, (-x, width - x), (-y, length - y), weighting=weighting)
        np.testing.assert_allclose(cf.pit_floor(x, y, *BOX, weighting=weighting), mouth, rtol=0, atol=1e-13)
        mouth = 1 - cf.upright_rectangle(depth - z, width, (-y, length - y), weighting=weighting)
        np.testing.assert_allclose(cf.pit_wall(y, z, *BOX, weighting=weighting), mouth, rtol=0, atol=1e-13)


@pytest.mark.parametrize("asked", ASKED, ids=lambda a: f"{a['falloff']} {a['weighting']}")
def test_bounds_monotone_and_scale_free(asked: dict[str, Any]) -> None:
    x = np.linspace(0.0, 0.5, 11)
    forms: list[Callable[..., Any]] = [
        lambda k, **q: cf.room_corner(k * x, k * 0.2, **q),
        lambda k, **q: cf.pit_floor(k * x, k * 2 * x, k * 0.5, k, k * 0.3, **q),
        lambda k, **q: cf.pit_wall(k * 2 * x, k * x, k, k, k * 0.5, **q),
        lambda k, **q: cf.round_pit_floor(k * x, k * 0.5, k * 0.3, **q),
        lambda k, **q: cf.round_pit_wall(k * x, k * 0.7, k * 0.5, **q),
        lambda k, **q: cf.bowl(200.0 * x, 100.0, k * 0.4, **q),
        lambda k, **q: cf.lying_cylinder(k * x, k * 0.2, **q),
        lambda k, **q: cf.disk_above(k * x, k * 0.3, k * 0.2, **q),
    ]
    for number, form in enumerate(forms):
        results = [form(1.0, radius=r, **asked) for r in (1e-6, 0.1, 0.3, 0.9, math.inf)]
        for longer, shorter in zip(results[1:], results[:-1], strict=True):
            assert (longer <= shorter + 1e-9).all(), number
        assert all(((r >= -1e-9) & (r <= 1 + 1e-9)).all() for r in results), number
        np.testing.assert_allclose(form(7.0, radius=2.1, **asked), results[2], rtol=0, atol=1e-11)
        assert (results[0][1:-1] > 1 - 1e-5).all(), number  # a vanishing radius sees nothing, but where surfaces touch


def test_errors_name_argument_and_remedy() -> None:
    bad: list[tuple[type[ValueError], str, Callable[[], Any]]] = [
        (checks.RangeError, "height must be greater than 0", lambda: cf.parallel_rectangle(0.0, (0, 1), (0, 1))),
        (checks.RangeError, "x_range must be", lambda: cf.parallel_rectangle(1.0, (1, 0), (0, 1))),
        (checks.RangeError, "y_range must be", lambda: cf.upright_rectangle(1.0, 1.0, (1, 0))),
        (checks.RangeError, "distance must be 0 or more", lambda: cf.upright_rectangle(-1.0, 1.0, (0, 1))),
        (checks.RangeError, "second must be 0 or more", lambda: cf.room_corner(1.0, -1.0)),
        (checks.RangeError, r"x must lie in \[0, width\]", lambda: cf.trench_floor(1.5, 1.0, 1.0)),
        (checks.RangeError, r"height must lie in \[0, depth\]", lambda: cf.trench_wall(1.5, 1.0, 1.0)),
        (checks.RangeError, r"y must lie in \[0, length\]", lambda: cf.pit_floor(0.5, 3.0, 1.0, 1.0, 1.0)),
        (checks.RangeError, r"along must lie in \[0, length\]", lambda: cf.pit_wall(-0.5, 0.5, 1.0, 1.0, 1.0)),
        (checks.RangeError, "depth must be greater than 0", lambda: cf.pit_floor(0.5, 0.5, 1.0, 1.0, 0.0)),
        (checks.RangeError, r"offset must lie in \[0, pit_radius\]", lambda: cf.round_pit_floor(1.5, 1.0, 1.0)),
        (checks.RangeError, "pit_radius must be greater than 0", lambda: cf.round_pit_wall(0.5, 0.0, 1.0)),
        (checks.RangeError, "half_angle_deg must lie in", lambda: cf.bowl(0.0, 180.0, 1.0)),
        (checks.RangeError, r"polar_deg must lie in \[0, half_angle_deg\]", lambda: cf.bowl(50.0, 40.0, 1.0)),
        (checks.RangeError, "cylinder_radius must be greater than 0", lambda: cf.lying_cylinder(1.0, 0.0)),
        (checks.RangeError, "offset must be 0 or more", lambda: cf.disk_above(-1.0, 1.0, 1.0)),
        (checks.ChoiceError, "weighting must be one of", lambda: cf.disk_above(1.0, 1.0, 1.0, weighting="volumetric")),
        (checks.ChoiceError, "falloff must be one of", lambda: cf.bowl(1.0, 40.0, 1.0, falloff="cubic")),
    ]
    for error, message, call in bad:
        with pytest.raises(error, match=message):
            call()
