"""Primary rays: exact depth, normals towards the eye, and errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

import torch_ssao as ts
from torch_ssao.checks import ChoiceError, DtypeError, RangeError, SceneError
from torch_ssao.scenes import Scene, View, primary_hits, render

H, W = 48, 64


def square(views: tuple[View, ...], *, flip: bool = False) -> Scene:
    vertices = 20.0 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Scene("square", vertices, faces[:, ::-1] if flip else faces, views, 0.5)


def test_depth_is_view_z_not_ray_length() -> None:
    gbuffer = render(square((View((0.3, -0.2, -4.0), (0.3, -0.2, 0)),)), height=H, width=W)
    assert gbuffer.valid_mask.all()
    assert (gbuffer.depth - 4.0).abs().max() < 1e-5
    assert gbuffer.depth.dtype == gbuffer.normal.dtype == torch.float32


@pytest.mark.parametrize("flip", [False, True])
def test_oblique_plane(flip: bool) -> None:
    # Depth along the pixel's ray (x, y, 1) to the plane n . p = d is d / (n . ray): closed form, pixel centres at +0.5.
    view = View((1.0, 2.0, -5.0), (0.0, 0.5, 0.0), fov_y_deg=50.0)
    gbuffer = render(square((view,), flip=flip), height=H, width=W, dtype=torch.float64)
    pose = view.world_to_view()
    normal = pose[:3, :3] @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    offset = normal @ pose[:3, 3]
    focal = 0.5 * H / np.tan(np.deg2rad(25.0))
    x = (torch.arange(W, dtype=torch.float64) + 0.5 - W / 2) / focal
    y = ((torch.arange(H, dtype=torch.float64) + 0.5 - H / 2) / focal)[:, None]
    exact = offset / (normal[0] * x + normal[1] * y + normal[2])
    assert (gbuffer.depth[0, 0] - exact).abs().max() < 1e-9
    assert (gbuffer.normal[0] + normal[:, None, None]).abs().max() < 1e-12  # both windings face the eye
    points = gbuffer.camera.unproject(gbuffer.depth)[0, :, 0]
    assert ((gbuffer.normal[0] * points).sum(0) < 0).all()


def test_box_in_front_of_the_sky() -> None:
    box = trimesh.creation.box((2, 2, 2))
    scene = Scene("box", box.vertices, box.faces, (View((0, 0, -5), (0, 0, 0)), View((3, 4, -5), (0, 0, 0))), 0.5)
    gbuffer = render(scene, height=H, width=W)
    assert gbuffer.depth.shape == (2, 1, H, W)
    inside = gbuffer.valid_mask[0, 0]
    focal = 0.5 * H / np.tan(np.deg2rad(30.0))
    half = focal / 4  # the near face spans +-1 at depth 4
    centers = torch.arange(W) + 0.5 - W / 2
    expected = (centers.abs() < half)[None] & ((torch.arange(H) + 0.5 - H / 2).abs() < half)[:, None]
    assert torch.equal(inside, expected)
    assert (gbuffer.depth[0, 0][inside] - 4.0).abs().max() < 1e-5
    assert torch.isinf(gbuffer.depth[0, 0][~inside]).all()
    assert (gbuffer.normal[0, :, ~inside] == 0).all()
    only = render(scene, views=1, height=H, width=W)
    assert torch.equal(only.depth, gbuffer.depth[1:])
    assert torch.equal(render(scene, views=[1, 0], height=H, width=W).depth, gbuffer.depth.flip(0))


def test_scene_far_from_the_origin() -> None:
    near = square((View((0.3, -0.2, -4.0), (0.3, -0.2, 0)),))
    shift = np.array([1e5, 1e5, -1e5])
    eye, target = (tuple(np.asarray(p) + shift) for p in (near.cameras[0].eye, near.cameras[0].target))
    far = replace(near, vertices=near.vertices + shift, cameras=(View(eye, target),))
    assert (render(far, height=H, width=W).depth - 4.0).abs().max() < 1e-5


def test_smooth_and_geometric_normals() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    scene = Scene("ball", ball.vertices, ball.faces, (View((0, 0, -3), (0, 0, 0), fov_y_deg=50.0),), 0.5)
    hits = primary_hits(scene, 0, H, W)
    exact = hits.position[hits.hit] / np.linalg.norm(hits.position[hits.hit], axis=1, keepdims=True)
    smooth = np.einsum("ij,ij->i", hits.shading_normal[hits.hit], exact)
    flat = np.einsum("ij,ij->i", hits.geometric_normal[hits.hit], exact)
    replaced = (hits.shading_normal[hits.hit] == hits.geometric_normal[hits.hit]).all(axis=1)
    assert smooth[~replaced].min() > 0.9995
    assert 0 < replaced.mean() < 0.05  # at the rim, where the smooth one looks away
    assert smooth.mean() > flat.mean()
    for kind in ("smooth", "geometric"):
        gbuffer = render(scene, height=H, width=W, normals=kind)
        seen = gbuffer.valid_mask[0, 0]
        assert (gbuffer.normal[0][:, seen].norm(dim=0) - 1).abs().max() < 1e-5
        points = gbuffer.camera.unproject(gbuffer.depth)[0, :, 0][:, seen]
        assert ((gbuffer.normal[0][:, seen] * points).sum(0) < 0).all()


def test_primary_hits_agree_with_the_gbuffer() -> None:
    scene = ts.scenes.builtin("temple")
    hits = primary_hits(scene, 2, H, W)
    gbuffer = render(scene, views=2, height=H, width=W, dtype=torch.float64)
    pose = gbuffer.camera.world_to_view[0].numpy()
    moved = hits.position @ pose[:3, :3].T + pose[:3, 3]
    points = gbuffer.camera.unproject(gbuffer.depth)[0, :, 0].numpy()
    np.testing.assert_allclose(moved[hits.hit], np.moveaxis(points, 0, -1)[hits.hit], atol=1e-9)
    assert np.array_equal(hits.hit, gbuffer.valid_mask[0, 0].numpy())
    corners = scene.vertices[scene.faces[hits.triangle[hits.hit]]]
    away = np.einsum("ij,ij->i", hits.position[hits.hit] - corners[:, 0], hits.geometric_normal[hits.hit])
    assert np.abs(away).max() < 1e-9  # hits lie in their triangles' planes
    np.testing.assert_allclose(hits.eye, scene.cameras[2].eye, atol=1e-12)


def test_view_that_sees_nothing() -> None:
    scene = square((View((0, 0, -4), (0, 0, 0)), View((0, 0, -4), (0, 0, -9))))
    with pytest.raises(SceneError, match=r"view 1 of scene 'square' sees nothing.*move the camera") as caught:
        render(scene, height=H, width=W)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"height": 0}, RangeError, "height must be a whole number at least 1"),
        ({"width": 2.5}, RangeError, "width must be a whole number at least 1"),
        ({"views": [1]}, RangeError, "views must be indices below 1"),
        ({"layers": 0}, RangeError, "layers must be a whole number at least 1"),
        ({"layers": 2}, RangeError, "layers must be 1, got 2: .*not available yet"),
        ({"triangles": True}, ChoiceError, "triangles must be False.*not available yet"),
        ({"normals": "flat"}, ChoiceError, "normals must be one of 'smooth', 'geometric'"),
        ({"dtype": torch.int32}, DtypeError, "dtype must be floating point"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], error: type[ValueError], message: str) -> None:
    with pytest.raises(error, match=message):
        render(square((View((0, 0, -4), (0, 0, 0)),)), **({"height": H, "width": W} | arguments))
