"""Tables for terminals and pages, from one list of cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch_ssao.report.pareto import Entry, entries, is_on, pareto_front
from torch_ssao.report.peers import Peer
from torch_ssao.report.rows import Row, Score, Timing
from torch_ssao.report.truth import Ceiling

if TYPE_CHECKING:
    from torch_ssao.report.measurement import Measurement

ON_FRONT = "*"
VALUE_COLUMNS = ("model", "parameter", "value", "standard error", "meaning")

UNDETERMINED = "not determined by these views"


def columns(measurement: Measurement) -> tuple[str, ...]:
    """The head of the table of errors: those on the judged views first, those on the fitted views second."""
    judged = "training-view RMSE" if measurement.judged_on_training_views else "validation RMSE"
    return ("model", judged, "PSNR", "SSIM", "training RMSE", "PSNR", "SSIM", "ms a view (quartiles)", "front")


def score_cells(measurement: Measurement) -> list[list[str]]:
    """Rows of the table of errors under `columns`: untuned, then fitted modules, peers, constant image, noise ceiling."""
    front = pareto_front(measurement)
    cells = []
    for entry in entries(measurement):
        mark = ON_FRONT if is_on(front, entry) else ""
        cells.append([_title(entry), *_score(entry.validation), *_score(entry.training), _timing(entry.timing), mark])
    constant = f"constant {measurement.constant.value:.3f}"
    cells.append([constant, *_score(measurement.constant.validation), *_score(measurement.constant.training), "", ""])
    return [*cells, ["noise ceiling", *_ceiling(measurement.ceiling), "", "", "", "", ""]]


def value_cells(measurement: Measurement) -> list[list[str]]:
    """Rows (model, parameter, value, standard error, unit and meaning) of every parameter in use."""
    cells = []
    for row in measurement.rows:
        if row.fit is None:
            continue
        values = row.module.values()
        for name in row.module.used_parameters():
            value = values[name]
            spec = row.module.PARAMETERS[name]
            cells.append([row.label, name, f"{value:.4g}", _uncertainty(row, name), f"{spec.meaning} ({spec.unit})"])
    return cells


def value_matrix(measurement: Measurement) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the fitted values, a model a row with one cell "value ± standard error" per parameter.

    Parameters that no model uses are left out; "-" where a model has no such parameter or does not use it.
    """
    fitted = [row for row in measurement.rows if row.fit is not None]
    names = list(dict.fromkeys(name for row in fitted for name in row.module.used_parameters()))
    cells = []
    for row in fitted:
        values, used = row.module.values(), row.module.used_parameters()
        texts = [f"{values[name]:.4g} {_uncertainty(row, name)}" if name in used else "-" for name in names]
        cells.append([row.label, *(text.replace(UNDETERMINED, "(undetermined)") for text in texts)])
    return ["fitted values", *names], cells


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns padded to equal width; the first is flush left, the others flush right."""
    widths = [max(len(line[i]) for line in (head, *rows)) for i in range(len(head))]
    lines = []
    for line in (head, ["-" * width for width in widths], *rows):
        padded = [cell.rjust(width) for cell, width in zip(line, widths, strict=True)]
        padded[0] = line[0].ljust(widths[0])
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)


def number(value: float, digits: int) -> str:
    """`value` with `digits` decimals, "inf" or "-" where it is infinite or unknown."""
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f}"


def _title(entry: Entry) -> str:
    if isinstance(entry, Peer):
        return f"{entry.name}, peer"
    return f"{entry.label}, {'fitted' if entry.is_fitted else 'untuned'}"


def _score(score: Score | None) -> list[str]:
    if score is None:
        return ["-", "-", "-"]
    return [number(score.rmse, 4), number(score.psnr, 2), number(score.ssim, 4)]


def _ceiling(ceiling: Ceiling) -> list[str]:
    return [number(ceiling.rmse, 4), number(ceiling.psnr, 2), number(ceiling.ssim, 4)]


def _timing(timing: Timing | None) -> str:
    if timing is None:
        return "-"
    low, median, high = map(milliseconds, (timing.low_ms, timing.median_ms, timing.high_ms))
    return (
        median if timing.low_ms == timing.high_ms else f"{median} ({low}-{high})"
    )  # a peer may come without quartiles


def milliseconds(value: float) -> str:
    """Three digits where there are that many before the point or after it: 0.0213, 8.92, 72.5, 1234.5."""
    return f"{value:.1f}" if value >= 10 else f"{value:.3g}"


def _uncertainty(row: Row, name: str) -> str:
    if row.fit is None or (name not in row.fit.standard_errors and name not in row.fit.undetermined):
        return "not fitted"
    error = row.fit.standard_errors.get(name, math.nan)
    if name in row.fit.undetermined or not math.isfinite(error):
        return UNDETERMINED
    return f"± {error:.2g}"
