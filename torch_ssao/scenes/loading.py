"""Mesh files to scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_ssao import checks
from torch_ssao.scenes.cameras import place_views, read_cameras, seen_distances
from torch_ssao.scenes.rays import RayCaster
from torch_ssao.scenes.scene import Scene, check_mesh
from torch_ssao.scenes.shapes import import_trimesh

RADIUS_OF_DISTANCE = 0.1
"""Suggested radius as a share of the median distance seen; on ten common test meshes
the suggestion comes out between 0.4 and 2.3 times the radius picked by hand."""

RADIUS_OF_DIAGONAL = (0.01, 0.05)
"""Least and greatest suggested radius as a share of the bounding box's diagonal."""


def load(path: str | Path, *, cameras: Any = None, radius: float | None = None) -> Scene:
    """Scene from a mesh file.

    Args:
        path: any file trimesh reads: .glb, .gltf, .obj, .ply, .stl, .off. Scene graphs are flattened with their
            transforms, materials are ignored, faces without area dropped, vertices kept as they are; y points up.
        cameras: path of a JSON file, or a list of views (see `read_cameras`); None places four views automatically.
        radius: suggested ambient-occlusion radius in scene units, > 0; None takes "ao_radius" of the camera file, else
            a tenth of the median distance that the views see, kept within 1 and 5 % of the bounding box's diagonal.
    Returns: a `Scene` named after the file.
    Raises: SceneError for a file that is missing, unreadable or holds no usable mesh, and for unusable cameras;
        ShapeError and RangeError for bad numbers in cameras; RangeError for a radius that is not positive.
    Cost: about 0.2 s for 260,000 faces; placing views adds about 1 s.
    """
    if radius is not None:
        checks.check_positive("radius", radius)
    source = Path(path)
    if not source.is_file():
        what = "is a folder" if source.is_dir() else "does not exist"
        raise checks.SceneError(f"mesh file {str(source)!r} {what}: check the path")
    given = None if cameras is None else read_cameras(cameras, source.stem)
    vertices, faces = read_mesh(source)
    if given is not None and (radius or given[1]):
        return Scene(source.stem, vertices, faces, given[0], float(radius or given[1] or 0.0))
    rays = RayCaster(vertices, faces)
    views = place_views(vertices, faces, rays) if given is None else given[0]
    suggested = radius or _suggest_radius(source, views, vertices[faces], rays)
    return Scene(source.stem, vertices, faces, views, suggested)


def read_mesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) and faces (F, 3) of everything in a mesh file. Raises: SceneError."""
    trimesh = import_trimesh()
    options = {"skip_materials": True} if path.suffix.lower() in (".obj", ".glb", ".gltf") else {}
    try:
        graph = trimesh.load_scene(str(path), process=False, **options)
        parts = [graph.graph[node] for node in graph.graph.nodes_geometry]
        meshes = [(graph.geometry[name], np.asarray(transform, dtype=np.float64)) for transform, name in parts]
    except Exception as error:  # trimesh lets each format's own exceptions through
        reason = (str(error).splitlines() or [""])[0]
        raise checks.SceneError(
            f"mesh file {str(path)!r} cannot be read ({type(error).__name__}: {reason}): "
            "use .glb, .gltf, .obj, .ply, .stl or .off"
        ) from error
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    for mesh, transform in meshes:
        points = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        with np.errstate(invalid="ignore"):  # infinite vertices are refused below
            vertices.append(points @ transform[:3, :3].T + transform[:3, 3])
        if hasattr(mesh, "faces"):
            faces.append(np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3) + count)
        count += len(points)
    every, kept = np.concatenate(vertices), np.concatenate(faces)
    check_mesh(path.name, every, kept)
    kept = kept[_has_area(every[kept])]
    if len(kept) == 0:
        raise checks.SceneError(
            f"mesh {path.name!r} must have faces with an area, got only degenerate ones: check its export"
        )
    return every, kept


def _has_area(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    # Below the limit float64 has no normal left.
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    longest = np.maximum((one * one).sum(axis=1), (two * two).sum(axis=1))
    return np.asarray(np.linalg.norm(np.cross(one, two), axis=1) > 1e-12 * longest)


def _suggest_radius(path: Path, views: Any, corners: NDArray[np.float64], rays: RayCaster) -> float:
    distance = seen_distances(views, rays)
    if len(distance) == 0:
        raise checks.SceneError(
            f"cameras of {path.name!r} see nothing of the mesh, no view of {len(views)} hits it: check their units"
        )
    diagonal = float(np.linalg.norm(corners.max(axis=(0, 1)) - corners.min(axis=(0, 1))))
    low, high = (share * diagonal for share in RADIUS_OF_DIAGONAL)
    return float(np.clip(RADIUS_OF_DISTANCE * np.median(distance), low, high))
