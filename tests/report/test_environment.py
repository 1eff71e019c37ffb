from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
import torch

from torch_ssao import checks
from torch_ssao.report.environment import commit, environment, require


def git(folder: Path, *arguments: str) -> None:
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    subprocess.run(["git", "-C", str(folder), *who, *arguments], check=True, capture_output=True)


def test_it_says_what_a_reader_needs_and_fits_into_json() -> None:
    found = environment()
    assert found["versions"]["torch"] == torch.__version__.partition("+")[0] or found["versions"]["torch"]
    assert {"torch_ssao", "python", "numpy", "kornia", "embreex"} <= set(found["versions"])
    assert found["threads"] == torch.get_num_threads()
    assert found["cpu"]
    assert found["cpu_count"] >= 1
    assert found["device"] == "cpu"
    json.dumps(found, allow_nan=False)


def test_commit_of_a_clean_a_changed_and_no_checkout(tmp_path: Path) -> None:
    assert commit(tmp_path) is None
    git(tmp_path, "init", "-q")
    (tmp_path / "__init__.py").write_text("1\n")
    assert commit(tmp_path) is None  # not tracked: some other project's checkout
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "a")
    clean = commit(tmp_path)
    assert clean is not None
    assert len(clean) == 40
    (tmp_path / "__init__.py").write_text("2\n")
    assert commit(tmp_path) == clean + "+dirty"


def test_no_git_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit(tmp_path) is None


def test_a_missing_extra_is_named() -> None:
    require("report", "report", "json")
    with pytest.raises(checks.MissingExtraError, match=r"no_such_package.*pip install 'torch_ssao\[report\]'"):
        require("make_report", "report", "no_such_package")
