"""Plane patches, disks, spheres and cylinders: ray intersection, normals, distances and triangles, in float64 world space."""

from __future__ import annotations

import math
from collections.abc import Callable
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
class Annulus:
    """A horizontal ring, a disk (inner 0) or a plane with a round hole (outer inf); seen from both sides.

    Args:
        centre: world-space point.
        inner, outer: radii, 0 <= inner < outer, scene units.
    """

    centre: Vector
    inner: float
    outer: float

    def hit(self, origin: Tensor, direction: Tensor, start: float = 0.0) -> Tensor:
        """Ray parameter of the hit beyond `start`, inf for none; arguments as `Patch.hit`."""
        to_centre = origin.new_tensor(self.centre) - origin
        t = to_centre[..., 2] / direction[..., 2]
        lateral = torch.linalg.vector_norm((t[..., None] * direction - to_centre)[..., :2], dim=-1)
        slack = _EDGE * (1.0 + origin.abs().amax(-1) + t.abs())
        inside = torch.isfinite(t) & (t > start) & (lateral >= self.inner - slack) & (lateral <= self.outer + slack)
        return torch.where(inside, t, torch.inf)

    def normal_at(self, points: Tensor) -> Tensor:
        """Unit normals (..., 3), upwards, at points (..., 3)."""
        return points.new_tensor((0.0, 0.0, 1.0)).expand_as(points)

    def distance(self, points: Tensor) -> Tensor:
        """Distances (...,) from points (..., 3) to the ring."""
        place = points - points.new_tensor(self.centre)
        lateral = torch.linalg.vector_norm(place[..., :2], dim=-1)
        return torch.hypot(lateral - lateral.clamp(self.inner, self.outer), place[..., 2])

    def mesh(self, centre: Array, extent: float, segments: int) -> tuple[Array, NDArray[np.int64]]:
        """Sectors between the circles, the outer one at least `extent` from `centre`; see `AnalyticScene.mesh`."""
        middle = np.asarray(self.centre)
        outer = self.outer
        if math.isinf(outer):
            outer = (extent + float(np.linalg.norm((centre - middle)[:2]))) / math.cos(math.pi / segments)
        circle = _circle(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), segments)
        here, there = np.arange(segments), (np.arange(segments) + 1) % segments
        if self.inner == 0.0:
            points = np.concatenate(([middle], middle + outer * circle))
            return points, np.stack((0 * here, 1 + here, 1 + there), axis=1).astype(np.int64)
        points = np.concatenate((middle + outer * circle, middle + self.inner * circle))
        return points, _band(segments + here, segments + there, here, there)


@final
@dataclass(frozen=True)
class Sphere:
    """A sphere, or what of it lies between two heights; normals point outwards.

    Args:
        centre: world-space point.
        radius: > 0, scene units.
        z_range: (low, high) world-space heights of the part kept, scene units; all by default.
    """

    centre: Vector
    radius: float
    z_range: tuple[float, float] = (-math.inf, math.inf)

    def hit(self, origin: Tensor, direction: Tensor, start: float = 0.0) -> Tensor:
        """Ray parameter of the nearest hit beyond `start`, inf for none; arguments as `Patch.hit`."""
        offset = origin - origin.new_tensor(self.centre)
        closest, half, inner = _chord(offset, direction, self.radius)

        def kept(t: Tensor) -> Tensor:
            height = origin[..., 2] + t * direction[..., 2]
            slack = _EDGE * (1.0 + origin.abs().amax(-1) + t.abs())
            return (t > start) & (height >= self.z_range[0] - slack) & (height <= self.z_range[1] + slack)

        return _nearest(closest, half, inner, kept)

    def normal_at(self, points: Tensor) -> Tensor:
        """Unit outward normals (..., 3) at points (..., 3)."""
        return torch.nn.functional.normalize(points - points.new_tensor(self.centre), dim=-1)

    def distance(self, points: Tensor) -> Tensor:
        """Distances (...,) from points (..., 3) to the surface."""
        offset = points - points.new_tensor(self.centre)
        first, last = self._polar_range()
        if (first, last) == (0.0, math.pi):
            return (torch.linalg.vector_norm(offset, dim=-1) - self.radius).abs()
        lateral, height = torch.linalg.vector_norm(offset[..., :2], dim=-1), offset[..., 2]
        polar = torch.atan2(lateral, height)
        nearest = polar.clamp(first, last)
        on_rim = torch.hypot(lateral - self.radius * nearest.sin(), height - self.radius * nearest.cos())
        return torch.where(polar == nearest, (torch.hypot(lateral, height) - self.radius).abs(), on_rim)

    def mesh(self, centre: Array, extent: float, segments: int) -> tuple[Array, NDArray[np.int64]]:
        """Latitudes and longitudes, `segments` around the equator; see `AnalyticScene.mesh`."""
        first, last = self._polar_range()
        rings = max(4, math.ceil(segments * (last - first) / (2.0 * math.pi)))
        polar = first + (last - first) * np.arange(int(first == 0.0), rings + int(last < math.pi)) / rings
        circle = _circle(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), segments)
        up = np.array([0.0, 0.0, 1.0])
        unit = (np.sin(polar)[:, None, None] * circle + np.cos(polar)[:, None, None] * up).reshape(-1, 3)
        here, there = np.arange(segments), (np.arange(segments) + 1) % segments
        row = segments * np.arange(len(polar))[:, None]
        faces = [_band(row[:-1] + here, row[:-1] + there, row[1:] + here, row[1:] + there)]
        for pole, at_pole, ends in ((up, first == 0.0, (here, there)), (-up, last == math.pi, (there, here))):
            if at_pole:
                rim = 0 if pole[2] > 0 else row[-1]
                faces.append(np.stack((np.full(segments, len(unit)), rim + ends[0], rim + ends[1]), axis=1))
                unit = np.concatenate((unit, [pole]))
        return np.asarray(self.centre) + self.radius * unit, np.concatenate(faces).astype(np.int64)

    def _polar_range(self) -> tuple[float, float]:
        """Polar angles of the upper and the lower rim, 0 and pi at a pole."""
        low, high = (min(max((z - self.centre[2]) / self.radius, -1.0), 1.0) for z in self.z_range)
        return math.acos(high), math.acos(low)


@final
@dataclass(frozen=True)
class Cylinder:
    """The side of a cylinder, finite or not; normals point away from the axis.

    Args:
        origin: world-space point on the axis.
        axis: unit direction.
        radius: > 0, scene units.
        reach: (low, high) along the axis from the origin, infinite by default.
    """

    origin: Vector
    axis: Vector
    radius: float
    reach: tuple[float, float] = (-math.inf, math.inf)

    def hit(self, origin: Tensor, direction: Tensor, start: float = 0.0) -> Tensor:
        """Ray parameter of the nearest hit beyond `start`, inf for none; arguments as `Patch.hit`."""
        axis, offset = origin.new_tensor(self.axis), origin - origin.new_tensor(self.origin)
        along_origin, along_ray = (offset * axis).sum(-1), (direction * axis).sum(-1)
        across = direction - along_ray[..., None] * axis
        closest, half, inner = _chord(offset - along_origin[..., None] * axis, across, self.radius)

        def kept(t: Tensor) -> Tensor:
            along = along_origin + t * along_ray
            slack = _EDGE * (1.0 + origin.abs().amax(-1) + t.abs())
            return (t > start) & (along >= self.reach[0] - slack) & (along <= self.reach[1] + slack)

        return _nearest(closest, half, inner, kept)

    def normal_at(self, points: Tensor) -> Tensor:
        """Unit outward normals (..., 3) at points (..., 3)."""
        axis, offset = points.new_tensor(self.axis), points - points.new_tensor(self.origin)
        return torch.nn.functional.normalize(offset - (offset * axis).sum(-1, keepdim=True) * axis, dim=-1)

    def distance(self, points: Tensor) -> Tensor:
        """Distances (...,) from points (..., 3) to the surface."""
        axis, offset = points.new_tensor(self.axis), points - points.new_tensor(self.origin)
        along = (offset * axis).sum(-1)
        lateral = torch.linalg.vector_norm(offset - along[..., None] * axis, dim=-1)
        return torch.hypot(lateral - self.radius, along - along.clamp(*self.reach))

    def mesh(self, centre: Array, extent: float, segments: int) -> tuple[Array, NDArray[np.int64]]:
        """`segments` strips, cut at `extent` from `centre`; see `AnalyticScene.mesh`."""
        axis, origin = np.asarray(self.axis, np.float64), np.asarray(self.origin, np.float64)
        middle = min(max(float((centre - origin) @ axis), self.reach[0]), self.reach[1])
        low, high = (
            end if math.isfinite(end) else middle + sign * extent for end, sign in zip(self.reach, (-1, 1), strict=True)
        )
        first = np.eye(3)[np.argmin(np.abs(axis))]
        first = first - (first @ axis) * axis
        first = first / np.linalg.norm(first)
        circle = self.radius * _circle(first, np.cross(axis, first), segments)
        here, there = np.arange(segments), (np.arange(segments) + 1) % segments
        points = np.concatenate((origin + high * axis + circle, origin + low * axis + circle))
        return points, _band(here, there, segments + here, segments + there)


Surface = Patch | Annulus | Sphere | Cylinder


def _chord(offset: Tensor, direction: Tensor, radius: float) -> tuple[Tensor, Tensor, Tensor]:
    """Middle and half-length (in ray parameters) of a ray's chord in a ball; the last is < 0 where it misses.

    The distance of the ray from the centre keeps its digits where the usual discriminant cancels.
    """
    square = (direction * direction).sum(-1)
    closest = -(offset * direction).sum(-1) / square
    miss = offset + closest[..., None] * direction
    inner = radius**2 - (miss * miss).sum(-1)
    return closest, torch.sqrt(inner.clamp_min(0.0) / square), inner


def _nearest(closest: Tensor, half: Tensor, inner: Tensor, kept: Callable[[Tensor], Tensor]) -> Tensor:
    """The first end of a chord that is kept, inf for none."""
    near, far = closest - half, closest + half
    found = torch.where(kept(near), near, torch.where(kept(far), far, torch.inf))
    return torch.where(inner >= 0, found, torch.inf)  # a ray along the axis of a cylinder gives NaN: no hit


def _circle(first: Array, second: Array, segments: int) -> Array:
    """(segments, 3) points of the unit circle that `first` and `second` span."""
    turn = 2.0 * np.pi * np.arange(segments) / segments
    return np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second


def _band(a: NDArray[np.int64], b: NDArray[np.int64], c: NDArray[np.int64], d: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles for each quadrilateral of the upper edge a b and the lower edge c d."""
    return np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, c, d), (a, d, b))]).astype(np.int64)
