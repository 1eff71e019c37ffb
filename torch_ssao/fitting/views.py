"""The views that a fit sees: one or several G-buffers and targets, checked, weighted and cut into single views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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


@final
@dataclass(frozen=True, eq=False)
class SceneImages:
    """A G-buffer of B views and what is wanted of them, checked and on its device.

    Args:
        gbuffer: the views.
        visibility: (B, 1, H, W). standard_error, weights, valid: alike, or None.
        share: (B, 1, H, W) float64, the weight of each pixel, 0 where it does not count.
        tag: "" or "[2]", to name the G-buffer's arguments in errors.
    """

    gbuffer: GBuffer
    visibility: Tensor
    standard_error: Tensor | None
    weights: Tensor | None
    valid: Tensor | None
    share: Tensor
    tag: str

    def check_finite(self, index: int, where: str) -> None:
        """Raise `RangeError` unless the target of a view, called `where`, is finite where it counts."""
        bad = int((~torch.isfinite(self.visibility[index]) & (self.share[index] > 0)).sum())
        if bad:
            raise checks.RangeError(
                f"target{self.tag} must be finite where it counts, got {bad} pixels of {where} that are not: mask them with valid"
            )


def check_scenes(gbuffer: Any, target: Any, weights: Any = None, valid: Any = None) -> list[SceneImages]:
    """The arguments of `fit` and `select`, one record a G-buffer; a single G-buffer is a list of one.

    Raises: ShapeError, DtypeError, ChoiceError; RangeError for weights below 0 or not finite.
    """
    if isinstance(gbuffer, GBuffer):
        return [_checked(gbuffer, target, weights, valid, "")]
    buffers = _as_many("gbuffer", gbuffer, None)
    given = {"target": target, "weights": weights, "valid": valid}
    many = {name: _as_many(name, items, len(buffers)) for name, items in given.items()}
    return [
        _checked(views, many["target"][index], many["weights"][index], many["valid"][index], f"[{index}]")
        for index, views in enumerate(buffers)
    ]


def gather_views(gbuffer: Any, target: Any, weights: Any = None, valid: Any = None) -> tuple[tuple[View, ...], int]:
    """Every view with a pixel that counts, and the number of scenes.

    Args:
        gbuffer: a G-buffer of B views, or a sequence of them, one a scene, of any sizes.
        target: (B, 1, H, W) visibility or an object with `.visibility` and `.standard_error`; a sequence where `gbuffer` is one.
        weights: (B, 1, H, W) >= 0 or None; a sequence likewise. valid: (B, 1, H, W) bool or None; likewise.
    Raises: ShapeError, DtypeError; RangeError for targets that are not finite where they count, for negative weights, and
        where no pixel counts.
    """
    scenes = check_scenes(gbuffer, target, weights, valid)
    views = [view for number, scene in enumerate(scenes) for view in _views_of(number, scene)]
    if not views:
        raise checks.RangeError("gbuffer, valid and weights leave no pixel to fit: choose views that see something")
    total = sum(float(view.weight.sum()) for view in views)
    return tuple(replace(view, weight=view.weight / total) for view in views), len(scenes)


def _views_of(number: int, scene: SceneImages) -> list[View]:
    found = []
    for index in range(len(scene.gbuffer)):
        scene.check_finite(index, f"view {index}")
        kept = scene.share[index, 0] > 0
        if bool(kept.any()):
            image, noise = scene.visibility[index, 0], scene.standard_error
            seen = torch.where(kept, image, 1.0)[None, None]
            spread = None if noise is None else noise[index, 0][kept].double()
            share = scene.share[index, 0][kept]
            found.append(View(number, scene.gbuffer[index], kept, seen, image[kept].double(), share, spread))
    return found


def _as_many(name: str, items: Any, count: int | None) -> list[Any]:
    if items is None and count is not None and name != "target":
        return [None] * count
    if not isinstance(items, Sequence) or not items or (count is not None and len(items) != count):
        wanted = "a GBuffer or a sequence of them" if count is None else f"a sequence of {count}, one per G-buffer"
        got = f"{len(items)}" if isinstance(items, Sequence) else type(items).__name__
        raise checks.ShapeError(f"{name} must be {wanted}, got {got}: pass a list")
    return list(items)


def _checked(gbuffer: Any, target: Any, weights: Any, valid: Any, tag: str) -> SceneImages:
    if not isinstance(gbuffer, GBuffer):
        raise checks.ChoiceError(
            f"gbuffer{tag} must be a GBuffer, got {type(gbuffer).__name__}: render or wrap the depth first"
        )
    shape = (len(gbuffer), 1, *gbuffer.depth.shape[2:])
    images = {
        "target": getattr(target, "visibility", target),
        "standard_error": getattr(target, "standard_error", None),
        "weights": weights,
        "valid": valid,
    }
    checks.check_floating(f"target{tag}", images["target"])
    for name, tensor in images.items():
        if tensor is not None:
            checks.check_shape(f"{name}{tag}", tensor, shape, "one image per view of gbuffer")
            images[name] = tensor.detach().to(gbuffer.depth.device)
    share = gbuffer.valid_mask[:, :1].double()
    if valid is not None:
        share = share * images["valid"].bool()
    if weights is not None:
        if bool((weights < 0).any()) or not bool(torch.isfinite(weights).all()):
            raise checks.RangeError(f"weights{tag} must be finite and at least 0, got values that are not: clamp them")
        share = share * images["weights"].double()
    visibility, noise, importance, mask = images.values()
    return SceneImages(gbuffer, visibility, noise, importance, mask, share, tag)
