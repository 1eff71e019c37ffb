"""Weighted residuals of modules against targets, their forward-mode Jacobian, and the count of what they cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, final

import torch
from torch import Tensor

from torch_ssao.fitting.losses import robust_residual
from torch_ssao.fitting.parameters import ParameterSpace
from torch_ssao.fitting.priors import Prior
from torch_ssao.fitting.views import View
from torch_ssao.modules import AmbientVisibility

CONTRAST_REACH = 1.5  # logarithm; a scan's neighbours never need more
CONTRAST_ROUNDS = 6  # to 2e-4 of the contrast


class BudgetSpent(Exception):
    """The next evaluation would exceed the budget."""


@final
class Residuals:
    """r(log p) = sqrt(w) root(loss(prediction - target)) over the pixels that count, and one row a prior.

    With squares and without priors |r| is the weighted RMSE.

    Args:
        modules: one a scene; evaluated by `torch.func.functional_call`, never changed.
        views: see `gather_views`.
        space: the P parameters.
        budget: evaluations allowed in all: one is a forward pass of all views; a Jacobian counts P.
        loss, loss_scale: see `losses.robust_residual`. priors: by the names of the space's columns.
        on_evaluation: called with the number of evaluations just done.
    Cost: one view at a time; kept are N-vectors of the N pixels that count, float64, on the modules' device.
    """

    def __init__(
        self,
        modules: Sequence[AmbientVisibility],
        views: Sequence[View],
        space: ParameterSpace,
        budget: int,
        *,
        loss: str = "l2",
        loss_scale: float = 0.1,
        priors: Mapping[str, Prior] | None = None,
        on_evaluation: Callable[[float], None] = lambda count: None,
    ) -> None:
        self.modules, self.views, self.space, self.budget = modules, views, space, budget
        self.loss, self.loss_scale = loss, loss_scale
        self.priors = [(space.names.index(name), prior) for name, prior in (priors or {}).items()]
        self.best_log: Tensor | None = None
        self.best: Tensor | None = None  # the residuals there
        self.best_difference: Tensor | None = None  # prediction - target there
        self._spent = 0.0
        self._active = list(views)
        self._on_evaluation = on_evaluation

    @property
    def evaluations(self) -> int:
        """Forward passes of all views so far, rounded up."""
        return math.ceil(self._spent - 1e-9)

    @property
    def left(self) -> int:
        """Evaluations, of the views in use, left in the budget."""
        return int((self.budget - self._spent) / self._share + 1e-9)

    @property
    def least(self) -> float:
        """The least |r| seen on all views."""
        return float("inf") if self.best is None else float(self.best.norm())

    @property
    def rmse(self) -> float:
        """The weighted RMSE at that point, whatever the loss and the priors."""
        if self.best_difference is None:
            return float("inf")
        return float((self.best_difference.square() @ self.all_weights).sqrt())

    @property
    def all_weights(self) -> Tensor:
        """(N,) weights of the pixels of the views in use; they sum to 1."""
        weight = torch.cat([view.weight for view in self._active])
        return weight / weight.sum()

    @contextmanager
    def batch(self, indices: Sequence[int]) -> Iterator[None]:
        """Within it only these views are evaluated, and nothing that is found counts as best."""
        self._active = [self.views[index] for index in indices]
        try:
            yield
        finally:
            self._active = list(self.views)

    @property
    def _share(self) -> float:
        return len(self._active) / len(self.views)

    def value(self, log: Tensor) -> Tensor:
        """(M,) float64 residuals at the (P,) logarithms. One evaluation. Raises: BudgetSpent."""
        self.spend(1)
        return self._seen(log, self._differences(log))

    def value_at_best_contrast(self, log: Tensor) -> Tensor:
        """Like `value`, but with the contrast that suits this image best; returns the (P,) logarithms with it.

        Contrast is the last thing every technique does (visibility^contrast), so that trying another one costs a power and
        no evaluation. One evaluation; without a contrast that all scenes share the same as `value`. Raises: BudgetSpent.
        """
        self.spend(1)
        difference = self._differences(log)
        self._seen(log, difference)
        at = self.space.column("contrast")
        if at is None:
            return log

        def moved(step: float) -> Tensor:
            changed = log.clone()
            changed[at] += step
            return changed

        wanted = torch.cat([view.wanted for view in self._active])
        image = (difference + wanted).clamp(0, 1)
        low, high = -CONTRAST_REACH, CONTRAST_REACH
        for _ in range(CONTRAST_ROUNDS):  # a narrowing grid: the error is smooth in contrast and has one minimum
            tried = torch.linspace(low, high, 9, dtype=torch.float64).tolist()
            errors = [float(self._residual(image ** math.exp(step) - wanted, moved(step)).norm()) for step in tried]
            least = min(range(9), key=errors.__getitem__)
            low, high = tried[max(least - 1, 0)], tried[min(least + 1, 8)]
        best = 0.5 * (low + high)
        self._seen(moved(best), image ** math.exp(best) - wanted)
        return moved(best)

    def jacobian(self, log: Tensor) -> Tensor:
        """(M, P) derivatives of the residuals to the logarithms. P evaluations. Raises: BudgetSpent.

        Forward mode with the tangents as a vmapped batch: the primal is computed once for all columns, one view at a time.
        """
        self.spend(len(self.space))
        rows = []
        with torch.no_grad():
            for view in self._active:
                image, columns = self._push_forward(view, log)
                slope = robust_residual(image[view.inside].double() - view.wanted, self.loss, self.loss_scale)[1]
                rows.append(columns[:, view.inside].double().T * slope[:, None])
        pixels = torch.cat(rows) * self.all_weights.sqrt()[:, None]
        pulls = torch.zeros(len(self.priors), len(self.space), dtype=torch.float64, device=pixels.device)
        for row, (at, prior) in enumerate(self.priors):
            pulls[row, at] = prior.slope
        return torch.cat((pixels, pulls))

    def noise(self) -> Tensor:
        """(M,) standard deviation of each residual at the best point: the target's own, else the size of the residual."""
        if self.best is None or self.best_difference is None:
            raise BudgetSpent
        slope = robust_residual(self.best_difference, self.loss, self.loss_scale)[1]
        pixels = len(self.best) - len(self.priors)
        stated, start = [], 0
        for view in self.views:
            stop = start + len(view.wanted)
            stated.append(self.best_difference[start:stop].abs() if view.noise is None else view.noise)
            start = stop
        spread = torch.cat(stated) * slope * self.all_weights.sqrt()
        return torch.nn.functional.pad(spread, (0, len(self.best) - pixels))

    def predict(self, view: View, log: Tensor) -> Tensor:
        """(1, 1, H, W) visibility with the parameters at `log`. Gradients: to log. Not counted."""
        state = {f"raw_{name}": raw for name, raw in self.space.of_scene(view.scene, log).items()}
        return torch.func.functional_call(self.modules[view.scene], state, (view.gbuffer,))

    def _differences(self, log: Tensor) -> Tensor:
        """(N,) float64 prediction - target over the views in use."""
        with torch.no_grad():
            return torch.cat([self._predict(view, log)[view.inside].double() - view.wanted for view in self._active])

    def _predict(self, view: View, log: Tensor) -> Tensor:
        return self.predict(view, log.to(view.gbuffer.depth.device))[0, 0]

    def _push_forward(self, view: View, log: Tensor) -> tuple[Tensor, Tensor]:
        """The visibility (H, W) and its tangents (P, H, W)."""

        def column(direction: Tensor) -> tuple[Tensor, Tensor]:
            pair: Any = torch.func.jvp(lambda at: self._predict(view, at), (log,), (direction,))
            return pair  # type: ignore[no-any-return]

        image, tangents = torch.func.vmap(column)(torch.eye(len(self.space), dtype=log.dtype))
        return image[0], tangents

    def loss_of(self, view: View, image: Tensor) -> Tensor:
        """0-d weighted loss of one view's image (H, W), of which the sum over all views is |r|^2 but for the priors."""
        difference = image[view.inside].double() - view.wanted
        return (robust_residual(difference, self.loss, self.loss_scale)[0].square() * view.weight).sum()

    def move_to(self, log: Tensor) -> None:
        """Make `log` the best point, whatever the squares say. Not counted."""
        self.best_log, self.best_difference = log.clone(), self._differences(log)
        self.best = self._residual(self.best_difference, log)

    def spend(self, count: float) -> None:
        """Count evaluations. Raises: BudgetSpent."""
        cost = count * self._share
        if self._spent + cost > self.budget + 1e-9:
            raise BudgetSpent
        self._spent += cost
        self._on_evaluation(cost)

    def _residual(self, difference: Tensor, log: Tensor) -> Tensor:
        root = robust_residual(difference, self.loss, self.loss_scale)[0] * self.all_weights.sqrt()
        pulls = [(log[at] - math.log(prior.value)) * prior.slope for at, prior in self.priors]
        return torch.cat((root, torch.stack(pulls).to(root))) if pulls else root

    def _seen(self, log: Tensor, difference: Tensor) -> Tensor:
        residual = self._residual(difference, log)
        if len(self._active) == len(self.views) and (self.best is None or float(residual.norm()) < self.least):
            self.best_log, self.best, self.best_difference = (
                log.clone(),
                residual,
                difference,
            )  # NaN never becomes the best
        return residual
