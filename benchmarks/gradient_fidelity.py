"""How well gradients predict differences of the image over smooth depth bumps: `python -m benchmarks.gradient_fidelity`.

One row a scene, form and question: correlation and slope between the predicted and the measured change of a weighted image, over 32
bumps of 3 pixels and 4 weightings. "edges" has depth steps and normals estimated from the depth, "smooth" neither. The weights
are white noise, a question about single pixels, or the same averaged over 9 x 9 pixels, as a loss over regions is. Bumps are 6 %
of the radius high, or .4 %. The soft form of the ray march predicts itself; its "exact" and "surrogate" are compared with the
hard image that they differentiate. "texels held": HBAO without its footprint term, the derivative almost everywhere. Rows go to
benchmarks/results/gradient_fidelity.json.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor

import torch_ssao as ts
from torch_ssao.ops.horizon import horizon_obscurance
from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parent / "results" / "gradient_fidelity.json"
SIZE, RADIUS, WIDTH_PX = (40, 56), 0.5, 3.0
HEIGHTS = {"6 %": 0.03, "0.4 %": 0.002}
FRAMES = 2


def held() -> AbstractContextManager[object]:
    """HBAO without its footprint term."""
    return patch("torch_ssao.modules.hbao.horizon_obscurance", partial(horizon_obscurance, footprint_step=0.0))


def march(gradient: str) -> ts.modules.AmbientVisibility:
    return ts.RayMarchedSSAO(RADIUS, rays=16, steps=8, gradient=gradient, surrogate_width=0.1).double()


FORMS: dict[str, tuple[Callable[[], ts.modules.AmbientVisibility], Callable[[], AbstractContextManager[object]]]] = {
    "HBAO bitmask": (lambda: ts.HBAO(RADIUS).double(), nullcontext),
    "HBAO bitmask, texels held": (lambda: ts.HBAO(RADIUS).double(), held),
    "HBAO increments": (lambda: ts.HBAO(RADIUS, estimator="increments").double(), nullcontext),
    "HBAO increments, texels held": (lambda: ts.HBAO(RADIUS, estimator="increments").double(), held),
    "ray march soft": (lambda: march("soft"), nullcontext),
    "ray march surrogate": (lambda: march("surrogate"), nullcontext),
    "ray march exact": (lambda: march("exact"), nullcontext),
}


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


def questions(like: Tensor) -> dict[str, Tensor]:
    """Four weightings (4, 1, H, W) each, of pixels and of regions."""
    white = torch.stack([torch.randn(like.shape[1:], generator=torch.Generator().manual_seed(s)) for s in range(4)])
    white = white.to(like.dtype)
    return {"pixels": white, "regions": 9 * torch.nn.functional.avg_pool2d(white, 9, 1, 4)}


def rows(gb: ts.GBuffer, make: Callable[[], ts.modules.AmbientVisibility]) -> list[dict[str, object]]:
    """Correlation and slope of predicted against measured changes, by question and height."""
    net, shapes = make(), bumps(32)
    normal = gb.normal

    def image(depth: Tensor) -> Tensor:
        given = ts.GBuffer(depth, gb.camera, normal=normal.expand(len(depth), -1, -1, -1))
        return sum(net(given, frame=frame) for frame in range(FRAMES)) / FRAMES  # type: ignore[return-value]

    changes = {}
    with torch.no_grad():
        for name, height in HEIGHTS.items():
            changes[name] = (image(gb.depth + height * shapes) - image(gb.depth - height * shapes)) / (2 * height)
    found = []
    for question, weights in questions(gb.depth).items():
        predicted = []
        for weight in weights:
            depth = gb.depth.clone().requires_grad_()
            (image(depth) * weight).sum().backward()
            predicted.append((depth.grad * shapes).sum((1, 2, 3)))  # type: ignore[operator]
        guess = torch.cat(predicted)
        for name, change in changes.items():
            truth = torch.cat([(change * weight).sum((1, 2, 3)) for weight in weights])
            correlation = float(torch.corrcoef(torch.stack((guess, truth)))[0, 1])
            slope = float((guess * truth).sum() / truth.square().sum())
            facts = {"question": question, "bumps": name}
            found.append(facts | {"correlation": round(correlation, 4), "slope": round(slope, 3)})
    return found


def main() -> None:
    torch.set_num_threads(1)
    everything = []
    print("scene   form                           question  bumps  correlation  slope")
    for kind in ("smooth", "edges"):
        gb = gbuffer(kind)
        for name, (make, context) in FORMS.items():
            with context():
                for row in rows(gb, make):
                    everything.append({"scene": kind, "form": name} | row)
                    shown = f"{row['question']:9} {row['bumps']:6} {row['correlation']:10.4f} {row['slope']:7.3f}"
                    print(f"{kind:7} {name:30} {shown}", flush=True)
    RESULTS.write_text(
        json.dumps({"environment": environment(), "rows": everything}, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
