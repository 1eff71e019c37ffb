"""Fits of all candidates and the choice among them, by `fitting.select`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from torch_ssao.fitting.candidates import COUNTS
from torch_ssao.fitting.timing import Timing, time_forward
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report.candidates import TITLES
from torch_ssao.report.rows import FitSummary
from torch_ssao.report.truth import Truth


@final
@dataclass(frozen=True)
class Wish:
    """What a choice is asked for: see `fitting.select`."""

    target_rmse: float | None = None
    budget_ms: float | None = None


@final
@dataclass(frozen=True)
class Chosen:
    """The fitted module that was chosen.

    Args:
        name: of its row. label: technique and counts, for people.
        reached: whether it does what was asked.
        reason: why it was chosen and why the next cheaper one was not.
        target_rmse, budget_ms: what was asked.
        notes: what failed or was left out, a sentence each.
    """

    name: str
    label: str
    reached: bool
    reason: str
    target_rmse: float | None
    budget_ms: float | None
    notes: tuple[str, ...]


@final
@dataclass(frozen=True, eq=False)
class Fitted:
    """One candidate, before and after its fit."""

    untuned: AmbientVisibility
    module: AmbientVisibility
    untuned_timing: Timing
    timing: Timing
    summary: FitSummary


def fit_and_choose(
    modules: Mapping[str, AmbientVisibility],
    gbuffer: GBuffer,
    truth: Truth,
    training: Sequence[int],
    validation: Sequence[int],
    wish: Wish,
    *,
    folder: Path,
    repeats: int,
    options: Mapping[str, Any],
) -> tuple[dict[str, Fitted], Chosen]:
    """Fit, judge and time all modules, and choose one.

    Args:
        modules: by name, with the values to start from.
        gbuffer, truth: all views. training, validation: rows of them, the same ones where none is left to judge on.
        wish: what is asked for.
        folder: where each fitted module is kept; the next run goes on from there.
        repeats: timed passes of each module, untuned and fitted ones in turns.
        options: further arguments of `fitting.select`.
    Returns: what was fitted, by name, and the choice. A module that fails is a note of the choice.
    Raises: as `fitting.select`.
    """
    from torch_ssao import fitting

    untuned: list[Timing] = []

    def timer(fitted: Sequence[AmbientVisibility], view: GBuffer) -> list[Timing]:
        """All in turns, so that a machine that slows down slows all of them."""
        found = time_forward([*fitted, *modules.values()], view, repeats=repeats)
        untuned[:] = found[len(fitted) :]
        return found[: len(fitted)]

    flattered = set(validation) <= set(training)  # then what is fitted is judged
    rows = list(training) if flattered else [*training, *validation]
    views, target = gbuffer[rows], truth[rows]
    held: Any = (views, target) if flattered else range(len(training), len(rows))
    choice = fitting.select(
        modules,
        views,
        target,
        target_rmse=wish.target_rmse,
        budget_ms=wish.budget_ms,
        validation=held,
        valid=target.valid,
        folder=folder,
        timer=timer,
        **options,
    )
    before = dict(zip(modules, untuned, strict=True))
    made = {
        row.name: Fitted(modules[row.name], row.module, before[row.name], row.timing, _summary(row))
        for row in choice.table
        if row.timing is not None
    }
    failed = tuple(f"{row.name} was left out: {row.error}." for row in choice.table if row.timing is None)
    reason = choice.reason.replace("validation RMSE", "training-view RMSE") if flattered else choice.reason
    label = describe(choice.best.module, choice.best.technique)
    notes = (*choice.notes, *failed)
    return made, Chosen(choice.best.name, label, choice.reached, reason, wish.target_rmse, wish.budget_ms, notes)


def describe(module: AmbientVisibility, technique: str) -> str:
    """A technique with its counts: "HBAO, 3 slices, 6 steps"."""
    counts = [(getattr(module, name), name) for name in COUNTS.get(technique, ())]
    words = [f"{count} {name[:-1] if count == 1 else name}" for count, name in counts]
    return ", ".join((TITLES.get(technique, technique), *words))


def _summary(row: Any) -> FitSummary:
    return FitSummary(dict(row.standard_errors), tuple(row.undetermined), row.evaluations, row.seconds, row.message)
