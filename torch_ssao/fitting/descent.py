"""A plain loop of a torch optimiser, for losses that are no sum of squares, such as 1 - SSIM."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, final

import torch
from torch import Tensor

from torch_ssao.fitting.losses import ImageLoss
from torch_ssao.fitting.parameters import ParameterSpace
from torch_ssao.fitting.residuals import BudgetSpent, Residuals
from torch_ssao.fitting.scan import scan_points
from torch_ssao.fitting.views import View

OPTIMISERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "rmsprop": torch.optim.RMSprop,
    "sgd": torch.optim.SGD,
}
RATE = {"sgd": 1.0}  # first step in u, where a unit is about a factor of e
DEFAULT_RATE = 0.1
LAST_RATE = 0.02  # of the first, reached by a cosine
GRADIENT_COST = 3  # evaluations: forward, and a backward of about twice that


@final
@dataclass(frozen=True)
class Descended:
    """Where the loop ended: the best logarithms on all views, the loss there and at the start, steps taken."""

    log: Tensor
    loss: float
    initial_loss: float
    steps: int


@final
class ImageLosses:
    """The mean loss over views, and its gradient; priors add (slope (log p - log value))^2.

    Args:
        residuals: whose views, modules, priors and budget are used.
        loss: of one view's image; None for the residuals' own squares, weighted by pixel.
    """

    def __init__(self, residuals: Residuals, loss: ImageLoss | None) -> None:
        self.residuals, self.loss = residuals, loss

    def value(self, log: Tensor, views: list[View] | None = None) -> float:
        """Loss. One evaluation of the views. Raises: BudgetSpent."""
        with torch.no_grad():
            return float(self._mean(log, views, 1))

    def slope(self, log: Tensor, views: list[View] | None = None) -> tuple[float, Tensor]:
        """Loss and its gradient (P,). `GRADIENT_COST` evaluations. Raises: BudgetSpent."""
        leaf = log.detach().requires_grad_()
        with torch.enable_grad():
            total = 0.0
            slope = torch.zeros_like(leaf)
            for term in self._terms(leaf, views, GRADIENT_COST):
                slope += torch.autograd.grad(term, leaf)[0]
                total += float(term.detach())
        return total, slope

    def _mean(self, log: Tensor, views: list[View] | None, cost: int) -> Tensor:
        return torch.stack([term.cpu() for term in self._terms(log, views, cost)]).sum()

    def _terms(self, log: Tensor, views: list[View] | None, cost: int) -> Iterator[Tensor]:
        used = list(self.residuals.views) if views is None else views
        self.residuals.spend(cost * len(used) / len(self.residuals.views))
        for view in used:
            image = self.residuals.predict(view, log.to(view.gbuffer.depth.device))
            if self.loss is None:
                weighted = self.residuals.loss_of(view, image[0, 0])
                yield weighted * len(self.residuals.views) / len(used)
            else:
                inside = view.inside[None, None]
                shown = torch.where(inside, image, 1.0)
                yield self.loss(shown, view.image.to(shown), inside).double() / len(used)
        for at, prior in self.residuals.priors:
            yield ((log[at] - math.log(prior.value)) * prior.slope).square()


def descend(
    losses: ImageLosses,
    space: ParameterSpace,
    *,
    optimiser: str,
    with_scan: bool,
    batches: Iterator[list[int]] | None,
) -> Descended:
    """Scan, then the optimiser from the best point, in u, until the budget is spent; the best point on all views is kept.

    With `batches` (indices of views, without end) each step sees one of them, and every eighth of the way the loss is
    looked at on all views.
    """
    residuals = losses.residuals
    initial = losses.value(space.start)
    best = (initial, space.start)
    if with_scan:
        points = scan_points(space)[1 : max(2, residuals.left // 3)]
        best = min([best, *((losses.value(point), point) for point in points)], key=lambda pair: _finite(pair[0]))
    cost = GRADIENT_COST * (1.0 if batches is None else len(next(batches)) / len(residuals.views))
    checks_apart = 0 if batches is None else 8
    planned = max(1, int((residuals.left - checks_apart) / cost))
    u = space.from_log(best[1]).requires_grad_()
    rate = RATE.get(optimiser, DEFAULT_RATE)
    stepper: Any = OPTIMISERS[optimiser]([u], lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(stepper, planned, LAST_RATE * rate)
    steps = 0
    try:
        while steps < planned:
            log = space.to_log(u.detach())
            views = None if batches is None else [residuals.views[index] for index in next(batches)]
            loss, slope = losses.slope(log, views)
            if batches is None and loss < best[0]:
                best = (loss, log)
            if not bool(torch.isfinite(slope).all()):
                break
            u.grad = slope * space.slope(u.detach())
            stepper.step()
            schedule.step()
            steps += 1
            if batches is not None and steps % max(1, planned // checks_apart) == 0:
                best = _better(best, losses, space.to_log(u.detach()))
        best = _better(best, losses, space.to_log(u.detach()))
    except BudgetSpent:
        pass
    return Descended(best[1], best[0], initial, steps)


def _better(best: tuple[float, Tensor], losses: ImageLosses, log: Tensor) -> tuple[float, Tensor]:
    loss = losses.value(log)
    return (loss, log) if loss < best[0] else best


def _finite(loss: float) -> float:
    return loss if math.isfinite(loss) else math.inf
