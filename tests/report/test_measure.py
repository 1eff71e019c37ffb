from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import torch_ssao as ts
from support.reports import TINY, corner, fake_fit, quick_fits
from torch_ssao import checks, load, reference, scenes
from torch_ssao.report import Measurement, measure
from torch_ssao.report.rows import predict, score


@pytest.fixture(autouse=True)
def quick_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    quick_fits(monkeypatch)


@pytest.fixture
def no_tracing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: Any, **options: Any) -> None:
        raise AssertionError("traced")

    monkeypatch.setattr(reference, "raytrace", refuse)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Measurement:
    with pytest.MonkeyPatch.context() as patch:
        quick_fits(patch)
        return measure(corner(views=3), tmp_path_factory.mktemp("out"), **TINY)


def test_views_are_judged_that_were_not_fitted(measured: Measurement) -> None:
    assert (measured.fit_views, measured.judged_views) == ((0,), (1, 2))
    assert not measured.judged_on_training_views
    assert measured.judged_label == "views 1, 2"
    gbuffer = scenes.render(corner(views=3), views=[1, 2], height=36, width=48)
    for row in measured.rows:
        assert row.validation == score(predict(row.module, gbuffer), measured.truth)
        assert row.training != row.validation


def test_untuned_rows_come_first_and_differ_from_the_default_in_the_radius_alone(measured: Measurement) -> None:
    assert [(row.name, row.is_fitted) for row in measured.rows] == [
        ("statvo_1", False),
        ("statvo_2", False),
        ("statvo_1", True),
        ("statvo_2", True),
    ]
    for row in measured.rows[:2]:
        assert row.module.values() == pytest.approx(ts.StatVO(0.5).values())


def test_constant_and_ceiling(measured: Measurement) -> None:
    assert measured.constant.training.rmse > measured.ceiling.rmse > 0
    assert 0 < measured.constant.value < 1


def test_the_json_says_everything(measured: Measurement) -> None:
    record = json.loads((measured.out / "report.json").read_text())
    assert record == measured.as_dict()
    assert record["scene"]["name"] == "corner"
    assert record["settings"]["samples"] == 16
    assert record["environment"]["threads"] == torch.get_num_threads()
    for row in record["rows"]:
        assert set(row["timing"]) == {"median_ms", "low_ms", "high_ms", "repeats"}
        assert set(row["validation"]) == {"rmse", "psnr", "ssim"}
    assert record["rows"][2]["fit"]["undetermined"] == ["falloff"]
    assert all((measured.out / name).is_file() for name in record["files"])


def test_fitted_modules_are_saved(measured: Measurement) -> None:
    for row in measured.rows[2:]:
        assert load(measured.out / f"{row.name}.json").values() == row.module.values()


def test_a_single_view_is_marked_as_a_training_view(tmp_path: Path) -> None:
    measured = measure(corner(views=1), tmp_path, **TINY | {"layers": (1,)})
    assert measured.judged_views == measured.fit_views == (0,)
    assert measured.judged_on_training_views
    assert measured.judged_label == "training view 0"
    assert measured.rows[1].validation == measured.rows[1].training
    assert json.loads((tmp_path / "report.json").read_text())["judged_on_training_views"] is True


def test_chosen_views_radius_and_parameters(tmp_path: Path) -> None:
    options = TINY | {"layers": (1,), "views": [2], "fit_views": (1, -3), "radius": 0.3, "parameters": ("radius",)}
    measured = measure(corner(views=3), tmp_path, **options)
    assert (measured.fit_views, measured.judged_views) == ((1, 0), (2,))
    assert measured.settings.radius == 0.3
    assert measured.rows[0].module.values()["radius"] == pytest.approx(0.3)
    assert set(measured.as_dict()["rows"][1]["fit"]["standard_errors"]) == {"radius"}


def test_several_techniques_are_measured_on_the_same_views(tmp_path: Path) -> None:
    options = TINY | {
        "layers": (1,),
        "technique": ("ray_march", "statvo", "hbao"),
        "parameters": ("thickness", "radius"),
    }
    counts = {"rays": 2, "slices": (1, 2), "steps": 2, "denoise": 1}
    measured = measure(corner(), tmp_path, **options, options=counts)
    assert measured.techniques == ("ray_march", "statvo", "hbao")
    names = ["ray_march_2x2", "statvo_1", "hbao_1x2", "hbao_2x2"]
    assert [row.name for row in measured.rows] == 2 * names
    assert [row.label for row in measured.rows[:3]] == ["ray march 2x2", "StatVO 1 layer", "HBAO 1x2"]
    record = json.loads((tmp_path / "report.json").read_text())
    assert record["techniques"] == ["ray_march", "statvo", "hbao"]
    by_name = {row["name"]: row for row in record["rows"] if row["fitted"]}
    fitted = {name: set(row["fit"]["standard_errors"]) for name, row in by_name.items()}
    assert fitted["hbao_1x2"] == fitted["ray_march_2x2"] == {"radius", "thickness"}
    assert fitted["statvo_1"] == {"radius"}
    assert [row["technique"] for row in record["rows"][:3]] == ["ray_march", "statvo", "hbao"]
    assert by_name["hbao_2x2"]["choices"]["denoise"] == by_name["ray_march_2x2"]["choices"]["denoise"] == 1


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"technique": "magic"}, checks.ChoiceError, "technique must be one of 'statvo', 'hbao', 'ray_march'"),
        ({"views": [7]}, checks.RangeError, "views must be indices below 2"),
        ({"fit_views": (9,)}, checks.RangeError, "views must be indices below 2"),
        ({"parameters": ("size",)}, checks.ChoiceError, "parameters must be one of 'radius'"),
        (
            {"technique": ("statvo", "hbao"), "parameters": ("height",)},
            checks.ChoiceError,
            "parameters must name at least one of each technique, .* one of HBAO's radius, contrast, thickness",
        ),
        (
            {"technique": ("hbao", "statvo"), "max_evaluations": 8},  # enough for three parameters, not for four
            checks.RangeError,
            "max_evaluations must be a whole number at least 10",
        ),
        ({"technique": "hbao", "options": {"thickness": 20.0}}, checks.RangeError, "thickness must start between"),
        ({"options": {"rays": 2}}, checks.ChoiceError, "options must be of statvo .* got 'rays'"),
        ({"max_evaluations": 3}, checks.RangeError, "max_evaluations must be a whole number at least 10"),
        ({"height": 10}, checks.RangeError, "height must be a whole number at least 11"),
        ({"radius": 0.0}, checks.RangeError, "radius must be finite and greater than 0"),
        ({"repeats": 3}, checks.RangeError, "repeats must be a whole number at least 5"),
        ({"samples": 0}, checks.RangeError, "samples"),
        ({"target_rmse": 0.0}, checks.RangeError, "target_rmse must be finite and greater than 0"),
        ({"budget_ms": -1.0}, checks.RangeError, "budget_ms must be finite and greater than 0"),
        ({"peers": "none.json"}, checks.SceneError, "peers file 'none.json' does not exist"),
    ],
)
@pytest.mark.usefixtures("no_tracing")
def test_bad_arguments_are_told_before_anything_is_made(
    tmp_path: Path, options: dict[str, Any], error: type[ValueError], message: str
) -> None:
    with pytest.raises(error, match=message):
        measure(corner(), tmp_path / "out", **TINY | options)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_tracing")
def test_an_output_folder_that_cannot_be_written_is_told_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(checks.OutputError, match=r"out .* is not writable"):
        measure(corner(), tmp_path / "file" / "out", **TINY)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "fits").write_text("")
    with pytest.raises(checks.OutputError, match=r"out .*fits' is not writable"):
        measure(corner(), tmp_path / "out", **TINY)


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted, traced = [], []
    interrupts = [True]
    real = reference.raytrace

    def fit(module: Any, *arguments: Any, **options: Any) -> Any:
        if module.layers == 2 and interrupts:
            interrupts.pop()
            raise KeyboardInterrupt
        fitted.append(module.layers)
        return fake_fit(module, *arguments, **options)

    def trace(*arguments: Any, **options: Any) -> Any:
        traced.append(options["views"])
        return real(*arguments, **options)

    monkeypatch.setattr("torch_ssao.fitting.chain.fit", fit)
    monkeypatch.setattr(reference, "raytrace", trace)
    with pytest.raises(KeyboardInterrupt, match="Interrupted after 1 of 2 candidates; those done are kept"):
        measure(corner(), tmp_path, **TINY)
    assert len(list((tmp_path / "fits").glob("statvo_1_*.json"))) == 1
    assert len(list(tmp_path.glob("reference_*.npz"))) == len(traced) == 3
    assert not (tmp_path / "report.json").exists()
    again = measure(corner(), tmp_path, **TINY)
    assert (fitted, len(traced)) == ([1, 2], 3)  # nothing twice
    assert not list(tmp_path.rglob(".*"))
    fresh = measure(corner(), tmp_path / "fresh", **TINY)
    for row, other in zip(again.rows, fresh.rows, strict=True):
        assert (row.module.values(), row.validation) == (other.module.values(), other.validation)


def test_a_damaged_fit_is_made_again(tmp_path: Path) -> None:
    first = measure(corner(), tmp_path, **TINY)
    for path in (tmp_path / "fits").iterdir():
        path.write_text(path.read_text()[:200])
    again = measure(corner(), tmp_path, **TINY)
    assert [row.validation for row in again.rows] == [row.validation for row in first.rows]


def test_the_chosen_module_is_saved_and_explained(tmp_path: Path) -> None:
    measured = measure(corner(), tmp_path, **TINY, target_rmse=0.9)
    chosen = measured.chosen
    assert chosen is not None
    assert chosen.reached
    assert chosen.label.startswith("StatVO, ")
    assert "is at most 0.9" in chosen.reason
    best = next(row for row in measured.rows if row.is_fitted and row.name == chosen.name)
    assert load(tmp_path / "chosen.json").values() == best.module.values()
    record = json.loads((tmp_path / "report.json").read_text())
    assert record["chosen"]["name"] == chosen.name
    assert record["chosen"]["target_rmse"] == 0.9
    unreached = measure(corner(), tmp_path, **TINY, target_rmse=1e-9).chosen
    assert unreached is not None
    assert not unreached.reached
    assert "No candidate reaches validation RMSE 1e-09" in unreached.reason


def test_the_errors_of_the_choice_are_those_of_the_table(tmp_path: Path) -> None:
    """`select` and the report judge the same pixels of the same views."""
    options = TINY | {"views": [2, 1], "fit_views": (3,)}
    measured = measure(corner(views=4), tmp_path, **options)
    chosen = measured.chosen
    assert chosen is not None
    best = next(row for row in measured.rows if row.is_fitted and row.name == chosen.name)
    assert f"(validation RMSE {best.validation.rmse:.5f}, training RMSE {best.training.rmse:.5f}, " in chosen.reason


def test_a_choice_on_training_views_says_so(tmp_path: Path) -> None:
    chosen = measure(corner(), tmp_path, **TINY | {"fit_views": (0, 1)}).chosen
    assert chosen is not None
    assert "validation" not in chosen.reason
    assert "training-view RMSE" in chosen.reason


def test_a_technique_that_fails_is_left_out_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(module: Any, *arguments: Any, **options: Any) -> Any:
        if module.layers == 2:
            raise RuntimeError("no luck\nat all")
        return fake_fit(module, *arguments, **options)

    monkeypatch.setattr("torch_ssao.fitting.chain.fit", broken)
    measured = measure(corner(), tmp_path, **TINY)
    assert [row.name for row in measured.rows] == ["statvo_1", "statvo_1"]
    assert measured.chosen is not None
    assert measured.chosen.notes == ("statvo_2 was left out: RuntimeError: no luck.",)
    assert not (tmp_path / "statvo_2.json").exists()


def test_notes_are_told_on_stderr_on_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measure(corner(views=1), tmp_path, **TINY | {"layers": (1,)})
    assert capsys.readouterr().err == ""
    measure(corner(views=1), tmp_path, **TINY | {"layers": (1,), "progress": True})
    assert "fitting and timing statvo_1\n" in capsys.readouterr().err
