"""Figures 11 to 15 of the StatVO paper: point sampling, line sampling and SAO at the time that StatVO takes.

Each technique is fitted to view 0, the peers with `FITTED` samples: what they estimate does not depend on the count. A limit is
the same formula with the same values and many samples, without a filter: for the peers `LIMIT` of them, for StatVO 256
columns through its own box (Fig. 13).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from benchmarks.paper_tables.common import Case, times, values_of
from benchmarks.peers import SAO, Crytek, LineSampled
from benchmarks.statvo_claims.obscurance import point_sampled
from torch_ssao.modules import AmbientVisibility

LAYERS = 4
LIMIT = 512
FITTED = 32
MOST = 256
TRIAL = (8, 32)  # counts whose times show what a sample costs

STATVO = {  # the paper's, and this library's default
    "StatVO, 1/4 SATs (Figs. 11, 12, 14, 15)": {"sat_scale": 4, "quadrants": False},
    "StatVO, full SATs (Fig. 13)": {"sat_scale": 1, "quadrants": False},
    "StatVO, quadrants": {"sat_scale": 1, "quadrants": True},
}
STATVO_FITTED = ("radius", "height", "falloff", "contrast")


@dataclass(frozen=True)
class Peer:
    """A technique with a count.

    Args:
        make: a module from radius, samples and passes of the filter.
        parameters: to fit.
        counts: that the paper shows it with.
    """

    make: Callable[[float, int, int], AmbientVisibility]
    parameters: tuple[str, ...]
    counts: tuple[int, ...]


PEERS = {
    "point sampling": Peer(
        lambda radius, samples, denoise: Crytek(radius, samples=samples, reach=1.0, denoise=denoise),
        ("radius", "strength", "reach", "contrast"),
        (17,),
    ),
    "line sampling": Peer(
        lambda radius, samples, denoise: LineSampled(radius, samples=samples, thickness=1.0, denoise=denoise),
        ("radius", "strength", "thickness", "contrast"),
        (12,),
    ),
    "SAO": Peer(
        lambda radius, samples, denoise: SAO(radius, samples=samples, denoise=denoise),
        ("radius", "strength", "bias", "contrast"),
        (11,),
    ),
}


def rows(case: Case) -> list[dict[str, Any]]:
    """Rows of one scene: StatVO's, then each peer with the paper's counts and those of equal time."""
    statvo = {name: ts.StatVO(case.radius, layers=LAYERS, **options) for name, options in STATVO.items()}
    fitted = {name: case.fit(module, STATVO_FITTED) for name, module in statvo.items()}
    counts = equal_counts(case, list(fitted.values()))
    modules: dict[str, tuple[str, int, AmbientVisibility]] = {}
    for name, peer in PEERS.items():
        values = values_of(case.fit(peer.make(case.radius, FITTED, 1), peer.parameters), peer.parameters)
        wanted = dict.fromkeys(peer.counts, "the paper's count")
        for like, count in zip(fitted, counts[name], strict=True):
            wanted[count] = f"as long as {like}"
        for count, why in wanted.items():
            modules[f"{name}, {count}: {why}"] = (name, count, _with(peer.make(case.radius, count, 1), values))
    everything = list(fitted.values()) + [module for _, _, module in modules.values()]
    taken = case.time(everything)
    found: list[dict[str, Any]] = []
    limits: dict[str, Tensor] = {}
    for (name, module), spent in zip(fitted.items(), taken, strict=False):
        facts = {"technique": name, "values": values_of(module, STATVO_FITTED)}
        found.append(_row(case, facts, module, _statvo_limit(case, module), spent))
    for (label, (name, count, module)), spent in zip(modules.items(), taken[len(fitted) :], strict=True):
        values = values_of(module, PEERS[name].parameters)
        if name not in limits:
            limits[name] = case.predict(_with(PEERS[name].make(case.radius, LIMIT, 0), values))
        facts = {"technique": label, "samples": count, "values": values}
        found.append(_row(case, facts, module, limits[name], spent))
    found.append({"scene": case.name, "technique": "constant", **case.judge(case.constant())})
    return found


def equal_counts(case: Case, statvo: list[AmbientVisibility]) -> dict[str, list[int]]:
    """For each peer the count whose time is nearest to each StatVO's, by what a sample costs."""
    trials = [peer.make(case.radius, count, 1) for peer in PEERS.values() for count in TRIAL]
    taken = [spent["median_ms"] for spent in case.time(statvo + trials)]
    goals, rest = taken[: len(statvo)], taken[len(statvo) :]
    few, many = TRIAL
    result = {}
    for place, name in enumerate(PEERS):
        first, second = rest[2 * place : 2 * place + 2]
        each = max((second - first) / (many - few), 1e-6)
        result[name] = [min(max(1, round(few + (goal - first) / each)), MOST) for goal in goals]
    return result


def _row(
    case: Case, facts: dict[str, Any], module: AmbientVisibility, limit: Tensor, spent: dict[str, float]
) -> dict[str, Any]:
    image = case.predict(module)
    case.picture(facts["technique"], image)
    scores = {"limit": case.judge(image, limit), "limit_to_reference": case.judge(limit)}
    return {"scene": case.name, **facts, **spent, **case.judge(image), **scores}


def _with(module: AmbientVisibility, values: dict[str, float]) -> AmbientVisibility:
    for name, value in values.items():
        setattr(module, name, value)
    return module


def _statvo_limit(case: Case, module: AmbientVisibility) -> Tensor:
    values = values_of(module, STATVO_FITTED)
    radius = values.pop("radius")
    return torch.cat([point_sampled(case.judged[view], radius, **values) for view in range(len(case.judged))])


def table(found: list[dict[str, Any]]) -> str:
    """Markdown: RMSE at the longest StatVO's time, then everything."""
    return f"{_summary(found)}\n\n{_everything(found)}"


def _summary(found: list[dict[str, Any]]) -> str:
    longest = list(STATVO)[-1]
    scenes = list(dict.fromkeys(row["scene"] for row in found))
    lines = ["| RMSE | " + " | ".join(scenes) + " |", "|---|" + "---|" * len(scenes)]
    for label in [*STATVO, *(f"{name}, as long as {longest}" for name in PEERS), "constant"]:
        name, _, suffix = label.partition(", as")
        cells = [
            f"{row['rmse']:.4f}"
            for row in found
            if row["technique"].startswith(name) and row["technique"].endswith(suffix)
        ]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _everything(found: list[dict[str, Any]]) -> str:
    lines = [
        "| scene | technique | ms, median [quartiles] | RMSE | PSNR | SSIM | RMSE, SSIM to its own limit | RMSE of that limit |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in found:
        taken = times(row) if "median_ms" in row else ""
        limit = f"{row['limit']['rmse']:.4f}, {row['limit']['ssim']:.3f}" if "limit" in row else ""
        its = f"{row['limit_to_reference']['rmse']:.4f}" if "limit" in row else ""
        lines.append(
            f"| {row['scene']} | {row['technique']} | {taken} | {row['rmse']:.4f} | {row['psnr']:.1f} "
            f"| {row['ssim']:.3f} | {limit} | {its} |"
        )
    return "\n".join(lines)
