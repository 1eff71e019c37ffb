"""Every configuration of StatVO on images that break careless code: finite, in range, exact where it must be."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

import torch_ssao as ts
from support.gbuffers import random_gbuffer

DEFAULTS: dict[str, Any] = {
    "layers": 4,
    "layering": "adaptive",
    "quadrants": False,
    "sat_scale": 1,
    "gradient": "exact",
}


class Config(NamedTuple):
    layers: int
    layering: str
    quadrants: bool
    sat_scale: int
    gradient: str


KINDS = (("adaptive", "exact"), ("adaptive", "surrogate"), ("uniform", "exact"))
LAYERS = (1, 2, 4, 16)
SCALES = (1, 2, 4)


def configs() -> list[Any]:
    """All configurations; those that together hold every pair of choices run always, the others are marked slow."""
    params = []
    for i, j, k, quadrants in itertools.product(range(3), range(4), range(3), (False, True)):
        config = Config(LAYERS[j], KINDS[i][0], quadrants, SCALES[k], KINDS[i][1])
        fast = (i + j + k + quadrants) % 3 == 0
        params.append(pytest.param(config, marks=() if fast else pytest.mark.slow, id="-".join(map(str, config))))
    return params


every_config = pytest.mark.parametrize("config", configs())


def build(config: Config, radius: float = 0.5) -> ts.StatVO:
    """The module of a configuration, all parameters learnable and none at its default; choices only where they differ."""
    choices = {name: value for name, value in config._asdict().items() if value != DEFAULTS[name]}
    return ts.StatVO(radius, height=0.7, falloff=0.8, contrast=1.3, learnable="all", **choices)


def test_build_leaves_out_defaults_only() -> None:
    for name, value in ts.StatVO().config().items():
        assert DEFAULTS.get(name, value) == value


class Image(NamedTuple):
    depth: Tensor
    valid: Tensor | None
    normal: Tensor | None
    camera: ts.Camera


def image(depth: Tensor, valid: Tensor | None = None, *, normals: bool = True, seed: int = 0) -> Image:
    """A float64 image of depths (H, W) or (B, L, H, W) with random normals, fx != fy and an off-centre camera."""
    depth = depth.expand(1, 1, *depth.shape) if depth.ndim == 2 else depth
    batch, _, height, width = depth.shape
    other = random_gbuffer(seed, batch=batch, height=height, width=width, normals=normals)
    return Image(depth.double(), None if valid is None else valid.expand(depth.shape), other.normal, other.camera)


def two_valued(height: int, width: int) -> Tensor:
    row, column = torch.arange(height)[:, None], torch.arange(width)
    return torch.where((row + 2 * column) % 5 < 2, 1.8, 2.0).double()


def one_valid() -> Image:
    valid = torch.zeros(6, 7, dtype=torch.bool)
    valid[2, 5] = True
    return image(2.0 + torch.rand(6, 7, generator=torch.Generator().manual_seed(1)), valid)


def checkered_extremes() -> Image:
    depth = torch.tensor([1e-4, 1e6, 2.0, 2.1]).repeat(13)[: 6 * 7].view(6, 7)
    return image(depth)


CASES: dict[str, Callable[[], Image]] = {
    "random": lambda: Image(*(getattr(random_gbuffer(4, height=6, width=7), n) for n in Image._fields)),
    "peeled": lambda: Image(*(getattr(random_gbuffer(5, peels=2, height=5, width=6), n) for n in Image._fields)),
    "two-valued": lambda: image(two_valued(6, 7), normals=False),
    "constant": lambda: image(torch.full((6, 7), 2.3)),
    "one valid": one_valid,
    "none valid": lambda: image(torch.full((3, 5), 2.0), torch.zeros(3, 5, dtype=torch.bool)),
    "no usable depth": lambda: image(torch.tensor([[torch.nan, torch.inf, -1.0, 0.0, -torch.inf]])),
    "row": lambda: image(two_valued(1, 9)),
    "column": lambda: image(two_valued(9, 1)),
    "pixel": lambda: image(torch.full((1, 1), 2.0)),
    "extremes": checkered_extremes,
}


def leaves(made: Image, dtype: torch.dtype) -> tuple[Tensor, Tensor | None]:
    """Depth and normal of an image as leaves that require gradients."""
    normal = None if made.normal is None else made.normal.to(dtype).requires_grad_()
    return made.depth.to(dtype).clone().requires_grad_(), normal


def check(net: ts.StatVO, made: Image, dtype: torch.dtype) -> Tensor:
    """Run forward and backward; values in [0, 1], all gradients finite, nothing at or from invalid pixels."""
    depth, normal = leaves(made, dtype)
    gb = ts.GBuffer(depth, made.camera.to(dtype), normal=normal, valid=made.valid)
    visibility = net(gb)
    assert visibility.shape == (depth.shape[0], 1, *depth.shape[2:])
    assert bool(((visibility >= 0) & (visibility <= 1)).all())  # a NaN fails too
    seen = gb.valid_mask
    assert bool((visibility[~seen[:, :1]] == 1).all())
    cotangent = torch.randn(visibility.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    (visibility * cotangent.to(visibility.dtype)).sum().backward()
    assert depth.grad is not None
    assert torch.isfinite(depth.grad).all()
    assert (depth.grad[~seen] == 0).all()
    if normal is not None:
        assert normal.grad is not None
        assert torch.isfinite(normal.grad).all()
        assert (normal.grad[~seen[:, :1].expand_as(normal)] == 0).all()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad), name
    return visibility.detach()


@every_config
@pytest.mark.parametrize("case", CASES)
def test_finite_in_range_and_silent_at_invalid_pixels(case: str, config: Config) -> None:
    made = CASES[case]()
    for dtype in (torch.float32, torch.float64):
        visibility = check(build(config).to(dtype), made, dtype)
        assert visibility.dtype == dtype
        if case in ("one valid", "none valid", "no usable depth", "pixel"):
            assert (visibility == 1).all()  # a sample alone is its own mean
        if case in ("random", "two-valued") and config.sat_scale < 4:
            assert visibility.std() > 0.02


@every_config
def test_constant_depth_is_exactly_open(config: Config) -> None:
    for value in (2.3, 1e-4, 1e6):
        made = image(torch.full((6, 7), value), normals=False)
        frontal = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).view(1, 3, 1, 1).expand(1, 3, 6, 7)
        for normal, dtype in ((None, torch.float32), (frontal.clone(), torch.float64)):
            net = build(config, radius=0.3 * value).to(dtype)
            assert (check(net, made._replace(normal=normal), dtype) == 1).all()


@every_config
@pytest.mark.parametrize("radius", [1e-6, 1e6])
def test_extreme_radii(radius: float, config: Config) -> None:
    for case in ("random", "peeled", "row", "pixel", "extremes"):
        dtype = torch.float64 if case in ("row", "peeled") else torch.float32
        visibility = check(build(config, radius).to(dtype), CASES[case](), dtype)
        if radius < 1 and config.sat_scale == 1 and case in ("random", "row"):
            assert (visibility == 1).all()  # the window lies inside the pixel


@every_config
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_under_autocast(dtype: torch.dtype, config: Config) -> None:
    for case in ("random", "none valid", "row"):
        with torch.autocast("cpu", dtype=dtype):
            assert check(build(config), CASES[case](), dtype).dtype == torch.float32
    # Autocast changes no arithmetic: the same float32 input gives the same image with and without it.
    with torch.autocast("cpu", dtype=dtype):
        inside = check(build(config), CASES["random"](), torch.float32)
    assert torch.equal(inside, check(build(config), CASES["random"](), torch.float32))


def derivatives(config: Config, made: Image, *, twice: bool) -> list[Tensor]:
    """Visibility and gradients to depth, normal and parameters, `twice` for a batch that repeats the image."""
    net = build(config).double()
    assert made.normal is not None
    depth, normal = made.depth.requires_grad_(), made.normal.requires_grad_()
    shape = (2 if twice else 1, -1, -1, -1)
    valid = None if made.valid is None else made.valid.expand(shape)
    out = net(ts.GBuffer(depth.expand(shape), made.camera, normal=normal.expand(shape), valid=valid))
    cotangent = torch.randn(out.shape[1:], generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    grads = torch.autograd.grad((out * cotangent).sum(), [depth, normal, *net.parameters()])
    assert all((out[i] == out[0]).all() for i in range(len(out)))
    return [out[0].detach(), *(grad / len(out) for grad in grads)]


@every_config
def test_layout_of_the_input_does_not_matter(config: Config) -> None:
    made = Image(*(getattr(random_gbuffer(6, height=6, width=7), n) for n in Image._fields))
    assert made.normal is not None
    expected = derivatives(config, made, twice=False)
    assert all((tensor != 0).any() for tensor in expected[:3])
    columns_first = made._replace(
        depth=made.depth.detach().mT.contiguous().mT,
        normal=made.normal.detach().permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2),
        valid=None if made.valid is None else made.valid.mT.contiguous().mT,
    )
    sliced = torch.stack((made.depth.detach(), made.depth.detach() + 9.0), -1).flatten(3)[..., ::2]
    assert not columns_first.depth.is_contiguous()
    assert not sliced.is_contiguous()
    for other, twice in ((columns_first, False), (made._replace(depth=sliced), False), (made, True)):
        for got, want in zip(derivatives(config, other, twice=twice), expected, strict=True):
            torch.testing.assert_close(got, want, atol=1e-10, rtol=1e-10)


@every_config
def test_a_broadcast_depth_is_a_constant_depth(config: Config) -> None:
    # All pixels share one number in memory: a kernel that writes in place or reads by pointer would show here.
    number = torch.tensor(2.3, dtype=torch.float64, requires_grad=True)
    camera = CASES["random"]().camera
    visibility = build(config).double()(ts.GBuffer(number.expand(1, 1, 6, 7), camera))
    assert (visibility == 1).all()
    visibility.sum().backward()
    assert number.grad is not None
    assert torch.isfinite(number.grad)
