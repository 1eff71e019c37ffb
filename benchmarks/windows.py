"""StatVO over two window sizes a pixel: not in the library, here to measure whether it would earn its keep."""

from __future__ import annotations

from typing import final

from torch import Tensor

import torch_ssao as ts
from torch_ssao.camera import Camera
from torch_ssao.modules.base import AmbientVisibility, ParameterSpec, Positive


@final
class TwoWindows(AmbientVisibility):
    """Weighted mean of StatVO at two radii; height (of each radius), falloff and contrast are shared.

    Args:
        radius: of the larger window, scene units. ratio: larger over smaller radius. odds: weight of the larger over the smaller.
    """

    PARAMETERS = {
        **ts.StatVO.PARAMETERS,
        "ratio": ParameterSpec("1", 1.05, 32.0, "larger over smaller radius"),
        "odds": ParameterSpec("1", 1e-2, 1e2, "weight of the larger window over that of the smaller"),
    }
    CHOICES = ("layers", "quadrants")

    radius = Positive()
    height = Positive()
    falloff = Positive()
    ratio = Positive()
    odds = Positive()
    layers: int
    quadrants: bool

    def __init__(self, radius: float, *, layers: int = 4, quadrants: bool = True) -> None:
        values = {"radius": radius, "height": 1.0, "falloff": 1.0, "contrast": 1.0, "ratio": 3.0, "odds": 1.0}
        super().__init__(values, {"layers": layers, "quadrants": quadrants}, ())

    def used_parameters(self) -> tuple[str, ...]:
        return tuple(self.PARAMETERS)

    def _visibility(
        self, depth: Tensor, valid: Tensor, normal: Tensor | None, camera: Camera, *, frame: int, backend: str
    ) -> Tensor:
        share = self.odds / (1 + self.odds)
        images = []
        for radius in (self.radius, self.radius / self.ratio):
            single = ts.StatVO(1.0, layers=self.layers, quadrants=self.quadrants)
            del single.raw_radius, single.raw_height, single.raw_falloff
            single.raw_radius, single.raw_height, single.raw_falloff = radius.log(), self.raw_height, self.raw_falloff
            images.append(single._visibility(depth, valid, normal, camera, frame=frame, backend=backend))
        return share * images[0] + (1 - share) * images[1]
