"""StarCraft II (Filion and McNaughton 2008): points of the hemisphere, and a function of how far they lie behind."""

from __future__ import annotations

from typing import final

from torch import Tensor

from benchmarks.peers.samples import CONTRAST, RADIUS, STRENGTH, Mean, Surface, normals, open_share, reflected_ball
from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive


@final
class StarCraft(AmbientVisibility):
    """Point-sampled obscurance of the hemisphere about the normal: a plane is open.

    visibility = 1 - strength mean_i f((z(p_i) - depth(p_i)) / R), p_i = x + R o_i, the o_i mirrored at a plane of each pixel's
    own and turned over where they point into the surface. f is 0 below `bias`, 1 up to `full`, and falls as
    (1 - (d - full) / fade)^power to 0. The publication describes f in words; that form of it is assumed.

    Args:
        radius: R of the hemisphere, scene units.
        strength: of the obscurance.
        full, fade, bias: of the radius: where f starts to fall, over what length, and where it starts.
        power: of the fall.
        samples: points, evenly in volume (assumed).
        contrast: the published power curve at the end; denoise: of this library.
    Gradients: to all parameters but the bias, through f; a point's being behind is a decision.
    Raises: ShapeError in forward for a G-buffer without normals.
    """

    PARAMETERS = {
        "radius": RADIUS,
        "strength": STRENGTH,
        "full": ParameterSpec("of the radius", 1e-2, 1e2, "how far behind a surface points count in full"),
        "fade": ParameterSpec("of the radius", 1e-2, 1e2, "length over which they stop to count"),
        "power": ParameterSpec("1", 1e-1, 1e1, "exponent of the fall"),
        "bias": ParameterSpec("of the radius", 1e-4, 1.0, "how far behind points start to count", may_be_zero=True),
        "contrast": CONTRAST,
    }
    CHOICES = ("samples", "denoise")

    strength = Positive()
    full = Positive()
    fade = Positive()
    power = Positive()
    bias = Positive()

    samples: int

    def __init__(
        self,
        radius: float = 0.5,
        *,
        strength: float = 1.0,
        full: float = 1.0,
        fade: float = 1.0,
        power: float = 1.0,
        bias: float = 0.02,
        contrast: float = 1.0,
        samples: int = 16,
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("samples", samples, 1)
        values = {"radius": radius, "strength": strength, "full": full, "fade": fade, "power": power, "bias": bias}
        super().__init__(values | {"contrast": contrast}, {"samples": samples, "denoise": denoise}, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        nx, ny, nz = normals(normal)
        surface, dtype = Surface(depth[:, 0], valid[:, 0], camera), depth.dtype
        radius, power = self.radius.to(dtype), self.power.to(dtype)
        start, fade = (radius * value.to(dtype) for value in (self.bias, self.fade))
        end = 1 + self.full.to(dtype) / self.fade.to(dtype)  # 1 - (d - full) / fade = end - d / fade
        mean = Mean()
        for x, y, z in reflected_ball(self.samples, frame, surface, radius):
            side = 1 - 2 * (x * nx + y * ny + z * nz < 0).to(dtype)
            behind, seen = surface.behind(x * side, y * side, z * side)
            # Not from 0: its power has no derivative there.
            kept = (end - behind / fade).clamp(1e-6, 1) ** power
            mean.add(kept * (behind > start), seen)
        return open_share(mean.value(), self.strength)
