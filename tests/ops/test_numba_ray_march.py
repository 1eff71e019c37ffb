"""The compiled ray march against the torch op: values, every gradient, threads, and what it leaves to torch."""

from __future__ import annotations

import itertools
import threading
from typing import Any

import pytest
import torch
from torch.func import jvp, vmap

import torch_ssao as ts
from support.gbuffers import random_gbuffer, steps_gbuffer
from support.horizon import smooth_gbuffer
from support.ray_march import geometry
from torch_ssao import checks
from torch_ssao.ops import poisson_disk, ray_march_visibility, tiled_noise
from torch_ssao.ops.depth_pyramid import furthest_read

pytest.importorskip("numba")

NAMES = {"points": 0, "normal": 2, "reach": 3, "falloff": 4, "thickness": 5, "intrinsics": 6}
CHANGES = [
    {},
    {"cap": 0.6},
    {"cap": 0.1},
    {"reach_step": 0.0},
    {"falloff": 3.0, "radius": 5.0},
    {"rays": 1, "steps": 1},
    {"radius": 0.02},
]


def question(
    gb: ts.GBuffer,
    *,
    rays: int = 4,
    steps: int = 5,
    radius: float = 0.6,
    falloff: float = 0.7,
    thickness: float | None = 0.4,
    cap: float | None = None,
    **options: object,
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Tensors and keywords of the operator."""
    dtype = gb.depth.dtype
    points, normals, intrinsics = (tensor.to(dtype) for tensor in geometry(gb))
    batch, _, _, height, width = points.shape
    reach = torch.full((batch, height, width), radius, dtype=dtype)
    if cap is not None:
        distance = torch.ones_like(reach) if gb.camera.is_orthographic else points[:, 2, 0]
        reach = torch.minimum(reach, furthest_read(cap) * distance / intrinsics[:, :2].amax(1)[:, None, None])
    scalars = [None if v is None else torch.full((batch,), v, dtype=dtype) for v in (falloff, thickness)]
    noise = tiled_noise(height, width, 0, dtype=dtype, device=reach.device)
    tensors = (points, gb.valid_mask, normals, reach, *scalars, intrinsics, poisson_disk(rays, dtype=dtype), *noise)
    return tensors, {"steps": steps, "orthographic": gb.camera.is_orthographic, "max_radius_px": cap} | options


def answer(
    tensors: tuple[Any, ...], keywords: dict[str, Any], backend: str, *, cotangent: torch.Tensor | None = None
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Visibility and, with a cotangent, the gradients by name."""
    if cotangent is None:
        return ray_march_visibility(*tensors, **keywords, backend=backend), {}
    moving = list(tensors)
    names = [name for name, place in NAMES.items() if tensors[place] is not None]
    for name in names:
        moving[NAMES[name]] = tensors[NAMES[name]].clone().requires_grad_()
    value = ray_march_visibility(*moving, **keywords, backend=backend)
    grads = torch.autograd.grad(value, [moving[NAMES[name]] for name in names], cotangent, materialize_grads=True)
    return value.detach(), dict(zip(names, grads, strict=True))


def cotangent_of(gb: ts.GBuffer) -> torch.Tensor:
    image = gb.depth[:, 0]
    return torch.randn(image.shape, generator=torch.Generator().manual_seed(3), dtype=image.dtype)


@pytest.mark.parametrize("peels", [1, 2, 3])
@pytest.mark.parametrize("thickness", [None, 0.4])
@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
def test_float64_equals_the_torch_op(peels: int, thickness: float | None, orthographic: bool) -> None:
    for make, change in itertools.product((smooth_gbuffer, random_gbuffer), CHANGES):
        given = {"seed": 1} if make is random_gbuffer else {}
        gb = make(height=9, width=14, batch=2, peels=peels, orthographic=orthographic, **given)  # type: ignore[operator]
        asked = question(gb, **({"thickness": thickness} | change))
        value, grads = answer(*asked, "numba", cotangent=cotangent_of(gb))
        wanted, wanted_grads = answer(*asked, "torch", cotangent=cotangent_of(gb))
        torch.testing.assert_close(value, wanted, atol=1e-10, rtol=0)
        for name, grad in grads.items():
            difference = float((grad - wanted_grads[name]).norm())
            assert difference <= 1e-9 * max(1.0, float(wanted_grads[name].norm())), (name, change)


def test_gradients_are_there() -> None:
    """The comparison above could not fail where both are 0."""
    gb = smooth_gbuffer(height=17, width=24, batch=2, peels=2)
    _, grads = answer(*question(gb, reach_step=0.0), "numba", cotangent=cotangent_of(gb))
    for name in ("points", "normal", "reach", "falloff"):
        assert grads[name].abs().max() > 1e-2, name


@pytest.mark.parametrize("peels", [1, 2])
def test_float32_equals_the_torch_op_but_where_a_step_falls_on_the_other_pixel(peels: int) -> None:
    gb = smooth_gbuffer(height=17, width=150, batch=2, peels=peels).to(torch.float32)
    asked = question(gb, rays=6, steps=7, reach_step=0.0)
    value, _ = answer(*asked, "numba")
    wanted, _ = answer(*asked, "torch")
    same = (value - wanted).abs() <= 1e-5
    assert same.double().mean() >= 0.99
    _, grads = answer(*asked, "numba", cotangent=cotangent_of(gb) * same)
    _, wanted_grads = answer(*asked, "torch", cotangent=cotangent_of(gb) * same)
    for name, grad in grads.items():
        assert (grad - wanted_grads[name]).norm() <= 1e-3 * wanted_grads[name].norm(), name


def test_any_number_of_threads_gives_the_same_bits_in_any_python_thread() -> None:
    gb = smooth_gbuffer(height=17, width=140, batch=2, peels=2).to(torch.float32)
    asked, cotangent = question(gb), cotangent_of(gb)
    threads, found = torch.get_num_threads(), []

    def ask(count: int) -> None:
        torch.set_num_threads(count)
        found.extend(answer(*asked, "numba", cotangent=cotangent) for _ in range(3))

    try:
        ask(1)
        askers = [threading.Thread(target=ask, args=(count,)) for count in (1, 2, 5)]
        for asker in askers:
            asker.start()
        for asker in askers:
            asker.join(60)
    finally:
        torch.set_num_threads(threads)
    assert len(found) == 12
    for value, grads in found[1:]:
        assert torch.equal(value, found[0][0])
        for name, grad in grads.items():
            assert torch.equal(grad, found[0][1][name]), name


def test_forward_mode_and_vmap() -> None:
    gb = random_gbuffer(6, height=7, width=9, batch=2)
    tensors, keywords = question(gb)
    move = torch.randn(tensors[0].shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def along(backend: str, points: torch.Tensor, reach: torch.Tensor) -> torch.Tensor:
        return answer((points, *tensors[1:3], reach, *tensors[4:]), keywords, backend)[0]

    pushed, wanted = (
        jvp(lambda points, b=b: along(b, points, tensors[3]), (tensors[0],), (move,))[1] for b in ("numba", "torch")
    )
    assert wanted.abs().max() > 1e-3
    torch.testing.assert_close(pushed, wanted, atol=1e-10, rtol=0)
    several = torch.stack([tensors[3], 1.5 * tensors[3]])
    mapped = vmap(lambda reach: along("numba", tensors[0], reach))(several)
    torch.testing.assert_close(mapped[1], along("torch", tensors[0], several[1]), atol=1e-10, rtol=0)


def test_strides_do_not_matter() -> None:
    tensors, keywords = question(smooth_gbuffer(height=9, width=14, batch=2, peels=2))
    turned = tuple(None if t is None else t.movedim(0, -1).contiguous().movedim(-1, 0) for t in tensors)
    assert torch.equal(answer(turned, keywords, "numba")[0], answer(tensors, keywords, "numba")[0])


def test_module_and_what_is_left_to_torch() -> None:
    gb = steps_gbuffer(height=20, width=30)
    net = ts.RayMarchedSSAO(0.5, rays=4, steps=5)
    torch.testing.assert_close(net(gb, backend="numba"), net(gb, backend="torch"), atol=1e-5, rtol=0)
    assert torch.equal(net(gb, backend="numba"), net(gb))
    soft = ts.RayMarchedSSAO(0.5, rays=4, steps=5, gradient="soft")
    with pytest.raises(checks.ChoiceError, match="'numba' has no gradient 'soft' of the ray march"):
        soft(gb, backend="numba")
    assert torch.equal(soft(gb), soft(gb, backend="torch"))
