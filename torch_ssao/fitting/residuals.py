"""Weighted residuals of a module against a target, their forward-mode Jacobian, and the count of what they cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import final

import torch
from torch import Tensor

from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility

CONTRAST_REACH = 1.5  # logarithm; a scan's neighbours never need more
CONTRAST_ROUNDS = 6  # to 2e-4 of the contrast


class BudgetSpent(Exception):
    """The next evaluation would exceed the budget."""


@final
class Residuals:
    """r(log p) = sqrt(w) (prediction - target) over the pixels of all views that count; |r| is the weighted RMSE.

    Args:
        module: evaluated by `torch.func.functional_call`, never changed.
        gbuffer: B views.
        target: (B, 1, H, W) visibility.
        weight: (B, 1, H, W) >= 0 that sum to 1; pixels of weight 0 never enter.
        names: the P parameters.
        budget: evaluations allowed in all; residuals count 1, a Jacobian counts P.
        on_evaluation: called with the number of evaluations just done.
    Cost: one view at a time; kept are N-vectors of the N pixels that count, float64, on the module's device.
    """

    def __init__(
        self,
        module: AmbientVisibility,
        gbuffer: GBuffer,
        target: Tensor,
        weight: Tensor,
        names: tuple[str, ...],
        budget: int,
        on_evaluation: Callable[[int], None] = lambda count: None,
    ) -> None:
        self.module, self.names, self.budget = module, names, budget
        self.evaluations = 0
        self.best_log: Tensor | None = None
        self.best: Tensor | None = None
        self._on_evaluation = on_evaluation
        self._views = []
        self._kept = []
        for index in range(len(gbuffer)):
            inside = weight[index, 0] > 0
            if bool(inside.any()):
                wanted = target[index, 0][inside].double()
                view = (gbuffer[index], inside, wanted, weight[index, 0][inside].double().sqrt())
                self._views.append(view)
                self._kept.append((index, view))

    @property
    def left(self) -> int:
        """Evaluations left in the budget."""
        return self.budget - self.evaluations

    @property
    def rmse(self) -> float:
        """The least weighted RMSE seen."""
        return float("inf") if self.best is None else float(self.best.norm())

    def value(self, log: Tensor) -> Tensor:
        """(N,) float64 residuals at the (P,) logarithms. One evaluation. Raises: BudgetSpent."""
        self._spend(1)
        with torch.no_grad():
            parts = [
                (self._predict(gbuffer, log)[inside].double() - wanted) * root
                for gbuffer, inside, wanted, root in self._views
            ]
        return self._seen(log, torch.cat(parts))

    def value_at_best_contrast(self, log: Tensor) -> Tensor:
        """Like `value`, but with the contrast that suits this image best; returns the (P,) logarithms with it.

        Contrast is the last thing every technique does (visibility^contrast), so that trying another one costs a power and
        no evaluation. One evaluation; without "contrast" among the names the same as `value`. Raises: BudgetSpent.
        """
        residual = self.value(log)
        if "contrast" not in self.names:
            return log
        at = self.names.index("contrast")
        root = torch.cat([view[3] for view in self._views])
        wanted = torch.cat([view[2] for view in self._views])
        image = (residual / root + wanted).clamp(0, 1)
        low, high = -CONTRAST_REACH, CONTRAST_REACH
        for _ in range(CONTRAST_ROUNDS):  # a narrowing grid: the error is smooth in contrast and has one minimum
            tried = torch.linspace(low, high, 9, dtype=torch.float64).tolist()
            errors = [float(((image ** math.exp(step) - wanted) * root).norm()) for step in tried]
            least = min(range(9), key=errors.__getitem__)
            low, high = tried[max(least - 1, 0)], tried[min(least + 1, 8)]
        moved = log.clone()
        moved[at] += 0.5 * (low + high)
        self._seen(moved, (image ** math.exp(0.5 * (low + high)) - wanted) * root)
        return moved

    def jacobian(self, log: Tensor) -> Tensor:
        """(N, P) derivatives of the residuals to the logarithms. P evaluations. Raises: BudgetSpent.

        Forward mode with the tangents as a vmapped batch: the primal is computed once for all columns, one view at a time.
        """
        self._spend(len(self.names))
        columns = []
        with torch.no_grad():
            for gbuffer, inside, _, root in self._views:
                columns.append(self._push_forward(gbuffer, log)[:, inside].double().T * root[:, None])
        return torch.cat(columns)

    def gather(self, image: Tensor) -> Tensor:
        """(N,) the pixels of a (B, 1, H, W) image in the order of the residuals."""
        return torch.cat([image[index, 0][inside] for index, (_, inside, _, _) in self._kept])

    def _predict(self, gbuffer: GBuffer, log: Tensor) -> Tensor:
        """(H, W) visibility with the parameters at `log`."""
        raw = log.to(gbuffer.depth.device)
        state = {f"raw_{name}": raw[i] for i, name in enumerate(self.names)}
        return torch.func.functional_call(self.module, state, (gbuffer,))[0, 0]

    def _push_forward(self, gbuffer: GBuffer, log: Tensor) -> Tensor:
        """(P, H, W) tangents of the visibility."""

        def column(direction: Tensor) -> Tensor:
            pushed = torch.func.jvp(lambda at: self._predict(gbuffer, at), (log,), (direction,))
            return pushed[1]  # type: ignore[no-any-return]

        return torch.func.vmap(column)(torch.eye(len(self.names), dtype=log.dtype))

    def _spend(self, count: int) -> None:
        if count > self.left:
            raise BudgetSpent
        self.evaluations += count
        self._on_evaluation(count)

    def _seen(self, log: Tensor, residual: Tensor) -> Tensor:
        if self.best is None or float(residual.norm()) < self.rmse:  # NaN never becomes the best
            self.best_log, self.best = log.clone(), residual
        return residual
