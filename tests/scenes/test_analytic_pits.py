"""Analytic pits, corners and round things: exact G-buffers, exact visibility, meshes, what is unknown, errors."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from support import monte_carlo as mc
from support import pits
from support.traced import analytic_mesh, judge_analytic
from torch_ssao import checks, scenes
from torch_ssao.camera import Camera, look_at
from torch_ssao.gbuffer import GBuffer
from torch_ssao.scenes import analytic
from torch_ssao.scenes import closed_forms as cf

Builder = Callable[[], analytic.AnalyticScene]
Array = mc.Array
BUILDERS: dict[str, tuple[Builder, list[mc.Occluder]]] = {
    "pit": (lambda: analytic.rectangular_pit(1.0, 1.6, 0.6), pits.box(1.0, 1.6, 0.6)),
    "trench": (lambda: analytic.trench(1.0, 0.6), pits.box(1.0, math.inf, 0.6)),
    "round pit": (lambda: analytic.round_pit(0.6, 0.5), pits.round_pit(0.6, 0.5)),
    "bowl": (lambda: analytic.spherical_bowl(0.6, 70.0), pits.bowl(0.6, 70.0)),
    "cavity": (lambda: analytic.spherical_bowl(0.6, 130.0), pits.bowl(0.6, 130.0)),
    "corner": (analytic.room_corner, pits.corner()),
    "cylinder": (lambda: analytic.lying_cylinder(0.4), pits.lying_cylinder(0.4)),
    "disk": (lambda: analytic.disk_over_plane(0.5, 0.4), pits.disk(0.5, 0.4)),
}
SIZE = (24, 32)


def _world(gbuffer: GBuffer, vectors: torch.Tensor, last: float) -> Array:
    """(H, W, 3) world coordinates of view-space positions (last 1) or directions (last 0), batch of one."""
    homogeneous = torch.cat((vectors, torch.full_like(vectors[:, :1], last)), dim=1)
    assert gbuffer.camera.world_to_view is not None
    inverse = torch.linalg.inv(gbuffer.camera.world_to_view.double())
    return torch.einsum("bij,bjhw->bhwi", inverse, homogeneous.double())[0, ..., :3].numpy()


def _geometry(gbuffer: GBuffer) -> tuple[Array, Array]:
    """World points and normals (N, 3) of the valid pixels."""
    assert gbuffer.normal is not None
    valid = gbuffer.valid_mask[0, 0].numpy()
    points = _world(gbuffer, gbuffer.camera.unproject(gbuffer.depth)[:, :, 0], 1.0)
    return points[valid], _world(gbuffer, gbuffer.normal, 0.0)[valid]


def _inwards(name: str, p: Array) -> list[tuple[Array, Array]]:
    """(gap, normal) of every surface of a scene at the points, written once more by hand."""
    x, y, z = np.eye(3)
    lateral = np.hypot(p[:, 0], p[:, 1])
    sideways = p * [1, 1, 0] / np.maximum(lateral, 1e-12)[:, None]
    if name in ("bowl", "cavity"):
        rim = 0.6 * (1 - math.cos(math.radians(70 if name == "bowl" else 130)))
        centre = np.array([0, 0, 0.6]) - p
        distance = np.linalg.norm(centre, axis=1)
        return [(np.abs(distance - 0.6), centre / distance[:, None]), (np.abs(p[:, 2] - rim), z + 0 * p)]
    flat = [(np.abs(p[:, 2]), z + 0 * p)]
    if name == "corner":
        return [*flat, (np.abs(p[:, 0]), x + 0 * p), (np.abs(p[:, 1]), -y + 0 * p)]
    if name == "cylinder":
        out = (p - [0, 0, 0.4]) * [1, 0, 1]
        distance = np.linalg.norm(out, axis=1)
        return [*flat, (np.abs(distance - 0.4), out / np.maximum(distance, 1e-12)[:, None])]
    if name == "disk":
        return [*flat, (np.abs(p[:, 2] - 0.4), z * np.where(p[:, 2:] > 0.39, 1.0, 0.0))]
    depth = 0.5 if name == "round pit" else 0.6
    mouth = [*flat, (np.abs(p[:, 2] - depth), z + 0 * p)]
    if name == "round pit":
        return [*mouth, (np.abs(lateral - 0.6), -sideways)]
    sides = [(np.abs(np.abs(p[:, 0]) - 0.5), -np.sign(p[:, :1]) * x)]
    return [*mouth, *sides, *([(np.abs(np.abs(p[:, 1]) - 0.8), -np.sign(p[:, 1:2]) * y)] if name == "pit" else [])]


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("name", BUILDERS)
def test_pixels_lie_on_surfaces(name: str, orthographic: bool) -> None:
    scene = BUILDERS[name][0]()
    for angle in (0.0, 40.0, 70.0):
        gbuffer = scene.render(scene.camera(*SIZE, view_angle_deg=angle, orthographic=orthographic))
        assert gbuffer.valid_mask.double().mean() > 0.4
        points, normals = _geometry(gbuffer)
        gaps, expected = (np.stack(part) for part in zip(*_inwards(name, points), strict=True))
        owner = gaps.argmin(axis=0)
        depth = gbuffer.depth[gbuffer.valid_mask].numpy()
        assert (gaps.min(axis=0) < 1e-12 * (1 + depth)).all()
        clear = np.sort(gaps, axis=0)[1] > 1e-9  # not on an edge
        agree = (expected[owner, np.arange(len(owner))] * normals).sum(axis=1)
        np.testing.assert_allclose(np.abs(agree[clear]), 1.0, rtol=0, atol=1e-11)
        # Sides are seen from within, but for the disk's underside; every normal faces the eye.
        assert (agree[clear] > 0).all() or name == "disk"
        eye = torch.linalg.inv(gbuffer.camera.world_to_view)[0] if gbuffer.camera.world_to_view is not None else None
        assert eye is not None
        ray = eye[:3, 2].numpy() if orthographic else points - eye[:3, 3].numpy()
        assert ((ray * normals).sum(axis=1) < 0).all()
        if angle == 0.0 and name in ("pit", "trench", "round pit", "disk", "cylinder"):
            assert len(np.unique(owner)) >= 2  # both floor and what stands or lies about it are seen


@pytest.mark.parametrize("name", BUILDERS)
def test_exact_against_ray_casting_at_pixels(name: str) -> None:
    build, occluders = BUILDERS[name]
    scene, rng = build(), np.random.default_rng(2)
    for orthographic, weighting in ((False, "cosine"), (True, "cosine"), (False, "uniform")):
        camera = scene.camera(*SIZE, view_angle_deg=35.0, orthographic=orthographic)
        gbuffer = scene.render(camera)
        points, normals = _geometry(gbuffer)
        near = np.abs(points).max(axis=1) < 2
        # Two pixels of anything, and one of the steepest surface.
        chosen = rng.permutation(np.flatnonzero(near))[:2].tolist()
        chosen.append(int(np.argmax(np.where(near, -np.abs(normals[:, 2]), -9.0))))
        answers = {}
        for radius in (math.inf, 0.5):
            for falloff in cf.FALLOFFS:
                visibility, known = scene.exact(gbuffer, radius=radius, falloff=falloff, weighting=weighting)
                assert torch.equal(known, gbuffer.valid_mask)
                answers[radius, falloff] = visibility[known].numpy()
        for pixel in chosen:
            start = points[pixel] + 1e-7 * normals[pixel]
            cast = mc.distances(start, normals[pixel], occluders, weighting=weighting, seed=pixel, log2_rays=14)
            for (radius, falloff), answer in answers.items():
                expected = mc.attenuated(cast, radius, falloff)
                assert answer[pixel] == pytest.approx(expected, abs=1.5e-3), (radius, falloff, points[pixel])


@pytest.mark.parametrize("name", BUILDERS)
def test_mesh_is_the_scene(name: str) -> None:
    """The triangles lie on the surfaces, look to the open side, and are rendered to the same G-buffer."""
    scene = BUILDERS[name][0]()
    vertices, faces = scene.mesh(3.0)
    assert (faces.min(), faces.max()) == (0, len(vertices) - 1)
    distances = torch.stack([s.distance(torch.from_numpy(vertices)) for s in scene.surfaces]).min(dim=0).values
    assert distances.max().item() < 1e-12
    corners = vertices[faces]
    assert np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).min() > 0
    world = analytic_mesh(scene, radius=1.0, extent=20.0)
    traced = scenes.render(world, height=SIZE[0], width=SIZE[1], dtype=torch.float64)
    exact = scene.render(traced.camera)
    both = traced.valid_mask & exact.valid_mask
    assert both.double().mean() > 0.9 * exact.valid_mask.double().mean()
    assert exact.normal is not None
    assert traced.normal is not None
    same = (exact.normal * traced.normal).sum(dim=1, keepdim=True) > 0.999
    relative = (exact.depth / traced.depth - 1).abs()
    assert (same & (relative < 2e-4))[both].double().mean() > 0.97  # all but silhouettes and edges


@pytest.mark.parametrize("name", BUILDERS)
def test_exact_against_ray_tracing(name: str) -> None:
    scene = BUILDERS[name][0]()
    found = judge_analytic(scene, radius=0.4, samples=64, size=SIZE, view_angle_deg=30.0)
    assert found.pixels > 300
    assert found.bias_in_errors() < 5
    assert found.rms_error < 1.3 * found.monte_carlo_error + 1e-3


def test_surfaces_seen_from_outside() -> None:
    """From below, what lies under the ground is unknown; a corner, a cylinder's floor and a disk are open there."""
    eye = torch.tensor([0.2, -0.3, -2.0], dtype=torch.float64)
    pose = look_at(eye, eye + torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    camera = Camera.perspective(torch.tensor(50.0, dtype=torch.float64), 8, 8, world_to_view=pose)
    for name, (build, _) in BUILDERS.items():
        scene = build()
        gbuffer = scene.render(camera)
        visibility, known = scene.exact(gbuffer)
        assert bool(gbuffer.valid_mask.any()), name
        assert bool((visibility == 1).all()), name
        opened = name in ("corner", "cylinder", "disk")
        assert torch.equal(known, gbuffer.valid_mask & opened), name


def test_volumetric_is_known_in_the_corner_only() -> None:
    for name, (build, _) in BUILDERS.items():
        scene = build()
        gbuffer = scene.render(scene.camera(*SIZE, view_angle_deg=20.0))
        _, known = scene.exact(gbuffer, radius=0.5, weighting="volumetric")
        assert bool(known.all()) == (name == "corner")


def test_default_cameras_stand_in_the_open() -> None:
    for name, (build, _) in BUILDERS.items():
        scene = build()
        for angle in (0.0, 45.0, 80.0):
            for orthographic in (False, True):
                gbuffer = scene.render(scene.camera(9, 13, view_angle_deg=angle, orthographic=orthographic))
                assert gbuffer.normal is not None
                points = _world(gbuffer, gbuffer.camera.unproject(gbuffer.depth)[:, :, 0], 1.0)
                np.testing.assert_allclose(points[4, 6], scene.focus, atol=1e-9, err_msg=f"{name} {angle}")
                known = scene.exact(gbuffer)[1][gbuffer.valid_mask]
                assert known.double().mean() > 0.95, name  # a pixel that hits an edge exactly may lie on either side


def test_scenes_pickle_and_take_float32() -> None:
    for name, (build, _) in BUILDERS.items():
        scene = build()
        camera = scene.camera(*SIZE, view_angle_deg=40.0)
        exact, known = scene.exact(scene.render(camera), radius=0.5)
        copy = pickle.loads(pickle.dumps(scene))
        assert torch.equal(copy.exact(copy.render(camera), radius=0.5)[0], exact), name
        rounded, known32 = scene.exact(scene.render(camera, dtype=torch.float32), radius=0.5)
        assert torch.equal(known, known32), name
        assert torch.allclose(rounded.double(), exact, atol=1e-4), name


def test_errors_name_argument_and_remedy() -> None:
    bad: list[tuple[str, Callable[[], Any]]] = [
        ("width must be finite", lambda: analytic.rectangular_pit(0.0, 1.0, 1.0)),
        ("length must be finite", lambda: analytic.rectangular_pit(1.0, math.inf, 1.0)),
        ("depth must be finite", lambda: analytic.rectangular_pit(1.0, 1.0, -1.0)),
        ("width must be finite", lambda: analytic.trench(-1.0, 1.0)),
        ("depth must be finite", lambda: analytic.trench(1.0, 0.0)),
        ("radius must be finite", lambda: analytic.round_pit(0.0, 1.0)),
        ("depth must be finite", lambda: analytic.round_pit(1.0, math.nan)),
        ("radius must be finite", lambda: analytic.spherical_bowl(0.0)),
        ("half_angle_deg must lie in", lambda: analytic.spherical_bowl(1.0, 180.0)),
        ("radius must be finite", lambda: analytic.lying_cylinder(0.0)),
        ("radius must be finite", lambda: analytic.disk_over_plane(0.0, 1.0)),
        ("height must be finite", lambda: analytic.disk_over_plane(1.0, 0.0)),
    ]
    for message, call in bad:
        with pytest.raises(checks.RangeError, match=message):
            call()
