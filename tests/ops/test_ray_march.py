"""The ray march against the pixel-loop oracle, closed forms and the cases that its contract names."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import torch_ssao as ts
from support.gbuffers import plane_gbuffer, random_gbuffer, steps_gbuffer
from support.ray_march import geometry, oracle, ray_march, some_pixels
from torch_ssao import checks
from torch_ssao.ops import ray_march_hit
from torch_ssao.scenes import analytic

CASES = [
    {"height": 13, "width": 17, "batch": 2},
    {"height": 10, "width": 11, "peels": 2},
    {"height": 10, "width": 11, "peels": 3},
    {"height": 9, "width": 11, "peels": 4, "invalid": 0.3},
    {"height": 12, "width": 15, "normals": False},
    {"height": 12, "width": 15, "orthographic": True},
    {"height": 12, "width": 15, "invalid": 0.6},
    {"height": 1, "width": 19},
    {"height": 19, "width": 1},
    {"height": 6, "width": 6, "invalid": 1.1},
]


@pytest.mark.parametrize("thick", [False, True])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_float64_equals_the_oracle(case: dict, thick: bool) -> None:
    gb = random_gbuffer(3, **case)
    net = ray_march(thick=thick)
    torch.testing.assert_close(net(gb), oracle(net, gb), atol=1e-9, rtol=0)


@pytest.mark.parametrize("radius", [1e-3, 0.05, 2.0, 100.0])
def test_float64_equals_the_oracle_at_any_radius(radius: float) -> None:
    gb = random_gbuffer(7, height=10, width=12)
    net = ray_march(radius=radius)
    torch.testing.assert_close(net(gb), oracle(net, gb), atol=1e-9, rtol=0)


def test_float64_equals_the_oracle_with_a_pixel_cap_another_frame_and_one_step() -> None:
    for changes in ({"max_radius_px": 2.5}, {"steps": 1}, {"rays": 1}, {"falloff": 9.0}):
        for orthographic in (False, True):
            gb = random_gbuffer(8, height=9, width=12, orthographic=orthographic)
            net = ray_march(**changes)
            torch.testing.assert_close(net(gb, frame=5), oracle(net, gb, frame=5), atol=1e-9, rtol=0)


def test_normals_that_face_away_are_tilted_as_in_the_oracle() -> None:
    gb = random_gbuffer(8, height=9, width=12)
    generator = torch.Generator().manual_seed(0)
    wild = torch.nn.functional.normalize(torch.randn(gb.normal.shape, generator=generator, dtype=torch.float64), dim=1)
    gb = ts.GBuffer(gb.depth, gb.camera, normal=wild, valid=gb.valid)
    net = ray_march()
    torch.testing.assert_close(net(gb), oracle(net, gb), atol=1e-9, rtol=0)


def test_float32_equals_the_oracle_on_98_percent() -> None:
    gb = random_gbuffer(3, height=21, width=27, dtype=torch.float32)
    net = ray_march()
    error = (net.float()(gb) - oracle(net, gb, eps=2.0**-23)).abs()
    assert (error <= 1e-5).double().mean() >= 0.98  # the rest: a step on the other side of a pixel's edge


def test_block_size_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    gb = random_gbuffer(3, height=13, width=17, batch=3)
    net = ray_march()
    whole = net(gb)
    for budget in (6, 600, 6000):
        monkeypatch.setitem(ts.ops.ray_march._TAPS_AT_ONCE, "cpu", budget)
        torch.testing.assert_close(net(gb), whole, atol=1e-14, rtol=0)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 70.0, 80.0, 85.0])
def test_plane_is_open(angle: float, dtype: torch.dtype, orthographic: bool) -> None:
    gb = plane_gbuffer(angle, dtype=dtype, orthographic=orthographic)
    for radius in (0.05, 0.7):
        assert ((1 - ts.RayMarchedSSAO(radius)(gb)).abs() <= 1e-3).all()
    estimated = ts.GBuffer.from_depth(gb.depth, gb.camera)
    assert ((1 - ts.RayMarchedSSAO(0.7)(estimated)).abs()[..., 1:-1, 1:-1] <= 1e-3).all()


def closed_form_error(scene: analytic.AnalyticScene, camera: ts.Camera, pixels: slice, **question: object) -> Tensor:
    """Errors at pixels of which the whole reach is on the screen and whose neighbours lie on the same surface."""
    gb = scene.render(camera)
    falloff = {"linear": 1.0, "quadratic": 2.0, "binary": 1e4}[str(question["falloff"])]
    value, whole = some_pixels(gb, pixels, radius=float(question["radius"]), falloff=falloff)  # type: ignore[arg-type]
    exact, known = scene.exact(gb, **question)  # type: ignore[arg-type]
    normal = gb.normal[0]
    same = torch.ones(normal.shape[1:], dtype=torch.bool)
    for axis in (1, 2):
        for shift in (-2, -1, 1, 2):  # the pixel on a crease shows one of its two surfaces
            same &= (normal * normal.roll(shift, axis)).sum(0) > 0.95
    kept = whole & known.flatten()[pixels] & same.flatten()[pixels]
    return (value - exact.flatten()[pixels])[kept]


CAMERAS = [
    {"fov_y_deg": 10.0},
    {"fov_y_deg": 50.0},
    {"fov_y_deg": 120.0},
    {"orthographic": True},
]


@pytest.mark.parametrize("kind", CAMERAS, ids=str)
@pytest.mark.parametrize("angle", [20.0, 50.0])
def test_closed_forms(angle: float, kind: dict) -> None:
    """Some pixels before a wall; all views and rows in the slow test."""
    scene = analytic.wall()
    height, width = 96, 128
    gb = scene.render(scene.camera(height, width, view_angle_deg=angle, **kind))
    exact, known = scene.exact(gb, radius=0.4, falloff="linear")
    row = slice(48 * width, 49 * width)
    _, whole = some_pixels(gb, row, radius=0.4, falloff=1.0, rays=512, steps=1)
    row_exact = torch.where(known.flatten()[row] & whole, exact.flatten()[row], 2.0)
    start = 48 * width + int((row_exact - 0.9).abs().argmin())
    error = closed_form_error(scene, gb.camera, slice(start - 2, start + 3), radius=0.4, falloff="linear")
    assert len(error) > 0
    assert error.abs().max() <= 0.005


@pytest.mark.slow
@pytest.mark.parametrize("falloff", ["binary", "linear", "quadratic"])
@pytest.mark.parametrize("kind", CAMERAS, ids=str)
@pytest.mark.parametrize("name", ["wall", "dihedral", "bowl"])
def test_closed_forms_at_every_view(name: str, kind: dict, falloff: str) -> None:
    scene = {
        "wall": analytic.wall(),
        "dihedral": analytic.dihedral(120.0),
        "bowl": analytic.spherical_bowl(1.0, 60.0),
    }[name]
    height, width, counted = 96, 128, 0
    for angle in (0.0,) if name == "bowl" else (0.0, 20.0, 40.0, 60.0, 80.0):  # tilted, a bowl hides its near side
        camera = scene.camera(height, width, view_angle_deg=angle, **kind)
        pixels = slice(48 * width, 49 * width)
        error = closed_form_error(scene, camera, pixels, radius=0.4, falloff=falloff)
        hidden = name == "wall" and angle == 0.0  # the wall is seen edge-on
        if len(error) and not hidden:
            counted += len(error)
            assert error.abs().max() <= 0.005, angle
    assert counted >= 20


def test_thickness_sees_the_gap_below_a_raised_slat() -> None:
    scene = analytic.raised_slat(0.2, 0.4)
    gb = scene.render(scene.camera(64, 80, view_angle_deg=50.0))
    exact, known = scene.exact(gb, radius=0.8, falloff="linear")
    pixels = slice(32 * 80 + 20, 32 * 80 + 60)
    errors = []
    for thickness in (None, 0.1, 0.03):
        value, whole = some_pixels(gb, pixels, radius=0.8, falloff=1.0, thickness=thickness, rays=128)
        error = (value - exact.flatten()[pixels])[whole & known.flatten()[pixels]]
        assert len(error) > 5
        errors.append(error.abs().mean())
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < 0.3 * errors[0]
    assert errors[2] < 0.005


def two_layers(back: float | None) -> ts.GBuffer:
    """A floor facing the eye with a bar across it in front; the floor's second layer, where there is one, is behind."""
    depth = torch.full((1, 4, 24, 24), torch.inf)
    depth[:, 0] = 4.0
    depth[:, 0, :, 14:18] = 3.0
    if back is not None:
        depth[:, 1, :, 14:18] = back
        depth[:, 2, :, 14:18] = 4.0
    return ts.GBuffer(depth, ts.Camera.orthographic(4.0, 24, 24))


def test_deeper_layers_are_exits_and_entries() -> None:
    net = ts.RayMarchedSSAO(1.5, rays=64, steps=16)
    blocked, thin, thick = (net(two_layers(back))[0, 0, 12, 12] for back in (None, 3.1, 3.9))
    assert blocked < thick < thin < 0.99  # rays pass between the bar and the floor, and the bar still occludes
    single = two_layers(None)
    alone = ts.GBuffer(single.depth[:, :1], single.camera)
    torch.testing.assert_close(net(single), net(alone))


def test_a_second_solid_is_seen_behind_the_first() -> None:
    depth = two_layers(3.1).depth.clone()
    depth[:, 2, :, 14:18] = 3.4
    depth[:, 3, :, 14:18] = 3.8
    net = ts.RayMarchedSSAO(1.5, rays=64, steps=16)
    with_second = net(ts.GBuffer(depth, two_layers(None).camera))[0, 0, 12, 12]
    assert with_second < net(two_layers(3.1))[0, 0, 12, 12] - 0.02


def test_off_screen_steps_never_occlude_and_are_left_out() -> None:
    gb = plane_gbuffer(30.0)
    assert (ts.RayMarchedSSAO(100.0)(gb) == 1).all()
    # A groove that ends at the screen's edge: what is left of each ray is averaged, nothing is darkened or opened.
    whole = analytic.dihedral(120.0)
    camera = whole.camera(64, 64, view_angle_deg=0.0, orthographic=True)
    gb = whole.render(camera)
    half = ts.Camera(camera.fx, camera.fy, camera.cx, camera.cy, 64, 40, camera.world_to_view, True)
    cut = ts.GBuffer(gb.depth[..., :40].contiguous(), half, normal=gb.normal[..., :40], valid=gb.valid[..., :40])
    net = ts.RayMarchedSSAO(0.3, rays=64, steps=16).double()
    change = net(cut) - net(gb)[..., :40]
    assert change[..., :29].abs().max() < 1e-14
    assert change[..., 30:].abs().max() < 0.2
    assert change[..., 30:].abs().mean() < 0.005


def test_invalid_pixels_are_open_and_never_occlude() -> None:
    gb = steps_gbuffer(height=24, width=32)
    block = gb.depth < 3.5
    hollow = ts.GBuffer(torch.where(block, torch.nan, gb.depth), gb.camera, normal=gb.normal)
    net = ts.RayMarchedSSAO(0.5, thickness=None)
    out = net(hollow)
    assert torch.isfinite(out).all()
    assert (out[block] == 1).all()
    smooth = net(gb)
    assert (out - smooth)[~block].min() >= -1e-3
    assert (out - smooth)[~block].max() > 0.05


def test_scale_invariance() -> None:
    gb = steps_gbuffer(height=20, width=24, dtype=torch.float64)
    small = ts.RayMarchedSSAO(0.4, thickness=0.5).double()(gb)
    for k in (2.0**-10, 2.0**20):
        scaled = ts.GBuffer(gb.depth * k, gb.camera, normal=gb.normal)
        torch.testing.assert_close(ts.RayMarchedSSAO(0.4 * k, thickness=0.5).double()(scaled), small, atol=1e-6, rtol=0)


def test_directions_are_a_cosine_weighted_hemisphere() -> None:
    gb = random_gbuffer(5, height=3, width=4)
    _, normals, _ = geometry(gb)
    normal = normals[:, :, 0].flatten(2).movedim(1, 0)
    noise = torch.rand(2, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ray = ray_march_hit.directions(normal, ts.ops.poisson_disk(512, dtype=torch.float64), 512, *noise)
    cosine = (ray * normal[:, None]).sum(0)
    torch.testing.assert_close(ray.square().sum(0), torch.ones_like(cosine), atol=1e-12, rtol=0)
    assert (cosine > 0).all()
    torch.testing.assert_close(cosine.mean(0), torch.full((1, 12), 2 / 3, dtype=torch.float64), atol=1e-3, rtol=0)
    torch.testing.assert_close(ray.mean(1), 2 / 3 * normal, atol=3e-3, rtol=0)


def test_equation_1() -> None:
    pixels = ray_march_hit.Pixels(*[torch.zeros(1)] * 3, falloff=torch.ones(1, 1), thickness=None)
    for before, after, bounded, expected in (
        (0.3, 0.1, True, 2 + 0.75),
        (0.0, 0.1, True, 2.0),
        (0.3, 0.0, True, 3.0),
        (0.0, 0.0, True, 2.0),
        (0.0, 0.1, False, 3.0),
    ):
        value = ray_march_hit.openness(
            torch.tensor([[before]]), torch.tensor([[bounded]]), torch.tensor([[after]]), torch.tensor([[3]]), pixels, 5
        )
        assert value.item() == pytest.approx(expected / 5)
        assert math.isfinite(value.item())


def test_bad_arguments() -> None:
    gb = random_gbuffer(1, height=4, width=5)
    points, normals, intrinsics = geometry(gb)
    reach, one = torch.ones(1, 4, 5, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    rest = (reach, one, None, intrinsics, torch.zeros(1, 2), torch.zeros(4, 5), torch.zeros(4, 5))
    for changes, error, message in (
        ({"steps": 0}, checks.RangeError, "steps must be a whole number"),
        ({"steps": 1, "gradient": "none"}, checks.ChoiceError, "gradient must be one of"),
        ({"steps": 1, "surrogate_width": 0.0}, checks.RangeError, "surrogate_width must be"),
    ):
        with pytest.raises(error, match=message):
            ts.ops.ray_march_visibility(points, gb.valid, normals, *rest, orthographic=False, **changes)
