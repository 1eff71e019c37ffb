"""Scenes that show one failure each: metres, y up, cameras that look along -z where nothing else is said."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from torch_ssao.scenes import Scene, View
from torch_ssao.scenes.shapes import Builder

RADIUS = 0.5
PLATE_HALF_LENGTH, PLATE_HALF_WIDTH, PLATE_HEIGHT = 1.0, 0.01, 1.0
PILLAR_DISTANCE = 4.0


def pillar_before_wall(gap: float, turn_deg: float) -> Scene:
    """A pillar taller than the picture at 4 m, and a wall `gap` behind it, turned about the vertical; nothing else."""
    b = Builder()
    b.box((-0.35, -20.0, -PILLAR_DISTANCE - 0.5), (0.35, 20.0, -PILLAR_DISTANCE))
    middle = -PILLAR_DISTANCE - 0.5 - gap
    b.box((-60.0, -60.0, middle - 0.1), (60.0, 60.0, middle + 0.1), turn_deg=turn_deg)
    return _scene("pillar", b, View((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), fov_y_deg=45.0))


def row_of_pillars() -> Scene:
    """Sixteen round pillars in a row on a floor before a wall, seen along the row from slightly beside it."""
    b = Builder()
    b.quad(60.0)
    b.box((-3.0, 0.0, -40.0), (-2.6, 4.0, 10.0))
    for z in np.arange(0.0, 24.0, 1.5):
        b.rod((0.0, 0.0, -z), (0.0, 3.0, -z), 0.22, sections=32)
        b.box((-0.35, 0.0, -z - 0.35), (0.35, 0.15, -z + 0.35))
        b.box((-0.35, 2.85, -z - 0.35), (0.35, 3.0, -z + 0.35))
    return _scene("row", b, View((1.5, 1.7, 4.5), (0.1, 1.4, -6.5), fov_y_deg=36.0))


def plate(azimuths_deg: tuple[float, ...]) -> Scene:
    """A plate of 2 cm on a floor, seen from above at angles about the vertical; 0 is edge-on, 90 from the side."""
    b = Builder()
    b.quad(60.0)
    x, z = PLATE_HALF_WIDTH, PLATE_HALF_LENGTH
    b.box((-x, 0.0, -z), (x, PLATE_HEIGHT, z))
    views = []
    for azimuth in np.deg2rad(azimuths_deg):
        eye = (5.0 * math.sin(azimuth), 2.6, 5.0 * math.cos(azimuth))
        views.append(View(eye, (0.0, 0.3, 0.0), fov_y_deg=38.0))
    return _scene("plate", b, *views)


def with_border(scene: Scene, view: int, height: int, border: int) -> Scene:
    """The scene with one view, which sees `border` more pixels on each side when rendered 2 border pixels larger."""
    seen = scene.cameras[view]
    tangent = math.tan(math.radians(seen.fov_y_deg) / 2) * (height + 2 * border) / height
    wide = replace(seen, fov_y_deg=2 * math.degrees(math.atan(tangent)))
    return Scene(scene.name, scene.vertices, scene.faces, (wide,), scene.radius)


def walk(scene: Scene, view: int, frames: int, step: float) -> Scene:
    """The scene seen from a path: `step` scene units a frame, mostly to the right, a little up and forward."""
    seen = scene.cameras[view]
    right, down, forward = seen.world_to_view()[:3, :3].numpy()
    way = 0.85 * right - 0.2 * down + 0.5 * forward
    way = step * way / np.linalg.norm(way)
    views = [
        replace(
            seen,
            eye=tuple(np.asarray(seen.eye) + i * way),
            target=tuple(np.asarray(seen.target) + i * way),
        )
        for i in range(frames)
    ]
    return Scene(scene.name, scene.vertices, scene.faces, tuple(views), scene.radius)


def _scene(name: str, builder: Builder, *views: View) -> Scene:
    vertices, faces = builder.mesh()
    return Scene(name, vertices, faces, views, RADIUS)
