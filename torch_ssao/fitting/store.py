"""Fitted candidates on disk, one file each, so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import copy
import errno
import hashlib
import json
import math
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.fitting.problem import ViewError, tensor_bytes
from torch_ssao.fitting.table import Row
from torch_ssao.modules import AmbientVisibility

FORMAT = "torch_ssao.fitted_candidate"
VERSION = 1
_PLAIN = ("validation_rmse", "training_rmse", "values", "evaluations", "seconds", "message", "warm_start")


@final
class Store:
    """Rows by key in a folder, or nowhere.

    A file is written in one step and holds its key and a checksum: one that is truncated, foreign or made for something else is
    never read, but made anew. When a file cannot be written (the disk is full), one line on stderr says so, once, and rows
    are kept in memory only.

    Args:
        folder: made where it is missing; None keeps nothing.
    Raises: OutputError when nothing can be written there.
    """

    def __init__(self, folder: str | Path | None) -> None:
        self.folder = None if folder is None else checks.check_output_folder("folder", folder)
        self.notes: list[str] = []

    def get(self, key: str, name: str, module: AmbientVisibility) -> Row | None:
        """The row stored under `key` with `module`'s values replaced by the fitted ones, or None."""
        if self.folder is None:
            return None
        try:
            record = json.loads(self._path(key, name).read_text(encoding="utf-8"))
            content = record["content"]
            facts = (record["format"], record["version"], record["key"], record["sha256"])
            if facts != (FORMAT, VERSION, key, _checksum(content)):
                return None
            return _row(name, module, content)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):  # missing, truncated or something else
            return None

    def put(self, key: str, row: Row) -> None:
        """Keep a row at once."""
        if self.folder is None or self.notes:
            return
        content = _content(row)
        record = {"format": FORMAT, "version": VERSION, "key": key, "sha256": _checksum(content), "content": content}
        path = self._path(key, row.name)
        partial = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            partial.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
            os.replace(partial, path)
        except OSError as error:
            self._give_up(error)
        finally:
            _remove(partial)

    def _path(self, key: str, name: str) -> Path:
        folder = Path() if self.folder is None else self.folder
        return folder / f"{re.sub(r'[^A-Za-z0-9_.+-]', '-', name)[:80]}_{key[:16]}.json"

    def _give_up(self, error: OSError) -> None:
        reason = "the disk is full" if error.errno == errno.ENOSPC else error.strerror or str(error)
        note = f"Results cannot be written to {self.folder} ({reason}): the run goes on, and keeps them in memory only."
        self.notes.append(note)
        sys.stderr.write(note + "\n")


def key_of(start: AmbientVisibility, data: str, options: Mapping[str, Any]) -> str:
    """SHA-256 of all that a fitted candidate depends on.

    Args:
        start: the module with the values that the fit starts from.
        data: hash of views and targets.
        options: everything else; plain values, tensors, records of these.
    Raises: ChoiceError for an option that has no content to compare, such as a function.
    """
    from torch_ssao import __version__

    facts = {
        "class": f"{type(start).__module__}.{type(start).__qualname__}",
        "choices": start.config(),
        "learnable": start.learnable,
        "raw": {name: getattr(start, f"raw_{name}") for name in start.PARAMETERS},
        "data": data,
        "options": options,
        "device": start.radius.device.type,  # kernels round differently
        "versions": (__version__, torch.__version__, VERSION),
    }
    return hashlib.sha256(json.dumps(_canonical(facts), sort_keys=True).encode()).hexdigest()


def _canonical(value: Any) -> Any:
    """`value` as JSON with equal text for equal content only."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return f"float {value!r}"
    if isinstance(value, Tensor):
        return f"tensor {hashlib.sha256(tensor_bytes(value)).hexdigest()}"
    if isinstance(value, Mapping):
        return {"mapping": [[_canonical(key), _canonical(item)] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {type(value).__qualname__: [_canonical(getattr(value, field.name)) for field in fields(value)]}
    raise checks.ChoiceError(
        f"fit_options must be plain values where results are stored, got {type(value).__name__}: leave folder out"
    )


def _content(row: Row) -> dict[str, Any]:
    raw = {name: getattr(row.module, f"raw_{name}") for name in row.module.PARAMETERS}
    numbers = {name: float(value.detach()) for name, value in raw.items() if value is not None}
    return {
        "name": row.name,
        "technique": row.technique,
        "choices": {name: str(value) for name, value in row.module.config().items()},
        **{name: getattr(row, name) for name in _PLAIN},
        # Infinite has no JSON: None.
        "standard_errors": {name: _finite(value) for name, value in row.standard_errors.items()},
        "undetermined": list(row.undetermined),
        "views": [asdict(view) for view in row.views],
        "raw": {name: _finite(value) for name, value in numbers.items()},
    }


def _row(name: str, module: AmbientVisibility, content: Mapping[str, Any]) -> Row:
    fitted = copy.deepcopy(module)
    with torch.no_grad():
        for parameter, number in content["raw"].items():
            if number is not None:  # else 0, which is off and stays off
                getattr(fitted, f"raw_{parameter}").fill_(number)
    return Row(
        name=name,
        module=fitted,
        views=tuple(ViewError(**view) for view in content["views"]),
        standard_errors={
            key: math.inf if value is None else float(value) for key, value in content["standard_errors"].items()
        },
        undetermined=tuple(content["undetermined"]),
        is_stored=True,
        **{field: content[field] for field in _PLAIN},
    )


def _checksum(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _remove(partial: Path) -> None:
    try:
        partial.unlink(missing_ok=True)
    except OSError:
        return
