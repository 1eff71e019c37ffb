"""The arrows of the house, and the purity of `import torch_ssao`, checked by reading imports."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torch_ssao

PACKAGE = Path(torch_ssao.__file__).parent
HEAVY = ("jax", "trimesh", "embreex", "numba", "triton", "matplotlib", "optimistix")

# room -> rooms it may import from, besides itself
ARROWS = {
    "checks": set(),
    "ops": {"checks"},
    "projection": {"checks"},
    "camera": {"checks", "projection"},
    "gbuffer": {"checks", "camera", "ops"},
    "modules": {"checks", "camera", "gbuffer", "ops"},
    "scenes": {"checks", "camera", "gbuffer"},
    "reference": {"checks", "camera", "gbuffer", "scenes"},
    "metrics": {"checks"},
    "serialize": {"checks", "modules"},
    "fitting": {"checks", "camera", "gbuffer", "modules", "metrics", "serialize"},
    "report": {"checks", "camera", "gbuffer", "fitting", "modules", "scenes", "reference", "metrics", "serialize"},
    "cli": {
        "checks",
        "camera",
        "gbuffer",
        "modules",
        "scenes",
        "reference",
        "metrics",
        "serialize",
        "report",
        "fitting",
    },
    "__main__": {"cli"},
}


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_modules(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def own_rooms(path: Path) -> set[str]:
    rooms = {name.split(".")[1] for name in imported_modules(path) if name.startswith("torch_ssao.")}
    return rooms - {"__version__"}


FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_arrows(path: Path) -> None:
    assert own_rooms(path) - {room(path)} <= ARROWS[room(path)]


def test_gbuffer_uses_no_op_but_the_normals() -> None:
    ops = {name for name in imported_modules(PACKAGE / "gbuffer.py") if name.startswith("torch_ssao.ops")}
    assert ops == {"torch_ssao.ops.normals.normals_from_points"}


def test_jax_lives_in_one_file() -> None:
    users = {
        path.name for path in FILES for name in imported_modules(path) if name.split(".")[0] in ("jax", "optimistix")
    }
    assert users == {"bridge.py"}


def test_the_arrow_check_can_fail(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text("from torch_ssao.modules import StatVO\nimport torch_ssao.scenes.render\n")
    assert own_rooms(bad) == {"modules", "scenes"}
    assert not own_rooms(bad) <= ARROWS["ops"]


def loaded_after(statement: str) -> list[str]:
    code = f"{statement}; import sys; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ast.literal_eval(done.stdout)


def test_import_is_light() -> None:
    assert loaded_after("import torch_ssao; torch_ssao.StatVO()") == []


def test_the_import_check_can_fail() -> None:
    assert loaded_after("import torch_ssao, matplotlib") == ["matplotlib"]


def test_files_and_functions_stay_short() -> None:
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 400, path.name
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                docs = len((ast.get_docstring(node, clean=False) or "").splitlines())
                assert (node.end_lineno or 0) - node.lineno - docs < 60, f"{path.name}: {node.name}"


def test_no_assert_in_the_package() -> None:
    for path in FILES:
        asserts = [
            node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Assert)
        ]
        assert not asserts, path.name
