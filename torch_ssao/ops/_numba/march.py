"""Rays of `ops.ray_march_hit` for `LANES` neighbouring pixels of a row: one loop over them a stage, values in rows of scratch."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from torch_ssao.ops._numba.maths import LANES, OPTIONS, STRICT, power, turn
from torch_ssao.ops.partition import ROUNDING
from torch_ssao.ops.plane_support import MIN_FACING
from torch_ssao.ops.ray_march_hit import _AWAY

P = LANES
AWAY = _AWAY
# Where rows begin: of pixels,
PX, PY, PZ, NX, NY, NZ, REACH, SLACK, DEEPEST, TURN_X, TURN_Y, OFFSET, TOTAL, WEIGHT = range(0, 14 * P, P)
# of their rays (SPAN_* the nearest surface before and behind a hit, LAYER_* its layer, BOUNDED whether one bounds the step before),
A, B, C, DX, DY, DZ, FOUND, COUNT, FIRST, SPAN_BEFORE, SPAN_BEHIND, BOUNDED, LAYER_BEFORE, LAYER_BEHIND = range(
    14 * P, 28 * P, P
)
# of a step, and of the step before it.
X, Y, Z, SEEN, SOLID, INSIDE, NEAREST, KNOWN, LAYER, LAST_NEAREST, LAST_KNOWN, LAST_LAYER = range(28 * P, 40 * P, P)
RAY_SIZE = 40 * P
# Rows of a stored plane: unit normal and n . point.
PLANE_X, PLANE_Y, PLANE_Z, PLANE_OFFSET = range(0, 4 * P, P)
PLANE_SIZE = 4 * P
# Rows of pixels that are read: at this step, at the one before, and on both sides of a hit.
HERE, LAST, BEFORE, BEHIND = range(0, 4 * P, P)
SOURCE_SIZE = 4 * P
# Numbers of an image.
FX, FY, CX, CY, FALLOFF, THICKNESS = range(6)
IMAGE_NUMBERS = 6


@njit(**STRICT)
def set_pixels(
    ray: Any, image: Any, position: Any, normal: Any, reach: Any, rotation: Any, offset: Any, start: int, stop: int,
    spread: float,
) -> None:  # fmt: skip
    """Rows of the flat pixels [start, stop) of a row; lanes beyond repeat the last. `spread` is a factor on the reach."""
    T = ray.dtype.type
    factor, scale = T(spread), T(ROUNDING) * T(np.finfo(T).eps)
    thickness, zero, half = image[THICKNESS], T(0), T(0.5)
    for p in range(P):
        at = min(start + p, stop - 1)
        x, y, z = position[0, at], position[1, at], position[2, at]
        length = factor * reach[at]
        shifted = rotation[at] - half
        cosine, sine = turn(T(2 * math.pi) * abs(shifted))
        ray[PX + p], ray[PY + p], ray[PZ + p] = x, y, z
        ray[NX + p], ray[NY + p], ray[NZ + p] = normal[0, at], normal[1, at], normal[2, at]
        ray[REACH + p], ray[SLACK + p] = length, scale * (math.sqrt(x * x + y * y + z * z) + length)
        ray[DEEPEST + p] = thickness * length
        ray[TURN_X + p], ray[TURN_Y + p] = -cosine, sine if shifted < zero else -sine
        ray[OFFSET + p] = offset[at]
        ray[TOTAL + p] = ray[WEIGHT + p] = zero


@njit(**STRICT)
def set_ray(ray: Any, source: Any, disk_x: float, disk_y: float, count: int) -> None:
    """Direction of a ray; it has met nothing yet, and stands on its own pixel's surface."""
    T = ray.dtype.type
    one, zero, half, number, away = T(1), T(0), T(0.5), T(count), T(AWAY)
    first, second = T(disk_x), T(disk_y)
    area = first * first + second * second
    least = max(area, T(np.finfo(T).tiny))
    for p in range(P):
        moved = min(max(area + (ray[OFFSET + p] - half) / number, zero), one)
        scale = math.sqrt(moved / least)
        u, v = first * scale, second * scale
        cosine, sine = ray[TURN_X + p], ray[TURN_Y + p]
        a, b, c = u * cosine - v * sine, u * sine + v * cosine, math.sqrt(one - moved)
        x, y, z = ray[NX + p], ray[NY + p], ray[NZ + p]
        across = a * x + b * y
        share = c - across / max(one - z, away)
        ray[A + p], ray[B + p], ray[C + p] = a, b, c
        ray[DX + p], ray[DY + p], ray[DZ + p] = a + share * x, b + share * y, c * z + across
        ray[FOUND + p] = ray[COUNT + p] = ray[FIRST + p] = zero
        ray[SPAN_BEFORE + p] = ray[SPAN_BEHIND + p] = ray[LAYER_BEFORE + p] = ray[LAYER_BEHIND + p] = zero
        ray[LAST_NEAREST + p] = ray[LAST_LAYER + p] = zero
        ray[LAST_KNOWN + p] = ray[BOUNDED + p] = one
        source[LAST + p] = source[BEFORE + p] = source[BEHIND + p] = np.int32(0)


@njit(**STRICT)
def step_to(ray: Any, source: Any, image: Any, step: int, steps: int, height: int, width: int, ortho: bool) -> None:
    """Where step `step` of `steps` stands, and on which pixel."""
    T = ray.dtype.type
    along, zero, one = T(step) / T(steps), T(0), T(1)
    fx, fy, cx, cy = image[FX], image[FY], image[CX], image[CY]
    right, bottom, wide = T(width), T(height), np.int32(width)
    for p in range(P):
        length = along * ray[REACH + p]
        x = ray[PX + p] + length * ray[DX + p]
        y = ray[PY + p] + length * ray[DY + p]
        z = ray[PZ + p] + length * ray[DZ + p]
        ahead = z > zero
        scale = one if ortho else one / (z if ahead else one)
        column, row = fx * x * scale + cx, fy * y * scale + cy
        seen = ahead & (column >= zero) & (column < right) & (row >= zero) & (row < bottom)
        ray[X + p], ray[Y + p], ray[Z + p], ray[SEEN + p] = x, y, z, one if seen else zero
        ray[SOLID + p] = ray[INSIDE + p] = ray[KNOWN + p] = ray[LAYER + p] = zero
        ray[NEAREST + p] = T(np.inf)
        source[HERE + p] = np.int32(np.int32(row if seen else zero) * wide + np.int32(column if seen else zero))


@njit(**OPTIONS)
def climb_pyramid(
    ray: Any, source: Any, image: Any, pyramid: Any, number: int, start: int, height: int, width: int, ortho: bool
) -> None:
    """Put the pixel that the pyramid's level of a step's distance offers in the place of its own."""
    T = ray.dtype.type
    pixel, first, cap = pyramid
    row = start // width
    for p in range(P):
        at = source[HERE + p]
        line, column = at // width, at % width
        z = ray[Z + p]
        scale = T(1) if ortho else T(1) / (z if z > T(0) else T(1))
        across = image[FX] * ray[X + p] * scale + image[CX] - (T(min(start % width + p, width - 1)) + T(0.5))
        down = image[FY] * ray[Y + p] * scale + image[CY] - (T(row) + T(0.5))
        distance = max(abs(across), abs(down))
        level = 0
        while level < first.size - 1 and distance > cap * 2**level:
            level += 1
        rows, columns = ((height - 1) >> level) + 1, ((width - 1) >> level) + 1
        chosen = pixel[first[level] + (number * rows + (line >> level)) * columns + (column >> level)]
        source[HERE + p] = np.int32(chosen - number * height * width)


@njit(**OPTIONS)
def fetch(plane: Any, source: Any, row: int, stored: Any, layer: int, layers: int) -> None:
    """Planes of a layer that a step reads."""
    stride, first = np.uintp(4 * layers), np.uintp(4 * layer)
    for p in range(P):
        at = stride * np.uintp(source[row + p]) + first
        plane[PLANE_X + p], plane[PLANE_Y + p] = stored[at], stored[at + np.uintp(1)]
        plane[PLANE_Z + p], plane[PLANE_OFFSET + p] = stored[at + np.uintp(2)], stored[at + np.uintp(3)]


@njit(**OPTIONS)
def meet_layer(ray: Any, plane: Any, layer: int, ortho: bool) -> None:
    """Whether a step lies inside the solid that this layer enters or leaves, and whether it is the nearest so far."""
    T = ray.dtype.type
    entry, number = layer % 2 == 0, T(layer)
    zero, one, least, missing = T(0), T(1), T(-0.5 * MIN_FACING), T(-np.inf)
    for p in range(P):
        x, y, z = ray[X + p], ray[Y + p], ray[Z + p]
        nx, ny, nz, offset = plane[PLANE_X + p], plane[PLANE_Y + p], plane[PLANE_Z + p], plane[PLANE_OFFSET + p]
        known = offset > missing
        level = nx * x + ny * y + nz * z
        over = level - offset
        behind = over / min(nz, least) if ortho else over * z / min(level, least * z)
        deeper = known & (over < -ray[SLACK + p])
        shallow = behind <= ray[DEEPEST + p]
        solid = ray[SOLID + p]
        enters, stays = (one if deeper & shallow else zero), (zero if deeper else solid)
        # An exit has the last word on the entry before it, which counted for inside already if there was none.
        inside = ray[INSIDE + p] - (zero if entry else solid - stays)
        ray[INSIDE + p] = inside + enters if entry else inside
        ray[SOLID + p] = enters if entry else stays
        closer = known & (abs(behind) < ray[NEAREST + p])
        ray[NEAREST + p] = abs(behind) if closer else ray[NEAREST + p]
        ray[LAYER + p] = number if closer else ray[LAYER + p]
        ray[KNOWN + p] = one if known else ray[KNOWN + p]


@njit(**OPTIONS)
def settle(ray: Any, source: Any, step: int) -> Any:
    """Note first hits; how many lanes may still meet something."""
    T = ray.dtype.type
    zero, one, number = T(0), T(1), T(step)
    left = np.int32(0)
    for p in range(P):
        seen, free = ray[SEEN + p] > zero, ray[FOUND + p] == zero
        hit = seen & free & (ray[INSIDE + p] > zero)
        nearest = ray[NEAREST + p] if ray[KNOWN + p] > zero else zero
        ray[COUNT + p] += ray[SEEN + p]
        ray[FOUND + p] = one if hit else ray[FOUND + p]
        ray[FIRST + p] = number if hit else ray[FIRST + p]
        ray[SPAN_BEFORE + p] = ray[LAST_NEAREST + p] if hit else ray[SPAN_BEFORE + p]
        ray[SPAN_BEHIND + p] = nearest if hit else ray[SPAN_BEHIND + p]
        ray[BOUNDED + p] = ray[LAST_KNOWN + p] if hit else ray[BOUNDED + p]
        ray[LAYER_BEFORE + p] = ray[LAST_LAYER + p] if hit else ray[LAYER_BEFORE + p]
        ray[LAYER_BEHIND + p] = ray[LAYER + p] if hit else ray[LAYER_BEHIND + p]
        ray[LAST_NEAREST + p], ray[LAST_KNOWN + p] = nearest, ray[KNOWN + p]
        ray[LAST_LAYER + p] = ray[LAYER + p]
        source[BEFORE + p] = source[LAST + p] if hit else source[BEFORE + p]
        source[BEHIND + p] = source[HERE + p] if hit else source[BEHIND + p]
        source[LAST + p] = source[HERE + p]
        # Rays are straight: what has left the image does not come back.
        left += np.int32(1 if seen & free & (not hit) else 0)
    return left


@njit(forceinline=True, **OPTIONS)
def distance_of(first: Any, before: Any, behind: Any, bounded: Any, steps: Any) -> tuple[Any, Any]:
    """Of the occluder, of the reach (Eq. 1); and before + behind."""
    T = type(first)
    total = before + behind
    share = before / (total if total > T(0) else T(1)) if bounded > T(0) else T(1)
    return (first - T(1) + share) / steps, total


@njit(**OPTIONS)
def finish_ray(ray: Any, image: Any, steps: int) -> None:
    """Add the ray: in full with a hit, by the share of its steps that were seen without one."""
    T = ray.dtype.type
    falloff, zero, one, count = image[FALLOFF], T(0), T(1), T(steps)
    for p in range(P):
        found = ray[FOUND + p] > zero
        first = ray[FIRST + p] if found else one
        distance, _ = distance_of(first, ray[SPAN_BEFORE + p], ray[SPAN_BEHIND + p], ray[BOUNDED + p], count)
        passes = power(distance, falloff) if distance < one else one
        weight = one if found else ray[COUNT + p] / count
        ray[TOTAL + p] += passes if found else weight
        ray[WEIGHT + p] += weight
