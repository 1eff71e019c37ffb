"""Which technique, with how many layers or taps, is the cheapest that is good enough."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

from torch_ssao import checks
from torch_ssao.fitting.candidates import as_candidates
from torch_ssao.fitting.chain import FitPlan, fit_chain
from torch_ssao.fitting.pareto import decide, pareto_front
from torch_ssao.fitting.problem import Problem
from torch_ssao.fitting.store import Store
from torch_ssao.fitting.table import Choice, Row, failed
from torch_ssao.fitting.timing import Timer, Timing, time_forward
from torch_ssao.gbuffer import GBuffer


def select(
    candidates: Any,
    gbuffer: GBuffer | Sequence[GBuffer],
    target: Any,
    *,
    target_rmse: float | None = None,
    budget_ms: float | None = None,
    validation: Any = None,
    parameters: str | tuple[str, ...] | None = None,
    weights: Any = None,
    valid: Any = None,
    fit_options: Mapping[str, Any] | None = None,
    warm_start: bool = True,
    folder: str | Path | None = None,
    timer: Timer = time_forward,
    progress: bool | None = None,
) -> Choice:
    """Fit every candidate, judge it on held-out views, time it, and choose.

    Chosen is, with `target_rmse`, the cheapest candidate within it; with `budget_ms`, the one of least validation error within
    that; with both, the cheapest within both; with neither, the cheapest whose validation error is within one standard error
    of the least (of the paired differences of the views' squared errors), or within 2 % of it. Cheapest means fewest
    milliseconds, or the smaller model of one technique where timing cannot tell. Where none does what was asked, the best is
    returned with `.reached` False, and `.reason` says so first.

    Args:
        candidates: modules, or what `fitting.candidates` makes, in a sequence; or modules by name in a mapping. They are copied.
        gbuffer: B views, or a sequence of G-buffers, one a scene; views are numbered through all of them.
        target: as in `fit`: (B, 1, H, W) visibility, or an object with `.visibility` and `.standard_error`; a sequence where
            `gbuffer` is one.
        target_rmse: validation RMSE that is good enough, > 0.
        budget_ms: median milliseconds of a forward pass of one view, > 0.
        validation: numbers of the views to hold out; or (gbuffer, target), and then all views of `gbuffer` are fitted; None
            holds out the last half. A single view is fitted and judged, and everything printed says so.
        parameters: names to fit, of each technique those that it uses; None for the modules' own lists, as in `fit`.
        weights: (B, 1, H, W) >= 0, importance of each pixel, in fit and judgement; None for all alike. A sequence like `gbuffer`.
        valid: (B, 1, H, W) bool, further pixels to leave out; invalid pixels of the G-buffer never count. Likewise.
        fit_options: further arguments of `fit`, such as `max_evaluations`.
        warm_start: whether a candidate's fit begins, without a scan, from the values of the fitted candidate of its technique
            that is nearest in counts, the cheapest of several. It is then never worse on the training views than with these
            values. False fits each from its own values with a scan.
        folder: where each fitted candidate is kept as soon as it is done; the next run with the same data and options goes on
            from there. None keeps nothing. Timings are always taken anew.
        timer: from modules and one view to a `Timing` of each; the default takes 7 forward passes of each in turn.
        progress: show a bar on stderr; None for only when that is a terminal.
    Returns: a Choice. A candidate that fails is a row with its error; views without a valid pixel are left out with a note.
    Raises: ShapeError, DtypeError, ChoiceError for arguments that do not fit together; RangeError for a target that is not
        finite, no view with a valid pixel, and when every candidate fails; MissingExtraError without optimistix; OutputError for
        a folder that cannot be written; KeyboardInterrupt with a line on what was kept.
    Cost: one `fit` a candidate, and 8 forward passes of one view; with `warm_start` a fit is shorter.
    """
    chosen = as_candidates(candidates)
    check_wishes(target_rmse, budget_ms)
    problem = Problem.of(gbuffer, target, validation=validation, weights=weights, valid=valid)
    plan = FitPlan.of(chosen, parameters, fit_options, warm_start, folder)
    store = Store(folder)
    done: list[Row] = []
    try:
        with Bar("fitting", len(chosen), "candidate", progress) as bar:

            def finished(row: Row) -> None:
                done.append(row)
                bar.update(row.name)

            rows = fit_chain(chosen, problem, plan, store, finished)
        rows = timed(rows, problem, timer)
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(interrupted(len(done), len(chosen), "candidates", store)) from error
    return choice_of(rows, problem, target_rmse, budget_ms, (*problem.notes, *store.notes))


def check_wishes(target_rmse: float | None, budget_ms: float | None) -> None:
    """Raise `RangeError` for a target or a budget that cannot be."""
    for name, value in (("target_rmse", target_rmse), ("budget_ms", budget_ms)):
        if value is not None:
            checks.check_positive(name, value)


def timed(rows: Sequence[Row], problem: Problem, timer: Timer) -> list[Row]:
    """The rows with timings on the first judged view; one that fails there gets an `error`."""
    view = problem.validation[0].gbuffer
    alive = [row for row in rows if row.error is None]
    found: dict[str, Timing | Exception] = {}
    try:
        timings = list(timer([row.module for row in alive], view)) if alive else []
        found = dict(zip((row.name for row in alive), timings, strict=True))
    except Exception:  # whose fault is it?
        for row in alive:
            try:
                (found[row.name],) = timer([row.module], view)
            except Exception as error:
                found[row.name] = error
    return [_with_timing(row, found.get(row.name)) for row in rows]


def choice_of(
    rows: Sequence[Row],
    problem: Problem,
    target_rmse: float | None,
    budget_ms: float | None,
    notes: tuple[str, ...],
) -> Choice:
    """The choice among timed rows.

    Raises: RangeError when all have an `error`.
    """
    if all(row.error is not None for row in rows):
        first = rows[0]
        raise checks.RangeError(
            f"candidates must hold one that can be fitted, got {len(rows)} that fail, {first.name} with {first.error}: mend or "
            f"replace them"
        )
    on_training = problem.judged_on_training_views
    judged = "RMSE on its training view" if on_training else "validation RMSE"
    decision = decide(rows, target_rmse=target_rmse, budget_ms=budget_ms, judged=judged)
    if on_training:
        notes = (
            *notes,
            "There is one view only: candidates are judged on the view they were fitted to, which flatters them.",
        )
    return Choice(
        best=decision.best,
        table=tuple(sorted(rows, key=lambda row: (row.error is not None, row.ms))),
        pareto=pareto_front(rows),
        reason=decision.reason,
        reached=decision.reached,
        judged_on_training_views=on_training,
        notes=notes,
    )


def interrupted(done: int, count: int, what: str, store: Store) -> str:
    """What a `KeyboardInterrupt` says."""
    if store.folder is None or store.notes:
        return f"Interrupted after {done} of {count} {what}; none is kept: pass folder to keep them the next time."
    return f"Interrupted after {done} of {count} {what}; those done are kept in {store.folder}: the same call goes on from there."


@final
class Bar:
    """tqdm's bar, or nothing.

    Args:
        title, total, unit: what is counted.
        progress: None shows the bar only where stderr is a terminal.
    """

    def __init__(self, title: str, total: int, unit: str, progress: bool | None) -> None:
        self._bar: Any = None
        if sys.stderr.isatty() if progress is None else progress:
            from tqdm import tqdm

            self._bar = tqdm(total=total, desc=title, unit=unit, file=sys.stderr)

    def update(self, name: str) -> None:
        """One more is done."""
        if self._bar is not None:
            self._bar.set_postfix_str(name, refresh=False)
            self._bar.update()

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()


def _with_timing(row: Row, timing: Timing | Exception | None) -> Row:
    if isinstance(timing, Exception):
        return failed(row.name, row.module, timing)
    return replace(row, timing=timing)
