"""Two-parameter and full fits against a 600-evaluation narrowing grid: `python -m benchmarks.fit_against_grid`.

The grid is XeGTAO's auto-tuner: 10 x 10 points, 6 passes, each narrowing the range around the best point, here logarithmic in
radius and contrast over factors 1/4 to 4 around the start. Fitted on view 0, judged on the others.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao.metrics import rmse
from torch_ssao.report.environment import environment

PASSES, STEPS, REACH, KEEP = 6, 10, 4.0, 0.6


def narrowing_grid(module: ts.StatVO, gbuffer: ts.GBuffer, target: torch.Tensor) -> dict[str, float]:
    """Leave `module` at the best of 600 points; return what it took."""
    valid = gbuffer.valid_mask[:, :1]
    low = torch.tensor([module.radius / REACH, module.contrast / REACH]).log()
    high = torch.tensor([module.radius * REACH, module.contrast * REACH]).log()
    best, at, start, count = float("inf"), (low + high) / 2, time.perf_counter(), 0
    for _ in range(PASSES):
        step = (high - low) / (STEPS - 1)
        for i in range(STEPS):
            for j in range(STEPS):
                point = low + step * torch.tensor([i, j])
                module.radius, module.contrast = point.exp().tolist()
                with torch.no_grad():
                    error = float(rmse(module(gbuffer), target, valid))
                count += 1
                if error < best:
                    best, at = error, point
        low, high = torch.lerp(low, at - step, KEEP), torch.lerp(high, at + step, KEEP)
    module.radius, module.contrast = at.exp().tolist()
    return {"rmse": best, "evaluations": count, "seconds": time.perf_counter() - start}


def compare(name: str, layers: int, options: argparse.Namespace) -> dict[str, Any]:
    scene = ts.scenes.builtin(name)
    size = {"height": options.height, "width": options.height * 4 // 3}
    gbuffer = ts.scenes.render(scene, **size)
    truth = ts.reference.raytrace(scene, **size, samples=options.samples, progress=False)
    held_out, valid = gbuffer[1:], truth.valid[1:] & gbuffer.valid_mask[1:, :1]

    def judge(module: ts.StatVO) -> float:
        with torch.no_grad():
            return float(rmse(module(held_out), truth.visibility[1:], valid))

    tuned = ts.StatVO(scene.radius, layers=layers)
    grid = narrowing_grid(tuned, gbuffer[0], truth.visibility[:1])
    row = {"scene": name, "layers": layers, "grid": grid | {"held_out": judge(tuned)}}
    for label, parameters in (("two", ("radius", "contrast")), ("all", None)):
        fit = ts.fitting.fit(
            ts.StatVO(scene.radius, layers=layers),
            gbuffer[0],
            truth.visibility[:1],
            parameters=parameters,
            progress=False,
        )
        row[label] = {
            "rmse": fit.rmse,
            "evaluations": fit.evaluations,
            "seconds": fit.seconds,
            "held_out": judge(fit.module),
            "values": fit.values,
        }
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--height", type=int, default=120)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--layers", type=int, nargs="+", default=[4])
    parser.add_argument("--out", type=Path, default=Path("out/bench/fit_against_grid.json"))
    options = parser.parse_args()
    rows = []
    print(
        "scene  layers | RMSE grid (600)  two (evaluations)  difference | held-out grid  two  all (evaluations)",
        flush=True,
    )
    for name in ts.scenes.names():
        for layers in options.layers:
            r = compare(name, layers, options)
            rows.append(r)
            g, t, a = r["grid"], r["two"], r["all"]
            print(
                f"{name:8} {layers} | {g['rmse']:.5f} {t['rmse']:.5f} ({t['evaluations']}) {t['rmse'] - g['rmse']:+.5f} | "
                f"{g['held_out']:.5f} {t['held_out']:.5f} {a['held_out']:.5f} ({a['evaluations']}) "
                f"{'worse' if a['held_out'] > g['held_out'] else 'better'} | "
                f"{g['seconds']:.1f} {t['seconds']:.1f} {a['seconds']:.1f} s",
                flush=True,
            )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"environment": environment(), "rows": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
