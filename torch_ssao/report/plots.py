"""Figures: error against milliseconds, fitted values against layers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from torch_ssao.report.images import figure_png
from torch_ssao.report.rows import Row

if TYPE_CHECKING:
    from torch_ssao.report.measure import Measurement

UNTUNED, FITTED = "#b4552d", "#1f6f8b"


def speed_error_png(measurement: Measurement) -> bytes:
    """PNG of RMSE on the judged views against milliseconds a view: untuned hollow, fitted filled, quartiles as bars."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.6), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    for fitted, colour in ((False, UNTUNED), (True, FITTED)):
        rows = [row for row in measurement.rows if row.is_fitted == fitted]
        face = colour if fitted else "white"
        times = [row.timing for row in rows]
        middle = [time.median_ms for time in times]
        spread = [[time.median_ms - time.low_ms for time in times], [time.high_ms - time.median_ms for time in times]]
        error = [row.validation.rmse for row in rows]
        axes.errorbar(
            middle,
            error,
            xerr=spread,
            color=colour,
            marker="o",
            markersize=9,
            markerfacecolor=face,
            markeredgewidth=1.6,
            linewidth=1.0,
            elinewidth=1.0,
            capsize=2,
            label="fitted" if fitted else "untuned",
            zorder=3,
        )
        for row, x, y in zip(rows, middle, error, strict=True):
            # The worse of a pair is labelled above and the better below, clear of each other.
            others = [o.validation.rmse for o in measurement.rows if o.name == row.name and o is not row]
            above = y > max(others) if others and y != others[0] else not fitted
            shift = (0, 9) if above else (0, -16)
            style: dict[str, Any] = {"ha": "center", "fontsize": 8, "color": colour}
            axes.annotate(row.label, (x, y), xytext=shift, textcoords="offset points", **style)
    constant, ceiling = measurement.constant.validation.rmse, measurement.ceiling.rmse
    axes.axhline(constant, color="0.35", linestyle="--", linewidth=1.1, label=f"constant image, {constant:.3f}")
    axes.axhline(ceiling, color="0.35", linestyle=":", linewidth=1.3, label=f"noise of the reference, {ceiling:.4f}")
    _finish(axes, measurement)
    return figure_png(figure)


def _finish(axes: Any, measurement: Measurement) -> None:
    settings, threads = measurement.settings, measurement.environment["threads"]
    axes.set_xscale("log")
    _readable_ticks(axes.xaxis)
    axes.margins(x=0.12)
    worst = max(row.validation.rmse for row in measurement.rows)
    axes.set_ylim(0, 1.15 * max(worst, measurement.constant.validation.rmse))  # room for the label of the worst
    threads_text = f"{threads} thread{'s' if threads != 1 else ''}"
    axes.set_xlabel(f"milliseconds a view, forward, {settings.width}x{settings.height}, {threads_text}")
    axes.set_ylabel(f"RMSE of visibility, {measurement.judged_label}")
    axes.set_title(f"{measurement.scene.name}, radius {settings.radius:.4g}", fontsize=11)
    axes.grid(True, which="both", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, framealpha=0.9)


def fitted_values_png(measurement: Measurement) -> bytes | None:
    """PNG of each parameter's fitted value and standard error by model, with its start; None without any fit."""
    from matplotlib.figure import Figure

    fitted = [row for row in measurement.rows if row.fit is not None]
    if not fitted:
        return None
    start = {row.name: row.module.values() for row in measurement.rows if row.fit is None}
    names = list(fitted[0].module.PARAMETERS)
    figure = Figure(figsize=(7.0, 2.3 * math.ceil(len(names) / 2)), dpi=120, layout="constrained")
    for index, name in enumerate(names):
        axes = figure.add_subplot(math.ceil(len(names) / 2), 2, index + 1)
        _draw_parameter(axes, name, fitted, start)
    return figure_png(figure)


def _draw_parameter(axes: Any, name: str, fitted: list[Row], start: dict[str, dict[str, float]]) -> None:
    drawn = []
    for x, row in enumerate(fitted):
        value, error = row.module.values()[name], _error(row, name)
        face = "white" if error is None else FITTED  # hollow: the views do not determine it, or it was not fitted
        axes.errorbar(x, value, yerr=error, marker="o", markersize=6, capsize=3, color=FITTED, markerfacecolor=face)
        drawn += [value - (error or 0.0), value + (error or 0.0)]
        if row.name in start:
            drawn.append(start[row.name][name])
            axes.plot(x, drawn[-1], marker="_", markersize=12, color=UNTUNED)
    spec = fitted[0].module.PARAMETERS[name]
    axes.set_title(name if spec.unit == "1" else f"{name} ({spec.unit})", fontsize=9)
    axes.set_yscale("log")
    axes.set_ylim(min(drawn) / 2.2, max(drawn) * 2.2)  # wide enough for two ticks however little the values differ
    _readable_ticks(axes.yaxis)
    axes.margins(x=0.15)
    axes.set_xticks(range(len(fitted)), [row.label for row in fitted], fontsize=8)
    axes.grid(True, axis="y", which="both", color="0.9", linewidth=0.6)


def _error(row: Row, name: str) -> float | None:
    if row.fit is None or name in row.fit.undetermined:
        return None
    error = row.fit.standard_errors.get(name, math.nan)
    if not math.isfinite(error):
        return None
    # The axis is logarithmic: a bar that reached zero would have no end.
    return min(error, 0.9 * row.module.values()[name])


def _readable_ticks(axis: Any) -> None:
    """Plain numbers at 1, 2 and 5 times powers of ten: the decades alone are too few for one technique's range."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
    axis.set_tick_params(which="both", labelsize=8)
