"""Result rows: how wrong a module is, and how long it takes."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, final

import torch
from torch import Tensor

from torch_ssao import metrics
from torch_ssao.fitting.timing import REPEATS as REPEATS
from torch_ssao.fitting.timing import Timing as Timing
from torch_ssao.fitting.timing import time_forward as time_forward
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import TECHNIQUES, AmbientVisibility
from torch_ssao.report.truth import Truth


@final
@dataclass(frozen=True)
class Score:
    """Error of an estimate over all valid pixels of some views: RMSE and SSIM of visibility, PSNR in decibel."""

    rmse: float
    psnr: float
    ssim: float


@final
@dataclass(frozen=True)
class FitSummary:
    """What a fit said: standard errors by parameter, parameters the data cannot determine, and how it went."""

    standard_errors: dict[str, float]
    undetermined: tuple[str, ...]
    evaluations: int
    seconds: float
    message: str


@final
@dataclass(frozen=True, eq=False)
class Row:
    """One point of a speed-against-error plot.

    Args:
        name: unique, used in file names, such as "statvo_4".
        label: for people, such as "4 layers" or, in the company of other techniques, "StatVO 4 layers".
        module: what was measured.
        validation: error on the judged views. training: error on the fitted views.
        timing: of one judged view.
        fit: None for a module with its default values.
    """

    name: str
    label: str
    module: AmbientVisibility
    validation: Score
    training: Score
    timing: Timing
    fit: FitSummary | None = None

    @property
    def technique(self) -> str:
        """The module's name in `modules.TECHNIQUES`."""
        return next(name for name, kind in TECHNIQUES.items() if isinstance(self.module, kind))

    @property
    def is_fitted(self) -> bool:
        """Whether the values come from a fit."""
        return self.fit is not None

    def as_dict(self) -> dict[str, Any]:
        """The row as plain values for report.json."""
        values = self.module.values()
        return {
            "name": self.name,
            "technique": self.technique,
            "label": self.label,
            "fitted": self.is_fitted,
            "validation": asdict(self.validation),
            "training": asdict(self.training),
            "timing": asdict(self.timing),
            "choices": self.module.config(),
            "values": {name: values.get(name) for name in self.module.PARAMETERS},  # None is off
            "fit": None if self.fit is None else asdict(self.fit),
        }


def predict(module: AmbientVisibility, gbuffer: GBuffer) -> Tensor:
    """(B, 1, H, W) visibility without gradients, view by view: the memory is that of one view."""
    with torch.no_grad():
        return torch.cat([module(gbuffer[i]) for i in range(len(gbuffer))])


def score(prediction: Tensor, truth: Truth) -> Score:
    """Error of (B, 1, H, W) visibility against a reference of the same views."""
    arguments = (prediction, truth.visibility.to(prediction), truth.valid.to(prediction.device))
    rmse, psnr, ssim = (float(metric(*arguments)) for metric in (metrics.rmse, metrics.psnr, metrics.ssim))
    return Score(rmse, psnr, ssim)


def score_constant(value: float, truth: Truth) -> Score:
    """Error of a picture that has one value wherever a surface is seen."""
    return score(torch.full_like(truth.visibility, value), truth)


def best_constant(truth: Truth) -> float:
    """The constant of least RMSE: the mean visibility of the valid pixels."""
    return float(truth.visibility[truth.valid].double().mean())


def plain(value: Any) -> Any:
    """`value` with everything JSON cannot say (infinite, NaN) replaced by None, recursively."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
