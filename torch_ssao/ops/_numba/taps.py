"""Taps of `ops.horizon_taps` for `LANES` neighbouring pixels of a row: one loop over them a stage, values in rows of scratch.

`frame` holds what the taps of a pixel share, `taps` a group of rows a tap; both are flat, so that LLVM sees which rows differ.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from torch_ssao.ops._numba.maths import LANES, OPTIONS, STRICT, power, rounded, turn
from torch_ssao.ops.horizon_arcs import ROUNDING
from torch_ssao.ops.horizon_taps import HORIZON, NEAREST, WIDEST
from torch_ssao.ops.sampling import GOLDEN

P = LANES
# Where rows of `frame` begin: of the pixels,
COLUMN, X, Y, LEVEL, DEPTH, FAR, RADIUS, FREE, NX, NY, NZ, FACING, LONGEST, ROTATION, OFFSET, NOISE = range(
    0, 16 * P, P
)
# and of their slices; MAJOR is the larger of |STEP_X| and |STEP_Y|, FREE whether no cap shortens the radius.
COSINE, SINE, DIRECTION_X, DIRECTION_Y, DIRECTION_Z, TURNED, LENGTH, STEP_X, STEP_Y, MAJOR, RECESSION = range(
    16 * P, 27 * P, P
)
FRAME_SIZE = 27 * P
# Rows of a tap.
SHRUNK, AWAY, REACH, INSIDE_X, INSIDE_Y, SEEN, P0, P1, P2, SEEN_LEVEL, ALONG, TOWARDS = range(0, 12 * P, P)
TO_ALONG, TO_TOWARDS, TO_REACH = range(12 * P, 15 * P, P)
TAP_SIZE = 15 * P
# Numbers of an image.
FX, FY, CX, CY, R, FALLOFF, THICKNESS, BIAS, LONGEST_PX, BIAS_COSINE, BIAS_SINE = range(11)
IMAGE_NUMBERS = 11


@njit(**STRICT)
def set_pixels(
    frame: Any, image: Any, texels: Any, normal: Any, rotation: Any, offset: Any, row: int, first: int, ortho: bool
) -> None:
    """Rows of the pixels `first` ... of a row; lanes off the image repeat its last pixel."""
    T = frame.dtype.type
    width = rotation.shape[1]
    fx, fy, cx, cy, radius = image[FX], image[FY], image[CX], image[CY], image[R]
    one, half = T(1), T(0.5)
    longest_px = image[LONGEST_PX] / max(fx, fy)
    y = (T(row) + half - cy) / fy
    for p in range(P):
        column = min(first + p, width - 1)
        at = row * width + column
        x = (T(column) + half - cx) / fx
        level = texels[4 * at + 3]
        depth = level if ortho else one / level
        limit = longest_px if ortho else longest_px * depth
        shortened = min(radius, limit)
        stretch = one if ortho else math.sqrt(one + x * x + y * y)
        far = depth * stretch
        part = min(shortened / far, T(WIDEST))
        nx, ny, nz = normal[0, row, column], normal[1, row, column], normal[2, row, column]
        frame[COLUMN + p] = T(column)
        frame[X + p], frame[Y + p] = x, y
        frame[LEVEL + p], frame[DEPTH + p], frame[FAR + p] = level, depth, far
        frame[RADIUS + p], frame[FREE + p] = shortened, one if radius < limit else T(0)
        frame[NX + p], frame[NY + p], frame[NZ + p] = nx, ny, nz
        frame[FACING + p] = -nz if ortho else -(x / stretch * nx + y / stretch * ny + one / stretch * nz)
        frame[LONGEST + p] = shortened if ortho else shortened * (one / math.sqrt(one - part * part))
        frame[ROTATION + p], frame[OFFSET + p] = rotation[row, column], offset[row, column]
        frame[NOISE + p] = T(ROUNDING) * T(np.finfo(T).eps) * abs(far)


@njit(**STRICT)
def set_slice(frame: Any, image: Any, number: int, slices: int, ortho: bool) -> None:
    """Rows of a slice."""
    T = frame.dtype.type
    one, zero, least = T(1), T(0), T(1e-12)
    fx, fy = image[FX], image[FY]
    share = T(math.pi / slices)
    for p in range(P):
        cosine, sine = turn((T(number) + frame[ROTATION + p]) * share)
        x, y, depth = frame[X + p], frame[Y + p], frame[DEPTH + p]
        stretch = math.sqrt(one + x * x + y * y)
        a, b, c = x / stretch, y / stretch, one / stretch
        mixed = -a * b / (one + c)
        dx = cosine * (one - a * a / (one + c)) + sine * mixed
        dy = cosine * mixed + sine * (one - b * b / (one + c))
        dz = -cosine * a - sine * b
        dx, dy, dz = cosine if ortho else dx, sine if ortho else dy, zero if ortho else dz
        turned = dx * frame[NX + p] + dy * frame[NY + p] + dz * frame[NZ + p]
        step_x = fx * cosine if ortho else fx * (dx - x * dz) / depth
        step_y = fy * sine if ortho else fy * (dy - y * dz) / depth
        facing = frame[FACING + p]
        frame[COSINE + p], frame[SINE + p] = cosine, sine
        frame[DIRECTION_X + p], frame[DIRECTION_Y + p], frame[DIRECTION_Z + p] = dx, dy, dz
        frame[TURNED + p] = turned
        frame[LENGTH + p] = math.sqrt(max(facing * facing + turned * turned, least))
        frame[STEP_X + p], frame[STEP_Y + p] = step_x, step_y
        frame[MAJOR + p] = max(abs(step_x), abs(step_y))
        frame[RECESSION + p] = zero if ortho else dz / depth


@njit(**STRICT)
def place_tap(
    frame: Any, tap: Any, source: Any, k: int, steps: int, side: int, number: int, step_power: float, spread: float,
    row: int, height: int, width: int, extend: bool,
) -> None:  # fmt: skip
    """Where tap k of a side lies in the image, and which pixel of it."""
    T = frame.dtype.type
    one, zero, half, nearest, furthest = T(1), T(0), T(0.5), T(NEAREST), T(max(height, width))
    sign = T(1 - 2 * side)
    shift = T(2 * number + side) * T(GOLDEN)
    first, part, exponent, factor = T(k), one / T(steps), T(step_power), T(spread)
    linear = step_power == 1.0
    right, bottom, here = T(width), T(height), T(row)
    last_column, last_row = T(width - 1), T(height - 1)
    for p in range(P):
        jitter = frame[OFFSET + p] + shift
        jitter = (first + (jitter - T(np.int32(jitter)))) * part
        share = jitter if linear else power(jitter, exponent)
        reach = frame[LONGEST + p] * share * factor
        recession, major = frame[RECESSION + p], frame[MAJOR + p]
        reach = reach / max(one + sign * reach * recession, nearest)
        count = max(rounded(min(reach * major, furthest)), one)
        shrunk = sign * count / major
        left = one - shrunk * recession
        left = left if left > nearest else nearest
        away = one / left
        offset_x, offset_y = shrunk * frame[STEP_X + p], shrunk * frame[STEP_Y + p]
        x, y = frame[COLUMN + p] + half + offset_x, here + half + offset_y
        if extend:
            x, y = min(max(x, zero), last_column), min(max(y, zero), last_row)
        seen = (x >= zero) & (x < right) & (y >= zero) & (y < bottom) & (away > nearest) & (away < one / nearest)
        column, line = np.int32(x if seen else zero), np.int32(y if seen else zero)
        tap[SHRUNK + p], tap[AWAY + p] = shrunk, away
        tap[REACH + p] = abs(shrunk) * away
        tap[INSIDE_X + p] = frame[COLUMN + p] + offset_x - T(column)
        tap[INSIDE_Y + p] = here + offset_y - T(line)
        tap[SEEN + p] = one if seen else zero
        source[p] = np.int32(line * np.int32(width) + column)


@njit(**OPTIONS)
def climb_pyramid(
    frame: Any, tap: Any, source: Any, pixel: Any, start: Any, cap: float, image: int,
    row: int, height: int, width: int,
) -> None:  # fmt: skip
    """Put the pixel that the pyramid's level of its distance offers in the place of a tap's own."""
    T = frame.dtype.type
    for p in range(P):
        at = source[p]
        line, column = at // width, at % width
        offset_x = tap[INSIDE_X + p] - frame[COLUMN + p] + T(column)
        offset_y = tap[INSIDE_Y + p] - T(row) + T(line)
        distance = np.rint(abs(tap[SHRUNK + p]) * frame[MAJOR + p])
        level = 0
        while level < start.size - 1 and distance > cap * 2**level:
            level += 1
        rows, columns = ((height - 1) >> level) + 1, ((width - 1) >> level) + 1
        chosen = pixel[start[level] + (image * rows + (line >> level)) * columns + (column >> level)]
        chosen -= image * height * width
        source[p] = chosen
        tap[INSIDE_X + p] = frame[COLUMN + p] + offset_x - T(chosen % width)
        tap[INSIDE_Y + p] = T(row) + offset_y - T(chosen // width)


@njit(**OPTIONS)
def fetch(tap: Any, source: Any, texels: Any) -> None:
    """Planes that a tap reads; a loop of its own, since nothing that jumps about in memory vectorises."""
    for p in range(P):
        at = 4 * np.uintp(source[p])
        tap[P0 + p], tap[P1 + p], tap[P2 + p] = (
            texels[at],
            texels[at + np.uintp(1)],
            texels[at + np.uintp(2)],
        )


@njit(**OPTIONS)
def meet_plane(frame: Any, tap: Any, ortho: bool) -> None:
    """Where the ray of a tap meets the plane of its pixel."""
    T = frame.dtype.type
    one, zero, horizon = T(1), T(0), T(HORIZON)
    for p in range(P):
        plane, depth = tap[P0 + p], frame[DEPTH + p]
        level = plane + tap[P1 + p] * tap[INSIDE_X + p] + tap[P2 + p] * tap[INSIDE_Y + p]
        seen = (tap[SEEN + p] > zero) & ((plane > zero) if ortho else (level > horizon * plane))
        level = level if seen else frame[LEVEL + p]
        scale = one if ortho else one / (level * depth * tap[AWAY + p])
        tap[SEEN_LEVEL + p] = level
        tap[ALONG + p] = scale * tap[REACH + p]
        tap[TOWARDS + p] = depth - level if ortho else (one - scale) * frame[FAR + p]
        tap[SEEN + p] = one if seen else zero
