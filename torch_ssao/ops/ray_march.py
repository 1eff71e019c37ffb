"""Ray-marched screen-space ambient occlusion: Poisson-disk rays through depth layers.

Rays start at the nearest layer; directions are disk points turned by `rotation` and shifted within their rings,
lifted to the hemisphere and aligned to the normal. Step j = 1 ... `steps` at j R / steps reads the whole pixel it
falls on; the stored sample stands for its tangent plane there, so that a plane never occludes itself at any angle
(up to 88.9 degrees, where slopes are capped, or to what the depth map supports, `plane_support`): the allowance for a
pixel's footprint is its slope times the step's offset from the pixel's centre, and a step must lie 8 eps (|x| + R)
below the plane. The first step inside a solid is a hit, at the distance of Eq. 1; a ray counts 1 without a hit,
1 - W_p(distance / R) with one.
Layers 0, 1, 2, ... are entry, exit, entry, ...: inside is behind an entry and before the next valid exit, and, with
a thickness, no deeper than that behind the entry.
Steps off the screen or behind the eye never occlude; a ray without a hit counts by the share of its steps that fall in
the image, one with a hit in full, and pixels of which nothing was seen are open. Invalid samples are open space.
Gradients: "exact" - almost everywhere, hits held constant: through Eq. 1 and W. "surrogate" - a hit differentiates as
sigmoid(depth behind / width) (exits and thickness alike) around the hard value. "soft" - value and gradient of the
sigmoid form itself, which darkens planes at grazing rays.
Steps move by whole pixels, so the derivative almost everywhere leaves out what a longer ray newly meets: a third to a half of
the effect of the radius. In all three the derivative to the reach is a difference over +-`REACH_STEP` of it, same noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ssao import checks
from torch_ssao.ops import ray_march_hit as hit
from torch_ssao.ops.backend import uses_numba
from torch_ssao.ops.depth_pyramid import Pyramid, build_pyramid, pixels_of, texels_at
from torch_ssao.ops.footprint import footprint_fade
from torch_ssao.ops.plane_support import least_facing
from torch_ssao.ops.ray_march_hit import Pixels, Steps
from torch_ssao.ops.recompute import Kernel, Outputs, pull_back, push_forward, recompute

GRADIENTS = ("exact", "surrogate", "soft")
REACH_STEP = 0.05  # relative change of the reach over which its effect is differenced
_TAPS_AT_ONCE = {"cpu": 2**17, "cuda": 2**21}  # a block fits the cache of a core, or fills a GPU


def ray_march_visibility(
    points: Tensor,
    valid: Tensor,
    normal: Tensor,
    reach: Tensor,
    falloff: Tensor,
    thickness: Tensor | None,
    intrinsics: Tensor,
    disk: Tensor,
    rotation: Tensor,
    offset: Tensor,
    *,
    steps: int,
    orthographic: bool,
    gradient: str = "exact",
    surrogate_width: float = 0.05,
    max_radius_px: float | None = None,
    reach_step: float = REACH_STEP,
    backend: str = "torch",
) -> Tensor:
    """Visibility of every pixel from rays marched through the depth layers; the module says how.

    Args:
        points: (B, 3, L, H, W) view-space positions, scene units, finite everywhere.
        valid: (B, L, H, W) bool.
        normal: (B, 3, L, H, W) unit normals of each layer; layer 0's orient the hemisphere.
        reach: (B, H, W) length R of the rays, scene units, > 0.
        falloff, thickness: (B,) exponent p of the attenuation, > 0; of the reach, > 0, or None for solids without end.
        intrinsics: (B, 4) fx, fy, cx, cy in pixels.
        disk: (K, 2) points inside the unit disk, one a ray, one a ring of equal area: the mean does not depend on K.
        rotation, offset: (H, W) noise in [0, 1): turns of the disk, and places of the points within their rings.
        steps: a ray, >= 1.
        orthographic: parallel projection along +z.
        gradient, surrogate_width: see the module; the width is of the reach, > 0.
        max_radius_px: steps further than this many pixels away read a pyramid of selected pixels (`ops.depth_pyramid`); the
            caller shortens the reach to `furthest_read`. None: no cap.
        reach_step: of the reach, over which its effect is differenced in derivatives; 0 for the derivative almost everywhere.
        backend: "torch", "numba" (gradient "exact" only) or "auto"; see `ops.backend`.
    Returns: (B, H, W) in [0, 1]; 1 at invalid pixels, and it fades to 1 where the reach spans less than a pixel.
    Gradients: to points, normal, reach, falloff and (not "exact") thickness; to intrinsics through the fading alone, and
        to the camera through points. Forward mode alike. Second derivatives raise a RuntimeError.
    Cost: K steps reads of L samples, in a derivative to the reach three times as many; saved: the inputs and two floats a
        pixel, whatever the rays and steps.
    Raises: RangeError, ChoiceError.
    Source: Poisson-based ray-marched SSAO, Algorithm 1, Eqs. 1 and 2.
    """
    checks.check_count("steps", steps, 1)
    checks.check_choice("gradient", gradient, GRADIENTS)
    checks.check_positive("surrogate_width", surrogate_width)
    height, width = valid.shape[2:]
    spec = _Spec(steps, height, width, orthographic, gradient, surrogate_width, max_radius_px)
    planes = tangent_planes(points, normal, valid, intrinsics, orthographic=orthographic).flatten(2, 3)
    kernel = _March(spec, disk, rotation.reshape(-1), offset.reshape(-1), reach_step)
    lacking = None if gradient == "exact" else f"gradient {gradient!r} of the ray march"
    visibility = recompute(
        _compiled(kernel) if uses_numba(backend, points, lacking=lacking) else kernel,
        points[:, :, 0].flatten(2),
        normal[:, :, 0].flatten(2),
        reach.flatten(1),
        falloff,
        thickness,
        planes.transpose(1, 2).contiguous(),
        valid.flatten(2).transpose(1, 2),
        intrinsics.detach(),
    )
    fade = footprint_fade(points[:, 2, 0], valid[:, 0], reach, intrinsics[:, :2], orthographic=orthographic)
    return torch.lerp(torch.ones_like(fade), visibility.unflatten(1, (height, width)), fade)


def _compiled(kernel: _March) -> Kernel:
    """The loops beside a kernel; numba is imported here, on first use."""
    from torch_ssao.ops._numba.ray_march import MarchLoops

    return MarchLoops(kernel)


def tangent_planes(points: Tensor, normal: Tensor, valid: Tensor, intrinsics: Tensor, *, orthographic: bool) -> Tensor:
    """Planes through samples: unit normal n and n . point, tilted towards the eye where they face it too little.

    Args:
        points, normal: (B, 3, L, H, W). valid: (B, L, H, W) bool. intrinsics: (B, 4) fx, fy, cx, cy in pixels.
        orthographic: parallel projection.
    Returns: (B, L, H, W, 4); the cosine between n and the ray to the eye is at least `plane_support.least_facing`.
    Gradients: to points, normal and intrinsics.
    """
    if orthographic:
        ray = points.new_tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1, 1)
    else:
        length = points.square().sum(1, keepdim=True).clamp(min=torch.finfo(points.dtype).tiny).sqrt()
        ray = points / length
    least = least_facing(points, normal, valid, intrinsics, orthographic=orthographic)[:, None]
    lacking = ((normal * ray).sum(1, keepdim=True) + least).clamp(min=0)
    facing = normal - lacking * ray
    return torch.cat((facing, (facing * points).sum(1, keepdim=True)), 1).movedim(1, -1)


class _Spec(NamedTuple):
    steps: int
    height: int
    width: int
    orthographic: bool
    gradient: str
    surrogate_width: float
    max_radius_px: float | None = None


class _Inputs(NamedTuple):
    """N pixels a batch, L layers."""

    position: Tensor  # (B, 3, N)
    normal: Tensor  # (B, 3, N)
    reach: Tensor  # (B, N)
    falloff: Tensor  # (B,)
    thickness: Tensor | None  # (B,)
    planes: Tensor  # (B, N, L, 4)
    valid: Tensor  # (B, N, L)
    intrinsics: Tensor  # (B, 4)
    pyramid: Pyramid | None = None


def _inputs(tensors: Sequence[Tensor | None], spec: _Spec) -> _Inputs:
    inputs = _Inputs(*tensors)  # type: ignore[arg-type]
    inputs = inputs._replace(planes=inputs.planes.contiguous())  # what is read at random lies together
    if spec.max_radius_px is None:
        return inputs
    known = inputs.valid.any(2).unflatten(1, (spec.height, spec.width))
    return inputs._replace(pyramid=build_pyramid(known, spec.max_radius_px))


def _stored(planes: Tensor, pyramid: Pyramid | None) -> Tensor:
    """(B, N, L, 4) of all pixels, or (1, M, L, 4) of all texels of the pyramid: copies, so that what is read lies together."""
    return planes if pyramid is None else planes.flatten(0, 1)[pyramid.pixel][None]


class _Block(NamedTuple):
    """Some rays of some pixels of some images."""

    rays: slice
    images: slice
    pixels: slice

    def cut(self, tensors: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Position, normal, reach, falloff, thickness of this block; views, vectors with their axis first."""
        position, normal, reach, falloff, thickness = tensors
        vectors = [None if t is None else t[self.images, :, self.pixels].movedim(1, 0) for t in (position, normal)]
        images = None if reach is None else reach[self.images, self.pixels]
        return [*vectors, images, *(None if t is None else t[self.images, None] for t in (falloff, thickness))]


class _March(NamedTuple):
    """The kernel: see `recompute.Kernel`."""

    spec: _Spec
    disk: Tensor
    rotation: Tensor
    offset: Tensor
    reach_step: float = REACH_STEP
    name: str = "ray_march_visibility"

    def value(self, *tensors: Tensor | None) -> Outputs:
        inputs = _inputs(tensors, self.spec)
        stored = _stored(inputs.planes, inputs.pyramid)
        visibility, weight = torch.empty_like(inputs.reach), torch.empty_like(inputs.reach)
        for rays in self.blocks(inputs):
            at = rays[0].images, rays[0].pixels
            visibility[at], weight[at] = self.value_of(rays, inputs, stored)
        return visibility, weight

    def value_of(
        self, rays: Sequence[_Block], inputs: _Inputs, stored: Tensor, spread: float = 1.0
    ) -> tuple[Tensor, Tensor]:
        """Visibility (b, P) of the pixels of blocks that differ in their rays alone, and the rays' weight, inf where unseen."""
        total: Tensor | float = 0.0
        weight: Tensor | float = 0.0
        for block in rays:
            piece = _Piece(self, block, inputs, stored, spread)
            total = total + piece.visibility(*piece.leaves)[0]
            weight = weight + piece.weight.sum(0)
        weight = torch.as_tensor(weight)
        seen = inputs.valid[rays[0].images, rays[0].pixels, 0] & (weight > 0)
        return torch.where(seen, total / weight.clamp(min=1e-6), 1.0), torch.where(seen, weight, torch.inf)

    def by_reach(self, rays: Sequence[_Block], inputs: _Inputs, stored: Tensor) -> Tensor:
        """(b, P) derivative of the value to the reach, by differences: longer rays read other pixels."""
        spreads = (1 + self.reach_step, 1 - self.reach_step)
        further, nearer = (self.value_of(rays, inputs, stored, spread)[0] for spread in spreads)
        return (further - nearer) / (2 * self.reach_step * inputs.reach[rays[0].images, rays[0].pixels])

    def pull_back(
        self, grad: Tensor, needed: Sequence[bool], outputs: Outputs, *tensors: Tensor | None
    ) -> list[Tensor]:
        inputs = _inputs(tensors, self.spec)
        stored = _stored(inputs.planes, inputs.pyramid)
        totals = [None if t is None else torch.zeros_like(t) for t in inputs[:5]]
        to_stored = torch.zeros_like(stored)
        flat = to_stored.view(-1, stored.shape[2] * 4)
        for rays in self.blocks(inputs, derivative=True):
            at = rays[0].images, rays[0].pixels
            for block in rays:
                piece = _Piece(self, block, inputs, stored)
                *parts, rows = pull_back(piece.visibility, piece.leaves, [grad[at] / outputs[1][at]])
                targets = [target for target in block.cut(totals) if target is not None]
                for target, part in zip(targets, parts, strict=True):
                    target += part
                if needed[5]:
                    flat.index_add_(0, piece.rows_at.flatten(), rows.flatten(0, -3).flatten(1))
            if needed[2] and self.reach_step > 0:
                totals[2][at] = grad[at] * self.by_reach(rays, inputs, stored)  # type: ignore[index]
        planes = to_stored
        if inputs.pyramid is not None:
            planes = torch.zeros_like(inputs.planes)
            planes.view(-1, flat.shape[1]).index_add_(0, inputs.pyramid.pixel, flat)
        return [total for total, want in zip([*totals, planes], needed, strict=False) if want and total is not None]

    def push_forward(self, tangents: Sequence[Tensor | None], outputs: Outputs, *tensors: Tensor | None) -> Tensor:
        inputs = _inputs(tensors, self.spec)
        stored = _stored(inputs.planes, inputs.pyramid)
        moves = [
            None if t is None else (torch.zeros_like(t) if move is None else move)
            for t, move in zip(inputs[:6], tangents[:6], strict=True)
        ]
        by_reach = None if tangents[2] is None or self.reach_step == 0 else tangents[2]
        if by_reach is not None:
            moves[2] = torch.zeros_like(inputs.reach)
        total = torch.zeros_like(inputs.reach)
        moved = _stored(moves[5], inputs.pyramid)  # type: ignore[arg-type]
        for rays in self.blocks(inputs, derivative=True):
            at = rays[0].images, rays[0].pixels
            for block in rays:
                piece = _Piece(self, block, inputs, stored)
                leaves = [move for move in block.cut(moves[:5]) if move is not None]
                leaves.append(_rows(moved, piece.rows_at))
                (pushed,) = push_forward(piece.visibility, piece.leaves, leaves)
                total[at] += pushed / outputs[1][at]
            if by_reach is not None and bool(by_reach[at].any()):  # most columns of a Jacobian do not move the reach
                total[at] += by_reach[at] * self.by_reach(rays, inputs, stored)
        return total

    def blocks(self, inputs: _Inputs, *, derivative: bool = False) -> Iterator[list[_Block]]:
        """Those of the same pixels together: they differ in their rays. Derivatives record them: fewer at once."""
        batch, count = inputs.reach.shape
        taps = _TAPS_AT_ONCE.get(inputs.reach.device.type, 2**17)
        share = (2 if self.spec.gradient == "exact" else 8) if derivative else 1  # the others record every step
        budget = max(1, taps // (share * self.spec.steps))
        pixels = min(count, budget)
        images = min(batch, max(1, budget // count))
        rays = min(len(self.disk), max(1, budget // (pixels * images)))
        for image in range(0, batch, images):
            for pixel in range(0, count, pixels):
                at = slice(image, image + images), slice(pixel, pixel + pixels)
                yield [_Block(slice(ray, ray + rays), *at) for ray in range(0, len(self.disk), rays)]


class _Piece:
    """The rays of a block: where their steps fall, and their visibility as a function of the differentiable inputs.

    `spread` is a factor on the reach.
    """

    def __init__(self, kernel: _March, block: _Block, inputs: _Inputs, stored: Tensor, spread: float = 1.0) -> None:
        self.spec = spec = kernel.spec
        noise = kernel.rotation[block.pixels], kernel.offset[block.pixels]
        self.sampling = kernel.disk[block.rays], len(kernel.disk), *noise
        cut = block.cut(inputs[:5])
        if spread != 1:
            cut[2] = spread * inputs.reach[block.images, block.pixels]
        self.given = [part is not None for part in cut]
        pixels = Pixels(*cut)  # type: ignore[arg-type]
        place = hit.march(pixels, hit.directions(pixels.normal, *self.sampling), spec.steps)
        self.steps = _read(place, inputs, block, spec)
        rows = _rows(stored, self.steps.sample)
        behind, height = hit.depth_behind(place, rows, spec.orthographic)
        thickness = None if pixels.thickness is None else pixels.thickness * pixels.reach
        known = self.steps.known
        self.inside = self.steps.seen & hit.is_inside(behind, height, known, hit.tolerance(pixels), thickness)
        seen = self.steps.seen.to(pixels.reach.dtype).mean(0)
        self.weight = torch.where(self.inside.any(0), 1.0, seen)  # what lies behind a hit does not matter
        self.rows_at = self.steps.sample
        if spec.gradient == "exact":
            self.found = self.inside.any(0)
            self.first = hit.first_inside(self.inside)
            pair = torch.cat(((self.first - 1).clamp(min=0), self.first))
            self.rows_at = self.steps.sample.gather(0, pair)
            self.pair_known = torch.stack([known[..., layer].gather(0, pair) for layer in range(known.shape[-1])], -1)
            rows = _rows(stored, self.rows_at)
        self.leaves = [*(part for part in cut if part is not None), rows]

    def visibility(self, *leaves: Tensor) -> tuple[Tensor]:
        """Weighted visibility (b, P), summed over the rays of the block; `leaves` as `self.leaves`."""
        parts = iter(leaves[:-1])
        pixels = Pixels(*(next(parts) if given else None for given in self.given))  # type: ignore[arg-type]
        direction = hit.directions(pixels.normal, *self.sampling)
        open_share = self._at_hit if self.spec.gradient == "exact" else self._along
        return ((self.weight * open_share(pixels, direction, leaves[-1])).sum(0),)

    def _at_hit(self, pixels: Pixels, direction: Tensor, rows: Tensor) -> Tensor:
        """Hits held constant: only the steps before and behind the surface matter."""
        steps = self.spec.steps
        first = self.first[0] + 1
        along = torch.stack((first - 1, first)).to(rows.dtype) / steps
        place = pixels.position[:, None, None] + (along * pixels.reach) * direction[:, None]
        behind, _ = hit.depth_behind(place, rows, self.spec.orthographic)
        distance, bounded = hit.nearest_surface(behind, self.pair_known)
        at_pixel = first == 1
        before = torch.where(at_pixel, 0.0, distance[0])
        value = hit.openness(before, bounded[0] | at_pixel, distance[1], first, pixels, steps)
        return torch.where(self.found, value, 1.0)

    def _along(self, pixels: Pixels, direction: Tensor, rows: Tensor) -> Tensor:
        """Every step may become a hit, or cease to be one."""
        spec, known = self.spec, self.steps.known
        place = hit.march(pixels, direction, spec.steps)
        behind, _ = hit.depth_behind(place, rows, spec.orthographic)
        thickness = None if pixels.thickness is None else pixels.thickness * pixels.reach
        soft = hit.soft_inside(behind, known, spec.surrogate_width * pixels.reach, thickness) * self.steps.seen
        after, bounded = hit.nearest_surface(behind, known)
        before = torch.cat((torch.zeros_like(after[:1]), after[:-1]))
        bounded = torch.cat((torch.ones_like(bounded[:1]), bounded[:-1]))
        number = torch.arange(1, spec.steps + 1, device=rows.device).view(-1, 1, 1, 1)
        open_at = hit.openness(before, bounded, after, number, pixels, spec.steps)
        if spec.gradient == "surrogate":
            soft = self.inside + (soft - soft.detach())
        return hit.last_to_first(soft, open_at)[0]


def _read(place: Tensor, inputs: _Inputs, block: _Block, spec: _Spec) -> Steps:
    """Whole-pixel positions of steps, and which samples they read."""
    x, y, z = place
    fx, fy, cx, cy = inputs.intrinsics[block.images].T[:, :, None]
    ahead = z > 0
    scale = 1.0 if spec.orthographic else 1 / torch.where(ahead, z, 1.0)
    column, row = fx * x * scale + cx, fy * y * scale + cy
    seen = ahead & (column >= 0) & (column < spec.width) & (row >= 0) & (row < spec.height)
    row_at, column_at = torch.where(seen, row, 0.0).long(), torch.where(seen, column, 0.0).long()
    image = torch.arange(len(inputs.reach), device=x.device)[block.images, None]
    if inputs.pyramid is None:
        index = pixel = row_at * spec.width + column_at + image * inputs.reach.shape[1]
    else:
        own = torch.arange(inputs.reach.shape[1], device=x.device)[block.pixels]
        down, across = row - (own // spec.width + 0.5), column - (own % spec.width + 0.5)
        index = texels_at(inputs.pyramid, image, row_at, column_at, torch.maximum(down.abs(), across.abs()))
        pixel = pixels_of(inputs.pyramid, index)
    known = inputs.valid.reshape(-1, inputs.valid.shape[2])[pixel]
    return Steps(seen, index, known)


def _rows(planes: Tensor, index: Tensor) -> Tensor:
    """(*index, L, 4) planes at flat indices."""
    layers = planes.shape[2]
    rows = planes.reshape(-1, 4 * layers).index_select(0, index.flatten())
    return rows.view(*index.shape, layers, 4)
