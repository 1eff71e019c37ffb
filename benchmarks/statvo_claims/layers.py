"""How many layers: adaptive against uniform, error by layers, coarser tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

import torch_ssao as ts
from benchmarks.statvo_claims.common import (
    Candidate,
    Case,
    Run,
    builtin_case,
    fitted,
    median_footprint,
    medians_ms,
    visibility,
)
from benchmarks.statvo_claims.obscurance import point_sampled
from benchmarks.statvo_claims.pictures import curves, strip

FIT_HEIGHT = 120
TIME_HEIGHT = 240
SCALE_HEIGHTS = (240, 480)
SHOWN = ("temple", "pipes")  # of the coarse tables: little and much harm
DEMANDED = ("temple", "street")
ADAPTIVE = tuple(Candidate(n) for n in (1, 2, 4, 8))
UNIFORM = tuple(Candidate(n, "uniform") for n in (4, 16, 64))
QUADRANTS = (Candidate(4, quadrants=True), Candidate(64, "uniform", quadrants=True))
FOUR, SIXTY_FOUR = ADAPTIVE[2], UNIFORM[2]


def layers(run: Run) -> tuple[list[dict[str, Any]], str]:
    """Four adaptive layers against 64 uniform: error against point-sampled obscurance and against rays, and time."""
    rows: list[dict[str, Any]] = []
    for name in run.scenes:
        train, test = builtin_case(name, 0, FIT_HEIGHT), builtin_case(name, 1, FIT_HEIGHT)
        obscurance = [point_sampled(c.gbuffer, c.radius) for c in (train, test)]
        times = _times(name, repeats=5)
        for candidate, took in zip(_every(name), times, strict=True):
            plain = candidate.build(train.radius)
            row = {"scene": name} | candidate.row() | {"time": took}
            row["vo_unfitted"] = [
                c.error(visibility(plain, c.gbuffer), o) for c, o in zip((train, test), obscurance, strict=True)
            ]
            targets = {"vo_fitted": obscurance, "rays_fitted": [train.truth, test.truth.visibility]}
            if candidate in QUADRANTS:
                del targets["vo_fitted"]
            for key, (target, judge) in targets.items():
                module, error = fitted(candidate, train, target)
                row[key] = [error, test.error(visibility(module, test.gbuffer), judge)]
                row[f"{key}_values"] = module.values()
            rows.append(row)
            _print_layers(row)
    rows = run.joined(rows)
    if {row["scene"] for row in rows} >= set(DEMANDED):
        _layers_picture(run, rows)
    return rows, _layers_statement(rows)


def _every(scene: str) -> tuple[Candidate, ...]:
    return (
        *ADAPTIVE,
        *UNIFORM,
        *(QUADRANTS if scene in DEMANDED else ()),
    )  # 64 layers of quadrants take minutes to fit


def _times(name: str, repeats: int) -> list[dict[str, float]]:
    where = builtin_case(name, 0, TIME_HEIGHT)
    return medians_ms(_renders([candidate.build(where.radius) for candidate in _every(name)], where), repeats)


def _print_layers(row: dict[str, Any]) -> None:
    def pair(key: str) -> str:
        return " ".join(f"{error:.4f}" for error in row.get(key, ()))

    print(
        f"{row['scene']:7} {row['layers']:3} {row['layering']:8} {row['quadrants']:1} vo plain {pair('vo_unfitted')}"
        f"  vo fitted {pair('vo_fitted')}  rays {pair('rays_fitted')}  {row['time']['median_ms']:.0f} ms",
        flush=True,
    )


def _pick(rows: list[dict[str, Any]], scene: str, candidate: Candidate) -> dict[str, Any]:
    return next(r for r in rows if r["scene"] == scene and r.items() >= candidate.row().items())


def _layers_statement(rows: list[dict[str, Any]]) -> str:
    parts = []
    for name in dict.fromkeys(row["scene"] for row in rows):
        few, many = _pick(rows, name, FOUR), _pick(rows, name, SIXTY_FOUR)
        ratios = {key: few[key][0] / many[key][0] for key in ("vo_unfitted", "vo_fitted", "rays_fitted")}
        held = {key: few[key][1] / many[key][1] for key in ("vo_fitted", "rays_fitted")}
        speed = many["time"]["median_ms"] / few["time"]["median_ms"]
        parts.append(
            f"{name}: error of 4 adaptive over 64 uniform {ratios['vo_unfitted']:.2f} (obscurance, same parameters), "
            f"{ratios['vo_fitted']:.2f} (obscurance, fitted; other view {held['vo_fitted']:.2f}), "
            f"{ratios['rays_fitted']:.2f} (rays, fitted; other view {held['rays_fitted']:.2f}), {speed:.1f} times faster"
        )
        if name in DEMANDED:
            four = _pick(rows, name, QUADRANTS[0])
            parts[-1] += (
                f"; with quadrants {four['vo_unfitted'][0] / many['vo_unfitted'][0]:.2f} (obscurance, same parameters), "
                f"{four['rays_fitted'][0] / many['rays_fitted'][0]:.2f} (rays, fitted; other view "
                f"{four['rays_fitted'][1] / many['rays_fitted'][1]:.2f}), "
                f"{many['time']['median_ms'] / four['time']['median_ms']:.1f} times faster than 64 uniform of one region"
            )
    return "; ".join(parts)


def _layers_picture(run: Run, rows: list[dict[str, Any]]) -> None:
    """Temple and street: one layer, 64 uniform, four adaptive without and with quadrants, rays."""
    lines = []
    for name in DEMANDED:
        where = builtin_case(name, 0, FIT_HEIGHT)
        line = []
        for candidate in (ADAPTIVE[0], SIXTY_FOUR, FOUR, QUADRANTS[0]):
            values = _pick(rows, name, candidate)["rays_fitted_values"]
            module = candidate.build(**values)
            image = visibility(module, where.gbuffer)
            line.append((f"{candidate.label}, RMSE {where.error(image):.3f}", image))
        lines.append([*line, ("ray-traced", where.truth.visibility)])
    strip(
        run.figures / "statvo_layers.png", lines, names=DEMANDED, title="fitted to the rays (height, falloff, contrast)"
    )


def monotone(run: Run) -> tuple[list[dict[str, Any]], str]:
    """Fitted error against rays for 1, 2, 4 layers, one region and quadrants, every built-in scene."""
    rows, words = [], []
    panels: dict[str, dict[str, tuple[list[float], list[float]]]] = {"one region": {}, "quadrants": {}}
    for name in ts.scenes.names():
        train, test = builtin_case(name, 0, FIT_HEIGHT), builtin_case(name, 1, FIT_HEIGHT)
        for quadrants in (False, True):
            errors = []
            for count in (1, 2, 4):
                module, error = fitted(Candidate(count, quadrants=quadrants), train)
                errors.append(error)
                row = {"scene": name, "layers": count, "quadrants": quadrants, "rmse": error}
                row["rmse_other_view"] = test.error(visibility(module, test.gbuffer))
                row["constant_rmse"] = _constant(train)
                rows.append(row | {"values": module.values()})
            falls = errors[0] > errors[1] > errors[2]
            kind = "quadrants" if quadrants else "one region"
            words.append(f"{name} ({kind}): {' > '.join(f'{e:.4f}' for e in errors) if falls else _not(errors)}")
            print(words[-1], flush=True)
            panels[kind][name] = ([1, 2, 4], errors)
    x, y = "adaptive layers", "fitted RMSE against rays"
    curves(run.figures / "statvo_monotone.png", panels, x=x, y=y, log_x=True)
    return rows, "; ".join(words)


def _not(errors: list[float]) -> str:
    return "does not fall: " + ", ".join(f"{e:.4f}" for e in errors)


def _constant(where: Case) -> float:
    """RMSE of the best constant image: the floor that a technique has to beat."""
    return float(where.truth.visibility[where.valid].std(correction=0))


def scale(run: Run) -> tuple[list[dict[str, Any]], str]:
    """Tables of half and quarter resolution: error against full ones, against obscurance and against rays, and time."""
    rows, words, lines = [], [], []
    for name in ts.scenes.names():
        values = fitted(FOUR, builtin_case(name, 0, FIT_HEIGHT))[0].values()
        for height in SCALE_HEIGHTS:
            mine, images = _scales(name, height, values)
            rows += mine
            words.append(_scale_words(name, height, mine))
            print(words[-1], flush=True)
            if name in SHOWN and height == SCALE_HEIGHTS[0]:
                where = builtin_case(name, 0, height)
                captions = ("full SATs", "half", "quarter")
                line = [(f"{c}, RMSE {r['rmse_rays']:.3f}", i) for c, r, i in zip(captions, mine, images, strict=True)]
                lines.append([*line, ("ray-traced", where.truth.visibility)])
    strip(run.figures / "statvo_scale.png", lines, names=SHOWN, title="four adaptive layers, 320 x 240")
    return rows, "; ".join(words)


def _scales(name: str, height: int, values: dict[str, float]) -> tuple[list[dict[str, Any]], list[Tensor]]:
    where = builtin_case(name, 0, height)
    obscurance = point_sampled(where.gbuffer, **values)
    modules = [Candidate(4, sat_scale=s).build(**values) for s in (1, 2, 4)]
    images = [visibility(m, where.gbuffer) for m in modules]
    rows = []
    for s, image, took in zip((1, 2, 4), images, medians_ms(_renders(modules, where), 5), strict=True):
        row = {"scene": name, "height": height, "sat_scale": s, "footprint_px": median_footprint(where), "time": took}
        row |= {"rmse_full": where.error(image, images[0]), "rmse_vo": where.error(image, obscurance)}
        rows.append(row | {"rmse_rays": where.error(image), "worst_full": float((image - images[0]).abs().max())})
    return rows, images


def _scale_words(name: str, height: int, rows: list[dict[str, Any]]) -> str:
    one, two, four = rows
    faster = [one["time"]["median_ms"] / r["time"]["median_ms"] for r in (two, four)]
    return (
        f"{name}, {height} rows: half and quarter differ from full by {two['rmse_full']:.4f} and {four['rmse_full']:.4f} "
        f"RMSE; against rays {', '.join(format(r['rmse_rays'], '.4f') for r in rows)}; against obscurance "
        f"{', '.join(format(r['rmse_vo'], '.4f') for r in rows)}; {faster[0]:.1f} and {faster[1]:.1f} times faster"
    )


def _renders(modules: list[ts.StatVO], where: Case) -> list[Callable[[], Tensor]]:
    return [lambda m=m: visibility(m, where.gbuffer) for m in modules]
