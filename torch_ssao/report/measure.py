"""The measurement behind fit and report: untuned and fitted modules against ray-traced references."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from torch_ssao import checks, serialize
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report import images, spreadsheet
from torch_ssao.report import rows as row_tools
from torch_ssao.report.candidates import LAYERS, candidates
from torch_ssao.report.choosing import Chosen, Fitted, Wish, fit_and_choose
from torch_ssao.report.environment import environment, require
from torch_ssao.report.measurement import Constant, Measurement
from torch_ssao.report.peers import Peer, load_peers
from torch_ssao.report.rows import Row
from torch_ssao.report.truth import CEILING_SEED_STEP, Ceiling, TraceSettings, Truth, noise_ceiling, trace_views

if TYPE_CHECKING:
    from torch_ssao.scenes import Scene

FITS = "fits"
"""Folder of the fitted modules that the next run reads back, inside that of the results."""
SMALLEST = 11
"""Pixels: the window of SSIM."""


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
    target_rmse: float | None = None,
    budget_ms: float | None = None,
    peers: str | Path | None = None,
    progress: bool | None = None,
) -> Measurement:
    """Measure techniques on a scene, untuned and fitted, against ray-traced references.

    Args:
        scene: from `scenes.builtin` or `scenes.load`.
        out: folder, made where it is missing. Written: a reference per view and, in `fits`, each fitted module as soon as it
            is done (both read back by the next run, which goes on from there), then all fitted modules as JSON, the chosen one as
            chosen.json too, report.csv and report.json.
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
        target_rmse, budget_ms: what the chosen module has to reach, error on the judged views and milliseconds a view; see
            `fitting.select`, also for what is chosen without. With either, counts that are left out are swept more finely.
        peers: JSON file with results of other implementations on this scene and size; see `peers.load_peers`.
        progress: bars and notes on stderr; None shows them on a terminal only.
    Returns: a `Measurement`; its errors are of the judged views first and of the fitted views second.
    Raises: RangeError, ChoiceError, SceneError for arguments that cannot be; MissingExtraError without the extras
        `scenes` and `fitting`; OutputError before any work when `out` cannot be written.
    Cost: tracing dominates; see `reference.raytrace`. Judged views are traced twice, for the noise ceiling.
    """
    require("measure", "scenes", "trimesh", "embreex")  # before any work: without the extras nothing should be traced
    require("measure", "fitting", "optimistix")
    settings = TraceSettings(height, width, scene.radius if radius is None else radius, samples, seed)
    fine = target_rmse is not None or budget_ms is not None
    modules = candidates(technique, settings.radius, layers, options, fine=fine)
    fit_on, judged = _split_views(scene, views, fit_views)
    wish = Wish(target_rmse, budget_ms)
    _check_arguments(settings, repeats, wish)
    others = () if peers is None else load_peers(peers, scene=scene.name, height=height, width=width)
    _check_fits([module for *_, module in modules], parameters, max_evaluations)
    folder = checks.check_output_folder("out", out)
    checks.check_output_folder("out", folder / FITS)
    return _run(
        _Plan(
            scene,
            folder,
            settings,
            modules,
            fit_on,
            judged,
            parameters,
            max_evaluations,
            repeats,
            progress,
            wish,
            others,
        )
    )


def write_json(measurement: Measurement, *more_files: str) -> Measurement:
    """Write report.json in one step; return the measurement with it and `more_files` among its files."""
    files = dict.fromkeys([*measurement.files, *more_files, "report.json"])
    measurement = replace(measurement, files=tuple(files))
    text = json.dumps(measurement.as_dict(), indent=2, allow_nan=False) + "\n"
    images.write(measurement.out / "report.json", text.encode())
    return measurement


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
    wish: Wish
    peers: tuple[Peer, ...]

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
    fits, chosen = _fit_all(plan, data)
    mean = row_tools.best_constant(data.truth[data.training])
    judged_on = (data.validation, data.training)
    constant = Constant(mean, *(row_tools.score_constant(mean, data.truth[rows]) for rows in judged_on))
    measurement = Measurement(
        scene=plan.scene,
        out=plan.folder,
        settings=plan.settings,
        fit_views=tuple(plan.fit_on),
        judged_views=tuple(plan.judged),
        rows=_judge(plan, fits, data),
        constant=constant,
        ceiling=data.ceiling,
        gbuffer=data.gbuffer[data.validation],
        truth=data.truth[data.validation],
        environment=environment(data.gbuffer.depth.device),
        files=tuple(f"{name}.json" for name in (*fits, "chosen")),
        peers=plan.peers,
        chosen=chosen,
    )
    images.write(plan.folder / "report.csv", spreadsheet.csv_text(measurement).encode())
    return write_json(measurement, "report.csv")


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


def _fit_all(plan: _Plan, data: _Data) -> tuple[dict[str, Fitted], Chosen]:
    """All modules fitted, timed and saved, and the choice among them."""
    modules = {name: module for name, _, module in plan.modules}
    options: dict[str, Any] = {"parameters": plan.parameters, "progress": plan.progress}
    if plan.max_evaluations is not None:
        options["fit_options"] = {"max_evaluations": plan.max_evaluations}
    plan.note(f"fitting and timing {', '.join(modules)}")
    fits, chosen = fit_and_choose(
        modules,
        data.gbuffer,
        data.truth,
        data.training,
        data.validation,
        plan.wish,
        folder=plan.folder / FITS,
        repeats=plan.repeats,
        options=options,
    )
    for name, fitted in fits.items():
        serialize.save(fitted.module, plan.folder / f"{name}.json")
    serialize.save(fits[chosen.name].module, plan.folder / "chosen.json")
    return fits, chosen


def _judge(plan: _Plan, fits: Mapping[str, Fitted], data: _Data) -> tuple[Row, ...]:
    """Rows of the untuned modules, then of the fitted ones."""
    untuned, tuned = [], []
    for name, label, _ in plan.modules:
        if name in fits:
            fit = fits[name]
            untuned.append((name, label, fit.untuned, fit.untuned_timing, None))
            tuned.append((name, label, fit.module, fit.timing, fit.summary))
    measured = []
    for name, label, module, timing, summary in [*untuned, *tuned]:
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


def _check_arguments(settings: TraceSettings, repeats: int, wish: Wish) -> None:
    checks.check_count("height", settings.height, SMALLEST)
    checks.check_count("width", settings.width, SMALLEST)
    checks.check_count("samples", settings.samples, 2)
    checks.check_count("repeats", repeats, 5)
    for name, value in asdict(wish).items():
        if value is not None:
            checks.check_positive(name, value)


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
