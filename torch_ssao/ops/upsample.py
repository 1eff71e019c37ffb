"""Visibility from half resolution back to full: every pixel takes from its nearest computed neighbours on its own surface."""

from __future__ import annotations

import torch
from torch import Tensor

PLANE_WIDTH = 0.1  # of the radius, as in `ops.denoise`
NORMAL_WIDTH = 0.15  # 1 - cos at which a weight falls to 1/e: 32 degrees
UNSEEN = 1e4  # cost of an invalid neighbour: only another invalid one is as bad


def upsample_visibility(half: Tensor, points: Tensor, normal: Tensor, valid: Tensor, radius: Tensor) -> Tensor:
    """Full-resolution visibility from the pixels of even rows and columns.

    A pixel that was computed keeps its value. Between two of them (or four) it is the mean with weights exp(-c), c = (d_pq^2 +
    d_qp^2) / (0.1 R)^2 + (1 - n_p . n_q) / 0.15, d_pq the distance of x_q from p's tangent plane; the least c of the
    neighbours is subtracted first, so that where all lie on other surfaces the nearest one counts.

    Args:
        half: (B, ceil(H / 2), ceil(W / 2)) visibility of the pixels (2i, 2j).
        points, normal: (B, 3, H, W) view-space positions, scene units, finite; unit normals.
        valid: (B, H, W) bool; invalid pixels lend nothing.
        radius: (B,) length R over which visibility may vary, scene units, > 0.
    Returns: (B, H, W); 1 where neither the pixel nor a neighbour is valid.
    Gradients: to half, points, normal and radius, of every order and mode.
    Cost: 8 reads a pixel of the odd rows or columns; saved about 60 floats a pixel.
    Source: ours; joint bilateral upsampling after Kopf et al. 2007, two and four neighbours as checkerboard renderers take.
    """
    height, width = valid.shape[1:]
    rows, columns = (torch.arange(size, device=half.device) for size in (height, width))
    unit = radius[:, None, None]
    values, costs = [], []
    for down in (0, 1):
        for right in (0, 1):
            # (2i, 2j) has one neighbour, four times itself; the last odd row and column have none beyond
            above, left = (rows + down) // 2, (columns + right) // 2
            above, left = above.clamp(max=half.shape[1] - 1), left.clamp(max=half.shape[2] - 1)
            values.append(half[:, above][:, :, left])
            far = (2 * above, 2 * left)
            between = _at(points, far) - points
            there = _at(normal, far)
            plane = (between * normal).sum(1).square() + (between * there).sum(1).square()
            alike = 1 - (normal * there).sum(1)
            cost = plane / (PLANE_WIDTH * unit).square() + alike / NORMAL_WIDTH
            costs.append(torch.where(valid[:, far[0]][:, :, far[1]], cost.clamp(max=0.5 * UNSEEN), UNSEEN))
    cost, value = torch.stack(costs), torch.stack(values)
    weight = torch.softmax(-cost, 0)
    return torch.where((cost < UNSEEN).any(0), (weight * value).sum(0), 1.0)


def _at(image: Tensor, index: tuple[Tensor, Tensor]) -> Tensor:
    return image[:, :, index[0]][:, :, :, index[1]]
