"""Attenuation, psi and the contrast power: values, derivatives, the clamps."""

from __future__ import annotations

import pytest
import torch

from torch_ssao.ops import attenuation, contrast_power, psi
from torch_ssao.ops.falloff import CONTRAST_FLOOR, DISTANCE_FLOOR


def test_psi_by_hand() -> None:
    s = torch.tensor([-1.0, 0.0, 0.25, 1.0, 1.5, 3.0, 9.0], dtype=torch.float64)
    value, by_s, by_slope = psi(s, torch.tensor(0.5, dtype=torch.float64))
    assert value.tolist() == [0.0, 0.0, 0.25, 1.0, 0.75, 0.0, 0.0]
    assert by_s.tolist() == [0.0, 0.0, 1.0, 1.0, -0.5, 0.0, 0.0]
    assert by_slope.tolist() == [0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0]


def test_contrast_gradients() -> None:
    visibility = torch.tensor([0.2, 0.7, 1.0], dtype=torch.float64, requires_grad=True)
    alpha = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(contrast_power, (visibility, alpha), check_forward_ad=True, check_batched_grad=True)


def test_contrast_derivative_is_finite_at_zero() -> None:
    visibility = torch.zeros(1, requires_grad=True)
    alpha = torch.tensor(0.5, requires_grad=True)
    contrast_power(visibility, alpha).backward()
    torch.testing.assert_close(visibility.grad, torch.tensor([0.5 * CONTRAST_FLOOR**-0.5]))
    assert alpha.grad == 0


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0, 30.0])
def test_attenuation_by_hand_and_by_differences(power: float) -> None:
    t = torch.tensor([0.0, 0.25, 0.9, 1.0, 1.5, torch.inf], dtype=torch.float64)
    p = torch.tensor(power, dtype=torch.float64)
    value, by_t, by_p = attenuation(t, p)
    torch.testing.assert_close(value, torch.where(t < 1, 1 - t.clamp(max=1) ** power, 0.0))
    step = 1e-6
    inner = t[1:3]
    rise = attenuation(inner + step, p)[0] - attenuation(inner - step, p)[0]
    torch.testing.assert_close(by_t[1:3], rise / (2 * step), atol=1e-7, rtol=1e-7)
    rise = attenuation(inner, p + step)[0] - attenuation(inner, p - step)[0]
    torch.testing.assert_close(by_p[1:3], rise / (2 * step), atol=1e-7, rtol=1e-7)
    assert (by_t[3:] == 0).all()
    assert (by_p[3:] == 0).all()


def test_attenuation_derivatives_are_finite_at_zero() -> None:
    for dtype in (torch.float32, torch.float64):
        _, by_t, by_p = attenuation(torch.zeros(1, dtype=dtype), torch.tensor(0.5, dtype=dtype))
        torch.testing.assert_close(by_t, torch.tensor([-0.5 * DISTANCE_FLOOR**-0.5], dtype=dtype))
        assert by_p == 0
