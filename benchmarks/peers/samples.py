"""What the peers share: a depth map that a tap reads once, points of a ball and of a disk, per-pixel noise.

The map has a border of one pixel and no holes: where there is no surface its depth is `SKY`, and on the border more
still, so that one read tells a surface from the sky (open) and from what is off the image (not counted).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import ParameterSpec
from torch_ssao.ops.sampling import poisson_disk, tiled_noise

SKY = 1e13  # beyond every valid depth, and its square is far from overflow in float32
BORDER, _OFF = 1e14, 3e13
_LARGEST = 2**24  # pixels that a float32 counts
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PLASTIC = 0.7548776662466927
_IN_FRONT = 1e-3  # of the pixel's depth: points nearer to the eye plane are not looked up

RADIUS = ParameterSpec("scene units", 1 / 64, 64.0, "distance within which it looks", relative_bounds=True)
STRENGTH = ParameterSpec("1", 1e-2, 1e2, "factor of the obscurance")
CONTRAST = ParameterSpec("1", 1e-2, 1e2, "exponent of the visibility")


class Surface:
    """Positions x, y, z (B, H, W) of the pixels, and reads of the depth map beside them.

    Args:
        depth: (B, H, W) view-space z, finite. valid: (B, H, W) bool. camera: of B images.
    Raises: RangeError for an image of more than 2^24 pixels, whose number a float32 does not hold.
    """

    def __init__(self, depth: Tensor, valid: Tensor, camera: Camera) -> None:
        height, width = camera.height, camera.width
        if (height + 2) * (width + 2) > _LARGEST:
            raise checks.RangeError(f"gbuffer must have at most 2^24 pixels, got {height}x{width}: cut it up")
        self.map = F.pad(torch.where(valid, depth, SKY), (1, 1, 1, 1), value=BORDER).flatten(1)
        self.size, self.orthographic = (height, width), camera.is_orthographic
        fx, fy, cx, cy = (getattr(camera, n)[:, None, None].to(depth.dtype) for n in ("fx", "fy", "cx", "cy"))
        # Pixel coordinates count the border: column 1 is the first of the image, and its centre lies at cx + 1/2.
        self.fx, self.fy, self.cx, self.cy = fx, fy, cx + 0.5, cy + 0.5
        self.per_x, self.per_y = 1 / fx, 1 / fy
        self.column = torch.arange(1, width + 1, dtype=depth.dtype, device=depth.device)
        self.row = torch.arange(1, height + 1, dtype=depth.dtype, device=depth.device)[:, None]
        self.z = depth
        self.x, self.y = self.unproject(self.column, self.row, depth)  # as for taps, so that a pixel is 0 from itself

    def footprint(self, radius: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (B, H, W) that a length spans to the right and down at every pixel."""
        if self.orthographic:
            return (radius * self.fx).expand_as(self.z), (radius * self.fy).expand_as(self.z)
        share = radius / self.z
        return share * self.fx, share * self.fy

    def read(self, column: Tensor, row: Tensor) -> Tensor:
        """Depth (B, H, W) at whole pixels; `SKY` where nothing is seen, more off the image (see `on_image`)."""
        height, width = self.size
        place = row.clamp(0, height + 1) * (width + 2) + column.clamp(0, width + 1)
        return self.map.gather(1, place.detach().long().flatten(1)).view_as(place)

    @staticmethod
    def on_image(depth: Tensor) -> Tensor:
        """1 where a depth was read on the image, 0 elsewhere."""
        return (depth < _OFF).to(depth.dtype)

    def tap(self, right: Tensor, down: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Vector from every pixel to the surface an offset in pixels away, rounded to whole ones, and the depth there."""
        column, row = (self.column + right.detach()).round(), (self.row + down.detach()).round()
        depth = self.read(column, row)
        x, y = self.unproject(column, row, depth)
        return x - self.x, y - self.y, depth - self.z, depth

    def unproject(self, column: Tensor, row: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """View-space x and y of pixel centres at a depth."""
        x, y = (column - self.cx) * self.per_x, (row - self.cy) * self.per_y
        return (x, y) if self.orthographic else (x * depth, y * depth)

    def behind(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """How far pixel + (x, y, z) lies behind the surface seen there, along z, and 1 where the image shows it."""
        x, y, z = self.x + x, self.y + y, self.z + z
        if self.orthographic:
            depth = self.read((x * self.fx + self.cx).round(), (y * self.fy + self.cy).round())
            return z - depth, self.on_image(depth)
        safe = torch.maximum(z, _IN_FRONT * self.z).detach()
        scale = 1 / safe
        column = (x.detach() * scale * self.fx + self.cx).round()
        row = (y.detach() * scale * self.fy + self.cy).round()
        depth = self.read(column, row)
        return z - depth, self.on_image(depth) * (z == safe)


class Mean:
    """Mean of what the taps on the image say; 0 where there are none."""

    def __init__(self) -> None:
        self.total: Tensor | float = 0.0
        self.count: Tensor | float = 0.0

    def add(self, value: Tensor, seen: Tensor) -> None:
        self.total = self.total + value * seen
        self.count = self.count + seen

    def value(self) -> Tensor:
        return self.total / torch.as_tensor(self.count).clamp_min(1.0)


def open_share(obscurance: Tensor, strength: Tensor) -> Tensor:
    """Visibility 1 - strength * obscurance, kept in [0, 1]."""
    return (1 - strength.to(obscurance.dtype) * obscurance).clamp(0, 1)


def normals(normal: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Components (B, H, W). Raises: ShapeError without normals."""
    if normal is None:
        raise checks.ShapeError("gbuffer must have normals, got none: use GBuffer.from_depth, or pass them")
    x, y, z = normal.unbind(1)
    return x, y, z


def ball_points(count: int) -> list[tuple[float, float, float]]:
    """Points of the unit ball, evenly in volume: a spiral over the sphere, cubed radii by a low-discrepancy sequence."""
    checks.check_count("samples", count, 1)
    points = []
    for i in range(count):
        z, angle = 1 - (2 * i + 1) / count, i * _GOLDEN_ANGLE
        ring, radius = math.sqrt(1 - z * z), math.fmod((i + 0.5) * _PLASTIC, 1.0) ** (1 / 3)
        points.append((radius * ring * math.cos(angle), radius * ring * math.sin(angle), radius * z))
    return points


def reflected_ball(count: int, frame: int, like: Surface, radius: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """`ball_points` times the radius, mirrored at a plane through the centre whose normal differs from pixel to pixel."""
    turn, level = tiled_noise(*like.size, frame, dtype=like.z.dtype, device=like.z.device)
    mz = 1 - 2 * level
    ring = (1 - mz * mz).clamp_min(0).sqrt()
    mx, my = ring * (2 * math.pi * turn).cos(), ring * (2 * math.pi * turn).sin()
    for x, y, z in ball_points(count):
        twice = 2 * (x * mx + y * my + z * mz)
        yield radius * (x - twice * mx), radius * (y - twice * my), radius * (z - twice * mz)


def turned_disk(count: int, frame: int, like: Surface) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Points of the unit disk, one a ring of equal area, turned and moved within the rings from pixel to pixel.

    Yields: x, y and squared radius, (H, W).
    """
    turn, offset = tiled_noise(*like.size, frame, dtype=like.z.dtype, device=like.z.device)
    cosine, sine = (2 * math.pi * turn).cos(), (2 * math.pi * turn).sin()
    for number, (x, y) in enumerate(poisson_disk(count, dtype=torch.float64).tolist()):
        square = (number + offset) / count
        scale = square.sqrt() / math.hypot(x, y)
        yield (x * cosine - y * sine) * scale, (x * sine + y * cosine) * scale, square
