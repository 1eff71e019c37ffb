"""Cotangents of `march`, with the hits held: only rays that have hit hand anything on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from torch_ssao.ops._numba import march as m
from torch_ssao.ops._numba.maths import LANES, OPTIONS, logarithm, power
from torch_ssao.ops.falloff import DISTANCE_FLOOR
from torch_ssao.ops.plane_support import MIN_FACING

P = LANES
# Rows of `back`: cotangents of pixels; COT is that of the visibility, over the weight of the pixel's rays,
COT, PX, PY, PZ, NX, NY, NZ, REACH, FALLOFF = range(0, 9 * P, P)
# and of a ray: its direction, and the nearest surface before and behind the hit.
DX, DY, DZ, TO_BEFORE, TO_BEHIND = range(9 * P, 14 * P, P)
BACK_SIZE = 14 * P


@njit(**OPTIONS)
def finish_ray(ray: Any, back: Any, image: Any, steps: int) -> None:
    """Of the ray's openness to the distances on both sides of the hit."""
    T = ray.dtype.type
    falloff, zero, one, count = image[m.FALLOFF], T(0), T(1), T(steps)
    least, tiny = T(DISTANCE_FLOOR) if falloff < T(1) else T(0), T(np.finfo(T).tiny)
    for p in range(P):
        found = ray[m.FOUND + p] > zero
        first = ray[m.FIRST + p] if found else one
        before, behind = ray[m.SPAN_BEFORE + p], ray[m.SPAN_BEHIND + p]
        bounded = ray[m.BOUNDED + p]
        distance, total = m.distance_of(first, before, behind, bounded, count)
        counts = found & (distance < one)
        cot = back[COT + p]
        to_share = cot * falloff * power(max(distance, least), falloff - one) / count
        to_falloff = cot * power(distance, falloff) * logarithm(max(distance, tiny))
        inside = counts & (bounded > zero) & (total > zero)
        square = total * total
        back[FALLOFF + p] += to_falloff if counts else zero
        # The first step's "before" is the pixel itself, on its surface whatever moves.
        back[TO_BEFORE + p] = to_share * behind / square if inside & (first > one) else zero
        back[TO_BEHIND + p] = -to_share * before / square if inside else zero
        back[DX + p] = back[DY + p] = back[DZ + p] = zero


@njit(**OPTIONS)
def meet_layer(ray: Any, plane: Any, back: Any, to_span: int, shift: int, steps: int, ortho: bool) -> None:
    """Of a depth behind the nearest plane to that plane (whose rows become its cotangents) and to the ray.

    Args:
        to_span: row of `back`, TO_BEFORE or TO_BEHIND. shift: steps from the hit, 1 or 0.
    """
    T = ray.dtype.type
    zero, one, least, count, off = T(0), T(1), T(-0.5 * MIN_FACING), T(steps), T(shift)
    for p in range(P):
        grad = back[to_span + p]
        along = (ray[m.FIRST + p] - off) / count
        length = along * ray[m.REACH + p]
        dx, dy, dz = ray[m.DX + p], ray[m.DY + p], ray[m.DZ + p]
        x, y, z = ray[m.PX + p] + length * dx, ray[m.PY + p] + length * dy, ray[m.PZ + p] + length * dz
        nx, ny, nz, offset = plane[m.PLANE_X + p], plane[m.PLANE_Y + p], plane[m.PLANE_Z + p], plane[m.PLANE_OFFSET + p]
        level = nx * x + ny * y + nz * z
        over = level - offset
        free = nz < least if ortho else level < least * z
        slope = min(nz, least) if ortho else min(level, least * z)
        scale = one if ortho else z
        behind = over * scale / slope
        grad = grad if behind > zero else -grad
        to_over, to_slope = grad * scale / slope, -grad * behind / slope
        to_level = to_over if ortho else to_over + (to_slope if free else zero)
        to_z = zero if ortho else grad * over / slope + (zero if free else least * to_slope)
        used = grad != zero
        plane[m.PLANE_X + p] = to_level * x if used else zero
        plane[m.PLANE_Y + p] = to_level * y if used else zero
        plane[m.PLANE_Z + p] = to_level * z + (to_slope if ortho & free else zero) if used else zero
        plane[m.PLANE_OFFSET + p] = -to_over if used else zero
        to_x, to_y, to_z = to_level * nx, to_level * ny, to_level * nz + to_z
        back[PX + p] += to_x if used else zero
        back[PY + p] += to_y if used else zero
        back[PZ + p] += to_z if used else zero
        back[DX + p] += length * to_x if used else zero
        back[DY + p] += length * to_y if used else zero
        back[DZ + p] += length * to_z if used else zero
        back[REACH + p] += along * (to_x * dx + to_y * dy + to_z * dz) if used else zero


@njit(**OPTIONS)
def fetch_nearest(plane: Any, source: Any, row: int, ray: Any, layer: int, stored: Any, layers: int) -> None:
    """Planes nearest to a side of the hits; `layer` is a row of `ray`."""
    stride = np.uintp(4 * layers)
    for p in range(P):
        at = stride * np.uintp(source[row + p]) + np.uintp(4) * np.uintp(ray[layer + p])
        plane[m.PLANE_X + p], plane[m.PLANE_Y + p] = stored[at], stored[at + np.uintp(1)]
        plane[m.PLANE_Z + p], plane[m.PLANE_OFFSET + p] = stored[at + np.uintp(2)], stored[at + np.uintp(3)]


@njit(**OPTIONS)
def add_nearest(
    plane: Any, source: Any, row: int, ray: Any, layer: int, to_stored: Any, layers: int, reached: Any
) -> None:
    """Add to the planes that were read; `reached` are the first and the last pixel so far."""
    stride = np.uintp(4 * layers)
    first, last = reached[0], reached[1]
    for p in range(P):
        first, last = min(first, source[row + p]), max(last, source[row + p])
        at = stride * np.uintp(source[row + p]) + np.uintp(4) * np.uintp(ray[layer + p])
        to_stored[at] += plane[m.PLANE_X + p]
        to_stored[at + np.uintp(1)] += plane[m.PLANE_Y + p]
        to_stored[at + np.uintp(2)] += plane[m.PLANE_Z + p]
        to_stored[at + np.uintp(3)] += plane[m.PLANE_OFFSET + p]
    reached[0], reached[1] = first, last


@njit(**OPTIONS)
def set_ray(ray: Any, back: Any) -> None:
    """Of a ray's direction to the normal."""
    T = ray.dtype.type
    one, zero, away = T(1), T(0), T(m.AWAY)
    for p in range(P):
        a, b, c = ray[m.A + p], ray[m.B + p], ray[m.C + p]
        x, y, z = ray[m.NX + p], ray[m.NY + p], ray[m.NZ + p]
        to_x, to_y, to_z = back[DX + p], back[DY + p], back[DZ + p]
        across, gap = a * x + b * y, max(one - z, away)
        share = c - across / gap
        to_share = to_x * x + to_y * y
        to_across = to_z - to_share / gap
        back[NX + p] += to_x * share + to_across * a
        back[NY + p] += to_y * share + to_across * b
        back[NZ + p] += to_z * c - (to_share * across / (gap * gap) if one - z > away else zero)
