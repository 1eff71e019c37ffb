"""fit over scenes and views together: shared and per-scene parameters, priors, batches, robust and image losses, solvers."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

import torch_ssao as ts
from support.clutter import clutter
from support.gbuffers import steps_gbuffer
from torch_ssao import checks
from torch_ssao.fitting import Prior, bridge, fit
from torch_ssao.fitting.descent import OPTIMISERS
from torch_ssao.fitting.losses import SQUARES, robust_residual

SCENES = [steps_gbuffer(height=24, width=32), clutter(24, 32, views=2).to(torch.float64)]
TRUE = {"contrast": 1.6, "falloff": 0.7}


def module(radius: float = 0.4, **values: float) -> ts.StatVO:
    return ts.StatVO(radius, layers=1, **values).double()


def targets(radii: tuple[float, float] = (0.4, 0.4)) -> list[torch.Tensor]:
    return [module(radius, **TRUE)(scene) for radius, scene in zip(radii, SCENES, strict=True)]


@pytest.mark.parametrize("solver", bridge.SOLVERS)
def test_shared_parameters_of_scenes_of_two_sizes(solver: str) -> None:
    scenes = [steps_gbuffer(height=20, width=40), SCENES[1]]
    wanted = [module(0.4, **TRUE)(scene) for scene in scenes]
    result = fit(module(0.3), scenes, wanted, parameters=("radius", "falloff", "contrast"), solver=solver)
    for name, value in {"radius": 0.4, **TRUE}.items():
        assert result.values[name] == pytest.approx(value, rel=2e-3), str(result)
    assert result.rmse < 1e-4
    assert [type(found) for found in result.modules] == [ts.StatVO, ts.StatVO]


def test_per_scene_radius_and_shared_contrast() -> None:
    result = fit(
        module(0.4), SCENES, targets((0.3, 0.6)), parameters=("radius", "contrast", "falloff"), per_scene="radius"
    )
    assert result.names == ("radius[0]", "radius[1]", "falloff", "contrast")
    assert result.values["radius[0]"] == pytest.approx(0.3, rel=2e-3)
    assert result.values["radius[1]"] == pytest.approx(0.6, rel=2e-3)
    assert result.values["contrast"] == pytest.approx(TRUE["contrast"], rel=2e-3)
    assert result.values["radius"] == result.values["radius[0]"]
    for found, scene, wanted in zip(result.modules, SCENES, targets((0.3, 0.6)), strict=True):
        assert float(ts.metrics.rmse(found(scene), wanted)) < 1e-3


def test_scenes_of_other_scales_share_a_factor_on_their_radii() -> None:
    starts = [module(0.3), module(3.0)]
    big = ts.GBuffer(10 * SCENES[1].depth, SCENES[1].camera, normal=SCENES[1].normal, valid=SCENES[1].valid)
    wanted = [module(0.4, **TRUE)(SCENES[0]), module(4.0, **TRUE)(big)]
    result = fit(starts, [SCENES[0], big], wanted, parameters=("radius", "falloff", "contrast"))
    assert [float(found.radius) for found in result.modules] == pytest.approx([0.4, 4.0], rel=2e-3)


def test_a_prior_decides_where_the_data_cannot_and_yields_where_they_can() -> None:
    gb = SCENES[0]
    wanted = module(0.4, **TRUE)(gb)
    off = 3 * TRUE["contrast"]
    start = module(falloff=TRUE["falloff"])
    weak = fit(start, gb, wanted, parameters="contrast", priors={"contrast": Prior(off, rmse=1e-4)})
    assert weak.values["contrast"] == pytest.approx(TRUE["contrast"], rel=0.01)
    strong = fit(start, gb, wanted, parameters="contrast", priors={"contrast": Prior(off, rmse=10.0)})
    assert strong.values["contrast"] == pytest.approx(off, rel=0.01)
    assert strong.loss > strong.rmse**2  # the prior is in the loss, not in the RMSE
    low = module(contrast=1.3)
    low.height = 60.0  # flat: no data decide the falloff (see test_fit)
    flat = fit(low, gb, low(gb), parameters=("contrast", "falloff"), scan=False)
    assert flat.undetermined == ("falloff",)
    held = fit(low, gb, low(gb), parameters=("contrast", "falloff"), priors={"falloff": Prior(0.5)}, scan=False)
    assert held.undetermined == ()
    assert held.values["falloff"] == pytest.approx(0.5, rel=1e-3)


def test_soft_l1_forgives_pixels_that_no_parameter_explains() -> None:
    gb = SCENES[0]
    wanted = module(0.4, **TRUE)(gb).clone()
    wanted[..., ::5] = 0.0
    squares, robust = (fit(module(), gb, wanted, parameters="contrast", loss=loss, loss_scale=0.01) for loss in SQUARES)
    error = [abs(result.values["contrast"] - TRUE["contrast"]) for result in (squares, robust)]
    assert error[1] < 0.1 * error[0]
    assert robust.rmse > squares.rmse


def test_root_of_the_soft_l1_loss_and_its_slope() -> None:
    difference = torch.tensor([-3.0, -1e-3, 0.0, 1e-9, 0.2], dtype=torch.float64, requires_grad=True)
    root, slope = robust_residual(difference, "soft_l1", 0.1)
    torch.testing.assert_close(
        root.square(), 2 * 0.01 * ((1 + (difference / 0.1).square()).sqrt() - 1), atol=1e-12, rtol=1e-6
    )
    (by_autograd,) = torch.autograd.grad(root.sum(), difference)
    torch.testing.assert_close(slope, by_autograd)


@pytest.mark.parametrize("solver", OPTIMISERS)
def test_torch_optimisers_lower_an_image_loss(solver: str) -> None:
    gb, wanted = SCENES[0], module(0.4, **TRUE)(SCENES[0])
    result = fit(module(0.4), gb, wanted, parameters=("falloff", "contrast"), loss="ssim", solver=solver)
    assert result.loss < 0.1 * result.initial_loss
    assert result.loss == pytest.approx(1 - float(ts.metrics.ssim(result.module(gb), wanted, gb.valid)), abs=1e-6)
    assert result.standard_errors == {}
    assert result.correlation is None
    assert result.evaluations <= 100


def test_a_loss_of_the_caller_and_squares_in_a_torch_loop() -> None:
    gb, wanted = SCENES[0], module(0.4, **TRUE)(SCENES[0])

    def absolute(prediction: torch.Tensor, target: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        return (prediction - target)[valid].abs().mean()

    for loss in (absolute, "l2", "soft_l1"):
        start = module(0.4, falloff=TRUE["falloff"])
        result = fit(start, gb, wanted, parameters="contrast", loss=loss, solver="adam", max_evaluations=150)
        assert result.values["contrast"] == pytest.approx(TRUE["contrast"], rel=0.02)
        assert result.loss < 0.05 * result.initial_loss
        assert (result.standard_errors == {}) == callable(loss)


@pytest.mark.parametrize("solver", ["levenberg_marquardt", "adam"])
def test_batches_cost_their_share_and_find_the_same(solver: str) -> None:
    gb = ts.GBuffer.cat([clutter(24, 32, views=2).to(torch.float64)] * 3)
    wanted = module(0.4, **TRUE)(gb)
    seen: list[int] = []
    result = fit(
        module(0.4), gb, wanted, parameters=("falloff", "contrast"), solver=solver, batch=2, max_evaluations=60, seed=3
    )
    assert result.evaluations <= 60
    assert result.rmse < 0.05 * result.initial_rmse, (str(result), seen)
    again = fit(
        module(0.4), gb, wanted, parameters=("falloff", "contrast"), solver=solver, batch=2, max_evaluations=60, seed=3
    )
    assert again.values == result.values


def test_correlations() -> None:
    gb = SCENES[0]
    noise = 0.02 * torch.randn(gb.depth.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = module(0.4, **TRUE)(gb) + noise
    correlation = fit(module(0.3), gb, wanted, parameters=("radius", "falloff", "contrast")).correlation
    torch.testing.assert_close(correlation.diagonal(), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(correlation, correlation.T)
    assert bool((correlation.abs() <= 1).all())
    assert float(correlation[0, 2]) < -0.1  # a larger radius and a higher contrast both darken


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"gbuffer": SCENES, "target": [torch.ones(1)]}, checks.ShapeError, "target must be a sequence of 2, one per"),
        ({"gbuffer": SCENES, "target": torch.ones(3, 1, 24, 32)}, checks.ShapeError, "target must be a sequence of 2"),
        ({"module": [module(), module()]}, checks.ShapeError, "module must be one, or 1, one per G-buffer"),
        ({"module": "HBAO"}, checks.ChoiceError, "module must be a technique"),
        ({"solver": "newton"}, checks.ChoiceError, "solver must be one of 'levenberg_marquardt'"),
        ({"loss": "ssim", "solver": "dogleg"}, checks.ChoiceError, "solver must be one of 'adam'"),
        ({"loss": "l1"}, checks.ChoiceError, "loss must be one of 'l2', 'soft_l1', 'ssim'"),
        ({"loss_scale": 0.0}, checks.RangeError, "loss_scale must be finite and greater than 0"),
        ({"loss": "ssim", "weights": torch.ones(1, 1, 24, 32)}, checks.ChoiceError, "weights must be left out"),
        ({"per_scene": "bias"}, checks.ChoiceError, "per_scene must be one of"),
        ({"priors": {"bias": Prior(1.0)}}, checks.ChoiceError, "priors must be one of"),
        ({"priors": {"radius": 1.0}}, checks.ChoiceError, r"priors\['radius'\] must be a Prior"),
        ({"batch": 2}, checks.RangeError, "batch must be a whole number between 1 and 1"),
    ],
)
def test_errors_name_the_argument(changes: dict, error: type[ValueError], message: str) -> None:
    arguments = {"module": module(), "gbuffer": SCENES[0], "target": torch.ones(1, 1, 24, 32)} | changes
    with pytest.raises(error, match=message):
        fit(**arguments)


def test_modules_of_scenes_must_be_alike() -> None:
    for other, message in ((ts.StatVO(layers=2), "alike in all scenes"), (module(contrast=2.0), "same contrast")):
        with pytest.raises(checks.ChoiceError, match=message):
            fit([module(), other.double()], SCENES, targets())


@pytest.mark.parametrize("arguments", [{"value": 0.0}, {"value": 1.0, "spread": 1.0}, {"value": 1.0, "rmse": -1.0}])
def test_priors_are_checked(arguments: dict) -> None:
    with pytest.raises(checks.RangeError):
        Prior(**arguments)


def test_a_bad_view_is_named_and_an_empty_one_is_left_out() -> None:
    gb = clutter(24, 32, views=2).to(torch.float64)
    wanted = module(0.4, **TRUE)(gb).clone()
    spoiled = wanted.clone()
    spoiled[1, 0, 3, 4] = math.inf
    with pytest.raises(checks.RangeError, match="1 pixels of view 1"):
        fit(module(), gb, spoiled)
    with pytest.raises(checks.RangeError, match=r"target\[1\] must be finite"):
        fit(module(), [SCENES[0], gb], [targets()[0], spoiled])
    empty = torch.ones_like(wanted, dtype=torch.bool)
    empty[1] = False
    result = fit(module(), gb, spoiled, valid=empty, parameters="contrast")
    assert result.rmse < 0.1


def test_fits_in_threads_take_turns() -> None:
    gb, wanted = SCENES[0], targets()[0]

    def run(_: int) -> dict[str, float]:
        return fit(module(0.4), gb, wanted, parameters=("falloff", "contrast"), max_evaluations=20).values

    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(run, range(4)))
    assert all(values == run(0) for values in found)
