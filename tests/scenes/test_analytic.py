"""Analytic scenes: exact G-buffers, exact visibility at their pixels, meshes, cameras, errors."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from support import monte_carlo as mc
from torch_ssao import checks
from torch_ssao.camera import Camera, look_at
from torch_ssao.gbuffer import GBuffer
from torch_ssao.scenes import analytic
from torch_ssao.scenes import closed_forms as cf

BUILDERS: dict[str, Callable[[], analytic.AnalyticScene]] = {
    "plane": analytic.plane,
    "wall": analytic.wall,
    "dihedral 50": lambda: analytic.dihedral(50.0),
    "dihedral 130": lambda: analytic.dihedral(130.0),
    "dihedral 250": lambda: analytic.dihedral(250.0),
    "finite wall": lambda: analytic.finite_wall(0.5),
    "slat": lambda: analytic.raised_slat(0.2, 0.4),
    "ceiling": lambda: analytic.ceiling(0.8),
    "sphere": lambda: analytic.sphere_on_plane(0.6),
}
SIZE = (24, 32)


def _world(gbuffer: GBuffer, vectors: torch.Tensor, last: float) -> np.ndarray[Any, Any]:
    """(H, W, 3) world coordinates of view-space positions (last 1) or directions (last 0), batch of one."""
    homogeneous = torch.cat((vectors, torch.full_like(vectors[:, :1], last)), dim=1)
    assert gbuffer.camera.world_to_view is not None
    inverse = torch.linalg.inv(gbuffer.camera.world_to_view.double())
    return torch.einsum("bij,bjhw->bhwi", inverse, homogeneous.double())[0, ..., :3].numpy()


def _points(gbuffer: GBuffer) -> np.ndarray[Any, Any]:
    return _world(gbuffer, gbuffer.camera.unproject(gbuffer.depth)[:, :, 0], 1.0)


def _occluders(name: str) -> list[mc.Occluder]:
    """The scenes once more, for the independent ray caster."""
    floor = mc.plane((0, 0, 0), (0, 0, 1))
    half_floor = mc.plane((0, 0, 0), (0, 0, 1), lambda p: p[:, 0] > 0)

    def upright(low: float, high: float) -> mc.Occluder:
        return mc.plane((0, 0, 0), (1, 0, 0), lambda p: (p[:, 2] > low) & (p[:, 2] < high))

    def face(angle_deg: float) -> mc.Occluder:
        along = np.array([math.cos(math.radians(angle_deg)), 0.0, math.sin(math.radians(angle_deg))])
        return mc.plane((0, 0, 0), (along[2], 0.0, -along[0]), lambda p: p @ along > 0)

    return {
        "plane": [floor],
        "wall": [half_floor, upright(0, math.inf)],
        "dihedral 50": [half_floor, face(50.0)],
        "dihedral 130": [half_floor, face(130.0)],
        "dihedral 250": [half_floor, face(250.0)],
        "finite wall": [floor, upright(0, 0.5)],
        "slat": [floor, upright(0.2, 0.6)],
        "ceiling": [floor, mc.plane((0, 0, 0.8), (0, 0, 1))],
        "sphere": [floor, mc.sphere((0, 0, 0.6), 0.6)],
    }[name]


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("view_angle_deg", [0.0, 40.0, 75.0])
@pytest.mark.parametrize("name", BUILDERS)
def test_pixels_lie_on_primitives(name: str, view_angle_deg: float, orthographic: bool) -> None:
    scene = BUILDERS[name]()
    gbuffer = scene.render(scene.camera(*SIZE, view_angle_deg=view_angle_deg, orthographic=orthographic))
    valid = gbuffer.valid_mask[0, 0].numpy()
    assert gbuffer.normal is not None
    assert valid.mean() > 0.4
    points, normals = _points(gbuffer)[valid], _world(gbuffer, gbuffer.normal, 0.0)[valid]
    reach = 1e-12 * (1 + gbuffer.depth[0, 0].numpy()[valid])
    # Which surface: the floor's normal is vertical, those of walls are not; a ceiling is told by its height.
    gaps = {
        "floor": np.abs(points[:, 2]),
        "wall": np.abs(points[:, 0]),
        "ceiling": np.abs(points[:, 2] - 0.8),
        "sphere": np.abs(np.linalg.norm(points - [0, 0, 0.6], axis=1) - 0.6),
    }
    second = {"finite wall": "wall", "slat": "wall", "plane": "floor"}.get(name, name)
    if name.startswith("dihedral"):
        beta = math.radians(float(name.split()[1]))
        gaps[name] = np.abs(points @ [math.sin(beta), 0.0, -math.cos(beta)])
    assert (np.minimum(gaps["floor"], gaps[second]) < reach).all()
    on_floor = gaps["floor"] < reach
    assert on_floor.any()
    np.testing.assert_allclose(np.abs(normals[on_floor & (gaps[second] > 1e-9)] @ [0, 0, 1]), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=0, atol=1e-12)
    if name == "sphere":
        ball = ~on_floor
        np.testing.assert_allclose(normals[ball], (points[ball] - [0, 0, 0.6]) / 0.6, rtol=0, atol=1e-11)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("name", BUILDERS)
def test_normals_face_the_eye(name: str, orthographic: bool) -> None:
    scene = BUILDERS[name]()
    gbuffer = scene.render(scene.camera(*SIZE, view_angle_deg=60.0, orthographic=orthographic))
    assert gbuffer.normal is not None
    positions = gbuffer.camera.unproject(torch.ones_like(gbuffer.depth))[:, :, 0]
    ray = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).view(1, 3, 1, 1) if orthographic else positions
    assert bool(((gbuffer.normal * ray).sum(1) < 0).all())
    assert bool(torch.isfinite(gbuffer.normal).all())


@pytest.mark.parametrize("angle", [0.0, 30.0, 85.0])
def test_view_angle_is_the_angle_from_the_normal(angle: float) -> None:
    scene = analytic.plane()
    for orthographic in (False, True):
        gbuffer = scene.render(scene.camera(9, 9, view_angle_deg=angle, orthographic=orthographic))
        assert gbuffer.normal is not None
        assert -gbuffer.normal[0, 2, 4, 4].item() == pytest.approx(math.cos(math.radians(angle)), abs=1e-12)
        np.testing.assert_allclose(_points(gbuffer)[4, 4], scene.focus, atol=1e-12)


@pytest.mark.parametrize("name", BUILDERS)
def test_exact_against_ray_casting_at_pixels(name: str) -> None:
    """A few pixels of every scene, both projections, every falloff: rays cast from the rendered point."""
    scene = BUILDERS[name]()
    rng = np.random.default_rng(5)
    for orthographic, (radius, falloff, weighting) in (
        (False, (math.inf, "binary", "cosine")),
        (True, (0.7, "binary", "cosine")),
        (False, (0.7, "linear", "cosine")),
        (True, (0.7, "quadratic", "cosine")),
        (False, (0.7, "binary", "uniform")),
        (True, (0.7, "linear", "uniform")),
    ):
        gbuffer = scene.render(scene.camera(*SIZE, view_angle_deg=50.0, orthographic=orthographic))
        visibility, known = scene.exact(gbuffer, radius=radius, falloff=falloff, weighting=weighting)
        assert torch.equal(known, gbuffer.valid_mask)
        assert gbuffer.normal is not None
        points, normals = _points(gbuffer), _world(gbuffer, gbuffer.normal, 0.0)
        interesting = np.argwhere(known[0, 0].numpy() & (np.abs(points).max(-1) < 3))
        for row, column in rng.permutation(interesting)[:5]:
            # Start a hair above the surface, as the independent caster knows nothing of which surface it stands on.
            start = points[row, column] + 1e-7 * normals[row, column]
            cast = mc.visibility(
                start,
                normals[row, column],
                _occluders(name),
                radius=radius,
                falloff=falloff,
                weighting=weighting,
                seed=int(row),
                log2_rays=16,
            )
            assert visibility[0, 0, row, column].item() == pytest.approx(cast, abs=4e-4)


def test_known_answers_per_pixel() -> None:
    scene = analytic.wall()
    gbuffer = scene.render(scene.camera(*SIZE))
    visibility, known = scene.exact(gbuffer)
    assert bool(known.all())
    assert torch.allclose(visibility, torch.tensor(0.5, dtype=torch.float64), atol=1e-12)
    visibility, _ = scene.exact(gbuffer, radius=0.5)
    points = _points(gbuffer)
    expected = cf.wall(np.maximum(np.abs(points[..., 0]), np.abs(points[..., 2])), radius=0.5)
    np.testing.assert_allclose(visibility[0, 0].numpy(), expected, atol=1e-12)
    convex = analytic.dihedral(250.0)
    assert bool((convex.exact(convex.render(convex.camera(*SIZE)))[0] == 1).all())


def test_other_sides_are_known() -> None:
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    eye = torch.tensor([0.4, 0.3, -2.0], dtype=torch.float64)
    pose = look_at(eye, eye - 3 * down, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    camera = Camera.perspective(torch.tensor(40.0, dtype=torch.float64), 8, 8, world_to_view=pose)
    for name in ("plane", "finite wall", "slat", "ceiling", "sphere"):
        scene = BUILDERS[name]()
        visibility, known = scene.exact(scene.render(camera))
        assert bool(known.all()), name
        assert bool((visibility == 1).all()), name
    # From below the floor half-plane of a wedge one stands in the outer angle of 360 - 275 = 85 degrees.
    outside = analytic.dihedral(275.0)
    visibility, known = outside.exact(outside.render(camera))
    assert bool(known.any())
    inner = math.sin(math.radians(42.5)) ** 2
    assert torch.allclose(visibility[known], torch.tensor(inner, dtype=torch.float64), atol=1e-12)


def test_unknown_where_no_closed_form_holds() -> None:
    scene = analytic.sphere_on_plane(1.0)
    inside = torch.eye(4, dtype=torch.float64)
    inside[:3, 3] = torch.tensor([0.0, 0.0, -1.0])  # the eye at the sphere's centre
    camera = Camera.perspective(torch.tensor(60.0, dtype=torch.float64), 6, 6, world_to_view=inside)
    gbuffer = scene.render(camera)
    assert torch.allclose(gbuffer.depth[0, 0, 3, 3], torch.tensor(1.0, dtype=torch.float64), atol=0.02)
    visibility, known = scene.exact(gbuffer)
    assert not bool(known.any())
    assert bool((visibility == 1).all())

    slat = analytic.raised_slat(0.2, 0.4)
    gbuffer = slat.render(slat.camera(*SIZE))
    _, known = slat.exact(gbuffer, radius=0.5, weighting="volumetric")
    on_floor = np.abs(_points(gbuffer)[..., 2]) < 1e-9
    assert on_floor.any()
    assert (~on_floor).any()
    np.testing.assert_array_equal(known[0, 0].numpy(), ~on_floor)

    wall = analytic.wall()
    gbuffer = wall.render(wall.camera(*SIZE))
    visibility, known = wall.exact(gbuffer, radius=0.5, weighting="volumetric")
    assert bool(known.all())
    assert 0.5 <= visibility.min().item() < 0.6

    moved = GBuffer(gbuffer.depth * 0.9, gbuffer.camera)
    assert not bool(wall.exact(moved)[1].any())


def test_rays_that_miss_are_invalid() -> None:
    scene = analytic.plane()
    gbuffer = scene.render(scene.camera(16, 16, view_angle_deg=85.0, fov_y_deg=60.0))
    valid = gbuffer.valid_mask[0, 0]
    assert bool(valid[-1].all())
    assert not bool(valid[0].any())
    assert bool(torch.isinf(gbuffer.depth[0, 0][~valid]).all())
    assert gbuffer.normal is not None
    assert bool((gbuffer.normal[0, :, 0, 0] == torch.tensor([0.0, 0.0, -1.0])).all())
    assert gbuffer.depth[0, 0][valid].max().item() <= 1e4 * scene.span
    visibility, known = scene.exact(gbuffer, radius=1.0)
    assert torch.equal(known[0, 0], valid)
    assert bool((visibility == 1).all())


def test_batches_dtypes_and_cameras_without_pose() -> None:
    scene = analytic.ceiling(1.0)
    both = Camera.cat([scene.camera(*SIZE, view_angle_deg=a) for a in (10.0, 60.0)])
    gbuffer = scene.render(both, dtype=torch.float32)
    assert gbuffer.depth.shape == (2, 1, *SIZE)
    assert gbuffer.depth.dtype == torch.float32
    visibility, known = scene.exact(gbuffer, radius=2.0)
    assert visibility.dtype == torch.float32
    assert bool(known.all())
    assert torch.allclose(visibility, torch.tensor(0.25), atol=1e-6)
    single = scene.render(both[1], dtype=torch.float32)
    assert torch.equal(single.depth, gbuffer.depth[1:])
    plain = scene.render(Camera.perspective(50.0, *SIZE))  # at the origin of the floor, looking up at the plate
    assert torch.allclose(plain.depth, torch.ones_like(plain.depth), atol=1e-12)


def test_float32_depth_is_still_on_its_surface() -> None:
    for name, build in BUILDERS.items():
        scene = build()
        camera = scene.camera(*SIZE, view_angle_deg=50.0)
        exact, known = scene.exact(scene.render(camera), radius=0.5)
        rounded, known32 = scene.exact(scene.render(camera, dtype=torch.float32), radius=0.5)
        assert torch.equal(known, known32), name
        assert torch.allclose(rounded.double(), exact, atol=2e-5), name


@pytest.mark.parametrize("name", BUILDERS)
def test_mesh_is_the_scene(name: str) -> None:
    scene = BUILDERS[name]()
    vertices, faces = scene.mesh(3.0)
    assert vertices.dtype == np.float64
    assert faces.dtype == np.int64
    assert faces.min() == 0
    assert faces.max() == len(vertices) - 1
    corners = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (area > 0).all()
    for surface in scene.surfaces:
        if isinstance(surface, analytic.Sphere):
            assert area[2:].sum() == pytest.approx(4 * math.pi * surface.radius**2, rel=5e-4)
            sides = corners[2:]
            outward = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
            assert ((outward * (sides.mean(axis=1) - surface.centre)).sum(axis=1) > 0).all()
            # closed and consistently wound: every directed edge occurs once, and so does its reverse
            edges = np.concatenate([faces[2:][:, [i, (i + 1) % 3]] for i in range(3)])
            assert {tuple(e) for e in edges} == {tuple(e[::-1]) for e in edges}
            assert len({tuple(e) for e in edges}) == len(edges)
    distances = torch.stack([s.distance(torch.from_numpy(vertices)) for s in scene.surfaces]).min(dim=0).values
    assert distances.max().item() < 1e-12
    floor = vertices[np.abs(vertices[:, 2]) < 1e-12]
    assert floor[:, 0].max() == pytest.approx(scene.focus[0] + 3.0)
    assert np.abs(floor[:, 1]).max() == pytest.approx(3.0)


def test_default_cameras_stand_in_the_open() -> None:
    """No surface between eye and focus, and no orthographic ray that starts beyond a surface."""
    for name, build in BUILDERS.items():
        scene = build()
        for angle in (0.0, 45.0, 80.0):
            for orthographic in (False, True):
                camera = scene.camera(9, 13, view_angle_deg=angle, orthographic=orthographic)
                gbuffer = scene.render(camera)
                assert gbuffer.normal is not None
                np.testing.assert_allclose(_points(gbuffer)[4, 6], scene.focus, atol=1e-9, err_msg=f"{name} {angle}")
                centre = _world(gbuffer, gbuffer.normal, 0.0)[4, 6]
                assert centre @ [0, 0, 1] == pytest.approx(1.0, abs=1e-9)
                if name == "ceiling":
                    assert bool((scene.exact(gbuffer, radius=1.6)[0] < 0.3).all())  # nothing is seen from outside


def test_scenes_pickle() -> None:
    for build in BUILDERS.values():
        scene = build()
        copy = pickle.loads(pickle.dumps(scene))
        gbuffer = scene.render(scene.camera(4, 4))
        assert torch.equal(copy.exact(gbuffer, radius=0.5)[0], scene.exact(gbuffer, radius=0.5)[0])


def test_errors_name_argument_and_remedy() -> None:
    scene = analytic.wall()
    gbuffer = scene.render(scene.camera(4, 4))
    bad: list[tuple[type[ValueError], str, Callable[[], Any]]] = [
        (checks.RangeError, "angle_deg must lie in", lambda: analytic.dihedral(360.0)),
        (checks.RangeError, "height must be finite", lambda: analytic.finite_wall(0.0)),
        (checks.RangeError, "gap must be finite", lambda: analytic.raised_slat(-0.1, 1.0)),
        (checks.RangeError, "height must be finite", lambda: analytic.raised_slat(0.1, 0.0)),
        (checks.RangeError, "height must be finite", lambda: analytic.ceiling(math.inf)),
        (checks.RangeError, "radius must be finite", lambda: analytic.sphere_on_plane(-1.0)),
        (checks.RangeError, "view_angle_deg must lie in", lambda: scene.camera(4, 4, view_angle_deg=90.0)),
        (checks.RangeError, "fov_y_deg must lie in", lambda: scene.camera(4, 4, fov_y_deg=180.0)),
        (checks.RangeError, "span must be finite", lambda: scene.camera(4, 4, span=0.0)),
        (checks.RangeError, "extent must be finite", lambda: scene.mesh(0.0)),
        (checks.RangeError, "segments must be a whole number", lambda: scene.mesh(1.0, segments=3)),
        (
            checks.DtypeError,
            "dtype must be floating point",
            lambda: scene.render(scene.camera(4, 4), dtype=torch.int32),
        ),
        (checks.RangeError, "radius must be greater than 0", lambda: scene.exact(gbuffer, radius=-1.0)),
        (checks.ChoiceError, "falloff must be one of", lambda: scene.exact(gbuffer, falloff="cubic")),
        (checks.ChoiceError, "weighting must be one of", lambda: scene.exact(gbuffer, weighting="solid")),
        (
            checks.ChoiceError,
            "falloff must be 'binary'",
            lambda: scene.exact(gbuffer, falloff="linear", weighting="volumetric"),
        ),
    ]
    for error, message, call in bad:
        with pytest.raises(error, match=message):
            call()
