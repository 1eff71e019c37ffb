"""The compiled horizon loops against the torch op: values, every gradient, threads, forks, and what they refuse."""

from __future__ import annotations

import itertools
import multiprocessing
import subprocess
import sys
import threading
from typing import Any

import pytest
import torch
from torch.func import jvp, vmap

import torch_ssao as ts
from support.gbuffers import random_gbuffer, steps_gbuffer
from support.horizon import FORMS, question, smooth_gbuffer
from torch_ssao import checks
from torch_ssao.ops import backend as backends
from torch_ssao.ops import horizon_obscurance

pytest.importorskip("numba")

NAMES = {"depth": 0, "normal": 2, "intrinsics": 3, "radius": 4, "falloff": 5, "thickness": 6, "bias": 7}
CHANGES = [
    {},
    {"max_radius_px": 0.6},
    {"max_radius_px": 0.1},  # shortens the radius
    {"offscreen": "extend"},
    {"bias": 0.0, "step_power": 1.0},
    {"radius": 30.0, "steps": 9},
    {"radius": 0.02, "slices": 1, "steps": 1},
    {"falloff": 0.6},
]


def scene(dtype: torch.dtype = torch.float64, *, width: int = 24, orthographic: bool = False) -> ts.GBuffer:
    """Two images with invalid pixels; rows that do not fill the loops' lanes."""
    return smooth_gbuffer(height=17, width=width, batch=2, orthographic=orthographic).to(dtype)


def answer(
    tensors: tuple[torch.Tensor, ...], keywords: dict[str, Any], backend: str, *, cotangent: torch.Tensor | None = None
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Obscurance and, with a cotangent, the gradients by name."""
    if cotangent is None:
        return horizon_obscurance(*tensors, **keywords, backend=backend), {}
    moving = list(tensors)
    names = [name for name, place in NAMES.items() if tensors[place] is not None]
    for name in names:
        moving[NAMES[name]] = tensors[NAMES[name]].clone().requires_grad_()
    value = horizon_obscurance(*moving, **keywords, backend=backend)
    grads = torch.autograd.grad(value, [moving[NAMES[name]] for name in names], cotangent)
    return value.detach(), dict(zip(names, grads, strict=True))


def cotangent_of(gb: ts.GBuffer) -> torch.Tensor:
    image = gb.depth[:, 0]
    return torch.randn(image.shape, generator=torch.Generator().manual_seed(3), dtype=image.dtype)


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return float((found - wanted).norm() / wanted.norm().clamp(min=1e-30))


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("weighting", ["cosine", "uniform"])
@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
def test_float64_equals_the_torch_op(form: dict[str, Any], weighting: str, orthographic: bool) -> None:
    for make, change in itertools.product((smooth_gbuffer, random_gbuffer), CHANGES):
        given = {"seed": 1} if make is random_gbuffer else {}
        gb = make(height=9, width=14, batch=2, orthographic=orthographic, **given)  # type: ignore[operator]
        asked = question(gb, **({"steps": 4, "weighting": weighting} | form | change))
        value, grads = answer(*asked, "numba", cotangent=cotangent_of(gb))
        wanted, wanted_grads = answer(*asked, "torch", cotangent=cotangent_of(gb))
        torch.testing.assert_close(value, wanted, atol=1e-10, rtol=0)
        if change.get("bias") == 0:  # a parameter that is not in use: ends on the tangent plane tie with it
            del grads["bias"]
        for name, grad in grads.items():
            difference = float((grad - wanted_grads[name]).norm())
            assert difference <= 1e-9 * max(1.0, float(wanted_grads[name].norm())), (name, change)


def test_every_gradient_is_there() -> None:
    """The comparison above could not fail where both are 0."""
    gb = scene()
    for form in ({"estimator": "increments"}, {"estimator": "bitmask", "connected": True}):
        _, grads = answer(*question(gb, slices=3, steps=4, **form), "numba", cotangent=cotangent_of(gb))
        for name in set(NAMES) - ({"falloff"} if form["estimator"] == "bitmask" else set()):
            assert grads[name].abs().max() > 1e-2, name


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("weighting", ["cosine", "uniform"])
def test_float32_equals_the_torch_op_but_where_a_tap_rounds_the_other_way(form: dict[str, Any], weighting: str) -> None:
    gb = scene(torch.float32, width=150)
    asked = question(gb, slices=3, steps=6, weighting=weighting, footprint_step=0.0, **form)
    value, _ = answer(*asked, "numba")
    wanted, _ = answer(*asked, "torch")
    same = (value - wanted).abs() <= 1e-5
    assert same.double().mean() >= 0.99
    cotangent = cotangent_of(gb) * same
    _, grads = answer(*asked, "numba", cotangent=cotangent)
    _, wanted_grads = answer(*asked, "torch", cotangent=cotangent)
    for name, grad in grads.items():
        assert relative(grad, wanted_grads[name]) <= 1e-3, name


def test_any_number_of_threads_gives_the_same_bits() -> None:
    gb = scene(torch.float32, width=140)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            found.append(answer(*question(gb, connected=True), "numba", cotangent=cotangent_of(gb)))
    finally:
        torch.set_num_threads(threads)
    for value, grads in found[1:]:
        assert torch.equal(value, found[0][0])
        for name, grad in grads.items():
            assert torch.equal(grad, found[0][1][name]), name


def test_several_python_threads_at_once() -> None:
    gb = scene(torch.float32)
    asked = question(gb)
    wanted, wanted_grads = answer(*asked, "numba", cotangent=cotangent_of(gb))
    wrong: list[object] = []

    def ask() -> None:
        try:
            for _ in range(5):
                value, grads = answer(*asked, "numba", cotangent=cotangent_of(gb))
                wrong.extend(n for n, grad in grads.items() if not torch.equal(grad, wanted_grads[n]))
                wrong.extend(["value"] * (not torch.equal(value, wanted)))
        except BaseException as error:
            wrong.append(error)

    askers = [threading.Thread(target=ask) for _ in range(4)]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join(60)
    assert not wrong
    assert not any(asker.is_alive() for asker in askers)


def _send(pipe: Any) -> None:
    torch.set_num_threads(2)  # a worker of a DataLoader has one; two need the helpers
    gb = scene(torch.float32)
    value, grads = answer(*question(gb), "numba", cotangent=cotangent_of(gb))
    pipe.send([value.tolist(), grads["depth"].tolist()])


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_answers() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        gb = scene(torch.float32)
        value, grads = answer(*question(gb), "numba", cotangent=cotangent_of(gb))
        context = multiprocessing.get_context("fork")
        here, there = context.Pipe(duplex=False)
        child = context.Process(target=_send, args=(there,))
        child.start()
        try:
            assert here.poll(60), "the child hangs"
            assert here.recv() == [value.tolist(), grads["depth"].tolist()]
        finally:
            child.join(10)
            child.kill()
    finally:
        torch.set_num_threads(threads)


def test_forward_mode_and_vmap() -> None:
    gb = random_gbuffer(6, height=7, width=9, batch=2)
    tensors, keywords = question(gb)
    generator = torch.Generator().manual_seed(1)
    move = torch.randn(tensors[0].shape, generator=generator, dtype=torch.float64)

    def along(backend: str, depth: torch.Tensor, radius: torch.Tensor) -> torch.Tensor:
        return answer((depth, *tensors[1:4], radius, *tensors[5:]), keywords, backend)[0]

    pushed, wanted = (
        jvp(lambda depth, b=b: along(b, depth, tensors[4]), (tensors[0],), (move,))[1] for b in ("numba", "torch")
    )
    assert wanted.abs().max() > 1e-3
    torch.testing.assert_close(pushed, wanted, atol=1e-10, rtol=0)
    several = torch.stack([tensors[4], 1.5 * tensors[4]])
    mapped = vmap(lambda radius: along("numba", tensors[0], radius))(several)
    torch.testing.assert_close(mapped[1], along("torch", tensors[0], several[1]), atol=1e-10, rtol=0)
    radius = tensors[4].clone().requires_grad_()
    (first,) = torch.autograd.grad(along("numba", tensors[0], radius).sum(), radius, create_graph=True)
    with pytest.raises(RuntimeError, match="no second derivative"):
        first.sum().backward()


def test_strides_do_not_matter() -> None:
    tensors, keywords = question(scene())
    turned = tuple(None if t is None else t.movedim(0, -1).contiguous().movedim(-1, 0) for t in tensors)
    value, _ = answer(tensors, keywords, "numba")
    assert torch.equal(answer(turned, keywords, "numba")[0], value)


def test_module_uses_them_unless_told_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    gb, net = steps_gbuffer(height=20, width=30), ts.HBAO(0.5, connected=False)
    asked: list[bool] = []
    monkeypatch.setattr("torch_ssao.ops.horizon.uses_numba", lambda *a, **k: asked.append(uses(*a, **k)) or asked[-1])
    images = [net(gb, backend=backend) for backend in ("auto", "numba", "torch")]
    assert asked == [True, True, False]
    assert torch.equal(images[0], images[1])
    torch.testing.assert_close(images[1], images[2], atol=1e-5, rtol=0)


uses = backends.uses_numba


def test_what_they_refuse(monkeypatch: pytest.MonkeyPatch) -> None:
    image = torch.zeros(1)
    with pytest.raises(checks.ChoiceError, match="backend must be one of"):
        uses("cuda", image)
    with pytest.raises(checks.DeviceError, match="'numba' needs tensors on the CPU, got meta"):
        uses("numba", image.to("meta"))
    with pytest.raises(checks.DtypeError, match=r"'numba' needs float32 or float64, got torch\.float16"):
        uses("numba", image.half())
    with pytest.raises(checks.ChoiceError, match="'numba' has no bent normals"):
        uses("numba", image, lacking="bent normals")
    with pytest.raises(checks.ChoiceError, match="backend must be one of 'auto', 'torch'"):
        ts.StatVO()(steps_gbuffer(), backend="numba")
    assert not uses("auto", image, lacking="bent normals")
    assert not uses("auto", image.to("meta"))
    monkeypatch.setattr(backends, "numba_is_installed", lambda: False)
    assert not uses("auto", image)
    with pytest.raises(checks.MissingExtraError, match=r"torch_ssao\[cpu\]"):
        ts.HBAO()(steps_gbuffer(), backend="numba")


def test_numba_is_imported_on_first_use_only() -> None:
    code = "import torch_ssao, sys; torch_ssao.HBAO(); print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_networks_sort() -> None:
    """What puts every list of zeros and ones in order puts every list in order."""
    from torch_ssao.ops._numba.horizon import sorting_network

    for count in range(1, 11):
        for values in itertools.product((0, 1), repeat=count):
            row = list(values)
            for one, two in sorting_network(count):
                row[one], row[two] = min(row[one], row[two]), max(row[one], row[two])
            assert row == sorted(values)
