"""Cameras from JSON and cameras placed automatically."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import torch_ssao as ts
from torch_ssao.checks import RangeError, SceneError, ShapeError
from torch_ssao.scenes import View
from torch_ssao.scenes.cameras import place_views, read_cameras
from torch_ssao.scenes.rays import RayCaster
from torch_ssao.scenes.shapes import Builder

ONE = {"eye": [0, 1, -6], "target": [0, 0, 0], "up": [0, 1, 0], "fov_y_deg": 45}
EXPECTED = View((0, 1, -6), (0, 0, 0), (0, 1, 0), 45)


@pytest.mark.parametrize(
    ("content", "radius"),
    [
        ([ONE], None),
        ({"views": [ONE]}, None),
        ({"views": [ONE], "ao_radius": 0.25}, 0.25),
        ({"mesh": {"views": [ONE], "ao_radius": 0.5}, "other": {"views": []}}, 0.5),
        ({"mesh": [ONE]}, None),
    ],
)
def test_forms(content: Any, radius: float | None, tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(content))
    for given in (path, str(path), content):
        assert read_cameras(given, "mesh") == ((EXPECTED,), radius)


def test_views_and_defaults() -> None:
    short = {"eye": [0, 1, -6], "target": [0, 0, 0]}
    assert read_cameras([EXPECTED, short], "mesh")[0] == (EXPECTED, View((0, 1, -6), (0, 0, 0), (0, 1, 0), 60))
    assert read_cameras(EXPECTED, "mesh")[0] == (EXPECTED,)


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        ("{", SceneError, "must be JSON"),
        ("[]", SceneError, "at least one view"),
        ("3", SceneError, "at least one view"),
        ('"text"', SceneError, "at least one view"),
        ("{}", SceneError, "key 'views' or 'mesh', got nothing"),
        ('{"other": {}}', SceneError, "key 'views' or 'mesh', got 'other'"),
        ('{"mesh": {"ao_radius": 1}}', SceneError, r"\['mesh'\] must have the key 'views', got 'ao_radius'"),
        ("[3]", SceneError, r"\[0\] must be"),
        ('[{"eye": [0, 0, 0]}]', SceneError, r"\[0\] must have the key 'target'"),
        ('[{"eye": [0, 0], "target": [0, 0, 1]}]', ShapeError, r"\[0\]: eye must be three numbers"),
        ('[{"eye": [0, 0, NaN], "target": [0, 0, 1]}]', RangeError, r"\[0\]: eye must be three finite numbers"),
        ('[{"eye": [0, 0, 0], "target": [0, 0, 1], "fov_y_deg": 190}]', RangeError, r"\[0\]: fov_y_deg must lie in"),
        ('{"views": [{"eye": [0, 0, 0], "target": [0, 0, 1]}], "ao_radius": 0}', RangeError, "'ao_radius'"),
    ],
)
def test_unusable_files(content: str, error: type[ValueError], message: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(content)
    with pytest.raises(error, match=message) as caught:
        read_cameras(path, "mesh")
    assert "cameras.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="does not exist: check the path"):
        read_cameras(tmp_path / "no.json", "mesh")


def test_object_is_seen_from_around(tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    b = Builder()
    b.quad(50.0)
    b.sphere((3.0, 1.0, 2.0), 1.0)
    vertices, faces = b.mesh()
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    scene = ts.scenes.load(path)
    assert len(scene.cameras) == 4
    eyes = np.array([view.eye for view in scene.cameras])
    away = np.linalg.norm(eyes - (3.0, 1.0, 2.0), axis=1)
    assert ((away > 1.5) & (away < 8.0)).all()  # round the ball, not round the ground
    assert (eyes[:, 1] > 1.0).all()
    for i in range(4):
        hits = ts.scenes.primary_hits(scene, i, 24, 32)
        assert hits.triangle[12, 16] >= 2  # the ball, not the ground's two triangles
    assert 0.01 * scene.diagonal <= scene.radius <= 0.05 * scene.diagonal
    assert ts.scenes.load(path) == scene


@pytest.mark.parametrize("name", ["room", "stairs"])
def test_interior_is_seen_from_inside(name: str) -> None:
    scene = ts.scenes.builtin(name)
    views = place_views(scene.vertices, scene.faces, scene.rays)
    assert len(views) == 4
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    assert all(((np.array(view.eye) > low) & (np.array(view.eye) < high)).all() for view in views)
    assert len(set(views)) == 4


def test_no_view_at_all() -> None:
    # A sliver that no coarse ray meets from any side.
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]])
    faces = np.array([[0, 1, 2]])
    with pytest.raises(SceneError, match=r"could not be placed automatically.*pass cameras"):
        place_views(vertices, faces, RayCaster(vertices, faces))
