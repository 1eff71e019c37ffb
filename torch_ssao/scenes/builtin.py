"""The built-in scenes: what a screen-space technique meets in practice, without a file to download. Metres, y up."""

from __future__ import annotations

import functools

from torch_ssao import checks
from torch_ssao.scenes import buildings, interiors, objects
from torch_ssao.scenes.scene import Scene

_SCENES = {
    "temple": buildings.temple,
    "room": interiors.room,
    "street": buildings.street,
    "pipes": objects.pipes,
    "heap": objects.heap,
    "stairs": interiors.stairs,
}


def names() -> list[str]:
    """Names of the built-in scenes."""
    return list(_SCENES)


def builtin(name: str) -> Scene:
    """One of the built-in scenes: a mesh in metres, y up, four views and a radius; the same every time.

    Args:
        name: "temple" (steps, columns, gabled roof, inner room), "room" (furniture, shelves, legs), "street" (houses
            with window recesses, kerbs), "pipes" (pipes, fence and wire: thin geometry), "heap" (spheres and tori
            piled on a plane) or "stairs" (two flights, landing, balusters).
    Raises: ChoiceError for another name; SceneError when trimesh is not installed.
    Cost: under 0.2 s the first time, nothing later.
    """
    checks.check_choice("name", name, _SCENES)
    return _build(name)


@functools.cache  # scenes are read-only, and share their embree scene this way
def _build(name: str) -> Scene:
    builder, views, radius = _SCENES[name]()
    vertices, faces = builder.mesh()
    return Scene(name, vertices, faces, views, radius)
