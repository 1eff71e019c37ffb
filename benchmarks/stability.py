"""Figures of the hard cases, as the table of docs/stability.md: `python -m benchmarks.stability`.

The cases are those of the tests (tests/support/hard_case_list.py). Bold: a known failure.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch


def figure_text(figure: float) -> str:
    """Two significant digits; 0 for what rounding leaves."""
    if abs(figure) < 1e-12:
        return "0"
    return f"{figure:.2g}" if abs(figure) >= 1e-3 else f"{figure:.0e}"


def main() -> None:
    """Print the table."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from support.hard_case_list import CASES
    from support.hard_cases import TITLES

    torch.set_num_threads(1)
    head = ["#", "hard case (`test id`)", "reported in", "figure", "at most", *TITLES.values()]
    print("| " + " | ".join(head) + " |")
    print("|---" * len(head) + "|")
    for case in CASES:
        cells = [str(case.number), f"{case.title} (`{case.name}`)", case.threads, case.meaning, f"{case.most:g}"]
        for name in TITLES:
            if name not in case.techniques:
                cells.append("-")
                continue
            text = figure_text(case.figure(name))
            cells.append(f"**{text}**" if name in case.known else text)
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
