"""Built-in scenes of buildings: temple and street. Metres, y up."""

from __future__ import annotations

import numpy as np

from torch_ssao.scenes.scene import View
from torch_ssao.scenes.shapes import Builder

Parts = tuple[Builder, tuple[View, ...], float]


def temple() -> Parts:
    """Steps, columns round all sides, gabled roof, an inner room with an altar.

    Returns: mesh, views, radius.
    """
    b = Builder()
    b.quad(40.0)
    for i in range(3):  # steps
        x, z = 7.2 - 0.4 * i, 11.2 - 0.4 * i
        b.box((-x, 0.3 * i, -z), (x, 0.3 * (i + 1), z))
    floor, top = 0.9, 6.1
    xs, zs = np.linspace(-5.6, 5.6, 6), np.linspace(-9.6, 9.6, 9)
    for x in xs:
        for z in zs:
            if abs(x) > 5.5 or abs(z) > 9.5:
                _column(b, float(x), float(z), floor, top)
    for z in (-6.6, 6.6):  # a second row in front of the inner room
        for x in (-1.7, 1.7):
            _column(b, x, z, floor, top)
    b.wall((-3.6, floor, -6.0), (3.6, top, -5.5), [])
    b.wall((-3.6, floor, 5.5), (3.6, top, 6.0), [(-1.0, 1.0, floor, 4.6)])
    for x in (-3.6, 3.1):
        b.wall((x, floor, -5.5), (x + 0.5, top, 5.5), [(z - 0.3, z + 0.3, 3.0, 4.6) for z in (-3.0, 0.0, 3.0)], axis=2)
    b.box((-1.0, floor, -4.8), (1.0, 2.0, -3.4))  # an altar, steps before it
    b.box((-1.5, floor, -5.1), (1.5, 1.2, -2.9))
    b.sphere((0.0, 2.6, -4.1), 0.6)
    for x in (-6.2, 5.0):  # architrave
        b.box((x, top, -10.2), (x + 1.2, top + 0.8, 10.2))
    for z in (-10.2, 9.0):
        b.box((-5.0, top, z), (5.0, top + 0.8, z + 1.2))
    b.box((-6.5, top + 0.8, -10.5), (6.5, top + 1.1, 10.5))
    b.gable((-6.5, top + 1.1, -10.2), (6.5, top + 3.6, 10.2))
    views = (
        View((11.5, 3.2, 17.0), (0.5, 3.6, 4.0), fov_y_deg=50.0),
        View((4.6, 2.5, 10.4), (4.4, 2.6, -6.0), fov_y_deg=60.0),
        View((0.3, 2.5, 4.9), (-0.6, 2.3, -4.5), fov_y_deg=65.0),
        View((-3.0, 1.8, 8.9), (2.8, 3.6, 5.6), fov_y_deg=65.0),
    )
    return b, views, 0.8


def _column(b: Builder, x: float, z: float, floor: float, top: float) -> None:
    b.box((x - 0.6, floor, z - 0.6), (x + 0.6, floor + 0.2, z + 0.6))
    b.rod((x, floor + 0.2, z), (x, floor + 0.4, z), 0.55, end_radius=0.5)
    b.rod((x, floor + 0.4, z), (x, top - 0.5, z), 0.45, end_radius=0.36)
    b.rod((x, top - 0.5, z), (x, top - 0.2, z), 0.36, end_radius=0.58)
    b.box((x - 0.6, top - 0.2, z - 0.6), (x + 0.6, top, z + 0.6))


def street() -> Parts:
    """Two rows of houses with window recesses, kerbs, lamps and cars.

    Returns: mesh, views, radius.
    """
    b = Builder()
    b.quad(60.0)
    for x in (-5.5, 3.5):  # pavements along a road of 7 m
        b.box((x, 0.0, -26.0), (x + 2.0, 0.16, 26.0))
    rng = np.random.default_rng(11)
    for side in (-1, 1):
        z = -24.0
        while z < 20.0:
            width, floors = float(rng.uniform(5.5, 8.5)), int(rng.integers(2, 4))
            _house(b, side, z, width, floors, float(rng.uniform(6.0, 8.0)))
            z += width + (0.0 if rng.random() < 0.6 else float(rng.uniform(1.0, 2.5)))
    for side in (-1, 1):
        for z in (-16.0, -4.0, 8.0, 20.0):
            b.rod((side * 3.9, 0.16, z), (side * 3.9, 4.6, z), 0.06, sections=12)
            b.sphere((side * 3.9, 4.75, z), 0.22, subdivisions=2)
    for x, z in ((-2.4, -7.0), (2.4, 3.5), (-2.4, 13.0)):  # parked cars
        b.box((x - 0.85, 0.25, z - 2.0), (x + 0.85, 0.85, z + 2.0))
        b.box((x - 0.75, 0.85, z - 1.0), (x + 0.75, 1.4, z + 1.2))
        for sx in (-0.8, 0.6):
            for sz in (-1.3, 1.3):
                b.rod((x + sx, 0.32, z + sz), (x + sx + 0.2, 0.32, z + sz), 0.32, sections=20)
    views = (
        View((-0.6, 1.7, 23.0), (0.4, 3.4, -6.0), fov_y_deg=55.0),
        View((4.6, 1.8, -14.0), (-4.5, 2.6, -3.0), fov_y_deg=60.0),
        View((-4.4, 1.8, -1.5), (-5.2, 2.2, 12.0), fov_y_deg=60.0),
        View((-1.5, 9.5, -20.0), (1.6, 2.0, -2.0), fov_y_deg=55.0),
    )
    return b, views, 0.9


def _house(b: Builder, side: int, z: float, width: float, floors: int, depth: float) -> None:
    """House on one side of the street, front at |x| = 5.5; side is the sign of x."""
    storey, wall = 2.9, 0.3
    top = 0.16 + floors * storey
    front, recess, back = 5.5, 5.5 + wall, 5.5 + depth

    def span(near: float, far: float) -> tuple[float, float]:
        return (near, far) if side > 0 else (-far, -near)

    x0, x1 = span(front, recess)
    columns = max(2, round(width / 2.2))
    pitch = width / columns
    centers = [z + pitch * (i + 0.5) for i in range(columns)]
    for floor in range(floors):
        y = 0.16 + floor * storey
        holes = [(c - 0.5, c + 0.5, y + 0.9, y + 2.3) for c in centers]
        if floor == 0:
            holes[0] = (centers[0] - 0.5, centers[0] + 0.5, 0.16, y + 2.2)
        b.wall((x0, y, z), (x1, y + storey, z + width), holes, axis=2)
        for start, stop, bottom, _ in holes:
            sill0, sill1 = span(front - 0.12, recess)
            b.box((sill0, bottom - 0.08, start - 0.1), (sill1, bottom, stop + 0.1))
        ledge0, ledge1 = span(front - 0.08, front)
        b.box((ledge0, y + storey - 0.15, z), (ledge1, y + storey, z + width))
    x0, x1 = span(recess, back)
    b.box((x0, 0.0, z), (x1, top, z + width))
    x0, x1 = span(front - 0.4, back + 0.4)
    b.gable((x0, top, z), (x1, top + 2.4, z + width), axis=2)
    chimney = span(front + depth * 0.62, front + depth * 0.62 + 0.6)
    b.box((chimney[0], top, z + width * 0.3), (chimney[1], top + 3.0, z + width * 0.3 + 0.6))
