"""Cotangents of `arcs`, each function that of its namesake; `cot` is the cotangent of the obscurance, by slice.

An end at the angle e over the tangent plane is at e + view from the slice's direction, so it moves with the point by the angle
at which that lies, and with the normal through the view angle alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from torch_ssao.ops._numba import arcs as a
from torch_ssao.ops._numba import taps as t
from torch_ssao.ops._numba.maths import LANES, OPTIONS, angle, logarithm, power
from torch_ssao.ops.falloff import DISTANCE_FLOOR
from torch_ssao.ops.horizon_arcs import CONNECTED_SLOPE, GRAZE, LINK_STEP, TRAPEZOID_SLOPE, TRAPEZOID_STEP

P = LANES
# Rows of `side`, of a side of a slice: cotangents of the normal at given elevations, of the view angle, and of the floor.
TO_FACING, TO_TURNED, TO_VIEW, TO_FLOOR, CARRY = range(0, 5 * P, P)
SIDE_SIZE = 5 * P
# Rows of `pixel`: cotangents of a pixel's numbers, and of one slice's (from TURNED on); COT is that of its obscurance.
COT, FACING, FAR, DEPTH, RADIUS, THICKNESS, BIAS, FALLOFF, NX, NY, NZ, A, B, C, FX, FY, TO_X, TO_Y = range(0, 18 * P, P)
TURNED, STEP_X, STEP_Y, RECESSION = range(18 * P, 22 * P, P)
PIXEL_SIZE = 22 * P


@njit(forceinline=True, **OPTIONS)
def amount_at(
    grad: Any, along: Any, towards: Any, facing: Any, turned: Any, length: Any, noise: Any,
    bias_cosine: Any, bias_sine: Any, by_cosine: bool,
) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
    """Cotangents of the point (2), the normal at given elevation (2), the view angle and the floor."""
    T = type(facing)
    half, zero = T(0.5), T(0)
    up = (towards * facing + along * turned) / length - noise
    out = (along * facing - towards * turned) / length
    above = (up >= zero) & (up * bias_cosine > out * bias_sine)
    inverse = T(1) / math.sqrt(up * up + out * out)
    sine, cosine = up * inverse, out * inverse
    into = (cosine * facing + sine * turned) * (sine if by_cosine else half / length)
    elevation = angle(up if above else T(1), out) if by_cosine else zero
    to_facing = half * sine * sine if by_cosine else zero
    to_turned = half * (elevation - cosine * sine) if by_cosine else zero
    to_view = (zero if by_cosine else into - half * facing / length) - into
    around = grad * into * inverse * inverse
    return (
        -around * towards if above else zero,
        around * along if above else zero,
        grad * to_facing if above else zero,
        grad * to_turned if above else zero,
        grad * to_view if above else zero,
        zero if above else grad,
    )


@njit(forceinline=True, **OPTIONS)
def clip(
    along: Any, towards: Any, ray_x: Any, ray_y: Any, radius: Any, length: Any, to_first: Any, to_last: Any
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Cotangents of the point, the direction, the radius and the length."""
    T = type(radius)
    zero, two = T(0), T(2)
    middle = -(along * ray_x + towards * ray_y)
    offset = along * ray_y - towards * ray_x
    inside = radius * radius - offset * offset
    soft = T(GRAZE) * radius
    root = math.sqrt(max(inside, zero) + soft * soft)
    half = root - soft
    to_first = to_first if middle > half else zero
    short = middle + half < length
    to_length = zero if short else to_last
    to_last = to_last if short else zero
    to_middle, to_half = to_first + to_last, to_last - to_first
    to_inside = to_half / (two * root)
    to_offset = -two * offset * to_inside
    return (
        to_offset * ray_y - to_middle * ray_x,
        -to_offset * ray_x - to_middle * ray_y,
        -to_offset * towards - to_middle * along,
        to_offset * along - to_middle * towards,
        two * radius * to_inside + T(GRAZE) * to_half * (soft / root - T(1)),
        to_length,
    )


@njit(forceinline=True, **OPTIONS)
def view_ray(to_x: Any, to_y: Any, ray_x: Any, ray_y: Any, reach: Any, far: Any, ortho: bool) -> tuple[Any, Any]:
    """Cotangents of reach and |x|."""
    T = type(reach)
    inverse = T(1) / math.sqrt(far * far + reach * reach)
    radial = ray_x * to_x + ray_y * to_y
    return (
        T(0) if ortho else (to_x - ray_x * radial) * inverse,
        T(0) if ortho else (ray_y * radial - to_y) * inverse,
    )


@njit(**OPTIONS)
def clear_taps(taps: Any) -> None:
    """Nothing has been handed to the taps yet."""
    for k in range(taps.shape[0]):
        tap = taps[k]
        for p in range(P):
            tap[t.TO_ALONG + p] = tap[t.TO_TOWARDS + p] = tap[t.TO_REACH + p] = taps.dtype.type(0)


@njit(**OPTIONS)
def unite(arcs: Any, pixel: Any, side: Any, count: int) -> None:
    """What counts is, with a plus, the last end of every gap-free run of arcs, and with a minus its first."""
    T = pixel.dtype.type
    zero, one = T(0), T(1)
    for p in range(P):
        side[CARRY + p] = one
    for i in range(count - 1, -1, -1):
        arc = arcs[i]
        for p in range(P):
            cot, last = pixel[COT + p], side[CARRY + p]
            low, high, reached = arc[a.LOW + p], arc[a.HIGH + p], arc[a.BEFORE + p]
            further = high > reached
            begins = further & (low >= reached)
            arc[a.TO_HIGH + p] = cot * last if further else zero
            arc[a.TO_LOW + p] = -cot if begins else zero
            side[CARRY + p] = one if begins else (zero if further else last)


@njit(**OPTIONS)
def sort_arcs(arcs: Any, ends: Any, count: int) -> None:
    """Into `ends` (count, 2 P), cotangents of low and high in the arcs' own places."""
    for i in range(count):
        arc = arcs[i]
        for p in range(P):
            place = np.intp(arc[a.PLACE + p])
            ends[place, p] = arc[a.TO_LOW + p]
            ends[place, P + p] = arc[a.TO_HIGH + p]


@njit(**OPTIONS)
def tap_arc(
    frame: Any, tap: Any, ends: Any, side: Any, pixel: Any, image: Any, sign: float, ortho: bool, by_cosine: bool
) -> None:
    T = pixel.dtype.type
    hand, thickness = T(sign), image[t.THICKNESS]
    bias_cosine, bias_sine = image[t.BIAS_COSINE], image[t.BIAS_SINE]
    thick = thickness < T(np.inf)
    zero = T(0)
    for p in range(P):
        along, towards = tap[t.ALONG + p], tap[t.TOWARDS + p]
        reach, far, radius = tap[t.REACH + p], frame[t.FAR + p], frame[t.RADIUS + p]
        facing, turned, length = frame[t.FACING + p], hand * frame[t.TURNED + p], frame[t.LENGTH + p]
        noise = frame[t.NOISE + p]
        ray_x, ray_y = a.view_ray(reach, far, ortho)
        span = thickness * radius
        first, last, hit = a.clip(along, towards, ray_x, ray_y, radius, span)
        hit = hit & (tap[t.SEEN + p] > zero)
        low, high = ends[p], ends[P + p]
        # Ends below the floor pull at it alike; what is not hit is as if it lay there.
        ha, ht, hf, hn, hv, hb = amount_at(
            high, along + first * ray_x, towards + first * ray_y, facing, turned, length, noise,
            bias_cosine, bias_sine, by_cosine,
        )  # fmt: skip
        la, lt, lf, ln, lv, lb = amount_at(
            low, along + last * ray_x, towards + last * ray_y, facing, turned, length, noise,
            bias_cosine, bias_sine, by_cosine,
        )  # fmt: skip
        ca, ct, cx, cy, cr, cl = clip(
            along, towards, ray_x, ray_y, radius, span, ha * ray_x + ht * ray_y, la * ray_x + lt * ray_y
        )
        to_reach, to_far = view_ray(
            cx + first * ha + last * la, cy + first * ht + last * lt, ray_x, ray_y, reach, far, ortho
        )
        tap[t.TO_ALONG + p] += ha + la + ca if hit else zero
        tap[t.TO_TOWARDS + p] += ht + lt + ct if hit else zero
        tap[t.TO_REACH + p] += to_reach if hit else zero
        pixel[FAR + p] += to_far if hit else zero
        pixel[RADIUS + p] += cr + (cl * thickness if thick else zero) if hit else zero
        pixel[THICKNESS + p] += cl * radius if hit else zero
        side[TO_FACING + p] += hf + lf if hit else zero
        side[TO_TURNED + p] += hn + ln if hit else zero
        side[TO_VIEW + p] += hv + lv if hit else zero
        side[TO_FLOOR + p] += hb + lb if hit else high + low


@njit(**OPTIONS)
def link_arc(
    frame: Any, tap: Any, before: Any, ends: Any, side: Any, pixel: Any, image: Any, start: bool, sign: float,
    by_cosine: bool,
) -> None:  # fmt: skip
    T = pixel.dtype.type
    hand, step, slope = T(sign), min(image[t.THICKNESS], T(LINK_STEP)), T(CONNECTED_SLOPE)
    bias_cosine, bias_sine = image[t.BIAS_COSINE], image[t.BIAS_SINE]
    one, zero = T(1), T(0)
    for p in range(P):
        along, towards = tap[t.ALONG + p], tap[t.TOWARDS + p]
        from_along = zero if start else before[t.ALONG + p]
        from_towards = zero if start else before[t.TOWARDS + p]
        seen_before = one if start else before[t.SEEN + p]
        facing, turned, length = frame[t.FACING + p], hand * frame[t.TURNED + p], frame[t.LENGTH + p]
        noise, radius = frame[t.NOISE + p], frame[t.RADIUS + p]
        across, rise = along - from_along, towards - from_towards
        same = a.joined(across, rise, tap[t.SEEN + p], seen_before, slope, step * radius, True)
        span = math.sqrt(across * across + rise * rise)
        across, rise = across / span, rise / span
        first, last, hit = a.clip(from_along, from_towards, across, rise, radius, span)
        hit = hit & same
        near_x, near_y = from_along + first * across, from_towards + first * rise
        far_x, far_y = from_along + last * across, from_towards + last * rise
        near, _ = a.amount_at(near_x, near_y, facing, turned, length, noise, bias_cosine, bias_sine, -one, by_cosine)
        far, _ = a.amount_at(far_x, far_y, facing, turned, length, noise, bias_cosine, bias_sine, -one, by_cosine)
        lower = start | (near <= far)
        to_near, to_far = (ends[p], ends[P + p]) if lower else (ends[P + p], ends[p])
        na, nt, nf, nn, nv, nb = amount_at(
            to_near, near_x, near_y, facing, turned, length, noise, bias_cosine, bias_sine, by_cosine
        )
        fa, ft, ff, fn, fv, fb = amount_at(
            to_far, far_x, far_y, facing, turned, length, noise, bias_cosine, bias_sine, by_cosine
        )
        if start:
            na, nt, nf, nn, nv, nb = zero, zero, zero, zero, zero, to_near
        ca, ct, cx, cy, cr, cl = clip(
            from_along, from_towards, across, rise, radius, span, na * across + nt * rise, fa * across + ft * rise
        )
        to_x, to_y = cx + first * na + last * fa, cy + first * nt + last * ft
        radial = across * to_x + rise * to_y
        to_x, to_y = (to_x - across * radial) / span + cl * across, (to_y - rise * radial) / span + cl * rise
        tap[t.TO_ALONG + p] += to_x if hit else zero
        tap[t.TO_TOWARDS + p] += to_y if hit else zero
        if not start:
            before[t.TO_ALONG + p] += na + fa + ca - to_x if hit else zero
            before[t.TO_TOWARDS + p] += nt + ft + ct - to_y if hit else zero
        pixel[RADIUS + p] += cr if hit else zero
        side[TO_FACING + p] += nf + ff if hit else zero
        side[TO_TURNED + p] += nn + fn if hit else zero
        side[TO_VIEW + p] += nv + fv if hit else zero
        side[TO_FLOOR + p] += nb + fb if hit else to_near + to_far


@njit(**OPTIONS)
def raise_horizon(
    frame: Any, tap: Any, before: Any, arc: Any, arc_before: Any, side: Any, pixel: Any, image: Any, start: bool,
    sign: float, ortho: bool, by_cosine: bool,
) -> None:  # fmt: skip
    """Taps come last to first: CARRY is what the later ones hand to the horizon that they start from.

    Row TO_HIGH of an arc is the cotangent of the tap's weight, row TO_LOW that of the share below the tap.
    """
    T = pixel.dtype.type
    hand, thickness = T(sign), image[t.THICKNESS]
    bias_cosine, bias_sine = image[t.BIAS_COSINE], image[t.BIAS_SINE]
    slope, step, one, zero, half = T(TRAPEZOID_SLOPE), T(TRAPEZOID_STEP), T(1), T(0), T(0.5)
    thick = thickness < T(np.inf)
    for p in range(P):
        along, towards = tap[t.ALONG + p], tap[t.TOWARDS + p]
        reach, far, radius = tap[t.REACH + p], frame[t.FAR + p], frame[t.RADIUS + p]
        facing, turned, length = frame[t.FACING + p], hand * frame[t.TURNED + p], frame[t.LENGTH + p]
        noise, cot, carry = frame[t.NOISE + p], pixel[COT + p], side[CARRY + p]
        across = along - (zero if start else before[t.ALONG + p])
        rise = towards - (zero if start else before[t.TOWARDS + p])
        seen, seen_before = tap[t.SEEN + p], one if start else before[t.SEEN + p]
        same = a.joined(across, rise, seen, seen_before, slope, step * radius, False)
        weight = arc[a.PLACE + p]
        earlier = one if start else arc_before[a.PLACE + p]
        low, high = arc[a.LOW + p], arc[a.HIGH + p]
        reached = arc[a.BEFORE + p]
        mean = half * ((earlier if same else weight) + weight) * cot
        raised, from_back = high > reached, low > reached
        counts = raised & (low < high)
        to_front = (mean if counts else zero) + carry if raised else zero
        to_back = -mean if counts & from_back else zero
        keep = zero if from_back else (-mean if counts else zero)
        side[CARRY + p] = keep if raised else carry
        to_weight = half * cot * (high - low)
        arc[a.TO_HIGH + p] += to_weight if same else to_weight + to_weight
        if not start:
            arc_before[a.TO_HIGH + p] += to_weight if same else zero
        fa, ft, ff, fn, fv, _ = amount_at(
            to_front, along, towards, facing, turned, length, noise, bias_cosine, bias_sine, by_cosine
        )
        ray_x, ray_y = a.view_ray(reach, far, ortho)
        depth = thickness * radius if thick else zero
        ba, bt, bf, bn, bv, _ = amount_at(
            to_back, along + depth * ray_x, towards + depth * ray_y, facing, turned, length, noise,
            bias_cosine, bias_sine, by_cosine,
        )  # fmt: skip
        to_depth = ba * ray_x + bt * ray_y
        to_reach, to_far = view_ray(depth * ba, depth * bt, ray_x, ray_y, reach, far, ortho)
        pulled = to_back != zero
        ba, bt, bf, bn, bv = (ba, bt, bf, bn, bv) if pulled else (zero, zero, zero, zero, zero)
        tap[t.TO_ALONG + p] += (fa if raised else zero) + ba
        tap[t.TO_TOWARDS + p] += (ft if raised else zero) + bt
        tap[t.TO_REACH + p] += to_reach if pulled else zero
        pixel[FAR + p] += to_far if pulled else zero
        pixel[RADIUS + p] += to_depth * thickness if pulled else zero
        pixel[THICKNESS + p] += to_depth * radius if pulled else zero
        side[TO_FACING + p] += (ff if raised else zero) + bf
        side[TO_TURNED + p] += (fn if raised else zero) + bn
        side[TO_VIEW + p] += (fv if raised else zero) + bv


@njit(**OPTIONS)
def weigh_tap(frame: Any, tap: Any, arc: Any, pixel: Any, image: Any) -> None:
    T = pixel.dtype.type
    falloff, one, zero = image[t.FALLOFF], T(1), T(0)
    least = T(DISTANCE_FLOOR) if falloff < one else zero
    tiny = T(np.finfo(T).tiny)
    for p in range(P):
        grad, radius = arc[a.TO_HIGH + p], frame[t.RADIUS + p]
        along, towards = tap[t.ALONG + p], tap[t.TOWARDS + p]
        length = math.sqrt(along * along + towards * towards)
        distance = length / radius
        near = (distance < one) & (tap[t.SEEN + p] > zero)
        to_distance = -falloff * power(max(distance, least), falloff - one) * grad
        to_falloff = -power(distance, falloff) * logarithm(max(distance, tiny)) * grad
        to_length = to_distance / radius
        tap[t.TO_ALONG + p] += to_length * along / length if near else zero
        tap[t.TO_TOWARDS + p] += to_length * towards / length if near else zero
        pixel[RADIUS + p] -= to_length * distance if near else zero
        pixel[FALLOFF + p] += to_falloff if near else zero


@njit(**OPTIONS)
def set_side(frame: Any, side: Any, pixel: Any, image: Any, sign: float, by_cosine: bool) -> None:
    """Hand on what the side has gathered: the floor to the bias and the normal, the view angle to the normal."""
    T = pixel.dtype.type
    bias, hand, half, zero = image[t.BIAS], T(sign), T(0.5), T(0)
    sine, cosine = image[t.BIAS_SINE], image[t.BIAS_COSINE]
    to_facing, to_turned = half * sine * sine, half * (bias - cosine * sine)
    for p in range(P):
        facing, turned, length = frame[t.FACING + p], hand * frame[t.TURNED + p], frame[t.LENGTH + p]
        floor = side[TO_FLOOR + p]
        into = (cosine * facing + sine * turned) * (sine if by_cosine else half / length)
        view = side[TO_VIEW + p] + (zero if by_cosine else floor * (into - half * facing / length))
        square = length * length
        pixel[BIAS + p] += floor * into
        pixel[FACING + p] += side[TO_FACING + p] + (floor * to_facing if by_cosine else zero) + view * turned / square
        pixel[TURNED + p] += hand * (
            side[TO_TURNED + p] + (floor * to_turned if by_cosine else zero) - view * facing / square
        )
