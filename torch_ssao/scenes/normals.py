"""Face normals and smooth corner normals of a triangle mesh."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

CREASE_DEG = 40.0
"""Faces that meet at a larger angle keep a hard edge; modelling tools' auto-smooth defaults lie between 30 and 60."""

_MAX_FAN = 256  # faces round one vertex beyond which its corners stay flat: pairs grow with the square
_PAIRS = 1 << 21  # pairs of corners handled at a time, about 200 MB


def face_normals(vertices: Float64, faces: Int64) -> Float64:
    """Unit normals by the winding.

    Args:
        vertices: (V, 3). faces: (F, 3) rows of it.
    Returns: (F, 3), zero for faces without area.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return _unit(np.cross(b - a, c - a))


def corner_normals(vertices: Float64, faces: Int64, crease_deg: float = CREASE_DEG) -> Float64:
    """Smooth normals per face corner: angle-weighted means over the faces round a vertex that meet without a crease.

    Vertices at exactly one place count as one, so files with split vertices are smoothed too. A neighbour wound the
    other way is flipped first: faces are two-sided.

    Args:
        vertices: (V, 3). faces: (F, 3) rows of it.
        crease_deg: faces that meet at a larger angle are not averaged.
    Returns: (F, 3, 3) - face, corner, xyz; unit, on the side of the face's own normal.
    Cost: about 2 s for 260,000 faces.
    """
    normal = face_normals(vertices, faces)
    weight = _corner_angles(vertices, faces).reshape(-1)
    place = _places(vertices)[faces].reshape(-1)  # (3F,)
    order = np.argsort(place, kind="stable")
    _, first, count = np.unique(place[order], return_index=True, return_counts=True)
    fan = np.repeat(np.arange(len(count)), count)  # of each sorted corner
    size = np.where(count[fan] <= _MAX_FAN, count[fan], 0)
    smooth = np.zeros((len(order), 3))
    ends = np.cumsum(size)
    start = 0
    while start < len(order):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + _PAIRS, side="right")))
        mine = np.repeat(np.arange(start, stop), size[start:stop])
        if len(mine):
            within = np.arange(len(mine)) - np.repeat(ends[start:stop] - size[start:stop] - done, size[start:stop])
            other = order[first[fan[mine]] + within]
            cosine = np.einsum("ij,ij->i", normal[order[mine] // 3], normal[other // 3])
            share = np.where(np.abs(cosine) >= math.cos(math.radians(crease_deg)), np.sign(cosine), 0.0) * weight[other]
            for axis in range(3):
                total = np.bincount(mine - start, share * normal[other // 3, axis], minlength=stop - start)
                smooth[start:stop, axis] = total
        start = stop
    result = np.empty_like(smooth)
    result[order] = smooth
    flat = np.repeat(normal, 3, axis=0)
    unit = _unit(result)
    unit[np.einsum("ij,ij->i", unit, flat) <= 0] = 0.0
    unit = np.where((unit == 0).all(axis=1, keepdims=True), flat, unit)
    return unit.reshape(-1, 3, 3)


def _places(vertices: Float64) -> Int64:
    """One number per distinct position."""
    rows = np.ascontiguousarray(vertices + 0.0)  # -0.0 and 0.0 are one place
    keys = rows.view(np.dtype((np.void, rows.itemsize * 3))).reshape(-1)
    return np.unique(keys, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _corner_angles(vertices: Float64, faces: Int64) -> Float64:
    corners = vertices[faces]
    angles = np.empty(faces.shape)
    for i in range(3):
        one = _unit(corners[:, (i + 1) % 3] - corners[:, i])
        two = _unit(corners[:, (i + 2) % 3] - corners[:, i])
        angles[:, i] = np.arccos(np.clip(np.einsum("ij,ij->i", one, two), -1.0, 1.0))
    return angles


def _unit(vectors: Float64) -> Float64:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
