"""What a fit returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from torch_ssao.modules import AmbientVisibility


@final
@dataclass(frozen=True)
class FitResult:
    """A fitted module and how it came about.

    Args:
        module: a new module with the fitted values; the one that was passed in is untouched.
        values: all continuous parameters of the module by name, fitted or not.
        standard_errors: of the fitted parameters, in their own units; inf where the data cannot determine one. They say how
            far the noise of the target may have moved the parameter, not how wrong the model is (see `fit`).
        undetermined: fitted parameters in a direction along which the error is flat, or at the end of their range.
        rmse, initial_rmse: weighted RMSE over the pixels that count, after and before.
        steps: steps that lowered the error. starts: descents begun, from different points of the scan.
        evaluations: evaluations of the module, each Jacobian column and each point of the scan counted as one.
        message: why the fit stopped, in a sentence.
        seconds: wall time.
    """

    module: AmbientVisibility
    values: dict[str, float]
    standard_errors: dict[str, float]
    undetermined: tuple[str, ...]
    rmse: float
    initial_rmse: float
    steps: int
    starts: int
    evaluations: int
    message: str
    seconds: float

    def __str__(self) -> str:
        fitted = ", ".join(
            f"{name} = {self.values[name]:.5g} ± {error:.2g}" for name, error in self.standard_errors.items()
        )
        flat = f"; undetermined: {', '.join(self.undetermined)}" if self.undetermined else ""
        return (
            f"RMSE {self.initial_rmse:.5f} -> {self.rmse:.5f} in {self.evaluations} evaluations "
            f"({self.seconds:.1f} s): {fitted}{flat}. {self.message}"
        )
