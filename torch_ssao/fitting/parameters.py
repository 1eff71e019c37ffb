"""Which parameters a fit moves, and the smooth bijection between their bounded ranges and R^n."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.modules import AmbientVisibility

EDGE = 0.02  # part of a logarithmic range next to its end that counts as "at the bound"


def choose_parameters(module: AmbientVisibility, parameters: str | tuple[str, ...] | None) -> tuple[str, ...]:
    """The names to fit, in the order of the module's `PARAMETERS`.

    Args:
        module: what is fitted.
        parameters: names, or None for the module's learnable ones or, when it has none, all that its configuration uses.
    Raises: ChoiceError for a name that the module does not use, or for no name at all.
    """
    used = module.used_parameters()
    if parameters is None:
        return module.learnable or used
    names = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    if not names:
        raise checks.ChoiceError(
            f"parameters must name at least one of {', '.join(used)}, got none: pass None for the module's own list"
        )
    for name in names:
        checks.check_choice("parameters", name, used)
    return tuple(name for name in used if name in names)


@final
@dataclass(frozen=True)
class ParameterSpace:
    """Positive parameters between bounds as points u of R^n.

    log p = low + (high - low) sigmoid(4 u / (high - low)), the bounds in logarithms: smooth, strictly increasing, and near
    the middle of the range a unit of u is a factor of e, whatever the width of the range.

    Args:
        names: the parameters.
        start: (P,) logarithms of the starting values.
        low, high: (P,) logarithms of the bounds.
    """

    names: tuple[str, ...]
    start: Tensor
    low: Tensor
    high: Tensor

    @staticmethod
    def of(module: AmbientVisibility, names: tuple[str, ...]) -> ParameterSpace:
        """The space of a module's parameters, from their values and `ParameterSpec`s.

        Raises: RangeError when a starting value lies outside its bounds.
        """
        start: list[float] = []
        low: list[float] = []
        high: list[float] = []
        for name in names:
            spec, value = module.PARAMETERS[name], float(getattr(module, name).detach())
            unit = value if spec.relative_bounds else 1.0
            if not (math.isfinite(value) and spec.low * unit < value < spec.high * unit):
                raise checks.RangeError(
                    f"module.{name} must start between {spec.low:g} and {spec.high:g}, got {value:g}: "
                    f"set module.{name} to 1 or so first"
                )
            for listed, number in ((start, value), (low, spec.low * unit), (high, spec.high * unit)):
                listed.append(math.log(number))
        return ParameterSpace(names, *(torch.tensor(listed, dtype=torch.float64) for listed in (start, low, high)))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def _width(self) -> Tensor:
        return self.high - self.low

    def to_log(self, u: Tensor) -> Tensor:
        """(..., P) logarithms of the parameters at u."""
        inside = self.low + self._width * torch.sigmoid(4 * u / self._width)
        return inside.clamp(self.low, self.high)  # rounding must not leave the bounds

    def from_log(self, log: Tensor) -> Tensor:
        """(..., P) points u of logarithms; those outside are first brought just inside the bounds."""
        return self._width / 4 * torch.logit((log - self.low) / self._width, eps=1e-6)

    def slope(self, u: Tensor) -> Tensor:
        """(..., P) d log p / d u."""
        part = torch.sigmoid(4 * u / self._width)
        return 4 * part * (1 - part)

    def at_bound(self, log: Tensor) -> Tensor:
        """(P,) bool: within `EDGE` of the range from an end."""
        part = (log - self.low) / self._width
        return (part < EDGE) | (part > 1 - EDGE)
