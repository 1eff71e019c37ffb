"""Line-sampled volumetric obscurance (Loos and Sloan 2010): how much of each chord of a sphere lies in the solid."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from benchmarks.peers.samples import CONTRAST, RADIUS, STRENGTH, Mean, Surface, normals, open_share, turned_disk
from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive

VOLUMES = ("sphere", "doubled", "hemisphere")
_FACING = 1e-2  # of n . v: how obliquely the tangent plane may cut a chord


@final
class LineSampled(AmbientVisibility):
    """Volumetric obscurance from chords along the view axis, at points of a disk.

    A chord at offset r has half-length c = sqrt(R^2 - r^2); the solid fills it up to the height D of the surface seen there.
    obscurance = sum of filled lengths / sum of lengths.

    Args:
        radius: R of the sphere, scene units.
        volume: "sphere" - all of the chord counts, and a plane is 1/2; "doubled" - max(0, 2 V - 1) of that, so that a facing plane
            is open; "hemisphere" - what lies over the tangent plane counts: planes are open at all angles (needs normals).
        strength: of the obscurance.
        thickness: how far the solid reaches behind what is seen, of the radius; None, as published: for ever.
        samples: chords.
        contrast, denoise: of this library; 1 and 0 leave what is published.
    Gradients: to all parameters; in the radius not through which pixels are read.
    Raises: ShapeError in forward for a G-buffer without normals, with "hemisphere".
    """

    PARAMETERS = {
        "radius": RADIUS,
        "strength": STRENGTH,
        "thickness": ParameterSpec("of the radius", 1e-2, 1e2, "how far solids reach back", optional=True),
        "contrast": CONTRAST,
    }
    CHOICES = ("samples", "volume", "denoise")

    strength = Positive()
    thickness = Positive()

    samples: int
    volume: str

    def __init__(
        self,
        radius: float = 0.5,
        *,
        strength: float = 1.0,
        thickness: float | None = None,
        contrast: float = 1.0,
        samples: int = 12,
        volume: str = "hemisphere",
        denoise: int = 0,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("samples", samples, 1)
        checks.check_choice("volume", volume, VOLUMES)
        values = {"radius": radius, "strength": strength, "thickness": thickness, "contrast": contrast}
        super().__init__(values, {"samples": samples, "volume": volume, "denoise": denoise}, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        surface, radius = Surface(depth[:, 0], valid[:, 0], camera), self.radius.to(depth.dtype)
        wide, high = (length.detach() for length in surface.footprint(radius))
        thickness = None if self.thickness is None else self.thickness.to(depth.dtype)
        slope = _tangent_slope(normal) if self.volume == "hemisphere" else None
        filled, length = Mean(), Mean()
        for x, y, square in turned_disk(self.samples, frame, surface):
            column, row = (surface.column + x * wide).round(), (surface.row + y * high).round()
            found = surface.read(column, row)
            top, half = (surface.z - found) / radius, (1 - square).sqrt()
            low = -half
            if slope is not None:
                # A chord of the hemisphere begins on the tangent plane. What is seen at a whole pixel is moved to the chord
                # along that plane, so that a plane leaves all chords empty in perspective, too.
                at_x, at_y = surface.unproject(column, row, found)
                ground = slope[0] * x + slope[1] * y
                top = top + (ground - (slope[0] * (at_x - surface.x) + slope[1] * (at_y - surface.y)) / radius).clamp(
                    -1, 1
                )
                low = ground.clamp(-half, half)
            bottom = low if thickness is None else torch.maximum(low, top - thickness)
            seen = surface.on_image(found)
            filled.add((torch.minimum(top, half) - bottom).clamp_min(0), seen)
            length.add(half - low, seen)
        share = filled.total / torch.as_tensor(length.total).clamp_min(1e-6)
        if self.volume == "doubled":
            share = 2 * share - 1
        return open_share(share.clamp_min(0), self.strength)


def _tangent_slope(normal: Tensor | None) -> tuple[Tensor, Tensor]:
    """Height of the tangent plane towards the eye for a unit to the right, and for one down."""
    nx, ny, nz = normals(normal)
    per_z = 1 / nz.clamp(max=-_FACING)
    return nx * per_z, ny * per_z
