"""What peers read: the padded depth map, points behind the eye, SAO's coarser levels, balls and disks of points."""

from __future__ import annotations

import pytest
import torch

from benchmarks.peers import samples
from benchmarks.peers.mcguire import _Pyramid
from torch_ssao.camera import Camera

HEIGHT, WIDTH = 45, 70


def _surface(orthographic: bool = False) -> tuple[torch.Tensor, samples.Surface]:
    depth = 1 + torch.rand((1, HEIGHT, WIDTH), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[:, 4, 6] = False
    two = torch.tensor(2.0, dtype=torch.float64)
    camera = Camera.orthographic(two, HEIGHT, WIDTH) if orthographic else Camera.perspective(30 * two, HEIGHT, WIDTH)
    return depth, samples.Surface(depth, valid, camera)


@pytest.mark.parametrize("orthographic", [False, True])
def test_taps_are_differences_of_positions(orthographic: bool) -> None:
    depth, surface = _surface(orthographic)
    camera = Camera.orthographic if orthographic else Camera.perspective
    points = camera(torch.tensor(2.0 if orthographic else 60.0).double(), HEIGHT, WIDTH).unproject(depth[:, None])[
        0, :, 0
    ]
    still = torch.zeros_like(depth)
    there = surface.read(surface.column + still, surface.row + still) < samples.SKY
    for axis in surface.tap(still, still)[:3]:
        assert (axis.expand_as(depth)[there] == 0).all()  # a pixel is exactly 0 from itself
    *vector, found = surface.tap(still + 3.2, still - 1.6)  # to whole pixels: 3 right, 2 up
    assert torch.allclose(torch.stack(vector)[:, 0, 10, 20], points[:, 8, 23] - points[:, 10, 20], atol=1e-12)
    assert found[0, 10, 20] == depth[0, 8, 23]
    assert found[0, 6, 3] == samples.SKY  # the hole
    seen = surface.on_image(found)[0]
    assert seen[2:, :-3].all()
    assert not seen[:2].any()
    assert not seen[:, -3:].any()


@pytest.mark.parametrize("orthographic", [False, True])
def test_points_are_looked_up_where_they_are_seen(orthographic: bool) -> None:
    depth, surface = _surface(orthographic)
    # From pixel (20, 30) along the way to the surface of pixel (24, 37), and a tenth beyond it.
    points = [axis.expand_as(depth) for axis in (surface.x, surface.y, surface.z)]
    target = [axis[0, 24, 37] for axis in points]
    scale = 1.0 if orthographic else 1.1
    place = [scale * target[0], scale * target[1], 1.1 * target[2]]
    offset = [p - axis[0, 20, 30] for p, axis in zip(place, points, strict=True)]
    behind, seen = surface.behind(*(torch.full_like(depth, float(value)) for value in offset))
    assert behind[0, 20, 30].item() == pytest.approx(0.1 * depth[0, 24, 37].item(), abs=1e-12)
    assert seen[0, 20, 30] == 1
    if not orthographic:  # through the eye: the point behind it projects onto the image, upside down
        _, seen = surface.behind(-2 * surface.x, -2 * surface.y, -2 * surface.z)
        assert not seen.any()
        _, seen = surface.behind(-surface.x, -surface.y, -3 * surface.z)  # onto the axis
        assert not seen.any()


def test_levels_are_sub_samples_on_a_rotated_grid() -> None:
    depth, surface = _surface()
    image = surface.map.view(HEIGHT + 2, WIDTH + 2)

    def sample(level: int, row: int, column: int) -> float:
        if level == 0:
            inside = row < HEIGHT + 2 and column < WIDTH + 2
            return float(image[row, column]) if inside else samples.BORDER
        return sample(level - 1, 2 * row + column % 2, 2 * column + row % 2)

    still = torch.zeros_like(depth)
    for level, span in ((0, 15.9), (1, 16.1), (1, 31.0), (2, 33.0), (4, 130.0), (5, 260.0), (5, 1e4)):
        *_, found = _Pyramid(surface, torch.full_like(depth, span)).tap(still, still, 1.0)
        for row, column in ((0, 0), (7, 12), (30, 41), (HEIGHT - 1, WIDTH - 1)):
            expected = sample(level, row + 1 >> level, column + 1 >> level)
            assert found[0, row, column].item() == expected, (level, row, column)


def test_points_fill_ball_and_disk_evenly() -> None:
    ball = torch.tensor(samples.ball_points(4000))
    assert ball.square().sum(1).max() <= 1
    assert torch.allclose(ball.mean(0), torch.zeros(3), atol=0.01)
    assert torch.allclose(ball.square().mean(0), torch.full((3,), 0.2), atol=0.01)
    _, surface = _surface()
    radius = torch.tensor(2.0).double()
    before = (2 * torch.tensor(samples.ball_points(8)).double()).norm(dim=1)
    moved = [torch.stack(point).norm(dim=0) for point in samples.reflected_ball(8, 0, surface, radius)]
    assert torch.allclose(torch.stack([m.mean() for m in moved]), before, atol=1e-9)  # mirrored, not scaled
    disk = [(x, y, square) for x, y, square in samples.turned_disk(16, 0, surface)]
    for number, (x, y, square) in enumerate(disk):
        assert torch.allclose(x * x + y * y, square)
        assert (square >= number / 16).all()
        assert (square <= (number + 1) / 16).all()
