"""Every technique on what people complain of: the figures of `support.hard_case_list`, and finite derivatives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

import torch_ssao as ts
from support.hard_case_list import CASES, SCENES, HardCase
from support.hard_case_scenes import facets, halved, horizon, pillar
from support.hard_cases import TECHNIQUES, derivatives, make

PINNED = 0.25  # a known failure may move by this before the record has to be brought up to date
FULL = (torch.float32, torch.float64)
HALF = (torch.float16, torch.bfloat16)


def requirements() -> list[Any]:
    return [
        pytest.param(case, name, id=f"{case.name}-{name}", marks=pytest.mark.slow if case.slow else ())
        for case in CASES
        for name in case.techniques
    ]


@pytest.mark.parametrize(("case", "name"), requirements())
def test_requirement(case: HardCase, name: str) -> None:
    figure = case.figure(name)
    if name not in case.known:
        assert abs(figure) <= case.most  # a NaN fails too
        return
    assert not abs(figure) <= case.most, f"no longer a failure: strike {name} from {case.name}, and from the document"
    assert figure == pytest.approx(case.known[name], rel=PINNED), "a known failure moved: record its new figure"


def precisions() -> list[Any]:
    params = []
    for scene in SCENES:
        for name in TECHNIQUES:
            for dtype in (*FULL, *HALF):
                params.append(
                    pytest.param(
                        *(scene, name, dtype),
                        id=f"{scene}-{name}-{str(dtype).removeprefix('torch.')}",
                    )
                )
    return params


@pytest.mark.parametrize(("scene", "name", "dtype"), precisions())
def test_image_and_every_gradient_are_finite(scene: str, name: str, dtype: torch.dtype) -> None:
    # float16 has no depth beyond 65504: such pixels are invalid, hence open and without gradient.
    build, radius = SCENES[scene]
    gb = halved(build())
    image, grads = derivatives(name, gb, dtype, radius=radius)
    assert image.dtype == (torch.float32 if dtype in HALF else dtype)
    assert bool(((image >= 0) & (image <= 1)).all())
    assert all(bool(torch.isfinite(grad).all()) for grad in grads)
    seen = gb.to(dtype).depth.isfinite() & gb.valid_mask
    assert bool((grads[0][~seen] == 0).all())
    if bool((image < 0.9).any()):
        assert bool((grads[0] != 0).any())


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("statvo", {"falloff": 10.0}),
        ("bitmask", {"thickness": 0.1, "connected": False}),
        ("march", {"thickness": 0.1}),
    ],
)
def test_halo_just_beyond_the_radius_has_a_remedy(name: str, remedy: dict[str, Any]) -> None:
    gb = pillar(1.2)
    assert bool((make(name, 1.0, **remedy)(gb)[gb.depth == 6.0] > 0.999).all())
    assert bool((make(name, 1.0, **remedy)(pillar(0.5))[gb.depth == 6.0] < 0.99).any())  # not by seeing nothing


@pytest.mark.parametrize("name", ["march", "march-solid"])
def test_rays_see_no_facets_with_normals_estimated_from_the_depth(name: str) -> None:
    gb = facets()
    assert gb.normal is not None
    front = (gb.normal[:, 2:] < -0.5) & gb.valid_mask
    bare = ts.GBuffer(gb.depth, gb.camera, valid=gb.valid)
    assert (1 - make(name, 0.5)(bare))[front].mean() < 2e-3


def test_unconnected_taps_leave_the_horizon_open() -> None:
    gb = horizon(limit=100.0)
    assert bool((make("bitmask", 0.5, connected=False)(gb) > 0.999).all())


@pytest.mark.parametrize("name", [name for name in TECHNIQUES if name != "statvo"])
def test_frames_change_the_noise_and_nothing_else_does(name: str) -> None:
    net, (build, radius) = TECHNIQUES[name](0.8), SCENES["temple"]
    assert radius == 0.8
    gb = build()
    image = net(gb, frame=4)
    torch.manual_seed(5)
    assert torch.equal(net(gb, frame=4), image)
    assert not torch.equal(net(gb, frame=5), image)


def test_the_document_lists_every_case_and_every_known_failure() -> None:
    text = (Path(__file__).parents[1] / "docs" / "stability.md").read_text(encoding="utf-8")
    lines = [row for row in text.splitlines() if row.startswith("| ") and row.split("|")[1].strip().isdigit()]
    rows = {row.split("|")[2].split("`")[1]: row for row in lines}
    assert set(rows) == {case.name for case in CASES}
    for case in CASES:
        assert case.title in rows[case.name]
        assert rows[case.name].count("**") == 2 * len(case.known), case.name


def test_numbers_run_from_one_to_twenty_one() -> None:
    assert sorted({case.number for case in CASES}) == list(range(1, 22))
    assert all(not abs(figure) <= case.most for case in CASES for figure in case.known.values())
    assert all(math.isfinite(case.most) for case in CASES)
