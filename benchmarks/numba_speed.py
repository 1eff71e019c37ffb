"""The compiled CPU loops against the torch ops, forward and backward: `python -m benchmarks.numba_speed`.

Every row is checked before it is timed: the images agree to 1e-5 on 99 % of the pixels, and each gradient of a random cotangent
on those pixels to 1e-3 in relative L2, or it lies no further than torch's (and 1e-3) from that in float64: a tap that rounds the
other way at a larger or smaller footprint moves both. Else the run ends. Both backends take turns in one process, with as many
threads. `ratio` is of the medians. `first_call_s` is what compiling takes, in a process of its own with an empty cache. --memory
adds the growth of the peak resident set over one forward and backward pass (Linux), less the gradients, a process each. Rows go
to benchmarks/results/numba_speed.json with --save.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from benchmarks.timing import interleaved, shown
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parent / "results" / "numba_speed.json"
GBUFFER_BYTES = 16  # a pixel: depth and normal in float32
ROWS: dict[str, Callable[[], AmbientVisibility]] = {  # 64 taps a pixel each
    "HBAO bitmask, unconnected": lambda: ts.HBAO(0.5, slices=4, steps=8, connected=False, learnable="all"),
    "HBAO bitmask, connected": lambda: ts.HBAO(0.5, slices=4, steps=8, learnable="all"),
    "HBAO increments": lambda: ts.HBAO(0.5, slices=4, steps=8, estimator="increments", learnable="all"),
    "HBAO increments, uniform": lambda: ts.HBAO(
        0.5, slices=4, steps=8, estimator="increments", weighting="uniform", learnable="all"
    ),
    "RayMarchedSSAO exact": lambda: ts.RayMarchedSSAO(0.5, rays=8, steps=8, learnable="all"),
}


def bumpy(size: int) -> ts.GBuffer:
    """A bumpy surface with a block before it."""
    v, u = torch.linspace(-1, 1, size)[:, None], torch.linspace(-1.3, 1.3, size)
    depth = 4 + 0.25 * torch.sin(5 * u) * torch.cos(4 * v)
    depth = torch.where((u > 0.1) & (u < 0.7) & (v.abs() < 0.45), 3.0, depth)
    return ts.GBuffer.from_depth(depth, ts.Camera.perspective(50.0, size, size))


def gradients(net: AmbientVisibility, gb: ts.GBuffer, cotangent: Tensor, backend: str) -> list[Tensor]:
    """To depth, normals and every parameter."""
    moving = [tensor.clone().requires_grad_() for tensor in (gb.depth, gb.normal) if tensor is not None]
    image = net(ts.GBuffer(moving[0], gb.camera, normal=moving[1], valid=gb.valid), backend=backend)
    return list(torch.autograd.grad(image, [*moving, *net.parameters()], cotangent, materialize_grads=True))


def check(net: AmbientVisibility, gb: ts.GBuffer, cotangent: Tensor) -> dict[str, Any]:
    """How well the backends agree; raises where they do not."""
    with torch.no_grad():
        images = [net(gb, backend=backend) for backend in ("torch", "numba")]
    same = (images[0] - images[1]).abs() <= 1e-5
    share = float(same.double().mean())
    if share < 0.99:
        raise SystemExit(f"{net}: only {share:.2%} of the pixels agree")
    plain, compiled = (gradients(net, gb, cotangent * same, backend) for backend in ("torch", "numba"))
    exact = gradients(copy.deepcopy(net).double(), gb.to(torch.float64), (cotangent * same).double(), "numba")
    between, to_torch, to_numba = (
        [float((b - a).norm() / c.norm().clamp(min=1e-30)) for a, b, c in zip(one, two, exact, strict=True)]
        for one, two in ((plain, compiled), (exact, plain), (exact, compiled))
    )
    for apart, torch_error, numba_error in zip(between, to_torch, to_numba, strict=True):
        if apart > 1e-3 and numba_error > 1.1 * torch_error + 1e-3:
            raise SystemExit(f"{net}: a gradient is off by {apart:.1e}, and by {numba_error:.1e} from float64")
    worst = {"between": max(between), "torch_to_float64": max(to_torch), "numba_to_float64": max(to_numba)}
    return {"pixels_that_agree": share, "worst_gradient_error": worst}


def row_of(name: str, size: int, repeats: int) -> dict[str, Any]:
    net, gb = ROWS[name](), bumpy(size)
    cotangent = torch.randn(gb.depth.shape, generator=torch.Generator().manual_seed(0))
    row: dict[str, Any] = {"name": name, "size": size, "threads": torch.get_num_threads()} | check(net, gb, cotangent)

    def forward(backend: str) -> Tensor:
        with torch.no_grad():
            return net(gb, backend=backend)

    for kind, work in (("forward", forward), ("both", partial(gradients, net, gb, cotangent))):
        times = interleaved({backend: partial(work, backend) for backend in ("torch", "numba")}, repeats)
        ratio = times["torch"]["median_ms"] / times["numba"]["median_ms"]
        row[kind] = times | {"ratio": round(ratio, 2)}
    return row


def first_call(name: str) -> None:
    """Print the seconds that the first forward and backward passes take."""
    net, gb = ROWS[name](), bumpy(32)
    start = time.perf_counter()
    with torch.no_grad():
        net(gb, backend="numba")
    middle = time.perf_counter()
    gradients(net, gb, torch.ones_like(gb.depth), "numba")
    print(json.dumps({"forward": round(middle - start, 2), "backward": round(time.perf_counter() - middle, 2)}))


def peak(name: str, size: int, backend: str) -> None:
    """Print the bytes a pixel by which the peak resident set grows over a pass."""
    net = ROWS[name]()
    gradients(net, bumpy(32), torch.ones(1, 1, 32, 32), backend)
    gb = bumpy(size)
    cotangent = torch.ones_like(gb.depth)
    Path("/proc/self/clear_refs").write_text(
        "5", encoding="utf-8"
    )  # the peak starts anew: loading compiled code has one too
    before = resident()
    kept = gradients(net, gb, cotangent, backend)
    grown = resident(at_most=True) - before - sum(4 * tensor.numel() for tensor in kept)
    print(json.dumps(round(grown / gb.depth.numel(), 1)))


def resident(*, at_most: bool = False) -> int:
    """Bytes of this process in memory, now or at most so far."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return 1024 * int(status.split("VmHWM:" if at_most else "VmRSS:")[1].split()[0])


def elsewhere(*arguments: str, fresh: bool = False) -> Any:
    """What this script prints in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.numba_speed", *arguments],
            env=os.environ | ({"NUMBA_CACHE_DIR": folder} if fresh else {}),
            cwd=Path(__file__).parents[1],
            check=True,
            capture_output=True,
            text=True,
        )
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--memory", action="store_true", help="peak memory too")
    parser.add_argument("--no-compile", action="store_true", help="leave out the time of the first call")
    parser.add_argument("--save", action="store_true")
    parser.add_argument("--one", nargs=2, metavar=("KIND", "BACKEND"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        kind, backend = arguments.one
        first_call(arguments.rows[0]) if kind == "first" else peak(arguments.rows[0], arguments.size, backend)
        return
    rows = []
    for name in arguments.rows:
        row = row_of(name, arguments.size, arguments.repeats)
        own = ("--rows", name, "--size", str(arguments.size), "--one")
        if not arguments.no_compile:
            row["first_call_s"] = elsewhere(*own, "first", "numba", fresh=True)
        if arguments.memory:
            row["peak_bytes_per_pixel"] = {b: elsewhere(*own, "peak", b) for b in ("torch", "numba")}
        for kind in ("forward", "both"):
            times = row[kind]
            print(
                f"{name}, {kind}: torch {shown(times['torch'])} ms, numba {shown(times['numba'])} ms, {times['ratio']} x"
            )
        print("  ", {key: row[key] for key in row if key not in ("name", "forward", "both")}, flush=True)
        rows.append(row)
    if arguments.save:
        record = {"environment": environment(), "gbuffer_bytes_per_pixel": GBUFFER_BYTES, "rows": rows}
        RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
