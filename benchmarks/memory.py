"""Peak memory of HBAO and the ray march, forward and backward, at 1920 x 1080: `python -m benchmarks.memory`.

Every row runs in its own process. `rss_bytes_per_pixel` is the growth of the peak resident set over the pass (G-buffer, module
and cotangent in place, a small pass done) less the image and the gradients of depth and normals (20 bytes a pixel).
`tensor_bytes_per_pixel` (with --tensors, for as long again) is the same of what torch's CPU allocator hands out. The bound is
20 times the 16 bytes a pixel of the G-buffer. Rows go to benchmarks/results/memory.json, beside earlier ones. Linux only.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

import torch_ssao as ts
from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parent / "results" / "memory.json"
BOUND = 20 * 16  # bytes a pixel: depth and normal in float32 are 16
ROWS: dict[
    str, tuple[int, Callable[[], ts.modules.AmbientVisibility]]
] = {  # taps a pixel, both sides of a slice counted
    "HBAO bitmask 4x8": (64, lambda: ts.HBAO(0.5, slices=4, steps=8, learnable="all")),
    "HBAO bitmask 8x16": (256, lambda: ts.HBAO(0.5, slices=8, steps=16, learnable="all")),
    "HBAO increments 4x8": (64, lambda: ts.HBAO(0.5, slices=4, steps=8, estimator="increments", learnable="all")),
    "HBAO increments 8x16": (256, lambda: ts.HBAO(0.5, slices=8, steps=16, estimator="increments", learnable="all")),
    "RayMarchedSSAO exact 8x8": (64, lambda: ts.RayMarchedSSAO(0.5, rays=8, steps=8, learnable="all")),
    "RayMarchedSSAO exact 16x16": (256, lambda: ts.RayMarchedSSAO(0.5, rays=16, steps=16, learnable="all")),
    "RayMarchedSSAO surrogate 8x8": (
        64,
        lambda: ts.RayMarchedSSAO(0.5, rays=8, steps=8, gradient="surrogate", learnable="all"),
    ),
    "RayMarchedSSAO surrogate 16x16": (
        256,
        lambda: ts.RayMarchedSSAO(0.5, rays=16, steps=16, gradient="surrogate", learnable="all"),
    ),
}


def pass_of(name: str, height: int, width: int) -> Callable[[], Any]:
    """One forward and backward pass to depth, normals and every parameter of a bumpy surface with a block before it."""
    v, u = torch.linspace(-1, 1, height)[:, None], torch.linspace(-1.3, 1.3, width)
    depth = 4 + 0.25 * torch.sin(5 * u) * torch.cos(4 * v)
    depth = torch.where((u > 0.1) & (u < 0.7) & (v.abs() < 0.45), 3.0, depth)
    gb = ts.GBuffer.from_depth(depth, ts.Camera.perspective(50.0, height, width))
    moving = [tensor.clone().requires_grad_() for tensor in (gb.depth, gb.normal)]
    net = ROWS[name][1]()
    cotangent = torch.randn(gb.depth.shape, generator=torch.Generator().manual_seed(0))

    def run() -> Any:
        image = net(ts.GBuffer(moving[0], gb.camera, normal=moving[1]))
        return image, torch.autograd.grad(image, [*moving, *net.parameters()], cotangent, allow_unused=True)

    return run


def measure(name: str, height: int, width: int, *, tensors: bool) -> dict[str, Any]:
    """One row, in this process: the peak resident set knows no way back, so a process measures one row only."""
    torch.set_num_threads(1)
    pass_of(name, 24, 32)()  # libraries, pools
    run, pixels = pass_of(name, height, width), height * width
    kept = 4 * (1 + 1 + 3) * pixels
    if tensors:
        with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
            run()
        events = [e for e in record.profiler.kineto_results.events() if e.name() == "[memory]"]
        sizes = torch.tensor([e.nbytes() for e in sorted(events, key=lambda e: e.start_ns())], dtype=torch.int64)
        return {"tensor_bytes_per_pixel": round((int(sizes.cumsum(0).max()) - kept) / pixels, 1)}
    before, start = _resident(), time.perf_counter()
    run()
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "rss_bytes_per_pixel": round((peak - before - kept) / pixels, 1),
        "seconds": round(time.perf_counter() - start, 1),
    }


def in_process(name: str, height: int, width: int, *, tensors: bool) -> dict[str, Any]:
    """One row, each figure from a process of its own."""
    row: dict[str, Any] = {"name": name, "taps": ROWS[name][0]}
    for kind in ("rss", "tensors") if tensors else ("rss",):
        command = [sys.executable, "-m", "benchmarks.memory", "--measure", kind, "--rows", name]
        done = subprocess.run(
            [*command, "--size", f"{width}x{height}"],
            capture_output=True,
            text=True,
            check=True,
            cwd=Path(__file__).parents[1],
        )
        row |= json.loads(done.stdout.splitlines()[-1])
    return row


def _resident() -> int:
    """Bytes of this process in memory now."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * resource.getpagesize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--tensors", action="store_true", help="count tensors too")
    parser.add_argument("--measure", choices=("rss", "tensors"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    width, height = (int(part) for part in arguments.size.split("x"))
    if arguments.measure:
        print(json.dumps(measure(arguments.rows[0], height, width, tensors=arguments.measure == "tensors")))
        return
    for name in arguments.rows:
        row = in_process(name, height, width, tensors=arguments.tensors)
        print(row, flush=True)
        if (height, width) == (1080, 1920):
            save(row)


def save(row: dict[str, Any]) -> None:
    """Put a row in its place."""
    kept = json.loads(RESULTS.read_text(encoding="utf-8"))["rows"] if RESULTS.exists() else []
    named = {row["name"]: row for row in [*kept, row]}
    rows = [named[name] for name in ROWS if name in named]
    record = {"environment": environment(), "size": [1080, 1920], "bound": BOUND, "rows": rows}
    RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
