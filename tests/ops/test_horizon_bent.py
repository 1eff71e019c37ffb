"""Bent normals: against numerical integration in the oracle's half slices, closed forms of dihedrals, planes, derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torch_ssao as ts
from oracles.horizon import bent_normals as oracle
from support.gbuffers import plane_gbuffer, random_gbuffer, steps_gbuffer
from support.horizon import FORMS, evaluate, oracle_question, question, smooth_gbuffer
from torch_ssao.ops import horizon_bent, horizon_bent_normal
from torch_ssao.ops.horizon_arcs import Measure
from torch_ssao.ops.horizon_moments import moments

WEIGHTINGS = ("cosine", "uniform")


def bent(gb: ts.GBuffer, **options: object) -> tuple[torch.Tensor, torch.Tensor]:
    tensors, keywords = question(gb, **options)
    return horizon_bent_normal(*tensors, **keywords)


@pytest.mark.parametrize("cosine", [True, False])
def test_moments_are_integrals(cosine: bool) -> None:
    """A single half slice, its elevations summed up one by one, for normals turned to and from the eye on both sides."""
    generator = torch.Generator().manual_seed(0)
    facing, turned = torch.rand(6, generator=generator).double(), torch.randn(6, generator=generator).double()
    sides = torch.stack((turned, -turned))[None, :, None]
    length = (facing**2 + turned**2).sqrt()
    measure = Measure(facing.view(1, 1, 1, 6), sides, length.view(1, 1, 1, 6), -torch.atan2(sides, facing), 0, cosine)  # type: ignore[arg-type]
    for share in (0.1, 0.5, 0.97):
        limit = math.pi / 2 - measure.view
        end = share * limit
        elevation = (torch.arange(4000, dtype=torch.float64).view(-1, 1, 1, 1, 1) + 0.5) / 4000 * end
        angle = limit - elevation
        density = angle.sin() * (measure.length * elevation.sin() if cosine else 0.5) * end
        want = torch.stack([(density * part).mean(0) for part in (torch.ones_like(angle), angle.cos(), angle.sin())])
        torch.testing.assert_close(moments(measure, end), want, atol=1e-7, rtol=0)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("form", FORMS, ids=str)
def test_directions_are_those_of_numerical_integration(form: dict, weighting: str, orthographic: bool) -> None:
    gb = smooth_gbuffer(height=7, width=12, orthographic=orthographic)
    options = form | {"weighting": weighting, "steps": 4}
    obscurance, direction = bent(gb, **options)
    torch.testing.assert_close(obscurance, evaluate(gb, **options), atol=1e-12, rtol=0)
    arguments, settings = oracle_question(gb, **options)
    mean = torch.from_numpy(oracle(*arguments, samples=2000, **settings))
    normal = torch.where(gb.valid, gb.normal, 0.0)
    open_share = (2 / 3 if weighting == "cosine" else 0.5) * normal - mean
    want = torch.nn.functional.normalize(open_share, dim=1)
    kept = gb.valid[:, 0] & ((open_share * normal).sum(1) > 0.05)
    assert kept.double().mean() > 0.6
    assert ((direction - normal).abs().amax(1)[kept] > 0.05).double().mean() > 0.3
    torch.testing.assert_close(
        direction.movedim(1, -1)[kept], want.movedim(1, -1)[kept], atol=4e-3, rtol=0
    )  # 2,000 elevations a side, and the ends of arcs fall between them


def wedge(interior_deg: float) -> ts.GBuffer:
    """Two planes that meet in a line down the middle of the image, three rows of 400 pixels; the eye is on the bisector."""
    camera = ts.Camera(*(torch.tensor([v], dtype=torch.float64) for v in (400.0, 400.0, 200.0, 1.5)), 3, 400)
    x = camera.rays()[0][0].expand(3, 400)
    across, towards = -math.cos(math.radians(interior_deg / 2)), -math.sin(math.radians(interior_deg / 2))
    depth = 5 * towards / (across * x.abs() + towards)
    normal = torch.stack((x.sign() * across, torch.zeros_like(x), torch.full_like(x, towards)))
    return ts.GBuffer(depth[None, None], camera, normal=normal[None])


@pytest.mark.parametrize(
    ("interior_deg", "weighting", "tilt"),
    [
        (60.0, "cosine", 50.686),
        (90.0, "cosine", 32.4816),
        (120.0, "cosine", 16.528),
        (60.0, "uniform", 60.0),
        (90.0, "uniform", 45.0),
        (120.0, "uniform", 30.0),
    ],
)
@pytest.mark.parametrize("estimator", ["bitmask", "increments"])
def test_tilt_at_the_foot_of_a_wall(interior_deg: float, weighting: str, tilt: float, estimator: str) -> None:
    gb = wedge(interior_deg)
    net = ts.HBAO(
        *(1.0,), thickness=None, falloff=100.0, weighting=weighting, estimator=estimator, slices=24, steps=24,
        step_power=4.0, offscreen="extend", connected=False,
    ).double()  # fmt: skip
    net.radius = 5e3
    direction = net.bent_normal(gb)[1]
    angle = torch.rad2deg(torch.acos((direction * gb.normal).sum(1).clamp(-1, 1)))[0, :, 199:201]
    assert float(angle.mean()) == pytest.approx(tilt, abs=0.3)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("angle", [0.0, 60.0])
def test_a_plane_has_its_normal(angle: float, weighting: str) -> None:
    gb = plane_gbuffer(angle, dtype=torch.float64)
    for estimator in ("bitmask", "increments"):
        visibility, direction = ts.HBAO(0.7, weighting=weighting, estimator=estimator).double().bent_normal(gb)
        torch.testing.assert_close(visibility, torch.ones_like(visibility), atol=1e-4, rtol=0)
        torch.testing.assert_close(direction, gb.normal, atol=1e-4, rtol=0)


@pytest.mark.parametrize("form", [{}, {"denoise": 1, "contrast": 1.4}, {"max_radius_px": 4.0}], ids=str)
def test_visibility_is_that_of_forward(form: dict) -> None:
    gb = steps_gbuffer()
    net = ts.HBAO(0.8, **form)
    visibility, direction = net.bent_normal(gb, frame=3)
    torch.testing.assert_close(visibility, net(gb, frame=3), atol=1e-5, rtol=0)
    torch.testing.assert_close(direction.norm(dim=1), torch.ones_like(direction[:, 0]))
    assert not torch.equal(direction, net.bent_normal(gb, frame=4)[1])


def test_pixels_without_an_open_direction_have_their_normal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pit as narrow as a pixel (1 % of it stays open: the bound is moved there), and a pixel that is not valid."""
    monkeypatch.setattr(horizon_bent, "CLOSED", 0.02)
    depth = torch.full((1, 1, 9, 9), 2.0, dtype=torch.float64)
    depth[..., 4, 4] = 2000.0
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[..., 0, 0] = False
    camera = ts.Camera.perspective(50.0, 9, 9).to(torch.float64)
    normal = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64).view(1, 3, 1, 1).expand(1, 3, 9, 9)
    net = ts.HBAO(1.0, thickness=None, slices=16, connected=False, offscreen="extend").double()
    net.radius = 5000.0
    visibility, direction = net.bent_normal(ts.GBuffer(depth, camera, normal=normal, valid=valid))
    assert float(visibility[0, 0, 4, 4]) < 0.02
    torch.testing.assert_close(direction[0, :, 4, 4], normal[0, :, 4, 4])
    assert direction[0, :, 0, 0].tolist() == [0.0, 0.0, -1.0]
    assert float(visibility[0, 0, 0, 0]) == 1.0
    bare = net.bent_normal(ts.GBuffer(depth, camera, valid=valid))  # normals estimated
    assert bool(torch.isfinite(bare[1]).all())


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("form", [FORMS[0], FORMS[3] | {"max_radius_px": 0.6}], ids=str)
def test_gradcheck_with_texels_held(form: dict, orthographic: bool) -> None:
    gb = random_gbuffer(3, height=5, width=6, orthographic=orthographic)
    gb = ts.GBuffer(2.0 + 0.3 * (gb.depth - 2.0), gb.camera, normal=gb.normal, valid=gb.valid)
    everything = [("cosine", number) for number in (0, 2, 3, 4, 5, 6, 7)]
    for weighting, number in (*everything, ("uniform", 0), ("uniform", 2)):
        tensors, options = question(gb, footprint_step=0.0, weighting=weighting, **form)
        assert torch.autograd.gradcheck(
            lambda v, i=number, t=tensors, o=options: horizon_bent_normal(*t[:i], v, *t[i + 1 :], **o),
            tensors[number].clone().requires_grad_(),
            eps=1e-6,
            atol=1e-5,
            fast_mode=True,
            check_forward_ad=True,
        ), number


def test_gradients_reach_parameters_and_vmap_works() -> None:
    gb = random_gbuffer(2, height=6, width=7, batch=2)
    net = ts.HBAO(0.6, learnable="all").double()
    weight = torch.from_numpy(np.random.default_rng(0).standard_normal((2, 3, 6, 7)))
    grads = torch.autograd.grad((net.bent_normal(gb)[1] * weight).sum(), [net.raw_radius, net.raw_thickness])
    assert all(float(grad.abs()) > 1e-3 for grad in grads)
    visibility, direction = torch.func.vmap(net.bent_normal)(gb)
    torch.testing.assert_close(direction, net.bent_normal(gb)[1], atol=1e-12, rtol=0)
    assert visibility.shape == (2, 1, 6, 7)
