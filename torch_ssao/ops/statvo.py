"""Statistical volumetric obscurance: partition, masked tables, box means and psi in one autograd Function."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ssao.ops import sat
from torch_ssao.ops.falloff import psi
from torch_ssao.ops.partition import ROUNDING, adaptive_labels, table_rounding
from torch_ssao.ops.sat import Window

MIN_COUNT = 1e-6  # pixels of a layer inside a window below which its mean is all rounding: the layer is left out


def statvo_obscurance(
    points: Tensor, valid: Tensor, normal: Tensor, half: Tensor, box_height: Tensor, slope: Tensor, *, layers: int
) -> Tensor:
    """Obscurance of every pixel from the mean position of each layer in its window.

    VO = sum_i n_i psi(((mean_i - x) . n) / box_height) / sum_i n_i over the layers i, with n_i the samples of layer i
    in the window and mean_i their mean position.

    Args:
        points: (B, 3, L, H, W) view-space positions, scene units, finite everywhere; layer 0 holds the centres x.
        valid: (B, L, H, W) bool; invalid samples never count.
        normal: (B, 3, H, W) unit normals towards the eye; (0, 0, -1) gives the view-aligned form.
        half: (B, 2, L, H, W) window half-size in pixels (x, y), >= 0; windows are clipped to the image.
        box_height: (B,) height of the sample box over the surface, scene units, > 0.
        slope: (B,) slope of psi above the box, > 0.
        layers: 1, 2, 4, ... 256 adaptive layers.
    Returns: (B, H, W) obscurance in [0, 1], 0 where the centre is invalid. Heights within rounding of the surface -
        8 eps |x| of the input's dtype plus what the float64 table loses - count as 0 with gradient 0: a plane is open.
    Gradients: to points, normal, half (of layer 0), box_height and slope: exact almost everywhere, labels held
        constant. Forward mode (`jvp`) alike. Second derivatives raise a RuntimeError.
    Cost: layers - 1 two-channel and `layers` four-channel float64 tables, one alive at a time, forward; about three
        times that backward. Saved for backward: the inputs, one byte and one float64 a pixel, whatever the layers.
    Source: Statistical Volumetric Obscurance, Eqs. 3-7, Sec. 5 and 6.
    """
    function = _StatVO if torch.compiler.is_compiling() else _StatVOWithJvp
    obscurance, _, _ = function.apply(points, valid, normal, half, box_height, slope, layers)
    return obscurance


class _Inputs(NamedTuple):
    points: Tensor
    valid: Tensor
    normal: Tensor
    half: Tensor
    box_height: Tensor
    slope: Tensor


class _Tangents(NamedTuple):
    """Tangents of `_Inputs`; None where there is none. Masks have none."""

    points: Tensor | None
    valid: Tensor | None
    normal: Tensor | None
    half: Tensor | None
    box_height: Tensor | None
    slope: Tensor | None


class _Leaf(NamedTuple):
    """One layer as every window sees it; (B, N, ...) float64, N = H W."""

    member: Tensor  # (B, L, H, W) bool
    table: Tensor
    amount: Tensor  # n_i, in pixels
    mean: Tensor
    height: Tensor  # s, the mean height as a fraction of the box
    value: Tensor
    to_height: Tensor
    to_slope: Tensor


class _StatVO(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(
        points: Tensor, valid: Tensor, normal: Tensor, half: Tensor, box_height: Tensor, slope: Tensor, layers: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        inputs = _Inputs(points, valid, normal, half, box_height, slope)
        labels = adaptive_labels(points[:, 2], valid, half, layers)
        frame = _Frame(inputs)
        total = count = torch.zeros_like(frame.reach)
        for leaf in frame.leaves(labels, layers):
            total = total + leaf.amount * leaf.value
            count = count + leaf.amount
        obscurance = torch.where(frame.seen & (count > 0), total / count.clamp(min=MIN_COUNT), 0.0).clamp(max=1)
        return obscurance.view_as(points[:, 0, 0]).to(points.dtype), labels, count

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor, Tensor]) -> None:
        obscurance, labels, count = output
        ctx.mark_non_differentiable(labels, count)
        ctx.layers = inputs[6]
        ctx.save_for_backward(*inputs[:6], obscurance, labels, count)
        ctx.save_for_forward(*inputs[:6], obscurance, labels, count)

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *unused: Tensor) -> tuple[Tensor | None, ...]:
        points, normal, half, box_height, slope = _StatVOBackward.apply(grad, *ctx.saved_tensors, ctx.layers)
        return points, None, normal, half, box_height, slope, None


class _StatVOWithJvp(_StatVO):
    """The same with forward mode, which dynamo refuses to trace."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, None, None]:
        *inputs, obscurance, labels, count = ctx.saved_tensors
        frame = _Frame(_Inputs(*inputs))
        tangent = frame.push_forward(_Tangents(*tangents[:6]), obscurance, labels, count, ctx.layers)
        return tangent.view_as(obscurance).to(obscurance.dtype), None, None


class _StatVOBackward(torch.autograd.Function):
    """The backward pass as a Function of its own: differentiating it again is an error, never a silent zero."""

    generate_vmap_rule = True

    @staticmethod
    def forward(grad: Tensor, *saved: Any) -> tuple[Tensor, ...]:
        *inputs, obscurance, labels, count, layers = saved
        return _Frame(_Inputs(*inputs)).pull_back(grad, obscurance, labels, count, layers)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> None:
        raise RuntimeError(
            "statvo_obscurance has no second derivative: detach the first gradient, or difference it numerically"
        )

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> None:
        raise RuntimeError(
            "statvo_obscurance has no second derivative: detach the first gradient, or difference it numerically"
        )


class _Frame:
    """What forward, backward and jvp share: centres, normals and windows of all pixels in float64."""

    def __init__(self, inputs: _Inputs) -> None:
        self.inputs = inputs
        self.window = Window.around_pixels(inputs.half[:, :, 0])
        self.centre = inputs.points[:, :, 0].double().flatten(2).transpose(1, 2)  # (B, N, 3)
        self.normal = inputs.normal.double().flatten(2).transpose(1, 2)
        self.box_height = inputs.box_height.double()[:, None]
        self.slope = inputs.slope.double()[:, None]
        self.seen = inputs.valid[:, 0].flatten(1)
        self.reach = torch.linalg.vector_norm(self.centre, dim=-1)
        self.input_rounding = ROUNDING * torch.finfo(inputs.points.dtype).eps * self.reach
        self.table_rounding = table_rounding(torch.linalg.vector_norm(inputs.points, dim=1), inputs.valid)

    def leaves(self, labels: Tensor, layers: int) -> Iterator[_Leaf]:
        """The layers one by one, so that one table is alive at a time."""
        for label in range(layers):
            member = self.inputs.valid & (labels == label)
            table = sat.summed_area_table(_samples(self.inputs.points, member, with_count=True))
            sums = sat.box_sum(table, self.window)
            count = torch.where(sums[..., 3] >= MIN_COUNT, sums[..., 3], 0.0)
            mean = sums[..., :3] / sums[..., 3:].clamp(min=MIN_COUNT)
            rise = ((mean - self.centre) * self.normal).sum(-1)
            tolerance = self.input_rounding + self.table_rounding / sums[..., 3].clamp(min=MIN_COUNT)
            height = torch.where(rise > tolerance, rise / self.box_height, 0.0)
            yield _Leaf(member, table, count, mean, height, *psi(height, self.slope))

    def derivatives(self, leaf: _Leaf, obscurance: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """d VO / d (sums of this layer), (B, N, 4), and d VO / d rise, (B, N); zero where unseen or left out."""
        kept = self.seen & (leaf.amount > 0)
        safe = count.clamp(min=MIN_COUNT)
        per_rise = torch.where(kept, leaf.to_height / (safe * self.box_height), 0.0)
        to_count = torch.where(kept, (leaf.value - obscurance) / safe, 0.0) - per_rise * (leaf.mean * self.normal).sum(
            -1
        )
        return torch.cat((per_rise[..., None] * self.normal, to_count[..., None]), -1), per_rise * leaf.amount

    def pull_back(
        self, grad: Tensor, obscurance: Tensor, labels: Tensor, count: Tensor, layers: int
    ) -> tuple[Tensor, ...]:
        """Cotangents of points, normal, half, box_height and slope."""
        points, half = self.inputs.points, self.inputs.half
        grad, obscurance = grad.double().flatten(1), obscurance.double().flatten(1)
        to_points = torch.zeros_like(points, dtype=torch.float64)
        to_centre, to_normal = torch.zeros_like(self.centre), torch.zeros_like(self.normal)
        to_edges = [torch.zeros_like(self.reach)] * 4
        to_box, to_slope = torch.zeros_like(self.box_height[:, 0]), torch.zeros_like(self.slope[:, 0])
        for leaf in self.leaves(labels, layers):
            to_sums, to_rise = self.derivatives(leaf, obscurance, count)
            to_sums, to_rise = to_sums * grad[..., None], to_rise * grad
            to_edges = [
                total + (to_sums * strip).sum(-1)
                for total, strip in zip(to_edges, sat.box_sum_edges(leaf.table, self.window), strict=True)
            ]
            image = sat.summed_area_table_adjoint(sat.box_sum_adjoint(to_sums[..., :3], self.window))
            to_points = to_points + torch.where(leaf.member[:, None], image.permute(0, 3, 1, 2)[:, :, None], 0.0)
            to_centre = to_centre - to_rise[..., None] * self.normal
            to_normal = to_normal + to_rise[..., None] * (leaf.mean - self.centre)
            to_box = to_box - (to_rise * leaf.height).sum(1)
            weight = torch.where(self.seen, leaf.amount / count.clamp(min=MIN_COUNT), 0.0)
            to_slope = to_slope + (grad * weight * leaf.to_slope).sum(1)
        image_shape = self.inputs.normal.shape
        centre_image = to_centre.transpose(1, 2).reshape(image_shape)
        to_points = torch.cat((to_points[:, :, :1] + centre_image[:, :, None], to_points[:, :, 1:]), 2)
        unused = torch.zeros_like(half[:, :, 1:], dtype=torch.float64)
        to_half = torch.cat((self._half_from_edges(to_edges)[:, :, None], unused), 2)
        dtype = points.dtype
        return (
            to_points.to(dtype),
            to_normal.transpose(1, 2).reshape(image_shape).to(dtype),
            to_half.to(dtype),
            to_box.to(dtype),
            to_slope.to(dtype),
        )

    def push_forward(
        self, tangents: _Tangents, obscurance: Tensor, labels: Tensor, count: Tensor, layers: int
    ) -> Tensor:
        """Tangent of the obscurance, (B, N); tangents that are None cost nothing."""
        obscurance = obscurance.double().flatten(1)
        edges = None if tangents.half is None else self._edges_from_half(tangents.half[:, :, 0].double())
        total = torch.zeros_like(self.reach)
        for leaf in self.leaves(labels, layers):
            to_sums, to_rise = self.derivatives(leaf, obscurance, count)
            if tangents.points is not None:
                table = sat.summed_area_table(_samples(tangents.points, leaf.member, with_count=False))
                moved = sat.box_sum(table, self.window)
                own = tangents.points[:, :, 0].double().flatten(2).transpose(1, 2)
                total = total + (to_sums[..., :3] * moved).sum(-1) - to_rise * (own * self.normal).sum(-1)
            if edges is not None:
                strips = sat.box_sum_edges(leaf.table, self.window)
                total = total + sum((to_sums * s).sum(-1) * e for s, e in zip(strips, edges, strict=True))
            if tangents.normal is not None:
                turned = tangents.normal.double().flatten(2).transpose(1, 2)
                total = total + to_rise * (turned * (leaf.mean - self.centre)).sum(-1)
            if tangents.box_height is not None:
                total = total - to_rise * leaf.height * tangents.box_height.double()[:, None]
            if tangents.slope is not None:
                weight = torch.where(self.seen, leaf.amount / count.clamp(min=MIN_COUNT), 0.0)
                total = total + weight * leaf.to_slope * tangents.slope.double()[:, None]
        return total

    def _edges_from_half(self, half: Tensor) -> list[Tensor]:
        """Tangents of x0, x1, y0, y1; an edge clipped to the image does not move."""
        half_x, half_y = half.flatten(2).unbind(1)
        window = self.window
        return [
            torch.where(window.x0 > 0, -half_x, 0.0),
            torch.where(window.x1 < window.width, half_x, 0.0),
            torch.where(window.y0 > 0, -half_y, 0.0),
            torch.where(window.y1 < window.height, half_y, 0.0),
        ]

    def _half_from_edges(self, edges: list[Tensor]) -> Tensor:
        """Cotangent (B, 2, H, W) of the half-size: the adjoint of `_edges_from_half`."""
        window = self.window
        half_x = torch.where(window.x1 < window.width, edges[1], 0.0) - torch.where(window.x0 > 0, edges[0], 0.0)
        half_y = torch.where(window.y1 < window.height, edges[3], 0.0) - torch.where(window.y0 > 0, edges[2], 0.0)
        batch = half_x.shape[0]
        return torch.stack((half_x, half_y), 1).view(batch, 2, window.height, window.width)


def _samples(points: Tensor, member: Tensor, *, with_count: bool) -> Tensor:
    """(B, H, W, 3 or 4) sums over the peeled layers of the member positions and, last, of their number."""
    kept = torch.where(member[:, None], points, 0.0).double().sum(2).permute(0, 2, 3, 1)
    return torch.cat((kept, member.sum(1).double()[..., None]), -1) if with_count else kept
