"""Techniques on meshes of your own: fitted on each scene's first view, judged on its others, beside the best constant image.

    python -m benchmarks.real_scenes FOLDER [--scenes bunny ...] [--models quadrants ...] [--size 480x360] [--fit-size 240x180]

FOLDER holds meshes and a scenes.json with cameras and radii (see `ts.scenes.load`). References are binary, traced once and kept in
out/real_scenes. Every model is fitted at the fit size and judged at the full size: a radius in scene units depends on neither. PSNR
is that of the mean squared error over all judged views. Rows go to benchmarks/results/real_scenes.json, beside earlier ones.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report.environment import environment
from torch_ssao.scenes.scene import Scene

RESULTS = Path(__file__).parent / "results" / "real_scenes.json"
CACHE = Path("out/real_scenes")

# name -> (module at a radius, parameters to fit, evaluations)
MODELS: dict[str, tuple[Callable[[float], AmbientVisibility], tuple[str, ...] | None, int]] = {
    "one layer, radius and contrast": (lambda r: ts.StatVO(r, layers=1, quadrants=False), ("radius", "contrast"), 100),
    "one region, radius and contrast": (lambda r: ts.StatVO(r, layers=4, quadrants=False), ("radius", "contrast"), 100),
    "one region": (lambda r: ts.StatVO(r, layers=4, quadrants=False), None, 300),
    "quadrants": (lambda r: ts.StatVO(r, layers=4, quadrants=True), None, 300),
    "quadrants, 8 layers": (lambda r: ts.StatVO(r, layers=8, quadrants=True), None, 300),
    "quadrants, two windows": (lambda r: ts.StatVO(r, layers=4, windows=2), None, 300),
}


def truth(scene: Scene, name: str, height: int, width: int, samples: int) -> Any:
    """The scene's reference, traced once."""
    path = CACHE / f"{name}_{width}x{height}_{samples}_{scene.radius:g}.pt"
    if path.exists():
        return torch.load(path, weights_only=True)
    traced = ts.reference.raytrace(scene, height=height, width=width, samples=samples)
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(traced.visibility, path)
    return traced.visibility


def judge(prediction: torch.Tensor, target: torch.Tensor, valid: torch.Tensor) -> dict[str, float]:
    """RMSE, PSNR of the mean squared error, mean SSIM of the views."""
    rmse = float(ts.metrics.rmse(prediction, target, valid))
    return {
        "rmse": round(rmse, 5),
        "psnr": round(-20 * math.log10(rmse), 3),
        "ssim": round(float(ts.metrics.ssim(prediction, target, valid)), 4),
    }


def predict(module: AmbientVisibility, gbuffer: ts.GBuffer) -> tuple[torch.Tensor, float]:
    """Images of all views, one at a time, and the median milliseconds of a view."""
    images, times = [], []
    with torch.no_grad():
        for view in range(len(gbuffer)):
            start = time.perf_counter()
            images.append(module(gbuffer[view]))
            times.append(time.perf_counter() - start)
    return torch.cat(images), 1e3 * sorted(times)[len(times) // 2]


def measure(
    folder: Path, name: str, file: str, models: list[str], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """Rows of one scene."""
    scene = ts.scenes.load(folder / file, cameras=folder / "scenes.json")
    (width, height), (fit_width, fit_height) = arguments.size, arguments.fit_size
    gb = ts.scenes.render(scene, height=height, width=width)
    target = truth(scene, name, height, width, arguments.samples)
    small = ts.scenes.render(scene, views=0, height=fit_height, width=fit_width)
    small_target = truth(scene, name, fit_height, fit_width, arguments.samples)[:1]
    others = list(range(1, len(gb)))
    judged, wanted = gb[others], target[others]
    valid = judged.valid_mask[:, :1]
    rows: list[dict[str, Any]] = []

    def add(model: str, **facts: Any) -> None:
        rows.append({"scene": name, "model": model, **facts})
        print(f"{name:16} {model:34} " + " ".join(f"{k} {v}" for k, v in facts.items() if k != "values"), flush=True)

    for model, level in (
        ("constant, best", float(wanted[valid].mean())),
        ("constant, training mean", float(small_target[small.valid_mask[:, :1]].mean())),
    ):
        add(model, **judge(torch.full_like(wanted, level), wanted, valid))
    for model in models:
        make, parameters, evaluations = MODELS[model]
        fitted = ts.fitting.fit(
            make(scene.radius), small, small_target, parameters=parameters, max_evaluations=evaluations, progress=False
        )
        image, milliseconds = predict(fitted.module, judged)
        add(
            model,
            **judge(image, wanted, valid),
            ms=round(milliseconds, 1),
            training_rmse=round(fitted.rmse, 5),
            values={key: round(value, 5) for key, value in fitted.values.items()},
        )
    return rows


def summarise(rows: list[dict[str, Any]]) -> str:
    """PSNR by scene and model, and the mean over the scenes."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    models = list(dict.fromkeys(row["model"] for row in rows))
    found = {(row["scene"], row["model"]): row["psnr"] for row in rows}
    lines = [f"{'PSNR':34}" + "".join(f"{scene[:11]:>12}" for scene in scenes) + f"{'mean':>9}"]
    for model in models:
        values = [found.get((scene, model), math.nan) for scene in scenes]
        lines.append(f"{model:34}" + "".join(f"{v:12.2f}" for v in values) + f"{sum(values) / len(values):9.2f}")
    return "\n".join(lines)


def merge(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows on disk with these in their place."""
    kept = json.loads(RESULTS.read_text(encoding="utf-8"))["rows"] if RESULTS.exists() else []
    new = {(row["scene"], row["model"]) for row in rows}
    return sorted([row for row in kept if (row["scene"], row["model"]) not in new] + rows, key=lambda row: row["scene"])


def _size(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="*")
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--size", type=_size, default=(480, 360))
    parser.add_argument("--fit-size", type=_size, default=(240, 180))
    parser.add_argument("--samples", type=int, default=256)
    arguments = parser.parse_args()
    known = json.loads((arguments.folder / "scenes.json").read_text(encoding="utf-8"))
    for name in arguments.scenes or list(known):
        rows = measure(arguments.folder, name, known[name]["file"], arguments.models, arguments)
        facts = {"environment": environment(), "size": arguments.size, "fit_size": arguments.fit_size}
        record = facts | {"samples": arguments.samples, "rows": merge(rows)}
        RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(summarise(merge([])))


if __name__ == "__main__":
    main()
