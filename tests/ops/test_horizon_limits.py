"""Horizon obscurance in the limit of many taps, with few taps, and that its mean does not depend on their number."""

from __future__ import annotations

import pytest
import torch

import torch_ssao as ts
from support.limits import ANGLES, HORIZON_FORMS, KINDS, SCENES, HorizonPixels, LimitCase, decided
from support.wall_profile import WallProfile
from torch_ssao.scenes import analytic

FAST = [
    ("wall", 20.0, "orthographic"),
    ("wall", 80.0, "10"),
    ("dihedral 60", 70.0, "10"),
    ("room corner", 45.0, "50"),
    ("finite wall", 70.0, "orthographic"),
    ("trench", 45.0, "10"),
    ("bowl", 0.0, "orthographic"),
]


# At single pixels. Near-binary increments lose half of the last of 64 steps where the taps end inside the sphere; the
# weight of the uniform bitmask lies on edges near the tangent plane, which pixels round.
LOOSER = {"increments, binary": 0.0075, "uniform bitmask, connected": 0.01}


def check(case: LimitCase, mean: float = 0.005) -> None:
    """The mean over the pixels of a view and every single pixel."""
    for form in HORIZON_FORMS if case.pixels else ():
        error = case.horizon(form)
        assert error.mean().abs() <= mean, (form, error)
        assert error.abs().max() <= LOOSER.get(form, 0.005), (form, error)


@pytest.mark.parametrize(("name", "angle", "kind"), FAST)
def test_many_taps_reach_the_closed_forms(name: str, angle: float, kind: str) -> None:
    case = LimitCase.of(name, angle, kind, count=3)
    assert len(case.pixels) == 3
    check(case)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SCENES)
def test_many_taps_reach_the_closed_forms_in_every_view(name: str, kind: str) -> None:
    counted = 0
    for angle in ANGLES:
        case = LimitCase.of(name, angle, kind, size=576 if kind == "120" else 384)
        counted += len(case.pixels)
        check(case)
    assert counted >= 2


def test_many_taps_under_a_ceiling() -> None:
    case = LimitCase.between_plates()
    assert len(case.pixels) >= 3
    check(case, mean=0.0075)  # near-binary increments of a shallow cap: 0.0065; the rest within 0.005 as everywhere


def test_hidden_geometry_is_recognised() -> None:
    """What the comparisons leave out, they leave out for a reason: a pixel under an overhang is not decided."""
    scene = analytic.disk_over_plane(1.0, 0.5)
    gb = scene.render(scene.camera(96, 96, view_angle_deg=20.0, span=4.0))
    exact, known = scene.exact(gb, radius=0.8)
    occluded = (known & (exact < 0.9)).flatten().nonzero()[:, 0]
    assert max(decided(scene, gb, int(p), 0.8) for p in occluded[::40]) < 0.999
    wall = LimitCase.of("wall", 45.0, "orthographic", count=1)
    assert decided(wall.scene, wall.gb, wall.pixels[0], wall.radius) == 1.0


@pytest.fixture(scope="module")
def profile() -> WallProfile:
    return WallProfile()


# Radius and falloff as `python -m benchmarks.limits` tunes them, over the three views together.
FEW_TAPS = [
    ({"steps": 3, "radius": 1.30, "connected": False}, 0.025),
    ({"steps": 3, "radius": 1.18}, 0.025),
    ({"steps": 3, "radius": 1.30, "estimator": "increments", "falloff": 30.0}, 0.025),
    ({"steps": 6, "radius": 1.14, "connected": False}, 0.015),
    ({"steps": 6, "radius": 1.06}, 0.015),
    ({"steps": 6, "radius": 1.10, "estimator": "increments", "falloff": 30.0}, 0.015),
]


@pytest.mark.parametrize(("options", "most"), FEW_TAPS, ids=str)
def test_few_taps_on_a_wall(profile: WallProfile, options: dict, most: float) -> None:
    """The mean along the wall, over frames and of one frame; pixel by pixel, that of the best form."""
    mean, single, pixel = profile.rmse(range(2), slices=3, step_power=1.3, **options)
    assert mean <= most
    assert single <= most
    assert options.get("connected", True) or pixel <= most


TAPS = ((4, 4), (4, 8), (8, 8), (8, 16), (16, 32))


def means(name: str, view: int, taps: tuple[tuple[int, int], ...], **options: object) -> torch.Tensor:
    scene = ts.scenes.builtin(name)
    gb = ts.scenes.render(scene, views=view, height=72, width=96)
    nets = [ts.HBAO(scene.radius, slices=s, steps=k, **options) for s, k in taps]  # type: ignore[arg-type]
    return torch.stack([net(gb)[gb.valid].mean() for net in nets])


VIEWS = [(name, view) for name in ts.scenes.names() for view in (0, 3)]
SCENE_CASES = [pytest.param(*case, marks=[] if case == ("stairs", 0) else pytest.mark.slow) for case in VIEWS]
FOUR_STEPS = [pytest.param(*case, marks=pytest.mark.slow) for case in VIEWS]


@pytest.mark.parametrize(("name", "view"), SCENE_CASES)
def test_more_taps_do_not_darken(name: str, view: int) -> None:
    increments = means(name, view, TAPS[1:], estimator="increments")
    assert increments.max() - increments.min() < 0.01
    bitmask = means(name, view, TAPS[2:])
    assert bitmask.max() - bitmask.min() < 0.02


@pytest.mark.parametrize(("name", "view"), FOUR_STEPS)
def test_more_taps_than_four_do_not_darken(name: str, view: int) -> None:
    """The linear falloff; what a nearly binary one misses is in `python -m benchmarks.limits taps`."""
    linear = means(name, view, TAPS, estimator="increments", falloff=1.0)
    assert linear.max() - linear.min() < 0.01


def test_finite_thickness_sees_the_gap_below_a_raised_slat() -> None:
    """Means over pixels before the slat, all of which is in view."""
    scene = analytic.raised_slat(0.3, 0.4)
    gb = scene.render(scene.camera(256, 256, view_angle_deg=50.0, span=3.0))
    exact, known = scene.exact(gb, radius=1.0)
    before = (known & ((exact - 0.8).abs() < 0.08)).flatten().nonzero()[:, 0]
    row, column = before // 256, before % 256
    before = before[((row - 128).abs() < 40) & ((column - 128).abs() < 40)]
    pixels = before[torch.linspace(0, len(before) - 1, 8).long()].tolist()
    off = {}
    for form in ((0.02, True), (0.02, False), (None, True)):
        op = HorizonPixels(gb, radius=1.0, thickness=form[0], connected=form[1])
        off[form] = float((torch.cat([op.visibility(p) for p in pixels]) - exact.flatten()[pixels]).mean())
    assert abs(off[0.02, True]) < 0.01, off
    assert abs(off[0.02, False]) < 0.02, off
    assert off[None, True] < -0.05, off
