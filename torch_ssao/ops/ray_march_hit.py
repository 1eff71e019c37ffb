"""Ray-marched ambient occlusion of a few pixels: directions, steps against stored planes, hits and their distances.

Shapes: K rays, J steps, and "pixels" for any trailing dimensions, here (b, P). Vectors carry their axis first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ssao.ops.falloff import attenuation
from torch_ssao.ops.partition import ROUNDING
from torch_ssao.ops.plane_support import MIN_FACING

_AWAY = 1e-4  # 1 - n_z is kept above this: a normal along +z, away from the eye, has no shortest turn


class Pixels(NamedTuple):
    """The differentiable inputs of some pixels."""

    position: Tensor  # (3, b, P)
    normal: Tensor  # (3, b, P)
    reach: Tensor  # (b, P) length of the rays
    falloff: Tensor  # (b, 1)
    thickness: Tensor | None  # (b, 1), of the reach


class Steps(NamedTuple):
    """Where steps fall: the same in every derivative."""

    seen: Tensor  # (J, K, b, P) bool: inside the image and in front of the eye
    sample: Tensor  # (J, K, b, P) row of the stored samples: of the pixels, or of the texels of the pyramid
    known: Tensor  # (J, K, b, P, L) bool: stored sample is valid


def directions(normal: Tensor, disk: Tensor, count: int, rotation: Tensor, offset: Tensor) -> Tensor:
    """Unit directions about the normals: disk points moved per pixel, lifted to the hemisphere, aligned to the normal.

    Args:
        normal: (3, b, P) unit.
        disk: (K, 2) points of the unit disk; a uniform disk lifts to a cosine-weighted hemisphere.
        count: number of points of the whole disk, of which `disk` may hold some.
        rotation: (P,) turns. offset: (P,) place of each point within its ring of area pi / count, in [0, 1): averaged over
            offsets a few points cover the disk as evenly as many.
    Returns: (3, K, b, P). The hemisphere about (0, 0, -1) is turned along the shortest arc onto the normal.
    Gradients: to normal.
    """
    cosine, sine = torch.cos(2 * math.pi * rotation), torch.sin(2 * math.pi * rotation)
    area = disk.square().sum(1)[:, None, None]
    moved = (area + (offset - 0.5) / count).clamp(0, 1)
    scale = (moved / area.clamp(min=torch.finfo(area.dtype).tiny)).sqrt()
    u, v = disk[:, 0, None, None] * scale, disk[:, 1, None, None] * scale
    a, b = u * cosine - v * sine, u * sine + v * cosine
    c = (1 - moved).sqrt()
    x, y, z = normal[:, None]
    across = a * x + b * y
    share = c - across / (1 - z).clamp(min=_AWAY)
    return torch.stack((a + share * x, b + share * y, c * z + across))


def march(pixels: Pixels, direction: Tensor, steps: int) -> Tensor:
    """Positions (3, J, K, b, P) of the uniform steps j R / J, j = 1 ... J."""
    along = _fractions(steps, pixels.reach)
    return pixels.position[:, None, None] + (along * pixels.reach) * direction[:, None]


def tolerance(pixels: Pixels) -> Tensor:
    """Distance from a stored plane within which a step counts as in front: rounding of positions (b, P)."""
    x, y, z = pixels.position
    size = (x**2 + y**2 + z**2).sqrt() + pixels.reach  # a norm over the first axis is slow on CPUs
    return ROUNDING * torch.finfo(size.dtype).eps * size


def depth_behind(place: Tensor, stored: Tensor, orthographic: bool) -> tuple[Tensor, Tensor]:
    """How far places lie behind stored planes, along z and along the plane's normal.

    Args:
        place: (3, ...) view-space positions.
        stored: (..., L, 4) planes: unit normal n towards the eye and n . point.
    Returns: (..., L) depth behind the plane at the place's own pixel position, and (..., L) height over the plane:
        they have opposite signs.
    Gradients: to both.
    """
    x, y, z = (axis[..., None] for axis in place)
    nx, ny, nz, offset = stored.unbind(-1)
    level = nx * x + ny * y + nz * z
    height = level - offset
    if orthographic:
        return height / nz.clamp(max=-0.5 * MIN_FACING), height
    return height * z / torch.minimum(level, -0.5 * MIN_FACING * z), height


def is_inside(behind: Tensor, height: Tensor, known: Tensor, slack: Tensor, thickness: Tensor | None) -> Tensor:
    """Whether steps lie inside a solid: between an entry layer and the next exit, within the thickness of the entry.

    Args:
        behind, height, known: (..., L); slack: (...); thickness: (...) as a depth.
    Returns: (...) bool.
    """
    deeper = known & (height < -slack[..., None])
    inside = torch.zeros_like(deeper[..., 0])
    for entry in range(0, deeper.shape[-1], 2):
        solid = deeper[..., entry]
        if entry + 1 < deeper.shape[-1]:
            solid = solid & ~deeper[..., entry + 1]
        if thickness is not None:
            solid = solid & (behind[..., entry] <= thickness)
        inside = inside | solid
    return inside


def first_inside(inside: Tensor) -> Tensor:
    """Number of steps before the first one inside, (1, ...) int64 of (J, ...) bool; J - 1 where there is none."""
    free = ~inside[0]
    before = free.to(torch.int64)
    for step in inside[1:-1]:  # argmax over the first axis is slow on CPUs
        free = free & ~step
        before += free
    return before[None].clamp(max=inside.shape[0] - 1)


def soft_inside(behind: Tensor, known: Tensor, width: Tensor, thickness: Tensor | None) -> Tensor:
    """`is_inside` with each comparison of depths as sigmoid(difference / width)."""
    share = torch.where(known, torch.sigmoid(behind / width[..., None]), 0.0)
    outside = torch.ones_like(share[..., 0])
    for entry in range(0, share.shape[-1], 2):
        solid = share[..., entry]
        if entry + 1 < share.shape[-1]:
            solid = solid * (1 - share[..., entry + 1])
        if thickness is not None:
            solid = solid * torch.sigmoid((thickness - behind[..., entry]) / width)
        outside = outside * (1 - solid)
    return 1 - outside


def nearest_surface(behind: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Distance in depth (...) to the nearest valid layer, 0 where there is none, and whether there is one."""
    if behind.shape[-1] == 1:
        return torch.where(known, behind, 0.0)[..., 0].abs(), known[..., 0]
    far = torch.where(known, behind.abs(), torch.inf)
    choice = far.argmin(-1, keepdim=True)
    bounded = known.any(-1)
    return torch.where(bounded, behind.abs().gather(-1, choice)[..., 0], 0.0), bounded


def openness(before: Tensor, bounded: Tensor, after: Tensor, first: Tensor, pixels: Pixels, steps: int) -> Tensor:
    """1 - W at the occluder distance of Eq. 1, for a hit between step `first` - 1 and step `first` of `steps`.

    Args:
        before, after: (...) absolute depth distances to the surface; 0 at the pixel itself. Where no surface bounds
            the step before (sky), the occluder is taken at the step behind.
        bounded: (...) bool. first: (...) steps from 1.
    """
    total = before + after
    share = torch.where(bounded, before / torch.where(total > 0, total, 1.0), 1.0)
    distance = (first - 1 + share) / steps
    falloff = pixels.falloff
    weight, to_distance, to_falloff = attenuation(distance.detach(), falloff.detach())
    # The attenuation brings its own derivatives, with their floor near 0.
    slope = to_distance * (distance - distance.detach()) + to_falloff * (falloff - falloff.detach())
    return 1 - weight - slope


def last_to_first(inside: Tensor, open_at: Tensor) -> list[Tensor]:
    """Visibility of what remains of a ray from each step on, (J + 1) of (...): value = a v + (1 - a) value behind."""
    values = [torch.ones_like(open_at[0])]
    for step in range(open_at.shape[0] - 1, -1, -1):
        values.append(values[-1] + inside[step] * (open_at[step] - values[-1]))
    return values[::-1]


def _fractions(steps: int, like: Tensor) -> Tensor:
    return torch.arange(1, steps + 1, dtype=like.dtype, device=like.device).view(-1, 1, 1, 1) / steps
