"""Ray-traced references of single views, kept on disk, and how well a perfect model would score against them."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import torch
from torch import Tensor

from torch_ssao import metrics

if TYPE_CHECKING:
    from torch_ssao.reference import Reference
    from torch_ssao.scenes import Scene

CEILING_SEED_STEP = 1
"""The second reference of the noise ceiling is traced with the seed of the first plus this."""


@final
@dataclass(frozen=True, eq=False)
class Truth:
    """Reference visibility of some views.

    Args:
        visibility: (B, 1, H, W) in [0, 1], 1 where a pixel is invalid.
        standard_error: (B, 1, H, W) of the visibility.
        valid: (B, 1, H, W) bool, pixels that see a surface.
    """

    visibility: Tensor
    standard_error: Tensor
    valid: Tensor

    def __getitem__(self, rows: Sequence[int]) -> Truth:
        index = list(rows)
        return Truth(self.visibility[index], self.standard_error[index], self.valid[index])


@final
@dataclass(frozen=True)
class TraceSettings:
    """What a reference depends on besides the mesh and the view.

    Args:
        height, width: pixels.
        radius: scene units.
        samples: rays a pixel, a power of two.
        seed, falloff: see `reference.raytrace`.
    """

    height: int
    width: int
    radius: float
    samples: int
    seed: int = 0
    falloff: str = "binary"


@final
@dataclass(frozen=True)
class Ceiling:
    """What a perfect model would score against the reference: its noise is all that is left.

    Args:
        rmse: root of the mean squared standard error over the judged pixels.
        psnr: -20 log10(rmse).
        ssim: 1 - (1 - ssim_pair) / 2: only one of the two pictures compared is noisy.
        rmse_pair: RMSE between two independent references of that sample count, divided by sqrt(2): a check of `rmse`.
        ssim_pair: SSIM between these two, a lower bound of the ceiling.
    """

    rmse: float
    psnr: float
    ssim: float
    rmse_pair: float
    ssim_pair: float


def trace_views(
    scene: Scene,
    views: Iterable[int],
    settings: TraceSettings,
    folder: Path,
    *,
    progress: bool | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> Truth:
    """Ray-traced references of some views, each read from `folder` where it was traced before.

    Args:
        scene: what is traced.
        views: indices into `scene.cameras`; the batch follows their order.
        settings: size, radius, samples, seed and falloff.
        folder: where `reference_<view>_<fingerprint>.npz` are read and written, one a view: an interrupted run keeps
            what it finished. The fingerprint covers mesh, views, settings and the package's version. A file that is
            truncated, foreign or made for something else is traced again and replaced.
        progress: bar of the tracer; None shows it on a terminal only.
        note: called with one line before each view that has to be traced.
    Raises: as `reference.raytrace`.
    """
    from torch_ssao import reference

    kept: list[Truth] = []
    for view in views:
        path = folder / f"reference_{view}_{_fingerprint(scene, view, settings)}.npz"
        truth = _read(path, scene, view, settings)
        if truth is None:
            note(f"tracing view {view} with {settings.samples} rays a pixel, seed {settings.seed}")
            traced = reference.raytrace(scene, views=[view], progress=progress, **asdict(settings))
            reference.save(traced, path)
            truth = _truth(traced)
        kept.append(truth)
    images = ("visibility", "standard_error", "valid")
    return Truth(*(torch.cat([getattr(truth, name) for truth in kept]) for name in images))


def noise_ceiling(first: Truth, second: Truth) -> Ceiling:
    """Score of a perfect model against `first`, whose noise is measured against `second`.

    Args:
        first, second: references of the same views and sample count with different seeds.
    Returns: see `Ceiling`. With reference = truth + noise of standard error s, a perfect model's RMSE is
        sqrt(mean(s^2)). Two references differ by twice that variance, and for small noise 1 - SSIM is proportional to
        the variance: hence the halving.
    """
    valid = first.valid & second.valid
    rmse = float(first.standard_error[first.valid].double().square().mean().sqrt())
    pair = float(metrics.rmse(first.visibility, second.visibility, valid))
    ssim = float(metrics.ssim(first.visibility, second.visibility, valid))
    psnr = -20 * math.log10(rmse) if rmse > 0 else math.inf
    return Ceiling(rmse, psnr, 1 - (1 - ssim) / 2, pair / math.sqrt(2), ssim)


def _fingerprint(scene: Scene, view: int, settings: TraceSettings) -> str:
    from torch_ssao import __version__

    parts: dict[str, Any] = {"scene": scene.fingerprint, "view": view, "version": __version__, **asdict(settings)}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def _read(path: Path, scene: Scene, view: int, settings: TraceSettings) -> Truth | None:
    """The reference in `path`, or None where there is none that can be trusted."""
    from torch_ssao import reference

    try:
        stored = reference.load(path)
    except ValueError:  # missing, truncated or something else
        return None
    facts = (stored.fingerprint, stored.views, tuple(stored.visibility.shape[2:]), *_traced_with(stored))
    wanted = (scene.fingerprint, (view,), (settings.height, settings.width), *_traced_with(settings))
    return _truth(stored) if facts == wanted else None


def _traced_with(facts: Reference | TraceSettings) -> tuple[float, int, int, str]:
    return float(facts.radius), facts.samples, facts.seed, facts.falloff


def _truth(traced: Reference) -> Truth:
    return Truth(traced.visibility, traced.standard_error, traced.valid)
