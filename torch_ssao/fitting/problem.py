"""What `select` is asked: views with their targets, which of them are fitted and which are held out to judge on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torch_ssao import checks
from torch_ssao.fitting.views import SceneImages, check_scenes
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility


@final
@dataclass(frozen=True, eq=False)
class Target:
    """Reference visibility (B, 1, H, W) and its standard error, or None."""

    visibility: Tensor
    standard_error: Tensor | None


@final
@dataclass(frozen=True, eq=False)
class Sight:
    """One view with a pixel that counts.

    Args:
        label: such as "view 3", numbered through all scenes. number: that number.
        scene: which G-buffer it comes from.
        gbuffer: of this view alone.
        target: of this view alone.
        weights: (1, 1, H, W) importance or None. valid: (1, 1, H, W) bool or None; both as they were given.
        share: (1, 1, H, W) float64, the weight of each pixel, 0 where it does not count.
    """

    label: str
    number: int
    scene: int
    gbuffer: GBuffer
    target: Target
    weights: Tensor | None
    valid: Tensor | None
    share: Tensor


@final
@dataclass(frozen=True)
class ViewError:
    """Mean squared error over one view, and the view's weight (its number of pixels, unless weights were given)."""

    view: str
    mse: float
    weight: float


@final
@dataclass(frozen=True, eq=False)
class Problem:
    """Checked views.

    Args:
        training: the views that are fitted, each with a pixel that counts.
        validation: the views that are judged; the same ones where there is only one.
        notes: a sentence for each thing left out.
    """

    training: tuple[Sight, ...]
    validation: tuple[Sight, ...]
    notes: tuple[str, ...]

    @property
    def judged_on_training_views(self) -> bool:
        """Whether no view was left to judge on, so that the errors flatter the fit."""
        return self.validation is self.training

    @staticmethod
    def of(gbuffer: Any, target: Any, *, validation: Any = None, weights: Any = None, valid: Any = None) -> Problem:
        """The problem of `select`'s arguments; see there.

        Raises: ShapeError, DtypeError, ChoiceError; RangeError for targets that are not finite where they count, weights below
            0, views without a pixel that counts and a `validation` that leaves nothing to fit or to judge on.
        """
        sights, notes = _sights(gbuffer, target, weights, valid)
        if _is_pair(validation):
            views, wanted = validation
            try:
                judged, more = _sights(views, wanted, None, None, "validation view")
            except ValueError as error:
                raise type(error)(f"in validation, {error}") from error
            return Problem(sights, judged, notes + more)
        training, judged = _split(sights, validation, _count(gbuffer))
        return Problem(training, judged, notes)

    def arguments(self) -> dict[str, Any]:
        """G-buffers, targets, weights and masks of the training views as `fit` takes them."""
        scenes = sorted({sight.scene for sight in self.training})
        groups = [[sight for sight in self.training if sight.scene == scene] for scene in scenes]
        joined = [_join(group) for group in groups]
        many = {name: [items[name] for items in joined] for name in joined[0]}
        for name in ("weights", "valid"):
            if all(item is None for item in many[name]):
                many[name] = None  # type: ignore[assignment]
        if len(groups) > 1:
            return many
        return {name: items if items is None else items[0] for name, items in many.items()}

    def errors(self, module: AmbientVisibility) -> tuple[tuple[ViewError, ...], tuple[ViewError, ...]]:
        """Mean squared errors of each validation view and of each training view, without gradients, view by view.

        Raises: RangeError where a prediction is not finite.
        """
        if self.judged_on_training_views:
            found = tuple(_error(module, sight) for sight in self.training)
            return found, found
        validation, training = (
            tuple(_error(module, sight) for sight in part) for part in (self.validation, self.training)
        )
        return validation, training

    def fingerprint(self) -> str:
        """SHA-256 of everything a fit and its errors depend on."""
        digest = hashlib.sha256()
        for part in (self.training, self.validation):
            digest.update(f"part {len(part)}".encode())
            for sight in part:
                noise = sight.target.standard_error
                leaves = pytree.tree_leaves(sight.gbuffer)
                camera = sight.gbuffer.camera
                frame = (sight.label, sight.scene, camera.height, camera.width, camera.is_orthographic, len(leaves))
                names = [name for name in ("normal", "triangles") if getattr(sight.gbuffer, name) is not None]
                digest.update(f"{frame} {names}".encode())
                images = (sight.target.visibility, sight.share, noise, sight.weights, sight.valid)
                for tensor in (*leaves, *images):
                    digest.update(tensor_bytes(tensor))
        return digest.hexdigest()


def rmse(errors: Sequence[ViewError]) -> float:
    """Root of the mean squared error over all pixels of some views."""
    total = sum(error.weight for error in errors)
    return float((sum(error.weight * error.mse for error in errors) / total) ** 0.5)


def tensor_bytes(tensor: Tensor | None) -> bytes:
    """Dtype, shape and bytes of a tensor, for hashes."""
    if tensor is None:
        return b"none"
    plain = (
        tensor.detach().cpu().clone(memory_format=torch.contiguous_format)
    )  # one that is expanded cannot be viewed as bytes
    content = plain.reshape(-1).view(torch.uint8).numpy().tobytes() if plain.numel() else b""
    return f"{plain.dtype} {tuple(plain.shape)} ".encode() + content


def _error(module: AmbientVisibility, sight: Sight) -> ViewError:
    with torch.no_grad():
        prediction = module(sight.gbuffer).double()
        gap = torch.where(sight.share > 0, prediction - sight.target.visibility.to(prediction), 0.0)
    total = float(sight.share.sum())
    mse = float((sight.share * gap.square()).sum()) / total
    if not mse < float("inf"):
        raise checks.RangeError(
            f"module must predict finite visibility, got some that is not in {sight.label}: check its parameters"
        )
    return ViewError(sight.label, mse, total)


def _join(group: Sequence[Sight]) -> dict[str, Any]:
    """The views of one scene as a batch."""
    noises = [sight.target.standard_error for sight in group]
    image = torch.cat([sight.target.visibility for sight in group])
    noise = None if noises[0] is None else torch.cat([item for item in noises if item is not None])
    found: dict[str, Any] = {
        "gbuffer": GBuffer.cat([sight.gbuffer for sight in group]),
        "target": image if noise is None else Target(image, noise),
    }
    for name in ("weights", "valid"):
        items = [getattr(sight, name) for sight in group]
        found[name] = None if items[0] is None else torch.cat(items)
    return found


def _count(gbuffer: Any) -> int:
    return len(gbuffer) if isinstance(gbuffer, GBuffer) else sum(map(len, gbuffer))


def _is_pair(validation: Any) -> bool:
    if not isinstance(validation, tuple | list) or len(validation) != 2:
        return False
    first = validation[0]
    return isinstance(first, GBuffer) or (isinstance(first, Sequence) and bool(first) and isinstance(first[0], GBuffer))


def _split(sights: tuple[Sight, ...], validation: Any, count: int) -> tuple[tuple[Sight, ...], tuple[Sight, ...]]:
    """Training and validation views; one and the same tuple where there is only one view."""
    if validation is None:
        if len(sights) == 1:
            return sights, sights
        kept = len(sights) - len(sights) // 2
        return sights[:kept], sights[kept:]
    chosen = _indices(validation, count)
    held = tuple(sight for sight in sights if sight.number in chosen)
    rest = tuple(sight for sight in sights if sight.number not in chosen)
    for part, what in ((held, "to judge on"), (rest, "to fit")):
        if not part:
            raise checks.RangeError(
                f"validation must leave views {what}, got {sorted(chosen)} of {count} views, of which {len(sights)} have pixels "
                f"that count: pass None for the last half"
            )
    return rest, held


def _indices(validation: Any, count: int) -> set[int]:
    plain = validation.tolist() if hasattr(validation, "tolist") else validation  # arrays and tensors
    listed = [plain] if isinstance(plain, int) else list(plain) if isinstance(plain, Iterable) else [plain]
    for index in listed:
        checks.check_count("validation", index, 0, count - 1)
    return set(listed)


def _sights(
    gbuffer: Any, target: Any, weights: Any, valid: Any, kind: str = "view"
) -> tuple[tuple[Sight, ...], tuple[str, ...]]:
    """Every view with a pixel that counts, and a note for each other."""
    found: list[Sight] = []
    empty: list[str] = []
    number = 0
    for place, scene in enumerate(check_scenes(gbuffer, target, weights, valid)):
        for index in range(len(scene.gbuffer)):
            sight = _sight(scene, index, place, number, f"{kind} {number}")
            if bool((sight.share > 0).any()):
                replace(scene, tag="").check_finite(index, sight.label)  # views are numbered through
                found.append(sight)
            else:
                empty.append(sight.label)
            number += 1
    if not found:
        listed = ", ".join(empty) or "no view"
        raise checks.RangeError(
            f"gbuffer must have a valid pixel that counts, got none in {listed}: choose other views"
        )
    return tuple(found), tuple(f"{label} has no valid pixel and was left out." for label in empty)


def _sight(scene: SceneImages, index: int, place: int, number: int, label: str) -> Sight:
    def cut(image: Tensor | None) -> Tensor | None:
        return None if image is None else image[index : index + 1]

    return Sight(
        label=label,
        number=number,
        scene=place,
        gbuffer=scene.gbuffer[index],
        target=Target(scene.visibility[index : index + 1], cut(scene.standard_error)),
        weights=cut(scene.weights),
        valid=cut(scene.valid),
        share=scene.share[index : index + 1],
    )
