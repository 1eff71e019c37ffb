"""The camera record: intrinsics in pixels, an optional pose, conversions from other conventions.

View space is x right, y down, z forward; pixel centres lie at +0.5 (docs/conventions.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torch_ssao import checks
from torch_ssao.projection import ClipMatrix

_TENSORS = ("fx", "fy", "cx", "cy", "world_to_view")


@dataclass(frozen=True, eq=False)
class Camera:
    """A batch of pinhole or orthographic cameras that share one image size.

    Args:
        fx, fy: (B,) focal lengths in pixels, > 0; for an orthographic camera pixels per scene unit.
        cx, cy: (B,) principal point in pixels; W/2, H/2 is the image centre (pixel centres at +0.5).
        height, width: image size in pixels.
        world_to_view: (B, 4, 4) rigid transform of column vectors from world to view space (x right, y down,
            z forward), or None when the world is the view.
        is_orthographic: parallel projection along +z.

    Gradients: every method is differentiable in fx, fy, cx, cy; construct the camera inside the function that
    you differentiate. Cameras are pytrees (`torch.utils._pytree`) and may be indexed along the batch.
    """

    fx: Tensor
    fy: Tensor
    cx: Tensor
    cy: Tensor
    height: int
    width: int
    world_to_view: Tensor | None = None
    is_orthographic: bool = False

    def __post_init__(self) -> None:
        checks.check_count("height", self.height, 1)
        checks.check_count("width", self.width, 1)
        for name in ("fx", "fy", "cx", "cy"):
            tensor = getattr(self, name)
            checks.check_floating(name, tensor)
            checks.check_shape(
                name, tensor, self.fx.shape if self.fx.ndim == 1 else ("B",), "give one value per camera"
            )
        if self.world_to_view is not None:
            checks.check_floating("world_to_view", self.world_to_view)
            remedy = "give one 4x4 matrix per camera"
            checks.check_shape("world_to_view", self.world_to_view, (len(self), 4, 4), remedy)
        tensors = {name: getattr(self, name) for name in _TENSORS}
        checks.check_same_device(**tensors)

    def __len__(self) -> int:
        return int(self.fx.shape[0])

    # ---- constructors ------------------------------------------------------------------------------------------

    @staticmethod
    def perspective(
        fov_y_deg: float | Tensor, height: int, width: int, *, world_to_view: Tensor | None = None
    ) -> Camera:
        """Centred camera with square pixels from its vertical field of view.

        Args:
            fov_y_deg: vertical field of view in degrees, in (0, 180); a number or a (B,) tensor.
            height, width: image size in pixels.
            world_to_view: (4, 4) or (B, 4, 4) pose, see `Camera`.
        Raises:
            RangeError: a field of view outside (0, 180).
        Gradients: to `fov_y_deg` when it is a tensor.
        """
        fov = torch.atleast_1d(torch.as_tensor(fov_y_deg, dtype=_float_dtype(fov_y_deg)))
        if not bool(((fov > 0) & (fov < 180)).all()):
            raise checks.RangeError(
                f"fov_y_deg must lie in (0, 180) degrees, got {fov.tolist()}: pass degrees, not radians"
            )
        focal = 0.5 * height / torch.tan(fov * (math.pi / 360.0))
        return _centred(focal, height, width, world_to_view, is_orthographic=False)

    @staticmethod
    def orthographic(
        view_height: float | Tensor, height: int, width: int, *, world_to_view: Tensor | None = None
    ) -> Camera:
        """Centred orthographic camera with square pixels that sees `view_height` scene units from top to bottom.

        Args:
            view_height: visible height in scene units, > 0; a number or a (B,) tensor.
            height, width: image size in pixels.
            world_to_view: (4, 4) or (B, 4, 4) pose, see `Camera`.
        Raises:
            RangeError: `view_height` not positive.
        Gradients: to `view_height` when it is a tensor.
        """
        extent = torch.atleast_1d(torch.as_tensor(view_height, dtype=_float_dtype(view_height)))
        checks.check_positive("view_height", extent)
        return _centred(height / extent, height, width, world_to_view, is_orthographic=True)

    @staticmethod
    def from_intrinsics(
        K: Tensor, height: int, width: int, *, pixel_centers: str = "half", world_to_view: Tensor | None = None
    ) -> Camera:
        """Camera from a 3x3 intrinsic matrix in pixels.

        Args:
            K: (3, 3) or (B, 3, 3); fx = K[0, 0], fy = K[1, 1], cx = K[0, 2], cy = K[1, 2]. Skew must be zero.
            height, width: image size in pixels.
            pixel_centers: "half" - the top-left pixel's centre is (0.5, 0.5) (OpenGL, gsplat, nerfstudio); "integer" -
                it is (0, 0) (OpenCV, kornia): cx and cy then grow by 0.5.
            world_to_view: (4, 4) or (B, 4, 4) pose, see `Camera`.
        Raises:
            ShapeError, DtypeError, ChoiceError; RangeError for skew or a focal length that is not positive.
        Gradients: to K.
        """
        checks.check_floating("K", K)
        checks.check_choice("pixel_centers", pixel_centers, ("half", "integer"))
        K = K[None] if K.ndim == 2 else K
        checks.check_shape("K", K, ("B", 3, 3), "pass (3, 3) or (B, 3, 3) pixel intrinsics")
        if bool((K[:, 0, 1] != 0).any()):
            raise checks.RangeError("K must have zero skew, got K[0, 1] != 0: rectify the images first")
        checks.check_positive("K[0, 0] (fx)", K[:, 0, 0])
        checks.check_positive("K[1, 1] (fy)", K[:, 1, 1])
        shift = 0.5 if pixel_centers == "integer" else 0.0
        return Camera(
            K[:, 0, 0],
            K[:, 1, 1],
            K[:, 0, 2] + shift,
            K[:, 1, 2] + shift,
            height,
            width,
            _pose(world_to_view, K.shape[0]),
        )

    @staticmethod
    def from_projection(
        P: Tensor, height: int, width: int, *, convention: str = "opengl", world_to_view: Tensor | None = None
    ) -> Camera:
        """Camera from a renderer's 4x4 clip matrix (column vectors: clip = P @ view); perspective or orthographic.

        Args:
            P: (4, 4) or (B, 4, 4), off-centre frusta allowed. Whether the renderer looks along -z or +z is read from P.
            height, width: image size in pixels.
            convention: "opengl" (NDC y up, z in [-1, 1]), "vulkan" (y down, z in [0, 1]), "d3d" (y up, z in [0, 1]) or
                "reversed_z" (y up, near 1, far 0).
            world_to_view: (4, 4) or (B, 4, 4) pose in *our* axes; see `opengl_to_view` for a renderer's.
        Raises:
            ShapeError, DtypeError, ChoiceError; RangeError for a matrix that is no projection.
        Gradients: to P.
        """
        clip = ClipMatrix.read(P, convention)
        P = clip.matrix
        # For a perspective frustum the offset rides on z (third column), for an orthographic one it is a translation.
        offset_x, offset_y = (
            (P[:, 0, 3], P[:, 1, 3]) if clip.is_orthographic else (clip.forward * P[:, 0, 2], clip.forward * P[:, 1, 2])
        )
        image_y = 1.0 if convention == "vulkan" else -1.0
        return Camera(
            fx=P[:, 0, 0].abs() * (width / 2),
            fy=P[:, 1, 1].abs() * (height / 2),
            cx=(1 + offset_x) * (width / 2),
            cy=(1 + image_y * offset_y) * (height / 2),
            height=height,
            width=width,
            world_to_view=_pose(world_to_view, P.shape[0]),
            is_orthographic=clip.is_orthographic,
        )

    # ---- geometry ----------------------------------------------------------------------------------------------

    def rays(self, *, dtype: torch.dtype | None = None) -> tuple[Tensor, Tensor]:
        """View-space x and y of every pixel centre: on the plane z = 1 (perspective) or anywhere (orthographic).

        Returns: x (B, 1, W) and y (B, H, 1), which broadcast to (B, H, W).
        """
        dtype = dtype or self.fx.dtype
        u = torch.arange(self.width, device=self.fx.device, dtype=dtype) + 0.5
        v = torch.arange(self.height, device=self.fx.device, dtype=dtype) + 0.5
        fx, fy, cx, cy = (getattr(self, name)[:, None, None].to(dtype) for name in ("fx", "fy", "cx", "cy"))
        return (u - cx) / fx, (v[:, None] - cy) / fy

    def unproject(self, depth: Tensor) -> Tensor:
        """View-space positions of a depth image.

        Args:
            depth: (B, L, H, W) view-space z in scene units.
        Returns: (B, 3, L, H, W) positions in scene units, in the dtype of `depth`.
        Gradients: to depth, fx, fy, cx, cy.
        """
        x, y = (plane[:, None] for plane in self.rays(dtype=depth.dtype))
        if self.is_orthographic:
            return torch.stack((x.expand_as(depth), y.expand_as(depth), depth), dim=1)
        return torch.stack((x * depth, y * depth, depth), dim=1)

    def footprint(self, length: Tensor, depth: Tensor) -> Tensor:
        """Half-size in pixels that `length` spans in x and y at `depth`: f length / z (orthographic: f length).

        Args:
            length: 0-d tensor, scene units.
            depth: (B, L, H, W) positive view-space z.
        Returns: (B, 2, L, H, W), x then y.
        Gradients: to length, depth, fx, fy.
        """
        focal = torch.stack((self.fx, self.fy), dim=1)[:, :, None, None, None].to(depth.dtype)
        spread = focal * length
        return spread.expand(-1, -1, *depth.shape[1:]) if self.is_orthographic else spread / depth[:, None]

    # ---- batch and device --------------------------------------------------------------------------------------

    def halved(self) -> Camera:
        """The camera of the pixels of even rows and columns, as `depth[..., ::2, ::2]` has them.

        Returns: a Camera of ceil(height / 2) x ceil(width / 2) pixels through the same rays: fx / 2, cx / 2 + 0.25.
        """
        intrinsics = (self.fx / 2, self.fy / 2, self.cx / 2 + 0.25, self.cy / 2 + 0.25)
        size = ((self.height + 1) // 2, (self.width + 1) // 2)
        return Camera(*intrinsics, *size, world_to_view=self.world_to_view, is_orthographic=self.is_orthographic)

    def expand(self, batch: int) -> Camera:
        """The same camera for `batch` images; a batch of one is repeated as a view."""
        if len(self) == batch:
            return self
        if len(self) != 1:
            raise checks.ShapeError(
                f"camera must have batch 1 or {batch}, got {len(self)}: give one camera per depth image"
            )
        return self._map(lambda tensor: tensor.expand(batch, *tensor.shape[1:]))

    def __getitem__(self, index: int | slice | Tensor | list[int]) -> Camera:
        """Cameras along the batch; an int keeps a batch of one."""
        kept = slice(index, index + 1 or None) if isinstance(index, int) else index
        return self._map(lambda tensor: tensor[kept])

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        """`torch.Tensor.to` on every tensor."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def pin_memory(self) -> Camera:
        """`torch.Tensor.pin_memory` on every tensor."""
        return self._map(lambda tensor: tensor.pin_memory())

    @staticmethod
    def cat(cameras: list[Camera]) -> Camera:
        """Join cameras of one image size and kind along the batch."""
        first = cameras[0]
        if any(
            (c.height, c.width, c.is_orthographic) != (first.height, first.width, first.is_orthographic)
            for c in cameras
        ):
            raise checks.ShapeError(
                "cameras must share height, width and projection kind: join only images of one size"
            )
        if len({c.world_to_view is None for c in cameras}) > 1:
            raise checks.ShapeError("cameras must all have a world_to_view or all have none: set the missing poses")
        joined: dict[str, Any] = {
            n: torch.cat([getattr(c, n) for c in cameras]) for n in _TENSORS if getattr(first, n) is not None
        }
        return replace(first, **joined)

    def _map(self, function: Any) -> Camera:
        changed: dict[str, Any] = {n: function(getattr(self, n)) for n in _TENSORS if getattr(self, n) is not None}
        return replace(self, **changed)


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """World-to-view matrix of a camera at `eye` that looks at `target`.

    Args:
        eye, target, up: (..., 3) world-space points and an up direction that is not parallel to the view.
    Returns: (..., 4, 4) in our axes (x right, y down, z forward).
    Raises: RangeError when eye equals target or up is parallel to the view.
    Gradients: to all three.
    """
    forward = target - eye
    right = torch.linalg.cross(forward, up.expand_as(forward))
    if bool((torch.linalg.vector_norm(forward, dim=-1) == 0).any()):
        raise checks.RangeError("target must differ from eye, got the same point: move one of them")
    if bool((torch.linalg.vector_norm(right, dim=-1) <= 1e-6 * torch.linalg.vector_norm(forward, dim=-1)).any()):
        raise checks.RangeError("up must not be parallel to target - eye, got parallel vectors: choose another up")
    forward = torch.nn.functional.normalize(forward, dim=-1)
    right = torch.nn.functional.normalize(right, dim=-1)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack((right, down, forward), dim=-2)  # (..., 3, 3)
    translation = -(rotation @ eye[..., None])
    last = eye.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*eye.shape[:-1], 1, 4)
    return torch.cat((torch.cat((rotation, translation), dim=-1), last), dim=-2)


def _float_dtype(value: float | Tensor) -> torch.dtype:
    return value.dtype if isinstance(value, Tensor) and value.is_floating_point() else torch.get_default_dtype()


def _pose(world_to_view: Tensor | None, batch: int) -> Tensor | None:
    if world_to_view is None:
        return None
    pose = world_to_view[None] if world_to_view.ndim == 2 else world_to_view
    return pose.expand(batch, -1, -1) if pose.shape[0] == 1 else pose


def _centred(focal: Tensor, height: int, width: int, pose: Tensor | None, *, is_orthographic: bool) -> Camera:
    batch = max(focal.shape[0], 1 if pose is None or pose.ndim == 2 else pose.shape[0])
    focal = focal.expand(batch)
    cx, cy = torch.full_like(focal, width / 2), torch.full_like(focal, height / 2)
    return Camera(focal, focal, cx, cy, height, width, _pose(pose, batch), is_orthographic)


def _flatten(camera: Camera) -> tuple[list[Tensor], Any]:
    names = tuple(name for name in _TENSORS if getattr(camera, name) is not None)
    return [getattr(camera, name) for name in names], (names, camera.height, camera.width, camera.is_orthographic)


def _unflatten(children: Any, context: Any) -> Camera:
    names, height, width, is_orthographic = context
    camera = object.__new__(Camera)  # no checks: vmap and friends pass other shapes through
    fields = dict.fromkeys(_TENSORS) | dict(zip(names, children, strict=True))
    fields |= {"height": height, "width": width, "is_orthographic": is_orthographic}
    for name, value in fields.items():
        object.__setattr__(camera, name, value)
    return camera


pytree.register_pytree_node(Camera, _flatten, _unflatten, serialized_type_name="torch_ssao.Camera")
