"""Meshes, cameras and G-buffers made from them by ray casting."""

from __future__ import annotations

import importlib
from typing import Any

from torch_ssao.scenes.builtin import builtin as builtin
from torch_ssao.scenes.builtin import names as names
from torch_ssao.scenes.loading import load as load
from torch_ssao.scenes.render import PrimaryHits as PrimaryHits
from torch_ssao.scenes.render import primary_hits as primary_hits
from torch_ssao.scenes.render import render as render
from torch_ssao.scenes.scene import Scene as Scene
from torch_ssao.scenes.scene import View as View


def __getattr__(name: str) -> Any:
    if name == "analytic":  # loaded on first use: it is not needed to load meshes
        return importlib.import_module("torch_ssao.scenes.analytic")
    raise AttributeError(f"module 'torch_ssao.scenes' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), "analytic"])
