"""Quasi-Monte Carlo visibility by casting rays against planes, spheres and cylinders; shares no code with the package."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

Array = NDArray[np.float64]
Occluder = Callable[[Array, Array], Array]  # origin (3,), unit directions (N, 3) -> distances (N,), inf for a miss
LOG2_RAYS = 17


def hemisphere(normal: Sequence[float], weighting: str, seed: int, log2_rays: int = LOG2_RAYS) -> Array:
    """Scrambled Sobol directions (N, 3) about a unit normal, distributed by cosine or by solid angle."""
    a, b = qmc.Sobol(2, scramble=True, rng=np.random.default_rng(seed)).random_base2(log2_rays).T
    rise = np.sqrt(1.0 - a) if weighting == "cosine" else 1.0 - a
    local = np.stack(
        (np.sqrt(1.0 - rise**2) * np.cos(2 * np.pi * b), np.sqrt(1.0 - rise**2) * np.sin(2 * np.pi * b), rise), axis=1
    )
    n = np.asarray(normal, np.float64)
    n = n / np.linalg.norm(n)
    tangent = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    tangent = tangent / np.linalg.norm(tangent)
    return local @ np.stack((tangent, np.cross(n, tangent), n))


def plane(point: Sequence[float], normal: Sequence[float], inside: Callable[[Array], Array] | None = None) -> Occluder:
    """Occluding plane, restricted to hit points (N, 3) that `inside` accepts."""

    def cast(origin: Array, directions: Array) -> Array:
        facing = directions @ np.asarray(normal, np.float64)
        distance = np.dot(np.subtract(point, origin), normal) / np.where(facing == 0, 1e-300, facing)
        good = distance > 1e-9
        hit = origin + np.where(good, np.minimum(distance, 1e12), 0.0)[:, None] * directions
        return np.where(good & (True if inside is None else inside(hit)), distance, np.inf)

    return cast


def sphere(centre: Sequence[float], radius: float) -> Occluder:
    """Occluding sphere, seen from outside."""

    def cast(origin: Array, directions: Array) -> Array:
        offset = np.subtract(centre, origin)
        along = directions @ offset
        inner = along**2 - offset @ offset + radius**2
        return np.where((inner > 0) & (along > 0), along - np.sqrt(np.maximum(inner, 0.0)), np.inf)

    return cast


def shell(
    centre: Sequence[float], radius: float, inside: Callable[[Array], Array], axis: Sequence[float] | None = None
) -> Occluder:
    """Both sides of a sphere, or with an axis of a cylinder, where `inside` accepts the hit points (N, 3)."""
    flat = np.eye(3) if axis is None else np.eye(3) - np.outer(axis, axis)

    def cast(origin: Array, directions: Array) -> Array:
        offset, across = flat @ np.subtract(origin, centre), directions @ flat
        square = np.maximum((across**2).sum(axis=1), 1e-300)
        half_b = across @ offset
        inner = half_b**2 - square * (offset @ offset - radius**2)
        root = np.sqrt(np.maximum(inner, 0.0))
        nearest = np.full(len(directions), np.inf)
        for distance in ((-half_b + root) / square, (-half_b - root) / square):
            good = (inner > 0) & (distance > 1e-9) & (distance < 1e12)
            hit = origin + np.where(good, distance, 0.0)[:, None] * directions
            nearest = np.where(good & inside(hit), distance, nearest)  # the nearer one comes last
        return nearest

    return cast


def visibility(
    origin: Sequence[float],
    normal: Sequence[float],
    occluders: Sequence[Occluder],
    *,
    radius: float = np.inf,
    falloff: str = "binary",
    weighting: str = "cosine",
    seed: int = 0,
    log2_rays: int = LOG2_RAYS,
) -> float:
    """Visibility 1 - mean W(distance / radius) of the nearest hits of all rays."""
    distance = distances(origin, normal, occluders, weighting=weighting, seed=seed, log2_rays=log2_rays)
    return attenuated(distance, radius, falloff)


def distances(
    origin: Sequence[float],
    normal: Sequence[float],
    occluders: Sequence[Occluder],
    *,
    weighting: str = "cosine",
    seed: int = 0,
    log2_rays: int = LOG2_RAYS,
) -> Array:
    """Distances (N,) to the nearest hits of all rays, to be attenuated by several radii and falloffs."""
    directions = hemisphere(normal, weighting, seed, log2_rays)
    start = np.asarray(origin, np.float64)
    return np.min([cast(start, directions) for cast in occluders], axis=0)


def attenuated(distance: Array, radius: float, falloff: str) -> float:
    """Visibility 1 - mean W(distance / radius)."""
    t = np.where(np.isfinite(distance), distance, 0.0) / radius
    weight = {"binary": np.ones_like(t), "linear": 1.0 - t, "quadratic": 1.0 - t**2}[falloff]
    return float(1.0 - np.where(np.isfinite(distance) & (t < 1), weight, 0.0).mean())


def free_volume(
    origin: Sequence[float],
    normal: Sequence[float],
    solid: Callable[[Array], Array],
    *,
    radius: float,
    seed: int = 0,
    log2_points: int = 19,
) -> float:
    """Share of the half-ball about `origin` whose points (N, 3) `solid` does not contain."""
    u = qmc.Sobol(3, scramble=True, rng=np.random.default_rng(seed)).random_base2(log2_points)
    n = np.asarray(normal, np.float64)
    tangent = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    tangent = tangent / np.linalg.norm(tangent)
    flat = np.sqrt(1.0 - u[:, 0] ** 2)
    local = np.stack((flat * np.cos(2 * np.pi * u[:, 1]), flat * np.sin(2 * np.pi * u[:, 1]), u[:, 0]), axis=1)
    points = np.asarray(origin) + radius * np.cbrt(u[:, 2:]) * (local @ np.stack((tangent, np.cross(n, tangent), n)))
    return float(1.0 - solid(points).mean())
