"""Weighted residuals of a module against a target, their forward-mode Jacobian, and the count of what they cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import torch
from torch import Tensor

from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility


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
        budget: evaluations allowed in all; a residual counts 1, a Jacobian P more.
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
        for index in range(len(gbuffer)):
            inside = weight[index, 0] > 0
            if bool(inside.any()):
                wanted = target[index, 0][inside].double()
                self._views.append((gbuffer[index], inside, wanted, weight[index, 0][inside].double().sqrt()))

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

    def value_and_jacobian(self, log: Tensor) -> tuple[Tensor, Tensor]:
        """(N,) residuals and (N, P) derivatives to the logarithms. P + 1 evaluations. Raises: BudgetSpent.

        Forward mode with the tangents as a vmapped batch: the primal is computed once for all columns.
        """
        self._spend(1 + len(self.names))
        values, columns = [], []
        with torch.no_grad():
            for gbuffer, inside, wanted, root in self._views:
                prediction, tangents = self._push_forward(gbuffer, log)
                values.append((prediction[inside].double() - wanted) * root)
                columns.append(tangents[:, inside].double().T * root[:, None])
        return self._seen(log, torch.cat(values)), torch.cat(columns)

    def per_view(self, columns: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Split rows of N pixels into (mask (H, W), rows) of each view."""
        masks = [inside for _, inside, _, _ in self._views]
        return list(zip(masks, columns.split([int(mask.sum()) for mask in masks]), strict=True))

    def _predict(self, gbuffer: GBuffer, log: Tensor) -> Tensor:
        """(H, W) visibility with the parameters at `log`."""
        raw = log.to(gbuffer.depth.device)
        state = {f"raw_{name}": raw[i] for i, name in enumerate(self.names)}
        return torch.func.functional_call(self.module, state, (gbuffer,))[0, 0]

    def _push_forward(self, gbuffer: GBuffer, log: Tensor) -> tuple[Tensor, Tensor]:
        def column(direction: Tensor) -> tuple[Tensor, Tensor]:
            return torch.func.jvp(lambda at: self._predict(gbuffer, at), (log,), (direction,))

        basis = torch.eye(len(self.names), dtype=log.dtype)
        prediction, tangents = torch.func.vmap(column, out_dims=(None, 0))(basis)
        return prediction, tangents

    def _spend(self, count: int) -> None:
        if count > self.left:
            raise BudgetSpent
        self.evaluations += count
        self._on_evaluation(count)

    def _seen(self, log: Tensor, residual: Tensor) -> Tensor:
        if self.best is None or float(residual.norm()) < self.rmse:  # NaN never becomes the best
            self.best_log, self.best = log.clone(), residual
        return residual
