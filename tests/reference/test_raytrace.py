"""The reference against closed forms, against itself with more rays, and against bad input."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
import torch

from support.traced import compare, judge_analytic
from torch_ssao import checks, reference, scenes
from torch_ssao.scenes import Scene, View, analytic

SMALL = {"height": 12, "width": 16}

CLOSED_FORMS = {
    "wall": (analytic.wall(), 1.0),
    "wall, short rays": (analytic.wall(), 0.3),
    "dihedral 30": (analytic.dihedral(30.0), 0.8),
    "dihedral 60": (analytic.dihedral(60.0), 0.8),
    "dihedral 120": (analytic.dihedral(120.0), 0.8),
    "ceiling": (analytic.ceiling(0.6), 1.0),
    "ceiling, threshold on a cell's edge": (analytic.ceiling(0.5), 1.0),
    "finite wall": (analytic.finite_wall(0.5), 1.0),
    "raised slat": (analytic.raised_slat(0.3, 0.4), 1.0),
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.builtin("room")


@pytest.mark.parametrize("falloff", reference.FALLOFFS)
@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_closed_forms(name: str, falloff: str) -> None:
    world, radius = CLOSED_FORMS[name]
    found = judge_analytic(world, radius=radius, falloff=falloff)
    assert found.pixels > 2500
    # A pixel without any noise leaves rounding alone: float32 coordinates 30 spans from the centre.
    assert abs(found.bias) <= max(3 * found.bias_error, 2e-6)
    assert found.share_within_3 >= 0.95


@pytest.mark.parametrize("falloff", reference.FALLOFFS)
def test_sphere_on_plane(falloff: str) -> None:
    found = judge_analytic(analytic.sphere_on_plane(0.5), radius=1.0, falloff=falloff, size=(36, 48))
    assert found.bias_in_errors() <= 3
    assert found.share_within_3 >= 0.95


@pytest.mark.parametrize("falloff", reference.FALLOFFS)
@pytest.mark.parametrize("angle", [0.0, 60.0, 80.0, 86.0])
def test_a_plane_is_exactly_one_at_any_angle(angle: float, falloff: str) -> None:
    world = analytic.plane()
    found = judge_analytic(world, radius=1.0, falloff=falloff, size=(24, 32), view_angle_deg=angle, samples=128)
    assert (found.bias, found.rms_error, found.stated_error) == (0.0, 0.0, 0.0)


def test_convex_edges_are_open() -> None:
    assert judge_analytic(analytic.dihedral(270.0), radius=1.0, size=(24, 32)).rms_error == 0.0


@pytest.mark.parametrize("shift", [0.0, 3e4])
def test_tilted_planes_anywhere_do_not_hide_themselves(shift: float) -> None:
    rng = np.random.default_rng(4)
    for _ in range(8):
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        place = rng.uniform(-shift, shift, 3) if shift else np.zeros(3)
        local = np.stack((*np.meshgrid([-20, 0.3, 20], [-20, -0.7, 20]), np.zeros((3, 3))), axis=-1).reshape(9, 3)
        corner = np.array([0, 1, 3, 4])
        faces = np.concatenate([[[a, a + 1, a + 3], [a + 1, a + 4, a + 3]] for a in corner])
        eye = place + turn @ [1.5 * np.sin(0.4), 1.5 * np.sin(1.2), 0.8]
        view = View(tuple(eye), tuple(place), tuple(turn[:, 2]), 60.0)
        result = reference.raytrace(Scene("plane", local @ turn.T + place, faces, (view,), 0.3), **SMALL, samples=128)
        assert bool((result.visibility == 1).all())


def test_sixty_degree_disk_tells_cosine_from_uniform() -> None:
    """A disk that subtends 60 degrees about the normal hides 3/4 of the cosine and 1/2 of the solid angle."""
    rim = np.linspace(0, 2 * np.pi, 2048, endpoint=False)
    disk = np.stack((np.sqrt(3) * np.cos(rim), np.sqrt(3) * np.sin(rim), np.ones_like(rim)), axis=1)
    floor = np.array([[-1e-2, -1e-2, 0], [1e-2, -1e-2, 0], [0, 1e-2, 0]])
    fan = np.stack((np.full(2046, 3), np.arange(4, 2050), np.arange(5, 2051)), axis=1)
    view = View((0, 0, 0.5), (0, 0, 0), (0, 1, 0), 0.01)  # between the two, looking down at the point below the centre
    scene = Scene("disk", np.concatenate((floor, disk)), np.concatenate(([[0, 1, 2]], fan)), (view,), 10.0)
    result = reference.raytrace(scene, height=16, width=16)
    mean_error = float(result.standard_error.square().sum().sqrt()) / 256
    assert abs(float(result.visibility.mean()) - 0.25) <= 3 * mean_error + 2e-5
    rng = np.random.default_rng(0)
    uniform = rng.standard_normal((1 << 18, 3)).astype(np.float32)
    uniform[:, 2] = np.abs(uniform[:, 2])
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    start = np.repeat(scene.rays.to_local(np.array([[0.0, 0.0, 1e-4]])), len(uniform), axis=0)
    assert abs(scene.rays.occluded(start, uniform, 10.0).mean() - 0.5) < 4e-3


def test_stated_error_matches_a_long_run_and_beats_plain_monte_carlo(scene: Scene) -> None:
    truth = reference.raytrace(scene, views=0, height=30, width=40, samples=16384, seed=7)
    found = compare(truth.visibility, reference.raytrace(scene, views=0, height=30, width=40, seed=1))
    assert abs(found.stated_error / found.rms_error - 1) < 0.25
    assert found.rms_error < 0.4 * found.monte_carlo_error
    assert found.share_within_3 >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes.names())
@pytest.mark.parametrize("falloff", reference.FALLOFFS)
def test_noise_of_every_builtin_scene(name: str, falloff: str) -> None:
    size = {"height": 48, "width": 64, "views": 1, "falloff": falloff}
    scene = scenes.builtin(name)
    truth = reference.raytrace(scene, **size, samples=16384, seed=7)
    for samples in (32, 512):
        found = [
            compare(truth.visibility, reference.raytrace(scene, **size, samples=samples, seed=seed))
            for seed in range(1, 5)
        ]
        # A few pixels carry most of the noise: four seeds together tell a wrong scale from chance.
        stated, measured = (sum(getattr(f, name) ** 2 for f in found) for name in ("stated_error", "rms_error"))
        assert abs((stated / measured) ** 0.5 - 1) < 0.1
        assert min(f.share_within_3 for f in found) >= 0.95
    assert measured < 0.4**2 * sum(f.monte_carlo_error**2 for f in found)


def test_falloffs_are_ordered_and_radius_darkens(scene: Scene) -> None:
    traced = {f: reference.raytrace(scene, views=1, **SMALL, falloff=f).visibility for f in reference.FALLOFFS}
    assert bool((traced["binary"] <= traced["quadratic"]).all())  # ray by ray: the same rays
    assert bool((traced["quadratic"] <= traced["linear"]).all())
    longer = reference.raytrace(scene, views=1, **SMALL, radius=3 * scene.radius).visibility
    assert bool((longer <= traced["binary"]).all())
    assert float((traced["binary"] - longer).mean()) > 0.02


def test_threads_and_tiles_do_not_change_a_bit(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = ({}, {"falloff": "linear"})
    expected = [reference.raytrace(scene, views=2, **SMALL, threads=1, **kind) for kind in kinds]
    for threads, tile in ((2, 1 << 17), (3, 1 << 11), (1, 7 * 512), (2, 1)):
        monkeypatch.setattr(sys.modules["torch_ssao.reference.raytrace"], "TILE_RAYS", tile)
        for first, kind in zip(expected, kinds, strict=True):
            again = reference.raytrace(scene, views=2, **SMALL, threads=threads, **kind)
            assert torch.equal(first.visibility, again.visibility)
            assert torch.equal(first.standard_error, again.standard_error)


def test_views_are_independent_of_the_batch_and_seeds_differ(scene: Scene) -> None:
    both = reference.raytrace(scene, views=[3, 1], **SMALL, samples=64)
    alone = reference.raytrace(scene, views=1, **SMALL, samples=64)
    assert both.views == (3, 1)
    assert torch.equal(both.visibility[1:], alone.visibility)
    other = reference.raytrace(scene, views=1, **SMALL, samples=64, seed=1)
    assert not torch.equal(alone.visibility, other.visibility)
    apart = (alone.visibility - other.visibility).square().mean().sqrt()
    assert 0.6 < float(apart) / np.hypot(alone.noise, other.noise) < 1.6


def test_record_and_background() -> None:
    view = View((0, 0, 2), (0, 0, 0), (0, 1, 0), 60.0)
    scene = Scene(
        "triangle", np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0, 0.5, 0]]), np.array([[0, 1, 2]]), (view,), 0.25
    )
    result = reference.raytrace(scene, **SMALL, samples=8, seed=3)
    assert (result.visibility.shape, result.visibility.dtype) == ((1, 1, 12, 16), torch.float32)
    assert (result.valid.dtype, len(result)) == (torch.bool, 1)
    assert 0 < int(result.valid.sum()) < 192
    assert bool((result.visibility == 1).all())
    assert bool((result.standard_error == 0).all())
    assert result.noise == 0.0
    facts = (result.samples, result.radius, result.falloff, result.seed, result.scene, result.fingerprint, result.views)
    assert facts == (8, 0.25, "binary", 3, "triangle", scene.fingerprint, (0,))


def test_the_scene_s_radius_is_the_default(scene: Scene) -> None:
    assert reference.raytrace(scene, views=0, **SMALL, samples=8).radius == scene.radius


def test_progress_is_silent_off_a_terminal_and_shown_on_request(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    reference.raytrace(scene, views=0, **SMALL, samples=8)
    assert capsys.readouterr() == ("", "")
    reference.raytrace(scene, views=0, **SMALL, samples=8, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "ray tracing: 100%" in err


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"radius": 0.0}, checks.RangeError, "radius must be finite and greater than 0, got 0.0"),
        ({"radius": -1.0}, checks.RangeError, "radius must be finite and greater than 0, got -1.0"),
        ({"radius": float("inf")}, checks.RangeError, "radius must be finite and greater than 0, got inf"),
        ({"radius": 1e-5}, checks.RangeError, "radius must be at least .* got 1e-05: shorter rays drown"),
        ({"samples": 100}, checks.RangeError, "samples must be a power of two, got 100: use 64 or 128"),
        ({"samples": 4}, checks.RangeError, "samples must be a whole number between 8 and 65536, got 4"),
        (
            {"falloff": "cubic"},
            checks.ChoiceError,
            "falloff must be one of 'binary', 'linear', 'quadratic', got 'cubic'",
        ),
        ({"views": 4}, checks.RangeError, "views must be indices below 4"),
        ({"views": []}, checks.RangeError, "views must name at least one view"),
        ({"seed": -1}, checks.RangeError, "seed must be a whole number at least 0, got -1"),
        ({"threads": 0}, checks.RangeError, "threads must be a whole number at least 1, got 0"),
        ({"height": 0}, checks.RangeError, "height must be a whole number at least 1, got 0"),
        ({"width": 2.5}, checks.RangeError, "width must be a whole number at least 1, got 2.5"),
    ],
)
def test_bad_arguments_give_one_line(
    scene: Scene, change: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message) as caught:
        reference.raytrace(scene, **{**SMALL, **change})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_a_view_of_nothing_is_refused(scene: Scene) -> None:
    away = dataclasses.replace(scene, cameras=(View((0, 50, 0), (0, 60, 0), (0, 0, 1)),))
    with pytest.raises(checks.SceneError, match="sees nothing"):
        reference.raytrace(away, **SMALL)
