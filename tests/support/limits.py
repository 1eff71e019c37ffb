"""The limit of many taps: chosen pixels of analytic scenes, and whether the depth map shows what decides about them.

What is left out of the comparisons with closed forms, by the rules of `decided` and `chosen`: pixels some of whose rays are
hidden on their way (the underside of a sphere, a cylinder or a disk and the floor below it, the near sides of pits seen at
an angle, the wall seen edge-on from straight above, everything that leaves the screen), surfaces seen at more than
81 degrees from their normal, pixels on a crease, and pixels at which the radius spans fewer than 48 pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from torch_ssao.ops import horizon, poisson_disk, ray_march, tiled_noise
from torch_ssao.ops import horizon_taps as taps
from torch_ssao.scenes import analytic
from torch_ssao.scenes.analytic import AnalyticScene

EXPONENTS = {"binary": 1e4, "linear": 1.0, "quadratic": 2.0}  # W = 1 - t^p of the closed forms' falloffs
_NEAR = 1e-6  # of the radius: a ray leaves its surface
_FACING = math.cos(math.radians(81.0))
_SPAN_PX = 48.0

# Builder, radius and scene units on the screen of each scene.
SCENES: dict[str, tuple[Callable[[], AnalyticScene], float, float]] = {
    "wall": (analytic.wall, 0.35, 2.0),
    "dihedral 60": (lambda: analytic.dihedral(60.0), 0.35, 2.0),
    "dihedral 120": (lambda: analytic.dihedral(120.0), 0.35, 2.0),
    "room corner": (analytic.room_corner, 0.35, 2.0),
    "finite wall": (lambda: analytic.finite_wall(0.5), 0.35, 1.5),
    "sphere": (lambda: analytic.sphere_on_plane(1.0), 0.8, 4.0),
    "cylinder": (lambda: analytic.lying_cylinder(1.0), 0.8, 4.0),
    "pit": (lambda: analytic.rectangular_pit(1.0, 1.4, 0.5), 0.4, 1.6),
    "trench": (lambda: analytic.trench(1.0, 0.5), 0.4, 1.6),
    "round pit": (lambda: analytic.round_pit(0.6, 0.4), 0.4, 1.6),
    "bowl": (lambda: analytic.spherical_bowl(1.0, 60.0), 0.4, 2.0),
}
KINDS: dict[str, dict[str, Any]] = {
    "10": {"fov_y_deg": 10.0},
    "50": {"fov_y_deg": 50.0},
    "120": {"fov_y_deg": 120.0},
    "orthographic": {"orthographic": True},
}
ANGLES = (0.0, 20.0, 45.0, 70.0, 80.0)

# Options of `HorizonPixels`, and the closed form: falloff, weighting.
HORIZON_FORMS: dict[str, tuple[dict[str, Any], str, str]] = {
    "increments, binary": ({"estimator": "increments", "falloff": 1e4}, "binary", "cosine"),
    "increments, linear": ({"estimator": "increments", "falloff": 1.0}, "linear", "cosine"),
    "increments, quadratic": ({"estimator": "increments", "falloff": 2.0}, "quadratic", "cosine"),
    "bitmask, connected": ({}, "binary", "cosine"),
    "uniform increments, quadratic": (
        {"estimator": "increments", "falloff": 2.0, "weighting": "uniform"}, "quadratic", "uniform"
    ),
    "uniform bitmask, connected": ({"weighting": "uniform"}, "binary", "uniform"),
}  # fmt: skip


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
        self.kernel = horizon._Horizon(layout, cosine, given["estimator"], connected, *noise, 0.0, bent=False)
        self.inputs = horizon._Inputs.of([planes, valid, gb.normal, intrinsics, *numbers], None)

    def visibility(self, start: int, stop: int | None = None) -> Tensor:
        """Of the flat pixels from `start` to `stop`, by default of one."""
        block = horizon._Block(self.kernel, self.inputs, start, stop or start + 1, range(self.slices))
        with torch.no_grad():
            return 1.0 - block.function(*block.leaves)[0][0].clamp(0, 1)


class MarchedPixels:
    """Ray-marched visibility of some pixels of one image, in float64; thickness is of the radius."""

    def __init__(
        self,
        gb: ts.GBuffer,
        *,
        radius: float,
        falloff: float,
        thickness: float | None = None,
        rays: int = 1024,
        steps: int = 64,
    ) -> None:
        camera = gb.camera
        points, normals = camera.unproject(gb.depth), gb.normal[:, :, None]
        noise = tiled_noise(camera.height, camera.width, 0, dtype=torch.float64, device=gb.depth.device)
        spec = ray_march._Spec(steps, camera.height, camera.width, camera.is_orthographic, "exact", 0.05)
        self.kernel = ray_march._March(spec, poisson_disk(rays, dtype=torch.float64), *(n.reshape(-1) for n in noise))
        intrinsics = torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1).double()
        options = {"orthographic": camera.is_orthographic}
        planes = ray_march.tangent_planes(points, normals, gb.valid_mask, intrinsics, **options).flatten(2, 3)
        self.inputs = ray_march._Inputs(
            points[:, :, 0].flatten(2),
            normals[:, :, 0].flatten(2),
            torch.full((1, camera.height * camera.width), radius, dtype=torch.float64),
            torch.tensor([falloff], dtype=torch.float64),
            None if thickness is None else torch.tensor([thickness], dtype=torch.float64),
            planes.transpose(1, 2).contiguous(),
            gb.valid_mask.flatten(2).transpose(1, 2),
            intrinsics,
        )

    def visibility(self, pixel: int) -> Tensor:
        """(1,) of a flat pixel; NaN where steps leave the image, even behind a hit: the rest weighs more there."""
        block = ray_march._Block(slice(0, len(self.kernel.disk)), slice(0, 1), slice(pixel, pixel + 1))
        piece = ray_march._Piece(self.kernel, block, self.inputs, self.inputs.planes)
        weight = piece.weight.sum(0)[0]
        whole = weight > len(self.kernel.disk) - 0.5 / self.kernel.spec.steps
        return torch.where(whole, piece.visibility(*piece.leaves)[0][0] / weight, torch.nan)


def decided(
    scene: AnalyticScene, gb: ts.GBuffer, pixel: int, radius: float, *, rays: int = 192, points: int = 16
) -> float:
    """Share of a pixel's cosine-weighted rays of which the depth map shows everything up to the hit, or up to R.

    A ray that is hidden anywhere on its way (by a surface nearer to the eye, or by the screen's edge) is not decided: what
    it meets there is unknown to any technique of one depth layer, and what is behind a surface counts as solid. Nor is
    one that hits a surface seen at more than 81 degrees from its normal.
    """
    camera = gb.camera
    to_world = torch.linalg.inv(camera.world_to_view[0])
    point = camera.unproject(gb.depth)[0, :, 0].flatten(1)[:, pixel]
    ray = _rays(gb.normal[0].flatten(1)[:, pixel], rays)
    ray_world, start = ray @ to_world[:3, :3].T, to_world[:3, :3] @ point + to_world[:3, 3]
    far, surface = scene._first_hit(start.expand_as(ray), ray_world, start=_NEAR * radius)
    hit = far.clamp(max=radius)
    along = (torch.arange(points, dtype=torch.float64)[:, None] + 1) / points * hit  # (J, K)
    place = point + along[..., None] * ray
    x, y, z = place.unbind(-1)
    scale = 1.0 if camera.is_orthographic else 1 / z.clamp(min=1e-9)
    u, v = camera.fx * x * scale + camera.cx, camera.fy * y * scale + camera.cy
    seen = (z > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    away = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(place) if camera.is_orthographic else -place
    length = torch.where(seen, z, 1.0) if camera.is_orthographic else 1.0
    world, back = start + along[..., None] * ray_world, away @ to_world[:3, :3].T
    shade = scene._first_hit(world, back, start=1e-5)[0]
    normal = scene._normals(world[-1], ray_world, surface)
    facing = (normal * torch.nn.functional.normalize(back[-1], dim=1)).sum(1).abs()
    steep = (far < radius) & (facing < _FACING)
    return float(((seen & (shade >= length)).all(0) & ~steep).double().mean())


def _rays(normal: Tensor, count: int) -> Tensor:
    """(count, 3) cosine-weighted unit directions about a normal."""
    disk = poisson_disk(count, dtype=torch.float64)
    up = (1 - disk.square().sum(1)).clamp(min=0).sqrt()
    side = torch.linalg.cross(normal, torch.eye(3, dtype=torch.float64)[int(normal.abs().argmin())])
    side = side / side.norm()
    return torch.stack((disk[:, 0], disk[:, 1], up), 1) @ torch.stack((side, torch.linalg.cross(normal, side), normal))


def chosen(scene: AnalyticScene, gb: ts.GBuffer, radius: float, *, count: int = 4) -> list[int]:
    """Flat pixels about which the depth map decides, occluded by 0.02 to 0.98, four pixels or more from a crease.

    Args:
        count: at most so many, spread over the visibilities that occur.
    """
    exact, known = scene.exact(gb, radius=radius)
    normal, size = gb.normal[0], gb.camera.footprint(torch.tensor(radius).double(), gb.depth)[0, 1]
    ray = torch.zeros_like(normal)
    ray[2] = 1.0
    ray = (
        ray
        if gb.camera.is_orthographic
        else torch.nn.functional.normalize(gb.camera.unproject(gb.depth)[0, :, 0], dim=0)
    )
    clear = known[0, 0] & ((exact[0, 0] - 0.5).abs() < 0.48) & (size[0] >= _SPAN_PX)
    clear &= (normal * ray).sum(0) < -_FACING
    for axis in (1, 2):
        for shift in (-4, -3, -2, -1, 1, 2, 3, 4):  # the pixel on a crease shows one of its two surfaces
            clear &= (normal * normal.roll(shift, axis)).sum(0) > 0.95
    candidates = clear.flatten().nonzero()[:, 0]
    generator = torch.Generator().manual_seed(0)
    candidates = candidates[torch.randperm(len(candidates), generator=generator)[: 12 * count]]
    candidates = candidates[exact.flatten()[candidates].argsort()]
    good = [int(p) for p in candidates if decided(scene, gb, int(p), radius) >= 0.999]
    stride = max(1.0, (len(good) - 1) / max(count - 1, 1))
    return [good[round(i * stride)] for i in range(min(count, len(good)))]


class LimitCase:
    """A view of an analytic scene, and the pixels to be judged.

    Args:
        count: see `chosen`.
    """

    def __init__(self, scene: AnalyticScene, camera: ts.Camera, radius: float, *, count: int = 4) -> None:
        self.scene, self.radius, self.gb = scene, radius, scene.render(camera)
        self.pixels = chosen(scene, self.gb, radius, count=count)

    @staticmethod
    def of(name: str, angle: float, kind: str, *, size: int = 384, count: int = 4) -> LimitCase:
        """A scene of `SCENES` from one of the views of `ANGLES` and `KINDS`; size: image side in pixels."""
        build, radius, span = SCENES[name]
        scene = build()
        camera = scene.camera(size, size, view_angle_deg=angle, span=span, **KINDS[kind])
        if camera.is_orthographic:  # it sees less where its rectangle of rays would reach through a wall
            radius = min(radius, 0.3 * size / float(camera.fy))
        return LimitCase(scene, camera, radius, count=count)

    @staticmethod
    def between_plates(*, size: int = 384, count: int = 4) -> LimitCase:
        """The ceiling, which no view from above shows: the eye is halfway between the plates and looks along them."""
        eye, target, up = (torch.tensor(v, dtype=torch.float64) for v in ((0, 0, 0.25), (1, 0.3, 0.25), (0, 0, 1)))
        camera = ts.Camera.perspective(
            torch.tensor(120.0, dtype=torch.float64), size, size, world_to_view=ts.look_at(eye, target, up)
        )
        return LimitCase(analytic.ceiling(0.5), camera, 0.55, count=count)

    def exact(self, falloff: str, weighting: str = "cosine") -> Tensor:
        """(pixels,) of the closed form."""
        wanted = torch.zeros_like(self.gb.valid_mask)
        wanted.view(-1)[self.pixels] = True  # forms that are integrated numerically cost
        few = ts.GBuffer(self.gb.depth, self.gb.camera, normal=self.gb.normal, valid=wanted)
        answer, _ = self.scene.exact(few, radius=self.radius, falloff=falloff, weighting=weighting)
        return answer.flatten()[self.pixels]

    def horizon(self, form: str) -> Tensor:
        """(pixels,) errors of a form of `HORIZON_FORMS`."""
        options, falloff, weighting = HORIZON_FORMS[form]
        op = HorizonPixels(self.gb, radius=self.radius, **options)
        return torch.cat([op.visibility(p) for p in self.pixels]) - self.exact(falloff, weighting)

    def marched(self, falloff: str) -> Tensor:
        """Errors of the ray march with 1,024 rays of 64 steps, at the pixels all of whose steps are in the image."""
        op = MarchedPixels(self.gb, radius=self.radius, falloff=EXPONENTS[falloff])
        error = torch.cat([op.visibility(p) for p in self.pixels]) - self.exact(falloff)
        return error[~error.isnan()]
