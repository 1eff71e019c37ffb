"""Ray-marched screen-space ambient occlusion as a module."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive
from torch_ssao.ops.backend import BACKENDS
from torch_ssao.ops.depth_pyramid import furthest_read
from torch_ssao.ops.normals import normals_from_points
from torch_ssao.ops.ray_march import GRADIENTS, ray_march_visibility
from torch_ssao.ops.sampling import poisson_disk, tiled_noise


@final
class RayMarchedSSAO(AmbientVisibility):
    """Ray-marched ambient occlusion: the plain ambient-occlusion integral, with rays that see the depth layers.

    Normals are taken from the G-buffer, or estimated from the depth where it has none (`ops.normals`).

    Args:
        radius: length of the rays, scene units, > 0.
        falloff: exponent p of the attenuation 1 - (distance / radius)^p, > 0; 1 is the paper's, large is binary.
        contrast: exponent of the visibility, > 0.
        rays: rays a pixel, >= 1.
        steps: steps a ray, >= 1, uniform.
        thickness: how far solids reach behind their last known surface, of the radius, > 0; None: for ever. The default is the
            best of benchmarks/results/default_thickness.json at the default falloff; it is the parameter to fit.
        gradient: "exact", "surrogate" or "soft"; see `ops.ray_march`. With "exact" the gradient to
            thickness is 0.
        surrogate_width: width of the sigmoid of "surrogate" and "soft", of the radius, > 0.
        max_radius_px: steps further than this many pixels from their pixel read a coarser level of a pyramid of selected
            pixels (`ops.depth_pyramid`), so that reads stay near each other; what lies between the selected pixels may be
            missed. Where the radius spans more than 32 times as many, it is shortened: less far-reaching occlusion there.
            None: every step reads its own pixel.
        denoise: passes of `ops.denoise.denoise_visibility`, before the contrast.
        half_resolution: compute the pixels of even rows and columns only and carry them to the others along surfaces
            (`ops.upsample`): a third to two thirds of the time; what is thinner than two pixels may be missed.
        learnable: names of the parameters to register as `nn.Parameter`s, or "all"; the rest are buffers.
    Raises:
        RangeError, ChoiceError.
    Gradients, Cost, Source: see `ops.ray_march.ray_march_visibility`.
    """

    PARAMETERS = {
        "radius": ParameterSpec("scene units", 1 / 64, 64.0, "length of the rays", relative_bounds=True),
        "falloff": ParameterSpec("1", 1e-1, 1e2, "exponent of the attenuation with distance"),
        "thickness": ParameterSpec("of the radius", 1e-2, 1e2, "depth of solids behind their surface", optional=True),
        "contrast": ParameterSpec("1", 1e-2, 1e2, "exponent of the visibility"),
    }
    CHOICES = ("rays", "steps", "gradient", "surrogate_width", "max_radius_px", "denoise", "half_resolution")

    BACKENDS = BACKENDS

    falloff = Positive()
    thickness = Positive()

    rays: int
    steps: int
    gradient: str
    surrogate_width: float
    max_radius_px: float | None

    def __init__(
        self,
        radius: float = 0.5,
        *,
        falloff: float = 1.0,
        contrast: float = 1.0,
        rays: int = 16,
        steps: int = 8,
        thickness: float | None = 0.5,
        gradient: str = "exact",
        surrogate_width: float = 0.05,
        max_radius_px: float | None = None,
        denoise: int = 0,
        half_resolution: bool = False,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_choice("half_resolution", half_resolution, (False, True))
        for name, count, low in (("rays", rays, 1), ("steps", steps, 1), ("denoise", denoise, 0)):
            checks.check_count(name, count, low)
        checks.check_choice("gradient", gradient, GRADIENTS)
        checks.check_positive("surrogate_width", surrogate_width)
        if max_radius_px is not None:
            checks.check_positive("max_radius_px", max_radius_px)
        values = {"radius": radius, "falloff": falloff, "thickness": thickness, "contrast": contrast}
        choices = {
            "rays": rays,
            "steps": steps,
            "gradient": gradient,
            "surrogate_width": surrogate_width,
            "max_radius_px": max_radius_px,
            "denoise": denoise,
            "half_resolution": half_resolution,
        }
        super().__init__(values, choices, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        batch, layers, height, width = depth.shape
        points = camera.unproject(depth)
        rotation, offset = tiled_noise(height, width, frame, dtype=depth.dtype, device=depth.device)
        radius, falloff = (value.to(depth.dtype).expand(batch) for value in (self.radius, self.falloff))
        thickness = None if self.thickness is None else self.thickness.to(depth.dtype).expand(batch)
        intrinsics = torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1).to(depth.dtype)
        nearest = normals_from_points(points[:, :, 0], valid[:, 0]) if normal is None else normal
        deeper = [normals_from_points(points[:, :, layer], valid[:, layer]) for layer in range(1, layers)]
        return ray_march_visibility(
            points,
            valid,
            torch.stack((nearest, *deeper), 2),
            self._reach(radius, depth[:, 0], camera),
            falloff,
            thickness,
            intrinsics,
            poisson_disk(self.rays, dtype=depth.dtype, device=depth.device),
            rotation,
            offset,
            steps=self.steps,
            orthographic=camera.is_orthographic,
            gradient=self.gradient,
            surrogate_width=self.surrogate_width,
            max_radius_px=self.max_radius_px,
            backend=backend,
        )

    def _reach(self, radius: Tensor, depth: Tensor, camera: Camera) -> Tensor:
        """(B, H, W) length of each pixel's rays."""
        reach = radius[:, None, None].expand(depth.shape)
        longest = furthest_read(self.max_radius_px)
        if longest is None:
            return reach
        focal = torch.maximum(camera.fx, camera.fy).to(depth.dtype)[:, None, None]
        scale = 1.0 if camera.is_orthographic else depth
        return torch.minimum(reach, longest * scale / focal)
