"""Masked metrics against numbers worked out by hand."""

from __future__ import annotations

import pytest
import torch

from torch_ssao import checks, metrics


def images() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(2, 1, 16, 20, generator=generator)
    valid = torch.rand(2, 1, 16, 20, generator=generator) > 0.3
    return target + 0.1, target, valid


def test_rmse_and_psnr_ignore_invalid_pixels() -> None:
    prediction, target, valid = images()
    spoiled = torch.where(valid, prediction, torch.nan)
    assert metrics.rmse(spoiled, target, valid).item() == pytest.approx(0.1, rel=1e-5)
    assert metrics.psnr(spoiled, target, valid).item() == pytest.approx(20.0, abs=1e-4)
    assert metrics.mse(prediction, target).item() == pytest.approx(0.01, rel=1e-5)


def test_ssim_is_one_for_equal_images_and_falls_with_noise() -> None:
    _, target, valid = images()
    assert metrics.ssim(target, target, valid).item() == pytest.approx(1.0)
    noisy = (target + 0.2 * torch.randn(target.shape, generator=torch.Generator().manual_seed(1))).clamp(0, 1)
    assert metrics.ssim(noisy, target, valid) < 0.98
    assert metrics.ssim(torch.where(valid, target, torch.nan), target, valid).item() == pytest.approx(1.0)


def test_gradients_flow() -> None:
    prediction, target, valid = images()
    prediction.requires_grad_()
    (1 - metrics.ssim(prediction, target, valid) + metrics.rmse(prediction, target, valid)).backward()
    assert torch.isfinite(prediction.grad).all()
    assert prediction.grad.abs().max() > 0


def test_errors() -> None:
    prediction, target, valid = images()
    with pytest.raises(checks.ShapeError, match="target must have shape"):
        metrics.rmse(prediction, target[:1])
    with pytest.raises(checks.ShapeError, match="prediction must have shape"):
        metrics.rmse(prediction[0], target)
    with pytest.raises(checks.RangeError, match="valid must hold at least one"):
        metrics.rmse(prediction, target, torch.zeros_like(valid))
    with pytest.raises(checks.RangeError, match="window must fit"):
        metrics.ssim(prediction[..., :8], target[..., :8])
