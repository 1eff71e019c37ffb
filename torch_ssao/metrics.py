"""Masked image metrics: RMSE, PSNR, SSIM."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ssao import checks


def mse(prediction: Tensor, target: Tensor, valid: Tensor | None = None) -> Tensor:
    """Mean squared error over the valid pixels.

    Args:
        prediction, target: (B, 1, H, W) visibility.
        valid: (B, 1, H, W) bool, None for all.
    Returns: 0-d tensor.
    Raises: ShapeError; RangeError when no pixel is valid.
    Gradients: to prediction and target.
    """
    valid = _check(prediction, target, valid)
    error = torch.where(valid, prediction - target, 0.0)
    return error.square().sum() / valid.sum()


def rmse(prediction: Tensor, target: Tensor, valid: Tensor | None = None) -> Tensor:
    """Root of `mse`; arguments as there."""
    return mse(prediction, target, valid).sqrt()


def psnr(prediction: Tensor, target: Tensor, valid: Tensor | None = None) -> Tensor:
    """Peak signal-to-noise ratio 10 log10(1 / mse) in decibel for a peak of 1; arguments as `mse`."""
    return -10 * torch.log10(mse(prediction, target, valid))


def ssim(prediction: Tensor, target: Tensor, valid: Tensor | None = None, *, window: int = 11) -> Tensor:
    """Mean structural similarity over the valid pixels, by kornia, for a dynamic range of 1.

    Args:
        prediction, target: (B, 1, H, W) visibility in [0, 1]; both are set to 1 at invalid pixels first, the
            convention of this library's images.
        valid: (B, 1, H, W) bool, None for all.
        window: odd width of the Gaussian window in pixels.
    Returns: 0-d tensor, at most 1. It falls with the target's noise: quote it beside the reference's own ceiling.
    Raises: ShapeError; RangeError when no pixel is valid or the image is smaller than the window.
    Gradients: to prediction and target.
    Source: Wang et al. 2004, kornia.metrics.ssim.
    """
    from kornia.metrics import ssim as kornia_ssim  # a heavy import that most users never need

    valid = _check(prediction, target, valid)
    if min(prediction.shape[-2:]) < window:
        raise checks.RangeError(
            f"window must fit the image {tuple(prediction.shape[-2:])}, got {window}: use a larger image"
        )
    prediction, target = (torch.where(valid, image, 1.0) for image in (prediction, target))
    quality = kornia_ssim(prediction, target, window, max_val=1.0)
    return torch.where(valid, quality, 0.0).sum() / valid.sum()


def _check(prediction: Tensor, target: Tensor, valid: Tensor | None) -> Tensor:
    for name, tensor in (("prediction", prediction), ("target", target)):
        checks.check_floating(name, tensor)
        checks.check_shape(name, tensor, ("B", 1, "H", "W"), "pass visibility as a technique returns it")
    checks.check_shape("target", target, tuple(prediction.shape), "compare images of one size")
    if valid is None:
        return torch.ones_like(prediction, dtype=torch.bool)
    checks.check_shape("valid", valid, tuple(prediction.shape), "one flag per pixel")
    checks.check_same_device(prediction=prediction, target=target, valid=valid)
    if not bool(valid.any()):
        raise checks.RangeError("valid must hold at least one True pixel, got none: choose another view")
    return valid
