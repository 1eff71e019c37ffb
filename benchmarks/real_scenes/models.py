"""What is fitted on the first view of a scene and judged on its others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch_ssao as ts
from benchmarks.peers.xegtao import PRESETS, XeGTAO
from torch_ssao.modules import AmbientVisibility


@dataclass(frozen=True)
class Model:
    """A technique with its counts.

    Args:
        make: a module at the scene's radius.
        parameters: to fit; None for all that are used; empty for as it comes.
        evaluations: budget of the fit.
        like: name of the model whose fitted values it takes over, instead of a fit of its own: what HBAO and the ray march
            estimate does not depend on the number of taps.
        refine: evaluations of a fit that goes on from there.
        search: random settings, within a factor of two of the start, of which the best is where the fit begins. For a peer
            whose derivatives miss what its taps do.
        taps: depth reads a pixel; 0 where it is not taps that it is made of.
    """

    make: Callable[[float], AmbientVisibility]
    parameters: tuple[str, ...] | None = None
    evaluations: int = 300
    like: str | None = None
    refine: int = 0
    search: int = 0
    taps: int = 0


def _statvo(layers: int = 4, *, quadrants: bool = True, windows: int = 1) -> Callable[[float], AmbientVisibility]:
    return lambda radius: ts.StatVO(radius, layers=layers, quadrants=quadrants, windows=windows)


STATVO = {
    "one layer, radius and contrast": Model(_statvo(1, quadrants=False), ("radius", "contrast"), 100),
    "one region, radius and contrast": Model(_statvo(quadrants=False), ("radius", "contrast"), 100),
    "one region": Model(_statvo(quadrants=False)),
    "quadrants": Model(_statvo()),
    "quadrants, 8 layers": Model(_statvo(8)),
    "quadrants, two windows": Model(_statvo(windows=2)),
}

BITMASK = ("radius", "thickness", "contrast")
INCREMENTS = ("radius", "falloff", "thickness", "contrast")
XEGTAO = ("radius", "falloff_range", "distribution_power", "final_power", "thin_occluder")


def _bitmask(
    slices: int,
    steps: int,
    *,
    connected: bool = False,
    offscreen: str = "extend",
    like: str | None = None,
    refine: int = 0,
) -> Model:
    return Model(
        lambda radius: ts.HBAO(radius, slices=slices, steps=steps, connected=connected, offscreen=offscreen, denoise=1),
        *(BITMASK, 90, like, refine),
        taps=2 * slices * steps,
    )


def _increments(slices: int, steps: int, like: str | None = None) -> Model:
    return Model(
        lambda radius: ts.HBAO(
            radius, estimator="increments", slices=slices, steps=steps, offscreen="extend", denoise=1
        ),
        *(INCREMENTS, 120, like),
        taps=2 * slices * steps,
    )


def _classic(slices: int, steps: int) -> Model:
    return Model(
        lambda radius: ts.HBAO(
            radius,
            estimator="increments",
            weighting="uniform",
            falloff=2.0,
            thickness=None,
            bias_deg=5.0,
            slices=slices,
            steps=steps,
            offscreen="extend",
            denoise=1,
        ),
        ("radius", "falloff", "bias_deg", "contrast"),
        120,
        taps=2 * slices * steps,
    )


def _rays(rays: int, steps: int, like: str | None = None) -> Model:
    return Model(
        lambda radius: ts.RayMarchedSSAO(radius, rays=rays, steps=steps, thickness=0.4, falloff=8.0, denoise=1),
        *(("radius", "thickness", "contrast"), 90, like),
        taps=rays * steps,
    )


def _xegtao(preset: str, parameters: tuple[str, ...] = (), like: str | None = None) -> Model:
    slices, steps = PRESETS[preset]
    thin = 0.1 if parameters else 0.0
    return Model(
        lambda radius: XeGTAO(radius, slices=slices, steps=steps, thin_occluder=thin, denoise=1),
        *(parameters, 160, like),
        search=400,
        taps=2 * slices * steps,
    )


TECHNIQUES = {
    "StatVO 4 layers": Model(_statvo(), None, 150),
    "HBAO bitmask 3x3, connected": _bitmask(3, 3, connected=True),
    "HBAO bitmask 3x6, connected": _bitmask(3, 6, connected=True),
    "HBAO bitmask 2x8": _bitmask(2, 8),
    "HBAO bitmask 2x8, open border": _bitmask(2, 8, offscreen="open", like="HBAO bitmask 2x8"),
    "HBAO bitmask 4x4, connected": _bitmask(4, 4, connected=True, like="HBAO bitmask 3x6, connected"),
    "HBAO bitmask 4x8": _bitmask(4, 8, like="HBAO bitmask 2x8", refine=40),
    "HBAO bitmask 2x16": _bitmask(2, 16, like="HBAO bitmask 2x8", refine=40),
    "HBAO bitmask 8x16": _bitmask(8, 16, like="HBAO bitmask 2x8", refine=40),
    "HBAO increments 3x6": _increments(3, 6),
    "HBAO increments 3x3": _increments(3, 3, like="HBAO increments 3x6"),
    "HBAO increments 4x8": _increments(4, 8, like="HBAO increments 3x6"),
    "HBAO classic 4x4": _classic(4, 4),
    "ray march 16x8": _rays(16, 8),
    "ray march 8x8": _rays(8, 8, like="ray march 16x8"),
    "ray march 32x16": _rays(32, 16, like="ray march 16x8"),
    "XeGTAO High, shipped": _xegtao("high"),
    "XeGTAO High, tuned": _xegtao("high", XEGTAO),
    "XeGTAO Ultra, tuned": _xegtao("ultra", XEGTAO, like="XeGTAO High, tuned"),
}

GROUPS = {"statvo": STATVO, "techniques": TECHNIQUES}
MODELS = STATVO | TECHNIQUES
