"""Which parameters a fit moves, and the smooth bijection between their bounded ranges and R^n."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
class Column:
    """One number that a fit moves: a parameter of all scenes (scene None) or of one."""

    field: str
    scene: int | None = None

    @property
    def name(self) -> str:
        """ "radius", or "radius[1]" of the scene 1 alone."""
        return self.field if self.scene is None else f"{self.field}[{self.scene}]"


@final
@dataclass(frozen=True)
class ParameterSpace:
    """Positive parameters between bounds as points u of R^n.

    log p = low + (high - low) sigmoid(4 u / (high - low)), the bounds in logarithms: smooth, strictly increasing, and near
    the middle of the range a unit of u is a factor of e, whatever the width of the range.

    Args:
        columns: what is moved.
        start: (P,) logarithms of the starting values.
        low, high: (P,) logarithms of the bounds.
        offsets: (S, P) what each scene adds to the logarithms: scenes whose modules start at other radii share a factor.
    """

    columns: tuple[Column, ...]
    start: Tensor
    low: Tensor
    high: Tensor
    offsets: Tensor

    @staticmethod
    def of(
        modules: AmbientVisibility | Sequence[AmbientVisibility],
        names: tuple[str, ...],
        per_scene: tuple[str, ...] = (),
    ) -> ParameterSpace:
        """The space of the modules' parameters, from their values and `ParameterSpec`s.

        Args:
            modules: one a scene, alike but for values.
            names: parameters to move. per_scene: those of them that every scene has for itself.
        Raises: RangeError when a starting value lies outside its bounds.
        """
        modules = [modules] if isinstance(modules, AmbientVisibility) else list(modules)
        columns: list[Column] = []
        for name in names:
            own: list[int | None] = list(range(len(modules))) if name in per_scene and len(modules) > 1 else [None]
            columns.extend(Column(name, scene) for scene in own)
        ends = [_ends(modules[column.scene or 0], column.field) for column in columns]
        start, low, high = torch.tensor(ends, dtype=torch.float64).log().T.contiguous()
        own_start = [[_ends(module, column.field)[0] for column in columns] for module in modules]
        shared = torch.tensor([column.scene is None for column in columns])
        offsets = torch.where(shared, torch.tensor(own_start, dtype=torch.float64).log() - start, 0.0)
        return ParameterSpace(tuple(columns), start, low, high, offsets)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(column.name for column in self.columns)

    def of_scene(self, scene: int, log: Tensor) -> dict[str, Tensor]:
        """Logarithms (0-d) of the parameters of one scene, by name, at the point log (P,)."""
        return {
            column.field: log[at] + self.offsets[scene, at].to(log)
            for at, column in enumerate(self.columns)
            if column.scene in (None, scene)
        }

    def column(self, field: str) -> int | None:
        """Where a parameter that all scenes share stands; None when it is not fitted, or by each scene for itself."""
        shared = Column(field)
        return self.columns.index(shared) if shared in self.columns else None

    def __len__(self) -> int:
        return len(self.columns)

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


def _ends(module: AmbientVisibility, name: str) -> tuple[float, float, float]:
    """Starting value and bounds of a module's parameter."""
    spec, value = module.PARAMETERS[name], float(getattr(module, name).detach())
    unit = value if spec.relative_bounds else 1.0
    if not (math.isfinite(value) and spec.low * unit < value < spec.high * unit):
        raise checks.RangeError(
            f"module.{name} must start between {spec.low:g} and {spec.high:g}, got {value:g}: "
            f"set module.{name} to 1 or so first"
        )
    return value, spec.low * unit, spec.high * unit
