"""Error of the box mean against time for ways to keep a summed-area table: `python -m benchmarks.statvo_precision`.

Depth is float32(offset + u), u in [0, 1] noise or a ramp with steps. Errors are taken against a direct float64 sum over the window
of the float32 depth minus its offset, and divided by the bound: 1e-6 (max - min in the window) + 1e-7 (mean depth in it).
Times are of one build of the table, and of looking up 17 x 17 windows around pixels, each in milliseconds a megapixel.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.sat_candidates import CANDIDATES, Boxes, Candidate
from benchmarks.timing import interleaved, shown
from torch_ssao.report.environment import environment

SIZES = (512, 1024, 2048, 4096)
OFFSETS = (0.0, 10.0, 1e4)
SIDES = (1.0, 3.0, 17.0, 65.0, 257.0, 1025.0, 4096.0, 0.7, 1.37, 5.3, 33.37, 400.9)  # pixels; clipped to the image
LEAST_SIDE = 1.0  # below it the bound is not demanded: listed in the results, not counted in the worst
POSITIONS = 166  # for each side: about 2,000 windows an image
SPREAD_BLOCK = 32  # pixels
REPEATS = 5
TIMED_WINDOWS = 1 << 19  # whole rows in the middle of the image
COLOURS = dict(zip(OFFSETS, ("#0072b2", "#e69f00", "#cc3311"), strict=True))
MARKERS = "oXsPD*p^"
EXACT = 1e-9  # where errors of 0 are drawn


class Probe(NamedTuple):
    """Boxes on one image with what their means must be, all (1, N)."""

    boxes: Boxes
    side: Tensor  # pixels before clipping
    mean: Tensor  # float64, without the offset
    bound: Tensor  # float64


def noise(size: int) -> Tensor:
    return torch.rand(size, size, generator=torch.Generator().manual_seed(size), dtype=torch.float64)


def ramp_with_steps(size: int) -> Tensor:
    """A slanted plane, and 13 steps down the image."""
    place = (torch.arange(size, dtype=torch.float64) + 0.5) / size
    step = (13 * place).floor() / 13
    return 0.05 + 0.4 * place[None, :] + 0.1 * place[:, None] + 0.4 * step[:, None]


IMAGES: dict[str, Callable[[int], Tensor]] = {"noise": noise, "ramp": ramp_with_steps}


def windows(size: int, seed: int = 0) -> tuple[Boxes, Tensor]:
    """For each side as many windows around pixel centres, a quarter of them where the table's entries are largest."""
    generator = torch.Generator().manual_seed(seed)
    edges, sides = [], []
    for side in SIDES:
        place = torch.rand(2, POSITIONS, generator=generator, dtype=torch.float64)
        place[:, : POSITIONS // 4] = 1 - place[:, : POSITIONS // 4] / 16
        centre = (place * size).floor().clamp(max=size - 1) + 0.5
        edges.append(torch.stack(((centre - side / 2).clamp(min=0), (centre + side / 2).clamp(max=size))))
        sides.append(torch.full((POSITIONS,), side))
    (x0, y0), (x1, y1) = torch.cat(edges, -1)
    return Boxes(x0[None], x1[None], y0[None], y1[None], size, size), torch.cat(sides)[None]


def overlap(low: Tensor, high: Tensor, size: int) -> Tensor:
    """(N, size) length of [low, high] inside each pixel."""
    cell = torch.arange(size, dtype=torch.float64)
    return (torch.minimum(high[:, None], cell + 1) - torch.maximum(low[:, None], cell)).clamp_(min=0)


def direct_means(residual: Tensor, boxes: Boxes) -> Tensor:
    """(1, N) means of a float64 image by summing every pixel with its covered area: no table."""
    rows = overlap(boxes.y0[0], boxes.y1[0], boxes.height) @ residual
    return rows.mul_(overlap(boxes.x0[0], boxes.x1[0], boxes.width)).sum(1)[None] / boxes.area


def spreads(image: Tensor, boxes: Boxes) -> Tensor:
    """(1, N) max - min in each window; beyond 96 pixels over the whole blocks inside: a lower bound, so a stricter test."""
    blocks = image.unfold(0, SPREAD_BLOCK, SPREAD_BLOCK).unfold(1, SPREAD_BLOCK, SPREAD_BLOCK)
    low, high = blocks.amin((2, 3)), blocks.amax((2, 3))
    found = []
    for x0, x1, y0, y1 in torch.cat(boxes[:4]).T.tolist():
        if min(x1 - x0, y1 - y0) > 3 * SPREAD_BLOCK:
            cut = tuple(slice(-int(-a // SPREAD_BLOCK), int(b // SPREAD_BLOCK)) for a, b in ((y0, y1), (x0, x1)))
            found.append(float(high[cut].max() - low[cut].min()))
        else:
            inside = image[int(y0) : -int(-y1 // 1), int(x0) : -int(-x1 // 1)]
            found.append(float(inside.max() - inside.min()))
    return torch.tensor([found], dtype=torch.float64)


def probe(depth: Tensor, offset: float) -> Probe:
    residual = depth.double() - offset  # exact
    boxes, side = windows(len(depth))
    mean = direct_means(residual, boxes)
    return Probe(boxes, side, mean, 1e-6 * spreads(residual, boxes) + 1e-7 * (mean + offset).abs())


def errors(candidate: Candidate, depth: Tensor, offset: float, at: Probe) -> dict[str, Any]:
    """Worst error of all windows that count and of each side: absolute, and relative to the bound."""
    found = candidate.means(candidate.build(depth), at.boxes.map(lambda edge: edge.to(depth.device)))
    wrong = ((found.cpu() - offset) - at.mean).abs()
    relative = wrong / at.bound
    by_side = {
        f"{side:g}": [
            float(f"{worst:.3g}") for worst in (relative[at.side == side].max(), wrong[at.side == side].max())
        ]
        for side in torch.unique(at.side).tolist()
    }
    counts = at.side >= LEAST_SIDE
    return {
        "worst_over_bound": float(relative[counts].max()),
        "worst_absolute": float(wrong[counts].max()),
        "by_side": by_side,
    }


def pixel_windows(size: int, half: float) -> Boxes:
    """Windows around the pixels of some rows in the middle."""
    rows = max(1, min(size, TIMED_WINDOWS // size))
    v = (torch.arange(rows, dtype=torch.float64) + (size - rows) // 2 + 0.5)[:, None].expand(rows, size)
    u = (torch.arange(size, dtype=torch.float64) + 0.5).expand(rows, size)
    edges = ((u - half).clamp(min=0), (u + half).clamp(max=size), (v - half).clamp(min=0), (v + half).clamp(max=size))
    return Boxes(*edges, size, size)


def times(size: int, device: torch.device) -> dict[str, dict[str, Any]]:
    """Milliseconds a megapixel of build and lookup for every candidate, taking turns."""
    image = (10 + noise(size)).float().to(device)
    boxes = pixel_windows(size, 8.5).map(lambda edge: edge.to(device))

    def lookup(candidate: Candidate, state: Any) -> Callable[[], Tensor]:
        return lambda: candidate.means(state, boxes)

    builds = interleaved({c.name: (lambda c=c: c.build(image)) for c in CANDIDATES}, REPEATS)
    states = {c.name: lookup(c, c.build(image)) for c in CANDIDATES}
    lookups = interleaved(states, REPEATS)
    return {
        c.name: {"build": _per(builds[c.name], size**2), "lookup": _per(lookups[c.name], boxes.x0.numel())}
        for c in CANDIDATES
    }


def _per(timing: dict[str, Any], pixels: int) -> dict[str, Any]:
    return {key: round(value * 1e6 / pixels, 3) if key.endswith("ms") else value for key, value in timing.items()}


def check_candidates() -> None:
    """Every candidate is the exact integral at fractional edges: no time is reported for a wrong one."""
    depth = noise(101)[:70].float()
    generator = torch.Generator().manual_seed(1)
    x, y = (
        (torch.rand(300, 2, generator=generator, dtype=torch.float64) * size).sort(-1).values.T for size in (101, 70)
    )
    boxes = Boxes(x[:1], x[1:], y[:1], y[1:], 70, 101)
    expected = direct_means(depth.double(), boxes)
    for candidate in CANDIDATES:
        wrong = (candidate.means(candidate.build(depth), boxes) - expected).abs()[boxes.area > 1].max()
        if wrong > 3e-4:
            sys.exit(f"{candidate.name} is not the integral of the image: wrong by {wrong:.2g}")


def measure(sizes: tuple[int, ...], device: torch.device) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Error rows and time rows."""
    error_rows, time_rows = [], []
    for size in sizes:
        for name, image in IMAGES.items():
            unit = image(size)
            for offset in OFFSETS:
                depth = (unit + offset).float()
                at, depth = probe(depth, offset), depth.to(device)
                for candidate in CANDIDATES:
                    row = {"size": size, "image": name, "offset": offset, "candidate": candidate.name}
                    error_rows.append(row | errors(candidate, depth, offset, at))
        for name, timing in times(size, device).items():
            time_rows.append({"size": size, "candidate": name} | timing)
            print(f"{size:>5}  {name:<40} build {shown(timing['build'])}  lookup {shown(timing['lookup'])} ms/MP")
    return error_rows, time_rows


def worst(rows: list[dict[str, Any]], size: int, candidate: str, offset: float) -> float:
    """Over both images."""
    return max(
        row["worst_over_bound"]
        for row in rows
        if (row["size"], row["candidate"], row["offset"]) == (size, candidate, offset)
    )


def total(rows: list[dict[str, Any]], size: int, candidate: str) -> float:
    """Median milliseconds a megapixel to build the table and look one window a pixel up."""
    (row,) = (row for row in rows if (row["size"], row["candidate"]) == (size, candidate))
    return row["build"]["median_ms"] + row["lookup"]["median_ms"]


def draw(error_rows: list[dict[str, Any]], time_rows: list[dict[str, Any]], device: str, path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    sizes = sorted({row["size"] for row in time_rows})
    figure = Figure(figsize=(max(3.1 * len(sizes) + 0.6, 9), 4.9), layout="constrained")
    axes = figure.subplots(1, len(sizes), sharey=True, sharex=True, squeeze=False)[0]
    for axis, size in zip(axes, sizes, strict=True):
        for candidate, marker in zip(CANDIDATES, MARKERS, strict=True):
            time = total(time_rows, size, candidate.name)
            for offset, colour in COLOURS.items():
                value = max(worst(error_rows, size, candidate.name, offset), EXACT)
                size_of_marker = 11 if marker == "*" else 7
                axis.plot(time, value, marker, color=colour, ms=size_of_marker, mec="white", mew=0.6, alpha=0.9)
        axis.axhline(1, color="black", lw=1)
        axis.set(xscale="log", yscale="log", title=f"{size} × {size}")
        axis.grid(True, which="major", color="0.9")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(NullFormatter())
    axes[0].set_ylabel(f"worst error of a box mean / bound (0 drawn at {EXACT:g})")
    axes[0].text(0.72, 1.4, "the bound", transform=axes[0].get_yaxis_transform(), fontsize=8)
    figure.supxlabel(f"build + one 17 × 17 lookup a pixel, ms a megapixel ({device})", fontsize=9)
    handles = [
        Line2D([], [], ls="", marker=m, color="0.4", label=c.name) for c, m in zip(CANDIDATES, MARKERS, strict=True)
    ]
    handles += [Line2D([], [], ls="", marker="o", color=c, label=f"depth {o:g} + [0, 1]") for o, c in COLOURS.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, fontsize=8, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/statvo_precision.json"))
    parser.add_argument("--figure", type=Path, default=Path("docs/figures/statvo_precision.png"))
    options = parser.parse_args()
    check_candidates()
    error_rows, time_rows = measure(tuple(options.sizes), options.device)
    where = environment(options.device)
    print(f"\n{'worst error / bound':<40}" + "".join(f"{s:>8}/{o:<6g}" for s in options.sizes for o in OFFSETS))
    for c in CANDIDATES:
        cells = (f"{worst(error_rows, s, c.name, o):>11.2g}    " for s in options.sizes for o in OFFSETS)
        print(f"{c.name:<40}" + "".join(cells))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    about = "by_side: window side in pixels -> [worst error / bound, worst absolute error]; times in ms a megapixel"
    candidates = [{"candidate": c.name, "bytes_per_pixel": round(c.bytes_per_pixel, 2)} for c in CANDIDATES]
    parts = {
        "environment": [where],
        "about": [about],
        "candidates": candidates,
        "times": time_rows,
        "errors": error_rows,
    }
    lines = [
        f' "{name}": [\n  ' + ",\n  ".join(json.dumps(row) for row in rows) + "\n ]" for name, rows in parts.items()
    ]
    options.out.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    draw(error_rows, time_rows, where["device"] if where["device"] != "cpu" else where["cpu"], options.figure)
    print(f"wrote {options.out} and {options.figure}")


if __name__ == "__main__":
    main()
