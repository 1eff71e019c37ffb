"""NVIDIA's HBAO+ in the form of its public sample: obscurance averaged over taps, no horizon."""

from __future__ import annotations

import math
from typing import final

from torch import Tensor

from benchmarks.peers.samples import CONTRAST, RADIUS, STRENGTH, Mean, Surface, normals, open_share
from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive
from torch_ssao.ops.sampling import tiled_noise


@final
class HBAOPlus(AmbientVisibility):
    """visibility = max(0, 1 - strength 2 / (1 - bias) mean_i clamp(n . d_i - bias) max(0, 1 - |v_i|^2 / R^2))^final_power.

    d = v / |v|. Taps lie along `directions` rays, at pixel 1 + (k + jitter) R_px / (steps + 1), k = 0 ... steps - 1. Two
    occluders in one direction count twice.

    Args:
        radius: R, scene units.
        strength: of the obscurance. bias: sine of the elevation below which nothing occludes. final_power: of the estimate.
        directions, steps: taps are their product.
        contrast, denoise: of this library; 1 and 0 leave what is NVIDIA's. Its own blur is left out.
    Gradients: to all parameters; in the radius not through which pixels are read.
    Raises: ShapeError in forward for a G-buffer without normals.
    """

    PARAMETERS = {
        "radius": RADIUS,
        "strength": STRENGTH,
        "bias": ParameterSpec("1", 1e-3, 0.7, "sine of the least elevation of an occluder", may_be_zero=True),
        "final_power": ParameterSpec("1", 0.3, 5.0, "exponent of the estimate"),
        "contrast": CONTRAST,
    }
    CHOICES = ("directions", "steps", "denoise")

    strength = Positive()
    bias = Positive()
    final_power = Positive()

    directions: int
    steps: int

    def __init__(
        self,
        radius: float = 0.5,
        *,
        strength: float = 1.0,
        bias: float = 0.1,
        final_power: float = 1.5,
        contrast: float = 1.0,
        directions: int = 8,
        steps: int = 4,
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("directions", directions, 1)
        checks.check_count("steps", steps, 1)
        values = {
            "radius": radius,
            "strength": strength,
            "bias": bias,
            "final_power": final_power,
            "contrast": contrast,
        }
        super().__init__(values, {"directions": directions, "steps": steps, "denoise": denoise}, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        nx, ny, nz = normals(normal)
        surface, radius = Surface(depth[:, 0], valid[:, 0], camera), self.radius.to(depth.dtype)
        turn, jitter = tiled_noise(*surface.size, frame, dtype=depth.dtype, device=depth.device)
        wide, high = (length / (self.steps + 1) for length in surface.footprint(radius.detach()))
        bias, per_square = self.bias.to(depth.dtype), 1 / radius**2
        mean = Mean()
        for direction in range(self.directions):
            angle = (direction + turn) * (2 * math.pi / self.directions)
            cosine, sine = angle.cos(), angle.sin()
            for step in range(self.steps):
                away = step + jitter
                vx, vy, vz, found = surface.tap(cosine * (1 + away * wide), sine * (1 + away * high))
                square = vx * vx + vy * vy + vz * vz
                sine_over = (vx * nx + vy * ny + vz * nz) * square.clamp_min(1e-30).rsqrt()
                kept = (1 - square * per_square).clamp_min(0)
                mean.add((sine_over - bias).clamp(0, 1) * kept, surface.on_image(found))
        visibility = open_share(2 / (1 - bias) * mean.value(), self.strength)
        return visibility.clamp_min(1e-6) ** self.final_power.to(depth.dtype)  # no derivative at 0
