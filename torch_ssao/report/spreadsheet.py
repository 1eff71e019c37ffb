"""The table of errors and fitted values as CSV: one line for each row of the report."""

from __future__ import annotations

import csv
import io
import math
from typing import TYPE_CHECKING, Any

from torch_ssao.report.pareto import Entry, entries, is_on, pareto_front
from torch_ssao.report.peers import Peer
from torch_ssao.report.rows import Score, Timing

if TYPE_CHECKING:
    from torch_ssao.report.measurement import Measurement

_METRICS = ("rmse", "psnr", "ssim")
_TIMES = ("ms", "ms_low", "ms_high")


def csv_text(measurement: Measurement) -> str:
    """The report's rows as CSV with a head.

    Columns: kind (untuned, fitted, peer, constant or ceiling), name, label, technique; errors on the judged views, then on the
    fitted ones; median and quartiles of the time; whether on the Pareto front; `choice_*` of the module; `value_*` and `error_*`,
    each parameter's value and standard error. Empty is unknown, not fitted or not determined.
    """
    lines = [_line(measurement, entry) for entry in entries(measurement)]
    constant, ceiling = measurement.constant, measurement.ceiling
    lines.append(_facts("constant", "constant", constant.validation, constant.training, None))
    lines.append(_facts("ceiling", "noise ceiling", Score(ceiling.rmse, ceiling.psnr, ceiling.ssim), None, None))
    head = list(dict.fromkeys(key for line in lines for key in line))
    last = ("choice_", "value_", "error_")  # after the columns that every row has
    head.sort(key=lambda key: next((i for i, start in enumerate(last, 1) if key.startswith(start)), 0))
    text = io.StringIO()
    writer = csv.DictWriter(text, head, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _line(measurement: Measurement, entry: Entry) -> dict[str, Any]:
    if isinstance(entry, Peer):
        line = _facts("peer", entry.name, entry.validation, entry.training, entry.timing)
    else:
        kind = "fitted" if entry.is_fitted else "untuned"
        line = _facts(kind, entry.name, entry.validation, entry.training, entry.timing)
        line |= {"label": entry.label, "technique": entry.technique}
        line |= {f"choice_{name}": value for name, value in entry.module.config().items()}
        values, fit = entry.module.values(), entry.fit
        used = entry.module.used_parameters()
        line |= {f"value_{name}": values[name] for name in used}
        if fit is not None:
            known = [name for name in used if name in fit.standard_errors and name not in fit.undetermined]
            line |= {f"error_{name}": _cell(fit.standard_errors[name]) for name in known}
    line["pareto"] = int(is_on(pareto_front(measurement), entry))
    return line


def _facts(kind: str, name: str, validation: Score, training: Score | None, timing: Timing | None) -> dict[str, Any]:
    line: dict[str, Any] = {"kind": kind, "name": name, "label": name, "technique": ""}
    for title, score in (("validation", validation), ("training", training)):
        line |= {f"{title}_{metric}": "" if score is None else _cell(getattr(score, metric)) for metric in _METRICS}
    times = ("", "", "") if timing is None else (timing.median_ms, timing.low_ms, timing.high_ms)
    return line | dict(zip(_TIMES, times, strict=True)) | {"pareto": ""}


def _cell(value: float) -> float | str:
    return value if math.isfinite(value) else ""
