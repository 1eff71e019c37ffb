"""Which errors are for the caller, and how they are told in one line."""

from __future__ import annotations

import errno
from typing import final

_EXTRAS = {
    "scenes": ("trimesh", "embreex", "PIL", "tqdm", "platformdirs"),
    "fitting": ("optimistix", "jax", "jaxlib", "equinox", "lineax"),
    "report": ("matplotlib",),
}


@final
class CommandLineError(ValueError):
    """The command line cannot be understood."""


def is_for_the_caller(error: Exception) -> bool:
    """Whether an error is meant for a person; another package's ValueError is a bug and keeps its traceback."""
    if type(error).__module__.startswith("torch_ssao."):
        return True
    return _extra(error) is not None if isinstance(error, ImportError) else isinstance(error, OSError)


def one_line(error: Exception) -> str:
    """The error's text in one line; a missing package with how to install it."""
    if isinstance(error, ImportError) and _extra(error):
        return f"{error.name} is not installed: run pip install 'torch_ssao[{_extra(error)}]'"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        where = "" if error.filename is None else f" for {error.filename}"
        return f"{error.strerror}{where}: free some, and the same command goes on with what was finished".replace(
            "\n", " "
        )
    return " ".join(str(error).split()) or type(error).__name__


def _extra(error: ImportError) -> str | None:
    top = (error.name or "").partition(".")[0]
    return next((extra for extra, packages in _EXTRAS.items() if top in packages), None)
