"""Half resolution beside full: error against a ray-traced reference, and milliseconds: `python -m benchmarks.half_resolution`.

Default values, 480x360, all views of three built-in scenes, 512 rays a pixel; times are medians of turns on the first view.
Rows go to benchmarks/results/half_resolution.json.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao.fitting.timing import time_forward
from torch_ssao.report.environment import environment
from torch_ssao.report.truth import TraceSettings, trace_views

RESULTS = Path(__file__).parent / "results" / "half_resolution.json"
CACHE = Path("out/half_resolution")
SCENES = ("temple", "street", "heap")
MODELS: dict[str, Any] = {
    "StatVO, 4 layers": lambda radius, half: ts.StatVO(radius, half_resolution=half),
    "HBAO 3x6": lambda radius, half: ts.HBAO(radius, half_resolution=half),
    "HBAO 3x6, one pass": lambda radius, half: ts.HBAO(radius, denoise=1, half_resolution=half),
    "ray march 16x8": lambda radius, half: ts.RayMarchedSSAO(radius, half_resolution=half),
    "ray march 16x8, one pass": lambda radius, half: ts.RayMarchedSSAO(radius, denoise=1, half_resolution=half),
}


def rows_of(name: str, height: int = 360, width: int = 480, samples: int = 512) -> list[dict[str, Any]]:
    """A row a model: RMSE at full and half resolution, RMSE between the two, times."""
    scene = ts.scenes.builtin(name)
    gbuffer = ts.scenes.render(scene, height=height, width=width)
    settings = TraceSettings(height, width, scene.radius, samples)
    truth = trace_views(scene, range(len(scene.cameras)), settings, CACHE)
    valid = truth.valid & gbuffer.valid_mask[:, :1]
    modules = [make(scene.radius, half) for make in MODELS.values() for half in (False, True)]
    timings = time_forward(modules, gbuffer[0])
    with torch.no_grad():
        images = [torch.cat([net(gbuffer[view]) for view in range(len(gbuffer))]) for net in modules]
    rows = []
    for at, model in enumerate(MODELS):
        full, half = images[2 * at : 2 * at + 2]
        errors = [float(ts.metrics.rmse(image, truth.visibility, valid)) for image in (full, half)]
        ms = [timing.median_ms for timing in timings[2 * at : 2 * at + 2]]
        between = float(ts.metrics.rmse(half, full, valid))
        rows.append({"scene": name, "model": model, "rmse": errors, "between": between, "ms": ms})
    return rows


def main() -> None:
    torch.set_num_threads(1)
    CACHE.mkdir(parents=True, exist_ok=True)
    print("| scene | model | RMSE full | half | half to full | ms full | half | ratio |\n" + "|---" * 8 + "|")
    rows = []
    for name in SCENES:
        for row in rows_of(name):
            rows.append(row)
            (full, half), (slow, fast) = row["rmse"], row["ms"]
            print(
                f"| {name} | {row['model']} | {full:.4f} | {half:.4f} | {row['between']:.4f} | {slow:.0f} | {fast:.0f} | "
                f"{slow / fast:.1f} |",
                flush=True,
            )
    RESULTS.write_text(json.dumps({"environment": environment(), "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
