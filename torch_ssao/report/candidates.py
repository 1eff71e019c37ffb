"""What is measured: modules of chosen techniques with default values, one for each layer count or pair of counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch_ssao import checks
from torch_ssao.fitting.candidates import COUNTS
from torch_ssao.modules import TECHNIQUES, AmbientVisibility

LAYERS = (1, 2, 4, 8)
SWEEPS: dict[str, tuple[tuple[int, ...], ...]] = {"hbao": ((2, 4), (3, 6)), "ray_march": ((16, 8),)}
"""Counts that are measured where none are given; `LAYERS` for techniques with layers."""
FINE_SWEEPS: dict[str, tuple[tuple[int, ...], ...]] = {
    "hbao": ((1, 4), (2, 4), (2, 6), (3, 6), (4, 8)),
    "ray_march": ((4, 4), (8, 4), (8, 8), (16, 8)),
}
"""As `SWEEPS`, where the cheapest that is good enough is looked for: each half again to twice the work of the one before."""
TITLES = {"statvo": "StatVO", "hbao": "HBAO", "ray_march": "ray march"}
"""Techniques by name in `TECHNIQUES`, for people."""
MEANINGS = {
    "hbao": "HBAO 3x6: 3 slices with 6 taps on either side of the pixel.",
    "ray_march": "Ray march 16x8: 16 rays of 8 steps.",
}

Candidate = tuple[str, str, AmbientVisibility]


def candidates(
    technique: str | Sequence[str],
    radius: float,
    layers: Sequence[int] = LAYERS,
    options: Mapping[str, Any] | None = None,
    *,
    fine: bool = False,
) -> list[Candidate]:
    """Modules with default values but for the radius and the options, one per layer count or pair of counts.

    Args:
        technique: a name in `modules.TECHNIQUES`, or several, each once.
        radius: scene units, > 0.
        layers: layer counts, each once, of techniques that have layers.
        options: arguments of the techniques by name. An option goes to every technique that has it. Counts (`COUNTS`) are
            one number or several; those of a pair are taken together: slices (3, 4) and steps (4, 8) make 3x4 and 4x8. A
            count whose partner alone is given keeps the technique's default. "layers" goes before the argument layers.
        fine: whether counts that are not given are those of `FINE_SWEEPS`.
    Returns: (name, label, module) for each, by technique. The label names the technique where it has to.
    Raises: ChoiceError for an unknown technique or an option that no technique has; RangeError for a radius, a count or a
        repetition that cannot be.
    """
    names = (technique,) if isinstance(technique, str) else tuple(technique)
    for name in names:
        checks.check_choice("technique", name, TECHNIQUES)
    if not names or len(set(names)) != len(names):
        raise checks.RangeError(
            f"technique must name techniques, each once, got {names}: pass ('statvo', 'hbao') or so"
        )
    given = {"layers": tuple(layers), **(options or {})}
    _check_options(names, options or {})
    sweeps = FINE_SWEEPS if fine else SWEEPS
    return [candidate for name in names for candidate in _of(name, radius, given, sweeps, alone=len(names) == 1)]


def options_of(technique: str) -> tuple[str, ...]:
    """Arguments of a technique that `candidates` takes as options."""
    kind = TECHNIQUES[technique]
    return tuple(name for name in (*kind.CHOICES, *kind.PARAMETERS) if name != "radius")


_Sweeps = Mapping[str, tuple[tuple[int, ...], ...]]


def _of(technique: str, radius: float, given: Mapping[str, Any], sweeps: _Sweeps, *, alone: bool) -> list[Candidate]:
    kind: Any = TECHNIQUES[technique]
    counts = COUNTS.get(technique, ())
    shared = {name: given[name] for name in options_of(technique) if name in given and name not in counts}
    made = []
    for numbers in _sweep(technique, given, sweeps):
        module = kind(radius, **shared, **dict(zip(counts, numbers, strict=True)))
        name = "_".join((technique, "x".join(map(str, numbers)))) if numbers else technique
        made.append((name, _label(technique, numbers, alone=alone), module))
    return made


def _sweep(technique: str, given: Mapping[str, Any], sweeps: _Sweeps) -> tuple[tuple[int, ...], ...]:
    """The counts of each candidate, in the order of `COUNTS`."""
    names = COUNTS.get(technique, ())
    if not any(name in given for name in names):
        return sweeps.get(technique, ((),))
    kind: Any = TECHNIQUES[technique]
    listed = [_several(given[name] if name in given else getattr(kind(), name)) for name in names]
    longest = max(map(len, listed))
    if any(len(numbers) not in (1, longest) for numbers in listed):
        pairs = ", ".join(f"{name} {numbers}" for name, numbers in zip(names, listed, strict=True))
        raise checks.RangeError(f"{' and '.join(names)} must be as many, or one for all, got {pairs}: they go in pairs")
    rows = tuple(zip(*(numbers * (longest if len(numbers) == 1 else 1) for numbers in listed), strict=True))
    if not rows or len(set(rows)) != len(rows):
        what = "layer counts" if names == ("layers",) else "counts"
        example = "(1, 2, 4, 8)" if names == ("layers",) else "(3, 4) and (4, 8)"
        got = " and ".join(map(str, listed))
        raise checks.RangeError(f"{' and '.join(names)} must name {what}, each once, got {got}: pass {example} or so")
    return rows


def _several(counts: int | Sequence[int]) -> tuple[int, ...]:
    return tuple(counts) if isinstance(counts, Sequence) else (counts,)


def _label(technique: str, numbers: tuple[int, ...], *, alone: bool) -> str:
    title = TITLES.get(technique, technique)
    if COUNTS.get(technique) == ("layers",):
        layers = f"{numbers[0]} layer{'s' if numbers[0] != 1 else ''}"
        return layers if alone else f"{title} {layers}"
    return " ".join((title, "x".join(map(str, numbers)))) if numbers else title


def _check_options(techniques: Sequence[str], options: Mapping[str, Any]) -> None:
    for name in options:
        if not any(name in options_of(technique) for technique in techniques):
            has = ", ".join(dict.fromkeys(own for technique in techniques for own in options_of(technique)))
            raise checks.ChoiceError(
                f"options must be of {', '.join(techniques)} ({has}), got {name!r}: leave it out or add its technique"
            )
