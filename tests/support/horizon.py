"""Horizon tests' common ground: the operator and the oracle on a G-buffer, with scalars for the parameters."""

from __future__ import annotations

import torch

import torch_ssao as ts
from oracles.horizon import horizon_obscurance as oracle
from support.gbuffers import random_gbuffer
from torch_ssao.ops import horizon_obscurance, tiled_noise


def smooth_gbuffer(**options: object) -> ts.GBuffer:
    """Random, but less rough than a tap's reach, so that connected taps and horizons of all kinds occur."""
    gb = random_gbuffer(4, **options)  # type: ignore[arg-type]
    depth = 2.0 + 0.15 * (gb.depth - 2.0) + 0.4 * (torch.arange(gb.depth.shape[-1]) > 8)
    return ts.GBuffer(depth, gb.camera, normal=gb.normal, valid=gb.valid)


def question(
    gb: ts.GBuffer, *, frame: int = 0, **options: object
) -> tuple[tuple[torch.Tensor, ...], dict[str, object]]:
    """Tensors and keywords of the operators."""
    given = {"radius": 0.7, "falloff": 2.5, "thickness": 0.4, "bias": 0.05} | options
    batch, dtype = len(gb), gb.depth.dtype
    scalars = [given.pop(name) for name in ("radius", "falloff", "thickness", "bias")]
    values = [None if v is None else torch.full((batch,), v, dtype=dtype) for v in scalars]  # type: ignore[arg-type]
    camera = gb.camera
    valid = gb.valid_mask[:, 0]
    noise = tiled_noise(camera.height, camera.width, frame, dtype=dtype, device=torch.device("cpu"))
    intrinsics = torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1).to(dtype)
    tensors = (torch.where(valid, gb.depth[:, 0], 1.0), valid, gb.normal, intrinsics, *values, *noise)
    defaults = {"slices": 2, "steps": 3, "step_power": 1.3, "weighting": "cosine", "estimator": "bitmask"}
    return tensors, {"orthographic": camera.is_orthographic} | defaults | given


def evaluate(gb: ts.GBuffer, *, frame: int = 0, **options: object) -> torch.Tensor:
    """The operator's obscurance."""
    tensors, keywords = question(gb, frame=frame, **options)
    return horizon_obscurance(*tensors, **keywords)


def oracle_question(gb: ts.GBuffer, **options: object) -> tuple[tuple[torch.Tensor, ...], dict[str, object]]:
    """Images and settings of the oracles."""
    camera = gb.camera
    noise = tiled_noise(camera.height, camera.width, 0, dtype=torch.float64, device=torch.device("cpu"))
    given = {
        "radius": 0.7, "falloff": 2.5, "thickness": 0.4, "bias": 0.05, "slices": 2, "steps": 3, "step_power": 1.3,
        "weighting": "cosine", "estimator": "bitmask", "connected": False, "max_radius_px": None,
    } | options  # fmt: skip
    given["extend"] = given.pop("offscreen", "open") == "extend"
    given["cosine"] = given.pop("weighting") == "cosine"
    intrinsics = torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1)
    settings = {"orthographic": camera.is_orthographic, "eps": torch.finfo(torch.float64).eps} | given
    return (gb.depth[:, 0], gb.valid[:, 0], gb.normal, intrinsics, *noise), settings


def expected(gb: ts.GBuffer, **options: object) -> torch.Tensor:
    """The oracle's obscurance."""
    images, settings = oracle_question(gb, **options)
    return torch.from_numpy(oracle(*images, **settings))


FORMS = [
    {"estimator": "increments"},
    {"estimator": "increments", "thickness": None},
    {"estimator": "bitmask"},
    {"estimator": "bitmask", "connected": True},
    {"estimator": "bitmask", "connected": True, "thickness": None},
]
