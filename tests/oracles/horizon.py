"""Horizon-based obscurance, one pixel, one slice, one tap at a time, in float64 and in three dimensions.

Written from the formulae alone; it judges the library and shares nothing with it. Arcs are measured by the slice-relative
cumulative distribution of directions, unions by merging sorted intervals, occluders are segments in space.

Source: HBAO (Bavoil and Sainz 2008), GTAO (Jimenez et al. 2016), visibility bitmasks (Therrien et al. 2023) with the cosine
distribution of GT-VBAO.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from oracles.depth_pyramid import LEVELS, fade, level_at, selected_pixel

Floats = npt.NDArray[np.float64]

GOLDEN: Final = (math.sqrt(5.0) - 1.0) / 2.0  # turns by which successive half-slices shift the taps
SLOPE_LIMIT: Final = 64.0  # footprints of depth a pixel; steeper is an edge
WIDEST: Final = 0.9  # radius over distance up to which the image of the sphere is taken exactly
SMALL: Final = 0.05  # bounds on how much a slice's line approaches or recedes
HORIZON: Final = 1e-3
CONNECTED: Final = 3.0
LINK_STEP: Final = 0.25  # of the radius
TRAPEZOID: Final = 6.0
TRAPEZOID_STEP: Final = 0.25  # of the radius
ROUNDINGS: Final = 4.0
GRAZE: Final = 1e-3


@dataclass(frozen=True)
class Settings:
    """The scalars of one image; see `horizon_visibility`."""

    fx: float
    fy: float
    cx: float
    cy: float
    orthographic: bool
    radius: float
    falloff: float
    thickness: float | None
    bias: float
    slices: int
    steps: int
    step_power: float
    cosine: bool
    estimator: str
    connected: bool
    max_radius_px: float | None
    extend: bool
    eps: float

    def ray(self, u: float, v: float) -> tuple[Floats, Floats]:
        """Origin and direction, of unit z, of the ray through image position (u, v)."""
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        if self.orthographic:
            return np.array([x, y, 0.0]), np.array([0.0, 0.0, 1.0])
        return np.zeros(3), np.array([x, y, 1.0])

    def project(self, point: Floats) -> Floats:
        scale = 1.0 if self.orthographic else point[2]
        return np.array([self.cx + self.fx * point[0] / scale, self.cy + self.fy * point[1] / scale])


def level_of(depth: float, s: Settings) -> float:
    return depth if s.orthographic else 1.0 / depth


def slope_at(depth: Floats, valid: Any, row: int, column: int, axis: int, s: Settings) -> float:
    """Slope of 1/z (or z) along an image axis, from the neighbour that changes it least."""
    here = level_of(depth[row, column], s)
    candidates = []
    for sign in (1, -1):
        r, c = (row + sign, column) if axis == 0 else (row, column + sign)
        if 0 <= r < depth.shape[0] and 0 <= c < depth.shape[1] and valid[r, c]:
            candidates.append(sign * (level_of(depth[r, c], s) - here))
    best = min(candidates, key=abs, default=0.0)
    limit = SLOPE_LIMIT / (s.fy if axis == 0 else s.fx) * (1.0 if s.orthographic else here)
    return best if abs(best) <= limit else 0.0


def turned_axes(view: Floats) -> tuple[Floats, Floats]:
    """The image axes x and y carried along by the shortest rotation from z to the viewing direction (Rodrigues)."""
    axis = np.cross([0.0, 0.0, 1.0], view)
    sine, cosine = float(np.linalg.norm(axis)), float(view[2])
    if sine < 1e-15:
        return np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    k = axis / sine
    return tuple(  # type: ignore[return-value]
        e * cosine + np.cross(k, e) * sine + k * float(k @ e) * (1 - cosine) for e in np.eye(3)[:2]
    )


class Slice:
    """A plane of directions: towards the eye, along the slice, and the measure of directions in it."""

    def __init__(self, point: Floats, normal: Floats, view: Floats, along: Floats, s: Settings) -> None:
        axis = np.cross(along, -view)
        projected = normal - axis * float(axis @ normal)
        self.point, self.s = point, s
        self.length = float(np.linalg.norm(projected))
        self.up = projected / self.length
        self.out = along - self.up * float(self.up @ along)
        self.out = np.cross(self.up, axis)
        self.out *= np.sign(float(np.cross(self.up, self.out) @ np.cross(-view, along)))
        # signed angles in the slice count from the projected normal towards `out`
        self.gamma = math.atan2(float(-view @ self.out), float(-view @ self.up))

    def elevation(self, place: Floats, side: int) -> float:
        offset = place - self.point
        far = abs(self.point[2]) if self.s.orthographic else float(np.linalg.norm(self.point))
        height = float(offset @ self.up) - ROUNDINGS * self.s.eps * far
        return math.atan2(height, side * float(offset @ self.out))

    def share_below(self, elevation: float, side: int) -> float:
        """Measure of the directions between the tangent plane and an elevation, on one side."""
        g, phi = self.gamma, side * (math.pi / 2 - elevation)
        if self.s.cosine:
            weight = math.cos(g) + g * math.sin(g)
            n0, n1, n2 = (3.0, -1.0, 4.0) if phi >= g else (1.0, 1.0, 0.0)
            t0 = n0 * math.cos(g) + n1 * math.cos(g - 2 * phi) + (n2 * g + 2 * n1 * phi + math.pi) * math.sin(g)
            before, weight = 0.25 * t0 / weight, weight * self.length
        else:
            m0, m1 = (2.0, -1.0) if phi >= g else (0.0, 1.0)
            before, weight = 0.5 * (m0 + m1 * math.cos(g - phi) + math.sin(g)), 1.0
        return weight * (1 - before if side > 0 else before)


@dataclass(frozen=True)
class Tap:
    place: Floats  # where its ray meets the surface
    ray: Floats  # unit, away from the eye
    along: float  # distance along the slice and towards the eye, from the pixel's point
    towards: float
    reach: float
    seen: bool


def inside_sphere(
    start: Floats, ray: Floats, length: float, centre: Floats, radius: float
) -> tuple[float, float] | None:
    """The part of a segment that lies in a sphere, its corner rounded off."""
    offset = start - centre
    middle = -float(offset @ ray)
    room = radius**2 - float(offset @ offset) + middle**2
    if room <= 0:
        return None
    half = math.sqrt(room + (GRAZE * radius) ** 2) - GRAZE * radius
    first, last = max(middle - half, 0.0), min(middle + half, length)
    return (first, last) if last > first else None


def merged_length(intervals: list[tuple[float, float]]) -> float:
    total, reached = 0.0, -math.inf
    for low, high in sorted(intervals):
        if high > reached:
            total += high - max(low, reached)
            reached = high
    return total


def connected(tap: Tap, before: Tap | None, slope: float, near: float, back: bool = False) -> bool:
    if not tap.seen or (before is not None and not before.seen):
        return False
    across = tap.along - (before.along if before else 0.0)
    rise = tap.towards - (before.towards if before else 0.0)
    if across < 0:
        return back and max(-across, abs(rise)) <= near
    return across > 0 and abs(rise) <= max(slope * across, near)


Arcs = list[tuple[float, float, float]]  # weight, lower and upper elevation


def side_rises(taps: list[Tap], plane: Slice, side: int, radius: float, s: Settings) -> Arcs:
    """The arcs by which taps raise the horizon."""
    arcs, horizon, earlier = [], s.bias, 1.0
    for number, tap in enumerate(taps):
        distance = math.hypot(tap.along, tap.towards) if tap.seen else tap.reach
        weight = max(0.0, 1.0 - (distance / radius) ** s.falloff)
        if tap.seen:
            elevation = plane.elevation(tap.place, side)
            if elevation > horizon:
                start = horizon
                if s.thickness is not None:
                    back = plane.elevation(tap.place + s.thickness * radius * tap.ray, side)
                    start = min(max(start, back), elevation)
                joined = connected(tap, taps[number - 1] if number else None, TRAPEZOID, TRAPEZOID_STEP * radius)
                arcs.append((0.5 * (earlier + weight) if joined else weight, start, elevation))
                horizon = elevation
        earlier = weight
    return arcs


def side_increments(taps: list[Tap], plane: Slice, side: int, radius: float, s: Settings) -> float:
    arcs = side_rises(taps, plane, side, radius, s)
    return sum(w * (plane.share_below(high, side) - plane.share_below(low, side)) for w, low, high in arcs)


def side_union(taps: list[Tap], plane: Slice, side: int, radius: float, s: Settings) -> float:
    arcs = side_covered(taps, plane, side, radius, s)
    return merged_length([(plane.share_below(low, side), plane.share_below(high, side)) for _, low, high in arcs])


def side_covered(taps: list[Tap], plane: Slice, side: int, radius: float, s: Settings) -> Arcs:
    """The arcs that occluders cover; they overlap."""
    arcs = []
    thick = math.inf if s.thickness is None else s.thickness * radius
    for number, tap in enumerate(taps):
        if not tap.seen:
            continue
        part = inside_sphere(tap.place, tap.ray, thick, plane.point, radius)
        if part is not None:
            ends = [plane.elevation(tap.place + t * tap.ray, side) for t in part]
            arcs.append((ends[1], ends[0]))
        before = taps[number - 1] if number else None
        if s.connected and connected(tap, before, CONNECTED, min(thick, LINK_STEP * radius), back=True):
            start = plane.point if before is None else before.place
            length = float(np.linalg.norm(tap.place - start))
            ray = (tap.place - start) / length
            part = inside_sphere(start, ray, length, plane.point, radius)
            if part is not None:
                ends = [plane.elevation(start + t * ray, side) for t in part]
                ends[0] = ends[0] if number else 0.0
                arcs.append((min(ends), max(ends)))
    clipped = []
    for low, high in arcs:
        high = max(high, s.bias)
        low = min(max(low, s.bias), high)
        clipped.append((1.0, low, high))
    return clipped


def pixel_obscurance(*pixel: Any) -> float:
    """Of what `half_slices` yields for a pixel."""
    total, s = 0.0, pixel[-1]
    for taps, plane, side, radius in half_slices(*pixel):
        judge = side_increments if s.estimator == "increments" else side_union
        total += judge(taps, plane, side, radius, s)
    return total / s.slices


def pixel_occluded_direction(samples: int, *pixel: Any) -> Floats:
    """Integral of the occluded directions over the hemisphere, over its measure, by the midpoint rule in every half slice."""
    total, s = np.zeros(3), pixel[-1]
    for taps, plane, side, radius in half_slices(*pixel):
        arcs = (side_rises if s.estimator == "increments" else side_covered)(taps, plane, side, radius, s)
        limit = math.pi / 2 - side * plane.gamma  # the elevation of the view
        step = limit / samples
        elevation = (np.arange(samples) + 0.5) * step
        weights = [w * ((elevation > low) & (elevation < high)) for w, low, high in arcs]
        occluded = np.max(weights, axis=0) if weights else np.zeros(samples)
        directions = side * np.cos(elevation)[:, None] * plane.out + np.sin(elevation)[:, None] * plane.up
        density = np.sin(limit - elevation) * (plane.length * np.sin(elevation) if s.cosine else 0.5)
        total += (occluded * density) @ directions * step
    return total / s.slices


def half_slices(
    depth: Floats, valid: Any, normal: Floats, row: int, column: int, rotation: float, offset: float, s: Settings
) -> Iterator[tuple[list[Tap], Slice, int, float]]:
    """Taps, plane, side and radius of the half slices of a pixel."""
    centre = np.array([column + 0.5, row + 0.5])
    origin, direction = s.ray(*centre)
    point = origin + depth[row, column] * direction
    view = direction / np.linalg.norm(direction)
    radius = s.radius
    if s.max_radius_px is not None:
        furthest = s.max_radius_px * 2 ** (LEVELS - 1)
        radius = min(radius, furthest / max(s.fx, s.fy) * (1.0 if s.orthographic else point[2]))
    wide = radius
    if not s.orthographic:
        wide /= math.sqrt(1 - min(radius / float(np.linalg.norm(point)), WIDEST) ** 2)
    one, two = turned_axes(view)
    for number in range(s.slices):
        angle = math.pi * (number + rotation) / s.slices
        along = math.cos(angle) * one + math.sin(angle) * two
        plane = Slice(point, normal, view, along, s)
        near = 1e-6 * point[2]
        line = (s.project(point + near * along) - s.project(point - near * along)) / (2 * near)
        # exact instead of differenced: the image moves by the derivative of the projection
        scale = 1.0 if s.orthographic else point[2]
        bend = np.zeros(2) if s.orthographic else (point[:2] / point[2]) * along[2]
        exact = np.array([s.fx, s.fy]) * (along[:2] - bend) / scale
        np.testing.assert_allclose(line, exact, rtol=1e-5, atol=1e-6 * np.abs(exact).max())
        recession = 0.0 if s.orthographic else along[2] / point[2]
        for side in (1, -1):
            shift = (offset + (2 * number + (side < 0)) * GOLDEN) % 1.0
            taps = []
            for k in range(s.steps):
                reach = wide * ((k + shift) / s.steps) ** s.step_power
                reach /= max(1 + side * reach * recession, SMALL)
                pixels = min(max(float(np.round(reach * np.abs(exact).max())), 1.0), float(max(depth.shape)))
                taps.append(
                    make_tap(depth, valid, centre, point, view, side * along, side * exact, pixels, recession * side, s)
                )
            yield taps, plane, side, radius


def make_tap(
    depth: Floats,
    valid: Any,
    centre: Floats,
    point: Floats,
    view: Floats,
    along: Floats,
    line: Floats,
    pixels: float,
    recession: float,
    s: Settings,
) -> Tap:
    shrunk = pixels / float(np.abs(line).max())
    left = max(1 - shrunk * recession, SMALL)
    reach = shrunk / left
    u, v = centre + shrunk * line
    column, row = math.floor(u), math.floor(v)
    if s.extend:
        column = min(max(column, 0), depth.shape[1] - 1)
        row = min(max(row, 0), depth.shape[0] - 1)
    nothing = Tap(point, view, reach, 0.0, reach, False)
    if not (0 <= column < depth.shape[1] and 0 <= row < depth.shape[0]) or not SMALL < 1 / left < 1 / SMALL:
        return nothing
    if s.max_radius_px is not None:
        row, column = selected_pixel(valid, row, column, level_at(pixels, s.max_radius_px))
    if not valid[row, column]:
        return nothing
    base = level_of(depth[row, column], s)
    level = base + slope_at(depth, valid, row, column, 1, s) * (u - column - 0.5)
    level += slope_at(depth, valid, row, column, 0, s) * (v - row - 0.5)
    if not s.orthographic and level <= HORIZON * base:
        return Tap(point, view, 1.0, 0.0, 1.0, False)
    origin, ray = s.ray(u, v)
    place = origin + (level if s.orthographic else 1.0 / level) * ray
    offset = place - point
    return Tap(place, ray / np.linalg.norm(ray), float(offset @ along), float(-offset @ view), reach, True)


def bent_normals(*images: npt.ArrayLike, samples: int, **settings: Any) -> Floats:
    """(B, 3, H, W) mean occluded directions, 0 at invalid pixels; `images` and `settings` as for `horizon_obscurance`."""
    z, n, turn, shift = (np.asarray(images[i], dtype=np.float64) for i in (0, 2, 4, 5))
    seen, result = np.asarray(images[1], dtype=bool), np.zeros(n.shape)
    for image, numbers in enumerate(np.asarray(images[3], dtype=np.float64)):
        s = Settings(*map(float, numbers), **settings)
        for row, column in np.argwhere(seen[image]):
            pixel = (
                z[image],
                seen[image],
                n[image, :, row, column],
                row,
                column,
                turn[row, column],
                shift[row, column],
            )
            span = s.radius * max(s.fx, s.fy) / (1.0 if s.orthographic else z[image, row, column])
            result[image, :, row, column] = fade(span) * pixel_occluded_direction(samples, *pixel, s)
    return result


def horizon_obscurance(
    depth: npt.ArrayLike,
    valid: npt.ArrayLike,
    normal: npt.ArrayLike,
    intrinsics: npt.ArrayLike,
    rotation: npt.ArrayLike,
    offset: npt.ArrayLike,
    **settings: Any,
) -> Floats:
    """Obscurance of a batch.

    Args:
        depth, valid: (B, H, W). normal: (B, 3, H, W). intrinsics: (B, 4) fx, fy, cx, cy. rotation, offset: (H, W).
        settings: the other fields of `Settings`.
    Returns: (B, H, W), 0 at invalid pixels.
    """
    z, seen, n = (
        np.asarray(depth, dtype=np.float64),
        np.asarray(valid, dtype=bool),
        np.asarray(normal, dtype=np.float64),
    )
    turn, shift = np.asarray(rotation, dtype=np.float64), np.asarray(offset, dtype=np.float64)
    result = np.zeros(z.shape)
    for image, numbers in enumerate(np.asarray(intrinsics, dtype=np.float64)):
        s = Settings(*map(float, numbers), **settings)
        for row, column in np.argwhere(seen[image]):
            place = (image, row, column)
            amount = pixel_obscurance(
                z[image], seen[image], n[image, :, row, column], row, column, turn[row, column], shift[row, column], s
            )
            amount *= fade(s.radius * max(s.fx, s.fy) / (1.0 if s.orthographic else z[place]))
            result[place] = min(max(amount, 0.0), 1.0)
    return result
