"""Ambient visibility of a depth map, its gradient, and a picture: `python examples/00_quickstart.py`."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from PIL import Image

import torch_ssao as ts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="64x48 instead of 640x480")
    parser.add_argument("--out", type=Path, default=Path("out/quickstart.png"))
    options = parser.parse_args()
    height, width = (48, 64) if options.small else (480, 640)

    # Two boxes on a floor that recedes: any depth map does, from a sensor, a network or a renderer.
    v = torch.linspace(-1, 1, height)[:, None]
    u = torch.linspace(-1.3, 1.3, width)
    depth = 3 / (1.2 + v).clamp(min=0.4) + 0 * u
    for centre, size, near in ((-0.5, 0.25, 2.2), (0.45, 0.35, 1.8)):
        depth = torch.where((u - centre).abs().maximum((v - 0.1).abs()) < size, torch.full_like(depth, near), depth)
    depth.requires_grad_()

    camera = ts.Camera.perspective(fov_y_deg=60.0, height=height, width=width)
    ambient = ts.StatVO(radius=0.4, layers=4, learnable=("radius",))
    visibility = ambient(ts.GBuffer.from_depth(depth, camera))  # (1, 1, H, W), 1 = open

    (1 - visibility).mean().backward()  # gradients to the depth map and to the radius
    print(ambient)
    print(f"mean visibility {visibility.mean():.3f}, d occlusion / d log radius {ambient.raw_radius.grad:.4f}")
    print(
        f"depth gradient: {int((depth.grad != 0).sum())} of {depth.numel()} pixels, all finite: {bool(depth.grad.isfinite().all())}"
    )

    options.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * visibility.detach()[0, 0]).round().byte().numpy()).save(options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
