"""Peers on scenes whose answer a line of mathematics gives: planes, the floor of a pit one pixel wide, a wall."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.peers import PEERS
from torch_ssao import checks
from torch_ssao.camera import Camera, look_at
from torch_ssao.gbuffer import GBuffer
from torch_ssao.scenes import analytic

POINTS = [name for name in PEERS if name != "xegtao"]  # which has a test of its own
RADIUS_PX, DEEP = 60, 0.4  # of the pit, whose radius is 1


def _pit(deep: float = DEEP) -> GBuffer:
    """A level surface seen straight on, but for its middle pixel, which lies deeper: all taps rise by `deep`."""
    size = 2 * RADIUS_PX + 5
    depth = torch.full((1, 1, size, size), 10.0)
    depth[..., size // 2, size // 2] += deep
    normal = torch.zeros(1, 3, size, size)
    normal[:, 2] = -1
    return GBuffer(depth, Camera.orthographic(size / RADIUS_PX, size, size), normal=normal)


def _in_the_pit(name: str, options: dict[str, Any], deep: float = DEEP, frames: int = 4) -> float:
    gbuffer = _pit(deep)
    middle = gbuffer.depth.shape[-1] // 2
    peer = PEERS[name](1.0, **options)
    return float(torch.stack([peer(gbuffer, frame=frame)[0, 0, middle, middle] for frame in range(frames)]).mean())


def _mean(value: Callable[[Any], Any], low: float, high: float) -> float:
    """Mean over an interval, midpoint rule."""
    at = low + (np.arange(20000) + 0.5) / 20000 * (high - low)
    return float(np.mean(value(at)))


def _sao(r: Any) -> Any:
    square = r**2 + DEEP**2
    return 5 * np.maximum(1 - square, 0) ** 3 * (DEEP - 0.01) / (square + 0.01)


def _hbao_plus(r: Any) -> Any:
    square = r**2 + DEEP**2
    return 2 / 0.9 * np.clip(DEEP / np.sqrt(square) - 0.1, 0, 1) * np.maximum(1 - square, 0)


def _unreal() -> float:
    def weight(r: Any) -> Any:
        return r * np.maximum(1 - np.sqrt(r**2 + DEEP**2) / 2, 0) ** 2

    return _mean(lambda r: weight(r) * 2 * np.arctan(r / DEEP) / math.pi, 0, 1) / _mean(weight, 0, 1)


def _starcraft_fading() -> float:
    """Slices of the half-ball at height t lie DEEP - t behind the surface."""

    def kept(t: Any) -> Any:
        behind = DEEP - t
        return 1.5 * (1 - t**2) * (behind > 0) * np.clip(1 - (behind - 0.1) / 0.5, 0, 1) ** 2

    return 1 - _mean(kept, 0, 1)


BALL = 1 - (1 - DEEP) ** 2 * (2 + DEEP) / 4  # of the ball, below the surface
HALF_BALL = 1 - (1 - DEEP) ** 2 * (2 + DEEP) / 2


@pytest.mark.parametrize(
    ("name", "options", "exact"),
    [
        ("crytek", {"samples": 512}, 1 - BALL),
        ("starcraft", {"samples": 512, "bias": 0.0}, 1 - HALF_BALL),
        ("starcraft", {"samples": 512, "bias": 0.0, "full": 0.1, "fade": 0.5, "power": 2.0}, _starcraft_fading()),
        ("line_sampled", {"samples": 256, "volume": "sphere"}, 1 - BALL),
        ("line_sampled", {"samples": 256, "volume": "doubled"}, 1 - HALF_BALL),
        ("line_sampled", {"samples": 256}, 1 - HALF_BALL),
        (
            "alchemy",
            {"samples": 512, "bias": 0.0, "epsilon": 1e-9, "strength": 0.4},
            1 - 0.8 * DEEP * math.log(1 + DEEP**-2),
        ),
        ("sao", {"samples": 256, "strength": 0.2, "mips": False}, 1 - 0.2 * _mean(_sao, 0, 1)),
        ("sao", {"samples": 256, "strength": 0.2}, 1 - 0.2 * _mean(_sao, 0, 1)),
        (
            "hbao_plus",
            {"directions": 8, "steps": 32, "final_power": 1.0},
            1 - _mean(_hbao_plus, 1 / RADIUS_PX, 1 / RADIUS_PX + 32 / 33),
        ),
        ("unreal", {"pairs": 256}, _unreal()),
    ],
)
def test_the_floor_of_a_pit_is_what_the_formula_integrates_to(name: str, options: dict[str, Any], exact: float) -> None:
    assert _in_the_pit(name, options) == pytest.approx(exact, abs=0.012)


@pytest.mark.parametrize(("thickness", "first_open"), [(0.8, math.atan2(1, 0.1)), (None, math.pi / 2)])
def test_bitmask_in_a_pit_covers_whole_sectors_from_the_normal_to_the_back_of_the_furthest_tap(
    thickness: float | None, first_open: float
) -> None:
    exact = 1 - round(32 * first_open / math.pi) / 16
    found = _in_the_pit("bitmask", {"slices": 2, "steps": 64, "thickness": thickness}, deep=0.9)
    assert found == pytest.approx(exact, abs=1e-6)


@pytest.mark.parametrize("name", POINTS)
@pytest.mark.parametrize("orthographic", [False, True])
def test_planes(name: str, orthographic: bool) -> None:
    """1, or what the technique is known for: 1/2 of a full sphere lies behind a plane."""
    scene = analytic.plane()
    for angle, least in ((0.0, 0.9995), (45.0, 0.96), (70.0, 0.94)):
        camera = scene.camera(96, 128, view_angle_deg=angle, orthographic=orthographic, fov_y_deg=20.0)
        found = PEERS[name](0.3)(scene.render(camera, dtype=torch.float32))[..., 36:-36, 36:-36]
        if name == "crytek":
            assert found.mean().item() == pytest.approx(0.5, abs=0.01)
        else:  # whole pixels lie beside the points that they stand for, where a tilted plane is higher
            assert least < found.mean().item() <= 1.0
    sphere = PEERS["line_sampled"](0.3, volume="sphere", samples=64)
    camera = scene.camera(96, 128, view_angle_deg=0.0, orthographic=orthographic, fov_y_deg=20.0)
    plane = sphere(scene.render(camera, dtype=torch.float32))[..., 36:-36, 36:-36]
    assert plane.mean().item() == pytest.approx(0.5, abs=1e-3)


def _wall(view_angle_deg: float, pixels: int = 160) -> tuple[GBuffer, torch.Tensor]:
    """Orthographic view across an infinite right-angle wall, and the floor's distance from it, NaN elsewhere."""
    angle = math.radians(view_angle_deg)
    focus = torch.tensor([0.7, 0.0, 0.0], dtype=torch.float64)
    towards = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    up = torch.tensor([-math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
    camera = Camera.orthographic(
        torch.tensor(7.0, dtype=torch.float64), pixels, pixels, world_to_view=look_at(focus + 10 * towards, focus, up)
    )
    gbuffer = analytic.wall().render(camera, dtype=torch.float32)
    view = gbuffer.camera.unproject(gbuffer.depth.double())[0, :, 0]
    to_world = torch.linalg.inv(camera.world_to_view)[0]
    x, y, z = torch.einsum("ij,jhw->ihw", to_world[:3, :3], view) + to_world[:3, 3, None, None]
    return gbuffer, torch.where((z.abs() < 1e-3) & (y.abs() < 1.5), x, math.nan)


@pytest.mark.parametrize("view_angle_deg", [20.0, 45.0, 65.0])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("line_sampled", {"samples": 48}),
        ("starcraft", {"samples": 64, "full": 1e3, "bias": 0.0}),
    ],
)
def test_volumetric_obscurance_of_a_wall(name: str, options: dict[str, Any], view_angle_deg: float) -> None:
    """(1 - s)^2 (2 + s) / 4 of the half-ball lies behind the wall, from every side."""
    gbuffer, distance = _wall(view_angle_deg)
    exact, _ = analytic.wall().exact(gbuffer, radius=1.0, weighting="volumetric")
    off = (PEERS[name](1.0, **options)(gbuffer) - exact)[0, 0]
    for low in (0.1, 0.3, 0.5, 0.7, 0.9):
        here = (distance >= low) & (distance < low + 0.2)
        assert off[here].mean().item() == pytest.approx(0.0, abs=0.025)


def test_bitmask_of_a_wall_changes_with_the_view() -> None:
    """Uniform sectors are not the cosine: next to an endless wall, exactly 1/2, they see .647 at 60 and .587 at 80 degrees."""
    for angle, expected in ((60.0, 0.647), (80.0, 0.587)):
        gbuffer, distance = _wall(angle, 320)
        peer = PEERS["bitmask"](4.0, thickness=None, slices=8, steps=64)
        here = (distance > 0.1) & (distance < 0.2)
        assert peer(gbuffer)[0, 0][here].mean().item() == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("name", sorted(PEERS))
def test_holes_edges_and_gradients(name: str) -> None:
    gbuffer, _ = _wall(45.0, 48)
    holes = torch.zeros_like(gbuffer.valid_mask)
    holes[..., 10:20, 10:20] = True
    depth = torch.where(holes, torch.nan, gbuffer.depth)
    masked = GBuffer(depth, gbuffer.camera, normal=gbuffer.normal)
    plain = PEERS[name](0.5)(gbuffer)
    peer = PEERS[name](0.5, learnable="all", denoise=1)
    seen = peer(masked)
    assert torch.equal(plain, PEERS[name](0.5)(gbuffer))
    assert not torch.equal(plain, PEERS[name](0.5)(gbuffer, frame=1))
    assert seen.dtype == torch.float32
    assert (seen[holes] == 1).all()
    assert ((seen >= 0) & (seen <= 1)).all()
    cotangent = torch.randn(seen.shape, generator=torch.Generator().manual_seed(0))
    seen.backward(cotangent)
    gradients = {key: raw.grad for key, raw in peer.named_parameters()}
    assert all(g is None or bool(torch.isfinite(g)) for g in gradients.values())
    contrast = gradients["raw_contrast"]
    assert contrast is not None
    assert contrast.abs() > 1e-3


@pytest.mark.parametrize("name", POINTS)
def test_forward_and_reverse_derivatives_agree(name: str) -> None:
    """A fit takes forward mode; the numbers are central differences away from hits, which are decisions."""
    gbuffer, _ = _wall(45.0, 32)
    gbuffer = gbuffer.to(torch.float64)
    peer = PEERS[name](0.5, learnable="all").double()
    names = [key for key, _ in peer.named_parameters() if key != "raw_radius"]  # which moves taps
    cotangent = torch.randn((1, 1, 32, 32), generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def total(*raws: torch.Tensor) -> torch.Tensor:
        values = dict(zip(names, raws, strict=True))
        return (torch.func.functional_call(peer, values, (gbuffer,)) * cotangent).sum()

    raws = tuple(dict(peer.named_parameters())[key].detach() for key in names)
    for place, key in enumerate(names):
        if name == "bitmask" and key != "raw_contrast":
            continue
        tangents = tuple(torch.ones_like(raw) if i == place else torch.zeros_like(raw) for i, raw in enumerate(raws))
        _, forward = torch.func.jvp(total, raws, tangents)
        reverse = torch.func.grad(total, argnums=place)(*raws)
        assert forward.item() == pytest.approx(reverse.item(), rel=1e-9, abs=1e-9)
        if key in ("raw_bias", "raw_thickness"):  # kinks and thresholds
            continue
        step = 1e-6
        moved = [[r + s * t for r, t in zip(raws, tangents, strict=True)] for s in (step, -step)]
        central = (total(*moved[0]) - total(*moved[1])) / (2 * step)
        assert forward.item() == pytest.approx(central.item(), rel=1e-4, abs=1e-5)


def test_errors() -> None:
    gbuffer, _ = _wall(45.0, 8)
    bare = GBuffer(gbuffer.depth, gbuffer.camera)
    for name, peer in PEERS.items():
        with pytest.raises(checks.RangeError, match="radius must be"):
            peer(0.0)
        if name != "crytek":
            with pytest.raises(checks.ShapeError, match="gbuffer must have normals"):
                peer(1.0)(bare)
    assert torch.isfinite(PEERS["crytek"](1.0)(bare)).all()
    assert torch.isfinite(PEERS["line_sampled"](1.0, volume="sphere")(bare)).all()
    with pytest.raises(checks.ChoiceError, match="volume must be"):
        PEERS["line_sampled"](1.0, volume="cube")
    with pytest.raises(checks.RangeError, match="samples must be"):
        PEERS["crytek"](1.0, samples=0)
    long = torch.ones(1, 1, 1, 2**23)
    with pytest.raises(checks.RangeError, match="at most 2\\^24 pixels"):
        PEERS["crytek"](1.0)(GBuffer(long, Camera.orthographic(1.0, 1, 2**23)))
