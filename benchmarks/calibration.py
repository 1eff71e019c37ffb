"""How often planted parameters lie within their stated errors over 100 noisy replicas: `python -m benchmarks.calibration`.

A Gaussian's are 68 and 95. The cases are those of the tests (tests/support/calibration.py), and radii, which are stepped.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

from torch_ssao.report.environment import environment

RESULTS = Path(__file__).parent / "results" / "calibration.json"


def main() -> None:
    """Print the table and store its rows."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from support.calibration import CASES, REPLICAS, STEPPED, counts

    torch.set_num_threads(1)
    rows = []
    print("| technique | parameter | within one | within two |\n|---|---|---|---|")
    for stepped, cases in ((False, CASES), (True, STEPPED)):
        for name, case in cases.items():
            for parameter, (one, two) in counts(case).items():
                rows.append({"technique": name, "stepped": stepped, "parameter": parameter, "one": one, "two": two})
                print(f"| {name} | {parameter} | {one} | {two} |", flush=True)
    record = {"environment": environment(), "replicas": REPLICAS, "rows": rows}
    RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
