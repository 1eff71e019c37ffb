"""Normals from positions: exact on planes, no bleeding, finite on the awkward cases."""

from __future__ import annotations

import pytest
import torch

import torch_ssao as ts
from support.gbuffers import plane_gbuffer
from torch_ssao.ops import normals_from_points


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("angle", [0.0, 30.0, 60.0, 80.0])
def test_plane_is_exact(angle: float, orthographic: bool) -> None:
    gb = plane_gbuffer(angle, orthographic=orthographic, dtype=torch.float64)
    estimated = ts.GBuffer.from_depth(gb.depth, gb.camera).normal
    inside = gb.valid.expand_as(gb.normal)
    torch.testing.assert_close(estimated[inside], gb.normal[inside], atol=1e-9, rtol=0)


def test_no_bleeding_across_a_silhouette() -> None:
    depth = torch.full((1, 1, 8, 8), 5.0)
    depth[..., 4:] = 1.0
    normal = ts.GBuffer.from_depth(depth, ts.Camera.perspective(60.0, 8, 8)).normal
    torch.testing.assert_close(normal, torch.tensor([0.0, 0, -1]).view(1, 3, 1, 1).expand_as(normal))


def test_invalid_neighbours_are_not_used() -> None:
    gb = plane_gbuffer(50.0, dtype=torch.float64)
    depth = gb.depth.clone()
    depth[..., ::3, :] = torch.nan
    depth[..., ::5] = torch.inf
    estimated = ts.GBuffer.from_depth(depth, gb.camera)
    assert torch.isfinite(estimated.normal).all()
    both_sides = estimated.valid[0, 0] & gb.valid[0, 0]
    lonely = torch.zeros_like(both_sides)
    lonely[:, 1::5] = False
    inside = both_sides.expand(3, -1, -1)
    torch.testing.assert_close(estimated.normal[0][inside], gb.normal[0][inside], atol=1e-9, rtol=0)


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (1, 1)])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_thin_images_are_finite(shape: tuple[int, int], dtype: torch.dtype) -> None:
    depth = torch.linspace(1, 2, 9)[: shape[0] * shape[1]].view(1, 1, *shape).to(dtype)
    gb = ts.GBuffer.from_depth(depth, ts.Camera.perspective(60.0, *shape).to(dtype))
    assert gb.normal.dtype == dtype
    assert torch.isfinite(gb.normal).all()
    torch.testing.assert_close(gb.normal.float().norm(dim=1), torch.ones(1, *shape), atol=1e-2, rtol=0)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_unit_length_and_facing_at_any_scale(scale: float) -> None:
    depth = scale * (2 + torch.rand(1, 1, 9, 7, generator=torch.Generator().manual_seed(3)))
    gb = ts.GBuffer.from_depth(depth, ts.Camera.perspective(60.0, 9, 7))
    torch.testing.assert_close(gb.normal.norm(dim=1), torch.ones(1, 9, 7), atol=1e-5, rtol=0)
    towards_eye = -(gb.normal * gb.camera.unproject(gb.depth)[:, :, 0]).sum(1)
    assert (towards_eye > 0).all()


def test_isolated_pixel_faces_its_axes() -> None:
    valid = torch.zeros(1, 5, 5, dtype=torch.bool)
    valid[0, 2, 2] = True
    points = torch.rand(1, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    assert normals_from_points(points, valid)[0, :, 2, 2].tolist() == [0.0, 0.0, -1.0]
