"""Camera: constructors agree, conversions go there and back, bad input says what to do."""

from __future__ import annotations

import math

import pytest
import torch
from torch.utils import _pytree as pytree

import torch_ssao as ts
from torch_ssao import checks

H, W, NEAR, FAR = 48, 64, 0.5, 30.0


def clip_matrix(
    convention: str, *, orthographic: bool = False, offset: tuple[float, float] = (0.0, 0.0)
) -> torch.Tensor:
    """Textbook matrices: 40 degrees, aspect W/H, near 0.5, far 30; offset shifts the picture in NDC (y up)."""
    f = 1 / math.tan(math.radians(20))
    sx, sy = (0.2 * H / W, 0.2) if orthographic else (f * H / W, f)
    forward = 1.0 if convention == "d3d" else -1.0
    low, high = {"opengl": (-1.0, 1.0), "reversed_z": (1.0, 0.0)}.get(convention, (0.0, 1.0))
    P = torch.zeros(4, 4, dtype=torch.float64)
    flip = -1.0 if convention == "vulkan" else 1.0
    P[0, 0], P[1, 1] = sx, flip * sy
    if orthographic:
        P[0, 3], P[1, 3], P[3, 3] = offset[0], flip * offset[1], 1.0
        P[2, 2] = forward * (high - low) / (FAR - NEAR)
        P[2, 3] = low - NEAR * (high - low) / (FAR - NEAR)
    else:
        P[0, 2], P[1, 2], P[3, 2] = forward * offset[0], forward * flip * offset[1], forward
        scale = (high * FAR - low * NEAR) / (FAR - NEAR)
        P[2, 2], P[2, 3] = forward * scale, NEAR * (low - scale)
    return P


def project(P: torch.Tensor, convention: str, point: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pixel u, v and window depth of a point in our view axes, through the renderer's own pipeline."""
    forward = 1.0 if convention == "d3d" else -1.0
    theirs = torch.stack((point[0], -point[1], forward * point[2], torch.ones_like(point[0])))
    clip = P @ theirs
    ndc = clip[:3] / clip[3]
    v = (1 + ndc[1]) / 2 * H if convention == "vulkan" else (1 - ndc[1]) / 2 * H
    window = (ndc[2] + 1) / 2 if convention == "opengl" else ndc[2]
    return (ndc[0] + 1) / 2 * W, v, window


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("convention", ["opengl", "vulkan", "d3d", "reversed_z"])
def test_from_projection_puts_points_where_the_renderer_does(convention: str, orthographic: bool) -> None:
    P = clip_matrix(convention, orthographic=orthographic, offset=(0.13, -0.21))
    cam = ts.Camera.from_projection(3.0 * P, H, W, convention=convention)  # a clip matrix has no scale
    assert cam.is_orthographic is orthographic
    point = torch.tensor([0.31, -0.42, 3.7], dtype=torch.float64)
    u, v, window = project(P, convention, point)
    w = 1.0 if orthographic else point[2]
    torch.testing.assert_close(cam.fx[0] * point[0] / w + cam.cx[0], u, atol=1e-9, rtol=0)
    torch.testing.assert_close(cam.fy[0] * point[1] / w + cam.cy[0], v, atol=1e-9, rtol=0)
    image = window.expand(2, 3)
    depth = ts.depth_from_zbuffer(image, P, convention=convention)
    torch.testing.assert_close(depth, point[2].expand(2, 3), atol=1e-9, rtol=0)
    torch.testing.assert_close(ts.zbuffer_from_depth(depth, P, convention=convention), image, atol=1e-12, rtol=0)


@pytest.mark.parametrize("convention", ["opengl", "vulkan", "d3d", "reversed_z"])
def test_zbuffer_background_is_invalid_and_comes_back(convention: str) -> None:
    P = clip_matrix(convention)
    far = 0.0 if convention == "reversed_z" else 1.0
    zbuffer = torch.tensor([[far, 0.5], [0.25, far]], dtype=torch.float64)
    depth = ts.depth_from_zbuffer(zbuffer, P, convention=convention)
    assert torch.isinf(depth).tolist() == [[True, False], [False, True]]
    torch.testing.assert_close(ts.zbuffer_from_depth(depth, P, convention=convention), zbuffer)
    batched = ts.depth_from_zbuffer(zbuffer.expand(2, 1, 2, 2), P.expand(2, 4, 4), convention=convention)
    torch.testing.assert_close(batched[1, 0], depth)


def test_reversed_z_with_infinite_far_plane() -> None:
    P = clip_matrix("reversed_z")
    P[2, 2], P[2, 3] = 0.0, NEAR
    depth = ts.depth_from_zbuffer(torch.tensor([[0.25, 0.0]], dtype=torch.float64), P, convention="reversed_z")
    assert depth.tolist() == [[2.0, math.inf]]


def test_perspective_intrinsics_and_projection_agree() -> None:
    fov = ts.Camera.perspective(torch.tensor([40.0], dtype=torch.float64), H, W)
    clip = ts.Camera.from_projection(clip_matrix("opengl"), H, W)
    f = float(fov.fx)
    K = torch.tensor([[f, 0, W / 2], [0, f, H / 2], [0, 0, 1]], dtype=torch.float64)
    half = ts.Camera.from_intrinsics(K, H, W)
    opencv = ts.Camera.from_intrinsics(
        K - torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), H, W, pixel_centers="integer"
    )
    for cam in (clip, half, opencv):
        for name in ("fx", "fy", "cx", "cy"):
            torch.testing.assert_close(getattr(cam, name), getattr(fov, name), msg=name)


def test_centre_pixel_convention() -> None:
    cam = ts.Camera.perspective(90.0, 3, 3)
    points = cam.unproject(torch.full((1, 1, 3, 3), 2.0))
    assert points[0, :, 0, 1, 1].tolist() == [0.0, 0.0, 2.0]
    assert points[0, 0, 0, 1, 2] > 0  # x right
    assert points[0, 1, 0, 2, 1] > 0  # y down
    ortho = ts.Camera.orthographic(6.0, 3, 3).unproject(torch.full((1, 1, 3, 3), 9.0))
    assert ortho[0, :, 0, 2, 2].tolist() == [2.0, 2.0, 9.0]


def test_footprint_is_focal_over_depth() -> None:
    cam = ts.Camera(*(torch.tensor([value]) for value in (100.0, 50.0, 2.0, 2.0)), 4, 4)
    half = cam.footprint(torch.tensor(0.5), torch.full((1, 1, 4, 4), 10.0))
    assert half[0, :, 0, 0, 0].tolist() == [5.0, 2.5]
    flat = ts.Camera.orthographic(4.0, 4, 4).footprint(torch.tensor(0.5), torch.full((1, 1, 4, 4), 10.0))
    assert flat.shape == (1, 2, 1, 4, 4)
    assert flat.unique().tolist() == [0.5]


def test_look_at_and_opengl_axes() -> None:
    eye, target, up = (torch.tensor(v, dtype=torch.float64) for v in ([0.0, 0, 5], [0.0, 0, 0], [0.0, 1, 0]))
    ours = ts.look_at(eye, target, up)
    theirs = torch.eye(4, dtype=torch.float64)
    theirs[2, 3] = -5.0  # OpenGL: an unrotated camera at z = 5 looks along -z
    torch.testing.assert_close(ts.opengl_to_view(theirs), ours)
    torch.testing.assert_close(
        ours @ torch.tensor([1.0, 2, 0, 1], dtype=torch.float64), torch.tensor([1.0, -2, 5, 1]).double()
    )
    with pytest.raises(checks.RangeError, match="up must not be parallel"):
        ts.look_at(eye, target, torch.tensor([0.0, 0, 1], dtype=torch.float64))
    with pytest.raises(checks.RangeError, match="target must differ"):
        ts.look_at(eye, eye, up)


def test_pytree_index_cat_expand_and_to() -> None:
    cam = ts.Camera.perspective(torch.tensor([30.0, 60.0]), H, W, world_to_view=torch.eye(4))
    leaves, spec = pytree.tree_flatten(cam)
    assert len(leaves) == 5
    again = pytree.tree_unflatten(leaves, spec)
    assert (again.height, again.width, again.is_orthographic) == (H, W, False)
    assert len(cam[1]) == 1
    assert float(cam[1].fx) == float(cam.fx[1])
    assert float(cam[-1].fx) == float(cam.fx[1])
    joined = ts.Camera.cat([cam[1], cam[0]])
    assert joined.fx.tolist() == cam.fx.flip(0).tolist()
    assert cam.to(torch.float64).world_to_view.dtype == torch.float64
    assert len(cam[0].expand(5)) == 5
    with pytest.raises(checks.ShapeError, match="camera must have batch 1 or 3"):
        cam.expand(3)
    with pytest.raises(checks.ShapeError, match="must share height"):
        ts.Camera.cat([cam, ts.Camera.perspective(30.0, H, W + 1)])
    with pytest.raises(checks.ShapeError, match="world_to_view"):
        ts.Camera.cat([cam, ts.Camera.perspective(30.0, H, W)])


def test_camera_is_frozen() -> None:
    cam = ts.Camera.perspective(30.0, H, W)
    with pytest.raises(AttributeError):
        cam.fx = torch.ones(1)  # type: ignore[misc]


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: ts.Camera.perspective(0.0, H, W), checks.RangeError, "fov_y_deg must lie in"),
        (lambda: ts.Camera.perspective(60.0, 0, W), checks.RangeError, "height must be a whole number"),
        (lambda: ts.Camera.orthographic(-1.0, H, W), checks.RangeError, "view_height must be"),
        (lambda: ts.Camera.from_intrinsics(torch.eye(4), H, W), checks.ShapeError, "K must have shape"),
        (lambda: ts.Camera.from_intrinsics(torch.eye(3) * 0, H, W), checks.RangeError, "fx"),
        (lambda: ts.Camera.from_intrinsics(torch.eye(3) + torch.eye(3).roll(1, 1), H, W), checks.RangeError, "skew"),
        (lambda: ts.Camera.from_intrinsics(torch.eye(3), H, W, pixel_centers="x"), checks.ChoiceError, "pixel_centers"),
        (lambda: ts.Camera.from_projection(torch.eye(4).int(), H, W), checks.DtypeError, "P must be floating"),
        (lambda: ts.Camera.from_projection(torch.eye(4), H, W, convention="metal"), checks.ChoiceError, "convention"),
        (lambda: ts.Camera.from_projection(torch.zeros(4, 4), H, W), checks.RangeError, "P must be perspective"),
        (
            lambda: ts.Camera(torch.ones(2), torch.ones(3), torch.ones(2), torch.ones(2), H, W),
            checks.ShapeError,
            "fy must",
        ),
    ],
)
def test_bad_input_names_argument_and_remedy(build: object, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        build()  # type: ignore[operator]
    assert "\n" not in str(caught.value)
    assert ": " in str(caught.value)
