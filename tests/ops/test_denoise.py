"""The denoiser: constants, edges, masks, noise, derivatives, memory."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.func import grad, jacfwd, jvp, vmap

import torch_ssao as ts
from support.gbuffers import plane_gbuffer, random_gbuffer
from support.memory import peak_bytes
from torch_ssao import checks
from torch_ssao.ops.denoise import denoise_visibility


def inputs(gb: ts.GBuffer) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, normals and validity of the nearest layer."""
    return gb.camera.unproject(gb.depth)[:, :, 0], gb.normal, gb.valid[:, 0]


def smooth_scene(seed: int = 0, batch: int = 2, height: int = 6, width: int = 7) -> tuple[Tensor, ...]:
    """Noise on a bumpy surface whose weights are neither 0 nor 1."""
    gb = random_gbuffer(seed, batch=batch, height=height, width=width, invalid=0.2)
    gb = ts.GBuffer(2 + 0.02 * (gb.depth - 2), gb.camera, normal=gb.normal, valid=gb.valid)
    noise = torch.rand(batch, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    normal = torch.nn.functional.normalize(gb.normal + torch.tensor([0.0, 0.0, -2.0]).view(1, 3, 1, 1), dim=1)
    points, _, valid = inputs(gb)
    return noise, points, normal, valid, torch.tensor([1.5, 2.5], dtype=torch.float64)[:batch]


@pytest.mark.parametrize("passes", [1, 2, 3])
def test_constants_stay_bit_for_bit(passes: int) -> None:
    _, points, normal, valid, radius = smooth_scene()
    flat = torch.full(points[:, 0].shape, 0.3, dtype=torch.float32)
    out = denoise_visibility(flat, points.float(), normal.float(), valid, radius.float(), passes=passes)
    assert torch.equal(out, flat)


def test_symmetric_weights_by_hand() -> None:
    """Two pixels: what one gives the other takes, by the documented weight."""
    points = torch.tensor([[0.0, 0.0, 2.0], [0.3, 0.0, 2.02]], dtype=torch.float64).T[None, :, None]
    angle = 0.2
    normal = torch.tensor([[0, 0, -1], [math.sin(angle), 0, -math.cos(angle)]], dtype=torch.float64).T[None, :, None]
    value = torch.tensor([[[0.2, 0.9]]], dtype=torch.float64)
    radius = torch.tensor([1.0], dtype=torch.float64)
    out = denoise_visibility(value, points, normal, torch.ones(1, 1, 2, dtype=torch.bool), radius, passes=1)
    planes = 0.02**2 + (0.3 * math.sin(angle) - 0.02 * math.cos(angle)) ** 2
    weight = 4 * math.exp(-planes / 0.1**2 - (0.3**2 + 0.02**2)) * math.cos(angle) ** 16
    share = weight / (4 + weight)
    torch.testing.assert_close(out[0, 0], torch.tensor([0.2 + 0.7 * share, 0.9 - 0.7 * share], dtype=torch.float64))


def test_mirrored_input_gives_the_mirrored_output() -> None:
    noise, points, normal, valid, radius = smooth_scene()
    out = denoise_visibility(noise, points, normal, valid, radius, passes=2)
    mirrored = denoise_visibility(noise.flip(2), points.flip(3), normal.flip(3), valid.flip(2), radius, passes=2)
    torch.testing.assert_close(mirrored.flip(2), out, atol=1e-14, rtol=0)


def edge_scene(kind: str) -> tuple[ts.GBuffer, Tensor]:
    """A plate half a radius in front of a plane, or two planes at right angles, and the mask of one side."""
    camera = ts.Camera.perspective(50.0, 40, 40)
    x, _ = camera.rays()
    left = (x < 0.02).expand(1, 40, 40)
    if kind == "step":
        depth = torch.where(left, 3.5, 4.0)
        normal = torch.tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1).expand(1, 3, 40, 40)
    else:
        x = x.expand(1, 40, 40)
        depth = 4 / (1 + x.abs())  # the planes z = 4 -+ x
        depth = torch.where(x < 0.02, 4 / (1 - x), 4 / (1 + x)) if kind == "ridge" else depth
        sign = torch.where(left, 1.0, -1.0)
        sign = -sign if kind == "ridge" else sign
        normal = torch.stack((sign, torch.zeros_like(sign), -torch.ones_like(sign)), 1) / math.sqrt(2)
    return ts.GBuffer(depth[:, None], camera, normal=normal), left


@pytest.mark.parametrize("kind", ["step", "groove", "ridge"])
def test_a_step_between_two_planes_is_kept(kind: str) -> None:
    gb, left = edge_scene(kind)
    for passes in (1, 2, 3):
        out = denoise_visibility(left.float(), *inputs(gb), torch.tensor([1.0]), passes=passes)
        assert (out - left.float()).abs().max() <= 1e-3


@pytest.mark.parametrize("angle", [0.0, 60.0])
def test_noise_goes(angle: float) -> None:
    gb = plane_gbuffer(angle, height=64, width=64)
    noise = torch.rand(1, 64, 64, generator=torch.Generator().manual_seed(3))
    deviations = [
        denoise_visibility(noise, *inputs(gb), torch.tensor([1.0]), passes=passes)[:, 12:-12, 12:-12].std()
        for passes in (0, 1, 2)
    ]
    assert deviations[1] < 0.3 * deviations[0]
    assert deviations[2] < 0.5 * deviations[1]


def test_invalid_pixels_never_leak() -> None:
    noise, points, normal, valid, radius = smooth_scene()
    garbage = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e30], dtype=torch.float64)[torch.arange(7) % 4]
    dirty = [torch.where(mask, t, garbage) for mask, t in ((valid, noise), (valid[:, None], points))]
    leaves = [t.clone().requires_grad_() for t in (*dirty, torch.where(valid[:, None], normal, garbage))]
    out = denoise_visibility(*leaves, valid, radius, passes=2)
    clean = denoise_visibility(noise, points, normal, valid, radius, passes=2)
    assert torch.equal(out[valid], clean[valid])
    torch.testing.assert_close(out[~valid], leaves[0][~valid], equal_nan=True, rtol=0, atol=0)
    (out[valid] * torch.randn(int(valid.sum()), dtype=torch.float64)).sum().backward()
    for leaf in leaves:
        hidden = ~valid.expand_as(leaf) if leaf.ndim == 3 else ~valid[:, None].expand_as(leaf)
        assert torch.isfinite(leaf.grad).all()
        assert (leaf.grad[hidden] == 0).all()
        assert (leaf.grad[~hidden] != 0).any()


def test_gradients_in_both_modes() -> None:
    noise, points, normal, valid, radius = smooth_scene(height=4, width=5)
    leaves = [t.clone().requires_grad_() for t in (noise, points, normal, radius)]

    def f(v: Tensor, x: Tensor, n: Tensor, r: Tensor) -> Tensor:
        return denoise_visibility(v, x, n, valid, r, passes=2)

    assert torch.autograd.gradcheck(f, leaves, check_forward_ad=True, fast_mode=True)
    for number in range(4):
        fixed = [t.detach() for t in leaves]
        assert torch.autograd.gradcheck(
            lambda t, k=number, fixed=fixed: f(*fixed[:k], t, *fixed[k + 1 :]), leaves[number], check_forward_ad=True
        )


def test_function_transforms() -> None:
    noise, points, normal, valid, radius = smooth_scene()

    def one(v: Tensor, x: Tensor, n: Tensor, m: Tensor, r: Tensor) -> Tensor:
        return denoise_visibility(v[None], x[None], n[None], m[None], r[None], passes=2)[0]

    batched = denoise_visibility(noise, points, normal, valid, radius, passes=2)
    torch.testing.assert_close(vmap(one)(noise, points, normal, valid, radius), batched)
    per_image = vmap(grad(lambda r, *t: one(*t, r).square().sum()))(radius, noise, points, normal, valid)
    leaf = radius.clone().requires_grad_()
    denoise_visibility(noise, points, normal, valid, leaf, passes=2).square().sum().backward()
    torch.testing.assert_close(per_image, leaf.grad)
    jacobian = jacfwd(lambda r: denoise_visibility(noise, points, normal, valid, r, passes=2))(radius)
    torch.testing.assert_close((2 * batched[..., None] * jacobian).sum((0, 1, 2)), leaf.grad)
    assert jacobian.abs().max() > 1e-3


def test_second_derivatives_are_errors() -> None:
    noise, points, normal, valid, radius = smooth_scene()
    leaf = points.clone().requires_grad_()
    out = denoise_visibility(noise, leaf, normal, valid, radius, passes=1)
    (first,) = torch.autograd.grad(out.square().sum(), leaf, create_graph=True)
    with pytest.raises(RuntimeError, match="denoise_visibility has no second derivative"):
        first.sum().backward()

    def loss(x: Tensor) -> Tensor:
        return denoise_visibility(noise, x, normal, valid, radius, passes=1).square().sum()

    with pytest.raises(RuntimeError, match="denoise_visibility has no second derivative"):
        jvp(grad(loss), (points,), (points,))


def test_memory_is_a_small_multiple_of_the_image() -> None:
    gb = plane_gbuffer(30.0, height=128, width=128)
    points, normal, valid = inputs(gb)
    leaves = [torch.rand(1, 128, 128).requires_grad_(), points.requires_grad_(), normal.clone().requires_grad_()]

    def work() -> None:
        denoise_visibility(*leaves, valid, torch.tensor([1.0]), passes=1).square().sum().backward()

    assert peak_bytes(work) / 128**2 <= 360  # bytes a pixel, of which 28 are gradients


def test_no_passes_and_bad_passes() -> None:
    noise, points, normal, valid, radius = smooth_scene()
    assert torch.equal(denoise_visibility(noise, points, normal, valid, radius, passes=0), noise)
    with pytest.raises(checks.RangeError, match="passes must be a whole number at least 0"):
        denoise_visibility(noise, points, normal, valid, radius, passes=-1)
