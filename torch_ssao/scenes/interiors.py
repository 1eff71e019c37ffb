"""Built-in scenes of interiors: room and stairs. Metres, y up."""

from __future__ import annotations

import numpy as np

from torch_ssao.scenes.scene import View
from torch_ssao.scenes.shapes import Builder

Parts = tuple[Builder, tuple[View, ...], float]


def room() -> Parts:
    """Table and chairs, shelves with books, sofa, lamp; closed but for a window and a door.

    Returns: mesh, views, radius.
    """
    b = Builder()
    b.box((-3.2, -0.2, -2.7), (3.2, 0.0, 2.7))
    b.box((-3.2, 2.7, -2.7), (3.2, 2.9, 2.7))
    b.wall((-3.2, 0.0, -2.7), (3.2, 2.7, -2.5), [(-1.6, 0.4, 0.9, 2.2)])
    b.wall((-3.2, 0.0, 2.5), (3.2, 2.7, 2.7), [(1.6, 2.5, 0.0, 2.1)])
    b.box((-3.2, 0.0, -2.5), (-3.0, 2.7, 2.5))
    b.box((3.0, 0.0, -2.5), (3.2, 2.7, 2.5))
    for z in (-2.5, 2.46):  # skirting boards
        b.wall((-3.0, 0.0, z), (3.0, 0.1, z + 0.04), [(1.6, 2.5, 0.0, 0.1)] if z > 0 else [])
    b.box((-1.7, 0.86, -2.56), (0.5, 0.9, -2.34))  # window sill
    _table(b, (-0.2, 0.2), 1.6, 0.9)
    for x, z, turn in ((-0.6, -0.55, 0.0), (0.35, -0.5, 12.0), (-0.5, 0.95, 180.0), (0.4, 1.0, 165.0)):
        _chair(b, x, z, turn)
    _shelf(b)
    b.box((-3.0, 0.08, 0.6), (-2.1, 0.42, 2.4))  # sofa
    b.box((-3.0, 0.42, 0.6), (-2.75, 0.9, 2.4))
    for z in (0.6, 2.2):
        b.box((-2.75, 0.42, z), (-2.1, 0.62, z + 0.2))
    for z in (0.82, 1.52):
        b.box((-2.72, 0.42, z), (-2.08, 0.54, z + 0.66))
    b.box((-3.0, 0.0, -2.5), (-1.9, 1.1, -1.9))  # cupboard, with a gap and a plinth
    b.box((-1.88, 0.12, -2.48), (-1.86, 1.05, -1.92))
    b.sphere((-2.5, 1.3, -2.2), 0.2)
    b.rod((2.72, 0.0, 2.2), (2.72, 0.04, 2.2), 0.18)
    b.rod((2.72, 0.04, 2.2), (2.72, 1.5, 2.2), 0.02, sections=12)
    b.rod((2.72, 1.45, 2.2), (2.72, 1.75, 2.2), 0.24, end_radius=0.12)
    b.torus((0.05, 0.79, 0.2), 0.14, 0.035)
    b.sphere((-0.5, 0.81, 0.35), 0.06)
    b.rod((0.4, 0.75, 0.05), (0.4, 0.98, 0.05), 0.06, end_radius=0.09)
    views = (
        View((2.2, 1.6, 1.9), (-1.2, 0.5, -1.2), fov_y_deg=65.0),
        View((-2.6, 1.5, -1.4), (2.2, 0.7, 0.6), fov_y_deg=65.0),
        View((-1.7, 0.5, 1.9), (1.2, 0.5, -1.2), fov_y_deg=60.0),
        View((1.2, 1.3, 0.4), (2.7, 1.0, -1.6), fov_y_deg=60.0),
    )
    return b, views, 0.35


def _table(b: Builder, center: tuple[float, float], length: float, depth: float) -> None:
    x, z = center
    b.box((x - length / 2, 0.71, z - depth / 2), (x + length / 2, 0.75, z + depth / 2))
    for sx in (-1, 1):
        for sz in (-1, 1):
            lx, lz = x + sx * (length / 2 - 0.08), z + sz * (depth / 2 - 0.08)
            b.box((lx - 0.03, 0.0, lz - 0.03), (lx + 0.03, 0.71, lz + 0.03))
    b.box((x - length / 2 + 0.08, 0.62, z - 0.015), (x + length / 2 - 0.08, 0.71, z + 0.015))


def _chair(b: Builder, x: float, z: float, turn_deg: float) -> None:
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))

    def part(low: tuple[float, float, float], high: tuple[float, float, float]) -> None:
        half = [(h - w) / 2 for w, h in zip(low, high, strict=True)]
        mx, my, mz = ((h + w) / 2 for w, h in zip(low, high, strict=True))
        cx, cz = x + c * mx + s * mz, z - s * mx + c * mz
        b.box((cx - half[0], my - half[1], cz - half[2]), (cx + half[0], my + half[1], cz + half[2]), turn_deg=turn_deg)

    part((-0.2, 0.43, -0.2), (0.2, 0.46, 0.2))
    for lx in (-0.2, 0.165):
        part((lx, 0.0, -0.2), (lx + 0.035, 0.9, -0.165))
        part((lx, 0.0, 0.165), (lx + 0.035, 0.43, 0.2))
    for y in (0.6, 0.72, 0.84):
        part((-0.165, y, -0.19), (0.165, y + 0.06, -0.172))


def _shelf(b: Builder) -> None:
    rng = np.random.default_rng(3)
    x0, x1, z0, z1 = 2.68, 3.0, -2.2, -0.4
    for z in (z0, -1.31, z1 - 0.02):
        b.box((x0, 0.0, z), (x1, 2.1, z + 0.02))
    for y in (0.05, 0.45, 0.85, 1.25, 1.65, 2.08):
        b.box((x0, y, z0 + 0.02), (x1, y + 0.02, z1 - 0.02))
    b.box((x1 - 0.01, 0.0, z0), (x1, 2.1, z1))
    for y in (0.07, 0.47, 0.87, 1.27, 1.67):
        for start, stop in ((z0 + 0.03, -1.33), (-1.28, z1 - 0.05)):
            at = start
            while at < start + (stop - start) * rng.uniform(0.5, 1.0) and at < stop - 0.07:
                thick, tall, deep = rng.uniform(0.02, 0.06), rng.uniform(0.18, 0.32), rng.uniform(0.16, 0.24)
                b.box((x1 - 0.01 - deep, y, at), (x1 - 0.01, y + tall, at + thick))
                at += thick + 0.002


def stairs() -> Parts:
    """Two flights about a landing in a stairwell, with balusters, handrails and an open underside.

    Returns: mesh, views, radius.
    """
    b = Builder()
    rise, run, steps = 0.175, 0.28, 10
    half = steps * rise
    b.box((-2.4, -0.2, -3.4), (2.4, 0.0, 3.0))
    b.wall((-2.4, 0.0, -3.6), (2.4, 6.4, -3.4), [(-0.6, 0.6, 2.6, 4.2)])
    b.box((-2.6, 0.0, -3.4), (-2.4, 6.4, 3.0))
    b.wall((2.4, 0.0, -3.4), (2.6, 6.4, 3.0), [(1.2, 2.2, 0.0, 2.1)], axis=2)
    b.wall((-2.4, 0.0, 3.0), (2.4, 6.4, 3.2), [(-1.6, -0.4, 4.2, 5.6)])
    b.box((-2.6, 6.4, -3.6), (2.6, 6.6, 3.2))
    b.box((-2.4, 2 * half - 0.2, 1.0), (2.4, 2 * half, 3.0))  # upper floor
    b.box((-2.4, half - 0.18, -3.4), (2.4, half, -1.8))  # landing
    for i in range(steps):  # first flight solid, second flight of open treads on two stringers
        z = 1.0 - run * i
        b.box((0.3, 0.0, z - run), (2.1, rise * (i + 1), z))
        b.box((0.27, rise * (i + 1) - 0.035, z - run), (2.13, rise * (i + 1), z + 0.03))
        y, z = half + rise * (i + 1), -1.8 + run * i
        b.box((-2.1, y - 0.05, z), (-0.3, y, z + run + 0.03))
    for x in (-2.0, -0.5):
        for i in range(steps):
            y, z = half + rise * i, -1.8 + run * i
            b.box((x, y - 0.12, z), (x + 0.08, y + rise - 0.05, z + run))
    _rail(b, 0.36, (0.0, 1.0), (half, 1.0 - run * steps), steps)
    _rail(b, -0.36, (half, -1.8), (2 * half, -1.8 + run * steps), steps)
    b.rod((-0.36, half + 0.9, -1.75), (0.36, half + 0.9, -1.75), 0.03, sections=12)
    for x in (-0.24, -0.12, 0.0, 0.12, 0.24):
        b.rod((x, half, -1.75), (x, half + 0.9, -1.75), 0.012, sections=8)
    for x in np.arange(0.4, 2.4, 0.14):  # balustrade of the upper floor
        b.rod((x, 2 * half, 1.05), (x, 2 * half + 0.9, 1.05), 0.012, sections=8)
    b.rod((-0.3, 2 * half + 0.9, 1.05), (2.4, 2 * half + 0.9, 1.05), 0.03, sections=12)
    for low, high in (
        ((-2.2, 0.0, -0.2), (-1.5, 0.6, 0.5)),
        ((-2.1, 0.6, -0.1), (-1.65, 0.95, 0.35)),
        ((-1.3, 0.0, -0.9), (-0.9, 0.4, -0.4)),
    ):
        b.box(low, high, turn_deg=8.0)  # boxes stored under the second flight
    views = (
        View((-0.4, 1.65, 2.8), (0.7, 1.2, -1.6), fov_y_deg=65.0),
        View((1.6, half + 1.6, -2.9), (-0.9, half + 0.7, 0.4), fov_y_deg=70.0),
        View((1.2, 2 * half + 1.6, 2.4), (-0.5, half - 0.2, -1.6), fov_y_deg=65.0),
        View((0.0, 1.3, 1.9), (-1.6, 0.6, -1.0), fov_y_deg=65.0),
    )
    return b, views, 0.4


def _rail(b: Builder, x: float, start: tuple[float, float], end: tuple[float, float], steps: int) -> None:
    """Handrail and balusters from (y, z) to (y, z)."""
    b.rod((x, start[0] + 0.9, start[1]), (x, end[0] + 0.9, end[1]), 0.03, sections=12)
    for i in range(2 * steps + 1):
        t = i / (2 * steps)
        y, z = start[0] + t * (end[0] - start[0]), start[1] + t * (end[1] - start[1])
        b.rod((x, y, z), (x, y + 0.9, z), 0.05 if i in (0, 2 * steps) else 0.012, sections=12)
