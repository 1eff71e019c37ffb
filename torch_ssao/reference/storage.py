"""The reference record and its npz files."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from torch_ssao import checks

_FORMAT = "torch_ssao reference 1"
_DAMAGE = (EOFError, KeyError, ValueError, TypeError, AttributeError, IndexError, zipfile.BadZipFile, zlib.error)
_IMAGES = {"visibility": torch.float32, "standard_error": torch.float32, "valid": torch.bool}


@final
@dataclass(frozen=True, eq=False)
class Reference:
    """Ray-traced visibility of some views of a scene, and how far to trust it.

    Args:
        visibility: (B, 1, H, W) float32 in [0, 1], 1 = open; 1 where nothing is seen.
        standard_error: (B, 1, H, W) float32, of each pixel's visibility; its square is unbiased, so average squares
            over pixels, then take the root. 0 where nothing is seen.
        valid: (B, 1, H, W) bool, pixels that see a surface.
        samples: rays a pixel.
        radius: length of the rays in scene units.
        falloff: attenuation of a hit by its distance, "binary", "linear" or "quadratic".
        seed: of the rays.
        scene: name of the scene.
        fingerprint: `Scene.fingerprint` of its mesh and views.
        views: indices of the views, one per image.
    Raises: ShapeError, DtypeError.
    """

    visibility: Tensor
    standard_error: Tensor
    valid: Tensor
    samples: int
    radius: float
    falloff: str
    seed: int
    scene: str
    fingerprint: str
    views: tuple[int, ...]

    def __post_init__(self) -> None:
        for name, dtype in _IMAGES.items():
            tensor = getattr(self, name)
            checks.check_shape(name, tensor, (len(self.views), 1, *self.visibility.shape[2:]), "one image per view")
            if tensor.dtype != dtype:
                raise checks.DtypeError(f"{name} must be {dtype}, got {tensor.dtype}: convert it first")

    def __len__(self) -> int:
        return int(self.visibility.shape[0])

    @property
    def noise(self) -> float:
        """Root mean square of the standard error over valid pixels: the RMSE that a perfect technique would show."""
        kept = self.standard_error[self.valid].double()
        return float(kept.square().mean().sqrt()) if kept.numel() else 0.0


def save(result: Reference, path: str | Path) -> None:
    """Write a reference as a compressed npz without pickled objects; a file of that name is replaced in one step.

    Args:
        result: from `raytrace`.
        path: file to write, in a folder that exists or can be made.
    Raises: OutputError when the file cannot be written; an earlier file is then left as it was.
    """
    target = Path(path)
    checks.check_output_folder("path's folder", target.parent)
    facts = {"format": _FORMAT, "views": list(result.views)}
    facts |= {name: getattr(result, name) for name in ("samples", "radius", "falloff", "seed", "scene", "fingerprint")}
    images = {name: getattr(result, name).detach().cpu().numpy() for name in _IMAGES}
    temporary: Path | None = None
    try:
        # In the same folder, so that the rename cannot cross file systems.
        with tempfile.NamedTemporaryFile(dir=target.parent, prefix=f".{target.name}-", delete=False) as file:
            temporary = Path(file.name)
            np.savez_compressed(file, facts=np.array(json.dumps(facts)), **images)
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # temporary files are private, results are not
        os.replace(temporary, target)
    except OSError as error:
        raise checks.OutputError(
            f"path {str(target)!r} must be writable, got {error.strerror or error}: choose another or free some space"
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def load(path: str | Path) -> Reference:
    """Read a reference that `save` wrote; nothing in the file is executed.

    Args:
        path: npz file.
    Raises: SceneError when the file is missing, cannot be read, is truncated or is something else.
    """
    source = Path(path)
    try:
        with zipfile.ZipFile(source) as archive:
            if archive.testzip() is not None:  # numpy does not read far enough to reach the checksums
                raise zipfile.BadZipFile("checksum")
        with np.load(source, allow_pickle=False) as file:
            facts = json.loads(str(file["facts"]))
            if facts.pop("format") != _FORMAT:
                raise KeyError("format")
            images: dict[str, Any] = {name: torch.from_numpy(file[name]) for name in _IMAGES}
        return Reference(**images, **(facts | {"views": tuple(facts["views"])}))
    except OSError as error:
        reason = error.strerror or error
        raise checks.SceneError(
            f"path {str(source)!r} must be a saved reference, got {reason}: check the name"
        ) from error
    except _DAMAGE as error:
        raise checks.SceneError(
            f"path {str(source)!r} must be a file of reference.save, got a damaged or foreign one: trace it again"
        ) from error
