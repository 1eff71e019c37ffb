"""Horizon obscurance against the pixel-loop oracle, closed forms and differences."""

from __future__ import annotations

import itertools

import pytest
import torch

from support.gbuffers import plane_gbuffer, random_gbuffer, steps_gbuffer
from support.horizon import FORMS, evaluate, expected, smooth_gbuffer
from torch_ssao import checks
from torch_ssao.ops import horizon


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("weighting", ["cosine", "uniform"])
@pytest.mark.parametrize("make", [random_gbuffer, smooth_gbuffer], ids=["rough", "smooth"])
@pytest.mark.parametrize("orthographic", [False, True])
def test_float64_equals_the_oracle(form: dict, weighting: str, make: object, orthographic: bool) -> None:
    seed = {"seed": 1} if make is random_gbuffer else {}
    gb = make(**seed, height=9, width=14, batch=2, orthographic=orthographic)  # type: ignore[operator]
    options = form | {"weighting": weighting}
    torch.testing.assert_close(evaluate(gb, **options), expected(gb, **options), atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    "change",
    [{"radius": 0.02}, {"radius": 30.0}, {"bias": 0.0}, {"max_radius_px": 2.5}, {"steps": 9}, {"offscreen": "extend"}],
)
def test_float64_equals_the_oracle_elsewhere(change: dict) -> None:
    gb = smooth_gbuffer(height=7, width=12)
    for form in FORMS:
        torch.testing.assert_close(evaluate(gb, **(form | change)), expected(gb, **(form | change)), atol=1e-9, rtol=0)


def test_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    gb = smooth_gbuffer(height=7, width=12, batch=2)
    whole = evaluate(gb, slices=3)
    monkeypatch.setitem(horizon.BLOCK, "cpu", 64)
    monkeypatch.setattr(horizon, "MIN_PIXELS", 5)
    torch.testing.assert_close(evaluate(gb, slices=3), whole, atol=1e-15, rtol=0)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 70.0, 80.0, 85.0])
def test_plane_is_open(angle: float, dtype: torch.dtype, orthographic: bool) -> None:
    gb = plane_gbuffer(angle, dtype=dtype, orthographic=orthographic)
    points = gb.camera.unproject(torch.where(gb.valid_mask, gb.depth, 1.0))[:, :, 0]
    to_eye = points.new_tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1) if orthographic else -points
    facing = (torch.nn.functional.normalize(to_eye.expand_as(points), dim=1) * gb.normal).sum(1)
    near = facing > 0.02  # to 88.9 degrees: beyond, a slope is taken for an edge
    for form, weighting in itertools.product(FORMS, ("cosine", "uniform")):
        value = evaluate(gb, bias=0.0, slices=4, steps=4, weighting=weighting, **form)
        assert value[near].abs().max() <= 1e-3, (form, weighting)


def test_bad_choices() -> None:
    gb = steps_gbuffer()
    with pytest.raises(checks.ChoiceError, match="estimator must be one of"):
        evaluate(gb, estimator="gtao")
    with pytest.raises(checks.ChoiceError, match="offscreen must be one of"):
        evaluate(gb, offscreen="clamp")
    with pytest.raises(checks.ChoiceError, match="weighting must be one of"):
        evaluate(gb, weighting="none")
