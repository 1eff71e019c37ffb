"""The papers' comparisons with what they were compared against, on scenes at hand.

    python -m benchmarks.paper_tables [FOLDER] [--tables ray_marched statvo] [--size 320x240] [--samples 2048]

The built-in temple and street, and sibenik.ply and sponza_crytek.ply of FOLDER (with its scenes.json) where there are any.
Every technique is fitted on view 0, at half the size, and judged on all other views; all noisy ones have the same filter, one
pass. Rows go to benchmarks/results/paper_tables.json beside those of other scenes, tables to stdout, pictures (reference, image,
difference) and cached references to out/paper_tables. --show prints the tables of the stored rows, and measures nothing.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.paper_tables import ray_marched, statvo
from benchmarks.paper_tables.common import EVALUATIONS, FIT_SAMPLES, Settings, cases
from benchmarks.statvo_claims.common import rounded
from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parents[1] / "results" / "paper_tables.json"
TABLES = {"ray_marched": ray_marched, "statvo": statvo}


def _size(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--tables", nargs="*", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--builtin", nargs="*", default=["temple", "street"])
    parser.add_argument("--meshes", nargs="*", default=["sibenik", "sponza_crytek"])
    parser.add_argument("--size", type=_size, default=Settings.size)
    parser.add_argument("--samples", type=int, default=Settings.samples, help="rays a pixel of the reference")
    parser.add_argument("--repeats", type=int, default=Settings.repeats, help="timed rounds, at least 5 for quartiles")
    parser.add_argument("--falloff", default=Settings.falloff, choices=("binary", "linear", "quadratic"))
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--show", action="store_true")
    return parser.parse_args()


def _stored(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def _keep(path: Path, name: str, facts: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Write a scene's rows of a table beside those of other scenes, if these were measured with the same settings."""
    facts = json.loads(json.dumps(facts))
    everything = _stored(path)
    table = everything.get(name, {})
    before = table["rows"] if table.get("settings") == facts else []
    scene = rows[0]["scene"]
    place = environment()
    fresh = [{**row, "commit": place["commit"]} for row in rounded(rows)]
    kept = [row for row in before if row["scene"] != scene] + fresh
    everything[name] = {"environment": place, "settings": facts, "rows": kept}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(everything, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    arguments = _arguments()
    if not arguments.show:
        settings = Settings(arguments.size, arguments.samples, repeats=arguments.repeats, falloff=arguments.falloff)
        facts = asdict(settings) | {"fit_samples": FIT_SAMPLES, "evaluations": EVALUATIONS}
        for case in cases(arguments.folder, arguments.builtin, arguments.meshes, settings):
            for name in arguments.tables:
                _keep(arguments.results, name, facts, TABLES[name].rows(case))
                print(f"{case.name}: {name} done", flush=True)
    for name, kept in _stored(arguments.results).items():
        print(f"\n## {name}\n\n{TABLES[name].table(kept['rows'])}")


if __name__ == "__main__":
    main()
