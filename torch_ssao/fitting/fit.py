"""Fit the continuous parameters of a technique to references."""

from __future__ import annotations

import copy
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.fitting import bridge, uncertainty
from torch_ssao.fitting.descent import OPTIMISERS, ImageLosses, descend
from torch_ssao.fitting.losses import SQUARES, ImageLoss, image_loss
from torch_ssao.fitting.parameters import ParameterSpace, choose_parameters
from torch_ssao.fitting.priors import Prior, check_priors
from torch_ssao.fitting.residuals import Residuals
from torch_ssao.fitting.result import FitResult
from torch_ssao.fitting.search import PERFECT, search
from torch_ssao.fitting.views import gather_views
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility

BUDGET = {1: 60, 2: 100, 3: 180}  # evaluations by number of parameters: scan, descents and polish
BUDGET_MANY = 700
_TURNS = threading.RLock()  # torch's forward-mode levels belong to the process: fits in threads must not overlap


def fit(
    module: AmbientVisibility | Sequence[AmbientVisibility],
    gbuffer: GBuffer | Sequence[GBuffer],
    target: Any,
    *,
    parameters: str | tuple[str, ...] | None = None,
    per_scene: str | tuple[str, ...] = (),
    priors: Mapping[str, Prior] | None = None,
    weights: Any = None,
    valid: Any = None,
    loss: str | ImageLoss = "l2",
    loss_scale: float = 0.1,
    solver: str | None = None,
    batch: int | None = None,
    seed: int = 0,
    max_evaluations: int | None = None,
    scan: bool = True,
    progress: bool | None = None,
) -> FitResult:
    """Fit a module's parameters to reference visibility: scan, descents, polish.

    The residual of a pixel is sqrt(weight) (prediction - target). A coarse logarithmic scan makes a bad start harmless;
    the solver (optimistix) descends from its best points on forward-mode Jacobians; a secant polish takes in what
    discrete decisions inside a technique add to the slope. The answer is the best point ever evaluated on all views, hence
    never worse than the start.

    Args:
        module: the technique, on any device; it is copied, not changed. For several scenes also a sequence, one a scene, alike
            but for values: a radius that they share is then one factor on each one's own.
        gbuffer: B views, or a sequence of G-buffers, one a scene, of any sizes.
        target: (B, 1, H, W) visibility in [0, 1] from anywhere (see `reference.load_image` for files), or an object with
            `.visibility` and `.standard_error` of that shape, such as `reference.raytrace` returns; a sequence like `gbuffer`.
        parameters: names to fit, the others stay fixed; None for the module's `learnable` ones or, when it has none, all that
            it uses.
        per_scene: those of them that every scene has for itself; the others are shared.
        priors: by parameter, what is known of it beforehand; "radius[1]" for that of one scene.
        weights: (B, 1, H, W) >= 0, importance of each pixel; None for all alike. A sequence like `gbuffer`.
        valid: (B, 1, H, W) bool, further pixels to leave out; invalid pixels of the G-buffer never count. Likewise.
        loss: of prediction - target: "l2", or "soft_l1", which forgives pixels that no parameter explains; or of whole images:
            "ssim" for 1 - SSIM, or a function (prediction, target, valid), each (1, 1, H, W), to a 0-d tensor.
        loss_scale: difference beyond which "soft_l1" turns from square to linear, > 0.
        solver: "levenberg_marquardt" (default), "dogleg" or "bfgs" of optimistix for "l2" and "soft_l1"; "adam" (default for other
            losses), "adamw", "rmsprop" or "sgd" of torch for every loss.
        batch: views seen by the scan and by each descent (or step of a torch optimiser), drawn anew each time; the polish and
            what is returned are judged on all. None for all.
        seed: of the batches.
        max_evaluations: budget: one is a forward pass of all views, a Jacobian column or a point of the scan too (a gradient of
            a torch optimiser: three); None for 60, 100, 180 or 700 by the number of parameters (1, 2, 3, more).
        scan: False starts from the module's own values only.
        progress: show a bar on stderr; None for only when that is a terminal.
    Returns: a FitResult. Its standard errors propagate the target's own noise through the fit: `target.standard_error` where
        there is one, else the size of each pixel's residual as if it were independent noise. They do not cover what the
        model cannot express: between views of a real scene the parameters scatter far more.
    Raises: ShapeError; RangeError for targets that are not finite, weights below 0, no pixel to fit, or starting
        values out of range; ChoiceError for unknown names; MissingExtraError without optimistix.
    Cost: `evaluations` forward passes of all views (a Jacobian column costs about one and a half); memory one view at a time.
        Fits in several threads take turns: use processes, or `sweep`.
    Source: Marquardt 1963, Powell 1970 (dogleg), Nocedal and Wright 2006 (BFGS); the scan is a Sobol sequence over factors of
        1/8 to 8.
    """
    views, scenes = gather_views(gbuffer, target, weights, valid)
    modules = _modules_of(module, scenes)
    names = choose_parameters(modules[0], parameters)
    space = ParameterSpace.of(modules, names, _check_per_scene(per_scene, names))
    plan = _Plan.of(loss, loss_scale, solver, weights is not None)
    budget = _budget(max_evaluations, len(space))
    began = time.perf_counter()
    with _TURNS, _Bar(budget, progress) as bar:
        searching = budget - (
            len(space) if plan.has_squares else 0
        )  # the Jacobian of the standard errors is paid for too
        residuals = Residuals(
            modules,
            views,
            space,
            searching,
            loss=plan.squares,
            loss_scale=loss_scale,
            priors=check_priors(priors, space.names),
            on_evaluation=bar.update,
        )
        batches = None if batch is None else _batches(len(views), batch, seed)
        found = _run(residuals, plan, batches, with_scan=scan)
        return _conclude(residuals, plan, found, time.perf_counter() - began)


@final
@dataclass(frozen=True)
class _Plan:
    """Which loss and which solver: the residuals' squares, the image loss (None for the squares), the solver."""

    squares: str
    image: ImageLoss | None
    solver: str

    @property
    def has_squares(self) -> bool:
        """Whether standard errors mean something."""
        return self.image is None

    @staticmethod
    def of(loss: str | ImageLoss, scale: float, solver: str | None, weighted: bool) -> _Plan:
        checks.check_positive("loss_scale", scale)
        squares = loss if isinstance(loss, str) and loss in SQUARES else None
        if squares is None:
            if isinstance(loss, str):
                checks.check_choice("loss", loss, (*SQUARES, "ssim"))
            if weighted:
                raise checks.ChoiceError(
                    f'weights must be left out with the image loss {loss!r}, which has none: pass loss="l2" or "soft_l1"'
                )
        chosen = ("levenberg_marquardt" if squares else "adam") if solver is None else solver
        checks.check_choice("solver", chosen, (*bridge.SOLVERS, *OPTIMISERS) if squares else tuple(OPTIMISERS))
        if chosen in bridge.SOLVERS:
            bridge.check_installed()
        return _Plan(squares or "l2", None if squares else image_loss(loss), chosen)


@final
@dataclass(frozen=True)
class _Found:
    """How a search ended: loss and RMSE at its start, the loss at its end, descents, steps, why it stopped."""

    initial_loss: float
    initial_rmse: float
    loss: float
    starts: int
    steps: int
    message: str


def _run(residuals: Residuals, plan: _Plan, batches: Iterator[list[int]] | None, *, with_scan: bool) -> _Found:
    space = residuals.space
    residuals.value(space.start)
    initial, initial_rmse = residuals.least**2, residuals.rmse
    if plan.solver in OPTIMISERS:
        losses = ImageLosses(residuals, plan.image)
        end = descend(losses, space, optimiser=plan.solver, with_scan=with_scan, batches=batches)
        residuals.move_to(end.log)
        better = end.loss < end.initial_loss
        message = "The planned steps were taken." if better else "No point better than the start was found."
        return _Found(end.initial_loss, initial_rmse, end.loss, 1, end.steps, message)
    outcome = search(residuals, space, with_scan=with_scan, solver=plan.solver, batches=batches)
    message = _message(residuals, outcome.converged, math.sqrt(initial))
    return _Found(initial, initial_rmse, residuals.least**2, outcome.starts, outcome.steps, message)


def _conclude(residuals: Residuals, plan: _Plan, found: _Found, seconds: float) -> FitResult:
    """The result at the best point seen."""
    log, space = residuals.best_log, residuals.space
    if log is None:
        raise checks.RangeError("module gives NaN at every point tried: check its parameters and the G-buffer")
    fitted = tuple(copy.deepcopy(module) for module in residuals.modules)
    if not torch.equal(log, space.start):
        for scene, module in enumerate(fitted):
            for name, raw in space.of_scene(scene, log).items():
                setattr(module, name, float(raw.exp()))
    values = fitted[0].values() | {
        column.name: float(getattr(fitted[column.scene], column.field).detach())
        for column in space.columns
        if column.scene is not None
    }
    errors, correlation, flat = _uncertainty(residuals, log, values) if plan.has_squares else ({}, None, ())
    return FitResult(
        module=fitted[0],
        modules=fitted,
        values=values,
        names=space.names,
        standard_errors=errors,
        correlation=correlation,
        undetermined=flat,
        rmse=residuals.rmse,
        initial_rmse=found.initial_rmse,
        loss=found.loss,
        initial_loss=found.initial_loss,
        steps=found.steps,
        starts=found.starts,
        evaluations=residuals.evaluations,
        message=found.message,
        seconds=seconds,
    )


def _uncertainty(
    residuals: Residuals, log: Tensor, values: dict[str, float]
) -> tuple[dict[str, float], Tensor, tuple[str, ...]]:
    """Standard errors and correlations at the best point, and what the data cannot determine."""
    space = residuals.space
    residuals.budget += len(space)  # kept back from the search for this Jacobian
    jacobian = residuals.jacobian(log)
    # The fit is done: a column that is not finite is an undetermined parameter, not a reason to lose it.
    jacobian = torch.where(jacobian.isfinite(), jacobian, 0.0)
    covariance = uncertainty.covariance(jacobian, residuals.noise())
    deviations = covariance.diagonal().clamp(min=0).sqrt().tolist()
    flat = uncertainty.undetermined(jacobian, space, log)
    errors = {
        name: math.inf if name in flat else values[name] * deviation
        for name, deviation in zip(space.names, deviations, strict=True)
    }
    return errors, uncertainty.correlation(covariance).cpu(), flat


def _modules_of(module: Any, scenes: int) -> list[AmbientVisibility]:
    """One module a scene."""
    modules = list(module) if isinstance(module, Sequence) else [module] * scenes
    for given in modules:
        if not isinstance(given, AmbientVisibility):
            raise checks.ChoiceError(
                f"module must be a technique of torch_ssao, got {type(given).__name__}: pass e.g. StatVO()"
            )
    if len(modules) != scenes:
        raise checks.ShapeError(f"module must be one, or {scenes}, one per G-buffer, got {len(modules)}: pass one")
    first = modules[0]
    for other in modules[1:]:
        if type(other) is not type(first) or other.config() != first.config():
            raise checks.ChoiceError(f"module must be alike in all scenes but for values, got {first} and {other}")
        differing = [
            name
            for name, spec in first.PARAMETERS.items()
            if not spec.relative_bounds and first.values().get(name) != other.values().get(name)
        ]
        if differing:
            raise checks.ChoiceError(
                f"module must start from the same {differing[0]} in every scene, got other values: only the radius may differ"
            )
    return modules


def _check_per_scene(per_scene: str | tuple[str, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    chosen = (per_scene,) if isinstance(per_scene, str) else tuple(per_scene)
    for name in chosen:
        checks.check_choice("per_scene", name, names)
    return chosen


def _budget(max_evaluations: int | None, size: int) -> int:
    budget = BUDGET.get(size, BUDGET_MANY) if max_evaluations is None else max_evaluations
    checks.check_count("max_evaluations", budget, 2 * (size + 1))
    return budget


def _batches(count: int, size: int, seed: int) -> Iterator[list[int]]:
    """Indices of `size` of `count` views, without end, so that all views come up equally often."""
    checks.check_count("batch", size, 1, count)
    return _draw(count, size, torch.Generator().manual_seed(seed))


def _draw(count: int, size: int, generator: torch.Generator) -> Iterator[list[int]]:
    waiting: list[int] = []
    while True:
        while len(waiting) < size:
            shuffled = torch.randperm(count, generator=generator).tolist()
            waiting += [index for index in shuffled if index not in waiting[-size:]] if size < count else shuffled
        yield sorted(waiting[:size])
        waiting = waiting[size:]


def _message(residuals: Residuals, converged: bool, initial: float) -> str:
    if residuals.least < PERFECT:
        return "Converged: the prediction equals the target to rounding."
    if residuals.least >= initial:
        return f"No point better than the start was found in {residuals.evaluations} evaluations."
    if converged:
        return "Converged: the last steps changed the error by less than 1e-5 of itself."
    return f"The budget of {residuals.budget} evaluations was spent: raise max_evaluations to go on."


class _Bar:
    """tqdm's bar over evaluations, or nothing."""

    def __init__(self, total: int, progress: bool | None) -> None:
        self._bar: Any = None
        if sys.stderr.isatty() if progress is None else progress:
            from tqdm import tqdm

            self._bar = tqdm(total=total, desc="fitting", unit="eval", file=sys.stderr)
        self.update: Callable[[float], None] = (lambda count: None) if self._bar is None else self._advance

    def _advance(self, count: float) -> None:
        self._bar.update(count)

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
