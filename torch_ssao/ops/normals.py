"""Normals from a position image, without bleeding across silhouettes."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize


def normals_from_points(points: Tensor, valid: Tensor) -> Tensor:
    """Unit normals towards the eye, each from the smaller of the two one-sided differences along x and along y.

    The neighbour whose depth is closer is taken as the same surface, so a normal never mixes foreground and background.
    With no valid neighbour along an axis (H or W = 1, an isolated pixel) the surface is taken as parallel to that axis.

    Args:
        points: (B, 3, H, W) view-space positions, scene units, finite (also where invalid).
        valid: (B, H, W) bool.
    Returns: (B, 3, H, W) in the dtype of `points`, n . v > 0 for v towards the eye; (0, 0, -1) at invalid pixels.
    Gradients: to points, through the chosen differences; the choice itself is non-differentiable.
    Cost: about 20 passes over memory; float16 and bfloat16 are computed in float32.
    Source: the usual remedy to kornia#4398 and to XeGTAO's edge normals.
    """
    dtype = points.dtype
    points = points.float() if dtype in (torch.float16, torch.bfloat16) else points
    right = _tangent(points, valid, axis=3)
    down = _tangent(points, valid, axis=2)
    # down x right points to the eye in x-right, y-down, z-forward axes.
    normal = normalize(torch.linalg.cross(down, right, dim=1), dim=1, eps=1e-30)
    facing = normal.new_tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1)
    return torch.where(valid[:, None], normal, facing).to(dtype)


def _tangent(points: Tensor, valid: Tensor, axis: int) -> Tensor:
    """Unit tangent along an image axis from the neighbour on either side that is closer in depth."""
    size = points.shape[axis]
    along = points.new_tensor([1.0, 0.0, 0.0] if axis == 3 else [0.0, 1.0, 0.0]).view(1, 3, 1, 1)
    if size == 1:
        return along.expand_as(points)
    step = points.narrow(axis, 1, size - 1) - points.narrow(axis, 0, size - 1)
    both = valid.narrow(axis - 1, 1, size - 1) & valid.narrow(axis - 1, 0, size - 1)
    gap = torch.where(both[:, None], step[:, 2:].abs(), torch.inf)
    edge = list(gap.shape)
    edge[axis] = 1
    beyond = gap.new_full(edge, torch.inf)
    zero = step.new_zeros([edge[0], 3, *edge[2:]])
    gap_after, gap_before = torch.cat((gap, beyond), axis), torch.cat((beyond, gap), axis)
    after, before = torch.cat((step, zero), axis), torch.cat((zero, step), axis)
    chosen = torch.where(gap_after <= gap_before, after, before)
    lonely = torch.isinf(gap_after) & torch.isinf(gap_before)
    return normalize(torch.where(lonely, along, chosen), dim=1, eps=1e-30)
