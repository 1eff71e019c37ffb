"""Examples run and write their pictures."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_small(path: Path, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    subprocess.run([sys.executable, str(path), "--small", "--out", str(picture)], check=True, capture_output=True)
    assert picture.stat().st_size > 100


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_whole(path: Path, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    subprocess.run([sys.executable, str(path), "--out", str(picture)], check=True, capture_output=True)
    assert picture.stat().st_size > 1000
