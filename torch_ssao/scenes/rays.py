"""Rays against triangles: embree for the search, float64 plane arithmetic for the distance."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from torch_ssao import checks

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

CHUNK_RAYS = 1 << 18
"""Rays handed to embree at a time, per thread: about 10 MB of arrays, long enough to hide Python's own time."""

MISS_DISTANCE = np.float32(1e30)
"""Length of an endless ray; embreex itself ends one at 1e37."""


@final
class RayCaster:
    """An embree scene over a triangle soup, two-sided, safe to use from several threads.

    Embree works in float32, so the triangles are moved to the centre of their bounding box first: a scene far from its
    origin loses no precision. Rays that enter as float32 must be in that moved frame (`to_local`).

    Args:
        vertices: (V, 3) float64 world positions in scene units, finite.
        faces: (F, 3) int64 rows of `vertices`.
    Raises: SceneError when embreex is not installed.
    Cost: building takes about 0.3 s and 100 MB for 260,000 triangles.
    """

    def __init__(self, vertices: Float64, faces: Int64) -> None:
        rtcore_scene, mesh_construction = _import_embree()
        used = vertices[faces]  # (F, 3, 3)
        low, high = used.min(axis=(0, 1)), used.max(axis=(0, 1))
        self.center: Float64 = 0.5 * (low + high)
        corners = used - self.center
        self._anchor: Float64 = corners[:, 0]
        self._normal: Float64 = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._scene: Any = rtcore_scene.EmbreeScene(robust=True)  # watertight along shared edges
        mesh_construction.TriangleMesh(self._scene, np.ascontiguousarray(corners, dtype=np.float32))
        # The first query commits the scene; doing it here keeps two threads from committing it at once.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def to_local(self, points: NDArray[np.floating[Any]]) -> Float32:
        """(N, 3) world positions in the float32 frame that `occluded` and `distance` take."""
        return np.ascontiguousarray(points - self.center, dtype=np.float32)

    def first_hit(
        self,
        origins: Float64,
        directions: Float64,
        max_distance: float | Float64 | None = None,
        *,
        threads: int | None = None,
    ) -> tuple[Int64, Float64]:
        """Nearest triangle along each ray.

        Args:
            origins: (N, 3) or (3,) float64 world positions.
            directions: (N, 3) float64, any length but zero; distances count in these lengths.
            max_distance: longest distance, a number or (N,); None for endless rays.
            threads: threads to use; None for every core this process may run on.
        Returns: triangle (N,) int64, -1 for none; distance (N,) float64 from the triangle's plane, inf for none.
        Cost: about 1 us a ray and thread.
        """
        origins = np.broadcast_to(np.asarray(origins, dtype=np.float64), directions.shape)
        limit = np.asarray(MISS_DISTANCE if max_distance is None else max_distance)
        reach = np.broadcast_to(limit, directions.shape[:1])
        triangle = np.full(len(directions), -1, dtype=np.int64)
        distance = np.full(len(directions), np.inf)

        def trace(part: slice) -> None:
            local, along = origins[part] - self.center, np.asarray(directions[part], dtype=np.float64)
            found = self._scene.run(_plain(local), _plain(along), dists=_plain(reach[part]), output=1)
            hit = np.flatnonzero(found["primID"] >= 0)
            face = found["primID"][hit].astype(np.int64)
            triangle[part][hit] = face
            rough = found["tfar"][hit].astype(np.float64)
            distance[part][hit] = self._plane_distance(face, local[hit], along[hit], rough)

        _in_chunks(trace, len(directions), threads)
        return triangle, distance

    def occluded(
        self, origins: Float32, directions: Float32, distances: Float32 | float, *, threads: int | None = None
    ) -> NDArray[np.bool_]:
        """Whether anything lies on each ray before its distance: the fast query, with no conversion of the rays.

        Args:
            origins: (N, 3) float32, from `to_local`, moved off the surface already: embree has no near limit here.
            directions: (N, 3) float32, any length but zero.
            distances: (N,) float32 or a number, in lengths of `directions`.
            threads: as in `first_hit`.
        Returns: (N,) bool.
        Cost: 6 to 17 million rays a second and core, by scene.
        """
        reach = np.broadcast_to(np.asarray(distances, dtype=np.float32), directions.shape[:1])
        answer = np.empty(len(directions), dtype=np.bool_)

        def trace(part: slice) -> None:
            answer[part] = self._run(origins[part], directions[part], reach[part], "OCCLUDED") != -1

        _in_chunks(trace, len(directions), threads)
        return answer

    def distance(
        self, origins: Float32, directions: Float32, distances: Float32 | float, *, threads: int | None = None
    ) -> Float32:
        """Distance to the nearest hit in lengths of `directions`, or the given limit where nothing is hit before it.

        Args: as in `occluded`.
        Returns: (N,) float32.
        """
        reach = np.broadcast_to(np.asarray(distances, dtype=np.float32), directions.shape[:1])
        answer = np.empty(len(directions), dtype=np.float32)

        def trace(part: slice) -> None:
            answer[part] = self._run(origins[part], directions[part], reach[part], "DISTANCE")

        _in_chunks(trace, len(directions), threads)
        return answer

    def _run(self, origins: Float32, directions: Float32, reach: Float32, query: str) -> NDArray[Any]:
        answer: NDArray[Any] = self._scene.run(_plain(origins), _plain(directions), dists=_plain(reach), query=query)
        return answer

    def _plane_distance(self, face: Int64, origins: Float64, directions: Float64, embree: Float64) -> Float64:
        normal = self._normal[face]
        along = np.einsum("ij,ij->i", normal, directions)
        # Within its plane a ray has no intersection to compute, and near that embree's answer is the better one.
        length = np.linalg.norm(normal, axis=1) * np.linalg.norm(directions, axis=1)
        grazing = np.abs(along) <= 1e-6 * length
        exact = np.einsum("ij,ij->i", normal, self._anchor[face] - origins) / np.where(grazing, 1.0, along)
        off = grazing | (np.abs(exact - embree) > 1e-2 * np.abs(embree)) | (exact <= 0)
        return np.where(off, embree, exact)


def _plain(array: NDArray[Any]) -> Float32:
    """As embreex takes it: float32, contiguous and, though it only reads, writable; copied only if need be."""
    return np.require(array, np.float32, ["C", "W"])


def worker_count() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _in_chunks(trace: Callable[[slice], None], count: int, threads: int | None) -> None:
    threads = worker_count() if threads is None else threads
    size = max(1, min(CHUNK_RAYS, -(-count // threads)))
    parts = [slice(start, start + size) for start in range(0, count, size)]
    if threads == 1 or len(parts) == 1:
        for part in parts:
            trace(part)
        return
    # A pool per call costs 0.1 ms and, unlike a kept one, survives a fork (DataLoader workers).
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(trace, part) for part in parts]:
            done.result()


def _import_embree() -> tuple[Any, Any]:
    try:
        from embreex import mesh_construction, rtcore_scene
    except ImportError as error:
        raise checks.SceneError(
            "tracing rays needs embreex, which is not installed: pip install torch_ssao[scenes]"
        ) from error
    return rtcore_scene, mesh_construction
