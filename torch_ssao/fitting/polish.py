"""The end of a fit without derivatives: Gauss-Newton whose Jacobian is a secant over a finite step.

The forward-mode Jacobian holds a technique's discrete decisions (StatVO's labels) constant. It is exact almost everywhere, yet the
average slope of the error over a finite step also holds what the flips do, so that the two vanish at slightly different places.
Differences over the step that is being taken see both.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ssao.fitting.parameters import ParameterSpace
from torch_ssao.fitting.residuals import BudgetSpent, Residuals

FIRST = 0.05  # first difference, in logarithms
LAST = 2e-5  # differences below this change nothing that a fit is judged by
WORTH = 1e-5  # relative gain of a round below which the difference is shortened


def polish(residuals: Residuals, space: ParameterSpace, *, first: float = FIRST) -> tuple[int, bool]:
    """Refine the best point of `residuals` in place.

    Each round takes P differences around the best point, downhill where that is known, and the damped Gauss-Newton step from them.
    Returns: the number of rounds that helped; whether the differences became as short as `LAST` (else the budget ended it).
    Cost: P + 1 evaluations a round, until the budget or `LAST` is reached.
    """
    size, steps, delta = len(space), 0, first
    side = torch.ones(size, dtype=torch.float64)
    try:
        while delta > LAST and residuals.left > size:
            before = residuals.least
            origin, base = _best(residuals)
            u = space.from_log(origin)
            columns = []
            for index in range(size):
                probe = u.clone()
                probe[index] += delta * side[index]
                columns.append((residuals.value(space.to_log(probe)) - base) / (delta * side[index]))
            jacobian = torch.stack(columns, 1)
            move = _step(jacobian, base, delta)
            residuals.value(space.to_log(u + move))
            side = torch.where(move.sign() == 0, side, move.sign())
            gained = residuals.least < before * (1 - WORTH)
            steps += residuals.least < before
            length = float(move.abs().max())
            delta = min(delta, max(length, delta / 8)) * (0.5 if gained else 0.25)
    except BudgetSpent:
        pass
    return steps, delta <= LAST


def _best(residuals: Residuals) -> tuple[Tensor, Tensor]:
    if residuals.best_log is None or residuals.best is None:
        raise BudgetSpent
    return residuals.best_log, residuals.best


def _step(jacobian: Tensor, residual: Tensor, delta: float) -> Tensor:
    """Gauss-Newton step, at most 4 differences long in any parameter."""
    gram = jacobian.T @ jacobian
    gram = gram + 1e-9 * gram.diagonal().max() * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    move = torch.linalg.lstsq(gram.cpu(), -(jacobian.T @ residual).cpu()[:, None]).solution[:, 0]
    return move * min(1.0, 4 * delta / max(float(move.abs().max()), 1e-300))
