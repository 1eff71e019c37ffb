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
        weight, low, high = arcs.rises(measure, frame, taps, falloff, thickness, bias)
        return (weight * (moments(measure, high) - moments(measure, low))).sum(3)
    low, high = arcs.disjoint_arcs(measure, frame, taps, thickness, bias, connected=connected)
    return (moments(measure, high) - moments(measure, low)).sum(3)
