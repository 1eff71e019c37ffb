"""G-buffers of the hard cases, float64 unless said otherwise; see `support.hard_cases`."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

import torch_ssao as ts
from support.gbuffers import plane_gbuffer, steps_gbuffer
from torch_ssao.scenes import analytic
from torch_ssao.scenes.analytic import AnalyticScene
from torch_ssao.scenes.primitives import Patch, Sphere

SIZE = (48, 64)
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def camera(height: int = SIZE[0], width: int = SIZE[1], fov_y_deg: float = 50.0) -> ts.Camera:
    return ts.Camera.perspective(fov_y_deg, height, width).to(torch.float64)


def frontal(depth: Tensor, valid: Tensor | None = None) -> ts.GBuffer:
    """Surfaces that face the camera squarely, from depth (L, H, W)."""
    height, width = depth.shape[-2:]
    normal = depth.new_tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1).expand(1, 3, height, width)
    return ts.GBuffer(depth[None], camera(height, width), normal=normal, valid=None if valid is None else valid[None])


def pillar(gap: float) -> ts.GBuffer:
    """A pillar `gap` in front of a wall at z = 6; the wall ought to be open where the gap exceeds the radius."""
    depth = torch.full((1, *SIZE), 6.0, dtype=torch.float64)
    depth[..., 8:40, 26:38] = 6.0 - gap
    return frontal(depth)


def ball(*, plane: bool) -> ts.GBuffer:
    """A sphere of radius 1 before a plane that is 5 behind its centre, or before the sky."""
    surfaces = (Sphere((0.0, 0.0, 5.0), 1.0), *((Patch((0.0, 0.0, 10.0), X, Y),) if plane else ()))
    return AnalyticScene("ball", surfaces, (), (0.0, 0.0, 5.0), 4.0).render(camera())


def rim(pixels: int = 3) -> Tensor:
    """(1, 1, H, W) bool: what lies within so many pixels of the sphere's outline."""
    inside = ball(plane=False).valid_mask.double()
    size = 2 * pixels + 1
    grown = torch.nn.functional.max_pool2d(inside, size, 1, pixels)
    return (grown + torch.nn.functional.max_pool2d(-inside, size, 1, pixels)) > 0


def steps(height: int = SIZE[0], width: int = SIZE[1]) -> ts.GBuffer:
    return steps_gbuffer(height=height, width=width, dtype=torch.float64)


def scaled(gb: ts.GBuffer, k: float) -> ts.GBuffer:
    return replace(gb, depth=gb.depth * k)


def halved(gb: ts.GBuffer) -> ts.GBuffer:
    """Every second pixel, with the camera whose pixel centres are exactly those."""
    height, width = gb.depth[..., ::2, ::2].shape[-2:]
    c = gb.camera
    half = replace(c, fx=c.fx / 2, fy=c.fy / 2, cx=c.cx / 2 + 0.25, cy=c.cy / 2 + 0.25, height=height, width=width)
    normal = None if gb.normal is None else gb.normal[..., ::2, ::2]
    return ts.GBuffer(gb.depth[..., ::2, ::2], half, normal=normal, valid=gb.valid_mask[..., ::2, ::2])


def cropped(gb: ts.GBuffer, height: int, width: int) -> ts.GBuffer:
    """The top left corner: the same pixel coordinates, hence the same noise."""
    normal = None if gb.normal is None else gb.normal[..., :height, :width]
    corner = replace(gb.camera, height=height, width=width)
    return ts.GBuffer(gb.depth[..., :height, :width], corner, normal=normal, valid=gb.valid_mask[..., :height, :width])


def wall(fov_y_deg: float = 50.0, *, orthographic: bool = False) -> ts.GBuffer:
    """A floor and an infinite wall, 2 scene units from top to bottom at the middle, 45 degrees from the floor's normal."""
    scene = analytic.wall()
    return scene.render(scene.camera(*SIZE, fov_y_deg=fov_y_deg, orthographic=orthographic))


def wall_distance(gb: ts.GBuffer) -> Tensor:
    """(1, 1, H, W) distance of the floor's pixels from the wall; inf on the wall."""
    pose = torch.linalg.inv(gb.camera.world_to_view)
    points = gb.camera.unproject(gb.depth)[:, :, 0]
    world = torch.einsum("bij,bjhw->bihw", pose[:, :3, :3], points) + pose[:, :3, 3, None, None]
    return torch.where(world[:, 2:].abs() < 1e-6, world[:, :1], torch.inf)


def quantised(depth: Tensor, far: float, bits: int = 24) -> Tensor:
    """Depth in [0, far] as a linear buffer of so many bits gives it back."""
    return (depth / far * (2**bits - 1)).round() * (far / (2**bits - 1))


def far_plane(*, normals: bool) -> ts.GBuffer:
    """Float32: a plane at z = 1e4, 60 degrees from the view, through a 24-bit buffer of range 2e4, 10 degrees of view."""
    gb = plane_gbuffer(60.0, distance=1e4, fov_y_deg=10.0, dtype=torch.float64)
    depth = quantised(gb.depth, 2e4).float()
    seen = ts.GBuffer(depth, gb.camera.to(torch.float32), normal=gb.normal.float())
    return seen if normals else ts.GBuffer.from_depth(depth, seen.camera)


def horizon(sky: float = math.inf, *, limit: float = 30.0) -> ts.GBuffer:
    """A floor seen to a distance (30: 88.7 degrees from its normal, 100: beyond 89), sky over it."""
    gb = plane_gbuffer(80.0, distance=4.0, dtype=torch.float64)
    near = gb.depth < limit
    return ts.GBuffer(torch.where(near, gb.depth, sky), gb.camera, normal=gb.normal, valid=near)


def damaged() -> ts.GBuffer:
    """NaN, infinite, zero and negative depths; zero, NaN, infinite and overlong normals at other pixels."""
    gb = steps()
    dice = torch.rand(2, *SIZE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    depth, normal = gb.depth.clone(), gb.normal.clone()
    for number, bad in enumerate((math.nan, math.inf, -math.inf, 0.0, -1.0)):
        depth[0, 0][(dice[0] * 50).long() == number] = bad
    for number, bad in enumerate((0.0, math.nan, math.inf, 100.0)):
        normal[0][:, (dice[1] * 50).long() == number] = bad
    return replace(gb, depth=depth, normal=normal, valid=None)


def absurd() -> ts.GBuffer:
    """Depths of 3e38 and 1e-20 here and there."""
    gb = steps()
    dice = torch.rand(SIZE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    depth = torch.where(dice < 0.03, 3e38, torch.where(dice > 0.97, 1e-20, gb.depth))
    return replace(gb, depth=depth)


def quantised_plane(angle: float, *, normals: bool = True) -> ts.GBuffer:
    """Float32: a plane through a 24-bit buffer of range 100, to a distance of 50."""
    gb = plane_gbuffer(angle, dtype=torch.float64)
    near = gb.depth < 50
    depth = quantised(torch.where(near, gb.depth, 1.0), 100.0).float()
    eye = gb.camera.to(torch.float32)
    if normals:
        return ts.GBuffer(depth, eye, normal=gb.normal.float(), valid=near)
    return ts.GBuffer.from_depth(depth, eye, valid=near)


def facets(count: int = 24, *, z: float = 5.0) -> ts.GBuffer:
    """A convex prism of so many sides with the normals of the cylinder it stands for: open everywhere."""
    turn, radius = 2 * math.pi / count, 1.0
    half = radius * math.tan(turn / 2)
    faces = []
    for k in range(count):
        c, s = math.cos(k * turn), math.sin(k * turn)
        faces.append(Patch((radius * c, 0.0, z + radius * s), (-s, 0.0, c), Y, u_range=(-half, half)))
    gb = AnalyticScene("facets", tuple(faces), (), (0.0, 0.0, z), 3.0).render(camera())
    points = gb.camera.unproject(torch.where(gb.valid_mask, gb.depth, 1.0))[:, :, 0]
    axis, across = (points.new_tensor(v).view(1, 3, 1, 1) for v in ((0.0, 0.0, z), (1.0, 0.0, 1.0)))
    around = (points - axis) * across
    return replace(gb, normal=torch.nn.functional.normalize(around, dim=1))


def foliage(front: float = 3.7) -> tuple[ts.GBuffer, Tensor]:
    """A plane at z = 4 behind leaves that the mask takes out, and the plane's pixels."""
    dice = torch.rand(1, 12, 16, generator=torch.Generator().manual_seed(2))
    leaf = (dice < 0.3).repeat_interleave(4, 1).repeat_interleave(4, 2)
    depth = torch.where(leaf, front, torch.full((1, *SIZE), 4.0, dtype=torch.float64))
    return frontal(depth, ~leaf), ~leaf[None]


def hidden_block(*, bar: bool, layers: int = 3) -> tuple[ts.GBuffer, Tensor]:
    """A block on a wall, hidden behind a bar near the eye (front, back, then the block), and the wall's pixels beside it."""
    none = math.inf
    depth = torch.full((3, *SIZE), none, dtype=torch.float64)
    depth[0] = 5.0
    covered = (slice(10, 38), slice(26, 38))
    if bar:
        for layer, z in enumerate((2.0, 2.1, 4.4)):
            depth[layer, covered[0], covered[1]] = z
    else:
        depth[0, covered[0], covered[1]] = 4.4
    beside = torch.zeros(1, 1, *SIZE, dtype=torch.bool)
    beside[..., 14:34, 20:26] = beside[..., 14:34, 38:44] = True
    return frontal(depth[: layers if bar else 1]), beside


def temple(height: int = SIZE[0], width: int = SIZE[1]) -> ts.GBuffer:
    return ts.scenes.render(ts.scenes.builtin("temple"), views=0, height=height, width=width)
