"""Horizon-based ambient obscurance as a module."""

from __future__ import annotations

import math
from typing import Any, final

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive
from torch_ssao.ops.backend import BACKENDS
from torch_ssao.ops.horizon import ESTIMATORS, OFFSCREEN, WEIGHTINGS, horizon_obscurance
from torch_ssao.ops.horizon_bent import horizon_bent_normal
from torch_ssao.ops.normals import normals_from_points
from torch_ssao.ops.sampling import tiled_noise


@final
class HBAO(AmbientVisibility):
    """Horizon-based ambient obscurance: a few slices of directions through each pixel, a few taps along each.

    Surface normals are estimated from the depth where the G-buffer has none.

    Args:
        radius: distance within which surfaces occlude, scene units, > 0.
        falloff: exponent p of the attenuation 1 - (distance / radius)^p, > 0; a large one approaches the binary hit. Not
            used by estimator "bitmask", which is binary.
        contrast: exponent of the visibility, > 0.
        slices: planes of directions through the pixel; steps: taps on either side of each.
        weighting: "cosine" - ambient occlusion; "uniform" - share of the solid angle (with estimator "increments": HBAO as
            Bavoil and Sainz gave it).
        estimator: "bitmask" - union of the arcs that the taps' occluders cover; "increments" - rises of the horizon.
        thickness: of every occluder behind what is seen of it, of the radius, > 0; None: infinite. The parameter that
            differs most between scenes.
        bias_deg: elevation over the tangent plane below which nothing occludes, degrees, >= 0.
        step_power: taps lie at R ((k + jitter) / steps)^step_power.
        connected: estimator "bitmask" also covers the arcs between neighbouring taps of one surface.
        max_radius_px: taps further than this many pixels from their pixel read a coarser level of a pyramid of selected
            pixels (`ops.depth_pyramid`), so that reads stay near each other; what lies between the selected pixels may be
            missed. Where the radius spans more than 32 times as many, it is shortened: less far-reaching occlusion there.
            None: every tap reads its own pixel.
        offscreen: "open" - what is off the image never occludes; "extend" - the surfaces at the border go on as planes.
        denoise: passes of the edge-aware filter.
        half_resolution: compute the pixels of even rows and columns only and carry them to the others along surfaces
            (`ops.upsample`): a third to two thirds of the time; what is thinner than two pixels may be missed.
        learnable: names of the parameters to register as `nn.Parameter`s, or "all"; the rest are buffers.
    Raises:
        RangeError, ChoiceError.
    Gradients, Cost, Source: see `ops.horizon.horizon_obscurance`.
    """

    PARAMETERS = {
        "radius": ParameterSpec("scene units", 1 / 64, 64.0, "distance within which it looks", relative_bounds=True),
        "falloff": ParameterSpec("1", 1e-2, 1e2, "exponent of the attenuation with distance"),
        "contrast": ParameterSpec("1", 1e-2, 1e2, "exponent of the visibility"),
        "thickness": ParameterSpec("of the radius", 1e-2, 1e1, "how far occluders reach back", optional=True),
        "bias_deg": ParameterSpec("degrees", 1e-2, 45.0, "least elevation of an occluder", may_be_zero=True),
    }
    CHOICES = (
        "slices",
        "steps",
        "weighting",
        "estimator",
        "step_power",
        "connected",
        "max_radius_px",
        "offscreen",
        "denoise",
        "half_resolution",
    )

    BACKENDS = BACKENDS

    falloff = Positive()
    thickness = Positive()
    bias_deg = Positive()

    slices: int
    steps: int
    weighting: str
    estimator: str
    step_power: float
    connected: bool
    max_radius_px: float | None
    offscreen: str

    def __init__(
        self,
        radius: float = 0.5,
        *,
        falloff: float = 8.0,
        contrast: float = 1.0,
        slices: int = 3,
        steps: int = 6,
        weighting: str = "cosine",
        estimator: str = "bitmask",
        thickness: float | None = 0.8,
        bias_deg: float = 0.0,
        step_power: float = 1.3,
        connected: bool = True,
        max_radius_px: float | None = None,
        offscreen: str = "open",
        denoise: int = 0,
        half_resolution: bool = False,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_choice("half_resolution", half_resolution, (False, True))
        checks.check_count("slices", slices, 1)
        checks.check_count("steps", steps, 1)
        checks.check_choice("weighting", weighting, WEIGHTINGS)
        checks.check_choice("estimator", estimator, ESTIMATORS)
        checks.check_positive("step_power", step_power)
        checks.check_choice("connected", connected, (True, False))
        if max_radius_px is not None:
            checks.check_positive("max_radius_px", max_radius_px)
        checks.check_choice("offscreen", offscreen, OFFSCREEN)
        checks.check_count("denoise", denoise, 0)
        values = {
            "radius": radius,
            "falloff": falloff,
            "contrast": contrast,
            "thickness": thickness,
            "bias_deg": bias_deg,
        }
        choices = {
            "slices": slices,
            "steps": steps,
            "weighting": weighting,
            "estimator": estimator,
            "step_power": step_power,
            "connected": connected,
            "max_radius_px": max_radius_px,
            "offscreen": offscreen,
            "denoise": denoise,
            "half_resolution": half_resolution,
        }
        super().__init__(values, choices, learnable)

    def _unused_parameters(self) -> tuple[str, ...]:
        return ("falloff",) if self.estimator == "bitmask" else ()

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        tensors, options = self._question(depth, valid, normal, camera, frame)
        return 1 - horizon_obscurance(*tensors, **options, backend=backend)

    def bent_normal(self, gbuffer: GBuffer, *, frame: int = 0) -> tuple[Tensor, Tensor]:
        """Visibility and the mean open direction of every pixel, from the same taps.

        Args:
            gbuffer, frame: as for `forward`.
        Returns: (B, 1, H, W) visibility, that of `forward` at full resolution; and (B, 3, H, W) unit directions in view space,
            cosine-weighted with weighting "cosine", all alike with "uniform": the normal where nothing is occluded or nothing
            is open, (0, 0, -1) at invalid pixels. The denoiser and the contrast leave them as they are.
        Gradients: to depth, normal, camera and the module's parameters.
        """
        if gbuffer.depth.ndim == 3:  # inside vmap
            batched = pytree.tree_map(lambda leaf: leaf.unsqueeze(0), gbuffer)
            visibility, bent = self.bent_normal(batched, frame=frame)
            return visibility.squeeze(0), bent.squeeze(0)
        with torch.autocast(device_type=gbuffer.depth.device.type, enabled=False):
            depth, valid, normal = self._prepared(gbuffer)
            tensors, options = self._question(depth, valid, normal, gbuffer.camera, frame)
            obscurance, bent = horizon_bent_normal(*tensors, **options)
            visibility = self._denoised(1 - obscurance, depth, valid, normal, gbuffer.camera)
            return self._finished(visibility, valid), bent

    def _question(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, frame: int
    ) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Tensors and keywords of the operators."""
        batch, dtype = depth.shape[0], depth.dtype
        nearest, seen = depth[:, 0], valid[:, 0]
        if normal is None:
            normal = normals_from_points(camera.unproject(depth[:, :1])[:, :, 0], seen)
        intrinsics = torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1).to(dtype)
        rotation, offset = tiled_noise(camera.height, camera.width, frame, dtype=dtype, device=depth.device)
        tensors = (
            nearest,
            seen,
            normal,
            intrinsics,
            self.radius.to(dtype).expand(batch),
            self.falloff.to(dtype).expand(batch),
            None if self.thickness is None else self.thickness.to(dtype).expand(batch),
            (self.bias_deg * (math.pi / 180)).to(dtype).expand(batch),
            rotation,
            offset,
        )
        names = ("slices", "steps", "step_power", "weighting", "estimator", "connected", "max_radius_px", "offscreen")
        return tensors, {"orthographic": camera.is_orthographic} | {name: getattr(self, name) for name in names}
