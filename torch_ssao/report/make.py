"""The full report: a measurement, its pictures, and one page that holds them all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch_ssao.report import html, images, plots
from torch_ssao.report.measure import Measurement, measure, write_json
from torch_ssao.report.rows import predict

if TYPE_CHECKING:
    from torch_ssao.scenes import Scene


def make_report(scene: Scene, out: str | Path, **options: Any) -> Measurement:
    """Measure a technique on a scene and write the report.

    Args:
        scene: from `scenes.builtin` or `scenes.load`.
        out: folder, made where it is missing.
        **options: every keyword of `measure`: views, height, width, samples, fit_views, layers, technique, radius, parameters,
            repeats, seed, progress.
    Returns: the `Measurement`; `files` names what was written to `out`: what `measure` writes, and report.html (self-contained),
        speed_error.png, fitted_values.png, and for the first judged view reference.png and, for every model,
        <name>_untuned.png, <name>_fitted.png and <name>_untuned_error.png, <name>_fitted_error.png. Grey pictures are
        visibility in linear 8-bit grey, 255 = open.
    Raises: as `measure`, and MissingExtraError without the extra `report`, before any work.
    Cost: as `measure`, and about 0.3 s a picture.
    """
    _check_installed()
    measurement = measure(scene, out, **options)
    pictures = draw(measurement)
    for name, content in pictures.items():
        images.write(measurement.out / name, content)
    measurement = write_json(measurement, *pictures, "report.html")
    images.write(measurement.out / "report.html", html.page(measurement, pictures).encode())
    return measurement


def draw(measurement: Measurement) -> dict[str, bytes]:
    """All pictures of a report as PNG files by name; visibility and errors are those of the first judged view."""
    pictures = {"speed_error.png": plots.speed_error_png(measurement)}
    values = plots.fitted_values_png(measurement)
    if values is not None:
        pictures["fitted_values.png"] = values
    target, valid = measurement.truth.visibility[0], measurement.truth.valid[0]
    pictures["reference.png"] = images.grey_png(target)
    for row in measurement.rows:
        name = f"{row.name}_{'fitted' if row.is_fitted else 'untuned'}"
        prediction = predict(row.module, measurement.gbuffer[0])[0]
        pictures[f"{name}.png"] = images.grey_png(prediction)
        pictures[f"{name}_error.png"] = images.error_png(prediction, target, valid)
    return pictures


def _check_installed() -> None:
    import importlib.util

    from torch_ssao import checks

    for package, imported in (("matplotlib", "matplotlib"), ("pillow", "PIL")):
        if importlib.util.find_spec(imported) is None:
            raise checks.MissingExtraError(
                f"make_report needs {package}, which is not installed: run pip install torch_ssao[report]"
            )
