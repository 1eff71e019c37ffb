"""Arcs of a slice: how much of the hemisphere lies below an elevation, and what taps occlude of it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ssao.ops.falloff import attenuation
from torch_ssao.ops.horizon_taps import Frame, Taps

ROUNDING = 4.0  # heights over the tangent plane below this many units of rounding of |x| are 0
# Neighbouring taps are one surface up to this depth step per step across; found on six views of the built-in scenes, of 3, 6, 12.
CONNECTED_SLOPE = 3.0  # to cover the arc between them
# Depth steps below this share of R, and at most the thickness, are one surface at any slope, so that dense taps on surfaces seen
# at 80 degrees, or from below, converge; of 0.1, 0.25, 0.5 on analytic scenes.
LINK_STEP = 0.25
TRAPEZOID_SLOPE = 6.0  # to average their attenuations; 12 and 24 put halos on walls two radii behind a pillar
TRAPEZOID_STEP = 0.25  # as LINK_STEP
GRAZE = 1e-3  # of R: rounds off the corner where a ray touches the sphere, so that derivatives stay bounded


class Measure(NamedTuple):
    """One side of a slice: elevations count from the tangent plane towards the eye."""

    facing: Tensor  # (S, 1, 1, P): n . v and, by side, n . t in the slice
    turned: Tensor  # (S, 2, 1, P)
    length: Tensor  # (S, 1, 1, P) of the projected normal
    view: Tensor  # (S, 2, 1, P): pi / 2 minus the elevation of the view direction
    rounding: Tensor  # (S, 1, 1, P) of heights, scene units
    cosine: bool

    @staticmethod
    def of(frame: Frame, *, cosine: bool) -> Measure:
        side = frame.turned.new_tensor([1.0, -1.0]).view(2, 1, 1)
        facing = frame.facing.expand_as(frame.turned)[:, None, None]
        turned = side * frame.turned[:, None, None]
        length = (facing**2 + turned[:, :1] ** 2).clamp(min=1e-12).sqrt()
        far = frame.depth if frame.distance is None else frame.distance
        rounding = ROUNDING * torch.finfo(far.dtype).eps * far.detach().abs().expand_as(frame.turned)[:, None, None]
        return Measure(facing, turned, length, -torch.atan2(turned, facing), rounding, cosine)

    def elevation(self, along: Tensor, towards: Tensor) -> Tensor:
        """Angle over the tangent plane, negative below."""
        up = (towards * self.facing + along * self.turned) / self.length - self.rounding
        out = (along * self.facing - towards * self.turned) / self.length
        return torch.atan2(up, out)

    def amount(self, elevation: Tensor) -> Tensor:
        """Share of the hemisphere between the tangent plane and an elevation, times the number of slices."""
        if self.cosine:
            arc = 0.25 * (self.view.cos() - (2 * elevation + self.view).cos()) - 0.5 * elevation * self.view.sin()
            return self.length * arc
        return 0.5 * ((elevation + self.view).sin() - self.view.sin())


def weighted_increments(
    measure: Measure, frame: Frame, taps: Taps, falloff: Tensor, thickness: Tensor | None, bias: Tensor
) -> Tensor:
    """Obscured amount (P,): each tap that raises the horizon adds what it raises it by, weighted by its distance.

    Args:
        falloff, thickness (of the radius; None: infinite), bias (radians): (P,).
    """
    weight, low, high = rises(measure, frame, taps, falloff, thickness, bias)
    return (weight * (measure.amount(high) - measure.amount(low))).sum((0, 1, 2))


def rises(
    measure: Measure, frame: Frame, taps: Taps, falloff: Tensor, thickness: Tensor | None, bias: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Weights, lower and upper elevations (S, 2, K, P) of the arcs by which each tap raises the horizon.

    Args: as `weighted_increments`.
    """
    front = torch.where(taps.seen, measure.elevation(taps.along, taps.towards), bias)
    horizon = torch.maximum(front, bias).cummax(2).values
    before = torch.cat((bias.expand_as(front[:, :, :1]), horizon[:, :, :-1]), 2)
    distance = torch.where(taps.seen, (taps.along**2 + taps.towards**2).sqrt(), taps.reach) / frame.radius
    weight = linear_attenuation(distance, falloff.expand_as(distance))
    earlier = torch.cat((torch.ones_like(weight[:, :, :1]), weight[:, :, :-1]), 2)
    joined = _connected(taps, TRAPEZOID_SLOPE, TRAPEZOID_STEP * frame.radius)
    earlier = torch.where(joined, earlier, weight)  # a step to another surface is not in between
    start = before
    if thickness is not None:
        ray, depth = view_ray(frame, taps), thickness * frame.radius
        back = measure.elevation(taps.along + depth * ray[0], taps.towards + depth * ray[1])
        start = torch.minimum(torch.maximum(before, back), horizon)
    return 0.5 * (earlier + weight), start, horizon


def covered_intervals(
    measure: Measure, frame: Frame, taps: Taps, thickness: Tensor | None, bias: Tensor, *, connected: bool
) -> Tensor:
    """Obscured amount (P,): the union of the arcs that the taps' occluders cover inside the sphere of radius R.

    An occluder is the piece of the tap's own view ray from the surface to `thickness` R behind it.

    Args:
        thickness (of the radius; None: infinite), bias (radians): (P,).
    """
    low, high = disjoint_arcs(measure, frame, taps, thickness, bias, connected=connected)
    return (measure.amount(high) - measure.amount(low)).sum((0, 1, 2))


def disjoint_arcs(
    measure: Measure, frame: Frame, taps: Taps, thickness: Tensor | None, bias: Tensor, *, connected: bool
) -> tuple[Tensor, Tensor]:
    """Elevations (S, 2, K', P) between which lies, arc by arc and none twice, what the taps' occluders cover.

    Args: as `covered_intervals`.
    """
    along, towards = (torch.where(taps.seen, part, taps.reach) for part in (taps.along, taps.towards))
    ray = view_ray(frame, taps)
    depth = torch.full_like(frame.radius, torch.inf) if thickness is None else thickness * frame.radius
    first, last, hit = _clip(along, towards, ray[0], ray[1], frame.radius, depth)
    high = measure.elevation(along + first * ray[0], towards + first * ray[1])
    low = measure.elevation(along + last * ray[0], towards + last * ray[1])
    hit = hit & taps.seen
    if connected:
        low_link, high_link, hit_link = _links(measure, frame, taps, thickness)
        low, high = torch.cat((low, low_link), 2), torch.cat((high, high_link), 2)
        hit = torch.cat((hit, hit_link), 2)
    high = torch.where(hit, torch.maximum(high, bias), bias)
    low = torch.minimum(torch.where(hit, torch.maximum(low, bias), bias), high)
    low, order = low.sort(2)
    high = high.gather(2, order)
    reached = torch.cat((low[:, :, :1], high.cummax(2).values[:, :, :-1]), 2)
    return torch.maximum(low, torch.minimum(reached, high)), high


def _connected(taps: Taps, slope: float, near: Tensor, *, back: bool = False) -> Tensor:
    """Whether each tap and the one before it (at first, the pixel itself) lie on one surface.

    Args:
        slope: most depth step per step outwards. near: (P,) depth step that is small enough at any slope.
        back: so is a step back towards the pixel, as under an overhang.
    """
    zero, one = torch.zeros_like(taps.along[:, :, :1]), torch.ones_like(taps.seen[:, :, :1])
    across = taps.along - torch.cat((zero, taps.along[:, :, :-1]), 2)
    rise = (taps.towards - torch.cat((zero, taps.towards[:, :, :-1]), 2)).abs()
    both = taps.seen & torch.cat((one, taps.seen[:, :, :-1]), 2)
    joined = (across > 0) & ((rise <= slope * across) | (rise <= near))
    if back:
        joined = joined | ((across < 0) & (-across <= near) & (rise <= near))
    return both & joined


def _links(measure: Measure, frame: Frame, taps: Taps, thickness: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Arcs between neighbouring taps of one surface, clipped to the sphere; the first neighbour is the pixel itself."""
    along, towards = (torch.where(taps.seen, part, taps.reach) for part in (taps.along, taps.towards))
    near = LINK_STEP * frame.radius if thickness is None else thickness.clamp(max=LINK_STEP) * frame.radius
    zero = torch.zeros_like(along[:, :, :1])
    from_along, from_towards = torch.cat((zero, along[:, :, :-1]), 2), torch.cat((zero, towards[:, :, :-1]), 2)
    same = _connected(taps, CONNECTED_SLOPE, near, back=True)
    across, rise = torch.where(same, along - from_along, 1.0), torch.where(same, towards - from_towards, 0.0)
    length = (across**2 + rise**2).sqrt()
    across, rise = across / length, rise / length
    first, last, hit = _clip(from_along, from_towards, across, rise, frame.radius, length)
    one = measure.elevation(from_along + first * across, from_towards + first * rise)
    one = torch.cat((torch.zeros_like(one[:, :, :1]), one[:, :, 1:]), 2)  # x itself lies on the tangent plane
    two = measure.elevation(from_along + last * across, from_towards + last * rise)
    return torch.minimum(one, two), torch.maximum(one, two), hit & same


def _clip(
    along: Tensor, towards: Tensor, ray_x: Tensor, ray_y: Tensor, radius: Tensor, length: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Part [first, last] of the segment from a point along a unit direction that lies in the sphere of radius R about x."""
    middle = -(along * ray_x + towards * ray_y)
    offset = along * ray_y - towards * ray_x
    inside = radius**2 - offset**2
    touched = inside > 0
    soft = GRAZE * radius
    half = (torch.where(touched, inside, 0.0) + soft**2).sqrt() - soft
    first = torch.maximum(middle - half, torch.zeros_like(half))
    last = torch.minimum(middle + half, length)
    return first, last, touched & (last > first)


def view_ray(frame: Frame, taps: Taps) -> tuple[Tensor, Tensor]:
    """Unit direction (along, towards) in which a tap's view ray leaves the eye."""
    if frame.distance is None:
        return torch.zeros_like(taps.reach), torch.full_like(taps.reach, -1.0)
    length = (frame.distance**2 + taps.reach**2).sqrt()
    return taps.reach / length, -frame.distance / length


def linear_attenuation(distance: Tensor, falloff: Tensor) -> Tensor:
    """`attenuation` with its clamped derivatives, for recording."""
    with torch.no_grad():
        value, to_distance, to_falloff = attenuation(distance, falloff)
    return value + to_distance * (distance - distance.detach()) + to_falloff * (falloff - falloff.detach())
