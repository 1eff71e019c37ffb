"""What choosing a model for a scene costs, and what warm starts save and lose: `python -m benchmarks.sweep_cost`.

For each built-in scene: seconds of rendering, tracing, all fits and all timings of one `select`, with warm starts and, for
those of `--cold`, with a scan for every candidate. An interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao.fitting import Choice, candidates, select
from torch_ssao.fitting.candidates import Candidate
from torch_ssao.report.environment import environment

SCENES = 1000


def grid(radius: float) -> list[Candidate]:
    """Eight candidates of two techniques."""
    return candidates.statvo(radius, layers=[1, 2, 4, 8]) + candidates.hbao(radius, slices=[1, 2], steps=[3, 6])


def clocked(work: Callable[[], Any]) -> tuple[Any, float]:
    """A result and its seconds."""
    start = time.perf_counter()
    found = work()
    return found, time.perf_counter() - start


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """One scene."""
    scene = ts.scenes.builtin(name)
    size = {"height": options.height, "width": options.height * 4 // 3}
    gbuffer, rendering = clocked(lambda: ts.scenes.render(scene, **size))
    truth, tracing = clocked(lambda: ts.reference.raytrace(scene, **size, samples=options.samples, progress=False))
    timing = 0.0

    def timer(modules: Any, view: ts.GBuffer) -> Any:
        nonlocal timing
        found, timing = clocked(lambda: ts.fitting.timing.time_forward(modules, view))
        return found

    row: dict[str, Any] = {"scene": name, "views": len(gbuffer), "rendering_s": rendering, "tracing_s": tracing}
    for label, warm in (("warm", True), ("cold", False)):
        if warm or name in options.cold:
            folder = options.work / f"{name}_{options.height}_{label}"
            choice = select(grid(scene.radius), gbuffer, truth, warm_start=warm, folder=folder, timer=timer)
            row[label] = summary(choice) | {"timing_s": timing}
    return row


def summary(choice: Choice) -> dict[str, Any]:
    """Seconds, evaluations and errors of one choice."""
    return {
        "fitting_s": sum(row.seconds for row in choice.table),
        "evaluations": sum(row.evaluations for row in choice.table),
        "chosen": choice.best.name,
        "reason": choice.reason,
        "validation": {row.name: row.validation_rmse for row in choice.table},
        "training": {row.name: row.training_rmse for row in choice.table},
        "ms": {row.name: row.ms for row in choice.table},
    }


def tables(rows: list[dict[str, Any]]) -> list[str]:
    """Markdown for docs/scale.md and docs/select.md."""
    lines = ["| scene | views | render | trace | fit | time | chosen |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        warm = row["warm"]
        seconds = (row["rendering_s"], row["tracing_s"], warm["fitting_s"], warm["timing_s"])
        lines.append(
            f"| {row['scene']} | {row['views']} | {' | '.join(f'{s:.2f} s' for s in seconds)} | {warm['chosen']} |"
        )
    scene = sum(r["rendering_s"] + r["tracing_s"] + r["warm"]["fitting_s"] for r in rows) / len(rows)
    serial = sum(r["warm"]["timing_s"] for r in rows) / len(rows)
    lines.append("")
    for workers in (1, 16, 256):
        hours = SCENES * (scene / workers + serial) / 3600
        lines.append(
            f"{SCENES} scenes on {workers} cores: {hours:.2f} h, of which {SCENES * serial / 3600:.2f} h timing."
        )
    for row in rows:
        if "cold" in row:
            lines += ["", *comparison(row)]
    return lines


def comparison(row: dict[str, Any]) -> list[str]:
    """What warm starts save and lose on one scene, candidate by candidate."""
    warm, cold = row["warm"], row["cold"]
    lines = [
        f"{row['scene']}: warm {warm['evaluations']} evaluations, {warm['fitting_s']:.0f} s, {warm['chosen']}; "
        f"cold {cold['evaluations']}, {cold['fitting_s']:.0f} s, {cold['chosen']}.",
        "",
        "| candidate | validation RMSE, warm | cold | training RMSE, warm | cold |",
        "|---|---|---|---|---|",
    ]
    for name in warm["validation"]:
        figures = [side[kind][name] for kind in ("validation", "training") for side in (warm, cold)]
        lines.append(f"| {name} | {' | '.join(f'{value:.4f}' for value in figures)} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=["temple", "street"], choices=ts.scenes.names())
    parser.add_argument("--height", type=int, default=60)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--cold", nargs="*", default=[], choices=ts.scenes.names(), help="scenes to fit with scans too")
    parser.add_argument("--work", type=Path, default=Path("out/bench/sweep_cost"))
    parser.add_argument("--out", type=Path, default=Path("out/bench/sweep_cost.json"))
    options = parser.parse_args()
    torch.set_num_threads(1)  # a scene a core
    rows = [measure(name, options) for name in options.scenes]
    print("\n".join(tables(rows)))
    facts = {"height": options.height, "samples": options.samples, "environment": environment(), "rows": rows}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
