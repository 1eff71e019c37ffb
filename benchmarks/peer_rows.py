"""Rows of the peers for a report: `python -m benchmarks.peer_rows temple --size 160x120`.

Then `torch-ssao report temple --size 160x120 --peers out/peers_temple.json`.

Every peer of `benchmarks.peers` is fitted like ours on the fitted views, with one pass of the same filter, judged on the others
against the same reference, and timed in turns on this machine. SCENE is a built-in scene, or a mesh file with --cameras.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from benchmarks.peers import PEERS
from torch_ssao.fitting.timing import time_forward
from torch_ssao.report.truth import TraceSettings, trace_views


def score(prediction: Tensor, target: Tensor, valid: Tensor) -> dict[str, float]:
    """RMSE, PSNR and SSIM as the report has them."""
    names = ("rmse", "psnr", "ssim")
    return {name: float(getattr(ts.metrics, name)(prediction, target, valid)) for name in names}


def rows(scene: Any, size: tuple[int, int], samples: int, fit_views: list[int], folder: Path) -> list[dict[str, Any]]:
    """One row a peer."""
    width, height = size
    judged = [view for view in range(len(scene.cameras)) if view not in fit_views] or fit_views
    settings = TraceSettings(height, width, scene.radius, samples)
    parts = {}
    for name, views in (("training", fit_views), ("validation", judged)):
        gbuffer = ts.scenes.render(scene, views=views, height=height, width=width)
        truth = trace_views(scene, views, settings, folder)
        parts[name] = (gbuffer, truth.visibility, truth.valid & gbuffer.valid_mask[:, :1])
    fitted = {}
    for name, kind in PEERS.items():
        made: Any = kind
        fit = ts.fitting.fit(made(scene.radius, denoise=1), *parts["training"][:2], max_evaluations=200, progress=False)
        fitted[name] = fit.module
        print(f"{name}: {fit}", flush=True)
    timings = time_forward(list(fitted.values()), parts["validation"][0][0])
    found = []
    for (name, module), timing in zip(fitted.items(), timings, strict=True):
        row: dict[str, Any] = {"name": name, "note": "fitted, one pass of the filter, same machine"}
        row |= {"ms": timing.median_ms, "ms_low": timing.low_ms, "ms_high": timing.high_ms}
        with torch.no_grad():
            for part, (gbuffer, target, valid) in parts.items():
                image = torch.cat([module(gbuffer[view]) for view in range(len(gbuffer))])
                row[part] = score(image, target, valid)
        found.append(row)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--size", default="480x360")
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--fit-views", default="0")
    parser.add_argument("--out", type=Path, help="the file; out/peers_SCENE.json if left out")
    options = parser.parse_args()
    width, height = (int(part) for part in options.size.split("x"))
    named = options.scene in ts.scenes.names()
    scene = ts.scenes.builtin(options.scene) if named else ts.scenes.load(options.scene, cameras=options.cameras)
    out = options.out or Path(f"out/peers_{scene.name}.json")
    folder = Path("out/peer_rows")
    folder.mkdir(parents=True, exist_ok=True)
    fit_views = [int(view) for view in options.fit_views.split(",")]
    found = rows(scene, (width, height), options.samples, fit_views, folder)
    record = {"scene": scene.name, "width": width, "height": height, "rows": found}
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
