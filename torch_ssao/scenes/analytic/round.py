"""Scenes of round things over a floor: a sphere, a lying cylinder, a disk."""

from __future__ import annotations

from functools import partial

import numpy as np

from torch_ssao import checks
from torch_ssao.scenes import closed_forms
from torch_ssao.scenes.analytic.forms import above_floor, floor, floor_under
from torch_ssao.scenes.analytic.scene import AnalyticScene, Question
from torch_ssao.scenes.primitives import Annulus, Array, Cylinder, Sphere


def sphere_on_plane(radius: float) -> AnalyticScene:
    """A sphere that rests on the floor at the origin: `closed_forms.sphere_on_plane`, and `half_space` on the sphere.

    Args:
        radius: > 0, of the sphere, scene units.
    Raises: RangeError.
    """
    checks.check_positive("radius", radius)
    form = partial(floor_under, form=_beside_sphere, sizes=(radius,))
    surfaces = (floor(), Sphere((0.0, 0.0, radius), radius))
    on_ball = partial(_on_sphere, sphere_radius=radius)
    return AnalyticScene("sphere_on_plane", surfaces, (form, on_ball), (1.2 * radius, 0.0, 0.0), 5.0 * radius)


def lying_cylinder(radius: float) -> AnalyticScene:
    """An infinite cylinder that rests on the floor along the y axis: `closed_forms.lying_cylinder`, `half_space` on it.

    Args:
        radius: > 0, of the cylinder, scene units.
    Raises: RangeError.
    """
    checks.check_positive("radius", radius)
    axis = (0.0, 0.0, radius)
    form = partial(floor_under, form=_beside_cylinder, sizes=(radius,))
    side = partial(_on_cylinder, cylinder_radius=radius)
    surfaces = (floor(), Cylinder(axis, (0.0, 1.0, 0.0), radius))
    return AnalyticScene("lying_cylinder", surfaces, (form, side), (1.5 * radius, 0.0, 0.0), 5.0 * radius)


def disk_over_plane(radius: float, height: float) -> AnalyticScene:
    """A thin horizontal disk above the origin: `closed_forms.disk_above` on the floor, `ceiling` on its underside.

    Args:
        radius: > 0, of the disk; height: > 0; scene units.
    Raises: RangeError.
    """
    checks.check_positive("radius", radius)
    checks.check_positive("height", height)
    form = partial(floor_under, form=_below_disk, sizes=(radius, height))
    surfaces = (floor(), Annulus((0.0, 0.0, height), 0.0, radius))
    focus = (radius + 0.5 * height, 0.0, 0.0)
    return AnalyticScene("disk_over_plane", surfaces, (form, above_floor), focus, 3.0 * radius + 2.0 * height)


def _on_sphere(points: Array, normals: Array, question: Question, *, sphere_radius: float) -> Array:
    outside = ((points - np.array([0.0, 0.0, sphere_radius])) * normals).sum(axis=1) > 0
    return np.where(outside, above_floor(points, normals, question), np.nan)


def _beside_sphere(points: Array, sphere_radius: float, **question: object) -> Array:
    lateral = np.hypot(points[:, 0], points[:, 1])
    return closed_forms.sphere_on_plane(lateral, sphere_radius, **question)  # type: ignore[arg-type]


def _on_cylinder(points: Array, normals: Array, question: Question, *, cylinder_radius: float) -> Array:
    outward = points[:, 0] * normals[:, 0] + (points[:, 2] - cylinder_radius) * normals[:, 2]
    return np.where(outward > 0, above_floor(points, normals, question), np.nan)


def _beside_cylinder(points: Array, cylinder_radius: float, **question: object) -> Array:
    return closed_forms.lying_cylinder(np.abs(points[:, 0]), cylinder_radius, **question)  # type: ignore[arg-type]


def _below_disk(points: Array, disk_radius: float, height: float, **question: object) -> Array:
    offset = np.hypot(points[:, 0], points[:, 1])
    return closed_forms.disk_above(offset, disk_radius, height, **question)  # type: ignore[arg-type]
