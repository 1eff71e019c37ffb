"""Tables over scenes and models."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

Rows = list[dict[str, Any]]


def summarise(rows: Rows) -> str:
    """PSNR by scene, then over all scenes: PSNR of the pooled squared error, SSIM, milliseconds, gain over the tuned peer."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    models = list(dict.fromkeys(row["model"] for row in rows))
    found = {(row["scene"], row["model"]): row for row in rows}
    pooled = {model: _pooled([found[s, model] for s in scenes if (s, model) in found]) for model in models}
    peer = pooled.get("XeGTAO High, tuned", math.nan)
    lines = [f"{'PSNR':32}" + "".join(f"{s[:9]:>10}" for s in scenes) + "    pooled  over peer   SSIM    ms"]
    for model in models:
        mine = [found[s, model] for s in scenes if (s, model) in found]
        cells = "".join(f"{found[s, model]['psnr']:10.2f}" if (s, model) in found else f"{'-':>10}" for s in scenes)
        tail = (
            f"{pooled[model]:10.2f} {pooled[model] - peer:+10.2f} {_mean(mine, 'ssim'):6.4f} {_mean(mine, 'ms'):6.0f}"
        )
        lines.append(f"{model:32}{cells}{tail}")
    return "\n".join(lines)


def _pooled(rows: Rows) -> float:
    """PSNR of the mean squared error over all judged pixels of all scenes, every view alike; NaN without them."""
    if not rows or any("mse" not in row for row in rows):
        return math.nan
    total: Callable[[str], float] = lambda key: sum(row[key] for row in rows)  # noqa: E731
    error = sum(row["mse"] * row["pixels"] for row in rows) / total("pixels")
    return -10 * math.log10(error)


def _mean(rows: Rows, key: str) -> float:
    values = [row[key] for row in rows if key in row]
    return sum(values) / len(values) if values else math.nan
