"""Ray-traced ambient occlusion: the judge of every technique. It shares no code with them."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ssao import checks
from torch_ssao.reference import sampling
from torch_ssao.reference.storage import Reference
from torch_ssao.scenes.rays import RayCaster, worker_count
from torch_ssao.scenes.render import primary_hits
from torch_ssao.scenes.scene import Scene

FALLOFFS = ("binary", "linear", "quadratic")

TILE_RAYS = 1 << 17
"""Rays of a tile of pixels, per thread: about 10 MB of arrays. Results do not depend on it."""

OFFSET = 1e-5
"""Height above the surface at which rays start, as a fraction of the radius. Means over real scenes (sibenik, sponza,
bunny, a Cornell box, a tree, teapot) move by under 4e-6 from a third of it to all of it, by under 3e-5 to ten times it;
at a tenth of it (and of `ROUNDING`) pixels of sibenik and sponza begin to hide themselves."""

ROUNDING = 4.0 * float(np.finfo(np.float32).eps)
"""Least such height, as a fraction of the largest coordinate: origins, vertices and embree's arithmetic are float32.
On 120 planes of random tilt, size and place, seen at up to 86 degrees, 3 % of the pixels hide themselves when it is
half an epsilon and none does at one."""

_WORST_OFFSET = 0.01  # of the radius; beyond it rounding would bias the answer


def raytrace(
    scene: Scene,
    *,
    views: Iterable[int] | int | None = None,
    height: int,
    width: int,
    radius: float | None = None,
    falloff: str = "binary",
    samples: int = 512,
    seed: int = 0,
    progress: bool | None = None,
    threads: int | None = None,
) -> Reference:
    """Cosine-weighted visibility of the surfaces that some views see: 1 - mean over rays of W(hit distance / radius).

    Rays leave the pixel centre's surface point about the geometric normal that faces the eye; faces are two-sided and
    smooth normals play no part. W(t) = 1 for "binary", 1 - t for "linear", 1 - t^2 for "quadratic"; 0 without a hit.

    Args:
        scene: the mesh and its views.
        views: indices into `scene.cameras`, one index, or None for all.
        height, width: image size in pixels.
        radius: length of the rays in scene units, > 0; None for the scene's own.
        falloff: "binary", "linear" or "quadratic".
        samples: rays a pixel, a power of two between 8 and 65,536.
        seed: whole number >= 0; every seed gives independent noise. The result depends neither on threads nor on tiles.
        progress: show a bar on stderr; None for only when that is a terminal.
        threads: threads to use; None for every core this process may run on.
    Returns: a Reference; pixels that see nothing have visibility 1 and standard error 0.
    Raises: RangeError for a radius, size, seed, view or sample count outside its range, or a radius too short for
        float32 coordinates; ChoiceError for an unknown falloff; SceneError for a view that sees nothing.
    Cost: 8 to 13 million rays a second and core (sibenik, bunny), ray generation included; memory is 10 MB a thread
        and 450 bytes a pixel of one view, whatever the samples.
    Source: hemisphere sampling by Malley's method; see `reference.sampling` for the points and the standard error.
    """
    checks.check_count("height", height, 1)
    checks.check_count("width", width, 1)
    checks.check_choice("falloff", falloff, FALLOFFS)
    checks.check_count("seed", seed, 0)
    threads = worker_count() if threads is None else threads
    checks.check_count("threads", threads, 1)
    plan = sampling.sample_plan(samples)
    radius = scene.radius if radius is None else radius
    checks.check_positive("radius", radius)
    offset = _offset(scene, radius)
    indices = scene.view_indices(views)
    visibility = np.ones((len(indices), height * width), dtype=np.float32)
    error, valid = np.zeros_like(visibility), np.zeros(visibility.shape, dtype=np.bool_)
    with _ProgressBar(len(indices) * height * width, progress) as bar:
        for row, index in enumerate(indices):
            hits = primary_hits(scene, index, height, width)
            normal = _unit_normals(hits.geometric_normal, hits.eye - hits.position).reshape(-1, 3)
            origin = scene.rays.to_local(hits.position.reshape(-1, 3))
            valid[row] = hits.hit.reshape(-1)
            pixels = np.flatnonzero(valid[row])
            bar.add(height * width - len(pixels))
            tracer = _Tracer(scene.rays, plan, sampling.stream_key(seed, index), float(radius), offset, falloff)
            for tile, answer in _in_tiles(tracer, pixels, origin, normal, threads):
                visibility[row, tile], error[row, tile] = answer
                bar.add(len(tile))
    shape = (len(indices), 1, height, width)
    return Reference(
        visibility=torch.from_numpy(visibility.reshape(shape)),
        standard_error=torch.from_numpy(error.reshape(shape)),
        valid=torch.from_numpy(valid.reshape(shape)),
        samples=samples,
        radius=float(radius),
        falloff=falloff,
        seed=seed,
        scene=scene.name,
        fingerprint=scene.fingerprint,
        views=tuple(indices),
    )


class _Tracer:
    """Traces the rays of a tile of pixels of one view."""

    def __init__(
        self, rays: RayCaster, plan: sampling.SamplePlan, key: np.uint64, radius: float, offset: float, falloff: str
    ) -> None:
        self.rays, self.plan, self.key = rays, plan, key
        self.radius, self.offset, self.falloff = radius, offset, falloff

    def __call__(
        self, pixels: NDArray[np.int64], origins: NDArray[np.float32], normals: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Visibility and standard error, each (P,), of pixels (P,) with origins and normals (P, 3)."""
        u, v = sampling.disk_points(self.plan, self.key, pixels)
        along, cosine = sampling.directions(u, v, normals)
        # Each ray starts where it has risen `offset` above the surface, on its own line: it misses only what it would hit
        # below that, of second order in offset / distance. A shift along the normal errs at first order.
        skipped = np.divide(np.float32(self.offset), cosine, out=cosine)
        start = along * skipped[..., None]
        start += origins[:, None]
        along, start, skipped = along.reshape(-1, 3), start.reshape(-1, 3), skipped.reshape(-1)
        reach = np.maximum(np.float32(self.radius) - skipped, 0.0)
        if self.falloff == "binary":
            open_share: NDArray[Any] = ~self.rays.occluded(start, along, reach, threads=1)
        else:
            # 1 - W of a hit is t or t^2, and a miss comes back with the ray's length: t = 1.
            open_share = self.rays.distance(start, along, reach, threads=1)
            missed = open_share >= reach
            open_share += skipped
            open_share *= np.float32(1.0 / self.radius)
            np.minimum(open_share, 1.0, out=open_share)
            open_share[missed] = 1.0  # not one rounding less: open pixels are exactly 1
            if self.falloff == "quadratic":
                open_share *= open_share
        return sampling.standard_error(self.plan, open_share.reshape(u.shape))


def _in_tiles(
    tracer: _Tracer, pixels: NDArray[np.int64], origins: NDArray[np.float32], normals: NDArray[np.float64], threads: int
) -> Iterator[tuple[NDArray[np.int64], tuple[NDArray[np.float64], NDArray[np.float64]]]]:
    size = max(1, TILE_RAYS // tracer.plan.samples)
    tiles = [pixels[start : start + size] for start in range(0, len(pixels), size)]
    with ThreadPoolExecutor(threads) as pool:
        try:
            yield from zip(tiles, pool.map(lambda tile: tracer(tile, origins[tile], normals[tile]), tiles), strict=True)
        finally:
            pool.shutdown(cancel_futures=True)  # Ctrl-C must not wait for the rest of the image


def _offset(scene: Scene, radius: float) -> float:
    reach = 0.5 * float(np.ptp(scene.vertices[scene.faces].reshape(-1, 3), axis=0).max())  # embree's frame is centred
    offset = max(OFFSET * radius, ROUNDING * reach)
    if offset > _WORST_OFFSET * radius:
        raise checks.RangeError(
            f"radius must be at least {offset / _WORST_OFFSET:.3g} in scene {scene.name!r} of size {2 * reach:g}, "
            f"got {radius!r}: shorter rays drown in float32 rounding, use a larger radius or a part of the mesh"
        )
    return offset


def _unit_normals(normal: NDArray[np.float64], to_eye: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normals, or the direction to the eye where a face without area has none."""
    missing = ~np.any(normal, axis=-1)
    length = np.maximum(np.linalg.norm(to_eye[missing], axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    normal = normal.copy()
    normal[missing] = to_eye[missing] / length
    return normal


class _ProgressBar:
    """tqdm's bar over pixels, or nothing."""

    def __init__(self, total: int, progress: bool | None) -> None:
        self.bar: Any = None
        if sys.stderr.isatty() if progress is None else progress:
            from tqdm import tqdm

            self.bar = tqdm(total=total, desc="ray tracing", unit="px", unit_scale=True, file=sys.stderr)

    def add(self, count: int) -> None:
        if self.bar is not None:
            self.bar.update(count)

    def __enter__(self) -> _ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()
