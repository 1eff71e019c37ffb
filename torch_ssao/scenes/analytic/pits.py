"""Scenes of pits in the ground: rectangular, round, a trench, a spherical bowl.

The pit's floor (the bowl's lowest point) lies at z = 0, the ground around its mouth above it.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from torch_ssao import checks
from torch_ssao.scenes import closed_forms
from torch_ssao.scenes.analytic.forms import open_above, seen_from_within
from torch_ssao.scenes.analytic.scene import AnalyticScene, ClosedForm
from torch_ssao.scenes.primitives import Annulus, Array, Cylinder, Patch, Sphere, Surface

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def rectangular_pit(width: float, length: float, depth: float) -> AnalyticScene:
    """A box without a lid, centred on the z axis: `closed_forms.pit_floor`, `pit_wall`; the ground is open.

    Args:
        width, length: > 0, along x and y; depth: > 0; scene units.
    Raises: RangeError.
    """
    for name, value in (("width", width), ("length", length), ("depth", depth)):
        checks.check_positive(name, value)
    return _box("rectangular_pit", width, length, depth, span=1.5 * max(width, length))


def trench(width: float, depth: float) -> AnalyticScene:
    """A pit that goes on for ever along y: `closed_forms.trench_floor`, `trench_wall`; the ground is open.

    Args:
        width, depth: > 0, scene units.
    Raises: RangeError.
    """
    checks.check_positive("width", width)
    checks.check_positive("depth", depth)
    return _box("trench", width, math.inf, depth, span=2.0 * width)


def round_pit(radius: float, depth: float) -> AnalyticScene:
    """A cylindrical pit about the z axis: `closed_forms.round_pit_floor`, `round_pit_wall`; the ground is open.

    Args:
        radius: > 0, of the pit; depth: > 0; scene units.
    Raises: RangeError.
    """
    checks.check_positive("radius", radius)
    checks.check_positive("depth", depth)
    surfaces = (
        Annulus((0.0, 0.0, 0.0), 0.0, radius),
        Cylinder((0.0, 0.0, 0.0), _Z, radius, (0.0, depth)),
        Annulus((0.0, 0.0, depth), radius, math.inf),
    )
    forms = (
        partial(seen_from_within, inward=_up, form=partial(_round_floor, pit_radius=radius, depth=depth)),
        partial(seen_from_within, inward=_to_axis, form=partial(_round_wall, pit_radius=radius, depth=depth)),
        open_above,
    )
    return AnalyticScene("round_pit", surfaces, forms, (0.0, 0.0, 0.0), 3.0 * radius)


def spherical_bowl(radius: float, half_angle_deg: float = 90.0) -> AnalyticScene:
    """A hollow in the ground, part of a sphere about the z axis: `closed_forms.bowl`; the ground is open.

    Args:
        radius: > 0, of the sphere, scene units.
        half_angle_deg: in (0, 180), from the lowest point to the rim, seen from the sphere's centre; 90 is a hemisphere.
    Raises: RangeError.
    """
    checks.check_positive("radius", radius)
    closed_forms.bowl(0.0, half_angle_deg, radius)  # one range check for both
    sine, cosine = math.sin(math.radians(half_angle_deg)), math.cos(math.radians(half_angle_deg))
    rim = radius * (1.0 - cosine)
    surfaces = (
        Sphere((0.0, 0.0, radius), radius, (-math.inf, rim)),
        Annulus((0.0, 0.0, rim), radius * sine, math.inf),
    )
    inside = partial(_in_bowl, sphere_radius=radius, half_angle_deg=half_angle_deg)
    to_centre = partial(_to_centre, height=radius)
    forms = (partial(seen_from_within, inward=to_centre, form=inside), open_above)
    return AnalyticScene("spherical_bowl", surfaces, forms, (0.0, 0.0, 0.0), 3.0 * radius * max(sine, 0.3))


def _box(name: str, width: float, length: float, depth: float, *, span: float) -> AnalyticScene:
    x, y = 0.5 * width, 0.5 * length
    across, along, up, everywhere = (-x, x), (-y, y), (0.0, depth), (-math.inf, math.inf)
    top, size = (0.0, 0.0, depth), (width, length, depth)
    surfaces: list[Surface] = [Patch((0.0, 0.0, 0.0), _X, _Y, across, along)]
    forms: list[ClosedForm] = [partial(seen_from_within, inward=_up, form=partial(_box_floor, size=size))]
    sides = [(0, -1.0), (0, 1.0)] if math.isinf(length) else [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)]
    for axis, sign in sides:
        if axis == 0:
            surfaces.append(Patch((sign * x, 0.0, 0.0), _Y, _Z, along, up))
            ground = Patch(top, _X, _Y, _beyond(x, sign), everywhere)
        else:
            surfaces.append(Patch((0.0, sign * y, 0.0), _X, _Z, across, up))
            ground = Patch(top, _X, _Y, across, _beyond(y, sign))
        wall = partial(_box_wall, size=size, axis=axis)
        forms.append(partial(seen_from_within, inward=partial(_inwards, axis=axis, sign=-sign), form=wall))
        surfaces.append(ground)
        forms.append(open_above)
    return AnalyticScene(name, tuple(surfaces), tuple(forms), (0.0, 0.0, 0.0), span)


def _beyond(edge: float, sign: float) -> tuple[float, float]:
    return (edge, math.inf) if sign > 0 else (-math.inf, -edge)


def _up(points: Array) -> Array:
    return np.broadcast_to(np.array(_Z), points.shape)


def _inwards(points: Array, *, axis: int, sign: float) -> Array:
    return np.broadcast_to(sign * np.eye(3)[axis], points.shape)


def _to_axis(points: Array) -> Array:
    return points * np.array([-1.0, -1.0, 0.0])


def _to_centre(points: Array, *, height: float) -> Array:
    return np.array([0.0, 0.0, height]) - points


def _box_floor(points: Array, *, size: tuple[float, float, float], **question: object) -> Array:
    width, length, depth = size
    x, y = _from_end(points[:, 0], width), _from_end(points[:, 1], length)
    return closed_forms.pit_floor(x, y, width, length, depth, **question)  # type: ignore[arg-type]


def _box_wall(points: Array, *, size: tuple[float, float, float], axis: int, **question: object) -> Array:
    opposite, length, depth = size[axis], size[1 - axis], size[2]
    along, height = _from_end(points[:, 1 - axis], length), np.clip(points[:, 2], 0.0, depth)
    return closed_forms.pit_wall(along, height, opposite, length, depth, **question)  # type: ignore[arg-type]


def _from_end(coordinate: Array, length: float) -> Array:
    return 0.0 * coordinate if math.isinf(length) else np.clip(coordinate + 0.5 * length, 0.0, length)


def _round_floor(points: Array, *, pit_radius: float, depth: float, **question: object) -> Array:
    offset = np.minimum(np.hypot(points[:, 0], points[:, 1]), pit_radius)
    return closed_forms.round_pit_floor(offset, pit_radius, depth, **question)  # type: ignore[arg-type]


def _round_wall(points: Array, *, pit_radius: float, depth: float, **question: object) -> Array:
    height = np.clip(points[:, 2], 0.0, depth)
    return closed_forms.round_pit_wall(height, pit_radius, depth, **question)  # type: ignore[arg-type]


def _in_bowl(points: Array, *, sphere_radius: float, half_angle_deg: float, **question: object) -> Array:
    polar = np.degrees(np.arctan2(np.hypot(points[:, 0], points[:, 1]), sphere_radius - points[:, 2]))
    return closed_forms.bowl(
        np.minimum(polar, half_angle_deg),
        half_angle_deg,
        sphere_radius,
        **question,  # type: ignore[arg-type]
    )
