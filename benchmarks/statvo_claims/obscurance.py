"""Volumetric obscurance by point sampling in StatVO's own box: what its means over layers approximate."""

from __future__ import annotations

import torch
from torch import Tensor

import torch_ssao as ts


def point_sampled(
    gbuffer: ts.GBuffer,
    radius: float,
    *,
    height: float = 1.0,
    falloff: float = 1.0,
    contrast: float = 1.0,
    grid: int = 16,
) -> Tensor:
    """Visibility from grid x grid columns through the box of every pixel, each resolved on its own.

    A column through the box at x is filled up to the height (p - x) . n of the surface sample p that the depth map holds
    there; a sample above the box counts less the higher it lies (StatVO's own psi). This is StatVO with as many layers as
    samples: no mean is taken before psi.

    Args:
        gbuffer: (B, 1, H, W) depth with normals.
        radius: half-size of the box, scene units.
        height, falloff, contrast: as in StatVO.
        grid: columns along each side of the window, nearest pixels at the centres of equal cells.
    Returns: (B, 1, H, W) visibility, 1 at invalid pixels.
    """
    valid = gbuffer.valid_mask[:, 0]
    depth = torch.where(valid, gbuffer.depth[:, 0], 1.0)
    batch, rows, columns = depth.shape
    points = gbuffer.camera.unproject(depth[:, None])[:, :, 0].double()  # (B, 3, H, W)
    normal = gbuffer.normal.double()
    half = gbuffer.camera.footprint(torch.tensor(radius), depth[:, None])[:, :, 0].double()
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    total = torch.zeros(batch, rows, columns, dtype=torch.float64)
    count = torch.zeros_like(total)
    image = torch.arange(batch)[:, None, None]
    for j in range(grid):
        at_y = torch.floor(y + 0.5 + ((2 * j + 1) / grid - 1) * half[:, 1]).long()
        for i in range(grid):
            at_x = torch.floor(x + 0.5 + ((2 * i + 1) / grid - 1) * half[:, 0]).long()
            inside = (at_x >= 0) & (at_x < columns) & (at_y >= 0) & (at_y < rows)
            place = (image, at_y.clamp(0, rows - 1), at_x.clamp(0, columns - 1))
            inside = inside & valid[place]
            sample = points.permute(0, 2, 3, 1)[place].permute(0, 3, 1, 2)
            share = ((sample - points) * normal).sum(1) / (radius * height)
            filled = torch.where(share > 1, 1 - falloff * (share - 1), share).clamp(min=0)
            total += torch.where(inside, filled, 0.0)
            count += inside
    open_share = (1 - total / count.clamp(min=1)) ** contrast
    return torch.where(valid & (count > 0), open_share, 1.0)[:, None].to(gbuffer.depth.dtype)
