"""What every claim uses: candidates, fits, errors, times, the results file."""

from __future__ import annotations

import functools
import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from torch_ssao.metrics import rmse
from torch_ssao.report.environment import environment

FITTED = ("height", "falloff", "contrast")  # the radius stays: reference and candidate look at the same neighbourhood
SAMPLES = 256
EVALUATIONS = 60


@dataclass(frozen=True)
class Run:
    """What a run of a claim is asked for; `layers` keeps the rows of the scenes that it is not asked for.

    Args:
        figures: folder of the pictures.
        scenes: built-in scenes to measure.
        known: rows of other scenes from an earlier run.
    """

    figures: Path
    scenes: tuple[str, ...]
    known: list[dict[str, Any]]

    def joined(self, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Known and new rows in the order of the built-in scenes."""
        return sorted(self.known + rows, key=lambda row: ts.scenes.names().index(row["scene"]))


@dataclass(frozen=True)
class Candidate:
    """A configuration of StatVO."""

    layers: int
    layering: str = "adaptive"
    quadrants: bool = False
    sat_scale: int = 1

    def build(self, radius: float, **parameters: float) -> ts.StatVO:
        return ts.StatVO(
            radius,
            layers=self.layers,
            layering=self.layering,
            quadrants=self.quadrants,
            sat_scale=self.sat_scale,
            **parameters,
        )

    @property
    def label(self) -> str:
        parts = [f"{self.layers} {self.layering}"]
        parts += ["quadrants"] if self.quadrants else []
        parts += [f"1/{self.sat_scale} SATs"] if self.sat_scale > 1 else []
        return ", ".join(parts)

    def row(self) -> dict[str, Any]:
        return {
            "layers": self.layers,
            "layering": self.layering,
            "quadrants": self.quadrants,
            "sat_scale": self.sat_scale,
        }


@dataclass(frozen=True)
class Case:
    """A view of a scene with its G-buffer and ray-traced truth."""

    gbuffer: ts.GBuffer
    truth: Any  # reference.Reference
    radius: float

    @property
    def valid(self) -> Tensor:
        return self.gbuffer.valid_mask[:, :1]

    def error(self, prediction: Tensor, target: Tensor | None = None, mask: Tensor | None = None) -> float:
        """RMSE against a target, the ray-traced truth by default, over the valid pixels of a mask."""
        target = self.truth.visibility if target is None else target
        return float(rmse(prediction, target, self.valid if mask is None else self.valid & mask))


def case(
    scene: ts.scenes.Scene, view: int | list[int], height: int, *, radius: float | None = None, samples: int = SAMPLES
) -> Case:
    """Render and trace a view, 4:3."""
    radius = scene.radius if radius is None else radius
    size = {"views": view, "height": height, "width": height * 4 // 3}
    truth = ts.reference.raytrace(scene, **size, radius=radius, samples=samples, progress=False)
    return Case(ts.scenes.render(scene, **size), truth, radius)


@functools.cache
def builtin_case(name: str, view: int, height: int) -> Case:
    """`case` of a built-in scene, kept for the claims that follow."""
    return case(ts.scenes.builtin(name), view, height)


def visibility(module: ts.StatVO, gbuffer: ts.GBuffer) -> Tensor:
    with torch.no_grad():
        return module(gbuffer)


def fitted(
    candidate: Candidate, where: Case, target: Any = None, mask: Tensor | None = None
) -> tuple[ts.StatVO, float]:
    """The candidate with height, falloff and contrast fitted to a target, the truth by default, and its RMSE."""
    target = where.truth if target is None else target
    fit = ts.fitting.fit(
        candidate.build(where.radius),
        where.gbuffer,
        target,
        parameters=FITTED,
        valid=mask,
        max_evaluations=EVALUATIONS,
        progress=False,
    )
    return fit.module, fit.rmse


def medians_ms(works: Sequence[Callable[[], Any]], repeats: int) -> list[dict[str, float]]:
    """Median and quartiles of each work after a warm-up, taken in turn so that all meet the same other load."""
    times: list[list[float]] = [[] for _ in works]
    for round_ in range(repeats + 1):
        for work, record in zip(works, times, strict=True):
            start = time.perf_counter()
            work()
            if round_:
                record.append(1e3 * (time.perf_counter() - start))
    result = []
    for record in times:
        low, median, high = statistics.quantiles(record, n=4)
        result.append({"median_ms": median, "q1_ms": low, "q3_ms": high, "repeats": repeats})
    return result


def stored(path: Path, claim: str, scenes: tuple[str, ...]) -> list[dict[str, Any]]:
    """Rows of a claim in the results file that belong to none of these scenes."""
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return [row for row in known.get(claim, {}).get("rows", []) if row.get("scene") not in scenes]


def store(path: Path, claim: str, rows: list[dict[str, Any]], statement: str) -> None:
    """Write a claim's rows, leaving the other claims of the file as they are."""
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    known[claim] = {"statement": statement, "environment": environment(), "rows": rounded(rows)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(dict(sorted(known.items())), indent=1) + "\n", encoding="utf-8")


def rounded(value: Any) -> Any:
    """Floats to six significant digits: more would be noise."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    return [rounded(item) for item in value] if isinstance(value, (list, tuple)) else value


def median_footprint(where: Case) -> float:
    """Median half-size of the windows in pixels."""
    half = where.gbuffer.camera.footprint(torch.tensor(where.radius), where.gbuffer.depth)[:, :1, 0]
    return float(half[where.valid].median())
