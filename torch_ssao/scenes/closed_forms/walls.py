"""Exact visibility of simple scenes: closed forms (or one-dimensional quadratures of them) in numpy float64.

Every function returns visibility in [0, 1] (1 = open) as float64, broadcasts over its array arguments, and takes
    radius: R > 0 in scene units, inf allowed; only occluders nearer than R count.
    falloff: the attenuation W(t), t = distance / R, of an occluder: "binary" 1, "linear" 1 - t, "quadratic" 1 - t^2.
        All are 1 for an infinite radius.
    weighting: "cosine" (the ambient-occlusion integral), "uniform" (share of the hemisphere's solid angle) or, where
        the occluder is a half-space, "volumetric" (free share of the half-ball of radius R; falloff must be "binary").
They raise ChoiceError for unknown names and combinations, RangeError for numbers out of range.

Occlusion is 1 - visibility; for cosine weights it is the configuration factor from the point to the occluder, the area
of the occluder's projection onto the unit disk over pi (Nusselt analog). A falloff is a mixture of binary radii:
occlusion_W(R) = integral over t in [0, 1] of occlusion_binary(t R) (-W'(t)). A point at distance rho lies in an
occluding half-space if and only if its ray has hit the boundary within rho, so volumetric obscurance is uniform
weighting with W(t) = 1 - t^3.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_ssao import checks

Array = NDArray[np.float64]

FALLOFFS = ("binary", "linear", "quadratic")
WEIGHTINGS = ("cosine", "uniform", "volumetric")

_EXPONENT = {"linear": 1, "quadratic": 2}
_TINY = 1e-300  # keeps 1/s and log(s) finite where s = 0 multiplies them away
# 48 nodes leave less than 1e-13 against every closed form that exists beside the quadrature (tests/scenes).
_NODES, _NODE_WEIGHTS = (0.5 * a for a in np.polynomial.legendre.leggauss(48))


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
    s = np.minimum(_non_negative("distance", distance) / radius, 1.0)
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
    s = np.minimum(_non_negative("height", height) / radius, 1.0)
    if kernel == "uniform":
        return 1.0 - _ramp(s, exponent)
    if exponent is None:
        return s**2
    if exponent == 1:
        return 1.0 - (1.0 - s) ** 2
    return s**2 * (1.0 - 2.0 * np.log(np.maximum(s, _TINY)))


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
    d, tilt = np.broadcast_arrays(_non_negative("distance", distance), _cosine("cos_tilt", cos_tilt))
    sin_tilt = np.sqrt(1.0 - tilt**2)

    def binary(reach: ArrayLike) -> Array:
        return _cap(np.minimum(d / np.maximum(reach, _TINY), 1.0), tilt, kernel)

    # The cap is born at t = d / R and meets the horizon at t = d / (R sin tilt).
    breaks = (d / radius, d / radius / np.maximum(sin_tilt, 1e-30))
    return 1.0 - _attenuated(binary, radius, exponent, breaks)


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
    distance = _non_negative("distance", distance)
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
        _non_negative("distance", distance), _non_negative("gap", gap), _non_negative("height", height)
    )
    high = low + size
    near, far = np.hypot(x, low), np.hypot(x, high)
    if kernel == "cosine":
        shrink_near = np.where(low == 0, 1.0, x / np.where(low == 0, 1.0, near))
        occlusion = shrink_near * _segment(near / radius, exponent) - x / far * _segment(far / radius, exponent)
        return 1.0 - occlusion / math.pi

    def binary(reach: ArrayLike) -> Array:
        return (_strip(x, high, reach) - _strip(x, low, reach)) / math.pi

    return 1.0 - _attenuated(binary, radius, exponent, (near / radius, far / radius))


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
        _non_negative("distance", distance),
        _cosine("cos_angle", cos_angle),
        _non_negative("sphere_radius", sphere_radius),
    )
    if not bool(((r > 0) & (d > r)).all()):
        raise checks.RangeError(
            f"distance must be greater than sphere_radius > 0, got {distance!r} and {sphere_radius!r}: "
            "pass the distance to the sphere's centre"
        )
    tangent = np.sqrt((d - r) * (d + r))

    def binary(reach: ArrayLike) -> Array:
        return _cap(_cap_of_sphere(d, tangent, reach), tilt, kernel)

    horizon = d * np.sqrt(1.0 - tilt**2) - np.sqrt(np.maximum(r**2 - (d * tilt) ** 2, 0.0))
    breaks = tuple(at / radius for at in (d - r, np.clip(horizon, d - r, tangent), tangent))
    return 1.0 - _attenuated(binary, radius, exponent, breaks)


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
    x, r = np.broadcast_arrays(_non_negative("lateral", lateral), _non_negative("sphere_radius", sphere_radius))
    d = np.hypot(x, r)

    def binary(reach: ArrayLike) -> Array:
        cos_half = _cap_of_sphere(d, x, reach)
        return r / d * (1.0 - cos_half**2) if kernel == "cosine" else 1.0 - cos_half

    return 1.0 - _attenuated(binary, radius, exponent, (x**2 / (d + r) / radius, x / radius))


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
    cos_half = _cosine("cos_half_angle", cos_half_angle)
    _non_negative("cos_half_angle", cos_half)
    return 1.0 - _cap(cos_half, _cosine("cos_tilt", cos_tilt), kernel)


def check_question(radius: float, falloff: str, weighting: str, *, volumetric: bool = True) -> tuple[str, int | None]:
    """Check radius, falloff and weighting, and resolve them to a kernel and an exponent.

    Args:
        radius, falloff, weighting: see the module.
        volumetric: whether the scene fills space behind its surface, so that "volumetric" means something.
    Returns: "cosine" or "uniform", and the p of W(t) = 1 - t^p (None: binary).
    Raises: RangeError, ChoiceError.
    """
    if not (isinstance(radius, (int, float)) and radius > 0):
        raise checks.RangeError(f"radius must be greater than 0, got {radius!r}: pass a positive radius, or math.inf")
    checks.check_choice("falloff", falloff, FALLOFFS)
    checks.check_choice("weighting", weighting, WEIGHTINGS if volumetric else WEIGHTINGS[:2])
    if weighting != "volumetric":
        return weighting, _EXPONENT.get(falloff)
    if falloff != "binary":
        raise checks.ChoiceError(f"falloff must be 'binary' with weighting='volumetric', got {falloff!r}: use that")
    return "uniform", 3


def _segment(u: Array, exponent: int | None) -> Array:
    """Area of the unit disk's segment beyond the chord at u, averaged over radii for a falloff."""
    u = np.minimum(u, 1.0)
    root, arc = np.sqrt(1.0 - u**2), np.arccos(u)
    if exponent is None:
        return arc - u * root
    if exponent == 1:
        return arc - 2.0 * u * np.arccosh(1.0 / np.maximum(u, _TINY)) + u * root
    return (1.0 + 2.0 * u**2) * arc - 3.0 * u * root


def _ramp(s: Array, exponent: int | None) -> Array:
    """1 - s averaged over radii: the solid angle of a cap of cosine s over 2 pi."""
    if exponent is None:
        return 1.0 - s
    if exponent == 1:
        return 1.0 - s + s * np.log(np.maximum(s, _TINY))
    return (1.0 - s) ** 2 * (1.0 if exponent == 2 else 1.0 + 0.5 * s)


def _strip(x: Array, height: Array, reach: ArrayLike) -> Array:
    """Integral of sqrt(1 - (x / reach / cos)^2) over elevations from 0 to that of an edge, as far as it is real."""
    s = np.minimum(x / np.maximum(reach, _TINY), 1.0)
    edge = np.maximum(np.hypot(x, height), _TINY)
    short = np.minimum(edge / np.maximum(reach, _TINY), 1.0)
    w = np.minimum(height / edge, np.sqrt(1.0 - s**2))
    chord = x / edge * np.sqrt(1.0 - short**2)  # sqrt(q^2 - w^2) without its cancellation
    return np.asarray(np.arctan2(w, chord) - s * np.arctan2(s * w, chord))


def _cap(cos_half: Array, tilt: Array, kernel: str) -> Array:
    """Occlusion by a cone of directions; see `spherical_cap`."""
    sin_half, sin_tilt = np.sqrt(1.0 - cos_half**2), np.sqrt(1.0 - tilt**2)
    whole = tilt * sin_half**2 if kernel == "cosine" else 1.0 - cos_half
    chord = np.sqrt(np.maximum(sin_half**2 - tilt**2, 0.0))
    arc = np.arccos(np.clip(-tilt * cos_half / np.maximum(sin_half * sin_tilt, _TINY), -1.0, 1.0))
    if kernel == "cosine":
        cut = whole * arc - cos_half * chord + np.arctan2(chord, cos_half)
    else:
        cut = math.pi - np.arccos(np.clip(tilt / np.maximum(sin_half, _TINY), -1.0, 1.0)) - cos_half * arc
    return np.where(tilt >= sin_half, whole, np.where(tilt <= -sin_half, 0.0, cut / math.pi))


def _cap_of_sphere(d: Array, tangent: Array, reach: ArrayLike) -> Array:
    """Cosine of the cone of rays of length `reach` that hit a sphere; centre `d`, tangent points `tangent` away."""
    reach = np.minimum(reach, tangent)  # beyond its tangent points a sphere only hides itself
    return np.minimum((tangent**2 + reach**2) / (2.0 * d * np.maximum(reach, _TINY)), 1.0)


def _attenuated(
    binary: Callable[[ArrayLike], Array], radius: float, exponent: int | None, breaks: tuple[Array, ...]
) -> Array:
    """Integral over t in [0, 1] of binary(t R) p t^(p - 1); `binary` is 0 before the first break, smooth between."""
    if exponent is None or math.isinf(radius):
        return binary(radius)
    edges = np.sort(
        np.stack([np.clip(b, 1e-14, 1.0) for b in (*np.broadcast_arrays(*breaks), 1.0 + 0.0 * breaks[0])]), axis=0
    )
    total = np.zeros(edges.shape[1:])
    for low, high in itertools.pairwise(edges):
        span = np.log(high / low)
        for node, weight in zip(_NODES + 0.5, _NODE_WEIGHTS, strict=True):
            # Logarithmic in t for small distances; the cubic removes the square roots at both ends.
            t = low * np.exp(span * node**2 * (3.0 - 2.0 * node))
            total += weight * 6.0 * node * (1.0 - node) * span * exponent * t**exponent * binary(t * radius)
    return total


def _non_negative(name: str, value: ArrayLike) -> Array:
    array = np.asarray(value, np.float64)
    if not bool((array >= 0).all()):
        raise checks.RangeError(f"{name} must be 0 or more, got {value!r}: pass lengths in scene units")
    return array


def _cosine(name: str, value: ArrayLike) -> Array:
    array = np.asarray(value, np.float64)
    if not bool((np.abs(array) <= 1 + 1e-9).all()):
        raise checks.RangeError(f"{name} must lie in [-1, 1], got {value!r}: pass a cosine of unit vectors")
    return np.clip(array, -1.0, 1.0)
