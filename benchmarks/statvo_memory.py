"""Peak memory of one StatVO pass, measured in a process of its own; `statvo_speed memory` calls it.

What counts is the resident set: /proc/self/clear_refs resets its high-water mark (VmHWM) just before the pass, so that what came
before does not hide it, and glibc is told to give every block over 256 KiB a mapping of its own, so that freed tensors leave the
resident set at once. torch's own allocator statistics exist for CUDA only; its profiler misses what numpy or a kernel allocates.
Linux only.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts

KNOWN_BYTES = 64 << 20  # allocated and measured first: a method that misses it reports nothing
TOLERANCE = 0.05


def peak_bytes(gbuffer: ts.GBuffer, radius: float, choices: dict[str, Any], mode: str) -> int:
    """Run one configuration in a child process, whose times mean nothing: every tensor costs it a new mapping.

    Args:
        gbuffer: one view.
        radius: scene units.
        choices: of `ts.StatVO`.
        mode: "forward" (without gradients) or "forward_backward" (to depth, normal and the module's parameters).
    Returns: what the pass takes at most beyond inputs, outputs and gradients.
    Raises: CalledProcessError when the child fails.
    """
    camera = gbuffer.camera
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "view.pt"
        matrix = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        tensors = {"depth": gbuffer.depth, "normal": gbuffer.normal, "valid": gbuffer.valid_mask, "matrix": matrix}
        torch.save(tensors, path)
        ask = {"path": str(path), "radius": radius, "choices": choices, "mode": mode}
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.statvo_memory", json.dumps(ask)],
            env=os.environ | {"MALLOC_MMAP_THRESHOLD_": str(1 << 18)},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return int(done.stdout.splitlines()[-1])


def resident(field: str) -> int:
    """Bytes of a field of /proc/self/status, such as VmRSS or VmHWM."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(field + ":"):
            return 1024 * int(line.split()[1])
    raise OSError(f"/proc/self/status has no {field}")


def peak_of(work: Callable[[], Any]) -> tuple[int, Any]:
    """Bytes by which the resident set rises at most while `work` runs, and what it returns."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before = resident("VmRSS")
    result = work()
    return resident("VmHWM") - before, result


def check_method() -> None:
    """A known allocation is seen, although a larger one went before."""
    torch.ones(2 * KNOWN_BYTES, dtype=torch.uint8)
    seen, _ = peak_of(lambda: torch.ones(KNOWN_BYTES, dtype=torch.uint8))
    if abs(seen / KNOWN_BYTES - 1) > TOLERANCE:
        sys.exit(f"the resident set rose by {seen} bytes for a tensor of {KNOWN_BYTES}: this system cannot be measured")


def work_of(tensors: dict[str, torch.Tensor], ask: dict[str, Any]) -> Callable[[], list[torch.Tensor]]:
    """A pass over one view; it returns its outputs and gradients."""
    height, width = tensors["depth"].shape[2:]
    camera = ts.Camera.from_intrinsics(tensors["matrix"], height, width)
    learnable = "all" if ask["mode"] == "forward_backward" else ()
    module = ts.StatVO(ask["radius"], learnable=learnable, **ask["choices"])
    cotangent = torch.randn(1, 1, height, width, generator=torch.Generator().manual_seed(0))

    def forward() -> list[torch.Tensor]:
        with torch.no_grad():
            return [module(ts.GBuffer(tensors["depth"], camera, normal=tensors["normal"], valid=tensors["valid"]))]

    def both() -> list[torch.Tensor]:
        depth, normal = (tensors[name].detach().requires_grad_() for name in ("depth", "normal"))
        visibility = module(ts.GBuffer(depth, camera, normal=normal, valid=tensors["valid"]))
        gradients = torch.autograd.grad(visibility, [depth, normal, *module.parameters()], cotangent)
        return [visibility, *gradients]

    return forward if ask["mode"] == "forward" else both


def main() -> None:
    ask = json.loads(sys.argv[1])
    check_method()
    tensors = torch.load(ask["path"])
    small = {name: value[..., :64, :64].contiguous() if value.ndim == 4 else value for name, value in tensors.items()}
    work_of(small, ask)()  # what torch allocates once is not the pass's
    peak, result = peak_of(work_of(tensors, ask))
    print(peak - sum(tensor.numel() * tensor.element_size() for tensor in result))


if __name__ == "__main__":
    main()
