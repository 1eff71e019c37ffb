"""Exact visibility before walls, slats and ceilings: planes that go on for ever."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from torch_ssao import checks
from torch_ssao.scenes.closed_forms.caps import cap
from torch_ssao.scenes.closed_forms.common import TINY, Array, attenuated, check_question, cosine, non_negative


def plane(*, radius: float = math.inf, falloff: str = "binary", weighting: str = "cosine") -> Array:
    """Visibility of a point on an unobstructed plane: 1, whatever the radius.

    Source: derived (the hemisphere is empty).
    """
    check_question(radius, falloff, weighting)
    return np.ones(())


def wall(distance: ArrayLike, *, radius: float = math.inf, falloff: str = "binary", weighting: str = "cosine") -> Array:
    """Visibility on a floor at `distance` from an infinite perpendicular wall.

    With s = distance / R, occlusion is, for cosine weights and binary, linear, quadratic falloff,
    S(s) / pi with S = acos s - s q, acos s - 2 s acosh(1/s) + s q, (1 + 2 s^2) acos s - 3 s q and q = sqrt(1 - s^2);
    for uniform weights (1 - s) / 2, (1 - s + s ln s) / 2, (1 - s)^2 / 2; volumetric (1 - s)^2 (2 + s) / 4.

    Args:
        distance: >= 0, scene units.
    Source: Nusselt analog (a segment of the unit disk); falloffs derived by integrating over the radius.
    """
    kernel, exponent = check_question(radius, falloff, weighting)
    s = np.minimum(non_negative("distance", distance) / radius, 1.0)
    occlusion = _segment(s, exponent) / math.pi if kernel == "cosine" else 0.5 * _ramp(s, exponent)
    return 1.0 - occlusion


def ceiling(
    height: ArrayLike, *, radius: float = math.inf, falloff: str = "binary", weighting: str = "cosine"
) -> Array:
    """Visibility on a floor under an infinite parallel plate at `height`.

    With s = height / R < 1, occlusion is, for cosine weights and binary, linear, quadratic falloff, 1 - s^2, (1 - s)^2,
    1 - s^2 (1 + 2 ln(1/s)); for uniform weights 1 - s, 1 - s + s ln s, (1 - s)^2; volumetric (1 - s)^2 (2 + s) / 2.

    Args:
        height: >= 0, scene units.
    Source: derived (a spherical cap about the normal).
    """
    kernel, exponent = check_question(radius, falloff, weighting)
    s = np.minimum(non_negative("height", height) / radius, 1.0)
    if kernel == "uniform":
        return 1.0 - _ramp(s, exponent)
    if exponent is None:
        return s**2
    if exponent == 1:
        return 1.0 - (1.0 - s) ** 2
    return s**2 * (1.0 - 2.0 * np.log(np.maximum(s, TINY)))


def half_space(
    distance: ArrayLike,
    cos_tilt: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility of a point at `distance` from an infinite plane of any orientation that fills the space behind it.

    The rays that reach the plane within R form a spherical cap of half-angle acos(distance / R) about the direction to
    the plane's nearest point; see `spherical_cap`. Falloffs other than binary by quadrature (error below 1e-13).

    Args:
        distance: >= 0, perpendicular distance to the plane, scene units.
        cos_tilt: in [-1, 1], cosine between the normal and the direction to the plane's nearest point.
    Source: derived; the infinite limit is (1 + cos_tilt) / 2 of configuration-factor tables.
    """
    kernel, exponent = check_question(radius, falloff, weighting)
    d, tilt = np.broadcast_arrays(non_negative("distance", distance), cosine("cos_tilt", cos_tilt))
    sin_tilt = np.sqrt(1.0 - tilt**2)

    def binary(reach: ArrayLike) -> Array:
        return cap(np.minimum(d / np.maximum(reach, TINY), 1.0), tilt, kernel)

    # The cap is born at t = d / R and meets the horizon at t = d / (R sin tilt).
    breaks = (d / radius, d / radius / np.maximum(sin_tilt, 1e-30))
    return 1.0 - attenuated(binary, radius, exponent, breaks)


def dihedral(
    distance: ArrayLike,
    angle_deg: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on one face of a dihedral (two half-planes that share an edge).

    Infinite radius: sin^2(angle / 2), uniform angle / 180 degrees, at any distance; finite: `half_space` at
    distance * sin(angle), tilted by the angle. Convex angles (180 degrees and more) are open.

    Args:
        distance: >= 0, from the edge, measured on the face, scene units.
        angle_deg: in (0, 360), the angle between the faces on the side of the point.
    Source: derived (the cosine over a lune); finite radius: a spherical cap about the other face's nearest point.
    """
    check_question(radius, falloff, weighting)
    angle = np.asarray(angle_deg, np.float64)
    if not bool(((angle > 0) & (angle < 360)).all()):
        raise checks.RangeError(f"angle_deg must lie in (0, 360) degrees, got {angle_deg!r}: pass the angle in degrees")
    concave = angle < 180.0
    beta = np.radians(np.where(concave, angle, 90.0))
    distance = non_negative("distance", distance)
    inside = half_space(distance * np.sin(beta), np.cos(beta), radius=radius, falloff=falloff, weighting=weighting)
    return np.where(concave, inside, 1.0)


def finite_wall(
    distance: ArrayLike,
    height: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a floor at `distance` from an infinitely long thin wall: `raised_slat` without a gap.

    Infinite radius: 1 - (1 - x / sqrt(x^2 + H^2)) / 2; uniform 1 - atan(H / x) / pi.

    Args:
        distance: >= 0; height: > 0; scene units.
    Source: Nusselt analog (half a disk minus half an ellipse).
    """
    return raised_slat(distance, 0.0, height, radius=radius, falloff=falloff, weighting=weighting)


def raised_slat(
    distance: ArrayLike,
    gap: ArrayLike,
    height: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a floor at `distance` from an infinitely long thin wall that begins at `gap` and is `height` high.

    With d1, d2 the distances to the lower and the upper edge, occlusion is (x / pi) (S(d1 / R) / d1 - S(d2 / R) / d2),
    S as in `wall`; infinite radius: (x / d1 - x / d2) / 2. Uniform, binary: (P((gap + height) / d2) - P(gap / d1)) / pi
    with P(w) = asin(w / q) - s atan(s w / sqrt(q^2 - w^2)), s = x / R, q^2 = 1 - s^2, w at most q; other uniform
    falloffs by quadrature.

    Args:
        distance: >= 0; gap: >= 0; height: > 0; scene units.
    Source: Nusselt analog (an edge parallel to the floor projects onto an ellipse of semi-axes x / d and 1).
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    checks.check_positive("height", float(np.min(np.asarray(height, np.float64))))
    x, low, size = np.broadcast_arrays(
        non_negative("distance", distance), non_negative("gap", gap), non_negative("height", height)
    )
    high = low + size
    near, far = np.hypot(x, low), np.hypot(x, high)
    if kernel == "cosine":
        shrink_near = np.where(low == 0, 1.0, x / np.where(low == 0, 1.0, near))
        occlusion = shrink_near * _segment(near / radius, exponent) - x / far * _segment(far / radius, exponent)
        return 1.0 - occlusion / math.pi

    def binary(reach: ArrayLike) -> Array:
        return (_strip(x, high, reach) - _strip(x, low, reach)) / math.pi

    return 1.0 - attenuated(binary, radius, exponent, (near / radius, far / radius))


def _segment(u: Array, exponent: int | None) -> Array:
    """Area of the unit disk's segment beyond the chord at u, averaged over radii for a falloff."""
    u = np.minimum(u, 1.0)
    root, arc = np.sqrt(1.0 - u**2), np.arccos(u)
    if exponent is None:
        return arc - u * root
    if exponent == 1:
        return arc - 2.0 * u * np.arccosh(1.0 / np.maximum(u, TINY)) + u * root
    return (1.0 + 2.0 * u**2) * arc - 3.0 * u * root


def _ramp(s: Array, exponent: int | None) -> Array:
    """1 - s averaged over radii: the solid angle of a cap of cosine s over 2 pi."""
    if exponent is None:
        return 1.0 - s
    if exponent == 1:
        return 1.0 - s + s * np.log(np.maximum(s, TINY))
    return (1.0 - s) ** 2 * (1.0 if exponent == 2 else 1.0 + 0.5 * s)


def _strip(x: Array, height: Array, reach: ArrayLike) -> Array:
    """Integral of sqrt(1 - (x / reach / cos)^2) over elevations from 0 to that of an edge, as far as it is real."""
    s = np.minimum(x / np.maximum(reach, TINY), 1.0)
    edge = np.maximum(np.hypot(x, height), TINY)
    short = np.minimum(edge / np.maximum(reach, TINY), 1.0)
    w = np.minimum(height / edge, np.sqrt(1.0 - s**2))
    chord = x / edge * np.sqrt(1.0 - short**2)  # sqrt(q^2 - w^2) without its cancellation
    return np.asarray(np.arctan2(w, chord) - s * np.arctan2(s * w, chord))
