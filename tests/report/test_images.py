from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torch_ssao import checks
from torch_ssao.report import images


def decoded(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)))


def test_grey_is_linear_and_white_is_open() -> None:
    plane = torch.tensor([[0.0, 0.25, 0.5], [1.0, 1.5, float("nan")]])
    content = images.grey_png(plane)
    assert decoded(content).tolist() == [[0, 64, 128], [255, 255, 255]]
    assert Image.open(io.BytesIO(content)).mode == "L"
    assert images.grey_png(plane[None]) == content


def test_more_than_one_image_is_refused() -> None:
    with pytest.raises(checks.ShapeError, match=r"image must have shape \(H, W\) or \(1, H, W\), got \(2, 4, 4\)"):
        images.grey_png(torch.ones(2, 4, 4))


def test_errors_are_red_where_too_open_blue_where_too_dark_grey_where_nothing_is_seen() -> None:
    target = torch.full((1, 12, 30), 0.5)
    prediction, valid = target.clone(), torch.ones_like(target, dtype=torch.bool)
    prediction[..., :10], prediction[..., 10:20], valid[..., 20:] = 1.0, 0.0, False
    picture = decoded(images.error_png(prediction, target, valid)).astype(int)
    row = picture[picture.shape[0] // 2]
    colours = [row[int(picture.shape[1] * share)] for share in (0.1, 0.35, 0.7)]
    assert colours[0][0] > colours[0][2] + 50
    assert colours[1][2] > colours[1][0] + 50
    assert abs(colours[2][0] - colours[2][2]) < 3


def test_the_same_error_has_the_same_colour_in_every_picture() -> None:
    target, valid = torch.zeros(1, 20, 20), torch.ones(1, 20, 20, dtype=torch.bool)
    small = images.error_png(target + 0.1, target, valid)
    other = target + 0.1
    other[..., 0, 0] = 0.9
    both = [decoded(content)[60, 200].tolist() for content in (small, images.error_png(other, target, valid))]
    assert both[0] == both[1]


def test_a_file_is_there_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.png"
    images.write(path, b"one")

    def refuse(*names: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(images.os, "replace", refuse)
    with pytest.raises(OSError, match="No space"):
        images.write(path, b"two")
    assert path.read_bytes() == b"one"
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_a_disk_that_fills_up_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left on device: .*a\.png'"):
        images.write(tmp_path / "a.png", b"content")
    assert not list(tmp_path.iterdir())
