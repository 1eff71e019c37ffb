"""StatVO's time by layers, image size and radius: `make bench`, or `python -m benchmarks.statvo`.

The oracle tests run first: a time is never reported on a red gate. Times are medians with the interquartile range in brackets; the
ratios are of medians in this one run.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao.report.environment import environment

SIZES = ((512, 384), (1280, 720))
LAYERS = (1, 2, 4, 8)
FOOTPRINTS = (10, 200)  # half-size of the window in pixels


def gbuffer(width: int, height: int) -> ts.GBuffer:
    """A wavy surface with a block in front of it, about 4 units away."""
    v = torch.linspace(-1, 1, height)[:, None]
    u = torch.linspace(-1.3, 1.3, width)
    depth = 4 + 0.25 * torch.sin(9 * u) * torch.cos(7 * v)
    depth = torch.where((u > 0.1) & (u < 0.7) & (v.abs() < 0.45), torch.full_like(depth, 3.0), depth)
    return ts.GBuffer.from_depth(depth, ts.Camera.perspective(50.0, height, width))


def measure(work: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Median and quartiles in milliseconds after one warm-up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    low, median, high = statistics.quantiles(times, n=4)
    return {"median_ms": median, "q1_ms": low, "q3_ms": high, "repeats": repeats}


def row(width: int, height: int, layers: int, footprint: int, repeats: int) -> dict[str, Any]:
    gb = gbuffer(width, height)
    radius = footprint * 4.0 / float(gb.camera.fx)
    module = ts.StatVO(radius, layers=layers, learnable="all")
    cotangent = torch.randn(1, 1, height, width, generator=torch.Generator().manual_seed(0))

    def forward() -> torch.Tensor:
        with torch.no_grad():
            return module(gb)

    def both() -> None:
        depth = gb.depth.clone().requires_grad_()
        (module(ts.GBuffer(depth, gb.camera, normal=gb.normal)) * cotangent).sum().backward()

    what = {"width": width, "height": height, "layers": layers, "footprint_px": footprint}
    return what | {"forward": measure(forward, repeats), "forward_backward": measure(both, max(3, repeats // 2))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/bench/statvo.json"))
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    gate = [sys.executable, "-m", "pytest", "-q", "tests/ops", "-k", "oracle or sum or gradcheck"]
    if subprocess.run(gate, check=False).returncode:
        sys.exit("the correctness tests fail: no times")
    rows = [
        row(width, height, layers, footprint, options.repeats)
        for width, height in SIZES
        for layers in LAYERS
        for footprint in FOOTPRINTS
    ]
    print(f"{'size':>10} {'layers':>6} {'window':>6}  forward ms            forward + backward ms")
    for r in rows:
        shown = [
            f"{t['median_ms']:8.1f} [{t['q1_ms']:.1f}, {t['q3_ms']:.1f}]" for t in (r["forward"], r["forward_backward"])
        ]
        print(f"{r['width']}x{r['height']:<5} {r['layers']:>6} {r['footprint_px']:>6}  {shown[0]:<21} {shown[1]}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"environment": environment(), "rows": rows}, indent=2) + "\n", encoding="utf-8")
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
