"""Small G-buffers made by hand; every one is a function of a seed."""

from __future__ import annotations

import torch
from torch import Tensor

import torch_ssao as ts


def random_gbuffer(
    seed: int,
    *,
    batch: int = 1,
    peels: int = 1,
    height: int = 13,
    width: int = 17,
    invalid: float = 0.1,
    normals: bool = True,
    orthographic: bool = False,
    dtype: torch.dtype = torch.float64,
) -> ts.GBuffer:
    """Random depths around 2, random normals, an off-centre camera with fx != fy, a share of invalid pixels."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = 1.5 + uniform(batch, peels, height, width) + torch.arange(peels)[None, :, None, None]
    valid = uniform(batch, peels, height, width) >= invalid
    normal = None
    if normals:
        tilt = uniform(batch, 3, height, width) - torch.tensor([0.5, 0.5, 1.5]).view(1, 3, 1, 1)
        normal = torch.nn.functional.normalize(tilt, dim=1).to(dtype)
    focal = (0.9 + 0.2 * uniform(batch)) * width
    camera = ts.Camera(
        focal.to(dtype),
        (1.2 * focal).to(dtype),
        (width / 2 + uniform(batch)).to(dtype),
        (height / 2 - uniform(batch)).to(dtype),
        height,
        width,
        is_orthographic=orthographic,
    )
    return ts.GBuffer(depth.to(dtype), camera, normal=normal, valid=valid)


def plane_gbuffer(
    view_angle_deg: float,
    *,
    height: int = 48,
    width: int = 64,
    distance: float = 4.0,
    fov_y_deg: float = 50.0,
    orthographic: bool = False,
    dtype: torch.dtype = torch.float32,
) -> ts.GBuffer:
    """An infinite plane seen at an angle from its normal, with its exact depth and normal."""
    size = (height, width)
    camera = ts.Camera.orthographic(2.0, *size) if orthographic else ts.Camera.perspective(fov_y_deg, *size)
    angle = torch.deg2rad(torch.tensor(view_angle_deg, dtype=torch.float64))
    normal = torch.stack((torch.zeros_like(angle), -torch.sin(angle), -torch.cos(angle)))
    x, y = camera.to(torch.float64).rays()
    if orthographic:
        depth = distance - (y * normal[1] + x * 0) / normal[2]
    else:
        facing = y * normal[1] + normal[2] + x * 0  # plane: n . p = distance * n_z
        depth = torch.where(facing < 0, distance * normal[2] / facing, torch.inf)
    image = normal.view(1, 3, 1, 1).expand(1, 3, height, width).to(dtype)
    return ts.GBuffer(depth[:, None].to(dtype), camera.to(dtype), normal=image)


def steps_gbuffer(*, height: int = 48, width: int = 64, dtype: torch.dtype = torch.float32) -> ts.GBuffer:
    """Smooth bumps with a raised block: a scene with both curved surfaces and depth discontinuities."""
    camera = ts.Camera.perspective(50.0, height, width).to(dtype)
    v = torch.linspace(-1, 1, height, dtype=torch.float64)[:, None]
    u = torch.linspace(-1.3, 1.3, width, dtype=torch.float64)
    depth = 4 + 0.25 * torch.sin(5 * u) * torch.cos(4 * v) - 0.3 * torch.exp(-8 * ((u + 0.6) ** 2 + (v - 0.3) ** 2))
    depth = torch.where((u > 0.1) & (u < 0.7) & (v.abs() < 0.45), torch.full_like(depth, 3.0), depth)
    return ts.GBuffer.from_depth(depth.to(dtype), camera)
