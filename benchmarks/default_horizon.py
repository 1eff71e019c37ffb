"""HBAO's counts and forms, unfitted, against ray-traced references of the built-in scenes: `python -m benchmarks.default_horizon`.

Where the default comes from. Views 0 and 1 of every scene at the scene's own radius, binary references, one denoising pass, every
other parameter at its default. Times are medians over the views, taken in turns. Rows go to
benchmarks/results/default_horizon.json; a row's `rmse` and `bias` (prediction minus reference) are of one scene.
"""

from __future__ import annotations

import json
import math
import statistics
import time
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parent / "results" / "default_horizon.json"
FORMS: dict[str, dict[str, Any]] = {
    "bitmask 3x3": {"slices": 3, "steps": 3, "connected": False},
    "bitmask 3x3, connected": {"slices": 3, "steps": 3},
    "bitmask 2x8": {"slices": 2, "steps": 8, "connected": False},
    "bitmask 2x8, connected": {"slices": 2, "steps": 8},
    "bitmask 4x4, connected": {"slices": 4, "steps": 4},
    "bitmask 3x6": {"slices": 3, "steps": 6, "connected": False},
    "bitmask 3x6, connected": {"slices": 3, "steps": 6},
    "bitmask 4x8": {"slices": 4, "steps": 8, "connected": False},
    "bitmask 4x8, connected": {"slices": 4, "steps": 8},
    "increments 3x6": {"slices": 3, "steps": 6, "estimator": "increments"},
    "increments 4x8": {"slices": 4, "steps": 8, "estimator": "increments"},
    "increments 6x10": {"slices": 6, "steps": 10, "estimator": "increments"},
}
VIEWS = (0, 1)
HEIGHT, WIDTH, SAMPLES = 180, 240, 256


def scene_rows(name: str) -> list[dict[str, Any]]:
    """Every form on one scene."""
    scene = ts.scenes.builtin(name)
    gb = ts.scenes.render(scene, views=VIEWS, height=HEIGHT, width=WIDTH)
    target = ts.reference.raytrace(scene, views=VIEWS, height=HEIGHT, width=WIDTH, samples=SAMPLES).visibility
    off: dict[str, list[torch.Tensor]] = {form: [] for form in FORMS}
    times: dict[str, list[float]] = {form: [] for form in FORMS}
    for view in range(len(gb)):
        for form, options in FORMS.items():
            net = ts.HBAO(scene.radius, denoise=1, **options)
            with torch.no_grad():
                start = time.perf_counter()
                image = net(gb[view])
                times[form].append(time.perf_counter() - start)
            off[form].append((image[0] - target[view])[gb.valid_mask[view, :1]])
    rows = []
    for form in FORMS:
        error = torch.cat(off[form])
        figures = {"rmse": round(float(error.square().mean().sqrt()), 5), "bias": round(float(error.mean()), 5)}
        rows.append({"scene": name, "form": form, **figures, "ms": round(1e3 * statistics.median(times[form]), 1)})
    return rows


def summary(rows: list[dict[str, Any]]) -> str:
    """Root of the mean squared error over the scenes, mean bias and time, by form."""
    lines = ["| form | RMSE | bias | ms |", "|---|---|---|---|"]
    for form in FORMS:
        mine = [row for row in rows if row["form"] == form]
        rmse = math.sqrt(sum(row["rmse"] ** 2 for row in mine) / len(mine))
        bias, ms = (sum(row[key] for row in mine) / len(mine) for key in ("bias", "ms"))
        lines.append(f"| {form} | {rmse:.4f} | {bias:+.4f} | {ms:.0f} |")
    return "\n".join(lines)


def main() -> None:
    torch.set_num_threads(1)
    rows = [row for name in ts.scenes.names() for row in scene_rows(name)]
    record = {"environment": environment(), "size": [HEIGHT, WIDTH], "views": VIEWS, "samples": SAMPLES, "rows": rows}
    RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(summary(rows))


if __name__ == "__main__":
    main()
