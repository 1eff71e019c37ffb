"""The horizon obscurance as compiled loops: the kernel beside `ops.horizon`'s, with the same tensors and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_ssao.ops._numba import horizon_rows as rows
from torch_ssao.ops._numba import taps, taps_back
from torch_ssao.ops._numba.arrays import as_array, as_pyramid, wanted
from torch_ssao.ops._numba.pool import Spare, row_blocks, run_blocks
from torch_ssao.ops.recompute import Outputs


class HorizonLoops(NamedTuple):
    """See `recompute.Kernel`. Forward mode is the torch kernel's."""

    torch_kernel: Any  # `ops.horizon._Horizon`: a Kernel, and what was asked
    name: str = "horizon_obscurance"

    def value(self, *tensors: Tensor | None) -> Outputs:
        images = _Images(self.torch_kernel, tensors)
        out = np.empty(images.shape, images.dtype)

        def work(number: int) -> None:
            image, first, last = images.blocks[number]
            rows.rows_value(out[image], *images.question(image), first, last)

        run_blocks(len(images.blocks), work, lambda _: None)
        return (torch.from_numpy(out)[:, None],)

    def pull_back(
        self, grad: Tensor, needed: Sequence[bool], outputs: Outputs, *tensors: Tensor | None
    ) -> list[Tensor]:
        images = _Images(self.torch_kernel, tensors)
        cotangent = as_array(grad[:, 0])
        batch, height, width = images.shape
        to_texels = np.zeros((batch, 3 * height * width), images.dtype)
        to_normal = np.empty((batch, 3, height, width), images.dtype)
        to_numbers = np.zeros((batch, 8))
        spare = Spare((3 * height * width,), images.dtype)

        def work(number: int) -> tuple[int, Any, Any, Any]:
            image, first, last = images.blocks[number]
            part, numbers, reached = spare.take(), np.zeros(8), np.zeros(2, np.int32)
            rows.rows_pull_back(
                cotangent[image], part, reached, to_normal[image], numbers, *images.question(image),
                self.torch_kernel.footprint_step, first, last,
            )  # fmt: skip
            return image, part, numbers, reached

        def hand_over(found: tuple[int, Any, Any, Any]) -> None:
            image, part, numbers, reached = found
            rows.hand_over(to_texels[image], part, reached)
            to_numbers[image] += numbers
            spare.give_back(part)

        run_blocks(len(images.blocks), work, hand_over)
        planes = torch.from_numpy(to_texels).view(batch, height, width, 3).permute(0, 3, 1, 2)
        return self._found(planes, torch.from_numpy(to_normal), torch.from_numpy(to_numbers), needed, tensors)

    def push_forward(self, tangents: Sequence[Tensor | None], outputs: Outputs, *tensors: Tensor | None) -> Tensor:
        return self.torch_kernel.push_forward(tangents, outputs, *tensors)  # type: ignore[no-any-return]

    @staticmethod
    def _found(
        planes: Tensor, normal: Tensor, numbers: Tensor, needed: Sequence[bool], tensors: Sequence[Tensor | None]
    ) -> list[Tensor]:
        numbers = numbers.to(planes.dtype)
        scalars = [numbers[:, i] for i in (taps_back.R, taps_back.FALLOFF, taps_back.THICKNESS, taps_back.BIAS)]
        everything = [planes, None, normal, numbers[:, :4], *scalars]
        return wanted(everything, needed, tensors)


class _Images:
    """The tensors of a question as arrays, and how its images fall into blocks of rows."""

    def __init__(self, kernel: Any, tensors: Sequence[Tensor | None]) -> None:
        planes, valid, normal, intrinsics, radius, falloff, thickness, bias = tensors
        self.shape = tuple(valid.shape)  # type: ignore[union-attr]
        batch, height, _ = self.shape
        self.kernel, layout = kernel, kernel.layout
        self.texels = _texels(planes, valid)  # type: ignore[arg-type]
        self.dtype = self.texels.dtype
        self.normal = as_array(normal)  # type: ignore[arg-type]
        self.noise = as_array(kernel.rotation), as_array(kernel.offset)
        longest = np.inf if layout.longest_px is None else layout.longest_px
        numbers = np.empty((batch, taps.IMAGE_NUMBERS), self.dtype)
        numbers[:, :4] = as_array(intrinsics)  # type: ignore[arg-type]
        for place, given in enumerate((radius, falloff, thickness, bias)):
            numbers[:, taps.R + place] = np.inf if given is None else as_array(given)
        numbers[:, taps.LONGEST_PX] = longest
        numbers[:, taps.BIAS_COSINE], numbers[:, taps.BIAS_SINE] = (f(numbers[:, taps.BIAS]) for f in (np.cos, np.sin))
        self.numbers = numbers
        connected = kernel.connected and kernel.estimator == "bitmask"
        self.network = sorting_network(layout.steps * (2 if connected else 1))
        self.form = np.array(
            [0, layout.slices, layout.steps, layout.orthographic, layout.extend, kernel.cosine,
             kernel.estimator == "increments", connected, layout.max_radius_px is not None],
            dtype=np.int64,
        )  # fmt: skip
        self.pyramid = as_pyramid(valid, layout.max_radius_px)  # type: ignore[arg-type]
        self.blocks = row_blocks(batch, height)

    def question(self, image: int) -> tuple[Any, ...]:
        """What the loops take of an image, in their order."""
        form = self.form.copy()
        form[rows.IMAGE] = image
        return (
            self.texels[image], self.normal[image], *self.noise, self.numbers[image], self.network, self.pyramid, form,
            float(self.kernel.layout.step_power),
        )  # fmt: skip


def _texels(planes: Tensor, valid: Tensor) -> Any:
    """(B, 4 H W): the plane of every pixel, together in memory, 0 where invalid, and its own level."""
    batch, height, width = valid.shape
    texels = torch.empty(batch, height, width, 4, dtype=planes.dtype)
    texels[..., :3] = torch.where(valid[:, None], planes, 0.0).permute(0, 2, 3, 1)
    texels[..., 3] = planes[:, 0]
    return texels.view(batch, -1).numpy()


@lru_cache(maxsize=64)
def sorting_network(count: int) -> Any:
    """(N, 2) int32 pairs of places that, put in order one after the other, sort `count` values: odd-even merge sort.

    Source: Batcher 1968.
    """
    pairs = []
    size = 1
    while size < count:
        reach = size
        while reach >= 1:
            for start in range(reach % size, count - reach, 2 * reach):
                for low in range(start, min(start + reach, count - reach)):
                    if low // (2 * size) == (low + reach) // (2 * size):
                        pairs.append((low, low + reach))
            reach //= 2
        size *= 2
    return np.array(pairs, np.int32).reshape(-1, 2)
