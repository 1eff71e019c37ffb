"""Arcs of `ops.horizon_arcs` for `LANES` pixels: measured, sorted and united by the share of the hemisphere below their ends.

That share grows with the elevation from the tangent plane to the view ray, so that ends compare as their elevations do.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from torch_ssao.ops._numba import taps as t
from torch_ssao.ops._numba.maths import LANES, OPTIONS, angle, power
from torch_ssao.ops.horizon_arcs import CONNECTED_SLOPE, GRAZE, LINK_STEP, TRAPEZOID_SLOPE, TRAPEZOID_STEP

P = LANES
# Rows of `sums`, of a side of a slice: the share below the bias, what is added up, how far it has got.
FLOOR, TOTAL, REACHED = range(0, 3 * P, P)
SUM_SIZE = 3 * P
# Rows of an arc; PLACE is where it was before sorting (increments: the tap's weight), BEFORE how far the earlier ones reach.
LOW, HIGH, PLACE, BEFORE, TO_LOW, TO_HIGH = range(0, 6 * P, P)
ARC_SIZE = 6 * P


@njit(forceinline=True, **OPTIONS)
def amount(elevation: Any, sine: Any, cosine: Any, facing: Any, turned: Any, length: Any, by_cosine: bool) -> Any:
    """Share of the hemisphere below an elevation (given with its sine and cosine), times the number of slices."""
    half = type(facing)(0.5)
    if by_cosine:
        return half * (facing * sine * sine + turned * (elevation - cosine * sine))
    return half * (sine * facing - cosine * turned + turned) / length


@njit(forceinline=True, **OPTIONS)
def amount_at(
    along: Any, towards: Any, facing: Any, turned: Any, length: Any, noise: Any,
    bias_cosine: Any, bias_sine: Any, floor: Any, by_cosine: bool,
) -> tuple[Any, bool]:  # fmt: skip
    """Share below a point, at least that below the bias; whether the point lies above the bias."""
    T = type(facing)
    up = (towards * facing + along * turned) / length - noise
    out = (along * facing - towards * turned) / length
    above = (up >= T(0)) & (up * bias_cosine > out * bias_sine)
    inverse = T(1) / math.sqrt(up * up + out * out)
    elevation = angle(up if above else T(1), out) if by_cosine else T(0)
    value = amount(elevation, up * inverse, out * inverse, facing, turned, length, by_cosine)
    return (value if above else floor), above


@njit(forceinline=True, **OPTIONS)
def clip(along: Any, towards: Any, ray_x: Any, ray_y: Any, radius: Any, length: Any) -> tuple[Any, Any, bool]:
    """Part of a segment that lies in the sphere of radius R; see `ops.horizon_arcs`."""
    T = type(radius)
    middle = -(along * ray_x + towards * ray_y)
    offset = along * ray_y - towards * ray_x
    inside = radius * radius - offset * offset
    soft = T(GRAZE) * radius
    half = math.sqrt(max(inside, T(0)) + soft * soft) - soft
    first, last = max(middle - half, T(0)), min(middle + half, length)
    return first, last, (inside > T(0)) & (last > first)


@njit(forceinline=True, **OPTIONS)
def view_ray(reach: Any, far: Any, ortho: bool) -> tuple[Any, Any]:
    """Direction of a tap's ray from the eye."""
    T = type(reach)
    inverse = T(1) / math.sqrt(far * far + reach * reach)
    return (T(0) if ortho else reach * inverse), (T(-1) if ortho else -far * inverse)


@njit(**OPTIONS)
def set_side(frame: Any, sums: Any, image: Any, sign: float, by_cosine: bool) -> None:
    """Share below the bias; nothing added up yet."""
    T = sums.dtype.type
    bias, side = image[t.BIAS], T(sign)
    sine, cosine = image[t.BIAS_SINE], image[t.BIAS_COSINE]
    for p in range(P):
        facing, turned, length = frame[t.FACING + p], side * frame[t.TURNED + p], frame[t.LENGTH + p]
        sums[FLOOR + p] = amount(bias, sine, cosine, facing, turned, length, by_cosine)


@njit(**OPTIONS)
def tap_arc(
    frame: Any, tap: Any, arc: Any, sums: Any, image: Any, place: int, sign: float, ortho: bool, by_cosine: bool
) -> None:  # fmt: skip
    """Arc that the occluder of tap k covers inside the sphere."""
    T = sums.dtype.type
    side = T(sign)
    thickness, bias_cosine, bias_sine = image[t.THICKNESS], image[t.BIAS_COSINE], image[t.BIAS_SINE]
    for p in range(P):
        along, towards = tap[t.ALONG + p], tap[t.TOWARDS + p]
        facing, turned, length = frame[t.FACING + p], side * frame[t.TURNED + p], frame[t.LENGTH + p]
        noise, floor, radius = frame[t.NOISE + p], sums[FLOOR + p], frame[t.RADIUS + p]
        ray_x, ray_y = view_ray(tap[t.REACH + p], frame[t.FAR + p], ortho)
        first, last, hit = clip(along, towards, ray_x, ray_y, radius, thickness * radius)
        high, _ = amount_at(
            along + first * ray_x, towards + first * ray_y, facing, turned, length, noise,
            bias_cosine, bias_sine, floor, by_cosine,
        )  # fmt: skip
        low, _ = amount_at(
            along + last * ray_x, towards + last * ray_y, facing, turned, length, noise,
            bias_cosine, bias_sine, floor, by_cosine,
        )  # fmt: skip
        hit = hit & (tap[t.SEEN + p] > T(0))
        high = high if hit else floor
        arc[HIGH + p] = high
        arc[LOW + p] = min(low, high) if hit else floor
        arc[PLACE + p] = T(place)


@njit(forceinline=True, **OPTIONS)
def joined(across: Any, rise: Any, seen: Any, seen_before: Any, slope: Any, near: Any, back: bool) -> bool:
    """Whether two neighbouring taps lie on one surface."""
    zero = type(across)(0)
    height = abs(rise)
    level = height <= near
    same = (across > zero) & ((height <= slope * across) | level)
    under = back & (across < zero) & (-across <= near) & level
    return (seen > zero) & (seen_before > zero) & (same | under)


@njit(**OPTIONS)
def link_arc(
    frame: Any,
    tap: Any,
    before: Any,
    arc: Any,
    sums: Any,
    image: Any,
    place: int,
    start: bool,
    sign: float,
    by_cosine: bool,
) -> None:
    """Arc between taps k - 1 and k; before the first tap comes the pixel itself, on the tangent plane."""
    T = sums.dtype.type
    side = T(sign)
    step, slope = min(image[t.THICKNESS], T(LINK_STEP)), T(CONNECTED_SLOPE)
    bias_cosine, bias_sine = image[t.BIAS_COSINE], image[t.BIAS_SINE]
    one, zero = T(1), T(0)
    for p in range(P):
        along, towards = tap[t.ALONG + p], tap[t.TOWARDS + p]
        from_along = zero if start else before[t.ALONG + p]
        from_towards = zero if start else before[t.TOWARDS + p]
        seen_before = one if start else before[t.SEEN + p]
        facing, turned, length = frame[t.FACING + p], side * frame[t.TURNED + p], frame[t.LENGTH + p]
        noise, floor, radius = frame[t.NOISE + p], sums[FLOOR + p], frame[t.RADIUS + p]
        across, rise = along - from_along, towards - from_towards
        same = joined(across, rise, tap[t.SEEN + p], seen_before, slope, step * radius, True)
        span = math.sqrt(across * across + rise * rise)
        across, rise = across / span, rise / span
        first, last, hit = clip(from_along, from_towards, across, rise, radius, span)
        two, _ = amount_at(
            from_along + last * across, from_towards + last * rise, facing, turned, length, noise,
            bias_cosine, bias_sine, floor, by_cosine,
        )  # fmt: skip
        other, _ = amount_at(
            from_along + first * across, from_towards + first * rise, facing, turned, length, noise,
            bias_cosine, bias_sine, floor, by_cosine,
        )  # fmt: skip
        other = floor if start else other
        hit = hit & same
        arc[HIGH + p] = max(two, other) if hit else floor
        arc[LOW + p] = min(two, other) if hit else floor
        arc[PLACE + p] = T(place)


@njit(**OPTIONS)
def sort_arcs(arcs: Any, network: Any) -> None:
    """By their lower ends, through a network of pairs to be put in order."""
    for pair in range(network.shape[0]):
        one, two = arcs[network[pair, 0]], arcs[network[pair, 1]]
        for p in range(P):
            low, low_two = one[LOW + p], two[LOW + p]
            high, high_two = one[HIGH + p], two[HIGH + p]
            place, place_two = one[PLACE + p], two[PLACE + p]
            swap = low > low_two
            one[LOW + p] = low_two if swap else low
            two[LOW + p] = low if swap else low_two
            one[HIGH + p] = high_two if swap else high
            two[HIGH + p] = high if swap else high_two
            one[PLACE + p] = place_two if swap else place
            two[PLACE + p] = place if swap else place_two


@njit(**OPTIONS)
def unite(arcs: Any, sums: Any, count: int) -> None:
    """Add the length of the union of sorted arcs."""
    first = arcs[0]
    for p in range(P):
        sums[REACHED + p] = first[LOW + p]
    for i in range(count):
        arc = arcs[i]
        for p in range(P):
            reached, high = sums[REACHED + p], arc[HIGH + p]
            arc[BEFORE + p] = reached
            low = max(arc[LOW + p], reached)
            sums[TOTAL + p] += max(high - low, type(high)(0))
            sums[REACHED + p] = max(reached, high)


@njit(**OPTIONS)
def weigh_tap(frame: Any, tap: Any, arc: Any, image: Any) -> None:
    """Attenuation of tap k, into the row PLACE of arc k."""
    T = frame.dtype.type
    falloff, one, zero = image[t.FALLOFF], T(1), T(0)
    for p in range(P):
        along, towards = tap[t.ALONG + p], tap[t.TOWARDS + p]
        distance = math.sqrt(along * along + towards * towards) / frame[t.RADIUS + p]
        arc[PLACE + p] = one - power(distance, falloff) if distance < one else zero


@njit(**OPTIONS)
def raise_horizon(
    frame: Any,
    tap: Any,
    before: Any,
    arc: Any,
    arc_before: Any,
    sums: Any,
    image: Any,
    start: bool,
    sign: float,
    ortho: bool,
    by_cosine: bool,
) -> None:
    """Add by how much tap k raises the horizon (row REACHED); its arc goes from where it starts to the horizon."""
    T = sums.dtype.type
    side = T(sign)
    thickness, bias_cosine, bias_sine = image[t.THICKNESS], image[t.BIAS_COSINE], image[t.BIAS_SINE]
    slope, step, one, zero, half = T(TRAPEZOID_SLOPE), T(TRAPEZOID_STEP), T(1), T(0), T(0.5)
    thick = thickness < T(np.inf)
    for p in range(P):
        along, towards = tap[t.ALONG + p], tap[t.TOWARDS + p]
        facing, turned, length = frame[t.FACING + p], side * frame[t.TURNED + p], frame[t.LENGTH + p]
        noise, floor, radius = frame[t.NOISE + p], sums[FLOOR + p], frame[t.RADIUS + p]
        across = along - (zero if start else before[t.ALONG + p])
        rise = towards - (zero if start else before[t.TOWARDS + p])
        seen, seen_before = tap[t.SEEN + p], one if start else before[t.SEEN + p]
        same = joined(across, rise, seen, seen_before, slope, step * radius, False)
        weight = arc[PLACE + p]
        earlier = one if start else arc_before[PLACE + p]
        front, _ = amount_at(along, towards, facing, turned, length, noise, bias_cosine, bias_sine, floor, by_cosine)
        reached = floor if start else sums[REACHED + p]
        horizon = max(reached, front) if seen > zero else reached
        ray_x, ray_y = view_ray(tap[t.REACH + p], frame[t.FAR + p], ortho)
        depth = thickness * radius if thick else zero
        back, _ = amount_at(
            along + depth * ray_x, towards + depth * ray_y, facing, turned, length, noise,
            bias_cosine, bias_sine, floor, by_cosine,
        )  # fmt: skip
        low = min(max(reached, back), horizon) if thick else reached
        arc[LOW + p], arc[HIGH + p], arc[BEFORE + p] = low, horizon, reached
        sums[TOTAL + p] += half * ((earlier if same else weight) + weight) * (horizon - low)
        sums[REACHED + p] = horizon
