"""The limit of many taps: chosen pixels of analytic scenes, and whether the depth map shows what decides about them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from support.ray_march import some_pixels
from torch_ssao.ops import horizon, poisson_disk, tiled_noise
from torch_ssao.ops import horizon_taps as taps
from torch_ssao.scenes.analytic import AnalyticScene

EXPONENTS = {"binary": 1e4, "linear": 1.0, "quadratic": 2.0}  # W = 1 - t^p of the closed forms' falloffs
_NEAR = 1e-6  # of the radius: a ray leaves its surface


class HorizonPixels:
    """Horizon visibility of some pixels of one image, in float64.

    Args:
        gb: one image with normals.
        options: of `horizon_obscurance`; by default 64 slices of 64 uniform steps, infinite thickness, no bias.
    """

    def __init__(self, gb: ts.GBuffer, *, radius: float, frame: int = 0, **options: Any) -> None:
        given = {
            "slices": 64, "steps": 64, "step_power": 1.0, "weighting": "cosine", "estimator": "bitmask",
            "connected": True, "falloff": 1.0, "thickness": None,
        } | options  # fmt: skip
        camera, valid = gb.camera, gb.valid_mask[:, 0]
        intrinsics = torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1).double()
        depth = torch.where(valid, gb.depth[:, 0], 1.0)
        planes = taps.surface_planes(depth, valid, intrinsics[:, :2], orthographic=camera.is_orthographic)
        noise = tiled_noise(camera.height, camera.width, frame, dtype=torch.float64, device=depth.device)
        numbers = [
            None if v is None else torch.tensor([v], dtype=torch.float64)
            for v in (radius, given["falloff"], given["thickness"], 0.0)
        ]
        self.slices = given["slices"]
        layout = taps.Layout(self.slices, given["steps"], given["step_power"], camera.is_orthographic, None, False)
        cosine, connected = given["weighting"] == "cosine", given["connected"]
        self.kernel = horizon._Horizon(layout, cosine, given["estimator"], connected, *noise, 0.0)
        self.inputs = horizon._Inputs.of([planes, valid, gb.normal, intrinsics, *numbers])

    def visibility(self, start: int, stop: int | None = None) -> Tensor:
        """Of the flat pixels from `start` to `stop`, by default of one."""
        block = horizon._Block(self.kernel, self.inputs, start, stop or start + 1, range(self.slices))
        with torch.no_grad():
            return 1.0 - block.function(*block.leaves)[0].clamp(0, 1)


def marched(gb: ts.GBuffer, pixel: int, **options: Any) -> float:
    """Ray-marched visibility of a flat pixel with 1,024 rays of 64 steps."""
    return float(some_pixels(gb, slice(pixel, pixel + 1), **options)[0])


def decided(scene: AnalyticScene, gb: ts.GBuffer, pixel: int, radius: float, *, rays: int = 256, points: int = 24) -> float:
    """Share of a pixel's cosine-weighted rays of which the depth map shows everything up to the hit, or up to R.

    A ray that is hidden anywhere on its way (by a surface nearer to the eye, or by the screen's edge) is not decided: what
    it meets there is unknown to any technique of one depth layer, and what is behind a surface counts as solid.
    """
    camera = gb.camera
    pose = camera.world_to_view[0]
    to_world = torch.linalg.inv(pose)
    point = camera.unproject(gb.depth)[0, :, 0].flatten(1)[:, pixel]
    normal = gb.normal[0].flatten(1)[:, pixel]
    disk = poisson_disk(rays, dtype=torch.float64)
    up = (1 - disk.square().sum(1)).clamp(min=0).sqrt()
    side = torch.linalg.cross(normal, torch.eye(3, dtype=torch.float64)[int(normal.abs().argmin())])
    side = side / side.norm()
    local = torch.stack((disk[:, 0], disk[:, 1], up), 1)
    ray = local @ torch.stack((side, torch.linalg.cross(normal, side), normal))  # (K, 3), in view space
    ray_world, start = ray @ to_world[:3, :3].T, to_world[:3, :3] @ point + to_world[:3, 3]
    hit = scene._first_hit(start.expand_as(ray), ray_world, start=_NEAR * radius)[0].clamp(max=radius)
    share = (torch.arange(points, dtype=torch.float64) + 1) / points
    along = share[:, None] * hit  # (J, K)
    place = point + along[..., None] * ray
    x, y, z = place.unbind(-1)
    scale = 1.0 if camera.is_orthographic else 1 / z.clamp(min=1e-9)
    u, v = camera.fx * x * scale + camera.cx, camera.fy * y * scale + camera.cy
    seen = (z > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    away = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(place) if camera.is_orthographic else -place
    length = torch.where(seen, z, 1.0) if camera.is_orthographic else 1.0
    world = start + along[..., None] * ray_world
    shade = scene._first_hit(world, away @ to_world[:3, :3].T, start=1e-5)[0]
    return float((seen & (shade >= length)).all(0).double().mean())


def chosen(scene: AnalyticScene, gb: ts.GBuffer, radius: float, *, count: int = 8, seed: int = 0) -> list[int]:
    """Flat pixels about which the depth map decides, occluded by 0.02 to 0.98, two pixels or more from any crease.

    Args:
        count: at most so many, spread over the visibilities that occur.
    """
    exact, known = scene.exact(gb, radius=radius)
    normal = gb.normal[0]
    clear = known[0, 0] & ((exact[0, 0] - 0.5).abs() < 0.48)
    for axis in (1, 2):
        for shift in (-2, -1, 1, 2):  # the pixel on a crease shows one of its two surfaces
            clear &= (normal * normal.roll(shift, axis)).sum(0) > 0.9
    candidates = clear.flatten().nonzero()[:, 0]
    generator = torch.Generator().manual_seed(seed)
    candidates = candidates[torch.randperm(len(candidates), generator=generator)[: 12 * count]]
    candidates = candidates[exact.flatten()[candidates].argsort()]
    good = [int(p) for p in candidates if decided(scene, gb, int(p), radius) >= 0.999]
    stride = max(1.0, (len(good) - 1) / max(count - 1, 1))
    return [good[round(i * stride)] for i in range(min(count, len(good)))]


def span_px(gb: ts.GBuffer, pixel: int, radius: float) -> float:
    """Pixels that the radius spans there, facing the eye."""
    size = gb.camera.footprint(torch.tensor(radius, dtype=torch.float64), gb.depth)
    return float(size[0, 1].flatten()[pixel])


def rms(values: list[float]) -> float:
    """Root of the mean square."""
    return math.sqrt(sum(v * v for v in values) / len(values))
