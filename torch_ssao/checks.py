"""Errors that name the argument, what was expected, what came, and the remedy."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor


class ShapeError(ValueError):
    """A tensor argument has the wrong shape."""


class DtypeError(ValueError):
    """A tensor argument has the wrong dtype."""


class DeviceError(ValueError):
    """Tensor arguments lie on different devices."""


class RangeError(ValueError):
    """A number lies outside the range in which it means something."""


class ChoiceError(ValueError):
    """A name is not one of those that exist."""


class SceneError(ValueError):
    """A mesh, a camera file or a view cannot be used."""


class MissingExtraError(ValueError):
    """A library of an optional extra is not installed."""


class OutputError(ValueError):
    """A result cannot be written where it was asked for."""


def check_shape(name: str, tensor: Tensor, expected: Sequence[int | str], remedy: str) -> None:
    """Raise `ShapeError` unless `tensor` has the shape `expected` (an int is exact, a letter any size)."""
    actual = tuple(tensor.shape)
    fits = len(actual) == len(expected) and all(
        isinstance(want, str) or want == have for want, have in zip(expected, actual, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join(str(want) for want in expected) + ")"
        raise ShapeError(f"{name} must have shape {wanted}, got {actual}: {remedy}")


def check_floating(name: str, tensor: Tensor) -> None:
    """Raise `DtypeError` unless `tensor` has a floating-point dtype."""
    if not isinstance(tensor, Tensor):
        raise DtypeError(f"{name} must be a torch.Tensor, got {type(tensor).__name__}: wrap it in torch.as_tensor")
    if not tensor.is_floating_point():
        raise DtypeError(f"{name} must be floating point, got {tensor.dtype}: convert it with .float()")


def check_same_device(**tensors: Tensor | None) -> None:
    """Raise `DeviceError` unless all tensors that are given lie on one device."""
    devices = {name: tensor.device for name, tensor in tensors.items() if tensor is not None}
    if len(set(devices.values())) > 1:
        listed = ", ".join(f"{name} on {device}" for name, device in devices.items())
        raise DeviceError(f"{listed}: move them to one device with .to(device)")


def check_positive(name: str, value: float | Tensor) -> None:
    """Raise `RangeError` unless every element of `value` is finite and above zero."""
    if isinstance(value, Tensor):
        good = bool(((value > 0) & torch.isfinite(value)).all())
        shown = f"a tensor with minimum {value.min().item():g}" if value.numel() else "an empty tensor"
    else:
        good = isinstance(value, (int, float)) and math.isfinite(value) and value > 0
        shown = repr(value)
    if not good:
        raise RangeError(f"{name} must be finite and greater than 0, got {shown}: pass a positive {name}")


def check_count(name: str, value: int, low: int, high: int | None = None) -> None:
    """Raise `RangeError` unless `value` is an int with low <= value <= high."""
    whole = isinstance(value, int) and not isinstance(value, bool)
    if not whole or value < low or (high is not None and value > high):
        span = f"at least {low}" if high is None else f"between {low} and {high}"
        raise RangeError(f"{name} must be a whole number {span}, got {value!r}: choose one in that range")


def check_choice(name: str, value: object, choices: Iterable[object]) -> None:
    """Raise `ChoiceError` unless `value` is one of `choices`."""
    listed = list(choices)
    if value not in listed:
        raise ChoiceError(f"{name} must be one of {', '.join(map(repr, listed))}, got {value!r}: pick one of these")


def check_output_folder(name: str, folder: str | Path) -> Path:
    """Make `folder` and return it; raise `OutputError` if nothing can be written there."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".write-probe-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(
            f"{name} {str(path)!r} is not writable ({reason}): pass a folder that you may write to"
        ) from error
    return path
