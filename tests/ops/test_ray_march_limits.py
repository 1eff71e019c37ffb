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


@pytest.mark.parametrize(
    ("gradient", "share"),
    # All hold the texels that steps read; "exact" holds the hits too. A share of 1 is what is wanted.
    [("soft", 0.68), ("surrogate", 0.87), ("exact", 0.55)],
)
def test_radius_gradient_is_this_share_of_the_differences(gradient: str, share: float) -> None:
    gb, step, frames = clutter(48, 64).to(torch.float64), 0.05, 6
    options = {"rays": 8, "steps": 8, "gradient": gradient}
    net = ts.RayMarchedSSAO(0.6, learnable=("radius",), **options).double()
    slope = sum(float(torch.autograd.grad(net(gb, frame=f).mean(), net.raw_radius)[0]) for f in range(frames)) / float(
        torch.autograd.grad(net.radius, net.raw_radius)[0]
    )
    ends = [ts.RayMarchedSSAO(0.6 * (1 + sign * step), **options).double() for sign in (1, -1)]
    with torch.no_grad():
        differences = sum(float(ends[0](gb, frame=f).mean() - ends[1](gb, frame=f).mean()) for f in range(frames))
    differences /= 2 * step * 0.6
    assert abs(differences) / frames > 0.02
    assert slope / differences == pytest.approx(share, abs=0.02)
