"""One self-contained page: pictures embedded, no script, nothing loaded from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

from torch_ssao.report import tables
from torch_ssao.report.candidates import MEANINGS
from torch_ssao.report.rows import Row

if TYPE_CHECKING:
    from torch_ssao.report.measure import Measurement

STYLE = """
:root { color-scheme: light dark; --ink: #1c2024; --soft: #59636e; --line: #d9dee3; --paper: #fff; --shade: #f4f6f8; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ec; --soft: #9aa4ae; --line: #363c43; --paper: #15181b; --shade: #1e2226; } }
body { margin: 0 auto; max-width: 70rem; padding: 1.2rem; font: 16px/1.5 system-ui, sans-serif; color: var(--ink);
  background: var(--paper); }
h1 { font-size: 1.5rem; margin: .4rem 0; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
p, li { max-width: 46rem; } .soft, figcaption { color: var(--soft); font-size: .9rem; }
.warning { border-left: 4px solid #c9821b; padding: .4rem .8rem; background: var(--shade); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } td.text { text-align: left; white-space: normal; }
tr.best { background: var(--shade); font-weight: 600; }
figure { margin: 0; } img { width: 100%; height: auto; display: block; background: #fff; }
.plot { max-width: 46rem; }
.grid { display: grid; gap: .8rem; grid-template-columns: repeat(auto-fit, minmax(min(15rem, 100%), 1fr)); }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
"""


def page(measurement: Measurement, pictures: Mapping[str, bytes]) -> str:
    """The report as HTML.

    Args:
        measurement: what was measured.
        pictures: PNG files by name, those of `make_report`.
    Returns: the page; every text in it is escaped, every picture embedded.
    """
    name = escape(measurement.scene.name)
    parts = [
        f"<h1>{name}: speed against error</h1>",
        _summary(measurement),
        _warning(measurement),
        "<h2>Error and time</h2>",
        _plot(pictures, "speed_error.png", "Error against time; bars are quartiles of the time."),
        _scores(measurement),
        _score_notes(measurement),
        f"<h2>Pictures, view {measurement.judged_views[0]}</h2>",
        _picture(
            pictures,
            "techniques.png",
            "The reference and of each technique the fitted model of least error on the judged views.",
        ),
        _gallery(measurement, pictures),
        "<h2>Fitted values</h2>",
        _values(measurement, pictures),
        "<h2>How this was measured</h2>",
        _conditions(measurement),
    ]
    head = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}: speed against error</title><style>{STYLE}</style></head>\n<body>\n"
    )
    return head + "\n".join(part for part in parts if part) + "\n</body></html>\n"


def best_row(measurement: Measurement) -> Row:
    """The row of least RMSE on the judged views."""
    return min(measurement.rows, key=lambda row: row.validation.rmse)


def _summary(measurement: Measurement) -> str:
    best, constant, ceiling = best_row(measurement), measurement.constant, measurement.ceiling
    state = "fitted" if best.is_fitted else "untuned"
    score = best.validation
    return (
        f"<p>Least error on {escape(measurement.judged_label)}: <strong>{escape(best.label)}, {state}</strong>, "
        f"RMSE {score.rmse:.4f}, PSNR {score.psnr:.2f} dB, SSIM {score.ssim:.4f} in {best.timing.median_ms:.3g} ms. "
        f"A constant image at the fitted views' mean has RMSE {constant.validation.rmse:.4f}; "
        f"the reference's own noise alone gives {ceiling.rmse:.4f}.</p>"
    )


def _warning(measurement: Measurement) -> str:
    if not measurement.judged_on_training_views:
        return ""
    return (
        '<p class="warning">Judged on the training view: no view was left that the fit had not seen, so the errors of '
        "the fitted modules flatter them. Give the scene more cameras for an honest number.</p>"
    )


def _scores(measurement: Measurement) -> str:
    cells = tables.score_cells(measurement)
    best = measurement.rows.index(best_row(measurement))
    return _table(tables.COLUMNS, cells, best=best)


def _score_notes(measurement: Measurement) -> str:
    ceiling, settings = measurement.ceiling, measurement.settings
    fitted_on = ", ".join(map(str, measurement.fit_views))
    judged = (
        f"Errors on {escape(measurement.judged_label)} first, on the fitted view(s) {fitted_on} second; pixels of all "
        "these views pooled, pixels that see nothing left out."
    )
    timed = (
        f"Time: median (quartiles) of {measurement.rows[0].timing.repeats} forward passes over view "
        f"{measurement.judged_views[0]}, models taking turns, no gradients."
    )
    counts = " ".join(MEANINGS[name] for name in measurement.techniques if name in MEANINGS)
    noise = (
        "Noise ceiling: what a perfect model would score against this reference. With s the reference's standard error "
        f"at {settings.samples} rays a pixel, RMSE = sqrt(mean s²) and PSNR = -20 log10 RMSE. Two references with "
        f"different seeds agree to SSIM {ceiling.ssim_pair:.4f}; only one of the two pictures would be noisy "
        f"if the model were perfect, so SSIM = 1 - (1 - {ceiling.ssim_pair:.4f}) / 2, which holds for small noise. The "
        f"RMSE of these two references divided by sqrt(2) is {ceiling.rmse_pair:.4f}, a check of the stated "
        f"{ceiling.rmse:.4f}."
    )
    return f'<p class="soft">{judged} {timed} {counts} {noise}</p>'


def _gallery(measurement: Measurement, pictures: Mapping[str, bytes]) -> str:
    parts = [f'<div class="grid">{_picture(pictures, "reference.png", "Ray-traced reference")}</div>']
    for name in dict.fromkeys(row.name for row in measurement.rows):
        figures = []
        for row in (row for row in measurement.rows if row.name == name):
            state = "fitted" if row.is_fitted else "untuned"
            error = f"{name}_{state}_error.png"
            figures += [_picture(pictures, f"{name}_{state}.png", state), _picture(pictures, error, f"{state}, error")]
        label = next(row.label for row in measurement.rows if row.name == name)
        parts.append(f'<h3>{escape(label)}</h3><div class="grid">{"".join(figures)}</div>')
    parts.append(
        '<p class="soft">Grey pictures are visibility in linear 8-bit grey without gamma, 255 = open. Error maps: red '
        "is too open, blue too dark, grey sees nothing.</p>"
    )
    return "\n".join(parts)


def _values(measurement: Measurement, pictures: Mapping[str, bytes]) -> str:
    caption = "Fitted values with standard errors; the dash is the start, hollow is not determined by these views."
    plot = _plot(pictures, "fitted_values.png", caption)
    fits = [
        f"<li>{escape(row.label)}: {row.fit.evaluations} evaluations, {row.fit.steps} steps, {row.fit.seconds:.1f} s: "
        f"{escape(row.fit.message)}</li>"
        for row in measurement.rows
        if row.fit is not None
    ]
    table = _table(tables.VALUE_COLUMNS, tables.value_cells(measurement), text_columns=(1, 4))
    return f'{plot}{table}<ul class="soft">{"".join(fits)}</ul>'


def _conditions(measurement: Measurement) -> str:
    settings, where, scene = measurement.settings, measurement.environment, measurement.scene
    versions = ", ".join(f"{name} {version}" for name, version in where["versions"].items())
    facts = {
        "scene": f"{scene.name}, {len(scene.faces)} faces, {len(scene.cameras)} views",
        "images": f"{settings.width}x{settings.height}",
        "radius": f"{settings.radius:g} scene units",
        "reference": f"{settings.samples} cosine-weighted rays a pixel, {settings.falloff} hits, seed {settings.seed}",
        "processor": f"{where['cpu']}, {where['cpu_count']} cores",
        "device": f"{where['device']}, {where['threads']} torch thread(s)",
        "versions": versions,
        "commit": where["commit"] or "not in a git checkout",
        "platform": where["platform"],
    }
    for row in measurement.rows:
        if not row.is_fitted:
            choices = row.module.config().items()
            facts[row.label] = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in choices)
    rows = "".join(
        f'<tr><td>{escape(key)}</td><td class="text">{escape(str(text))}</td></tr>' for key, text in facts.items()
    )
    return f'<div class="scroll"><table>{rows}</table></div>'


def _table(
    head: Sequence[str], rows: Sequence[Sequence[str]], *, best: int | None = None, text_columns: Sequence[int] = ()
) -> str:
    lines = []
    for index, row in enumerate(rows):
        cells = "".join(
            f"<td{' class=text' if i in text_columns else ''}>{escape(cell)}</td>" for i, cell in enumerate(row)
        )
        lines.append(f"<tr{' class=best' if index == best else ''}>{cells}</tr>")
    top = "".join(f"<th>{escape(title)}</th>" for title in head)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _plot(pictures: Mapping[str, bytes], name: str, caption: str) -> str:
    return f'<div class="plot">{_picture(pictures, name, caption)}</div>' if name in pictures else ""


def _picture(pictures: Mapping[str, bytes], name: str, caption: str) -> str:
    if name not in pictures:
        return ""
    data = base64.b64encode(pictures[name]).decode("ascii")
    text = escape(caption, quote=True)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'
