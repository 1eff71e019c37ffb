"""Fits against XeGTAO's 600-evaluation narrowing grid: `python -m benchmarks.fit_against_grid [FOLDER]`.

The grid is XeGTAO's auto-tuner: 10 x 10 points, 6 passes, each narrowing the range around the best point. With a FOLDER of meshes
(and a scenes.json of cameras and radii), on XeGTAO and its own two parameters, radius multiplier in [.9, 2] and falloff range in
[0, .95]; without, on StatVO in radius and contrast over factors 1/4 to 4, on the built-in scenes. Fitted on view 0, judged on the
others; `fit` with the same two parameters in at most 100 evaluations, and with all of them. Rows go to
benchmarks/results/fit_against_grid.json, beside earlier ones.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torch_ssao as ts
from benchmarks.peers.xegtao import XeGTAO
from torch_ssao.metrics import rmse
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report.environment import environment
from torch_ssao.report.truth import TraceSettings, trace_views
from torch_ssao.scenes.scene import Scene

PASSES, STEPS, KEEP = 6, 10, 0.6
RESULTS = Path(__file__).parent / "results" / "fit_against_grid.json"
CACHE = Path("out/fit_against_grid")


class Tuning(NamedTuple):
    """A module, two of its parameters with the ends of their ranges, whether the grid is logarithmic, and all it has to fit."""

    make: Callable[[float], AmbientVisibility]
    names: tuple[str, str]
    low: Callable[[float], tuple[float, float]]
    high: Callable[[float], tuple[float, float]]
    logarithmic: bool
    everything: tuple[str, ...]


def _statvo(layers: int) -> Tuning:
    return Tuning(
        lambda radius: ts.StatVO(radius, layers=layers),
        ("radius", "contrast"),
        lambda radius: (radius / 4, 1 / 4),
        lambda radius: (radius * 4, 4.0),
        True,
        ("radius", "height", "falloff", "contrast"),
    )


SHIPPED = 1.457  # the multiplier that XeGTAO's module holds: its radius is what varies here
XEGTAO = Tuning(
    XeGTAO,
    ("radius", "falloff_range"),
    lambda radius: (0.9 / SHIPPED * radius, 0.05 + 1e-6),  # of 0 the module's logarithm knows nothing
    lambda radius: (2.0 / SHIPPED * radius, 0.95),
    False,
    (
        "radius",
        "falloff_range",
        "distribution_power",
        "final_power",
    ),  # the fifth, thin_occluder, is shipped switched off
)


def narrowing_grid(
    tuning: Tuning, module: AmbientVisibility, radius: float, gbuffer: ts.GBuffer, target: Tensor
) -> dict[str, Any]:
    """Leave `module` at the best of 600 points; return what it took."""
    valid = gbuffer.valid_mask[:, :1]
    low, high = (torch.tensor(ends(radius), dtype=torch.float64) for ends in (tuning.low, tuning.high))
    if tuning.logarithmic:
        low, high = low.log(), high.log()
    best, at, start, count = float("inf"), (low + high) / 2, time.perf_counter(), 0

    def move(point: Tensor) -> None:
        values = (point.exp() if tuning.logarithmic else point).tolist()
        for name, value in zip(tuning.names, values, strict=True):
            setattr(module, name, value)

    for _ in range(PASSES):
        step = (high - low) / (STEPS - 1)
        for i in range(STEPS):
            for j in range(STEPS):
                point = low + step * torch.tensor([i, j])
                move(point)
                with torch.no_grad():
                    error = float(rmse(module(gbuffer), target, valid))
                count += 1
                if error < best:
                    best, at = error, point
        low, high = torch.lerp(low, at - step, KEEP), torch.lerp(high, at + step, KEEP)
        low = torch.maximum(low, torch.full_like(low, 1e-3)) if not tuning.logarithmic else low
    move(at)
    return {"rmse": best, "evaluations": count, "seconds": time.perf_counter() - start, "values": module.values()}


def compare(scene: Scene, tuning: Tuning, height: int, samples: int) -> dict[str, Any]:
    """Rows of the grid, of the fit of the same two parameters, and of all."""
    width = height * 4 // 3
    gbuffer = ts.scenes.render(scene, height=height, width=width)
    truth = trace_views(scene, range(len(scene.cameras)), TraceSettings(height, width, scene.radius, samples), CACHE)
    train, wanted = gbuffer[0], truth.visibility[:1]
    valid = truth.valid & gbuffer.valid_mask[:, :1]

    def judge(module: AmbientVisibility) -> float:
        with torch.no_grad():
            images = torch.cat([module(gbuffer[view]) for view in range(1, len(gbuffer))])
        return float(rmse(images, truth.visibility[1:], valid[1:]))

    tuned = tuning.make(scene.radius)
    row: dict[str, Any] = {"scene": scene.name, "technique": type(tuned).__name__}
    row["grid"] = narrowing_grid(tuning, tuned, scene.radius, train, wanted)
    row["grid"]["held_out"] = judge(tuned)
    for label, parameters, budget in (("two", tuning.names, 100), ("all", tuning.everything, None)):
        fit = ts.fitting.fit(
            tuning.make(scene.radius), train, wanted, parameters=parameters, max_evaluations=budget, progress=False
        )
        row[label] = {
            "rmse": fit.rmse,
            "evaluations": fit.evaluations,
            "seconds": fit.seconds,
            "held_out": judge(fit.module),
            "values": fit.values,
        }
    return row


def show(row: dict[str, Any]) -> None:
    grid, two, full = row["grid"], row["two"], row["all"]
    print(
        f"{row['scene']:16} {row['technique']:7} | {grid['rmse']:.5f} {two['rmse']:.5f} ({two['evaluations']}) "
        f"{two['rmse'] - grid['rmse']:+.5f} | {grid['held_out']:.5f} {two['held_out']:.5f} {full['held_out']:.5f} "
        f"({full['evaluations']}) {'worse' if full['held_out'] > grid['held_out'] else 'better'} | "
        f"{grid['seconds']:.1f} {two['seconds']:.1f} {full['seconds']:.1f} s",
        flush=True,
    )


def keep(rows: list[dict[str, Any]]) -> None:
    """Write rows in their place beside earlier ones."""
    kept = json.loads(RESULTS.read_text(encoding="utf-8"))["rows"] if RESULTS.exists() else []
    named = {(row["scene"], row["technique"]): row for row in [*kept, *rows]}
    RESULTS.write_text(
        json.dumps({"environment": environment(), "rows": list(named.values())}, indent=1) + "\n", encoding="utf-8"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--scenes", nargs="*")
    parser.add_argument("--height", type=int, default=120)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--layers", type=int, default=4)
    options = parser.parse_args()
    if options.folder is None:
        tuning, scenes = (
            _statvo(options.layers),
            [ts.scenes.builtin(name) for name in options.scenes or ts.scenes.names()],
        )
    else:
        known = json.loads((options.folder / "scenes.json").read_text(encoding="utf-8"))
        tuning = XEGTAO
        scenes = [
            ts.scenes.load(options.folder / known[name]["file"], cameras=options.folder / "scenes.json")
            for name in options.scenes or known
        ]
    print("scene             module  | RMSE grid, two (evaluations), difference | held out: grid, two, all | seconds")
    CACHE.mkdir(parents=True, exist_ok=True)
    for scene in scenes:
        row = compare(scene, tuning, options.height, options.samples)
        show(row)
        keep([row])


if __name__ == "__main__":
    main()
