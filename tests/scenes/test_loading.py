"""Mesh files: every format, scene graphs, and one-line errors."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import torch_ssao as ts
from torch_ssao.checks import RangeError, SceneError

VIEW = {"eye": [0, 1, -6], "target": [0, 0, 0], "up": [0, 1, 0], "fov_y_deg": 45}


@pytest.mark.parametrize("ending", ["glb", "gltf", "obj", "ply", "stl", "off"])
def test_formats(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"box.{ending}"
    box = trimesh.creation.box((2, 2, 2))
    if ending == "gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(box)).items():
            (tmp_path / name.replace("model", "box")).write_bytes(data)
    else:
        box.export(path)
    scene = ts.scenes.load(path, cameras=[VIEW], radius=0.5)
    assert scene.name == "box"
    assert len(scene.faces) == 12
    assert scene.radius == 0.5
    np.testing.assert_allclose(scene.vertices[scene.faces].reshape(-1, 3).max(axis=0), 1.0, atol=1e-6)
    assert ts.scenes.render(scene, height=24, width=32).valid_mask.any()


def test_scene_graph_is_flattened(tmp_path: Path) -> None:
    graph = trimesh.Scene()
    box = trimesh.creation.box((1, 1, 1))
    graph.add_geometry(box, geom_name="box")
    graph.add_geometry(box, geom_name="box2", transform=trimesh.transformations.translation_matrix((5, 0, 0)))
    graph.export(tmp_path / "two.glb")
    scene = ts.scenes.load(str(tmp_path / "two.glb"), cameras=[VIEW], radius=0.5)
    assert len(scene.faces) == 24
    assert scene.vertices[:, 0].max() == pytest.approx(5.5)
    assert scene.diagonal == pytest.approx(np.sqrt(6**2 + 1 + 1))


def test_degenerate_faces_are_dropped(tmp_path: Path) -> None:
    (tmp_path / "some.off").write_text("OFF\n4 3 0\n0 0 0\n1 0 0\n0 1 0\n2 0 0\n3 0 1 2\n3 0 1 1\n3 0 1 3\n")
    assert ts.scenes.load(tmp_path / "some.off", cameras=[VIEW], radius=1.0).faces.tolist() == [[0, 1, 2]]
    (tmp_path / "none.off").write_text("OFF\n4 1 0\n0 0 0\n1 0 0\n0 1 0\n2 0 0\n3 0 1 3\n")
    with pytest.raises(SceneError, match="only degenerate ones"):
        ts.scenes.load(tmp_path / "none.off")


def test_radius_argument_file_and_suggestion(tmp_path: Path) -> None:
    path = tmp_path / "box.ply"
    trimesh.creation.box((2, 2, 2)).export(path)
    record = {"views": [VIEW], "ao_radius": 0.3}
    assert ts.scenes.load(path, cameras=record).radius == 0.3
    assert ts.scenes.load(path, cameras=record, radius=0.4).radius == 0.4
    # Seen from about 5 away a tenth is above the cap of 5 % of the diagonal.
    assert ts.scenes.load(path, cameras=[VIEW]).radius == pytest.approx(0.05 * np.sqrt(12), rel=1e-6)
    lost = {**VIEW, "target": [0, 1, -12]}
    with pytest.raises(SceneError, match="see nothing of the mesh"):
        ts.scenes.load(path, cameras=[lost])


@pytest.mark.parametrize("radius", [0, -0.5, float("nan")])
def test_radius_must_be_positive(radius: float, tmp_path: Path) -> None:
    with pytest.raises(RangeError, match="radius must be finite and greater than 0"):
        ts.scenes.load(tmp_path / "any.ply", radius=radius)


OFF_NAN = "OFF\n3 1 0\n0 0 nan\n1 0 0\n0 1 0\n3 0 1 2\n"
PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("noise.ply", b"\x00\x01 not a mesh", "cannot be read"),
        ("noise.glb", b"glTF????", "cannot be read"),
        ("mesh.xyzzy", b"1 2 3", "cannot be read"),
        ("nothing.stl", b"", "cannot be read|empty mesh"),
        ("empty.ply", PLY.format(0).encode(), "cannot be read|empty mesh"),
        ("cloud.ply", (PLY.format(2) + "0 0 0\n1 1 1\n").encode(), "must have faces, got 2 vertices alone"),
        ("bad.off", OFF_NAN.encode(), "finite vertices, got 1 with NaN or inf"),
        ("far.off", OFF_NAN.replace("nan", "inf").encode(), "finite vertices, got 1 with NaN or inf"),
        ("wild.off", OFF_NAN.replace("nan", "0").replace("3 0 1 2", "3 0 1 7").encode(), "cannot be read|below 3"),
    ],
)
def test_unusable_files(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SceneError, match=message) as caught:
        ts.scenes.load(path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"mesh file '.*no\.glb' does not exist: check the path"):
        ts.scenes.load(tmp_path / "no.glb")
    with pytest.raises(SceneError, match="is a folder"):
        ts.scenes.load(tmp_path)


def test_trimesh_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "box.off"
    path.write_text(OFF_NAN)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(SceneError, match=r"trimesh.*pip install torch_ssao\[scenes\]"):
        ts.scenes.load(path)


def test_loading_leaves_no_state(tmp_path: Path) -> None:
    path = tmp_path / "box.ply"
    trimesh.creation.box((2, 2, 2)).export(path)
    arguments: dict[str, Any] = {"cameras": [VIEW], "radius": 0.5}
    assert ts.scenes.load(path, **arguments) == ts.scenes.load(path, **arguments)
