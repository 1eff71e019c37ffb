"""StatVO on raw tensors: the value and its derivatives, layer by layer and block of rows by block of rows.

No autograd in here. `ops.statvo` wraps these into a differentiable function; what is alive at a time is one table, its cotangent
and a block of rows, so that memory grows neither with the layers nor with the footprint.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ssao.ops import sat
from torch_ssao.ops.falloff import psi
from torch_ssao.ops.leaf_tables import Leaf, leaf_tables, sample_table
from torch_ssao.ops.partition import MIN_COUNT, ROUNDING, Samples, adaptive_labels, uniform_labels
from torch_ssao.ops.sat import Lattice
from torch_ssao.ops.soft_partition import SoftPartition, half_from_lines


@dataclass(frozen=True)
class Settings:
    """The discrete choices; see `ops.statvo.statvo_obscurance`."""

    layers: int
    layering: str
    quadrants: bool
    block: int
    differential: bool
    gradient: str


class Queries(NamedTuple):
    """Where the obscurance is asked for: the pixels of the nearest image.

    centre, normal: (B, 3, H, W); seen: (B, H, W) bool; half: (B, 2, H, W); box_height, slope, width: (B,).
    """

    centre: Tensor
    normal: Tensor
    seen: Tensor
    half: Tensor
    box_height: Tensor
    slope: Tensor
    width: Tensor


class Response(NamedTuple):
    """One layer as the boxes of a block of rows see it: (B, Q, rows, W) float64, vectors (B, Q, 3, rows, W)."""

    amount: Tensor  # pixels of the layer in the box
    mean: Tensor  # mean position over the centre x
    height: Tensor  # mean height over the surface as a fraction of the box
    value: Tensor
    to_height: Tensor
    to_slope: Tensor


class _Cotangents(NamedTuple):
    """What the backward pass adds up over the layers; `rise` (B, H, W) is that of the height of the mean over the centre."""

    position: Tensor
    normal: Tensor
    half: Tensor
    rise: Tensor
    box_height: Tensor
    slope: Tensor


class LayeredObscurance:
    """What value, pull-back and push-forward share."""

    def __init__(self, samples: Samples, queries: Queries, settings: Settings) -> None:
        self.samples, self.queries, self.settings = samples, queries, settings
        self.origin = samples.centre()
        self.box_height = queries.box_height.double()[:, None, None, None]
        self.slope = queries.slope.double()[:, None, None, None]
        self.lost = samples.table_rounding(self.origin)[:, None, None, None]
        self.eps = ROUNDING * torch.finfo(samples.position.dtype).eps
        self.cells = 4 if settings.quadrants else 1

    # ---- the value ---------------------------------------------------------------------------------------------

    def value(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Obscurance (B, H, W); labels (B, L, h, w); obscurance and samples of each box, (B, Q, H, W)."""
        labels = self._labels()
        boxes, count = self._boxes(self._leaves(labels))
        held = (count > 0).sum(1).clamp(min=1)
        obscurance = torch.where(self.queries.seen, boxes.sum(1) / held, 0.0)
        dtype = self.samples.position.dtype
        return obscurance.to(dtype), labels, boxes.to(dtype), count.to(dtype)

    def _boxes(self, leaves: Iterator[Leaf]) -> tuple[Tensor, Tensor]:
        """Obscurance and samples of each box, (B, Q, H, W) float64."""
        batch, height, width = self.queries.seen.shape
        total = torch.zeros((batch, self.cells, height, width), dtype=torch.float64, device=self.lost.device)
        count = torch.zeros_like(total)
        for leaf in leaves:
            for rows, lattice in self._windows():
                response = self._respond(sat.cell_sums(leaf.table, lattice), rows)
                total[:, :, rows] += response.amount * response.value
                count[:, :, rows] += response.amount
            del leaf  # before the next table is made
        return torch.where(count > 0, total.div_(count.clamp(min=MIN_COUNT)), 0.0).clamp_(max=1), count

    def _labels(self) -> Tensor:
        if self.settings.layering == "uniform":
            return uniform_labels(self.samples, self.settings.layers)
        return adaptive_labels(self.samples, self.settings.layers)

    def _leaves(self, labels: Tensor) -> Iterator[Leaf]:
        return leaf_tables(
            self.samples, self.origin, labels, self.settings.layers, differential=self.settings.differential
        )

    def _soft(self) -> SoftPartition | None:
        if self.settings.gradient == "exact" or self.settings.layers == 1:
            return None
        return SoftPartition(self.samples, self.settings.layers, self.queries.width)

    def _soft_boxes(self, soft: SoftPartition) -> tuple[Tensor, Tensor]:
        dtype = self.samples.position.dtype
        boxes, count = self._boxes(self._soft_leaf(member) for member in soft.leaves())
        return boxes.to(dtype), count.to(dtype)

    def _soft_leaf(self, member: Tensor) -> Leaf:
        return Leaf(member, sample_table(self.samples, self.origin, member))

    def _windows(self, outer: slice | None = None) -> Iterator[tuple[slice, Lattice]]:
        """Blocks of rows of pixels, all or those inside `outer`, with their windows."""
        rows, columns = self.queries.seen.shape[1:]
        values = 4 * (9 if self.settings.quadrants else 4)
        for part in sat.row_blocks(outer or slice(0, rows), columns, values, self.lost.device):
            yield part, self._lattice(part)

    def _lattice(self, rows: slice) -> Lattice:
        return Lattice.around_pixels(
            self.queries.half[:, :, rows],
            self.samples.size,
            rows=rows,
            block=self.settings.block,
            quadrants=self.settings.quadrants,
        )

    def _respond(self, sums: Tensor, rows: slice) -> Response:
        area = sums[:, :, 3]
        safe = area.clamp(min=MIN_COUNT)
        centre = self.queries.centre[:, :, rows].double()
        normal = self.queries.normal[:, :, rows].double()
        relative = (self.origin[..., None, None] - centre)[:, None]
        mean = sums[:, :, :3] / safe[:, :, None] + relative
        rise = (mean * normal[:, None]).sum(2)
        reach = torch.linalg.vector_norm(centre, dim=1)[:, None]
        height = torch.where(rise > self.eps * reach + self.lost / safe, rise / self.box_height, 0.0)
        amount = torch.where(area >= MIN_COUNT, area, 0.0)
        return Response(amount, mean, height, *psi(height, self.slope))

    # ---- derivatives -------------------------------------------------------------------------------------------

    def _derivatives(
        self, response: Response, boxes: Tensor, count: Tensor, rows: slice
    ) -> tuple[Tensor, Tensor, Tensor]:
        """d VO / d (sums of this layer) (B, Q, 4, rows, W), d VO / d rise and d VO / d slope (B, Q, rows, W)."""
        boxes, count = boxes[:, :, rows].double(), count[:, :, rows].double()
        held = (count > 0).sum(1, keepdim=True).clamp(min=1)
        weight = torch.where(self.queries.seen[:, None, rows] & (response.amount > 0), 1 / held, 0.0)
        weight = weight / count.clamp(min=MIN_COUNT)
        per_rise = weight * response.to_height / self.box_height
        normal = self.queries.normal[:, :, rows].double()
        centre = self.queries.centre[:, :, rows].double() - self.origin[..., None, None]
        over_origin = ((response.mean + centre[:, None]) * normal[:, None]).sum(2)
        to_count = weight * (response.value - boxes) - per_rise * over_origin
        to_sums = torch.cat((per_rise[:, :, None] * normal[:, None], to_count[:, :, None]), 2)
        return to_sums, per_rise * response.amount, weight * response.amount * response.to_slope

    def pull_back(self, grad: Tensor, labels: Tensor, boxes: Tensor, count: Tensor) -> list[Tensor]:
        """Cotangents of position, sample half, centre, normal, half, box_height and slope.

        Args:
            grad: (B, H, W) cotangent of the obscurance; the rest as `value` returned them.
        """
        samples, queries = self.samples, self.queries
        into = _Cotangents(
            samples.position.new_zeros(samples.position.shape),
            *(torch.zeros_like(t, memory_format=torch.contiguous_format) for t in (queries.normal, queries.half)),
            *(torch.zeros_like(t, dtype=torch.float64) for t in (grad, queries.box_height, queries.slope)),
        )
        to_sample_half = samples.half.new_zeros((grad.shape[0], 0))
        if (soft := self._soft()) is None:
            for leaf in self._leaves(labels):
                to_samples = self._pull_back_leaf(leaf.table, grad, boxes, count, into)
                self._pull_back_position(to_samples, leaf.member, into)
                del leaf, to_samples  # before the next table is made
        else:
            boxes, count = self._soft_boxes(soft)

            def pull(member: Tensor) -> Tensor:
                to_samples = self._pull_back_leaf(self._soft_leaf(member).table, grad, boxes, count, into)
                self._pull_back_position(to_samples, member, into)
                return self._to_member(to_samples)

            to_depth, to_sample_half = soft.pull_back(pull)
            into.position[:, 2] += to_depth
        to_centre = (-into.rise[:, None] * queries.normal).to(grad.dtype)
        scalars = (into.box_height.to(grad.dtype), into.slope.to(grad.dtype))
        return [into.position, to_sample_half, to_centre, into.normal, into.half, *scalars]

    def _pull_back_position(self, to_samples: Tensor, member: Tensor, into: _Cotangents) -> None:
        weight = member * self.samples.mass
        for axis in range(3):
            into.position[:, axis] += to_samples[:, axis, None] * weight

    def _pull_back_leaf(self, table: Tensor, grad: Tensor, boxes: Tensor, count: Tensor, into: _Cotangents) -> Tensor:
        """Cotangents (B, 4, h, w) of what one layer's table was made of; those of the queries are added to `into`."""
        to_table = torch.zeros_like(table)
        for outer in sat.scatter_blocks(*grad.shape[1:]):
            to_sums = table.new_empty((*boxes.shape[:2], 4, outer.stop - outer.start, grad.shape[2]))
            for rows, lattice in self._windows(outer):
                response = self._respond(sat.cell_sums(table, lattice), rows)
                sums, rise, slope = self._derivatives(response, boxes, count, rows)
                weight = grad[:, None, rows].double()
                inside = slice(rows.start - outer.start, rows.stop - outer.start)
                torch.mul(sums, weight[:, :, None], out=to_sums[:, :, :, inside])
                rise = rise * weight
                into.rise[:, rows] += rise.sum(1)
                into.normal[:, :, rows] += (rise[:, :, None] * response.mean).sum(1)
                into.box_height.sub_((rise * response.height).flatten(1).sum(1))
                into.slope.add_((slope * weight).flatten(1).sum(1))
            lattice = self._lattice(outer)
            lines = sat.cell_sums_pull_back(to_sums, table, lattice, to_table)
            into.half[:, :, outer] += half_from_lines(*lines, lattice, self.samples.size)
        return sat.summed_area_table_adjoint(to_table)

    def push_forward(self, tangents: dict[str, Tensor | None], labels: Tensor, boxes: Tensor, count: Tensor) -> Tensor:
        """Tangent of the obscurance, (B, H, W).

        Args:
            tangents: by name - position, sample_half, centre, normal, half, box_height, slope; None costs nothing.
        """
        position, half = tangents["position"], tangents["half"]
        moving: Iterator[tuple[Leaf, Tensor | None]]
        if (soft := self._soft()) is None:
            moving = ((leaf, self._moving_table(leaf.member, position, None)) for leaf in self._leaves(labels))
        else:
            boxes, count = self._soft_boxes(soft)
            pushed = soft.push_forward(None if position is None else position[:, 2], tangents["sample_half"])
            moving = ((self._soft_leaf(m), self._moving_table(m, position, moved)) for m, moved in pushed)
        total = torch.zeros_like(self.queries.seen, dtype=torch.float64)
        for leaf, table in moving:
            for rows, lattice in self._windows():
                response = self._respond(sat.cell_sums(leaf.table, lattice), rows)
                to_sums, to_rise, to_slope = self._derivatives(response, boxes, count, rows)
                tangent = self._own_tangent(tangents, response, to_rise, to_slope, rows)
                if table is not None:
                    tangent = tangent + (sat.cell_sums(table, lattice) * to_sums).sum((1, 2))
                if half is not None:
                    slopes = half_from_lines(*sat.edge_slopes(to_sums, leaf.table, lattice), lattice, self.samples.size)
                    tangent = tangent + (slopes * half[:, :, rows]).sum(1)
                total[:, rows] += tangent
            del leaf, table
        return total.to(self.samples.position.dtype)

    def _own_tangent(
        self, tangents: dict[str, Tensor | None], response: Response, to_rise: Tensor, to_slope: Tensor, rows: slice
    ) -> Tensor:
        """What the pixel's own centre, normal, box and slope add."""
        normal = self.queries.normal[:, :, rows].double()
        tangent = torch.zeros_like(to_rise[:, 0])
        if (centre := tangents["centre"]) is not None:
            tangent = tangent - to_rise.sum(1) * (centre[:, :, rows] * normal).sum(1)
        if (turned := tangents["normal"]) is not None:
            tangent = tangent + (to_rise * (turned[:, None, :, rows] * response.mean).sum(2)).sum(1)
        if (box_height := tangents["box_height"]) is not None:
            tangent = tangent - (to_rise * response.height).sum(1) * box_height[:, None, None]
        if (slope := tangents["slope"]) is not None:
            tangent = tangent + to_slope.sum(1) * slope[:, None, None]
        return tangent

    def _moving_table(self, member: Tensor, position: Tensor | None, moved: Tensor | None) -> Tensor | None:
        """Table of the tangents of a layer's samples, from those of positions and memberships; None when nothing moves."""
        if position is None and moved is None:
            return None
        mass = self.samples.mass.double()
        joined = mass * (0.0 if moved is None else moved)
        channels = []
        for axis in range(3):
            total = joined * self._apart(axis)
            if position is not None:
                total += position[:, axis] * member * mass
            channels.append(total.sum(1))
        return sat.summed_area_table(torch.stack((*channels, joined.sum(1)), 1))

    def _to_member(self, to_samples: Tensor) -> Tensor:
        """(B, L, h, w) cotangent of a layer's memberships."""
        total = to_samples[:, 3, None].expand(self.samples.mass.shape).clone()
        for axis in range(3):
            total += to_samples[:, axis, None] * self._apart(axis)
        return (total * self.samples.mass).to(self.samples.position.dtype)

    def _apart(self, axis: int) -> Tensor:
        return self.samples.position[:, axis].double() - self.origin[:, axis, None, None, None]
