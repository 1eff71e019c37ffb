"""Screen-space visibility bitmask (Therrien, Levesque and Gilet 2023), with 32 uniform sectors as published."""

from __future__ import annotations

import math
from typing import final

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.peers.samples import CONTRAST, RADIUS, Surface, normals
from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive
from torch_ssao.ops.sampling import tiled_noise

SECTORS = 32


@final
class VisibilityBitmask(AmbientVisibility):
    """Share of 32 equal sectors about the projected normal that no tap's interval from front to back covers, over slices.

    A tap at v covers the angles from v to v - thickness R e, e the way to the eye from the pixel. The ends of the interval are
    rounded to sectors. Every sector and every slice counts alike: no cosine. Sectors are bits, of which derivatives see nothing.

    Args:
        radius: reach of the taps, scene units. There is no falloff: the thickness is what far things fade by.
        thickness: of every occluder, of the radius; None: infinite, the interval ends at the tangent plane's horizon.
        slices, steps: azimuths, and taps on either side of each, evenly spaced.
        contrast, denoise: of this library; 1 and 0 leave what is published.
    Gradients: to the contrast alone. Fit the rest by search: scan and polish of `fitting.fit` see them.
    Raises: ShapeError in forward for a G-buffer without normals.
    """

    PARAMETERS = {
        "radius": RADIUS,
        "thickness": ParameterSpec("of the radius", 1e-2, 1e1, "how far occluders reach back", optional=True),
        "contrast": CONTRAST,
    }
    CHOICES = ("slices", "steps", "denoise")

    thickness = Positive()

    slices: int
    steps: int

    def __init__(
        self,
        radius: float = 0.5,
        *,
        thickness: float | None = 0.5,
        contrast: float = 1.0,
        slices: int = 2,
        steps: int = 8,
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("slices", slices, 1)
        checks.check_count("steps", steps, 1)
        values = {"radius": radius, "thickness": thickness, "contrast": contrast}
        super().__init__(values, {"slices": slices, "steps": steps, "denoise": denoise}, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        surface, radius = Surface(depth[:, 0], valid[:, 0], camera), self.radius.to(depth.dtype)
        turn, jitter = tiled_noise(*surface.size, frame, dtype=depth.dtype, device=depth.device)
        wide, high = surface.footprint(radius)
        back = None if self.thickness is None else radius * self.thickness.to(depth.dtype)
        view = _view(surface)
        open_bits = torch.zeros_like(surface.z)
        for number in range(self.slices):
            azimuth = (number + turn) * (math.pi / self.slices)
            cosine, sine = azimuth.cos(), azimuth.sin()
            plane = _Slice(cosine, sine, view, normals(normal))
            covered = torch.zeros(surface.z.shape, dtype=torch.int64, device=depth.device)
            for side in (1, -1):
                for step in range(self.steps):
                    share = side * (step + jitter) / self.steps
                    # A tap is at least a pixel away: its own pixel says nothing.
                    right, down = cosine * (share * wide + side), sine * (share * high + side)
                    vx, vy, vz, _ = surface.tap(right, down)
                    covered = covered | plane.sectors(vx, vy, vz, back, side)
            open_bits = open_bits + (SECTORS - _bits(covered)).to(depth.dtype)
        return open_bits / (SECTORS * self.slices)


class _Slice:
    """Plane through the eye and the pixel; angles in it run from the view direction towards the slice's own.

    Args:
        cosine, sine: (H, W) of the azimuth. view: unit components towards the eye. normal: unit components.
    """

    def __init__(
        self, cosine: Tensor, sine: Tensor, view: tuple[Tensor, ...], normal: tuple[Tensor, Tensor, Tensor]
    ) -> None:
        ex, ey, ez = view
        along = cosine * ex + sine * ey
        tx, ty, tz = cosine - along * ex, sine - along * ey, -along * ez
        scale = (tx * tx + ty * ty + tz * tz).rsqrt()
        self.view, self.turned = view, (tx * scale, ty * scale, tz * scale)
        nx, ny, nz = normal
        self.gamma = torch.atan2(
            nx * self.turned[0] + ny * self.turned[1] + nz * self.turned[2], nx * ex + ny * ey + nz * ez
        )

    def sectors(self, vx: Tensor, vy: Tensor, vz: Tensor, back: Tensor | None, side: int) -> Tensor:
        """Bits (B, H, W) int64 that a tap covers; none for the sky."""
        (ex, ey, ez), (tx, ty, tz) = self.view, self.turned
        out, up = vx * tx + vy * ty + vz * tz, vx * ex + vy * ey + vz * ez
        # Whole pixels may lie across the axis; a tap belongs to its side.
        out = side * (side * out).clamp_min(0)
        front = torch.atan2(out, up)
        # The angles from the normal as shares of the half-circle about it.
        first = (front - self.gamma) / math.pi + 0.5
        behind = 1.0 if side > 0 else 0.0
        last = behind if back is None else (torch.atan2(out, up - back) - self.gamma) / math.pi + 0.5
        low, high = (first, last) if side > 0 else (last, first)
        low, high = (_edge(value, first) for value in (low, high))
        bits = (1 << high) - (1 << low)
        return bits * ((high > low) & (vz < 1e12))


def _edge(value: Tensor | float, like: Tensor) -> Tensor:
    value = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    return (SECTORS * value.clamp(0, 1)).round().long()


def _view(surface: Surface) -> tuple[Tensor, ...]:
    """Unit components towards the eye."""
    if surface.orthographic:
        return torch.zeros_like(surface.z), torch.zeros_like(surface.z), -torch.ones_like(surface.z)
    return F.normalize(-torch.stack((surface.x, surface.y, surface.z), 0), dim=0).unbind(0)


def _bits(mask: Tensor) -> Tensor:
    """Number of bits set of (...) int64 that hold 32."""
    mask = mask - ((mask >> 1) & 0x55555555)
    mask = (mask & 0x33333333) + ((mask >> 2) & 0x33333333)
    mask = (mask + (mask >> 4)) & 0x0F0F0F0F
    return (mask * 0x01010101 >> 24) & 0xFF
