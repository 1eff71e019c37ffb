"""Crytek's point sampling (Mittring 2007): the share of a sphere of points that lies behind the depth map."""

from __future__ import annotations

from typing import final

from torch import Tensor

from benchmarks.peers.samples import CONTRAST, RADIUS, STRENGTH, Mean, Surface, open_share, reflected_ball
from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive


@final
class Crytek(AmbientVisibility):
    """Point-sampled obscurance of a full sphere, without normals: a plane is 1/2, an edge that sticks out is brighter.

    visibility = 1 - strength mean_i [z(p_i) > depth(p_i)], p_i = x + R o_i, the o_i mirrored at a plane of each pixel's own.

    Args:
        radius: R of the sphere, scene units.
        strength: of the obscurance; 1 is the published form, 2 makes a plane black.
        reach: of the radius: a point counts in full up to this far behind the surface, not at all from twice as far on. The
            published text asks for a range check and does not give its form; None leaves it out.
        samples: points.
        contrast, denoise: of this library; 1 and 0 leave what is Crytek's.
    Gradients: to strength, reach and contrast; to the radius only through `reach`, as hits are decisions.
    """

    PARAMETERS = {
        "radius": RADIUS,
        "strength": STRENGTH,
        "reach": ParameterSpec("of the radius", 1e-2, 1e2, "how far behind a surface points are hidden", optional=True),
        "contrast": CONTRAST,
    }
    CHOICES = ("samples", "denoise")

    strength = Positive()
    reach = Positive()

    samples: int

    def __init__(
        self,
        radius: float = 0.5,
        *,
        strength: float = 1.0,
        reach: float | None = None,
        contrast: float = 1.0,
        samples: int = 16,
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("samples", samples, 1)
        values = {"radius": radius, "strength": strength, "reach": reach, "contrast": contrast}
        super().__init__(values, {"samples": samples, "denoise": denoise}, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        surface, radius = Surface(depth[:, 0], valid[:, 0], camera), self.radius.to(depth.dtype)
        length = None if self.reach is None else radius * self.reach.to(depth.dtype)
        mean = Mean()
        for x, y, z in reflected_ball(self.samples, frame, surface, radius):
            behind, seen = surface.behind(x, y, z)
            hidden = (behind > 0).to(behind.dtype)
            if length is not None:
                hidden = hidden * (2 - behind / length).clamp(0, 1)
            mean.add(hidden, seen)
        return open_share(mean.value(), self.strength)
