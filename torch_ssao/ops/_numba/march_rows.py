"""Visibility of some rows of an image: the loops over pixels, rays, steps and layers around `march`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from torch_ssao.ops._numba import march as m
from torch_ssao.ops._numba import march_back as mb
from torch_ssao.ops._numba.maths import LANES, OPTIONS, entry

P = LANES
# Whole numbers and flags of a question.
IMAGE, STEPS, LAYERS, ORTHO, CAPPED = range(5)


@njit(**OPTIONS)
def cast_ray(
    work: Any, number: int, disk: Any, image: Any, stored: Any, pyramid: Any, form: Any, start: int, height: int,
    width: int,
) -> None:  # fmt: skip
    """March ray `number` of the pixels in `work` to its first hit, or out of the image."""
    ray, plane, source = work
    steps, ortho = form[STEPS], form[ORTHO] != 0
    m.set_ray(ray, source, disk[number, 0], disk[number, 1], disk.shape[0])
    for step in range(1, steps + 1):
        m.step_to(ray, source, image, step, steps, height, width, ortho)
        if form[CAPPED] != 0:
            m.climb_pyramid(ray, source, image, pyramid, form[IMAGE], start, height, width, ortho)
        for layer in range(form[LAYERS]):
            m.fetch(plane, source, m.HERE, stored, layer, form[LAYERS])
            m.meet_layer(ray, plane, layer, ortho)
        if m.settle(ray, source, step) == 0:
            break
    m.finish_ray(ray, image, steps)


@njit(**OPTIONS)
def cast_rays(
    work: Any, spread: float, tensors: Any, disk: Any, image: Any, stored: Any, pyramid: Any, form: Any, start: int,
    stop: int, height: int, width: int,
) -> None:  # fmt: skip
    """Rows TOTAL and WEIGHT of the flat pixels [start, stop) of a row."""
    position, normal, reach, rotation, offset = tensors
    m.set_pixels(work[0], image, position, normal, reach, rotation, offset, start, stop, spread)
    for number in range(disk.shape[0]):
        cast_ray(work, number, disk, image, stored, pyramid, form, start, height, width)


@njit(**OPTIONS)
def scratch(like: Any) -> tuple[Any, Any, Any]:
    """Rows that the loops work on."""
    return np.zeros(m.RAY_SIZE, like.dtype), np.zeros(m.PLANE_SIZE, like.dtype), np.zeros(m.SOURCE_SIZE, np.int32)


@njit(forceinline=True, **OPTIONS)
def visibility_of(ray: Any, known: Any, p: int) -> tuple[Any, Any]:
    """Of a lane: the mean of its rays and their weight; open, with a weight without end, where nothing was seen."""
    T = ray.dtype.type
    weight = ray[m.WEIGHT + p]
    if known and weight > T(0):
        return ray[m.TOTAL + p] / max(weight, T(1e-6)), weight
    return T(1), T(np.inf)


@entry
def rows_value(
    out: Any, weights: Any, known: Any, tensors: Any, disk: Any, image: Any, stored: Any, pyramid: Any, form: Any,
    height: int, width: int, first_row: int, last_row: int,
) -> None:  # fmt: skip
    """Visibility and weights (H W) of the rows [first_row, last_row) of an image.

    Args:
        known: (H W) bool, of the nearest layer. tensors: position (3, H W), normal (3, H W), reach, rotation, offset (H W).
        disk: (K, 2). image: `march.IMAGE_NUMBERS` of them. stored: (H W L 4) planes, offset -inf where invalid.
        pyramid: pixel, start and cap. form: see above.
    """
    work = scratch(out)
    for row in range(first_row, last_row):
        for first in range(0, width, P):
            start, stop = row * width + first, (row + 1) * width
            cast_rays(work, 1.0, tensors, disk, image, stored, pyramid, form, start, stop, height, width)
            for p in range(min(P, width - first)):
                out[start + p], weights[start + p] = visibility_of(work[0], known[start + p], p)


@njit(**OPTIONS)
def take_back_rays(
    work: Any, back: Any, to_stored: Any, reached: Any, disk: Any, image: Any, stored: Any, pyramid: Any, form: Any,
    start: int, height: int, width: int,
) -> None:  # fmt: skip
    """Cotangents of the pixels in `work`, and of the planes that bound their hits."""
    ray, plane, source = work
    steps, layers, ortho = form[STEPS], form[LAYERS], form[ORTHO] != 0
    for number in range(disk.shape[0]):
        cast_ray(work, number, disk, image, stored, pyramid, form, start, height, width)
        mb.finish_ray(ray, back, image, steps)
        mb.fetch_nearest(plane, source, m.BEFORE, ray, m.LAYER_BEFORE, stored, layers)
        mb.meet_layer(ray, plane, back, mb.TO_BEFORE, 1, steps, ortho)
        mb.add_nearest(plane, source, m.BEFORE, ray, m.LAYER_BEFORE, to_stored, layers, reached)
        mb.fetch_nearest(plane, source, m.BEHIND, ray, m.LAYER_BEHIND, stored, layers)
        mb.meet_layer(ray, plane, back, mb.TO_BEHIND, 0, steps, ortho)
        mb.add_nearest(plane, source, m.BEHIND, ray, m.LAYER_BEHIND, to_stored, layers, reached)
        mb.set_ray(ray, back)


@entry
def rows_pull_back(
    cotangent: Any, weights: Any, step: float, to_stored: Any, reached: Any, to_pixels: Any, to_falloff: Any,
    known: Any, tensors: Any, disk: Any, image: Any, stored: Any, pyramid: Any, form: Any, height: int, width: int,
    first_row: int, last_row: int,
) -> None:  # fmt: skip
    """Add the cotangents of some rows of an image: `rows_value` names the arguments.

    Args:
        cotangent, weights: (H W). step: of the reach, over which its effect is differenced; 0: not at all.
        to_stored: (H W L 4), of which the pixels from reached[0] to reached[1], set here, are written to.
        to_pixels: (7, H W) of position, normal and reach. to_falloff: (1) float64.
    """
    T = cotangent.dtype.type
    work = scratch(cotangent)
    position, normal, reach, rotation, offset = tensors
    back, nearer = np.zeros(mb.BACK_SIZE, cotangent.dtype), np.zeros(P, cotangent.dtype)
    reached[0], reached[1] = first_row * width, last_row * width - 1
    for row in range(first_row, last_row):
        for first in range(0, width, P):
            start, stop, count = row * width + first, (row + 1) * width, min(P, width - first)
            if step > 0:
                cast_rays(work, 1 - step, tensors, disk, image, stored, pyramid, form, start, stop, height, width)
                for p in range(count):
                    nearer[p], _ = visibility_of(work[0], known[start + p], p)
                cast_rays(work, 1 + step, tensors, disk, image, stored, pyramid, form, start, stop, height, width)
                for p in range(count):
                    further, _ = visibility_of(work[0], known[start + p], p)
                    by_reach = (further - nearer[p]) / (T(2 * step) * reach[start + p])
                    to_pixels[6, start + p] = cotangent[start + p] * by_reach
            m.set_pixels(work[0], image, position, normal, reach, rotation, offset, start, stop, 1.0)
            back[:] = T(0)
            for p in range(count):
                back[mb.COT + p] = cotangent[start + p] / weights[start + p]
            take_back_rays(work, back, to_stored, reached, disk, image, stored, pyramid, form, start, height, width)
            for p in range(count):
                for axis in range(6):
                    to_pixels[axis, start + p] = back[mb.PX + axis * P + p]
                if step == 0:
                    to_pixels[6, start + p] = back[mb.REACH + p]
                to_falloff[0] += back[mb.FALLOFF + p]


@entry
def hand_over(total: Any, part: Any, reached: Any, size: int) -> None:
    """Add a block's cotangents of `size` numbers a pixel to the image's, and clear them."""
    for i in range(size * reached[0], size * (reached[1] + 1)):
        total[i] += part[i]
        part[i] = part.dtype.type(0)
