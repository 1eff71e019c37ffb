"""One self-contained page: pictures, style and script embedded, nothing loaded from elsewhere."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from html import escape
from importlib import resources
from typing import TYPE_CHECKING

from torch_ssao.report import gallery, tables
from torch_ssao.report.candidates import MEANINGS
from torch_ssao.report.markup import picture, plot, table
from torch_ssao.report.pareto import entries, is_on, pareto_front
from torch_ssao.report.rows import Row

if TYPE_CHECKING:
    from torch_ssao.report.measurement import Measurement


def page(measurement: Measurement, pictures: Mapping[str, bytes]) -> str:
    """The report as HTML.

    Args:
        measurement: what was measured.
        pictures: PNG files by name, those of `make_report`.
    Returns: the page; every text in it is escaped, every picture embedded once. A content security policy lets a browser run
        this page's own script and load nothing.
    """
    name = escape(measurement.scene.name)
    overview = "The reference and of each technique the fitted model of least error on the judged views."
    parts = [
        f"<h1>{name}: speed against error</h1>",
        _choice(measurement),
        _summary(measurement),
        _warning(measurement),
        "<h2>Error and time</h2>",
        plot(pictures, "speed_error.png", "Error against time; bars are quartiles of the time."),
        _scores(measurement),
        _score_notes(measurement),
        gallery.compare(measurement, pictures, shown_first(measurement).name),
        f"<h2>Pictures, view {measurement.judged_views[0]}</h2>",
        picture(pictures, "techniques.png", overview),
        gallery.everything(measurement, pictures),
        "<h2>Fitted values</h2>",
        _values(measurement, pictures),
        "<h2>How this was measured</h2>",
        _conditions(measurement),
    ]
    style, script = _asset("page.css"), _asset("page.js")
    policy = f"default-src 'none'; img-src data:; style-src {_digest(style)}; script-src {_digest(script)}"
    head = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}: speed against error</title><style>{style}</style></head>\n<body>\n"
    )
    return head + "\n".join(part for part in parts if part) + f"\n<script>{script}</script>\n</body></html>\n"


def shown_first(measurement: Measurement) -> Row:
    """The fitted row that was chosen, or else the one of least error."""
    chosen = measurement.chosen
    for row in measurement.rows:
        if chosen is not None and row.is_fitted and row.name == chosen.name:
            return row
    return best_row(measurement)


def _asset(name: str) -> str:
    return resources.files("torch_ssao.report").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


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


def _choice(measurement: Measurement) -> str:
    chosen = measurement.chosen
    if chosen is None:
        return ""
    kind = "choice" if chosen.reached else "warning"
    notes = "".join(f"<br>{escape(note)}" for note in chosen.notes)
    title = "Chosen" if chosen.reached else "Not reached; nearest"
    return f'<p class="{kind}"><strong>{title}: {escape(chosen.label)}</strong>. {escape(chosen.reason)}{notes}</p>'


def _scores(measurement: Measurement) -> str:
    first = shown_first(measurement)
    best = [index for index, row in enumerate(measurement.rows) if row is first]
    return table(tables.columns(measurement), tables.score_cells(measurement), best=best)


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
    return f'<p class="soft">{judged} {timed} {_front(measurement)} {counts} {noise}</p>{_peer_notes(measurement)}'


def _front(measurement: Measurement) -> str:
    mark, front = tables.ON_FRONT, pareto_front(measurement)
    peers = [escape(peer.name) for peer in measurement.peers if is_on(front, peer)]
    theirs = f" Peers on it: {', '.join(peers)}." if peers else ""
    return (
        f"{mark}: on the Pareto front: none of these {len(entries(measurement))} is both faster and nearer (a model untuned and "
        f"fitted does the same work: the better of the two competes).{theirs}"
    )


def _peer_notes(measurement: Measurement) -> str:
    if not measurement.peers:
        return ""
    notes = "".join(f"<li>{escape(peer.name)}: {escape(peer.note)}</li>" for peer in measurement.peers if peer.note)
    text = "Peers are rows of a file, not measured here: compare their times only where they ran on the same machine."
    return f'<p class="soft">{text}</p>' + (f'<ul class="soft">{notes}</ul>' if notes else "")


def _values(measurement: Measurement, pictures: Mapping[str, bytes]) -> str:
    caption = "Fitted values with standard errors; the dash is the start, hollow is not determined by these views."
    figure = plot(pictures, "fitted_values.png", caption)
    fits = [
        f"<li>{escape(row.label)}: {row.fit.evaluations} evaluations, {row.fit.seconds:.1f} s: "
        f"{escape(row.fit.message)}</li>"
        for row in measurement.rows
        if row.fit is not None
    ]
    cells = table(tables.VALUE_COLUMNS, tables.value_cells(measurement), text_columns=(1, 4))
    return f'{figure}{cells}<ul class="soft">{"".join(fits)}</ul>'


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
    return table((), [(key, str(text)) for key, text in facts.items()], text_columns=(1,))
