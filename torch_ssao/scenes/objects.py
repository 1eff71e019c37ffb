"""Built-in scenes of objects in the open: pipes and heap. Metres, y up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torch_ssao.scenes.scene import View
from torch_ssao.scenes.shapes import Builder

Parts = tuple[Builder, tuple[View, ...], float]


def pipes() -> Parts:
    """Pipes on a wall, a tank, a picket fence and a wire fence: thin geometry.

    Returns: mesh, views, radius.
    """
    b = Builder()
    b.quad(25.0)
    b.box((-7.0, 0.0, -3.4), (7.0, 4.0, -3.0))
    for y, out, radius in (
        (0.35, 0.28, 0.16),
        (0.8, 0.2, 0.09),
        (1.15, 0.2, 0.05),
        (2.6, 0.34, 0.2),
        (3.2, 0.18, 0.06),
    ):
        b.rod((-6.8, y, -3.0 + out), (6.8, y, -3.0 + out), radius)
        for x in np.arange(-6.0, 6.1, 2.0):  # flanges and brackets
            b.rod((x - 0.04, y, -3.0 + out), (x + 0.04, y, -3.0 + out), radius * 1.3)
            b.box((x + 0.3, y - 0.02, -3.0), (x + 0.34, y + 0.02, -3.0 + out))
    for x, radius in ((-4.6, 0.12), (-3.9, 0.07), (0.9, 0.14), (1.5, 0.05), (4.3, 0.1)):
        _riser(b, x, radius)
    b.rod((-1.6, 0.0, -1.6), (-1.6, 1.9, -1.6), 0.55, sections=40)  # a tank and its valve wheel
    b.sphere((-1.6, 1.9, -1.6), 0.55)
    b.rod((-1.6, 0.9, -1.1), (-1.6, 0.9, -0.75), 0.05)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    b.torus((-1.6, 0.9, -0.75), 0.2, 0.025, tilt)
    for angle in (0.0, 60.0, 120.0):
        c, s = 0.2 * np.cos(np.deg2rad(angle)), 0.2 * np.sin(np.deg2rad(angle))
        b.rod((-1.6 - c, 0.9 - s, -0.75), (-1.6 + c, 0.9 + s, -0.75), 0.012, sections=8)
    for x in np.arange(-6.0, 0.01, 1.5):  # a picket fence
        b.box((x - 0.05, 0.0, 1.95), (x + 0.05, 1.35, 2.05))
    for y in (0.35, 1.0):
        b.box((-6.0, y, 2.05), (0.0, y + 0.08, 2.08))
    for x in np.arange(-5.9, 0.0, 0.14):
        b.box((x, 0.08, 2.08), (x + 0.08, 1.25, 2.1))
    _wire_fence(b)
    for i, x in enumerate((2.3, 2.75, 3.2, 2.52, 2.98, 2.75)):  # stacked pipes
        row = 0 if i < 3 else 1 if i < 5 else 2
        b.rod((x, 0.225 + 0.39 * row, -2.2), (x, 0.225 + 0.39 * row, 0.2), 0.225, sections=32)
    views = (
        View((4.6, 1.9, 5.4), (-0.8, 0.9, -1.2), fov_y_deg=50.0),
        View((-6.3, 1.6, 0.4), (-0.4, 0.9, -2.6), fov_y_deg=60.0),
        View((-4.8, 1.2, 4.2), (-1.4, 0.8, -1.0), fov_y_deg=55.0),
        View((1.6, 1.3, 0.9), (0.2, 1.6, -3.0), fov_y_deg=65.0),
    )
    return b, views, 0.3


def _riser(b: Builder, x: float, radius: float) -> None:
    """Pipe that comes down the wall, bends out and goes into the ground."""
    out = -3.0 + 0.62
    b.rod((x, 3.9, out), (x, 1.6, out), radius)
    b.sphere((x, 1.6, out), radius * 1.02, subdivisions=2)
    b.rod((x, 1.6, out), (x, 1.6, out + 0.5), radius)
    b.sphere((x, 1.6, out + 0.5), radius * 1.02, subdivisions=2)
    b.rod((x, 1.6, out + 0.5), (x, 0.0, out + 0.5), radius)
    b.rod((x, 0.0, out + 0.5), (x, 0.06, out + 0.5), radius * 1.7)


def _wire_fence(b: Builder) -> None:
    for x in (0.6, 2.4, 4.2, 6.0):
        b.rod((x, 0.0, 2.0), (x, 1.5, 2.0), 0.035, sections=12)
    b.rod((0.6, 1.45, 2.0), (6.0, 1.45, 2.0), 0.02, sections=8)
    for start in np.arange(-0.6, 6.1, 0.15):  # two families of diagonals, cut at the posts' rectangle
        for sign in (-1.0, 1.0):
            low, high = (start, 0.1), (start + sign * 1.3, 1.4)
            ends = _clipped(low, high, 0.6, 6.0)
            if ends is not None:
                (xa, ya), (xb, yb) = ends
                b.rod((xa, ya, 2.0), (xb, yb, 2.0), 0.006, sections=5)


def _clipped(
    a: tuple[float, float], c: tuple[float, float], low: float, high: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """The part of a segment with low <= x <= high, if any is worth drawing."""
    ts = sorted(((low - a[0]) / (c[0] - a[0]), (high - a[0]) / (c[0] - a[0])))
    t0, t1 = max(0.0, ts[0]), min(1.0, ts[1])
    if t1 - t0 < 0.02:
        return None
    first, second = ((a[0] + t * (c[0] - a[0]), a[1] + t * (c[1] - a[1])) for t in (t0, t1))
    return first, second


def heap() -> Parts:
    """Spheres and rings piled on a plane.

    Returns: mesh, views, radius.
    """
    b = Builder()
    b.quad(15.0)
    rng = np.random.default_rng(5)
    placed: list[tuple[tuple[float, float, float], float]] = []
    for i in range(46):
        ring = i % 3 == 0
        size = float(rng.uniform(0.3, 0.5) if ring else rng.uniform(0.16, 0.42))
        body = size * (0.55 if ring else 1.0)
        drops = [(_rest_height(placed, x, z, body), x, z) for x, z in rng.normal(0.0, 0.8, (10, 2))]
        y, x, z = min(drops)  # the lowest of ten places: a heap, not a tower
        center = (float(x), float(y), float(z))
        if ring:
            b.torus(center, size * 0.75, size * 0.25, _tilt(rng))
        else:
            b.sphere(center, size)
        placed.append((center, body))
    for angle in np.arange(0.0, 360.0, 30.0):  # a few strays round the heap
        far = float(rng.uniform(2.4, 3.6))
        size = float(rng.uniform(0.12, 0.3))
        x, z = far * np.cos(np.deg2rad(angle)), far * np.sin(np.deg2rad(angle))
        if angle % 60 == 0:
            b.sphere((x, size, z), size)
        else:
            b.torus((x, size * 0.3, z), size, size * 0.3)
    views = (
        View((3.6, 2.3, 3.9), (0.0, 0.55, 0.0), fov_y_deg=45.0),
        View((-3.4, 1.0, 2.6), (0.1, 0.6, 0.0), fov_y_deg=45.0),
        View((0.6, 3.9, -3.2), (0.0, 0.5, 0.1), fov_y_deg=45.0),
        View((2.9, 1.3, -3.6), (0.0, 0.4, 0.0), fov_y_deg=38.0),
    )
    return b, views, 0.4


def _rest_height(placed: list[tuple[tuple[float, float, float], float]], x: float, z: float, radius: float) -> float:
    """Lowest height at which a ball dropped at (x, z) touches the ground or an earlier one."""
    height = radius
    for center, other in placed:
        gap = (radius + other) ** 2 - (x - center[0]) ** 2 - (z - center[2]) ** 2
        if gap > 0:
            height = max(height, float(center[1] + np.sqrt(gap)))
    return height


def _tilt(rng: np.random.Generator) -> NDArray[np.float64]:
    """Rotation that leans a ring by up to 50 degrees, towards any side."""
    lean, way = np.deg2rad(rng.uniform(0.0, 50.0)), rng.uniform(0.0, 2 * np.pi)
    c, s = np.cos(lean), np.sin(lean)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    turn = np.array([[np.cos(way), 0.0, np.sin(way)], [0.0, 1.0, 0.0], [-np.sin(way), 0.0, np.cos(way)]])
    return np.asarray(turn @ about_x)
