"""Small synthetic G-buffers: a floor and a back wall with boxes and spheres, made by ray intersection in torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ssao import Camera, GBuffer, look_at


def clutter(
    height: int = 48,
    width: int = 64,
    *,
    views: int = 1,
    seed: int = 0,
    boxes: int = 8,
    spheres: int = 5,
    walls: bool = True,
    dtype: torch.dtype = torch.float32,
) -> GBuffer:
    """A 6 x 6 floor (world y up) under boxes and spheres about 1 in size, seen from `views` sides; sky is invalid.

    Args:
        height, width: image size in pixels.
        views: number of cameras, on an arc of 60 degrees.
        seed: of the placement.
        boxes, spheres: how many of each.
        walls: whether there are two walls behind them; without them the horizon is sky.
        dtype: of the result.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(count: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)

    low = torch.stack((uniform(boxes, -2.5, 1.5), torch.zeros(boxes).double(), uniform(boxes, -2.5, 1.5)), -1)
    size = torch.stack((uniform(boxes, 0.3, 1.2), uniform(boxes, 0.2, 1.5), uniform(boxes, 0.3, 1.2)), -1)
    slabs = [(low, low + size)]
    if walls:
        slabs.append((torch.tensor([[-3.1, 0, -3], [-3, 0, -3.1]]).double(), torch.tensor([[-3, 3, 3], [3, 3, -3]]).double()))
    slabs.append((torch.tensor([[-3, -0.1, -3]]).double(), torch.tensor([[3.0, 0, 3]]).double()))
    box_low, box_high = (torch.cat(parts) for parts in zip(*slabs, strict=True))
    centre = torch.stack((uniform(spheres, -2, 2.5), uniform(spheres, 0.2, 0.6), uniform(spheres, -2, 2.5)), -1)
    radius = uniform(spheres, 0.2, 0.6)
    images = []
    for view in range(views):
        angle = math.radians(45 + (60 * view / max(views - 1, 1) - 30 if views > 1 else 0))
        eye = torch.tensor([7 * math.sin(angle), 4.0, 7 * math.cos(angle)]).double()
        pose = look_at(eye, torch.tensor([0, 0.5, 0]).double(), torch.tensor([0, 1, 0]).double())
        camera = Camera.perspective(45.0, height, width, world_to_view=pose)
        images.append(_cast(camera, pose, eye, (box_low, box_high), (centre, radius)).to(dtype))
    return GBuffer.cat(images)


def step(height: int = 48, width: int = 64, *, rise: float = 0.3, dtype: torch.dtype = torch.float32) -> GBuffer:
    """Two fronto-parallel planes at depth 2 and 2 - rise, seen from above; no pixel is invalid."""
    depth = torch.full((1, 1, height, width), 2.0, dtype=dtype)
    depth[..., width // 2 :] -= rise
    normal = torch.tensor([0, 0, -1], dtype=dtype).view(1, 3, 1, 1).expand(1, 3, height, width)
    return GBuffer(depth, Camera.perspective(50.0, height, width).to(dtype), normal=normal)


def _cast(
    camera: Camera, pose: Tensor, eye: Tensor, boxes: tuple[Tensor, Tensor], spheres: tuple[Tensor, Tensor]
) -> GBuffer:
    x, y = camera.rays(dtype=torch.float64)
    x, y = torch.broadcast_tensors(x, y)
    ray = torch.stack((x, y, torch.ones_like(x)), -1)[0] @ pose[:3, :3]  # unit view depth per unit of t: t is the depth
    low, high = (((bound - eye) / ray[..., None, :]) for bound in boxes)  # (H, W, N, 3)
    near, axis = torch.minimum(low, high).max(-1)
    far = torch.maximum(low, high).amin(-1)
    near = torch.where((near < far) & (near > 0), near, torch.inf)
    depth, first = near.min(-1)
    axis = axis.gather(-1, first[..., None])[..., 0]
    normal = torch.nn.functional.one_hot(axis, 3).double() * -ray.gather(-1, axis[..., None]).sign()
    for centre, radius in zip(*spheres, strict=True):
        a, b = (ray * ray).sum(-1), (ray * (eye - centre)).sum(-1)
        root = b * b - a * ((eye - centre).square().sum() - radius**2)
        t = torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, torch.inf)
        closer = (t < depth) & (t > 0)
        outward = (eye + torch.where(closer, t, 0.0)[..., None] * ray - centre) / radius
        depth = torch.where(closer, t, depth)
        normal = torch.where(closer[..., None], outward, normal)
    normal = (normal @ pose[:3, :3].T).permute(2, 0, 1)
    return GBuffer(depth[None, None], camera, normal=normal[None])
