"""The ray march's derivatives: exact, soft and surrogate; transforms; memory."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor
from torch.func import functional_call, grad, jacfwd, jacrev, vmap

import torch_ssao as ts
from support.gbuffers import random_gbuffer, steps_gbuffer
from support.memory import peak_bytes
from support.ray_march import bumps, ray_march, smooth_gbuffer, with_depth
from torch_ssao.ops.ray_march import ray_march_visibility

PARAMETERS = ("radius", "falloff", "thickness", "contrast")


def pieces(net: ts.RayMarchedSSAO, gb: ts.GBuffer) -> dict[str, Tensor]:
    camera = gb.camera
    tensors = {"depth": gb.depth, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    if gb.normal is not None:
        tensors["normal"] = gb.normal
    used = [name for name in PARAMETERS if getattr(net, name) is not None]
    return tensors | {name: getattr(net, f"raw_{name}").detach().clone() for name in used}


def evaluate(net: ts.RayMarchedSSAO, gb: ts.GBuffer, tensors: dict[str, Tensor]) -> Tensor:
    intrinsics = (tensors[name] for name in ("fx", "fy", "cx", "cy"))
    size = (gb.camera.height, gb.camera.width)
    camera = ts.Camera(*intrinsics, *size, is_orthographic=gb.camera.is_orthographic)
    rebuilt = ts.GBuffer(tensors["depth"], camera, normal=tensors.get("normal"), valid=gb.valid)
    raw = {f"raw_{name}": tensors[name] for name in PARAMETERS if name in tensors}
    return functional_call(net, raw, (rebuilt,))


@pytest.fixture
def texels_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """The derivative almost everywhere: no differences to the reach."""
    held = partial(ray_march_visibility, reach_step=0.0)
    monkeypatch.setattr("torch_ssao.modules.ray_march.ray_march_visibility", held)


def cotangent(shape: torch.Size, seed: int = 5) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.usefixtures("texels_held")
@pytest.mark.parametrize("gradient", ["exact", "soft"])
@pytest.mark.parametrize(
    "case",
    [
        {"height": 5, "width": 6, "batch": 2},
        {"height": 5, "width": 5, "peels": 3},
        {"height": 5, "width": 6, "normals": False},
        {"height": 5, "width": 6, "orthographic": True},
    ],
    ids=str,
)
def test_gradcheck_and_forward_mode(case: dict, gradient: str) -> None:
    gb = random_gbuffer(11, **case)
    for thick in (True, False):
        net = ray_march(thick=thick, radius=0.9, rays=3, steps=4, gradient=gradient, surrogate_width=0.2)
        tensors = pieces(net, gb)
        leaves = [tensor.clone().requires_grad_() for tensor in tensors.values()]

        def f(*values: Tensor, net=net, names=tuple(tensors)) -> Tensor:
            return evaluate(net, gb, dict(zip(names, values, strict=True)))

        assert torch.autograd.gradcheck(f, leaves, eps=1e-6, atol=1e-6, fast_mode=True, check_forward_ad=True)


@pytest.mark.usefixtures("texels_held")
def test_gradcheck_slow_mode_names_every_input() -> None:
    gb = random_gbuffer(5, height=3, width=4, peels=2)
    net = ray_march(radius=0.9, rays=3, steps=3, gradient="soft", surrogate_width=0.2)
    tensors = pieces(net, gb)
    for name in tensors:
        assert torch.autograd.gradcheck(
            lambda v, name=name: evaluate(net, gb, tensors | {name: v}),
            tensors[name].clone().requires_grad_(),
            eps=1e-6,
            atol=1e-6,
            check_forward_ad=True,
        ), name


def parameter_gradients(gb: ts.GBuffer, **changes: object) -> tuple[Tensor, dict[str, float]]:
    net = ray_march(radius=0.9, **changes)
    out = net(gb)
    (out * cotangent(out.shape)).sum().backward()
    return out.detach(), {name: float(getattr(net, f"raw_{name}").grad) for name in PARAMETERS}


def test_surrogate_keeps_the_value_and_moves_the_thickness() -> None:
    gb = random_gbuffer(6, height=16, width=20)
    exact, slopes = parameter_gradients(gb)
    assert slopes["thickness"] == 0
    assert min(abs(slopes[name]) for name in ("radius", "falloff", "contrast")) > 1e-2
    value, slopes = parameter_gradients(gb, gradient="surrogate")
    torch.testing.assert_close(value, exact, rtol=0, atol=1e-12)  # exact may run as compiled loops
    assert min(map(abs, slopes.values())) > 1e-2
    soft, _ = parameter_gradients(gb, gradient="soft", surrogate_width=1e-4)
    assert (soft - exact).abs().median() < 1e-3  # the soft form tends to the hard one


def test_soft_gradients_predict_differences_over_bumps() -> None:
    """Random cotangents, 32 bumps of 3 pixels and 6 % of the radius: many steps change pixels on the way."""
    gb, height = smooth_gbuffer(40, 56), 0.03
    smooth = bumps(32, 40, 56)[:, None]
    images = {}
    for gradient in ("soft", "exact"):
        net = ts.RayMarchedSSAO(0.5, rays=16, steps=8, gradient=gradient, surrogate_width=0.1).double()
        with torch.no_grad():
            up, down = (net(with_depth(gb, gb.depth + h * smooth)) for h in (height, -height))
        predicted, measured = [], []
        for seed in range(5, 8):
            weights = cotangent(gb.depth.shape, seed)
            depth = gb.depth.clone().requires_grad_()
            (net(with_depth(gb, depth)) * weights).sum().backward()
            predicted.append((depth.grad * smooth).sum((1, 2, 3)))
            measured.append(((up - down) * weights).sum((1, 2, 3)) / (2 * height))
        guess, truth = torch.cat(predicted), torch.cat(measured)
        correlation = torch.corrcoef(torch.stack((guess, truth)))[0, 1]
        images[gradient] = float(correlation), float((guess * truth).sum() / truth.square().sum())
    assert images["soft"][0] >= 0.99
    assert abs(images["soft"][1] - 1) <= 0.03
    assert images["exact"][0] < 0.9  # what holding hits constant leaves out


def cosine_and_error(direction: Tensor, truth: Tensor) -> tuple[float, float]:
    """Cosine similarity, and its standard error by leaving out one entry at a time."""
    count = len(truth)
    kept = ~torch.eye(count, dtype=torch.bool)
    each = torch.stack([torch.cosine_similarity(direction[k], truth[k], dim=0) for k in kept])
    error = ((count - 1) / count * (each - each.mean()).square().sum()).sqrt()
    return float(torch.cosine_similarity(direction, truth, dim=0)), float(error)


@pytest.mark.parametrize("thickness", [None, pytest.param(0.5, marks=pytest.mark.slow)])
def test_surrogate_follows_the_noise_smoothed_output(thickness: float | None) -> None:
    """64 smooth directions, the same noise on both sides of each difference."""
    size, width, radius = (22, 28), 0.05, 0.6
    options = {"rays": 4, "steps": 6, "thickness": thickness, "surrogate_width": width}
    gb = steps_gbuffer(height=size[0], width=size[1], dtype=torch.float64)
    smooth = bumps(64, *size, sigma=2.5, seed=3)[:, None]
    weights = 3 * torch.nn.functional.avg_pool2d(
        cotangent(gb.depth.shape), 3, 1, 1
    )  # of order 1, less noise in the mean
    net = ts.RayMarchedSSAO(radius, **options).double()
    generator = torch.Generator().manual_seed(9)
    truth = torch.zeros(64, dtype=torch.float64)
    with torch.no_grad():
        for _ in range(16):
            # A logistic of scale w has the standard deviation of a Gaussian of 1.7 w, nearly.
            noise = 1.7 * width * radius * torch.randn(gb.depth.shape, generator=generator, dtype=torch.float64)
            up, down = (net(with_depth(gb, gb.depth + noise + h * smooth)) for h in (0.03, -0.03))
            truth += ((up - down) * weights).sum((1, 2, 3))
    scores = {}
    for gradient in ("exact", "surrogate"):
        depth = gb.depth.clone().requires_grad_()
        net = ts.RayMarchedSSAO(radius, gradient=gradient, **options).double()
        (net(with_depth(gb, depth)) * weights).sum().backward()
        scores[gradient] = cosine_and_error((depth.grad * smooth).sum((1, 2, 3)), truth)
    gap = scores["surrogate"][0] - scores["exact"][0]
    assert gap > 2 * (scores["surrogate"][1] ** 2 + scores["exact"][1] ** 2) ** 0.5
    assert scores["surrogate"][0] > 0.5


def test_function_transforms() -> None:
    gb = random_gbuffer(2, batch=3, height=6, width=7)
    net = ray_march(radius=0.9, rays=3, steps=4, gradient="surrogate")
    batched = net(gb)
    torch.testing.assert_close(vmap(net)(gb), batched, atol=1e-12, rtol=0)

    def f(raw: Tensor) -> Tensor:
        return functional_call(net, {"raw_radius": raw[0], "raw_thickness": raw[1]}, (gb,))

    raw = torch.stack((net.raw_radius.detach(), net.raw_thickness.detach()))
    jacobian = jacfwd(f)(raw)
    assert (jacobian.abs().amax((0, 1, 2, 3)) > 1e-2).all()
    torch.testing.assert_close(jacrev(f)(raw), jacobian, atol=1e-12, rtol=1e-9)

    def loss(depth: Tensor, camera: ts.Camera, normal: Tensor, valid: Tensor) -> Tensor:
        return net(ts.GBuffer(depth[None], camera, normal=normal[None], valid=valid[None])).square().sum()

    depth = gb.depth.clone().requires_grad_()
    net(ts.GBuffer(depth, gb.camera, normal=gb.normal, valid=gb.valid)).square().sum().backward()
    for k in range(3):
        one = grad(loss)(gb.depth[k], gb.camera[k], gb.normal[k], gb.valid[k])
        torch.testing.assert_close(one, depth.grad[k], atol=1e-12, rtol=0)
    first = gb.camera[0]
    per_image = vmap(lambda d, n, v: grad(loss)(d, first, n, v))(gb.depth, gb.normal, gb.valid)
    torch.testing.assert_close(per_image[0], depth.grad[0], atol=1e-12, rtol=0)


def test_second_derivative_is_an_error_not_a_zero() -> None:
    gb = random_gbuffer(2, height=5, width=5)
    net = ray_march(radius=0.9)
    (first,) = torch.autograd.grad(net(gb).square().sum(), net.raw_radius, create_graph=True)
    with pytest.raises(RuntimeError, match="ray_march_visibility has no second derivative"):
        first.backward()


@pytest.mark.parametrize("gradient", ["exact", "surrogate", "soft"])
def test_invalid_pixels_and_bad_normals(gradient: str) -> None:
    gb = random_gbuffer(9, height=9, width=8, invalid=0.4)
    garbage = torch.tensor([torch.nan, torch.inf, -3.0, 0.0], dtype=torch.float64)[torch.arange(8) % 4]
    depth = torch.where(gb.valid, gb.depth, garbage).requires_grad_()
    normal = torch.where(gb.valid, gb.normal, torch.nan).requires_grad_()
    net = ray_march(gradient=gradient)
    out = net(ts.GBuffer(depth, gb.camera, normal=normal))
    torch.testing.assert_close(out, net(gb))
    assert (out[~gb.valid] == 1).all()
    (out * cotangent(out.shape)).sum().backward()
    for found, mask in ((depth.grad, gb.valid), (normal.grad, gb.valid.expand_as(normal))):
        assert torch.isfinite(found).all()
        assert (found[~mask] == 0).all()
        assert (found[mask] != 0).any()
    wild = gb.normal.clone()
    wild[..., 0], wild[..., 1], wild[..., 2], wild[..., 3] = torch.nan, torch.inf, 0.0, 1e200
    wild[:, :, :, 4] = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).view(1, 3, 1)  # away from the eye
    leaves = [gb.depth.clone().requires_grad_(), wild.requires_grad_()]
    out = net(ts.GBuffer(leaves[0], gb.camera, normal=leaves[1], valid=gb.valid))
    (out * cotangent(out.shape)).sum().backward()
    assert torch.isfinite(out).all()
    assert all(torch.isfinite(leaf.grad).all() for leaf in leaves)


def test_contrast_and_falloff_below_one_are_finite_at_zero() -> None:
    depth = torch.full((1, 1, 12, 12), 4.0)
    depth[..., ::2] = 2.0  # deep slots: many hits at the first step, where the distance is 0
    gb = ts.GBuffer(depth.requires_grad_(), ts.Camera.perspective(60.0, 12, 12))
    net = ts.RayMarchedSSAO(3.0, falloff=0.3, contrast=0.5, rays=4, steps=2, learnable="all")
    net(gb).sum().backward()
    assert torch.isfinite(depth.grad).all()
    assert all(torch.isfinite(p.grad) for p in net.parameters())


def peak_per_pixel(height: int, width: int, rays: int, steps: int, gradient: str) -> float:
    gb = steps_gbuffer(height=height, width=width)
    leaves = [gb.depth.clone().requires_grad_(), gb.normal.clone().requires_grad_()]
    net = ts.RayMarchedSSAO(0.5, rays=rays, steps=steps, thickness=0.5, gradient=gradient, learnable="all")
    weights = torch.randn(1, 1, height, width, generator=torch.Generator().manual_seed(0))
    work = lambda: net(ts.GBuffer(leaves[0], gb.camera, normal=leaves[1])).backward(weights)  # noqa: E731
    kept = 4 * (1 + 1 + 3)  # the output, and the gradients of depth and normal
    return peak_bytes(work) / (height * width) - kept


@pytest.mark.parametrize("gradient", ["exact", "surrogate"])
def test_memory_does_not_grow_with_taps(monkeypatch: pytest.MonkeyPatch, gradient: str) -> None:
    at_once = {"exact": 2**12, "surrogate": 2**14}[gradient]  # blocks as small beside this image as usual
    monkeypatch.setitem(ts.ops.ray_march._TAPS_AT_ONCE, "cpu", at_once)
    few, many = (peak_per_pixel(96, 128, *counts, gradient) for counts in ((2, 4), (4, 8)))
    assert many <= 320
    assert many <= 1.05 * few


@pytest.mark.slow
@pytest.mark.parametrize("counts", [(8, 8), (16, 16)])
def test_memory_at_full_size(counts: tuple[int, int]) -> None:
    assert peak_per_pixel(1080, 1920, *counts, "surrogate") <= 320


@pytest.mark.filterwarnings("ignore")  # dynamo's own
def test_compiled_module_gives_the_same_numbers() -> None:
    gb = random_gbuffer(2, height=6, width=7)
    net = ray_march(radius=0.9, rays=3, steps=4)

    def f(depth: Tensor) -> Tensor:
        return net(ts.GBuffer(depth, gb.camera, normal=gb.normal, valid=gb.valid))

    gradients = []
    for function in (f, torch.compile(f, backend="eager")):
        depth = gb.depth.clone().requires_grad_()
        out = function(depth)
        (out * cotangent(out.shape)).sum().backward()
        gradients.append((out.detach(), depth.grad))
    torch.testing.assert_close(gradients[1], gradients[0])
