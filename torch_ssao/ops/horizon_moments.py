"""Occluded directions of a slice: not only how many there are, but where their mean points.

Between the tangent plane and an elevation e on one side of a slice lie directions at the angle b = pi / 2 - view - e from the eye:
cos b v + sin b t. They count |sin b| db, times n . d = length sin e with cosine weighting. The first moments are integrals of
cos b sin b sin e and sin^2 b sin e (uniform: without sin e), products of sines that are sums of sines of e and 3 e (uniform: 2 e).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ssao.ops import horizon_arcs as arcs
from torch_ssao.ops.horizon_arcs import Measure
from torch_ssao.ops.horizon_taps import Frame, Taps

HEMISPHERE = {True: 2 / 3, False: 1 / 2}  # length of the mean direction, cosine-weighted and not


def moments(measure: Measure, elevation: Tensor) -> Tensor:
    """What lies between the tangent plane and an elevation (S, 2, K, P), times the number of slices.

    Returns: (3, S, 2, K, P): share of the hemisphere, mean direction towards the eye, and along the side.
    """
    turn = 2 * measure.view
    if measure.cosine:
        once, thrice = turn + elevation, turn + 3 * elevation
        towards = 0.25 * (once.sin() - turn.sin() - (thrice.sin() - turn.sin()) / 3)
        along = 0.25 * (once.cos() - turn.cos() - (thrice.cos() - turn.cos()) / 3) + 0.5 * (1 - elevation.cos())
        towards, along = measure.length * towards, measure.length * along
    else:
        twice = turn + 2 * elevation
        towards = 0.125 * (turn.cos() - twice.cos())
        along = 0.25 * elevation + 0.125 * (twice.sin() - turn.sin())
    return torch.stack((measure.amount(elevation), towards, along))


def occluded_moments(
    measure: Measure,
    frame: Frame,
    taps: Taps,
    falloff: Tensor,
    thickness: Tensor | None,
    bias: Tensor,
    *,
    estimator: str,
    connected: bool,
) -> Tensor:
    """Moments (3, S, 2, P) of the directions that the taps occlude, as `horizon_arcs` counts them.

    Args:
        falloff (of "increments"), thickness (of the radius; None: infinite), bias (radians): (P,).
    """
    if estimator == "increments":
        weight, low, high = _rises(measure, frame, taps, falloff, thickness, bias)
        return (weight * (moments(measure, high) - moments(measure, low))).sum(3)
    low, high = _united(measure, frame, taps, thickness, bias, connected=connected)
    return (moments(measure, high) - moments(measure, low)).sum(3)


def _rises(
    measure: Measure, frame: Frame, taps: Taps, falloff: Tensor, thickness: Tensor | None, bias: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Weights and elevations of the arcs by which each tap raises the horizon; see `arcs.weighted_increments`."""
    front = torch.where(taps.seen, measure.elevation(taps.along, taps.towards), bias)
    horizon = torch.maximum(front, bias).cummax(2).values
    before = torch.cat((bias.expand_as(front[:, :, :1]), horizon[:, :, :-1]), 2)
    distance = torch.where(taps.seen, (taps.along**2 + taps.towards**2).sqrt(), taps.reach) / frame.radius
    weight = arcs.linear_attenuation(distance, falloff.expand_as(distance))
    earlier = torch.cat((torch.ones_like(weight[:, :, :1]), weight[:, :, :-1]), 2)
    earlier = torch.where(arcs._connected(taps, arcs.TRAPEZOID_SLOPE), earlier, weight)
    start = before
    if thickness is not None:
        ray, depth = arcs.view_ray(frame, taps), thickness * frame.radius
        back = measure.elevation(taps.along + depth * ray[0], taps.towards + depth * ray[1])
        start = torch.minimum(torch.maximum(before, back), horizon)
    return 0.5 * (earlier + weight), start, horizon


def _united(
    measure: Measure, frame: Frame, taps: Taps, thickness: Tensor | None, bias: Tensor, *, connected: bool
) -> tuple[Tensor, Tensor]:
    """Elevations of disjoint arcs with the union that the taps' occluders cover; see `arcs.covered_intervals`."""
    along, towards = (torch.where(taps.seen, part, taps.reach) for part in (taps.along, taps.towards))
    ray = arcs.view_ray(frame, taps)
    depth = torch.full_like(frame.radius, torch.inf) if thickness is None else thickness * frame.radius
    first, last, hit = arcs._clip(along, towards, ray[0], ray[1], frame.radius, depth)
    high = measure.elevation(along + first * ray[0], towards + first * ray[1])
    low = measure.elevation(along + last * ray[0], towards + last * ray[1])
    hit = hit & taps.seen
    if connected:
        low_link, high_link, hit_link = arcs._links(measure, frame, taps, along, towards)
        low, high = torch.cat((low, low_link), 2), torch.cat((high, high_link), 2)
        hit = torch.cat((hit, hit_link), 2)
    high = torch.where(hit, torch.maximum(high, bias), bias)
    low = torch.minimum(torch.where(hit, torch.maximum(low, bias), bias), high)
    low, order = low.sort(2)
    high = high.gather(2, order)
    reached = torch.cat((low[:, :, :1], high.cummax(2).values[:, :, :-1]), 2)
    return torch.maximum(low, torch.minimum(reached, high)), high
