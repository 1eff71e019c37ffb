"""Parts that the built-in scenes are put together from: metres, y up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from torch_ssao import checks

Point = Sequence[float]


def import_trimesh() -> Any:
    """The trimesh package. Raises: SceneError when it is not installed."""
    try:
        import trimesh
    except ImportError as error:
        raise checks.SceneError(
            "scenes need trimesh, which is not installed: pip install torch_ssao[scenes]"
        ) from error
    return trimesh


@final
class Builder:
    """Collects parts and joins them into one vertex and one face array; every part keeps its own vertices."""

    def __init__(self) -> None:
        self._trimesh = import_trimesh()
        self._vertices: list[NDArray[np.float64]] = []
        self._faces: list[NDArray[np.int64]] = []
        self._count = 0

    def mesh(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """vertices (V, 3) and faces (F, 3) of everything added so far."""
        return np.concatenate(self._vertices), np.concatenate(self._faces)

    def add(self, vertices: Any, faces: Any) -> None:
        """Add triangles (F, 3) over vertices (V, 3)."""
        self._vertices.append(np.asarray(vertices, dtype=np.float64))
        self._faces.append(np.asarray(faces, dtype=np.int64) + self._count)
        self._count += len(self._vertices[-1])

    def box(self, low: Point, high: Point, *, turn_deg: float = 0.0) -> None:
        """Box between two corners, turned about the vertical axis through its centre."""
        low_corner, high_corner = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
        part = self._trimesh.creation.box(extents=high_corner - low_corner)
        self.add(_turned(part.vertices, turn_deg) + (low_corner + high_corner) / 2, part.faces)

    def wall(
        self, low: Point, high: Point, holes: Sequence[tuple[float, float, float, float]], *, axis: int = 0
    ) -> None:
        """Box with rectangular openings, none of which overlap along the wall.

        `holes` are (start, stop, bottom, top) along `axis` (0 = x, 2 = z) and y, in world coordinates.
        """
        at = low[axis]
        for start, stop, bottom, top in sorted(holes):
            self._slab(low, high, axis, (at, start), (low[1], high[1]))
            self._slab(low, high, axis, (start, stop), (low[1], bottom))
            self._slab(low, high, axis, (start, stop), (top, high[1]))
            at = stop
        self._slab(low, high, axis, (at, high[axis]), (low[1], high[1]))

    def rod(
        self, start: Point, end: Point, radius: float, *, sections: int = 24, end_radius: float | None = None
    ) -> None:
        """Capped cylinder, or cone frustum, between two points."""
        a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
        axis = (b - a) / np.linalg.norm(b - a)
        side = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
        side /= np.linalg.norm(side)
        angle = 2 * np.pi * np.arange(sections) / sections
        ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
        rings = (a + radius * ring, b + (radius if end_radius is None else end_radius) * ring)
        i, j = np.arange(sections), (np.arange(sections) + 1) % sections
        sides = np.concatenate((np.stack((i, j, j + sections), 1), np.stack((i, j + sections, i + sections), 1)))
        foot, tip = np.full_like(i, 2 * sections), np.full_like(i, 2 * sections + 1)
        caps = np.concatenate((np.stack((j, i, foot), 1), np.stack((i + sections, j + sections, tip), 1)))
        self.add(np.concatenate((*rings, a[None], b[None])), np.concatenate((sides, caps)))

    def sphere(self, center: Point, radius: float, *, subdivisions: int = 3) -> None:
        """Geodesic sphere of 20 * 4^subdivisions faces."""
        part = self._trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
        self.add(part.vertices + np.asarray(center), part.faces)

    def torus(self, center: Point, major: float, minor: float, rotation: NDArray[np.float64] | None = None) -> None:
        """Ring about the vertical axis, turned by a 3x3 rotation."""
        part = self._trimesh.creation.torus(major, minor, major_sections=48, minor_sections=20)
        upright = part.vertices[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
        self.add(upright @ (np.eye(3) if rotation is None else rotation).T + np.asarray(center), part.faces)

    def gable(self, low: Point, high: Point, *, axis: int = 2) -> None:
        """Roof over a rectangle: a triangular prism whose ridge runs along `axis` (0 = x, 2 = z), closed all round."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        if axis == 2:
            xm = (x0 + x1) / 2
            points = [(x0, y0, z0), (x1, y0, z0), (xm, y1, z0), (x0, y0, z1), (x1, y0, z1), (xm, y1, z1)]
        else:
            zm = (z0 + z1) / 2
            points = [(x0, y0, z1), (x0, y0, z0), (x0, y1, zm), (x1, y0, z1), (x1, y0, z0), (x1, y1, zm)]
        faces = [(0, 2, 1), (3, 4, 5), (0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)]
        self.add(points, faces)

    def quad(self, half: float, y: float = 0.0) -> None:
        """Square of ground about the origin."""
        points = [(-half, y, -half), (half, y, -half), (half, y, half), (-half, y, half)]
        self.add(points, [(0, 2, 1), (0, 3, 2)])

    def _slab(self, low: Point, high: Point, axis: int, along: tuple[float, float], up: tuple[float, float]) -> None:
        if along[1] - along[0] <= 1e-9 or up[1] - up[0] <= 1e-9:
            return
        first, last = list(low), list(high)
        first[axis], last[axis] = along
        first[1], last[1] = up
        self.box(first, last)


def _turned(vertices: NDArray[np.float64], turn_deg: float) -> NDArray[np.float64]:
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return vertices @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T
