"""Figures: error against milliseconds, fitted values against layers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from torch_ssao.report.candidates import TITLES
from torch_ssao.report.images import figure_png
from torch_ssao.report.pareto import entries, pareto_front
from torch_ssao.report.rows import Row

if TYPE_CHECKING:
    from torch_ssao.report.measurement import Measurement

UNTUNED, FITTED = "#b4552d", "#1f6f8b"
CROWDED = 14
"""Rows beyond which only those on the front, and the one chosen, are named in the plot; the table names all."""
PEER, FRONT = "0.25", "#e0a83c"
COLOURS, MARKERS = ("#1f6f8b", "#b4552d", "#6b7f1f", "#7b4b94"), ("o", "s", "^", "D")
"""Of techniques in the order of the report."""


def speed_error_png(measurement: Measurement) -> bytes:
    """PNG of RMSE on the judged views against milliseconds a view.

    Untuned hollow, fitted filled, quartiles as bars; every technique has its own marker and, beside others, its own colour.
    """
    from matplotlib.figure import Figure

    several = len(measurement.techniques) > 1
    figure = Figure(figsize=(8.4, 5.6) if several else (7.0, 4.6), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    named = _named(measurement)
    for index, technique in enumerate(measurement.techniques):
        marker, own = MARKERS[index % len(MARKERS)], COLOURS[index % len(COLOURS)]
        for fitted in (False, True):
            rows = [row for row in measurement.rows if row.is_fitted == fitted and row.technique == technique]
            if not rows:
                continue
            state = "fitted" if fitted else "untuned"
            colour = own if several else (FITTED if fitted else UNTUNED)
            style = {"color": colour, "marker": marker, "markerfacecolor": colour if fitted else "white"}
            style |= {"linestyle": "-" if fitted or not several else "--"}
            style |= {"label": f"{TITLES.get(technique, technique)}, {state}" if several else state}
            _draw_rows(axes, rows, style)
            for row in rows:
                if row in named:
                    _annotate(axes, row, measurement, colour)
    _draw_peers(axes, measurement)
    _draw_front(axes, measurement)
    constant, ceiling = measurement.constant.validation.rmse, measurement.ceiling.rmse
    axes.axhline(constant, color="0.35", linestyle="--", linewidth=1.1, label=f"constant image, {constant:.3f}")
    axes.axhline(ceiling, color="0.35", linestyle=":", linewidth=1.3, label=f"noise of the reference, {ceiling:.4f}")
    _finish(axes, measurement)
    return figure_png(figure)


def _draw_rows(axes: Any, rows: list[Row], style: dict[str, Any]) -> None:
    times = [row.timing for row in rows]
    axes.errorbar(
        [time.median_ms for time in times],
        [row.validation.rmse for row in rows],
        xerr=[[time.median_ms - time.low_ms for time in times], [time.high_ms - time.median_ms for time in times]],
        markersize=9,
        markeredgewidth=1.6,
        linewidth=1.0,
        elinewidth=1.0,
        capsize=2,
        zorder=3,
        **style,
    )


def _draw_peers(axes: Any, measurement: Measurement) -> None:
    """Crosses with names; those without a time are in the table only."""
    shown = [(peer.name, peer.timing, peer.validation.rmse) for peer in measurement.peers if peer.timing is not None]
    for index, (name, timing, error) in enumerate(shown):
        bars = [[timing.median_ms - timing.low_ms], [timing.high_ms - timing.median_ms]]
        style: dict[str, Any] = {"linestyle": "none", "marker": "X", "markersize": 8, "capsize": 2, "elinewidth": 1.0}
        style |= {"color": PEER, "label": "peer" if index == 0 else None, "zorder": 3}
        axes.errorbar(timing.median_ms, error, xerr=bars, **style)
        label: dict[str, Any] = {
            "ha": "left",
            "va": "center",
            "fontsize": 8,
            "color": PEER,
            "textcoords": "offset points",
            "zorder": 4,
        }
        axes.annotate(name, (timing.median_ms, error), xytext=(8, 0), **label)


def _draw_front(axes: Any, measurement: Measurement) -> None:
    """A staircase: what is above and right of it is beaten in both error and time."""
    front = [(entry.timing.median_ms, entry.validation.rmse) for entry in pareto_front(measurement) if entry.timing]
    times, errors = zip(*front, strict=True)
    style: dict[str, Any] = {"color": FRONT, "linewidth": 5.0, "alpha": 0.35, "zorder": 2, "label": "Pareto front"}
    axes.step(times, errors, where="post", marker="o", markersize=15, markeredgewidth=0, **style)


def _named(measurement: Measurement) -> list[Any]:
    """The rows that are named in the plot."""
    if len(measurement.rows) <= CROWDED:
        return list(measurement.rows)
    chosen = measurement.chosen
    picked = [row for row in measurement.rows if chosen is not None and row.is_fitted and row.name == chosen.name]
    return [*pareto_front(measurement), *picked]


def _annotate(axes: Any, row: Row, measurement: Measurement, colour: str) -> None:
    """The model's label; of an untuned and fitted pair the worse is labelled above and the better below."""
    error = row.validation.rmse
    others = [o.validation.rmse for o in measurement.rows if o.name == row.name and o is not row]
    above = error > max(others) if others and error != others[0] else not row.is_fitted
    style: dict[str, Any] = {"ha": "center", "fontsize": 8, "color": colour, "textcoords": "offset points", "zorder": 4}
    style["bbox"] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.5}
    axes.annotate(row.label, (row.timing.median_ms, error), xytext=(0, 9) if above else (0, -16), **style)


def _finish(axes: Any, measurement: Measurement) -> None:
    settings, threads = measurement.settings, measurement.environment["threads"]
    axes.set_xscale("log")
    _readable_ticks(axes.xaxis)
    axes.margins(x=0.12)
    worst = max(entry.validation.rmse for entry in entries(measurement))
    axes.set_ylim(0, 1.15 * max(worst, measurement.constant.validation.rmse))  # room for the label of the worst
    threads_text = f"{threads} thread{'s' if threads != 1 else ''}"
    axes.set_xlabel(f"milliseconds a view, forward, {settings.width}x{settings.height}, {threads_text}")
    axes.set_ylabel(f"RMSE of visibility, {measurement.judged_label}")
    axes.set_title(f"{measurement.scene.name}, radius {settings.radius:.4g}", fontsize=11)
    axes.grid(True, which="both", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, framealpha=0.9)


def fitted_values_png(measurement: Measurement) -> bytes | None:
    """PNG of each used parameter's value and standard error by fitted model, with its start; None without any fit."""
    from matplotlib.figure import Figure

    fitted = [row for row in measurement.rows if row.fit is not None]
    if not fitted:
        return None
    start = {row.name: row.module.values() for row in measurement.rows if row.fit is None}
    names = list(dict.fromkeys(name for row in fitted for name in row.module.used_parameters()))
    several = len(measurement.techniques) > 1  # then labels are long, hence slanted
    labels: dict[str, Any] = {"rotation": 20, "ha": "right", "rotation_mode": "anchor"} if several else {}
    rows = math.ceil(len(names) / 2)
    figure = Figure(figsize=(7.0, (2.7 if several else 2.3) * rows), dpi=120, layout="constrained")
    for index, name in enumerate(names):
        axes = figure.add_subplot(rows, 2, index + 1)
        shown = [row for row in fitted if name in row.module.used_parameters()]
        _draw_parameter(axes, name, shown, start)
        axes.set_xticks(range(len(shown)), [row.label for row in shown], fontsize=8, **labels)
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
