"""Statistical volumetric obscurance as a module."""

from __future__ import annotations

from typing import final

from torch import Tensor

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive
from torch_ssao.ops.statvo import statvo_obscurance


@final
class StatVO(AmbientVisibility):
    """Statistical volumetric obscurance: visibility from the mean position of a few depth layers around each pixel.

    Surface-aligned where the G-buffer has normals, view-aligned where it has none. No sampling, so no noise, no blur.

    Args:
        radius: half-size of the sample box across the surface, scene units, > 0.
        height: height of the box over the surface, of the radius, > 0.
        falloff: slope of psi above the box: how fast layers in front of it stop to occlude, > 0.
        contrast: exponent of the visibility, > 0.
        layers: adaptive depth layers, 1, 2, 4, ... 256. One without depth discontinuities; more remove halos.
        layering: "adaptive".
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
    }
    CHOICES = ("layers", "layering")

    radius = Positive()
    height = Positive()
    falloff = Positive()

    layers: int
    layering: str

    def __init__(
        self,
        radius: float = 0.5,
        *,
        height: float = 1.0,
        falloff: float = 1.0,
        contrast: float = 1.0,
        layers: int = 4,
        layering: str = "adaptive",
        learnable: str | tuple[str, ...] = (),
    ) -> None:
        checks.check_count("layers", layers, 1, 256)
        if layers & (layers - 1):
            below = 1 << (layers.bit_length() - 1)
            raise checks.RangeError(f"layers must be a power of two, got {layers}: use {below} or {2 * below}")
        checks.check_choice("layering", layering, ("adaptive",))
        values = {"radius": radius, "height": height, "falloff": falloff, "contrast": contrast}
        super().__init__(values, {"layers": layers, "layering": layering}, learnable)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        batch = depth.shape[0]
        radius, height, falloff = (value.to(depth.dtype) for value in (self.radius, self.height, self.falloff))
        points = camera.unproject(depth)
        if normal is None:
            normal = depth.new_tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1).expand(batch, 3, *depth.shape[2:])
        obscurance = statvo_obscurance(
            points,
            valid,
            normal,
            camera.footprint(radius, depth),
            (radius * height).expand(batch),
            falloff.expand(batch),
            layers=self.layers,
        )
        return 1 - obscurance
