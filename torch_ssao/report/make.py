"""The full report: a measurement, its pictures, and one page that holds them all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch_ssao.report import html, images, overview, plots
from torch_ssao.report.candidates import LAYERS
from torch_ssao.report.environment import require
from torch_ssao.report.measure import measure, write_json
from torch_ssao.report.measurement import Measurement
from torch_ssao.report.rows import REPEATS, predict

if TYPE_CHECKING:
    from torch_ssao.scenes import Scene


def make_report(
    scene: Scene,
    out: str | Path,
    *,
    views: Iterable[int] | None = None,
    height: int = 360,
    width: int = 480,
    samples: int = 512,
    fit_views: Iterable[int] = (0,),
    layers: Sequence[int] = LAYERS,
    technique: str | Sequence[str] = "statvo",
    options: Mapping[str, Any] | None = None,
    radius: float | None = None,
    parameters: tuple[str, ...] | None = None,
    max_evaluations: int | None = None,
    repeats: int = REPEATS,
    seed: int = 0,
    target_rmse: float | None = None,
    budget_ms: float | None = None,
    peers: str | Path | None = None,
    progress: bool | None = None,
) -> Measurement:
    """Measure techniques on a scene and write the report.

    Args: those of `measure`.
    Returns: the `Measurement`; `files` names what was written to `out`: what `measure` writes, and report.html
        (self-contained), speed_error.png, fitted_values.png, and for the first judged view reference.png and, for every
        model, <name>_untuned.png, <name>_fitted.png, <name>_untuned_error.png, <name>_fitted_error.png; chosen_<view>.png is
        what the module in chosen.json gives for each judged view. Grey pictures are visibility in linear 8-bit grey, 255 =
        open. Of several techniques, techniques.png shows the best of each beside the reference.
    Raises: as `measure`, and MissingExtraError without the extra `report`, before any work.
    Cost: as `measure`, and about 0.3 s a picture.
    """
    require("make_report", "report", "matplotlib", "PIL")
    measurement = measure(
        scene,
        out,
        views=views,
        height=height,
        width=width,
        samples=samples,
        fit_views=fit_views,
        layers=layers,
        technique=technique,
        options=options,
        radius=radius,
        parameters=parameters,
        max_evaluations=max_evaluations,
        repeats=repeats,
        seed=seed,
        target_rmse=target_rmse,
        budget_ms=budget_ms,
        peers=peers,
        progress=progress,
    )
    pictures = draw(measurement)
    page = html.page(measurement, pictures)
    pictures |= draw_chosen(measurement)
    for name, content in pictures.items():
        images.write(measurement.out / name, content)
    images.write(measurement.out / "report.html", page.encode())
    return write_json(measurement, *pictures, "report.html")


def draw(measurement: Measurement) -> dict[str, bytes]:
    """All pictures of a report as PNG files by name; visibility and errors are those of the first judged view."""
    pictures = {"speed_error.png": plots.speed_error_png(measurement)}
    values = plots.fitted_values_png(measurement)
    if values is not None:
        pictures["fitted_values.png"] = values
    if len(measurement.techniques) > 1:
        pictures["techniques.png"] = overview.overview_png(measurement)
    target, valid = measurement.truth.visibility[0], measurement.truth.valid[0]
    pictures["reference.png"] = images.grey_png(target)
    for row in measurement.rows:
        name = f"{row.name}_{'fitted' if row.is_fitted else 'untuned'}"
        prediction = predict(row.module, measurement.gbuffer[0])[0]
        pictures[f"{name}.png"] = images.grey_png(prediction)
        pictures[f"{name}_error.png"] = images.error_png(prediction, target, valid)
    return pictures


def draw_chosen(measurement: Measurement) -> dict[str, bytes]:
    """The chosen module's visibility of every judged view as PNG files by name; not on the page, where it is shown already."""
    chosen = measurement.chosen
    rows = [row for row in measurement.rows if row.is_fitted and chosen is not None and row.name == chosen.name]
    return {
        f"chosen_{view}.png": images.grey_png(predict(row.module, measurement.gbuffer[index])[0])
        for row in rows
        for index, view in enumerate(measurement.judged_views)
    }
