"""Views of a mesh: read from a JSON file, or placed by looking round with rays."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_ssao import checks
from torch_ssao.scenes.rays import RayCaster
from torch_ssao.scenes.scene import View

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

PLACED_VIEWS = 4
_UP = (0.0, 1.0, 0.0)
_INSIDE_FOV, _OUTSIDE_FOV = 60.0, 50.0


def read_cameras(cameras: Any, stem: str) -> tuple[tuple[View, ...], float | None]:
    """Views, and the radius that comes with them if any, from a JSON file or from what such a file holds.

    Args:
        cameras: path of a JSON file, or its content: a list of {"eye", "target", "up", "fov_y_deg"} or `View`; or
            {"views": such a list, "ao_radius": number}, of which the radius may be missing; or {mesh name: such a
            record}, of which the entry `stem` is taken. "up" defaults to y and "fov_y_deg" to 60.
        stem: file name of the mesh without its ending.
    Returns: views, and the radius in scene units or None.
    Raises: SceneError for a file that is missing or no JSON, a missing key, no view; others as `View`.
    """
    origin = "cameras"
    if isinstance(cameras, (str, Path)):
        origin = f"cameras {str(cameras)!r}"
        cameras = _read_json(Path(cameras))
    if isinstance(cameras, Mapping) and "views" not in cameras:
        if stem not in cameras:
            known = ", ".join(map(repr, list(cameras)[:12])) or "nothing"
            raise checks.SceneError(
                f"{origin} must have the key 'views' or {stem!r}, got {known}: add one, or rename the mesh file"
            )
        origin, cameras = f"{origin}[{stem!r}]", cameras[stem]
    radius = None
    if isinstance(cameras, Mapping):
        if "views" not in cameras:
            raise checks.SceneError(
                f"{origin} must have the key 'views', got {', '.join(map(repr, cameras)) or 'nothing'}: add it"
            )
        radius = cameras.get("ao_radius")
        if radius is not None:
            checks.check_positive(f"{origin}['ao_radius']", radius)
        cameras = cameras["views"]
    if isinstance(cameras, View):
        cameras = [cameras]
    if not isinstance(cameras, Sequence) or isinstance(cameras, str) or len(cameras) == 0:
        raise checks.SceneError(
            f"{origin} must hold a list with at least one view, got {cameras!r}: write [{{'eye': ..., 'target': ...}}]"
        )
    return tuple(_view(f"{origin}[{i}]", record) for i, record in enumerate(cameras)), radius


def place_views(vertices: Float64, faces: Int64, rays: RayCaster) -> tuple[View, ...]:
    """Four views of a mesh that comes without any; y is taken to point up. The same mesh gives the same views.

    Where rays from most of its faces reach the sky it is an object or an open place and is seen from around, slightly
    from above; where they do not, and rays from the middle end on the mesh too, it is an interior and is seen from
    inside.

    Args:
        vertices: (V, 3). faces: (F, 3) rows of it. rays: the same mesh.
    Raises: SceneError where no view of the mesh can be found.
    Cost: about 0.5 s.
    """
    corners = vertices[faces]
    # Percentiles of the faces' centres, so that two triangles of ground do not decide how large the scene is.
    centers = corners.mean(axis=1)
    low, high = np.percentile(centers, 1, axis=0), np.percentile(centers, 99, axis=0)
    whole_low, whole_high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    size = float(np.linalg.norm(high - low)) or float(np.linalg.norm(whole_high - whole_low))
    views: list[View] = []
    if _is_interior(corners, rays, size):
        views = _inside(whole_low, whole_high, rays)
    if len(views) < PLACED_VIEWS:
        views = _outside((low + high) / 2, size, rays)
    if not views:
        raise checks.SceneError(
            "cameras could not be placed automatically: no view found that sees the mesh, pass cameras"
        )
    return tuple(views)


def seen_distances(views: Sequence[View], rays: RayCaster, height: int = 24, width: int = 32) -> Float64:
    """View-space depths, in scene units, that a coarse grid of the views' pixels sees; empty where none hits."""
    found = [rays.first_hit(np.asarray(view.eye), _frustum(view, height, width))[1] for view in views]
    distance = np.concatenate(found)
    return distance[np.isfinite(distance)]


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise checks.SceneError(f"cameras file {str(path)!r} does not exist: check the path") from error
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise checks.SceneError(f"cameras file {str(path)!r} must be JSON, got: {error}: repair the file") from error


def _view(origin: str, record: Any) -> View:
    if isinstance(record, View):
        return record
    if not isinstance(record, Mapping):
        raise checks.SceneError(
            f"{origin} must be {{'eye', 'target', 'up', 'fov_y_deg'}}, got {record!r}: write one object per view"
        )
    for key in ("eye", "target"):
        if key not in record:
            raise checks.SceneError(
                f"{origin} must have the key {key!r}, got {', '.join(map(repr, record)) or 'nothing'}: add it"
            )
    try:
        return View(record["eye"], record["target"], record.get("up", _UP), record.get("fov_y_deg", 60.0))
    except ValueError as error:
        raise type(error)(f"{origin}: {error}") from error


def _is_interior(corners: NDArray[Any], rays: RayCaster, size: float) -> bool:
    rng = np.random.default_rng(0)
    middle = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
    if (rays.first_hit(middle, sphere_directions(256))[0] >= 0).mean() < 0.75:
        return False
    faces = corners[rng.integers(0, len(corners), 512)]
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    center, around = faces.mean(axis=1), sphere_directions(64)
    sides = np.sign(around @ normal.T).T[..., None] * normal[:, None]  # off the face on the side the ray leaves by
    origin = (center[:, None] + 1e-4 * size * sides).reshape(-1, 3)
    escaped = rays.first_hit(origin, np.tile(around, (len(center), 1)))[0].reshape(len(center), -1) < 0
    front = (around @ normal.T).T > 0
    share = [np.where(side, escaped, False).sum(axis=1) / np.maximum(side.sum(axis=1), 1) for side in (front, ~front)]
    return bool(np.median(np.maximum(*share)) < 0.2)


def _inside(low: Float64, high: Float64, rays: RayCaster) -> list[View]:
    """Places with room around them, towards where much is seen and far, away from one another."""
    diagonal = float(np.linalg.norm(high - low))
    axes = [low[i] + (high[i] - low[i]) * np.linspace(0.06, 0.94, n) for i, n in enumerate((9, 7, 9))]
    eyes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    around = sphere_directions(96)
    reach, _ = _cast(eyes, around, rays)  # (N, 96), inf for none
    enclosed = np.isfinite(reach).mean(axis=1) >= 0.8
    roomy = reach.min(axis=1) >= 0.015 * diagonal
    eyes = eyes[enclosed & roomy]
    azimuths = np.deg2rad(np.arange(0.0, 360.0, 22.5))
    ahead = np.stack((np.cos(azimuths), np.full_like(azimuths, -0.15), np.sin(azimuths)), axis=1)
    candidates: list[tuple[float, int, int]] = []
    for j, direction in enumerate(ahead):
        if len(eyes) == 0:
            break
        frustum = _frustum(View((0.0, 0.0, 0.0), tuple(direction), _UP, _INSIDE_FOV), 6, 8)
        seen, detail = _cast(eyes, frustum / np.linalg.norm(frustum, axis=1, keepdims=True), rays)
        covered = np.isfinite(seen).mean(axis=1)
        near = np.where(np.isfinite(seen), seen, np.inf).min(axis=1)
        merit = np.log(np.where(np.isfinite(seen), seen, 0.02 * diagonal) / diagonal + 1e-3).mean(axis=1) + np.log(
            detail
        )
        merit = np.where((covered >= 0.9) & (near >= 0.02 * diagonal), merit, -np.inf)
        candidates += [(float(s), i, j) for i, s in enumerate(merit) if np.isfinite(s)]
    candidates.sort(key=lambda c: (-c[0], c[1], c[2]))
    chosen: list[tuple[int, int]] = []
    # Among good views first, ever nearer ones where the place is small; a dull view is better than none.
    for apart, margin in ((0.25, 0.5), (0.12, 0.5), (0.05, 0.5), (0.05, np.inf)):
        for score, i, j in candidates:
            if score < candidates[0][0] - margin:
                break
            distinct = all(
                np.linalg.norm(eyes[i] - eyes[k]) > apart * diagonal or (apart < 0.25 and ahead[j] @ ahead[m] < 0.3)
                for k, m in chosen
            )
            if distinct and len(chosen) < PLACED_VIEWS:
                chosen.append((i, j))
    return [View(tuple(eyes[i]), tuple(eyes[i] + 0.2 * diagonal * ahead[j]), _UP, _INSIDE_FOV) for i, j in chosen]


def _outside(middle: Float64, size: float, rays: RayCaster) -> list[View]:
    """Round the middle at a height of 15 to 35 degrees, nearer where something else is in the way."""
    views: list[View] = []
    reach = 0.5 * size / np.sin(np.deg2rad(_OUTSIDE_FOV / 2))
    for azimuth, elevation in ((35.0, 20.0), (125.0, 30.0), (215.0, 15.0), (305.0, 35.0)):
        a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
        outwards = np.array([np.cos(e) * np.cos(a), np.sin(e), np.cos(e) * np.sin(a)])
        best, best_share = None, 0.0
        for factor in (0.9, 0.65, 1.2, 1.6):
            eye = middle + factor * reach * outwards
            view = View(tuple(eye), tuple(middle), _UP, _OUTSIDE_FOV)
            distance = rays.first_hit(eye, _frustum(view, 12, 16))[1]
            length = np.linalg.norm(_frustum(view, 12, 16), axis=1)
            seen = np.isfinite(distance) & (distance * length > 0.15 * reach)
            share = float(seen.mean()) * (0.3 if (distance * length < 0.15 * reach).mean() > 0.1 else 1.0)
            if share > best_share:
                best, best_share = view, share
            if share >= 0.45:
                break
        if best is not None:
            views.append(best)
    return views


def sphere_directions(count: int) -> Float64:
    """(count, 3) unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    y = 1 - 2 * i / count
    angle = np.pi * (1 + np.sqrt(5.0)) * i
    r = np.sqrt(1 - y * y)
    return np.stack((r * np.cos(angle), y, r * np.sin(angle)), axis=1)


def _cast(eyes: Float64, directions: Float64, rays: RayCaster) -> tuple[Float64, Int64]:
    """(N, M) distances along every direction from every eye, inf for none; (N,) count of different triangles hit."""
    origins = np.repeat(eyes, len(directions), axis=0)
    triangle, distance = rays.first_hit(origins, np.tile(directions, (len(eyes), 1)))
    ordered = np.sort(triangle.reshape(len(eyes), -1), axis=1)
    return distance.reshape(len(eyes), -1), 1 + (np.diff(ordered, axis=1) != 0).sum(axis=1)


def _frustum(view: View, height: int, width: int) -> Float64:
    """(height * width, 3) world directions through a coarse grid of pixels, of length 1 along the view's axis."""
    rotation = view.world_to_view().numpy()[:3, :3]
    half = np.tan(np.deg2rad(view.fov_y_deg / 2))
    y = half * (2 * (np.arange(height) + 0.5) / height - 1)
    x = half * width / height * (2 * (np.arange(width) + 0.5) / width - 1)
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    return np.asarray(np.stack((grid_x, grid_y, np.ones_like(grid_x)), axis=-1).reshape(-1, 3) @ rotation)
