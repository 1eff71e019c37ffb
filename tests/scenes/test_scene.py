"""The scene record and its views."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from torch_ssao.checks import RangeError, SceneError, ShapeError
from torch_ssao.scenes import Scene, View

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
FRONT, SIDE = View((0, 0, -3), (0, 0, 0), fov_y_deg=40.0), View((1, 0.5, -2), (0, 0, 0))


def scene(**changes: Any) -> Scene:
    return replace(Scene("square", SQUARE, HALVES, (FRONT, SIDE), 0.5), **changes)


def test_camera_of_views() -> None:
    camera = scene().camera([1, -2], 48, 64)
    assert len(camera) == 2
    assert camera.fx.dtype == torch.float32
    assert camera.fy[1].item() == pytest.approx(24 / np.tan(np.deg2rad(20.0)), rel=1e-6)
    eye = torch.tensor([1.0, 0.5, -2.0, 1.0])
    assert torch.allclose(camera.world_to_view[0] @ eye, torch.tensor([0.0, 0, 0, 1]), atol=1e-6)
    assert len(scene().camera(None, 8, 8)) == 2
    assert len(scene().camera(1, 8, 8, dtype=torch.float64)) == 1


@pytest.mark.parametrize("views", [2, -3, [0, 5], [0.5], [True], []])
def test_views_out_of_range(views: Any) -> None:
    with pytest.raises(RangeError, match="views must"):
        scene().camera(views, 8, 8)


def test_equality_fingerprint_and_repr() -> None:
    assert scene() == scene()
    assert len({scene(), scene()}) == 1
    assert scene() != "square"
    assert scene(radius=0.7).fingerprint == scene().fingerprint == scene(name="other").fingerprint
    assert scene(radius=0.7) != scene()
    assert scene(cameras=(FRONT,)).fingerprint != scene().fingerprint
    assert scene(vertices=2 * SQUARE).fingerprint != scene().fingerprint
    assert scene(faces=HALVES[:, ::-1]).fingerprint != scene().fingerprint
    assert repr(scene()) == "Scene('square', 4 vertices, 2 faces, 2 views, radius=0.5)"


def test_arrays_are_read_only_copies() -> None:
    mine = SQUARE.copy()
    made = scene(vertices=mine)
    mine[0] = 7.0
    assert made.vertices[0, 0] == -1.0
    with pytest.raises(ValueError, match="read-only"):
        made.vertices[0] = 1.0


def test_pickle_and_copy_leave_embree_behind() -> None:
    made = scene()
    _ = made.rays
    for other in (pickle.loads(pickle.dumps(made)), copy.deepcopy(made)):
        assert other == made
        assert other.rays is not made.rays


def test_embree_is_built_once_whatever_the_threads() -> None:
    made = scene()
    with ThreadPoolExecutor(4) as pool:
        assert len({id(caster) for caster in pool.map(lambda _: made.rays, range(16))}) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vertices": np.zeros((0, 3)), "faces": np.zeros((0, 3), int)}, "empty mesh"),
        ({"faces": np.zeros((0, 3), int)}, "must have faces, got 4 vertices alone"),
        ({"vertices": SQUARE * [1, np.nan, 1]}, "finite vertices, got 4 with NaN or inf"),
        ({"vertices": np.where(SQUARE == 1, np.inf, SQUARE)}, "finite vertices"),
        ({"faces": np.array([[0, 1, 4]])}, "faces of vertices below 4"),
        ({"faces": np.array([[0, 1, 2, 3]])}, "triangulate it"),
        ({"cameras": ()}, "at least one view"),
    ],
)
def test_unusable_meshes(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        scene(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan"), float("inf")])
def test_radius_must_be_positive(radius: float) -> None:
    with pytest.raises(RangeError, match="radius must be finite and greater than 0"):
        scene(radius=radius)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (((0, 0), (0, 0, 1)), ShapeError, "eye must be three numbers"),
        ((3.0, (0, 0, 1)), ShapeError, "eye must be three numbers"),
        (((0, 0, 0), (0, 0, float("nan"))), RangeError, "target must be three finite numbers"),
        (((0, 0, 0), (0, 0, "1")), RangeError, "target must be three finite numbers"),
        (((0, 0, 0), (0, 0, 0)), RangeError, "target must differ from eye"),
        (((0, 0, 0), (0, 2, 0)), RangeError, "up must not be parallel"),
        (((0, 0, 0), (0, 0, 1), (0, 1, 0), 180.0), RangeError, r"fov_y_deg must lie in \(0, 180\)"),
        (((0, 0, 0), (0, 0, 1), (0, 1, 0), 0), RangeError, "fov_y_deg"),
        (((0, 0, 0), (0, 0, 1), (0, 1, 0), "60"), RangeError, "fov_y_deg"),
    ],
)
def test_unusable_views(arguments: Any, error: type[ValueError], message: str) -> None:
    with pytest.raises(error, match=message):
        View(*arguments)
