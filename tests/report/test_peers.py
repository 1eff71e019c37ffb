"""Results of other implementations: what is read, and one line for what cannot be."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from torch_ssao import checks
from torch_ssao.report.peers import Peer, load_peers
from torch_ssao.report.rows import Score, Timing

HERE = {"scene": "corner", "height": 36, "width": 48}
ROW = {"name": "other", "validation": {"rmse": 0.1}}


def written(folder: Path, content: Any) -> Path:
    path = folder / "peers.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_list_of_rows(tmp_path: Path) -> None:
    full = {
        "name": "full",
        "ms": 3.0,
        "ms_low": 2.5,
        "ms_high": 3.5,
        "validation": {"rmse": 0.1, "psnr": 20, "ssim": 0.9},
        "training": {"rmse": 0.05, "ssim": None},
        "note": "elsewhere",
    }
    first, second = load_peers(written(tmp_path, [full, ROW | {"ms": None}]), **HERE)
    assert first.validation == Score(0.1, 20.0, 0.9)
    assert first.timing == Timing(3.0, 2.5, 3.5, 0)
    assert first.training is not None
    assert (first.training.rmse, math.isnan(first.training.psnr)) == (0.05, True)
    assert (first.note, second.note) == ("elsewhere", "")
    assert (second.name, second.timing, second.training) == ("other", None, None)


def test_a_file_that_says_what_it_is_about(tmp_path: Path) -> None:
    record = {**HERE, "note": "card X", "rows": [ROW, {**ROW, "name": "b", "note": "card Y", "ms": 2}]}
    peers = load_peers(written(tmp_path, record), **HERE)
    assert [peer.note for peer in peers] == ["card X", "card Y"]
    assert peers[1].timing == Timing(2.0, 2.0, 2.0, 0)
    assert isinstance(peers[0], Peer)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "must be JSON"),
        ("3", "must hold a list of rows, got int"),
        ({"note": "x"}, "must hold a list of rows, got none"),
        ({"rows": [], "scene": "temple"}, "must be about scene 'corner', got 'temple'"),
        ({"rows": [], "width": 640}, "must be about width 48, got 640"),
        ({"rows": [], "sizes": 1}, "must give the file only .* got 'sizes'"),
        ([3], "must name each row, got 3"),
        ([{"validation": {"rmse": 1}}], "must name each row"),
        ([{"name": " ", "validation": {"rmse": 1}}], "must name each row"),
        ([{"name": "a"}], "must give row 'a' validation an rmse, got None"),
        ([{"name": "a", "validation": {"ssim": 1}}], "must give row 'a' validation an rmse"),
        ([ROW | {"training": {"psnr": 3}}], "must give row 'other' training an rmse"),
        ([{"name": "a", "validation": {"rmse": "low"}}], "row 'a' validation rmse as a finite number of at least 0"),
        ([{"name": "a", "validation": {"rmse": -1}}], "of at least 0, got -1"),
        ('[{"name": "a", "validation": {"rmse": NaN}}]', "finite number"),
        ([{"name": "a", "validation": {"rmse": True}}], "finite number"),
        ([{"name": "a", "validation": {"rmse": 0.1, "lpips": 2}}], "only rmse, psnr, ssim, got 'lpips'"),
        ([ROW | {"time": 3}], "only name, ms, .* got 'time'"),
        ([ROW | {"ms": 0}], "0 < ms_low <= ms <= ms_high"),
        ([ROW | {"ms": 2, "ms_low": 3}], "0 < ms_low <= ms <= ms_high, got 3, 2, 2"),
        ([ROW, ROW], "must name each row once, got 'other' twice"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(checks.SceneError, match=message) as raised:
        load_peers(written(tmp_path, content), **HERE)
    assert "\n" not in str(raised.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(checks.SceneError, match="does not exist"):
        load_peers(tmp_path / "none.json", **HERE)
    with pytest.raises(checks.SceneError, match="cannot be read"):
        load_peers(tmp_path, **HERE)
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\xff")
    with pytest.raises(checks.SceneError, match="must be JSON"):
        load_peers(tmp_path / "picture.png", **HERE)
