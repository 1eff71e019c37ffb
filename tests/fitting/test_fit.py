"""fit: known parameters come back, weights and masks count, errors name the argument and the remedy."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from support.clutter import clutter

import torch_ssao as ts
from torch_ssao import checks
from torch_ssao.fitting import MissingExtraError, bridge, fit

TRUTH = {"radius": 0.6, "height": 0.8, "falloff": 1.3, "contrast": 1.4}
STARTS = [{name: factor} for name in TRUTH for factor in (4.0, 0.25)] + [dict.fromkeys(TRUTH, f) for f in (4.0, 0.25)]


@pytest.fixture(scope="module")
def gbuffer() -> ts.GBuffer:
    return clutter()


def _target(gbuffer: ts.GBuffer, layers: int = 1, **values: float) -> torch.Tensor:
    return ts.StatVO(**(TRUTH | values), layers=layers)(gbuffer)


def _start(factors: dict[str, float], layers: int = 1) -> ts.StatVO:
    return ts.StatVO(**{name: value * factors.get(name, 1.0) for name, value in TRUTH.items()}, layers=layers)


def _check_recovery(gbuffer: ts.GBuffer, factors: dict[str, float], layers: int) -> None:
    result = fit(_start(factors, layers), gbuffer, _target(gbuffer, layers))
    for name, value in TRUTH.items():
        assert name in result.undetermined or result.values[name] == pytest.approx(value, rel=1e-3), result


@pytest.mark.parametrize("factors", STARTS, ids=str)
def test_known_parameters_come_back_from_starts_four_times_off(gbuffer: ts.GBuffer, factors: dict[str, float]) -> None:
    _check_recovery(gbuffer, factors, layers=1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("factors", STARTS, ids=str)
def test_known_parameters_come_back_with_four_layers(seed: int, factors: dict[str, float]) -> None:
    _check_recovery(clutter(seed=seed), factors, layers=4)


def test_two_parameters_stay_within_a_hundred_evaluations(gbuffer: ts.GBuffer) -> None:
    result = fit(_start({"radius": 4.0}), gbuffer, 0.9 * _target(gbuffer) + 0.05, parameters=("radius", "contrast"))
    assert result.evaluations <= 100
    assert 0 < result.rmse <= result.initial_rmse


def test_input_is_untouched_and_module_holds_the_values(gbuffer: ts.GBuffer) -> None:
    module = ts.StatVO(0.3, layers=1, learnable=("radius",))
    before = module.values()
    result = fit(module, gbuffer, _target(gbuffer))
    assert module.values() == before
    assert set(result.standard_errors) == {"radius"}  # None fits the learnable ones
    assert result.module.radius.item() == pytest.approx(result.values["radius"])
    assert result.module.values()["height"] == before["height"]
    prediction = result.module(gbuffer)
    assert ts.metrics.rmse(prediction, _target(gbuffer), gbuffer.valid_mask[:, :1]).item() == pytest.approx(result.rmse, abs=1e-6)


@pytest.mark.parametrize("scan", [True, False])
def test_never_worse_than_the_start(gbuffer: ts.GBuffer, scan: bool) -> None:
    module = _start({})
    result = fit(module, gbuffer, module(gbuffer), parameters="radius", scan=scan, max_evaluations=6)
    assert result.rmse <= result.initial_rmse
    assert result.evaluations <= 7
    assert result.values["radius"] == pytest.approx(TRUTH["radius"])
    assert result.message.endswith(".")


def test_weights_and_masks_leave_pixels_out(gbuffer: ts.GBuffer) -> None:
    keep = torch.zeros(1, 1, 48, 64, dtype=torch.bool)
    keep[..., :32] = True
    spoiled = torch.where(keep, _target(gbuffer), 0.3)
    nan = torch.where(keep, _target(gbuffer), torch.nan)
    by_weight = fit(_start({"radius": 1.5}), gbuffer, spoiled, parameters=("radius", "contrast"), weights=keep.float())
    by_mask = fit(_start({"radius": 1.5}), gbuffer, nan, parameters=("radius", "contrast"), valid=keep)
    for result in (by_weight, by_mask):
        assert result.values["radius"] == pytest.approx(TRUTH["radius"], rel=1e-3)


def test_several_views_count_as_one_evaluation() -> None:
    both = clutter(views=2)
    result = fit(_start({"radius": 2.0}), both, _target(both), parameters=("radius", "contrast"))
    assert result.evaluations <= 100
    assert result.values["radius"] == pytest.approx(TRUTH["radius"], rel=1e-3)


def test_parameter_without_influence_is_undetermined() -> None:
    plane = ts.GBuffer.from_depth(torch.full((24, 32), 2.0), ts.Camera.perspective(50.0, 24, 32))
    result = fit(ts.StatVO(0.5, layers=1), plane, torch.ones(1, 1, 24, 32))
    assert set(result.undetermined) == set(TRUTH)
    assert all(math.isinf(error) for error in result.standard_errors.values())


def test_standard_errors_match_the_scatter_of_refits(gbuffer: ts.GBuffer) -> None:
    sigma, seeds = 0.02, 10
    clean = _target(gbuffer)
    names = ("height", "contrast")  # smooth: the radius flips no label with one layer either, but costs evaluations
    values, stated = [], []
    for seed in range(seeds):
        noise = sigma * torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))
        target = SimpleNamespace(visibility=clean + noise, standard_error=torch.full_like(clean, sigma))
        result = fit(_start({}), gbuffer, target, parameters=names, scan=False, max_evaluations=25)
        values.append([result.values[name] for name in names])
        stated.append([result.standard_errors[name] for name in names])
    ratio = torch.tensor(values).std(0) / torch.tensor(stated).mean(0)
    # the standard deviation of 10 draws scatters by 24 %
    assert bool(((ratio > 0.4) & (ratio < 1.8)).all()), ratio


def _bad(**changes: Any) -> dict[str, Any]:
    return changes


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        (_bad(module="StatVO"), checks.ChoiceError, "module must be"),
        (_bad(target=torch.ones(1, 1, 4, 4)), checks.ShapeError, "target must have shape"),
        (_bad(target=torch.ones(1, 1, 48, 64, dtype=torch.int64)), checks.DtypeError, "target must be floating point"),
        (_bad(target=torch.full((1, 1, 48, 64), torch.nan)), checks.RangeError, "target must be finite"),
        (_bad(valid=torch.zeros(1, 1, 48, 64, dtype=torch.bool)), checks.RangeError, "choose views"),
        (_bad(valid=torch.ones(1, 1, 4, 4, dtype=torch.bool)), checks.ShapeError, "valid must have shape"),
        (_bad(weights=torch.full((1, 1, 48, 64), -1.0)), checks.RangeError, "weights must be finite and at least 0"),
        (_bad(weights=torch.zeros(1, 1, 48, 64)), checks.RangeError, "weights"),
        (_bad(weights=torch.ones(4)), checks.ShapeError, "weights must have shape"),
        (_bad(parameters=("radius", "thickness")), checks.ChoiceError, "parameters must be one of"),
        (_bad(parameters=()), checks.ChoiceError, "parameters must name at least one"),
        (_bad(max_evaluations=1), checks.RangeError, "max_evaluations must be a whole number"),
        (_bad(module=ts.StatVO(0.5, height=1e5)), checks.RangeError, "module.height must start between"),
    ],
)
def test_errors_are_one_line_that_names_the_argument(
    gbuffer: ts.GBuffer, changes: dict[str, Any], error: type[ValueError], words: str
) -> None:
    arguments = {"module": ts.StatVO(0.5, layers=1), "gbuffer": gbuffer, "target": torch.ones(1, 1, 48, 64)} | changes
    with pytest.raises(error, match=words) as caught:
        fit(**arguments)
    assert "\n" not in str(caught.value)
    assert ": " in str(caught.value)  # what follows is the remedy


def test_missing_extra_is_named(gbuffer: ts.GBuffer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridge.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pip install torch_ssao\[fitting\]"):
        fit(ts.StatVO(0.5, layers=1), gbuffer, torch.ones(1, 1, 48, 64))


def test_progress_bar_only_when_asked(gbuffer: ts.GBuffer, capsys: pytest.CaptureFixture[str]) -> None:
    fit(ts.StatVO(0.5, layers=1), gbuffer, _target(gbuffer), parameters="contrast", max_evaluations=8, progress=None)
    assert capsys.readouterr().err == ""  # no terminal here
    fit(ts.StatVO(0.5, layers=1), gbuffer, _target(gbuffer), parameters="contrast", max_evaluations=8, progress=True)
    assert "fit" in capsys.readouterr().err
