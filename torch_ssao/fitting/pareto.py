"""The rules by which one of several fitted candidates is chosen, and the sentences that say so."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from torch_ssao.fitting.table import Row

SMALLEST_DIFFERENCE = 0.02
"""Part of the best RMSE below which a difference decides nothing, however sure it is: nobody sees it."""


@final
@dataclass(frozen=True, eq=False)
class Decision:
    """The row chosen, whether it does what was asked, and why it was chosen."""

    best: Row
    reached: bool
    reason: str


def pareto_front(rows: Sequence[Row]) -> tuple[Row, ...]:
    """The rows that no other beats in both validation error and milliseconds, cheapest first; of equals the first.

    Args:
        rows: those with an `error` are passed over.
    """
    front: list[Row] = []
    for row in sorted(_timed(rows), key=lambda row: (row.ms, row.validation_rmse)):
        if not front or row.validation_rmse < front[-1].validation_rmse:
            front.append(row)
    return tuple(front)


def decide(rows: Sequence[Row], *, target_rmse: float | None, budget_ms: float | None, judged: str) -> Decision:
    """Choose.

    - A target alone: the cheapest row within it.
    - A budget alone: the row of least error within it.
    - Both: the cheapest row within both.
    - Neither: the cheapest row whose error is within `allowance` of the least.
    Where none does what was asked: within the budget the row of least error, or else the fastest of all.

    Args:
        rows: at least one without an `error`.
        target_rmse: validation RMSE. budget_ms: median milliseconds.
        judged: what the error is called, such as "validation RMSE".
    """
    timed = _timed(rows)
    within = [row for row in timed if budget_ms is None or row.ms <= budget_ms]
    text = _Text(timed, judged, target_rmse, budget_ms)
    if not within:
        best = min(timed, key=lambda row: (row.ms, row.validation_rmse))
        return Decision(best, False, text.no_budget(best))
    least = min(within, key=lambda row: (row.validation_rmse, row.ms))
    if target_rmse is not None:
        good = [row for row in within if row.validation_rmse <= target_rmse]
        if not good:
            return Decision(least, False, text.no_target(least))
        return text.decision(cheapest(good))
    if budget_ms is not None:
        return text.decision(least)
    good = [row for row in within if row.validation_rmse - least.validation_rmse <= allowance(row, least)]
    return text.decision(cheapest(good), least)


def cheapest(rows: Sequence[Row]) -> Row:
    """The fastest row; where timing cannot tell others of its technique from it, the one of least estimated cost.

    Not told apart are rows whose lower quartile is not above the fastest one's upper quartile: noise must not pick eight
    layers where one takes as long.
    """
    fastest = min(rows, key=lambda row: (row.ms, row.cost, row.validation_rmse))
    if fastest.timing is None:
        return fastest
    limit, technique = fastest.timing.high_ms, fastest.technique
    tied = [row for row in rows if row.technique == technique and row.timing is not None and row.timing.low_ms <= limit]
    return min(tied, key=lambda row: (row.cost, row.validation_rmse, row.ms))


def allowance(row: Row, best: Row) -> float:
    """How much larger a row's RMSE may be than the least one and still count as equal.

    Returns: one standard error of the difference, from the paired differences of the squared error of each view, but at least
        `SMALLEST_DIFFERENCE` of the least RMSE. With one view there is no standard error.
    Source: the one-standard-error rule of Breiman et al. 1984, with paired differences: views differ far more than candidates.
    """
    return max(standard_error(row, best), SMALLEST_DIFFERENCE * best.validation_rmse)


def standard_error(row: Row, best: Row) -> float:
    """Of the difference of two rows' RMSE over the same views; 0 with fewer than two views.

    The mean squared errors differ by d = sum_v w_v d_v, w_v the views' weights that sum to 1; the variance of d is
    n / (n - 1) sum_v (w_v (d_v - d))^2, and RMSE_1 - RMSE_2 = d / (RMSE_1 + RMSE_2).
    """
    count, both = len(best.views), row.validation_rmse + best.validation_rmse
    if count < 2 or both == 0:
        return 0.0
    total = sum(view.weight for view in best.views)
    shares = [view.weight / total for view in best.views]
    gaps = [one.mse - other.mse for one, other in zip(row.views, best.views, strict=True)]
    mean = sum(share * gap for share, gap in zip(shares, gaps, strict=True))
    spread = sum((share * (gap - mean)) ** 2 for share, gap in zip(shares, gaps, strict=True))
    return math.sqrt(count / (count - 1) * spread) / both


def _timed(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row.error is None and row.timing is not None]


@final
class _Text:
    """The sentences of a decision."""

    def __init__(self, rows: list[Row], judged: str, target_rmse: float | None, budget_ms: float | None) -> None:
        self.rows, self.judged = rows, judged
        self.target, self.budget = target_rmse, budget_ms

    def decision(self, best: Row, least: Row | None = None) -> Decision:
        """What was asked is met; `least` is given where the rule of one standard error decided."""
        return Decision(best, True, " ".join((self._why(best, least), self._why_not_cheaper(best, least))))

    def no_budget(self, best: Row) -> str:
        return f"No candidate runs within {self.budget:g} ms: returned is the fastest, {self._figures(best)}."

    def no_target(self, best: Row) -> str:
        within = f" within {self.budget:g} ms" if self.budget is not None else ""
        line = (
            f"No candidate reaches {self.judged} {self.target:g}{within}: returned is the best{within}, "
            f"{self._figures(best)}."
        )
        slower = [row for row in self.rows if self.target is not None and row.validation_rmse <= self.target]
        if slower:
            line += f" Over the budget, {self._figures(cheapest(slower))}, reaches it."
        return line

    def _why(self, best: Row, least: Row | None) -> str:
        budget = "" if self.budget is None else f" and takes at most {self.budget:g} ms"
        if self.target is not None:
            return f"{self._figures(best)}, is the cheapest candidate whose {self.judged} is at most {self.target:g}{budget}."
        if least is None:
            return f"{self._figures(best)}, has the least {self.judged} of the candidates that take at most {self.budget:g} ms."
        if best is least:
            others = any(row.ms < best.ms for row in self.rows)
            return f"{self._figures(best)}, has the least {self.judged} of all{', and no cheaper one comes close' * others}."
        gap = best.validation_rmse - least.validation_rmse
        return (
            f"{self._figures(best)}, is the cheapest candidate that cannot be told from the best, {self._figures(least)}: "
            f"it is worse by {gap:.5f}, {self._allowed(best, least)} allowed."
        )

    def _why_not_cheaper(self, best: Row, least: Row | None) -> str:
        """What the next cheaper row on the front lacks."""
        cheaper = [row for row in pareto_front(self.rows) if row.ms < best.ms]
        if not cheaper:
            return "None is cheaper."
        row = cheaper[-1]
        start = f"The next cheaper one on the front, {self._figures(row)}, "
        if self.target is not None and row.validation_rmse > self.target:
            return start + f"misses the target by {row.validation_rmse - self.target:.5f}."
        reference = best if least is None else least
        gap = row.validation_rmse - reference.validation_rmse
        if least is not None and gap > allowance(row, least):
            whom = "the best" if best is not least else "it"
            return start + f"is worse than {whom} by {gap:.5f}, {self._allowed(row, least)} allowed."
        if least is not None or self.target is not None:
            return start + "is as fast as far as timing can tell: the smaller model was taken."
        return start + f"is worse by {gap:.5f}."

    def _figures(self, row: Row) -> str:
        return f"{row.name} ({self.judged} {row.validation_rmse:.5f}, training RMSE {row.training_rmse:.5f}, {row.ms:.2f} ms)"

    def _allowed(self, row: Row, least: Row) -> str:
        error = standard_error(row, least)
        slack = SMALLEST_DIFFERENCE * least.validation_rmse
        if error > slack:
            return f"{error:.5f} (one standard error over {len(least.views)} views)"
        return f"{slack:.5f} ({SMALLEST_DIFFERENCE:.0%} of the least)"
