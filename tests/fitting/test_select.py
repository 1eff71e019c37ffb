"""select: the smallest model that is good enough, held-out views first, and nothing that fails takes the rest along."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch

import torch_ssao as ts
from support.choices import bumps, dense_rays, price_list, quick_fit
from torch_ssao import checks, metrics
from torch_ssao.fitting import candidates, chain, pareto, select
from torch_ssao.fitting.problem import Problem, ViewError, rmse
from torch_ssao.fitting.table import Row
from torch_ssao.fitting.timing import Timing, time_forward


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chain, "fit", quick_fit)


@pytest.fixture(scope="module")
def smooth() -> tuple[ts.GBuffer, torch.Tensor]:
    gbuffer = bumps()
    return gbuffer, dense_rays(gbuffer)


FAST = {"max_evaluations": 60}


def test_a_scene_without_depth_discontinuities_gets_one_layer(smooth: Any) -> None:
    choice = select(candidates.statvo(0.5, layers=[1, 2, 4]), *smooth, timer=price_list, fit_options=FAST)
    assert choice.best.module.layers == 1
    assert choice.reached
    assert not choice.judged_on_training_views


def test_the_temple_gets_more_than_one_layer() -> None:
    scene = ts.scenes.builtin("temple")
    size = {"height": 48, "width": 64}
    gbuffer = ts.scenes.render(scene, **size)
    truth = ts.reference.raytrace(scene, **size, samples=64, progress=False)
    choice = select(candidates.statvo(scene.radius, layers=[1, 4]), gbuffer, truth, timer=price_list, fit_options=FAST)
    assert choice.best.module.layers > 1
    rows = {row.name: row for row in choice.table}
    assert rows["statvo_layers1"].validation_rmse > 1.1 * choice.best.validation_rmse
    assert "statvo_layers" in choice.reason.split("next cheaper", 1)[1]


def test_errors_are_those_of_the_held_out_and_of_the_fitted_views(smooth: Any, quick: None) -> None:
    gbuffer, truth = smooth
    choice = select([ts.StatVO(0.5)], gbuffer, truth, validation=[1], timer=price_list)
    row = choice.best
    for error, views in ((row.validation_rmse, [1]), (row.training_rmse, [0, 2, 3])):
        expected = metrics.rmse(row.module(gbuffer[views]), truth[views], gbuffer.valid_mask[views, :1])
        assert error == pytest.approx(float(expected), rel=1e-5)
    assert [view.view for view in row.views] == ["view 1"]


def test_warm_starts_come_from_the_nearest_cheaper_candidate_and_never_harm(smooth: Any) -> None:
    gbuffer, truth = smooth
    grid = [ts.StatVO(0.5, layers=n) for n in (1, 2, 8)] + [ts.HBAO(0.5, slices=1, steps=2)]
    choice = select(grid, gbuffer, truth, timer=price_list, fit_options={"max_evaluations": 24})
    rows = {row.name: row for row in choice.table}
    starts = {name: row.warm_start for name, row in rows.items()}
    assert starts == {
        "statvo_layers1": None,
        "statvo_layers2": "statvo_layers1",
        "statvo_layers8": "statvo_layers2",
        "hbao_slices1_steps2": None,
    }
    for name, near in starts.items():
        if near is not None:
            begun = chain.warm_started(ts.StatVO(0.5, layers=rows[name].module.layers), rows[near].module)
            before = float(metrics.rmse(begun(gbuffer[:2]), truth[:2], gbuffer.valid_mask[:2, :1]))
            assert rows[name].training_rmse <= before * (1 + 1e-6)
    cold = select(grid[:2], gbuffer, truth, timer=price_list, fit_options={"max_evaluations": 24}, warm_start=False)
    assert {row.warm_start for row in cold.table} == {None}


def test_a_start_on_a_bound_is_moved_inside() -> None:
    fitted = ts.StatVO(0.5, layers=1)
    fitted.height = fitted.PARAMETERS["height"].high
    warm = chain.warm_started(ts.StatVO(0.3, layers=2), fitted)
    assert float(warm.height) < fitted.PARAMETERS["height"].high
    assert float(warm.radius) == pytest.approx(0.5)
    assert warm.layers == 2


def test_several_scenes_of_different_sizes(smooth: Any, quick: None) -> None:
    gbuffer, truth = smooth
    other = bumps(24, 32, views=2)
    choice = select([ts.StatVO(0.5)], [gbuffer, other], [truth, dense_rays(other)], validation=[3, 5], timer=price_list)
    assert [view.view for view in choice.best.views] == ["view 3", "view 5"]
    assert [view.weight for view in choice.best.views] == [36 * 48, 24 * 32]
    assert choice.best.validation_rmse == pytest.approx(rmse(choice.best.views))


def test_several_scenes_reach_the_real_fit(smooth: Any) -> None:
    gbuffer, truth = smooth
    other = bumps(24, 32, views=2)
    select(
        [ts.StatVO(0.5, layers=1)],
        [gbuffer[:1], other],
        [truth[:1], dense_rays(other)],
        validation=[2],
        parameters="contrast",
        fit_options={"max_evaluations": 8},
        timer=price_list,
    )


def test_validation_of_its_own(smooth: Any, quick: None) -> None:
    gbuffer, truth = smooth
    choice = select([ts.StatVO(0.5)], gbuffer[:3], truth[:3], validation=(gbuffer[3:], truth[3:]), timer=price_list)
    assert [view.view for view in choice.best.views] == ["validation view 0"]
    problem = Problem.of(gbuffer[:3], truth[:3], validation=(gbuffer[3:], truth[3:]))
    assert len(problem.training) == 3
    with pytest.raises(checks.ShapeError, match="in validation, target must have shape"):
        select([ts.StatVO(0.5)], gbuffer[:3], truth[:3], validation=(gbuffer[3:], truth[2:]), timer=price_list)


def test_the_last_half_is_held_out(smooth: Any) -> None:
    gbuffer, truth = smooth
    for count, training in ((2, [0]), (3, [0, 1]), (4, [0, 1])):
        problem = Problem.of(gbuffer[:count], truth[:count])
        assert [sight.number for sight in problem.training] == training
        assert [sight.number for sight in problem.validation] == list(range(len(training), count))
    for held in ([1], (1,), 1, range(1, 2), torch.tensor([1]), np.array([1])):
        assert [sight.number for sight in Problem.of(gbuffer, truth, validation=held).validation] == [1]


def test_one_view_is_judged_on_itself_and_all_output_says_so(smooth: Any, quick: None) -> None:
    gbuffer, truth = smooth
    choice = select([ts.StatVO(0.5, layers=n) for n in (1, 2)], gbuffer[:1], truth[:1], timer=price_list)
    assert choice.judged_on_training_views
    assert choice.best.validation_rmse == choice.best.training_rmse
    assert "training-view RMSE" in str(choice)
    assert "validation" not in str(choice)
    assert "on its training view" in choice.reason
    assert choice.as_dict()["judged_on_training_views"] is True


def test_weights_and_masks_choose_the_pixels(smooth: Any, quick: None) -> None:
    gbuffer, truth = smooth
    half = torch.zeros_like(truth)
    half[..., 24:] = 1.0
    spoiled = torch.where(half > 0, truth, torch.nan)
    for given in ({"weights": half}, {"valid": half > 0}):
        row = select([ts.StatVO(0.5)], gbuffer, spoiled, timer=price_list, **given).best
        expected = metrics.rmse(row.module(gbuffer[2:]), truth[2:], half[2:] > 0)
        assert row.validation_rmse == pytest.approx(float(expected), rel=1e-5)


def test_parameters_go_to_the_techniques_that_use_them(smooth: Any, quick: None) -> None:
    grid = [ts.StatVO(0.5), ts.HBAO(0.5), ts.RayMarchedSSAO(0.5)]
    table = select(grid, *smooth, parameters=("contrast", "height"), timer=price_list).table
    fitted = {row.technique: tuple(row.standard_errors) for row in table}
    assert fitted == {"statvo": ("height", "contrast"), "hbao": ("contrast",), "ray_march": ("contrast",)}
    table = select(grid, *smooth, parameters="height", timer=price_list).table
    errors = {row.technique: row.error for row in table if row.error}
    assert set(errors) == {"hbao", "ray_march"}
    assert "parameters must name one of" in errors["hbao"]


def test_priors_go_to_the_techniques_that_use_them(smooth: Any, quick: None) -> None:
    grid = [ts.StatVO(0.5), ts.HBAO(0.5)]
    options = {"priors": {"height": ts.fitting.Prior(1.0)}}
    assert not [row for row in select(grid, *smooth, fit_options=options, timer=price_list).table if row.error]


# --- rules, on made-up rows ---


def row(name: str, ms: float, *errors: float, layers: int = 1, spread: float = 0.01) -> Row:
    views = tuple(ViewError(f"view {i}", error**2, 1.0) for i, error in enumerate(errors))
    timing = Timing(ms, ms * (1 - spread), ms * (1 + spread), 5)
    return Row(name, ts.StatVO(layers=layers), rmse(views), 0.1, views, {}, {}, (), 1, 0.0, "", None, timing)


def decide(rows: list[Row], target: float | None = None, budget: float | None = None) -> pareto.Decision:
    return pareto.decide(rows, target_rmse=target, budget_ms=budget, judged="validation RMSE")


ROWS = [row("a", 1, 0.30), row("b", 2, 0.20), row("c", 3, 0.25), row("d", 4, 0.10), row("e", 8, 0.09)]


def test_the_front_has_no_row_that_another_beats_in_both() -> None:
    assert [item.name for item in pareto.pareto_front(ROWS)] == ["a", "b", "d", "e"]
    assert [item.name for item in pareto.pareto_front([row("x", 1, 0.2), row("y", 1, 0.1)])] == ["y"]


@pytest.mark.parametrize(
    ("target", "budget", "name", "reached"),
    [
        (0.26, None, "b", True),
        (0.10, None, "d", True),
        (None, 4.0, "d", True),
        (None, 3.5, "b", True),
        (0.26, 2.0, "b", True),
        (0.15, 3.0, "b", False),
        (0.05, None, "e", False),
        (None, 0.5, "a", False),
        (0.35, 0.5, "a", False),
        (None, None, "e", True),
    ],
)
def test_target_and_budget(target: float | None, budget: float | None, name: str, reached: bool) -> None:
    found = decide(ROWS, target, budget)
    assert (found.best.name, found.reached) == (name, reached)
    assert name in found.reason
    first = found.reason.split(". ")[0]
    assert first.startswith("No candidate") == (not reached)


def test_reasons_name_the_next_cheaper_one_with_its_figures() -> None:
    assert "The next cheaper one on the front, b (validation RMSE 0.20000" in decide(ROWS, target=0.15).reason
    assert "misses the target by 0.05000" in decide(ROWS, target=0.15).reason
    assert "d (validation RMSE 0.10000, training RMSE 0.10000, 4.00 ms), reaches it" in decide(ROWS, 0.15, 3.0).reason
    assert decide(ROWS, target=0.5).reason.endswith("None is cheaper.")
    assert "is worse by 0.10000." in decide(ROWS, budget=5.0).reason


def test_one_standard_error_of_paired_differences_decides_between_near_equals() -> None:
    # views differ by a factor of 4, candidates hardly: unpaired errors would let anything pass
    best = row("best", 8, 0.10, 0.20, 0.40)
    noisy = row("noisy", 2, 0.10, 0.12, 0.455)  # worse in one view, better in another
    gaps = torch.tensor([a.mse - b.mse for a, b in zip(noisy.views, best.views, strict=True)], dtype=torch.float64)
    both = noisy.validation_rmse + best.validation_rmse
    assert pareto.standard_error(noisy, best) == pytest.approx(float(gaps.std() / math.sqrt(3)) / both)
    assert decide([best, noisy]).best is noisy
    assert "one standard error over 3 views" in decide([best, noisy]).reason
    even = row("even", 4, *(math.sqrt(view.mse + 0.01) for view in best.views))  # the same loss in every view: sure
    assert pareto.standard_error(even, best) == pytest.approx(0, abs=1e-9)
    assert decide([best, even]).best is best


def test_two_percent_is_always_equal() -> None:
    best = row("best", 8, 0.1)
    assert decide([best, row("near", 2, 0.1019)]).best.name == "near"
    assert decide([best, row("far", 2, 0.1021)]).best is best
    assert "2% of the least" in decide([best, row("far", 2, 0.1021)]).reason


def test_of_candidates_that_timing_cannot_tell_apart_the_smaller_is_taken() -> None:
    eight, one = row("eight", 1.00, 0.1, layers=8, spread=0.1), row("one", 1.05, 0.1, layers=1, spread=0.1)
    assert decide([eight, one], target=0.2).best is one
    assert "as fast as far as timing can tell" in decide([eight, row("one", 1.05, 0.11, spread=0.1)], 0.2).reason
    slower = row("one", 1.5, 0.1, layers=1, spread=0.1)
    assert decide([eight, slower], target=0.2).best is eight


# --- failures ---


class Broken(ts.StatVO):
    """A technique whose forward pass fails, from the given call on."""

    calls_left = 0

    def _visibility(self, *arguments: Any, **options: Any) -> torch.Tensor:
        if self.calls_left <= 0:
            raise RuntimeError("planted failure\nwith a second line")
        self.calls_left -= 1
        return super()._visibility(*arguments, **options)


def test_a_candidate_that_crashes_is_a_row_and_the_rest_go_on(smooth: Any, quick: None) -> None:
    late = Broken(0.5, layers=2)
    late.calls_left = 4 + 4  # the quick fit and the errors of four views
    grid = {"good": ts.StatVO(0.5), "broken": Broken(0.5), "late": late}
    choice = select(grid, *smooth, timer=time_forward)
    assert choice.best.name == "good"
    errors = {item.name: item.error for item in choice.table}
    assert errors["broken"] == "RuntimeError: planted failure"
    assert errors["good"] is None
    assert choice.table[-1].error is not None
    assert "broken" in str(choice)
    assert "failed: RuntimeError: planted failure" in str(choice)
    json.dumps(choice.as_dict(), allow_nan=False)


def test_a_candidate_that_fails_only_when_timed_is_a_row(smooth: Any, quick: None) -> None:
    def timer(modules: Any, view: ts.GBuffer) -> list[Timing]:
        if any(module.layers == 2 for module in modules):
            raise RuntimeError("no memory")
        return price_list(modules, view)

    choice = select([ts.StatVO(0.5, layers=n) for n in (1, 2)], *smooth, timer=timer)
    assert [item.error for item in choice.table] == [None, "RuntimeError: no memory"]


def test_predictions_that_are_not_finite_are_a_row(smooth: Any, quick: None) -> None:
    class Nan(ts.StatVO):
        def forward(self, *arguments: Any, **options: Any) -> torch.Tensor:
            return super().forward(*arguments, **options) * torch.nan

    choice = select({"nan": Nan(0.5), "good": ts.StatVO(0.5)}, *smooth, timer=price_list)
    assert "finite visibility" in str(choice.table[-1].error)


def test_when_all_fail_the_first_reason_is_told(smooth: Any, quick: None) -> None:
    with pytest.raises(
        checks.RangeError, match=r"got 1 that fail, broken with RuntimeError: planted failure"
    ) as caught:
        select({"broken": Broken(0.5)}, *smooth, timer=price_list)
    assert "\n" not in str(caught.value)


def test_a_missing_extra_is_no_row(smooth: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(checks.MissingExtraError, match=r"torch_ssao\[fitting\]"):
        select([ts.StatVO(0.5)], *smooth, timer=price_list)


def test_views_without_valid_pixels_are_left_out_with_a_note(smooth: Any, quick: None) -> None:
    gbuffer, truth = smooth
    valid = torch.ones_like(truth, dtype=torch.bool)
    valid[2] = False
    choice = select([ts.StatVO(0.5)], gbuffer, truth, valid=valid, timer=price_list)
    assert [view.view for view in choice.best.views] == ["view 3"]
    assert choice.notes == ("view 2 has no valid pixel and was left out.",)
    assert choice.notes[0] in str(choice)


def test_timed_modules_take_turns() -> None:
    order: list[int] = []

    class Watched(ts.StatVO):
        def forward(self, *arguments: Any, **options: Any) -> torch.Tensor:
            order.append(self.layers)
            assert not torch.is_grad_enabled()
            return super().forward(*arguments, **options)

    found = time_forward([Watched(0.5, layers=1), Watched(0.5, layers=2, learnable="all")], bumps(12, 16, views=1))
    assert order == [1, 2] * 8
    assert [timing.repeats for timing in found] == [7, 7]


def test_no_bar_without_a_terminal(smooth: Any, quick: None, capsys: pytest.CaptureFixture[str]) -> None:
    select([ts.StatVO(0.5)], *smooth, timer=price_list)
    assert capsys.readouterr() == ("", "")
    select([ts.StatVO(0.5)], *smooth, timer=price_list, progress=True)
    assert "fitting" in capsys.readouterr().err


GB = bumps(12, 16, views=2)
GOOD = torch.full((2, 1, 12, 16), 0.9)


def spoiled(view: int) -> torch.Tensor:
    image = GOOD.clone()
    image[view, 0, :2, :2] = torch.nan
    return image


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"target": spoiled(1)}, checks.RangeError, "target must be finite where it counts, got 4 pixels of view 1"),
        ({"target": GOOD[:1]}, checks.ShapeError, "target must have shape"),
        ({"target": GOOD.int()}, checks.DtypeError, "target must be floating point"),
        ({"target": [GOOD]}, checks.DtypeError, "target must be a torch.Tensor"),
        ({"gbuffer": [GB, GB]}, checks.ShapeError, "target must be a sequence of 2, one per G-buffer"),
        ({"gbuffer": []}, checks.ShapeError, "gbuffer must be a GBuffer or a sequence"),
        ({"gbuffer": [GOOD], "target": [GOOD]}, checks.ChoiceError, r"gbuffer\[0\] must be a GBuffer"),
        ({"valid": GOOD < 0}, checks.RangeError, "got none in view 0, view 1"),
        ({"weights": -GOOD}, checks.RangeError, "weights must be finite and at least 0"),
        ({"weights": GOOD[..., 1:]}, checks.ShapeError, "weights must have shape"),
        ({"target_rmse": 0.0}, checks.RangeError, "target_rmse must be finite and greater than 0"),
        ({"budget_ms": -1.0}, checks.RangeError, "budget_ms must be finite and greater than 0"),
        ({"validation": [0, 1]}, checks.RangeError, "validation must leave views to fit"),
        ({"validation": []}, checks.RangeError, "validation must leave views to judge on"),
        ({"validation": [2]}, checks.RangeError, "validation must be a whole number between 0 and 1"),
        ({"validation": "last"}, checks.RangeError, "validation must be a whole number"),
        ({"parameters": ("thickness",)}, checks.ChoiceError, "parameters must be one of"),
        ({"fit_options": {"scan": False}}, checks.ChoiceError, "fit_options must be one of"),
        ({"fit_options": {"priors": {"thickness": 1}}}, checks.ChoiceError, "priors must be one of"),
        ({"candidates": []}, checks.RangeError, "candidates must hold at least one"),
    ],
)
def test_bad_input(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    call = {"candidates": [ts.StatVO(0.4)], "gbuffer": GB, "target": GOOD} | arguments
    with pytest.raises(error, match=message) as caught:
        select(call.pop("candidates"), call.pop("gbuffer"), call.pop("target"), **call)
    assert "\n" not in str(caught.value)
