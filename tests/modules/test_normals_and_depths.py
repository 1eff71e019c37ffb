"""What every technique makes of normals that are not unit, and of depths that no surface has."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import torch_ssao as ts
from support.gbuffers import plane_gbuffer, steps_gbuffer
from support.hard_cases import TECHNIQUES, derivatives, make


@pytest.mark.parametrize("name", TECHNIQUES)
def test_lengths_of_normals_do_not_matter_and_zero_ones_face_the_eye(name: str) -> None:
    gb, net = steps_gbuffer(height=24, width=32, dtype=torch.float64), make(name, 0.4)
    assert gb.normal is not None
    facing = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).view(1, 3, 1, 1)
    odd = torch.zeros(gb.depth.shape, dtype=torch.bool)
    odd[..., ::3, ::2] = True
    known = net(replace(gb, normal=torch.where(odd, facing, gb.normal)))
    for bad in (0.0, 1e-9, torch.nan, torch.inf, 1e200):
        torch.testing.assert_close(net(replace(gb, normal=torch.where(odd, bad, gb.normal))), known, atol=1e-12, rtol=0)
    for length in (1e-3, 0.7, 6e4):
        torch.testing.assert_close(net(replace(gb, normal=gb.normal * length)), net(gb), atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", TECHNIQUES)
def test_the_derivative_to_a_normal_is_across_it(name: str) -> None:
    gb = steps_gbuffer(height=24, width=32, dtype=torch.float64)
    assert gb.normal is not None
    long = replace(gb, normal=2 * gb.normal)
    unit, double = (derivatives(name, image, torch.float64, radius=0.4)[1][1] for image in (gb, long))
    assert bool((unit != 0).any())
    assert (unit * gb.normal).sum(1).abs().max() < 1e-9 * unit.abs().max()
    torch.testing.assert_close(2 * double, unit, atol=1e-9 * float(unit.abs().max()), rtol=0)


@pytest.mark.parametrize("name", TECHNIQUES)
def test_float16_normals_do_not_overflow(name: str) -> None:
    gb = steps_gbuffer(height=24, width=32, dtype=torch.float64).to(torch.float16)
    assert gb.normal is not None
    net = make(name, 0.4).float()
    image = net(replace(gb, normal=gb.normal * 3e4))
    assert (image - net(gb)).abs().max() < 0.02  # float16 rounds the products


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", TECHNIQUES)
def test_depths_at_the_limits_are_surfaces_and_stay_finite(name: str, dtype: torch.dtype) -> None:
    gb = steps_gbuffer(height=24, width=32, dtype=torch.float64)
    most = 1e100 if dtype == torch.float64 else 1e12
    dice = torch.rand(gb.depth.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for depth in (0.99 * most, 1.01 / most):
        edge = replace(gb, depth=torch.where(dice < 0.06, depth, gb.depth))
        assert bool(edge.to(dtype).valid_mask.all())
        image, grads = derivatives(name, edge, dtype)
        assert bool(((image >= 0) & (image <= 1)).all())
        assert all(bool(torch.isfinite(grad).all()) for grad in grads)


@pytest.mark.parametrize(("dtype", "most"), [(torch.float32, 1e12), (torch.float64, 1e100), (torch.bfloat16, 1e12)])
def test_depths_beyond_the_limits_are_invalid(dtype: torch.dtype, most: float) -> None:
    gb = plane_gbuffer(0.0, height=1, width=5, dtype=torch.float64)
    depth = torch.tensor([0.9 * most, 1.1 * most, 1.1 / most, 0.9 / most, 1.0], dtype=torch.float64).view(1, 1, 1, 5)
    assert replace(gb, depth=depth, valid=None).to(dtype).valid_mask.flatten().tolist()[::4] == [True, True]
    built = ts.GBuffer(depth.to(dtype), gb.camera)
    assert built.valid_mask.flatten().tolist() == [True, False, True, False, True]


def test_float16_has_neither_limit_and_still_no_zero_and_no_infinity() -> None:
    gb = plane_gbuffer(0.0, height=1, width=4, dtype=torch.float64)
    depth = torch.tensor([0.0, torch.inf, 6e-8, 65504.0], dtype=torch.float16).view(1, 1, 1, 4)
    assert ts.GBuffer(depth, gb.camera).valid_mask.flatten().tolist() == [False, False, True, True]
