"""Tensors as the arrays that compiled loops take."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from torch_ssao.ops.depth_pyramid import build_pyramid


def as_array(tensor: Tensor) -> Any:
    """The tensor's memory where it is contiguous, a copy where it is not; no graph."""
    return tensor.detach().contiguous().numpy()


def as_pyramid(known: Tensor, cap: float | None) -> tuple[Any, Any, float]:
    """Pixels of the texels of a depth pyramid, starts of its levels, and the cap; loops look at none of it where `cap` is None.

    Args:
        known: (B, H, W) bool, pixels that may be selected. cap: `max_radius_px`, or None.
    """
    if cap is None:
        return np.zeros(1, np.int64), np.zeros(1, np.int64), 1.0
    pyramid = build_pyramid(known, cap)
    return as_array(pyramid.pixel), as_array(pyramid.start), float(pyramid.cap)


def wanted(found: Sequence[Tensor | None], needed: Sequence[bool], tensors: Sequence[Tensor | None]) -> list[Tensor]:
    """Those cotangents that are needed, in their order; `found` may have None, and end early."""
    triples = zip(found, needed, tensors, strict=False)
    return [part for part, want, tensor in triples if want and tensor is not None and part is not None]
