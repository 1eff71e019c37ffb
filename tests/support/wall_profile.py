"""Few taps before a right-angle wall: errors against distance, over three views, of any configuration of the horizons."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from support.limits import HorizonPixels
from torch_ssao.scenes import analytic

VIEWS = ((20.0, 128), (45.0, 160), (70.0, 288))  # degrees from the floor's normal, image height in pixels
NEAR, FAR, BINS = 0.03, 1.4, 15  # distances from the wall, of the radius


class WallView:
    """An orthographic view across the wall, 7 radii high, of radius 1; the rows that show the floor near the wall."""

    def __init__(self, view_angle_deg: float, pixels: int) -> None:
        angle = math.radians(view_angle_deg)
        focus = torch.tensor([0.7, 0.0, 0.0], dtype=torch.float64)
        towards = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
        up = torch.tensor([-math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
        pose = ts.look_at(focus + 10 * towards, focus, up)
        camera = ts.Camera.orthographic(torch.tensor(7.0, dtype=torch.float64), pixels, pixels, world_to_view=pose)
        scene = analytic.wall()
        self.gb = scene.render(camera)
        view = camera.unproject(self.gb.depth)[:, :, 0]
        to_world = torch.linalg.inv(pose.view(4, 4))
        x, y, z = torch.einsum("ij,jhw->ihw", to_world[:3, :3], view[0]) + to_world[:3, 3, None, None]
        used = (z.abs() < 1e-6) & (y.abs() < 1.5) & (x >= NEAR) & (x <= FAR)
        rows = used.any(1).nonzero()[:, 0]
        self.start, self.stop = int(rows[0]) * pixels, (int(rows[-1]) + 1) * pixels
        self.used = used.flatten()[self.start : self.stop]
        exact, _ = scene.exact(self.gb, radius=1.0)
        self.exact = exact.flatten()[self.start : self.stop][self.used]
        place = (x.flatten()[self.start : self.stop][self.used] - NEAR) / (FAR - NEAR) * BINS
        self.place = place.long().clamp(0, BINS - 1)
        self.count = torch.bincount(self.place, minlength=BINS)

    def errors(self, frames: range, **options: Any) -> Tensor:
        """(frames, pixels) visibility minus the exact one; options of `HorizonPixels`."""
        found = [
            HorizonPixels(self.gb, frame=frame, **options).visibility(self.start, self.stop)[self.used]
            for frame in frames
        ]
        return torch.stack(found) - self.exact

    def profile(self, error: Tensor) -> Tensor:
        """(BINS,) mean error at each distance, of (pixels,)."""
        return torch.zeros(BINS, dtype=torch.float64).index_add(0, self.place, error) / self.count


class WallProfile:
    """All `VIEWS`."""

    def __init__(self) -> None:
        self.views = [WallView(*view) for view in VIEWS]

    def rmse(self, frames: range, **options: Any) -> tuple[float, float, float]:
        """RMS over distances and views of the error of the mean over frames, of each single frame, and of each pixel.

        Along the wall, a frame is averaged within each of the `BINS` distances in both of the first two.
        """
        mean, single, pixel = [], [], []
        for view in self.views:
            errors = view.errors(frames, **options)
            mean.append(view.profile(errors.mean(0)).square().mean())
            single.append(torch.stack([view.profile(e) for e in errors]).square().mean())
            pixel.append(errors.square().mean())
        return tuple(float(torch.stack(part).mean().sqrt()) for part in (mean, single, pixel))  # type: ignore[return-value]
