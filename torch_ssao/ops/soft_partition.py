"""The surrogate of StatVO's adaptive partition: a label counts as sigmoid((mean - depth) / width).

Every sample belongs to every node a little: a node of membership m passes m u to its upper and m (1 - u) to its lower child, with u
the sigmoid of how far the sample lies before the node's own mean in its window. Nothing here is discrete, so its derivative is exact;
StatVO takes it for the derivative of the hard image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ssao.ops import sat
from torch_ssao.ops.partition import EMPTY, Partition, Samples


class SoftLeaf(NamedTuple):
    """Memberships of all samples in one leaf, (B, L, h, w), and their tangent."""

    member: Tensor
    moved: Tensor


class SoftPartition:
    """The soft tree over one set of samples; nodes are visited depth first, so that few are alive.

    Args:
        samples: see `Samples`.
        layers: leaves, a power of two.
        width: (B,) transition width of the sigmoid, scene units, > 0.
    """

    def __init__(self, samples: Samples, layers: int, width: Tensor) -> None:
        self.samples = samples
        self.rounds = layers.bit_length() - 1
        self.partition = Partition(samples)
        self.width = width.double()[:, None, None]
        self.root = self.partition.kept.to(samples.position.dtype)
        self.apart = samples.position[:, 2].double() - self.partition.centre

    def leaves(self) -> Iterator[Tensor]:
        """Memberships of the leaves, nearest first."""
        yield from self._descend(self.root, 0)

    def _descend(self, member: Tensor, level: int) -> Iterator[Tensor]:
        if level == self.rounds:
            yield member
            return
        upper = self._decide(self.partition.table(member))
        yield from self._descend(member * upper, level + 1)
        yield from self._descend(member * (1 - upper), level + 1)

    def _decide(self, table: Tensor) -> Tensor:
        """(B, L, h, w) share of every sample that goes to the upper child."""
        upper = torch.empty_like(self.root)
        for rows, mean, count in self.partition.means(table):
            share = torch.sigmoid((mean - self.apart.flatten(1, 2)[:, rows]) / self.width)
            upper.flatten(1, 2)[:, rows] = torch.where(count > EMPTY, share, 0.0).to(upper.dtype)
        return upper

    # ---- derivatives -------------------------------------------------------------------------------------------

    def pull_back(self, leaf: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Cotangents of the samples' depths (B, L, h, w) and window half-sizes (B, 2, L, h, w).

        Args:
            leaf: from the memberships of a leaf, called in the order of `leaves`, to their cotangent.
        """
        to_depth = torch.zeros_like(self.root)
        to_half = self.samples.half.new_zeros(self.samples.half.shape)
        self._pull_back_node(self.root, 0, leaf, to_depth, to_half)
        return to_depth, to_half

    def _pull_back_node(
        self, member: Tensor, level: int, leaf: Callable[[Tensor], Tensor], to_depth: Tensor, to_half: Tensor
    ) -> Tensor:
        """Cotangent of a node's memberships; what its decision adds to depths and half-sizes is added in place."""
        if level == self.rounds:
            return leaf(member)
        upper = self._decide(self.partition.table(member))
        to_upper = self._pull_back_node(member * upper, level + 1, leaf, to_depth, to_half)
        to_lower = self._pull_back_node(member * (1 - upper), level + 1, leaf, to_depth, to_half)
        to_decision = member * (to_upper - to_lower) * upper * (1 - upper) / self.width[..., None].to(member.dtype)
        to_member = to_upper.mul_(upper).add_(to_lower.mul_(1 - upper))
        to_depth -= to_decision
        table = self.partition.table(member)
        to_table = torch.zeros_like(table)
        for rows, lattice in self.samples.windows(12, scatter=True):
            total, count = sat.cell_sums(table, lattice)[:, 0].unbind(1)
            count = self.partition.pixels(count)
            here = torch.where(count > EMPTY, to_decision.flatten(1, 2)[:, rows].double(), 0.0)
            to_sums = torch.stack((here / count, -here * total / count.square()), 1)[:, None]
            lines = sat.cell_sums_pull_back(to_sums, table, lattice, to_table)
            to_half.flatten(2, 3)[:, :, rows] += half_from_lines(*lines, lattice, self.samples.size)
        to_total, to_count = sat.summed_area_table_adjoint(to_table)[:, :, None].unbind(1)
        to_depth += member * self.samples.mass * to_total
        to_member += self.samples.mass * (to_total * self.apart + to_count)
        return to_member

    def push_forward(self, depth: Tensor | None, half: Tensor | None) -> Iterator[SoftLeaf]:
        """The leaves with the tangents of their memberships.

        Args:
            depth: (B, L, h, w) tangent of the samples' depths; half: (B, 2, L, h, w) of their windows; None: no motion.
        """
        yield from self._push_node(self.root, torch.zeros_like(self.root), 0, depth, half)

    def _push_node(
        self, member: Tensor, moved: Tensor, level: int, depth: Tensor | None, half: Tensor | None
    ) -> Iterator[SoftLeaf]:
        if level == self.rounds:
            yield SoftLeaf(member, moved)
            return
        table = self.partition.table(member)
        upper, slope = self._decide(table), self._decision_tangent(table, member, moved, depth, half)
        slope = slope * (upper * (1 - upper)) / self.width[..., None].to(member.dtype)
        flow = member * slope
        yield from self._push_node(member * upper, moved * upper + flow, level + 1, depth, half)
        yield from self._push_node(member * (1 - upper), moved * (1 - upper) - flow, level + 1, depth, half)

    def _decision_tangent(
        self, table: Tensor, member: Tensor, moved: Tensor, depth: Tensor | None, half: Tensor | None
    ) -> Tensor:
        """(B, L, h, w) tangent of mean - depth."""
        mass = self.samples.mass.double()
        total = mass * moved * self.apart
        if depth is not None:
            total += mass * member * depth
        moving = sat.summed_area_table(torch.stack((total.sum(1), (mass * moved).sum(1)), 1))
        tangent = torch.zeros_like(member)
        for rows, lattice in self.samples.windows(24):
            total, count = sat.cell_sums(table, lattice)[:, 0].unbind(1)
            count = self.partition.pixels(count)
            to_sums = torch.stack((1 / count, -total / count.square()), 1)[:, None]
            here = (sat.cell_sums(moving, lattice) * to_sums).sum((1, 2))
            if half is not None:
                slopes = half_from_lines(*sat.edge_slopes(to_sums, table, lattice), lattice, self.samples.size)
                here += (slopes * half.flatten(2, 3)[:, :, rows]).sum(1)
            if depth is not None:
                here -= depth.flatten(1, 2)[:, rows]
            tangent.flatten(1, 2)[:, rows] = torch.where(count > EMPTY, here, 0.0).to(tangent.dtype)
        return tangent


def half_from_lines(
    to_x: tuple[Tensor, ...], to_y: tuple[Tensor, ...], lattice: sat.Lattice, size: tuple[int, int]
) -> Tensor:
    """(B, 2, R, S) cotangent of the half-size from those of the outer lines; a line clipped to the image does not move."""
    height, width = size
    sides = []
    for slopes, lines, end in ((to_x, lattice.xs, width), (to_y, lattice.ys, height)):
        low, high = lines[0], lines[-1]
        sides.append(torch.where(high < end, slopes[-1], 0.0) - torch.where(low > 0, slopes[0], 0.0))
    return torch.stack(sides, 1)
