"""The views that a fit sees: one or several G-buffers and targets, checked, weighted and cut into single views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.gbuffer import GBuffer


@final
@dataclass(frozen=True, eq=False)
class View:
    """One view and the N of its pixels that count.

    Args:
        scene: which G-buffer it comes from. gbuffer: of this view alone.
        inside: (H, W) bool, the pixels that count.
        image: (1, 1, H, W) the target, 1 where it does not count.
        wanted: (N,) float64 target. weight: (N,) float64 > 0; those of all views sum to 1.
        noise: (N,) float64 standard error of the target, or None.
    """

    scene: int
    gbuffer: GBuffer
    inside: Tensor
    image: Tensor
    wanted: Tensor
    weight: Tensor
    noise: Tensor | None


def gather_views(gbuffer: Any, target: Any, weights: Any = None, valid: Any = None) -> tuple[tuple[View, ...], int]:
    """Every view with a pixel that counts, and the number of scenes.

    Args:
        gbuffer: a G-buffer of B views, or a sequence of them, one a scene, of any sizes.
        target: (B, 1, H, W) visibility or an object with `.visibility` and `.standard_error`; a sequence where `gbuffer` is one.
        weights: (B, 1, H, W) >= 0 or None; a sequence likewise. valid: (B, 1, H, W) bool or None; likewise.
    Raises: ShapeError, DtypeError; RangeError for targets that are not finite where they count, for negative weights, and
        where no pixel counts.
    """
    if isinstance(gbuffer, GBuffer):
        gbuffer, target, weights, valid = [gbuffer], [target], [weights], [valid]
        where = [""]
    else:
        gbuffer = list(gbuffer)
        where = [f"[{index}]" for index in range(len(gbuffer))]
        target, weights, valid = (
            _as_many(name, items, len(gbuffer))
            for name, items in (("target", target), ("weights", weights), ("valid", valid))
        )
    views: list[View] = []
    for scene, (views_of, image, importance, mask, tag) in enumerate(
        zip(gbuffer, target, weights, valid, where, strict=True)
    ):
        if not isinstance(views_of, GBuffer):
            raise checks.ChoiceError(
                f"gbuffer{tag} must be a GBuffer, got {type(views_of).__name__}: render or wrap the depth first"
            )
        views.extend(_views_of(scene, views_of, image, importance, mask, tag))
    if not views:
        raise checks.RangeError("gbuffer, valid and weights leave no pixel to fit: choose views that see something")
    return _normalised(views), len(gbuffer)


def _as_many(name: str, items: Any, count: int) -> list[Any]:
    if items is None:
        return [None] * count
    if not isinstance(items, Sequence) or len(items) != count:
        got = f"{len(items)}" if isinstance(items, Sequence) else type(items).__name__
        raise checks.ShapeError(f"{name} must be a sequence of {count}, one per G-buffer, got {got}: pass a list")
    return list(items)


def _views_of(scene: int, gbuffer: GBuffer, target: Any, weights: Any, valid: Any, tag: str) -> list[View]:
    image = getattr(target, "visibility", target)
    noise = getattr(target, "standard_error", None)
    checks.check_floating(f"target{tag}", image)
    batch, _, height, width = gbuffer.depth.shape
    shape = (batch, 1, height, width)
    checks.check_shape(f"target{tag}", image, shape, "one visibility image per view of gbuffer")
    inside = gbuffer.valid_mask[:, :1]
    image = image.to(inside.device)
    if valid is not None:
        checks.check_shape(f"valid{tag}", valid, shape, "one flag per pixel")
        inside = inside & valid.to(inside.device).bool()
    weight = inside.double()
    if weights is not None:
        checks.check_shape(f"weights{tag}", weights, shape, "one weight per pixel")
        if bool((weights < 0).any()) or not bool(torch.isfinite(weights).all()):
            raise checks.RangeError(f"weights{tag} must be finite and at least 0, got values that are not: clamp them")
        weight = weight * weights.to(weight.device).double()
    for index in range(batch):
        bad = int((~torch.isfinite(image[index]) & (weight[index] > 0)).sum())
        if bad:
            raise checks.RangeError(
                f"target{tag} must be finite where it counts, got {bad} pixels of view {index} that are not: mask them with valid"
            )
    found = []
    for index in range(batch):
        kept = weight[index, 0] > 0
        if bool(kept.any()):
            seen = torch.where(kept, image[index, 0], 1.0)[None, None]
            spread = None if noise is None else noise.to(kept.device)[index, 0][kept].double()
            wanted, share = image[index, 0][kept].double(), weight[index, 0][kept]
            found.append(View(scene, gbuffer[index], kept, seen, wanted, share, spread))
    return found


def _normalised(views: list[View]) -> tuple[View, ...]:
    total = sum(float(view.weight.sum()) for view in views)
    return tuple(
        View(view.scene, view.gbuffer, view.inside, view.image, view.wanted, view.weight / total, view.noise)
        for view in views
    )
