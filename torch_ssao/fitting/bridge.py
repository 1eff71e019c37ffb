"""The bridge to optimistix: its solvers in jax on residuals that torch evaluates. The one file with both.

jax is imported on first use, works on the CPU only and in float64. Importing this file loads neither jax nor optimistix.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_ssao.checks import MissingExtraError

Array = NDArray[np.float64]
Evaluate = Callable[[Array], tuple[Array, Array]]

SOLVERS = ("levenberg_marquardt", "dogleg", "bfgs")
MAX_STEPS = 256  # the budget of evaluations ends a solve long before
TOLERANCE = 1e-6  # in u and in the scaled residuals: far below what a fit can tell apart

_LOCK = threading.Lock()  # jax's float64 flag is global, and so is the evaluation that the compiled solver visits
_ACTIVE: list[_Visit] = []


class StopSolver(Exception):
    """Raised by an evaluation to end the solve early."""


def check_installed() -> None:
    """Raise `MissingExtraError` unless optimistix can be imported."""
    if importlib.util.find_spec("optimistix") is None:
        raise MissingExtraError("fit needs optimistix, which is not installed: run pip install torch_ssao[fitting]")


def solve(solver: str, evaluate: Evaluate, start: Array) -> bool:
    """Minimise |r(u)|^2 from `start`.

    Args:
        solver: one of `SOLVERS`; BFGS sees |r|^2 / 2 and its gradient J'r only.
        evaluate: u (P,) -> residuals (P + 1,) and Jacobian (P + 1, P), float64; what it raises ends the solve.
            Only the Jacobian at points that lower |r| is used.
        start: (P,) float64.
    Returns: whether the tolerances were met; False when `evaluate` raised `StopSolver` or the steps ran out. The caller keeps the
        best point that `evaluate` saw.
    Raises: whatever else `evaluate` raised, from here and not from inside jax.
    Cost: one visit to `evaluate` a step; a solver is compiled once (about a second) for each P.
    """
    with _LOCK, _float64_on_cpu():
        visit = _Visit(evaluate)
        _ACTIVE.append(visit)
        try:
            converged = bool(_compiled(solver, len(start))(start))
        finally:
            _ACTIVE.pop()
    if visit.error is not None and not isinstance(visit.error, StopSolver):
        raise visit.error
    return converged and visit.error is None


class _Visit:
    """One solve's evaluations; the first exception is kept, because jax would wrap it in one of its own."""

    def __init__(self, evaluate: Evaluate) -> None:
        self.evaluate = evaluate
        self.error: BaseException | None = None

    def __call__(self, u: Any) -> tuple[Array, Array]:
        u = np.array(u, dtype=np.float64)
        if self.error is None:
            try:
                residual, jacobian = self.evaluate(u)
                return np.asarray(residual, np.float64), np.asarray(jacobian, np.float64)
            except BaseException as error:  # KeyboardInterrupt too must leave jax in order
                self.error = error
        return np.full(len(u) + 1, np.nan), np.full((len(u) + 1, len(u)), np.nan)


@contextmanager
def _float64_on_cpu() -> Iterator[None]:
    """Import jax so that it leaves the GPU alone, and switch it to float64 while the context lasts."""
    if "jax" not in sys.modules:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax

    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)  # the context manager does not reach the callback's thread
    try:
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            yield
    finally:
        jax.config.update("jax_enable_x64", before)


@functools.cache
def _compiled(solver: str, size: int) -> Callable[[Array], Any]:
    """The compiled solve for `size` parameters."""
    import jax
    import jax.numpy as jnp
    import optimistix

    shapes = (jax.ShapeDtypeStruct((size + 1,), jnp.float64), jax.ShapeDtypeStruct((size + 1, size), jnp.float64))

    def visit(u: Any) -> Any:
        return jax.pure_callback(lambda at: _ACTIVE[-1](at), shapes, u)

    @jax.custom_jvp
    def residual(u: Any) -> Any:
        return visit(u)[0]

    @residual.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        value, jacobian = visit(*primals)
        return value, jacobian @ tangents[0]

    if solver == "bfgs":
        method: Any = optimistix.BFGS(rtol=TOLERANCE, atol=TOLERANCE)

        def minimise(start: Any) -> Any:
            def half_square(u: Any, _: Any) -> Any:
                return 0.5 * jnp.sum(residual(u) ** 2)

            return optimistix.minimise(half_square, method, start, max_steps=MAX_STEPS, throw=False)
    else:
        method = _least_squares_solver(solver, optimistix)

        def minimise(start: Any) -> Any:
            return optimistix.least_squares(lambda u, _: residual(u), method, start, max_steps=MAX_STEPS, throw=False)

    return jax.jit(lambda start: minimise(start).result == optimistix.RESULTS.successful)  # type: ignore[no-any-return]


def _least_squares_solver(solver: str, optimistix: Any) -> Any:
    """Accept every descent: a visit that does not lower |r| is then surely rejected, and its Jacobian is never needed.

    The damping falls tenfold after a step that did at least half of what was predicted (optimistix asks for 99 %, which labels that
    flip never let a step reach); the radius of the dogleg grows likewise.
    """
    import equinox

    if solver == "dogleg":
        plain, growth = optimistix.Dogleg(rtol=TOLERANCE, atol=TOLERANCE), 3.5
    else:
        plain, growth = optimistix.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE), 10.0
    search = optimistix.ClassicalTrustRegion(low_cutoff=0.0, high_cutoff=0.5, high_constant=growth)
    return equinox.tree_at(lambda s: s.search, plain, search)
