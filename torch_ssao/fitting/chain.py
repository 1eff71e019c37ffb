"""Fits of many candidates on one problem, each begun from the values of its nearest fitted neighbour."""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from torch_ssao import checks
from torch_ssao.fitting.candidates import Candidate, distance
from torch_ssao.fitting.fit import fit
from torch_ssao.fitting.interrupts import remembered_interrupts
from torch_ssao.fitting.problem import Problem, rmse
from torch_ssao.fitting.result import FitResult
from torch_ssao.fitting.store import Store, key_of
from torch_ssao.fitting.table import Row, failed
from torch_ssao.modules import AmbientVisibility

OWN = ("module", "gbuffer", "target", "parameters", "per_scene", "weights", "valid", "scan", "progress")
"""Arguments of `fit` that are not options: `select` has its own, or sets them."""
MARGIN = 1e-3
"""Logarithm by which a start stays inside its bounds; `fit` refuses to start on one."""


@final
@dataclass(frozen=True)
class FitPlan:
    """How candidates are fitted, and where results are kept.

    Args:
        parameters: names to fit, of each technique those that it uses; None for the module's own list.
        options: further arguments of `fit`.
        warm_start: whether a fit begins from its neighbour's values.
        folder: where fitted candidates are kept, or None.
    """

    parameters: tuple[str, ...] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    warm_start: bool = True
    folder: str | Path | None = None

    @staticmethod
    def of(
        candidates: Sequence[Candidate],
        parameters: str | tuple[str, ...] | None,
        options: Mapping[str, Any] | None,
        warm_start: bool,
        folder: str | Path | None,
    ) -> FitPlan:
        """Checked. Raises: ChoiceError for options that `fit` has not or that are not for the caller, for parameters and
        priors that no candidate uses, and for functions where results are stored."""
        known = [name for name in inspect.signature(fit).parameters if name not in OWN]
        given = dict(options or {})
        for name in given:
            checks.check_choice("fit_options", name, known)
        names = (
            (parameters,) if isinstance(parameters, str) else parameters if parameters is None else tuple(parameters)
        )
        used = list(dict.fromkeys(name for candidate in candidates for name in candidate.module.used_parameters()))
        for name in names or ():
            checks.check_choice("parameters", name, used)
        for name in given.get("priors") or {}:
            checks.check_choice("priors", name, used)
        if folder is not None:
            key_of(candidates[0].module, "", given)
        return FitPlan(names, given, warm_start, folder)


def fit_chain(
    candidates: Sequence[Candidate],
    problem: Problem,
    plan: FitPlan,
    store: Store,
    on_row: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Fit and judge every candidate.

    Args:
        candidates: cheapest first.
        problem: what is fitted and judged.
        plan: how.
        store: where each finished row is looked for and kept at once.
        on_row: called with each finished row.
    Returns: a row each, in the order of the candidates. One that raises becomes a row with an `error`, and the rest go on.
    Raises: MissingExtraError; KeyboardInterrupt. The rows finished before have gone to `store` and `on_row`.
    """
    data = "" if store.folder is None else problem.fingerprint()
    arguments = problem.arguments()
    rows: list[Row] = []
    with remembered_interrupts() as check_interrupted:
        for candidate in candidates:
            try:
                row = _fitted(candidate, rows, problem, arguments, plan, store, data)
            except checks.MissingExtraError:  # not the candidate's fault, and all others would say the same
                raise
            except Exception as error:
                check_interrupted()  # an interrupt in disguise is not the candidate's fault either
                row = failed(candidate.name, candidate.module, error)
            rows.append(row)
            on_row(row)
            check_interrupted()
    return rows


def neighbour(candidate: Candidate, rows: Sequence[Row]) -> Row | None:
    """The fitted row of the same technique that is nearest in counts; of equally near ones the cheapest."""
    fitted = [row for row in rows if row.error is None and type(row.module) is type(candidate.module)]
    return min(fitted, key=lambda row: (distance(candidate.module, row.module), row.cost), default=None)


def warm_started(module: AmbientVisibility, fitted: AmbientVisibility) -> AmbientVisibility:
    """A copy of `module` with the values of `fitted` of all parameters that both use, just inside their bounds."""
    warm = copy.deepcopy(module)
    values = fitted.values()
    for name in module.used_parameters():
        if name in fitted.used_parameters():
            spec, value = module.PARAMETERS[name], values[name]
            if not spec.relative_bounds:
                value = min(max(value, spec.low * math.exp(MARGIN)), spec.high * math.exp(-MARGIN))
            setattr(warm, name, value)
    return warm


def _fitted(
    candidate: Candidate,
    rows: Sequence[Row],
    problem: Problem,
    arguments: Mapping[str, Any],
    plan: FitPlan,
    store: Store,
    data: str,
) -> Row:
    """The candidate's row, from the store or made now."""
    near = neighbour(candidate, rows) if plan.warm_start else None
    start = candidate.module if near is None else warm_started(candidate.module, near.module)
    options = _options(candidate.module, plan)
    key = "" if store.folder is None else key_of(start, data, {**options, "own": _own(candidate, near)})
    kept = store.get(key, candidate.name, candidate.module)
    if kept is not None:
        return kept
    result = fit(start, **arguments, **options, scan=near is None, progress=False)
    row = _judged(candidate, result, problem, None if near is None else near.name)
    store.put(key, row)
    return row


def _own(candidate: Candidate, near: Row | None) -> list[Any]:
    """What decides about the scan."""
    return [candidate.name, None if near is None else near.name]


def _judged(candidate: Candidate, result: FitResult, problem: Problem, warm_start: str | None) -> Row:
    validation, training = problem.errors(result.module)
    return Row(
        name=candidate.name,
        module=result.module,
        validation_rmse=rmse(validation),
        training_rmse=rmse(training),
        views=validation,
        values=result.values,
        standard_errors=result.standard_errors,
        undetermined=result.undetermined,
        evaluations=result.evaluations,
        seconds=result.seconds,
        message=result.message,
        warm_start=warm_start,
    )


def _options(module: AmbientVisibility, plan: FitPlan) -> dict[str, Any]:
    """Arguments of `fit` for one module: parameters and priors of those it uses."""
    used = module.used_parameters()
    options = dict(plan.options)
    if plan.parameters is not None:
        names = tuple(name for name in used if name in plan.parameters)
        if not names:
            raise checks.ChoiceError(
                f"parameters must name one of {', '.join(used)}, got {', '.join(plan.parameters)}: add one"
            )
        options["parameters"] = names
    if options.get("priors"):
        fitted = options.get("parameters") or module.learnable or used
        options["priors"] = {name: prior for name, prior in options["priors"].items() if name in fitted}
    return options
