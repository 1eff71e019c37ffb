"""Thickness of the ray march against ray-traced references of the built-in scenes: `python -m benchmarks.default_thickness`.

Where the default comes from. Views 0 and 1 of every scene, at the scene's own radius, with the module's default rays and steps
and with many. Falloff 1 is judged by the linear reference, falloff 8 by the binary one. One depth layer, exact normals. Rows go to
benchmarks/results/default_thickness.json; a row's `rmse` and `bias` (prediction minus reference) are of one scene.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parent / "results" / "default_thickness.json"
THICKNESSES = (0.25, 0.4, 0.5, 0.6, 0.8, None)
FALLOFFS = {1.0: "linear", 8.0: "binary"}
TAPS: dict[str, dict[str, int]] = {"default": {}, "many": {"rays": 64, "steps": 32}}
VIEWS = (0, 1)
HEIGHT, WIDTH, SAMPLES = 90, 120, 256


def scene_rows(name: str) -> list[dict[str, Any]]:
    """Every thickness, falloff and number of taps on one scene."""
    scene = ts.scenes.builtin(name)
    gb = ts.scenes.render(scene, views=VIEWS, height=HEIGHT, width=WIDTH)
    rows = []
    for falloff, reference in FALLOFFS.items():
        traced = ts.reference.raytrace(
            scene, views=VIEWS, height=HEIGHT, width=WIDTH, falloff=reference, samples=SAMPLES, threads=1
        )
        for taps, counts in TAPS.items():
            for thickness in THICKNESSES:
                net = ts.RayMarchedSSAO(scene.radius, falloff=falloff, thickness=thickness, **counts)
                with torch.no_grad():
                    off = (net(gb) - traced.visibility)[gb.valid_mask]
                figures = {"rmse": round(float(off.square().mean().sqrt()), 5), "bias": round(float(off.mean()), 5)}
                rows.append({"scene": name, "falloff": falloff, "taps": taps, "thickness": thickness} | figures)
    return rows


def summary(rows: list[dict[str, Any]]) -> str:
    """Root of the mean squared error over the scenes, and mean bias, by falloff, taps and thickness."""
    lines = ["| falloff, reference | taps | " + " | ".join(f"{t} R" if t else "infinite" for t in THICKNESSES) + " |"]
    lines.append("|---" * (len(THICKNESSES) + 2) + "|")
    for falloff, reference in FALLOFFS.items():
        for taps in TAPS:
            cells = []
            for thickness in THICKNESSES:
                wanted = (falloff, taps, thickness)
                mine = [row for row in rows if (row["falloff"], row["taps"], row["thickness"]) == wanted]
                rmse = math.sqrt(sum(row["rmse"] ** 2 for row in mine) / len(mine))
                cells.append(f"{rmse:.4f} ({sum(row['bias'] for row in mine) / len(mine):+.4f})")
            lines.append(f"| {falloff:g}, {reference} | {taps} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for name in ts.scenes.names():
        rows += scene_rows(name)
        print(name, flush=True)
    record = {"environment": environment(), "size": [HEIGHT, WIDTH], "views": VIEWS, "samples": SAMPLES, "rows": rows}
    RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(summary(rows))


if __name__ == "__main__":
    main()
