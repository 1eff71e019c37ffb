"""StatVO's speed and memory by what it can be asked for: `python -m benchmarks.statvo_speed [PART ...]`.

The oracle tests run first: no time is reported on a red gate. Within a part works take turns; times are medians with the range in
brackets, and ratios are of medians of one run. "paper" marks what the paper reports for the same change on its GPU. Parts:
"""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from benchmarks.statvo_memory import peak_bytes
from benchmarks.timing import interleaved, shown
from torch_ssao.ops import sat, statvo_obscurance
from torch_ssao.report.environment import environment

SCENES = ("temple", "street")
SMALL = (512, 384)
LAYERS = (1, 2, 4, 8, 16)
MODES = ("forward", "forward_backward")
FOOTPRINTS = (10, 25, 50, 100, 200)  # median half-size of the window in pixels
SCALES = (1, 2, 4)
PLAIN = {"layering": "adaptive", "quadrants": False, "sat_scale": 1, "gradient": "exact"}
PAPER = {  # at 1280 x 720 on a GTX 770
    "table at half resolution": 4.4,  # Table 1, root SAT
    "total at half resolution": 4.1,  # Table 1
    "quadrants": (1.25, 1.40),  # Sec. 4, "25% to 40%"
    "64 uniform / 4 adaptive layers": 55 / 23,  # Fig. 6 e and f
}
Row = dict[str, Any]
Work = Callable[[], Any]


@functools.cache
def view(scene: str, width: int, height: int) -> tuple[ts.GBuffer, float]:
    """The first view of a built-in scene and its suggested radius."""
    built = ts.scenes.builtin(scene)
    return ts.scenes.render(built, views=0, height=height, width=width), built.radius


def per_radius(gbuffer: ts.GBuffer) -> float:
    """Median half-size of the window in pixels for a radius of 1."""
    pixels = gbuffer.camera.footprint(torch.tensor(1.0), gbuffer.depth[:, :1])[:, 0]
    return float(pixels[gbuffer.valid_mask[:, :1].expand_as(pixels)].median())


def statvo(gbuffer: ts.GBuffer, radius: float, mode: str, **choices: Any) -> Work:
    """One pass of a module over a view, all choices named."""
    module = ts.StatVO(radius, learnable="all" if mode == "forward_backward" else (), **(PLAIN | choices))
    cotangent = torch.randn(gbuffer.depth[:, :1].shape, generator=torch.Generator().manual_seed(0))

    def forward() -> torch.Tensor:
        with torch.no_grad():
            return module(gbuffer)

    def both() -> tuple[torch.Tensor, ...]:
        depth, normal = gbuffer.depth.clone().requires_grad_(), gbuffer.normal.clone().requires_grad_()
        moved = ts.GBuffer(depth, gbuffer.camera, normal=normal, valid=gbuffer.valid_mask)
        return torch.autograd.grad(module(moved), [depth, normal, *module.parameters()], cotangent)

    return forward if mode == "forward" else both


def compare(
    works: dict[tuple[Any, ...], Work], names: tuple[str, ...], pixels: int, repeats: int, **common: Any
) -> list[Row]:
    """Time works in turns; a row each, with the parts of its key by name and milliseconds a megapixel."""
    timings = interleaved(works, repeats)
    return [
        common
        | dict(zip(names, key, strict=True))
        | timing
        | {"ms_per_megapixel": round(timing["median_ms"] * 1e6 / pixels, 2)}
        for key, timing in timings.items()
    ]


def ratio(rows: list[Row], over: Row, under: Row, value: str = "median_ms", **common: Any) -> float:
    """Of the rows that `over` and `under` single out among those with `common`."""

    def only(what: Row) -> float:
        (row,) = (row for row in rows if all(row.get(key) == wanted for key, wanted in (common | what).items()))
        return row[value]

    return round(only(over) / only(under), 3)


def layers(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    """time by scene, image size and number of layers"""
    rows = []
    for scene in SCENES:
        for width, height in (SMALL, options.size):
            gbuffer, radius = view(scene, width, height)
            works = {(n, mode): statvo(gbuffer, radius, mode, layers=n) for n in LAYERS[:4] for mode in MODES}
            common = {"scene": scene, "width": width, "height": height}
            rows += compare(works, ("layers", "mode"), width * height, options.repeats, **common)
    return rows, []


def memory(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    """peak resident bytes a pixel beyond inputs, outputs and gradients (a process for each row), and time, of a large image"""
    width, height = options.large
    gbuffer, radius = view("temple", width, height)
    works = {
        (n, cut, mode): statvo(gbuffer, radius, mode, layers=n, quadrants=cut)
        for n in LAYERS
        for cut in (False, True)
        for mode in MODES
    }
    names, common = ("layers", "quadrants", "mode"), {"width": width, "height": height}
    if options.large_repeats:
        rows = compare(works, names, width * height, options.large_repeats, **common)
    else:
        rows = [common | dict(zip(names, key, strict=True)) for key in works if key[2] == "forward_backward"]
    for row in rows:
        choices = PLAIN | {"layers": row["layers"], "quadrants": row["quadrants"]}
        row["bytes_per_pixel"] = round(peak_bytes(gbuffer, radius, choices, row["mode"]) / (width * height), 1)
    ratios = [
        {
            "what": f"bytes of {LAYERS[-1]} layers / 2 layers",
            "quadrants": cut,
            "mode": mode,
            "ratio": ratio(rows, {"layers": LAYERS[-1]}, {"layers": 2}, "bytes_per_pixel", quadrants=cut, mode=mode),
        }
        for cut in (False, True)
        for mode in dict.fromkeys(row["mode"] for row in rows)
    ]
    return rows, ratios


def footprints(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    """time by median half-size of the window"""
    width, height = options.size
    rows, ratios = [], []
    for scene in SCENES:
        gbuffer, _ = view(scene, width, height)
        unit = per_radius(gbuffer)
        works = {(px, mode): statvo(gbuffer, px / unit, mode, layers=4) for px in FOOTPRINTS for mode in MODES}
        rows += compare(works, ("footprint_px", "mode"), width * height, options.repeats, scene=scene)
        ratios += [
            {
                "what": f"{px} px / {FOOTPRINTS[0]} px",
                "scene": scene,
                "mode": mode,
                "ratio": ratio(rows, {"footprint_px": px}, {"footprint_px": FOOTPRINTS[0]}, scene=scene, mode=mode),
            }
            for px in FOOTPRINTS[1:]
            for mode in MODES
        ]
    return rows, ratios


def scales(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    """time at full, half and quarter resolution of the tables: one table of four channels, and in total"""
    width, height = options.size
    gbuffer, radius = view("temple", width, height)
    generator = torch.Generator().manual_seed(0)
    works: dict[tuple[Any, ...], Work] = {}
    for scale in SCALES:
        samples = torch.rand(1, 4, height // scale, width // scale, generator=generator)
        works["table", scale] = functools.partial(sat.summed_area_table, samples)
        works["total", scale] = statvo(gbuffer, radius, "forward", layers=4, sat_scale=scale)
    rows = compare(works, ("step", "sat_scale"), width * height, options.repeats, layers=4, width=width, height=height)
    ratios = [
        {
            "what": f"{step} at scale 1 / {step} at scale {scale}",
            "ratio": ratio(rows, {"sat_scale": 1}, {"sat_scale": scale}, step=step),
            "paper": PAPER[f"{step} at half resolution"] if scale == 2 else None,
        }
        for step in ("table", "total")
        for scale in SCALES[1:]
    ]
    return rows, ratios


def quadrants(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    """time with the window cut into quadrants against one window"""
    values, mode_rows = (False, True), []
    ratios = []
    for n in (1, 4):
        rows = pair(options, "quadrants", values, MODES, layers=n)
        mode_rows += rows
        for mode in MODES:
            value = ratio(rows, {"quadrants": True}, {"quadrants": False}, mode=mode)
            paper = PAPER["quadrants"] if mode == "forward" else None
            ratios.append({"what": "quadrants on / off", "layers": n, "mode": mode, "ratio": value, "paper": paper})
    return mode_rows, ratios


def layering(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    """time of 64 uniform layers against 4 adaptive ones"""
    width, height = options.size
    gbuffer, radius = view("temple", width, height)
    works = {
        (kind, n): statvo(gbuffer, radius, "forward", layers=n, layering=kind)
        for kind, n in (("adaptive", 4), ("uniform", 64))
    }
    rows = compare(works, ("layering", "layers"), width * height, options.repeats, mode="forward")
    value = ratio(rows, {"layering": "uniform"}, {"layering": "adaptive"})
    what = "64 uniform / 4 adaptive layers"
    return rows, [{"what": what, "ratio": value, "paper": round(PAPER[what], 2)}]


def gradient(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    """time of forward and backward with the surrogate gradient against the exact one"""
    rows = pair(options, "gradient", ("exact", "surrogate"), MODES[1:], layers=4)
    value = ratio(rows, {"gradient": "surrogate"}, {"gradient": "exact"})
    return rows, [{"what": "surrogate / exact, forward and backward", "ratio": value, "paper": None}]


def differential(options: argparse.Namespace) -> tuple[list[Row], list[Row]]:
    """time and rounding with half of the layers' tables made by subtraction against all of them built"""
    width, height = options.size
    gbuffer, radius = view("temple", width, height)
    depth = torch.where(gbuffer.valid_mask, gbuffer.depth, 1.0)
    half = gbuffer.camera.footprint(torch.tensor(radius), depth)
    box, slope = torch.full((1,), radius), torch.ones(1)
    inputs = (gbuffer.camera.unproject(depth), gbuffer.valid_mask, gbuffer.normal, half, box, slope)
    rows, ratios = [], []
    for n in (4, 16):
        works = {
            (how,): functools.partial(statvo_obscurance, *inputs, layers=n, differential=how) for how in (False, True)
        }
        found = compare(works, ("differential",), width * height, options.repeats, layers=n)
        rows += found
        ratios.append(
            {
                "what": "differential / direct",
                "layers": n,
                "ratio": ratio(found, {"differential": True}, {"differential": False}),
                "largest_difference": float((works[(True,)]() - works[(False,)]()).abs().max()),
            }
        )
    return rows, ratios


def pair(
    options: argparse.Namespace, name: str, values: tuple[Any, ...], modes: tuple[str, ...], **common: Any
) -> list[Row]:
    """One choice with two values."""
    width, height = options.size
    gbuffer, radius = view("temple", width, height)
    works = {(v, mode): statvo(gbuffer, radius, mode, **{name: v}, **common) for mode in modes for v in values}
    return compare(works, (name, "mode"), width * height, options.repeats, **common)


PARTS = {
    part.__name__: part for part in (layers, memory, footprints, scales, quadrants, layering, gradient, differential)
}


def show(name: str, rows: list[Row], ratios: list[Row]) -> None:
    print(f"\n{name}: {PARTS[name].__doc__}")
    hidden = ("median_ms", "min_ms", "max_ms", "repeats")
    for row in rows:
        what = "  ".join(f"{key}={value}" for key, value in row.items() if key not in hidden)
        print(f"  {shown(row) if 'median_ms' in row else '':>28} ms  {what}")
    for row in ratios:
        print("  " + "  ".join(f"{key}={value}" for key, value in row.items() if value is not None))


def main() -> None:
    about = __doc__ + "".join(f"\n  {name:<11} {part.__doc__}" for name, part in PARTS.items())
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help="default: all of them")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument(
        "--large", type=int, nargs=2, default=(1920, 1080), metavar=("WIDTH", "HEIGHT"), help="of memory"
    )
    parser.add_argument("--large-repeats", type=int, default=3, help="of memory; 0: bytes only, no times")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/statvo_speed.json"))
    options = parser.parse_args()
    chosen = options.parts or list(PARTS)
    if unknown := set(chosen) - set(PARTS):
        parser.error(f"unknown part {', '.join(sorted(unknown))}: choose from {', '.join(PARTS)}")
    gate = [sys.executable, "-m", "pytest", "-q", "tests/ops", "-k", "oracle or sum or gradcheck"]
    if subprocess.run(gate, check=False).returncode:
        sys.exit("the correctness tests fail: no times")
    # A part that is not run keeps what it had, with the environment it was measured in.
    results = json.loads(options.out.read_text(encoding="utf-8")) if options.out.exists() else {}
    for name in chosen:
        rows, ratios = PARTS[name](options)
        show(name, rows, ratios)
        results[name] = {"environment": environment(), "ratios": ratios, "rows": rows}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
