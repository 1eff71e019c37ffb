"""Candidate grids: every combination, names, order, errors."""

from __future__ import annotations

from typing import Any

import pytest

import torch_ssao as ts
from torch_ssao import checks
from torch_ssao.fitting import candidates
from torch_ssao.modules import TECHNIQUES


def names(made: list[candidates.Candidate]) -> list[str]:
    return [candidate.name for candidate in made]


def test_statvo_is_the_product_in_order_of_cost() -> None:
    made = candidates.statvo(layers=[1, 2, 4, 8], sat_scale=[1, 2, 4], radius=0.3, quadrants=False)
    assert {(c.module.layers, c.module.sat_scale) for c in made} == {(n, s) for n in (1, 2, 4, 8) for s in (1, 2, 4)}
    assert len(made) == 12
    assert [c.cost for c in made] == sorted(c.cost for c in made)
    assert names(made)[0] == "statvo_layers1_sat4_noquadrants"
    assert "statvo_layers4_sat2_noquadrants" in names(made)
    for candidate in made:
        assert float(candidate.module.radius) == pytest.approx(0.3)
        assert candidate.technique == "statvo"
        assert not candidate.module.quadrants


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (candidates.statvo(layers=[1, 2], sat_scale=2), ["statvo_layers1_sat2", "statvo_layers2_sat2"]),
        (candidates.statvo(layers=4, sat_scale=1), ["statvo_layers4"]),
        (candidates.statvo(layers=8, half_resolution=[False, True]), ["statvo_layers8_half", "statvo_layers8_nohalf"]),
        (candidates.hbao(slices=2, steps=range(3, 5)), ["hbao_slices2_steps3", "hbao_slices2_steps4"]),
        (
            candidates.hbao(slices=1, steps=4, weighting=["cosine", "uniform"], estimator="increments"),
            [
                "hbao_slices1_steps4_weighting-cosine_estimator-increments",
                "hbao_slices1_steps4_weighting-uniform_estimator-increments",
            ],
        ),
        (
            candidates.ray_march(rays=(4, 8), steps=4, thickness=[None, 0.5], denoise=1),
            [
                "ray_march_rays4_steps4_thickness-none_denoise1",
                "ray_march_rays4_steps4_thickness0.5_denoise1",
                "ray_march_rays8_steps4_thickness-none_denoise1",
                "ray_march_rays8_steps4_thickness0.5_denoise1",
            ],
        ),
        (candidates.statvo(layers=1, learnable=("radius", "contrast")), ["statvo_layers1"]),
    ],
)
def test_names(made: list[candidates.Candidate], expected: list[str]) -> None:
    assert names(made) == expected


def test_options_reach_the_modules() -> None:
    (candidate,) = candidates.hbao(0.7, slices=2, steps=5, thickness=0.3, denoise=2, learnable=("thickness",))
    reference = ts.HBAO(0.7, slices=2, steps=5, thickness=0.3, denoise=2, learnable=("thickness",))
    assert repr(candidate.module) == repr(reference)


def test_all_techniques_holds_each_from_its_smallest_form_up() -> None:
    made = candidates.all_techniques(0.25)
    assert len(set(names(made))) == len(made) == 44
    assert {candidate.technique for candidate in made} == set(TECHNIQUES)
    assert {float(candidate.module.radius) for candidate in made} == {0.25}
    assert [candidate.cost for candidate in made] == sorted(candidate.cost for candidate in made)


def test_more_work_never_costs_less() -> None:
    for less, more in (
        (ts.StatVO(layers=2), ts.StatVO(layers=4)),
        (ts.StatVO(sat_scale=2), ts.StatVO(sat_scale=1)),
        (ts.StatVO(quadrants=False), ts.StatVO(quadrants=True)),
        (ts.StatVO(windows=1), ts.StatVO(windows=2)),
        (ts.HBAO(slices=2), ts.HBAO(slices=3)),
        (ts.HBAO(denoise=0), ts.HBAO(denoise=1)),
        (ts.RayMarchedSSAO(steps=4), ts.RayMarchedSSAO(steps=8)),
        (ts.RayMarchedSSAO(denoise=0), ts.RayMarchedSSAO(denoise=1)),
        (ts.HBAO(half_resolution=True), ts.HBAO(half_resolution=False)),
    ):
        assert candidates.estimated_cost(less) < candidates.estimated_cost(more)


def test_distance_counts_halvings_and_other_choices() -> None:
    base = ts.HBAO(slices=2, steps=4)
    assert candidates.distance(base, base) == 0
    assert candidates.distance(base, ts.HBAO(slices=4, steps=8)) == pytest.approx(2)
    assert candidates.distance(base, ts.HBAO(slices=2, steps=4, denoise=1)) == pytest.approx(1)
    assert candidates.distance(base, ts.HBAO(slices=2, steps=4, connected=False)) == 1


def test_candidates_modules_and_mappings_are_taken() -> None:
    given = [ts.StatVO(layers=4), *candidates.statvo(layers=1), ts.HBAO(slices=1, steps=1, offscreen="open")]
    assert names(candidates.as_candidates(given)) == ["hbao_slices1_steps1", "statvo_layers1", "statvo_layers4"]
    named = candidates.as_candidates({"mine": ts.StatVO(layers=2, quadrants=False)})
    assert names(named) == ["mine"]
    assert names(candidates.as_candidates(ts.StatVO(layers=2, sat_scale=4))) == ["statvo_layers2_sat4"]


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: candidates.statvo(steps=3), checks.ChoiceError, "options must be one of 'radius'"),
        (lambda: candidates.statvo(layers=[]), checks.RangeError, "layers must be a value or a list"),
        (lambda: candidates.hbao(steps=[3, 3]), checks.RangeError, "steps must be a value or a list"),
        (lambda: candidates.hbao(steps=[0]), checks.RangeError, "steps must be a whole number"),
        (lambda: candidates.as_candidates([]), checks.RangeError, "candidates must hold at least one"),
        (lambda: candidates.as_candidates(["statvo"]), checks.ChoiceError, "candidates must be modules"),
        (lambda: candidates.as_candidates(3), checks.ChoiceError, "candidates must be modules"),
        (lambda: candidates.as_candidates([ts.StatVO(), ts.StatVO(0.2)]), checks.ChoiceError, "'statvo_layers4' twice"),
    ],
)
def test_bad_input(call: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
