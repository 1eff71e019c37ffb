"""Taps of horizon-based techniques: where a slice of directions through a pixel meets the surfaces of the depth map.

A slice is a plane that holds the eye and the pixel's point x, so it is a straight line in the image, and everything in it is
two-dimensional: a tap is (along, towards), its offset from x along the slice's direction and towards the eye.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ssao.ops.depth_pyramid import Pyramid, furthest_read, pixels_of, texels_at
from torch_ssao.ops.sampling import GOLDEN

SLOPE_LIMIT = 64.0  # a depth step of more pixel footprints than this a pixel is an edge, not a slope (89.1 degrees)
WIDEST = 0.9  # of |x|: the radius up to which the footprint of the whole sphere, not of its equator, is sampled
HORIZON = 1e-3  # of 1/z at the texel's centre: a plane seen at less is past its horizon
NEAREST = 0.05  # a tap ray that meets the slice's line this close to the eye's plane is left out


class Layout(NamedTuple):
    """How the taps of a pixel are laid out; none of it is differentiable."""

    slices: int
    steps: int
    step_power: float
    orthographic: bool
    max_radius_px: float | None  # taps further away read a coarser level of the depth pyramid
    extend: bool  # taps off the image read the nearest pixel's plane

    @property
    def longest_px(self) -> float | None:
        """Pixels to which the radius is shortened; None: never."""
        return furthest_read(self.max_radius_px)


class Pixels(NamedTuple):
    """Flat pixels (P,) and the slices (S,) to be looked at; integers and noise, none of it differentiable."""

    image: Tensor  # batch index
    column: Tensor
    row: Tensor
    angle: Tensor  # (S, P) of the slice about the view direction
    share: Tensor  # (S, 2, K, P) of the taps' distance, in (0, 1]


class Frame(NamedTuple):
    """The slices of the pixels, differentiable; (P,) or (S, P)."""

    distance: Tensor | None  # |x|; None for parallel rays
    radius: Tensor
    depth: Tensor
    facing: Tensor  # n . v
    turned: Tensor  # n . t, t the slice's direction
    step_x: Tensor  # image offset along the slice, in pixels per unit of length at x
    step_y: Tensor
    recession: Tensor | None  # t_z / z: how fast the slice's line recedes


class Taps(NamedTuple):
    """(S, 2, K, P)"""

    along: Tensor
    towards: Tensor
    reach: Tensor  # distance along t at x, before the ray meets the surface
    seen: Tensor  # bool: on the image, valid


def surface_planes(depth: Tensor, valid: Tensor, focal: Tensor, *, orthographic: bool) -> Tensor:
    """Plane through every pixel's point, as 1/z (orthographic: z) at the pixel's centre and its slopes along x and y.

    Both are linear in the image on a plane. Of the differences to the two neighbours the smaller one is the slope, so a
    plane never bridges foreground and background; across an isolated pixel, or a step steeper than `SLOPE_LIMIT`
    footprints, it faces the eye.

    Args:
        depth: (B, H, W) view-space z, > 0 where valid, finite elsewhere.
        valid: (B, H, W) bool.
        focal: (B, 2) fx, fy in pixels (orthographic: pixels per scene unit).
        orthographic: parallel rays.
    Returns: (B, 3, H, W).
    Gradients: to depth, by plain autograd; the choice of neighbours is non-differentiable.
    Cost: about 20 passes over memory.
    """
    level = depth if orthographic else 1 / torch.where(valid, depth, 1.0)
    limit = SLOPE_LIMIT / focal.detach()
    slopes = []
    for axis, steepest in ((2, limit[:, 0]), (1, limit[:, 1])):
        most = steepest[:, None, None] if orthographic else steepest[:, None, None] * level.detach()
        slopes.append(_slope(level, valid, axis, most))
    return torch.stack((level, *slopes), 1)


def _slope(level: Tensor, valid: Tensor, axis: int, limit: Tensor) -> Tensor:
    size = level.shape[axis]
    step = level.narrow(axis, 1, size - 1) - level.narrow(axis, 0, size - 1)
    both = valid.narrow(axis, 1, size - 1) & valid.narrow(axis, 0, size - 1)
    edge = list(level.shape)
    edge[axis] = 1
    far, zero = step.new_full(edge, torch.inf), step.new_zeros(edge)
    gap = torch.where(both, step.detach().abs(), torch.inf)
    gap_after, gap_before = torch.cat((gap, far), axis), torch.cat((far, gap), axis)
    chosen = torch.where(gap_after <= gap_before, torch.cat((step, zero), axis), torch.cat((zero, step), axis))
    return torch.where(torch.minimum(gap_after, gap_before) <= limit, chosen, 0.0)


def make_pixels(
    start: int, stop: int, slices: range, layout: Layout, size: tuple[int, int], rotation: Tensor, offset: Tensor
) -> Pixels:
    """Noise and coordinates of the flat pixels [start, stop) of a batch of images.

    Args:
        rotation, offset: (H, W) noise in [0, 1).
    """
    height, width = size
    flat = torch.arange(start, stop, device=rotation.device)
    row, column = flat // width % height, flat % width
    number = torch.tensor(list(slices), device=flat.device, dtype=rotation.dtype)
    angle = (number[:, None] + rotation[row, column]) * (math.pi / layout.slices)
    side = torch.arange(2, device=flat.device, dtype=rotation.dtype)
    shift = (2 * number[:, None] + side) * GOLDEN
    jitter = (offset[row, column] + shift[:, :, None]) % 1.0
    step = torch.arange(layout.steps, device=flat.device, dtype=rotation.dtype)
    share = ((step[:, None] + jitter[:, :, None]) / layout.steps) ** layout.step_power
    return Pixels(flat // (height * width), column, row, angle, share)


def make_frame(
    level: Tensor, normal: Tensor, intrinsics: Tensor, radius: Tensor, pixels: Pixels, layout: Layout
) -> Frame:
    """Slices of the pixels.

    Args:
        level: (P,) 1/z (orthographic: z). normal: (3, P). intrinsics: (B, 4) fx, fy, cx, cy. radius: (B,).
    """
    fx, fy, cx, cy = intrinsics[pixels.image].unbind(1)
    radius = radius[pixels.image]
    depth = level if layout.orthographic else 1 / level
    if layout.longest_px is not None:
        unit = torch.maximum(fx, fy)
        radius = torch.minimum(radius, layout.longest_px / unit * (1.0 if layout.orthographic else depth))
    cosine, sine = pixels.angle.cos(), pixels.angle.sin()
    if layout.orthographic:
        turned = cosine * normal[0] + sine * normal[1]
        return Frame(None, radius, depth, -normal[2], turned, fx * cosine, fy * sine, None)
    x, y = (pixels.column + 0.5 - cx) / fx, (pixels.row + 0.5 - cy) / fy
    stretch = (1 + x * x + y * y).sqrt()
    a, b, c = x / stretch, y / stretch, 1 / stretch  # from the eye to x
    direction = _slice_direction(a, b, c, cosine, sine)
    turned = direction[0] * normal[0] + direction[1] * normal[1] + direction[2] * normal[2]
    facing = -(a * normal[0] + b * normal[1] + c * normal[2])
    return Frame(
        depth * stretch,
        radius,
        depth,
        facing,
        turned,
        fx * (direction[0] - x * direction[2]) / depth,
        fy * (direction[1] - y * direction[2]) / depth,
        direction[2] / depth,
    )


def slice_axes(intrinsics: Tensor, pixels: Pixels, layout: Layout) -> tuple[Tensor, Tensor]:
    """Unit directions towards the eye (3, P) and along the slices (3, S, P)."""
    cosine, sine = pixels.angle.cos(), pixels.angle.sin()
    zero = torch.zeros_like(cosine)
    if layout.orthographic:
        return torch.stack((zero[0], zero[0], zero[0] - 1)), torch.stack((cosine, sine, zero))
    fx, fy, cx, cy = intrinsics[pixels.image].unbind(1)
    x, y = (pixels.column + 0.5 - cx) / fx, (pixels.row + 0.5 - cy) / fy
    stretch = (1 + x * x + y * y).sqrt()
    a, b, c = x / stretch, y / stretch, 1 / stretch
    return -torch.stack((a, b, c)), torch.stack(_slice_direction(a, b, c, cosine, sine))


class Texels(NamedTuple):
    """Which texel each tap reads, (S, 2, K, P); none of it is differentiable."""

    pixels: Tensor  # away along the slice's major image axis, >= 1
    column: Tensor
    row: Tensor
    source: Tensor  # index into the flattened batch, or into the texels of the pyramid
    seen: Tensor  # bool: exists and is valid


def find_texels(
    frame: Frame, pixels: Pixels, valid: Tensor, spread: float, *, extend: bool, pyramid: Pyramid | None = None
) -> Texels:
    """Round the taps to whole pixels along the major axis.

    Args:
        valid: (B, H, W) bool.
        spread: factor on the taps' distances. extend: see `Layout`.
        pyramid: of which a tap takes the level of its distance; it meets the plane of the pixel that is found there.
    """
    _, height, width = valid.shape
    longest = frame.radius
    if frame.distance is not None:  # the sphere of radius R is wider in the image than its equator
        part = (frame.radius / frame.distance).clamp(max=WIDEST)
        longest = longest * (1 - part * part).rsqrt()
    reach = longest * pixels.share * spread
    if frame.recession is not None:
        signed = _sides(reach) * reach
        reach = reach / (1 + signed * frame.recession[:, None, None]).clamp(min=NEAREST)
    major = torch.maximum(frame.step_x.abs(), frame.step_y.abs())
    furthest = float(max(height, width))  # beyond it every tap is off the image
    count = (reach * major[:, None, None]).round().clamp(1.0, furthest)
    _, offset_x, offset_y, away = _place(frame, count)
    column = (pixels.column + 0.5 + offset_x).floor()
    row = (pixels.row + 0.5 + offset_y).floor()
    if extend:
        column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
    seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    if away is not None:
        seen = seen & (away > NEAREST) & (away < 1 / NEAREST)
    column, row = (torch.where(seen, texel, 0).long() for texel in (column, row))
    if pyramid is None:
        source = (pixels.image * height + row) * width + column
        return Texels(count, column, row, source, seen & valid.reshape(-1)[source])
    source = texels_at(pyramid, pixels.image, row, column, count)
    pixel = pixels_of(pyramid, source)
    return Texels(count, pixel % width, pixel // width % height, source, seen & valid.reshape(-1)[pixel])


def meet_surface(frame: Frame, pixels: Pixels, texels: Texels, planes: Tensor) -> Taps:
    """Where the tap rays meet the planes of their texels.

    Args:
        planes: (3, S, 2, K, P) `surface_planes` at the texels.
    """
    reach, offset_x, offset_y, away = _place(frame, texels.pixels)
    inside_x = pixels.column + offset_x - texels.column
    inside_y = pixels.row + offset_y - texels.row
    level = planes[0] + planes[1] * inside_x + planes[2] * inside_y
    if away is None or frame.distance is None:
        return Taps(reach, frame.depth - level, reach, texels.seen)
    seen = texels.seen & (level > HORIZON * planes[0])  # beyond, the tap's ray misses the plane
    reach, away = torch.where(seen, reach, 1.0), torch.where(seen, away, 1.0)
    scale = 1 / torch.where(seen, level * frame.depth * away, 1.0)
    return Taps(scale * reach, (1 - scale) * frame.distance, reach, seen)


def _slice_direction(a: Tensor, b: Tensor, c: Tensor, cosine: Tensor, sine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(cosine, sine, 0) carried from the view direction z to (a, b, c) by the shortest turn."""
    mixed = -a * b / (1 + c)
    return (
        cosine * (1 - a * a / (1 + c)) + sine * mixed,
        cosine * mixed + sine * (1 - b * b / (1 + c)),
        -cosine * a - sine * b,
    )


def _sides(like: Tensor) -> Tensor:
    return like.new_tensor([1.0, -1.0]).view(2, 1, 1)


def _place(frame: Frame, count: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Reach along the slice, image offset (x, y) in pixels and recession of the taps some whole pixels away."""
    major = torch.maximum(frame.step_x.abs(), frame.step_y.abs())
    shrunk = _sides(count) * count / major[:, None, None]
    offset_x, offset_y = shrunk * frame.step_x[:, None, None], shrunk * frame.step_y[:, None, None]
    if frame.recession is None:
        return shrunk.abs(), offset_x, offset_y, None
    left = 1 - shrunk * frame.recession[:, None, None]
    left = torch.where(left > NEAREST, left, NEAREST)
    return (shrunk / left).abs(), offset_x, offset_y, 1 / left
