"""Peers, the Pareto front and the spreadsheet of a report."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from support.reports import TINY, corner, quick_fits
from torch_ssao.report import Measurement, html, make_report, plots, spreadsheet, tables
from torch_ssao.report.pareto import entries, pareto_front
from torch_ssao.report.peers import Peer
from torch_ssao.report.rows import Score, Timing


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Measurement:
    folder = tmp_path_factory.mktemp("out")
    rows = [
        {"name": "fast & near", "ms": 1e-3, "validation": {"rmse": 1e-3, "ssim": 0.9}, "note": "another <machine>"},
        {
            "name": "slow",
            "ms": 1e6,
            "ms_low": 9e5,
            "ms_high": 2e6,
            "validation": {"rmse": 0.9},
            "training": {"rmse": 0.8},
        },
        {"name": "untimed", "validation": {"rmse": 1e-4}},
    ]
    (folder / "peers.json").write_text(json.dumps(rows))
    with pytest.MonkeyPatch.context() as patch:
        quick_fits(patch)
        return make_report(corner(), folder, **TINY, peers=folder / "peers.json")


def timed(made: Measurement, points: list[tuple[float, float]]) -> Measurement:
    """The measurement with its rows at other places and no peers."""
    rows = tuple(
        replace(made.rows[0], name=str(i), timing=Timing(ms, ms, ms, 5), validation=Score(error, 0.0, 0.0))
        for i, (ms, error) in enumerate(points)
    )
    return replace(made, rows=rows, peers=())


def test_the_front_is_what_nothing_beats(made: Measurement) -> None:
    points = [tuple(map(float, point)) for point in np.random.default_rng(3).integers(1, 9, (40, 2))]
    front = pareto_front(timed(made, points))
    found = [(entry.timing.median_ms, entry.validation.rmse) for entry in front if entry.timing]
    beaten = {
        a for a in points for b in points if b[0] <= a[0] and b[1] <= a[1] and b != a
    }  # at least as good in both, better in one
    assert set(found) == set(points) - beaten
    assert found == sorted(set(found))  # cheapest first, of equals one


def test_peers_are_on_the_front_where_they_win(made: Measurement) -> None:
    front = pareto_front(made)
    assert [entry.name for entry in front] == ["fast & near"]
    assert [entry.name for entry in entries(made)][-3:] == ["fast & near", "slow", "untimed"]
    ours = pareto_front(replace(made, peers=()))
    assert all(not isinstance(entry, Peer) for entry in ours)
    assert min(row.validation.rmse for row in made.rows) == ours[-1].validation.rmse


def test_of_a_module_untuned_and_fitted_one_competes(made: Measurement) -> None:
    """However little time tells them apart."""
    untuned, fitted = made.rows[0], next(row for row in made.rows if row.is_fitted)
    assert untuned.name == fitted.name
    slower = replace(fitted, timing=Timing(2.0, 2.0, 2.0, 5), validation=Score(0.1, 0.0, 0.0))
    for error, expected in ((0.2, slower), (0.1, slower), (0.05, None)):
        faster = replace(untuned, timing=Timing(1.0, 1.0, 1.0, 5), validation=Score(error, 0.0, 0.0))
        (only,) = pareto_front(replace(made, rows=(faster, slower), peers=()))
        assert only is (expected or faster)


def test_the_table_lists_peers_and_marks_the_front(made: Measurement) -> None:
    head = tables.columns(made)
    assert head.index("validation RMSE") < head.index("training RMSE")
    lines = {line[0]: dict(zip(range(len(head)), line, strict=True)) for line in tables.score_cells(made)}
    near, slow, untimed = (lines[f"{name}, peer"] for name in ("fast & near", "slow", "untimed"))
    assert list(near.values())[1:] == ["0.0010", "-", "0.9000", "-", "-", "-", "0.001", tables.ON_FRONT]
    assert slow[4] == "0.8000"
    assert slow[7] == "1000000.0 (900000.0-2000000.0)"
    assert untimed[7] == "-"
    assert [name for name, line in lines.items() if line[8] == tables.ON_FRONT] == ["fast & near, peer"]


def test_the_page_says_where_peers_come_from(made: Measurement) -> None:
    page = (made.out / "report.html").read_text()
    assert "fast &amp; near: another &lt;machine&gt;" in page
    assert "Peers on it: fast &amp; near." in page
    assert "not measured here" in page
    assert "not measured here" not in html.page(replace(made, peers=()), {})


def test_the_plot_draws_timed_peers_and_the_front(made: Measurement, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}
    real = plots._finish

    def finish(axes: Any, measurement: Measurement) -> None:
        real(axes, measurement)
        seen["texts"] = [text.get_text() for text in axes.texts]
        seen["front"] = next(line for line in axes.lines if line.get_label() == "Pareto front").get_xydata()
        seen["top"] = axes.get_ylim()[1]

    monkeypatch.setattr(plots, "_finish", finish)
    plots.speed_error_png(made)
    assert {"fast & near", "slow"} <= set(seen["texts"])
    assert "untimed" not in seen["texts"]
    assert seen["front"].tolist() == [[1e-3, 1e-3]]
    assert seen["top"] > 0.9
    plots.speed_error_png(replace(made, peers=()))
    front = pareto_front(replace(made, peers=()))
    assert seen["front"].tolist() == [
        [entry.timing.median_ms, entry.validation.rmse] for entry in front if entry.timing
    ]


def test_the_spreadsheet_holds_every_row(made: Measurement) -> None:
    text = (made.out / "report.csv").read_text()
    assert text == spreadsheet.csv_text(made)
    lines = list(csv.DictReader(io.StringIO(text)))
    assert [line["kind"] for line in lines] == ["untuned"] * 2 + ["fitted"] * 2 + ["peer"] * 3 + ["constant", "ceiling"]
    names = list(lines[0])
    assert (
        names.index("validation_rmse") < names.index("training_rmse") < names.index("ms") < names.index("choice_layers")
    )
    for line, row in zip(lines, made.rows, strict=False):
        assert (line["name"], line["technique"]) == (row.name, "statvo")
        assert float(line["validation_rmse"]) == row.validation.rmse
        assert float(line["training_ssim"]) == row.training.ssim
        assert float(line["ms_high"]) == row.timing.high_ms
        assert float(line["value_radius"]) == row.module.values()["radius"]
        assert line["choice_layers"] == str(row.module.config()["layers"])
    assert [line["error_radius"] for line in lines[:4]] == ["", "", "0.01", "0.01"]
    assert "error_falloff" not in names  # the fake fit cannot determine it
    near, _, untimed = lines[4:7]
    assert (near["pareto"], near["validation_psnr"], near["training_rmse"], untimed["ms"]) == ("1", "", "", "")
    assert float(lines[-1]["validation_rmse"]) == made.ceiling.rmse


def test_the_json_lists_peers_and_front(made: Measurement) -> None:
    record = json.loads((made.out / "report.json").read_text())
    assert [peer["pareto"] for peer in record["peers"]] == [True, False, False]
    assert record["peers"][0]["validation"] == {"rmse": 1e-3, "psnr": None, "ssim": 0.9}
    assert all(row["pareto"] is False for row in record["rows"])
    for row in record["rows"]:
        assert list(row).index("validation") < list(row).index("training") < list(row).index("timing")
    assert math.isfinite(record["rows"][0]["validation"]["rmse"])
