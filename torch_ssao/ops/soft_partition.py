"""The surrogate derivative of StatVO's adaptive partition: a label counts as sigmoid((mean - depth) / width).

The forward pass stays hard. A sample of leaf l weighs in through the product of its rounds' decisions; the surrogate lets each
decision move, one at a time, and follows what that does: the sample leaves one leaf for the one at the end of its sibling path,
and the means on the way depend on depths, windows and earlier decisions alike.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ssao.ops import sat
from torch_ssao.ops.partition import Partition, Samples


class SoftPartition:
    """Derivatives of memberships. Directions are signed towards the upper child.

    Args:
        samples: see `Samples`.
        layers: leaves, a power of two.
        width: (B,) transition width of the sigmoid, scene units, > 0.
    """

    def __init__(self, samples: Samples, layers: int, width: Tensor) -> None:
        self.samples = samples
        self.rounds = layers.bit_length() - 1
        self.partition = Partition(samples)
        self.paths = self.partition.paths(self.rounds, with_siblings=True)
        self.width = width.double()[:, None, None]

    def membership(self, level: int, node: int, flip: int) -> Tensor:
        """(B, L, h, w) in {-1, 0, 1}: what a unit of round `flip`'s decision adds to the membership of a node of a level."""
        shift = self.rounds - level
        own, other = ((path >> shift) == node for path in (self.paths[0], self.paths[1 + flip]))
        towards_upper = 1 - 2 * ((self.paths[0] >> (self.rounds - 1 - flip)) & 1).to(torch.int8)
        return (own.to(torch.int8) - other.to(torch.int8)) * towards_upper

    def zeros(self) -> Tensor:
        """(rounds, B, L, h, w): cotangents of the decisions, before any."""
        return torch.zeros((self.rounds, *self.samples.mass.shape), dtype=self.samples.position.dtype, device=self.paths.device)

    def add_membership_cotangent(self, to_decisions: Tensor, to_member: Tensor, level: int, node: int) -> None:
        """Pass the cotangent of a node's memberships on to the rounds above it, in place."""
        for flip in range(level):
            to_decisions[flip] += (to_member * self.membership(level, node, flip)).to(to_decisions.dtype)

    def membership_tangent(self, decisions: list[Tensor], level: int, node: int) -> Tensor:
        """(B, L, h, w) tangent of a node's memberships from those of the rounds above it."""
        moved = torch.zeros_like(self.samples.mass, dtype=torch.float64)
        for flip in range(level):
            moved += decisions[flip] * self.membership(level, node, flip)
        return moved

    def pull_back(self, to_decisions: Tensor) -> tuple[Tensor, Tensor]:
        """Cotangents of the samples' depths (B, L, h, w) and half-sizes (B, 2, L, h, w) from those of the decisions.

        Args:
            to_decisions: (rounds, B, L, h, w), used up.
        """
        samples, partition = self.samples, self.partition
        mass = samples.mass.double()
        to_depth = torch.zeros_like(mass)
        to_half = samples.half.new_zeros(samples.half.shape)
        apart = samples.position[:, 2].double() - partition.centre
        for level in range(self.rounds - 1, -1, -1):
            for node in range(2**level):
                member = partition.kept & ((self.paths[0] >> (self.rounds - level)) == node)
                table = partition.table(member)
                to_table = torch.zeros_like(table)
                for rows, lattice in samples.windows(12, scatter=True):
                    total, count = sat.cell_sums(table, lattice)[:, 0].unbind(1)
                    count = partition.pixels(count)
                    here = torch.where(member.flatten(1, 2)[:, rows], to_decisions[level].flatten(1, 2)[:, rows].double(), 0.0)
                    here = here * self._steepness(apart.flatten(1, 2)[:, rows], total / count)
                    to_depth.flatten(1, 2)[:, rows] -= here
                    to_sums = torch.stack((here / count, -here * total / count.square()), 1)[:, None]
                    (x0, x1), (y0, y1) = sat.cell_sums_pull_back(to_sums, table, lattice, to_table)
                    to_half.flatten(2, 3)[:, :, rows] += half_from_lines((x0, x1), (y0, y1), lattice, samples.size)
                to_mean, to_count = sat.summed_area_table_adjoint(to_table).unbind(1)
                to_depth += torch.where(member, to_mean[:, None] * mass, 0.0)
                to_member = torch.where(partition.kept, mass * (to_mean[:, None] * apart + to_count[:, None]), 0.0)
                self.add_membership_cotangent(to_decisions, to_member, level, node)
        return to_depth, to_half

    def push_forward(self, depth: Tensor | None, half: Tensor | None) -> list[Tensor]:
        """Tangents of the decisions, one (B, L, h, w) float64 for each round.

        Args:
            depth: (B, L, h, w) tangent of the samples' depths; half: (B, 2, L, h, w) of their windows; None: no motion.
        """
        samples, partition = self.samples, self.partition
        mass = samples.mass.double()
        apart = samples.position[:, 2].double() - partition.centre
        decisions: list[Tensor] = []
        for level in range(self.rounds):
            decision = torch.zeros_like(mass)
            for node in range(2**level):
                member = partition.kept & ((self.paths[0] >> (self.rounds - level)) == node)
                table = partition.table(member)
                joined = mass * self.membership_tangent(decisions, level, node)
                moved = joined * apart if depth is None else joined * apart + torch.where(member, mass * depth.double(), 0.0)
                moving = sat.summed_area_table(torch.stack((moved.sum(1), joined.sum(1)), 1))
                for rows, lattice in samples.windows(24):
                    total, count = sat.cell_sums(table, lattice)[:, 0].unbind(1)
                    count = partition.pixels(count)
                    to_sums = torch.stack((1 / count, -total / count.square()), 1)[:, None]
                    tangent = (sat.cell_sums(moving, lattice) * to_sums).sum((1, 2))
                    if half is not None:
                        slopes = half_from_lines(*sat.edge_slopes(to_sums, table, lattice), lattice, samples.size)
                        tangent += (slopes * half.flatten(2, 3)[:, :, rows]).sum(1)
                    if depth is not None:
                        tangent -= depth.flatten(1, 2)[:, rows]
                    tangent *= self._steepness(apart.flatten(1, 2)[:, rows], total / count)
                    decision.flatten(1, 2)[:, rows] += torch.where(member.flatten(1, 2)[:, rows], tangent, 0.0)
            decisions.append(decision)
        return decisions

    def _steepness(self, depth: Tensor, mean: Tensor) -> Tensor:
        """d decision / d (mean - depth)."""
        upper = torch.sigmoid((mean - depth) / self.width)
        return upper * (1 - upper) / self.width


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
