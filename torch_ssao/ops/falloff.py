"""The shared response curves: the attenuation with distance, StatVO's psi and the contrast power."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

CONTRAST_FLOOR = 1e-3  # visibility is clamped to this inside the derivative of A^alpha (infinite at 0 for alpha < 1)

DISTANCE_FLOOR = 1e-3  # t is clamped to this inside the derivative of t^p to t (infinite at 0 for p < 1)


def attenuation(t: Tensor, power: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How much an occluder at a distance counts, and the two derivatives: W_p(t) = 1 - t^p for t < 1, else 0.

    Args:
        t: distance as a fraction of the radius, >= 0, any shape; inf is allowed.
        power: p > 0, broadcastable to t; 1 is linear, 2 is HBAO's, a large p approaches the binary hit.
    Returns: W, d W / d t, d W / d power, each of the shape of t.
    Gradients: by the returned derivatives, 0 from t = 1 on; for p < 1, t is clamped to `DISTANCE_FLOOR` inside d W / d t.
    Source: ray-marched SSAO paper (p = 1), HBAO (p = 2).
    """
    near = t < 1
    inside = torch.where(near, t, 1.0)
    raised = inside**power
    floor = torch.where(power < 1, DISTANCE_FLOOR, 0.0)
    to_t = torch.where(near, -power * torch.maximum(inside, floor.to(t.dtype)) ** (power - 1), 0.0)
    to_power = -raised * inside.clamp(min=torch.finfo(t.dtype).tiny).log()
    return 1 - raised, to_t, to_power


def psi(s: Tensor, slope: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """StatVO's response to the mean height of a layer, and its two derivatives.

    psi(s) = 0 for s < 0, s on [0, 1], max(0, 1 - slope (s - 1)) above.

    Args:
        s: mean height over the surface as a fraction of the box height, any shape, finite.
        slope: how fast samples above the box stop to count, > 0, broadcastable to s.
    Returns: psi, d psi / d s, d psi / d slope, each of the shape of s.
    Gradients: by the returned derivatives; at the kinks those of the left side.
    Source: Statistical Volumetric Obscurance, Eq. 4 and Fig. 3a.
    """
    above = s > 1
    tail = 1 - slope * (s - 1)
    value = torch.where(above, tail, s).clamp(min=0)
    rising = ((s > 0) & ~above).to(s.dtype)
    falling = (above & (tail > 0)).to(s.dtype)
    return value, rising - falling * slope, falling * (1 - s)


class _ContrastPower(torch.autograd.Function):
    """A^alpha with A clamped inside the derivative."""

    generate_vmap_rule = True

    @staticmethod
    def forward(visibility: Tensor, alpha: Tensor) -> Tensor:
        return visibility**alpha

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        to_visibility, to_alpha = _contrast_derivatives(*ctx.saved_tensors)
        return grad * to_visibility, (grad * to_alpha).sum_to_size(ctx.saved_tensors[1].shape)


class _ContrastPowerWithJvp(_ContrastPower):
    """The same with forward mode, which dynamo refuses to trace."""

    @staticmethod
    def jvp(ctx: Any, visibility_t: Tensor | None, alpha_t: Tensor | None) -> Tensor:
        visibility, alpha = ctx.saved_tensors
        to_visibility, to_alpha = _contrast_derivatives(visibility, alpha)
        tangent = torch.zeros_like(to_visibility)
        if visibility_t is not None:
            tangent = tangent + to_visibility * visibility_t
        if alpha_t is not None:
            tangent = tangent + to_alpha * alpha_t
        return tangent


def contrast_power(visibility: Tensor, alpha: Tensor) -> Tensor:
    """Contrast A^alpha.

    Args:
        visibility: any shape, in [0, 1].
        alpha: 0-d, > 0; 1 leaves the image as it is.
    Returns: the shape of visibility, in [0, 1].
    Gradients: to both; inside the derivative A is clamped to `CONTRAST_FLOOR`, so that alpha < 1 stays finite at A = 0.
    Source: ray-marched SSAO paper, Eq. 2.
    """
    function = _ContrastPower if torch.compiler.is_compiling() else _ContrastPowerWithJvp
    return function.apply(visibility, alpha)


def _contrast_derivatives(visibility: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    clamped = visibility.clamp(min=CONTRAST_FLOOR)
    return alpha * clamped ** (alpha - 1), visibility**alpha * clamped.log()
