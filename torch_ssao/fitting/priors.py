"""What is known of a parameter before the data speak."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

from torch_ssao import checks


@final
@dataclass(frozen=True)
class Prior:
    """A pull of a parameter towards a value, on a logarithmic scale.

    Args:
        value: where the parameter is expected, in its own unit, > 0.
        spread: the factor by which it may well be off, > 1.
        rmse: what being off by that factor costs, as the RMSE over all pixels that costs as much: .01 decides where the data
            hardly care, .1 holds against most images. > 0.
    Raises: RangeError.
    """

    value: float
    spread: float = 2.0
    rmse: float = 0.01

    def __post_init__(self) -> None:
        checks.check_positive("value", self.value)
        checks.check_positive("rmse", self.rmse)
        if not (math.isfinite(self.spread) and self.spread > 1):
            raise checks.RangeError(f"spread must be a factor above 1, got {self.spread!r}: pass 2 for a factor of 2")

    @property
    def slope(self) -> float:
        """Residual per unit of the parameter's logarithm."""
        return self.rmse / math.log(self.spread)


def check_priors(priors: Mapping[str, Prior] | None, names: tuple[str, ...]) -> dict[str, Prior]:
    """Priors by parameter; raise `ChoiceError` for a parameter that is not fitted, or a value that is no `Prior`."""
    found = dict(priors or {})
    for name, prior in found.items():
        checks.check_choice("priors", name, names)
        if not isinstance(prior, Prior):
            raise checks.ChoiceError(f"priors[{name!r}] must be a Prior, got {type(prior).__name__}: pass Prior(value)")
    return found
