"""Modules as human-readable JSON, never pickle."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import torch

from torch_ssao import checks
from torch_ssao.modules import TECHNIQUES, AmbientVisibility

FORMAT = "torch_ssao.module"
VERSION = 1


class ModuleFileError(ValueError):
    """A file does not hold a saved module."""


def save(module: AmbientVisibility, path: str | Path) -> None:
    """Write a module as JSON: technique, discrete choices, readable values and the raw values that are loaded back.

    Args:
        module: any technique of this package.
        path: file to write; replaced in one step, so that a crash never leaves half a file.
    Raises:
        ModuleFileError: not a module of this package. OutputError: the folder cannot be written.
    """
    names = {kind: name for name, kind in TECHNIQUES.items()}
    if type(module) not in names:
        raise ModuleFileError(
            f"module must be one of {', '.join(TECHNIQUES)}, got {type(module).__name__}: save its state_dict instead"
        )
    values = module.values()
    raw = {name: float(getattr(module, f"raw_{name}").detach()) for name in values}
    record = {
        "format": FORMAT,
        "version": VERSION,
        "technique": names[type(module)],
        "choices": module.config(),
        "learnable": list(module.learnable),
        "values": {name: values.get(name) for name in module.PARAMETERS},  # None is off
        "raw": {name: number for name, number in raw.items() if math.isfinite(number)},  # 0 is exact without
        "dtype": str(module.radius.dtype).removeprefix("torch."),
    }
    path = Path(path)
    checks.check_output_folder("path", path.parent)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        reason = error.strerror or error
        raise checks.OutputError(
            f"path {str(path)!r} cannot be written ({reason}): make room or pass another path"
        ) from error


def load(path: str | Path) -> AmbientVisibility:
    """Read a module that `save` wrote; its images come back bit for bit.

    Args:
        path: the JSON file.
    Returns: the module, on the CPU, with the dtype it was saved in.
    Raises:
        ModuleFileError: no such file, not JSON, or not a module of this package.
    """
    record = _read(Path(path))
    try:
        kind = TECHNIQUES[record["technique"]]
        module = kind(**record["values"], **record["choices"], learnable=tuple(record["learnable"]))
        module = module.to(getattr(torch, record["dtype"]))
        with torch.no_grad():
            for name, number in record["raw"].items():
                getattr(module, f"raw_{name}").fill_(number)
    except (KeyError, TypeError, AttributeError) as error:
        raise ModuleFileError(f"path {str(path)!r} lacks or has a wrong {error}: save the module again") from error
    return module


def _read(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ModuleFileError(f"path {str(path)!r} does not exist: pass a file that torch_ssao.save wrote") from error
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ModuleFileError(f"path {str(path)!r} is not readable JSON ({error}): save the module again") from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise ModuleFileError(f"path {str(path)!r} is no torch_ssao module: pass a file that torch_ssao.save wrote")
    if record.get("version") != VERSION:
        raise ModuleFileError(
            f"path {str(path)!r} has version {record.get('version')}, this package reads {VERSION}: save it again"
        )
    return record
