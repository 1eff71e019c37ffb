"""Statistical volumetric obscurance, one pixel and one window at a time, in float64.

Written from the paper alone; it judges the library and shares nothing with it. No summed-area table anywhere: every
window is summed sample by sample. Positions and depths are summed as differences from the centre, which is the same
mean with less rounding.

Approximate tables (Sec. 7.1) are stated without tables too: the image is cut into blocks of scale x scale pixels, each
block and peeled layer is one sample - the mean position of its valid pixels, as heavy as their number - and its mass
lies evenly on the whole block, which is what a low-resolution table looked up bilinearly integrates. Positions are
averaged, not depths alone: the mean of points of a plane lies on the plane, so a plane stays open.

Source: "Adaptively Layered Statistical Volumetric Obscurance" (HPG 2015), Eq. 3-7, Sections 3 to 6 and 7.1.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Rectangle = tuple[float, float, float, float]

# Layers holding less than this area (in pixels) are dropped, and so are quadrants that hold no more.
MINIMUM_COUNT: Final = 1e-6
# Depths and heights closer to zero than this many machine epsilons (relative) are rounding, not geometry.
ROUNDING_EPSILONS: Final = 8.0
INVALID: Final = -1


class Camera:
    """Camera of one image: where a sample lies in view space, and how many pixels a length spans at its depth."""

    def __init__(self, fx: float, fy: float, cx: float, cy: float, orthographic: bool) -> None:
        self.fx, self.fy, self.cx, self.cy = fx, fy, cx, cy
        self.orthographic = orthographic

    def position(self, row: int, column: int, z: float) -> Floats:
        """View-space position of the sample of depth z seen through the centre of a pixel."""
        scale = 1.0 if self.orthographic else z
        return np.array([(column + 0.5 - self.cx) / self.fx * scale, (row + 0.5 - self.cy) / self.fy * scale, z])

    def window(self, x: float, y: float, z: float, radius: float) -> Rectangle:
        """Sample box about (x, y) on the screen: left, top, right, bottom, in pixels, not yet clipped."""
        scale = 1.0 if self.orthographic else z
        half_x, half_y = self.fx * radius / scale, self.fy * radius / scale
        return x - half_x, y - half_y, x + half_x, y + half_y


class Samples(NamedTuple):
    """What windows are summed over: one sample a block of scale x scale pixels and peeled layer."""

    position: Floats  # (L, rows, columns, 3), zero where a block holds nothing
    count: Floats  # (L, rows, columns) valid pixels of the block
    scale: int
    size: tuple[int, int]  # of the image in pixels: height, width

    def weights(self, rectangle: Rectangle) -> tuple[slice, slice, Floats]:
        """Rows and columns of the blocks a rectangle touches, and the pixels it holds of each sample (L, rows, columns).

        The rectangle is clipped to the image; a block's mass lies evenly on all of it, also on what sticks out.
        """
        left, top, right, bottom = rectangle
        rows, down = covered(top, bottom, self.size[0], self.scale)
        columns, across = covered(left, right, self.size[1], self.scale)
        return rows, columns, np.outer(down, across) * self.count[:, rows, columns] / self.scale**2


def samples_of(depth: Floats, valid: Bools, camera: Camera, scale: int) -> Samples:
    """One sample a block and peeled layer; of every pixel itself for scale 1."""
    peels, height, width = depth.shape
    shape = (peels, -(-height // scale), -(-width // scale))
    position, count = np.zeros((*shape, 3)), np.zeros(shape)
    for peel, i, j in np.ndindex(shape):
        held = np.argwhere(valid[peel, i * scale : (i + 1) * scale, j * scale : (j + 1) * scale])
        if len(held):
            pixels = [(i * scale + int(row), j * scale + int(column)) for row, column in held]
            points = np.array([camera.position(row, column, depth[peel, row, column]) for row, column in pixels])
            # As a difference from the first, so that the mean of equal depths is that depth.
            position[peel, i, j] = points[0] + (points - points[0]).mean(axis=0)
            count[peel, i, j] = len(points)
    return Samples(position, count, scale, (height, width))


def covered(low: float, high: float, size: int, scale: int) -> tuple[slice, Floats]:
    """Blocks of `scale` pixels in a row of `size` pixels that [low, high] touches, and the length it covers of each."""
    low, high = max(low, 0.0), min(high, float(size))
    blocks = -(-size // scale)
    first, last = min(math.floor(low / scale), blocks), max(math.ceil(high / scale), 0)
    lengths = [max(0.0, min((k + 1.0) * scale, high) - max(float(k * scale), low)) for k in range(first, last)]
    return slice(first, first + len(lengths)), np.array(lengths, dtype=np.float64)


def psi(s: float, slope: float) -> float:
    """Obscurance of a box filled to the height s: linear inside the box, falling off above it."""
    if s <= 0.0:
        return 0.0
    return s if s <= 1.0 else max(0.0, 1.0 - slope * (s - 1.0))


def adaptive_labels(samples: Samples, camera: Camera, radius: float, rounds: int, eps: float) -> Ints:
    """Split every node at the local mean depth, `rounds` times; the upper (nearer) child comes first (Sec. 5).

    The window of a sample lies about its block's centre, at the size that its own (mean) depth gives.
    """
    depth, scale = samples.position[..., 2], samples.scale
    labels = np.where(samples.count > 0, 0, INVALID)
    for _ in range(rounds):
        children = labels.copy()
        for peel, row, column in np.argwhere(samples.count > 0):
            z, node = depth[peel, row, column], labels[peel, row, column]
            window = camera.window(scale * (column + 0.5), scale * (row + 0.5), z, radius)
            rows, columns, weight = samples.weights(window)
            weight = weight * (labels[:, rows, columns] == node)
            total = weight.sum()
            above_mean = (weight * (depth[:, rows, columns] - z)).sum() / total if total > 0.0 else 0.0
            is_upper = above_mean > ROUNDING_EPSILONS * eps * abs(z)
            children[peel, row, column] = 2 * node + (0 if is_upper else 1)
        labels = children
    return labels


def uniform_labels(samples: Samples, layers: int) -> Ints:
    """Cut the depth range of the samples into slices of equal thickness (Sec. 4)."""
    depth, held = samples.position[..., 2], samples.count > 0
    labels = np.full(depth.shape, INVALID)
    if not held.any():
        return labels
    nearest, farthest = depth[held].min(), depth[held].max()
    for sample in map(tuple, np.argwhere(held)):
        fraction = (depth[sample] - nearest) / (farthest - nearest) if farthest > nearest else 0.0
        labels[sample] = min(max(math.floor(fraction * layers), 0), layers - 1)
    return labels


def box_obscurance(
    samples: Samples,
    labels: Ints,
    rectangle: Rectangle,
    centre: Floats,
    normal: Floats,
    box: float,
    slope: float,
    eps: float,
) -> float | None:
    """Eq. 5 to 7 over one rectangle; None where it holds no samples. `box` is the height of the sample box."""
    rows, columns, pixels = samples.weights(rectangle)
    near = labels[:, rows, columns]
    heights = (samples.position[:, rows, columns] - centre) @ normal
    rounding = ROUNDING_EPSILONS * eps * math.sqrt(float(centre @ centre))
    obscured, counted = 0.0, 0.0
    for label in np.unique(near[near != INVALID]):
        weight = pixels * (near == label)
        count = float(weight.sum())
        if count < MINIMUM_COUNT:
            continue
        mean_height = float((weight * heights).sum()) / count
        obscured += count * (0.0 if mean_height <= rounding else psi(mean_height / box, slope))
        counted += count
    return obscured / counted if counted > 0.0 else None


def split_at(rectangle: Rectangle, x: float, y: float) -> list[Rectangle]:
    """The four parts of a rectangle that meet at (x, y)."""
    left, top, right, bottom = rectangle
    return [(left, top, x, y), (x, top, right, y), (left, y, x, bottom), (x, y, right, bottom)]


def image_visibility(
    depth: Floats,
    valid: Bools,
    normal: Floats | None,
    camera: Camera,
    samples: Samples,
    labels: Ints,
    *,
    radius: float,
    height: float,
    slope: float,
    contrast: float,
    eps: float,
    quadrants: bool,
) -> Floats:
    """Visibility (H, W) of one image whose samples are labelled already; windows and centres are full resolution."""
    visibility = np.ones(depth.shape[-2:])
    for row, column in np.argwhere(valid[0]):
        n = np.array([0.0, 0.0, -1.0]) if normal is None else normal[:, row, column]
        window = camera.window(column + 0.5, row + 0.5, depth[0, row, column], radius)
        parts = split_at(window, column + 0.5, row + 0.5) if quadrants else [window]
        centre = camera.position(row, column, depth[0, row, column])
        answers = [box_obscurance(samples, labels, p, centre, n, height * radius, slope, eps) for p in parts]
        held = [answer for answer in answers if answer is not None]
        obscurance = sum(held) / len(held) if held else 0.0
        # Rounding can leave a full box a hair above 1, and a fractional power of a negative number is NaN.
        visibility[row, column] = max(0.0, 1.0 - obscurance) ** contrast
    return visibility


def statvo_visibility(
    depth: npt.ArrayLike,
    valid: npt.ArrayLike,
    normal: npt.ArrayLike | None,
    fx: npt.ArrayLike,
    fy: npt.ArrayLike,
    cx: npt.ArrayLike,
    cy: npt.ArrayLike,
    orthographic: bool,
    *,
    radius: float,
    height: float,
    slope: float,
    contrast: float,
    layers: int,
    eps: float,
    layering: str = "adaptive",
    quadrants: bool = False,
    sat_scale: int = 1,
) -> Floats:
    """StatVO visibility of a batch of layered depth images.

    Args:
        depth: (B, L, H, W) view-space z in scene units; `depth[:, 0]` is the nearest surface.
        valid: (B, L, H, W) bool; a sample is used where this holds and its depth is positive and finite.
        normal: (B, 3, H, W) unit view-space normals of the nearest surface, or None for the view-aligned form (Eq. 4).
        fx, fy, cx, cy: (B,) or scalar, pixels (orthographic: fx and fy in pixels per scene unit).
        orthographic: parallel projection instead of a pinhole.
        radius: half-extent of the sample box, scene units. height: its height as a fraction of the radius.
        slope: falloff of psi above the box. contrast: exponent of the visibility.
        layers: number of layers; a power of two when adaptive. layering: "adaptive" or "uniform".
        eps: machine epsilon of the dtype under test. quadrants: average four separately evaluated quarters.
        sat_scale: side in pixels of the blocks that samples are averaged over (1: none); the last row and column of
            blocks may stick out of the image.

    Returns:
        (B, H, W) float64 visibility; 1 at invalid pixels.
    """
    if layering not in ("adaptive", "uniform"):
        raise ValueError(f"layering must be 'adaptive' or 'uniform', got {layering!r}")
    rounds = int(layers).bit_length() - 1
    if layers < 1 or (layering == "adaptive" and layers != 2**rounds):
        raise ValueError(f"layers must be a positive number, and a power of two when adaptive, got {layers}")
    if sat_scale < 1:
        raise ValueError(f"sat_scale must be a positive number, got {sat_scale}")
    z = np.array(depth, dtype=np.float64)
    usable = np.array(valid, dtype=bool) & np.isfinite(z) & (z > 0.0)
    # Weights of unusable samples are zero, and zero times NaN is not.
    z[~usable] = 0.0
    n = None if normal is None else np.asarray(normal, dtype=np.float64)
    batch = z.shape[0]
    intrinsics = [np.broadcast_to(np.asarray(value, dtype=np.float64), (batch,)) for value in (fx, fy, cx, cy)]
    images = []
    for b in range(batch):
        focal_x, focal_y, centre_x, centre_y = (float(value[b]) for value in intrinsics)
        camera = Camera(focal_x, focal_y, centre_x, centre_y, orthographic)
        samples = samples_of(z[b], usable[b], camera, sat_scale)
        if layering == "adaptive":
            labels = adaptive_labels(samples, camera, radius, rounds, eps)
        else:
            labels = uniform_labels(samples, layers)
        images.append(
            image_visibility(
                z[b],
                usable[b],
                None if n is None else n[b],
                camera,
                samples,
                labels,
                radius=radius,
                height=height,
                slope=slope,
                contrast=contrast,
                eps=eps,
                quadrants=quadrants,
            )
        )
    return np.stack(images)
