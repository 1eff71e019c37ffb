"""Bent normals: the mean open direction of every pixel, from the taps of the horizon obscurance."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torch_ssao.ops.horizon import evaluate_horizon
from torch_ssao.ops.horizon_moments import HEMISPHERE

# Less visibility, or less of the mean open direction along the normal, is what rounding and few slices leave.
CLOSED = 1e-4


def horizon_bent_normal(*tensors: Any, weighting: str, **options: Any) -> tuple[Tensor, Tensor]:
    """Obscurance and mean open direction of every pixel.

    The mean direction of the whole hemisphere, which is along the normal, less that of what the taps occlude: so a surface
    that nothing occludes has its normal exactly. With "increments" what is occluded by halves bends by halves.

    Args:
        tensors: depth, valid, normal, intrinsics, radius, falloff, thickness, bias, rotation, offset, in this order: see
            `horizon_obscurance`.
        weighting: "cosine" - the mean counts a direction by its cosine to the normal; "uniform" - all alike.
        options: the other keywords of `horizon_obscurance`.
    Returns: (B, H, W) obscurance, and (B, 3, H, W) unit directions in view space; the normal where nothing is open, and
        (0, 0, -1) at invalid pixels.
    Gradients: to what `horizon_obscurance` has gradients to, in the same sense; none through a fallback's direction but to
        the normal.
    Cost: about twice `horizon_obscurance`; four floats a pixel are kept.
    Raises: ChoiceError.
    Source: GTAO (Jimenez et al. 2016), Algorithm 2, from here integrated over any union of arcs.
    """
    found, normal = evaluate_horizon(*tensors, weighting=weighting, bent=True, **options)
    valid = tensors[1]
    obscurance = torch.where(valid, found[:, 0], 0.0).clamp(0, 1)
    normal = torch.nn.functional.normalize(normal, dim=1)
    mean = HEMISPHERE[weighting == "cosine"] * normal - found[:, 1:]
    bent = valid & (obscurance < 1 - CLOSED) & ((mean * normal).sum(1) > CLOSED)
    direction = torch.where(bent[:, None], mean, normal)
    return obscurance, torch.nn.functional.normalize(direction, dim=1)
