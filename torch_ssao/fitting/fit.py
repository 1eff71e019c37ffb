"""Fit the continuous parameters of a technique to a reference."""

from __future__ import annotations

import copy
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.fitting import bridge, uncertainty
from torch_ssao.fitting.parameters import ParameterSpace, choose_parameters
from torch_ssao.fitting.residuals import Residuals
from torch_ssao.fitting.result import FitResult
from torch_ssao.fitting.search import PERFECT, Outcome, search
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility

BUDGET = {1: 60, 2: 100, 3: 180}  # evaluations by number of parameters: scan, descents and polish
BUDGET_MANY = 700


def fit(
    module: AmbientVisibility,
    gbuffer: GBuffer,
    target: Any,
    *,
    parameters: str | tuple[str, ...] | None = None,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
    max_evaluations: int | None = None,
    scan: bool = True,
    progress: bool | None = None,
) -> FitResult:
    """Least-squares fit of a module's parameters to reference visibility: scan, Levenberg-Marquardt, polish.

    The residual of a pixel is sqrt(weight) (prediction - target). A coarse logarithmic scan makes a bad start harmless;
    Levenberg-Marquardt (optimistix) descends from its best points on forward-mode Jacobians; a secant polish takes in what
    discrete decisions inside a technique add to the slope. The answer is the best point ever evaluated, hence never worse
    than the start.

    Args:
        module: the technique, on any device; it is copied, not changed.
        gbuffer: B views.
        target: (B, 1, H, W) visibility in [0, 1], or an object with `.visibility` and `.standard_error` of that shape, such as
            `reference.raytrace` returns.
        parameters: names to fit; None for the module's `learnable` ones or, when it has none, all that it uses.
        weights: (B, 1, H, W) >= 0, importance of each pixel; None for all alike.
        valid: (B, 1, H, W) bool, further pixels to leave out; invalid pixels of the G-buffer never count.
        max_evaluations: budget, every residual, Jacobian column and scan point counted as one; None for 60, 100, 180 or 700 by
            the number of parameters (1, 2, 3, more).
        scan: False starts from the module's own values only.
        progress: show a bar on stderr; None for only when that is a terminal.
    Returns: a FitResult. Its standard errors propagate the target's own noise through the fit: `target.standard_error` where
        there is one, else the size of each pixel's residual as if it were independent noise. They do not cover what the
        model cannot express: between views of a real scene the parameters scatter far more.
    Raises: ShapeError; RangeError for targets that are not finite, weights below 0, no pixel to fit, or starting
        values out of range; ChoiceError for unknown parameters; MissingExtraError without optimistix.
    Cost: `evaluations` forward passes of all views (a Jacobian column costs about one and a half); memory one view at a time.
    Source: Marquardt 1963; the scan is a Sobol sequence over factors of 1/8 to 8.
    """
    if not isinstance(module, AmbientVisibility):
        raise checks.ChoiceError(
            f"module must be a technique of torch_ssao, got {type(module).__name__}: pass e.g. StatVO()"
        )
    names = choose_parameters(module, parameters)
    image = getattr(target, "visibility", target)
    weight = _pixel_weights(gbuffer, image, weights, valid)
    space = ParameterSpace.of(module, names)
    budget = BUDGET.get(len(names), BUDGET_MANY) if max_evaluations is None else max_evaluations
    checks.check_count("max_evaluations", budget, 2 * (len(names) + 1))
    bridge.check_installed()
    began = time.perf_counter()
    with _Bar(budget, progress) as bar:
        searching = budget - len(names)  # the last Jacobian, for the standard errors, is paid for too
        residuals = Residuals(module, gbuffer, image.to(weight.device), weight, names, searching, bar.update)
        initial = float(residuals.value(space.start).norm())
        outcome = search(residuals, space, with_scan=scan)
    noise = getattr(target, "standard_error", None)
    return _conclude(module, space, residuals, outcome, initial, weight, noise, time.perf_counter() - began)


def _conclude(
    module: AmbientVisibility,
    space: ParameterSpace,
    residuals: Residuals,
    outcome: Outcome,
    initial: float,
    weight: Tensor,
    noise: Tensor | None,
    seconds: float,
) -> FitResult:
    """The result at the best point seen."""
    log, best = residuals.best_log, residuals.best
    if log is None or best is None:
        raise checks.RangeError("module gives NaN at every point tried: check its parameters and the G-buffer")
    fitted = copy.deepcopy(module)
    if not torch.equal(log, space.start):
        for name, value in zip(space.names, log.exp().tolist(), strict=True):
            setattr(fitted, name, value)
    residuals.budget += len(space)  # kept back from the search for this Jacobian
    jacobian = residuals.jacobian(log)
    # The fit is done: a column that is not finite is an undetermined parameter, not a reason to lose it.
    jacobian = torch.where(jacobian.isfinite(), jacobian, 0.0)
    # Without a stated noise of the target, the size of each residual stands in for it.
    spread = best.abs() if noise is None else residuals.gather(weight.sqrt() * noise.to(weight.device).double())
    deviations = uncertainty.covariance(jacobian, spread).diagonal().clamp(min=0).sqrt().tolist()
    flat = uncertainty.undetermined(jacobian, space, log)
    values = fitted.values()
    return FitResult(
        module=fitted,
        values=values,
        standard_errors={
            name: math.inf if name in flat else values[name] * deviation
            for name, deviation in zip(space.names, deviations, strict=True)
        },
        undetermined=flat,
        rmse=residuals.rmse,
        initial_rmse=initial,
        steps=outcome.steps,
        starts=outcome.starts,
        evaluations=residuals.evaluations,
        message=_message(residuals, outcome, initial),
        seconds=seconds,
    )


def _pixel_weights(gbuffer: GBuffer, image: Any, weights: Tensor | None, valid: Tensor | None) -> Tensor:
    """(B, 1, H, W) weights that sum to 1, zero at pixels that do not count."""
    checks.check_floating("target", image)
    batch, _, height, width = gbuffer.depth.shape
    shape = (batch, 1, height, width)
    checks.check_shape("target", image, shape, "one visibility image per view of gbuffer")
    inside = gbuffer.valid_mask[:, :1]
    if valid is not None:
        checks.check_shape("valid", valid, shape, "one flag per pixel")
        inside = inside & valid.to(inside.device).bool()
    weight = inside.double()
    if weights is not None:
        checks.check_shape("weights", weights, shape, "one weight per pixel")
        if bool((weights < 0).any()) or not bool(torch.isfinite(weights).all()):
            raise checks.RangeError("weights must be finite and at least 0, got values that are not: clamp them")
        weight = weight * weights.to(weight.device).double()
    if not bool(weight.any()):
        raise checks.RangeError("gbuffer, valid and weights leave no pixel to fit: choose views that see something")
    bad = int((~torch.isfinite(image.to(weight.device)) & (weight > 0)).sum())
    if bad:
        raise checks.RangeError(
            f"target must be finite where it counts, got {bad} pixels that are not: mask them with valid"
        )
    return weight / weight.sum()


def _message(residuals: Residuals, outcome: Outcome, initial: float) -> str:
    if residuals.rmse < PERFECT:
        return "Converged: the prediction equals the target to rounding."
    if residuals.rmse >= initial:
        return f"No point better than the start was found in {residuals.evaluations} evaluations."
    if outcome.converged:
        return "Converged: the last steps changed the error by less than 1e-5 of itself."
    return f"The budget of {residuals.budget} evaluations was spent: raise max_evaluations to go on."


class _Bar:
    """tqdm's bar over evaluations, or nothing."""

    def __init__(self, total: int, progress: bool | None) -> None:
        self._bar: Any = None
        if sys.stderr.isatty() if progress is None else progress:
            from tqdm import tqdm

            self._bar = tqdm(total=total, desc="fitting", unit="eval", file=sys.stderr)
        self.update: Callable[[int], None] = (lambda count: None) if self._bar is None else self._advance

    def _advance(self, count: int) -> None:
        self._bar.update(count)

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
