"""Closed forms of single surfaces in world space, shared by the builders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from torch_ssao.scenes import closed_forms
from torch_ssao.scenes.analytic.scene import Question
from torch_ssao.scenes.primitives import Array, Patch


def floor() -> Patch:
    """The plane z = 0."""
    return Patch((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def always_open(points: Array, normals: Array, question: Question) -> Array:
    """A surface that nothing occludes."""
    return np.ones(len(points))


def above_floor(points: Array, normals: Array, question: Question) -> Array:
    """A point of any normal that only the floor occludes."""
    return closed_forms.half_space(np.abs(points[:, 2]), -normals[:, 2], **question)


def floor_under(
    points: Array,
    normals: Array,
    question: Question,
    *,
    form: Callable[..., Array],
    sizes: tuple[float, ...],
) -> Array:
    """The floor below an occluder: open from underneath; thin and round occluders have no volumetric form."""
    above = np.nan if question["weighting"] == "volumetric" else form(points, *sizes, **question)
    return np.where(normals[:, 2] > 0, above, 1.0)


def open_above(points: Array, normals: Array, question: Question) -> Array:
    """The ground around a pit: open, and unknown from underneath."""
    return np.where(normals[:, 2] > 0, 1.0, np.nan)


def seen_from_within(
    points: Array,
    normals: Array,
    question: Question,
    *,
    inward: Callable[[Array], Array],
    form: Callable[..., Array],
) -> Array:
    """A side of a pit: `form(points, **question)` where `inward(points)` points to the eye, unknown from outside.

    A ray may leave the solid around a pit again, so there is no volumetric form.
    """
    if question["weighting"] == "volumetric":
        return np.full(len(points), np.nan)
    inside = (inward(points) * normals).sum(axis=1) > 0
    return np.where(inside, form(points, **question), np.nan)
