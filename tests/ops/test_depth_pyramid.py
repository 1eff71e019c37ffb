"""The pyramid of selected pixels, and what the techniques that read it make of a cap."""

from __future__ import annotations

import math

import pytest
import torch

import torch_ssao as ts
from oracles import depth_pyramid as oracle
from support.gbuffers import plane_gbuffer, random_gbuffer, steps_gbuffer
from support.horizon import FORMS, evaluate, expected
from support.ray_march import oracle as march_oracle
from support.ray_march import ray_march
from torch_ssao.ops.depth_pyramid import LEVELS, build_pyramid, furthest_read, texels_at
from torch_ssao.ops.footprint import footprint_fade


def random_mask(*shape: int, share: float, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) < share


@pytest.mark.parametrize("share", [1.1, 0.5, 0.05, 0.0])
@pytest.mark.parametrize("size", [(37, 70), (64, 64), (1, 9), (33, 1)])
def test_every_texel_is_the_pixel_of_the_oracle(size: tuple[int, int], share: float) -> None:
    valid = random_mask(2, *size, share=share)
    pyramid = build_pyramid(valid, 2.5)
    generator = torch.Generator().manual_seed(1)
    image, row, column = (torch.randint(n, (400,), generator=generator) for n in (2, *size))
    distance = torch.rand(400, generator=generator, dtype=torch.float64) * 120
    distance[:20] = 2.5 * 2.0 ** torch.arange(20)  # on the bounds
    at = texels_at(pyramid, image, row, column, distance)
    for i, r, c, d, found in zip(*(t.tolist() for t in (image, row, column, distance, pyramid.pixel[at])), strict=True):
        want = oracle.selected_pixel(valid[i].numpy(), r, c, oracle.level_at(d, 2.5))
        assert found == (i * size[0] + want[0]) * size[1] + want[1]


def test_reads_stay_within_the_cap_in_texels_and_keep_their_place() -> None:
    pyramid = build_pyramid(random_mask(1, 200, 300, share=0.7), 8.0)
    column = torch.arange(1, 256)
    at = texels_at(pyramid, torch.zeros(1, dtype=torch.int64), torch.tensor(0), column, column.float())
    level = torch.bucketize(at, pyramid.start, right=True) - 1
    assert int(level.max()) == LEVELS - 1
    assert bool((column / 2**level <= 8).all())
    assert bool((column / 2 ** (level - 1) > 8)[level > 0].all())
    away = pyramid.pixel[at] % 300 // 2**level - column // 2**level
    assert bool((away == 0).all())


def test_no_row_and_no_column_is_left_out() -> None:
    pyramid = build_pyramid(torch.ones(1, 64, 96, dtype=torch.bool), 1.0)
    first = pyramid.pixel[int(pyramid.start[1]) : int(pyramid.start[2])]
    assert torch.equal(first.div(96, rounding_mode="floor").unique(), torch.arange(64))
    assert torch.equal((first % 96).unique(), torch.arange(96))
    for level in range(1, LEVELS):
        end = int(pyramid.start[level + 1]) if level + 1 < LEVELS else len(pyramid.pixel)
        pixel = pyramid.pixel[int(pyramid.start[level]) : end]
        assert pixel.unique().numel() == pixel.numel() == 64 * 96 // 4**level


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("cap", [0.3, 1.0, 2.5])
@pytest.mark.parametrize("form", FORMS, ids=str)
def test_horizon_equals_the_oracle(form: dict, cap: float, orthographic: bool) -> None:
    gb = random_gbuffer(5, height=11, width=22, invalid=0.4, orthographic=orthographic)
    gb = ts.GBuffer(2.0 + 0.15 * (gb.depth - 2.0), gb.camera, normal=gb.normal, valid=gb.valid)
    options = form | {"max_radius_px": cap, "radius": 2.0}
    value = evaluate(gb, **options)
    torch.testing.assert_close(value, expected(gb, **options), atol=1e-9, rtol=0)
    assert not torch.equal(value, evaluate(gb, **form, radius=2.0))


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("cap", [0.3, 1.0, 2.5])
@pytest.mark.parametrize("peels", [1, 3])
def test_ray_march_equals_the_oracle(peels: int, cap: float, orthographic: bool) -> None:
    gb = random_gbuffer(5, height=11, width=22, batch=2, invalid=0.4, peels=peels, orthographic=orthographic)
    net = ray_march(max_radius_px=cap, radius=1.3)
    torch.testing.assert_close(net(gb), march_oracle(net, gb), atol=1e-9, rtol=0)
    assert not torch.equal(net(gb), ray_march(radius=1.3)(gb))


TECHNIQUES = {
    "bitmask": ts.HBAO,
    "increments": lambda *a, **k: ts.HBAO(*a, estimator="increments", **k),
    "march": lambda *a, **k: ts.RayMarchedSSAO(*a, thickness=0.5, **k),
}


@pytest.mark.parametrize("name", TECHNIQUES)
def test_beyond_the_coarsest_level_the_radius_is_shortened(name: str) -> None:
    gb = random_gbuffer(2, height=48, width=64, orthographic=True)
    short = furthest_read(0.5) / float(torch.maximum(gb.camera.fx, gb.camera.fy))
    nets = [TECHNIQUES[name](1.0, max_radius_px=0.5).double() for _ in range(3)]
    for net, radius in zip(nets, (short, 5 * short, 0.9 * short), strict=True):
        net.radius = radius
    images = [net(gb) for net in nets]
    torch.testing.assert_close(images[1], images[0], atol=1e-12, rtol=0)
    assert not torch.allclose(images[2], images[0])


@pytest.mark.parametrize("name", TECHNIQUES)
@pytest.mark.parametrize(("angle", "most"), [(0.0, 1e-3), (45.0, 1e-3), (60.0, 1e-3), (80.0, 0.01)])
def test_planes_stay_open(name: str, angle: float, most: float) -> None:
    """At 80 degrees the horizon is in view: its last row, flat because it is steeper than an edge, stands for some sky."""
    gb = plane_gbuffer(angle, dtype=torch.float64)
    near = gb.depth < 50
    assert ((1 - TECHNIQUES[name](3.0, max_radius_px=4.0).double()(gb))[near].abs() <= most).all()


@pytest.mark.parametrize("gradient", ["exact", "soft"])
def test_gradients_of_the_march_reach_the_selected_pixels(gradient: str) -> None:
    """The horizon's are in its own gradcheck; its derivative to a depth has a part of the footprint's."""
    gb = random_gbuffer(4, height=8, width=15, invalid=0.3)
    net = ray_march(radius=1.3, max_radius_px=1.0, gradient=gradient)
    generator = torch.Generator().manual_seed(0)
    cotangent, move = (torch.randn(1, 1, 8, 15, generator=generator, dtype=torch.float64) for _ in range(2))

    def loss(depth: torch.Tensor) -> torch.Tensor:
        return (net(ts.GBuffer(depth, gb.camera, normal=gb.normal, valid=gb.valid)) * cotangent).sum()

    depth = gb.depth.clone().requires_grad_()
    (grad,) = torch.autograd.grad(loss(depth), depth)
    _, forward = torch.func.jvp(loss, (gb.depth,), (move,))
    with torch.no_grad():
        difference = (loss(depth + 1e-7 * move) - loss(depth - 1e-7 * move)) / 2e-7
    assert abs(float(difference)) > 0.1
    assert float((grad * move).sum()) == pytest.approx(float(difference), rel=1e-5)
    assert float(forward.detach()) == pytest.approx(float(difference), rel=1e-5)


def test_the_footprint_fades_below_a_pixel() -> None:
    depth = torch.tensor([[[0.5, 0.9, 1.25, 1.6, 2.1, 9.0, 1.25]]], dtype=torch.float64)
    valid = torch.tensor([[[True] * 6 + [False]]])
    focal, radius = torch.tensor([[8.0, 10.0]], dtype=torch.float64), torch.full((1, 1, 1), 0.1, dtype=torch.float64)
    fade = footprint_fade(depth, valid, radius, focal, orthographic=False)[0, 0]
    want = [oracle.fade(1 / z) for z in depth[0, 0].tolist()]
    torch.testing.assert_close(fade, torch.tensor([*want[:6], 1.0], dtype=torch.float64), atol=1e-15, rtol=0)
    assert want[:2] == [1.0, 1.0]
    assert want[4:6] == [0.0, 0.0]
    assert 0 < want[3] < want[2] < 1
    inputs = [t.clone().requires_grad_() for t in (depth, radius, focal)]
    weight = torch.linspace(-1, 1, 7, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda z, r, f: footprint_fade(z, valid, r, f, orthographic=False) * weight, inputs, check_forward_ad=True
    )
    parallel = footprint_fade(depth, valid, radius * 0.8, focal, orthographic=True)
    torch.testing.assert_close(parallel[valid], torch.full((6,), oracle.fade(0.8), dtype=torch.float64))


@pytest.mark.parametrize("depth", [1e-20, 3e38, 0.0, math.inf])
def test_the_fade_has_finite_derivatives_at_absurd_depths(depth: float) -> None:
    given = torch.tensor([[[depth]]], requires_grad=True)
    valid = torch.isfinite(given) & (given > 0)
    radius = torch.ones(1, 1, 1, requires_grad=True)
    focal = torch.full((1, 2), 40.0, requires_grad=True)
    fade = footprint_fade(torch.where(valid, given, 0.0), valid, radius, focal, orthographic=False)
    for grad in torch.autograd.grad(fade.sum(), (given, radius, focal)):
        assert bool(torch.isfinite(grad).all())


@pytest.mark.parametrize("name", TECHNIQUES)
def test_a_radius_below_half_a_pixel_occludes_nothing(name: str) -> None:
    gb = steps_gbuffer(dtype=torch.float64)
    pixel = float((gb.depth / gb.camera.fy).min())
    assert bool((TECHNIQUES[name](0.45 * pixel).double()(gb) == 1).all())
