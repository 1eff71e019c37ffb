"""The StatVO oracle on one image, with defaults that make answers easy to work out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from oracles.statvo import statvo_visibility

Floats = npt.NDArray[np.float64]
EPS = float(np.finfo(np.float64).eps)


def run(depth: Any, valid: Any = None, normal: Any = None, camera: Any = (1, 1, 0, 0), **options: Any) -> Floats:
    """Visibility (H, W) of one image given as (L, H, W) or (H, W); unit-scale orthographic camera unless told."""
    layered = np.asarray(depth, dtype=np.float64).reshape((-1, *np.shape(depth)[-2:]))
    mask = np.ones(layered.shape, dtype=bool) if valid is None else np.broadcast_to(valid, layered.shape)
    n = None if normal is None else np.asarray(normal, dtype=np.float64)[None]
    defaults: dict[str, Any] = {"radius": 1.5, "height": 1.0, "slope": 1.0, "contrast": 1.0, "layers": 1, "eps": EPS}
    orthographic = options.pop("orthographic", True)
    fx, fy, cx, cy = camera
    batched = layered[None], mask[None], n
    images = statvo_visibility(*batched, fx, fy, cx, cy, orthographic, **(defaults | options))
    return np.asarray(images[0], dtype=np.float64)


def constant_normal(vector: tuple[float, float, float], height: int, width: int) -> Floats:
    unit = np.array(vector) / np.linalg.norm(vector)
    return np.broadcast_to(unit[:, None, None], (3, height, width)).copy()


def psi_by_table(s: float, slope: float) -> float:
    return float(np.interp(s, [0.0, 1.0, 1.0 + 1.0 / slope], [0.0, 1.0, 0.0]))
