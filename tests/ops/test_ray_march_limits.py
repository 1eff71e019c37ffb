"""The ray march in the limit of many rays and steps, on scenes of all kinds, and the derivative of its mean to the radius."""

from __future__ import annotations

import pytest
import torch

import torch_ssao as ts
from support.clutter import clutter
from support.limits import ANGLES, EXPONENTS, KINDS, SCENES, LimitCase

FAST = [
    ("dihedral 60", 70.0, "10"),
    ("room corner", 45.0, "50"),
    ("finite wall", 70.0, "orthographic"),
    ("cylinder", 80.0, "50"),
    ("trench", 45.0, "10"),
]


def check(case: LimitCase) -> None:
    """The mean over the pixels of a view and every single pixel; binary hits keep some noise of 1,024 rays."""
    for falloff in EXPONENTS if case.pixels else ():
        error = case.marched(falloff)
        assert len(error) == 0 or error.mean().abs() <= 0.005, (falloff, error)
        assert (error.abs() <= (0.0075 if falloff == "binary" else 0.005)).all(), (falloff, error)


@pytest.mark.parametrize(("name", "angle", "kind"), FAST)
def test_many_rays_reach_the_closed_forms(name: str, angle: float, kind: str) -> None:
    case = LimitCase.of(name, angle, kind, count=3)
    assert case.pixels
    check(case)


def test_many_rays_under_a_ceiling() -> None:
    check(LimitCase.between_plates(count=3))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SCENES)
def test_many_rays_reach_the_closed_forms_in_every_view(name: str, kind: str) -> None:
    for angle in ANGLES:
        check(LimitCase.of(name, angle, kind, size=576 if kind == "120" else 384))


@pytest.mark.parametrize("forward_mode", [False, True])
@pytest.mark.parametrize("gradient", ["soft", "surrogate", "exact"])
def test_radius_gradient_is_that_of_the_differences(gradient: str, forward_mode: bool) -> None:
    """d mean / d radius against central differences of the same module, over a step that is not the one used inside."""
    gb, step, frames = clutter(48, 64).to(torch.float64), 0.07, range(6)
    options = {"rays": 8, "steps": 8, "gradient": gradient}

    def mean(radius: torch.Tensor) -> torch.Tensor:
        net = ts.RayMarchedSSAO(0.6, **options).double()
        raw = {"raw_radius": radius.log()}
        return sum(torch.func.functional_call(net, raw, (gb,), {"frame": frame}).mean() for frame in frames)

    at = torch.tensor(0.6, dtype=torch.float64)
    slope = torch.func.jvp(mean, (at,), (torch.ones_like(at),))[1] if forward_mode else torch.func.grad(mean)(at)
    with torch.no_grad():
        differences = (mean(at * (1 + step)) - mean(at * (1 - step))) / (2 * step * at)
    assert abs(differences) / len(frames) > 0.02
    assert slope / differences == pytest.approx(1.0, abs=0.02)
