"""The commands fit and report: the choice, its files, and what an interrupted run leaves to the next one."""

from __future__ import annotations

import errno
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

import torch_ssao as ts
from support.reports import corner, fake_fit, quick_fits
from torch_ssao import cli, reference, scenes
from torch_ssao.report import images, make

pytestmark = pytest.mark.usefixtures("quick_fit", "elsewhere")
TINY = ["--radius", "0.5", "--size", "48x36", "--samples", "16", "--out", "o"]
TWO = ["--layers", "1,2"]
WISH = ["--target-rmse", "0.9"]


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def quick_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    quick_fits(monkeypatch)


@pytest.fixture
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing is most of the time, and not what is tested."""
    monkeypatch.setattr(make, "draw", lambda measurement: {})


@pytest.fixture
def fit(tmp_path: Path) -> list[str]:
    """The command on a mesh file with two views."""
    scene = corner()
    lines = [f"v {x} {y} {z}" for x, y, z in scene.vertices]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in scene.faces]
    (tmp_path / "corner.obj").write_text("\n".join(lines) + "\n")
    views = [{"eye": view.eye, "target": view.target, "up": view.up, "fov_y_deg": 45} for view in scene.cameras]
    (tmp_path / "cameras.json").write_text(json.dumps(views))
    return ["fit", "corner.obj", "--cameras", "cameras.json", *TINY]


def error_of(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The one line a failing command writes."""
    capsys.readouterr()
    assert cli.main(argv) == 2
    told = capsys.readouterr().err
    assert told.startswith("torch-ssao: error: ")
    assert told.count("\n") == 1, told
    return told


def test_fit_with_a_target_prints_the_choice_and_writes_everything(
    fit: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    several = ["--technique", "all", "--layers", "1", "--slices", "2", "--steps", "2", "--rays", "2"]
    assert cli.main([*fit, *WISH, *several]) == 0
    lines = capsys.readouterr().out.splitlines()
    (chosen,) = (line for line in lines if line.startswith("chosen: "))
    assert re.fullmatch(r"chosen: (StatVO, 1 layer|HBAO, 2 slices, 2 steps|ray march, 2 rays, 2 steps)", chosen)
    reason = lines[lines.index(chosen) + 1]
    assert "is the cheapest candidate whose validation RMSE is at most 0.9." in reason
    assert "None is cheaper." in reason or "The next cheaper one on the front" in reason
    assert lines[-2:] == ["wrote o/chosen.json", "wrote o/report.html"]
    assert Path("o/report.csv").is_file()


def test_the_chosen_module_gives_the_pictures_bit_for_bit(fit: list[str]) -> None:
    argv = [*fit, *TWO, "--target-rmse", "1e-6"]
    for _ in range(2):  # the second run reads the fits that the first kept
        assert cli.main(argv) == 0
        record = json.loads(Path("o/report.json").read_text())
        scene = scenes.load("corner.obj", cameras="cameras.json", radius=0.5)
        gbuffer = scenes.render(scene, views=[1], height=36, width=48)
        for row in record["rows"]:
            if row["fitted"]:
                picture = images.grey_png(ts.load(f"o/{row['name']}.json")(gbuffer)[0])
                assert Path(f"o/{row['name']}_fitted.png").read_bytes() == picture
                if row["name"] == record["chosen"]["name"]:
                    assert picture == images.grey_png(ts.load("o/chosen.json")(gbuffer)[0])
                    assert picture == Path("o/chosen_1.png").read_bytes()


@pytest.mark.usefixtures("few_pictures")
def test_a_target_that_nothing_reaches_and_a_budget(fit: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    argv = [*fit, "--layers", "1"]
    assert cli.main([*argv, "--target-rmse", "1e-6"]) == 0
    text = capsys.readouterr().out
    assert "not reached; nearest: " in text
    assert "No candidate reaches validation RMSE 1e-06: returned is the best, " in text
    assert cli.main([*argv, "--budget-ms", "1e6"]) == 0
    assert "has the least validation RMSE of the candidates that take at most 1e+06 ms." in capsys.readouterr().out


def test_report_shows_peers_of_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    Path("peers.json").write_text(
        '{"scene": "temple", "rows": [{"name": "other", "ms": 2, "validation": {"rmse": 0.2}}]}'
    )
    argv = ["report", "temple", "--layers", "1", "--views", "2", *TINY, "--peers", "peers.json"]
    assert cli.main(argv) == 0
    assert any(line.startswith("other, peer  ") for line in capsys.readouterr().out.splitlines())
    assert "scene 'heap', got 'temple'" in error_of(capsys, "report", "heap", *TINY, "--peers", "peers.json")


@pytest.mark.usefixtures("few_pictures")
def test_ctrl_c_in_a_fit_is_one_line_and_the_next_run_goes_on(
    fit: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    argv = [*fit, *TWO, *WISH]
    fits: list[str] = []

    def interrupted(module: Any, *arguments: Any, **options: Any) -> Any:
        if len(fits) == 1:
            raise KeyboardInterrupt
        fits.append(type(module).__name__)
        return fake_fit(module, *arguments, **options)

    def again(module: Any, *arguments: Any, **options: Any) -> Any:
        fits.append("again")
        return fake_fit(module, *arguments, **options)

    monkeypatch.setattr("torch_ssao.fitting.chain.fit", interrupted)
    assert cli.main(argv) == 130
    told = capsys.readouterr().err
    assert told.startswith("torch-ssao: Interrupted after 1 of 2 candidates; those done are kept in o/fits")
    assert told.count("\n") == 1
    kept = {path.name for path in Path("o").rglob("*") if path.is_file()}
    assert len(kept) == 4  # one fit, two views and the second reference of one of them
    monkeypatch.setattr("torch_ssao.fitting.chain.fit", again)
    monkeypatch.setattr(reference, "raytrace", lambda *a, **k: pytest.fail("traced again"))
    assert cli.main(argv) == 0
    assert fits[1:] == ["again"]


@pytest.mark.usefixtures("few_pictures")
@pytest.mark.parametrize("what", ["reference_", "report.csv", "report.html", "chosen_1.png"])
def test_a_full_disk_is_one_line_and_the_next_run_goes_on(
    fit: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    argv = [*fit, "--layers", "1", *WISH]
    real = os.replace

    def full(source: Any, target: Any) -> None:
        if Path(target).name.startswith(what) and Path(target).parent.name == "o":
            raise OSError(errno.ENOSPC, "No space left on device", str(target))
        real(source, target)

    monkeypatch.setattr(os, "replace", full)
    told = error_of(capsys, *argv)
    assert "No space left on device" in told
    assert "free some" in told
    assert not list(Path("o").rglob(".*"))  # no half-written file
    monkeypatch.setattr(os, "replace", real)
    if what != "reference_":
        monkeypatch.setattr(reference, "raytrace", lambda *a, **k: pytest.fail("traced again"))
    assert cli.main(argv) == 0


@pytest.mark.usefixtures("few_pictures")
def test_something_in_the_way_of_the_results_is_one_line(fit: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    argv = [*fit, "--layers", "1", *WISH]
    Path("o").write_text("in the way")
    assert "out 'o' is not writable" in error_of(capsys, *argv)
    Path("o").unlink()
    Path("o").mkdir()
    Path("o/fits").write_text("in the way")
    assert "out 'o/fits' is not writable" in error_of(capsys, *argv)
    Path("o/fits").unlink()
    Path("o/report.html").mkdir()
    assert "report.html" in error_of(capsys, *argv)
    Path("o/report.html").rmdir()
    assert cli.main(argv) == 0
