"""Alchemy (McGuire et al. 2011) and Scalable Ambient Obscurance (McGuire, Mara and Luebke 2012)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import final

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.peers.samples import BORDER, CONTRAST, RADIUS, STRENGTH, Mean, Surface, normals, open_share, turned_disk
from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive
from torch_ssao.ops.sampling import tiled_noise

_BIAS = ParameterSpec("of the radius", 1e-4, 1.0, "height over the tangent plane that does not count", may_be_zero=True)
_BIAS_BY_DEPTH = ParameterSpec("of the depth", 1e-6, 0.1, "height that does not count", may_be_zero=True)
_LEVELS = 5
_FULL_TO = 3  # taps from 2^(3 + l) pixels on read level l: full depth up to 16


@final
class Alchemy(AmbientVisibility):
    """visibility = max(0, 1 - strength 2/N sum_i max(0, v_i . n - bias z) / (v_i . v_i + epsilon))^contrast, lengths in radii.

    Points lie evenly on the disk that the radius spans in the image. The published falloff cancels the cosine's length, so a
    tap beyond the radius still counts, by the inverse of its distance.

    Args:
        radius: of the disk, scene units. The published v is in scene units with a radius near 1 (0.5 as given); here it is in
            radii, so that the module moves between scenes.
        strength: sigma. bias: of the pixel's depth, so it grows with it, as published.
        epsilon: keeps the division finite, of the radius squared.
        samples: points.
        contrast: k; denoise: of this library.
    Gradients: to all parameters; in the radius not through which pixels are read.
    Raises: ShapeError in forward for a G-buffer without normals.
    """

    PARAMETERS = {"radius": RADIUS, "strength": STRENGTH, "bias": _BIAS_BY_DEPTH, "contrast": CONTRAST}
    CHOICES = ("samples", "epsilon", "denoise")

    strength = Positive()
    bias = Positive()

    samples: int
    epsilon: float

    def __init__(
        self,
        radius: float = 0.5,
        *,
        strength: float = 1.0,
        bias: float = 1e-4,
        contrast: float = 1.0,
        samples: int = 12,
        epsilon: float = 1e-4,
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("samples", samples, 1)
        checks.check_positive("epsilon", epsilon)
        values = {"radius": radius, "strength": strength, "bias": bias, "contrast": contrast}
        super().__init__(values, {"samples": samples, "epsilon": epsilon, "denoise": denoise}, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        nx, ny, nz = normals(normal)
        surface, radius = Surface(depth[:, 0], valid[:, 0], camera), self.radius.to(depth.dtype)
        wide, high = surface.footprint(radius.detach())
        bias = self.bias.to(depth.dtype) * surface.z
        mean = Mean()
        for x, y, _ in turned_disk(self.samples, frame, surface):
            vx, vy, vz, found = surface.tap(x * wide, y * high)
            height = (vx * nx + vy * ny + vz * nz - bias) / radius
            square = (vx * vx + vy * vy + vz * vz) / radius**2 + self.epsilon
            mean.add(height.clamp_min(0) / square, surface.on_image(found))
        return open_share(2 * mean.value(), self.strength)


@final
class SAO(AmbientVisibility):
    """visibility = max(0, 1 - strength 5/N sum_i f_i^3 max(0, v_i . n - bias) / (v_i . v_i + epsilon)), v in radii.

    f = max(0, 1 - v . v): variant B, the one that was shipped. Taps lie on a spiral, evenly in distance, which turns from pixel to
    pixel; far ones read coarser levels of the depth, each a sub-sampled copy of the one before on a rotated grid.

    Args:
        radius: scene units.
        strength: sigma. bias, epsilon: of the radius and its square; as shipped for a radius of 1 unit.
        samples, turns: taps and turns of the spiral.
        mips: read coarser levels from 16 pixels on; False reads the full map.
        contrast, denoise: of this library; 1 and 0 leave what was shipped. Its own blur is left out.
    Gradients: to all parameters; in the radius not through which pixels are read.
    Raises: ShapeError in forward for a G-buffer without normals.
    """

    PARAMETERS = {"radius": RADIUS, "strength": STRENGTH, "bias": _BIAS, "contrast": CONTRAST}
    CHOICES = ("samples", "turns", "epsilon", "mips", "denoise")

    strength = Positive()
    bias = Positive()

    samples: int
    turns: int
    epsilon: float
    mips: bool

    def __init__(
        self,
        radius: float = 0.5,
        *,
        strength: float = 1.0,
        bias: float = 0.01,
        contrast: float = 1.0,
        samples: int = 11,
        turns: int = 7,
        epsilon: float = 0.01,
        mips: bool = True,
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("samples", samples, 1)
        checks.check_count("turns", turns, 1)
        checks.check_positive("epsilon", epsilon)
        values = {"radius": radius, "strength": strength, "bias": bias, "contrast": contrast}
        choices = {"samples": samples, "turns": turns, "epsilon": epsilon, "mips": mips, "denoise": denoise}
        super().__init__(values, choices, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        nx, ny, nz = normals(normal)
        surface, radius = Surface(depth[:, 0], valid[:, 0], camera), self.radius.to(depth.dtype)
        wide, high = surface.footprint(radius.detach())
        pyramid = _Pyramid(surface, wide) if self.mips else None
        bias = self.bias.to(depth.dtype)
        mean = Mean()
        for x, y, share in self._spiral(frame, surface):
            if pyramid is None:
                vx, vy, vz, found = surface.tap(x * wide, y * high)
            else:
                vx, vy, vz, found = pyramid.tap(x * wide, y * high, share)
            square = (vx * vx + vy * vy + vz * vz) / radius**2
            height = ((vx * nx + vy * ny + vz * nz) / radius - bias).clamp_min(0)
            near = (1 - square).clamp_min(0)
            mean.add(near * near * near * height / (square + self.epsilon), surface.on_image(found))
        return open_share(5 * mean.value(), self.strength)

    def _spiral(self, frame: int, surface: Surface) -> Iterator[tuple[Tensor, Tensor, float]]:
        """Offsets (H, W) in radii, and their length."""
        turn, _ = tiled_noise(*surface.size, frame, dtype=surface.z.dtype, device=surface.z.device)
        cosine, sine = (2 * math.pi * turn).cos(), (2 * math.pi * turn).sin()
        for number in range(self.samples):
            share = (number + 0.5) / self.samples
            angle = 2 * math.pi * self.turns * share
            x, y = share * math.cos(angle), share * math.sin(angle)
            yield x * cosine - y * sine, x * sine + y * cosine, share


class _Pyramid:
    """Levels of the depth map below one another in one image, so that a tap of any level is one read."""

    def __init__(self, surface: Surface, wide: Tensor) -> None:
        self.surface = surface
        height, width = (size + 2 for size in surface.size)
        unit = 2**_LEVELS
        level = F.pad(surface.map.view(-1, height, width), (0, -width % unit, 0, -height % unit), value=BORDER)
        self.rows, self.stride = level.shape[1:]
        levels = [level]
        for _ in range(_LEVELS):
            level = _rotated_half(level)
            levels.append(F.pad(level, (0, self.stride - level.shape[2])))
        self.map = torch.cat(levels, 1).flatten(1)
        self.reach = wide.log2()
        self.furthest = float(wide.max())

    def tap(self, right: Tensor, down: Tensor, share: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`Surface.tap` with the depth of the level for taps at a share of the radius."""
        surface = self.surface
        if share * self.furthest < 2 ** (_FULL_TO + 1):
            return surface.tap(right, down)
        height, width = surface.size
        column, row = (surface.column + right).round(), (surface.row + down).round()
        scale = torch.exp2(-(self.reach + (math.log2(share) - _FULL_TO)).floor().clamp(0, _LEVELS))
        # Levels are half as high each: level l begins at row 2 rows (1 - 2^-l).
        line = 2 * self.rows * (1 - scale) + (row.clamp(0, height + 1) * scale).floor()
        place = line * self.stride + (column.clamp(0, width + 1) * scale).floor()
        depth = self.map.gather(1, place.long().flatten(1)).view_as(place)
        x, y = surface.unproject(column, row, depth)
        return x - surface.x, y - surface.y, depth - surface.z, depth


def _rotated_half(level: Tensor) -> Tensor:
    """Every second pixel of every second row, moved by one where the column, or the row, of the result is odd."""
    height, width = level.shape[1:]
    rows = torch.arange(height // 2, device=level.device)[:, None]
    columns = torch.arange(width // 2, device=level.device)[None]
    return level[:, 2 * rows + (columns & 1), 2 * columns + (rows & 1)]
