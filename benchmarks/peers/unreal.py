"""Unreal Engine 4's angle-based ambient occlusion (Mittring, "The Technology Behind the Elemental Demo", 2012).

Known, from those slides and a re-implementer's account of them: taps come in opposite pairs; a pair leaves open the share
min(1, (left + right) / pi) of its half-circle, left and right being the angles between the way to the eye - with normals, the
normal - and each tap; pairs are averaged; far pairs lose weight. Assumed here: that a pair's weight is the product over its taps of
max(0, 1 - |v| / (halo R)), and that nothing is occluded where no pair has weight. The engine's later defaults
(GTAO in its own settings) are not this.
"""

from __future__ import annotations

import math
from typing import final

import torch
from torch import Tensor

from benchmarks.peers.samples import CONTRAST, RADIUS, STRENGTH, Surface, normals, open_share, turned_disk
from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive

_STEEPEST = 1 - 1e-6  # cosine: the derivative of its angle stays finite
_REST = 1e-4  # weight of an open pair that is always there


@final
class UnrealAngle(AmbientVisibility):
    """visibility = 1 - strength (1 - mean over pairs of min(1, (left + right) / pi)), angles of at most pi/2 from the normal.

    Args:
        radius: of the disk of taps, scene units.
        strength: of the obscurance.
        halo: of the radius: taps that far away have no weight.
        pairs: of opposite taps; 6 by the account.
        contrast, denoise: of this library; 1 and 0 leave the rest.
    Gradients: to all parameters; in the radius not through which pixels are read.
    Raises: ShapeError in forward for a G-buffer without normals.
    """

    PARAMETERS = {
        "radius": RADIUS,
        "strength": STRENGTH,
        "halo": ParameterSpec("of the radius", 1e-1, 1e2, "distance at which taps lose all weight"),
        "contrast": CONTRAST,
    }
    CHOICES = ("pairs", "denoise")

    strength = Positive()
    halo = Positive()

    pairs: int

    def __init__(
        self,
        radius: float = 0.5,
        *,
        strength: float = 1.0,
        halo: float = 2.0,
        contrast: float = 1.0,
        pairs: int = 6,
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("pairs", pairs, 1)
        values = {"radius": radius, "strength": strength, "halo": halo, "contrast": contrast}
        super().__init__(values, {"pairs": pairs, "denoise": denoise}, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        nx, ny, nz = normals(normal)
        surface, radius = Surface(depth[:, 0], valid[:, 0], camera), self.radius.to(depth.dtype)
        wide, high = surface.footprint(radius.detach())
        per_halo = 1 / (radius * self.halo.to(depth.dtype))
        total = weights = torch.full_like(surface.z, _REST)
        for x, y, _ in turned_disk(self.pairs, frame, surface):
            weight: Tensor | float = 1.0
            angle: Tensor | float = 0.0
            right, down = x * wide, y * high
            for side in (1, -1):
                vx, vy, vz, _ = surface.tap(side * right, side * down)
                length = (vx * vx + vy * vy + vz * vz).clamp_min(1e-30).sqrt()
                cosine = ((vx * nx + vy * ny + vz * nz) / length).clamp(0, _STEEPEST)
                angle = angle + cosine.acos()
                weight = weight * (1 - length * per_halo).clamp_min(0)  # nothing for the sky and off the image
            total = total + weight * (angle / math.pi)
            weights = weights + weight
        return open_share(1 - total / weights, self.strength)
