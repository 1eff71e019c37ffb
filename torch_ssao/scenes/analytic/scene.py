"""The record of an analytic scene: surfaces, the closed form of each, cameras, G-buffers, meshes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypedDict, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_ssao import checks
from torch_ssao.camera import Camera, look_at
from torch_ssao.gbuffer import GBuffer
from torch_ssao.scenes import closed_forms
from torch_ssao.scenes.primitives import Array, Surface

_FAR = 1e4  # in spans: what lies deeper is background, so that rays along a plane's horizon do not reach 1e16
_ON_SURFACE = 1e-4  # of the depth: a float32 depth, or a finely tessellated sphere, still counts as on its surface
_AZIMUTH = (
    0.8,
    -0.6,
    0.0,
)  # default cameras stand in front of the wall and to the side, so that nothing is axis-aligned


class Question(TypedDict):
    """How visibility is measured; see `closed_forms`."""

    radius: float
    falloff: str
    weighting: str


# World points (N, 3), unit normals towards the eye (N, 3) -> visibility (N,), NaN where no closed form holds.
ClosedForm = Callable[[Array, Array, Question], Array]


@final
@dataclass(frozen=True, eq=False)
class AnalyticScene:
    """Simple surfaces with the exact visibility of the points on them; made by the builders of this package.

    Args:
        name: of the builder.
        surfaces: the primitives, in world space.
        exact_forms: the closed form of each surface.
        focus: world-space point of the floor that default cameras look at.
        span: scene units that default cameras see about the focus; a sensible radius is half of it.
    """

    name: str
    surfaces: tuple[Surface, ...]
    exact_forms: tuple[ClosedForm, ...]
    focus: tuple[float, float, float]
    span: float

    def camera(
        self,
        height: int,
        width: int,
        *,
        view_angle_deg: float = 45.0,
        orthographic: bool = False,
        fov_y_deg: float = 50.0,
        span: float | None = None,
    ) -> Camera:
        """Float64 camera that looks at the focus, at an angle from the floor's normal.

        Args:
            height, width: image size in pixels.
            view_angle_deg: in [0, 90), between the viewing direction and the floor's normal at the image centre.
            orthographic: parallel projection of the same span.
            fov_y_deg: vertical field of view of a perspective camera, degrees.
            span: scene units visible at the focus, top to bottom; the scene's own by default. Where a surface would
                come between the eye and the focus, the camera stands halfway to that surface and sees less.
        Returns: a batch of one.
        Raises: RangeError.
        """
        if not 0 <= view_angle_deg < 90:
            raise checks.RangeError(
                f"view_angle_deg must lie in [0, 90), got {view_angle_deg!r}: measure it from the normal"
            )
        span = self.span if span is None else span
        checks.check_positive("span", span)
        if not 0 < fov_y_deg < 180:
            raise checks.RangeError(
                f"fov_y_deg must lie in (0, 180) degrees, got {fov_y_deg!r}: pass degrees, not radians"
            )
        tangent = math.tan(math.radians(fov_y_deg) / 2)
        sine, cosine = math.sin(math.radians(view_angle_deg)), math.cos(math.radians(view_angle_deg))
        focus, azimuth, z = (torch.tensor(v, dtype=torch.float64) for v in (self.focus, _AZIMUTH, (0.0, 0.0, 1.0)))
        towards_eye, up = sine * azimuth + cosine * z, sine * z - cosine * azimuth
        distance = 0.5 * span / tangent
        free = float(self._first_hit(focus, towards_eye, start=1e-9 * span)[0])
        distance = min(distance, 0.5 * free)
        eye = focus + distance * towards_eye
        pose = look_at(eye, focus, up)
        if not orthographic:
            return Camera.perspective(torch.tensor(fov_y_deg, dtype=torch.float64), height, width, world_to_view=pose)
        # The rays of a parallel projection start on a rectangle about the eye, which must not reach through a surface.
        right, aspect = pose[0, :3], width / height
        corners = torch.stack([i * aspect * right + j * up for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
        room = float(self._first_hit(eye, corners, start=1e-9 * span)[0].min())
        return Camera.orthographic(
            min(span, 1.8 * room) * torch.ones(1, dtype=torch.float64), height, width, world_to_view=pose
        )

    def render(self, camera: Camera, *, dtype: torch.dtype = torch.float64) -> GBuffer:
        """Exact G-buffer by ray/primitive intersection in float64.

        Args:
            camera: perspective or orthographic, any batch; without a `world_to_view` the world is its view space.
            dtype: of depth and normals, rounded from float64.
        Returns: depth (B, 1, H, W), inf where nothing is seen; unit normals towards the eye (B, 3, H, W), (0, 0, -1)
            where nothing is seen; valid (B, 1, H, W). On the camera's device.
        Raises: DtypeError.
        Gradients: none.
        Cost: about 0.3 us a pixel and surface on one core.
        """
        if not dtype.is_floating_point:
            raise checks.DtypeError(f"dtype must be floating point, got {dtype}: pass torch.float64 or torch.float32")
        with torch.no_grad():
            origin, direction = _world_rays(camera)
            depth, index = self._first_hit(origin, direction)
            seen = depth <= _FAR * self.span
            points = origin + torch.where(seen, depth, 1.0)[..., None] * direction
            normal = self._normals(points, direction, index)
            if camera.world_to_view is not None:
                normal = torch.einsum("bij,bhwj->bhwi", camera.world_to_view[:, :3, :3].double(), normal)
                normal = torch.nn.functional.normalize(normal, dim=-1)  # a float32 pose is rigid only to 1e-7
            normal = torch.where(seen[..., None], normal, normal.new_tensor([0.0, 0.0, -1.0])).permute(0, 3, 1, 2)
            depth = torch.where(seen, depth, torch.inf)[:, None]
        return GBuffer(depth.to(dtype), camera, normal=normal.to(dtype).contiguous(), valid=seen[:, None])

    def exact(
        self, gbuffer: GBuffer, *, radius: float = math.inf, falloff: str = "binary", weighting: str = "cosine"
    ) -> tuple[Tensor, Tensor]:
        """Exact visibility at the pixels of a G-buffer of this scene, made by `render` or from the `mesh`.

        Args:
            gbuffer: the nearest layer's depth and the camera are read; pixels off the scene's surfaces (by more than
                1e-4 of their depth) are unknown.
            radius: > 0, scene units, inf allowed.
            falloff: "binary", "linear" or "quadratic".
            weighting: "cosine", "uniform" or "volumetric" (binary falloff only; known where occluders are half-spaces).
        Returns: visibility (B, 1, H, W) in depth's dtype, 1 where unknown; known (B, 1, H, W) bool, False where no
            closed form holds.
        Raises: RangeError, ChoiceError.
        Gradients: none.
        Cost: about 0.5 us a pixel on one core, 1 to 10 us where a form is integrated numerically.
        """
        closed_forms.check_question(radius, falloff, weighting)
        question = Question(radius=radius, falloff=falloff, weighting=weighting)
        depth = gbuffer.depth[:, 0].detach()
        valid = gbuffer.valid_mask[:, 0]
        with torch.no_grad():
            origin, direction = _world_rays(gbuffer.camera)
            safe = torch.where(valid, depth.double(), 1.0)
            points = origin + safe[..., None] * direction
            distance, index = torch.stack([surface.distance(points) for surface in self.surfaces]).min(dim=0)
            normal = self._normals(points, direction, index)
            known = valid & (distance <= _ON_SURFACE * safe)
        flat = known.cpu().numpy().ravel()
        place, normals = (t.reshape(-1, 3).cpu().numpy() for t in (points, normal))
        owner = index.cpu().numpy().ravel()
        visibility = np.full(flat.shape, np.nan)
        for number, form in enumerate(self.exact_forms):
            mine = flat & (owner == number)
            if mine.any():
                visibility[mine] = form(place[mine], normals[mine], question)
        answer = torch.from_numpy(visibility).reshape(depth.shape).to(depth.device)
        known = ~torch.isnan(answer)
        return torch.where(known, answer, 1.0).to(depth.dtype)[:, None], known[:, None]

    def mesh(self, extent: float, *, segments: int = 256) -> tuple[Array, NDArray[np.int64]]:
        """Triangles of the surfaces, for ray tracers.

        Args:
            extent: > 0, scene units; infinite surfaces are cut at this distance from the focus, so pixels whose sphere
                of radius R stays within it have the visibility that `exact` gives.
            segments: around a sphere or a circle; its error in visibility is about (pi / segments)^2.
        Returns: vertices (V, 3) float64 in world space; faces (F, 3) int64, counter-clockwise about the normals.
        Raises: RangeError.
        """
        checks.check_positive("extent", extent)
        checks.check_count("segments", segments, 8)
        vertices: list[Array] = []
        faces: list[NDArray[np.int64]] = []
        for surface in self.surfaces:
            points, corners = surface.mesh(np.asarray(self.focus), extent, segments)
            faces.append(corners + sum(len(v) for v in vertices))
            vertices.append(points)
        return np.concatenate(vertices), np.concatenate(faces)

    def _first_hit(self, origin: Tensor, direction: Tensor, *, start: float = 0.0) -> tuple[Tensor, Tensor]:
        """Ray parameter (..., ) of the nearest surface beyond `start`, inf for none, and that surface's number."""
        hits = torch.stack([surface.hit(origin, direction, start) for surface in self.surfaces])
        nearest, index = hits.min(dim=0)
        return (nearest.reshape(1), index.reshape(1)) if nearest.ndim == 0 else (nearest, index)

    def _normals(self, points: Tensor, direction: Tensor, index: Tensor) -> Tensor:
        """World normals (..., 3) of the numbered surfaces, towards the eye."""
        normal = torch.zeros_like(points)
        for number, surface in enumerate(self.surfaces):
            normal = torch.where((index == number)[..., None], surface.normal_at(points), normal)
        away = (normal * direction).sum(dim=-1, keepdim=True) > 0
        return torch.where(away, -normal, normal)


def _world_rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """Origins and directions (B, H, W, 3) of the pixel centres in world space, float64; the ray parameter is depth."""
    x, y = torch.broadcast_tensors(*camera.rays(dtype=torch.float64))
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    origin = torch.stack((x, y, zero) if camera.is_orthographic else (zero, zero, zero), dim=-1)
    direction = torch.stack((zero, zero, one) if camera.is_orthographic else (x, y, one), dim=-1)
    if camera.world_to_view is None:
        return origin, direction
    to_world = torch.linalg.inv(camera.world_to_view.double())
    rotation = to_world[:, :3, :3]
    origin = torch.einsum("bij,bhwj->bhwi", rotation, origin) + to_world[:, None, None, :3, 3]
    return origin, torch.einsum("bij,bhwj->bhwi", rotation, direction)
