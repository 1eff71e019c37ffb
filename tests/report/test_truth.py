from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from support.reports import SIZE, corner
from torch_ssao import reference
from torch_ssao.report.truth import TraceSettings, Truth, noise_ceiling, trace_views

SETTINGS = TraceSettings(**SIZE, radius=0.5, samples=16)


def traced(folder: Path, settings: TraceSettings = SETTINGS, views: tuple[int, ...] = (0, 1)) -> Truth:
    return trace_views(corner(), views, settings, folder, progress=False)


@pytest.fixture
def count(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The views that were really traced."""
    views: list[int] = []
    real = reference.raytrace

    def counting(scene: Any, **options: Any) -> Any:
        views.extend(options["views"])
        return real(scene, **options)

    monkeypatch.setattr(reference, "raytrace", counting)
    return views


def test_views_come_in_the_order_asked_for_and_match_raytrace(tmp_path: Path) -> None:
    truth = traced(tmp_path, views=(1, 0))
    expected = reference.raytrace(corner(), views=[1, 0], radius=0.5, samples=16, **SIZE)
    assert torch.equal(truth.visibility, expected.visibility)
    assert torch.equal(truth.standard_error, expected.standard_error)
    assert torch.equal(truth.valid, expected.valid)


def test_a_second_run_reads_what_the_first_wrote(tmp_path: Path, count: list[int]) -> None:
    first = traced(tmp_path)
    second = traced(tmp_path)
    assert count == [0, 1]
    assert torch.equal(first.visibility, second.visibility)


@pytest.mark.parametrize(
    "change", [{"radius": 0.4}, {"samples": 32}, {"seed": 1}, {"falloff": "linear"}, {"width": 40}]
)
def test_other_settings_are_traced_anew(tmp_path: Path, count: list[int], change: dict[str, Any]) -> None:
    traced(tmp_path, views=(0,))
    traced(tmp_path, replace(SETTINGS, **change), views=(0,))
    assert count == [0, 0]


def test_damaged_and_foreign_files_are_replaced(tmp_path: Path, count: list[int]) -> None:
    good = traced(tmp_path, views=(0,))
    (path,) = tmp_path.glob("*.npz")
    content = path.read_bytes()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    traced(elsewhere, replace(SETTINGS, seed=5), views=(0,))
    (other,) = elsewhere.glob("*.npz")
    np.savez(tmp_path / "numbers.npz", a=np.zeros(3))
    for wrong in (
        content[: len(content) // 2],
        b"",
        b"text",
        other.read_bytes(),
        (tmp_path / "numbers.npz").read_bytes(),
    ):
        path.write_bytes(wrong)
        count.clear()
        again = traced(tmp_path, views=(0,))
        assert count == [0]
        assert torch.equal(again.visibility, good.visibility)
        assert path.read_bytes() != wrong


def test_ceiling_follows_its_formulae() -> None:
    generator = torch.Generator().manual_seed(1)
    truth = torch.rand(1, 1, 64, 64, generator=generator) * 0.6 + 0.2
    error = torch.full_like(truth, 0.02)
    valid = torch.ones_like(truth, dtype=torch.bool)
    pair = [Truth(truth + error * torch.randn(truth.shape, generator=generator), error, valid) for _ in range(2)]
    ceiling = noise_ceiling(*pair)
    assert ceiling.rmse == pytest.approx(0.02, rel=1e-5)
    assert ceiling.psnr == pytest.approx(-20 * math.log10(0.02), rel=1e-4)
    assert ceiling.rmse_pair == pytest.approx(0.02, rel=0.05)
    assert ceiling.ssim == pytest.approx(1 - (1 - ceiling.ssim_pair) / 2)
    assert ceiling.ssim_pair < ceiling.ssim < 1


def test_ceiling_is_what_the_truth_itself_scores() -> None:
    from torch_ssao import metrics

    options: dict[str, Any] = {"views": [0], "height": 72, "width": 96, "radius": 0.5, "progress": False}
    pair = [reference.raytrace(corner(), samples=64, seed=seed, **options) for seed in (0, 1)]
    fine = reference.raytrace(corner(), samples=4096, seed=9, **options)
    ceiling = noise_ceiling(*(Truth(r.visibility, r.standard_error, r.valid) for r in pair))
    measured = float(metrics.rmse(fine.visibility, pair[0].visibility, fine.valid))
    lost = 1 - float(metrics.ssim(fine.visibility, pair[0].visibility, fine.valid))
    assert ceiling.rmse == pytest.approx(measured, rel=0.25)
    assert 1 - ceiling.ssim == pytest.approx(lost, rel=0.25)


def test_no_noise_gives_an_infinite_psnr() -> None:
    still = Truth(torch.ones(1, 1, 16, 16), torch.zeros(1, 1, 16, 16), torch.ones(1, 1, 16, 16, dtype=torch.bool))
    assert noise_ceiling(still, still).psnr == math.inf
