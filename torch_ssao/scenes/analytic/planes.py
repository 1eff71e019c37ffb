"""Scenes of planes that go on for ever: floors, walls, wedges, slats, ceilings, the corner of a room."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from torch_ssao import checks
from torch_ssao.scenes import closed_forms
from torch_ssao.scenes.analytic.forms import above_floor, always_open, floor, floor_under
from torch_ssao.scenes.analytic.scene import AnalyticScene, ClosedForm, Question
from torch_ssao.scenes.primitives import Array, Patch


def plane() -> AnalyticScene:
    """The infinite floor alone: visibility 1."""
    return AnalyticScene("plane", (floor(),), (always_open,), (0.5, 0.0, 0.0), 2.0)


def wall() -> AnalyticScene:
    """A floor and an infinite wall at right angles: `closed_forms.wall` on both."""
    return AnalyticScene("wall", *_wedge(90.0), focus=(0.5, 0.0, 0.0), span=2.0)


def dihedral(angle_deg: float) -> AnalyticScene:
    """Two half-planes that share the y axis: `closed_forms.dihedral` on both, inside and outside.

    Args:
        angle_deg: interior angle, in (0, 360); above 180 the edge is convex.
    Raises: RangeError.
    """
    closed_forms.dihedral(1.0, angle_deg)  # one range check for both
    return AnalyticScene("dihedral", *_wedge(angle_deg), focus=(0.5, 0.0, 0.0), span=2.0)


def finite_wall(height: float) -> AnalyticScene:
    """A thin, infinitely long wall of finite height: `closed_forms.finite_wall` on the floor, `wall` on the wall.

    Args:
        height: > 0, scene units.
    Raises: RangeError.
    """
    checks.check_positive("height", height)
    return _slat("finite_wall", 0.0, height)


def raised_slat(gap: float, height: float) -> AnalyticScene:
    """A thin wall that begins at a height above the floor: `closed_forms.raised_slat` on the floor, `wall` on the slat.

    Args:
        gap: > 0, scene units below the slat; height: > 0, of the slat itself.
    Raises: RangeError.
    """
    checks.check_positive("gap", gap)
    checks.check_positive("height", height)
    return _slat("raised_slat", gap, height)


def ceiling(height: float) -> AnalyticScene:
    """A floor under an infinite parallel plate: `closed_forms.ceiling` on both.

    Args:
        height: > 0, of the plate, scene units.
    Raises: RangeError.
    """
    checks.check_positive("height", height)
    plate = Patch((0.0, 0.0, height), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
    inside = (partial(_between_plates, height=height, up=1.0), partial(_between_plates, height=height, up=-1.0))
    return AnalyticScene("ceiling", (floor(), plate), inside, (0.0, 0.0, 0.0), 2.0 * height)


def room_corner() -> AnalyticScene:
    """A floor and two walls, all at right angles: `closed_forms.room_corner` on each; the outside is open."""
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    away, towards = (0.0, math.inf), (-math.inf, 0.0)
    origin = (0.0, 0.0, 0.0)
    faces = (
        Patch(origin, x, y, away, towards),
        Patch(origin, y, z, towards, away),
        Patch(origin, x, z, away, away),
    )
    forms = tuple(
        partial(_in_corner, inward=np.array(face.normal), sides=sides)
        for face, sides in zip(faces, ((0, 1), (1, 2), (0, 2)), strict=True)
    )
    return AnalyticScene("room_corner", faces, forms, (0.5, -0.5, 0.0), 2.0)


def _wedge(angle_deg: float) -> tuple[tuple[Patch, Patch], tuple[ClosedForm, ClosedForm]]:
    """Half-planes from the y axis along +x and along the interior angle, with normals into the interior."""
    sine, cosine = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
    half = (0.0, math.inf)
    floor = Patch((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), u_range=half)
    face = Patch((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (cosine, 0.0, sine), v_range=half)
    forms = [partial(_on_wedge, angle_deg=angle_deg, inward=np.array(patch.normal)) for patch in (floor, face)]
    return (floor, face), (forms[0], forms[1])


def _slat(name: str, gap: float, height: float) -> AnalyticScene:
    slat = Patch((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), v_range=(gap, gap + height))
    form = partial(floor_under, form=_beside_slat, sizes=(gap, height))
    top = gap + height
    return AnalyticScene(name, (floor(), slat), (form, above_floor), (0.6 * top, 0.0, 0.0), 3.0 * top)


def _on_wedge(points: Array, normals: Array, question: Question, *, angle_deg: float, inward: Array) -> Array:
    angle = np.where(normals @ inward > 0, angle_deg, 360.0 - angle_deg)
    return closed_forms.dihedral(np.hypot(points[:, 0], points[:, 2]), angle, **question)


def _between_plates(points: Array, normals: Array, question: Question, *, height: float, up: float) -> Array:
    return np.where(up * normals[:, 2] > 0, closed_forms.ceiling(height, **question), 1.0)


def _beside_slat(points: Array, gap: float, height: float, **question: object) -> Array:
    return closed_forms.raised_slat(np.abs(points[:, 0]), gap, height, **question)  # type: ignore[arg-type]


def _in_corner(points: Array, normals: Array, question: Question, *, inward: Array, sides: tuple[int, int]) -> Array:
    first, second = (np.abs(points[:, side]) for side in sides)
    return np.where(normals @ inward > 0, closed_forms.room_corner(first, second, **question), 1.0)
