"""The options that belong to techniques: how they are declared, and modules made from them.

An option that was not given is no attribute of the parsed arguments, because None is a value (infinite thickness).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch_ssao.cli.errors import CommandLineError

if TYPE_CHECKING:
    from torch_ssao.modules import AmbientVisibility

COUNTS = {
    "layers": "depth layers",
    "slices": "planes of directions through each pixel",
    "rays": "rays a pixel",
    "steps": "taps on either side of each slice, or steps along each ray",
}
OPTIONS = (
    "layers",
    "quadrants",
    "layering",
    "sat_scale",
    "slices",
    "rays",
    "steps",
    "estimator",
    "weighting",
    "offscreen",
    "thickness",
    "denoise",
    "half_resolution",
)


def add_options(parser: argparse.ArgumentParser, count: Callable[[str], Any], metavar: str, note: str) -> None:
    """Declare the techniques' options.

    Args:
        parser: of one command.
        count: what turns the text of a count, such as --layers, into its value: one number or several.
        metavar: how the help shows that value.
        note: what the help says about counts that are left out.
    """
    group = parser.add_argument_group("options of the techniques", note)

    def add(name: str, text: str, **settings: Any) -> None:
        owners = ", ".join(technique for technique in _names() if name in _has(technique))
        group.add_argument(flag(name), default=argparse.SUPPRESS, help=f"{owners}: {text}", **settings)

    for name, text in COUNTS.items():
        add(name, text, type=count, metavar=metavar)
    both = argparse.BooleanOptionalAction
    add("quadrants", "evaluate the four quarters of the window on their own, or the window as one", action=both)
    add("layering", "adaptive or uniform", metavar="NAME")
    add("sat_scale", "1, 2 or 4: tables at full, half or quarter resolution", type=int, metavar="N")
    add("estimator", "bitmask or increments", metavar="NAME")
    add("weighting", "cosine or uniform", metavar="NAME")
    add("offscreen", "open: what is off the image never occludes; extend: border surfaces go on", metavar="NAME")
    text = (
        "depth of occluders behind what is seen of them, of the radius, where a fit starts; none: infinite, not fitted"
    )
    add("thickness", text, type=_thickness, metavar="T")
    add("denoise", "passes of the edge-aware filter", type=int, metavar="N")
    add("half_resolution", "compute every other row and column, carry them to the rest along surfaces", action=both)


def parse_names(text: str) -> tuple[str, ...]:
    """Technique names with commas between them, or all; "raymarch" and "ray-march" are understood too."""
    if text.strip() == "all":
        return _names()
    plain = {name.replace("_", ""): name for name in _names()}
    parts = (part.strip() for part in text.split(","))
    return tuple(plain.get(part.lower().replace("_", "").replace("-", ""), part) for part in parts)


def flag(name: str) -> str:
    """An option as it is written on the command line."""
    return f"--{name.replace('_', '-')}"


def options(arguments: argparse.Namespace) -> dict[str, Any]:
    """The techniques' options that were given, by name.

    Raises: ChoiceError for an unknown technique; CommandLineError for an option that no chosen technique has.
    """
    from torch_ssao import checks

    chosen = _chosen(arguments)
    for technique in chosen:
        checks.check_choice("technique", technique, _names())
    given = _given(arguments)
    for name in given:
        if any(name in _has(technique) for technique in chosen):
            continue
        owners = ",".join(technique for technique in _names() if name in _has(technique))
        has = ", ".join(dict.fromkeys(flag(own) for technique in chosen for own in _has(technique)))
        raise CommandLineError(
            f"{flag(name)} must be left out with --technique {','.join(chosen)}, which has {has}: "
            f"or choose --technique {owners}"
        )
    return given


def module(arguments: argparse.Namespace, radius: float) -> AmbientVisibility:
    """The one technique chosen, with default values but for the radius and the options given."""
    from torch_ssao.modules import TECHNIQUES

    given, chosen = options(arguments), _chosen(arguments)
    if len(chosen) != 1:
        raise CommandLineError(f"--technique must be one technique, got {','.join(chosen)}: run render once for each")
    kind: Any = TECHNIQUES[chosen[0]]
    made: AmbientVisibility = kind(radius, **given)
    return made


def saved_module(arguments: argparse.Namespace) -> AmbientVisibility | None:
    """The module of --module, or None without it."""
    from torch_ssao import serialize

    path: Path | None = arguments.module
    if path is None:
        return None
    given = (["technique"] if arguments.technique is not None else []) + list(_given(arguments))
    if given:
        raise CommandLineError(f"{flag(given[0])} must be left out with --module: the file says what the module is")
    return serialize.load(path)


def _chosen(arguments: argparse.Namespace) -> tuple[str, ...]:
    return ("statvo",) if arguments.technique is None else arguments.technique


def _given(arguments: argparse.Namespace) -> dict[str, Any]:
    return {name: getattr(arguments, name) for name in OPTIONS if hasattr(arguments, name)}


def _names() -> tuple[str, ...]:
    from torch_ssao.modules import TECHNIQUES

    return tuple(TECHNIQUES)


def _has(technique: str) -> tuple[str, ...]:
    from torch_ssao.modules import TECHNIQUES

    kind = TECHNIQUES[technique]
    return tuple(name for name in OPTIONS if name in kind.CHOICES or name in kind.PARAMETERS)


def _thickness(text: str) -> float | None:
    if text.lower() == "none":
        return None
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a positive number or none, got {text!r}") from None
