"""Upsampling along surfaces: values kept, edges kept, gradients; and `half_resolution` of every technique."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import torch_ssao as ts
from support.clutter import clutter
from support.gbuffers import random_gbuffer
from torch_ssao.modules import TECHNIQUES
from torch_ssao.ops.upsample import upsample_visibility

SMALL: dict[str, dict[str, Any]] = {
    "statvo": {"layers": 2},
    "hbao": {"slices": 2, "steps": 2, "denoise": 1},
    "ray_march": {"rays": 3, "steps": 3, "denoise": 1},
}


def technique(name: str, **options: Any) -> ts.modules.AmbientVisibility:
    return TECHNIQUES[name](0.6, **SMALL[name], **options)


def question(height: int, width: int, seed: int = 0) -> tuple[Tensor, ...]:
    gb = random_gbuffer(seed, height=height, width=width, batch=2)
    points = gb.camera.unproject(torch.where(gb.valid_mask, gb.depth, 1.0))[:, :, 0]
    normal = torch.nn.functional.normalize(gb.normal, dim=1)
    half = torch.rand(2, (height + 1) // 2, (width + 1) // 2, generator=torch.Generator().manual_seed(seed)).double()
    return half, points, normal, gb.valid_mask[:, 0], torch.tensor([0.3, 0.7]).double()


@pytest.mark.parametrize("size", [(1, 1), (1, 4), (5, 1), (6, 8), (7, 9)])
def test_computed_pixels_keep_their_value_and_others_stay_within_range(size: tuple[int, int]) -> None:
    half, points, normal, valid, radius = question(*size)
    full = upsample_visibility(half, points, normal, valid, radius)
    assert full.shape == valid.shape
    kept = valid[:, ::2, ::2]
    torch.testing.assert_close(full[:, ::2, ::2][kept], half[kept])
    assert bool(((full >= 0) & (full <= 1)).all())
    constant = upsample_visibility(torch.full_like(half, 0.3), points, normal, torch.ones_like(valid), radius)
    torch.testing.assert_close(constant, torch.full_like(constant, 0.3))


def test_no_value_crosses_a_depth_step_or_a_crease() -> None:
    points = torch.zeros(1, 3, 5, 9).double()
    points[:, 0] = torch.arange(9) * 0.01
    normal = torch.tensor([0.0, 0.0, -1.0]).double().view(1, 3, 1, 1).repeat(1, 1, 5, 9)
    for change in ("depth", "normal"):
        place, facing = points.clone(), normal.clone()
        if change == "depth":
            place[:, 2, :, 5:] = 1.0  # column 5 is computed by nobody: its neighbours are 4, before, and 6, behind
        else:
            facing[:, :, :, 5:] = torch.tensor([-1.0, 0.0, 0.0]).double().view(1, 3, 1, 1)
        half = torch.zeros(1, 3, 5).double()
        half[:, :, 3:] = 1.0
        full = upsample_visibility(half, place, facing, torch.ones(1, 5, 9, dtype=torch.bool), torch.ones(1).double())
        assert float(full[:, :, :5].max()) < 2e-3, change
        assert float(full[:, :, 5:].min()) > 1 - 2e-3, change


def test_invalid_pixels_lend_nothing() -> None:
    half, points, normal, valid, radius = question(6, 8)
    valid = torch.ones_like(valid)
    valid[:, :, 4] = False
    spoiled = torch.where(valid[:, ::2, ::2], half, torch.rand_like(half))
    a, b = (upsample_visibility(h, points, normal, valid, radius) for h in (half, spoiled))
    torch.testing.assert_close(a[valid], b[valid])
    nobody = upsample_visibility(half, points, normal, torch.zeros_like(valid), radius)
    assert bool((nobody == 1).all())


def test_gradcheck() -> None:
    half, points, normal, valid, radius = question(3, 4)
    leaves = [t.clone().requires_grad_() for t in (half, points, normal, radius)]
    assert torch.autograd.gradcheck(
        lambda h, x, n, r: upsample_visibility(h, x, n, valid, r), leaves, check_forward_ad=True
    )


def test_the_halved_camera_sees_the_same_rays() -> None:
    for orthographic in (False, True):
        gb = random_gbuffer(1, height=7, width=10, orthographic=orthographic)
        depth = torch.rand(1, 1, 7, 10).double() + 1
        full, half = gb.camera.unproject(depth), gb.camera.halved().unproject(depth[..., ::2, ::2])
        torch.testing.assert_close(half, full[..., ::2, ::2])


@pytest.mark.parametrize("name", SMALL)
def test_half_resolution_is_the_technique_on_every_other_pixel(name: str) -> None:
    gb = clutter(30, 41, views=2)
    full = technique(name, half_resolution=True)(gb)
    few = ts.GBuffer(
        gb.depth[..., ::2, ::2],
        gb.camera.halved(),
        normal=gb.normal[..., ::2, ::2],
        valid=None if gb.valid is None else gb.valid[..., ::2, ::2],
    )
    torch.testing.assert_close(full[..., ::2, ::2], technique(name)(few))
    assert bool((full[~gb.valid_mask[:, :1]] == 1).all())
    close = (full - technique(name)(gb)).abs()
    assert float(close.mean()) < 0.03


@pytest.mark.parametrize("name", SMALL)
def test_half_resolution_is_differentiable_vmaps_and_is_saved(name: str, tmp_path: Any) -> None:
    gb = clutter(16, 21, views=2).to(torch.float64)
    net = technique(name, half_resolution=True, learnable="all").double()
    depth = gb.depth.clone().requires_grad_()
    image = net(ts.GBuffer(depth, gb.camera, normal=gb.normal, valid=gb.valid))
    cotangent = torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=image.dtype)
    (image * cotangent).sum().backward()
    assert bool(torch.isfinite(depth.grad).all())
    assert bool((depth.grad[~gb.valid_mask] == 0).all())
    assert float(depth.grad[..., 1::2, 1::2].abs().max()) > 0
    assert all(abs(float(p.grad)) > 0 for n, p in net.named_parameters() if n in ("raw_radius", "raw_contrast"))
    torch.testing.assert_close(torch.func.vmap(net)(gb), image)
    ts.save(net, tmp_path / "net.json")
    assert torch.equal(ts.load(tmp_path / "net.json")(gb), image)


def test_a_plane_stays_open_seen_at_80_degrees() -> None:
    camera = ts.Camera.perspective(15.0, 24, 33)
    _, y = camera.rays(dtype=torch.float64)
    tilt = torch.tensor(80.0).deg2rad().double()
    depth = (2 * tilt.cos() / (y * tilt.sin() + tilt.cos())).expand(1, 24, 33)[:, None]
    normal = torch.stack((torch.zeros_like(tilt), -tilt.sin(), -tilt.cos()))
    gb = ts.GBuffer(depth, camera, normal=normal.view(1, 3, 1, 1).expand(1, 3, 24, 33))
    for name in SMALL:
        image = technique(name, half_resolution=True).double()(gb)
        assert float((image - technique(name).double()(gb)).abs().max()) < 1e-3, name
