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


def evaluate(gb: ts.GBuffer, *, frame: int = 0, **options: object) -> torch.Tensor:
    given = {"radius": 0.7, "falloff": 2.5, "thickness": 0.4, "bias": 0.05} | options
    batch, dtype = len(gb), gb.depth.dtype
    scalars = [given.pop(name) for name in ("radius", "falloff", "thickness", "bias")]
    values = [None if v is None else torch.full((batch,), v, dtype=dtype) for v in scalars]  # type: ignore[arg-type]
    camera = gb.camera
    valid = gb.valid_mask[:, 0]
    noise = tiled_noise(camera.height, camera.width, frame, dtype=dtype, device=torch.device("cpu"))
    return horizon_obscurance(
        torch.where(valid, gb.depth[:, 0], 1.0),
        valid,
        gb.normal,
        torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1).to(dtype),
        *values,
        *noise,
        orthographic=camera.is_orthographic,
        **({"slices": 2, "steps": 3, "step_power": 1.3, "weighting": "cosine", "estimator": "bitmask"} | given),
    )


def expected(gb: ts.GBuffer, **options: object) -> torch.Tensor:
    camera = gb.camera
    noise = tiled_noise(camera.height, camera.width, 0, dtype=torch.float64, device=torch.device("cpu"))
    given = {
        "radius": 0.7, "falloff": 2.5, "thickness": 0.4, "bias": 0.05, "slices": 2, "steps": 3, "step_power": 1.3,
        "weighting": "cosine", "estimator": "bitmask", "connected": False, "max_radius_px": None,
    } | options  # fmt: skip
    given["extend"] = given.pop("offscreen", "open") == "extend"
    given["cosine"] = given.pop("weighting") == "cosine"
    image = oracle(
        gb.depth[:, 0], gb.valid[:, 0], gb.normal,
        torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1), *noise,
        orthographic=camera.is_orthographic, eps=torch.finfo(torch.float64).eps, **given,
    )  # fmt: skip
    return torch.from_numpy(image)


FORMS = [
    {"estimator": "increments"},
    {"estimator": "increments", "thickness": None},
    {"estimator": "bitmask"},
    {"estimator": "bitmask", "connected": True},
    {"estimator": "bitmask", "connected": True, "thickness": None},
]
