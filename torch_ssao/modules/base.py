"""The abstract base of all techniques: learnable positive parameters, configuration, the forward frame."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.gbuffer import GBuffer
from torch_ssao.ops.denoise import denoise_visibility
from torch_ssao.ops.falloff import contrast_power
from torch_ssao.ops.normals import normals_from_points
from torch_ssao.ops.upsample import upsample_visibility

LEAST_LENGTH = 1e-6  # of a normal: shorter ones are noise


@dataclass(frozen=True)
class ParameterSpec:
    """A continuous parameter: its meaning and the range a fit searches. Positive, unless it says otherwise.

    Args:
        unit: "scene units" or "of the radius" or "degrees" or "1".
        low, high: fit bounds; for the radius they multiply the starting value, for all others they are absolute.
        relative_bounds: whether low and high multiply the starting value.
        optional: whether it may be None, which switches off what it controls.
        may_be_zero: whether it may be 0. A parameter at 0 or None is not in use: nothing moves it from there.
        meaning: one line for tables and error messages.
    """

    unit: str
    low: float
    high: float
    meaning: str
    relative_bounds: bool = False
    optional: bool = False
    may_be_zero: bool = False


class Positive:
    """Property over the unconstrained storage `raw_<name>`: the parameter is exp(raw), None where raw is None."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, module: nn.Module | None, owner: type | None = None) -> Any:
        if module is None:
            return self
        raw = getattr(module, f"raw_{self.name}")
        return None if raw is None else raw.exp()

    def __set__(self, module: AmbientVisibility, value: float | Tensor | None) -> None:
        plain = value.detach() if isinstance(value, Tensor) else value
        module.check_value(self.name, plain)
        raw = getattr(module, f"raw_{self.name}")
        if plain is not None and raw is not None:
            with torch.no_grad():
                raw.copy_(torch.as_tensor(plain, dtype=torch.float64).log())
        elif plain is None and raw is not None:
            setattr(module, f"raw_{self.name}", None)
        elif plain is not None:
            like: Tensor = module.radius
            setattr(module, f"raw_{self.name}", torch.as_tensor(plain, dtype=torch.float64).log().to(like))


class AmbientVisibility(nn.Module, abc.ABC):
    """Abstract base: a module from a G-buffer to ambient visibility.

    A technique names its continuous parameters in `PARAMETERS`, declares one `Positive` for each, and computes
    `_visibility`.
    """

    PARAMETERS: ClassVar[dict[str, ParameterSpec]]
    CHOICES: ClassVar[tuple[str, ...]]  # discrete configuration, plain attributes
    BACKENDS: ClassVar[tuple[str, ...]] = ("auto", "torch")  # those that `forward` takes

    radius = Positive()
    contrast = Positive()
    denoise: int = 0  # passes of the edge-aware filter; techniques without noise have none
    half_resolution: bool = False  # compute every other row and column, upsample

    def __init__(
        self, values: Mapping[str, float | None], choices: dict[str, Any], learnable: str | tuple[str, ...]
    ) -> None:
        super().__init__()
        for name, value in choices.items():
            setattr(self, name, value)
        self.learnable: tuple[str, ...] = ()
        for name in self.PARAMETERS:
            value = values[name]
            self.check_value(name, value.detach() if isinstance(value, Tensor) else value)
            raw = None if value is None else torch.tensor(_log(float(value)), dtype=torch.get_default_dtype())
            self.register_buffer(f"raw_{name}", raw)
        self.learnable = self._resolve_learnable(learnable)
        for name in self.learnable:
            raw = self._buffers.pop(f"raw_{name}")
            self.register_parameter(f"raw_{name}", nn.Parameter(raw))  # type: ignore[arg-type]

    @abc.abstractmethod
    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        """(B, H, W) visibility before contrast.

        `depth` (B, L, H, W) and `normal` (B, 3, H, W) are finite everywhere and at least float32, normals of length 1; what
        is returned at invalid pixels is ignored.
        """

    def used_parameters(self) -> tuple[str, ...]:
        """Names of the continuous parameters that this configuration uses, in the order of `PARAMETERS`."""
        unused = self._unused_parameters()
        return tuple(name for name in self.PARAMETERS if name not in unused and self._is_on(name))

    def _unused_parameters(self) -> tuple[str, ...]:
        """Parameters that the discrete choices leave without effect."""
        return ()

    def _is_on(self, name: str) -> bool:
        raw = getattr(self, f"raw_{name}")
        return raw is not None and not bool(torch.isneginf(raw.detach()))

    def check_value(self, name: str, value: float | Tensor | None) -> None:
        """Raise `RangeError` unless `value` is one that the parameter may take."""
        spec = self.PARAMETERS[name]
        off = value is None or (spec.may_be_zero and bool(value == 0))
        if off and name in self.learnable:
            raise checks.RangeError(
                f"{name} must stay above 0 while it is learnable, got {value}: leave it out of learnable"
            )
        if value is None and not spec.optional:
            raise checks.RangeError(f"{name} must be a number, got None: pass a positive {name}")
        if not off:
            checks.check_positive(name, value)  # type: ignore[arg-type]

    def values(self) -> dict[str, float]:
        """The continuous parameters as plain numbers, by name; those that are None are left out."""
        named = {name: getattr(self, name) for name in self.PARAMETERS}
        return {name: float(value.detach()) for name, value in named.items() if value is not None}

    def config(self) -> dict[str, Any]:
        """The discrete choices, by name."""
        return {name: getattr(self, name) for name in self.CHOICES}

    def forward(self, gbuffer: GBuffer, *, frame: int = 0, backend: str = "auto") -> Tensor:
        """Ambient visibility of a G-buffer.

        Args:
            gbuffer: see `GBuffer`; float16 and bfloat16 depth is computed in float32. Normals are made unit; zero ones, and
                those that are not finite, face the eye plane. Works without the batch dimension under `torch.func.vmap`.
            frame: integer offset of the noise pattern, for techniques that have one.
            backend: "torch"; "numba", compiled loops on the CPU (extra `cpu`), for techniques that have them; or "auto", the
                faster of what there is. It changes speed, never the number.
        Returns: (B, 1, H, W) visibility in [0, 1]; 1 and gradient 0 at invalid pixels.
        Gradients: to depth, normal (through its length too: none along itself), camera and the module's parameters.
        """
        checks.check_choice("backend", backend, self.BACKENDS)
        if gbuffer.depth.ndim == 3:  # inside vmap
            batched = pytree.tree_map(lambda leaf: leaf.unsqueeze(0), gbuffer)
            return self.forward(batched, frame=frame, backend=backend).squeeze(0)
        with torch.autocast(device_type=gbuffer.depth.device.type, enabled=False):
            depth, valid, normal = self._prepared(gbuffer)
            if self.half_resolution:
                visibility = self._upsampled(gbuffer, depth, valid, normal, frame=frame, backend=backend)
            else:
                visibility = self._visibility(depth, valid, normal, gbuffer.camera, frame=frame, backend=backend)
                visibility = self._denoised(visibility, depth, valid, normal, gbuffer.camera)
            return self._finished(visibility, valid)

    @staticmethod
    def _prepared(gbuffer: GBuffer) -> tuple[Tensor, Tensor, Tensor | None]:
        """Depth, validity and normals of a G-buffer as `_visibility` takes them."""
        valid = gbuffer.valid_mask
        # Invalid samples get a harmless depth before any arithmetic: a NaN times a zero gradient is still NaN.
        depth = _wide(torch.where(valid, gbuffer.depth, 1.0))
        normal = None if gbuffer.normal is None else _unit(_wide(gbuffer.normal), valid[:, :1])
        return depth, valid, normal

    def _finished(self, visibility: Tensor, valid: Tensor) -> Tensor:
        """(B, 1, H, W): raised to the contrast, 1 at invalid pixels."""
        visibility = contrast_power(visibility, self.contrast.to(visibility.dtype))
        return torch.where(valid[:, :1], visibility[:, None], 1.0)

    def _denoised(
        self, visibility: Tensor, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera
    ) -> Tensor:
        """`denoise` passes of the edge-aware filter over the visibility (B, H, W)."""
        if not self.denoise:
            return visibility
        points, normal = _surface(depth, valid, normal, camera)
        radius = self.radius.to(depth.dtype).expand(depth.shape[0])
        return denoise_visibility(visibility, points, normal, valid[:, 0], radius, passes=self.denoise)

    def _upsampled(
        self, gbuffer: GBuffer, depth: Tensor, valid: Tensor, normal: Tensor | None, *, frame: int, backend: str
    ) -> Tensor:
        """Visibility of every other row and column, denoised there, carried to the rest along surfaces."""
        points, full_normal = _surface(depth, valid, normal, gbuffer.camera)
        few = None if normal is None else normal[..., ::2, ::2]
        small, camera = (depth[..., ::2, ::2], valid[..., ::2, ::2], few), gbuffer.camera.halved()
        visibility = self._visibility(*small, camera, frame=frame, backend=backend)
        visibility = self._denoised(visibility, *small, camera)
        radius = self.radius.to(depth.dtype).expand(depth.shape[0])
        return upsample_visibility(visibility, points, full_normal, valid[:, 0], radius)

    def extra_repr(self) -> str:
        off = {name: None for name in self.PARAMETERS if getattr(self, name) is None}
        values = [f"{name}={value:.6g}" for name, value in self.values().items()] + [f"{name}=None" for name in off]
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


def _surface(depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera) -> tuple[Tensor, Tensor]:
    """Positions and normals (B, 3, H, W) of the nearest layer."""
    points = camera.unproject(depth[:, :1])[:, :, 0]
    return points, normals_from_points(points, valid[:, 0]) if normal is None else normal


def _log(value: float) -> float:
    return math.log(value) if value > 0 else -math.inf  # exp brings 0 back


def _unit(normal: Tensor, seen: Tensor) -> Tensor:
    """Normals of length 1: interpolation leaves them shorter. One that is not seen, or that has no length to divide by (zero,
    not finite, or with a square that is not) faces the eye plane, with gradient 0: it must not spoil the others' gradients."""
    square = normal.detach().square().sum(1, keepdim=True)
    usable = seen & torch.isfinite(square) & (square > LEAST_LENGTH**2)
    facing = normal.new_tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1)
    kept = torch.where(usable, normal, facing)
    return kept / torch.linalg.vector_norm(kept, dim=1, keepdim=True)


def _wide(tensor: Tensor) -> Tensor:
    return tensor.float() if tensor.dtype in (torch.float16, torch.bfloat16) else tensor
