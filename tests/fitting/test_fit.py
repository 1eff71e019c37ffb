"""fit: planted parameters come back, a grid finds nothing better, errors name the argument."""

from __future__ import annotations

import math

import pytest
import torch

import torch_ssao as ts
from support.gbuffers import random_gbuffer, steps_gbuffer
from torch_ssao import checks
from torch_ssao.fitting import fit

TRUE = {"radius": 0.3, "height": 0.6, "falloff": 0.5, "contrast": 1.3}
OFF = [
    *({name: factor} for name in TRUE for factor in (4.0, 0.25)),
    dict.fromkeys(TRUE, 4.0),
    dict.fromkeys(TRUE, 0.25),
]


def module(layers: int = 1, **factors: float) -> ts.StatVO:
    net = ts.StatVO(layers=layers)
    for name, value in TRUE.items():
        setattr(net, name, value * factors.get(name, 1.0))
    return net


def recovers(layers: int, factors: dict[str, float], gbuffer: ts.GBuffer) -> None:
    result = fit(module(layers, **factors), gbuffer, module(layers)(gbuffer))
    for name, value in TRUE.items():
        if name not in result.undetermined:
            assert result.values[name] == pytest.approx(value, rel=1e-3), str(result)
    assert result.rmse < 1e-4


@pytest.mark.parametrize("factors", OFF, ids=str)
def test_planted_parameters_come_back_from_starts_four_times_off(factors: dict[str, float]) -> None:
    recovers(1, factors, steps_gbuffer(height=36, width=48))


@pytest.mark.slow
@pytest.mark.parametrize("layers", [2, 4])
@pytest.mark.parametrize("factors", OFF, ids=str)
def test_planted_parameters_come_back_with_layers(factors: dict[str, float], layers: int) -> None:
    scene = ts.scenes.builtin("temple")
    recovers(layers, factors, ts.scenes.render(scene, views=0, height=60, width=80))


def test_parameters_the_data_cannot_determine_are_named() -> None:
    gb = steps_gbuffer(height=24, width=32)
    low = module(1)
    low.height = 60.0  # no mean ever leaves so high a box: the slope above it plays no part
    result = fit(low, gb, low(gb), parameters=("contrast", "falloff"), scan=False)
    assert result.undetermined == ("falloff",)
    assert result.standard_errors["falloff"] == math.inf
    assert result.standard_errors["contrast"] < 1


def test_two_parameters_within_a_hundred_evaluations_match_a_fine_grid() -> None:
    gb = steps_gbuffer(height=24, width=32)
    target = (1 - 0.8 * (1 - module(8, radius=1.3, contrast=0.7)(gb))).clamp(0, 1)  # no parameters reach it
    result = fit(ts.StatVO(0.5, layers=2), gb, target, parameters=("radius", "contrast"))
    assert result.evaluations <= 100
    best = math.inf
    centre = torch.tensor([result.values["radius"], result.values["contrast"]]).log()
    for spread in (1.0, 0.2, 0.05):
        for i in range(11):
            for j in range(11):
                net = ts.StatVO(layers=2)
                net.radius, net.contrast = (centre + spread * torch.tensor([i / 5 - 1, j / 5 - 1])).exp().tolist()
                best = min(best, float(ts.metrics.rmse(net(gb), target)))
    assert result.rmse <= best + 1e-4


def test_never_worse_than_the_start_and_the_input_is_untouched() -> None:
    gb = random_gbuffer(1, height=16, width=20, dtype=torch.float32)
    net = module(1)
    before = net.state_dict()["raw_radius"].clone()
    noise = torch.rand(1, 1, 16, 20, generator=torch.Generator().manual_seed(0))
    for budget in (10, 12, 40):
        result = fit(net, gb, noise, max_evaluations=budget)
        assert result.rmse <= result.initial_rmse
        assert result.evaluations <= budget
        again = ts.metrics.rmse(result.module(gb), noise, gb.valid)
        assert float(again) == pytest.approx(result.rmse, rel=1e-4)
    assert torch.equal(net.raw_radius, before)


def test_perfect_start_stays() -> None:
    gb = steps_gbuffer(height=24, width=32)
    result = fit(module(1), gb, module(1)(gb), max_evaluations=30)
    assert result.values == module(1).values()
    assert "equals the target" in result.message


def test_weights_and_masks_choose_the_pixels() -> None:
    gb = steps_gbuffer(height=24, width=32)
    target = module(1)(gb)
    half = torch.zeros_like(target)
    half[..., 16:] = 1.0
    spoiled = torch.where(half > 0, target, torch.nan)
    for arguments in ({"weights": half}, {"valid": half > 0}):
        result = fit(module(1, contrast=2.0), gb, spoiled, parameters=("contrast",), **arguments)
        assert result.values["contrast"] == pytest.approx(1.3, rel=1e-3)


def test_several_views_are_fitted_together() -> None:
    gb = ts.GBuffer.cat(
        [
            steps_gbuffer(height=24, width=32),
            ts.GBuffer.from_depth(
                steps_gbuffer(height=24, width=32).depth[:, 0].flip(-1), ts.Camera.perspective(50.0, 24, 32)
            ),
        ]
    )
    result = fit(module(1, radius=2.0), gb, module(1)(gb), parameters="radius")
    assert result.values["radius"] == pytest.approx(0.3, rel=1e-3)


def test_standard_errors_are_those_of_noisy_replicas() -> None:
    gb = steps_gbuffer(height=24, width=32)
    clean = module(1)(gb)
    sigma = 0.01

    class Noisy:
        standard_error = torch.full_like(clean, sigma)

        def __init__(self, seed: int) -> None:
            noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))
            self.visibility = clean + sigma * noise

    results = [fit(module(1), gb, Noisy(seed), parameters=("radius", "contrast"), scan=False) for seed in range(24)]
    for name in ("radius", "contrast"):
        found = torch.tensor([result.values[name] for result in results])
        stated = results[0].standard_errors[name]
        assert 0.6 < float(found.std()) / stated < 1.5
        without = fit(module(1), gb, Noisy(0).visibility, parameters=("radius", "contrast"), scan=False)
        assert without.standard_errors[name] == pytest.approx(stated, rel=0.3)


def test_learnable_parameters_are_the_default() -> None:
    gb = steps_gbuffer(height=24, width=32)
    target = module(1)(gb)
    net = ts.StatVO(0.4, learnable=("contrast",))
    assert list(fit(net, gb, target, max_evaluations=12).standard_errors) == ["contrast"]
    assert list(fit(ts.StatVO(0.4), gb, target, max_evaluations=12).standard_errors) == list(TRUE)


GB = steps_gbuffer(height=12, width=16)
GOOD = torch.ones(1, 1, 12, 16)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"module": torch.nn.Identity()}, checks.ChoiceError, "module must be a technique"),
        ({"target": torch.ones(1, 1, 12, 15)}, checks.ShapeError, "target must have shape"),
        ({"target": GOOD.int()}, checks.DtypeError, "target must be floating point"),
        ({"target": GOOD * torch.nan}, checks.RangeError, "target must be finite where it counts, got 192"),
        ({"valid": GOOD == 0}, checks.RangeError, "leave no pixel to fit"),
        ({"valid": GOOD[..., 1:] > 0}, checks.ShapeError, "valid must have shape"),
        ({"weights": -GOOD}, checks.RangeError, "weights must be finite and at least 0"),
        ({"weights": 0 * GOOD}, checks.RangeError, "leave no pixel to fit"),
        ({"weights": GOOD[0]}, checks.ShapeError, "weights must have shape"),
        ({"parameters": ("thickness",)}, checks.ChoiceError, "parameters must be one of"),
        ({"parameters": ()}, checks.ChoiceError, "parameters must name at least one"),
        ({"max_evaluations": 3}, checks.RangeError, "max_evaluations must be a whole number at least 10"),
        ({"module": ts.StatVO(height=1e4)}, checks.RangeError, "module.height must start between"),
    ],
)
def test_bad_input(arguments: dict, error: type[Exception], message: str) -> None:
    call = {"module": ts.StatVO(0.4), "gbuffer": GB, "target": GOOD} | arguments
    with pytest.raises(error, match=message) as caught:
        fit(call.pop("module"), call.pop("gbuffer"), call.pop("target"), **call)
    assert "\n" not in str(caught.value)


def test_missing_optimistix_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install torch_ssao\[fitting\]"):
        fit(ts.StatVO(0.4), GB, GOOD)


def test_an_exception_inside_the_solver_comes_out_as_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = 0
    original = ts.StatVO.forward

    def failing(self: ts.StatVO, gbuffer: ts.GBuffer, **options: object) -> torch.Tensor:
        nonlocal calls
        calls += 1
        if calls > 2:
            raise MemoryError("planted")
        return original(self, gbuffer, **options)

    monkeypatch.setattr(ts.StatVO, "forward", failing)
    with pytest.raises(MemoryError, match="planted"):
        fit(ts.StatVO(0.4), GB, 0.5 * GOOD, scan=False)


def test_jax_is_left_as_it_was() -> None:
    import jax

    before = jax.config.jax_enable_x64
    fit(ts.StatVO(0.4), GB, 0.9 * GOOD, max_evaluations=12)
    assert jax.config.jax_enable_x64 == before
