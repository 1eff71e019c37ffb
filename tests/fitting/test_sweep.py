"""sweep: many scenes in parallel, the same table wherever the fits run."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import joblib
import pytest
import torch

import torch_ssao as ts
from support.choices import bumps, dense_rays, price_list, quick_fit
from torch_ssao import checks
from torch_ssao.fitting import Sweep, candidates, chain, select, sweep

GRID = candidates.statvo(0.5, layers=[1, 2])
FAST = {"max_evaluations": 16}


def problem(view: int, views: int = 2) -> dict[str, Any]:
    """Bumps of a size of their own; made where it is called."""
    gbuffer = bumps(16 + view, 20, views=views)
    return {"gbuffer": gbuffer, "target": dense_rays(gbuffer)}


def recorded(view: int, folder: Path) -> dict[str, Any]:
    """A problem that leaves the number of the process that asked for it."""
    (folder / str(os.getpid())).touch()
    return problem(view)


PROBLEMS = {f"scene {view}": functools.partial(problem, view) for view in range(3)}


def run(problems: Any = PROBLEMS, **options: Any) -> Sweep:
    return sweep(problems, GRID, timer=price_list, fit_options=FAST, **options)


def facts(found: Sweep) -> Any:
    """Everything but the wall times of the fits; values bit for bit."""
    table = [
        (name, {k: v for k, v in row.as_dict().items() if k != "seconds"}, row.module.state_dict())
        for name, row in found.table
    ]
    plain = [(name, facts, [(key, raw.tolist()) for key, raw in state.items()]) for name, facts, state in table]
    return plain, [(name, choice.best.name, choice.reason) for name, choice in found.choices.items()]


@pytest.fixture(scope="module")
def serial() -> Sweep:
    return run()


def test_each_scene_gets_the_choice_that_select_makes(serial: Sweep) -> None:
    assert list(serial.choices) == list(PROBLEMS)
    assert len(serial.table) == 6
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    alone = select(GRID, **problem(1), timer=price_list, fit_options=FAST)
    torch.set_num_threads(threads)
    assert [row.values for row in serial.choices["scene 1"].table] == [row.values for row in alone.table]
    assert serial.choices["scene 1"].reason == alone.reason
    assert sum(serial.chosen.values()) == 3
    assert "scene 2" in str(serial)
    assert all(f"{name} {count}" in str(serial).splitlines()[-1] for name, count in serial.chosen.items())


def test_a_dask_cluster_gives_the_same_table(serial: Sweep, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster),
        joblib.parallel_config(backend="dask"),
    ):
        assert facts(run({name: functools.partial(recorded, i, tmp_path) for i, name in enumerate(PROBLEMS)})) == facts(
            serial
        )
    workers = {int(path.name) for path in tmp_path.iterdir()}
    assert workers
    assert os.getpid() not in workers


@pytest.mark.slow
def test_processes_give_the_same_table(serial: Sweep) -> None:
    assert facts(run(n_jobs=2)) == facts(serial)


def test_threads_give_the_same_table(serial: Sweep) -> None:
    with joblib.parallel_config(backend="threading", n_jobs=2):
        assert facts(run()) == facts(serial)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chain, "fit", quick_fit)


def test_pairs_mappings_and_candidates_of_their_own(quick: None) -> None:
    gbuffer = bumps(16, 20, views=3)
    truth = dense_rays(gbuffer)
    given = {
        "pair": (gbuffer, truth),
        "mapping": {"gbuffer": gbuffer, "target": truth, "validation": [0], "candidates": [ts.HBAO(0.5, slices=1)]},
    }
    found = run(given)
    assert {row.technique for name, row in found.table if name == "pair"} == {"statvo"}
    assert {row.technique for name, row in found.table if name == "mapping"} == {"hbao"}
    assert [view.view for view in found.choices["mapping"].best.views] == ["view 0"]


def test_a_scene_that_cannot_be_used_has_an_error_and_the_rest_go_on(quick: None) -> None:
    gbuffer = bumps(16, 20, views=2)
    truth = dense_rays(gbuffer)
    found = run({"nan": (gbuffer, truth * torch.nan), "good": (gbuffer, truth), "broken": lambda: 1 / 0})
    assert list(found.choices) == ["good"]
    assert "got 320 pixels of view 0" in found.errors["nan"]
    assert found.errors["broken"] == "ZeroDivisionError: division by zero"
    assert "nan: failed: RangeError: target must be finite" in str(found)
    with pytest.raises(checks.RangeError, match="problems must hold one that can be fitted, got 1 that fail, nan with"):
        run({"nan": (gbuffer, truth * torch.nan)})


def test_scenes_judged_on_their_training_view_say_so(quick: None) -> None:
    found = run({"one": problem(0, views=1)})
    assert "(training view)" in str(found)
    assert found.as_dict()["choices"]["one"]["judged_on_training_views"] is True


def test_an_interrupted_sweep_keeps_what_is_done(tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = 0

    def fit(*arguments: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 4:
            raise KeyboardInterrupt
        return quick_fit(*arguments, **options)

    fit.__wrapped__ = quick_fit  # type: ignore[attr-defined]
    monkeypatch.setattr(chain, "fit", fit)
    with pytest.raises(
        KeyboardInterrupt, match=r"after 1 of 3 scenes; those done are kept in .*: the same call goes on"
    ):
        run(folder=tmp_path)
    assert len(list(tmp_path.rglob("*.json"))) == 3
    again = run(folder=tmp_path)
    assert calls == 4 + 3
    assert facts(again) == facts(run())


def test_each_scene_has_a_folder(tmp_path: Path, quick: None) -> None:
    run({"../a b": problem(0)}, folder=tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["-a-b"]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"problems": {}}, checks.ChoiceError, "problems must be a mapping"),
        ({"problems": [1]}, checks.ChoiceError, "problems must be a mapping"),
        ({"problems": {"a": 3}}, checks.ChoiceError, r"problems\['a'\] must be \(gbuffer, target\)"),
        ({"problems": {"a": {"gbuffer": 1, "image": 2}}}, checks.ChoiceError, r"problems\['a'\] must be one of"),
        (
            {"candidates": None, "problems": {"a": (1, 2)}},
            checks.ChoiceError,
            "candidates must be given, got none for 'a'",
        ),
        ({"threads": 0}, checks.RangeError, "threads must be a whole number at least 1"),
        ({"target_rmse": -1}, checks.RangeError, "target_rmse must be finite"),
        ({"fit_options": {"scan": True}}, checks.ChoiceError, "fit_options must be one of"),
    ],
)
def test_bad_input(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    call = {"problems": {"a": (1, 2)}, "candidates": GRID} | arguments
    with pytest.raises(error, match=message) as caught:
        sweep(call.pop("problems"), call.pop("candidates"), **call)
    assert "\n" not in str(caught.value)


def test_a_missing_joblib_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "joblib", None)
    with pytest.raises(checks.MissingExtraError, match=r"pip install torch_ssao\[fitting\]"):
        run()


def test_importing_fitting_loads_no_library_of_the_extras() -> None:
    code = (
        "import torch_ssao.fitting, sys; "
        "print([m for m in ('joblib', 'dask', 'distributed', 'jax', 'optimistix') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
