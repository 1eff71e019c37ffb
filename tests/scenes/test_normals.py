"""Smooth normals: exact on spheres, hard over creases, indifferent to winding and to split vertices."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from torch_ssao.scenes import normals as normals_module
from torch_ssao.scenes.normals import corner_normals, face_normals


def test_sphere_is_smooth() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    corners = corner_normals(np.asarray(ball.vertices), np.asarray(ball.faces))
    exact = ball.vertices[ball.faces]
    assert np.einsum("fci,fci->fc", corners, exact).min() > 0.9999


def test_box_stays_flat() -> None:
    box = trimesh.creation.box((1, 2, 3))
    vertices, faces = np.asarray(box.vertices), np.asarray(box.faces)
    flat = np.repeat(face_normals(vertices, faces)[:, None], 3, axis=1)
    np.testing.assert_allclose(corner_normals(vertices, faces), flat, atol=1e-12)


def test_crease_angle() -> None:
    vertices = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0.5, 0], [-np.cos(0.5), 0.5, np.sin(0.5)]])
    faces = np.array([[0, 2, 1], [0, 1, 3]])  # they meet at 0.5 rad, 28.6 degrees
    assert np.abs(np.diff(corner_normals(vertices, faces, 30.0)[0, :2], axis=0)).max() > 0.1
    np.testing.assert_allclose(
        corner_normals(vertices, faces, 28.0)[0], np.repeat([[0, 0, 1.0]], 3, axis=0), atol=1e-12
    )


def test_winding_and_split_vertices_do_not_matter() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    plain = corner_normals(vertices, faces)
    split = corner_normals(vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))
    np.testing.assert_allclose(split, plain, atol=1e-12)
    turned = faces.copy()
    turned[::2] = turned[::2, ::-1]
    other = corner_normals(vertices, turned)
    np.testing.assert_allclose(other[1::2], plain[1::2], atol=1e-12)
    np.testing.assert_allclose(other[::2], -plain[::2, ::-1], atol=1e-12)


def test_small_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    plain = corner_normals(vertices, faces)
    monkeypatch.setattr(normals_module, "_PAIRS", 17)
    np.testing.assert_allclose(corner_normals(vertices, faces), plain, atol=1e-12)


def test_wide_fans_and_faces_without_area() -> None:
    angle = 2 * np.pi * np.arange(400) / 400
    rim = np.stack((np.cos(angle), np.zeros(400), np.sin(angle)), axis=1)
    vertices = np.concatenate((rim, [[0.0, 0.1, 0.0]]))
    i = np.arange(400)
    faces = np.concatenate((np.stack((i, np.full(400, 400), (i + 1) % 400), 1), [[0, 0, 1]]))
    corners = corner_normals(vertices, faces)
    assert np.isfinite(corners).all()
    np.testing.assert_allclose(corners[:400, 1], face_normals(vertices, faces)[:400], atol=1e-12)
    assert (face_normals(vertices, faces)[400] == 0).all()
