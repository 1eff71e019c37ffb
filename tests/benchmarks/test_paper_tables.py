"""The papers' tables: a whole run on tiny images, the ceiling, the counts of equal time."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import torch_ssao as ts
from benchmarks.paper_tables import __main__ as program
from benchmarks.paper_tables import common, ray_marched, statvo


@pytest.fixture
def case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> common.Case:
    monkeypatch.setattr(common, "CACHE", tmp_path)
    monkeypatch.setattr(common, "EVALUATIONS", 14)
    monkeypatch.setattr(common, "FIT_SAMPLES", 16)
    settings = common.Settings((32, 24), samples=64, traced=16, repeats=2)
    return common.Case("temple", ts.scenes.builtin("temple"), settings)


def test_a_run_writes_rows_tables_and_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in (("CACHE", tmp_path), ("EVALUATIONS", 14), ("FIT_SAMPLES", 16)):
        monkeypatch.setattr(common, name, value)
    results = tmp_path / "rows.json"
    options = "--builtin temple --size 32x24 --samples 512 --repeats 2 --tables ray_marched"
    monkeypatch.setattr(sys, "argv", ["paper_tables", *options.split(), "--results", str(results)])
    program.main()
    stored = json.loads(results.read_text(encoding="utf-8"))["ray_marched"]
    rows = {row["technique"]: row for row in stored["rows"]}
    assert list(rows) == ["Mittring", "Filion", "ours", "ray-traced", "constant", "ceiling"]
    assert stored["settings"]["size"] == [32, 24]
    assert stored["environment"]["versions"]["torch"] == torch.__version__
    # As many rays of another seed differ by the noise of both, and by less than any technique.
    assert rows["ceiling"]["rmse"] < rows["ray-traced"]["rmse"] < rows["ours"]["rmse"] < rows["constant"]["rmse"]
    assert rows["ceiling"]["ssim"] > rows["ray-traced"]["ssim"] > rows["ours"]["ssim"]
    assert rows["Mittring"]["published"]["rmse"] > 0.3  # a plane is 1/2
    assert rows["ours"]["paper_ssim"] == 0.85
    assert capsys.readouterr().out.count("| temple |") == len(rows)
    assert (tmp_path / "temple_ours_fitted.png").exists()
    # A run of another scene keeps these rows, one of another size does not.
    facts = stored["settings"]
    program._keep(results, "ray_marched", facts, [{"scene": "street", "rmse": 1.0}])
    assert len(json.loads(results.read_text(encoding="utf-8"))["ray_marched"]["rows"]) == len(rows) + 1
    program._keep(results, "ray_marched", facts | {"size": [64, 48]}, [{"scene": "street", "rmse": 1.0}])
    assert len(json.loads(results.read_text(encoding="utf-8"))["ray_marched"]["rows"]) == 1


def test_counts_of_equal_time_solve_what_a_sample_costs(case: common.Case, monkeypatch: pytest.MonkeyPatch) -> None:
    def spent(modules: list[Any]) -> list[dict[str, float]]:
        costs = {"Crytek": 2.0, "LineSampled": 1.0, "SAO": 0.5}
        return [
            {"median_ms": 50.0 if type(m) is ts.StatVO else 10.0 + costs[type(m).__name__] * m.samples} for m in modules
        ]

    monkeypatch.setattr(case, "time", spent)
    counts = statvo.equal_counts(case, [ts.StatVO(case.radius)])
    assert counts == {"point sampling": [20], "line sampling": [40], "SAO": [80]}


def test_statvo_beside_its_peers(case: common.Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statvo, "LIMIT", 64)
    monkeypatch.setattr(statvo, "equal_counts", lambda case, modules: {name: [20, 30, 40] for name in statvo.PEERS})
    found = statvo.rows(case)
    rows = {row["technique"]: row for row in found}
    assert len(rows) == 3 + 3 * 4 + 1
    for name, count in (("point sampling", 17), ("line sampling", 12), ("SAO", 11)):
        few, many = rows[f"{name}, {count}: the paper's count"], rows[f"{name}, 40: as long as StatVO, quadrants"]
        assert (few["samples"], many["samples"]) == (count, 40)
        assert few["values"] == many["values"]  # one fit
        assert few["limit_to_reference"] == many["limit_to_reference"]
    limits = {name: rows[name]["limit"]["rmse"] for name in statvo.STATVO}
    assert all(0 < value < 0.2 for value in limits.values())
    assert statvo.table(found).count("| temple |") == len(rows) + 1  # and the head of the summary


def test_the_ceiling_takes_the_reference_share_of_the_noise(case: common.Case) -> None:
    image = case.traced()
    assert len(case.traced_ms) == 2
    score = case.judge(image)
    ceiling = ray_marched._ceiling(case, score["ssim"])
    # Independent references of 64 and 16 rays differ by the noise of both.
    own = case.truth.standard_error[case.truth.valid].square().mean()
    other = case.traced_error[case.truth.valid].square().mean()
    assert ceiling["rmse"] == pytest.approx(own.sqrt().item(), rel=1e-5)
    assert score["rmse"] == pytest.approx((own + other).sqrt().item(), rel=0.35)
    assert ceiling["ssim"] == pytest.approx(1 - (1 - score["ssim"]) * (own / (own + other)).item(), rel=1e-5)
    assert case.judge(case.truth.visibility)["ssim"] == pytest.approx(1.0, abs=1e-6)
