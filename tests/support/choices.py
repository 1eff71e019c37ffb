"""For tests of select and sweep: a smooth scene, a timer without a clock, a fit that takes no time."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao import metrics
from torch_ssao.fitting import FitResult
from torch_ssao.fitting.candidates import estimated_cost
from torch_ssao.fitting.fit import fit
from torch_ssao.fitting.timing import Timing
from torch_ssao.modules import AmbientVisibility


def bumps(height: int = 36, width: int = 48, *, views: int = 4) -> ts.GBuffer:
    """A gently waved surface without a depth discontinuity, other waves in each view."""
    camera = ts.Camera.perspective(50.0, height, width)
    v = torch.linspace(-1, 1, height, dtype=torch.float64)[:, None]
    u = torch.linspace(-1.3, 1.3, width, dtype=torch.float64)
    depth = [
        4
        + 0.25 * torch.sin(5 * u + 1.3 * k) * torch.cos(4 * v + 0.9 * k)
        + 0.15 * torch.sin(3 * (u * (0.5 + 0.2 * k) + v))
        for k in range(views)
    ]
    return ts.GBuffer.from_depth(torch.stack(depth).float(), camera)


def dense_rays(gbuffer: ts.GBuffer, radius: float = 0.5) -> torch.Tensor:
    """The answer for a heightfield without hidden surfaces: many rays of many steps, binary hits, infinite thickness."""
    return ts.RayMarchedSSAO(radius, rays=64, steps=24, thickness=None, falloff=30.0)(gbuffer).detach()


def price_list(modules: Sequence[AmbientVisibility], gbuffer: ts.GBuffer) -> list[Timing]:
    """The estimated cost as milliseconds: a timer that always says the same."""
    return [Timing(cost, 0.9 * cost, 1.1 * cost, 5) for cost in map(estimated_cost, modules)]


@functools.wraps(fit)
def quick_fit(module: Any, gbuffer: Any, target: Any, **options: Any) -> FitResult:
    """The better of two contrasts on the first scene, with made-up uncertainties."""
    many = not isinstance(gbuffer, ts.GBuffer)
    views, image = (gbuffer[0], target[0]) if many else (gbuffer, target)
    image = getattr(image, "visibility", image)
    tried = []
    for factor in (1.0, 1.5):
        other = copy.deepcopy(module)
        other.contrast = float(module.contrast.detach()) * factor
        with torch.no_grad():
            tried.append((float(metrics.rmse(other(views), image, views.valid_mask[:, :1])), other))
    error, best = min(tried, key=lambda pair: pair[0])
    names = options.get("parameters") or best.used_parameters()
    return FitResult(
        module=best,
        modules=(best,),
        values=best.values(),
        names=names,
        standard_errors={name: float("inf") if name == "falloff" else 0.01 for name in names},
        correlation=None,
        undetermined=("falloff",) if "falloff" in names else (),
        rmse=error,
        initial_rmse=tried[0][0],
        loss=error**2,
        initial_loss=tried[0][0] ** 2,
        steps=1,
        starts=1,
        evaluations=2,
        message="two contrasts tried",
        seconds=0.0,
    )
