"""psi and the contrast power: values, derivatives, the clamps."""

from __future__ import annotations

import torch

from torch_ssao.ops import contrast_power, psi
from torch_ssao.ops.falloff import CONTRAST_FLOOR


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
