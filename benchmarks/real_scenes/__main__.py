"""Techniques on meshes of your own: fitted on each scene's first view, judged on its others, beside the best constant image.

    python -m benchmarks.real_scenes FOLDER [--scenes bunny ...] [--models techniques ...] [--samples 1024] [--pictures DIR]

FOLDER holds meshes and a scenes.json with cameras and radii (see `ts.scenes.load`). References are binary, traced once and kept in
out/real_scenes. Models are fitted at the fit size and judged at the full size: a radius in scene units depends on neither. PSNR is
that of the mean squared error over all judged views. Rows go to benchmarks/results/real_scenes.json, beside earlier ones.
--models takes names and groups of `models.py`; --summary prints only.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import math
import statistics
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from benchmarks.real_scenes.models import GROUPS, MODELS, Model
from benchmarks.real_scenes.summary import summarise
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report.environment import environment
from torch_ssao.report.images import grey_png, write
from torch_ssao.report.truth import TraceSettings, Truth, noise_ceiling, trace_views
from torch_ssao.scenes.scene import Scene

RESULTS = Path(__file__).parents[1] / "results" / "real_scenes.json"
CACHE = Path("out/real_scenes")


def truth(scene: Scene, views: Iterable[int], size: tuple[int, int], samples: int, seed: int = 0) -> Truth:
    """References of some views, each traced once."""
    settings = TraceSettings(size[1], size[0], scene.radius, samples, seed)
    return trace_views(scene, views, settings, CACHE)


def judge(prediction: Tensor, target: Tensor, valid: Tensor) -> dict[str, Any]:
    """RMSE, PSNR of the mean squared error, mean SSIM of the views, and the pixels and squared error that they are made of."""
    mse = float(ts.metrics.mse(prediction.double(), target.double(), valid))
    return {
        "rmse": round(math.sqrt(mse), 5),
        "psnr": round(-10 * math.log10(mse), 3),
        "ssim": round(float(ts.metrics.ssim(prediction, target, valid)), 4),
        "mse": mse,
        "pixels": int(valid.sum()),
    }


def predict(module: AmbientVisibility, gbuffer: ts.GBuffer) -> Tensor:
    """Images of all views, one at a time."""
    with torch.no_grad():
        return torch.cat([module(gbuffer[view]) for view in range(len(gbuffer))])


class SceneRun:
    """One scene: its G-buffers and references, and the rows of its models."""

    def __init__(self, folder: Path, name: str, file: str, arguments: argparse.Namespace) -> None:
        self.name, self.arguments = name, arguments
        self.scene = scene = ts.scenes.load(folder / file, cameras=folder / "scenes.json")
        (width, height), (fit_width, fit_height) = arguments.size, arguments.fit_size
        views = list(range(1, len(scene.cameras)))
        everything = ts.scenes.render(scene, height=height, width=width)
        self.judged = everything[views]
        self.small = ts.scenes.render(scene, views=0, height=fit_height, width=fit_width)
        self.small_target = truth(scene, [0], arguments.fit_size, arguments.samples).visibility
        self.truth = truth(scene, views, arguments.size, arguments.samples)
        self.wanted, self.valid = self.truth.visibility, self.truth.valid
        self.rows: list[dict[str, Any]] = []
        self.fitted: dict[str, dict[str, float]] = {}

    def add(self, model: str, **facts: Any) -> None:
        self.rows.append({"scene": self.name, "model": model, "samples": self.arguments.samples, **facts})
        shown = " ".join(f"{k} {v}" for k, v in facts.items() if k not in ("mse", "pixels"))
        print(f"{self.name:16} {model:32} {shown}", flush=True)

    def constants(self) -> None:
        """The best constant image, and the one a fit to the training view would give."""
        levels = {
            "constant, best": float(self.wanted[self.valid].mean()),
            "constant, training mean": float(self.small_target[self.small.valid_mask[:, :1]].mean()),
        }
        for model, level in levels.items():
            self.add(model, **judge(torch.full_like(self.wanted, level), self.wanted, self.valid))

    def ceiling(self) -> None:
        """What a perfect model would score: the reference's own noise."""
        views = range(1, len(self.scene.cameras))
        found = noise_ceiling(self.truth, truth(self.scene, views, self.arguments.size, self.arguments.samples, seed=1))
        facts = {"rmse": round(found.rmse, 5), "psnr": round(found.psnr, 3), "ssim": round(found.ssim, 4)}
        self.add("noise ceiling", **facts, mse=found.rmse**2, pixels=int(self.valid.sum()))

    def measure(self, name: str, model: Model) -> None:
        """Fit a model, or take over another's values, and judge it."""
        module, facts = self._fit(name, model)
        image, facts["taps"] = predict(module, self.judged), model.taps
        self.add(name, **judge(image, self.wanted, self.valid), **facts)
        if self.arguments.pictures:
            self._picture(name, image)

    def time(self, names: list[str], rounds: int = 3) -> dict[str, float]:
        """Milliseconds of the first judged view, medians of rounds in which the models take turns, at their default values."""
        modules = {name: MODELS[name].make(self.scene.radius) for name in names}
        times: dict[str, list[float]] = {name: [] for name in names}
        with torch.no_grad():
            for number in range(rounds + 1):
                for name, module in modules.items():
                    start = time.perf_counter()
                    module(self.judged[0])
                    if number:  # the first round allocates
                        times[name].append(1e3 * (time.perf_counter() - start))
        return {name: round(statistics.median(taken), 1) for name, taken in times.items()}

    def _fit(self, name: str, model: Model) -> tuple[AmbientVisibility, dict[str, Any]]:
        module = model.make(self.scene.radius)
        if model.like is not None:
            values = self._values_of(model.like)
            for parameter in MODELS[model.like].parameters or module.used_parameters():
                setattr(module, parameter, values[parameter])
            if not model.refine:
                return module, {"values": values, "like": model.like}
        if model.parameters == ():
            return module, {}
        if model.search:
            self._search(module, model)
        fit = ts.fitting.fit(
            module,
            *(self.small, self.small_target),
            parameters=model.parameters,
            max_evaluations=model.refine or model.evaluations,
            scan=not model.refine,
            progress=False,
        )
        self.fitted[name] = {key: round(value, 5) for key, value in fit.values.items()}
        return fit.module, {"values": self.fitted[name], "training_rmse": round(fit.rmse, 5)}

    def _values_of(self, name: str) -> dict[str, float]:
        """Fitted values of a model, of this run or an earlier one."""
        if name not in self.fitted:
            rows = stored()["rows"]
            key = (self.name, name, self.arguments.samples)
            self.fitted[name] = next(row["values"] for row in rows if _key(row) == key)
        return self.fitted[name]

    def _search(self, module: AmbientVisibility, model: Model) -> None:
        """Set a module to the best of random settings."""
        generator = torch.Generator().manual_seed(0)
        valid = self.small.valid_mask[:, :1]
        start = {name: float(getattr(module, name)) for name in model.parameters or module.used_parameters()}
        best, kept = math.inf, start
        for _ in range(model.search):
            factors = 2 ** (2 * torch.rand(len(start), generator=generator) - 1)
            tried = {name: value * float(f) for (name, value), f in zip(start.items(), factors, strict=True)}
            for name, value in tried.items():
                setattr(module, name, value)
            with torch.no_grad():
                error = float(ts.metrics.rmse(module(self.small), self.small_target, valid))
            if error < best:
                best, kept = error, tried
        for name, value in kept.items():
            setattr(module, name, value)

    def _picture(self, name: str, image: Tensor) -> None:
        """Every judged view: reference, prediction, and half of their difference about grey."""
        rows = torch.cat((self.wanted, image, (0.5 + 0.5 * (image - self.wanted))), 3)[:, 0].flatten(0, 1)
        slug = "".join(c if c.isalnum() else "_" for c in name.lower())
        self.arguments.pictures.mkdir(parents=True, exist_ok=True)
        write(self.arguments.pictures / f"{self.name}_{slug}.png", grey_png(rows))


def keep(rows: list[dict[str, Any]], arguments: argparse.Namespace) -> None:
    """Write the rows beside earlier ones; several runs may write at once."""
    facts = {"environment": environment(), "size": arguments.size, "fit_size": arguments.fit_size}
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        RESULTS.write_text(json.dumps(stored() | facts | {"rows": merge(rows)}, indent=1) + "\n", encoding="utf-8")


def stored() -> dict[str, Any]:
    """What is on disk."""
    return json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {"rows": []}


def merge(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows on disk with these in their place."""
    kept = stored()["rows"]
    new = {_key(row) for row in rows}
    return sorted([row for row in kept if _key(row) not in new] + rows, key=lambda row: row["scene"])


def _key(row: dict[str, Any]) -> tuple[str, str, int]:
    return row["scene"], row["model"], row["samples"]


def _size(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="*")
    parser.add_argument("--models", nargs="*", default=["techniques"])
    parser.add_argument("--size", type=_size, default=(480, 360))
    parser.add_argument("--fit-size", type=_size, default=(240, 180))
    parser.add_argument("--samples", type=int, default=1024)
    parser.add_argument("--pictures", type=Path, help="folder for a picture a scene and model")
    parser.add_argument("--times", action="store_true", help="time the models on the first scene, measure nothing else")
    parser.add_argument("--summary", action="store_true", help="print the tables of earlier rows, measure nothing")
    return parser.parse_args()


def main() -> None:
    arguments = _arguments()
    known = json.loads((arguments.folder / "scenes.json").read_text(encoding="utf-8"))
    names = [name for given in arguments.models for name in GROUPS.get(given, (given,))]
    scenes = arguments.scenes or list(known)
    if arguments.times:
        run = SceneRun(arguments.folder, scenes[0], known[scenes[0]]["file"], arguments)
        times = {"scene": scenes[0], "environment": environment(), "ms": run.time(names)}
        RESULTS.write_text(json.dumps(stored() | {"times": times}, indent=1) + "\n", encoding="utf-8")
    for name in () if arguments.summary or arguments.times else scenes:
        run = SceneRun(arguments.folder, name, known[name]["file"], arguments)
        run.constants()
        run.ceiling()
        for model in names:
            run.measure(model, MODELS[model])
            keep(run.rows, arguments)
    rows = [row for row in stored()["rows"] if row["samples"] == arguments.samples]
    print(summarise(rows, stored().get("times", {}).get("ms", {})))


if __name__ == "__main__":
    main()
