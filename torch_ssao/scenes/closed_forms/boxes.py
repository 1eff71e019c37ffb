"""Exact visibility inside corners, trenches and rectangular pits, built from rectangles that are cut by the radius.

Seen from inside a convex cavity every ray meets one side at most, so occlusions by the sides add up. A side is cut into
rectangles that have a corner at the foot of the perpendicular from the point to the side's plane; these are integrated
in closed form, but for linear and quadratic falloffs where cosine and solid angle leave a dilogarithm (quadrature).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from torch_ssao import checks
from torch_ssao.scenes.closed_forms.common import (
    TINY,
    Array,
    check_question,
    integrate,
    non_negative,
    part_of,
    positive,
)

_EDGE = 1e-12  # of a side: where three faces meet, visibility depends on the way there; points keep off them
_SMALL = 1e-200  # keeps quotients finite where 0 multiplies them away

Range = tuple[ArrayLike, ArrayLike]


def parallel_rectangle(
    height: ArrayLike,
    x_range: Range,
    y_range: Range,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a floor under a parallel rectangle.

    Infinite radius, a corner above the point, sides a and b, with X = a / h and Y = b / h: occlusion is
    (X / sqrt(1 + X^2) atan(Y / sqrt(1 + X^2)) + Y / sqrt(1 + Y^2) atan(X / sqrt(1 + Y^2))) / (2 pi).

    Args:
        height: h > 0, scene units.
        x_range, y_range: (low, high) of the rectangle's sides, measured from above the point, scene units; infinite
            ends allowed.
    Source: configuration-factor tables (plane element to parallel rectangle); finite radius derived in polar
        coordinates about the foot.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    h = positive("height", height)
    return 1.0 - _four_corners(_quarter(h, radius, exponent, kernel), _range("x", x_range), _range("y", y_range))


def upright_rectangle(
    distance: ArrayLike,
    height: ArrayLike,
    y_range: Range,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a floor before a rectangle that stands on it.

    Infinite radius, one side of the rectangle opposite the point, width b: occlusion is
    (atan(b / c) - c / sqrt(c^2 + a^2) atan(b / sqrt(c^2 + a^2))) / (2 pi) at the distance c from the height a.

    Args:
        distance: >= 0, to the rectangle's plane, scene units.
        height: > 0, scene units, inf allowed.
        y_range: (low, high) of the rectangle along the floor, measured from the foot of the perpendicular; infinite
            ends allowed.
    Source: configuration-factor tables (plane element to perpendicular rectangle); finite radius and falloffs derived
        by integrating over the height first.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    c, a = non_negative("distance", distance), positive("height", height)
    return 1.0 - _upright(c, a, _range("y", y_range), radius, exponent, kernel)


def room_corner(
    first: ArrayLike,
    second: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on one face of a corner of three mutually perpendicular planes.

    Infinite radius: 1/4 everywhere, whatever the weighting.

    Args:
        first, second: >= 0, distances from the other two faces, scene units.
    Source: `upright_rectangle`, twice, with infinite sides.
    """
    kernel, exponent = check_question(radius, falloff, weighting)
    step = 1.0 if math.isinf(radius) else radius
    x, y = (np.maximum(non_negative(n, side), _EDGE * step) for n, side in (("first", first), ("second", second)))
    top = np.asarray(np.inf)
    return (
        1.0
        - _upright(x, top, (-y, top), radius, exponent, kernel)
        - _upright(y, top, (-x, top), radius, exponent, kernel)
    )


def trench_floor(
    distance: ArrayLike,
    width: ArrayLike,
    depth: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on the floor of an infinitely long trench.

    Infinite radius: (u / sqrt(u^2 + D^2) + (w - u) / sqrt((w - u)^2 + D^2)) / 2.

    Args:
        distance: u in [0, width], from one wall; width: w > 0; depth: D > 0; scene units.
    Source: the occlusion of two `finite_wall`s.
    """
    return pit_floor(distance, 0.0, width, math.inf, depth, radius=radius, falloff=falloff, weighting=weighting)


def trench_wall(
    height: ArrayLike,
    width: ArrayLike,
    depth: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a wall of an infinitely long trench.

    Infinite radius, at y = depth - height below the rim: (1 - y / sqrt(y^2 + w^2)) / 2.

    Args:
        height: in [0, depth], above the trench's floor; width: w > 0; depth: > 0; scene units.
    Source: half a plane of sky beyond the opposite rim.
    """
    return pit_wall(0.0, height, width, math.inf, depth, radius=radius, falloff=falloff, weighting=weighting)


def pit_floor(
    x: ArrayLike,
    y: ArrayLike,
    width: ArrayLike,
    length: ArrayLike,
    depth: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on the floor of a rectangular pit: one minus four `upright_rectangle` walls.

    Infinite radius: what `parallel_rectangle` would hide in the place of the pit's mouth.

    Args:
        x, y: in [0, width], [0, length], from one corner; scene units. With an infinite length y does not matter.
        width, length, depth: > 0, scene units; the length may be inf.
    Source: configuration-factor tables; finite radius derived.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    side, top = positive("width", width), positive("depth", depth)
    near = np.clip(part_of("x", x, "width", side), _EDGE * side, (1.0 - _EDGE) * side)
    far = side - near
    low, high, long = _ends("y", y, length)
    occlusion = _upright(near, top, (-low, high), radius, exponent, kernel)
    occlusion = occlusion + _upright(far, top, (-low, high), radius, exponent, kernel)
    if not long:
        for wall in (low, high):
            occlusion = occlusion + _upright(wall, top, (-near, far), radius, exponent, kernel)
    return 1.0 - occlusion


def pit_wall(
    along: ArrayLike,
    height: ArrayLike,
    width: ArrayLike,
    length: ArrayLike,
    depth: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a wall of a rectangular pit: one minus its floor, two adjoining walls and the opposite wall.

    Infinite radius: what an `upright_rectangle` would hide in the place of the pit's mouth.

    Args:
        along: in [0, length], from one end of the wall; with an infinite length it does not matter.
        height: in [0, depth], above the pit's floor.
        width: > 0, to the opposite wall; length: > 0, of this wall, may be inf; depth: > 0; all in scene units.
    Source: configuration-factor tables; finite radius derived.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    width, depth = positive("width", width), positive("depth", depth)
    z = np.maximum(part_of("height", height, "depth", depth), _EDGE * depth)
    low, high, long = _ends("along", along, length)
    occlusion = _upright(z, width, (-low, high), radius, exponent, kernel)
    occlusion = occlusion + _four_corners(_quarter(width, radius, exponent, kernel), (-low, high), (-z, depth - z))
    if not long:
        for wall in (low, high):
            occlusion = occlusion + _upright(wall, width, (-z, depth - z), radius, exponent, kernel)
    return 1.0 - occlusion


def _range(name: str, ends: Range) -> tuple[Array, Array]:
    low, high = np.asarray(ends[0], np.float64), np.asarray(ends[1], np.float64)
    if not bool((low <= high).all()):
        raise checks.RangeError(f"{name}_range must be (low, high) with low <= high, got {ends!r}: swap them")
    return low, high


def _ends(name: str, value: ArrayLike, length: ArrayLike) -> tuple[Array, Array, bool]:
    """Distances to both ends of a side, and whether these are infinite."""
    whole = positive("length", length)
    if bool(np.isinf(whole).all()):
        return whole, whole, True
    at = part_of(name, value, "length", whole)
    return np.maximum(at, _EDGE * whole), np.maximum(whole - at, _EDGE * whole), False


def _four_corners(quarter: Callable[[Array, Array], Array], xs: tuple[Array, Array], ys: tuple[Array, Array]) -> Array:
    """A rectangle as the signed sum of four that have a corner at the origin."""
    total = np.zeros(())
    for i, x in enumerate(xs):
        for j, y in enumerate(ys):
            sign = (1.0 if i == j else -1.0) * np.sign(x) * np.sign(y)
            total = total + sign * quarter(np.abs(x), np.abs(y))
    return total


def _upright(c: Array, top: Array, ys: tuple[Array, Array], radius: float, exponent: int | None, kernel: str) -> Array:
    """Occlusion by a rectangle that stands on the floor, heights 0 to `top`."""
    if kernel == "uniform":
        return _four_corners(_quarter(c, radius, exponent, kernel), (np.zeros(()), top), ys)
    low, high = (np.sign(y) * _upright_quarter(c, top, np.abs(y), radius, exponent) for y in ys)
    return high - low


def _upright_quarter(c: Array, a: Array, b: Array, radius: float, exponent: int | None) -> Array:
    """Cosine-weighted occlusion by y in [0, b], z in [0, a] of a plane at distance c, z along the normal.

    (1 / pi) times the integral of c z / r^4 W(r / R): over z it is G(q) - G(min(top, R)), G(r) the antiderivative of
    -W / r^3, at the rectangle's lower and upper end; `_line` integrates G over y. Lengths in units of R.
    """
    if math.isinf(radius):
        far = np.hypot(c, a)
        return (np.arctan2(b, c) - c / far * np.arctan2(b, far)) / (2.0 * math.pi)
    c, b = c / radius, b / radius
    far = np.hypot(c, np.minimum(a / radius, 1.0))  # higher than R is as high as R
    low_end = np.minimum(b, np.sqrt(np.maximum(1.0 - c**2, 0.0)))
    high_end = np.minimum(b, np.sqrt(np.maximum(1.0 - far**2, 0.0)))
    at_reach = -0.5 if exponent == 1 else 0.5  # G(R)
    cut = c * (low_end - high_end) * at_reach
    return (_line(c, c, low_end, exponent) - _line(c, far, high_end, exponent) - cut) / math.pi


def _line(c: Array, q: Array, y: Array, exponent: int | None) -> Array:
    """c times the integral over [0, y] of G(sqrt(q^2 + y^2)): 1 / (2 r^2), less 1 / r (linear), plus ln r (quadratic)."""
    share, angle = np.where(c == q, 1.0, c / np.maximum(q, _SMALL)), np.arctan2(y, q)
    if exponent is None:
        return 0.5 * share * angle
    if exponent == 1:
        return 0.5 * share * angle - c * np.arcsinh(y / np.maximum(q, _SMALL))
    return 0.5 * share * angle + c * (y * np.log(np.maximum(np.hypot(q, y), TINY)) - y + q * angle)


def _quarter(h: Array, radius: float, exponent: int | None, kernel: str) -> Callable[[Array, Array], Array]:
    """Occlusion by x in [0, a], y in [0, b] of the plane at distance h; the normal is along h (irrelevant to "uniform").

    In polar coordinates about the foot the rectangle is two triangles. Where an edge is nearer than R the integral over
    the distance is `_inner` at the edge, elsewhere at R.
    """
    if math.isinf(radius):

        def triangle(a: Array, b: Array) -> Array:
            return _to_edge(h, a, np.arctan2(b, a), None, kernel) / (2.0 * math.pi)

        return lambda a, b: triangle(a, b) + triangle(b, a)
    h = h / radius
    flat = np.sqrt(np.maximum(1.0 - h**2, 0.0))
    beyond = _inner(h, np.maximum(h, 1.0), exponent, kernel)

    def cut_triangle(a: Array, b: Array) -> Array:
        turn = np.arctan2(b, a)
        inside = np.minimum(turn, np.arccos(np.minimum(a / np.maximum(flat, _SMALL), 1.0)))
        near = _to_edge(h, np.minimum(a, 1.0), inside, exponent, kernel)
        return (near + (turn - inside) * beyond) / (2.0 * math.pi)

    return lambda a, b: cut_triangle(a / radius, b / radius) + cut_triangle(b / radius, a / radius)


def _inner(h: Array, r: Array, exponent: int | None, kernel: str) -> Array:
    """Cosine: 2 h^2 times the integral of W(r) / r^3 over [h, r]; uniform: h times that of W(r) / r^2. In units of R."""
    near = h / np.maximum(r, TINY)
    if kernel == "cosine":
        if exponent == 1:
            return (1.0 - near) * (1.0 + near - 2.0 * h)
        loss = 0.0 if exponent is None else -2.0 * h**2 * np.log(np.maximum(near, TINY))
        return 1.0 - near**2 - loss
    if exponent == 1:
        return 1.0 - near + h * np.log(np.maximum(near, TINY))
    if exponent == 2:
        return 1.0 - near - h * (r - h)
    return 1.0 - near - (0.0 if exponent is None else 0.5 * h * (r - h) * (r + h))


def _to_edge(h: Array, a: Array, turn: Array, exponent: int | None, kernel: str) -> Array:
    """Integral of `_inner` over the azimuths [0, turn] of an edge at distance `a` from the foot."""
    if exponent is None:
        if kernel == "cosine":
            share = 1.0 / np.hypot(1.0, h / np.maximum(a, _SMALL))
            return share * np.arctan2(share * np.sin(turn), np.cos(turn))
        return turn - np.arcsin(np.sin(turn) / np.hypot(1.0, a / np.maximum(h, _SMALL)))
    a = np.maximum(a, 1e-150)

    def along(tau: Array) -> Array:
        """Along the edge at a sinh(tau) from its nearest point."""
        return _inner(h, np.hypot(h, a * np.cosh(tau)), exponent, kernel) / np.cosh(tau)

    end = np.arcsinh(np.tan(np.minimum(turn, 0.5 * math.pi - 1e-12)))
    return integrate(along, np.stack(np.broadcast_arrays(0.0 * h, end)), linear=True)
