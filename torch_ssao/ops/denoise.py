"""Edge-aware smoothing of a visibility image: noise goes, edges stay."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.ops.recompute import Outputs, pull_back, push_forward, recompute

KERNEL = (2.0, 2.0, 1.0)  # of a tap 0, 1, 2 pixels away along an axis: 5 x 5 taps, trapezoidal
PLANE_WIDTH = 0.1  # of the radius: distance from the other pixel's plane at which a weight falls to 1/e
NORMAL_POWER = 4  # weights fall as cos^16 of the angle between the normals: 0.4 at 20 degrees, 0.004 at 45


def denoise_visibility(
    visibility: Tensor, points: Tensor, normal: Tensor, valid: Tensor, radius: Tensor, *, passes: int
) -> Tensor:
    """Weighted mean of every pixel with its neighbours on the same surface, 5 x 5 taps, spread wider each pass.

    out(p) = v(p) + sum_q k w(p, q) (v(q) - v(p)) / sum_q k w(p, q), with the symmetric weight
    w = exp(-(d_pq^2 + d_qp^2) / (0.1 R)^2 - |x_q - x_p|^2 / R^2) max(0, n_p . n_q)^16, d_pq the distance of x_q from
    p's tangent plane; pass m takes taps 2^m pixels apart. A constant image stays as it is, bit for bit.

    Args:
        visibility: (B, H, W).
        points: (B, 3, H, W) view-space positions, scene units.
        normal: (B, 3, H, W) unit normals.
        valid: (B, H, W) bool; invalid pixels keep their value and lend it to nobody.
        radius: (B,) length R over which visibility may vary, scene units, > 0.
        passes: number of passes, >= 0; 0 returns `visibility`.
    Returns: (B, H, W), within the range of the valid input.
    Gradients: to visibility, points, normal and radius; exact; 0 to points, normals at invalid pixels. Forward mode
        alike. Second derivatives raise a RuntimeError.
    Cost: 12 pairs of taps a pass; saved a pass: the input and two floats a pixel, whatever the taps.
    Raises: RangeError.
    Source: ours; a-trous spreading after Dammertz et al. 2010, weights as production denoisers have them.
    """
    checks.check_count("passes", passes, 0)
    seen = valid[:, None]
    points, normal = torch.where(seen, points, 0.0), torch.where(seen, normal, 0.0)
    smooth = torch.where(valid, visibility, 1.0)  # a NaN times a zero weight is still NaN
    for number in range(passes):
        smooth = recompute(_Pass(2**number), smooth, points, normal, valid, radius)
    return torch.where(valid, smooth, visibility)


class _Pair(NamedTuple):
    """Two overlapping parts of the image, so that pixel i of one and pixel i of the other are a tap apart."""

    weight: float
    here: tuple[slice, slice]
    there: tuple[slice, slice]

    def split(self, image: Tensor) -> tuple[Tensor, Tensor]:
        return image[..., self.here[0], self.here[1]], image[..., self.there[0], self.there[1]]


class _Pass(NamedTuple):
    """One pass, of the taps `stride` pixels apart."""

    stride: int
    name: str = "denoise_visibility"

    def pairs(self, height: int, width: int) -> Iterator[_Pair]:
        """Half of the taps: the other half are the same pairs seen from the other end."""
        for down in range(3):
            for right in range(-2, 3):
                y, x = down * self.stride, right * self.stride
                if (down == 0 and right <= 0) or y >= height or abs(x) >= width:
                    continue
                here = (slice(0, height - y), slice(max(0, -x), width - max(0, x)))
                there = (slice(y, height), slice(max(0, x), width - max(0, -x)))
                yield _Pair(KERNEL[down] * KERNEL[abs(right)], here, there)

    def value(self, *tensors: Tensor | None) -> Outputs:
        visibility, points, normal, valid, radius = _given(tensors)
        gain, total = torch.zeros_like(visibility), torch.full_like(visibility, KERNEL[0] ** 2)
        for pair in self.pairs(*visibility.shape[1:]):
            both = _both(pair, valid, visibility.dtype)
            weight, flow = _exchange(
                *pair.split(visibility), *pair.split(points), *pair.split(normal), radius, both * pair.weight
            )
            _add((*pair.split(gain), *pair.split(total)), (flow, -flow, weight, weight))
        return visibility + gain / total, total

    def pull_back(
        self, grad: Tensor, needed: Sequence[bool], outputs: Outputs, *tensors: Tensor | None
    ) -> list[Tensor]:
        visibility, points, normal, valid, radius = _given(tensors)
        to_gain = grad / outputs[1]
        to_total = to_gain * (visibility - outputs[0])
        images = (visibility, points, normal)
        totals = [grad.clone(), torch.zeros_like(points), torch.zeros_like(normal), torch.zeros_like(radius)]
        for pair in self.pairs(*visibility.shape[1:]):
            both = _both(pair, valid, visibility.dtype) * pair.weight
            leaves = [part for image in images for part in pair.split(image)]
            gain_here, gain_there = pair.split(to_gain)
            total_here, total_there = pair.split(to_total)
            cotangents = (total_here + total_there, gain_here - gain_there)
            *parts, to_radius = pull_back(partial(_exchange, tap=both), [*leaves, radius], cotangents)
            _add([part for total in totals[:3] for part in pair.split(total)], parts)
            totals[3] += to_radius
        kept = [needed[0], needed[1], needed[2], needed[4]]
        return [total for total, want in zip(totals, kept, strict=True) if want]

    def push_forward(self, tangents: Sequence[Tensor | None], outputs: Outputs, *tensors: Tensor | None) -> Tensor:
        visibility, points, normal, valid, radius = _given(tensors)
        images = (visibility, points, normal)
        moves = [torch.zeros_like(i) if t is None else t for i, t in zip(images, tangents[:3], strict=True)]
        to_radius = torch.zeros_like(radius) if tangents[4] is None else tangents[4]
        gain, total = torch.zeros_like(visibility), torch.zeros_like(visibility)
        for pair in self.pairs(*visibility.shape[1:]):
            both = _both(pair, valid, visibility.dtype) * pair.weight
            leaves = [part for image in images for part in pair.split(image)]
            pushed = [part for move in moves for part in pair.split(move)]
            weight, flow = push_forward(partial(_exchange, tap=both), [*leaves, radius], [*pushed, to_radius])
            _add((*pair.split(gain), *pair.split(total)), (flow, -flow, weight, weight))
        return moves[0] + (gain - (outputs[0] - visibility) * total) / outputs[1]


def _given(tensors: Sequence[Tensor | None]) -> tuple[Tensor, ...]:
    return tuple(tensor for tensor in tensors if tensor is not None)


def _add(targets: Sequence[Tensor], changes: Sequence[Tensor]) -> None:
    for target, change in zip(targets, changes, strict=True):
        target += change


def _both(pair: _Pair, valid: Tensor, dtype: torch.dtype) -> Tensor:
    here, there = pair.split(valid)
    return (here & there).to(dtype)


def _exchange(
    here: Tensor,
    there: Tensor,
    point: Tensor,
    other_point: Tensor,
    normal: Tensor,
    other_normal: Tensor,
    radius: Tensor,
    tap: Tensor,
) -> Outputs:
    """Weight (B, H', W') between two pixels, and what flows from `there` to `here`."""
    between = other_point - point
    over, under = (between * normal).sum(1), (between * other_normal).sum(1)
    unit = radius[:, None, None]
    far = ((over**2 + under**2) / PLANE_WIDTH**2 + (between**2).sum(1)) / unit**2
    alike = (normal * other_normal).sum(1).clamp(min=0)
    for _ in range(NORMAL_POWER):
        alike = alike**2
    weight = tap * alike * torch.exp(-far)
    return weight, weight * (there - here)
