"""The page's pictures: a slider over untuned, fitted and reference, and the list of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

from torch_ssao.report import markup, tables
from torch_ssao.report.rows import Row

if TYPE_CHECKING:
    from torch_ssao.report.measurement import Measurement

HELP = (
    "Drag the dividers, or reach them with the Tab key and move them with the arrow keys, Page Up, Page Down, Home and End. "
    "Left: untuned; middle: fitted; right: the ray-traced reference."
)


def compare(measurement: Measurement, pictures: Mapping[str, bytes], shown: str) -> str:
    """One picture with two dividers, a list to choose the model from, and its error maps; hidden until the script runs.

    Args:
        measurement: what was measured.
        pictures: PNG files by name. The page holds each once, in `everything`; the script shows them here too.
        shown: name of the model that is chosen at first.
    Returns: nothing where no model is there both untuned and fitted.
    """
    pairs = [pair for pair in _pairs(measurement) if all(name in pictures for name in _files(pair[0].name))]
    if not pairs or "reference.png" not in pictures:
        return ""
    options = "".join(_option(untuned, fitted, selected=fitted.name == shown) for untuned, fitted in pairs)
    view = measurement.judged_views[0]
    layers = "".join(
        f'<div class="layer {kind}" data-alt="{text}"><span>{kind}</span></div>'
        for kind, text in (
            ("reference", "ray-traced reference"),
            ("fitted", "the fitted model's visibility"),
            ("untuned", "the untuned model's visibility"),
        )
    )
    handles = "".join(_handle(side, now, text) for side, now, text in _DIVIDERS)
    errors = "".join(
        f'<figure class="error {state}" data-alt="error of the {state} model"><figcaption>{state}, error</figcaption></figure>'
        for state in ("untuned", "fitted")
    )
    return (
        f'<section id="compare" hidden><h2>Compare, view {view}</h2>\n'
        f'<p><label>model <select name="model">{options}</select></label></p>\n'
        f'<div class="stage">{layers}{handles}</div>\n<p class="note" aria-live="polite"></p>\n<p class="soft">{HELP}</p>\n'
        f'<div class="grid">{errors}</div></section>'
    )


def everything(measurement: Measurement, pictures: Mapping[str, bytes]) -> str:
    """Every picture of the first judged view, folded away."""
    parts = [f'<div class="grid">{markup.picture(pictures, "reference.png", "Ray-traced reference")}</div>']
    for name in dict.fromkeys(row.name for row in measurement.rows):
        figures = []
        for row in (row for row in measurement.rows if row.name == name):
            state = "fitted" if row.is_fitted else "untuned"
            figures.append(markup.picture(pictures, f"{name}_{state}.png", state))
            figures.append(markup.picture(pictures, f"{name}_{state}_error.png", f"{state}, error"))
        label = next(row.label for row in measurement.rows if row.name == name)
        parts.append(f'<h3>{escape(label)}</h3><div class="grid">{"".join(figures)}</div>')
    parts.append(
        '<p class="soft">Grey pictures are visibility in linear 8-bit grey without gamma, 255 = open. Error maps: red '
        "is too open, blue too dark, grey sees nothing.</p>"
    )
    title = f"<summary>All pictures of view {measurement.judged_views[0]}</summary>"
    return "\n".join(("<details>" + title, *parts, "</details>"))


_DIVIDERS = (
    ("left", 33, "divider between untuned and fitted"),
    ("right", 67, "divider between fitted and reference"),
)


def _pairs(measurement: Measurement) -> list[tuple[Row, Row]]:
    """Untuned and fitted rows of one name."""
    untuned = {row.name: row for row in measurement.rows if not row.is_fitted}
    return [(untuned[row.name], row) for row in measurement.rows if row.is_fitted and row.name in untuned]


def _files(name: str) -> list[str]:
    return [f"{name}_{state}{kind}.png" for state in ("untuned", "fitted") for kind in ("", "_error")]


def _option(untuned: Row, fitted: Row, *, selected: bool) -> str:
    before, after = untuned.validation, fitted.validation
    note = (
        f"{fitted.label}: RMSE {tables.number(before.rmse, 4)} untuned, {tables.number(after.rmse, 4)} fitted; SSIM "
        f"{tables.number(before.ssim, 4)} and {tables.number(after.ssim, 4)}; on the fitted views RMSE "
        f"{tables.number(untuned.training.rmse, 4)} and {tables.number(fitted.training.rmse, 4)}; "
        f"{fitted.timing.median_ms:.3g} ms."
    )
    chosen = " selected" if selected else ""
    value, text = escape(fitted.name, quote=True), escape(note, quote=True)
    return f'<option value="{value}" data-note="{text}"{chosen}>{escape(fitted.label)}</option>'


def _handle(side: str, now: int, text: str) -> str:
    return (
        f'<div class="handle {side}" role="slider" tabindex="0" aria-orientation="horizontal" aria-label="{text}" '
        f'aria-valuemin="0" aria-valuemax="100" aria-valuenow="{now}"></div>'
    )
