"""The measurement behind fit and report: untuned and fitted modules against ray-traced references."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from torch_ssao import checks, serialize
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report import rows as row_tools
from torch_ssao.report.candidates import LAYERS, candidates
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
        rows: untuned modules by technique and count, then the fitted ones.
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
    def techniques(self) -> tuple[str, ...]:
        """Names in `modules.TECHNIQUES` of what was compared, each once."""
        return tuple(dict.fromkeys(row.technique for row in self.rows))

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
                "techniques": self.techniques,
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
    layers: Sequence[int] = LAYERS,
    technique: str | Sequence[str] = "statvo",
    options: Mapping[str, Any] | None = None,
    radius: float | None = None,
    parameters: tuple[str, ...] | None = None,
    max_evaluations: int | None = None,
    repeats: int = row_tools.REPEATS,
    seed: int = 0,
    progress: bool | None = None,
) -> Measurement:
    """Measure techniques on a scene, untuned and fitted, against ray-traced references.

    Args:
        scene: from `scenes.builtin` or `scenes.load`.
        out: folder, made where it is missing. Written: a reference per view (read back by the next run), each fitted
            module as JSON as soon as it is fitted, report.json.
        views: the views to judge on; None for all of the scene. Those used for fitting are left out, unless none
            remains: then the fitted views are judged and marked as training views everywhere.
        height, width: image size in pixels, at least 11 (the window of SSIM).
        samples: rays a pixel of the reference, a power of two.
        fit_views: the views to fit on.
        layers: layer counts, each once; of techniques that have layers.
        technique: a name in `modules.TECHNIQUES`, or several.
        options: counts and other choices of the techniques; see `candidates.candidates`.
        radius: scene units, of the reference and of the untuned modules; None for the scene's suggestion.
        parameters: names to fit, of each technique those that it uses; None for all.
        max_evaluations: budget of each fit; None for that of `fitting.fit`.
        repeats: timed forward passes per module, at least 5.
        seed: of the reference's sampling pattern.
        progress: bars and notes on stderr; None shows them on a terminal only.
    Returns: a `Measurement`; its errors are of the judged views first and of the fitted views second.
    Raises: RangeError, ChoiceError, SceneError for arguments that cannot be; MissingExtraError without the extras
        `scenes` and `fitting`; OutputError before any work when `out` cannot be written.
    Cost: tracing dominates; see `reference.raytrace`. Judged views are traced twice, for the noise ceiling.
    """
    require("measure", "scenes", "trimesh", "embreex")  # before any work: without the extras nothing should be traced
    require("measure", "fitting", "optimistix")
    settings = TraceSettings(height, width, scene.radius if radius is None else radius, samples, seed)
    modules = candidates(technique, settings.radius, layers, options)
    fit_on, judged = _split_views(scene, views, fit_views)
    _check_arguments(settings, repeats)
    _check_fits([module for *_, module in modules], parameters, max_evaluations)
    folder = checks.check_output_folder("out", out)
    return _run(_Plan(scene, folder, settings, modules, fit_on, judged, parameters, max_evaluations, repeats, progress))


def write_json(measurement: Measurement, *more_files: str) -> Measurement:
    """Write report.json in one step; return the measurement with it and `more_files` among its files."""
    files = dict.fromkeys([*measurement.files, *more_files, "report.json"])
    measurement = replace(measurement, files=tuple(files))
    path = measurement.out / "report.json"
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_text(json.dumps(measurement.as_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(partial, path)
    return measurement


_Fit = tuple[str, str, AmbientVisibility, FitSummary | None]


@final
@dataclass(frozen=True, eq=False)
class _Plan:
    """Checked arguments of a measurement."""

    scene: Scene
    folder: Path
    settings: TraceSettings
    modules: list[tuple[str, str, AmbientVisibility]]
    fit_on: list[int]
    judged: list[int]
    parameters: tuple[str, ...] | None
    max_evaluations: int | None
    repeats: int
    progress: bool | None

    def note(self, text: str) -> None:
        """One line on stderr, where progress is shown."""
        if sys.stderr.isatty() if self.progress is None else self.progress:
            sys.stderr.write(text + "\n")


@final
@dataclass(frozen=True, eq=False)
class _Data:
    """Every view that is fitted or judged, and which rows of the batch are which."""

    gbuffer: GBuffer
    truth: Truth
    training: list[int]
    validation: list[int]
    ceiling: Ceiling


def _run(plan: _Plan) -> Measurement:
    data = _trace_all(plan)
    fits, files = _fit_all(plan, data)
    plan.note("timing")
    measured = _judge(fits, data, plan.repeats)
    mean = row_tools.best_constant(data.truth[data.training])
    judged_on = (data.validation, data.training)
    constant = Constant(mean, *(row_tools.score_constant(mean, data.truth[rows]) for rows in judged_on))
    measurement = Measurement(
        scene=plan.scene,
        out=plan.folder,
        settings=plan.settings,
        fit_views=tuple(plan.fit_on),
        judged_views=tuple(plan.judged),
        rows=measured,
        constant=constant,
        ceiling=data.ceiling,
        gbuffer=data.gbuffer[data.validation],
        truth=data.truth[data.validation],
        environment=environment(data.gbuffer.depth.device),
        files=files,
    )
    return write_json(measurement)


def _trace_all(plan: _Plan) -> _Data:
    from torch_ssao import scenes

    settings = plan.settings
    traced = sorted({*plan.fit_on, *plan.judged})
    gbuffer = scenes.render(plan.scene, views=traced, height=settings.height, width=settings.width)

    def trace(views: list[int], seed: int) -> Truth:
        seeded = replace(settings, seed=seed)
        return trace_views(plan.scene, views, seeded, plan.folder, progress=plan.progress, note=plan.note)

    truth = trace(traced, settings.seed)
    # A pixel that the technique holds for empty is not its error: judge what both see.
    truth = replace(truth, valid=truth.valid & gbuffer.valid_mask[:, :1].cpu())
    training, validation = ([traced.index(view) for view in chosen] for chosen in (plan.fit_on, plan.judged))
    second = trace(plan.judged, settings.seed + CEILING_SEED_STEP)
    return _Data(gbuffer, truth, training, validation, noise_ceiling(truth[validation], second))


def _fit_all(plan: _Plan, data: _Data) -> tuple[list[_Fit], tuple[str, ...]]:
    """All modules untuned, then fitted; each fitted one is saved at once."""
    from torch_ssao import fitting

    gbuffer, truth = data.gbuffer[data.training], data.truth[data.training]
    fitted: list[_Fit] = []
    for name, label, module in plan.modules:
        plan.note(f"fitting {label}")
        result = fitting.fit(
            module,
            gbuffer,
            truth,
            parameters=_fitted_names(module, plan.parameters),
            valid=truth.valid,
            max_evaluations=plan.max_evaluations,
            progress=plan.progress,
        )
        serialize.save(result.module, plan.folder / f"{name}.json")
        fitted.append((name, label, result.module, _summarise(result)))
    untuned: list[_Fit] = [(*entry, None) for entry in plan.modules]
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


def _check_arguments(settings: TraceSettings, repeats: int) -> None:
    checks.check_count("height", settings.height, SMALLEST)
    checks.check_count("width", settings.width, SMALLEST)
    checks.check_count("samples", settings.samples, 2)
    checks.check_count("repeats", repeats, 5)


def _check_fits(
    modules: Sequence[AmbientVisibility], parameters: tuple[str, ...] | None, max_evaluations: int | None
) -> None:
    """Every name to fit is used by some module, every module has one and starts in range, and the budget is enough."""
    from torch_ssao.fitting.parameters import ParameterSpace

    known = tuple(dict.fromkeys(name for module in modules for name in module.used_parameters()))
    for name in parameters or ():
        checks.check_choice("parameters", name, known)
    for module in modules:
        fitted = _fitted_names(module, parameters)
        if not fitted:
            used = ", ".join(module.used_parameters())
            raise checks.ChoiceError(
                f"parameters must name at least one of each technique, got {parameters}: add one of {type(module).__name__}'s "
                f"{used}, or leave that technique out"
            )
        ParameterSpace.of(module, fitted)  # told now, not after tracing
        if max_evaluations is not None:  # two residuals with their Jacobians, the least a fit can work with
            checks.check_count("max_evaluations", max_evaluations, 2 * (len(fitted) + 1))


def _fitted_names(module: AmbientVisibility, parameters: tuple[str, ...] | None) -> tuple[str, ...]:
    used = module.used_parameters()
    return used if parameters is None else tuple(name for name in used if name in parameters)


def _summarise(result: Any) -> FitSummary:
    errors, undetermined = dict(result.standard_errors), tuple(result.undetermined)
    return FitSummary(errors, undetermined, result.steps, result.evaluations, result.seconds, result.message)
