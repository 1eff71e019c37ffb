"""What a measurement ran on: commit, versions, processor, device, threads."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from torch_ssao import checks

_PACKAGES = ("torch", "numpy", "kornia", "trimesh", "embreex", "optimistix", "jax", "matplotlib")


def environment(device: torch.device | str = "cpu") -> dict[str, Any]:
    """Where a measurement was made, as plain values for report.json.

    Args:
        device: the one the tensors lay on.
    Returns: `commit` (None outside a git checkout of this package; "+dirty" is appended when files differ from it),
        `versions`, `cpu`, `cpu_count` (cores this process may use), `threads` (of torch), `device`, `platform`.
    """
    from torch_ssao import __version__

    device = torch.device(device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
    versions = {"torch_ssao": __version__, "python": platform.python_version()}
    versions |= {package: version for package in _PACKAGES if (version := _version(package))}
    return {
        "commit": commit(Path(__file__).resolve().parents[1]),
        "versions": versions,
        "cpu": _cpu_model(),
        "cpu_count": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": torch.get_num_threads(),
        "device": name,
        "platform": platform.platform(),
    }


def commit(folder: Path) -> str | None:
    """The git commit of `folder`'s files, with "+dirty" where they differ from it; None where there is none."""
    # A package installed into another project's checkout is not part of that project: ask whether git tracks it.
    if _git(folder, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    head = _git(folder, "rev-parse", "HEAD")
    if not head:
        return None
    return head + ("+dirty" if _git(folder, "status", "--porcelain", "--", ".") else "")


def require(caller: str, extra: str, *modules: str) -> None:
    """Raise `MissingExtraError` unless all `modules`, installed by the extra `extra`, can be imported. Imports none."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            remedy = f"run pip install 'torch_ssao[{extra}]'"
            raise checks.MissingExtraError(f"{caller} needs {module}, which is not installed: {remedy}")


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()
