"""Six procedural scenes: what a screen-space technique meets in practice, without a file to download. Metres, y up."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from torch_ssao import checks
from torch_ssao.scenes.scene import Scene, View
from torch_ssao.scenes.shapes import Builder

Parts = tuple[Builder, tuple[View, ...], float]


def names() -> list[str]:
    """Names of the built-in scenes."""
    return list(_SCENES)


@functools.lru_cache(maxsize=None)  # scenes are read-only, and share their embree scene this way
def builtin(name: str) -> Scene:
    """One of the built-in scenes: a mesh in metres, y up, four views and a radius; the same every time.

    Args:
        name: "temple" (steps, columns, gabled roof, inner room), "room" (furniture, shelves, legs), "street" (houses with window
            recesses, kerbs), "pipes" (pipes, fence and wire: thin geometry), "heap" (spheres and tori piled on a plane) or "stairs"
            (two flights, landing, balusters).
    Raises: ChoiceError for another name; SceneError when trimesh is not installed.
    Cost: under 0.1 s, 2,000 to 60,000 faces.
    """
    checks.check_choice("name", name, _SCENES)
    builder, views, radius = _SCENES[name]()
    vertices, faces = builder.mesh()
    return Scene(name, vertices, faces, views, radius)


def _temple() -> Parts:
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
        View((-2.6, 1.9, 9.9), (2.5, 5.2, 5.6), fov_y_deg=65.0),
    )
    return b, views, 0.8


def _column(b: Builder, x: float, z: float, floor: float, top: float) -> None:
    b.box((x - 0.6, floor, z - 0.6), (x + 0.6, floor + 0.2, z + 0.6))
    b.rod((x, floor + 0.2, z), (x, floor + 0.4, z), 0.55, end_radius=0.5)
    b.rod((x, floor + 0.4, z), (x, top - 0.5, z), 0.45, end_radius=0.36)
    b.rod((x, top - 0.5, z), (x, top - 0.2, z), 0.36, end_radius=0.58)
    b.box((x - 0.6, top - 0.2, z - 0.6), (x + 0.6, top, z + 0.6))


def _room() -> Parts:
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
    b.rod((2.5, 0.0, 1.3), (2.5, 0.04, 1.3), 0.18)
    b.rod((2.5, 0.04, 1.3), (2.5, 1.5, 1.3), 0.02, sections=12)
    b.rod((2.5, 1.45, 1.3), (2.5, 1.75, 1.3), 0.24, end_radius=0.12)
    b.torus((0.05, 0.79, 0.2), 0.14, 0.035)
    b.sphere((-0.5, 0.81, 0.35), 0.06)
    b.rod((0.4, 0.75, 0.05), (0.4, 0.98, 0.05), 0.06, end_radius=0.09)
    views = (
        View((2.6, 1.6, 2.2), (-1.2, 0.5, -1.2), fov_y_deg=65.0),
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


def _street() -> Parts:
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


def _pipes() -> Parts:
    b = Builder()
    b.quad(25.0)
    b.box((-7.0, 0.0, -3.4), (7.0, 4.0, -3.0))
    for y, out, radius in ((0.35, 0.28, 0.16), (0.8, 0.2, 0.09), (1.15, 0.2, 0.05), (2.6, 0.34, 0.2), (3.2, 0.18, 0.06)):
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


def _heap() -> Parts:
    b = Builder()
    b.quad(15.0)
    rng = np.random.default_rng(5)
    placed: list[tuple[NDArray[np.float64], float]] = []
    for i in range(46):
        ring = i % 3 == 0
        size = float(rng.uniform(0.3, 0.5) if ring else rng.uniform(0.16, 0.42))
        x, z = rng.normal(0.0, 0.85, 2)
        center = np.array([x, _rest_height(placed, x, z, size * (0.55 if ring else 1.0)), z])
        if ring:
            b.torus(center, size * 0.75, size * 0.25, _tilt(rng))
        else:
            b.sphere(center, size)
        placed.append((center, size * (0.55 if ring else 1.0)))
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
        View((1.6, 1.0, -3.3), (-0.1, 0.7, 0.0), fov_y_deg=35.0),
    )
    return b, views, 0.4


def _rest_height(placed: list[tuple[NDArray[np.float64], float]], x: float, z: float, radius: float) -> float:
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
