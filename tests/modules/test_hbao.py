"""HBAO as a module: configuration, invalid input, closed forms, files."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from torch.func import vmap

import torch_ssao as ts
from support.gbuffers import random_gbuffer, steps_gbuffer
from torch_ssao import checks
from torch_ssao.scenes import analytic

FORMS = [
    {"estimator": "bitmask"},
    {"estimator": "bitmask", "thickness": None, "connected": False},
    {"estimator": "increments", "thickness": None},
    {"estimator": "increments", "weighting": "uniform"},
]


def test_parameters_follow_the_configuration() -> None:
    assert ts.HBAO().used_parameters() == ("radius", "contrast", "thickness")
    assert ts.HBAO(estimator="increments").used_parameters() == ("radius", "falloff", "contrast", "thickness")
    assert ts.HBAO(thickness=None, bias_deg=2.0).used_parameters() == ("radius", "contrast", "bias_deg")
    assert list(ts.HBAO().parameters()) == []
    assert [n for n, _ in ts.HBAO(learnable="all").named_parameters()] == [
        "raw_radius",
        "raw_contrast",
        "raw_thickness",
    ]


def test_thickness_may_be_switched_off_and_on() -> None:
    net = ts.HBAO(thickness=None)
    assert net.thickness is None
    assert "thickness=None" in repr(net)
    net.thickness = 0.3
    torch.testing.assert_close(net.thickness, torch.tensor(0.3))
    net.thickness = None
    assert "raw_thickness" not in net.state_dict()
    net.bias_deg = 0.0
    assert net.bias_deg == 0
    with pytest.raises(checks.RangeError, match="radius must be a number, got None"):
        net.radius = None
    learning = ts.HBAO(learnable=("thickness",))
    with pytest.raises(checks.RangeError, match="thickness must stay above 0 while it is learnable"):
        learning.thickness = None


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"slices": 0}, checks.RangeError, "slices must be a whole number"),
        ({"steps": 1.5}, checks.RangeError, "steps must be a whole number"),
        ({"weighting": "none"}, checks.ChoiceError, "weighting must be one of"),
        ({"estimator": "gtao"}, checks.ChoiceError, "estimator must be one of"),
        ({"step_power": 0.0}, checks.RangeError, "step_power must be"),
        ({"max_radius_px": -1.0}, checks.RangeError, "max_radius_px must be"),
        ({"thickness": 0.0}, checks.RangeError, "thickness must be"),
        ({"bias_deg": -1.0}, checks.RangeError, "bias_deg must be"),
        ({"denoise": -1}, checks.RangeError, "denoise must be a whole number"),
        ({"connected": 2}, checks.ChoiceError, "connected must be one of"),
        ({"learnable": "bias_deg"}, checks.ChoiceError, "learnable must be one of"),
        ({"learnable": "thickness", "thickness": None}, checks.ChoiceError, "learnable must be one of"),
    ],
)
def test_bad_configuration(arguments: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ts.HBAO(**arguments)


@pytest.mark.parametrize("form", [*FORMS, {"denoise": 2}, {"bias_deg": 3.0, "max_radius_px": 9.0}], ids=str)
def test_copies_pickles_and_files_give_the_same_image(tmp_path, form: dict) -> None:
    gb = steps_gbuffer()
    net = ts.HBAO(0.37, contrast=1.1, slices=2, steps=3, learnable=("radius",), **form)
    image = net(gb)
    assert image.min() < 0.999
    ts.save(net, tmp_path / "ao.json")
    for twin in (copy.deepcopy(net), pickle.loads(pickle.dumps(net)), ts.load(tmp_path / "ao.json")):
        assert torch.equal(twin(gb), image)
        assert twin.config() == net.config()
        assert twin.values() == net.values()


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_invalid_pixels_are_open_with_zero_gradient_and_never_occlude(form: dict) -> None:
    gb = random_gbuffer(9, height=9, width=8, invalid=0.4)
    garbage = torch.where(gb.valid, gb.depth, torch.tensor([torch.nan, torch.inf, -3.0, 0.0])[torch.arange(8) % 4])
    depth = garbage.clone().requires_grad_()
    normal = torch.where(gb.valid, gb.normal, torch.nan).requires_grad_()
    net = ts.HBAO(1.0, **form).double()
    out = net(ts.GBuffer(depth, gb.camera, normal=normal))
    torch.testing.assert_close(out, net(gb))
    assert (out[~gb.valid] == 1).all()
    (out * torch.randn(out.shape, generator=torch.Generator().manual_seed(0), dtype=out.dtype)).sum().backward()
    for grad, mask in ((depth.grad, gb.valid), (normal.grad, gb.valid.expand_as(normal))):
        assert torch.isfinite(grad).all()
        assert (grad[~mask] == 0).all()
        assert (grad[mask] != 0).any()


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [0.0, math.nan, math.inf])
def test_bad_normals_stay_finite(form: dict, dtype: torch.dtype, bad: float) -> None:
    gb = random_gbuffer(9, height=9, width=8, dtype=dtype)
    normal = gb.normal.clone()
    normal[..., ::3] = bad
    depth, normal = gb.depth.clone().requires_grad_(), normal.requires_grad_()
    out = ts.HBAO(1.0, **form)(ts.GBuffer(depth, gb.camera, normal=normal, valid=gb.valid))
    out.sum().backward()
    assert torch.isfinite(out).all()
    assert torch.isfinite(depth.grad).all()
    assert torch.isfinite(normal.grad).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1)])
def test_thin_images(shape: tuple[int, int]) -> None:
    gb = random_gbuffer(1, height=shape[0], width=shape[1], invalid=0.0)
    assert torch.isfinite(ts.HBAO(1.0)(gb)).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_input_and_autocast(dtype: torch.dtype) -> None:
    gb = steps_gbuffer()
    exact = ts.HBAO(0.4)(gb)
    assert ts.HBAO(0.4)(gb.to(dtype)).dtype == torch.float32
    with torch.autocast("cpu", dtype=dtype):
        torch.testing.assert_close(ts.HBAO(0.4)(gb), exact)


def test_batch_vmap_frames_and_normals_from_depth() -> None:
    gb = random_gbuffer(2, batch=3, height=6, width=7)
    net = ts.HBAO(0.8).double()
    torch.testing.assert_close(vmap(net)(gb), net(gb), atol=1e-12, rtol=0)
    torch.testing.assert_close(net(gb[1]), net(gb)[1:2], atol=1e-12, rtol=0)
    assert torch.equal(net(gb, frame=5), net(gb, frame=5))
    assert not torch.equal(net(gb, frame=5), net(gb, frame=6))
    flat = steps_gbuffer(dtype=torch.float64)
    bare = ts.GBuffer(flat.depth, flat.camera)
    torch.testing.assert_close(net(bare), net(flat))


def test_scale_invariance() -> None:
    gb = steps_gbuffer(height=20, width=24, dtype=torch.float64)
    small = ts.HBAO(0.4).double()(gb)
    for k in (1e-3, 1e6):
        scaled = ts.GBuffer(gb.depth * k, gb.camera, normal=gb.normal)
        net = ts.HBAO().double()
        net.radius = 0.4 * k
        base = ts.HBAO().double()
        base.radius = 0.4
        torch.testing.assert_close(net(scaled), base(gb), atol=1e-6, rtol=0)
    assert small.min() < 0.95


def inside(gb: ts.GBuffer, radius: float) -> torch.Tensor:
    """(B, 1, H, W) pixels whose sphere lies on the image."""
    height, width = gb.depth.shape[-2:]
    span = 1.3 * gb.camera.footprint(torch.tensor(radius).to(gb.depth), gb.depth)
    u, v = torch.arange(width) + 0.5, torch.arange(height)[:, None] + 0.5
    return (span[:, 0] < torch.minimum(u, width - u)) & (span[:, 1] < torch.minimum(v, height - v))


def error(
    net: ts.HBAO, scene: analytic.AnalyticScene, *, size: int = 64, radius: float = 0.3, **view: object
) -> torch.Tensor:
    gb = scene.render(scene.camera(size, size, **view))  # type: ignore[arg-type]
    exact, known = scene.exact(gb, radius=radius, weighting=net.weighting)
    kept = known & inside(gb, radius)
    assert kept.sum() > 100
    return (net(gb) - exact)[kept]


@pytest.mark.parametrize("weighting", ["cosine", "uniform"])
@pytest.mark.parametrize("angle", [20.0, 45.0, 70.0])
def test_many_taps_on_a_wall_converge_to_the_closed_form(angle: float, weighting: str) -> None:
    net = ts.HBAO(0.3, thickness=None, slices=16, steps=24, step_power=1.0, weighting=weighting).double()
    off = error(net, analytic.wall(), view_angle_deg=angle)
    assert off.abs().mean() <= 0.005
    assert off.square().mean().sqrt() <= 0.012


@pytest.mark.parametrize(("steps", "most"), [(3, 0.025), (6, 0.016)])
def test_few_taps_on_a_wall(steps: int, most: float) -> None:
    net = ts.HBAO(0.3, thickness=None, slices=3, steps=steps, step_power=1.0).double()
    errors = [error(net, analytic.wall(), view_angle_deg=angle, size=96) for angle in (20.0, 45.0, 70.0)]
    assert torch.stack([e.square().mean() for e in errors]).mean().sqrt() <= most


def test_only_finite_thickness_sees_under_a_slat() -> None:
    scene = analytic.raised_slat(0.3, 0.4)
    mean = {}
    for thickness in (0.02, None):
        net = ts.HBAO(1.0, thickness=thickness, slices=12, steps=48, step_power=1.0, connected=thickness is not None)
        mean[thickness] = error(net.double(), scene, radius=1.0, view_angle_deg=50.0, span=6.0).mean()
    assert mean[0.02].abs() < 0.03
    assert mean[None] < -0.03


def test_more_taps_do_not_darken() -> None:
    scene = ts.scenes.builtin("temple")
    gb = ts.scenes.render(scene, views=0, height=60, width=80)
    for estimator, taps, most in (("increments", ((4, 4), (8, 16)), 0.02), ("bitmask", ((4, 8), (8, 24)), 0.02)):
        means = [ts.HBAO(scene.radius, estimator=estimator, slices=s, steps=k)(gb).mean() for s, k in taps]
        assert abs(means[0] - means[1]) < most, estimator
