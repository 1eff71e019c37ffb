"""Statistical volumetric obscurance as a module."""

from __future__ import annotations

from typing import final

from torch import Tensor

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive
from torch_ssao.ops.statvo import check_choices, statvo_obscurance


@final
class StatVO(AmbientVisibility):
    """Statistical volumetric obscurance: visibility from the mean position of a few depth layers around each pixel.

    Surface-aligned where the G-buffer has normals, view-aligned where it has none. No sampling, so no noise, no blur.

    Args:
        radius: half-size of the sample box across the surface, scene units, > 0.
        height: height of the box over the surface, of the radius, > 0.
        falloff: slope of psi above the box: how fast layers in front of it stop to occlude, > 0.
        contrast: exponent of the visibility, > 0.
        layers: depth layers, 1 to 256; a power of two when adaptive. One without depth discontinuities; more remove halos.
        layering: "adaptive" splits samples at their local mean depth, again and again; "uniform" cuts the image's depth range
            into equal slices, many of which are needed.
        quadrants: evaluate the four quarters of the window on their own and average them.
        sat_scale: 1, 2 or 4: build partition and tables at full, half or quarter resolution.
        gradient: "exact" (almost everywhere: layers are constants) or "surrogate" (adaptive: a sample moves between layers
            like sigmoid((mean - depth) / width)); the image is the same.
        surrogate_width: width of that sigmoid, of the box height, > 0.
        windows: 1, or 2: average the obscurance of a second, smaller window into it. Costs twice, and is worth 0.5 to 0.9 dB
            on real meshes (docs/statvo.md).
        inner_radius: radius of the second window, of the radius, > 0. Its box is as many times smaller in all directions.
        inner_weight: weight of the second window over that of the first, > 0.
        half_resolution: compute the pixels of even rows and columns only and carry them to the others along surfaces
            (`ops.upsample`): a third to two thirds of the time; what is thinner than two pixels may be missed.
        learnable: names of the parameters to register as `nn.Parameter`s, or "all"; the rest are buffers.
    Raises:
        RangeError, ChoiceError.
    Gradients, Cost, Source: see `ops.statvo.statvo_obscurance`.
    """

    PARAMETERS = {
        "radius": ParameterSpec("scene units", 1 / 64, 64.0, "half-size of the sample box", relative_bounds=True),
        "height": ParameterSpec("of the radius", 1e-2, 1e2, "height of the sample box over the surface"),
        "falloff": ParameterSpec("1", 1e-2, 1e2, "slope of psi above the box"),
        "contrast": ParameterSpec("1", 1e-2, 1e2, "exponent of the visibility"),
        "inner_radius": ParameterSpec("of the radius", 1 / 32, 1.0, "half-size of the second sample box"),
        "inner_weight": ParameterSpec("1", 1e-2, 1e2, "weight of the second window over that of the first"),
    }
    CHOICES = (
        "layers",
        "layering",
        "quadrants",
        "sat_scale",
        "windows",
        "gradient",
        "surrogate_width",
        "half_resolution",
    )

    radius = Positive()
    height = Positive()
    falloff = Positive()
    inner_radius = Positive()
    inner_weight = Positive()

    layers: int
    layering: str
    quadrants: bool
    sat_scale: int
    windows: int
    gradient: str
    surrogate_width: float

    def __init__(
        self,
        radius: float = 0.5,
        *,
        height: float = 1.0,
        falloff: float = 1.0,
        contrast: float = 1.0,
        layers: int = 4,
        layering: str = "adaptive",
        quadrants: bool = True,
        sat_scale: int = 1,
        windows: int = 1,
        inner_radius: float = 1 / 3,
        inner_weight: float = 1.0,
        gradient: str = "exact",
        surrogate_width: float = 0.1,
        half_resolution: bool = False,
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_choice("half_resolution", half_resolution, (False, True))
        check_choices(layers, layering, sat_scale, gradient, surrogate_width)
        checks.check_choice("quadrants", quadrants, (False, True))
        checks.check_choice("windows", windows, (1, 2))
        values = {
            "radius": radius,
            "height": height,
            "falloff": falloff,
            "contrast": contrast,
            "inner_radius": inner_radius,
            "inner_weight": inner_weight,
        }
        choices = {
            "layers": layers,
            "layering": layering,
            "quadrants": quadrants,
            "sat_scale": sat_scale,
            "windows": windows,
            "gradient": gradient,
            "surrogate_width": surrogate_width,
            "half_resolution": half_resolution,
        }
        super().__init__(values, choices, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        points = camera.unproject(depth)
        if normal is None:
            front = depth.new_tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1)
            normal = front.expand(depth.shape[0], 3, *depth.shape[2:])
        radius = self.radius.to(depth.dtype)
        obscurance = self._obscurance(points, valid, normal, camera, radius)
        if self.windows == 2:
            weight = self.inner_weight.to(depth.dtype)
            inner = self._obscurance(points, valid, normal, camera, radius * self.inner_radius.to(depth.dtype))
            obscurance = (obscurance + weight * inner) / (1 + weight)
        return 1 - obscurance

    def _obscurance(self, points: Tensor, valid: Tensor, normal: Tensor, camera: Camera, radius: Tensor) -> Tensor:
        """Obscurance of one window size."""
        batch, dtype = points.shape[0], points.dtype
        return statvo_obscurance(
            points,
            valid,
            normal,
            camera.footprint(radius, points[:, 2]),
            (radius * self.height.to(dtype)).expand(batch),
            self.falloff.to(dtype).expand(batch),
            layers=self.layers,
            layering=self.layering,
            quadrants=self.quadrants,
            sat_scale=self.sat_scale,
            gradient=self.gradient,
            surrogate_width=self.surrogate_width,
        )

    def _unused_parameters(self) -> tuple[str, ...]:
        return () if self.windows == 2 else ("inner_radius", "inner_weight")
