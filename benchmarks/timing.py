"""Interleaved timings: works take turns, so that a machine that slows down slows all of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch


def interleaved(works: Mapping[str, Callable[[], Any]], repeats: int, *, warm_up: int = 1) -> dict[str, dict[str, Any]]:
    """Milliseconds of each work.

    Args:
        works: what to time, by name.
        repeats: timed rounds; in each, every work runs once.
        warm_up: rounds before that count for nothing.
    Returns: for each name `median_ms`, `min_ms`, `max_ms` and `repeats`.
    """
    taken: dict[str, list[float]] = {name: [] for name in works}
    for count in range(warm_up + repeats):
        for name, work in works.items():
            _wait()
            start = time.perf_counter()
            work()
            _wait()
            if count >= warm_up:
                taken[name].append(1e3 * (time.perf_counter() - start))
    return {name: spread(times) for name, times in taken.items()}


def spread(times: list[float]) -> dict[str, Any]:
    """Median and range of milliseconds."""
    return {
        "median_ms": round(statistics.median(times), 4),
        "min_ms": round(min(times), 4),
        "max_ms": round(max(times), 4),
        "repeats": len(times),
    }


def shown(timing: Mapping[str, Any]) -> str:
    """Median and range as text for tables."""
    return f"{timing['median_ms']:.1f} [{timing['min_ms']:.1f}, {timing['max_ms']:.1f}]"


def _wait() -> None:
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
