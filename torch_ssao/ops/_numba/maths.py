"""Elementary functions for loops over pixels: in float32 without calls and without branches, so that LLVM vectorises them.

In float64 they are those of the C library. The float32 forms are Taylor and Chebyshev sums, right to about two units of rounding.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic, overload

# How every function here is compiled. A sum of products may be fused; nothing else is reordered, no NaN is ruled out. Only
# `entry` is called from Python and cached: a cached piece of a function would not notice that it changed.
OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
STRICT: dict[str, Any] = OPTIONS | {"fastmath": False}  # where taps are rounded to pixels: as the torch op rounds
LANES = 128  # pixels of a row worked on at a time: a loop over them is the innermost one

_F = np.float32
_HALF_PI, _PI, _QUARTER_PI = _F(math.pi / 2), _F(math.pi), _F(math.pi / 4)
_TAN_EIGHTH = _F(math.tan(math.pi / 8))
_ATAN = tuple(_F(c) for c in (-0.33332938, 0.19977361, -0.13874449, 0.08044466))  # Chebyshev fit of atan(x) / x - 1
_SIN = tuple(_F((-1) ** k / math.factorial(2 * k + 1)) for k in range(7))
_COS = tuple(_F((-1) ** k / math.factorial(2 * k)) for k in range(7))
_LOG = tuple(
    _F(2 / math.log(2) / (2 * k + 1)) for k in range(5)
)  # log2 m = sum of these times s^(2k+1), s = (m-1) / (m+1)
_EXP = tuple(_F(math.log(2) ** k / math.factorial(k)) for k in range(8))
_ROUND32, _ROUND64 = _F(1.5 * 2.0**23), 1.5 * 2.0**52
_LN2 = _F(math.log(2))


def entry(function: Callable[..., None]) -> Callable[..., None]:
    """Compile on first use a function that Python calls, and keep it on disk.

    The cache looks at the function's own file only, but it holds what other files define: their digest is made part of the name.
    """
    function.__qualname__ = f"{function.__qualname__}_{_digest()}"
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # nowhere to write to
        return njit(**options)(function)


@cache
def _digest() -> str:
    found = hashlib.sha256()
    folder = Path(__file__).parent
    for path in sorted([*folder.glob("*.py"), *folder.parent.glob("*.py")]):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


@intrinsic
def _bits(typing: Any, x: Any) -> Any:
    """Of a float32, as int32."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return (types.int32(types.float32), make) if x == types.float32 else None


@intrinsic
def _float(typing: Any, x: Any) -> Any:
    """Float32 of int32 bits."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return (types.float32(types.int32), make) if x == types.int32 else None


@njit(forceinline=True, **STRICT)
def _log2_32(x: Any) -> Any:
    """Exponent, as int32, and the logarithm of the rest, in [-1/2, 1/2]."""
    bits = _bits(x)
    exponent = np.int32(np.int32(bits - np.int32(0x3F3504F3)) >> np.int32(23))
    part = _float(np.int32(bits - np.int32(exponent << np.int32(23))))
    s = (part - _F(1)) / (part + _F(1))
    q = s * s
    return exponent, s * (_LOG[0] + q * (_LOG[1] + q * (_LOG[2] + q * (_LOG[3] + q * _LOG[4]))))


def _power_32(x: Any, exponent: Any) -> Any:
    octave, rest = _log2_32(x)
    whole = exponent * _F(octave)
    n = max(whole + exponent * rest, _F(-126))
    n = (n + _ROUND32) - _ROUND32
    r = max((whole - n) + exponent * rest, _F(-1))
    high = _EXP[4] + r * (_EXP[5] + r * (_EXP[6] + r * _EXP[7]))
    value = _EXP[0] + r * (_EXP[1] + r * (_EXP[2] + r * (_EXP[3] + r * high)))
    return value * _float(np.int32(np.int32(np.int32(n) + np.int32(127)) << np.int32(23)))


def _angle_32(up: Any, out: Any) -> Any:
    side = abs(out)
    low, high = min(up, side), max(up, side)
    steep = low > _TAN_EIGHTH * high
    ratio = (low - high if steep else low) / (low + high if steep else high)
    q = ratio * ratio
    value = ratio + ratio * q * (_ATAN[0] + q * (_ATAN[1] + q * (_ATAN[2] + q * _ATAN[3])))
    value = value + _QUARTER_PI if steep else value
    value = _HALF_PI - value if up > side else value
    return _PI - value if out < _F(0) else value


def _turn_32(angle: Any) -> Any:
    x = angle - _HALF_PI
    q = x * x
    sine = x * (_SIN[0] + q * (_SIN[1] + q * (_SIN[2] + q * (_SIN[3] + q * (_SIN[4] + q * (_SIN[5] + q * _SIN[6]))))))
    cosine = _COS[0] + q * (_COS[1] + q * (_COS[2] + q * (_COS[3] + q * (_COS[4] + q * (_COS[5] + q * _COS[6])))))
    return -sine, cosine


def power(x: Any, exponent: Any) -> Any:
    """x ** exponent of x >= 0."""


def logarithm(x: Any) -> Any:
    """Natural logarithm of x > 0, a normal number."""


def angle(up: Any, out: Any) -> Any:
    """atan2(up, out) of up >= 0."""


def turn(angle: Any) -> Any:
    """Cosine and sine of an angle in [0, pi]."""


def rounded(x: Any) -> Any:
    """The nearest whole number, halves to even; |x| < 2^22."""


_INLINE = {"forceinline": True} | STRICT


@overload(power, jit_options=_INLINE)
def _power(x: Any, exponent: Any) -> Any:
    def plain(x: Any, exponent: Any) -> Any:
        return x**exponent

    return _power_32 if x == types.float32 else plain


@overload(logarithm, jit_options=_INLINE)
def _logarithm(x: Any) -> Any:
    def plain(x: Any) -> Any:
        return math.log(x)

    def short(x: Any) -> Any:
        octave, rest = _log2_32(x)
        return (_F(octave) + rest) * _LN2

    return short if x == types.float32 else plain


@overload(angle, jit_options=_INLINE)
def _angle(up: Any, out: Any) -> Any:
    def plain(up: Any, out: Any) -> Any:
        return math.atan2(up, out)

    return _angle_32 if up == types.float32 else plain


@overload(turn, jit_options=_INLINE)
def _turn(angle: Any) -> Any:
    def plain(angle: Any) -> Any:
        return math.cos(angle), math.sin(angle)

    return _turn_32 if angle == types.float32 else plain


@overload(rounded, jit_options=_INLINE)
def _rounded(x: Any) -> Any:
    constant = _ROUND32 if x == types.float32 else _ROUND64

    def shifted(x: Any) -> Any:
        return (x + constant) - constant

    return shifted
