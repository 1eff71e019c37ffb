"""Residuals: exact norm, forward-mode Jacobian, counting; and the bijection of the parameters."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import torch_ssao as ts
from support.clutter import clutter
from torch_ssao.fitting.parameters import ParameterSpace
from torch_ssao.fitting.residuals import BudgetSpent, Residuals
from torch_ssao.fitting.scan import scan_points
from torch_ssao.fitting.views import gather_views

NAMES = ("radius", "height", "falloff", "contrast")


def _residuals(views: int = 2, budget: int = 100, **options: Any) -> tuple[Residuals, ParameterSpace]:
    gbuffer = clutter(views=views).to(torch.float64)
    module = ts.StatVO(0.5, layers=2).double()
    target = torch.full_like(gbuffer.depth[:, :1], 0.9)
    space = ParameterSpace.of(module, NAMES)
    return Residuals([module], gather_views(gbuffer, target)[0], space, budget, **options), space


def test_norm_is_the_rmse() -> None:
    residuals, space = _residuals()
    gbuffer = clutter(views=2).to(torch.float64)
    prediction = ts.StatVO(0.5, layers=2).double()(gbuffer)
    expected = ts.metrics.rmse(prediction, torch.full_like(prediction, 0.9), gbuffer.valid_mask[:, :1])
    assert residuals.value(space.start).norm().item() == pytest.approx(expected.item(), rel=1e-6)


def test_jacobian_matches_central_differences() -> None:
    residuals, space = _residuals(views=1)
    jacobian = residuals.jacobian(space.start)
    for index in range(1, len(NAMES)):  # moving the radius flips labels, which the derivative holds constant
        step = torch.zeros(4, dtype=torch.float64)
        step[index] = 1e-6
        difference = (residuals.value(space.start + step) - residuals.value(space.start - step)) / 2e-6
        error = (jacobian[:, index] - difference).abs()
        assert (error < 1e-6).double().mean() > 0.99  # kinks of psi
    assert jacobian[:, 0].norm() > 0


def test_every_image_is_counted() -> None:
    residuals, space = _residuals(budget=6)
    residuals.value(space.start)
    residuals.jacobian(space.start)
    assert residuals.evaluations == 5
    assert residuals.left == 1
    with pytest.raises(BudgetSpent):
        residuals.jacobian(space.start)
    assert residuals.evaluations == 5


def test_bijection_goes_both_ways_and_respects_bounds() -> None:
    _, space = _residuals(views=1)
    u = torch.linspace(-3, 3, 13, dtype=torch.float64)[:, None].expand(-1, 4).clone().requires_grad_()
    log = space.to_log(u)
    torch.testing.assert_close(space.from_log(log), u)
    (slope,) = torch.autograd.grad(log.sum(), u)
    torch.testing.assert_close(space.slope(u), slope)
    far = space.to_log(torch.full((4,), 1e6, dtype=torch.float64))
    assert bool((far <= space.high + 1e-12).all())
    assert bool(space.at_bound(far).all())
    assert not bool(space.at_bound(space.start).any())


def test_scan_begins_with_the_start_and_reaches_a_factor_of_four() -> None:
    _, space = _residuals(views=1)
    points = scan_points(space)
    torch.testing.assert_close(points[0], space.start)
    away = points - space.start
    assert bool((away.amax(0) > torch.tensor(4.0).log()).all())
    assert bool((away.amin(0) < torch.tensor(0.25).log()).all())
    assert bool(((points > space.low) & (points < space.high)).all())
