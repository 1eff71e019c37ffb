"""Peers that average over taps, against a loop over pixels and taps in plain numbers, on a rough depth map with holes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from benchmarks.peers import PEERS
from torch_ssao.camera import Camera
from torch_ssao.gbuffer import GBuffer
from torch_ssao.ops.sampling import poisson_disk, tiled_noise

HEIGHT, WIDTH, RADIUS, FRAME = 24, 31, 0.5, 3
Vector = np.ndarray


class Pixels:
    """Points and noise of the image, read one at a time."""

    def __init__(self, orthographic: bool) -> None:
        generator = torch.Generator().manual_seed(5)
        shape = (1, 1, HEIGHT, WIDTH)
        depth = 2 + 0.3 * torch.rand(shape, generator=generator, dtype=torch.float64)
        depth[..., 10:] += 0.25
        depth[..., 3:6, 20:24] = torch.inf
        normal = 0.4 * torch.randn((1, 3, HEIGHT, WIDTH), generator=generator, dtype=torch.float64)
        normal[:, 2] = -1
        normal = torch.nn.functional.normalize(normal, dim=1)
        if orthographic:
            camera = Camera.orthographic(torch.tensor(2.0).double(), HEIGHT, WIDTH)
        else:
            camera = Camera.perspective(torch.tensor(55.0).double(), HEIGHT, WIDTH)
        self.gbuffer = GBuffer(depth, camera, normal=normal)
        self.orthographic, self.focal = orthographic, float(camera.fx)
        self.turn, self.offset = (
            noise.numpy() for noise in tiled_noise(HEIGHT, WIDTH, FRAME, dtype=torch.float64, device=depth.device)
        )
        self.depth, self.normal = depth[0, 0].numpy(), normal[0].permute(1, 2, 0).numpy()

    def point(self, row: int, column: int) -> Vector:
        z = self.depth[row, column]
        scale = 1.0 if self.orthographic else z
        x, y = (column + 0.5 - WIDTH / 2) / self.focal, (row + 0.5 - HEIGHT / 2) / self.focal
        return np.array([x * scale, y * scale, z])

    def span(self, row: int, column: int) -> float:
        return self.focal * RADIUS / (1.0 if self.orthographic else self.depth[row, column])

    def tap(self, row: int, column: int, right: float, down: float) -> Vector | None:
        """Vector to the surface in radii: infinite for the sky, None off the image."""
        at_row, at_column = round(row + down), round(column + right)
        if not (0 <= at_row < HEIGHT and 0 <= at_column < WIDTH):
            return None
        if not math.isfinite(self.depth[at_row, at_column]):
            return np.array([0.0, 0.0, np.inf])
        return (self.point(at_row, at_column) - self.point(row, column)) / RADIUS


def _disk(pixels: Pixels, row: int, column: int, count: int) -> Iterator[tuple[float, float]]:
    for number, (x, y) in enumerate(poisson_disk(count, dtype=torch.float64).tolist()):
        angle = math.atan2(y, x) + 2 * math.pi * pixels.turn[row, column]
        length = math.sqrt((number + pixels.offset[row, column]) / count)
        yield length * math.cos(angle), length * math.sin(angle)


def _tap_mean(
    pixels: Pixels, row: int, column: int, offsets: Iterator[tuple[float, float]], value: Callable[[Vector], float]
) -> float:
    found = [pixels.tap(row, column, right, down) for right, down in offsets]
    seen = [0.0 if np.isinf(v[2]) else value(v) for v in found if v is not None]
    return sum(seen) / len(seen) if seen else 0.0


def alchemy(pixels: Pixels, row: int, column: int) -> float:
    span, normal, z = pixels.span(row, column), pixels.normal[row, column], pixels.depth[row, column]
    offsets = ((span * x, span * y) for x, y in _disk(pixels, row, column, 9))
    mean = _tap_mean(pixels, row, column, offsets, lambda v: max(0.0, v @ normal - 1e-4 * z / RADIUS) / (v @ v + 1e-4))
    return max(0.0, 1 - 0.2 * 2 * mean)


def sao(pixels: Pixels, row: int, column: int) -> float:
    span, normal = pixels.span(row, column), pixels.normal[row, column]

    def offsets() -> Iterator[tuple[float, float]]:
        for number in range(9):
            share = (number + 0.5) / 9
            angle = 2 * math.pi * (7 * share + pixels.turn[row, column])
            yield span * share * math.cos(angle), span * share * math.sin(angle)

    def value(v: Vector) -> float:
        return max(0.0, 1 - v @ v) ** 3 * max(0.0, v @ normal - 0.01) / (v @ v + 0.01)

    return max(0.0, 1 - 0.2 * 5 * _tap_mean(pixels, row, column, offsets(), value))


def hbao_plus(pixels: Pixels, row: int, column: int) -> float:
    span, normal = pixels.span(row, column), pixels.normal[row, column]

    def offsets() -> Iterator[tuple[float, float]]:
        for direction in range(5):
            angle = 2 * math.pi * (direction + pixels.turn[row, column]) / 5
            for step in range(3):
                away = 1 + (step + pixels.offset[row, column]) * span / 4
                yield away * math.cos(angle), away * math.sin(angle)

    def value(v: Vector) -> float:
        return min(max(v @ normal / math.sqrt(v @ v) - 0.1, 0.0), 1.0) * max(0.0, 1 - v @ v)

    return max(0.0, 1 - 2 / 0.9 * _tap_mean(pixels, row, column, offsets(), value)) ** 1.5


def unreal(pixels: Pixels, row: int, column: int) -> float:
    span, normal = pixels.span(row, column), pixels.normal[row, column]
    total = weights = 1e-4
    for x, y in _disk(pixels, row, column, 6):
        weight, angle = 1.0, 0.0
        for side in (1, -1):
            v = pixels.tap(row, column, side * span * x, side * span * y)
            if v is None or np.isinf(v[2]):
                weight = 0.0
                continue
            length = math.sqrt(v @ v)
            weight *= max(0.0, 1 - length / 2)
            angle += math.acos(min(max(v @ normal / length, 0.0), 1 - 1e-6)) if length > 0 else math.pi / 2
        total += weight * angle / math.pi
        weights += weight
    return total / weights


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize(
    ("loop", "options"),
    [
        (alchemy, {"samples": 9, "strength": 0.2}),
        (sao, {"samples": 9, "strength": 0.2, "mips": False}),
        (hbao_plus, {"directions": 5, "steps": 3}),
        (unreal, {"pairs": 6}),
    ],
)
def test_equals_the_pixel_loop(
    loop: Callable[[Pixels, int, int], float], options: dict[str, float], orthographic: bool
) -> None:
    pixels = Pixels(orthographic)
    peer = PEERS[loop.__name__](RADIUS, **options).double()
    found = peer(pixels.gbuffer, frame=FRAME)[0, 0].numpy()
    expected = np.ones((HEIGHT, WIDTH))
    for row, column in np.ndindex(HEIGHT, WIDTH):
        if math.isfinite(pixels.depth[row, column]):
            expected[row, column] = loop(pixels, row, column)
    # A tap that falls between two pixels may be rounded either way: a handful of pixels may differ.
    close = np.isclose(found, expected, rtol=0, atol=1e-6)
    assert close.mean() > 0.99
    assert expected.std() > 0.02
