"""Pits, corners and round things for the Monte Carlo ray caster, in the places where the analytic scenes have them."""

from __future__ import annotations

import math

import numpy as np

from support import monte_carlo as mc

UP = (0.0, 0.0, 1.0)


def within(axis: int, low: float, high: float, points: mc.Array) -> mc.Array:
    return (points[:, axis] >= low) & (points[:, axis] <= high)


def box(width: float, length: float, depth: float) -> list[mc.Occluder]:
    """A pit about the z axis whose floor is z = 0, and the ground around it."""
    x, y = width / 2, length / 2

    def mouth(p: mc.Array) -> mc.Array:
        return within(0, -x, x, p) & within(1, -y, y, p)

    sides = [
        mc.plane((0, 0, 0), UP, mouth),
        mc.plane((0, 0, depth), UP, lambda p: ~mouth(p)),
        mc.plane((-x, 0, 0), (1, 0, 0), lambda p: within(1, -y, y, p) & within(2, 0, depth, p)),
        mc.plane((x, 0, 0), (1, 0, 0), lambda p: within(1, -y, y, p) & within(2, 0, depth, p)),
    ]
    if math.isinf(length):
        return sides
    return [
        *sides,
        mc.plane((0, -y, 0), (0, 1, 0), lambda p: within(0, -x, x, p) & within(2, 0, depth, p)),
        mc.plane((0, y, 0), (0, 1, 0), lambda p: within(0, -x, x, p) & within(2, 0, depth, p)),
    ]


def round_pit(radius: float, depth: float) -> list[mc.Occluder]:
    def mouth(p: mc.Array) -> mc.Array:
        return np.hypot(p[:, 0], p[:, 1]) <= radius

    return [
        mc.plane((0, 0, 0), UP, mouth),
        mc.plane((0, 0, depth), UP, lambda p: ~mouth(p)),
        mc.shell((0, 0, 0), radius, lambda p: within(2, 0, depth, p), axis=UP),
    ]


def bowl(radius: float, half_angle_deg: float) -> list[mc.Occluder]:
    rim = radius * (1 - math.cos(math.radians(half_angle_deg)))
    hole = radius * math.sin(math.radians(half_angle_deg))
    return [
        mc.shell((0, 0, radius), radius, lambda p: p[:, 2] <= rim),
        mc.plane((0, 0, rim), UP, lambda p: np.hypot(p[:, 0], p[:, 1]) > hole),
    ]


def corner() -> list[mc.Occluder]:
    """The corner of the octant x > 0, y < 0, z > 0."""
    return [
        mc.plane((0, 0, 0), UP, lambda p: (p[:, 0] > 0) & (p[:, 1] < 0)),
        mc.plane((0, 0, 0), (1, 0, 0), lambda p: (p[:, 1] < 0) & (p[:, 2] > 0)),
        mc.plane((0, 0, 0), (0, 1, 0), lambda p: (p[:, 0] > 0) & (p[:, 2] > 0)),
    ]


def lying_cylinder(radius: float) -> list[mc.Occluder]:
    everywhere = mc.shell((0, 0, radius), radius, lambda p: p[:, 2] > 1e-9, axis=(0, 1, 0))
    return [mc.plane((0, 0, 0), UP), everywhere]


def disk(radius: float, height: float) -> list[mc.Occluder]:
    return [mc.plane((0, 0, 0), UP), mc.plane((0, 0, height), UP, lambda p: np.hypot(p[:, 0], p[:, 1]) < radius)]
