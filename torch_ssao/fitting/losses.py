"""What a difference between prediction and target costs: squares, soft-L1, and losses of whole images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_ssao import checks, metrics

SQUARES = ("l2", "soft_l1")
"""Losses that are sums over pixels of the square of something: what least-squares solvers take."""
ImageLoss = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(prediction, target, valid), each (1, 1, H, W), to a 0-d tensor that falls as the prediction gets better."""


def robust_residual(difference: Tensor, loss: str, scale: float) -> tuple[Tensor, Tensor]:
    """Signed roots of the loss of each difference, and their slope: least squares of these minimises the loss.

    Args:
        difference: (N,) prediction - target.
        loss: "l2": d^2; "soft_l1": 2 s^2 (sqrt(1 + d^2 / s^2) - 1), which grows like 2 s |d| beyond the scale s.
        scale: s, > 0.
    Returns: (N,) r with r^2 = loss and the sign of d, and (N,) dr/dd > 0.
    Source: soft-L1 as in Triggs et al. 2000, "Bundle adjustment", section 4; taking roots keeps every solver exact.
    """
    if loss == "l2":
        return difference, torch.ones_like(difference)
    root = (1 + (difference / scale).square()).sqrt()
    # 2 s^2 (root - 1) = 2 d^2 / (root + 1), without cancellation
    shrink = (2 / (root + 1)).sqrt()
    return difference * shrink, 1 / (root * shrink)


def image_loss(loss: str | ImageLoss) -> ImageLoss:
    """A loss of whole images: "l2" the mean square, "ssim" 1 - SSIM, or the caller's own function.

    Raises: ChoiceError.
    """
    if callable(loss):
        return loss
    known: dict[str, Any] = {"l2": metrics.mse, "ssim": _one_minus_ssim}
    checks.check_choice("loss", loss, known)
    return known[loss]  # type: ignore[no-any-return]


def _one_minus_ssim(prediction: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    return 1 - metrics.ssim(prediction, target, valid)
