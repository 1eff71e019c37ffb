"""`select` for many scenes, on many cores or machines."""

from __future__ import annotations

import re
import threading
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import torch

from torch_ssao import checks
from torch_ssao.fitting.candidates import as_candidates
from torch_ssao.fitting.chain import FitPlan, fit_chain
from torch_ssao.fitting.problem import Problem
from torch_ssao.fitting.select import Bar, check_wishes, choice_of, interrupted, timed
from torch_ssao.fitting.store import Store
from torch_ssao.fitting.table import Choice, Row, aligned, one_line
from torch_ssao.fitting.timing import Timer, time_forward
from torch_ssao.gbuffer import GBuffer

ARGUMENTS = ("gbuffer", "target", "validation", "weights", "valid", "candidates")
"""What a problem may give: arguments of `select`."""
_ONE_AT_A_TIME = threading.Lock()
"""Levels of forward-mode differentiation belong to the process: fits in two threads of one spoil each other's numbers."""


@final
@dataclass(frozen=True, eq=False)
class Sweep:
    """What `sweep` found.

    Args:
        choices: by scene, in the order of the problems.
        errors: why the other scenes have none, a line each.
    """

    choices: dict[str, Choice]
    errors: dict[str, str]

    @property
    def table(self) -> tuple[tuple[str, Row], ...]:
        """Scene and row of every candidate of every scene."""
        return tuple((name, row) for name, choice in self.choices.items() for row in choice.table)

    @property
    def chosen(self) -> dict[str, int]:
        """How many scenes each candidate was chosen for, the most frequent first."""
        return dict(Counter(choice.best.name for choice in self.choices.values()).most_common())

    def __str__(self) -> str:
        lines = [("scene", "chosen", "validation RMSE", "training RMSE", "ms", "asked for")]
        for name, choice in self.choices.items():
            best = choice.best
            judged = f"{best.validation_rmse:.5f}" + (" (training view)" if choice.judged_on_training_views else "")
            met = "met" if choice.reached else "not met"
            lines.append((name, best.name, judged, f"{best.training_rmse:.5f}", f"{best.ms:.2f}", met))
        failures = [f"{name}: failed: {error}" for name, error in self.errors.items()]
        counts = ", ".join(f"{name} {count}" for name, count in self.chosen.items())
        return "\n".join((*aligned(lines), *failures, f"Chosen: {counts}."))

    def as_dict(self) -> dict[str, Any]:
        """The sweep as plain values, for JSON."""
        choices = {name: choice.as_dict() for name, choice in self.choices.items()}
        return {"choices": choices, "errors": self.errors}


def sweep(
    problems: Mapping[str, Any],
    candidates: Any = None,
    *,
    target_rmse: float | None = None,
    budget_ms: float | None = None,
    parameters: str | tuple[str, ...] | None = None,
    fit_options: Mapping[str, Any] | None = None,
    warm_start: bool = True,
    folder: str | Path | None = None,
    timer: Timer = time_forward,
    n_jobs: int | None = None,
    backend: str | None = None,
    threads: int = 1,
    progress: bool | None = None,
) -> Sweep:
    """Choose a candidate for each of many scenes, fits in parallel.

    Every scene is a task of its own for `joblib.Parallel`: inside `with joblib.parallel_config(backend="dask"):` (or "ray", or
    any other backend) tasks go to that cluster. Timings are taken afterwards, one after the other, in the calling process:
    beside other work they would be noise. The result does not depend on where the fits ran.

    Args:
        problems: by scene (gbuffer, target), or a mapping with these and `validation`, `weights`, `valid`, `candidates` as in
            `select`; or a function without arguments that returns one of both, called in the worker: so a thousand scenes
            are rendered where they are fitted and not sent there. A function must be picklable.
        candidates: as in `select`, for every problem that does not bring its own.
        target_rmse, budget_ms, parameters, fit_options, warm_start, timer: as in `select`, for every scene.
        folder: where fitted candidates are kept, a folder for each scene in it; on a cluster, one that all machines see.
        n_jobs: tasks at a time, each in a process of its own; None for what `joblib.parallel_config` says, or else 1; -1 for all
            cores. Threads of one process take turns and gain nothing: on a cluster, start workers with one thread each.
        backend: of joblib; None for what `joblib.parallel_config` says, or else processes.
        threads: of torch in each task. Sums depend on it in their last digits, hence 1 everywhere, whatever the machine.
        progress: show a bar over scenes on stderr; None for only when that is a terminal.
    Returns: a Sweep. A scene whose data cannot be used has an error, and the rest go on.
    Raises: ChoiceError, RangeError, ShapeError for arguments that cannot be; RangeError when every scene fails; MissingExtraError
        without optimistix or joblib; KeyboardInterrupt with a line on what was kept.
    Cost: that of `select` a scene, divided by the number of workers; timing is not divided.
    """
    given = _check(problems, candidates, threads)
    check_wishes(target_rmse, budget_ms)
    store = Store(folder)
    options = _Options(parameters, dict(fit_options or {}), warm_start, threads)
    shared = None if candidates is None else as_candidates(candidates)
    if shared is not None:
        FitPlan.of(shared, parameters, fit_options, warm_start, folder)  # told now, not once a scene
    tasks = [(name, problem, shared, options, _folder_of(store, name)) for name, problem in given.items()]
    found: dict[str, _Fitted] = {}
    try:
        running = _parallel(tasks, n_jobs, backend)
        with Bar("scenes", len(tasks), "scene", progress) as bar, closing(running):  # an interrupt ends the tasks left
            for name, fitted in running:
                found[name] = fitted
                bar.update(name)
        return _conclude({name: found[name] for name in given}, target_rmse, budget_ms, timer)
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(interrupted(len(found), len(tasks), "scenes", store)) from error


@final
@dataclass(frozen=True)
class _Options:
    """What is the same for all scenes."""

    parameters: str | tuple[str, ...] | None
    fit_options: Mapping[str, Any]
    warm_start: bool
    threads: int


@final
@dataclass(frozen=True, eq=False)
class _Fitted:
    """What a task sends back: rows without timings, the view to time, or the error of the scene."""

    rows: list[Row]
    view: GBuffer | None
    on_training: bool
    notes: tuple[str, ...]
    error: str | None = None


def fit_scene(name: str, problem: Any, shared: Any, options: _Options, folder: Path | None) -> tuple[str, _Fitted]:
    """One task: fit and judge all candidates of a scene."""
    with _ONE_AT_A_TIME, _torch_threads(options.threads):
        try:
            arguments = _arguments(name, problem() if callable(problem) else problem)
            own = arguments.pop("candidates", None)
            candidates = shared if own is None else as_candidates(own)
            if candidates is None:
                raise checks.ChoiceError(f"candidates must be given, got none for {name!r}: pass candidates")
            checked = Problem.of(arguments.pop("gbuffer"), arguments.pop("target"), **arguments)
            plan = FitPlan.of(candidates, options.parameters, options.fit_options, options.warm_start, folder)
            store = Store(folder)
            rows = fit_chain(candidates, checked, plan, store)
        except checks.MissingExtraError:
            raise
        except Exception as error:
            return name, _Fitted([], None, False, (), one_line(error))
    notes = (*checked.notes, *store.notes)
    return name, _Fitted(rows, checked.validation[0].gbuffer, checked.judged_on_training_views, notes)


def _parallel(
    tasks: Sequence[Any], n_jobs: int | None, backend: str | None
) -> Generator[tuple[str, _Fitted], None, None]:
    """Results in the order in which they are done."""
    try:
        import joblib
    except ImportError as error:
        raise checks.MissingExtraError(
            "sweep needs joblib, which is not installed: run pip install torch_ssao[fitting]"
        ) from error
    options = {} if backend is None else {"backend": backend}
    parallel = joblib.Parallel(n_jobs=n_jobs, return_as="generator_unordered", batch_size=1, **options)
    yield from parallel(joblib.delayed(fit_scene)(*task) for task in tasks)


def _conclude(found: Mapping[str, _Fitted], target_rmse: float | None, budget_ms: float | None, timer: Timer) -> Sweep:
    """Timings, one scene after the other, and choices."""
    choices: dict[str, Choice] = {}
    errors: dict[str, str] = {}
    for name, fitted in found.items():
        if fitted.error is not None or fitted.view is None:
            errors[name] = fitted.error or "nothing came back"
            continue
        rows = timed(fitted.rows, fitted.view, timer)
        try:
            choices[name] = choice_of(rows, target_rmse, budget_ms, on_training=fitted.on_training, notes=fitted.notes)
        except checks.RangeError as error:  # all candidates failed
            errors[name] = str(error)
    if not choices:
        first = next(iter(errors))
        raise checks.RangeError(
            f"problems must hold one that can be fitted, got {len(errors)} that fail, {first} with {errors[first]}"
        )
    return Sweep(choices, errors)


def _check(problems: Any, candidates: Any, threads: int) -> dict[str, Any]:
    checks.check_count("threads", threads, 1)
    if not isinstance(problems, Mapping) or not problems:
        raise checks.ChoiceError(
            f"problems must be a mapping from names to (gbuffer, target), got {type(problems).__name__}: name the scenes"
        )
    given = {str(name): problem for name, problem in problems.items()}
    for name, problem in given.items():
        if callable(problem):
            continue  # looked at in the worker
        arguments = _arguments(name, problem)
        if candidates is None and arguments.get("candidates") is None:
            raise checks.ChoiceError(f"candidates must be given, got none for {name!r}: pass candidates")
    return given


def _arguments(name: str, problem: Any) -> dict[str, Any]:
    """A problem as arguments of `select`."""
    if isinstance(problem, Mapping):
        for argument in problem:
            checks.check_choice(f"problems[{name!r}]", argument, ARGUMENTS)
        found = dict(problem)
    else:
        pair = isinstance(problem, tuple | list) and len(problem) == 2
        found = dict(zip(("gbuffer", "target"), problem, strict=True)) if pair else {}
    if "gbuffer" not in found or "target" not in found:
        raise checks.ChoiceError(
            f"problems[{name!r}] must be (gbuffer, target) or a mapping with both, got {type(problem).__name__}: pass a pair"
        )
    return found


def _folder_of(store: Store, name: str) -> Path | None:
    return None if store.folder is None else store.folder / re.sub(r"[^A-Za-z0-9_.+-]", "-", name).lstrip(".")[:80]


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
