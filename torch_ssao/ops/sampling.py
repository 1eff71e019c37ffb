"""Sampling patterns: one fixed tile of low-discrepancy noise, and disk points. No generator, no global seed.

All noise is 24-bit fixed point, so that float32, float64 and every backend see the same numbers.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ssao import checks

TILE = 64  # pixels; the pattern repeats after this many
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # fractions of a turn by which successive slices or rings are shifted
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
# The two-dimensional low-discrepancy sequence of the root p of p^3 = p + 1: frac(n / p), frac(n / p^2).
_PLASTIC = 1.32471795724474602596
_STRIDES = (round(2**32 / _PLASTIC), round(2**32 / _PLASTIC**2))
_FRAME_STEP = 3083  # of the steps in [300, 4000) the one whose first 4 to 64 frames fill the unit square most evenly


def tiled_noise(
    height: int, width: int, frame: int, *, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Two independent-looking numbers per pixel: neighbours along a space-filling curve get far-apart values.

    Args:
        height, width: image size in pixels.
        frame: any integer; offsets the pattern, and the average over frames is the average over the unit square.
        dtype, device: of the result.
    Returns: rotation and offset, each (H, W) in [0, 1), multiples of 2^-24: the same in float32 and float64.
    Gradients: none.
    Cost: two table look-ups a pixel.
    Source: Hilbert curve over a 64 x 64 tile, indexing the R2 sequence (production notes, XeGTAO's choice).
    """
    index = _CURVE.to(device)[
        torch.arange(height, device=device)[:, None] % TILE, torch.arange(width, device=device) % TILE
    ]
    rotation, offset = (_fixed_point(index, stride, frame).to(dtype) * 2.0**-24 for stride in _STRIDES)
    return rotation, offset


def poisson_disk(count: int, *, dtype: torch.dtype = torch.float32, device: torch.device | None = None) -> Tensor:
    """Fixed, well-spaced points of the unit disk: the golden-angle spiral, one point in each of `count` equal-area rings.

    No two points are nearer than 1.5 / sqrt(count) (the densest packing has 1.9), and because every ring of equal area
    holds one point, a sum over the points under random rotation is the midpoint rule over the disk: it does not
    drift with the count, as dart throwing does, which crowds the rim.

    Args:
        count: number of points, >= 1.
        dtype, device: of the result; points are computed in float64 on the CPU.
    Returns: (count, 2), from the centre outwards.
    Gradients: none.
    Raises: RangeError.
    Source: Vogel 1979.
    """
    checks.check_count("count", count, 1)
    ring = torch.arange(count, dtype=torch.float64)
    radius, angle = ((ring + 0.5) / count).sqrt(), ring * _GOLDEN_ANGLE
    return torch.stack((radius * angle.cos(), radius * angle.sin()), 1).to(device=device, dtype=dtype)


def _fixed_point(index: Tensor, stride: int, frame: int) -> Tensor:
    """24 high bits of frac((index + step frame + 1/2) stride / 2^32), in integers: exact for any frame."""
    shift = (_FRAME_STEP * frame * stride + stride // 2) % 2**32
    return ((index * stride + shift) & 0xFFFFFFFF) >> 8


def _hilbert_curve(size: int) -> Tensor:
    """(size, size) int64: the place of each cell along the Hilbert curve."""
    x, y = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="xy")
    place = torch.zeros_like(x)
    side = size // 2
    while side:
        right, low = (x & side) > 0, (y & side) > 0
        place = place + side * side * ((3 * right) ^ low.long())
        turned = ~low
        mirrored = turned & right
        x, y = (
            torch.where(mirrored, side - 1 - (x & (side - 1)), x),
            torch.where(mirrored, side - 1 - (y & (side - 1)), y),
        )
        x, y = torch.where(turned, y, x) & (side - 1), torch.where(turned, x, y) & (side - 1)
        side //= 2
    return place


_CURVE = _hilbert_curve(TILE)
