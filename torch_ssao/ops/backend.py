"""Which implementation of an op runs: a backend changes speed, never the number."""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec

from torch import Tensor

from torch_ssao import checks

BACKENDS = ("auto", "torch", "numba")


def uses_numba(backend: str, tensor: Tensor, *, lacking: str | None = None) -> bool:
    """Whether the compiled loops are asked for and can answer.

    Args:
        backend: "torch"; "numba"; or "auto": numba for tensors on the CPU where it is installed and the op has loops, else torch.
        tensor: of the op, on its device.
        lacking: what the loops do not have of what is asked; None: nothing.
    Raises: ChoiceError; DeviceError or MissingExtraError where "numba" is asked for and cannot answer.
    """
    checks.check_choice("backend", backend, BACKENDS)
    if backend == "torch":
        return False
    on_cpu, fits = tensor.device.type == "cpu", tensor.dtype.itemsize in (4, 8)
    if backend == "auto":
        return on_cpu and fits and lacking is None and numba_is_installed()
    if not on_cpu:
        raise checks.DeviceError(
            f"backend 'numba' needs tensors on the CPU, got {tensor.device}: use 'auto' or 'torch'"
        )
    if not fits:
        raise checks.DtypeError(f"backend 'numba' needs float32 or float64, got {tensor.dtype}: use 'auto' or 'torch'")
    if lacking is not None:
        raise checks.ChoiceError(f"backend 'numba' has no {lacking}: use 'auto' or 'torch'")
    if not numba_is_installed():
        raise checks.MissingExtraError("backend 'numba' needs numba: pip install 'torch_ssao[cpu]'")
    return True


@lru_cache(maxsize=1)
def numba_is_installed() -> bool:
    """Without importing it."""
    return find_spec("numba") is not None
