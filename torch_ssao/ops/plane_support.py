"""How steep a stored plane may be: as steep as the depth map around its sample supports.

A normal need not be that of the depth map: smooth normals of a coarse mesh turn away from the eye before its silhouette. Half a
pixel of such a plane reaches far towards the eye, and would shadow the neighbours.
"""

from __future__ import annotations

import torch
from torch import Tensor

MIN_FACING = 0.02  # cosine to the view ray at which slopes of stored planes are capped: 88.9 degrees
STEEP_FACING = 0.2  # planes seen at less than this cosine need support; half a pixel of others reaches little
MARGIN = 1.5  # of the depth's slope: what curvature and quantised depth may lack


def least_facing(points: Tensor, normal: Tensor, valid: Tensor, intrinsics: Tensor, *, orthographic: bool) -> Tensor:
    """Least cosine between stored planes' normals and the ray to the eye.

    Slopes are changes per pixel, |along x| + |along y|, of 1/z (parallel rays: of z): on a plane the same everywhere. The depth
    map's are those to the nearer in value of the two neighbours along each axis, which lies on the same surface if any does. A
    sample that has no valid neighbour along one axis is taken at its word.

    Args:
        points, normal: (B, 3, L, H, W). valid: (B, L, H, W) bool. intrinsics: (B, 4) fx, fy, cx, cy in pixels.
        orthographic: parallel projection.
    Returns: (B, L, H, W) in [`MIN_FACING`, `STEEP_FACING`].
    Gradients: to points, normal and intrinsics; the choice of neighbours is non-differentiable.
    Cost: about 30 passes over memory.
    """
    z = torch.where(valid, points[:, 2], 1.0)
    level = z if orthographic else 1 / z
    x, y = (_smaller_step(level, valid, axis) for axis in (3, 2))
    known = torch.isfinite(x) & torch.isfinite(y)
    supported = torch.where(known, x + y, 0.0)
    length = 1.0 if orthographic else torch.linalg.vector_norm(points, dim=1)  # z |ray to the pixel at z = 1|
    wanted = (
        normal[:, 0].abs() / intrinsics[:, 0, None, None, None]
        + normal[:, 1].abs() / intrinsics[:, 1, None, None, None]
    )
    supported = MARGIN * supported * length
    gentle = wanted < STEEP_FACING * supported
    ratio = torch.where(gentle, wanted / torch.where(gentle, supported, 1.0), STEEP_FACING)
    return torch.where(known, ratio, MIN_FACING).clamp(min=MIN_FACING)


def _smaller_step(level: Tensor, valid: Tensor, axis: int) -> Tensor:
    """|difference| to the nearer in value of the two neighbours along an axis, inf without a valid one."""
    size = level.shape[axis]
    step = (level.narrow(axis, 1, size - 1) - level.narrow(axis, 0, size - 1)).abs()
    both = valid.narrow(axis, 1, size - 1) & valid.narrow(axis, 0, size - 1)
    step = torch.where(both, step, torch.inf)
    edge = list(level.shape)
    edge[axis] = 1
    beyond = step.new_full(edge, torch.inf)
    return torch.minimum(torch.cat((step, beyond), axis), torch.cat((beyond, step), axis))
