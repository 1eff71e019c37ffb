"""The coarse logarithmic scan before a fit: where to start, whatever the start given."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ssao.fitting.parameters import ParameterSpace
from torch_ssao.fitting.residuals import Residuals

REACH = math.log(8.0)  # a start four times off is well inside
POINTS = {1: 8, 2: 20, 3: 28}  # evaluations by number of parameters, found on synthetic clutter
MANY = 64


def scan_points(space: ParameterSpace) -> Tensor:
    """(S, P) logarithms: the start, then a Sobol sequence in the box of factors 1/8 to 8 around it, inside the bounds."""
    size = len(space)
    sobol = torch.quasirandom.SobolEngine(size, scramble=False)
    sobol.fast_forward(1)  # the first point is a corner
    spread = sobol.draw(POINTS.get(size, MANY) - 1, dtype=torch.float64) * 2 - 1
    margin = 0.05 * (space.high - space.low)
    points = (space.start + REACH * spread).clamp(space.low + margin, space.high - margin)
    return torch.cat((space.start[None], points))


def scan(residuals: Residuals, space: ParameterSpace) -> list[Tensor]:
    """Evaluate the scan's points; return them best first. One evaluation each, at most half the budget."""
    affordable = scan_points(space)[: max(1, residuals.left // 2)]
    ranked = [(float(residuals.value(point).norm()), point) for point in affordable]
    return [point for _, point in sorted(ranked, key=lambda pair: pair[0])]
