"""The built-in scenes: all there, the same every time, and seen well by their cameras."""

from __future__ import annotations

import numpy as np
import pytest

import torch_ssao as ts
from torch_ssao.checks import ChoiceError
from torch_ssao.scenes.builtin import _SCENES

NAMES = ("temple", "room", "street", "pipes", "heap", "stairs")


def test_names() -> None:
    assert tuple(ts.scenes.names()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_every_camera_sees_a_good_picture(name: str) -> None:
    scene = ts.scenes.builtin(name)
    assert len(scene.cameras) == 4
    gbuffer = ts.scenes.render(scene, height=48, width=64)
    seen = gbuffer.valid_mask
    assert (seen.float().mean(dim=(1, 2, 3)) > 0.55).all()  # some sky is welcome
    for depth, mask in zip(gbuffer.depth, seen, strict=True):
        assert depth[mask].min() > 0.5  # nothing in front of the lens
        assert depth[mask].quantile(0.95) > 1.5 * depth[mask].quantile(0.05)  # not a wall
        assert scene.radius < depth[mask].median()


@pytest.mark.parametrize("name", NAMES)
def test_no_camera_is_inside_a_solid(name: str) -> None:
    # Parts are closed and wound outwards: what an eye in the open sees first is a front face.
    scene = ts.scenes.builtin(name)
    for view in range(4):
        hits = ts.scenes.primary_hits(scene, view, 24, 32)
        outward = scene.face_normals[hits.triangle[hits.hit]]
        assert np.mean(np.einsum("ij,ij->i", outward, hits.geometric_normal[hits.hit]) > 0) > 0.995


@pytest.mark.parametrize("name", NAMES)
def test_the_same_every_time(name: str) -> None:
    builder, views, radius = _SCENES[name]()
    vertices, faces = builder.mesh()
    again = ts.scenes.Scene(name, vertices, faces, views, radius)
    scene = ts.scenes.builtin(name)
    assert again == scene
    assert ts.scenes.builtin(name) is scene


def test_unknown_name() -> None:
    with pytest.raises(ChoiceError, match=r"name must be one of 'temple', .*got 'castle': pick one"):
        ts.scenes.builtin("castle")


def test_analytic_is_loaded_on_demand() -> None:
    assert ts.scenes.analytic.__name__ == "torch_ssao.scenes.analytic"
    assert "analytic" in dir(ts.scenes)
    with pytest.raises(AttributeError, match="has no attribute 'castle'"):
        _ = ts.scenes.castle
