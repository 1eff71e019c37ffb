"""A small synthetic scene for fits: a floor and two walls with boxes and spheres, made by ray intersection in torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ssao import Camera, GBuffer, look_at

Pair = tuple[Tensor, Tensor]


def clutter(height: int = 48, width: int = 64, *, views: int = 1, seed: int = 0, walls: bool = True) -> GBuffer:
    """A 6 x 6 floor under eight boxes and five spheres about 1 in size, seen from an arc of 60 degrees; sky is invalid.

    Args:
        height, width: image size in pixels.
        views: number of cameras.
        seed: of the placement.
        walls: whether there are two walls behind; without them there is sky.
    """
    generator = torch.Generator().manual_seed(seed)
    boxes, spheres = _place_boxes(generator, walls), _place_spheres(generator)
    images = []
    for view in range(views):
        angle = math.radians(45 if views == 1 else 15 + 60 * view / (views - 1))
        eye = torch.tensor([7 * math.sin(angle), 4.0, 7 * math.cos(angle)]).double()
        pose = look_at(eye, torch.tensor([0, 0.5, 0]).double(), torch.tensor([0, 1, 0]).double())
        camera = Camera.perspective(45.0, height, width, world_to_view=pose)
        images.append(_cast(camera, pose, eye, boxes, spheres).to(torch.float32))
    return GBuffer.cat(images)


def _uniform(generator: torch.Generator, count: int, low: float, high: float) -> Tensor:
    return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)


def _place_boxes(generator: torch.Generator, walls: bool, count: int = 8) -> Pair:
    ranges = ((-2.5, 1.5), (0, 0), (-2.5, 1.5))
    low = torch.stack([_uniform(generator, count, *span) for span in ranges], -1)
    size = torch.stack([_uniform(generator, count, *span) for span in ((0.3, 1.2), (0.2, 1.5), (0.3, 1.2))], -1)
    fixed = torch.tensor(
        [[[-3, -0.1, -3], [3, 0, 3]], [[-3.1, 0, -3], [-3, 3, 3]], [[-3, 0, -3.1], [3, 3, -3]]]
    ).double()
    kept = fixed if walls else fixed[:1]
    return torch.cat((low, kept[:, 0])), torch.cat((low + size, kept[:, 1]))


def _place_spheres(generator: torch.Generator, count: int = 5) -> Pair:
    centre = torch.stack([_uniform(generator, count, *span) for span in ((-2, 2.5), (0.2, 0.6), (-2, 2.5))], -1)
    return centre, _uniform(generator, count, 0.2, 0.6)


def _cast(camera: Camera, pose: Tensor, eye: Tensor, boxes: Pair, spheres: Pair) -> GBuffer:
    x, y = torch.broadcast_tensors(*camera.rays(dtype=torch.float64))
    ray = torch.stack((x, y, torch.ones_like(x)), -1)[0] @ pose[:3, :3]  # t is the view depth
    one, other = ((bound - eye) / ray[..., None, :] for bound in boxes)  # (H, W, N, 3)
    near, axis = torch.minimum(one, other).max(-1)
    far = torch.maximum(one, other).amin(-1)
    depth, first = torch.where((near < far) & (near > 0), near, torch.inf).min(-1)
    axis = axis.gather(-1, first[..., None])
    normal = torch.nn.functional.one_hot(axis[..., 0], 3).double() * -ray.gather(-1, axis).sign()
    for centre, radius in zip(*spheres, strict=True):
        a, b = (ray * ray).sum(-1), (ray * (eye - centre)).sum(-1)
        root = b * b - a * ((eye - centre).square().sum() - radius**2)
        t = torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, torch.inf)
        closer = (t < depth) & (t > 0)
        outward = (eye + torch.where(closer, t, 0.0)[..., None] * ray - centre) / radius
        depth = torch.where(closer, t, depth)
        normal = torch.where(closer[..., None], outward, normal)
    return GBuffer(depth[None, None], camera, normal=(normal @ pose[:3, :3].T).permute(2, 0, 1)[None])
