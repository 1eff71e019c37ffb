"""The finished report: files, pictures, tables and the page."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.reports import TINY, corner, quick_fits
from torch_ssao import checks
from torch_ssao.modules import TECHNIQUES
from torch_ssao.report import Measurement, html, make_report, overview, plots, tables
from torch_ssao.report import make as make_module
from torch_ssao.report.rows import predict

MODELS = ("StatVO 1 layer", "StatVO 2 layers", "HBAO 2x2", "ray march 2x2")
NASTY = 'corner <b>&"'


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Measurement:
    with pytest.MonkeyPatch.context() as patch:
        quick_fits(patch)
        return make_report(corner(NASTY), tmp_path_factory.mktemp("out"), **TINY)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Measurement:
    """Three techniques in one report."""
    with pytest.MonkeyPatch.context() as patch:
        quick_fits(patch)
        options = {"technique": tuple(TECHNIQUES), "options": {"layers": (1, 2), "rays": 2, "slices": 2, "steps": 2}}
        return make_report(corner(), tmp_path_factory.mktemp("compared"), **TINY, **options)


@pytest.fixture(scope="module")
def page(made: Measurement) -> str:
    return (made.out / "report.html").read_text(encoding="utf-8")


def shown_on_the_page(measurement: Measurement) -> list[str]:
    """The chosen module's pictures are there under its row's name."""
    return [name for name in measurement.files if name.endswith(".png") and not name.startswith("chosen_")]


def test_all_files_are_there_and_listed(made: Measurement) -> None:
    expected = {"report.html", "report.json", "report.csv", "speed_error.png", "fitted_values.png", "reference.png"}
    expected |= {"chosen.json", "chosen_1.png"}
    for name in ("statvo_1", "statvo_2"):
        expected |= {f"{name}.json"}
        expected |= {f"{name}_{state}{kind}.png" for state in ("untuned", "fitted") for kind in ("", "_error")}
    assert set(made.files) == expected
    assert all((made.out / name).is_file() for name in expected)
    assert json.loads((made.out / "report.json").read_text())["files"] == list(made.files)


def test_pictures_hold_the_numbers(made: Measurement) -> None:
    reference = np.asarray(Image.open(made.out / "reference.png"))
    assert np.array_equal(reference, np.rint(255 * made.truth.visibility[0, 0].numpy()).astype(np.uint8))
    for name in made.files:
        if name.endswith(".png"):
            with Image.open(made.out / name) as picture:
                picture.verify()


def test_the_page_loads_nothing_from_elsewhere(page: str) -> None:
    sources = re.findall(r'src="([^"]*)"', page)
    assert sources
    for source in sources:
        assert source.startswith("data:image/png;base64,")
        Image.open(io.BytesIO(base64.b64decode(source.partition(",")[2]))).verify()
    keys = re.findall(r'<img id="([^"]*)"', page)
    assert len(set(keys)) == len(keys) == len(sources) == page.count("data:image")  # each picture once
    rest = re.sub(r'src="[^"]*"', "", page)
    assert not re.search(r"https?:|url\(|@import|<script[^>]|<link|href=", rest)
    assert "default-src 'none'" in rest


def test_the_page_shows_every_picture_and_row(made: Measurement, page: str) -> None:
    assert len(re.findall("<img", page)) == len(shown_on_the_page(made))
    for row in made.rows:
        assert f"{row.validation.rmse:.4f}" in page
    assert "noise ceiling" in page
    assert f"constant {made.constant.value:.3f}" in page
    assert "linear 8-bit grey" in page
    assert made.environment["versions"]["torch"] in page
    assert 'name="viewport"' in page


def test_the_page_is_well_formed_and_escapes_names(page: str) -> None:
    class Check(HTMLParser):
        open: list[str] = []

        def handle_starttag(self, tag: str, attrs: object) -> None:
            if tag not in ("meta", "img"):
                self.open.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert self.open.pop() == tag

    check = Check()
    check.feed(page)
    assert check.open == []
    assert "corner &lt;b&gt;&amp;&quot;" in page
    assert "<b>" not in page


def test_a_training_view_is_marked_on_the_page(made: Measurement) -> None:
    assert "Judged on the training view" not in html.page(made, {})
    flattered = html.page(replace(made, judged_views=(0,)), {})
    assert "Judged on the training view" in flattered
    assert "training view 0" in flattered


def test_table_cells(made: Measurement) -> None:
    cells = tables.score_cells(made)
    titles = [line[0] for line in cells]
    assert titles[:4] == ["1 layer, untuned", "2 layers, untuned", "1 layer, fitted", "2 layers, fitted"]
    assert titles[-1] == "noise ceiling"
    assert all(len(line) == len(tables.columns(made)) for line in cells)
    by_parameter = {(line[0], line[1]): line[3] for line in tables.value_cells(made)}
    assert by_parameter["1 layer", "radius"] == "± 0.01"
    assert by_parameter["1 layer", "falloff"] == tables.UNDETERMINED
    head, matrix = tables.value_matrix(made)
    assert head == ["fitted values", "radius", "height", "falloff", "contrast"]
    assert matrix[0][3] == "1 (undetermined)"


def test_several_techniques_share_one_page(compared: Measurement) -> None:
    page = (compared.out / "report.html").read_text(encoding="utf-8")
    assert len(re.findall("<img", page)) == len(shown_on_the_page(compared))
    assert "techniques.png" in compared.files
    for text in ("StatVO 2 layers", "HBAO 2x2", "ray march 2x2", "slices 2", "rays 2"):
        assert text in page, text
    titles = [line[0] for line in tables.score_cells(compared)]
    assert titles[:4] == [f"{model}, untuned" for model in MODELS]
    assert titles[4:8] == [f"{model}, fitted" for model in MODELS]


def test_each_technique_shows_the_parameters_it_uses(compared: Measurement) -> None:
    head, matrix = tables.value_matrix(compared)
    assert head == ["fitted values", "radius", "height", "falloff", "contrast", "thickness"]
    dashes = {line[0]: [name for name, cell in zip(head, line, strict=True) if cell == "-"] for line in matrix}
    assert dashes == {
        "StatVO 1 layer": ["thickness"],
        "StatVO 2 layers": ["thickness"],
        "HBAO 2x2": ["height", "falloff"],
        "ray march 2x2": ["height"],
    }
    listed = {(line[0], line[1]) for line in tables.value_cells(compared)}
    assert {("HBAO 2x2", "thickness"), ("ray march 2x2", "thickness")} <= listed
    assert not {("HBAO 2x2", "bias_deg"), ("HBAO 2x2", "falloff")} & listed


def test_the_overview_holds_reference_and_best_fits_pixel_by_pixel(compared: Measurement) -> None:
    best = overview.best_of_each(compared)
    assert [row.technique for row in best] == list(TECHNIQUES)
    statvo = [row.validation.rmse for row in compared.rows if row.technique == "statvo" and row.is_fitted]
    assert best[0].validation.rmse == min(statvo)
    assert all(row.is_fitted for row in best)
    picture = np.asarray(Image.open(compared.out / "techniques.png").convert("L")).astype(int)
    shown = [compared.truth.visibility[0, 0], *(predict(row.module, compared.gbuffer[0])[0, 0] for row in best)]
    zoom = -(-overview.LEAST // 48)
    for column, image in enumerate(shown):
        left = overview.GAP + column * (48 * zoom + overview.GAP)
        there = picture[overview.HEAD :, left:][: 36 * zoom, : 48 * zoom][zoom // 2 :: zoom, zoom // 2 :: zoom]
        assert (
            np.abs(there - 255 * image.numpy()).max() <= 2.1
        )  # matplotlib rounds down, and the palette has every other level


def test_every_technique_has_its_marker_in_the_plot(compared: Measurement, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    real = plots._draw_rows
    monkeypatch.setattr(
        plots, "_draw_rows", lambda axes, rows, style: (drawn.append((rows, style)), real(axes, rows, style))
    )
    plots.speed_error_png(compared)
    markers = {(rows[0].technique, style["marker"]) for rows, style in drawn}
    assert len(markers) == len({marker for _, marker in markers}) == 3
    assert sorted(style["label"] for _, style in drawn) == sorted(
        f"{title}, {state}" for title in ("StatVO", "HBAO", "ray march") for state in ("untuned", "fitted")
    )


def test_text_table_lines_up() -> None:
    lines = tables.text_table(("a", "bb"), [["long name", "1"], ["x", "1000"]]).splitlines()
    assert lines == ["a            bb", "---------  ----", "long name     1", "x          1000"]
    assert tables.number(float("nan"), 2) == "-"
    assert tables.number(float("inf"), 2) == "inf"


def test_plots_are_pictures_and_come_without_fits_too(made: Measurement) -> None:
    untuned = replace(made, rows=made.rows[:2])
    for content in (plots.speed_error_png(made), plots.speed_error_png(untuned), plots.fitted_values_png(made)):
        assert content is not None
        assert min(Image.open(io.BytesIO(content)).size) > 300
    assert plots.fitted_values_png(untuned) is None
    assert "<h2>Fitted values" in html.page(untuned, make_module.draw(untuned))


def test_without_matplotlib_nothing_is_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(caller: str, extra: str, *modules: str) -> None:
        raise checks.MissingExtraError(f"{caller} needs {modules[0]}")

    monkeypatch.setattr(make_module, "require", refuse)
    with pytest.raises(checks.MissingExtraError, match="make_report needs matplotlib"):
        make_report(corner(), tmp_path / "out", **TINY)
    assert not (tmp_path / "out").exists()
