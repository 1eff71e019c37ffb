"""Ray-traced ambient occlusion: the judge of every technique. It shares no code with them."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ssao import checks
from torch_ssao.reference import sampling
from torch_ssao.reference.storage import Reference
from torch_ssao.scenes.rays import worker_count
from torch_ssao.scenes.render import primary_hits
from torch_ssao.scenes.scene import Scene

Float32 = NDArray[np.float32]

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
    Cost: 7 to 10 million rays a second and core (sibenik, bunny), ray generation included; memory is 10 MB a thread
        and 450 bytes a pixel of one view, whatever the samples.
    Source: hemisphere sampling by Malley's method; see `reference.sampling` for the points and the standard error.
    """
    checks.check_count("height", height, 1)
    checks.check_count("width", width, 1)
    checks.check_choice("falloff", falloff, FALLOFFS)
    checks.check_count("seed", seed, 0)
    threads = worker_count() if threads is None else threads
    checks.check_count("threads", threads, 1)
    radius = scene.radius if radius is None else radius
    checks.check_positive("radius", radius)
    indices = scene.view_indices(views)
    tracer = _Tracer(scene, sampling.sample_plan(samples), seed, float(radius), falloff, threads)
    with _ProgressBar(len(indices) * height * width, progress) as bar:
        traced = [tracer.view(index, height, width, bar) for index in indices]
    visibility, error, valid = (torch.from_numpy(np.stack(images)[:, None]) for images in zip(*traced, strict=True))
    return Reference(
        visibility=visibility,
        standard_error=error,
        valid=valid,
        samples=samples,
        radius=float(radius),
        falloff=falloff,
        seed=seed,
        scene=scene.name,
        fingerprint=scene.fingerprint,
        views=tuple(indices),
    )


class _Tracer:
    """Traces views of one scene in tiles of pixels that several threads share."""

    def __init__(
        self, scene: Scene, plan: sampling.SamplePlan, seed: int, radius: float, falloff: str, threads: int
    ) -> None:
        self.scene, self.plan, self.seed = scene, plan, seed
        self.radius, self.falloff, self.threads = radius, falloff, threads
        self.offset = _offset(scene, radius)

    def view(
        self, index: int, height: int, width: int, bar: _ProgressBar
    ) -> tuple[Float32, Float32, NDArray[np.bool_]]:
        """Visibility, standard error and validity (H, W) of one view."""
        hits = primary_hits(self.scene, index, height, width)
        normals = _unit_normals(hits.geometric_normal, hits.eye - hits.position).reshape(-1, 3)
        origins = self.scene.rays.to_local(hits.position.reshape(-1, 3))
        key = sampling.stream_key(self.seed, index)
        visibility, error = np.ones(height * width, np.float32), np.zeros(height * width, np.float32)
        pixels = np.flatnonzero(hits.hit)
        bar.add(height * width - len(pixels))
        size = max(1, TILE_RAYS // self.plan.samples)
        tiles = [pixels[start : start + size] for start in range(0, len(pixels), size)]
        with ThreadPoolExecutor(self.threads) as pool:
            try:
                answers = pool.map(lambda tile: self.tile(key, tile, origins[tile], normals[tile]), tiles)
                for tile, (mean, spread) in zip(tiles, answers, strict=True):
                    visibility[tile], error[tile] = mean, spread
                    bar.add(len(tile))
            finally:
                pool.shutdown(cancel_futures=True)  # Ctrl-C must not wait for the rest of the image
        return visibility.reshape(hits.hit.shape), error.reshape(hits.hit.shape), hits.hit

    def tile(
        self, key: np.uint64, pixels: NDArray[np.int64], origins: Float32, normals: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Visibility and standard error, each (P,), of pixels (P,) with local origins and normals (P, 3)."""
        u, v = sampling.disk_points(self.plan, key, pixels)
        along, cosine = sampling.directions(u, v, normals)
        # Each ray starts where it has risen `offset` above the surface, on its own line: it misses only what it would
        # hit below that, of second order in offset / distance. A shift along the normal errs at first order.
        skipped = np.divide(np.float32(self.offset), cosine, out=cosine)
        start = along * skipped[..., None]
        start += origins[:, None]
        along, start, skipped = along.reshape(-1, 3), start.reshape(-1, 3), skipped.reshape(-1)
        reach = np.maximum(np.float32(self.radius) - skipped, 0.0)
        if self.falloff == "binary":
            open_share: NDArray[Any] = ~self.scene.rays.occluded(start, along, reach, threads=1)
        else:
            # 1 - W of a hit is t or t^2, and a miss comes back with the ray's length: t = 1.
            open_share = self.scene.rays.distance(start, along, reach, threads=1)
            missed = open_share >= reach
            open_share += skipped
            open_share *= np.float32(1.0 / self.radius)
            np.minimum(open_share, 1.0, out=open_share)
            open_share[missed] = 1.0  # not one rounding less: open pixels are exactly 1
            if self.falloff == "quadratic":
                open_share *= open_share
        return sampling.standard_error(self.plan, open_share.reshape(u.shape))


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
