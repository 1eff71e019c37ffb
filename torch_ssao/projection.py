"""Renderers' conventions: clip matrices, z-buffers, OpenGL axes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_ssao import checks


def opengl_to_view(matrix: Tensor) -> Tensor:
    """Turn a world-to-camera matrix of OpenGL / Blender axes (y up, -z forward) into `world_to_view` of ours.

    Args:
        matrix: (..., 4, 4), column vectors.
    Returns: (..., 4, 4) with the y and z rows negated. For vectors (normals, positions) negate y and z alike.
    Gradients: to matrix.
    """
    checks.check_floating("matrix", matrix)
    checks.check_shape("matrix", matrix[..., :, :].reshape(-1, *matrix.shape[-2:]), ("B", 4, 4), "pass 4x4 matrices")
    return matrix * matrix.new_tensor([1.0, -1.0, -1.0, 1.0])[:, None]


def depth_from_zbuffer(zbuffer: Tensor, P: Tensor, *, convention: str = "opengl") -> Tensor:
    """Linear view-space depth from a z-buffer.

    Args:
        zbuffer: (..., H, W) window-space values in [0, 1] (OpenGL: after the default glDepthRange).
        P: (4, 4), or (B, 4, 4) with zbuffer (B, ..., H, W): the clip matrix the image was rendered with.
        convention: as in `Camera.from_projection`.
    Returns: depth of zbuffer's shape, scene units; pixels at the cleared far value come back as inf, hence invalid.
    Gradients: to zbuffer and P.
    """
    checks.check_floating("zbuffer", zbuffer)
    clip = ClipMatrix.read(P, convention)
    ndc = 2 * zbuffer - 1 if convention == "opengl" else zbuffer
    scale, offset = clip.depth_terms(zbuffer.ndim)
    background = zbuffer == (0.0 if convention == "reversed_z" else 1.0)
    denominator = scale if clip.is_orthographic else ndc - scale
    denominator = torch.where(background | (denominator == 0), torch.ones_like(ndc), denominator)
    depth = (ndc - offset) / denominator if clip.is_orthographic else offset / denominator
    return torch.where(background, torch.full_like(depth, torch.inf), depth)


def zbuffer_from_depth(depth: Tensor, P: Tensor, *, convention: str = "opengl") -> Tensor:
    """Window-space z-buffer values in [0, 1] from linear depth: the inverse of `depth_from_zbuffer`.

    Args and Gradients as there; an infinite depth gives the cleared far value.
    """
    checks.check_floating("depth", depth)
    clip = ClipMatrix.read(P, convention)
    scale, offset = clip.depth_terms(depth.ndim)
    ndc = scale * depth + offset if clip.is_orthographic else scale + offset / depth
    zbuffer = (ndc + 1) / 2 if convention == "opengl" else ndc
    far = 0.0 if convention == "reversed_z" else 1.0
    return torch.where(torch.isinf(depth), torch.full_like(zbuffer, far), zbuffer)


@dataclass(frozen=True)
class ClipMatrix:
    """What a clip matrix says of itself: its kind and the sign of z that means forward."""

    matrix: Tensor  # (B, 4, 4)
    is_orthographic: bool
    forward: Tensor  # (B,), +1 or -1

    @staticmethod
    def read(P: Tensor, convention: str) -> ClipMatrix:
        checks.check_floating("P", P)
        checks.check_choice("convention", convention, ("opengl", "vulkan", "d3d", "reversed_z"))
        P = P[None] if P.ndim == 2 else P
        checks.check_shape("P", P, ("B", 4, 4), "pass one 4x4 clip matrix per camera, for column vectors")
        orthographic = P[:, 3, 2] == 0
        whole = bool(orthographic.all()) or not bool(orthographic.any())
        if not whole or bool((P[:, [0, 1], [0, 1]] == 0).any()):
            raise checks.RangeError(
                "P must be perspective or orthographic clip matrices for column vectors (clip = P @ view), got neither "
                "or a mixture: transpose row-vector matrices, and split mixed batches"
            )
        if bool(orthographic.all()):
            # Depth in the buffer grows with distance, except in reversed z.
            forward = torch.sign(P[:, 2, 2]) * (-1 if convention == "reversed_z" else 1)
        else:
            forward = torch.sign(P[:, 3, 2])
        P = P / P[:, 3, 3 if bool(orthographic.all()) else 2].abs()[:, None, None]  # clip matrices have no scale
        return ClipMatrix(P, bool(orthographic.all()), forward)

    def depth_terms(self, ndim: int) -> tuple[Tensor, Tensor]:
        """scale, offset of ndc_z = scale * depth + offset (orthographic) or scale + offset / depth (perspective)."""
        shape = (-1,) + (1,) * (ndim - 1)
        return (self.forward * self.matrix[:, 2, 2]).view(shape), self.matrix[:, 2, 3].view(shape)
