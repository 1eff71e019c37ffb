"""The peers that benchmarks compare against behave as their formulae say. XeGTAO: an infinite right-angle wall."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from benchmarks.peers.xegtao import PRESETS, XeGTAO
from torch_ssao import checks
from torch_ssao.camera import Camera, look_at
from torch_ssao.gbuffer import GBuffer
from torch_ssao.scenes import analytic

RAW: dict[str, Any] = {"final_power": 1.0, "floor": None, "fudge": 0.0}


def _facing_the_wall(view_angle_deg: float, pixels: int) -> tuple[GBuffer, torch.Tensor]:
    """Orthographic view in the plane across a wall, 7 units high, and the distance of every pixel from it."""
    angle = math.radians(view_angle_deg)
    focus = torch.tensor([0.7, 0.0, 0.0], dtype=torch.float64)
    towards = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    up = torch.tensor([-math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
    pose = look_at(focus + 10 * towards, focus, up)
    camera = Camera.orthographic(torch.tensor(7.0, dtype=torch.float64), pixels, pixels, world_to_view=pose)
    gbuffer = analytic.wall().render(camera, dtype=torch.float32)
    view = gbuffer.camera.unproject(gbuffer.depth.double())[:, :, 0]
    assert camera.world_to_view is not None
    to_world = torch.linalg.inv(camera.world_to_view)[0]
    x, y, z = torch.einsum("ij,jhw->ihw", to_world[:3, :3], view[0]) + to_world[:3, 3, None, None]
    return gbuffer, torch.where((z.abs() < 1e-3) & (y.abs() < 1.5), x, math.nan)


def _error(peer: XeGTAO, view_angle_deg: float, pixels: int, frames: int = 4, bins: int = 15) -> float:
    """RMS over distances in [0.03, 1.4] radii of the mean error there, with the noise averaged away."""
    gbuffer, distance = _facing_the_wall(view_angle_deg, pixels)
    exact, _ = analytic.wall().exact(gbuffer, radius=1.0)
    found = torch.stack([peer(gbuffer, frame=frame) for frame in range(frames)]).mean(dim=0)
    used = (distance >= 0.03) & (distance <= 1.4)
    place = ((distance[used] - 0.03) / 1.37 * bins).long().clamp(0, bins - 1)
    count = torch.bincount(place, minlength=bins)
    assert count.min() > 0
    mean = torch.zeros(bins, dtype=torch.float64).index_add(0, place, (found - exact)[0, 0][used].double()) / count
    return float(mean.square().mean().sqrt())


@pytest.mark.parametrize(
    ("options", "low", "high"),
    # Without the power, an independent simulation without pixels finds .112, .090 and .074 with 3, 6 and 16 steps.
    [
        (RAW, 0.107, 0.118),
        (RAW | {"steps": 6}, 0.085, 0.095),
        (RAW | {"steps": 16}, 0.068, 0.078),
        ({}, 0.060, 0.080),
    ],
    ids=["raw", "raw, 6 steps", "raw, 16 steps", "shipped"],
)
def test_xegtao_has_its_known_error_on_a_wall(options: dict[str, Any], low: float, high: float) -> None:
    peer = XeGTAO(1.0, **options)
    errors = [_error(peer, angle, pixels) for angle, pixels in ((20.0, 128), (45.0, 160), (70.0, 288))]
    assert low < math.sqrt(sum(e * e for e in errors) / 3) < high


@pytest.mark.parametrize("orthographic", [False, True])
def test_xegtao_leaves_a_plane_open(orthographic: bool) -> None:
    scene = analytic.plane()
    for angle in (0.0, 45.0, 70.0):
        camera = scene.camera(96, 128, view_angle_deg=angle, orthographic=orthographic, fov_y_deg=20.0)
        found = XeGTAO(0.3, slices=16, **RAW)(scene.render(camera))[..., 36:-36, 36:-36]  # taps stay in the image
        # Taps at whole pixels lie a little beside their slice, where a tilted plane may rise above its horizon.
        assert found.mean().item() == pytest.approx(1.0, abs=0.01)
        assert found.min().item() > 0.97
        assert angle > 0 or found.min().item() > 0.9995


def test_xegtao_options() -> None:
    gbuffer, _ = _facing_the_wall(45.0, 64)
    plain = XeGTAO(0.5)(gbuffer)
    assert plain.shape == (1, 1, 64, 64)
    assert not plain.requires_grad
    assert torch.equal(plain, XeGTAO(0.5)(gbuffer))
    assert not torch.equal(plain, XeGTAO(0.5)(gbuffer, frame=1))
    assert (plain >= 0.03).all()
    assert (plain <= 1.0).all()
    # Compensation for thin occluders only ever opens; coarser depth changes little on planes.
    assert (XeGTAO(0.5, thin_occluder=0.7)(gbuffer) >= plain - 1e-6).all()
    coarse = XeGTAO(0.5, depth_mips=True, mip_offset=1.0)(gbuffer)
    assert 0 < (coarse - plain).abs().mean().item() < 0.05
    slices, steps = PRESETS["ultra"]
    assert torch.isfinite(XeGTAO(0.5, slices=slices, steps=steps)(gbuffer)).all()
    holes = torch.zeros_like(gbuffer.valid_mask)
    holes[..., 10:20, 10:20] = True
    masked = GBuffer(gbuffer.depth, gbuffer.camera, normal=gbuffer.normal, valid=~holes)
    seen = XeGTAO(0.5)(masked)
    assert (seen[holes] == 1).all()
    assert torch.isfinite(seen).all()
    assert (seen >= plain - 1e-6).all()  # what is not there does not occlude


def test_xegtao_errors() -> None:
    gbuffer, _ = _facing_the_wall(45.0, 8)
    with pytest.raises(checks.RangeError, match="radius must be"):
        XeGTAO(0.0)
    with pytest.raises(checks.RangeError, match="slices must be"):
        XeGTAO(1.0, slices=0)
    with pytest.raises(checks.ShapeError, match="gbuffer must have normals"):
        XeGTAO(1.0)(GBuffer(gbuffer.depth, gbuffer.camera))
