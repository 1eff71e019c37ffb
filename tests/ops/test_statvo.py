"""StatVO against the pixel-loop oracle, and its gradients against differences."""

from __future__ import annotations

import pytest
import torch
from torch.func import functional_call, jacfwd, vmap

import torch_ssao as ts
from oracles.statvo import statvo_visibility
from support.gbuffers import plane_gbuffer, random_gbuffer, steps_gbuffer

VALUES = {"radius": 0.45, "height": 0.6, "falloff": 0.7, "contrast": 1.4}
PARAMETERS = tuple(VALUES)


def module(layers: int, *, variant: dict | None = None, **changes: float) -> ts.StatVO:
    net = ts.StatVO(layers=layers, learnable="all", **(variant or {})).double()
    for name, value in (VALUES | changes).items():
        setattr(net, name, value)  # set in float64, after the conversion
    return net


def oracle(
    gb: ts.GBuffer, layers: int, eps: float, *, variant: dict | None = None, **changes: float
) -> torch.Tensor:
    v = VALUES | changes
    camera = gb.camera
    arrays = [t.double().numpy() for t in (camera.fx, camera.fy, camera.cx, camera.cy)]
    normal = None if gb.normal is None else gb.normal.double().numpy()
    image = statvo_visibility(
        gb.depth.double().numpy(),
        gb.valid.numpy(),
        normal,
        *arrays,
        camera.is_orthographic,
        radius=v["radius"],
        height=v["height"],
        slope=v["falloff"],
        contrast=v["contrast"],
        layers=layers,
        eps=eps,
        **({"quadrants": True} | (variant or {})),
    )
    return torch.from_numpy(image)[:, None]


CASES = [
    {"height": 13, "width": 17, "batch": 2},
    {"height": 16, "width": 11, "peels": 3},
    {"height": 12, "width": 15, "normals": False},
    {"height": 12, "width": 15, "orthographic": True},
    {"height": 12, "width": 15, "invalid": 0.6},
    {"height": 1, "width": 19},
    {"height": 19, "width": 1},
    {"height": 6, "width": 6, "invalid": 1.1},
]


VARIANTS = [
    {"quadrants": False},
    {"quadrants": True},
    {"quadrants": True, "sat_scale": 2},
    {"quadrants": False, "sat_scale": 4},
    {"quadrants": False, "layering": "uniform"},
    {"quadrants": True, "layering": "uniform", "sat_scale": 2},
]


@pytest.mark.parametrize("layers", [1, 2, 4, 8])
@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_float64_equals_the_oracle(variant: dict, case: dict, layers: int) -> None:
    gb = random_gbuffer(layers, **case)
    expected = oracle(gb, layers, torch.finfo(torch.float64).eps, variant=variant)
    torch.testing.assert_close(module(layers, variant=variant)(gb), expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("layers", [3, 5, 64])
def test_uniform_layers_may_be_any_number(layers: int) -> None:
    gb = random_gbuffer(layers, height=9, width=10)
    variant = {"layering": "uniform"}
    expected = oracle(gb, layers, torch.finfo(torch.float64).eps, variant=variant)
    torch.testing.assert_close(module(layers, variant=variant)(gb), expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("radius", [1e-3, 0.05, 2.0, 100.0])
def test_float64_equals_the_oracle_at_any_radius(radius: float) -> None:
    gb = random_gbuffer(7, height=10, width=12)
    expected = oracle(gb, 4, torch.finfo(torch.float64).eps, radius=radius)
    torch.testing.assert_close(module(4, radius=radius)(gb), expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("layers", [1, 4, 8])
def test_float32_equals_the_oracle_on_99_percent(layers: int) -> None:
    gb = random_gbuffer(3, height=31, width=37, dtype=torch.float32)
    expected = oracle(gb, layers, torch.finfo(torch.float32).eps)
    error = (module(layers).float()(gb) - expected).abs()
    assert (error <= 1e-5).double().mean() >= 0.99


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 70.0, 80.0, 85.0])
def test_plane_is_open(angle: float, dtype: torch.dtype, orthographic: bool) -> None:
    gb = plane_gbuffer(angle, dtype=dtype, orthographic=orthographic)
    for layers in (1, 4):
        net = ts.StatVO(0.7, layers=layers, learnable="all")
        depth = gb.depth.clone().requires_grad_()
        visibility = net(ts.GBuffer(depth, gb.camera, normal=gb.normal))
        assert (1 - visibility).abs().max() <= 1e-3
        visibility.sum().backward()
        assert torch.isfinite(depth.grad).all()
        if dtype == torch.float64:
            assert (visibility == 1).all()  # values within rounding are exactly 0, and so is their gradient
            assert (depth.grad == 0).all()


def pieces(gb: ts.GBuffer) -> dict[str, torch.Tensor]:
    camera = gb.camera
    tensors = {"depth": gb.depth, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return tensors if gb.normal is None else tensors | {"normal": gb.normal}


def evaluate(net: ts.StatVO, gb: ts.GBuffer, tensors: dict[str, torch.Tensor]) -> torch.Tensor:
    camera = ts.Camera(
        *(tensors[name] for name in ("fx", "fy", "cx", "cy")),
        gb.camera.height,
        gb.camera.width,
        is_orthographic=gb.camera.is_orthographic,
    )
    rebuilt = ts.GBuffer(tensors["depth"], camera, normal=tensors.get("normal"), valid=gb.valid)
    raw = {f"raw_{name}": tensors[name] for name in PARAMETERS}
    return functional_call(net, raw, (rebuilt,))


@pytest.mark.parametrize(
    "case",
    [
        {"layers": 4, "height": 6, "width": 7, "batch": 2},
        {"layers": 2, "height": 5, "width": 6, "peels": 2},
        {"layers": 4, "height": 6, "width": 5, "normals": False},
        {"layers": 1, "height": 6, "width": 5, "orthographic": True},
    ],
    ids=str,
)
def test_gradcheck_and_forward_mode(case: dict) -> None:
    layers = case.pop("layers") if "layers" in case else 1
    gb = random_gbuffer(11, **case)
    case["layers"] = layers
    net = module(layers)
    tensors = pieces(gb) | {name: getattr(net, f"raw_{name}").detach().clone() for name in PARAMETERS}
    names = [n for n in tensors if not (gb.camera.is_orthographic and n in ("cx", "cy"))]
    rest = {n: t for n, t in tensors.items() if n not in names}
    inputs = [tensors[name].clone().requires_grad_() for name in names]

    def f(*values: torch.Tensor) -> torch.Tensor:
        return evaluate(net, gb, rest | dict(zip(names, values, strict=True)))

    assert torch.autograd.gradcheck(f, inputs, eps=1e-6, atol=1e-6, fast_mode=True, check_forward_ad=True)


def test_gradcheck_slow_mode_names_every_input() -> None:
    gb = random_gbuffer(5, height=4, width=5)
    net = module(2)
    tensors = pieces(gb) | {name: getattr(net, f"raw_{name}").detach().clone() for name in PARAMETERS}
    for name in tensors:
        value = tensors[name].clone().requires_grad_()
        assert torch.autograd.gradcheck(
            lambda v, name=name: evaluate(net, gb, tensors | {name: v}),
            value,
            eps=1e-6,
            atol=1e-6,
            check_forward_ad=True,
        ), name


@pytest.mark.parametrize("layers", [1, 4])
def test_radius_gradient_matches_differences_and_is_not_zero(layers: int) -> None:
    gb = random_gbuffer(21, height=24, width=32)  # no ties: no label may flip within the step
    cotangent = torch.randn(1, 1, 24, 32, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(radius: float) -> torch.Tensor:
        net = module(layers, radius=radius)
        return (net(gb) * cotangent).sum().detach()

    net = module(layers, radius=0.31)
    (net(gb) * cotangent).sum().backward()
    slope = float(net.raw_radius.grad) / 0.31  # the parameter is log radius
    numeric = float((loss(0.31 + 1e-7) - loss(0.31 - 1e-7)) / 2e-7)
    assert abs(slope) > 1e-2
    assert abs(slope - numeric) <= 1e-6 * max(1.0, abs(numeric))


def test_invalid_pixels_are_open_with_zero_gradient_and_never_occlude() -> None:
    gb = random_gbuffer(9, height=9, width=8, invalid=0.4)
    garbage = torch.where(gb.valid, gb.depth, torch.tensor([torch.nan, torch.inf, -3.0, 0.0])[torch.arange(8) % 4])
    depth = garbage.clone().requires_grad_()
    normal = torch.where(gb.valid, gb.normal, torch.nan).requires_grad_()
    net = module(4)
    out = net(ts.GBuffer(depth, gb.camera, normal=normal))
    torch.testing.assert_close(out, net(gb))
    assert (out[~gb.valid] == 1).all()
    (out * torch.randn(out.shape, generator=torch.Generator().manual_seed(0), dtype=out.dtype)).sum().backward()
    for grad, mask in ((depth.grad, gb.valid), (normal.grad, gb.valid.expand_as(normal))):
        assert torch.isfinite(grad).all()
        assert (grad[~mask] == 0).all()
        assert (grad[mask] != 0).any()


def test_scale_invariance() -> None:
    gb = steps_gbuffer(height=20, width=24, dtype=torch.float64)
    small = ts.StatVO(0.4, layers=4).double()(gb)
    for k in (1e-3, 1e6):
        scaled = ts.GBuffer(gb.depth * k, gb.camera, normal=gb.normal)
        torch.testing.assert_close(ts.StatVO(0.4 * k, layers=4).double()(scaled), small, atol=1e-6, rtol=0)


def test_forward_mode_through_vmap_and_jacfwd() -> None:
    gb = random_gbuffer(2, batch=3, height=6, width=7)
    net = module(4)
    batched = net(gb)
    torch.testing.assert_close(vmap(net)(gb), batched, atol=1e-12, rtol=0)

    def f(raw: torch.Tensor) -> torch.Tensor:
        return functional_call(net, {"raw_radius": raw[0], "raw_height": raw[1]}, (gb,))

    raw = torch.stack((net.raw_radius.detach(), net.raw_height.detach()))
    jacobian = jacfwd(f)(raw)
    raw.requires_grad_()
    assert jacobian.abs().amax() > 1e-3
    cotangent = torch.randn(batched.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (reverse,) = torch.autograd.grad((f(raw) * cotangent).sum(), raw)
    torch.testing.assert_close((jacobian * cotangent[..., None]).flatten(0, 3).sum(0), reverse, atol=1e-9, rtol=1e-9)


def test_second_derivative_is_an_error_not_a_zero() -> None:
    gb = random_gbuffer(2, height=5, width=5)
    net = module(2)
    (first,) = torch.autograd.grad(net(gb).square().sum(), net.raw_radius, create_graph=True)
    with pytest.raises(RuntimeError, match="no second derivative"):
        first.backward()


def test_memory_saved_for_backward_does_not_grow_with_layers() -> None:
    gb = random_gbuffer(1, height=16, width=16)

    def saved(layers: int) -> int:
        total = 0

        def pack(tensor: torch.Tensor) -> torch.Tensor:
            nonlocal total
            total += tensor.numel() * tensor.element_size()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            module(layers)(gb)
        return total

    assert saved(8) == saved(1)


@pytest.mark.parametrize(
    "depth", [torch.full((1, 1, 9, 9), 3.0), torch.full((1, 1, 9, 9), 3.0).index_fill(3, torch.arange(4), 2.0)]
)
def test_constant_and_two_valued_depth(depth: torch.Tensor) -> None:
    gb = ts.GBuffer(depth, ts.Camera.perspective(60.0, 9, 9))
    for layers in (1, 2, 4, 8, 16):
        out = ts.StatVO(0.8, layers=layers)(gb)
        assert torch.isfinite(out).all()
        assert ((out >= 0) & (out <= 1)).all()
        if depth.unique().numel() == 1:
            assert (out == 1).all()
