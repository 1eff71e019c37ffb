"""Horizon-based obscurance: slices of directions through each pixel, taps along them, arcs that they close.

A slice is a plane through the eye and the pixel's point x. On either side of x, each tap reads one texel, a whole number of
pixels away along the slice's major image axis, and meets that texel's plane exactly in the slice: a plane occludes nothing,
and no geometry is made up across edges. With e the elevation of a tap over the tangent plane and a(e) the share of the
hemisphere below it (cosine-weighted, or of solid angle), on each side of each slice the obscurance grows
- "increments": by 1/2 (W_{k-1} + W_k) (a(H_k) - a(H_{k-1})) where tap k raises the horizon H, W = 1 - (distance / R)^p; W_k
  alone where taps k-1 and k are not one surface; with a thickness, only by the part of the rise that the occluder covers;
- "bitmask": by the length of the union of the arcs [a(e_back), a(e_front)] that the occluders cover, each the piece of its
  tap's view ray from the surface to `thickness` R behind it, clipped to the sphere of radius R about x. The union is exact:
  the limit of infinitely many sectors.

Taps move by whole pixels, so the derivative along the footprint R f / z is zero almost everywhere, and the gradient of the
*expected* estimate is not. It is made of two parts: the exact derivative with the texels held, and the effect of the
footprint's size, differenced over +-`FOOTPRINT_STEP` of it with the same noise and handed on to R, z and f.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.ops import horizon_arcs as arcs
from torch_ssao.ops import horizon_taps as taps
from torch_ssao.ops.backend import uses_numba
from torch_ssao.ops.depth_pyramid import Pyramid, build_pyramid
from torch_ssao.ops.footprint import footprint_fade
from torch_ssao.ops.horizon_moments import occluded_moments
from torch_ssao.ops.recompute import Kernel, Outputs, pull_back, push_forward, recompute

BLOCK = {"cpu": 2**18, "cuda": 2**21}  # taps worked on at a time: what fits a cache, what fills a GPU
ESTIMATORS = ("increments", "bitmask")
WEIGHTINGS = ("cosine", "uniform")
OFFSCREEN = ("open", "extend")
FOOTPRINT_STEP = 0.05  # relative change of the footprint over which its effect is differenced
MIN_PIXELS = 4096  # of a block, where there are as many: fewer, and the slices are split instead


def horizon_obscurance(
    depth: Tensor,
    valid: Tensor,
    normal: Tensor,
    intrinsics: Tensor,
    radius: Tensor,
    falloff: Tensor,
    thickness: Tensor | None,
    bias: Tensor,
    rotation: Tensor,
    offset: Tensor,
    *,
    orthographic: bool,
    slices: int,
    steps: int,
    step_power: float,
    weighting: str,
    estimator: str,
    connected: bool = False,
    max_radius_px: float | None = None,
    offscreen: str = "open",
    footprint_step: float = FOOTPRINT_STEP,
    backend: str = "torch",
) -> Tensor:
    """Obscurance of every pixel from slices of directions through it; the module says how.

    Args:
        depth: (B, H, W) view-space z, scene units, > 0 where valid and finite everywhere.
        valid: (B, H, W) bool; invalid pixels never occlude and have obscurance 0.
        normal: (B, 3, H, W) unit normals towards the eye; where zero or not finite, towards the eye plane.
        intrinsics: (B, 4) fx, fy, cx, cy in pixels (orthographic: fx, fy in pixels per scene unit).
        radius: (B,) R, scene units, > 0.
        falloff: (B,) p of "increments", > 0.
        thickness: (B,) of the radius, > 0; None: infinite.
        bias: (B,) radians, >= 0: elevations below it are open.
        rotation, offset: (H, W) noise in [0, 1): of the slices, in 1 / slices of half a turn; of the taps, in steps.
        slices, steps, step_power: taps lie at R ((k + jitter) / steps)^step_power along the slice, at least a pixel away.
        weighting: "cosine" or "uniform".
        estimator: "increments" or "bitmask".
        connected: "bitmask" also covers the arcs between neighbouring taps of one surface.
        max_radius_px: taps further than this many pixels away read a pyramid of selected pixels (`ops.depth_pyramid`): reads
            stay near each other, what lies between the pixels may be missed. R spans at most 32 times as many. None: no cap.
        offscreen: taps off the image never occlude ("open"), or meet the plane of the nearest pixel ("extend").
        footprint_step: of the footprint, over which its effect is differenced in derivatives.
        backend: "torch", "numba" or "auto"; see `ops.backend`.
    Returns: (B, H, W) obscurance in [0, 1]; it fades out where R spans less than a pixel (`ops.footprint`).
    Gradients: to depth, normal, intrinsics, radius, falloff, thickness and bias, of the expected estimate (above);
        footprint_step = 0 gives the derivative almost everywhere. Of a change of the footprint by fx and fy each takes half.
        Forward mode alike. Second derivatives raise a RuntimeError.
    Cost: blocks of 2^18 taps (2^21 on a GPU), one alive at a time; saved: the inputs and three floats a pixel, whatever the
        taps. Backward costs about five times forward.
    Raises: ChoiceError.
    Source: HBAO (Bavoil, Sainz, Dimitrov 2008), GTAO (Jimenez et al. 2016), visibility bitmasks (Therrien et al. 2023).
    """
    form: dict[str, Any] = {"weighting": weighting, "estimator": estimator, "connected": connected}
    layout: dict[str, Any] = {"slices": slices, "steps": steps, "step_power": step_power, "offscreen": offscreen}
    rest: dict[str, Any] = {"max_radius_px": max_radius_px, "footprint_step": footprint_step, "backend": backend}
    tensors: tuple[Any, ...] = (depth, valid, normal, intrinsics, radius, falloff, thickness, bias, rotation, offset)
    options = form | layout | rest
    found, _ = evaluate_horizon(*tensors, orthographic=orthographic, **options)
    return torch.where(valid, found[:, 0], 0.0).clamp(0, 1)


def evaluate_horizon(
    *tensors: Any,
    orthographic: bool,
    slices: int,
    steps: int,
    step_power: float,
    weighting: str,
    estimator: str,
    connected: bool = False,
    max_radius_px: float | None = None,
    offscreen: str = "open",
    footprint_step: float = FOOTPRINT_STEP,
    bent: bool = False,
    backend: str = "torch",
) -> tuple[Tensor, Tensor]:
    """Obscurance and, with `bent`, the mean direction of what is occluded: `horizon_obscurance` says how, and names the tensors.

    Returns: (B, 1 or 4, H, W), not clamped, meaningless at invalid pixels; and the normals that were used.
    """
    depth, valid, normal, intrinsics, radius, falloff, thickness, bias, rotation, offset = tensors
    checks.check_choice("weighting", weighting, WEIGHTINGS)
    checks.check_choice("estimator", estimator, ESTIMATORS)
    checks.check_choice("offscreen", offscreen, OFFSCREEN)
    normal = _usable(normal, valid)
    planes = taps.surface_planes(depth, valid, intrinsics[:, :2], orthographic=orthographic)
    layout = taps.Layout(slices, steps, step_power, orthographic, max_radius_px, offscreen == "extend")
    kernel = _Horizon(layout, weighting == "cosine", estimator, connected, rotation, offset, footprint_step, bent)
    loops = uses_numba(backend, depth, lacking="bent normals" if bent else None)
    found = recompute(
        _compiled(kernel) if loops else kernel, planes, valid, normal, intrinsics, radius, falloff, thickness, bias
    )
    fade = footprint_fade(depth, valid, radius[:, None, None], intrinsics[:, :2], orthographic=orthographic)
    return found * fade[:, None], normal


def _compiled(kernel: _Horizon) -> Kernel:
    """The loops beside a kernel; numba is imported here, on first use."""
    from torch_ssao.ops._numba.horizon import HorizonLoops

    return HorizonLoops(kernel)


def _usable(normal: Tensor, valid: Tensor) -> Tensor:
    known = (torch.isfinite(normal).all(1) & ((normal * normal).sum(1) > 0) & valid)[:, None]
    return torch.where(known, normal, normal.new_tensor([0.0, 0.0, -1.0]).view(1, 3, 1, 1))


class _Inputs(NamedTuple):
    """As the pieces read them: images flat, channels first."""

    planes: Tensor  # (3, B H W)
    valid: Tensor  # (B, H, W)
    normal: Tensor  # (3, B H W)
    intrinsics: Tensor  # (B, 4)
    radius: Tensor  # (B,)
    falloff: Tensor
    thickness: Tensor | None
    bias: Tensor
    stored: Tensor  # (3, M) planes that taps read: of the pixels, or of the texels of the pyramid, in their order
    pyramid: Pyramid | None

    @staticmethod
    def of(tensors: Sequence[Tensor | None], pyramid: Pyramid | None) -> _Inputs:
        planes, valid, normal, *rest = tensors
        flat = [None if t is None else t.transpose(0, 1).flatten(1) for t in (planes, normal)]
        # Levels are copies: what is read lies together.
        stored = flat[0] if pyramid is None else flat[0][:, pyramid.pixel]  # type: ignore[index]
        return _Inputs(flat[0], valid, flat[1], *rest, stored, pyramid)  # type: ignore[arg-type, call-arg]

    @property
    def scalars(self) -> tuple[Tensor | None, ...]:
        """Those of an image: intrinsics, radius, falloff, thickness, bias."""
        return self[3:8]  # type: ignore[return-value]


class _Horizon(NamedTuple):
    layout: taps.Layout
    cosine: bool
    estimator: str
    connected: bool
    rotation: Tensor
    offset: Tensor
    footprint_step: float
    bent: bool  # obscurance and the mean direction of what is occluded, not obscurance alone
    name: str = "horizon_obscurance"

    def value(self, *tensors: Tensor | None) -> Outputs:
        inputs = _Inputs.of(tensors, self._pyramid(tensors))
        total = self._nothing(inputs)
        for block in self._blocks(inputs):
            total[:, block.piece] += block.function(*block.leaves)[0]
        return (_images(total, inputs),)

    def pull_back(
        self, grad: Tensor, needed: Sequence[bool], outputs: Outputs, *tensors: Tensor | None
    ) -> list[Tensor]:
        inputs = _Inputs.of(tensors, self._pyramid(tensors))
        to_planes, to_normal = torch.zeros_like(inputs.planes), torch.zeros_like(inputs.normal)
        to_stored = to_planes if inputs.pyramid is None else torch.zeros_like(inputs.stored)
        to_rest = [torch.zeros_like(t) for t in inputs.scalars if t is not None]
        cotangent = grad.transpose(0, 1).flatten(1)
        for block in self._blocks(inputs):
            piece = block.piece
            level, normal, read, *rest = pull_back(block.function, block.leaves, (cotangent[:, piece],))
            if self.footprint_step > 0:
                own = block.pull_back_spread((cotangent[:, piece] * block.by_spread(inputs)).sum(0))
                level = level + own[0]
                rest[0], rest[1] = rest[0] + own[1], rest[1] + own[2]
            to_planes[0, piece] += level
            to_normal[:, piece] += normal
            for image, part in zip(to_stored, read, strict=True):
                image.index_add_(0, block.texels.source.flatten(), part.flatten())
            for total, part in zip(to_rest, rest, strict=True):
                total += part
        if inputs.pyramid is not None:
            to_planes.index_add_(1, inputs.pyramid.pixel, to_stored)
        everything = iter([_images(to_planes, inputs), None, _images(to_normal, inputs), *to_rest])
        found = [next(everything) if t is not None else None for t in inputs[:8]]
        return [t for t, want in zip(found, needed, strict=True) if want and t is not None]

    def push_forward(self, tangents: Sequence[Tensor | None], outputs: Outputs, *tensors: Tensor | None) -> Tensor:
        inputs = _Inputs.of(tensors, self._pyramid(tensors))
        pairs = zip(tensors, tangents, strict=True)
        tangents = [torch.zeros_like(t) if m is None and t is not None else m for t, m in pairs]
        moved = _Inputs.of(tangents, inputs.pyramid)
        total = self._nothing(inputs)
        for block in self._blocks(inputs):
            leaves = block.leaves_of(moved)
            total[:, block.piece] += push_forward(block.function, block.leaves, leaves)[0]
            if self.footprint_step > 0:
                total[:, block.piece] += block.by_spread(inputs) * block.push_spread(leaves)
        return _images(total, inputs)

    def _pyramid(self, tensors: Sequence[Tensor | None]) -> Pyramid | None:
        valid, cap = tensors[1], self.layout.max_radius_px
        return None if cap is None or valid is None else build_pyramid(valid, cap)

    def _nothing(self, inputs: _Inputs) -> Tensor:
        return inputs.planes.new_zeros(4 if self.bent else 1, inputs.planes.shape[1])

    def _blocks(self, inputs: _Inputs) -> Iterator[_Block]:
        pixels = inputs.planes.shape[1]
        budget = BLOCK.get(inputs.planes.device.type, BLOCK["cpu"])
        per_slice = 2 * self.layout.steps
        together = max(1, min(self.layout.slices, budget // (per_slice * min(MIN_PIXELS, pixels))))
        count = max(1, budget // (per_slice * together))
        for start in range(0, pixels, count):
            for first in range(0, self.layout.slices, together):
                numbers = range(first, min(first + together, self.layout.slices))
                yield _Block(self, inputs, start, min(start + count, pixels), numbers)


class _Block:
    """Some pixels and some of their slices; `spread` is a factor on the taps' distances."""

    def __init__(
        self, kernel: _Horizon, inputs: _Inputs, start: int, stop: int, slices: range, spread: float = 1.0
    ) -> None:
        self.kernel, self.slices = kernel, slices
        size = (inputs.valid.shape[1], inputs.valid.shape[2])
        self.piece = slice(start, stop)
        self.pixels = taps.make_pixels(start, stop, slices, kernel.layout, size, kernel.rotation, kernel.offset)
        level, normal = self._own(inputs)
        frame = taps.make_frame(level, normal, inputs.intrinsics, inputs.radius, self.pixels, kernel.layout)
        self.texels = taps.find_texels(
            frame, self.pixels, inputs.valid, spread, extend=kernel.layout.extend, pyramid=inputs.pyramid
        )
        self.leaves = self.leaves_of(inputs)
        self.has_thickness = inputs.thickness is not None

    def _own(self, inputs: _Inputs) -> tuple[Tensor, Tensor]:
        return inputs.planes[0, self.piece], inputs.normal[:, self.piece]

    def leaves_of(self, inputs: _Inputs) -> list[Tensor]:
        read = torch.stack([plane[self.texels.source] for plane in inputs.stored])
        return [*self._own(inputs), read, *(t for t in inputs.scalars if t is not None)]

    def function(self, level: Tensor, normal: Tensor, read: Tensor, *rest: Tensor) -> Outputs:
        """Obscurance (1, P) that this block adds; with `bent` (4, P), with the mean occluded direction."""
        kernel, image = self.kernel, self.pixels.image
        intrinsics, radius, falloff = rest[:3]
        thickness = rest[3][image] if self.has_thickness else None
        bias = rest[-1][image]
        frame = taps.make_frame(level, normal, intrinsics, radius, self.pixels, kernel.layout)
        found = taps.meet_surface(frame, self.pixels, self.texels, read)
        measure = arcs.Measure.of(frame, cosine=kernel.cosine)
        if kernel.bent:
            part = occluded_moments(
                *(measure, frame, found, falloff[image], thickness, bias),
                estimator=kernel.estimator,
                connected=kernel.connected,
            )
            view, along = taps.slice_axes(intrinsics, self.pixels, kernel.layout)
            amount, towards = part[:2].sum(2)
            direction = towards.sum(0) * view + ((part[2, :, 0] - part[2, :, 1]) * along).sum(1)
            return (torch.cat((amount.sum(0)[None], direction)) / kernel.layout.slices,)
        if kernel.estimator == "increments":
            amount = arcs.weighted_increments(measure, frame, found, falloff[image], thickness, bias)
        else:
            amount = arcs.covered_intervals(measure, frame, found, thickness, bias, connected=kernel.connected)
        return (amount[None] / kernel.layout.slices,)

    def by_spread(self, inputs: _Inputs) -> Tensor:
        """Derivative (1 or 4, P) to the logarithm of the taps' spread: a difference, since taps move by whole pixels."""
        step = self.kernel.footprint_step
        further, nearer = (
            _Block(self.kernel, inputs, self.piece.start, self.piece.stop, self.slices, 1 + sign * step)
            for sign in (1, -1)
        )
        change = further.function(*further.leaves)[0] - nearer.function(*nearer.leaves)[0]
        cap = self.kernel.layout.longest_px
        if cap is not None:  # where it holds, the spread depends on nothing
            level, intrinsics, radius = (self.leaves[i] for i in (0, 3, 4))
            span = radius[self.pixels.image] * intrinsics[self.pixels.image, :2].amax(1)
            span = span if self.kernel.layout.orthographic else span * level
            change = torch.where(span < cap, change, 0.0)
        return change / (2 * step)

    def pull_back_spread(self, to_spread: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cotangents of level (P,), intrinsics (B, 4) and radius (B,) from that of the spread, R f / z in pixels."""
        level, intrinsics, radius = (self.leaves[i] for i in (0, 3, 4))
        to_level = torch.zeros_like(level) if self.kernel.layout.orthographic else to_spread / level
        total = torch.zeros_like(radius).index_add_(0, self.pixels.image, to_spread)
        to_focal = 0.5 * total[:, None] / intrinsics[:, :2]
        return to_level, torch.cat((to_focal, torch.zeros_like(to_focal)), 1), total / radius

    def push_spread(self, tangents: Sequence[Tensor]) -> Tensor:
        """Tangent (P,) of the logarithm of the spread."""
        level, intrinsics, radius = (self.leaves[i] for i in (0, 3, 4))
        moved = tangents[4] / radius + 0.5 * (tangents[3] / intrinsics)[:, :2].sum(1)
        own = 0.0 if self.kernel.layout.orthographic else tangents[0] / level
        return moved[self.pixels.image] + own


def _images(flat: Tensor, inputs: _Inputs) -> Tensor:
    """(B, C, H, W) of (C, B H W)."""
    return flat.unflatten(1, inputs.valid.shape).transpose(0, 1)
