"""Ray-marched ambient occlusion, one pixel, one ray and one step at a time, in float64.

Written from the paper; it judges the library and shares nothing with it. What the paper leaves open is decided as
the library documents it: a stored sample stands for its tangent plane within its pixel (Eq. 1's "piecewise linear"),
layers alternate between entry and exit, steps outside the image are unknown.

Source: "Poisson-based ray-marched SSAO", Algorithm 1, Eqs. 1 and 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from oracles.depth_pyramid import fade, level_at, selected_pixel

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

FLATTEST: Final = 0.02  # smallest cosine between a stored plane's normal and the ray to the eye
UNSUPPORTED: Final = 0.2  # the same where the depth around the sample does not show such a slope
LEEWAY: Final = 1.5  # of the slope that the depth shows
ROUNDING_EPSILONS: Final = 8.0


@dataclass
class Image:
    """One image: positions (L, H, W, 3), normals (L, H, W, 3), valid (L, H, W), camera, and how to march."""

    positions: Floats
    normals: Floats
    valid: Bools
    camera: tuple[float, float, float, float]
    orthographic: bool
    steps: int
    falloff: float
    thickness: float | None
    eps: float
    max_radius_px: float | None
    flattest: dict[tuple[int, int, int], float] = field(default_factory=dict)  # of planes asked for already


def hemisphere_direction(point: Floats, turn: float, outwards: float, normal: Floats) -> Floats:
    """A disk point moved within its ring and turned in the eye's XY plane, lifted to the hemisphere about -z, and aligned
    to the normal. `outwards` is what is added to the square of its radius."""
    angle = 2.0 * math.pi * turn
    square = float(point @ point)
    point = point * math.sqrt(max(0.0, square + outwards) / square)
    x = point[0] * math.cos(angle) - point[1] * math.sin(angle)
    y = point[0] * math.sin(angle) + point[1] * math.cos(angle)
    lifted = np.array([x, y, -math.sqrt(max(0.0, 1.0 - point[0] ** 2 - point[1] ** 2))])
    pole = np.array([0.0, 0.0, -1.0])
    axis = np.cross(pole, normal)
    sine, cosine = float(np.linalg.norm(axis)), float(pole @ normal)
    if sine < 1e-12:
        return lifted
    axis /= sine  # Rodrigues
    return lifted * cosine + np.cross(axis, lifted) * sine + axis * (axis @ lifted) * (1.0 - cosine)


def pixel_of(image: Image, place: Floats, start: Floats) -> tuple[int, int] | None:
    """Row and column of the sample read at a position, by a ray from `start`; None outside of the image or behind the eye."""
    if place[2] <= 0.0:
        return None
    fx, fy, cx, cy = image.camera
    scale = 1.0 if image.orthographic else place[2]
    column, row = fx * place[0] / scale + cx, fy * place[1] / scale + cy
    height, width = image.valid.shape[1:]
    if not (0.0 <= column < width and 0.0 <= row < height):
        return None
    if image.max_radius_px is None:
        return math.floor(row), math.floor(column)
    scale = 1.0 if image.orthographic else start[2]
    away = max(abs(fx * start[0] / scale + cx - column), abs(fy * start[1] / scale + cy - row))
    level = level_at(away, image.max_radius_px)
    return selected_pixel(image.valid.any(0), math.floor(row), math.floor(column), level)


def shown_slope(image: Image, layer: int, pixel: tuple[int, int], axis: int) -> float | None:
    """Smaller of the changes of 1/z (parallel rays: z) to the two neighbours along an axis; None without a valid one."""

    def level(at: tuple[int, int]) -> float:
        z = float(image.positions[(layer, *at)][2])
        return z if image.orthographic else 1.0 / z

    size, found = image.valid.shape[1 + axis], []
    for step in (-1, 1):
        other = (pixel[0] + step, pixel[1]) if axis == 0 else (pixel[0], pixel[1] + step)
        if 0 <= other[axis] < size and image.valid[(layer, *other)]:
            found.append(abs(level(other) - level(pixel)))
    return min(found, default=None)


def flattest_plane(image: Image, layer: int, pixel: tuple[int, int]) -> float:
    """Smallest cosine to the view ray that the depth around a sample allows its plane."""
    key = (layer, *pixel)
    if key not in image.flattest:
        down, right = (shown_slope(image, layer, pixel, axis) for axis in (0, 1))
        sample, normal = image.positions[key], image.normals[key]
        allowed = FLATTEST
        if down is not None and right is not None:
            claimed = abs(normal[0]) / image.camera[0] + abs(normal[1]) / image.camera[1]
            shown = LEEWAY * (down + right) * (1.0 if image.orthographic else float(np.linalg.norm(sample)))
            allowed = UNSUPPORTED if claimed >= UNSUPPORTED * shown else max(FLATTEST, claimed / shown)
        image.flattest[key] = allowed
    return image.flattest[key]


def depth_behind(image: Image, place: Floats, layer: int, pixel: tuple[int, int]) -> tuple[float, float]:
    """Depth of a position behind the tangent plane of a sample, along its own view ray; and its height over it."""
    sample, normal = image.positions[(layer, *pixel)], image.normals[(layer, *pixel)]
    ray = np.array([0.0, 0.0, 1.0]) if image.orthographic else sample / np.linalg.norm(sample)
    least = flattest_plane(image, layer, pixel)
    if normal @ ray > -least:  # tilt the plane until it faces the eye enough
        normal = normal - (normal @ ray + least) * ray
    height = float(normal @ place) - float(normal @ sample)
    through = np.array([0.0, 0.0, 1.0]) if image.orthographic else place / place[2]
    return height / min(float(normal @ through), -0.5 * FLATTEST), height


def surface_distance(image: Image, place: Floats, pixel: tuple[int, int]) -> float | None:
    """Depth distance to the nearest layer; None where nothing is stored."""
    layers = [k for k in range(len(image.valid)) if image.valid[(k, *pixel)]]
    return min((abs(depth_behind(image, place, k, pixel)[0]) for k in layers), default=None)


def is_inside(image: Image, place: Floats, pixel: tuple[int, int], slack: float, thickness: float) -> bool:
    """Between an entry layer and the next exit, and not deeper than the thickness behind the entry."""
    for entry in range(0, len(image.valid), 2):
        if not image.valid[(entry, *pixel)]:
            continue
        depth, height = depth_behind(image, place, entry, pixel)
        if height >= -slack or depth > thickness:
            continue
        leave = entry + 1
        has_exit = leave < len(image.valid) and image.valid[(leave, *pixel)]
        if not has_exit or depth_behind(image, place, leave, pixel)[1] >= -slack:
            return True
    return False


def ray_visibility(image: Image, start: Floats, direction: Floats, reach: float) -> tuple[float, float]:
    """Contribution of one ray, and its weight: 1 with a hit, else the share of its steps that fall in the image."""
    slack = ROUNDING_EPSILONS * image.eps * (float(np.linalg.norm(start)) + reach)
    thickness = math.inf if image.thickness is None else image.thickness * reach
    places = [start + (j / image.steps) * reach * direction for j in range(image.steps + 1)]
    pixels = [pixel_of(image, place, start) for place in places]
    share = sum(pixel is not None for pixel in pixels[1:]) / image.steps
    before: float | None = 0.0  # the ray starts on the surface
    for j in range(1, image.steps + 1):
        pixel = pixels[j]
        if pixel is None:
            before = None
            continue
        after = surface_distance(image, places[j], pixel)
        if is_inside(image, places[j], pixel, slack, thickness):
            if before is None:
                part = 1.0
            else:
                total = before + (after or 0.0)
                part = before / total if total > 0.0 else 0.0  # Eq. 1
            distance = (j - 1 + part) / image.steps
            return (distance**image.falloff if distance < 1.0 else 1.0), 1.0
        before = after
    return 1.0, share


def ray_march_visibility(
    positions: npt.ArrayLike,
    valid: npt.ArrayLike,
    normals: npt.ArrayLike,
    reach: npt.ArrayLike,
    intrinsics: npt.ArrayLike,
    disk: npt.ArrayLike,
    rotation: npt.ArrayLike,
    offset: npt.ArrayLike,
    *,
    orthographic: bool,
    steps: int,
    falloff: float,
    contrast: float,
    thickness: float | None,
    eps: float,
    max_radius_px: float | None = None,
) -> Floats:
    """Visibility (B, H, W) of a batch.

    Args:
        positions, normals: (B, 3, L, H, W) view space. valid: (B, L, H, W) bool.
        reach: (B, H, W) length of the rays. intrinsics: (B, 4) fx, fy, cx, cy.
        disk: (K, 2) points of the unit disk. rotation: (H, W) turns. offset: (H, W) in [0, 1), places within rings.
        falloff, contrast: exponents. thickness: of the reach, or None. eps: of the dtype under test.
    """
    x = np.moveaxis(np.asarray(positions, np.float64), 1, -1)
    n = np.moveaxis(np.asarray(normals, np.float64), 1, -1)
    usable, lengths = np.asarray(valid, bool), np.asarray(reach, np.float64)
    points, turns = np.asarray(disk, np.float64), np.asarray(rotation, np.float64)
    shifts = (np.asarray(offset, np.float64) - 0.5) / len(points)
    answer = np.ones(lengths.shape)
    for b in range(len(x)):
        camera = tuple(float(value) for value in np.asarray(intrinsics, np.float64)[b])
        image = Image(x[b], n[b], usable[b], camera, orthographic, steps, falloff, thickness, eps, max_radius_px)  # type: ignore[arg-type]
        for row, column in np.argwhere(usable[b, 0]):
            start, normal = x[b, 0, row, column], n[b, 0, row, column]
            rays = [
                ray_visibility(image, start, direction, lengths[b, row, column])
                for direction in (
                    hemisphere_direction(point, turns[row, column], shifts[row, column], normal) for point in points
                )
            ]
            weight = sum(share for _, share in rays)
            mean = sum(value * share for value, share in rays) / weight if weight > 0.0 else 1.0
            span = lengths[b, row, column] * max(camera[:2]) / (1.0 if orthographic else start[2])
            answer[b, row, column] = (1.0 - fade(span) * (1.0 - mean)) ** contrast
    return answer
