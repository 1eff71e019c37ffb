"""The abstract base of all techniques: learnable positive parameters, configuration, the forward frame."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.gbuffer import GBuffer
from torch_ssao.ops.falloff import contrast_power


@dataclass(frozen=True)
class ParameterSpec:
    """A positive continuous parameter: its meaning and the range a fit searches.

    Args:
        unit: "scene units" or "of the radius" or "1".
        low, high: fit bounds; for the radius they multiply the starting value, for all others they are absolute.
        relative_bounds: whether low and high multiply the starting value.
        meaning: one line for tables and error messages.
    """

    unit: str
    low: float
    high: float
    meaning: str
    relative_bounds: bool = False


class Positive:
    """Property over the unconstrained storage `raw_<name>`: the parameter is exp(raw)."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, module: nn.Module | None, owner: type | None = None) -> Any:
        if module is None:
            return self
        return getattr(module, f"raw_{self.name}").exp()

    def __set__(self, module: nn.Module, value: float | Tensor) -> None:
        checks.check_positive(self.name, value.detach() if isinstance(value, Tensor) else value)
        raw = getattr(module, f"raw_{self.name}")
        with torch.no_grad():
            raw.copy_(torch.as_tensor(value, dtype=torch.float64).log())


class AmbientVisibility(nn.Module, abc.ABC):
    """Abstract base: a module from a G-buffer to ambient visibility.

    A technique names its continuous parameters in `PARAMETERS`, declares one `Positive` for each, and computes
    `_visibility`.
    """

    PARAMETERS: ClassVar[dict[str, ParameterSpec]]
    CHOICES: ClassVar[tuple[str, ...]]  # discrete configuration, plain attributes

    contrast = Positive()

    def __init__(self, values: dict[str, float], choices: dict[str, Any], learnable: str | tuple[str, ...]) -> None:
        super().__init__()
        for name, value in choices.items():
            setattr(self, name, value)
        self.learnable = self._resolve_learnable(learnable)
        for name in self.PARAMETERS:
            value = values[name]
            checks.check_positive(name, value.detach() if isinstance(value, Tensor) else value)
            raw = torch.tensor(math.log(float(value)), dtype=torch.get_default_dtype())
            if name in self.learnable:
                self.register_parameter(f"raw_{name}", nn.Parameter(raw))
            else:
                self.register_buffer(f"raw_{name}", raw)

    @abc.abstractmethod
    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        """(B, H, W) visibility before contrast.

        `depth` (B, L, H, W) and `normal` (B, 3, H, W) are finite everywhere and at least float32; what is returned at
        invalid pixels is ignored.
        """

    @abc.abstractmethod
    def used_parameters(self) -> tuple[str, ...]:
        """Names of the continuous parameters that this configuration uses, in the order of `PARAMETERS`."""

    def values(self) -> dict[str, float]:
        """The continuous parameters as plain numbers, by name."""
        return {name: float(getattr(self, name).detach()) for name in self.PARAMETERS}

    def config(self) -> dict[str, Any]:
        """The discrete choices, by name."""
        return {name: getattr(self, name) for name in self.CHOICES}

    def forward(self, gbuffer: GBuffer, *, frame: int = 0, backend: str = "auto") -> Tensor:
        """Ambient visibility of a G-buffer.

        Args:
            gbuffer: see `GBuffer`; float16 and bfloat16 depth is computed in float32. Works without the batch dimension
                under `torch.func.vmap`.
            frame: integer offset of the noise pattern, for techniques that have one.
            backend: "auto" or "torch".
        Returns: (B, 1, H, W) visibility in [0, 1]; 1 and gradient 0 at invalid pixels.
        Gradients: to depth, normal, camera and the module's parameters.
        """
        checks.check_choice("backend", backend, ("auto", "torch"))
        if gbuffer.depth.ndim == 3:  # inside vmap
            batched = pytree.tree_map(lambda leaf: leaf.unsqueeze(0), gbuffer)
            return self.forward(batched, frame=frame, backend=backend).squeeze(0)
        with torch.autocast(device_type=gbuffer.depth.device.type, enabled=False):
            valid = gbuffer.valid_mask
            # Invalid samples get a harmless depth before any arithmetic: a NaN times a zero gradient is still NaN.
            depth = _wide(torch.where(valid, gbuffer.depth, 1.0))
            normal = None if gbuffer.normal is None else _wide(torch.where(valid[:, :1], gbuffer.normal, 0.0))
            visibility = self._visibility(depth, valid, normal, gbuffer.camera, frame=frame, backend=backend)
            visibility = contrast_power(visibility, self.contrast.to(visibility.dtype))
            return torch.where(valid[:, :1], visibility[:, None], 1.0)

    def extra_repr(self) -> str:
        values = [f"{name}={value:.6g}" for name, value in self.values().items()]
        choices = [f"{name}={value!r}" for name, value in self.config().items()]
        return ", ".join([*values, *choices, f"learnable={self.learnable!r}"])

    def _resolve_learnable(self, learnable: str | tuple[str, ...]) -> tuple[str, ...]:
        used = self.used_parameters()
        if learnable == "all":
            return used
        names = (learnable,) if isinstance(learnable, str) else tuple(learnable)
        for name in names:
            checks.check_choice("learnable", name, used)
        return tuple(name for name in used if name in names)


def _wide(tensor: Tensor) -> Tensor:
    return tensor.float() if tensor.dtype in (torch.float16, torch.bfloat16) else tensor
