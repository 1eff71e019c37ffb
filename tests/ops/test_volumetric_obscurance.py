"""What StatVO measures on walls, edges and ceilings, against closed forms and against point-sampled volumes.

Lengths in units of R; s is a floor point's distance from the edge, beta the angle there (a wall: 90 degrees), h the
height of the box, theta the angle between the floor's normal and the view, which is tilted towards the edge. All
numbers are obscurances, 1 - visibility, and fractions of a volume over the surface; the depth image shows everything.

- Ball: a wall (1 - s)^2 (2 + s) / 4, a ceiling at height s (1 - s)^2 (2 + s) / 2, on an edge 1 - beta / pi.
- Upright box: a wall (1 - s) / 2, a ceiling 1 - s / h, an edge the mean over t in [0, h] of (1 - s + t cot beta) / 2
  clipped to [0, 1]. Any view gives the same. With h = 1 the ball is the box minus s (1 - s^2) / 4 on the wall and twice
  that under the ceiling: at most 0.0962 and 0.1925, at s = 1 / sqrt 3, and 0 in contact and at s = 1.
- Prism: section = the pixel's window, sides = the view rays, h high. A point of it is occupied where it lies lower than
  the surface that its ray sees. So its occupancy is the mean over the window of the visible heights clipped to [0, h] -
  what StatVO estimates. A parallel ray that passes the edge w behind it (on the floor's plane) sees the other face at
  height k w, k = 1 / (tan theta - cot beta). The window reaches to w = q / cos theta, q = 1 - s cos theta, and up to
  the height Y = k q / cos theta. Occupancy: k q^2 / (4 h cos theta) for Y <= h, else (q - h cos theta / (2 k)) / 2.
  On a wall k = cot theta: q^2 / (4 h sin theta), else (q - h sin theta / 2) / 2. Along the normal it is the upright
  box; in contact with a wall it is 1 / (4 h sin theta), or 1 / 2 - h sin theta / 4, where ball and box are 1 / 2.
- A pinhole D high over the floor and e from the wall, looking down, sees heights D w / (e + w): their mean is
  D / 2 (W - e ln(1 + W / e)), W = 1 - s.

StatVO with one layer is psi(mean height / h), the mean of heights that are not clipped: Y > h makes it larger than the
prism, until the mean itself leaves the box and psi falls; heights below the floor count as negative. More layers apply
psi to parts of the window, in the limit to each sample: cos theta h / (2 k) P(Y / h), P the integral of psi from 0.
Samples above the box then fall off, where the prism counts them as full. As long as every height lies in [0, h], psi is
linear: StatVO is the prism whatever the number of layers.

Under a ceiling (height c, a level pinhole at height e < 1) the window looks past the horizon, where rays go up: a share
(1 - e) / 2 of it sees the ceiling at height c. StatVO fills the space *under* what it sees: psi(c (1 - e) / (2 h)),
rising with c where the ball and the box fall. A parallel view, or one from above, shows the floor alone: 0.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

import torch_ssao as ts
from oracles.volumetric_obscurance import SHAPES, volumetric_visibility
from support.gbuffers import plane_gbuffer
from torch_ssao.camera import look_at
from torch_ssao.scenes import analytic, closed_forms

Floats = npt.NDArray[np.float64]
# Edge angle and view angle of scenes whose two faces are both in view.
EDGES = [(90.0, 20.0), (90.0, 45.0), (90.0, 70.0), (60.0, 60.0), (120.0, 0.0), (120.0, 40.0), (135.0, 0.0)]
# Pixels sample heights at their centres. Measured at 14 pixels a radius and h = 3: 8.3e-5 at most.
PIXELS = 2e-4


def camera_over_edge(theta_deg: float, height: int, width: int) -> ts.Camera:
    """Parallel view of the floor beside the edge x = 0, tilted by theta towards it; the edge is level in the image."""
    theta = math.radians(theta_deg)
    focus, z = (torch.tensor(v, dtype=torch.float64) for v in ([0.5, 0.0, 0.0], [0.0, 0.0, 1.0]))
    out = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    eye = focus + 20.0 * (math.sin(theta) * out + math.cos(theta) * z)
    pose = look_at(eye, focus, math.sin(theta) * z - math.cos(theta) * out)
    extent = torch.tensor(height / 24, dtype=torch.float64)  # 24 pixels a scene unit
    return ts.Camera.orthographic(extent, height, width, world_to_view=pose)


def level_camera(eye_height: float, size: int, fov_deg: float) -> ts.Camera:
    """Pinhole that looks along x, parallel to the floor, with its horizon between two rows of pixels."""
    eye = torch.tensor([0.0, 0.0, eye_height], dtype=torch.float64)
    ahead, up = (torch.tensor(v, dtype=torch.float64) for v in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    fov = torch.tensor(fov_deg, dtype=torch.float64)
    return ts.Camera.perspective(fov, size, size, world_to_view=look_at(eye, eye + ahead, up))


def world_points(gb: ts.GBuffer) -> Floats:
    """(H, W, 3); NaN or inf where nothing is seen."""
    camera = gb.camera
    assert camera.world_to_view is not None
    to_world = torch.linalg.inv(camera.world_to_view[0])
    view = camera.unproject(torch.where(gb.valid_mask, gb.depth, torch.nan))[0, :, 0]
    return (torch.einsum("ij,jhw->hwi", to_world[:3, :3], view) + to_world[:3, 3]).numpy()


def floor_pixels(gb: ts.GBuffer, radius: float) -> npt.NDArray[np.bool_]:
    """Pixels of the floor whose windows end within the image, top and bottom."""
    height = gb.depth.shape[2]
    half = gb.camera.footprint(torch.tensor(radius, dtype=torch.float64), gb.depth)[0, 1, 0].numpy()
    row = np.arange(height)[:, None] + 0.5
    points = world_points(gb)
    on_floor = (np.abs(points[..., 2]) < 1e-9) & (points[..., 0] > 1e-9)
    return on_floor & (row - half >= 0) & (row + half <= height)


def sampled(gb: ts.GBuffer, shape: str, radius: float, **options: Any) -> tuple[Floats, Floats]:
    """Obscurance (H, W) by point samples, and the share of the samples on the screen."""
    camera = gb.camera
    intrinsics = [t.double().numpy() for t in (camera.fx, camera.fy, camera.cx, camera.cy)]
    normal = None if gb.normal is None else gb.normal.numpy()
    flat = camera.is_orthographic
    images = gb.depth.numpy(), gb.valid_mask.numpy(), normal
    answer = volumetric_visibility(*images, *intrinsics, flat, shape=shape, radius=radius, **options)
    return 1.0 - answer.visibility[0], answer.kept[0]


def statvo(gb: ts.GBuffer, radius: float, **options: Any) -> Floats:
    return 1.0 - ts.StatVO(radius, **({"quadrants": False} | options)).double()(gb)[0, 0].detach().numpy()


def psi(s: npt.ArrayLike, slope: float = 1.0) -> Floats:
    return np.interp(np.asarray(s), [0.0, 1.0, 1.0 + 1.0 / slope], [0.0, 1.0, 0.0])


def psi_integral(s: Floats, slope: float = 1.0) -> Floats:
    above = np.clip(s - 1.0, 0.0, 1.0 / slope)
    return np.where(s <= 1.0, s**2 / 2, 0.5 + above - slope * above**2 / 2)


def box_form(s: Floats, beta_deg: float, h: float) -> Floats:
    """Upright box beside an edge: the mean of a clipped linear function."""
    cot = 1.0 / math.tan(math.radians(beta_deg))
    low, high = (1.0 - s) / 2, (1.0 - s + h * cot) / 2
    if abs(cot) < 1e-12:
        return np.clip(low, 0.0, 1.0)

    def primitive(g: Floats) -> Floats:
        return np.where(g < 0, 0.0, np.where(g <= 1, g**2 / 2, g - 0.5))

    return (primitive(high) - primitive(low)) / (high - low)


class Prism:
    """Closed forms of a window that reaches past an edge, for parallel views."""

    def __init__(self, s: Floats, beta_deg: float, theta_deg: float, h: float) -> None:
        beta, theta = math.radians(beta_deg), math.radians(theta_deg)
        self.h, self.cos = h, math.cos(theta)
        self.k = 1.0 / (math.tan(theta) - math.cos(beta) / math.sin(beta))
        self.q = np.maximum(1.0 - s * self.cos, 0.0)
        self.top = self.k * self.q / self.cos

    def occupancy(self) -> Floats:
        low = self.k * self.q**2 / (4 * self.h * self.cos)
        return np.where(self.top <= self.h, low, (self.q - self.h * self.cos / (2 * self.k)) / 2)

    def one_layer(self, slope: float = 1.0) -> Floats:
        return psi(self.k * self.q**2 / (4 * self.h * self.cos), slope)

    def every_sample(self, slope: float = 1.0) -> Floats:
        return self.cos * self.h / (2 * self.k) * psi_integral(self.top / self.h, slope)


@cache
def edge_scene(beta: float, theta: float, width: int) -> tuple[analytic.AnalyticScene, ts.GBuffer]:
    scene = analytic.wall() if beta == 90 else analytic.dihedral(beta)
    return scene, scene.render(camera_over_edge(theta, 72, width))


# ---- the point-sampled references -----------------------------------------------------------------------------------


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("angle", [0.0, 45.0, 80.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_plane_is_open(shape: str, angle: float, orthographic: bool) -> None:
    gb = plane_gbuffer(angle, dtype=torch.float64, orthographic=orthographic, height=24, width=32)
    assert (sampled(gb, shape, 0.4, samples=32)[0] == 0).all()
    # Depth constant within a pixel makes a tilted plane hide parts of itself.
    assert (sampled(gb, shape, 0.4, samples=32, planar=False)[0].max() > 0.05) == (angle > 0)


@pytest.mark.parametrize(("beta", "theta"), EDGES)
def test_ball_equals_the_closed_forms(beta: float, theta: float) -> None:
    scene, gb = edge_scene(beta, theta, 32)
    obscurance, kept = sampled(gb, "ball", 0.5)
    again, _ = sampled(gb, "ball", 0.5, seed=1)
    exact, known = (t[0, 0].numpy() for t in scene.exact(gb, radius=0.5, weighting="volumetric"))
    mine = known & (kept == 1)
    assert mine.sum() > 200
    error, noise = (obscurance - 1.0 + exact)[mine], (obscurance - again)[mine].std() / math.sqrt(2)
    # Measured: noise 3.4e-3 to 4.0e-3, error 0.91 to 1.04 of it, bias 2.8e-4 at most.
    assert noise < 5e-3
    assert error.std() < 1.2 * noise
    assert abs(error.mean()) < 6e-4
    assert (1.0 - exact[mine]).max() > 0.2
    if beta == 90:
        s = np.abs(world_points(gb)[..., [0, 2]]).max(axis=-1)[mine] / 0.5
        form = np.where(s < 1, (1 - s) ** 2 * (2 + s) / 4, 0.0)
        np.testing.assert_allclose(1.0 - exact[mine], form, atol=1e-12)


def test_ball_on_an_edge_is_the_share_of_the_angle() -> None:
    beta = np.array([30.0, 60.0, 90.0, 120.0, 135.0])
    form = closed_forms.dihedral(0.0, beta, radius=1.0, weighting="volumetric")
    np.testing.assert_allclose(1.0 - form, 1.0 - beta / 180.0, atol=1e-12)


@pytest.mark.parametrize("ratio", [1.25, 2.0])
def test_ball_and_box_under_a_ceiling(ratio: float) -> None:
    # Between the plates, looking level: floor pixels far enough away have ball and box on the screen.
    scene = analytic.ceiling(0.5)
    gb = scene.render(level_camera(0.25, 64, 110.0))
    radius, s = 0.5 * ratio, 1.0 / ratio
    on_floor = np.abs(world_points(gb)[..., 2]) < 1e-9
    for shape, h, expected in (
        ("ball", 1.0, (1 - s) ** 2 * (2 + s) / 2),
        ("box", 1.0, 1 - s),
        ("box", 1.5, 1 - s / 1.5),
    ):
        obscurance, kept = sampled(gb, shape, radius, height=h)
        mine = on_floor & (kept == 1)
        assert mine.sum() > 80
        # Measured: ball 5.7e-3, box 2e-3; 1.2e-2 at most.
        assert np.sqrt(((obscurance[mine] - expected) ** 2).mean()) < 7e-3
        assert np.abs(obscurance[mine] - expected).max() < 0.025
    ball, box = (1 - s) ** 2 * (2 + s) / 2, 1 - s
    assert box - ball == pytest.approx(s * (1 - s**2) / 2)


@pytest.mark.parametrize(("beta", "theta"), EDGES)
def test_upright_box_beside_an_edge(beta: float, theta: float) -> None:
    radius, h = 0.4, 0.7
    _, gb = edge_scene(beta, theta, 32)
    obscurance, kept = sampled(gb, "box", radius, height=h)
    points = world_points(gb)
    mine = floor_pixels(gb, radius) & (kept == 1) & (points[..., 0] < 1.2 * radius)
    assert mine.sum() > 40
    error = (obscurance - box_form(np.maximum(points[..., 0], 0.0) / radius, beta, h))[mine]
    # Measured: 2.6e-3 to 4.1e-3, bias 6e-4 at most.
    assert np.sqrt((error**2).mean()) < 6e-3
    assert abs(error.mean()) < 1.5e-3


def test_ball_against_box_on_a_wall() -> None:
    s = np.linspace(0.0, 1.0, 101)
    ball, box = (1 - s) ** 2 * (2 + s) / 4, box_form(s, 90.0, 1.0)
    np.testing.assert_allclose(box - ball, s * (1 - s**2) / 4, atol=1e-12)
    assert (box - ball).max() == pytest.approx(1 / (6 * math.sqrt(3)), abs=1e-4)  # 0.0962


def test_the_prism_along_the_normal_is_the_upright_box() -> None:
    s = np.linspace(0.0, 1.2, 25)
    for h in (0.3, 1.0, 3.0):
        for beta in (100.0, 120.0, 160.0):
            np.testing.assert_allclose(Prism(s, beta, 0.0, h).occupancy(), box_form(s, beta, h), atol=1e-12)
        steep = Prism(np.minimum(s, 1.0), 90.0, 1e-4, h).occupancy()
        np.testing.assert_allclose(steep, box_form(s, 90.0, h), atol=1e-5)


@pytest.mark.parametrize("h", [0.4, 3.0])
@pytest.mark.parametrize(("beta", "theta"), EDGES)
def test_prism_beside_an_edge(beta: float, theta: float, h: float) -> None:
    radius = 0.5
    _, gb = edge_scene(beta, theta, 32)
    obscurance, kept = sampled(gb, "prism", radius, height=h)
    s = world_points(gb)[..., 0] / radius
    mine = floor_pixels(gb, radius) & (kept == 1) & (s < 1.2)
    assert mine.sum() > 35
    error = obscurance[mine] - Prism(s[mine], beta, theta, h).occupancy()
    # Measured: 2.8e-3 to 4.6e-3, bias 1.2e-3 at most (over 40 to 112 pixels).
    assert np.sqrt((error**2).mean()) < 6e-3
    assert abs(error.mean()) < 2e-3


# ---- StatVO ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layers", [1, 4])
@pytest.mark.parametrize(("beta", "theta"), EDGES)
def test_statvo_is_the_prism_while_all_heights_lie_in_the_box(beta: float, theta: float, layers: int) -> None:
    _, gb = edge_scene(beta, theta, 8)
    radius, h = 0.6, 3.0
    mine = floor_pixels(gb, radius)
    form = Prism(world_points(gb)[..., 0][mine] / radius, beta, theta, h)
    assert form.top.max() <= h
    got = statvo(gb, radius, height=h, layers=layers)[mine]
    assert np.abs(got - form.occupancy()).max() < PIXELS
    assert got.max() > 0.02


@pytest.mark.parametrize("slope", [1.0, 3.0])
@pytest.mark.parametrize("h", [0.15, 0.3, 0.6])
@pytest.mark.parametrize("theta", [20.0, 45.0, 70.0])
def test_one_layer_on_a_wall_above_the_box_is_psi_of_the_unclipped_mean(theta: float, h: float, slope: float) -> None:
    _, gb = edge_scene(90.0, theta, 8)
    radius = 0.6
    mine = floor_pixels(gb, radius)
    form = Prism(world_points(gb)[..., 0][mine] / radius, 90.0, theta, h)
    got = statvo(gb, radius, height=h, falloff=slope, layers=1)[mine]
    # Measured: 2.5e-4 slope / h at most, 5e-3 for slope 3 and h = 0.15.
    assert np.abs(got - form.one_layer(slope)).max() < 4e-4 * slope / h
    assert np.abs(got - form.occupancy()).max() > 0.02


@pytest.mark.parametrize("slope", [1.0, 3.0])
def test_more_layers_lead_from_psi_of_the_mean_to_the_mean_of_psi(slope: float) -> None:
    # A wall seen from steeply above rises to 2.8 boxes in the windows.
    _, gb = edge_scene(90.0, 20.0, 8)
    radius, h = 0.6, 1.0
    mine = floor_pixels(gb, radius)
    form = Prism(world_points(gb)[..., 0][mine] / radius, 90.0, 20.0, h)
    assert form.top.max() > 2.5
    errors = []
    for layers in (1, 4, 16, 64):
        got = statvo(gb, radius, height=h, falloff=slope, layers=layers)[mine]
        errors.append(np.sqrt(((got - form.every_sample(slope)) ** 2).mean()))
    # Measured: 0.112 0.056 0.009 0.001 for slope 1, 0.132 0.077 0.019 0.002 for 3.
    assert errors[0] > 0.1
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < 0.03
    assert errors[3] < 5e-3
    # Not the occupancy: what rises above the box falls off instead of filling it.
    assert (form.every_sample(slope) <= form.occupancy() + 1e-12).all()
    assert (form.occupancy() - form.every_sample(slope)).max() > 0.05


def test_wall_from_above() -> None:
    # A pinhole 4 R over the floor and 1.6 R from the wall looks down along the floor's normal.
    radius, over, beside = 0.5, 4.0, 1.6
    eye, below, up = (
        torch.tensor(v, dtype=torch.float64) for v in ([0.8, 0.0, 2.0], [0.8, 0.0, 0.0], [-1.0, 0.0, 0.0])
    )
    fov = torch.tensor(2 * math.degrees(math.atan(0.7)), dtype=torch.float64)
    gb = analytic.wall().render(ts.Camera.perspective(fov, 96, 48, world_to_view=look_at(eye, below, up)))
    s = world_points(gb)[..., 0] / radius
    mine = floor_pixels(gb, radius) & (s < 1)
    assert mine.sum() > 300

    def mean_height(w: Floats) -> Floats:
        return over / 2 * (w - beside * np.log1p(w / beside))

    def prism(w: Floats, h: float) -> Floats:
        inside = np.minimum(w, h * beside / (over - h))
        return mean_height(inside) / h + (w - inside) / 2

    past = 1 - s[mine]
    for layers in (1, 4):
        got = statvo(gb, radius, height=2.0, layers=layers)[mine]
        np.testing.assert_allclose(got, mean_height(past) / 2.0, atol=PIXELS)
        np.testing.assert_allclose(got, prism(past, 2.0), atol=PIXELS)
    got = statvo(gb, radius, height=0.2, layers=1)[mine]
    np.testing.assert_allclose(got, psi(mean_height(past) / 0.2), atol=2e-3)
    for h in (0.2, 2.0):
        obscurance, kept = sampled(gb, "prism", radius, height=h)
        whole = mine & (kept == 1)
        assert whole.sum() > 100
        error = obscurance[whole] - prism(1 - s[whole], h)
        assert np.sqrt((error**2).mean()) < 8e-3
        assert abs(error.mean()) < 1.5e-3
    # The upright box holds (1 - s) / 2 whatever the height of the wall that the window happens to see.
    assert np.abs(prism(past, 0.2) - past / 2).max() < 0.05
    assert np.abs(prism(past, 2.0) - past / 2).max() > 0.1


@pytest.mark.parametrize("layers", [1, 4, 16])
def test_ceiling_is_filled_below_and_not_above(layers: int) -> None:
    radius, eye = 1.0, 0.25
    previous = 0.0
    for height in (0.4, 0.6, 0.8):
        gb = analytic.ceiling(height).render(level_camera(eye, 64, 110.0))
        mine = floor_pixels(gb, radius)
        assert mine.sum() > 200
        got = statvo(gb, radius, layers=layers)[mine]
        # The horizon lies between two rows, and the heights are 0 and c: exact but for rounding.
        np.testing.assert_allclose(got, height * (1 - eye) / 2, atol=1e-9)
        assert got.min() > previous  # while box and ball, 1 - s and (1 - s)^2 (2 + s) / 2, fall
        previous = got.max()
    got = statvo(gb, radius, height=0.5, falloff=0.5, layers=1)[mine]
    np.testing.assert_allclose(got, psi(0.8 * 0.75 / 2 / 0.5, 0.5), atol=1e-9)
    # Looking down between the plates the ceiling is out of view, for StatVO and for point samples.
    scene = analytic.ceiling(0.5)
    gb = scene.render(scene.camera(24, 32, view_angle_deg=0.0))
    assert (statvo(gb, 1.0, layers=layers) == 0).all()
    assert all((sampled(gb, shape, 1.0, samples=16)[0] == 0).all() for shape in SHAPES)


def test_heights_below_the_floor_count_as_negative() -> None:
    # Strips of three columns, 0.5 above, level with and 0.3 below the middle one, along the normal; R = 4.5 pixels.
    depth = torch.tensor([1.5, 2.0, 2.3], dtype=torch.float64).repeat_interleave(3).expand(1, 1, 9, 9).contiguous()
    camera = ts.Camera.orthographic(torch.tensor(2.0, dtype=torch.float64), 9, 9)
    towards_eye = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).view(1, 3, 1, 1).expand(1, 3, 9, 9)
    gb = ts.GBuffer(depth, camera, normal=towards_eye.contiguous())
    assert statvo(gb, 1.0, layers=1)[4, 4] == pytest.approx((0.5 - 0.3) / 3, abs=1e-12)
    assert sampled(gb, "prism", 1.0, samples=1024)[0][4, 4] == pytest.approx(0.5 / 3, abs=4e-3)
    # Layers that keep the strips apart agree with the prism; two of them are enough here.
    assert statvo(gb, 1.0, layers=2)[4, 4] == pytest.approx(0.5 / 3, abs=1e-12)
