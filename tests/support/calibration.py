"""Fits of noisy replicas: how often a planted parameter lies within its stated standard error."""

from __future__ import annotations

import copy
from typing import Any

import torch

import torch_ssao as ts
from support.clutter import clutter
from torch_ssao.fitting import fit

REPLICAS = 100
CASES: dict[str, tuple[Any, dict[str, Any], tuple[str, ...]]] = {
    "statvo, one layer": (ts.StatVO, {"layers": 1}, ("radius", "height", "falloff", "contrast")),
    "statvo, two layers": (ts.StatVO, {"layers": 2}, ("falloff", "contrast")),
    "hbao": (ts.HBAO, {"slices": 2, "steps": 4}, ("thickness", "contrast")),
    "hbao increments": (
        ts.HBAO,
        {"slices": 2, "steps": 4, "estimator": "increments", "thickness": None},
        ("falloff", "contrast"),
    ),
    "ray march": (ts.RayMarchedSSAO, {"rays": 4, "steps": 4, "gradient": "surrogate"}, ("falloff", "contrast")),
}
"""Parameters in which the images are continuous."""
STEPPED: dict[str, tuple[Any, dict[str, Any], tuple[str, ...]]] = {
    "statvo, two layers": (ts.StatVO, {"layers": 2}, ("radius", "contrast")),
    "hbao": (ts.HBAO, {"slices": 2, "steps": 4}, ("radius", "thickness", "contrast")),
    "ray march": (
        ts.RayMarchedSSAO,
        {"rays": 4, "steps": 4, "gradient": "surrogate"},
        ("radius", "falloff", "thickness", "contrast"),
    ),
}
"""With radii and thicknesses, which move taps and labels by whole pixels."""
VALUES = {"radius": 0.5, "falloff": 2.0, "contrast": 1.4}


class Noisy:
    """A target whose noise differs from pixel to pixel, as a traced one's does, and says so."""

    def __init__(self, clean: torch.Tensor, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.standard_error = 0.01 + 0.06 * (1 - clean)
        noise = torch.randn(clean.shape, generator=generator, dtype=clean.dtype)
        self.visibility = clean + self.standard_error * noise


def counts(case: tuple[Any, dict[str, Any], tuple[str, ...]], replicas: int = REPLICAS) -> dict[str, tuple[int, int]]:
    """How many of the replicas lie within one and within two stated standard errors of the truth, by parameter."""
    kind, choices, names = case
    gb = clutter(36, 48, views=2).to(torch.float64)
    planted = kind(**VALUES, **choices).double()
    clean = planted(gb).detach()
    within = {parameter: [0, 0] for parameter in names}
    start = copy.deepcopy(planted)
    for parameter in names:
        setattr(start, parameter, 1.2 * planted.values()[parameter])
    for seed in range(replicas):
        result = fit(start, gb, Noisy(clean, seed), parameters=names, scan=False)
        for parameter in names:
            off = abs(result.values[parameter] - planted.values()[parameter]) / result.standard_errors[parameter]
            within[parameter][0] += off <= 1
            within[parameter][1] += off <= 2
    return {parameter: (one, two) for parameter, (one, two) in within.items()}
