"""Run claims by name: `python -m benchmarks.statvo_claims [names ...]`."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch_ssao as ts
from benchmarks.statvo_claims import artefacts, layers, motion
from benchmarks.statvo_claims.common import Run, store, stored

CLAIMS = {
    "layers": layers.layers,
    "monotone": layers.monotone,
    "scale": layers.scale,
    "halos": artefacts.halos,
    "pillars": artefacts.pillars,
    "thin": artefacts.thin,
    "guard_band": artefacts.guard_band,
    "temporal": motion.temporal,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("claims", nargs="*", metavar="claim", help=f"of {', '.join(CLAIMS)}; none for all")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/statvo_claims.json"))
    parser.add_argument("--figures", type=Path, default=Path("docs/figures"))
    parser.add_argument(
        "--scenes",
        nargs="*",
        default=ts.scenes.names(),
        help="of the claim layers, which takes minutes a scene; the others keep their rows",
    )
    options = parser.parse_args()
    scenes = tuple(options.scenes)
    unknown = sorted(set(options.claims) - set(CLAIMS))
    if unknown:
        parser.error(f"unknown claims {', '.join(unknown)}: choose from {', '.join(CLAIMS)}")
    for name in options.claims or CLAIMS:
        began = time.perf_counter()
        rows, statement = CLAIMS[name](Run(options.figures, scenes, stored(options.out, name, scenes)))
        store(options.out, name, rows, statement)
        print(f"{name} ({time.perf_counter() - began:.0f} s): {statement}", flush=True)


if __name__ == "__main__":
    main()
