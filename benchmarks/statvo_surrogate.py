"""Which gradient of StatVO's partition points where the noise-smoothed image does: exact almost everywhere, or the surrogate?

    python -m benchmarks.statvo_surrogate [--scenes temple street ...] [--widths 0.25 ...]

The hard image is a staircase in depth wherever a sample changes its layer. Averaged over small depth perturbations it is smooth;
its slope along 64 smooth directions, by central differences on common random numbers, is the truth. Each gradient predicts those 64
slopes; the score is the cosine between prediction and truth over all seeds (each with its own cotangent, directions and
perturbations), its standard error is by bootstrap over the directions. The radius is twice the scene's, so that at 64 x 48 a
window has a footprint, 5 to 10 pixels, as it has in a real image.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parent / "results" / "statvo_surrogate.json"
SIZE = (48, 64)
DIRECTIONS, PERTURBATIONS = 64, 16
DEFAULT_WIDTH = 0.1  # of the box height, as in StatVO
CORRELATION = 2.0  # pixels
LARGER = 2.0  # radius over the scene's own


def smooth_fields(count: int, generator: torch.Generator) -> Tensor:
    """(count, 1, H, W) Gaussian fields of unit variance."""
    noise = torch.randn(count, 1, SIZE[0] + 24, SIZE[1] + 24, generator=generator, dtype=torch.float64)
    tap = torch.exp(-0.5 * (torch.arange(-12, 13, dtype=torch.float64) / CORRELATION) ** 2)
    tap = tap / tap.square().sum().sqrt()
    rows = torch.nn.functional.conv2d(noise, tap.view(1, 1, -1, 1))
    return torch.nn.functional.conv2d(rows, tap.view(1, 1, 1, -1))


def slopes_of(scene_name: str, width: float, *, seed: int, layers: int = 4) -> dict[str, Tensor]:
    """Slopes of the smoothed image on view 0 of a built-in scene, and as both gradients predict them; (64,) each."""
    scene = ts.scenes.builtin(scene_name)
    gb = ts.scenes.render(scene, views=0, height=SIZE[0], width=SIZE[1])
    camera, normal, valid = gb.camera.to(torch.float64), gb.normal.double(), gb.valid_mask
    depth = torch.where(valid, gb.depth.double(), 1.0)
    radius = LARGER * scene.radius
    generator = torch.Generator().manual_seed(seed)
    cotangent = torch.randn(1, 1, *SIZE, generator=generator, dtype=torch.float64)
    directions = smooth_fields(DIRECTIONS, generator)
    net = {
        g: ts.StatVO(radius, layers=layers, gradient=g, surrogate_width=width).double() for g in ("exact", "surrogate")
    }
    scale = width * radius  # the box is one radius high

    def losses(depths: Tensor) -> Tensor:
        shape = (len(depths), -1, -1, -1)
        image = net["exact"](
            ts.GBuffer(depths, camera.expand(len(depths)), normal=normal.expand(shape), valid=valid.expand(shape))
        )
        return (image * cotangent).sum((1, 2, 3))

    truth = torch.zeros(DIRECTIONS, dtype=torch.float64)
    with torch.no_grad():
        for _ in range(PERTURBATIONS):  # common random numbers: one perturbation serves all directions and both signs
            uniform = torch.rand(1, 1, *SIZE, generator=generator, dtype=torch.float64).clamp(1e-12, 1 - 1e-12)
            noisy = depth + scale * (uniform / (1 - uniform)).log()  # logistic noise, whose distribution is the sigmoid
            step = 0.5 * scale
            difference = losses(noisy + step * directions) - losses(noisy - step * directions)
            truth += difference / (2 * step * PERTURBATIONS)
    slopes = {"truth": truth / truth.norm()}
    for name, module in net.items():
        leaf = depth.clone().requires_grad_()
        (module(ts.GBuffer(leaf, camera, normal=normal, valid=valid)) * cotangent).sum().backward()
        slopes[name] = (directions * leaf.grad).sum((1, 2, 3)) / truth.norm()
    return slopes


def score(scene_name: str, width: float, seeds: list[int]) -> dict[str, Any]:
    """Cosines of both gradients with the truth, their difference, and standard errors."""
    runs = [slopes_of(scene_name, width, seed=seed) for seed in seeds]
    slopes = {name: torch.cat([run[name] for run in runs]) for name in runs[0]}
    truth = slopes.pop("truth")
    draws = torch.randint(0, len(truth), (4000, len(truth)), generator=torch.Generator().manual_seed(0))
    spread = {name: _cosine(predicted[draws], truth[draws]) for name, predicted in slopes.items()}
    row: dict[str, Any] = {"scene": scene_name, "width": width, "seeds": seeds}
    for name, predicted in slopes.items():
        row[name] = round(float(_cosine(predicted, truth)), 4)
        row[f"{name}_standard_error"] = round(float(spread[name].std()), 4)
    error = float((spread["surrogate"] - spread["exact"]).std())
    row["gain"] = round(row["surrogate"] - row["exact"], 4)
    row["gain_standard_error"] = round(error, 4)
    row["gain_over_standard_error"] = round(row["gain"] / max(error, 1e-9), 2)
    return row


def _cosine(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1) / (a.square().sum(-1) * b.square().sum(-1)).sqrt().clamp(min=math.ulp(0.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(ts.scenes.names()))
    parser.add_argument("--widths", nargs="*", type=float, default=[DEFAULT_WIDTH])
    parser.add_argument("--seeds", nargs="*", type=int, default=list(range(16)))
    arguments = parser.parse_args()
    rows = []
    for width in arguments.widths:
        for scene in arguments.scenes:
            rows.append(score(scene, width, arguments.seeds))
            print(
                "{scene:8} width {width:<5} exact {exact:.3f} +- {exact_standard_error:.3f}   surrogate {surrogate:.3f} +- "
                "{surrogate_standard_error:.3f}   gain {gain:+.3f} = {gain_over_standard_error} standard errors".format(
                    **rows[-1]
                ),
                flush=True,
            )
            kept = json.loads(RESULTS.read_text(encoding="utf-8"))["rows"] if RESULTS.exists() else []
            done = {(row["scene"], row["width"]) for row in rows}
            rows_now = rows + [row for row in kept if (row["scene"], row["width"]) not in done]
            RESULTS.write_text(
                json.dumps({"environment": environment(), "rows": rows_now}, indent=1) + "\n", encoding="utf-8"
            )


if __name__ == "__main__":
    main()
