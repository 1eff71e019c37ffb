"""Plane patches and spheres: ray intersection, normals, distances and triangles, in float64 world space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

_EDGE = 1e-12  # of the size of the coordinates: neighbouring patches leave no crack between them


@final
@dataclass(frozen=True)
class Patch:
    """A plane, half-plane, strip or rectangle: origin + a u + b v with a, b in their ranges; seen from both sides.

    Args:
        origin: world-space point.
        u, v: orthonormal directions; the normal is u x v.
        u_range, v_range: (low, high) in scene units, infinite by default.
    """

    origin: Vector
    u: Vector
    v: Vector
    u_range: tuple[float, float] = (-math.inf, math.inf)
    v_range: tuple[float, float] = (-math.inf, math.inf)

    @property
    def normal(self) -> Vector:
        """Unit normal u x v."""
        x, y, z = np.cross(self.u, self.v)
        return float(x), float(y), float(z)

    def hit(self, origin: Tensor, direction: Tensor, start: float = 0.0) -> Tensor:
        """Ray parameter of the hit beyond `start`, inf for none.

        Args:
            origin, direction: (..., 3) float64, broadcastable; directions of any length.
        Returns: (...,) float64.
        """
        normal, to_origin = origin.new_tensor(self.normal), origin.new_tensor(self.origin) - origin
        t = (to_origin * normal).sum(-1) / (direction * normal).sum(-1)  # a parallel ray gives inf or NaN: no hit
        place = t[..., None] * direction - to_origin
        slack = _EDGE * (1.0 + origin.abs().amax(-1) + t.abs())
        inside = torch.isfinite(t) & (t > start)
        for axis, (low, high) in ((self.u, self.u_range), (self.v, self.v_range)):
            along = (place * origin.new_tensor(axis)).sum(-1)
            inside = inside & (along >= low - slack) & (along <= high + slack)
        return torch.where(inside, t, torch.inf)

    def normal_at(self, points: Tensor) -> Tensor:
        """Unit normals (..., 3) at points (..., 3)."""
        return points.new_tensor(self.normal).expand_as(points)

    def distance(self, points: Tensor) -> Tensor:
        """Distances (...,) from points (..., 3) to the patch."""
        place = points - points.new_tensor(self.origin)
        square = (place * points.new_tensor(self.normal)).sum(-1) ** 2
        for axis, (low, high) in ((self.u, self.u_range), (self.v, self.v_range)):
            along = (place * points.new_tensor(axis)).sum(-1)
            square = square + (along - along.clamp(low, high)) ** 2
        return square.sqrt()

    def mesh(self, centre: Array, extent: float, segments: int) -> tuple[Array, NDArray[np.int64]]:
        """Two triangles of the patch, cut at `extent` from `centre`; see `AnalyticScene.mesh`."""
        u, v, origin = (np.asarray(a, np.float64) for a in (self.u, self.v, self.origin))
        cuts = []
        for axis, (low, high) in ((u, self.u_range), (v, self.v_range)):
            middle = min(max(float((centre - origin) @ axis), low), high)
            cuts.append(
                (low if math.isfinite(low) else middle - extent, high if math.isfinite(high) else middle + extent)
            )
        (a, b), (c, d) = cuts
        corners = [origin + p * u + q * v for p, q in ((a, c), (b, c), (b, d), (a, d))]
        return np.stack(corners), np.array([[0, 1, 2], [0, 2, 3]], np.int64)


@final
@dataclass(frozen=True)
class Sphere:
    """A sphere; normals point outwards.

    Args:
        centre: world-space point.
        radius: > 0, scene units.
    """

    centre: Vector
    radius: float

    def hit(self, origin: Tensor, direction: Tensor, start: float = 0.0) -> Tensor:
        """Ray parameter of the nearest hit beyond `start`, inf for none; arguments as `Patch.hit`."""
        offset = origin - origin.new_tensor(self.centre)
        square = (direction * direction).sum(-1)
        closest = -(offset * direction).sum(-1) / square
        # The distance of the ray from the centre keeps its digits where the usual discriminant cancels.
        miss = offset + closest[..., None] * direction
        inner = self.radius**2 - (miss * miss).sum(-1)
        half = torch.sqrt(inner.clamp_min(0.0) / square)
        near, far = closest - half, closest + half
        t = torch.where(near > start, near, far)
        return torch.where((inner >= 0) & (t > start), t, torch.inf)

    def normal_at(self, points: Tensor) -> Tensor:
        """Unit outward normals (..., 3) at points (..., 3)."""
        return torch.nn.functional.normalize(points - points.new_tensor(self.centre), dim=-1)

    def distance(self, points: Tensor) -> Tensor:
        """Distances (...,) from points (..., 3) to the surface."""
        return (torch.linalg.vector_norm(points - points.new_tensor(self.centre), dim=-1) - self.radius).abs()

    def mesh(self, centre: Array, extent: float, segments: int) -> tuple[Array, NDArray[np.int64]]:
        """Latitudes and longitudes, `segments` around the equator; see `AnalyticScene.mesh`."""
        rings = max(4, segments // 2)
        polar = np.pi * np.arange(1, rings) / rings
        turn = 2.0 * np.pi * np.arange(segments) / segments
        ring = np.stack(
            (
                np.outer(np.sin(polar), np.cos(turn)),
                np.outer(np.sin(polar), np.sin(turn)),
                np.outer(np.cos(polar), np.ones(segments)),
            ),
            axis=-1,
        ).reshape(-1, 3)
        unit = np.concatenate(([[0.0, 0.0, 1.0]], ring, [[0.0, 0.0, -1.0]]))
        row = 1 + segments * np.arange(rings - 1)[:, None]
        here, there = np.arange(segments), (np.arange(segments) + 1) % segments
        north = np.stack((np.zeros(segments, np.int64), 1 + here, 1 + there), axis=1)
        south = np.stack((np.full(segments, len(unit) - 1), row[-1] + there, row[-1] + here), axis=1)
        a, b, c, d = (row[:-1] + here, row[1:] + here, row[1:] + there, row[:-1] + there)
        sides = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
        faces = np.concatenate((north, sides, south)).astype(np.int64)
        return np.asarray(self.centre) + self.radius * unit, faces
