"""How steep a stored plane may be: planes keep their normals, others only what the depth supports; derivatives."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import torch_ssao as ts
from support.gbuffers import plane_gbuffer
from support.ray_march import geometry
from torch_ssao.ops.plane_support import MIN_FACING, STEEP_FACING, least_facing


def least(gb: ts.GBuffer, normal: Tensor | None = None) -> Tensor:
    points, normals, intrinsics = geometry(gb)
    normals = normals if normal is None else normal
    return least_facing(points, normals, gb.valid, intrinsics, orthographic=gb.camera.is_orthographic)


def facing(gb: ts.GBuffer) -> Tensor:
    points, normals, _ = geometry(gb)
    ray = torch.tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1, 1) if gb.camera.is_orthographic else points
    return -(normals * torch.nn.functional.normalize(ray.expand_as(points).double(), dim=1)).sum(1)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("angle", [0.0, 45.0, 80.0, 88.0])
def test_a_plane_keeps_its_normal(angle: float, orthographic: bool) -> None:
    # A cosine of c asks for c / 1.5 at most: the plane's own slope, a third more for what the depth may lack.
    gb = plane_gbuffer(angle, dtype=torch.float64, orthographic=orthographic)
    wanted, own = least(gb)[gb.valid], facing(gb)[gb.valid]
    assert bool((wanted <= own)[own > 0.03].all())
    steep = (own < 0.2) & (own > 0.05)
    torch.testing.assert_close(wanted[steep], own[steep] / 1.5, rtol=1e-6, atol=0)


@pytest.mark.parametrize("orthographic", [False, True])
def test_a_normal_that_the_depth_does_not_support_is_held_back(orthographic: bool) -> None:
    gb = plane_gbuffer(20.0, dtype=torch.float64, orthographic=orthographic)
    grazing = plane_gbuffer(80.0, dtype=torch.float64, orthographic=orthographic).normal[:, :, None]
    assert bool((least(gb, grazing) == STEEP_FACING).all())


def test_samples_without_neighbours_are_taken_at_their_word() -> None:
    gb = plane_gbuffer(20.0, dtype=torch.float64)
    alone = torch.zeros_like(gb.valid)
    alone[..., ::2, ::2] = True
    grazing = plane_gbuffer(80.0, dtype=torch.float64).normal[:, :, None]
    lonely = ts.GBuffer(gb.depth, gb.camera, normal=gb.normal, valid=alone)
    assert bool((least(lonely, grazing) == MIN_FACING).all())


@pytest.mark.parametrize("orthographic", [False, True])
def test_derivatives(orthographic: bool) -> None:
    gb = plane_gbuffer(82.0, height=5, width=6, fov_y_deg=8.0, dtype=torch.float64, orthographic=orthographic)
    points, normals, intrinsics = geometry(gb)
    dice = torch.rand(2, *points.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64) - 0.5
    points, normals = points * (1 + 0.02 * dice[0]), normals + 0.02 * dice[1]

    def answer(points: Tensor, normals: Tensor, intrinsics: Tensor) -> Tensor:
        return least_facing(points, normals, gb.valid, intrinsics, orthographic=orthographic)

    inputs = [tensor.clone().requires_grad_() for tensor in (points, normals, intrinsics)]
    value = answer(*inputs)
    assert bool(((value > MIN_FACING) & (value < STEEP_FACING)).any())
    assert torch.autograd.gradcheck(answer, inputs, check_forward_ad=True)
