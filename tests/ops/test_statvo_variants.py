"""StatVO's variants: gradients of each in both modes, differential tables, compilers."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.func import functional_call, jacfwd, jvp, vmap

import torch_ssao as ts
from support.gbuffers import random_gbuffer
from torch_ssao.ops import statvo_obscurance

VARIANTS: list[dict[str, Any]] = [
    {"quadrants": True},
    {"quadrants": False, "layering": "uniform", "layers": 5},
    {"quadrants": False, "sat_scale": 2},
    {"quadrants": True, "sat_scale": 4},
    {"quadrants": True, "differential": True},
]
CASES: list[dict[str, Any]] = [{}, {"peels": 2, "batch": 2}, {"orthographic": True}, {"normals": False}]


def arguments(gb: ts.GBuffer, radius: float = 0.4) -> list[torch.Tensor]:
    """points, valid, normal, half, box_height and slope of a G-buffer, as the module makes them."""
    valid = gb.valid_mask
    depth = torch.where(valid, gb.depth, 1.0)
    normal = gb.normal
    if normal is None:
        normal = depth.new_tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1).expand(len(gb), 3, *depth.shape[2:])
    half = gb.camera.footprint(torch.tensor(radius, dtype=depth.dtype), depth)
    per_image = depth.new_ones(len(gb))
    return [gb.camera.unproject(depth), valid, normal, half, 0.3 * per_image, 0.7 * per_image]


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_gradcheck_in_both_modes(case: dict[str, Any], variant: dict[str, Any]) -> None:
    gb = random_gbuffer(13, height=5, width=6, **case)
    points, valid, *rest = arguments(gb)
    inputs = [tensor.clone().requires_grad_() for tensor in (points, *rest)]

    def f(points: torch.Tensor, *rest: torch.Tensor) -> torch.Tensor:
        return statvo_obscurance(points, valid, *rest, **({"layers": 4} | variant))

    assert torch.autograd.gradcheck(f, inputs, eps=1e-7, atol=2e-6, fast_mode=True, check_forward_ad=True)


@pytest.mark.parametrize("sat_scale", [1, 2])
@pytest.mark.parametrize("layers", [2, 4, 8])
@pytest.mark.parametrize("case", [{}, {"peels": 2, "batch": 2}, {"orthographic": True}], ids=str)
def test_surrogate_has_the_same_value_and_its_two_modes_are_transposes(
    case: dict[str, Any], layers: int, sat_scale: int
) -> None:
    gb = random_gbuffer(17, height=7, width=8, **case)
    points, valid, *rest = arguments(gb)
    inputs = tuple(tensor.clone() for tensor in (points, *rest))  # forward mode refuses expanded inputs
    generator = torch.Generator().manual_seed(layers)

    def f(gradient: str, *inputs: torch.Tensor) -> torch.Tensor:
        return statvo_obscurance(
            inputs[0],
            valid,
            *inputs[1:],
            layers=layers,
            sat_scale=sat_scale,
            gradient=gradient,
            surrogate_width=0.25,
            quadrants=layers == 4,
        )

    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    tangents = tuple(torch.randn(t.shape, generator=generator, dtype=torch.float64) for t in inputs)
    gradients = {}
    for gradient in ("exact", "surrogate"):
        value = f(gradient, *leaves)
        cotangent = torch.randn(value.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
        pulled = torch.autograd.grad((value * cotangent).sum(), leaves)
        _, pushed = jvp(lambda *t, kind=gradient: f(kind, *t), inputs, tangents)
        left = (pushed * cotangent).sum()
        right = sum((p * t).sum() for p, t in zip(pulled, tangents, strict=True))
        torch.testing.assert_close(left, right, atol=1e-9, rtol=1e-9)
        gradients[gradient] = pulled
    assert torch.equal(f("exact", *inputs), f("surrogate", *inputs))
    for exact, surrogate in zip(gradients["exact"], gradients["surrogate"], strict=True):
        assert torch.isfinite(surrogate).all()
        assert surrogate.shape == exact.shape
    assert (gradients["exact"][0] - gradients["surrogate"][0]).abs().max() > 1e-3  # it does something


def soft_obscurance(
    points: torch.Tensor,
    valid: torch.Tensor,
    normal: torch.Tensor,
    half: torch.Tensor,
    box: float,
    slope: float,
    rounds: int,
) -> torch.Tensor:
    """One image with soft labels, every window summed pixel by pixel under plain autograd; width a quarter of the box."""
    height, width = valid.shape[-2:]
    v, u = (t.flatten().double() for t in torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij"))

    def cover(low: torch.Tensor, high: torch.Tensor, at: torch.Tensor, size: int) -> torch.Tensor:
        low, high = low.clamp(0, size)[:, None], high.clamp(0, size)[:, None]
        return (torch.minimum(high, at + 1) - torch.maximum(low, at)).clamp(min=0)

    reach_x, reach_y = half[0, :, 0].flatten(1)
    area = cover(u + 0.5 - reach_x, u + 0.5 + reach_x, u, width) * cover(
        v + 0.5 - reach_y, v + 0.5 + reach_y, v, height
    )
    x = points[0, :, 0].flatten(1)

    def leaves(member: torch.Tensor, level: int) -> list[torch.Tensor]:
        if level == 0:
            return [member]
        mean = (area @ (member * x[2])) / (area @ member)
        upper = torch.sigmoid((mean - x[2]) / (0.25 * box))
        return leaves(member * upper, level - 1) + leaves(member * (1 - upper), level - 1)

    total, count = 0, 0
    for member in leaves(valid.flatten().double(), rounds):
        amount = area @ member
        mean = (area @ (member * x).T) / amount[:, None]
        rise = ((mean - x.T) * normal[0].flatten(1).T).sum(1) / box
        psi = torch.where(rise > 1, (1 - slope * (rise - 1)).clamp(min=0), rise.clamp(min=0))
        total, count = total + amount * psi, count + amount
    return torch.where(valid.flatten(), total / count, 0.0).view(1, height, width)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("layers", [2, 4, 8])
def test_surrogate_is_the_gradient_of_the_soft_partition(layers: int, orthographic: bool) -> None:
    gb = random_gbuffer(layers, height=7, width=8, orthographic=orthographic)
    points, valid, normal, half, box, slope = arguments(gb)
    cotangent = torch.randn(1, 7, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    inputs = [tensor.clone().requires_grad_() for tensor in (points, normal, half)]
    soft = soft_obscurance(inputs[0], valid, *inputs[1:], 0.3, 0.7, layers.bit_length() - 1)
    expected = torch.autograd.grad((soft * cotangent).sum(), inputs)
    hard = statvo_obscurance(
        inputs[0], valid, *inputs[1:], box, slope, layers=layers, gradient="surrogate", surrogate_width=0.25
    )
    for got, want in zip(torch.autograd.grad((hard * cotangent).sum(), inputs), expected, strict=True):
        torch.testing.assert_close(got, want, atol=1e-9, rtol=1e-9)
    assert (soft - hard).abs().max() > 1e-2  # the value stays hard


@pytest.mark.parametrize("quadrants", [False, True])
@pytest.mark.parametrize("layers", [1, 4, 16])
def test_differential_tables_give_the_same_image(layers: int, quadrants: bool) -> None:
    points, *rest = arguments(random_gbuffer(4, height=21, width=23, batch=2))
    direct, differential = (
        statvo_obscurance(points, *rest, layers=layers, quadrants=quadrants, differential=choice)
        for choice in (False, True)
    )
    torch.testing.assert_close(direct, differential, atol=1e-9, rtol=0)


def test_differential_tables_need_a_tree() -> None:
    with pytest.raises(ts.checks.ChoiceError, match="differential"):
        statvo_obscurance(
            *arguments(random_gbuffer(4, height=5, width=6)), layers=3, layering="uniform", differential=True
        )


VMAPPED = [{}, {"sat_scale": 2}, {"layering": "uniform"}, {"gradient": "surrogate"}, {"windows": 2}]


@pytest.mark.parametrize("variant", VMAPPED, ids=str)
def test_vmap_and_jacfwd_agree_with_loops(variant: dict[str, Any]) -> None:
    gb = random_gbuffer(8, batch=3, height=6, width=7)
    net = ts.StatVO(0.45, layers=4, learnable="all", **variant).double()
    torch.testing.assert_close(vmap(net)(gb), net(gb), atol=1e-12, rtol=0)
    names = [f"raw_{name}" for name in net.used_parameters()]
    raw = torch.stack([getattr(net, name).detach() for name in names])

    def f(raw: torch.Tensor) -> torch.Tensor:
        return functional_call(net, dict(zip(names, raw.unbind(), strict=True)), (gb,))

    jacobian = jacfwd(f)(raw)
    assert (jacobian.flatten(0, 3).abs().amax(0) > 1e-3).all()  # no parameter's derivative is silently zero
    for index, column in enumerate(torch.eye(len(names), dtype=torch.float64)):
        torch.testing.assert_close(jvp(f, (raw,), (column,))[1], jacobian[..., index], atol=1e-12, rtol=0)
    cotangent = torch.randn(jacobian.shape[:-1], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    raw.requires_grad_()
    (reverse,) = torch.autograd.grad((f(raw) * cotangent).sum(), raw)
    torch.testing.assert_close((jacobian * cotangent[..., None]).flatten(0, 3).sum(0), reverse, atol=1e-9, rtol=1e-9)
    one = gb.camera[0]
    mapped = vmap(torch.func.grad(lambda depth: net(ts.GBuffer(depth[None], one)).square().sum()))(gb.depth)
    for image in range(3):
        depth = gb.depth[image : image + 1].clone().requires_grad_()
        net(ts.GBuffer(depth, one)).square().sum().backward()
        torch.testing.assert_close(mapped[image], depth.grad[0], atol=1e-12, rtol=0)


# torch's own: dynamo makes an instance of a Function to trace its backward.
@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")
@pytest.mark.parametrize("backend", ["eager", "aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
@pytest.mark.parametrize("variant", [{}, {"sat_scale": 2, "gradient": "surrogate"}], ids=str)
def test_compiled_whole_graph_gives_value_and_gradients(variant: dict[str, Any], backend: str) -> None:
    gb = random_gbuffer(8, batch=2, height=8, width=9, dtype=torch.float32)
    net = ts.StatVO(0.45, layers=4, learnable="all", **variant)
    torch._dynamo.reset()

    def visibility(depth: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
        return net(ts.GBuffer(depth, gb.camera, normal=normal, valid=gb.valid))

    results = []
    cotangent = torch.randn(2, 1, 8, 9, generator=torch.Generator().manual_seed(0))
    for function in (torch.compile(visibility, fullgraph=True, backend=backend), visibility):
        net.zero_grad()
        depth, normal = gb.depth.clone().requires_grad_(), gb.normal.clone().requires_grad_()
        out = function(depth, normal)
        (out * cotangent).sum().backward()
        results.append([out.detach(), depth.grad, normal.grad, *(p.grad.clone() for p in net.parameters())])
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want, atol=1e-5, rtol=1e-5)
