"""How well the ray march's gradients predict differences over smooth depth bumps: `python -m benchmarks.ray_march_fidelity`.

One row a scene and gradient: correlation and slope between the predicted and the measured change of a randomly
weighted image, over 32 bumps of 3 pixels and 6 % of the radius and 4 random weightings. "edges" has depth steps and
normals estimated from the depth, "smooth" neither. The soft form predicts itself; "exact" and "surrogate" are
compared with the hard image that they differentiate.
"""

from __future__ import annotations

import torch
from torch import Tensor

import torch_ssao as ts

SIZE, RADIUS, HEIGHT, WIDTH_PX = (40, 56), 0.5, 0.03, 3.0


def gbuffer(kind: str) -> ts.GBuffer:
    """A bumpy surface, with a block in front of it or without."""
    v = torch.linspace(-1, 1, SIZE[0], dtype=torch.float64)[:, None]
    u = torch.linspace(-1.3, 1.3, SIZE[1], dtype=torch.float64)
    depth = 4 + 0.25 * torch.sin(5 * u) * torch.cos(4 * v) - 0.5 * torch.exp(-8 * ((u + 0.6) ** 2 + (v - 0.3) ** 2))
    if kind == "edges":
        depth = torch.where((u > 0.1) & (u < 0.7) & (v.abs() < 0.45), torch.full_like(depth, 3.0), depth)
    camera = ts.Camera.perspective(50.0, *SIZE).to(torch.float64)
    estimated = ts.GBuffer.from_depth(depth, camera)
    if kind == "edges":
        return estimated
    points = camera.unproject(depth[None, None])[:, :, 0]
    down, right = (torch.gradient(points, dim=axis)[0] for axis in (2, 3))  # central: exact to second order
    normal = torch.nn.functional.normalize(torch.linalg.cross(down, right, dim=1), dim=1)
    return ts.GBuffer(depth[None, None], camera, normal=normal)


def bumps(count: int) -> Tensor:
    """(count, 1, H, W) Gaussians of height 1."""
    generator = torch.Generator().manual_seed(1)
    spread = torch.tensor([SIZE[0] - 12.0, SIZE[1] - 12.0]).view(1, 2, 1, 1)
    centre = torch.rand(count, 2, 1, 1, generator=generator, dtype=torch.float64) * spread + 6
    y, x = torch.arange(SIZE[0], dtype=torch.float64)[:, None], torch.arange(SIZE[1], dtype=torch.float64)
    return torch.exp(-((y - centre[:, :1]) ** 2 + (x - centre[:, 1:]) ** 2) / (2 * WIDTH_PX**2))


def row(gb: ts.GBuffer, gradient: str) -> tuple[float, float]:
    """Correlation and slope of predicted against measured changes."""
    net = ts.RayMarchedSSAO(RADIUS, rays=16, steps=8, gradient=gradient, surrogate_width=0.1).double()
    shapes = bumps(32)

    def image(depth: Tensor) -> Tensor:
        return net(ts.GBuffer(depth, gb.camera, normal=gb.normal.expand(len(depth), -1, -1, -1)))

    with torch.no_grad():
        change = (image(gb.depth + HEIGHT * shapes) - image(gb.depth - HEIGHT * shapes)) / (2 * HEIGHT)
    predicted, measured = [], []
    for seed in range(4):
        weights = torch.randn(gb.depth.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        depth = gb.depth.clone().requires_grad_()
        (image(depth) * weights).sum().backward()
        predicted.append((depth.grad * shapes).sum((1, 2, 3)))
        measured.append((change * weights).sum((1, 2, 3)))
    guess, truth = torch.cat(predicted), torch.cat(measured)
    correlation = torch.corrcoef(torch.stack((guess, truth)))[0, 1]
    return float(correlation), float((guess * truth).sum() / truth.square().sum())


def main() -> None:
    print("scene   gradient   correlation  slope")
    for kind in ("smooth", "edges"):
        gb = gbuffer(kind)
        for gradient in ("soft", "surrogate", "exact"):
            correlation, slope = row(gb, gradient)
            print(f"{kind:7} {gradient:10} {correlation:11.4f} {slope:6.3f}")


if __name__ == "__main__":
    main()
