"""StatVO's partition of depth samples into layers: uniform slices, or a tree that splits every node at its own local mean."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_ssao.ops import sat
from torch_ssao.ops.sat import Lattice

ROUNDING = 8.0  # depths and heights within this many units of rounding count as equal: a plane must not split itself
EMPTY = 1e-12  # pixels of a node in a window below which there is no mean to compare with: the sample counts as lower
MIN_COUNT = 1e-6  # pixels of a layer inside a window below which its mean is all rounding: the layer is left out


@dataclass(frozen=True)
class Samples:
    """What is partitioned and averaged: pixels, or blocks of pixels when tables are approximate.

    Args:
        position: (B, 3, L, h, w) mean view-space position, finite everywhere, scene units.
        mass: (B, L, h, w) number of valid pixels that a sample stands for; 0 leaves it out. Any dtype.
        half: (B, 2, L, h, w) half-size of its window in pixels (x, y).
        size: (H, W) of the image in pixels.
        block: pixels per sample on each axis.
    """

    position: Tensor
    mass: Tensor
    half: Tensor
    size: tuple[int, int]
    block: int = 1

    def centre(self) -> Tensor:
        """(B, 3) float64 mean position of all: what tables are relative to, so that they lose nothing to a large depth."""
        mass = self.mass[:, None].double()
        return (self.position * mass).flatten(2).sum(2) / mass.flatten(2).sum(2).clamp(min=1)

    def table_rounding(self, centre: Tensor) -> Tensor:
        """(B,) bound on the rounding of a box sum of positions relative to `centre`, scene units."""
        apart = torch.zeros_like(self.mass, dtype=torch.float64)
        for axis in range(3):
            apart += (self.position[:, axis].double() - centre[:, axis, None, None, None]).square_()
        return ROUNDING * torch.finfo(torch.float64).eps * (apart.sqrt_() * self.mass).flatten(1).sum(1)

    def windows(self, values: int, *, scatter: bool = False) -> Iterator[tuple[slice, Lattice]]:
        """The samples' own windows, block of rows by block of rows of the L stacked images."""
        half = self.half.flatten(2, 3)
        rows, columns = half.shape[2:]
        blocks = (
            sat.scatter_blocks(rows, columns)
            if scatter
            else sat.row_blocks(slice(0, rows), columns, values, half.device)
        )
        for part in blocks:
            yield (
                part,
                Lattice.around_pixels(half[:, :, part], self.size, rows=part, block=self.block, coarse=self.block > 1),
            )


def uniform_labels(samples: Samples, layers: int) -> Tensor:
    """Slices of equal thickness between the nearest and the farthest sample of each image.

    Args:
        samples: see `Samples`.
        layers: number of slices, 1 to 256.
    Returns: (B, L, h, w) uint8.
    Gradients: none.
    Source: Statistical Volumetric Obscurance, Sec. 4.
    """
    depth = samples.position[:, 2].double()
    kept = samples.mass > 0
    near = torch.where(kept, depth, torch.inf).flatten(1).amin(1)[:, None, None, None]
    far = torch.where(kept, depth, -torch.inf).flatten(1).amax(1)[:, None, None, None]
    thickness = torch.where(far > near, far - near, torch.inf)
    fraction = torch.where(kept, (depth - near) / thickness, 0.0)
    return (fraction * layers).floor().clamp(0, layers - 1).to(torch.uint8)


def adaptive_labels(samples: Samples, layers: int) -> Tensor:
    """Layer of every sample: each round splits a node at its own local mean depth.

    A sample goes to the upper (nearer) child where its depth is less than the mean depth of its node's samples in its own
    window, else to the lower; log2(layers) rounds.

    Args:
        samples: see `Samples`.
        layers: number of leaves, a power of two up to 256.
    Returns: (B, L, h, w) uint8 labels in [0, layers); a sample without mass carries one too, which means nothing.
    Gradients: none, labels are discrete; `ops.soft_partition` has the surrogate.
    Cost: layers - 1 two-channel tables, one alive at a time.
    Source: Statistical Volumetric Obscurance, Sec. 5.
    """
    return Partition(samples).labels(layers.bit_length() - 1)


class Partition:
    """The adaptive partition of one set of samples: node tables, the means in every sample's window, the decisions."""

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        centre = samples.centre()
        depth = samples.position[:, 2]
        self.centre = centre[:, 2, None, None, None]
        self.kept = samples.mass > 0
        self.lost = samples.table_rounding(centre)[:, None, None]  # broadcasts to (B, rows, w)
        self.eps = ROUNDING * torch.finfo(depth.dtype).eps

    def labels(self, rounds: int) -> Tensor:
        """(B, L, h, w) uint8 labels of all samples after so many rounds."""
        labels = torch.zeros(self.kept.shape, dtype=torch.uint8, device=self.kept.device)
        for level in range(rounds):
            children = torch.zeros_like(labels)
            old, new = labels.flatten(1, 2), children.flatten(1, 2)
            for node in range(2**level):
                for rows, mean, count in self.means(self.table(self.kept & (labels == node))):
                    lower = self._is_lower(rows, mean, count)
                    new[:, rows] = torch.where(old[:, rows] == node, 2 * node + lower, new[:, rows])
            labels = children
        return labels

    def table(self, member: Tensor) -> Tensor:
        """Two-channel table of a node: depth relative to the centre, and mass.

        Args:
            member: (B, L, h, w) bool, or memberships between 0 and 1.
        """
        samples = self.samples
        table = sat.empty_table(samples.position, channels=2)
        weight = member.double() * samples.mass
        table[:, 1, 1:, 1:] = weight.sum(1)
        table[:, 0, 1:, 1:] = weight.mul_(samples.position[:, 2].double() - self.centre).sum(1)
        return sat.accumulate(table)

    def means(self, table: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Rows, mean depth relative to the centre and mass of a node in every sample's window, each (B, rows, w)."""
        for rows, lattice in self.samples.windows(12):
            total, count = sat.cell_sums(table, lattice)[:, 0].unbind(1)
            yield rows, total / self.pixels(count), self.pixels(count)

    @staticmethod
    def pixels(count: Tensor) -> Tensor:
        """Mass that is safe to divide by: a window without samples of the node decides nothing that matters."""
        return count.clamp(min=EMPTY)

    def _is_lower(self, rows: slice, mean: Tensor, count: Tensor) -> Tensor:
        depth = self.samples.position[:, 2].flatten(1, 2)[:, rows].double()
        slack = self.eps * depth.abs() + self.lost / count
        return ((depth - self.centre[:, 0] >= mean - slack) | (count <= EMPTY)).to(torch.uint8)
