"""Results of other implementations, read from a JSON file, to stand beside ours in table and plot."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

from torch_ssao import checks
from torch_ssao.report.rows import Score, Timing

_FACTS = ("scene", "width", "height", "note", "rows")
_KEYS = ("name", "ms", "ms_low", "ms_high", "validation", "training", "note")
_EXAMPLE = '{"name": "mine", "ms": 3.2, "validation": {"rmse": 0.05}}'


@final
@dataclass(frozen=True)
class Peer:
    """What another implementation scored on the same reference.

    Args:
        name: for people.
        validation: error on the judged views; NaN where it is not known. training: on the fitted views; None if unknown.
        timing: of one view, with 0 repeats where the file does not say quartiles; None if unknown: listed, not plotted.
        note: where it ran, or anything else; shown below the table.
    """

    name: str
    validation: Score
    training: Score | None = None
    timing: Timing | None = None
    note: str = ""

    @property
    def label(self) -> str:
        """The name."""
        return self.name

    def as_dict(self) -> dict[str, Any]:
        """The peer as plain values for report.json."""
        return asdict(self)


def load_peers(path: str | Path, *, scene: str, height: int, width: int) -> tuple[Peer, ...]:
    """Rows of a peers file.

    Args:
        path: JSON, a list of rows or an object with `rows` and, optionally, `scene` (name), `width`, `height` and `note`. A row
            has `name` and `validation` ({"rmse": .., "psnr": .., "ssim": ..}, of which rmse is needed), and may have `training`
            (likewise), `ms`, `ms_low` and `ms_high` (median and quartiles of a view) and `note`.
        scene, height, width: what this report is about: a file that states something else is refused.
    Returns: the rows, each with the note of the file where it has none of its own.
    Raises: SceneError for a file that is missing or is no such JSON, and one made for another scene or size.
    """
    record = _read(Path(path))
    facts, rows = ({}, record) if isinstance(record, list) else (record, record.get("rows"))
    _check_keys(path, "the file", facts, _FACTS)
    for name, wanted in (("scene", scene), ("width", width), ("height", height)):
        if name in facts and facts[name] != wanted:
            raise checks.SceneError(
                f"peers file {str(path)!r} must be about {name} {wanted!r}, got {facts[name]!r}: measure the "
                f"peers on this report's scene and size"
            )
    if not isinstance(rows, list):
        raise checks.SceneError(
            f"peers file {str(path)!r} must hold a list of rows, got none: write rows such as {_EXAMPLE}"
        )
    peers = tuple(_peer(path, row, str(facts.get("note", ""))) for row in rows)
    names = [peer.name for peer in peers]
    for name in names:
        if names.count(name) > 1:
            raise checks.SceneError(f"peers file {str(path)!r} must name each row once, got {name!r} twice: rename one")
    return peers


def _read(path: Path) -> Any:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise checks.SceneError(f"peers file {str(path)!r} {reason}: check the path") from error
    except ValueError as error:  # not UTF-8, or not JSON
        raise checks.SceneError(f"peers file {str(path)!r} must be JSON, got: {error}: repair the file") from error
    if not isinstance(record, (list, dict)):
        raise checks.SceneError(
            f"peers file {str(path)!r} must hold a list of rows, got {type(record).__name__}: write rows such as {_EXAMPLE}"
        )
    return record


def _peer(path: str | Path, row: Any, note: str) -> Peer:
    if not isinstance(row, dict) or not isinstance(row.get("name"), str) or not row["name"].strip():
        raise checks.SceneError(
            f"peers file {str(path)!r} must name each row, got {row!r:.60}: write rows such as {_EXAMPLE}"
        )
    where = f"row {row['name']!r}"
    _check_keys(path, where, row, _KEYS)
    validation = _score(path, f"{where} validation", row.get("validation"))
    training = None if row.get("training") is None else _score(path, f"{where} training", row["training"])
    return Peer(row["name"].strip(), validation, training, _timing(path, where, row), str(row.get("note", note)))


def _score(path: str | Path, where: str, values: Any) -> Score:
    known = ("rmse", "psnr", "ssim")
    if not isinstance(values, dict) or values.get("rmse") is None:
        raise checks.SceneError(
            f"peers file {str(path)!r} must give {where} an rmse, got {values!r:.60}: write rows such as {_EXAMPLE}"
        )
    _check_keys(path, where, values, known)
    rmse = _number(path, f"{where} rmse", values["rmse"], 0.0)
    psnr, ssim = (
        math.nan if values.get(name) is None else _number(path, f"{where} {name}", values[name], -math.inf)
        for name in known[1:]
    )
    return Score(rmse, psnr, ssim)


def _timing(path: str | Path, where: str, row: Mapping[str, Any]) -> Timing | None:
    if row.get("ms") is None:
        return None
    median = _number(path, f"{where} ms", row["ms"], 0.0)
    low, high = (
        median if row.get(name) is None else _number(path, f"{where} {name}", row[name], 0.0)
        for name in ("ms_low", "ms_high")
    )
    if not 0 < low <= median <= high:
        raise checks.SceneError(
            f"peers file {str(path)!r} must give {where} 0 < ms_low <= ms <= ms_high, got {low:g}, {median:g}, {high:g}: repair it"
        )
    return Timing(median, low, high, 0)


def _number(path: str | Path, where: str, value: Any, low: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value < low:
        limit = f" of at least {low:g}" if math.isfinite(low) else ""
        raise checks.SceneError(
            f"peers file {str(path)!r} must give {where} as a finite number{limit}, got {value!r:.60}: repair it"
        )
    return float(value)


def _check_keys(path: str | Path, where: str, record: Mapping[str, Any], known: Sequence[str]) -> None:
    """A key that is misspelt would be left out in silence."""
    for key in record:
        if key not in known:
            raise checks.SceneError(
                f"peers file {str(path)!r} must give {where} only {', '.join(known)}, got {key!r}: rename it or leave it out"
            )
