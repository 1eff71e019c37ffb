"""The table of the ray-marched paper: Mittring, Filion, the paper's method, ray tracing with 512 samples."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch_ssao as ts
from benchmarks.paper_tables.common import Case, times, values_of
from benchmarks.peers import Crytek, StarCraft
from torch_ssao.modules import AmbientVisibility

SAMPLES = 16  # the paper's, of every technique
STEPS = 8
DENOISE = 1  # pass of the same filter, for every technique

PAPER = {  # milliseconds and SSIM against its ray tracing, as printed; a built-in scene stands for the street
    "temple": {"Mittring": (15, 0.65), "Filion": (38, 0.72), "ours": (70, 0.85), "ray-traced": (351000, None)},
    "sibenik": {"Mittring": (14, 0.73), "Filion": (40, 0.77), "ours": (77, 0.87), "ray-traced": (238000, None)},
    "street": {"Mittring": (13, 0.68), "Filion": (16, 0.76), "ours": (47, 0.85), "ray-traced": (220000, None)},
}


@dataclass(frozen=True)
class Entry:
    """A technique of the table.

    Args:
        published: a module of the scene's radius as it was published. start: where the fit begins.
        parameters: to fit.
    """

    published: Callable[[float], AmbientVisibility]
    start: Callable[[float], AmbientVisibility]
    parameters: tuple[str, ...]


ENTRIES = {
    "Mittring": Entry(
        lambda radius: Crytek(radius, samples=SAMPLES, denoise=DENOISE),
        lambda radius: Crytek(radius, samples=SAMPLES, reach=1.0, denoise=DENOISE),
        ("radius", "strength", "reach", "contrast"),
    ),
    "Filion": Entry(
        lambda radius: StarCraft(radius, samples=SAMPLES, denoise=DENOISE),
        lambda radius: StarCraft(radius, samples=SAMPLES, denoise=DENOISE),
        ("radius", "strength", "full", "fade", "contrast"),
    ),
    "ours": Entry(
        lambda radius: ts.RayMarchedSSAO(radius, rays=SAMPLES, steps=STEPS, thickness=None, denoise=DENOISE),
        lambda radius: ts.RayMarchedSSAO(radius, rays=SAMPLES, steps=STEPS, denoise=DENOISE),
        ("radius", "falloff", "thickness", "contrast"),
    ),
}


def rows(case: Case) -> list[dict[str, Any]]:
    """Rows of one scene."""
    found: list[dict[str, Any]] = []
    published = {name: entry.published(case.radius) for name, entry in ENTRIES.items()}
    fitted = {name: case.fit(entry.start(case.radius), entry.parameters) for name, entry in ENTRIES.items()}
    taken = dict(zip(ENTRIES, case.time(list(fitted.values())), strict=True))
    paper = PAPER.get(case.name, {})
    for name, entry in ENTRIES.items():
        image, plain = case.predict(fitted[name]), case.predict(published[name])
        case.picture(f"{name} fitted", image)
        case.picture(f"{name} published", plain)
        row = {"scene": case.name, "technique": name, **taken[name], **case.judge(image)}
        row |= {"published": case.judge(plain), "values": values_of(fitted[name], entry.parameters)}
        found.append(row | _paper(paper.get(name)))
    image = case.traced()
    case.picture("ray-traced", image)
    low, median, high = statistics.quantiles(case.traced_ms, n=4)
    spread = {"median_ms": median, "q1_ms": low, "q3_ms": high, "repeats": len(case.traced_ms)}
    score = case.judge(image)
    found.append({"scene": case.name, "technique": "ray-traced", **spread, **score} | _paper(paper.get("ray-traced")))
    found.append({"scene": case.name, "technique": "constant", **case.judge(case.constant())})
    found.append({"scene": case.name, "technique": "ceiling", **_ceiling(case, score["ssim"])})
    return found


def _ceiling(case: Case, ssim: float) -> dict[str, float]:
    """What a perfect image would score: the reference's own noise.

    The ray-traced row differs from the reference by the noise of both, and 1 - SSIM is proportional to the variance while
    that is small: the reference's share of it is what is left for a perfect image.
    """
    valid = case.truth.valid
    own = float(case.truth.standard_error[valid].double().square().mean())
    other = float(case.traced_error[valid].double().square().mean())
    return {"rmse": own**0.5, "ssim": 1 - (1 - ssim) * own / (own + other)}


def _paper(printed: tuple[float, float | None] | None) -> dict[str, Any]:
    return {} if printed is None else {"paper_ms": printed[0], "paper_ssim": printed[1]}


def table(found: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| scene | technique | ms, median [quartiles] | RMSE fitted | SSIM fitted | RMSE, SSIM as published | paper: ms / SSIM |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in found:
        taken = times(row) if "median_ms" in row else ""
        plain = row.get("published")
        untuned = f"{plain['rmse']:.4f}, {plain['ssim']:.3f}" if plain else ""
        printed = f"{row['paper_ms']} / {row['paper_ssim'] or '-'}" if "paper_ms" in row else ""
        lines.append(
            f"| {row['scene']} | {row['technique']} | {taken} | {row['rmse']:.4f} | {row['ssim']:.3f} | {untuned} | {printed} |"
        )
    return "\n".join(lines)
