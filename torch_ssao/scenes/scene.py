"""The scene record: a triangle mesh, the views it is seen from and the radius it suggests."""

from __future__ import annotations

import hashlib
import math
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from numpy.typing import NDArray

from torch_ssao import checks
from torch_ssao.camera import Camera, look_at
from torch_ssao.scenes.normals import corner_normals, face_normals
from torch_ssao.scenes.rays import RayCaster

Vector = tuple[float, float, float]
_BUILD_LOCK = threading.RLock()  # of the module, not the record: a record that holds a lock cannot be pickled


@final
@dataclass(frozen=True)
class View:
    """Where a picture of a scene is taken from.

    Args:
        eye, target, up: world-space point, point looked at, upward direction, in scene units.
        fov_y_deg: vertical field of view in degrees, in (0, 180).
    Raises: ShapeError for vectors that are not three numbers; RangeError for values that are not finite, a field of
        view outside (0, 180), a target equal to the eye, or an `up` along the view.
    """

    eye: Vector
    target: Vector
    up: Vector = (0.0, 1.0, 0.0)
    fov_y_deg: float = 60.0

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            object.__setattr__(self, name, _vector(name, getattr(self, name)))
        fov = self.fov_y_deg
        if not _is_number(fov) or not 0 < fov < 180:
            raise checks.RangeError(f"fov_y_deg must lie in (0, 180) degrees, got {fov!r}: pass degrees, not radians")
        object.__setattr__(self, "fov_y_deg", float(fov))
        self.world_to_view()  # refuses a target equal to the eye and an up along the view

    def world_to_view(self) -> torch.Tensor:
        """(4, 4) float64 rigid transform from world to view space (x right, y down, z forward)."""
        return look_at(*(torch.tensor(v, dtype=torch.float64) for v in (self.eye, self.target, self.up)))


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """A triangle mesh with views. Faces are two-sided; materials play no part.

    Args:
        name: what to call it in messages and reports.
        vertices: (V, 3) world positions in scene units, finite; stored as read-only float64.
        faces: (F, 3) rows of `vertices`, F > 0; stored as read-only int64.
        cameras: the views it is seen from, at least one.
        radius: suggested ambient-occlusion radius in scene units, > 0.
    Raises: SceneError for a mesh without faces or with NaN or infinite vertices, faces that name no vertex, no view;
        RangeError for a radius that is not positive.
    Cost: the embree scene and the normals are built on first use and kept; pickles and copies leave them behind.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    cameras: tuple[View, ...]
    radius: float

    def __post_init__(self) -> None:
        vertices, faces = _frozen(self.vertices, np.float64), _frozen(self.faces, np.int64)
        check_mesh(self.name, vertices, faces)
        checks.check_positive("radius", self.radius)
        if not self.cameras:
            raise checks.SceneError(f"scene {self.name!r} must have at least one view, got none: pass cameras")
        for field, value in (("vertices", vertices), ("faces", faces), ("cameras", tuple(self.cameras))):
            object.__setattr__(self, field, value)
        object.__setattr__(self, "radius", float(self.radius))

    def camera(
        self, views: Iterable[int] | int | None, height: int, width: int, *, dtype: torch.dtype = torch.float32
    ) -> Camera:
        """The cameras of some views, as one batch.

        Args:
            views: indices into `cameras` (negative ones count from the end), one index, or None for all.
            height, width: image size in pixels.
            dtype: of the camera's tensors.
        Raises: RangeError for a view that does not exist.
        """
        chosen = [self.cameras[i] for i in self.view_indices(views)]
        fov = torch.tensor([view.fov_y_deg for view in chosen], dtype=torch.float64)
        pose = torch.stack([view.world_to_view() for view in chosen])
        return Camera.perspective(fov, height, width, world_to_view=pose).to(dtype)

    def view_indices(self, views: Iterable[int] | int | None) -> list[int]:
        """`views` as a list of indices from 0; None gives all. Raises: RangeError for a view that does not exist."""
        if views is None:
            return list(range(len(self.cameras)))
        listed: list[Any] = [views] if isinstance(views, int) else list(views)
        count = len(self.cameras)
        for index in listed:
            whole = isinstance(index, (int, np.integer)) and not isinstance(index, bool)
            if not whole or not -count <= index < count:
                raise checks.RangeError(
                    f"views must be indices below {count} of scene {self.name!r}, got {index!r}: use 0 to {count - 1}"
                )
        if not listed:
            raise checks.RangeError("views must name at least one view, got none: pass None for all of them")
        return [int(index) % count for index in listed]

    @property
    def rays(self) -> RayCaster:
        """The mesh as embree sees it, built on first use (thread-safe). Face indices are rows of `faces`."""
        return self._once("_rays", lambda: RayCaster(self.vertices, self.faces))

    @property
    def face_normals(self) -> NDArray[np.float64]:
        """(F, 3) unit normals by the winding of each face, zero for faces without area; built on first use."""
        return self._once("_face_normals", lambda: face_normals(self.vertices, self.faces))

    @property
    def corner_normals(self) -> NDArray[np.float64]:
        """(F, 3, 3) unit normals of each face's corners, smooth except over creases; built on first use."""
        return self._once("_corner_normals", lambda: corner_normals(self.vertices, self.faces))

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal in scene units."""
        used = self.vertices[self.faces].reshape(-1, 3)
        return float(np.linalg.norm(used.max(axis=0) - used.min(axis=0)))

    @property
    def fingerprint(self) -> str:
        """Hash of the mesh and the views, not of the name or the suggested radius."""
        return self._once("_fingerprint", self._hash)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scene):
            return NotImplemented
        return (self.name, self.radius, self.fingerprint) == (other.name, other.radius, other.fingerprint)

    def __hash__(self) -> int:
        return hash((self.name, self.radius, self.fingerprint))

    def __repr__(self) -> str:
        return (
            f"Scene({self.name!r}, {len(self.vertices)} vertices, {len(self.faces)} faces, {len(self.cameras)} views, "
            f"radius={self.radius:g})"
        )

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if not key.startswith("_")}

    def _hash(self) -> str:
        digest = hashlib.sha256()
        for array in (self.vertices, self.faces):
            digest.update(repr(array.shape).encode())
            digest.update(array.tobytes())
        digest.update(repr(self.cameras).encode())
        return digest.hexdigest()[:32]

    def _once(self, key: str, build: Any) -> Any:
        if key not in self.__dict__:
            with _BUILD_LOCK:
                if key not in self.__dict__:
                    object.__setattr__(self, key, build())
        return self.__dict__[key]


def check_mesh(name: str, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
    """Raise `SceneError` unless the arrays make a mesh that rays can hit."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise checks.SceneError(
            f"mesh {name!r} must have vertices (V, 3) and faces (F, 3), got {vertices.shape} and {faces.shape}: "
            "triangulate it"
        )
    if len(vertices) == 0:
        raise checks.SceneError(f"mesh {name!r} must have vertices, got an empty mesh: check how it was exported")
    if len(faces) == 0:
        raise checks.SceneError(
            f"mesh {name!r} must have faces, got {len(vertices)} vertices alone: point clouds need meshing first"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise checks.SceneError(
            f"mesh {name!r} must have faces of vertices below {len(vertices)}, got {faces.min()} to {faces.max()}: "
            "repair the file"
        )
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise checks.SceneError(
            f"mesh {name!r} must have finite vertices, got {bad} with NaN or inf: repair or remove them"
        )


def _frozen(array: Any, dtype: Any) -> NDArray[Any]:
    frozen = np.array(array, dtype=dtype, order="C")  # a copy: a cached embree scene must not go stale behind it
    frozen.setflags(write=False)
    return frozen


def _is_number(value: object) -> bool:
    return (
        isinstance(value, (int, float, np.floating, np.integer))
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def _vector(name: str, value: Any) -> Vector:
    listed = list(value) if isinstance(value, (tuple, list, np.ndarray)) else [value]
    if len(listed) != 3:
        raise checks.ShapeError(f"{name} must be three numbers, got {value!r}: write [x, y, z]")
    if not all(_is_number(v) for v in listed):
        raise checks.RangeError(f"{name} must be three finite numbers, got {value!r}: write [x, y, z]")
    return float(listed[0]), float(listed[1]), float(listed[2])
