"""Volumetric obscurance of a depth image by point samples in float64: the share of a volume that lies behind the image.

The reference of the paper's Fig. 13 (256 points a pixel, no blur), with three volumes over the visible surface:

- "ball": the half-ball of radius R about the normal;
- "box": the upright box of Fig. 7c, half-size R across the tangent plane along the image's axes, h R along the normal;
- "prism": the volume that StatVO averages over. Its section is the pixel's window on the screen (half-size f R / z
  pixels), its sides are the view rays through the window's edge, and its top is at the height h R along the normal.

A point is occupied where the image holds a surface in front of it. All three lie above the surface, so a plane gives
visibility 1. Points are a Hammersley set, shifted around the unit cube by an offset of each pixel's own (seeded), so
that every pixel's estimate is unbiased and errors of different pixels are independent.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

SHAPES: Final = ("ball", "box", "prism")
# A point must lie deeper than the surface by this share of its depth: points on the surface itself are free.
ROUNDING: Final = 1e-9
# A ray this close to parallel with a pixel's tangent plane (cosine) meets it at the pixel's own depth instead.
GRAZING: Final = 1e-6


class Answer(NamedTuple):
    visibility: Floats  # (B, H, W), 1 at invalid pixels
    kept: Floats  # (B, H, W) share of the points that fell on the screen; visibility is over these alone


class View:
    """One image: its camera, the surface that each pixel sees, and what lies in front of a point."""

    def __init__(
        self, depth: Floats, valid: Bools, normal: Floats | None, camera: tuple[float, ...], flat: bool, planar: bool
    ) -> None:
        self.fx, self.fy, self.cx, self.cy = camera
        self.flat, self.planar = flat, planar and normal is not None
        self.valid, self.size = valid, depth.shape
        self.depth = np.where(valid, depth, 1.0)
        self.v, self.u = np.indices(depth.shape) + 0.5
        origin, direction = self.rays(self.u, self.v)
        self.position = origin + direction * self.depth[..., None]
        towards_eye = np.broadcast_to(np.array([0.0, 0.0, -1.0]), self.position.shape)
        self.normal = towards_eye if normal is None else np.moveaxis(normal, 0, -1)

    def rays(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Origin and direction of the view rays through screen points; the ray parameter is depth."""
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        zero, one = np.zeros_like(x), np.ones_like(x)
        sideways = np.stack((x, y, zero), axis=-1)
        forward = np.stack((zero, zero, one), axis=-1)
        return (sideways, forward) if self.flat else (np.zeros_like(sideways), sideways + forward)

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Screen coordinates of view-space points; nonsense behind the camera."""
        z = np.ones_like(points[..., 2]) if self.flat else np.where(points[..., 2] > 0, points[..., 2], 1.0)
        return self.fx * points[..., 0] / z + self.cx, self.fy * points[..., 1] / z + self.cy

    def behind(self, points: Floats) -> tuple[Bools, Bools]:
        """Which points lie behind the visible surface, and which are on the screen at all."""
        u, v = self.project(points)
        height, width = self.size
        on_screen = (points[..., 2] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        column = np.clip(np.floor(np.where(on_screen, u, 0.0)).astype(int), 0, width - 1)
        row = np.clip(np.floor(np.where(on_screen, v, 0.0)).astype(int), 0, height - 1)
        surface = self.depth[row, column]
        if self.planar:
            origin, direction = self.rays(u, v)
            normal = self.normal[row, column]
            facing = (direction * normal).sum(axis=-1)
            usable = facing < -GRAZING * np.linalg.norm(direction, axis=-1)
            along = ((self.position[row, column] - origin) * normal).sum(axis=-1) / np.where(usable, facing, -1.0)
            surface = np.where(usable & (along > 0), along, surface)
        occupied = self.valid[row, column] & (surface < points[..., 2] * (1.0 - ROUNDING))
        return on_screen & occupied, on_screen


def volumetric_visibility(
    depth: npt.ArrayLike,
    valid: npt.ArrayLike,
    normal: npt.ArrayLike | None,
    fx: npt.ArrayLike,
    fy: npt.ArrayLike,
    cx: npt.ArrayLike,
    cy: npt.ArrayLike,
    orthographic: bool,
    *,
    shape: str,
    radius: float,
    height: float = 1.0,
    samples: int = 256,
    seed: int = 0,
    planar: bool = True,
) -> Answer:
    """1 - the occupied share of the volume above the surface, at every pixel of a batch of depth images.

    Args:
        depth: (B, L, H, W) view-space z in scene units; the nearest surface `depth[:, 0]` alone is used, and everything
            behind it is solid.
        valid: (B, L, H, W) bool; a sample is used where this holds and its depth is positive and finite. Points seen
            through other pixels are free.
        normal: (B, 3, H, W) unit view-space normals, or None for volumes about the viewing axis.
        fx, fy, cx, cy: (B,) or scalar, pixels (orthographic: fx and fy in pixels per scene unit).
        orthographic: parallel projection instead of a pinhole.
        shape: "ball", "box" or "prism". radius, height: R in scene units, h as a fraction of R.
        samples: points a pixel. seed: of the pixels' offsets.
        planar: the surface inside a pixel is its tangent plane (needs normals), so that tilted planes do not occlude
            themselves; otherwise the stored depth, as the paper's shader reads it.
    """
    if shape not in SHAPES:
        raise ValueError(f"shape must be one of {SHAPES}, got {shape!r}")
    z = np.array(depth, dtype=np.float64)[:, 0]
    usable = np.asarray(valid, dtype=bool)[:, 0] & np.isfinite(z) & (z > 0.0)
    normals = [None] * len(z) if normal is None else list(np.asarray(normal, dtype=np.float64))
    intrinsics = np.stack([np.broadcast_to(np.asarray(a, dtype=np.float64), (len(z),)) for a in (fx, fy, cx, cy)], 1)
    rng = np.random.default_rng(seed)
    visibility, kept = np.ones_like(z), np.ones_like(z)
    for b in range(len(z)):
        view = View(z[b], usable[b], normals[b], tuple(intrinsics[b]), orthographic, planar)
        occupied, seen = np.zeros(view.size), np.zeros(view.size)
        for points, exists in volume_points(view, shape, radius, height * radius, samples, rng):
            behind, on_screen = view.behind(points)
            occupied += exists & behind
            seen += exists & on_screen
        visibility[b] = np.where(usable[b] & (seen > 0), 1.0 - occupied / np.maximum(seen, 1.0), 1.0)
        kept[b] = seen / samples
    return Answer(visibility, kept)


def volume_points(
    view: View, shape: str, radius: float, top: float, samples: int, rng: np.random.Generator
) -> Iterator[tuple[Floats, Bools]]:
    """One point a pixel at a time (H, W, 3), evenly in the volume, and whether it exists (a prism's ray may miss)."""
    shift = rng.random((3, *view.size))
    across, along = tangents(view.normal)
    everywhere = np.ones(view.size, dtype=bool)
    for i in range(samples):
        base = np.array([(i + 0.5) / samples, radical_inverse(i, 2), radical_inverse(i, 3)])
        a, b, c = (base[:, None, None] + shift) % 1.0
        if shape == "ball":
            # Equal volumes: the cube root of the radius, and the height over the unit circle, are uniform.
            rise, distance = b, radius * np.cbrt(a)
            flat = np.sqrt(1.0 - rise**2)
            x, y, up = flat * np.cos(2.0 * np.pi * c), flat * np.sin(2.0 * np.pi * c), rise
            offset = x[..., None] * across + y[..., None] * along + up[..., None] * view.normal
            yield view.position + distance[..., None] * offset, everywhere
        elif shape == "box":
            x, y = radius * (2.0 * b - 1.0), radius * (2.0 * c - 1.0)
            offset = x[..., None] * across + y[..., None] * along + (top * a)[..., None] * view.normal
            yield view.position + offset, everywhere
        else:
            yield prism_point(view, radius, top * a, 2.0 * b - 1.0, 2.0 * c - 1.0)


def prism_point(view: View, radius: float, rise: Floats, x: Floats, y: Floats) -> tuple[Floats, Bools]:
    """The point at height `rise` over each pixel's tangent plane, on the ray through (x, y) in [-1, 1]^2 of its window.

    Rays that go up from the plane (beyond its horizon) have none.
    """
    scale = np.ones(view.size) if view.flat else view.depth
    origin, direction = view.rays(view.u + x * view.fx * radius / scale, view.v + y * view.fy * radius / scale)
    facing = (direction * view.normal).sum(axis=-1)
    depth = (rise + ((view.position - origin) * view.normal).sum(axis=-1)) / np.where(facing < 0, facing, -1.0)
    return origin + direction * depth[..., None], (facing < 0) & (depth > 0)


def tangents(normal: Floats) -> tuple[Floats, Floats]:
    """Unit tangents along the image's x axis and across it."""
    axis = np.where(np.abs(normal[..., :1]) < 0.99, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    across = axis - (axis * normal).sum(axis=-1, keepdims=True) * normal
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return across, np.cross(normal, across)


def radical_inverse(index: int, base: int) -> float:
    """Digits of the index mirrored at the point."""
    value, unit = 0.0, 1.0
    while index:
        unit /= base
        index, digit = divmod(index, base)
        value += digit * unit
    return value
