"""What a cap on the reads costs and saves: HBAO and RayMarchedSSAO with far taps on the depth pyramid, and without it.

    python -m benchmarks.pyramid [--scenes temple street] [--techniques HBAO ...] [--size 480x360] [--samples 256] [--repeats 3]

On two built-in scenes, with a radius that spans up to about 200 pixels (the 95th percentile over the image), caps of 8, 16, 32
and 64 pixels and none: mean change and RMSE against no cap, bias and RMSE against a ray-traced reference, milliseconds on one
thread. Everything else is at its default; the reference has the technique's own falloff. Rows go to
benchmarks/results/pyramid.json, beside those of other runs.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import torch_ssao as ts
from benchmarks.timing import interleaved
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parent / "results" / "pyramid.json"
CAPS = (None, 8.0, 16.0, 32.0, 64.0)
SPAN = 200.0  # pixels of the radius, at the 95th percentile of the image
TECHNIQUES: dict[str, tuple[Callable[..., AmbientVisibility], str]] = {  # with the reference's falloff
    "HBAO": (ts.HBAO, "binary"),
    "RayMarchedSSAO": (ts.RayMarchedSSAO, "linear"),
}


def measure(
    name: str, techniques: list[str], height: int, width: int, samples: int, repeats: int
) -> list[dict[str, Any]]:
    """Rows of one scene."""
    scene = ts.scenes.builtin(name)
    gb = ts.scenes.render(scene, views=0, height=height, width=width)
    seen = gb.valid_mask[:, :1]
    per_unit = (gb.camera.fy / gb.depth[seen]).quantile(0.95)
    radius = round(SPAN / float(per_unit), 2)
    rows = []
    for technique in techniques:
        make, falloff = TECHNIQUES[technique]
        options = {"views": 0, "height": height, "width": width, "radius": radius, "samples": samples}
        truth = ts.reference.raytrace(scene, falloff=falloff, **options).visibility
        nets = {str(cap): make(radius, max_radius_px=cap) for cap in CAPS}
        with torch.no_grad():
            images = {cap: net(gb) for cap, net in nets.items()}
            taken = interleaved({cap: lambda net=net: net(gb) for cap, net in nets.items()}, repeats)
        for cap, image in images.items():
            change, error = (image - images["None"])[seen], (image - truth)[seen]
            row = {
                "scene": name,
                "technique": technique,
                "radius": radius,
                "max_radius_px": cap,
                "mean_change": round(float(change.mean()), 5),
                "rmse_to_none": round(float(change.square().mean().sqrt()), 5),
                "bias": round(float(error.mean()), 5),
                "rmse_to_reference": round(float(error.square().mean().sqrt()), 5),
                "ms": taken[cap],
            }
            rows.append(row)
            print(" ".join(f"{key}={value}" for key, value in row.items()), flush=True)
    return rows


def main() -> None:
    """Measure and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["temple", "street"])
    parser.add_argument("--techniques", nargs="+", choices=list(TECHNIQUES), default=list(TECHNIQUES))
    parser.add_argument("--size", default="480x360", help="WIDTHxHEIGHT")
    parser.add_argument("--samples", type=int, default=256, help="rays a pixel of the reference")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    width, height = map(int, arguments.size.split("x"))
    before = json.loads(RESULTS.read_text(encoding="utf-8"))["rows"] if RESULTS.exists() else []
    done = [(scene, technique) for scene in arguments.scenes for technique in arguments.techniques]
    rows = [row for row in before if (row["scene"], row["technique"]) not in done]
    for name in arguments.scenes:
        rows += measure(name, arguments.techniques, height, width, arguments.samples, arguments.repeats)
    record = {"environment": environment(), "size": [height, width], "samples": arguments.samples, "rows": rows}
    RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
