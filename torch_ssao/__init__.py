"""Differentiable screen-space ambient occlusion for PyTorch."""

from __future__ import annotations

import importlib
from typing import Any

from torch_ssao import metrics as metrics
from torch_ssao.camera import Camera as Camera
from torch_ssao.camera import look_at as look_at
from torch_ssao.gbuffer import GBuffer as GBuffer
from torch_ssao.gbuffer import collate as collate
from torch_ssao.modules import HBAO as HBAO
from torch_ssao.modules import RayMarchedSSAO as RayMarchedSSAO
from torch_ssao.modules import StatVO as StatVO
from torch_ssao.projection import depth_from_zbuffer as depth_from_zbuffer
from torch_ssao.projection import opengl_to_view as opengl_to_view
from torch_ssao.projection import zbuffer_from_depth as zbuffer_from_depth
from torch_ssao.serialize import load as load
from torch_ssao.serialize import save as save

__version__ = "0.1.0"

_LAZY = ("fitting", "reference", "report", "scenes")  # they need the extras: loaded on first use


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return importlib.import_module(f"torch_ssao.{name}")
    raise AttributeError(f"module 'torch_ssao' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_LAZY])
