"""The table over scenes and models, as docs/hbao.md has it."""

from __future__ import annotations

import math
from typing import Any

Rows = list[dict[str, Any]]
PEER = "XeGTAO High, tuned"


def summarise(rows: Rows, times: dict[str, float]) -> str:
    """PSNR by scene; over all scenes RMSE and PSNR of the pooled squared error, its gain over the tuned peer, SSIM, time.

    Args:
        rows: of one sample count.
        times: milliseconds by model.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    order = [*times, *(row["model"] for row in rows)]
    models = [model for model in dict.fromkeys(order) if any(row["model"] == model for row in rows)]
    found = {(row["scene"], row["model"]): row for row in rows}
    common = [scene for scene in scenes if all((scene, model) in found for model in models)]
    left = (
        f" (left out of the pool, for want of rows: {', '.join(set(scenes) - set(common))})" if common != scenes else ""
    )
    peer = _pooled([found[scene, PEER] for scene in common]) if PEER in models and common else math.nan
    heads = ["model", "taps", *(scene.replace("_", " ") for scene in scenes), "RMSE", "PSNR", "over peer", "SSIM", "ms"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for model in models:
        mine = [found[scene, model] for scene in common]
        psnr = _pooled(mine) if mine else math.nan
        cells = [f"{found[s, model]['psnr']:.2f}" if (s, model) in found else "-" for s in scenes]
        tail = [f"{10 ** (-psnr / 20):.4f}", f"{psnr:.2f}", f"{psnr - peer:+.2f}", f"{_mean(mine, 'ssim'):.4f}"]
        taps = next((str(row["taps"]) for row in mine if row.get("taps")), "-")
        time = f"{times[model]:.0f}" if model in times else "-"
        lines.append("| " + " | ".join([model, taps, *cells, *tail, time]) + " |")
    return "\n".join(lines) + left


def _pooled(rows: Rows) -> float:
    """PSNR of the mean squared error over all judged pixels of all scenes."""
    error = sum(row["mse"] * row["pixels"] for row in rows) / sum(row["pixels"] for row in rows)
    return -10 * math.log10(error)


def _mean(rows: Rows, key: str) -> float:
    values = [row[key] for row in rows if key in row]
    return sum(values) / len(values) if values else math.nan
