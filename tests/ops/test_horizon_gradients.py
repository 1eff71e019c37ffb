"""Derivatives of the horizon obscurance: exact with the texels held, right in expectation with the footprint."""

from __future__ import annotations

import pytest
import torch
from torch.func import jacfwd, vmap

import torch_ssao as ts
from support.clutter import clutter
from support.gbuffers import random_gbuffer, steps_gbuffer
from torch_ssao.ops import horizon_obscurance, tiled_noise
from torch_ssao.ops.horizon import FOOTPRINT_STEP

SCALARS = {"radius": 0.7, "falloff": 2.5, "thickness": 0.4, "bias": 0.05}
FORMS = [
    {"estimator": "increments"},
    {"estimator": "increments", "weighting": "uniform"},
    {"estimator": "bitmask", "weighting": "uniform"},
    {"estimator": "bitmask", "connected": True},
    {"estimator": "bitmask", "connected": True, "max_radius_px": 0.6},
]


def tensors(gb: ts.GBuffer, **changes: float) -> dict[str, torch.Tensor]:
    camera = gb.camera
    values = {name: torch.full((len(gb),), value).to(gb.depth) for name, value in (SCALARS | changes).items()}
    intrinsics = torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1).to(gb.depth)
    depth = torch.where(gb.valid_mask[:, 0], gb.depth[:, 0], 1.0)
    return {"depth": depth, "normal": gb.normal, "intrinsics": intrinsics} | values


def evaluate(gb: ts.GBuffer, given: dict[str, torch.Tensor], *, frame: int = 0, **options: object) -> torch.Tensor:
    noise = tiled_noise(gb.camera.height, gb.camera.width, frame, dtype=gb.depth.dtype, device=torch.device("cpu"))
    return horizon_obscurance(
        valid=gb.valid_mask[:, 0],
        rotation=noise[0],
        offset=noise[1],
        orthographic=gb.camera.is_orthographic,
        **given,
        **({"slices": 2, "steps": 3, "step_power": 1.3, "weighting": "cosine", "estimator": "bitmask"} | options),
    )


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("form", FORMS, ids=str)
def test_gradcheck_with_texels_held(form: dict, orthographic: bool) -> None:
    gb = random_gbuffer(3, height=5, width=6, orthographic=orthographic)
    given = tensors(gb)
    for name, value in given.items():
        moving = value.clone().requires_grad_()
        assert torch.autograd.gradcheck(
            lambda v, name=name: evaluate(gb, given | {name: v}, footprint_step=0.0, **form),
            moving,
            eps=1e-6,
            atol=1e-6,
            fast_mode=name in ("depth", "normal", "intrinsics"),
            check_forward_ad=True,
        ), name


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("max_radius_px", [None, 0.1])
def test_forward_mode_equals_reverse_mode(form: dict, max_radius_px: float | None) -> None:
    gb = random_gbuffer(6, height=7, width=9, batch=2)
    given = tensors(gb)
    generator = torch.Generator().manual_seed(1)
    moves = {n: torch.randn(t.shape, generator=generator, dtype=t.dtype) for n, t in given.items()}
    options = form | {"max_radius_px": max_radius_px}

    def along(amount: torch.Tensor) -> torch.Tensor:
        return evaluate(gb, {n: t + amount * moves[n] for n, t in given.items()}, **options)

    zero = torch.zeros((), dtype=torch.float64)
    forward = jacfwd(along)(zero)
    assert forward.abs().max() > 1e-3
    cotangent = torch.randn(forward.shape, generator=generator, dtype=forward.dtype)
    zero.requires_grad_()
    (reverse,) = torch.autograd.grad((along(zero) * cotangent).sum(), zero)
    torch.testing.assert_close((forward * cotangent).sum(), reverse, atol=1e-9, rtol=1e-9)


RADIUS_FORMS = [
    {"weighting": weighting, **form}
    for weighting in ("cosine", "uniform")
    for form in ({"connected": False}, {"connected": True}, {"estimator": "increments"})
]


@pytest.mark.parametrize("options", RADIUS_FORMS, ids=str)
def test_radius_gradient_is_that_of_the_expected_estimate(options: dict) -> None:
    """Both sides over the same frames and the same step: what remains is their difference, not the noise of each."""
    gb, frames = clutter(48, 64).to(torch.float64), 16
    given, step = tensors(gb, radius=0.6), FOOTPRINT_STEP

    def mean(factor: torch.Tensor | float, frame: int) -> torch.Tensor:
        return evaluate(gb, given | {"radius": factor * given["radius"]}, frame=frame, **options).mean()

    slope = differences = 0.0
    for frame in range(frames):
        factor = torch.ones((), dtype=torch.float64, requires_grad=True)
        slope += float(torch.autograd.grad(mean(factor, frame), factor)[0]) / frames
        with torch.no_grad():
            differences += float(mean(1 + step, frame) - mean(1 - step, frame)) / (2 * step) / frames
    assert differences > 0.01
    assert slope == pytest.approx(differences, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"connected": True}, {"estimator": "increments"}], ids=str)
def test_depth_gradient_predicts_small_smooth_bumps(options: dict) -> None:
    gb = steps_gbuffer(height=40, width=56, dtype=torch.float64)
    given = tensors(gb, radius=0.5)
    generator = torch.Generator().manual_seed(0)
    predicted, found = [], []
    options = options | {"slices": 4, "steps": 6}
    cotangent = torch.randn(gb.depth[:, 0].shape, generator=generator, dtype=torch.float64)
    cotangent = torch.nn.functional.avg_pool2d(cotangent, 9, 1, 4)  # a smooth question, as a loss over regions is
    depth = given["depth"].clone().requires_grad_()
    grad = sum(
        torch.autograd.grad((evaluate(gb, given | {"depth": depth}, frame=f, **options) * cotangent).sum(), depth)[0]
        for f in range(2)
    )
    v, u = torch.meshgrid(torch.arange(40.0).double(), torch.arange(56.0).double(), indexing="ij")
    for _ in range(20):
        at = torch.rand(2, generator=generator) * torch.tensor([30.0, 46.0]) + 5
        bump = torch.exp(-((v - at[0]) ** 2 + (u - at[1]) ** 2) / (2 * 2.5**2))[None]
        predicted.append(float((grad * bump).sum()))
        size = 2e-3
        with torch.no_grad():
            ends = [
                sum((evaluate(gb, given | {"depth": given["depth"] + s * size * bump}, frame=f, **options) * cotangent).sum()
                    for f in range(2)) for s in (1, -1)
            ]  # fmt: skip
        found.append(float(ends[0] - ends[1]) / (2 * size))
    pair = torch.tensor([predicted, found])
    slope = float((pair[0] * pair[1]).sum() / pair[1].square().sum())
    correlation = float(torch.corrcoef(pair)[0, 1])
    assert correlation >= 0.995, (correlation, slope)
    assert abs(slope - 1) <= 0.03, (correlation, slope)


def test_vmap_and_second_derivative() -> None:
    gb = random_gbuffer(2, height=5, width=6, batch=3)
    given = tensors(gb)
    several = torch.stack([given["radius"], 1.5 * given["radius"]])
    mapped = vmap(lambda radius: evaluate(gb, given | {"radius": radius}))(several)
    torch.testing.assert_close(mapped[1], evaluate(gb, given | {"radius": several[1]}))
    radius = given["radius"].clone().requires_grad_()
    (first,) = torch.autograd.grad(evaluate(gb, given | {"radius": radius}).square().sum(), radius, create_graph=True)
    with pytest.raises(RuntimeError, match="no second derivative"):
        first.sum().backward()


def test_memory_saved_for_backward_does_not_grow_with_taps() -> None:
    gb = random_gbuffer(1, height=16, width=16)
    given = tensors(gb)
    given["depth"].requires_grad_()

    def saved(slices: int, steps: int) -> int:
        total = 0

        def pack(tensor: torch.Tensor) -> torch.Tensor:
            nonlocal total
            total += tensor.numel() * tensor.element_size()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            evaluate(gb, given, slices=slices, steps=steps)
        return total

    assert saved(8, 16) == saved(1, 1)
