"""Scan, descents from the best points of the scan, polish: one search within one budget."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ssao.fitting import bridge
from torch_ssao.fitting.parameters import ParameterSpace
from torch_ssao.fitting.polish import polish
from torch_ssao.fitting.residuals import BudgetSpent, Residuals
from torch_ssao.fitting.scan import scan

PERFECT = 1e-6  # RMSE at which float32 images agree: nothing is left to fit
PATIENCE = 3  # visits without a relative gain of WORTH after which a descent has stalled
WORTH = 1e-3
FIRST_DAMPING = 1e-2  # of the largest diagonal entry of J'J, Marquardt's tau
FIRST_CURVATURE = 1.0  # what BFGS, which starts from the identity, takes the largest diagonal entry of J'J for
APART = 0.7  # distance in logarithms below which two scan points lead to the same place
POLISH_ROUNDS = 4  # rounds of evaluations kept back for the polish
STARTS = 32
WALKS = (
    (20, 0.05),
    (12, 0.008),
    (12, 0.0016),
)  # points and spacing in log radius; the ripples seen are 0.01 to 0.4 long
WALK_COST = sum(count for count, _ in WALKS)
SAME = (
    5e-3,
    0.05,
)  # relative distance in RMSE and distance in logarithms below which two descents found the same minimum
RUNAWAY = math.log(16.0)  # a descent that moves a parameter by more from the start follows a ridge to infinity


@final
@dataclass(frozen=True)
class Outcome:
    """How a search went: descents begun, steps that lowered the error, whether the last difference was as small as it gets."""

    starts: int
    steps: int
    converged: bool


def search(
    residuals: Residuals,
    space: ParameterSpace,
    *,
    with_scan: bool,
    solver: str = "levenberg_marquardt",
    batches: Iterator[list[int]] | None = None,
) -> Outcome:
    """Find the least |r| within the budget; the best point stays in `residuals`.

    With `batches` (views, without end) the scan and each descent see one of them, and what they end at is then judged on all.
    """
    with _next_batch(residuals, batches):
        candidates = scan(residuals, space) if with_scan else [space.start]
    reserve = min(POLISH_ROUNDS * (len(space) + 1) + WALK_COST, 2 * residuals.left // 3)
    tried: list[Tensor] = []
    ends: list[tuple[float, Tensor]] = []
    steps = 0
    for candidate in candidates:
        exhausted = len(tried) == STARTS or (tried and residuals.left < reserve + 3 * (len(space) + 1))
        if exhausted or residuals.least < PERFECT or _found_twice(ends):
            break
        if any(float((candidate - other).norm()) < APART for other in tried):
            continue
        tried.append(candidate)
        descent = _Descent(residuals, space, reserve, solver)
        with _next_batch(residuals, batches):
            steps += descent.run(candidate)
        least = descent.least if batches is None or not residuals.left else float(residuals.value(descent.at).norm())
        ends.append((least, descent.at))
    walk_radius(residuals, space)
    refined, converged = polish(residuals, space)
    return Outcome(len(tried), steps + refined, converged)


@contextmanager
def _next_batch(residuals: Residuals, batches: Iterator[list[int]] | None) -> Iterator[None]:
    if batches is None:
        yield
    else:
        with residuals.batch(next(batches)):
            yield


def walk_radius(residuals: Residuals, space: ParameterSpace) -> None:
    """Evaluate radii outward from the best point on both sides, each with the contrast that suits it best; then again, closer.

    Radius and contrast trade off, so the error has a long valley, and regular scenes (columns, windows) put ripples on its floor:
    a descent ends in the nearest. Skipped unless the radius is fitted for all scenes together and the budget pays for all points.
    Cost: the sum of `WALKS`.
    """
    at = space.column("radius")
    if at is None or residuals.left < WALK_COST or residuals.least < PERFECT:
        return
    for count, spacing in WALKS:
        if residuals.best_log is None:
            return
        origin = residuals.best_log
        for side in (-1, 1):
            point = origin.clone()
            for _ in range(count // 2):
                point[at] = (point[at] + side * spacing).clamp(space.low[at], space.high[at])
                point = residuals.value_at_best_contrast(point)


def _found_twice(ends: list[tuple[float, Tensor]]) -> bool:
    """Whether two descents from different starts ended at the least error: a third would hardly find less."""
    if not ends:
        return False
    least, at = min(ends, key=lambda end: end[0])
    close = [end <= least * (1 + SAME[0]) and float((log - at).norm()) < SAME[1] for end, log in ends]
    return sum(close) >= 2


@final
class _Descent:
    """One run of a solver: what optimistix visits, and when it is told to stop."""

    def __init__(self, residuals: Residuals, space: ParameterSpace, reserve: int, solver: str) -> None:
        self.residuals, self.space, self.solver = residuals, space, solver
        self.reserve = reserve
        self.least, self.at = math.inf, space.start
        self.scale = 0.0
        self.stalled = 0
        self.steps = -1  # the first visit is no step

    def run(self, start: Tensor) -> int:
        bridge.solve(self.solver, self._visit, self.space.from_log(start).numpy())
        return max(self.steps, 0)

    def _visit(self, at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Residuals and Jacobian reduced to P + 1 rows: the R of a QR of [J r] has the same J'J, J'r and |r|, so that every step
        of the solver is the same as with all N rows."""
        u = torch.from_numpy(at)
        log = self.space.to_log(u)
        if self.residuals.left < self.reserve + 1 + len(self.space):
            raise bridge.StopSolver
        try:
            residual = self.residuals.value(log)
            norm = float(residual.norm())
            self.stalled = 0 if norm < self.least * (1 - WORTH) else self.stalled + 1
            runaway = float((log - self.space.start).abs().max()) > RUNAWAY
            if self.stalled == PATIENCE or norm < PERFECT or runaway or not math.isfinite(norm):
                raise bridge.StopSolver
            if norm >= self.least * (1 - 1e-12):  # surely rejected: its Jacobian is never looked at
                reduced = np.zeros((len(at) + 1, len(at) + 1))
                reduced[-1, -1] = norm * self.scale
            else:
                self.least, self.at, self.steps = norm, log, self.steps + 1
                reduced = self._reduce(residual, self.residuals.jacobian(log) * self.space.slope(u).to(residual.device))
        except BudgetSpent as spent:
            raise bridge.StopSolver from spent
        return reduced[:, -1], reduced[:, :-1]

    def _reduce(self, residual: Tensor, jacobian: Tensor) -> NDArray[np.float64]:
        if not self.scale:  # optimistix starts with a damping of 1: scaled, that is FIRST_DAMPING of J'J
            largest = float(jacobian.square().sum(0).max())
            unit = FIRST_CURVATURE if self.solver == "bfgs" else FIRST_DAMPING
            self.scale = 1 / math.sqrt(max(unit * largest, 1e-30))
        stacked = torch.cat((jacobian, residual[:, None]), 1)
        stacked = torch.nn.functional.pad(stacked, (0, 0, 0, max(0, stacked.shape[1] - len(stacked))))
        upper = torch.linalg.qr(stacked, mode="r").R
        upper = (
            upper * torch.where(upper.diagonal() < 0, -1.0, 1.0)[:, None]
        )  # unique, hence comparable from step to step
        return (self.scale * upper).cpu().numpy()
