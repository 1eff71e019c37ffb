"""A tiny scene and a fit that takes no time, for tests of report and cli."""

from __future__ import annotations

import copy
import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from torch_ssao import metrics, scenes
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility

SIZE = {"height": 36, "width": 48}
TINY = {**SIZE, "samples": 16, "layers": (1, 2), "repeats": 5, "progress": False}


def corner(name: str = "corner", views: int = 2) -> scenes.Scene:
    """Three faces of a cube of side 2 seen from inside; the last third of the pictures sees nothing."""
    vertices = np.array([[x, y, z] for x in (0, 2) for y in (0, 2) for z in (0, 2)], dtype=float)
    quads = [(0, 1, 5, 4), (0, 1, 3, 2), (0, 2, 6, 4)]  # y = 0, x = 0, z = 0
    faces = np.array([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])
    eyes = [(4.0, 2.5, 3.0), (3.0, 2.0, 4.0), (3.5, 3.5, 3.0), (2.5, 3.0, 3.5)]
    cameras = tuple(scenes.View(eye, (0.3, 0.7, 0.0), (0.0, 1.0, 0.0), 45.0) for eye in eyes[:views])
    return scenes.Scene(name, vertices, faces, cameras, 0.5)


def fake_fit(
    module: AmbientVisibility,
    gbuffer: GBuffer,
    target: Any,
    *,
    parameters: Any = None,
    weights: Any = None,
    valid: Any = None,
    max_evaluations: Any = None,
    scan: bool = True,
    progress: Any = None,
) -> Any:
    """The better of two radii, with made-up standard errors and one parameter that cannot be determined."""
    candidates = []
    for factor in (1.0, 0.7):
        candidate = copy.deepcopy(module)
        candidate.radius = float(module.radius) * factor
        error = float(metrics.rmse(candidate(gbuffer), target.visibility, valid))
        candidates.append((error, candidate))
    error, best = min(candidates, key=lambda pair: pair[0])
    names = parameters or best.used_parameters()
    return SimpleNamespace(
        module=best,
        values=best.values(),
        standard_errors={name: math.inf if name == "falloff" else 0.01 for name in names},
        undetermined=("falloff",) if "falloff" in names else (),
        rmse=error,
        initial_rmse=candidates[0][0],
        evaluations=2,
        seconds=0.0,
        message="two radii tried",
    )


def quick_fits(patch: Any) -> None:
    """Let `select` use `fake_fit`."""
    patch.setattr("torch_ssao.fitting.chain.fit", fake_fit)
