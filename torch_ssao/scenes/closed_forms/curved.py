"""Exact visibility under disks, beside cylinders, in round pits and in spherical bowls.

For an infinite radius and cosine weights most have closed forms; all else is one quadrature (error below 1e-9) whose
inner integral, falloff included, is closed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

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
    sorted_edges,
)

_NEAREST = 1e-7  # of an integration range: steps grow from there


def disk_above(
    offset: ArrayLike,
    disk_radius: ArrayLike,
    height: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a floor under, or beside, a parallel disk.

    Infinite radius: 1 - (1 - (a^2 + h^2 - r^2) / sqrt((a^2 + h^2 + r^2)^2 - 4 a^2 r^2)) / 2; on the axis
    1 - r^2 / (r^2 + h^2).

    Args:
        offset: a >= 0, lateral distance from the disk's axis; disk_radius: r > 0; height: h > 0; scene units.
    Source: configuration-factor tables (plane element to parallel disk); finite radius: rings about the normal.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    a, r, h = np.broadcast_arrays(
        non_negative("offset", offset), positive("disk_radius", disk_radius), positive("height", height)
    )
    if kernel == "cosine" and math.isinf(radius):
        root = np.sqrt(((a - r) ** 2 + h**2) * ((a + r) ** 2 + h**2))
        return 0.5 + 0.5 * (a**2 + h**2 - r**2) / root

    def ring(q: Array) -> Array:
        """Rays whose angle from the normal has the tangent q meet the disk's plane q h away from its foot."""
        blocked = _half_width((q * h) ** 2 + a**2 - r**2, 2.0 * a * q * h)
        c = 1.0 / np.hypot(1.0, q)
        return blocked * q * c**3 * _kernel(c, kernel) * _falloff(h / c / radius, exponent)

    furthest = np.minimum(a + r, np.sqrt(np.maximum(radius - h, 0.0)) * np.sqrt(radius + h)) / h
    return 1.0 - _from_zero(ring, (np.abs(a - r) / h, 1.0, 1e3, furthest), furthest) / math.pi


def bowl(
    polar_deg: ArrayLike,
    half_angle_deg: ArrayLike,
    sphere_radius: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility inside a spherical bowl: the part of a sphere within `half_angle_deg` of its lowest point.

    Infinite radius: (1 + cos(half angle)) / 2 everywhere. Within R of a point lies the share R^2 / (4 r^2) of the
    sphere; as far as the bowl contains it that is the occlusion by cosine and binary hits.

    Args:
        polar_deg: in [0, half_angle_deg], of the point, from the lowest point, degrees.
        half_angle_deg: in (0, 180), of the rim; sphere_radius: r > 0, scene units.
    Source: on a sphere the cosine-weighted directions from any point hit all areas alike; finite radius: rings about
        the normal, which points to the centre.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    half = np.asarray(half_angle_deg, np.float64)
    if not bool(((half > 0) & (half < 180)).all()):
        raise checks.RangeError(
            f"half_angle_deg must lie in (0, 180) degrees, got {half_angle_deg!r}: pass the angle in degrees"
        )
    r = positive("sphere_radius", sphere_radius)
    polar, rim = np.radians(part_of("polar_deg", polar_deg, "half_angle_deg", half)), np.radians(half)
    if kernel == "cosine" and math.isinf(radius):
        return 0.5 + 0.5 * np.cos(rim) + 0.0 * polar * r

    def ring(c: Array) -> Array:
        """At a distance 2 r c lie points an arc of 2 asin c away."""
        cosine, sine = 1.0 - 2.0 * c**2, 2.0 * c * np.sqrt((1.0 - c) * (1.0 + c))
        blocked = _half_width(np.cos(rim) - np.cos(polar) * cosine, np.sin(polar) * sine)
        return blocked * _kernel(c, kernel) * _falloff(2.0 * r * c / radius, exponent)

    reach = np.minimum(0.5 * radius / r, 1.0)
    nearest, furthest = np.sin(0.5 * (rim - polar)), np.sin(0.5 * np.minimum(rim + polar, 2.0 * math.pi - rim - polar))
    return 1.0 - _from_zero(ring, (nearest, furthest, reach), reach) / math.pi


def lying_cylinder(
    distance: ArrayLike,
    cylinder_radius: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a floor at `distance` from the line on which an infinitely long cylinder rests.

    Infinite radius: 1 - 1 / (1 + (x / r)^2); uniform 1 - 2 atan(r / x) / pi.

    Args:
        distance: x >= 0; cylinder_radius: r > 0; scene units.
    Source: strings between the tangents (infinite radius); finite radius: planes through the point's parallel to the
        axis, in which the cylinder is a straight wall.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    x, r = np.broadcast_arrays(non_negative("distance", distance), positive("cylinder_radius", cylinder_radius))
    d = np.hypot(x, r)
    if math.isinf(radius):
        return (x / d) ** 2 if kernel == "cosine" else 1.0 - 2.0 / math.pi * np.arctan2(r, x)
    middle, shorter = np.arctan2(r, x), np.minimum(radius, x)
    # Rays of length R reach the cylinder in a wedge about the direction to its axis, at most between the tangents.
    cosine = (x**2 + shorter**2) / (2.0 * d * np.maximum(shorter, TINY))
    opening = np.where(shorter > 0, np.arccos(np.minimum(cosine, 1.0)), middle)

    def slice_(turn: Array) -> Array:
        chord = d * np.cos(turn) + np.sqrt(np.maximum((r - d * np.sin(turn)) * (r + d * np.sin(turn)), 0.0))
        s = np.minimum(x**2 / (radius * np.maximum(chord, TINY)), 1.0)
        across = np.sin(middle + turn) if kernel == "cosine" else 0.5
        return across * _straight_wall(s, np.arccos(s), kernel, exponent)

    edges = np.stack((-opening, 0.0 * opening, opening))
    return 1.0 - 2.0 / math.pi * integrate(slice_, edges, linear=True)


def round_pit_floor(
    offset: ArrayLike,
    pit_radius: ArrayLike,
    depth: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on the floor of a cylindrical pit.

    Infinite radius: what `disk_above` would hide in the place of the pit's mouth; on the axis r^2 / (r^2 + D^2).

    Args:
        offset: in [0, pit_radius], from the axis; pit_radius: r > 0; depth: D > 0; scene units.
    Source: configuration-factor tables; finite radius: vertical planes through the point.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    r, depth = np.broadcast_arrays(positive("pit_radius", pit_radius), positive("depth", depth))
    a = part_of("offset", offset, "pit_radius", r)
    if math.isinf(radius):
        return 1.0 - disk_above(a, r, depth, weighting=weighting)
    # Near the wall the chord changes where the azimuth from the tangent, psi, is about as small as k: psi = k sinh(v).
    a = np.clip(a, 1e-9 * r, (1.0 - 1e-9) * r)
    k = np.sqrt((r - a) * (r + a)) / a

    def elevations(v: Array) -> Array:
        psi = np.clip(k * np.sinh(v), -0.5 * math.pi, 0.5 * math.pi)
        towards = a * np.sin(psi)  # sin: the azimuth from the direction away from the axis is pi / 2 - psi
        other = np.sqrt((r - a) * (r + a) + towards**2)
        chord = np.where(towards > 0, (r - a) * (r + a) / (other + np.abs(towards)), other - towards)
        s = np.minimum(chord / radius, 1.0)
        return k * np.cosh(v) * _standing_wall(s, np.maximum(s, chord / np.hypot(chord, depth)), kernel, exponent)

    edges = [np.arcsinh(side * 0.5 * math.pi / k) for side in (-1.0, 1.0)]
    for chord in (np.asarray(radius), np.sqrt(np.maximum(radius**2 - depth**2, 0.0))):
        cosine = (r**2 - a**2 - chord**2) / (2.0 * a * np.maximum(chord, 1e-100))
        edges.append(np.arcsinh(np.arcsin(np.clip(cosine, -1.0, 1.0)) / k))
    ordered = sorted_edges((*edges, np.zeros(())), low=edges[0], high=edges[1])
    return 1.0 - integrate(elevations, ordered, linear=True) * (2.0 if kernel == "cosine" else 1.0) / math.pi


def round_pit_wall(
    height: ArrayLike,
    pit_radius: ArrayLike,
    depth: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on the wall of a cylindrical pit.

    Infinite radius, at y = depth - height below the rim, with Y = y / r: ((Y^2 + 2) / sqrt(Y^2 + 4) - Y) / 2.

    Args:
        height: in [0, depth], above the pit's floor; pit_radius: r > 0; depth: > 0; scene units.
    Source: configuration-factor tables (plane element to perpendicular disk); finite radius: vertical planes through
        the point.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    r, depth = np.broadcast_arrays(positive("pit_radius", pit_radius), positive("depth", depth))
    z = part_of("height", height, "depth", depth)
    y = depth - z
    if kernel == "cosine" and math.isinf(radius):
        at = y / r
        return 0.5 * ((at**2 + 2.0) / np.sqrt(at**2 + 4.0) - at)

    def elevations(psi: Array) -> Array:
        """In the vertical plane psi from the tangent the pit is a rectangle as wide as the chord."""
        chord = 2.0 * r * np.sin(psi)
        s = np.minimum(chord / radius, 1.0)
        total = _under(np.minimum(z / radius, 1.0), np.arctan2(z, chord), kernel, exponent)
        for up in (y, z):
            total = total + _straight_wall(s, np.minimum(np.arctan2(up, chord), np.arccos(s)), kernel, exponent)
        return total * (np.sin(psi) if kernel == "cosine" else 1.0)

    edges: list[ArrayLike] = [np.asarray(0.5 * math.pi)]
    for chord in (y, z, radius, np.sqrt(np.maximum(radius**2 - y**2, 0.0)), np.sqrt(np.maximum(radius**2 - z**2, 0.0))):
        edges.append(np.arcsin(np.minimum(chord / (2.0 * r), 1.0)))
    occlusion = _from_zero(elevations, edges, np.asarray(0.5 * math.pi))
    return 1.0 - occlusion * (2.0 if kernel == "cosine" else 1.0) / math.pi


def _from_zero(function: Callable[[Array], Array], kinks: Sequence[ArrayLike], end: Array) -> Array:
    """Integral of `function` over [0, end]: linear up to the first kink, with logarithmic steps between the others."""
    edges = sorted_edges((*kinks, end), low=_NEAREST * np.maximum(end, TINY), high=end)
    start = np.stack((0.0 * edges[0], edges[0]))
    return integrate(function, start, linear=True) + integrate(function, np.maximum(edges, TINY))


def _kernel(c: Array, kernel: str) -> Array | float:
    """Weight of a ring about the normal, per cosine."""
    return 2.0 * c if kernel == "cosine" else 1.0


def _falloff(t: Array, exponent: int | None) -> Array | float:
    """W(t)."""
    return 1.0 if exponent is None else 1.0 - np.minimum(t, 1.0) ** exponent


def _half_width(numerator: Array, denominator: Array) -> Array:
    """acos(numerator / denominator), 0 or pi beyond its domain."""
    return np.arccos(np.clip(numerator / np.maximum(denominator, 1e-150), -1.0, 1.0))


def _straight_wall(s: Array, up: Array, kernel: str, exponent: int | None) -> Array:
    """Integral of W(s / cos e) cos^2 e (cosine) or cos e (uniform) over [0, up]: a wall at distance s R, seen along."""
    sine = np.sin(up)
    if kernel == "cosine":
        whole = 0.5 * (up + sine * np.cos(up))
        return whole if exponent is None else whole - (s * sine if exponent == 1 else s**2 * up)
    if exponent is None:
        return sine
    # A wall is seen up to where cos e = s, so s^2 atanh vanishes where its argument reaches 1.
    return sine - (s * up if exponent == 1 else s**2 * np.arctanh(np.minimum(sine, 1.0 - 1e-16)))


def _standing_wall(s: Array, cosine: Array, kernel: str, exponent: int | None) -> Array:
    """Integral of W(s / cos e) sin e cos e (cosine) or cos e (uniform) from the floor up to an edge of that cosine."""
    if kernel == "uniform":
        return _straight_wall(s, np.arccos(cosine), kernel, exponent)
    whole = 0.5 * (1.0 - cosine) * (1.0 + cosine)
    if exponent is None:
        return whole
    return whole - (s * (1.0 - cosine) if exponent == 1 else -(s**2) * np.log(np.maximum(cosine, TINY)))


def _under(depth: Array, edge: Array, kernel: str, exponent: int | None) -> Array:
    """Integral as in `_straight_wall`, downwards: a floor `depth` R below, from its far edge to the nadir."""
    edge = np.maximum(edge, np.arcsin(depth))
    sine, cosine = np.maximum(np.sin(edge), TINY), np.cos(edge)
    if kernel == "cosine":
        rest = 0.5 * math.pi - edge
        whole = 0.5 * (rest - sine * cosine)
        if exponent == 1:
            return whole + depth * (np.log(np.maximum(np.tan(0.5 * edge), TINY)) + cosine)
        return whole if exponent is None else whole - depth**2 * (cosine / sine - rest)
    if exponent == 1:
        return 1.0 - sine + depth * np.log(sine)
    return 1.0 - sine - (0.0 if exponent is None else depth**2 * (1.0 / sine - 1.0))
