"""The G-buffer record: batched depth layers, normals, validity and the camera that saw them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torch_ssao import checks
from torch_ssao.camera import Camera
from torch_ssao.ops.normals import normals_from_points

# Surfaces have depths between 1 / FARTHEST and FARTHEST: beyond, products of depths, or of their inverses, that the techniques
# take leave the range of the dtype they compute in. In float32 that was seen from 1e15 on, in float64 from 1e150.
FARTHEST = {torch.float64: 1e100}
FARTHEST_FLOAT32 = 1e12  # and for what is computed in float32
_TENSORS = ("depth", "normal", "valid", "triangles")


@dataclass(frozen=True, eq=False)
class GBuffer:
    """Batched geometry of the visible (and, optionally, depth-peeled) surfaces.

    Args:
        depth: (B, L, H, W) view-space z in scene units, floating point; `depth[:, 0]` is the nearest surface, deeper
            layers follow. Pixels with z <= 0, inf or NaN are invalid, and those that no surface has: z > 1e12 or z < 1e-12
            (float64: 1e100, 1e-100), where arithmetic overflows. Clear depth buffers to infinity all the same.
        camera: `Camera` of batch B or 1, with the image size H x W.
        normal: (B, 3, H, W) unit view-space normals towards the eye, dtype of depth (the techniques make them unit, as
            interpolation does not leave them); None: view-aligned only.
        valid: (B, L, H, W) bool, further pixels to leave out (sky, transparency); None keeps all with a usable depth.
        triangles: (B, 3, 3, H, W) vertices of the visible triangle (vertex, xyz), for triangle-buffer techniques.

    Raises: ShapeError, DtypeError, DeviceError.
    Gradients: to depth, normal, triangles and the camera; invalid pixels receive exactly 0. G-buffers are pytrees:
        build one inside the function that you differentiate, or map over it with `torch.func.vmap`.
    """

    depth: Tensor
    camera: Camera
    normal: Tensor | None = None
    valid: Tensor | None = None
    triangles: Tensor | None = None

    def __post_init__(self) -> None:
        checks.check_floating("depth", self.depth)
        remedy = "add the batch and layer dimensions, or use GBuffer.from_depth for plain depth maps"
        checks.check_shape("depth", self.depth, ("B", "L", "H", "W"), remedy)
        if not isinstance(self.camera, Camera):
            raise checks.ShapeError(
                f"camera must be a torch_ssao.Camera, got {type(self.camera).__name__}: build one first"
            )
        batch, _, height, width = self.depth.shape
        if (self.camera.height, self.camera.width) != (height, width):
            raise checks.ShapeError(
                f"camera must have the image size of depth, {height}x{width}, "
                f"got {self.camera.height}x{self.camera.width}: build it with depth's height and width"
            )
        object.__setattr__(self, "camera", self.camera.expand(batch))
        for name, shape in (("normal", (batch, 3, height, width)), ("triangles", (batch, 3, 3, height, width))):
            tensor = getattr(self, name)
            if tensor is None:
                continue
            checks.check_floating(name, tensor)
            checks.check_shape(name, tensor, shape, "one per pixel of depth")
            if tensor.dtype != self.depth.dtype:
                raise checks.DtypeError(
                    f"{name} must have depth's dtype {self.depth.dtype}, got {tensor.dtype}: convert one of them"
                )
        usable = _usable(self.depth)
        if self.valid is not None:
            checks.check_shape("valid", self.valid, self.depth.shape, "one flag per depth sample")
            if self.valid.dtype != torch.bool:
                raise checks.DtypeError(f"valid must be bool, got {self.valid.dtype}: compare first, e.g. alpha > 0.5")
        checks.check_same_device(
            depth=self.depth, normal=self.normal, valid=self.valid, triangles=self.triangles, fx=self.camera.fx
        )
        object.__setattr__(self, "valid", usable if self.valid is None else usable & self.valid)

    @staticmethod
    def from_depth(depth: Tensor, camera: Camera, *, valid: Tensor | None = None) -> GBuffer:
        """G-buffer of plain depth maps, with normals estimated from the depth.

        Args:
            depth: (H, W), (B, H, W) or (B, L, H, W) view-space z, scene units.
            camera: its camera, batch 1 or B.
            valid: bool, shape of depth.
        Returns: a GBuffer with normals of the nearest layer (see `ops.normals.normals_from_points`).
        Gradients: to depth and camera, also through the normals.
        """
        checks.check_floating("depth", depth)
        if depth.ndim not in (2, 3, 4):
            raise checks.ShapeError(
                f"depth must have shape (H, W), (B, H, W) or (B, L, H, W), got {tuple(depth.shape)}: reshape it"
            )
        if valid is not None:
            checks.check_shape("valid", valid, depth.shape, "one flag per depth value")
        lead = {2: (None, None), 3: (slice(None), None), 4: ()}[depth.ndim]
        plain = GBuffer(depth[lead], camera, valid=None if valid is None else valid[lead])
        seen = plain.valid_mask[:, :1]
        points = plain.camera.unproject(torch.where(seen, plain.depth[:, :1], 1.0))
        return replace(plain, normal=normals_from_points(points[:, :, 0], seen[:, 0]))

    @property
    def valid_mask(self) -> Tensor:
        """(B, L, H, W) bool: usable depth and not masked out."""
        if self.valid is None:  # only while __post_init__ runs, or for a record that vmap rebuilt without one
            return _usable(self.depth)
        return self.valid

    def __len__(self) -> int:
        return int(self.depth.shape[0])

    def __getitem__(self, index: int | slice | Tensor | list[int]) -> GBuffer:
        """Images along the batch; an int keeps a batch of one."""
        kept = slice(index, index + 1 or None) if isinstance(index, int) else index
        return self._map(lambda tensor: tensor[kept], self.camera[kept])

    def to(self, *args: Any, **kwargs: Any) -> GBuffer:
        """`torch.Tensor.to` on every tensor; masks stay bool."""
        device = self.depth.to(*args, **kwargs).device
        return self._map(
            lambda tensor: tensor.to(*args, **kwargs) if tensor.is_floating_point() else tensor.to(device),
            self.camera.to(*args, **kwargs),
        )

    def pin_memory(self) -> GBuffer:
        """`torch.Tensor.pin_memory` on every tensor."""
        return self._map(lambda tensor: tensor.pin_memory(), self.camera.pin_memory())

    @staticmethod
    def cat(gbuffers: Sequence[GBuffer]) -> GBuffer:
        """Join G-buffers of one image size and layer count along the batch.

        Raises: ShapeError when sizes differ or only some have normals or triangles.
        """
        if not gbuffers:
            raise checks.ShapeError("gbuffers must hold at least one GBuffer, got none: pass a non-empty list")
        first = gbuffers[0]
        joined: dict[str, Tensor] = {}
        for name in _TENSORS:
            tensors = [getattr(g, name) for g in gbuffers]
            if all(tensor is None for tensor in tensors):
                continue
            shapes = {None if tensor is None else tuple(tensor.shape[1:]) for tensor in tensors}
            if len(shapes) > 1:
                raise checks.ShapeError(
                    f"{name} must have one shape per image in every GBuffer, got {shapes}: pad or drop it first"
                )
            joined[name] = torch.cat(tensors)
        return replace(first, camera=Camera.cat([g.camera for g in gbuffers]), **joined)

    def _map(self, function: Any, camera: Camera) -> GBuffer:
        changed = {n: function(getattr(self, n)) for n in _TENSORS if getattr(self, n) is not None}
        return replace(self, camera=camera, **changed)


def _usable(depth: Tensor) -> Tensor:
    farthest = FARTHEST.get(depth.dtype, FARTHEST_FLOAT32)
    # float16 rounds both limits, to 0 and infinity: it has neither depth.
    return torch.isfinite(depth) & (depth > 0) & (depth >= 1 / farthest) & (depth <= farthest)


def collate(items: Sequence[Any]) -> Any:
    """`collate_fn` for a DataLoader whose dataset yields G-buffers, alone or inside tuples and dicts.

    G-buffers are joined along their own batch dimension; everything else goes through torch's default_collate.
    """
    first = items[0]
    if isinstance(first, GBuffer):
        return GBuffer.cat(items)
    if isinstance(first, dict):
        return {key: collate([item[key] for item in items]) for key in first}
    if isinstance(first, (tuple, list)):
        return type(first)(collate(list(column)) for column in zip(*items, strict=True))
    return torch.utils.data.default_collate(list(items))


def _flatten(gbuffer: GBuffer) -> tuple[list[Any], Any]:
    names = tuple(name for name in _TENSORS if getattr(gbuffer, name) is not None)
    return [gbuffer.camera, *(getattr(gbuffer, name) for name in names)], names


def _unflatten(children: Any, names: Any) -> GBuffer:
    gbuffer = object.__new__(GBuffer)  # no checks: vmap and friends pass other shapes through
    camera, *tensors = children
    for name, value in (dict.fromkeys(_TENSORS) | dict(zip(names, tensors, strict=True)) | {"camera": camera}).items():
        object.__setattr__(gbuffer, name, value)
    return gbuffer


pytree.register_pytree_node(GBuffer, _flatten, _unflatten, serialized_type_name="torch_ssao.GBuffer")
