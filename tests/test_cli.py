"""The command line: what each command leaves behind, and one line for every error."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import torch_ssao as ts
from support.reports import corner, quick_fits
from torch_ssao import cli, reference, scenes
from torch_ssao.cli import commands, parser

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(ts.__file__).parents[1])}  # found from any folder, installed or not
TINY = ["--size", "48x36", "--samples", "16"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # nothing may be written beside the tests


@pytest.fixture
def quick_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    quick_fits(monkeypatch)


@pytest.fixture
def mesh(tmp_path: Path) -> tuple[str, str]:
    """A mesh file and its cameras."""
    scene = corner()
    lines = [f"v {x} {y} {z}" for x, y, z in scene.vertices]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in scene.faces]
    (tmp_path / "corner.obj").write_text("\n".join(lines) + "\n")
    views = [{"eye": view.eye, "target": view.target, "up": view.up, "fov_y_deg": 45} for view in scene.cameras]
    (tmp_path / "cameras.json").write_text(json.dumps(views))
    return str(tmp_path / "corner.obj"), str(tmp_path / "cameras.json")


def error_of(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The one line a failing command writes."""
    assert cli.main(argv) == 2
    told = capsys.readouterr().err
    assert told.startswith("torch-ssao: error: ")
    assert told.endswith("\n")
    assert told.count("\n") == 1, told
    return told


# ---- scenes ----------------------------------------------------------------------------------------------------------


def test_scenes_lists_the_built_in_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["scenes"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["scene", "faces", "views", "radius"]
    temple = scenes.builtin("temple")
    listed = {line.split()[0]: line.split()[1:] for line in lines[2:]}
    assert list(listed) == scenes.names()
    assert listed["temple"] == [str(len(temple.faces)), "4", f"{temple.radius:g}"]


def test_scenes_describes_a_mesh_file(capsys: pytest.CaptureFixture[str], mesh: tuple[str, str]) -> None:
    assert cli.main(["scenes", mesh[0], "--cameras", mesh[1]]) == 0
    text = capsys.readouterr().out
    assert "corner: 6 faces" in text
    assert "(0, 0, 0) to (2, 2, 2)" in text
    assert "(4, 2.5, 3)" in text


# ---- render ----------------------------------------------------------------------------------------------------------


def test_render_writes_visibility_as_grey(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        cli.main(["render", "temple", "--views", "1,3", *TINY, "--layers", "2", "--radius", "0.6", "--out", "o"]) == 0
    )
    assert sorted(file.name for file in (tmp_path / "o").iterdir()) == ["visibility_1.png", "visibility_3.png"]
    gbuffer = scenes.render(scenes.builtin("temple"), views=3, height=36, width=48)
    expected = np.rint(255 * ts.StatVO(0.6, layers=2)(gbuffer)[0, 0].numpy())
    assert np.array_equal(np.asarray(Image.open("o/visibility_3.png")), expected)
    assert capsys.readouterr().out.splitlines() == ["wrote o/visibility_1.png", "wrote o/visibility_3.png"]


def test_render_a_mesh_file_with_a_fitted_module_and_the_reference(mesh: tuple[str, str]) -> None:
    module = ts.StatVO(0.4, contrast=1.7, layers=1)
    ts.save(module, "fitted.json")
    argv = ["render", mesh[0], "--cameras", mesh[1], "--views", "0", "--module", "fitted.json", "--reference", *TINY]
    assert cli.main([*argv, "--radius", "0.3"]) == 0  # into out/<scene> without --out
    scene = scenes.load(mesh[0], cameras=mesh[1])
    gbuffer = scenes.render(scene, views=0, height=36, width=48)
    expected = np.rint(255 * module(gbuffer)[0, 0].numpy())
    assert np.array_equal(np.asarray(Image.open("out/corner/visibility_0.png")), expected)
    truth = reference.raytrace(scene, views=0, height=36, width=48, radius=0.3, samples=16)
    traced = np.rint(255 * truth.visibility[0, 0].numpy())
    assert np.array_equal(np.asarray(Image.open("out/corner/reference_0.png")), traced)


# ---- fit and report --------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick_fit")
def test_fit_prints_a_table_and_saves_modules(
    tmp_path: Path, mesh: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["fit", mesh[0], "--cameras", mesh[1], "--radius", "0.5", "--layers", "1,2", *TINY, "--out", "o"]
    assert cli.main([*argv, "--fit-views", "1", "--parameters", "radius,contrast"]) == 0
    text = capsys.readouterr().out
    assert "fitted on view 1, judged on view 0" in text
    for start in ("1 layer, untuned", "2 layers, fitted", "constant ", "noise ceiling"):
        assert any(line.startswith(start) for line in text.splitlines()), start
    assert f"wrote {Path('o') / 'report.json'}" in text
    record = json.loads(Path("o/report.json").read_text())
    assert record["fit_views"] == [1]
    assert set(record["rows"][2]["fit"]["standard_errors"]) == {"radius", "contrast"}
    assert ts.load("o/statvo_2.json").layers == 2
    assert not (tmp_path / "o" / "report.html").exists()


@pytest.mark.usefixtures("quick_fit")
def test_report_writes_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report", "temple", "--layers", "1", "--views", "2", *TINY, "--out", "o"]) == 0
    told = capsys.readouterr()
    assert "wrote o/report.html" in told.out
    assert told.err == ""
    assert "judged on view 2" in told.out
    assert Path("o/report.html").read_text().startswith("<!doctype html>")


@pytest.mark.usefixtures("quick_fit")
def test_fitting_every_view_says_that_errors_flatter(mesh: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["fit", mesh[0], "--cameras", mesh[1], "--radius", "0.5", "--layers", "1", "--fit-views", "0,1", *TINY]
    assert cli.main(argv) == 0
    text = capsys.readouterr().out
    assert "judged on training views 0, 1" in text
    assert "flatter" in text


def test_render_a_chosen_technique_with_its_options() -> None:
    gbuffer = scenes.render(scenes.builtin("temple"), views=3, height=36, width=48)
    asked = {
        ts.HBAO(
            0.6, slices=2, steps=3, thickness=None, denoise=1
        ): "hbao --slices 2 --steps 3 --thickness none --denoise 1",
        ts.RayMarchedSSAO(0.6, rays=3, steps=4, thickness=0.5): "raymarch --rays 3 --steps 4 --thickness 0.5",
        ts.StatVO(0.6, layers=3, layering="uniform", quadrants=False, sat_scale=2): (
            "statvo --layers 3 --layering uniform --no-quadrants --sat-scale 2"
        ),
    }
    for module, options in asked.items():
        argv = ["render", "temple", "--views", "3", *TINY, "--radius", "0.6", "--out", "o", "--technique"]
        assert cli.main([*argv, *options.split()]) == 0
        expected = np.rint(255 * module(gbuffer)[0, 0].numpy())
        assert np.array_equal(np.asarray(Image.open("o/visibility_3.png")), expected), options


@pytest.mark.usefixtures("quick_fit")
def test_report_compares_all_techniques(mesh: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["report", mesh[0], "--cameras", mesh[1], "--radius", "0.5", *TINY, "--out", "o", "--technique", "all"]
    assert cli.main([*argv, "--layers", "1", "--slices", "2", "--steps", "2,3", "--rays", "2"]) == 0
    names = ["statvo_1", "hbao_2x2", "hbao_2x3", "ray_march_2x2", "ray_march_2x3"]
    assert [row["name"] for row in json.loads(Path("o/report.json").read_text())["rows"]] == 2 * names
    text = capsys.readouterr().out
    for start in ("StatVO 1 layer, untuned", "HBAO 2x3, fitted", "ray march 2x2, fitted"):
        assert any(line.startswith(start) for line in text.splitlines()), start
    assert Path("o/techniques.png").is_file()


@pytest.mark.slow
def test_fit_for_real(mesh: tuple[str, str]) -> None:
    argv = ["fit", mesh[0], "--cameras", mesh[1], "--radius", "0.5", "--layers", "1", *TINY, "--out", "o", "--quiet"]
    assert cli.main(argv) == 0
    untuned, fitted = json.loads(Path("o/report.json").read_text())["rows"]
    assert fitted["training"]["rmse"] <= untuned["training"]["rmse"]
    assert fitted["fit"]["evaluations"] > 0


# ---- errors ----------------------------------------------------------------------------------------------------------

EMPTY = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize("command", ["render", "fit", "report"])
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["tempel"], "scene must be a built-in scene (temple, "),
        (["missing.ply"], "mesh file 'missing.ply' does not exist"),
        (["empty.ply"], "empty.ply"),
        (["points.obj"], "must have faces"),
        (["temple", "--radius", "0"], "radius must be finite and greater than 0"),
        (["temple", "--radius", "-1"], "radius must be finite and greater than 0"),
        (["temple", "--radius", "wide"], "argument --radius: invalid float value: 'wide'"),
        (["temple", "--size", "640"], "argument --size: must be WIDTHxHEIGHT in pixels such as 640x480, got '640'"),
        (["temple", "--size", "0x4"], "argument --size: must be WIDTHxHEIGHT"),
        (["temple", "--views", "0;1"], "argument --views: must be whole numbers with commas"),
        (["temple", "--views", "9"], "views must be indices below 4 of scene 'temple', got 9"),
        (["temple", "--layers", "3"], "layers must be a power of two, got 3"),
        (["temple", "--cameras", "cameras.json"], "--cameras must go with a mesh file"),
        (["temple", "--nonsense"], "unrecognized arguments: --nonsense: see torch-ssao"),
        (["temple", "--out", "points.obj/out"], "out 'points.obj/out' is not writable"),
    ],
)
def test_bad_arguments(capsys: pytest.CaptureFixture[str], command: str, options: list[str], expected: str) -> None:
    Path("empty.ply").write_text(EMPTY)
    Path("points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    before = set(Path().rglob("*"))
    assert expected in error_of(capsys, command, *options)
    assert set(Path().rglob("*")) == before


def test_an_unknown_technique_names_the_choices(capsys: pytest.CaptureFixture[str]) -> None:
    told = error_of(capsys, "fit", "temple", "--technique", "magic")
    assert "technique must be one of 'statvo', 'hbao', 'ray_march', got 'magic'" in told


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--technique hbao --layers 2", "--layers must be left out with --technique hbao, which has --slices, --steps"),
        ("--technique hbao --rays 2", "or choose --technique ray_march"),
        ("--technique raymarch --no-quadrants", "--quadrants must be left out with --technique ray_march"),
        ("--slices 2", "--slices must be left out with --technique statvo, which has --layers, --quadrants"),
        ("--technique hbao --estimator magic", "estimator must be one of"),
        ("--technique hbao --weighting magic", "weighting must be one of"),
        ("--technique hbao --offscreen magic", "offscreen must be one of"),
        ("--technique hbao --slices 0", "slices must be a whole number at least 1"),
        ("--technique hbao --thickness thick", "--thickness: must be a positive number or none, got 'thick'"),
        ("--technique hbao --thickness -1", "thickness must be finite and greater than 0"),
    ],
)
@pytest.mark.parametrize("command", ["render", "fit", "report"])
def test_options_of_another_technique(
    capsys: pytest.CaptureFixture[str], command: str, options: str, expected: str
) -> None:
    assert expected in error_of(capsys, command, "temple", *options.split())
    assert not list(Path().iterdir())


def test_an_option_that_one_of_several_techniques_has_is_allowed(capsys: pytest.CaptureFixture[str]) -> None:
    told = error_of(capsys, "fit", "temple", "--technique", "statvo,hbao", "--slices", "2,3", "--steps", "1,2,3")
    assert "slices and steps must be as many" in told  # past the check of the options
    assert "--rays must be left out" in error_of(capsys, "fit", "temple", "--technique", "statvo,hbao", "--rays", "2")


def test_render_takes_one_technique(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--technique must be one technique, got statvo,hbao" in error_of(
        capsys, "render", "temple", "--technique", "statvo,hbao"
    )


def test_a_camera_that_sees_nothing(capsys: pytest.CaptureFixture[str], mesh: tuple[str, str]) -> None:
    away = [{"eye": [9, 9, 9], "target": [20, 20, 20]}, {"eye": [9, 9, 9], "target": [20, 20, 21]}]
    Path("away.json").write_text(json.dumps(away))
    for command in ("render", "fit"):
        argv = (command, mesh[0], "--cameras", "away.json", "--radius", "0.5", *TINY)
        assert "sees nothing" in error_of(capsys, *argv)


def test_a_broken_camera_file(capsys: pytest.CaptureFixture[str], mesh: tuple[str, str]) -> None:
    Path("bad.json").write_text("{")
    assert "cameras" in error_of(capsys, "render", mesh[0], "--cameras", "bad.json")
    assert "does not exist" in error_of(capsys, "scenes", mesh[0], "--cameras", "none.json")


def test_a_module_file_that_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert "path 'none.json' does not exist" in error_of(capsys, "render", "temple", "--module", "none.json")
    for option in (("--layers", "2"), ("--technique", "hbao"), ("--denoise", "1")):
        told = error_of(capsys, "render", "temple", "--module", "a.json", *option)
        assert f"{option[0]} must be left out with --module" in told


def test_no_command_and_an_unknown_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert "arguments are required: COMMAND" in error_of(capsys)
    assert "invalid choice: 'paint'" in error_of(capsys, "paint")


def test_a_missing_extra(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(arguments: Any) -> None:
        raise ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib.figure")

    monkeypatch.setattr(commands, "scenes_command", missing)
    assert "run pip install 'torch_ssao[report]'" in error_of(capsys, "scenes")


def test_an_error_of_the_system_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(arguments: Any) -> None:
        raise OSError(28, "No space left\non device", "a.png")

    monkeypatch.setattr(commands, "scenes_command", full)
    assert "No space left" in error_of(capsys, "scenes")


@pytest.mark.parametrize(
    "error", [ValueError("operands could not be broadcast"), ImportError("x", name="torch_ssao.y")]
)
def test_a_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def broken(arguments: Any) -> None:
        raise error

    monkeypatch.setattr(commands, "scenes_command", broken)
    with pytest.raises(type(error)):
        cli.main(["scenes"])


def test_ctrl_c_is_one_line_and_keeps_finished_files(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = scenes.render

    def interrupted(scene: Any, **options: Any) -> Any:
        if options["views"] == 1:
            raise KeyboardInterrupt
        return real(scene, **options)

    monkeypatch.setattr(scenes, "render", interrupted)
    assert cli.main(["render", "temple", *TINY, "--out", "o"]) == 130
    assert capsys.readouterr().err == "torch-ssao: interrupted: the same command goes on with what was finished\n"
    assert [file.name for file in Path("o").iterdir()] == ["visibility_0.png"]


# ---- the program -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["scenes", "render", "fit", "report"])
def test_help_has_an_example_that_parses(capsys: pytest.CaptureFixture[str], command: str) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert ended.value.code == 0
    example = capsys.readouterr().out.rpartition("example:\n")[2].split()
    assert example[:2] == ["torch-ssao", command]
    parser.build().parse_args(example[1:])


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--version"])
    assert capsys.readouterr().out == f"torch-ssao {ts.__version__}\n"


def test_python_m_torch_ssao_is_the_command() -> None:
    program = [sys.executable, "-W", "error", "-m", "torch_ssao"]
    done = subprocess.run([*program, "render", "none.ply"], env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "torch-ssao: error: mesh file 'none.ply' does not exist: check the path\n"


def test_run_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["torch-ssao", "paint"])
    with pytest.raises(SystemExit) as ended:
        cli.run()
    assert ended.value.code == 2


def test_a_reader_that_left_is_no_error() -> None:
    reader = subprocess.Popen(["true"], stdin=subprocess.PIPE)
    reader.wait()
    program = [sys.executable, "-m", "torch_ssao", "scenes"]
    done = subprocess.run(program, env=ENVIRONMENT, stdout=reader.stdin, stderr=subprocess.PIPE, text=True)
    reader.communicate()
    assert (done.returncode, done.stderr) == (0, "")
