"""What every closed form shares: the question it answers, checks of its arguments, quadrature."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_ssao import checks

Array = NDArray[np.float64]

FALLOFFS = ("binary", "linear", "quadratic")
WEIGHTINGS = ("cosine", "uniform", "volumetric")

_EXPONENT = {"linear": 1, "quadratic": 2}
TINY = 1e-300  # keeps 1/s and log(s) finite where s = 0 multiplies them away
# 48 nodes leave less than 1e-13 against every closed form that exists beside the quadrature (tests/scenes).
_NODES, _NODE_WEIGHTS = (0.5 * a for a in np.polynomial.legendre.leggauss(48))


def check_question(radius: float, falloff: str, weighting: str, *, volumetric: bool = True) -> tuple[str, int | None]:
    """Check radius, falloff and weighting, and resolve them to a kernel and an exponent.

    Args:
        radius, falloff, weighting: see the module.
        volumetric: whether the scene fills space behind its surface, so that "volumetric" means something.
    Returns: "cosine" or "uniform", and the p of W(t) = 1 - t^p (None: binary).
    Raises: RangeError, ChoiceError.
    """
    if not (isinstance(radius, (int, float)) and radius > 0):
        raise checks.RangeError(f"radius must be greater than 0, got {radius!r}: pass a positive radius, or math.inf")
    checks.check_choice("falloff", falloff, FALLOFFS)
    checks.check_choice("weighting", weighting, WEIGHTINGS if volumetric else WEIGHTINGS[:2])
    if weighting != "volumetric":
        return weighting, _EXPONENT.get(falloff)
    if falloff != "binary":
        raise checks.ChoiceError(f"falloff must be 'binary' with weighting='volumetric', got {falloff!r}: use that")
    return "uniform", 3


def attenuated(
    binary: Callable[[ArrayLike], Array], radius: float, exponent: int | None, breaks: tuple[Array, ...]
) -> Array:
    """Integral over t in [0, 1] of binary(t R) p t^(p - 1); `binary` is 0 before the first break, smooth between."""
    if exponent is None or math.isinf(radius):
        return binary(radius)
    ends = (*breaks, np.ones(()))

    def integrand(t: Array) -> Array:
        return exponent * t ** (exponent - 1) * binary(t * radius)

    return integrate(integrand, sorted_edges(ends, low=1e-14, high=1.0))


def sorted_edges(edges: Sequence[ArrayLike], *, low: ArrayLike, high: ArrayLike) -> Array:
    """Places where an integrand may have kinks, broadcast, clipped to [low, high] and sorted along a new first axis."""
    return np.sort(np.stack(np.broadcast_arrays(*(np.clip(e, low, high) for e in edges))), axis=0)


def integrate(function: Callable[[Array], Array], edges: Array, *, linear: bool = False) -> Array:
    """Integral of `function` over [edges[0], edges[-1]], in pieces between the edges (K, ...), which are ascending.

    Nodes are spaced logarithmically (edges > 0), as features of the integrands shrink towards 0, or linearly; the cubic
    removes the square roots at both ends of a piece.
    """
    total = np.zeros(edges.shape[1:])
    for low, high in itertools.pairwise(edges):
        span = high - low if linear else np.log(high / low)
        for node, weight in zip(_NODES + 0.5, _NODE_WEIGHTS, strict=True):
            along = span * node**2 * (3.0 - 2.0 * node)
            place = low + along if linear else low * np.exp(along)
            slope = weight * 6.0 * node * (1.0 - node) * span
            total += (slope if linear else slope * place) * function(place)
    return total


def positive(name: str, value: ArrayLike) -> Array:
    """Lengths > 0, inf allowed."""
    array = np.asarray(value, np.float64)
    if not bool((array > 0).all()):
        raise checks.RangeError(f"{name} must be greater than 0, got {value!r}: pass lengths in scene units")
    return array


def part_of(name: str, value: ArrayLike, whole_name: str, whole: Array) -> Array:
    """Coordinates in [0, whole], up to rounding."""
    array = np.asarray(value, np.float64)
    if not bool(((array >= 0) & (array <= whole * (1 + 1e-9))).all()):
        raise checks.RangeError(f"{name} must lie in [0, {whole_name}], got {value!r}: pass a point of the surface")
    return np.minimum(array, whole)


def non_negative(name: str, value: ArrayLike) -> Array:
    array = np.asarray(value, np.float64)
    if not bool((array >= 0).all()):
        raise checks.RangeError(f"{name} must be 0 or more, got {value!r}: pass lengths in scene units")
    return array


def cosine(name: str, value: ArrayLike) -> Array:
    array = np.asarray(value, np.float64)
    if not bool((np.abs(array) <= 1 + 1e-9).all()):
        raise checks.RangeError(f"{name} must lie in [-1, 1], got {value!r}: pass a cosine of unit vectors")
    return np.clip(array, -1.0, 1.0)
