from __future__ import annotations

from typing import Any

import pytest

from torch_ssao import HBAO, RayMarchedSSAO, StatVO, checks
from torch_ssao.modules import TECHNIQUES
from torch_ssao.report import candidates as made_from
from torch_ssao.report.candidates import candidates


def test_candidates_differ_in_layers_alone() -> None:
    made = candidates("statvo", 0.7, (1, 4))
    assert [(name, label, module.layers) for name, label, module in made] == [
        ("statvo_1", "1 layer", 1),
        ("statvo_4", "4 layers", 4),
    ]
    for _, _, module in made:
        assert module.values() == pytest.approx(StatVO(0.7).values())


def test_candidates_refuse_what_cannot_be() -> None:
    with pytest.raises(checks.ChoiceError, match="technique must be one of 'statvo', 'hbao', 'ray_march', got 'magic'"):
        candidates("magic", 0.5, (1,))
    for layers in ((), (2, 2)):
        with pytest.raises(checks.RangeError, match="layers must name layer counts, each once"):
            candidates("statvo", 0.5, layers)
    with pytest.raises(checks.RangeError, match="power of two"):
        candidates("statvo", 0.5, (3,))
    with pytest.raises(checks.RangeError, match="radius"):
        candidates("statvo", -1.0, (1,))


def names_of(*arguments: Any) -> list[str]:
    return [name for name, *_ in candidates(*arguments)]


def test_counts_of_a_pair_go_together() -> None:
    made = candidates("hbao", 0.7, options={"slices": (3, 4), "steps": (4, 8), "denoise": 2, "thickness": None})
    assert [(name, label) for name, label, _ in made] == [("hbao_3x4", "HBAO 3x4"), ("hbao_4x8", "HBAO 4x8")]
    expected = [HBAO(0.7, slices=n, steps=k, denoise=2, thickness=None) for n, k in ((3, 4), (4, 8))]
    for (*_, module), wanted in zip(made, expected, strict=True):
        assert repr(module) == repr(wanted)
    assert names_of("hbao", 0.5, (1,), {"slices": 2, "steps": (1, 2)}) == ["hbao_2x1", "hbao_2x2"]


def test_a_count_left_out_is_the_default_of_the_technique() -> None:
    assert names_of("hbao", 0.5, (1,), {"slices": (2, 3)}) == [f"hbao_{n}x{HBAO().steps}" for n in (2, 3)]
    assert names_of("ray_march", 0.5, (1,), {"steps": 2}) == [f"ray_march_{RayMarchedSSAO().rays}x2"]
    assert names_of("hbao", 0.5) == ["hbao_2x4", "hbao_3x6"]
    assert names_of("ray_march", 0.5) == ["ray_march_16x8"]


def test_options_go_to_every_technique_that_has_them() -> None:
    made = candidates(("statvo", "hbao", "ray_march"), 0.5, (2,), {"steps": 2, "denoise": 1, "quadrants": False})
    assert [label for _, label, _ in made] == ["StatVO 2 layers", "HBAO 3x2", "ray march 16x2"]
    statvo, hbao, march = (module for *_, module in made)
    assert isinstance(statvo, StatVO)
    assert statvo.quadrants is False
    assert (hbao.denoise, march.denoise) == (1, 1)


def test_every_technique_has_a_title_and_counts_that_exist() -> None:
    for technique, kind in TECHNIQUES.items():
        assert technique in made_from.TITLES
        assert set(made_from.COUNTS[technique]) <= set(kind.CHOICES)
        for name, _, module in candidates(technique, 0.5):
            assert isinstance(module, kind)
            assert name.startswith(technique)


@pytest.mark.parametrize(
    ("technique", "options", "error", "message"),
    [
        ((), {}, checks.RangeError, "technique must name techniques, each once"),
        (("hbao", "hbao"), {}, checks.RangeError, "technique must name techniques, each once"),
        ("hbao", {"rays": 4}, checks.ChoiceError, r"options must be of hbao \(slices, .* got 'rays': leave it out"),
        ("hbao", {"radius": 4}, checks.ChoiceError, "got 'radius'"),
        ("hbao", {"slices": (1, 2), "steps": (1, 2, 3)}, checks.RangeError, "slices and steps must be as many"),
        ("hbao", {"slices": (2, 2)}, checks.RangeError, "slices and steps must name counts, each once"),
        ("hbao", {"slices": ()}, checks.RangeError, "slices and steps must"),
        ("ray_march", {"rays": 0}, checks.RangeError, "rays must be a whole number at least 1"),
        ("hbao", {"estimator": "magic"}, checks.ChoiceError, "estimator must be one of"),
    ],
)
def test_options_that_cannot_be(technique: Any, options: dict[str, Any], error: type[ValueError], message: str) -> None:
    with pytest.raises(error, match=message):
        candidates(technique, 0.5, (1,), options)


def test_fine_sweeps_are_for_counts_that_are_left_out() -> None:
    def names(**given: int) -> list[str]:
        return [name for name, *_ in candidates(("statvo", "hbao", "ray_march"), 0.5, (1, 2), given, fine=True)]

    hbao, rays = ["hbao_1x4", "hbao_2x4", "hbao_2x6", "hbao_3x6", "hbao_4x8"], ["4x4", "8x4", "8x8", "16x8"]
    assert names() == ["statvo_1", "statvo_2", *hbao, *(f"ray_march_{counts}" for counts in rays)]
    assert names(slices=2, steps=3, rays=5) == ["statvo_1", "statvo_2", "hbao_2x3", "ray_march_5x3"]
