"""The bridge alone: optimistix's Levenberg-Marquardt on residuals made in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from torch_ssao.fitting import bridge


def rosenbrock(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    residual = np.array([10 * (u[1] - u[0] ** 2), 1 - u[0], 0.0])
    return residual, np.array([[-20 * u[0], 10.0], [-1.0, 0.0], [0.0, 0.0]])


@pytest.mark.parametrize("solver", bridge.SOLVERS)
def test_rosenbrock(solver: str) -> None:
    seen = []

    def evaluate(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen.append(u.copy())
        return rosenbrock(u)

    assert bridge.solve(solver, evaluate, np.array([-1.2, 1.0]))
    best = min(seen, key=lambda u: np.square(rosenbrock(u)[0]).sum())
    np.testing.assert_allclose(best, [1.0, 1.0], atol=1e-5)
    assert all(u.dtype == np.float64 for u in seen)
    assert len(seen) < 60


def test_stop_and_errors() -> None:
    def stop(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise bridge.StopSolver

    assert not bridge.solve("levenberg_marquardt", stop, np.zeros(2))

    def fail(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise KeyError("planted")

    with pytest.raises(KeyError, match="planted"):
        bridge.solve("levenberg_marquardt", fail, np.zeros(2))
    assert bridge.solve("levenberg_marquardt", rosenbrock, np.array([0.5, 0.5]))  # the next solve is not harmed
