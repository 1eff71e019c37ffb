"""`fit` on every technique, with optional parameters on and off."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import torch_ssao as ts
from support.reports import SIZE, corner
from torch_ssao import checks, fitting, scenes
from torch_ssao.modules import TECHNIQUES

SMALL: dict[str, dict[str, int]] = {
    "statvo": {"layers": 2},
    "hbao": {"slices": 2, "steps": 2},
    "ray_march": {"rays": 3, "steps": 3},
}


@pytest.fixture(scope="module")
def gbuffer() -> ts.GBuffer:
    return scenes.render(corner(), views=0, **SIZE)


@pytest.mark.parametrize(
    ("technique", "options", "fitted"),
    [
        ("statvo", {}, ("radius", "height", "falloff", "contrast")),
        ("hbao", {}, ("radius", "contrast", "thickness")),
        ("hbao", {"thickness": None, "estimator": "increments"}, ("radius", "falloff", "contrast")),
        ("hbao", {"thickness": None, "bias_deg": 5.0}, ("radius", "contrast", "bias_deg")),
        ("ray_march", {"thickness": None}, ("radius", "falloff", "contrast")),
        ("ray_march", {}, ("radius", "falloff", "thickness", "contrast")),
    ],
)
def test_all_used_parameters_are_fitted_and_what_is_off_stays_off(
    gbuffer: ts.GBuffer, technique: str, options: dict[str, Any], fitted: tuple[str, ...]
) -> None:
    kind: Any = TECHNIQUES[technique]
    start = kind(0.5, **SMALL[technique], **options)
    target = kind(0.5, contrast=1.6, **SMALL[technique], **options)(gbuffer).detach()
    result = fitting.fit(start, gbuffer, target, max_evaluations=40, scan=False)
    assert set(result.standard_errors) == set(fitted)
    assert result.rmse < 0.3 * result.initial_rmse
    assert start.contrast == pytest.approx(1.0)  # the module given is not changed
    for name in set(kind.PARAMETERS) - set(fitted):
        assert result.values.get(name) == start.values().get(name)  # None, 0 or without use
    again = fitting.fit(result.module, gbuffer, target, max_evaluations=10, scan=False)
    assert again.rmse <= result.rmse * (1 + 1e-9) + 1e-7  # rounding
    assert torch.isfinite(result.module(gbuffer)).all()


def test_a_parameter_that_is_off_cannot_be_named(gbuffer: ts.GBuffer) -> None:
    target = torch.full((1, 1, *SIZE.values()), 0.5)
    for name in ("thickness", "bias_deg"):
        with pytest.raises(checks.ChoiceError, match="parameters must be one of"):
            fitting.fit(ts.HBAO(0.5, thickness=None), gbuffer, target, parameters=name)
