"""What `select` chooses from: grids of modules over discrete choices, named, cheapest first."""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, final

from torch_ssao import checks
from torch_ssao.modules import TECHNIQUES, AmbientVisibility

COUNTS: dict[str, tuple[str, ...]] = {
    "statvo": ("layers",),
    "hbao": ("slices", "steps"),
    "ray_march": ("rays", "steps"),
}
"""The counts of each technique that are always part of a name."""
SHORT = {"sat_scale": "sat", "half_resolution": "half"}
DENOISE_TAPS = 24
"""Neighbours that a pass of `ops.denoise.denoise_visibility` reads."""
UPSAMPLE_TAPS = 8
"""Reads of `ops.upsample.upsample_visibility`."""


@final
@dataclass(frozen=True, eq=False)
class Candidate:
    """A module that may be chosen, not yet fitted.

    Args:
        name: unique among the candidates, such as "statvo_layers4_sat2".
        module: with its starting values; never changed.
    """

    name: str
    module: AmbientVisibility

    @property
    def technique(self) -> str:
        """The module's name in `modules.TECHNIQUES`, or that of its class."""
        return technique_of(self.module)

    @property
    def cost(self) -> float:
        """A guess of the work, in image reads a pixel: orders candidates before anything is timed."""
        return estimated_cost(self.module)


def statvo(radius: Any = 0.5, *, layers: Any = (1, 2, 4, 8), **options: Any) -> list[Candidate]:
    """StatVO over a grid of choices.

    Args:
        radius: scene units, > 0.
        layers: layer counts.
        options: any other argument of `StatVO`, such as `sat_scale=[1, 2, 4]`. All arguments may be a value or a list (tuple,
            range) of values, of which every combination is made; the names that `learnable` takes are one value.
    Returns: candidates in the order of their estimated cost. Named are the counts, what is given as a list, and choices other
        than the default: "statvo_layers4_sat2".
    Raises: ChoiceError for an argument that StatVO has not; what `StatVO` raises; RangeError for an empty list or a value
        given twice.
    """
    return _grid("statvo", {"layers": layers, **options, "radius": radius})


def hbao(radius: Any = 0.5, *, slices: Any = (1, 2, 3), steps: Any = (3, 6, 12), **options: Any) -> list[Candidate]:
    """HBAO over a grid of choices; as `statvo`, with the arguments of `HBAO`."""
    return _grid("hbao", {"slices": slices, "steps": steps, **options, "radius": radius})


def ray_march(radius: Any = 0.5, *, rays: Any = (4, 8, 16), steps: Any = (4, 8), **options: Any) -> list[Candidate]:
    """Ray-marched SSAO over a grid of choices; as `statvo`, with the arguments of `RayMarchedSSAO`."""
    return _grid("ray_march", {"rays": rays, "steps": steps, **options, "radius": radius})


def all_techniques(radius: float) -> list[Candidate]:
    """Every technique from its smallest form up, 44 candidates: when nothing is known of a scene.

    Args:
        radius: scene units, > 0.
    Returns: StatVO of 1 to 8 layers with and without quadrants, at full and half SAT resolution; HBAO of 1 to 3 slices with 3
        to 12 steps a side and ray marches of 4 to 16 rays with 4 or 8 steps, plain, and all but the largest denoised; the larger
        HBAOs at half resolution.
    """
    made = statvo(radius, sat_scale=[1, 2], quadrants=[False, True])
    made += hbao(radius) + hbao(radius, slices=[1, 2], steps=[3, 6], denoise=1)
    made += ray_march(radius) + ray_march(radius, rays=[4, 8], steps=[4, 8], denoise=1)
    made += hbao(radius, slices=[2, 3], steps=[6, 12], half_resolution=True)
    return _by_cost(made + hbao(radius, slices=3, steps=6, denoise=1))


def as_candidates(given: Any) -> list[Candidate]:
    """Candidates of what a caller passed, cheapest first.

    Args:
        given: candidates and modules in a sequence, or modules by name in a mapping. Modules alone are named by their choices.
    Raises: ChoiceError for anything else, and for a name that comes twice; RangeError for none at all.
    """
    if isinstance(given, Mapping):
        items: list[Any] = [Candidate(str(name), module) for name, module in given.items()]
    else:
        items = list(given) if isinstance(given, Iterable) else [given]
    made = []
    for item in items:
        module = item.module if isinstance(item, Candidate) else item
        if not isinstance(module, AmbientVisibility):
            raise checks.ChoiceError(
                f"candidates must be modules of torch_ssao, got {type(module).__name__}: pass fitting.candidates.statvo() or so"
            )
        made.append(item if isinstance(item, Candidate) else Candidate(_name_of(module, {}), module))
    if not made:
        raise checks.RangeError("candidates must hold at least one, got none: pass fitting.candidates.statvo() or so")
    names = [candidate.name for candidate in made]
    for name in names:
        if names.count(name) > 1:
            raise checks.ChoiceError(
                f"candidates must have names of their own, got {name!r} twice: pass a mapping from names to modules"
            )
    return _by_cost(made)


def technique_of(module: AmbientVisibility) -> str:
    """The module's name in `modules.TECHNIQUES`, or that of its class."""
    return next((name for name, kind in TECHNIQUES.items() if type(module) is kind), type(module).__name__.lower())


def estimated_cost(module: AmbientVisibility) -> float:
    """Image reads a pixel: what speed follows before anything is timed. Only its order is used."""
    choices = module.config()
    reads = _taps(technique_of(module), choices) + DENOISE_TAPS * choices.get("denoise", 0)
    return reads / 4 + UPSAMPLE_TAPS if choices.get("half_resolution") else reads


def _taps(technique: str, choices: Mapping[str, Any]) -> float:
    if technique == "statvo":  # each layer builds its tables, then each window looks up corners
        corners = 9 if choices["quadrants"] else 4
        return float(choices["layers"]) * (corners * choices["windows"] + 4 / choices["sat_scale"] ** 2)
    if technique == "hbao":
        return float(2 * choices["slices"] * choices["steps"])
    if technique == "ray_march":
        return float(choices["rays"] * choices["steps"])
    counts = [float(value) for name, value in choices.items() if name != "denoise" and _is_count(value) and value > 0]
    return math.prod(counts)


def distance(one: AmbientVisibility, other: AmbientVisibility) -> float:
    """How far apart two modules of a technique are: halvings of each count, and 1 for each other choice that differs."""
    total = 0.0
    for name, value in one.config().items():
        against = other.config().get(name)
        if _is_count(value) and _is_count(against):
            total += abs(_log2(name, value) - _log2(name, against))
        else:
            total += value != against
    return total


def _log2(name: str, count: Any) -> float:
    return math.log2(max(count + (name == "denoise"), 1))  # no passes are a choice too


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _by_cost(made: list[Candidate]) -> list[Candidate]:
    return sorted(made, key=lambda candidate: candidate.cost)


def _grid(technique: str, given: Mapping[str, Any]) -> list[Candidate]:
    kind: Any = TECHNIQUES[technique]
    known = [name for name in inspect.signature(kind).parameters if name != "self"]
    for name in given:
        checks.check_choice("options", name, known)
    listed = {name: _several(name, value) for name, value in given.items()}
    varied = {name for name, value in given.items() if _is_list(name, value)}
    made = []
    for values in itertools.product(*listed.values()):
        options = dict(zip(listed, values, strict=True))
        module = kind(**options)
        made.append(Candidate(_name_of(module, {name: options[name] for name in options if name in varied}), module))
    return _by_cost(made)


def _is_list(name: str, value: Any) -> bool:
    return isinstance(value, list | range) or (isinstance(value, tuple) and name != "learnable")


def _several(name: str, value: Any) -> list[Any]:
    values = list(value) if _is_list(name, value) else [value]
    if not values or any(values.count(item) > 1 for item in values):
        raise checks.RangeError(f"{name} must be a value or a list of values, each once, got {value!r}: list them once")
    return values


def _name_of(module: AmbientVisibility, varied: Mapping[str, Any]) -> str:
    """Technique, counts, `varied` and choices other than the default, in that order."""
    technique = technique_of(module)
    shown = {name: getattr(module, name) for name in COUNTS.get(technique, ())} | dict(varied)
    if technique in TECHNIQUES:
        usual = TECHNIQUES[technique]().config()  # type: ignore[call-arg]
        shown |= {name: value for name, value in module.config().items() if value != usual[name]}
    else:
        shown |= module.config()
    return "_".join([technique, *(_part(name, value) for name, value in shown.items())])


def _part(name: str, value: Any) -> str:
    short = SHORT.get(name, name)
    if isinstance(value, bool):
        return short if value else f"no{short}"
    if isinstance(value, int | float):
        return f"{short}{value:g}" if isinstance(value, float) else f"{short}{value}"
    words = "+".join(map(str, value)) if isinstance(value, tuple) else str(value).lower()
    return f"{short}-{words}"
