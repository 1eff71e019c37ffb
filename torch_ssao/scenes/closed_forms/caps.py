"""Exact visibility beside spheres, and under any cone of blocked directions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from torch_ssao import checks
from torch_ssao.scenes.closed_forms.common import TINY, Array, attenuated, check_question, cosine, non_negative


def sphere(
    distance: ArrayLike,
    cos_angle: ArrayLike,
    sphere_radius: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility of a point outside a sphere that may be cut by the point's horizon.

    The rays that hit form a cap (`spherical_cap`) of sine r / d, or of cosine (d^2 + R^2 - r^2) / (2 d R) where R is
    shorter than the tangent. Above the horizon and for an infinite radius occlusion is cos_angle (r / d)^2, uniform
    1 - sqrt(1 - (r / d)^2). Falloffs other than binary by quadrature.

    Args:
        distance: d > sphere_radius, to the sphere's centre, scene units.
        cos_angle: in [-1, 1], cosine between the normal and the direction to the centre.
        sphere_radius: r > 0, scene units.
    Source: Quilez, "Sphere ambient occlusion" (infinite radius); finite radius derived.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    d, tilt, r = np.broadcast_arrays(
        non_negative("distance", distance),
        cosine("cos_angle", cos_angle),
        non_negative("sphere_radius", sphere_radius),
    )
    if not bool(((r > 0) & (d > r)).all()):
        raise checks.RangeError(
            f"distance must be greater than sphere_radius > 0, got {distance!r} and {sphere_radius!r}: "
            "pass the distance to the sphere's centre"
        )
    tangent = np.sqrt((d - r) * (d + r))

    def binary(reach: ArrayLike) -> Array:
        return cap(cap_of_sphere(d, tangent, reach), tilt, kernel)

    horizon = d * np.sqrt(1.0 - tilt**2) - np.sqrt(np.maximum(r**2 - (d * tilt) ** 2, 0.0))
    breaks = tuple(at / radius for at in (d - r, np.clip(horizon, d - r, tangent), tangent))
    return 1.0 - attenuated(binary, radius, exponent, breaks)


def sphere_on_plane(
    lateral: ArrayLike,
    sphere_radius: ArrayLike,
    *,
    radius: float = math.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
) -> Array:
    """Visibility on a floor at `lateral` from the contact point of a sphere that rests on it.

    Infinite radius: 1 - (1 + (x / r)^2)^(-3/2); uniform x / sqrt(x^2 + r^2). Finite: as `sphere`, above the horizon.

    Args:
        lateral: x >= 0; sphere_radius: r > 0; scene units.
    Source: Quilez, "Sphere ambient occlusion" (infinite radius); finite radius derived.
    """
    kernel, exponent = check_question(radius, falloff, weighting, volumetric=False)
    checks.check_positive("sphere_radius", float(np.min(np.asarray(sphere_radius, np.float64))))
    x, r = np.broadcast_arrays(non_negative("lateral", lateral), non_negative("sphere_radius", sphere_radius))
    d = np.hypot(x, r)

    def binary(reach: ArrayLike) -> Array:
        cos_half = cap_of_sphere(d, x, reach)
        return r / d * (1.0 - cos_half**2) if kernel == "cosine" else 1.0 - cos_half

    return 1.0 - attenuated(binary, radius, exponent, (x**2 / (d + r) / radius, x / radius))


def spherical_cap(cos_half_angle: ArrayLike, cos_tilt: ArrayLike, *, weighting: str = "cosine") -> Array:
    """Visibility when all directions within a cone are blocked and no others.

    With c = cos_half_angle, q = sqrt(1 - c^2), t = cos_tilt, u = sqrt(1 - t^2): occlusion is t q^2 for t >= q (above
    the horizon), 0 for t <= -q (below), else (t q^2 acos(-t c / (q u)) - c sqrt(q^2 - t^2) + atan2(sqrt(q^2 - t^2), c))
    / pi. Uniform: 1 - c, 0, 1 - (acos(t / q) + c acos(-t c / (q u))) / pi.

    Args:
        cos_half_angle: in [0, 1], cosine of the cone's half-angle.
        cos_tilt: in [-1, 1], cosine between the normal and the cone's axis.
        weighting: "cosine" or "uniform".
    Source: Quilez, "Sphere ambient occlusion"; uniform: solid angle of two intersecting caps, one of them a hemisphere.
    """
    kernel, _ = check_question(math.inf, "binary", weighting, volumetric=False)
    cos_half = cosine("cos_half_angle", cos_half_angle)
    non_negative("cos_half_angle", cos_half)
    return 1.0 - cap(cos_half, cosine("cos_tilt", cos_tilt), kernel)


def cap(cos_half: Array, tilt: Array, kernel: str) -> Array:
    """Occlusion by a cone of directions; see `spherical_cap`."""
    sin_half, sin_tilt = np.sqrt(1.0 - cos_half**2), np.sqrt(1.0 - tilt**2)
    whole = tilt * sin_half**2 if kernel == "cosine" else 1.0 - cos_half
    chord = np.sqrt(np.maximum(sin_half**2 - tilt**2, 0.0))
    arc = np.arccos(np.clip(-tilt * cos_half / np.maximum(sin_half * sin_tilt, TINY), -1.0, 1.0))
    if kernel == "cosine":
        cut = whole * arc - cos_half * chord + np.arctan2(chord, cos_half)
    else:
        cut = math.pi - np.arccos(np.clip(tilt / np.maximum(sin_half, TINY), -1.0, 1.0)) - cos_half * arc
    return np.where(tilt >= sin_half, whole, np.where(tilt <= -sin_half, 0.0, cut / math.pi))


def cap_of_sphere(d: Array, tangent: Array, reach: ArrayLike) -> Array:
    """Cosine of the cone of rays of length `reach` that hit a sphere; centre `d`, tangent points `tangent` away."""
    reach = np.minimum(reach, tangent)  # beyond its tangent points a sphere only hides itself
    return np.minimum((tangent**2 + reach**2) / (2.0 * d * np.maximum(reach, TINY)), 1.0)
