"""A module's file on a disk that fills up."""

from __future__ import annotations

from pathlib import Path

import pytest

import torch_ssao as ts
from torch_ssao import checks


@pytest.mark.parametrize("failing", ["pathlib.Path.write_text", "os.replace"])
def test_a_file_that_cannot_be_written_is_one_clear_error(
    failing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "ao.json"
    ts.save(ts.StatVO(0.5), path)
    before = path.read_text()

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(failing, full)
    with pytest.raises(checks.OutputError, match=r"ao.json' cannot be written \(No space left on device\): make room"):
        ts.save(ts.StatVO(0.7), path)
    assert [file.name for file in tmp_path.iterdir()] == ["ao.json"]
    assert path.read_text() == before
