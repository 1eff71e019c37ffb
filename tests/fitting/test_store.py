"""Fitted candidates on disk: a run goes on where it stopped, and trusts nothing that is not its own."""

from __future__ import annotations

import contextlib
import errno
import functools
import json
import math
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest
import torch

import torch_ssao as ts
from support.choices import bumps, dense_rays, price_list, quick_fit
from torch_ssao import checks
from torch_ssao.fitting import Choice, Prior, chain, select, store


class Counter:
    """`quick_fit`, counting, and failing from the given call on."""

    def __init__(self) -> None:
        self.calls = 0
        self.fail_at = math.inf
        self.failure: BaseException = KeyboardInterrupt()

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        self.calls += 1
        if self.calls >= self.fail_at:
            raise self.failure
        return quick_fit(*arguments, **options)

    __wrapped__ = quick_fit


@pytest.fixture
def counter(monkeypatch: pytest.MonkeyPatch) -> Counter:
    made = Counter()
    monkeypatch.setattr(chain, "fit", made)
    return made


GB = bumps(16, 20, views=2)
TRUTH = dense_rays(GB)
GRID = {
    "one": ts.StatVO(0.5, layers=1),
    "two": ts.StatVO(0.5, layers=2),
    "rays": ts.RayMarchedSSAO(0.5, rays=2, steps=2),
}


def run(folder: Path | None, grid: Any = GRID, target: torch.Tensor = TRUTH, **options: Any) -> Choice:
    return select(grid, GB, target, folder=folder, timer=price_list, **options)


def facts(choice: Choice) -> Any:
    """All but the wall time."""
    rows = [{k: v for k, v in row.as_dict().items() if k != "seconds"} for row in choice.table]
    raw = [[(n, t.tolist()) for n, t in row.module.state_dict().items()] for row in choice.table]
    return rows, raw, choice.best.name, choice.reason


def test_a_second_run_fits_nothing_and_says_the_same(tmp_path: Path, counter: Counter) -> None:
    first = run(tmp_path)
    assert counter.calls == 3
    assert len(list(tmp_path.glob("*.json"))) == 3
    second = run(tmp_path)
    assert counter.calls == 3
    assert facts(second) == facts(first)
    assert [row.is_stored for row in second.table] == [True] * 3
    assert facts(run(None)) == facts(first)
    images = (choice.best.module(GB) for choice in (first, second))
    assert torch.equal(*images)


def test_interrupted_runs_keep_what_is_done_and_go_on(tmp_path: Path, counter: Counter) -> None:
    counter.fail_at = 3
    with pytest.raises(KeyboardInterrupt) as caught:
        run(tmp_path)
    text = str(caught.value)
    assert "after 2 of 3 candidates" in text
    assert f"kept in {tmp_path}" in text
    assert "goes on from there" in text
    assert "\n" not in text
    counter.fail_at = math.inf
    counter.calls = 0
    resumed = run(tmp_path)
    assert counter.calls == 1
    assert facts(resumed) == facts(run(None))
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("disguise", [False, True])
def test_an_interrupt_that_a_library_swallows_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disguise: bool
) -> None:
    @functools.wraps(quick_fit)
    def swallowing(*arguments: Any, **options: Any) -> Any:
        with contextlib.suppress(KeyboardInterrupt):  # as the garbage collector does with those in its callbacks
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        if disguise:
            raise RuntimeError("the solver was interrupted")
        return quick_fit(*arguments, **options)

    monkeypatch.setattr(chain, "fit", swallowing)
    inherited = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # shells start background jobs with SIGINT ignored
    try:
        with pytest.raises(KeyboardInterrupt, match=f"after {0 if disguise else 1} of 3 candidates"):
            run(tmp_path)
        assert len(list(tmp_path.iterdir())) == (0 if disguise else 1)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, inherited)


def test_an_interruption_without_a_folder_says_that_nothing_is_kept(counter: Counter) -> None:
    counter.fail_at = 2
    with pytest.raises(KeyboardInterrupt, match="after 1 of 3 candidates; none is kept: pass folder"):
        run(None)


@pytest.mark.parametrize(
    "damage", ["truncated", "foreign", "empty", "binary", "edited", "other_key", "list", "lacking"]
)
def test_a_file_that_is_not_whole_is_made_anew(tmp_path: Path, counter: Counter, damage: str) -> None:
    first = run(tmp_path)
    (path,) = tmp_path.glob("two_*.json")
    text = path.read_text()
    record = json.loads(text)
    if damage == "edited":
        record["content"]["validation_rmse"] = 1e-9
    elif damage == "other_key":
        record["key"] = record["key"][::-1]
    elif damage == "lacking":
        del record["content"]["raw"]
        record["sha256"] = store._checksum(record["content"])
    spoiled = {
        "truncated": text[: len(text) // 2].encode(),
        "foreign": b'{"format": "something else"}',
        "empty": b"",
        "binary": bytes(range(128, 256)),
        "list": b"[1, 2]",
    }
    path.write_bytes(spoiled.get(damage, json.dumps(record).encode()))
    counter.calls = 0
    assert facts(run(tmp_path)) == facts(first)
    assert counter.calls == 1
    assert json.loads(path.read_text())["content"] | {"seconds": 0} == json.loads(text)["content"] | {"seconds": 0}


def test_other_data_options_or_values_are_fitted_anew(tmp_path: Path, counter: Counter) -> None:
    grid = {"one": ts.StatVO(0.5, layers=1)}
    run(tmp_path, grid)
    moved = TRUTH.clone()
    moved[1, 0, 3, 4] -= 1e-3  # a single pixel of a held-out view
    for change in (
        {"target": moved},
        {"parameters": "contrast"},
        {"fit_options": {"max_evaluations": 50}},
        {"fit_options": {"priors": {"height": Prior(1.0)}}},
        {"fit_options": {"priors": {"height": Prior(1.5)}}},
        {"validation": [0]},
        {"weights": 2 * torch.ones_like(TRUTH)},
        {"grid": {"one": ts.StatVO(0.6, layers=1)}},
        {"grid": {"one": ts.StatVO(0.5, layers=1).double()}},
        {"grid": {"one": ts.StatVO(0.5, layers=1, learnable="all")}},
    ):
        before = counter.calls
        run(tmp_path, change.pop("grid", grid), **change)
        assert counter.calls == before + 1, change
    run(tmp_path, grid)
    assert counter.calls == before + 1


def test_a_full_disk_is_told_once_and_the_run_goes_on(
    tmp_path: Path, counter: Counter, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: Path, *arguments: Any, **options: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    expected = facts(run(None))
    monkeypatch.setattr(Path, "write_text", full)
    choice = run(tmp_path)
    assert facts(choice) == expected
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "the disk is full" in said
    assert str(tmp_path) in said
    assert choice.notes == (said.strip(),)
    assert list(tmp_path.iterdir()) == []


def test_failures_are_not_kept(tmp_path: Path, counter: Counter) -> None:
    counter.fail_at, counter.failure = 2, MemoryError("planted")
    choice = run(tmp_path)
    assert [row.error for row in choice.table].count("MemoryError: planted") == 2
    counter.fail_at = math.inf
    assert [row.error for row in run(tmp_path).table] == [None] * 3


def test_parameters_that_are_off_come_back_off(tmp_path: Path, counter: Counter) -> None:
    grid = {"off": ts.HBAO(0.5, slices=1, steps=2, thickness=None, bias_deg=0.0)}
    first = run(tmp_path, grid)
    second = run(tmp_path, grid)
    assert counter.calls == 1
    assert repr(second.best.module) == repr(first.best.module)
    assert second.best.standard_errors == first.best.standard_errors


def test_a_function_among_the_options_cannot_be_kept(tmp_path: Path, counter: Counter) -> None:
    with pytest.raises(checks.ChoiceError, match="fit_options must be plain values where results are stored"):
        run(tmp_path, fit_options={"loss": lambda *images: images[0].mean()})
    assert counter.calls == 0


def test_a_folder_that_cannot_be_written(tmp_path: Path, counter: Counter) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(checks.OutputError, match="folder"):
        run(tmp_path / "file")
    assert counter.calls == 0
