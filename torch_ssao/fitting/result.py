"""What a fit returns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

from torch import Tensor

from torch_ssao.modules import AmbientVisibility


@final
@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted module and how it came about.

    Args:
        module: a new module with the fitted values; the one that was passed in is untouched. Of several scenes, the first's.
        modules: one a scene; alike but where parameters are the scenes' own.
        values: all continuous parameters of `module` by name, fitted or not, and "radius[1]" and so on for those of one scene.
        names: the fitted parameters: keys of `values`, rows of `correlation`.
        standard_errors: of the fitted parameters, in their own units; inf where the data cannot determine one. They say how
            far the noise of the target may have moved the parameter, not how wrong the model is (see `fit`). Empty when the
            loss is no sum of squares.
        correlation: (P, P) float64 of the logarithms of the fitted parameters, nan where there is no variance; None with
            `standard_errors` empty. Two near 1 or -1 can be traded for each other: fix one of them.
        undetermined: fitted parameters in a direction along which the error is flat, or at the end of their range.
        rmse, initial_rmse: weighted RMSE over the pixels that count, after and before.
        loss, initial_loss: what was minimised, priors included, after and before: the mean square for "l2".
        steps: steps that lowered the error. starts: descents begun, from different points of the scan.
        evaluations: forward passes of all views, each Jacobian column and each point of the scan counted as one.
        message: why the fit stopped, in a sentence.
        seconds: wall time.
    """

    module: AmbientVisibility
    modules: tuple[AmbientVisibility, ...]
    values: dict[str, float]
    names: tuple[str, ...]
    standard_errors: dict[str, float]
    correlation: Tensor | None
    undetermined: tuple[str, ...]
    rmse: float
    initial_rmse: float
    loss: float
    initial_loss: float
    steps: int
    starts: int
    evaluations: int
    message: str
    seconds: float

    def __str__(self) -> str:
        fitted = ", ".join(
            f"{name} = {self.values[name]:.5g}"
            + (f" ± {self.standard_errors[name]:.2g}" if name in self.standard_errors else "")
            for name in self.names
        )
        flat = f"; undetermined: {', '.join(self.undetermined)}" if self.undetermined else ""
        return (
            f"RMSE {self.initial_rmse:.5f} -> {self.rmse:.5f} in {self.evaluations} evaluations "
            f"({self.seconds:.1f} s): {fitted}{flat}{self._traded()}. {self.message}"
        )

    def _traded(self) -> str:
        """Pairs of parameters that the data hardly tell apart."""
        if self.correlation is None:
            return ""
        pairs = [
            f"{a} and {b} ({value:+.3f})"
            for i, a in enumerate(self.names)
            for j, b in enumerate(self.names[:i])
            if math.fabs(value := float(self.correlation[i, j])) > TRADED
        ]
        return f"; correlated: {', '.join(pairs)}" if pairs else ""


TRADED = 0.98  # correlation from which a pair is named
