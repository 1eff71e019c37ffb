"""Three techniques and the ray-traced reference, one picture, one table: `python examples/01_three_techniques.py`.

Needs the extra `scenes`. Values are the defaults; `torch-ssao report heap --technique all` fits them too.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from PIL import Image

import torch_ssao as ts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="64x48 instead of 320x240")
    parser.add_argument("--out", type=Path, default=Path("out/three_techniques.png"))
    options = parser.parse_args()
    size = {"height": 48, "width": 64} if options.small else {"height": 240, "width": 320}

    scene = ts.scenes.builtin("heap")
    gbuffer = ts.scenes.render(scene, views=2, **size)
    samples = 32 if options.small else 256
    truth = ts.reference.raytrace(scene, views=2, radius=scene.radius, samples=samples, progress=False, **size)

    # Each looks as far as the reference's rays reach; "radius" is what the gradient below is for.
    techniques = {
        "StatVO, 4 layers": ts.StatVO(scene.radius, layers=4, learnable="radius"),
        "HBAO, 4 slices x 4 steps": ts.HBAO(scene.radius, slices=4, steps=4, learnable="radius"),
        "ray march, 16 rays x 8 steps": ts.RayMarchedSSAO(scene.radius, rays=16, steps=8, learnable="radius"),
    }
    pictures = [truth.visibility[0, 0]]
    print(f"{'':30}{'RMSE':>8}{'SSIM':>8}{'ms':>8}{'d RMSE / d log radius':>24}")
    for name, module in techniques.items():
        with torch.no_grad():
            module(gbuffer)  # the first pass allocates
            start = time.perf_counter()
            module(gbuffer)
            milliseconds = 1e3 * (time.perf_counter() - start)
        visibility = module(gbuffer)
        rmse = ts.metrics.rmse(visibility, truth.visibility, truth.valid)
        rmse.backward()
        ssim = ts.metrics.ssim(visibility.detach(), truth.visibility, truth.valid)
        print(f"{name:30}{rmse:8.4f}{ssim:8.4f}{milliseconds:8.1f}{module.raw_radius.grad:24.4f}")
        pictures.append(visibility.detach()[0, 0])

    options.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * torch.cat(pictures, 1)).round().byte().numpy()).save(options.out)
    print(f"wrote {options.out}: reference, {', '.join(techniques)}")


if __name__ == "__main__":
    main()
