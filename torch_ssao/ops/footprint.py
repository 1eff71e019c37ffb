"""What becomes of a technique where its radius is smaller than a pixel: there is nothing left to sample, so it fades out."""

from __future__ import annotations

import torch
from torch import Tensor

FADE = (0.5, 1.0)  # pixels that the radius spans: nothing at the first, everything from the second on


def footprint_fade(depth: Tensor, valid: Tensor, radius: Tensor, focal: Tensor, *, orthographic: bool) -> Tensor:
    """Share of the obscurance that is kept: 0 where the radius spans half a pixel, 1 from a pixel on, smooth between.

    Args:
        depth: (B, H, W) view-space z, > 0 where valid. valid: (B, H, W) bool.
        radius: (B, 1, 1) or (B, H, W) scene units. focal: (B, 2) pixels (orthographic: pixels a scene unit); the larger counts.
        orthographic: parallel rays.
    Returns: (B, H, W) in [0, 1]; 1 at invalid pixels.
    Gradients: to depth, radius and focal; exactly 0 from a pixel on.
    """
    wide = radius * focal.amax(1)[:, None, None]
    distance = torch.ones_like(depth) if orthographic else torch.where(valid, depth, torch.inf)
    small = (wide < FADE[1] * distance) & valid
    # Where nothing fades, nothing is divided: 0 times the derivative of what overflows is not 0.
    span = wide / torch.where(small, distance, torch.ones_like(depth))
    share = ((span - FADE[0]) / (FADE[1] - FADE[0])).clamp(0, 1)
    return torch.where(small, share * share * (3 - 2 * share), 1.0)
