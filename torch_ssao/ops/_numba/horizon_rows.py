"""Obscurance of some rows of an image: the loops over pixels, slices, sides and taps around `taps` and `arcs`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from torch_ssao.ops._numba import arcs as a
from torch_ssao.ops._numba import arcs_back as ab
from torch_ssao.ops._numba import taps as t
from torch_ssao.ops._numba import taps_back as tb
from torch_ssao.ops._numba.maths import LANES, OPTIONS, entry

P = LANES
# Whole numbers and flags of a question.
IMAGE, SLICES, STEPS, ORTHO, EXTEND, COSINE, INCREMENTS, CONNECTED, CAPPED = range(9)


@njit(**OPTIONS)
def find_taps(
    frame: Any, taps: Any, source: Any, texels: Any, pyramid: Any, form: Any, number: int, side: int,
    step_power: float, spread: float, row: int, height: int, width: int,
) -> None:  # fmt: skip
    """Taps of a side of a slice."""
    ortho = form[ORTHO] != 0
    pixel, start, cap = pyramid
    for k in range(form[STEPS]):
        t.place_tap(
            frame, taps[k], source[k], k, form[STEPS], side, number, step_power, spread, row, height, width,
            form[EXTEND] != 0,
        )  # fmt: skip
        if form[CAPPED] != 0:
            t.climb_pyramid(frame, taps[k], source[k], pixel, start, cap, form[IMAGE], row, height, width)
        t.fetch(taps[k], source[k], texels)
        t.meet_plane(frame, taps[k], ortho)


@njit(**OPTIONS)
def find_arcs(frame: Any, taps: Any, arcs: Any, sums: Any, image: Any, network: Any, form: Any, side: int) -> None:
    """Add to the total what the taps of a side occlude; arcs are left sorted (bitmask) or by tap (increments)."""
    steps, ortho, cosine, sign = form[STEPS], form[ORTHO] != 0, form[COSINE] != 0, 1.0 - 2.0 * side
    a.set_side(frame, sums, image, sign, cosine)
    if form[INCREMENTS] != 0:
        for k in range(steps):
            before = k - 1 if k else steps
            a.weigh_tap(frame, taps[k], arcs[k], image)
            a.raise_horizon(
                frame, taps[k], taps[before], arcs[k], arcs[before], sums, image, k == 0, sign, ortho, cosine
            )
        return
    for k in range(steps):
        a.tap_arc(frame, taps[k], arcs[k], sums, image, k, sign, ortho, cosine)
        if form[CONNECTED] != 0:
            before, place = k - 1 if k else steps, steps + k
            a.link_arc(frame, taps[k], taps[before], arcs[place], sums, image, place, k == 0, sign, cosine)
    a.sort_arcs(arcs, network)
    a.unite(arcs, sums, 2 * steps if form[CONNECTED] != 0 else steps)


@njit(**OPTIONS)
def scratch(like: Any, form: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Rows that the loops work on. What comes before the first tap is a row of its own: a loop over rows that may be one
    and the same does not vectorise."""
    steps = form[STEPS]
    frame, sums = np.zeros(t.FRAME_SIZE, like.dtype), np.zeros(a.SUM_SIZE, like.dtype)
    taps = np.zeros((steps + 1, t.TAP_SIZE), like.dtype)
    arcs = np.zeros((2 * steps + 1, a.ARC_SIZE), like.dtype)
    return frame, taps, arcs, sums, np.zeros((steps, P), np.int32)


@njit(**OPTIONS)
def add_slices(
    work: Any, texels: Any, image: Any, network: Any, pyramid: Any, form: Any, step_power: float, spread: float, row: int,
    height: int, width: int,
) -> None:  # fmt: skip
    """Obscurance of the pixels in `frame`, times the number of slices, into the row TOTAL."""
    frame, taps, arcs, sums, source = work
    sums[a.TOTAL : a.TOTAL + P] = sums.dtype.type(0)
    for number in range(form[SLICES]):
        t.set_slice(frame, image, number, form[SLICES], form[ORTHO] != 0)
        for side in range(2):
            find_taps(frame, taps, source, texels, pyramid, form, number, side, step_power, spread, row, height, width)
            find_arcs(frame, taps, arcs, sums, image, network, form, side)


@entry
def rows_value(
    out: Any, texels: Any, normal: Any, rotation: Any, offset: Any, image: Any, network: Any, pyramid: Any, form: Any,
    step_power: float, first_row: int, last_row: int,
) -> None:  # fmt: skip
    """Obscurance (H, W) of the rows [first_row, last_row) of an image.

    Args:
        texels: (4 H W) plane of every pixel, 0 where invalid, and its own level.
        normal: (3, H, W). rotation, offset, out: (H, W). image: `taps.IMAGE_NUMBERS` of them. form: see above.
        network: (N, 2) pairs to sort. pyramid: pixel, start and cap.
    """
    height, width = out.shape
    T = out.dtype.type
    work = scratch(out, form)
    frame, _, _, sums, _ = work
    share = T(1) / T(form[SLICES])
    for row in range(first_row, last_row):
        for first in range(0, width, P):
            t.set_pixels(frame, image, texels, normal, rotation, offset, row, first, form[ORTHO] != 0)
            add_slices(work, texels, image, network, pyramid, form, step_power, 1.0, row, height, width)
            for p in range(min(P, width - first)):
                out[row, first + p] = sums[a.TOTAL + p] * share


@njit(**OPTIONS)
def take_back_arcs(
    frame: Any, taps: Any, arcs: Any, ends: Any, side_sums: Any, pixel: Any, image: Any, form: Any, side: int
) -> None:
    """Cotangents of the taps of a side, of its slice and its pixels, from what `find_arcs` has left."""
    steps, ortho, cosine, sign = form[STEPS], form[ORTHO] != 0, form[COSINE] != 0, 1.0 - 2.0 * side
    ab.clear_taps(taps)
    side_sums[:] = side_sums.dtype.type(0)
    if form[INCREMENTS] != 0:
        arcs[:, a.TO_HIGH : a.TO_HIGH + P] = arcs.dtype.type(0)
        for k in range(steps - 1, -1, -1):
            before = k - 1 if k else steps
            ab.raise_horizon(
                frame,
                taps[k],
                taps[before],
                arcs[k],
                arcs[before],
                side_sums,
                pixel,
                image,
                k == 0,
                sign,
                ortho,
                cosine,
            )
            ab.weigh_tap(frame, taps[k], arcs[k], pixel, image)
        side_sums[ab.TO_FLOOR : ab.TO_FLOOR + P] = side_sums[ab.CARRY : ab.CARRY + P]
    else:
        count = 2 * steps if form[CONNECTED] != 0 else steps
        ab.unite(arcs, pixel, side_sums, count)
        ab.sort_arcs(arcs, ends, count)
        for k in range(steps):
            ab.tap_arc(frame, taps[k], ends[k], side_sums, pixel, image, sign, ortho, cosine)
            if form[CONNECTED] != 0:
                before, place = k - 1 if k else steps, steps + k
                ab.link_arc(frame, taps[k], taps[before], ends[place], side_sums, pixel, image, k == 0, sign, cosine)
    ab.set_side(frame, side_sums, pixel, image, sign, cosine)


@njit(**OPTIONS)
def take_back_slices(
    work: Any, back: Any, to_texels: Any, reached: Any, texels: Any, image: Any, network: Any, pyramid: Any, form: Any,
    step_power: float, row: int, height: int, width: int,
) -> None:  # fmt: skip
    """Cotangents of the pixels in `frame`, and of what they read."""
    frame, taps, arcs, sums, source = work
    pixel, side_sums, ends = back
    for number in range(form[SLICES]):
        t.set_slice(frame, image, number, form[SLICES], form[ORTHO] != 0)
        for side in range(2):
            find_taps(frame, taps, source, texels, pyramid, form, number, side, step_power, 1.0, row, height, width)
            find_arcs(frame, taps, arcs, sums, image, network, form, side)
            take_back_arcs(frame, taps, arcs, ends, side_sums, pixel, image, form, side)
            for k in range(form[STEPS]):
                tb.meet_plane(frame, taps[k], pixel, form[ORTHO] != 0)
                tb.fetch(taps[k], source[k], to_texels, reached)
        tb.set_slice(frame, pixel, image, form[ORTHO] != 0)


@entry
def rows_pull_back(
    cotangent: Any, to_texels: Any, reached: Any, to_normal: Any, to_image: Any, texels: Any, normal: Any, rotation: Any,
    offset: Any, image: Any, network: Any, pyramid: Any, form: Any, step_power: float, step: float, first_row: int,
    last_row: int,
) -> None:  # fmt: skip
    """Add the cotangents of some rows of an image: `rows_value` names the arguments.

    Args:
        cotangent: (H, W). to_texels: (3 H W), of which the pixels from reached[0] to reached[1], set here, are written to.
        to_normal: (3, H, W). to_image: (8) float64.
        step: of the footprint, over which its effect is differenced; 0: not at all.
    """
    height, width = cotangent.shape
    T = cotangent.dtype.type
    work = scratch(cotangent, form)
    frame, _, _, sums, _ = work
    pixel, side_sums = np.zeros(ab.PIXEL_SIZE, cotangent.dtype), np.zeros(ab.SIDE_SIZE, cotangent.dtype)
    ends, change = np.zeros((2 * form[STEPS], 2 * P), cotangent.dtype), np.zeros(P, cotangent.dtype)
    share, ortho = T(1) / T(form[SLICES]), form[ORTHO] != 0
    reached[0], reached[1] = first_row * width, last_row * width - 1
    for row in range(first_row, last_row):
        for first in range(0, width, P):
            t.set_pixels(frame, image, texels, normal, rotation, offset, row, first, ortho)
            pixel[:] = T(0)
            for p in range(min(P, width - first)):
                pixel[ab.COT + p] = cotangent[row, first + p] * share
            if step > 0:
                add_slices(work, texels, image, network, pyramid, form, step_power, 1 - step, row, height, width)
                change[:] = -sums[a.TOTAL : a.TOTAL + P]
                add_slices(work, texels, image, network, pyramid, form, step_power, 1 + step, row, height, width)
                for p in range(P):
                    change[p] = (change[p] + sums[a.TOTAL + p]) / T(2 * step)
                tb.spread(frame, pixel, image, to_image, to_texels, change, row, first, width, ortho)
            take_back_slices(
                work, (pixel, side_sums, ends), to_texels, reached, texels, image, network, pyramid, form,
                step_power, row, height, width,
            )  # fmt: skip
            tb.set_pixels(frame, pixel, image, to_image, to_texels, to_normal, row, first, ortho)


@entry
def hand_over(total: Any, part: Any, reached: Any) -> None:
    """Add a block's cotangents of the planes to the image's, and clear them."""
    for i in range(3 * reached[0], 3 * (reached[1] + 1)):
        total[i] += part[i]
        part[i] = part.dtype.type(0)
