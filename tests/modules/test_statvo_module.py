"""The module: parameters, configuration, copies, files, dtypes, errors."""

from __future__ import annotations

import copy
import json
import pickle

import pytest
import torch

import torch_ssao as ts
from support.gbuffers import random_gbuffer, steps_gbuffer
from torch_ssao import checks
from torch_ssao.serialize import ModuleFileError


def test_parameters_are_fixed_by_default_and_learnable_on_request() -> None:
    assert list(ts.StatVO().parameters()) == []
    net = ts.StatVO(0.5, learnable=("radius", "contrast"))
    assert [name for name, _ in net.named_parameters()] == ["raw_radius", "raw_contrast"]
    assert len(list(ts.StatVO(learnable="all").parameters())) == 4
    assert set(ts.StatVO().state_dict()) == set(ts.StatVO(learnable="all").state_dict())


def test_values_read_and_write_as_positive_tensors() -> None:
    net = ts.StatVO(0.5, learnable=("radius",))
    net.radius = 0.7
    torch.testing.assert_close(net.radius, torch.tensor(0.7))
    net.height = torch.tensor(2.0)
    assert net.values()["height"] == pytest.approx(2.0)
    with pytest.raises(checks.RangeError, match="radius must be finite and greater than 0"):
        net.radius = -1.0
    torch.testing.assert_close(net.radius, torch.tensor(0.7))
    loss = net(steps_gbuffer()).mean()
    loss.backward()
    assert net.raw_radius.grad != 0


def test_repr_names_values_and_choices() -> None:
    text = repr(ts.StatVO(0.25, layers=8))
    assert "radius=0.25" in text
    assert "layers=8" in text


def test_copies_pickles_and_files_give_the_same_image(tmp_path) -> None:
    gb = steps_gbuffer()
    net = ts.StatVO(0.37, height=1.7, falloff=0.3, contrast=0.9, layers=2, learnable=("radius",))
    image = net(gb)
    ts.save(net, tmp_path / "deep" / "ao.json")
    for twin in (copy.deepcopy(net), pickle.loads(pickle.dumps(net)), ts.load(tmp_path / "deep" / "ao.json")):
        assert torch.equal(twin(gb), image)
        assert twin.learnable == ("radius",)
        assert twin.config() == net.config()
    record = json.loads((tmp_path / "deep" / "ao.json").read_text())
    assert record["values"]["radius"] == pytest.approx(0.37)
    ts.save(net.double(), tmp_path / "ao.json")
    assert ts.load(tmp_path / "ao.json").radius.dtype == torch.float64


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "does not exist"),
        ("{", "not readable JSON"),
        ("[]", "no torch_ssao module"),
        ('{"format": "torch_ssao.module", "version": 99}', "version 99"),
        ('{"format": "torch_ssao.module", "version": 1}', "lacks or has a wrong"),
    ],
)
def test_bad_files(tmp_path, content: str | None, message: str) -> None:
    path = tmp_path / "ao.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ModuleFileError, match=message):
        ts.load(path)


def test_save_errors(tmp_path) -> None:
    with pytest.raises(ModuleFileError, match="module must be one of"):
        ts.save(torch.nn.Linear(1, 1), tmp_path / "x.json")  # type: ignore[arg-type]
    (tmp_path / "file").write_text("")
    with pytest.raises(checks.OutputError, match="not writable"):
        ts.save(ts.StatVO(), tmp_path / "file" / "x.json")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_input_and_autocast(dtype: torch.dtype) -> None:
    gb = steps_gbuffer()
    exact = ts.StatVO(0.4)(gb)
    assert ts.StatVO(0.4)(gb.to(dtype)).dtype == torch.float32
    with torch.autocast("cpu", dtype=dtype):
        torch.testing.assert_close(ts.StatVO(0.4)(gb), exact)


def test_non_contiguous_and_expanded_input() -> None:
    gb = random_gbuffer(1, height=8, width=10)
    net = ts.StatVO(0.4).double()
    strided = ts.GBuffer(
        gb.depth.mT.contiguous().mT,
        gb.camera,
        normal=gb.normal.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2),
        valid=gb.valid,
    )
    torch.testing.assert_close(net(strided), net(gb), atol=1e-12, rtol=0)
    twice = ts.GBuffer(
        gb.depth.expand(2, -1, -1, -1),
        gb.camera,
        normal=gb.normal.expand(2, -1, -1, -1),
        valid=gb.valid.expand(2, -1, -1, -1),
    )
    torch.testing.assert_close(net(twice)[1:], net(gb), atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"radius": 0.0}, checks.RangeError, "radius must be finite and greater than 0, got 0.0"),
        ({"radius": float("nan")}, checks.RangeError, "radius must be"),
        ({"contrast": -1.0}, checks.RangeError, "contrast must be"),
        ({"layers": 3}, checks.RangeError, "power of two, got 3: use 2 or 4"),
        ({"layers": 0}, checks.RangeError, "layers must be a whole number"),
        ({"layering": "random"}, checks.ChoiceError, "layering must be one of"),
        ({"learnable": "thickness"}, checks.ChoiceError, "learnable must be one of"),
    ],
)
def test_bad_configuration(arguments: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ts.StatVO(**arguments)


def test_unknown_backend() -> None:
    with pytest.raises(checks.ChoiceError, match="backend must be one of"):
        ts.StatVO()(steps_gbuffer(), backend="cuda")


def test_two_windows_are_the_weighted_mean_of_two_modules() -> None:
    gb = steps_gbuffer(height=20, width=24, dtype=torch.float64)
    outer, inner = (1 - ts.StatVO(radius, layers=4).double()(gb) for radius in (0.8, 0.2))
    both = ts.StatVO(0.8, layers=4, windows=2, inner_radius=0.25, inner_weight=3.0, learnable="all").double()
    torch.testing.assert_close(both(gb), 1 - (outer + 3 * inner) / 4, atol=1e-6, rtol=0)
    assert set(both.learnable) == set(both.PARAMETERS)
    assert "inner_radius" not in ts.StatVO(learnable="all").learnable
    with pytest.raises(ts.checks.ChoiceError, match="windows"):
        ts.StatVO(windows=3)
