"""What horizons and rays reach in the limit, and with few taps: `python -m benchmarks.limits [SECTION ...]`.

Sections, each a table here and a list of rows in results/limits.json with the environment it was made in:
closed_forms - 64 slices x 64 steps, and 1,024 rays x 64 steps, against exact visibility, over scenes, views and cameras,
    at pixels about which the depth map decides (tests/support/limits.py says what is left out, and why);
few_taps - a wall seen at 20, 45 and 70 degrees with 3 slices, radius and falloff tuned over the three together: RMSE of
    the mean along the wall over frames, of single frames, and pixel by pixel;
taps - mean visibility of the built-in scenes from 4 x 4 to 16 x 32 taps;
gradients - derivative of the mean to the radius beside central differences over the same frames.
"""

from __future__ import annotations

import itertools
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from torch_ssao.report.environment import environment

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.clutter import clutter
from support.limits import ANGLES, EXPONENTS, HORIZON_FORMS, KINDS, SCENES, LimitCase
from support.wall_profile import WallProfile

RESULTS = Path(__file__).parent / "results" / "limits.json"
TAPS = ((4, 4), (4, 8), (8, 8), (8, 16), (16, 32))
Row = dict[str, Any]


def closed_forms() -> list[Row]:
    """A row a scene and camera."""
    views = [*((name, kind) for name in SCENES for kind in KINDS), ("ceiling", "120")]
    with ProcessPoolExecutor(max_workers=2) as pool:
        return list(pool.map(closed_form_row, views))


def closed_form_row(view: tuple[str, str]) -> Row:
    """Largest and mean error over the pixels of all view angles, by form."""
    torch.set_num_threads(1)
    name, kind = view
    if name == "ceiling":
        cases = {90.0: LimitCase.between_plates()}
    else:
        size = 576 if kind == "120" else 384
        cases = {angle: LimitCase.of(name, angle, kind, size=size) for angle in ANGLES}
    cases = {angle: case for angle, case in cases.items() if case.pixels}
    row: Row = {"scene": name, "camera": kind, "angles": list(cases)}
    row["pixels"] = sum(len(case.pixels) for case in cases.values())
    errors = {form: [case.horizon(form) for case in cases.values()] for form in HORIZON_FORMS}
    errors |= {f"rays, {falloff}": [case.marched(falloff) for case in cases.values()] for falloff in EXPONENTS}
    for form, parts in errors.items():
        every = torch.cat([torch.zeros(0, dtype=torch.float64), *parts])
        if len(every):
            row[form] = {"largest": round(float(every.abs().max()), 5), "mean": round(float(every.mean()), 5)}
    found = "  ".join(f"{form} {row[form]['largest']:.4f}/{row[form]['mean']:+.4f}" for form in errors if form in row)
    print(f"{name:13} {kind:13} {row['pixels']:3} {row['angles']} {found}", flush=True)
    return row


FEW: dict[str, dict[str, Any]] = {
    "bitmask": {"connected": False},
    "bitmask, connected": {},
    "increments": {"estimator": "increments"},
}


def few_taps() -> list[Row]:
    """Grid over the radius multiplier (and falloff) on one frame, judged on the 8 frames after it."""
    wall, rows = WallProfile(), []
    for (form, options), steps, power in itertools.product(FEW.items(), (3, 6), (1.0, 1.3)):
        given = options | {"slices": 3, "steps": steps, "step_power": power}
        exponents = (2.0, 8.0, 30.0, 100.0) if form == "increments" else (1.0,)
        tried = itertools.product((1.0, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.35, 1.45), exponents)
        best = min(tried, key=lambda pair: wall.rmse(range(1), radius=pair[0], falloff=pair[1], **given)[1])
        untuned = wall.rmse(range(1, 9), radius=1.0, falloff=exponents[-1], **given)
        tuned = wall.rmse(range(1, 9), radius=best[0], falloff=best[1], **given)
        names = ("mean", "single_frame", "pixel")
        row: Row = {"form": form, "slices": 3, "steps": steps, "step_power": power, "radius_multiplier": best[0]}
        row |= {"falloff": best[1]} if form == "increments" else {}
        row |= {name: round(value, 4) for name, value in zip(names, tuned, strict=True)}
        row |= {f"{name}_untuned": round(value, 4) for name, value in zip(names, untuned, strict=True)}
        rows.append(row)
        print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    return rows


def taps() -> list[Row]:
    """Mean visibility by taps, and its range from 4 x 4, 4 x 8 and 8 x 8 on."""
    forms: dict[str, dict[str, Any]] = {
        "increments, falloff 1": {"estimator": "increments", "falloff": 1.0},
        "increments, falloff 2": {"estimator": "increments", "falloff": 2.0},
        "increments, falloff 8": {"estimator": "increments", "falloff": 8.0},
        "bitmask, connected": {},
    }
    rows = []
    for name, view in itertools.product(ts.scenes.names(), (0, 3)):
        scene = ts.scenes.builtin(name)
        gb = ts.scenes.render(scene, views=view, height=72, width=96)
        for form, options in forms.items():
            nets = [ts.HBAO(scene.radius, slices=s, steps=k, **options) for s, k in TAPS]
            means = [round(float(net(gb)[gb.valid_mask].mean()), 5) for net in nets]
            spread = {f"range_from_{s}x{k}": max(means[i:]) - min(means[i:]) for i, (s, k) in enumerate(TAPS[:3])}
            rows.append({"scene": name, "view": view, "form": form, "means": means} | spread)
            shown = " ".join(f"{m:.4f}" for m in means)
            print(f"{name:7} {view} {form:22} {shown}  " + " ".join(f"{s:.4f}" for s in spread.values()), flush=True)
    return rows


def gradients(step: float = 0.07, frames: int = 32) -> list[Row]:
    """R d mean / dR of the gradient, and of differences over the same frames; not over the step that is differenced inside."""
    gb, rows, radius = clutter(48, 64).to(torch.float64), [], 0.6
    modules: dict[str, tuple[type, dict[str, Any]]] = {}
    for weighting in ("cosine", "uniform"):
        base: dict[str, Any] = {"weighting": weighting, "slices": 2, "steps": 3, "thickness": 0.4}
        modules[f"increments, {weighting}"] = (ts.HBAO, base | {"estimator": "increments", "falloff": 2.5})
        for connected in (False, True):
            name = f"bitmask, {'connected, ' if connected else ''}{weighting}"
            modules[name] = (ts.HBAO, base | {"connected": connected})
    for gradient in ("exact", "surrogate"):
        modules[f"rays, {gradient}"] = (ts.RayMarchedSSAO, {"rays": 8, "steps": 8, "gradient": gradient})
    for name, (build, options) in modules.items():
        net = build(radius, learnable=("radius",), **options).double()
        ends = [build(radius * (1 + sign * step), **options).double() for sign in (1, -1)]
        per_raw = float(torch.autograd.grad(net.radius, net.raw_radius)[0]) / radius
        slopes, differences = [], []
        for frame in range(frames):
            slopes.append(float(torch.autograd.grad(net(gb, frame=frame).mean(), net.raw_radius)[0]) / per_raw)
            with torch.no_grad():
                further, nearer = (float(end(gb, frame=frame).mean()) for end in ends)
            differences.append((further - nearer) / (2 * step))
        slope, difference = (sum(values) / frames for values in (slopes, differences))
        spread = float(torch.tensor(slopes).std()) / frames**0.5
        rows.append({
            "form": name, "gradient": slope, "differences": difference, "ratio": slope / difference,
            "standard_error_of_gradient": spread, "frames": frames, "step": step,
        })  # fmt: skip
        print(f"{name:28} {slope:+.5f} +- {spread:.5f}, differences {difference:+.5f}, ratio {slope / difference:.4f}")
    return rows


SECTIONS = {"closed_forms": closed_forms, "few_taps": few_taps, "taps": taps, "gradients": gradients}


def main() -> None:
    """Make and store the sections named on the command line, or all."""
    torch.set_num_threads(1)
    for name in sys.argv[1:] or SECTIONS:
        print(f"\n{name}")
        rows = SECTIONS[name]()
        stored = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        stored[name] = {"environment": environment(), "rows": rows}
        RESULTS.write_text(json.dumps({k: stored[k] for k in SECTIONS if k in stored}, indent=1) + "\n")


if __name__ == "__main__":
    main()
