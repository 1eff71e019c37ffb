"""The measurement behind fit and report: untuned and fitted modules against ray-traced references."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from torch_ssao import checks, serialize
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report import rows as row_tools
from torch_ssao.report.environment import environment, require
from torch_ssao.report.rows import FitSummary, Row, Score
from torch_ssao.report.truth import CEILING_SEED_STEP, Ceiling, TraceSettings, Truth, noise_ceiling, trace_views

if TYPE_CHECKING:
    from torch_ssao.scenes import Scene

FORMAT = "torch_ssao.report"
VERSION = 1
SMALLEST = 11
"""Pixels: the window of SSIM."""


@final
@dataclass(frozen=True)
class Constant:
    """The best constant picture: the mean visibility of the fitted views, and its errors."""

    value: float
    validation: Score
    training: Score


@final
@dataclass(frozen=True, eq=False)
class Measurement:
    """What was measured, and all that pictures of it need.

    Args:
        scene: what was rendered.
        out: folder of the files written.
        settings: size, radius, samples of the reference.
        fit_views, judged_views: indices into `scene.cameras`.
        rows: untuned modules by layer count, then the fitted ones.
        constant, ceiling: the two lines every error lies between.
        gbuffer, truth: of the judged views.
        environment: see `environment.environment`.
        files: everything written so far, relative to `out`.
    """

    scene: Scene
    out: Path
    settings: TraceSettings
    fit_views: tuple[int, ...]
    judged_views: tuple[int, ...]
    rows: tuple[Row, ...]
    constant: Constant
    ceiling: Ceiling
    gbuffer: GBuffer
    truth: Truth
    environment: dict[str, Any]
    files: tuple[str, ...]

    @property
    def judged_on_training_views(self) -> bool:
        """Whether no view was left to judge on, so that the errors flatter the fit."""
        return set(self.judged_views) <= set(self.fit_views)

    @property
    def judged_label(self) -> str:
        """The judged views in words."""
        kind = "training view" if self.judged_on_training_views else "view"
        return f"{kind}{'s' if len(self.judged_views) > 1 else ''} {', '.join(map(str, self.judged_views))}"

    def as_dict(self) -> dict[str, Any]:
        """The measurement as plain values, as in report.json."""
        scene = {"name": self.scene.name, "faces": len(self.scene.faces), "fingerprint": self.scene.fingerprint}
        return row_tools.plain(
            {
                "format": FORMAT,
                "version": VERSION,
                "scene": scene | {"views": len(self.scene.cameras), "suggested_radius": self.scene.radius},
                "settings": asdict(self.settings),
                "fit_views": self.fit_views,
                "judged_views": self.judged_views,
                "judged_on_training_views": self.judged_on_training_views,
                "rows": [row.as_dict() for row in self.rows],
                "constant": asdict(self.constant),
                "ceiling": asdict(self.ceiling),
                "environment": self.environment,
                "files": self.files,
            }
        )


def measure(
    scene: Scene,
    out: str | Path,
    *,
    views: Iterable[int] | None = None,
    height: int = 360,
    width: int = 480,
    samples: int = 512,
    fit_views: Iterable[int] = (0,),
    layers: Sequence[int] = (1, 2, 4, 8),
    technique: str = "statvo",
    radius: float | None = None,
    parameters: tuple[str, ...] | None = None,
    repeats: int = row_tools.REPEATS,
    seed: int = 0,
    progress: bool | None = None,
) -> Measurement:
    """Measure a technique on a scene, untuned and fitted, against ray-traced references.

    Args:
        scene: from `scenes.builtin` or `scenes.load`.
        out: folder, made where it is missing. Written: a reference per view (read back by the next run), each fitted module
            as JSON as soon as it is fitted, report.json.
        views: the views to judge on; None for all of the scene. Those used for fitting are left out, unless none remains:
            then the fitted views are judged and marked as training views everywhere.
        height, width: image size in pixels, at least 11 (the window of SSIM).
        samples: rays a pixel of the reference, a power of two.
        fit_views: the views to fit on.
        layers: layer counts, each once.
        technique: a name in `modules.TECHNIQUES`.
        radius: scene units, of the reference and of the untuned modules; None for the scene's suggestion.
        parameters: names to fit; None for all that the technique uses.
        repeats: timed forward passes per module, at least 5.
        seed: of the reference's sampling pattern.
        progress: bars and notes on stderr; None shows them on a terminal only.
    Returns: a `Measurement`; its errors are of the judged views first and of the fitted views second.
    Raises: RangeError, ChoiceError, SceneError for arguments that cannot be; MissingExtraError without the extras `scenes`
        and `fitting`; OutputError before any work when `out` cannot be written.
    Cost: tracing dominates; see `reference.raytrace`. Judged views are traced twice, for the noise ceiling.
    """
    require("measure", "scenes", "trimesh", "embreex")  # before any work: without the extras nothing should be traced
    require("measure", "fitting", "optimistix")
    settings = TraceSettings(height, width, scene.radius if radius is None else radius, samples, seed)
    modules = row_tools.candidates(technique, settings.radius, layers)
    fit_on, judged = _split_views(scene, views, fit_views)
    _check_arguments(settings, repeats, modules[0][2], parameters)
    folder = checks.check_output_folder("out", out)
    note = _note(progress)

    data = _trace_all(scene, fit_on, judged, settings, folder, progress, note)
    fits, files = _fit_all(modules, data, folder, parameters, progress, note)
    note("timing")
    measured = _judge(fits, data, repeats)
    mean = row_tools.best_constant(data.truth[data.training])
    judged_on = (data.validation, data.training)
    constant = Constant(mean, *(row_tools.score_constant(mean, data.truth[rows]) for rows in judged_on))
    measurement = Measurement(
        scene,
        folder,
        settings,
        tuple(fit_on),
        tuple(judged),
        measured,
        constant,
        data.ceiling,
        data.gbuffer[data.validation],
        data.truth[data.validation],
        environment(data.gbuffer.depth.device),
        files,
    )
    return write_json(measurement)


def write_json(measurement: Measurement, *more_files: str) -> Measurement:
    """Write report.json in one step; return the measurement with it and `more_files` among its files."""
    files = dict.fromkeys([*measurement.files, *more_files, "report.json"])
    measurement = replace(measurement, files=tuple(files))
    path = measurement.out / "report.json"
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_text(json.dumps(measurement.as_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(partial, path)
    return measurement


@final
@dataclass(frozen=True, eq=False)
class _Data:
    """Every view that is fitted or judged, and which rows of the batch are which."""

    gbuffer: GBuffer
    truth: Truth
    training: list[int]
    validation: list[int]
    ceiling: Ceiling


def _trace_all(
    scene: Scene,
    fit_on: list[int],
    judged: list[int],
    settings: TraceSettings,
    folder: Path,
    progress: bool | None,
    note: Callable[[str], None],
) -> _Data:
    from torch_ssao import scenes

    traced = sorted({*fit_on, *judged})
    gbuffer = scenes.render(scene, views=traced, height=settings.height, width=settings.width)
    truth = trace_views(scene, traced, settings, folder, progress=progress, note=note)
    # A pixel that the technique holds for empty is not its error: judge what both see.
    truth = replace(truth, valid=truth.valid & gbuffer.valid_mask[:, :1].cpu())
    training, validation = ([traced.index(view) for view in chosen] for chosen in (fit_on, judged))
    again = replace(settings, seed=settings.seed + CEILING_SEED_STEP)
    second = trace_views(scene, judged, again, folder, progress=progress, note=note)
    return _Data(gbuffer, truth, training, validation, noise_ceiling(truth[validation], second))


_Fit = tuple[str, str, AmbientVisibility, FitSummary | None]


def _fit_all(
    modules: list[tuple[str, str, AmbientVisibility]],
    data: _Data,
    folder: Path,
    parameters: tuple[str, ...] | None,
    progress: bool | None,
    note: Callable[[str], None],
) -> tuple[list[_Fit], tuple[str, ...]]:
    """All modules untuned, then fitted; each fitted one is saved at once."""
    from torch_ssao import fitting

    gbuffer, truth = data.gbuffer[data.training], data.truth[data.training]
    fitted: list[_Fit] = []
    for name, label, module in modules:
        note(f"fitting {label}")
        result = fitting.fit(module, gbuffer, truth, parameters=parameters, valid=truth.valid, progress=progress)
        serialize.save(result.module, folder / f"{name}.json")
        fitted.append((name, label, result.module, _summarise(result)))
    untuned: list[_Fit] = [(*entry, None) for entry in modules]
    return untuned + fitted, tuple(f"{name}.json" for name, *_ in fitted)


def _judge(fits: list[_Fit], data: _Data, repeats: int) -> tuple[Row, ...]:
    timings = row_tools.time_forward([fit[2] for fit in fits], data.gbuffer[data.validation[0]], repeats=repeats)
    measured = []
    for (name, label, module, summary), timing in zip(fits, timings, strict=True):
        prediction = row_tools.predict(module, data.gbuffer)
        validation, training = (
            row_tools.score(prediction[rows], data.truth[rows]) for rows in (data.validation, data.training)
        )
        measured.append(Row(name, label, module, validation, training, timing, summary))
    return tuple(measured)


def _split_views(scene: Scene, views: Iterable[int] | None, fit_views: Iterable[int]) -> tuple[list[int], list[int]]:
    """The views to fit on and the views to judge on, each once."""
    fit_on = list(dict.fromkeys(scene.view_indices(fit_views)))
    judged = [view for view in dict.fromkeys(scene.view_indices(views)) if view not in fit_on]
    return fit_on, judged or fit_on


def _check_arguments(
    settings: TraceSettings, repeats: int, module: AmbientVisibility, parameters: tuple[str, ...] | None
) -> None:
    checks.check_count("height", settings.height, SMALLEST)
    checks.check_count("width", settings.width, SMALLEST)
    checks.check_count("samples", settings.samples, 2)
    checks.check_count("repeats", repeats, 5)
    for name in parameters or ():
        checks.check_choice("parameters", name, module.used_parameters())


def _summarise(result: Any) -> FitSummary:
    errors, undetermined = dict(result.standard_errors), tuple(result.undetermined)
    return FitSummary(errors, undetermined, result.steps, result.evaluations, result.seconds, result.message)


def _note(progress: bool | None) -> Callable[[str], None]:
    shown = sys.stderr.isatty() if progress is None else progress
    return (lambda text: print(text, file=sys.stderr, flush=True)) if shown else (lambda text: None)  # noqa: T201
