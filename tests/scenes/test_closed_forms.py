"""Every closed form against quasi-Monte Carlo ray casting, its limits, and its errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from support import monte_carlo as mc
from torch_ssao import checks
from torch_ssao.scenes import closed_forms as cf

UP = (0.0, 0.0, 1.0)
TOLERANCE = 3e-4
RADII = (math.inf, 1.0)
ASKED = [(f, w) for w in ("cosine", "uniform") for f in cf.FALLOFFS]


def _seed(*parts: float) -> int:
    return int(1e6 * sum((i + 1) * p for i, p in enumerate(parts) if math.isfinite(p))) % 100003


def _half_plane(angle_deg: float) -> mc.Occluder:
    """The second face of a dihedral whose first is z = 0, x > 0 and whose edge is the y axis."""
    beta = math.radians(angle_deg)
    along = np.array([math.cos(beta), 0.0, math.sin(beta)])
    return mc.plane((0, 0, 0), (math.sin(beta), 0.0, -math.cos(beta)), lambda hit: hit @ along > 0)


def test_monte_carlo_helper_on_a_60_degree_disk() -> None:
    height = 0.7
    disk = mc.plane((0, 0, height), UP, lambda hit: np.hypot(hit[:, 0], hit[:, 1]) < height * math.tan(math.pi / 3))
    assert mc.visibility((0, 0, 0), UP, [disk], weighting="cosine") == pytest.approx(0.25, abs=TOLERANCE)
    assert mc.visibility((0, 0, 0), UP, [disk], weighting="uniform") == pytest.approx(0.5, abs=TOLERANCE)
    assert cf.spherical_cap(0.5, 1.0) == pytest.approx(0.25, abs=1e-15)
    assert cf.spherical_cap(0.5, 1.0, weighting="uniform") == pytest.approx(0.5, abs=1e-15)


@pytest.mark.parametrize("weighting", ["cosine", "uniform"])
@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 50.0, 90.0, 130.0, 170.0])
def test_spherical_cap(tilt_deg: float, weighting: str) -> None:
    tilt, half = math.radians(tilt_deg), math.radians(55.0)
    directions = mc.hemisphere(UP, weighting, seed=_seed(tilt_deg))
    blocked = directions @ np.array([math.sin(tilt), 0.0, math.cos(tilt)]) > math.cos(half)
    exact = cf.spherical_cap(math.cos(half), math.cos(tilt), weighting=weighting)
    assert exact == pytest.approx(1 - blocked.mean(), abs=TOLERANCE)


CASES: dict[str, tuple[Callable[..., Any], tuple[float, ...], tuple[float, ...], list[mc.Occluder]]] = {
    # name: closed form, its arguments, the point, the occluders
    "wall near": (cf.wall, (0.05,), (0.05, 0, 0), [_half_plane(90)]),
    "wall": (cf.wall, (0.4,), (0.4, 0, 0), [_half_plane(90)]),
    "wall far": (cf.wall, (0.9,), (0.9, 0, 0), [_half_plane(90)]),
    "dihedral 25": (cf.dihedral, (0.7, 25.0), (0.7, 0, 0), [_half_plane(25)]),
    "dihedral 60": (cf.dihedral, (0.4, 60.0), (0.4, 0, 0), [_half_plane(60)]),
    "dihedral 60 far": (cf.dihedral, (1.1, 60.0), (1.1, 0, 0), [_half_plane(60)]),
    "dihedral 120": (cf.dihedral, (0.3, 120.0), (0.3, 0, 0), [_half_plane(120)]),
    "dihedral 160": (cf.dihedral, (0.1, 160.0), (0.1, 0, 0), [_half_plane(160)]),
    "dihedral 180": (cf.dihedral, (0.3, 180.0), (0.3, 0, 0), [_half_plane(180)]),
    "dihedral 250": (cf.dihedral, (0.3, 250.0), (0.3, 0, 0), [_half_plane(250)]),
    "low wall": (
        cf.finite_wall,
        (0.4, 0.3),
        (0.4, 0, 0),
        [mc.plane((0, 0, 0), (1, 0, 0), lambda p: (p[:, 2] > 0) & (p[:, 2] < 0.3))],
    ),
    "high wall": (
        cf.finite_wall,
        (0.4, 2.0),
        (0.4, 0, 0),
        [mc.plane((0, 0, 0), (1, 0, 0), lambda p: (p[:, 2] > 0) & (p[:, 2] < 2))],
    ),
    "slat": (
        cf.raised_slat,
        (0.4, 0.2, 0.3),
        (0.4, 0, 0),
        [mc.plane((0, 0, 0), (1, 0, 0), lambda p: (p[:, 2] > 0.2) & (p[:, 2] < 0.5))],
    ),
    "cut slat": (
        cf.raised_slat,
        (0.5, 0.6, 9.0),
        (0.5, 0, 0),
        [mc.plane((0, 0, 0), (1, 0, 0), lambda p: (p[:, 2] > 0.6) & (p[:, 2] < 9.6))],
    ),
    "ceiling low": (cf.ceiling, (0.2,), (0, 0, 0), [mc.plane((0, 0, 0.2), UP)]),
    "ceiling high": (cf.ceiling, (0.8,), (0, 0, 0), [mc.plane((0, 0, 0.8), UP)]),
    "resting sphere beside": (cf.sphere_on_plane, (0.8, 0.5), (0.8, 0, 0), [mc.sphere((0, 0, 0.5), 0.5)]),
    "resting sphere under": (cf.sphere_on_plane, (0.1, 0.5), (0.1, 0, 0), [mc.sphere((0, 0, 0.5), 0.5)]),
    "resting sphere cut by R": (cf.sphere_on_plane, (1.5, 2.0), (1.5, 0, 0), [mc.sphere((0, 0, 2.0), 2.0)]),
    "sphere above": (cf.sphere, (0.8, 1.0, 0.5), (0, 0, 0), [mc.sphere((0, 0, 0.8), 0.5)]),
    "sphere tilted": (cf.sphere, (0.9, 0.8, 0.5), (0, 0, 0), [mc.sphere((0.54, 0, 0.72), 0.5)]),
    "sphere cut": (cf.sphere, (1.0, 0.28, 0.7), (0, 0, 0), [mc.sphere((0.96, 0, 0.28), 0.7)]),
    "sphere mostly below": (cf.sphere, (1.0, -0.28, 0.7), (0, 0, 0), [mc.sphere((0.96, 0, -0.28), 0.7)]),
    "sphere below": (cf.sphere, (1.0, -0.8, 0.5), (0, 0, 0), [mc.sphere((0.6, 0, -0.8), 0.5)]),
    "half space": (cf.half_space, (0.3, 0.6), (0, 0, 0), [mc.plane((0.24, 0, 0.18), (0.8, 0, 0.6))]),
    "half space below": (cf.half_space, (0.3, -0.6), (0, 0, 0), [mc.plane((0.24, 0, -0.18), (0.8, 0, -0.6))]),
}


@pytest.mark.parametrize(("falloff", "weighting"), ASKED)
@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize("case", CASES)
def test_closed_form_against_ray_casting(case: str, radius: float, falloff: str, weighting: str) -> None:
    form, arguments, origin, occluders = CASES[case]
    asked: dict[str, Any] = {"radius": radius, "falloff": falloff, "weighting": weighting}
    cast = mc.visibility(origin, UP, occluders, seed=_seed(*arguments), **asked)
    assert float(form(*arguments, **asked)) == pytest.approx(cast, abs=TOLERANCE)


SOLIDS: dict[str, tuple[Callable[..., Any], tuple[float, ...], tuple[float, ...], Callable[[mc.Array], mc.Array]]] = {
    "wall": (cf.wall, (0.3,), (0.3, 0, 0), lambda p: p[:, 0] < 0),
    "ceiling": (cf.ceiling, (0.4,), (0, 0, 0), lambda p: p[:, 2] > 0.4),
    "dihedral edge": (cf.dihedral, (0.0, 70.0), (0, 0, 0), lambda p: p[:, 2] > math.tan(math.radians(70)) * p[:, 0]),
    "dihedral 70": (cf.dihedral, (0.5, 70.0), (0.5, 0, 0), lambda p: p[:, 2] > math.tan(math.radians(70)) * p[:, 0]),
    "dihedral 130": (cf.dihedral, (0.4, 130.0), (0.4, 0, 0), lambda p: p[:, 2] < math.tan(math.radians(130)) * p[:, 0]),
}


@pytest.mark.parametrize("case", SOLIDS)
def test_volumetric_obscurance(case: str) -> None:
    form, arguments, origin, solid = SOLIDS[case]
    counted = mc.free_volume(origin, UP, solid, radius=1.25, seed=_seed(*arguments))
    assert float(form(*arguments, radius=1.25, weighting="volumetric")) == pytest.approx(counted, abs=TOLERANCE)


def test_textbook_values() -> None:
    assert cf.plane() == 1
    assert cf.wall(0.3) == pytest.approx(0.5, abs=1e-15)
    assert cf.dihedral(0.3, 60.0) == pytest.approx(0.25, abs=1e-15)
    assert cf.dihedral(0.3, 60.0, weighting="uniform") == pytest.approx(1 / 3, abs=1e-15)
    assert cf.ceiling(0.3) == 0
    assert cf.sphere_on_plane(1.0, 1.0) == pytest.approx(1 - 2**-1.5, abs=1e-15)
    assert cf.sphere_on_plane(0.0, 1.0) == pytest.approx(0.0, abs=1e-15)
    assert cf.sphere(2.0, 1.0, 1.0) == pytest.approx(0.75, abs=1e-15)
    assert cf.finite_wall(1.0, 1.0) == pytest.approx(0.5 + 0.5 * math.sqrt(0.5), abs=1e-15)
    assert cf.wall(0.5, radius=1.0, falloff="quadratic", weighting="uniform") == pytest.approx(1 - 0.125, abs=1e-15)
    assert cf.dihedral(0.0, 70.0, radius=1.0, weighting="volumetric") == pytest.approx(70 / 180, abs=1e-13)


@pytest.mark.parametrize(("falloff", "weighting"), [*ASKED, ("binary", "volumetric")])
def test_special_cases_agree_with_general_forms(falloff: str, weighting: str) -> None:
    """Closed falloffs of wall and ceiling against the quadrature, over eight decades of distance."""
    s = np.array([0.0, 1e-8, 1e-4, 1e-2, 0.1, 0.5, 0.9, 0.999, 1.0, 3.0])
    for radius in (1.0, math.inf):
        asked: dict[str, Any] = {"radius": radius, "falloff": falloff, "weighting": weighting}
        np.testing.assert_allclose(cf.half_space(s, 0.0, **asked), cf.wall(s, **asked), rtol=0, atol=1e-13)
        np.testing.assert_allclose(cf.half_space(s, 1.0, **asked), cf.ceiling(s, **asked), rtol=0, atol=1e-13)
        if weighting == "volumetric":
            continue
        np.testing.assert_allclose(cf.finite_wall(s, 1e13, **asked), cf.wall(s, **asked), rtol=0, atol=1e-12)
        split = cf.finite_wall(s, 0.3, **asked) + cf.raised_slat(s, 0.3, 0.4, **asked) - 1
        np.testing.assert_allclose(split, cf.finite_wall(s, 0.7, **asked), rtol=0, atol=1e-11)
        x, r = s[3:], 0.7
        tilted = cf.sphere(np.hypot(x, r), r / np.hypot(x, r), r, **asked)
        # The general form's arc cosine loses half the digits exactly at the horizon, where the resting sphere lies.
        np.testing.assert_allclose(tilted, cf.sphere_on_plane(x, r, **asked), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("falloff", "weighting"), ASKED)
def test_bounds_monotone_and_scale_free(falloff: str, weighting: str) -> None:
    x = np.linspace(0.0, 2.0, 41)
    forms: list[Callable[..., Any]] = [
        lambda k, **q: cf.wall(k * x, **q),
        lambda k, **q: cf.ceiling(k * x, **q),
        lambda k, **q: cf.dihedral(k * x, 40.0, **q),
        lambda k, **q: cf.raised_slat(k * x, k * 0.2, k * 0.5, **q),
        lambda k, **q: cf.sphere_on_plane(k * x, k * 0.6, **q),
    ]
    for form in forms:
        results = [form(1.0, radius=r, falloff=falloff, weighting=weighting) for r in (1e-6, 0.3, 0.9, 2.7, math.inf)]
        for longer, shorter in zip(results[1:], results[:-1], strict=True):
            assert (longer <= shorter + 1e-12).all()
        assert all(((r >= -1e-12) & (r <= 1 + 1e-12)).all() for r in results)
        np.testing.assert_allclose(form(7.0, radius=6.3, falloff=falloff, weighting=weighting), results[2], atol=1e-12)
        assert (results[0][1:] > 1 - 1e-12).all()  # a vanishing radius sees nothing, except where surfaces touch


def test_errors_name_argument_and_remedy() -> None:
    bad: list[tuple[type[ValueError], str, Callable[[], Any]]] = [
        (checks.RangeError, "radius must be greater than 0, got 0", lambda: cf.wall(1.0, radius=0)),
        (checks.RangeError, "radius must be greater than 0, got nan", lambda: cf.plane(radius=math.nan)),
        (checks.ChoiceError, "falloff must be one of", lambda: cf.wall(1.0, falloff="cubic")),
        (checks.ChoiceError, "weighting must be one of", lambda: cf.wall(1.0, weighting="solid")),
        (
            checks.ChoiceError,
            "falloff must be 'binary'",
            lambda: cf.wall(1.0, falloff="linear", weighting="volumetric"),
        ),
        (checks.ChoiceError, "weighting must be one of", lambda: cf.raised_slat(1.0, 0.1, 1.0, weighting="volumetric")),
        (checks.RangeError, "distance must be 0 or more", lambda: cf.wall([-1.0, 1.0])),
        (checks.RangeError, "distance must be 0 or more", lambda: cf.wall(math.nan)),
        (checks.RangeError, "angle_deg must lie in", lambda: cf.dihedral(1.0, 0.0)),
        (checks.RangeError, "height must be finite and greater than 0", lambda: cf.finite_wall(1.0, 0.0)),
        (checks.RangeError, "sphere_radius must be finite and greater than 0", lambda: cf.sphere_on_plane(1.0, 0.0)),
        (checks.RangeError, "distance must be greater than sphere_radius", lambda: cf.sphere(1.0, 1.0, 1.0)),
        (checks.RangeError, "cos_tilt must lie in", lambda: cf.half_space(1.0, 1.5)),
        (checks.RangeError, "cos_half_angle must be 0 or more", lambda: cf.spherical_cap(-0.5, 0.0)),
    ]
    for error, message, call in bad:
        with pytest.raises(error, match=message):
            call()
