"""The optimistix bridge: it minimises, hands exceptions through, restores jax, and is loaded only when used."""

from __future__ import annotations

import subprocess
import sys

import jax
import numpy as np
import pytest
from numpy.typing import NDArray

from torch_ssao.fitting import bridge

Array = NDArray[np.float64]
START = np.array([-1.2, 1.0])


def _rosenbrock(u: Array) -> tuple[Array, Array]:
    residual = np.array([10 * (u[1] - u[0] ** 2), 1 - u[0], 0.0])
    return residual, np.array([[-20 * u[0], 10.0], [-1.0, 0.0], [0.0, 0.0]])


def test_minimises_rosenbrock_in_float64() -> None:
    visited: list[Array] = []

    def evaluate(u: Array) -> tuple[Array, Array]:
        visited.append(u)
        return _rosenbrock(u)

    assert bridge.levenberg_marquardt(evaluate, START)
    assert min(np.abs(u - 1).max() for u in visited) < 1e-9
    assert len({u.tobytes() for u in visited}) == len(visited)  # one visit a step, none repeated


def test_jacobian_of_a_rejected_step_is_never_used() -> None:
    paths: list[list[Array]] = []
    for spoil in (False, True):
        least, visited = np.inf, []

        def evaluate(u: Array, spoil: bool = spoil, visited: list[Array] = visited) -> tuple[Array, Array]:
            nonlocal least
            residual, jacobian = _rosenbrock(u)
            visited.append(u)
            if residual @ residual >= least and spoil:
                return residual, np.zeros_like(jacobian)
            least = min(least, residual @ residual)
            return residual, jacobian

        bridge.levenberg_marquardt(evaluate, START)
        paths.append(visited)
    np.testing.assert_array_equal(paths[0], paths[1])


def test_exception_comes_out_as_itself_and_jax_is_restored() -> None:
    before = jax.config.jax_enable_x64

    def evaluate(u: Array) -> tuple[Array, Array]:
        raise KeyError("from the evaluation")

    with pytest.raises(KeyError, match="from the evaluation"):
        bridge.levenberg_marquardt(evaluate, START)
    assert jax.config.jax_enable_x64 == before
    assert bridge.levenberg_marquardt(_rosenbrock, START)  # and the next solve works
    assert jax.config.jax_enable_x64 == before


def test_stop_ends_the_solve_quietly() -> None:
    def evaluate(u: Array) -> tuple[Array, Array]:
        raise bridge.StopSolver

    assert not bridge.levenberg_marquardt(evaluate, START)


def test_importing_fitting_loads_no_jax() -> None:
    code = "import sys, torch_ssao.fitting; sys.exit(any(m in sys.modules for m in ('jax', 'optimistix', 'tqdm.auto')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
