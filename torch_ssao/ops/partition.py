"""StatVO's adaptive partition of depth samples into layers."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ssao.ops.sat import Window, box_sum, summed_area_table

ROUNDING = 8.0  # depths and heights within this many units of rounding count as equal: a plane must not split itself


def adaptive_labels(depth: Tensor, valid: Tensor, half: Tensor, layers: int) -> Tensor:
    """Layer of every sample: each round splits a node at its own local mean depth.

    A sample goes to the upper (nearer) child where its depth is less than the mean depth of its node's valid samples
    in its own window, else to the lower; log2(layers) rounds.

    Args:
        depth: (B, L, H, W) view-space z, finite everywhere, scene units.
        valid: (B, L, H, W) bool.
        half: (B, 2, L, H, W) window half-size in pixels (x, y) of every sample.
        layers: number of leaves, a power of two up to 256.
    Returns: (B, L, H, W) uint8 labels in [0, layers); invalid samples carry one too, which means nothing.
    Gradients: none, labels are discrete.
    Cost: layers - 1 two-channel tables, one alive at a time.
    Source: Statistical Volumetric Obscurance, Sec. 5.
    """
    labels = torch.zeros_like(depth, dtype=torch.uint8)
    input_rounding = ROUNDING * torch.finfo(depth.dtype).eps * depth.abs()
    lost = table_rounding(depth, valid)[..., None, None]
    windows = [Window.around_pixels(half[:, :, peel]) for peel in range(depth.shape[1])]
    for level in range(layers.bit_length() - 1):
        split = torch.zeros_like(labels)
        for node in range(2**level):
            inside = valid & (labels == node)
            table = summed_area_table(torch.stack((torch.where(inside, depth, 0.0), inside.to(depth.dtype)), -1).sum(1))
            total, count = torch.stack([box_sum(table, window) for window in windows], 1).unbind(-1)
            count = count.clamp(min=1e-12).view_as(depth)  # a window of no samples belongs to nobody: any value will do
            lower = depth >= total.view_as(depth) / count - input_rounding - lost / count
            split = torch.where(inside, 2 * node + lower.to(torch.uint8), split)
        labels = split
    return labels


def table_rounding(size: Tensor, valid: Tensor) -> Tensor:
    """Bound on the rounding of a float64 box sum of samples of the given size, (B, 1).

    Args:
        size: (B, L, H, W) magnitude of the samples.
        valid: (B, L, H, W) bool.
    """
    total = torch.where(valid, size, 0.0).double().flatten(1).sum(1, keepdim=True)
    return ROUNDING * torch.finfo(torch.float64).eps * total
