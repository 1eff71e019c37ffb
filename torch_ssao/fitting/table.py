"""Rows of a choice: how wrong and how slow each candidate is, as records and as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, final

from torch_ssao.fitting.candidates import estimated_cost, technique_of
from torch_ssao.fitting.problem import ViewError
from torch_ssao.fitting.timing import Timing
from torch_ssao.modules import AmbientVisibility


@final
@dataclass(frozen=True, eq=False)
class Row:
    """A candidate, fitted and judged, or the reason why it was not.

    Args:
        name: of the candidate.
        module: fitted; as it was given where there is an `error`.
        validation_rmse: over the judged views. training_rmse: over the fitted views. NaN where there is an `error`.
        views: error of each judged view.
        values, standard_errors, undetermined, evaluations, seconds, message: of the fit, see `FitResult`.
        warm_start: the fitted candidate whose values the fit began with; None for the module's own values and a scan.
        timing: of one judged view; None where there is an `error`.
        error: why the candidate is out of the race, in one line; None for all others.
        is_stored: whether the fit was read from disk and not made now.
    """

    name: str
    module: AmbientVisibility
    validation_rmse: float
    training_rmse: float
    views: tuple[ViewError, ...]
    values: dict[str, float]
    standard_errors: dict[str, float]
    undetermined: tuple[str, ...]
    evaluations: int
    seconds: float
    message: str
    warm_start: str | None = None
    timing: Timing | None = None
    error: str | None = None
    is_stored: bool = False

    @property
    def technique(self) -> str:
        """The module's name in `modules.TECHNIQUES`, or that of its class."""
        return technique_of(self.module)

    @property
    def cost(self) -> float:
        """Estimated, in image reads a pixel: tells two candidates of a technique apart that timing cannot."""
        return estimated_cost(self.module)

    @property
    def ms(self) -> float:
        """Median milliseconds of a forward pass; infinite where there is an `error`."""
        return math.inf if self.timing is None else self.timing.median_ms

    def as_dict(self) -> dict[str, Any]:
        """The row as plain values; what is infinite or NaN as None."""
        numbers = {name: _plain(getattr(self, name)) for name in ("validation_rmse", "training_rmse")}
        return {
            "name": self.name,
            "technique": self.technique,
            **numbers,
            "timing": None if self.timing is None else asdict(self.timing),
            "views": [asdict(view) for view in self.views],
            "choices": self.module.config(),
            "values": self.values,
            "standard_errors": {name: _plain(value) for name, value in self.standard_errors.items()},
            "undetermined": list(self.undetermined),
            "evaluations": self.evaluations,
            "seconds": self.seconds,
            "message": self.message,
            "warm_start": self.warm_start,
            "error": self.error,
        }


def failed(name: str, module: AmbientVisibility, error: BaseException) -> Row:
    """The row of a candidate that raised `error`."""
    lines = str(error).strip().splitlines()
    text = f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
    return Row(name, module, math.nan, math.nan, (), {}, {}, (), 0, 0.0, "", error=text)


@final
@dataclass(frozen=True, eq=False)
class Choice:
    """What `select` found.

    Args:
        best: the row chosen; `best.module` is fitted and ready.
        table: all rows, cheapest first, those that failed last.
        pareto: the rows that no other beats in both validation error and milliseconds, cheapest first.
        reason: why `best` was chosen and why the next cheaper one on the front was not, in sentences.
        reached: whether the target and the budget asked for are met.
        judged_on_training_views: whether no view was left to judge on: the validation errors are then training errors.
        notes: what was left out or went wrong on the way, a sentence each.
    """

    best: Row
    table: tuple[Row, ...]
    pareto: tuple[Row, ...]
    reason: str
    reached: bool
    judged_on_training_views: bool
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n".join((*self._lines(), self.reason, *self.notes))

    def as_dict(self) -> dict[str, Any]:
        """The choice as plain values, for JSON."""
        return {
            "best": self.best.name,
            "reached": self.reached,
            "reason": self.reason,
            "judged_on_training_views": self.judged_on_training_views,
            "pareto": [row.name for row in self.pareto],
            "table": [row.as_dict() for row in self.table],
            "notes": list(self.notes),
        }

    def _lines(self) -> list[str]:
        judged = "training-view RMSE" if self.judged_on_training_views else "validation RMSE"
        head = ("", "candidate", judged, "training RMSE", "ms [quartiles]")
        return aligned([head, *(self._cells(row) for row in self.table)])

    def _cells(self, row: Row) -> tuple[str, ...]:
        mark = ">" if row is self.best else "*" if row in self.pareto else ""
        if row.timing is None:
            return (mark, row.name, f"failed: {row.error}")
        times = f"{row.ms:.2f} [{row.timing.low_ms:.2f}, {row.timing.high_ms:.2f}]"
        return (mark, row.name, f"{row.validation_rmse:.5f}", f"{row.training_rmse:.5f}", times)


def aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Lines with the columns of all full rows aligned; a shorter row's last cell runs on."""
    full = max(map(len, rows))
    widths = [max(len(row[i]) for row in rows if len(row) == full) for i in range(full)]
    for row in rows:
        widths[:2] = [max(width, len(cell)) for width, cell in zip(widths[:2], row, strict=False)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=False)).rstrip() for row in rows]


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
