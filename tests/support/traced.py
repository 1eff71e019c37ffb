"""Comparing ray-traced references with exact answers and with longer runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torch_ssao import reference, scenes
from torch_ssao.reference import Reference
from torch_ssao.scenes import Scene, View
from torch_ssao.scenes.analytic import AnalyticScene


@dataclass(frozen=True)
class Comparison:
    """How a reference's errors look beside the standard errors that it states."""

    pixels: int
    bias: float  # mean error
    bias_error: float  # standard error of that mean, from the pixels' own
    rms_error: float
    stated_error: float  # RMS of the stated standard errors
    monte_carlo_error: float  # RMS error of as many independent rays with binary hits
    share_within_3: float  # pixels within 3 of their own standard errors, floored at 1 / (samples + 1)

    def bias_in_errors(self) -> float:
        return abs(self.bias) / self.bias_error if self.bias_error else 1e9 * abs(self.bias)


def compare(truth: Tensor, result: Reference, known: Tensor | None = None) -> Comparison:
    """Set `result` against `truth` (B, 1, H, W) over its valid pixels that are `known`."""
    kept = result.valid if known is None else result.valid & known
    exact, stated = truth[kept].double(), result.standard_error[kept].double()
    error = result.visibility[kept].double() - exact
    count = len(error)
    return Comparison(
        count,
        float(error.mean()),
        float(stated.square().sum().sqrt()) / count,
        float(error.square().mean().sqrt()),
        float(stated.square().mean().sqrt()),
        float((exact * (1 - exact) / result.samples).mean().sqrt()),
        float((error.abs() <= 3 * stated.clamp_min(1 / (result.samples + 1))).double().mean()),
    )


def analytic_mesh(
    analytic: AnalyticScene, *, radius: float, view_angle_deg: float = 45.0, segments: int = 384, extent: float = 30.0
) -> Scene:
    """Triangles of an analytic scene, seen as its default camera sees it; infinite surfaces end `extent` spans away."""
    vertices, faces = analytic.mesh(extent * analytic.span, segments=segments)
    pose = analytic.camera(8, 8, view_angle_deg=view_angle_deg).world_to_view
    rotation, translation = pose[0, :3, :3].numpy(), pose[0, :3, 3].numpy()
    eye = -rotation.T @ translation
    view = View(tuple(eye), tuple(eye + rotation[2]), tuple(-rotation[1]), 50.0)
    return Scene(analytic.name, vertices, faces, (view,), radius)


def judge_analytic(
    analytic: AnalyticScene,
    *,
    radius: float,
    falloff: str = "binary",
    samples: int = 256,
    size: tuple[int, int] = (48, 64),
    seed: int = 1,
    view_angle_deg: float = 45.0,
) -> Comparison:
    """Trace an analytic scene and compare with its closed form, where the cut edge of the mesh is out of reach."""
    height, width = size
    extent = 30.0
    scene = analytic_mesh(analytic, radius=radius, view_angle_deg=view_angle_deg, extent=extent)
    gbuffer = scenes.render(scene, height=height, width=width, dtype=torch.float64)
    exact, known = analytic.exact(gbuffer, radius=radius, falloff=falloff)
    away = scenes.primary_hits(scene, 0, height, width).position - np.asarray(analytic.focus)
    inside = np.linalg.norm(away, axis=-1) < extent * analytic.span - radius
    result = reference.raytrace(scene, height=height, width=width, falloff=falloff, samples=samples, seed=seed)
    return compare(exact, result, known & torch.from_numpy(inside))
