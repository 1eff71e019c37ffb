"""Peak memory of one StatVO pass; `statvo_speed memory` calls it.

What counts is every block that torch's CPU allocator hands out and takes back, as its profiler records them, temporaries inside
operators included. Memory that a kernel of numpy or numba takes would be missed; StatVO has none.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

import torch_ssao as ts

KNOWN_BYTES = 8 << 20  # allocated and measured first: a method that misses it reports nothing


def peak_bytes(gbuffer: ts.GBuffer, radius: float, choices: dict[str, Any], mode: str) -> int:
    """What a pass takes at most beyond inputs, outputs and gradients.

    Args:
        gbuffer: one view, with normals.
        radius: scene units.
        choices: of `ts.StatVO`.
        mode: "forward" (without gradients) or "forward_backward" (to depth, normal and the module's parameters).
    Raises: RuntimeError where the profiler does not see a known allocation.
    """
    if not 0.99 * KNOWN_BYTES <= _peak(lambda: torch.empty(KNOWN_BYTES, dtype=torch.uint8)) <= 1.01 * KNOWN_BYTES:
        raise RuntimeError("the profiler does not see CPU allocations on this machine: no figures")
    backward = mode == "forward_backward"
    module = ts.StatVO(radius, learnable="all" if backward else (), **choices)
    cotangent = torch.randn(gbuffer.depth[:, :1].shape, generator=torch.Generator().manual_seed(0))
    depth, normal = (tensor.clone().requires_grad_(backward) for tensor in (gbuffer.depth, gbuffer.normal))
    moved = ts.GBuffer(depth, gbuffer.camera, normal=normal, valid=gbuffer.valid_mask)

    def run() -> Any:
        with torch.set_grad_enabled(backward):
            image = module(moved)
        return torch.autograd.grad(image, [depth, normal, *module.parameters()], cotangent) if backward else image

    results = cotangent.nbytes + (depth.nbytes + normal.nbytes if backward else 0)
    return _peak(run) - results


def _peak(work: Any) -> int:
    """Largest number of bytes in use at once while `work` runs, beyond those before."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        result = work()
    events = recorded.profiler.kineto_results.events()
    del result
    changes = sorted((event.start_ns(), event.nbytes()) for event in events if event.name() == "[memory]")
    used = peak = 0
    for _, change in changes:
        used += change
        peak = max(peak, used)
    return peak
