from __future__ import annotations

import math

import pytest
import torch

from support.reports import SIZE, corner
from torch_ssao import StatVO, checks, metrics, scenes
from torch_ssao.fitting.timing import summary
from torch_ssao.report import rows
from torch_ssao.report.truth import Truth


def truth_of(visibility: torch.Tensor) -> Truth:
    valid = torch.ones_like(visibility, dtype=torch.bool)
    valid[..., :3] = False
    return Truth(visibility, torch.zeros_like(visibility), valid)


@pytest.fixture
def image() -> torch.Tensor:
    return torch.rand(2, 1, 16, 20, generator=torch.Generator().manual_seed(3))


def test_scores_are_the_metrics_of_all_views_together(image: torch.Tensor) -> None:
    truth, guess = truth_of(image), image.flip(-1)
    found = rows.score(guess, truth)
    assert found.rmse == pytest.approx(float(metrics.rmse(guess, image, truth.valid)))
    assert found.psnr == pytest.approx(-20 * math.log10(found.rmse), rel=1e-4)
    assert found.ssim == pytest.approx(float(metrics.ssim(guess, image, truth.valid)))


def test_the_best_constant_is_the_mean_of_valid_pixels(image: torch.Tensor) -> None:
    truth = truth_of(image)
    mean = rows.best_constant(truth)
    assert mean == pytest.approx(float(image[..., 3:].mean()))
    least = rows.score_constant(mean, truth).rmse
    assert least < min(rows.score_constant(mean + shift, truth).rmse for shift in (-0.02, 0.02))


def test_prediction_view_by_view_equals_the_batch() -> None:
    gbuffer = scenes.render(corner(), **SIZE)
    module = StatVO(0.5, layers=2, learnable="all")
    found = rows.predict(module, gbuffer)
    assert not found.requires_grad
    torch.testing.assert_close(found, module(gbuffer).detach())


def test_timing_is_ordered_and_counts() -> None:
    gbuffer = scenes.render(corner(), views=0, height=16, width=16)
    timings = rows.time_forward([StatVO(0.5, layers=1), StatVO(0.5, layers=2)], gbuffer, repeats=5)
    assert len(timings) == 2
    for timing in timings:
        assert 0 < timing.low_ms <= timing.median_ms <= timing.high_ms
        assert timing.repeats == 5
    with pytest.raises(checks.RangeError, match="repeats must be a whole number at least 5"):
        rows.time_forward([], gbuffer, repeats=4)


def test_quartiles() -> None:
    found = summary([5.0, 1.0, 2.0, 4.0, 3.0])
    assert (found.low_ms, found.median_ms, found.high_ms) == (2.0, 3.0, 4.0)


def test_plain_replaces_what_json_cannot_say() -> None:
    assert rows.plain({"a": [math.inf, 1.0, (math.nan, "x", None, True)]}) == {
        "a": [None, 1.0, [None, "x", None, True]]
    }
