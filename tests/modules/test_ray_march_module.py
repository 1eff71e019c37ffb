"""RayMarchedSSAO as a module: parameters, configuration, copies, files, dtypes, denoising, errors."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch

import torch_ssao as ts
from support.gbuffers import plane_gbuffer, random_gbuffer, steps_gbuffer
from torch_ssao import checks


def test_parameters_are_fixed_by_default_and_learnable_on_request() -> None:
    assert list(ts.RayMarchedSSAO().parameters()) == []
    every = ts.RayMarchedSSAO(learnable="all")
    assert every.learnable == ("radius", "falloff", "thickness", "contrast")
    solid = ts.RayMarchedSSAO(thickness=None, learnable="all")
    assert solid.learnable == ("radius", "falloff", "contrast")  # no thickness to learn
    net = ts.RayMarchedSSAO(thickness=0.5, gradient="surrogate", learnable=("radius", "thickness"))
    net(steps_gbuffer()).mean().backward()
    assert net.raw_radius.grad != 0
    assert net.raw_thickness.grad != 0


def test_thickness_reads_none_and_numbers() -> None:
    assert ts.RayMarchedSSAO().thickness.item() == pytest.approx(0.5)
    net = ts.RayMarchedSSAO(thickness=None)
    assert net.thickness is None
    assert "thickness" not in net.values()
    blocked = net(steps_gbuffer())
    net.thickness = 0.3
    assert net.thickness.item() == pytest.approx(0.3)
    assert net(steps_gbuffer()).mean() > blocked.mean()
    net.thickness = None
    assert torch.equal(net(steps_gbuffer()), blocked)


def test_repr_names_values_and_choices() -> None:
    text = repr(ts.RayMarchedSSAO(0.25, rays=4, max_radius_px=90.0))
    for part in ("radius=0.25", "rays=4", "steps=8", "gradient='exact'", "max_radius_px=90.0", "thickness=0.5"):
        assert part in text
    assert "thickness=None" in repr(ts.RayMarchedSSAO(thickness=None))


@pytest.mark.parametrize("thickness", [None, 0.4])
def test_copies_pickles_and_files_give_the_same_image(tmp_path, thickness: float | None) -> None:
    gb = steps_gbuffer()
    net = ts.RayMarchedSSAO(
        0.37, falloff=1.7, contrast=0.9, rays=3, steps=5, thickness=thickness, denoise=1, learnable=("radius",)
    )
    image = net(gb)
    ts.save(net, tmp_path / "ao.json")
    for twin in (copy.deepcopy(net), pickle.loads(pickle.dumps(net)), ts.load(tmp_path / "ao.json")):
        assert torch.equal(twin(gb), image)
        assert twin.learnable == ("radius",)
        assert twin.config() == net.config()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_input_and_autocast(dtype: torch.dtype) -> None:
    gb = steps_gbuffer()
    net = ts.RayMarchedSSAO(0.4, denoise=1)
    exact = net(gb)
    assert net(gb.to(dtype)).dtype == torch.float32
    with torch.autocast("cpu", dtype=dtype):
        assert torch.equal(net(gb), exact)


def test_frames_differ_and_repeat_and_average_out() -> None:
    gb = steps_gbuffer()
    net = ts.RayMarchedSSAO(0.5, rays=4, steps=8)
    first = net(gb)
    assert torch.equal(net(gb), first)
    assert not torch.equal(net(gb, frame=1), first)
    truth = ts.RayMarchedSSAO(0.5, rays=128, steps=8)(gb)
    mean = torch.stack([net(gb, frame=frame) for frame in range(16)]).mean(0)
    assert (mean - truth).square().mean().sqrt() < 0.5 * (first - truth).square().mean().sqrt()
    assert (mean - truth).mean().abs() < 2e-3  # few rays are noisier, not darker


def test_the_denoiser_brings_few_rays_nearer_to_many() -> None:
    gb = steps_gbuffer(height=96, width=128)
    truth = ts.RayMarchedSSAO(1.5, rays=128, steps=8)(gb)
    errors = [
        (ts.RayMarchedSSAO(1.5, rays=4, steps=8, denoise=passes)(gb) - truth).square().mean().sqrt()
        for passes in (0, 1)
    ]
    assert errors[1] < 0.6 * errors[0]


def test_a_pixel_cap_that_no_step_reaches_changes_nothing() -> None:
    gb = steps_gbuffer()
    spans = float(gb.camera.fx) * 0.5 / gb.depth
    wide = ts.RayMarchedSSAO(0.5)(gb)
    assert torch.equal(ts.RayMarchedSSAO(0.5, max_radius_px=2 * float(spans.max()))(gb), wide)
    capped = ts.RayMarchedSSAO(0.5, max_radius_px=0.25 * float(spans.median()))(gb)
    assert not torch.equal(capped, wide)
    assert (capped - wide).abs().mean() < 0.01


def test_without_normals_they_are_estimated() -> None:
    gb = plane_gbuffer(60.0)
    bare = ts.GBuffer(gb.depth, gb.camera)
    estimated = ts.GBuffer.from_depth(gb.depth, gb.camera)
    assert torch.equal(ts.RayMarchedSSAO(0.7)(bare), ts.RayMarchedSSAO(0.7)(estimated))


def test_a_tiny_radius_is_open() -> None:
    assert (ts.RayMarchedSSAO(1e-4)(steps_gbuffer()) == 1).all()


def test_non_contiguous_and_expanded_input() -> None:
    gb = random_gbuffer(1, height=8, width=10, peels=2)
    net = ts.RayMarchedSSAO(0.4, thickness=0.5).double()
    strided = ts.GBuffer(
        gb.depth.mT.contiguous().mT,
        gb.camera,
        normal=gb.normal.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2),
        valid=gb.valid,
    )
    torch.testing.assert_close(net(strided), net(gb), atol=1e-12, rtol=0)
    twice = ts.GBuffer.cat([gb, gb])
    torch.testing.assert_close(net(twice)[1:], net(gb), atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"radius": 0.0}, checks.RangeError, "radius must be finite and greater than 0, got 0.0"),
        ({"thickness": -1.0}, checks.RangeError, "thickness must be"),
        ({"rays": 0}, checks.RangeError, "rays must be a whole number"),
        ({"steps": 1.5}, checks.RangeError, "steps must be a whole number"),
        ({"denoise": -1}, checks.RangeError, "denoise must be a whole number"),
        ({"gradient": "none"}, checks.ChoiceError, "gradient must be one of"),
        ({"surrogate_width": 0.0}, checks.RangeError, "surrogate_width must be"),
        ({"max_radius_px": 0.0}, checks.RangeError, "max_radius_px must be"),
        ({"thickness": None, "learnable": "thickness"}, checks.ChoiceError, "learnable must be one of"),
    ],
)
def test_bad_configuration(arguments: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ts.RayMarchedSSAO(**arguments)
