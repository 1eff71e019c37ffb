"""What both tables use: scenes with references, fits on view 0, scores on the other views, times, pictures."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from benchmarks.statvo_claims.common import medians_ms
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report.images import grey_png, write
from torch_ssao.report.truth import TraceSettings, Truth, trace_views
from torch_ssao.scenes.scene import Scene

CACHE = Path("out/paper_tables")
FIT_SAMPLES = 512
EVALUATIONS = 200


@dataclass(frozen=True)
class Settings:
    """How large and how careful a run is.

    Args:
        size: width and height of the judged images; fits see half of it.
        samples: rays a pixel of the reference, a power of two.
        traced: rays a pixel of the ray-traced row.
        repeats: timed rounds.
        falloff: of the reference.
    """

    size: tuple[int, int] = (320, 240)
    samples: int = 2048
    traced: int = 512
    repeats: int = 5
    falloff: str = "binary"


@dataclass
class Case:
    """A scene: the view to fit on, at half size, the views to judge on, and the reference of both."""

    name: str
    scene: Scene
    settings: Settings
    traced_ms: list[float] = field(default_factory=list)
    traced_error: Tensor = field(default_factory=lambda: torch.zeros(0))

    def __post_init__(self) -> None:
        width, height = self.settings.size
        self.views = list(range(1, len(self.scene.cameras)))
        self.small = ts.scenes.render(self.scene, views=0, height=height // 2, width=width // 2)
        self.judged = ts.scenes.render(self.scene, views=self.views, height=height, width=width)
        self.small_truth = self._truth([0], (width // 2, height // 2), FIT_SAMPLES, 0)
        self.truth = self._truth(self.views, self.settings.size, self.settings.samples, 0)

    @property
    def radius(self) -> float:
        return self.scene.radius

    def traced(self) -> Tensor:
        """Ray-traced images with fewer rays and another seed than the reference's; the first view's times are kept."""
        images = [self._trace(view) for view in self.views]
        for _ in range(self.settings.repeats):
            start = time.perf_counter()
            self._trace(self.views[0])
            self.traced_ms.append(1e3 * (time.perf_counter() - start))
        self.traced_error = torch.cat([image.standard_error for image in images])
        return torch.cat([image.visibility for image in images])

    def _trace(self, view: int) -> ts.reference.Reference:
        width, height = self.settings.size
        samples, falloff = self.settings.traced, self.settings.falloff
        asked = {"views": view, "height": height, "width": width, "samples": samples, "falloff": falloff, "seed": 1}
        return ts.reference.raytrace(self.scene, **asked, progress=False)

    def fit(self, module: AmbientVisibility, parameters: tuple[str, ...]) -> AmbientVisibility:
        """The module with these parameters fitted to view 0."""
        return ts.fitting.fit(
            module,
            self.small,
            self.small_truth.visibility,
            parameters=parameters,
            max_evaluations=EVALUATIONS,
            progress=False,
        ).module

    def predict(self, module: AmbientVisibility) -> Tensor:
        """Images of the judged views, one at a time."""
        with torch.no_grad():
            return torch.cat([module(self.judged[view]) for view in range(len(self.judged))])

    def judge(self, image: Tensor, target: Tensor | None = None) -> dict[str, float]:
        """RMSE, PSNR of the mean squared error and mean SSIM over the judged views, against the reference by default."""
        target = self.truth.visibility if target is None else target
        error = float(ts.metrics.mse(image.double(), target.double(), self.truth.valid))
        return {
            "rmse": math.sqrt(error),
            "psnr": -10 * math.log10(max(error, 1e-20)),
            "ssim": float(ts.metrics.ssim(image, target, self.truth.valid)),
        }

    def time(self, modules: list[AmbientVisibility]) -> list[dict[str, float]]:
        """Milliseconds of each module on the first judged view, in turns: median, quartiles, count."""
        view = self.judged[0]
        with torch.no_grad():
            return medians_ms([lambda module=module: module(view) for module in modules], self.settings.repeats)

    def constant(self) -> Tensor:
        """The image that has the mean of the fitted view everywhere."""
        level = float(self.small_truth.visibility[self.small_truth.valid].mean())
        return torch.full_like(self.truth.visibility, level)

    def picture(self, label: str, image: Tensor) -> None:
        """First judged view: reference, image, and half their difference about grey."""
        wanted, found = self.truth.visibility[0, 0], image[0, 0]
        row = torch.cat((wanted, found, 0.5 + 0.5 * (found - wanted)), 1)
        slug = "".join(c if c.isalnum() else "_" for c in label.lower())
        CACHE.mkdir(parents=True, exist_ok=True)
        write(CACHE / f"{self.name}_{slug}.png", grey_png(row))

    def _truth(self, views: list[int], size: tuple[int, int], samples: int, seed: int) -> Truth:
        settings = TraceSettings(size[1], size[0], self.radius, samples, seed, self.settings.falloff)
        return trace_views(self.scene, views, settings, CACHE, progress=False)


def cases(folder: Path | None, builtin: list[str], meshes: list[str], settings: Settings) -> list[Case]:
    """Built-in scenes, and those of the folder that it has."""
    scenes = {name: ts.scenes.builtin(name) for name in builtin}
    for name in meshes if folder is not None else ():
        path = Path(folder or ".") / f"{name}.ply"
        if path.exists():
            scenes[name] = ts.scenes.load(path, cameras=path.parent / "scenes.json")
    return [Case(name, scene, settings) for name, scene in scenes.items()]


def values_of(module: AmbientVisibility, names: tuple[str, ...]) -> dict[str, float]:
    return {name: value for name, value in module.values().items() if name in names}


def times(row: dict[str, Any]) -> str:
    """Median and quartiles as text."""
    return f"{row['median_ms']:.1f} [{row['q1_ms']:.1f}, {row['q3_ms']:.1f}]"
