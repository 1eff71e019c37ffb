"""How long a module takes: forward passes of one view, modules taking turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import torch

from torch_ssao import checks
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility

REPEATS = 7
"""Timed forward passes per module, after one that is not timed; at least 5, so that quartiles mean something."""


@final
@dataclass(frozen=True)
class Timing:
    """Milliseconds of one forward pass over one view without gradients: median and quartiles of `repeats`."""

    median_ms: float
    low_ms: float
    high_ms: float
    repeats: int


Timer = Callable[[Sequence[AmbientVisibility], GBuffer], Sequence[Timing]]
"""From modules and one view to a `Timing` of each; `time_forward` is one."""


def time_forward(modules: Sequence[AmbientVisibility], gbuffer: GBuffer, *, repeats: int = REPEATS) -> list[Timing]:
    """Milliseconds of one forward pass of each module without gradients.

    Args:
        modules: what to time. They take turns, so that a machine that slows down slows all of them.
        gbuffer: one view.
        repeats: timed passes a module, at least 5.
    Raises: RangeError for fewer than 5 repeats.
    """
    checks.check_count("repeats", repeats, 5)
    milliseconds: list[list[float]] = [[] for _ in modules]
    with torch.no_grad():
        for module in modules:
            module(gbuffer)  # the first pass allocates and, on a GPU, loads kernels
        for _ in range(repeats):
            for module, taken in zip(modules, milliseconds, strict=True):
                _wait(gbuffer)
                start = time.perf_counter()
                module(gbuffer)
                _wait(gbuffer)
                taken.append(1e3 * (time.perf_counter() - start))
    return [summary(taken) for taken in milliseconds]


def summary(taken: Sequence[float]) -> Timing:
    """Median and quartiles of milliseconds."""
    low, median, high = (
        torch.tensor(taken, dtype=torch.float64).quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)).tolist()
    )
    return Timing(median, low, high, len(taken))


def _wait(gbuffer: GBuffer) -> None:
    if gbuffer.depth.is_cuda:
        torch.cuda.synchronize(gbuffer.depth.device)
