"""A renderer's pass becomes a target: PNG of 8 and 16 bit, EXR of half and single precision, and what goes wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import torch_ssao as ts
from support.gbuffers import steps_gbuffer
from torch_ssao import checks
from torch_ssao.reference import load_image

RAMP = np.linspace(0, 1, 24 * 32, dtype=np.float32).reshape(24, 32)
OpenEXR = pytest.importorskip("OpenEXR")


def write_exr(path: Path, **channels: np.ndarray) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {name.replace("_", "."): pixels for name, pixels in channels.items()}) as file:
        file.write(str(path))
    return path


@pytest.mark.parametrize(("depth", "step"), [(np.uint8, 255), (np.uint16, 65535)])
def test_png_of_8_and_16_bit(tmp_path: Path, depth: type, step: int) -> None:
    Image.fromarray((RAMP * step).round().astype(depth)).save(tmp_path / "ao.png")
    image = load_image(tmp_path / "ao.png")
    assert image.shape == (1, 1, 24, 32)
    assert image.dtype == torch.float32
    assert float((image[0, 0] - torch.from_numpy(RAMP)).abs().max()) <= 0.51 / step


def test_bands_and_srgb(tmp_path: Path) -> None:
    encoded = np.where(RAMP <= 0.0031308, 12.92 * RAMP, 1.055 * RAMP ** (1 / 2.4) - 0.055)
    bands = np.stack([encoded, 1 - encoded, 0 * encoded], 2)
    Image.fromarray((bands * 255).round().astype(np.uint8)).save(tmp_path / "ao.png")
    linear = load_image(tmp_path / "ao.png", srgb=True)
    assert float((linear[0, 0] - torch.from_numpy(RAMP)).abs().max()) < 0.01
    second = load_image(tmp_path / "ao.png", channel=1)
    assert float((second[0, 0] - torch.from_numpy(1 - encoded)).abs().max()) < 0.01


@pytest.mark.parametrize("precision", [np.float16, np.float32])
def test_exr_channels(tmp_path: Path, precision: type) -> None:
    path = write_exr(tmp_path / "passes.exr", ao_V=RAMP.astype(precision), Z=(7 * RAMP).astype(precision))
    assert torch.allclose(load_image(path)[0, 0], torch.from_numpy(RAMP), atol=1e-3)
    assert torch.allclose(load_image(path, channel="Z")[0, 0], torch.from_numpy(7 * RAMP), atol=1e-2)


def test_a_module_is_fitted_to_a_file(tmp_path: Path) -> None:
    gb = steps_gbuffer(height=24, width=32)
    wanted = ts.StatVO(0.4, layers=1, contrast=1.7)(gb)
    path = write_exr(tmp_path / "ao.exr", R=wanted[0, 0].float().numpy())
    result = ts.fitting.fit(ts.StatVO(0.4, layers=1), gb, load_image(path), parameters="contrast")
    assert result.values["contrast"] == pytest.approx(1.7, rel=1e-3)


def test_errors(tmp_path: Path) -> None:
    with pytest.raises(checks.SceneError, match="is not there"):
        load_image(tmp_path / "ao.exr")
    for name in ("broken.exr", "broken.png"):
        (tmp_path / name).write_bytes(b"not an image")
        with pytest.raises(checks.SceneError, match="cannot be read as an image"):
            load_image(tmp_path / name)
    with pytest.raises(checks.SceneError, match="channel must be one of R"):
        load_image(write_exr(tmp_path / "ao.exr", R=RAMP), channel="V")
    Image.fromarray((RAMP * 255).astype(np.uint8)).save(tmp_path / "ao.png")
    with pytest.raises(checks.SceneError, match="channel must be an index below 1"):
        load_image(tmp_path / "ao.png", channel=3)


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_exr(tmp_path / "ao.exr", R=RAMP)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(checks.MissingExtraError, match=r"needs OpenEXR.*torch_ssao\[exr\]"):
        load_image(path)
