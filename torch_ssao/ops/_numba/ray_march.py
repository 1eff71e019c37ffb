"""The ray march as compiled loops: the kernel beside `ops.ray_march`'s, with the same tensors and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_ssao.ops._numba import march
from torch_ssao.ops._numba import march_rows as rows
from torch_ssao.ops._numba.arrays import as_array, as_pyramid, wanted
from torch_ssao.ops._numba.pool import Spare, row_blocks, run_blocks
from torch_ssao.ops.recompute import Outputs


class MarchLoops(NamedTuple):
    """See `recompute.Kernel`; gradient "exact". Forward mode is the torch kernel's."""

    torch_kernel: Any  # `ops.ray_march._March`: a Kernel, and what was asked
    name: str = "ray_march_visibility"

    def value(self, *tensors: Tensor | None) -> Outputs:
        images = _Images(self.torch_kernel, tensors)
        visibility, weight = (np.empty((images.batch, images.pixels), images.dtype) for _ in range(2))

        def work(number: int) -> None:
            image, first, last = images.blocks[number]
            rows.rows_value(visibility[image], weight[image], *images.question(image), first, last)

        run_blocks(len(images.blocks), work, lambda _: None)
        return torch.from_numpy(visibility), torch.from_numpy(weight)

    def pull_back(
        self, grad: Tensor, needed: Sequence[bool], outputs: Outputs, *tensors: Tensor | None
    ) -> list[Tensor]:
        images = _Images(self.torch_kernel, tensors)
        cotangent, weight = as_array(grad), as_array(outputs[1])
        size = 4 * images.layers
        to_stored = np.zeros((images.batch, size * images.pixels), images.dtype)
        to_pixels = np.zeros((images.batch, 7, images.pixels), images.dtype)
        to_falloff = np.zeros((images.batch, 1))
        spare = Spare((size * images.pixels,), images.dtype)
        step = self.torch_kernel.reach_step if needed[2] else 0.0  # a difference costs two more marches

        def work(number: int) -> tuple[int, Any, Any, Any]:
            image, first, last = images.blocks[number]
            part, falloff, reached = spare.take(), np.zeros(1), np.zeros(2, np.int32)
            rows.rows_pull_back(
                cotangent[image], weight[image], step, part, reached, to_pixels[image], falloff,
                *images.question(image), first, last,
            )  # fmt: skip
            return image, part, falloff, reached

        def hand_over(found: tuple[int, Any, Any, Any]) -> None:
            image, part, falloff, reached = found
            rows.hand_over(to_stored[image], part, reached, size)
            to_falloff[image] += falloff
            spare.give_back(part)

        run_blocks(len(images.blocks), work, hand_over)
        pixels = torch.from_numpy(to_pixels)
        falloff = torch.from_numpy(to_falloff)[:, 0].to(pixels.dtype)
        planes = torch.from_numpy(to_stored).view(images.batch, images.pixels, images.layers, 4)
        everything = [pixels[:, :3], pixels[:, 3:6], pixels[:, 6], falloff, torch.zeros_like(falloff), planes]
        return wanted(everything, needed, tensors)

    def push_forward(self, tangents: Sequence[Tensor | None], outputs: Outputs, *tensors: Tensor | None) -> Tensor:
        return self.torch_kernel.push_forward(tangents, outputs, *tensors)  # type: ignore[no-any-return]


class _Images:
    """The tensors of a question as arrays, and how its images fall into blocks of rows."""

    def __init__(self, kernel: Any, tensors: Sequence[Tensor | None]) -> None:
        position, normal, reach, falloff, thickness, planes, valid, intrinsics = tensors
        self.spec = spec = kernel.spec
        self.batch, self.pixels, self.layers = tuple(valid.shape)  # type: ignore[union-attr,var-annotated]
        self.stored = _stored(planes, valid)  # type: ignore[arg-type]
        self.dtype = self.stored.dtype
        self.known = as_array(valid[:, :, 0])  # type: ignore[index]
        self.own = [as_array(tensor) for tensor in (position, normal, reach)]  # type: ignore[arg-type]
        self.noise = as_array(kernel.rotation), as_array(kernel.offset)
        self.disk = as_array(kernel.disk)
        self.numbers = np.empty((self.batch, march.IMAGE_NUMBERS), self.dtype)
        self.numbers[:, :4] = as_array(intrinsics)  # type: ignore[arg-type]
        self.numbers[:, march.FALLOFF] = as_array(falloff)  # type: ignore[arg-type]
        self.numbers[:, march.THICKNESS] = np.inf if thickness is None else as_array(thickness)
        capped = spec.max_radius_px is not None
        self.form = np.array([0, spec.steps, self.layers, spec.orthographic, capped], dtype=np.int64)
        known = valid.any(2).unflatten(1, (spec.height, spec.width))  # type: ignore[union-attr]
        self.pyramid = as_pyramid(known, spec.max_radius_px)
        self.blocks = row_blocks(self.batch, spec.height)

    def question(self, image: int) -> tuple[Any, ...]:
        """What the loops take of an image, in their order."""
        form = self.form.copy()
        form[rows.IMAGE] = image
        tensors = (*(array[image] for array in self.own), *self.noise)
        return (
            self.known[image], tensors, self.disk, self.numbers[image], self.stored[image], self.pyramid, form,
            self.spec.height, self.spec.width,
        )  # fmt: skip


def _stored(planes: Tensor, valid: Tensor) -> Any:
    """(B, N L 4): planes, with an offset of -inf where invalid."""
    stored = planes.detach().clone(memory_format=torch.contiguous_format)
    stored[..., 3].masked_fill_(~valid, -torch.inf)
    return stored.view(len(planes), -1).numpy()
