"""Intel's XeGTAO as an estimator on tensors: what a renderer's horizon search, tuned by hand or fitted, reaches.

Written from the formulae: the slice integral of Jimenez et al. 2016 (eq. 5 to 7) with XeGTAO's horizon falloff, sample
distribution, final power and presets. Left out: the spatial denoiser, bent normals, half precision (and its larger
depth offset), the packing of the result. Cameras may be orthographic, which the original does not support.
"""

from __future__ import annotations

import math
from typing import final

import torch
import torch.nn.functional as F
from torch import Tensor

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive
from torch_ssao.ops.sampling import GOLDEN, tiled_noise

PRESETS = {"low": (1, 2), "medium": (2, 2), "high": (3, 3), "ultra": (9, 3)}  # slices, steps a side
_PULL = 0.99999  # of the centre's depth, so that a surface does not occlude itself (single precision)
_NEAREST = 1.3  # pixels; taps keep this far from the centre
_LEVELS = 5
_STEEPEST = 1.0 - 1e-6  # cosine of a horizon: the derivative of its angle stays finite
_SKY = 1e5  # of the radius: the depth of pixels without a surface


@final
class XeGTAO(AmbientVisibility):
    """Ground-truth-style ambient occlusion as XeGTAO computes it: a module, so that it is fitted as ours are.

    Args:
        radius: of the ray-traced reference that it approximates, scene units.
        slices, steps: azimuths, and taps on each side of an azimuth; see `PRESETS`.
        radius_multiplier: taps reach as far as this times the radius.
        falloff_range: share of the reach over which an occluder's horizon sinks back to the tangent plane.
        distribution_power: taps crowd towards the centre with this power.
        final_power: of the estimate; 1 leaves it.
        floor: the least visibility after the power; None leaves it.
        fudge: pulls the projected normal's length towards 1 by this share.
        thin_occluder: share by which depth differences are stretched in the falloff, so that thin things matter less.
        depth_mips: far taps read coarser levels of the depth.
        mip_offset: log2 of the pixels from which coarser levels are read.
        contrast, denoise: of this library, after all that is XeGTAO's; 1 and 0 leave it.
    Gradients: to the parameters, almost everywhere: what a fit needs.
    Raises: ShapeError in forward for a G-buffer without normals.
    """

    PARAMETERS = {
        "radius": ParameterSpec(
            "scene units", 0.25, 4.0, "of the reference, before the multiplier", relative_bounds=True
        ),
        "falloff_range": ParameterSpec("1", 0.05, 1.0, "share of the reach over which horizons sink"),
        "distribution_power": ParameterSpec("1", 0.5, 8.0, "how taps crowd towards the centre"),
        "final_power": ParameterSpec("1", 0.3, 5.0, "exponent of the estimate"),
        "thin_occluder": ParameterSpec("1", 1e-2, 4.0, "stretch of depth differences", may_be_zero=True),
        "contrast": ParameterSpec("1", 1e-2, 1e2, "exponent of the visibility"),
    }
    CHOICES = ("slices", "steps", "radius_multiplier", "floor", "fudge", "depth_mips", "mip_offset", "denoise")

    falloff_range = Positive()
    distribution_power = Positive()
    final_power = Positive()
    thin_occluder = Positive()

    def __init__(
        self,
        radius: float,
        *,
        slices: int = 3,
        steps: int = 3,
        radius_multiplier: float = 1.457,
        falloff_range: float = 0.615,
        distribution_power: float = 2.0,
        final_power: float = 2.2,
        floor: float | None = 0.03,
        fudge: float = 0.05,
        thin_occluder: float = 0.0,
        depth_mips: bool = False,
        mip_offset: float = 3.30,
        contrast: float = 1.0,
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_positive("radius_multiplier", radius_multiplier)
        checks.check_count("slices", slices, 1)
        checks.check_count("steps", steps, 1)
        values = {
            "radius": radius,
            "falloff_range": falloff_range,
            "distribution_power": distribution_power,
            "final_power": final_power,
            "thin_occluder": thin_occluder,
            "contrast": contrast,
        }
        choices = {
            "slices": slices,
            "steps": steps,
            "radius_multiplier": radius_multiplier,
            "floor": floor,
            "fudge": fudge,
            "depth_mips": depth_mips,
            "mip_offset": mip_offset,
            "denoise": denoise,
        }
        super().__init__(values, choices, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        if normal is None:
            raise checks.ShapeError("gbuffer must have normals, got none: use GBuffer.from_depth, or pass them")
        reach = (self.radius * self.radius_multiplier).to(depth.dtype)
        pixels = _Pixels(depth[:, 0], valid[:, 0], normal, camera, reach, self.depth_mips, self.mip_offset)
        rotation, offset = tiled_noise(*pixels.size, frame, dtype=depth.dtype, device=depth.device)
        total = 0.5 * ((10.0 - pixels.reach) / 100.0).clamp(0.0, 1.0)
        for number in range(self.slices):
            total = total + self._slice(pixels, number, (number + rotation) * (math.pi / self.slices), offset)
        visibility = (total / self.slices).clamp_min(1e-6) ** self.final_power.to(depth.dtype)
        if self.floor is not None:
            visibility = visibility.clamp_min(self.floor)
        return visibility.clamp_max(1.0)

    def _slice(self, pixels: _Pixels, number: int, azimuth: Tensor, offset: Tensor) -> Tensor:
        """Visible share of one slice (B, H, W), times the projected normal's length."""
        x, y = azimuth.cos().expand_as(pixels.depth), azimuth.sin().expand_as(pixels.depth)
        direction = torch.stack((x, y, torch.zeros_like(x)), dim=-1)
        across = direction - _dot(direction, pixels.view) * pixels.view
        axis = F.normalize(torch.linalg.cross(across, pixels.view), dim=-1)
        projected = pixels.normal - _dot(axis, pixels.normal) * axis
        length = torch.linalg.vector_norm(projected, dim=-1)
        cosine = (_dot(projected, pixels.view)[..., 0] / length.clamp_min(1e-12)).clamp(0.0, 1.0)
        gamma = torch.sign(_dot(across, projected)[..., 0]) * cosine.arccos()
        weight = length + self.fudge * (1.0 - length)
        total = torch.zeros_like(length)
        for side in (1.0, -1.0):
            horizon = lowest = (gamma + side * 0.5 * math.pi).cos()
            for step in range(self.steps):
                noise = torch.frac(offset + (number + step * self.steps) * GOLDEN)
                power = self.distribution_power.to(pixels.depth.dtype)
                share = ((step + noise) / self.steps) ** power + _NEAREST / pixels.reach
                away = share * pixels.reach
                delta, seen = pixels.tap(side * away * x, side * away * y, away)
                found = self._faded(delta, seen, pixels, lowest)
                horizon = torch.maximum(horizon, found)
            angle = side * horizon.clamp(-_STEEPEST, _STEEPEST).arccos()
            total = total + 0.25 * (cosine + 2.0 * angle * gamma.sin() - (2.0 * angle - gamma).cos())
        return weight * total

    def _faded(self, delta: Tensor, seen: Tensor, pixels: _Pixels, lowest: Tensor) -> Tensor:
        """Horizon cosine of a tap, drawn to the tangent plane's as it leaves the radius."""
        stretched = delta[..., 2:] * (1.0 + self.thin_occluder.to(delta.dtype))
        distance = torch.linalg.vector_norm(torch.cat((delta[..., :2], stretched), -1), dim=-1)
        full = (self.radius * self.radius_multiplier).to(delta.dtype)
        kept = ((full - distance) / (full * self.falloff_range.to(delta.dtype))).clamp(0.0, 1.0) * seen
        cosine = (_dot(delta, pixels.view) / torch.linalg.vector_norm(delta, dim=-1, keepdim=True).clamp_min(1e-12))[
            ..., 0
        ]
        return lowest + kept * (cosine - lowest)


class _Pixels:
    """Positions, view vectors and normals (B, H, W, 3), reach in pixels, and taps.

    Args:
        depth: (B, H, W) view-space z. valid: (B, H, W) bool. normal: (B, 3, H, W).
        reach: of the taps, scene units.
        mips, mip_offset: see `XeGTAO`.
    """

    def __init__(
        self,
        depth: Tensor,
        valid: Tensor,
        normal: Tensor,
        camera: Camera,
        reach: Tensor,
        mips: bool,
        mip_offset: float,
    ) -> None:
        self.camera, self.mip_offset = camera, mip_offset
        self.size = (camera.height, camera.width)
        depth = torch.where(valid, depth, _SKY * reach.detach())
        self.sky = 0.5 * _SKY * reach.detach()
        self.depth = depth
        self.levels = [depth]
        while mips and len(self.levels) < _LEVELS and min(self.levels[-1].shape[1:]) > 1:
            self.levels.append(_coarser(self.levels[-1], 0.75 * reach))
        height, width = self.size
        self.row = torch.arange(height, device=depth.device)[:, None].expand(height, width)
        self.column = torch.arange(width, device=depth.device)[None].expand(height, width)
        self.position = self._positions(self.column, self.row, depth * _PULL)
        self.normal = normal.permute(0, 2, 3, 1)
        towards = -self.position
        if self.camera.is_orthographic:
            towards = torch.zeros_like(towards)
            towards[..., 2] = -1.0
        self.view = F.normalize(towards, dim=-1)
        focal = self.camera.fx[:, None, None].to(depth.dtype)
        self.reach = reach * focal / (1.0 if self.camera.is_orthographic else depth)

    def tap(self, right: Tensor, down: Tensor, away: Tensor) -> tuple[Tensor, Tensor]:
        """Vectors (B, H, W, 3) from the centres to the surface at whole-pixel offsets, and whether one is there."""
        height, width = self.size
        column = (self.column + right.round().long()).clamp(0, width - 1)
        row = (self.row + down.round().long()).clamp(0, height - 1)
        depth = self._read(0, column, row)
        if len(self.levels) > 1:
            level = (away.clamp_min(1.0).log2() - self.mip_offset).round().clamp(0, len(self.levels) - 1)
            for number in range(1, len(self.levels)):
                depth = torch.where(level == number, self._read(number, column, row), depth)
        return self._positions(column, row, depth) - self.position, depth < self.sky

    def _read(self, level: int, column: Tensor, row: Tensor) -> Tensor:
        image = self.levels[level]
        height, width = image.shape[1:]
        place = (row >> level).clamp_max(height - 1) * width + (column >> level).clamp_max(width - 1)
        return image.flatten(1).gather(1, place.expand(image.shape[0], *self.size).flatten(1)).view(-1, *self.size)

    def _positions(self, column: Tensor, row: Tensor, depth: Tensor) -> Tensor:
        fx, fy, cx, cy = (
            getattr(self.camera, name)[:, None, None].to(depth.dtype) for name in ("fx", "fy", "cx", "cy")
        )
        x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
        scale = torch.ones_like(depth) if self.camera.is_orthographic else depth
        return torch.stack((x * scale, y * scale, depth), dim=-1)


def _coarser(depth: Tensor, reach: float, falloff_range: float = 0.615) -> Tensor:
    """Half-size level: a mean of four depths, weighted by their nearness to the farthest, so that thin things go."""
    height, width = depth.shape[1:]
    padded = F.pad(depth[:, None], (0, width % 2, 0, height % 2), mode="replicate")[:, 0]
    four = torch.stack([padded[:, i::2, j::2] for i in (0, 1) for j in (0, 1)])
    weight = ((reach - (four.amax(0) - four)) / (reach * falloff_range)).clamp(0.0, 1.0)
    return (weight * four).sum(0) / weight.sum(0)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=-1, keepdim=True)
