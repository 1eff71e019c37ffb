"""Statistical volumetric obscurance as a differentiable function."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torch_ssao import checks
from torch_ssao.ops.statvo_function import layered_obscurance


def statvo_obscurance(
    points: Tensor,
    valid: Tensor,
    normal: Tensor,
    half: Tensor,
    box_height: Tensor,
    slope: Tensor,
    *,
    layers: int,
    layering: str = "adaptive",
    quadrants: bool = False,
    sat_scale: int = 1,
    differential: bool = False,
    gradient: str = "exact",
    surrogate_width: float = 0.1,
) -> Tensor:
    """Obscurance of every pixel from the mean position of each layer in its window.

    VO = sum_i n_i psi(((mean_i - x) . n) / box_height) / sum_i n_i over the layers i, with n_i the samples of layer i
    in the window and mean_i their mean position.

    Args:
        points: (B, 3, L, H, W) view-space positions, scene units, finite everywhere; layer 0 holds the centres x. Deeper
            images add their samples to the window.
        valid: (B, L, H, W) bool; invalid samples never count.
        normal: (B, 3, H, W) unit normals towards the eye; (0, 0, -1) gives the view-aligned form.
        half: (B, 2, L, H, W) window half-size in pixels (x, y), >= 0; windows are clipped to the image.
        box_height: (B,) height of the sample box over the surface, scene units, > 0.
        slope: (B,) slope of psi above the box, > 0.
        layers: 1 to 256 uniform layers, or 1, 2, 4, ... 256 adaptive ones.
        layering: "adaptive" - a tree of splits at local means; "uniform" - slices of the image's depth range.
        quadrants: evaluate the four quarters of the window that meet at the pixel (nine lookups) and average those that hold
            samples.
        sat_scale: 1, 2 or 4: partition and tables are made of the mean positions of blocks of so many pixels a side, with
            the number of valid pixels carried along; every pixel is still evaluated.
        differential: build half of the layers' tables by subtraction (adaptive layers only): faster to build, more memory.
        gradient: "exact" holds labels constant, which is right almost everywhere; "surrogate" lets a label count as
            sigmoid((mean - depth) / width) in the derivative (adaptive layers only), the value stays the same.
        surrogate_width: width of that sigmoid as a fraction of the box height, > 0.
    Returns: (B, H, W) obscurance in [0, 1], 0 where the centre is invalid. Heights within rounding of the surface -
        8 eps |x| of the input's dtype plus what the float64 table loses - count as 0 with gradient 0: a plane is open.
    Gradients: to points, normal, half, box_height and slope, by the rule `gradient`. Forward mode (`jvp`) alike. Second
        derivatives raise a RuntimeError. The surrogate's width is held constant.
    Cost: layers - 1 two-channel and `layers` four-channel float64 tables, one alive at a time; lookups do not depend on the
        footprint. Backward about three times that, the surrogate's about five. Saved: the inputs, one byte and two floats a
        pixel (eight with quadrants), whatever the layers.
    Source: Statistical Volumetric Obscurance, Eqs. 3-7, Secs. 4 to 7.
    """
    check_choices(layers, layering, sat_scale, gradient, surrogate_width)
    if differential and layering != "adaptive":
        raise checks.ChoiceError("differential must be False with uniform layers, got True: their tables form no tree")
    samples = (points, valid, half) if sat_scale == 1 else _blocks(points, valid, half, sat_scale)
    queries = (points[:, :, 0], normal, valid[:, 0], half[:, :, 0])
    scalars = (box_height, slope, (surrogate_width * box_height).detach())
    choices = (layers, layering, quadrants, sat_scale, differential, gradient)
    return layered_obscurance(*samples, *queries, *scalars, *choices)


def check_choices(layers: int, layering: str, sat_scale: int, gradient: str, surrogate_width: float) -> None:
    """Raise RangeError or ChoiceError unless the discrete choices of `statvo_obscurance` fit together."""
    checks.check_choice("layering", layering, ("adaptive", "uniform"))
    checks.check_count("layers", layers, 1, 256)
    if layering == "adaptive" and layers & (layers - 1):
        below = 1 << (layers.bit_length() - 1)
        raise checks.RangeError(f"layers must be a power of two, got {layers}: use {below} or {2 * below}")
    checks.check_choice("sat_scale", sat_scale, (1, 2, 4))
    checks.check_choice("gradient", gradient, ("exact", "surrogate"))
    if layering == "uniform" and gradient == "surrogate":
        raise checks.ChoiceError(
            "gradient must be 'exact' with uniform layers, got 'surrogate': choose layering='adaptive'"
        )
    checks.check_positive("surrogate_width", surrogate_width)


def _blocks(points: Tensor, valid: Tensor, half: Tensor, side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mean position, number of valid pixels and window half-size of blocks of side x side pixels.

    The half-size is the harmonic mean, which for a perspective camera is the window of the block's mean depth.
    """
    height, width = valid.shape[-2:]
    margin = (0, -width % side, 0, -height % side)

    def total(image: Tensor) -> Tensor:
        padded = pad(image, margin)
        return padded.unflatten(-1, (-1, side)).unflatten(-3, (-1, side)).sum((-1, -3))

    mass = total(valid.to(points.dtype))
    filled = mass[:, None].clamp(min=1)
    position = total(torch.where(valid[:, None], points, 0.0)) / filled
    inverse = total(torch.where(valid[:, None], 1 / half, 0.0))
    return position, mass, torch.where(mass[:, None] > 0, filled / inverse, 0.0)
