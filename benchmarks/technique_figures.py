"""Pictures of docs/hbao.md and docs/ray_march.md: known failures with their remedies, and the ray march at few samples.

    python -m benchmarks.technique_figures [--dragon FOLDER]

References are traced, 256 rays a pixel. FOLDER holds meshes and a scenes.json with a scene "dragon" (see `ts.scenes.load`).
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import torch_ssao as ts
from benchmarks.statvo_claims.pictures import strip
from torch_ssao.scenes import analytic

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
Net = Callable[..., ts.modules.AmbientVisibility]
Cell = tuple[str, Tensor]


def caption(name: str, image: Tensor, target: Tensor, valid: Tensor) -> Cell:
    """An image with its RMSE."""
    return f"{name}: RMSE {float(ts.metrics.rmse(image, target, valid)):.3f}", image


def traced(name: str, view: int, nets: dict[str, ts.modules.AmbientVisibility], falloff: str) -> list[Cell]:
    """A view of a built-in scene: reference and estimates."""
    scene = ts.scenes.builtin(name)
    gb = ts.scenes.render(scene, views=view, height=180, width=240)
    target = ts.reference.raytrace(scene, views=view, height=180, width=240, samples=256, falloff=falloff).visibility
    valid = gb.valid_mask[:, :1]
    with torch.no_grad():
        return [("reference", target), *(caption(n, net(gb), target, valid) for n, net in nets.items())]


def slat(nets: dict[str, ts.modules.AmbientVisibility], falloff: str) -> list[Cell]:
    """A thin slat 0.3 above a floor, R = 1: its exact floor, and estimates."""
    scene = analytic.raised_slat(0.3, 0.4)
    gb = scene.render(scene.camera(180, 240, view_angle_deg=50.0, span=3.0), dtype=torch.float32)
    exact, known = scene.exact(gb, radius=1.0, falloff=falloff)
    exact = torch.where(known, exact, 1.0).float()
    with torch.no_grad():
        return [("exact on the floor", exact), *(caption(n, net(gb), exact, known) for n, net in nets.items())]


def pillar(nets: dict[str, ts.modules.AmbientVisibility]) -> list[Cell]:
    """A pillar 1.2 R before a wall, which ought to be open."""
    depth = torch.full((1, 1, 180, 240), 6.0)
    depth[..., 30:150, 98:142] = 4.8
    gb = ts.GBuffer.from_depth(depth, ts.Camera.perspective(50.0, 180, 240))
    open_wall = torch.ones_like(depth)
    with torch.no_grad():
        return [("exact", open_wall), *(caption(n, net(gb), open_wall, depth == 6.0) for n, net in nets.items())]


def hbao_failures() -> None:
    """docs/figures/hbao_failures.png."""
    many = {"slices": 8, "steps": 16}
    rows = [
        slat({"thickness 0.8 R": ts.HBAO(1.0, **many), "0.05 R": ts.HBAO(1.0, thickness=0.05, **many)}, "binary"),
        pillar({"connected, 0.8 R": ts.HBAO(1.0), "apart, 0.1 R": ts.HBAO(1.0, connected=False, thickness=0.1)}),
        traced(
            "temple",
            2,
            {'"open"': ts.HBAO(0.8, denoise=1), '"extend"': ts.HBAO(0.8, denoise=1, offscreen="extend")},
            "binary",
        ),
        traced("pipes", 0, {"thickness 0.8 R": _pipes(0.8), "0.2 R": _pipes(0.2)}, "binary"),
    ]
    names = ["under a thin slat", "wall 1.2 R behind a pillar", "off the image", "pipes and wire"]
    strip(FIGURES / "hbao_failures.png", rows, names=names, title="HBAO: where it fails, and what helps")


def _pipes(thickness: float) -> ts.HBAO:
    return ts.HBAO(ts.scenes.builtin("pipes").radius, slices=4, steps=8, thickness=thickness, denoise=1)


def ray_march_failures() -> None:
    """docs/figures/ray_march_failures.png."""
    many = {"rays": 64, "steps": 32}

    def net(radius: float, thickness: float | None, **counts: int) -> ts.RayMarchedSSAO:
        return ts.RayMarchedSSAO(radius, thickness=thickness, denoise=1, **counts)

    rows = [
        pillar({"infinite": net(1.0, None), "0.1 R": net(1.0, 0.1)}),
        slat({"infinite": net(1.0, None, **many), "0.05 R": net(1.0, 0.05, **many)}, "linear"),
        traced("heap", 0, {"infinite": _heap(None), "0.4 R": _heap(0.4)}, "linear"),
        traced("pipes", 0, {"8 steps": _thin(8), "32 steps": _thin(32)}, "linear"),
    ]
    names = ["wall 1.2 R behind a pillar", "under a thin slat", "a heap", "pipes and wire"]
    strip(FIGURES / "ray_march_failures.png", rows, names=names, title="Ray march: where it fails, and what helps")


def _heap(thickness: float | None) -> ts.RayMarchedSSAO:
    return ts.RayMarchedSSAO(ts.scenes.builtin("heap").radius, rays=32, steps=16, thickness=thickness, denoise=1)


def _thin(steps: int) -> ts.RayMarchedSSAO:
    return ts.RayMarchedSSAO(ts.scenes.builtin("pipes").radius, rays=32, steps=steps, thickness=0.2, denoise=1)


def dragon(folder: Path) -> None:
    """docs/figures/ray_march_dragon.png: 8, 13 and 24 steps a ray and rays a pixel, one frame, no filter; the reference."""
    file = json.loads((folder / "scenes.json").read_text(encoding="utf-8"))["dragon"]["file"]
    scene = ts.scenes.load(folder / file, cameras=folder / "scenes.json")
    size = {"height": 600, "width": 800}
    shown = (..., slice(190, 420), slice(170, 500))
    gb = ts.scenes.render(scene, views=0, **size)
    target = ts.reference.raytrace(scene, views=0, samples=256, falloff="linear", **size).visibility
    valid = gb.valid_mask[:, :1]
    rows = []
    for what in ("steps", "rays"):
        row = []
        for count in (8, 13, 24):
            counts = {"rays": count, "steps": 8} if what == "rays" else {"rays": 16, "steps": count}
            net = ts.RayMarchedSSAO(scene.radius, thickness=0.6, **counts)
            with torch.no_grad():
                image = net(gb)
            error = float(ts.metrics.rmse(image, target, valid))
            row.append(
                (f"{counts['rays']} rays x {counts['steps']} steps: {-20 * math.log10(error):.1f} dB", image[shown])
            )
        rows.append([*row, ("reference", target[shown])])
    strip(FIGURES / "ray_march_dragon.png", rows, size=2.6, names=["more steps", "more rays"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dragon", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    hbao_failures()
    ray_march_failures()
    if arguments.dragon:
        dragon(arguments.dragon)


if __name__ == "__main__":
    main()
