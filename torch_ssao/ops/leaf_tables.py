"""Summed-area tables of the layers, one after another: each built on its own, or from its parent's and sibling's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from torch import Tensor

from torch_ssao.ops import sat
from torch_ssao.ops.partition import Samples


class Leaf(NamedTuple):
    """One layer: its samples (B, L, h, w), bool or memberships, and its table of x, y, z (relative to the centre) and mass."""

    member: Tensor
    table: Tensor


def leaf_tables(samples: Samples, centre: Tensor, labels: Tensor, layers: int, *, differential: bool) -> Iterator[Leaf]:
    """The layers' tables in the order of their labels.

    Args:
        samples, centre: see `Samples`; labels: (B, L, h, w) uint8 in [0, layers).
        layers: number of labels.
        differential: get the second child of every node of the binary tree over the labels as its parent minus the first, as
            Algorithms 1 and 2 of the paper do; layers must be a power of two. log2(layers) more tables are alive, and an empty
            layer holds rounding instead of zeros.
    Cost: one four-channel table each (32 bytes a sample); differential builds half of them by one subtraction instead of a
        mask, a product and two cumulative sums.
    Source: Statistical Volumetric Obscurance, Sec. 7.2.
    """
    kept = samples.mass > 0
    if differential:
        root = sample_table(samples, centre, kept)
        yield from _descend(samples, centre, labels, root, first=0, count=layers)
        return
    for label in range(layers):
        member = kept & (labels == label)
        yield Leaf(member, sample_table(samples, centre, member))


def sample_table(samples: Samples, centre: Tensor, member: Tensor) -> Tensor:
    """(B, 4, h + 1, w + 1) table of the members' positions relative to the centre and of their mass, summed over the L images."""
    table = sat.empty_table(samples.position, channels=4)
    weight = member.double() * samples.mass
    for axis in range(3):
        apart = samples.position[:, axis].double() - centre[:, axis, None, None, None]
        table[:, axis, 1:, 1:] = apart.mul_(weight).sum(1)
    table[:, 3, 1:, 1:] = weight.sum(1)
    return sat.accumulate(table)


def _descend(
    samples: Samples, centre: Tensor, labels: Tensor, table: Tensor, *, first: int, count: int
) -> Iterator[Leaf]:
    """The leaves below a node that holds the labels first ... first + count - 1; the node's table is used up."""
    if count == 1:
        yield Leaf((samples.mass > 0) & (labels == first), table)
        return
    half = count // 2
    inside = (samples.mass > 0) & (labels >= first) & (labels < first + half)
    upper = sample_table(samples, centre, inside)
    table.sub_(upper)
    yield from _descend(samples, centre, labels, upper, first=first, count=half)
    yield from _descend(samples, centre, labels, table, first=first + half, count=half)
