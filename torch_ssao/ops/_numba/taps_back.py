"""Cotangents of `taps`, each function that of its namesake."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from torch_ssao.ops._numba import arcs_back as b
from torch_ssao.ops._numba import taps as t
from torch_ssao.ops._numba.maths import LANES, OPTIONS

P = LANES
# Numbers of an image that its pixels add their cotangents to.
FX, FY, CX, CY, R, FALLOFF, THICKNESS, BIAS = range(8)


@njit(**OPTIONS)
def meet_plane(frame: Any, tap: Any, pixel: Any, ortho: bool) -> None:
    """Of a tap's point to its plane (rows P0, P1, P2 become their cotangents) and the slice."""
    T = pixel.dtype.type
    one, zero = T(1), T(0)
    for p in range(P):
        seen = tap[t.SEEN + p] > zero
        to_along, to_towards = tap[t.TO_ALONG + p], tap[t.TO_TOWARDS + p]
        to_reach = tap[t.TO_REACH + p]
        shrunk, away, reach = tap[t.SHRUNK + p], tap[t.AWAY + p], tap[t.REACH + p]
        depth, level, far = frame[t.DEPTH + p], tap[t.SEEN_LEVEL + p], frame[t.FAR + p]
        step_x, step_y = frame[t.STEP_X + p], frame[t.STEP_Y + p]
        major, recession = frame[t.MAJOR + p], frame[t.RECESSION + p]
        scale = one if ortho else one / (level * depth * away)
        to_scale = -(to_along * reach - to_towards * far) * scale
        to_level = -to_towards if ortho else to_scale / level
        to_depth = to_towards if ortho else to_scale / depth
        to_far = zero if ortho else to_towards * (one - scale)
        to_reach = to_reach + to_along * scale
        to_away = (zero if ortho else to_scale / away) + to_reach * abs(shrunk)
        to_recession = to_away * shrunk * away * away
        to_shrunk = to_reach * away * (one if shrunk > zero else -one) + to_away * recession * away * away
        to_x, to_y = to_level * tap[t.P1 + p], to_level * tap[t.P2 + p]
        to_shrunk = to_shrunk + to_x * step_x + to_y * step_y
        to_major = -to_shrunk * shrunk / major
        wide = abs(step_x) >= abs(step_y)
        to_x = to_x * shrunk + ((to_major if step_x > zero else -to_major) if wide else zero)
        to_y = to_y * shrunk + (zero if wide else (to_major if step_y > zero else -to_major))
        tap[t.P0 + p] = to_level if seen else zero
        tap[t.P1 + p] = to_level * tap[t.INSIDE_X + p] if seen else zero
        tap[t.P2 + p] = to_level * tap[t.INSIDE_Y + p] if seen else zero
        pixel[b.DEPTH + p] += to_depth if seen else zero
        pixel[b.FAR + p] += to_far if seen else zero
        pixel[b.STEP_X + p] += to_x if seen else zero
        pixel[b.STEP_Y + p] += to_y if seen else zero
        pixel[b.RECESSION + p] += (zero if ortho else to_recession) if seen else zero


@njit(**OPTIONS)
def fetch(tap: Any, source: Any, to_texels: Any, reached: Any) -> None:
    """Add to the planes that were read; `reached` are the first and the last pixel so far."""
    first, last = reached[0], reached[1]
    for p in range(P):
        first, last = min(first, source[p]), max(last, source[p])
        at = 3 * np.uintp(source[p])
        to_texels[at] += tap[t.P0 + p]
        to_texels[at + np.uintp(1)] += tap[t.P1 + p]
        to_texels[at + np.uintp(2)] += tap[t.P2 + p]
    reached[0], reached[1] = first, last


@njit(**OPTIONS)
def set_slice(frame: Any, pixel: Any, image: Any, ortho: bool) -> None:
    """Of a slice to its pixel; the rows of the slice are left at 0."""
    T = pixel.dtype.type
    fx, fy, one, zero = image[t.FX], image[t.FY], T(1), T(0)
    for p in range(P):
        cosine, sine = frame[t.COSINE + p], frame[t.SINE + p]
        x, y, depth = frame[t.X + p], frame[t.Y + p], frame[t.DEPTH + p]
        dx, dy, dz = frame[t.DIRECTION_X + p], frame[t.DIRECTION_Y + p], frame[t.DIRECTION_Z + p]
        to_turned, to_recession = pixel[b.TURNED + p], pixel[b.RECESSION + p]
        to_x, to_y = pixel[b.STEP_X + p], pixel[b.STEP_Y + p]
        pixel[b.NX + p] += to_turned * dx
        pixel[b.NY + p] += to_turned * dy
        pixel[b.NZ + p] += to_turned * dz
        pixel[b.FX + p] += to_x * frame[t.STEP_X + p] / fx
        pixel[b.FY + p] += to_y * frame[t.STEP_Y + p] / fy
        along_x, along_y = to_x * fx / depth, to_y * fy / depth
        to_depth = to_x * frame[t.STEP_X + p] + to_y * frame[t.STEP_Y + p]
        to_depth = -(to_depth + to_recession * frame[t.RECESSION + p]) / depth
        to_dx = along_x + to_turned * frame[t.NX + p]
        to_dy = along_y + to_turned * frame[t.NY + p]
        to_dz = to_recession / depth - along_x * x - along_y * y + to_turned * frame[t.NZ + p]
        # The direction is (cosine - a u w, sine - b u w, -u) with u = a cosine + b sine and w = 1 / (1 + c).
        stretch = math.sqrt(one + x * x + y * y)
        a, b_, c = x / stretch, y / stretch, one / stretch
        w = one / (one + c)
        to_u = -(to_dx * a + to_dy * b_) * w - to_dz
        pixel[b.A + p] += zero if ortho else to_u * cosine + to_dx * w * dz
        pixel[b.B + p] += zero if ortho else to_u * sine + to_dy * w * dz
        pixel[b.C + p] -= zero if ortho else dz * (to_dx * a + to_dy * b_) * w * w
        # x and y of the pixel move the slice's steps as well.
        pixel[b.TO_X + p] -= zero if ortho else along_x * dz
        pixel[b.TO_Y + p] -= zero if ortho else along_y * dz
        pixel[b.DEPTH + p] += zero if ortho else to_depth
        pixel[b.TURNED + p] = pixel[b.RECESSION + p] = zero
        pixel[b.STEP_X + p] = pixel[b.STEP_Y + p] = zero


@njit(**OPTIONS)
def set_pixels(
    frame: Any, pixel: Any, image: Any, to_image: Any, to_texels: Any, to_normal: Any, row: int, first: int, ortho: bool
) -> None:
    """Of the pixels of a row to their planes and normals, and to the image's numbers (float64)."""
    T = pixel.dtype.type
    width = to_normal.shape[2]
    fx, fy, one, zero, half = image[t.FX], image[t.FY], T(1), T(0), T(0.5)
    unit = max(fx, fy)
    share_x = half if fx == fy else (one if fx > fy else zero)
    longest_px = image[t.LONGEST_PX]
    for p in range(min(P, width - first)):
        x, y, depth = frame[t.X + p], frame[t.Y + p], frame[t.DEPTH + p]
        stretch = one if ortho else math.sqrt(one + x * x + y * y)
        a, b_, c = x / stretch, y / stretch, one / stretch
        to_facing, to_far = pixel[b.FACING + p], pixel[b.FAR + p]
        nx, ny, nz = frame[t.NX + p], frame[t.NY + p], frame[t.NZ + p]
        to_depth, to_radius = pixel[b.DEPTH + p], pixel[b.RADIUS + p]
        to_fx, to_fy = pixel[b.FX + p], pixel[b.FY + p]
        if frame[t.FREE + p] == zero:  # the cap sets the radius
            to_limit = to_radius * longest_px / unit
            to_unit = -to_limit * (one if ortho else depth) / unit
            to_depth += zero if ortho else to_limit
            to_fx, to_fy, to_radius = to_fx + to_unit * share_x, to_fy + to_unit * (one - share_x), zero
        if ortho:
            to_normal[0, row, first + p], to_normal[1, row, first + p] = pixel[b.NX + p], pixel[b.NY + p]
            to_normal[2, row, first + p] = pixel[b.NZ + p] - to_facing
            to_level = to_depth
        else:
            to_normal[0, row, first + p] = pixel[b.NX + p] - to_facing * a
            to_normal[1, row, first + p] = pixel[b.NY + p] - to_facing * b_
            to_normal[2, row, first + p] = pixel[b.NZ + p] - to_facing * c
            to_a, to_b = pixel[b.A + p] - to_facing * nx, pixel[b.B + p] - to_facing * ny
            radial = a * to_a + b_ * to_b + c * (pixel[b.C + p] - to_facing * nz)
            to_x = (to_a - a * radial) / stretch + to_far * depth * a + pixel[b.TO_X + p]
            to_y = (to_b - b_ * radial) / stretch + to_far * depth * b_ + pixel[b.TO_Y + p]
            to_depth += to_far * stretch
            to_level = -to_depth * depth * depth
            to_fx, to_fy = to_fx - to_x * x / fx, to_fy - to_y * y / fy
            to_image[CX] -= to_x / fx
            to_image[CY] -= to_y / fy
        to_texels[3 * (row * width + first + p)] += to_level
        to_image[FX] += to_fx
        to_image[FY] += to_fy
        to_image[R] += to_radius
        to_image[FALLOFF] += pixel[b.FALLOFF + p]
        to_image[THICKNESS] += pixel[b.THICKNESS + p]
        to_image[BIAS] += pixel[b.BIAS + p]


@njit(**OPTIONS)
def spread(
    frame: Any, pixel: Any, image: Any, to_image: Any, to_texels: Any, by_spread: Any, row: int, first: int, width: int,
    ortho: bool,
) -> None:  # fmt: skip
    """Of the size of the footprint R f / z in the image; of a change by fx and fy each takes half."""
    T = pixel.dtype.type
    for p in range(min(P, width - first)):
        grad = pixel[b.COT + p] * by_spread[p] * frame[t.FREE + p]
        if not ortho:
            to_texels[3 * (row * width + first + p)] += grad / frame[t.LEVEL + p]
        to_image[FX] += T(0.5) * grad / image[t.FX]
        to_image[FY] += T(0.5) * grad / image[t.FY]
        to_image[R] += grad / image[t.R]
