"""Ray-march tests' common ground: the oracle on a G-buffer, a few pixels of a large image, smooth depth bumps."""

from __future__ import annotations

import torch
from torch import Tensor

import torch_ssao as ts
from oracles.ray_march import ray_march_visibility as oracle_visibility
from torch_ssao.ops import normals_from_points, poisson_disk, tiled_noise
from torch_ssao.ops.ray_march import _Block, _Inputs, _March, _Piece, _Spec, tangent_planes

VALUES = {"radius": 0.45, "falloff": 0.7, "thickness": 0.4, "contrast": 1.4}


def ray_march(*, thick: bool = True, rays: int = 5, steps: int = 6, **changes: object) -> ts.RayMarchedSSAO:
    """Float64 module with the values of `VALUES`, all learnable."""
    values = {name: changes.pop(name, value) for name, value in VALUES.items()}
    values["thickness"] = values["thickness"] if thick else None
    net = ts.RayMarchedSSAO(**values, rays=rays, steps=steps, learnable="all", **changes).double()  # type: ignore[arg-type]
    for name, value in values.items():
        if value is not None:
            setattr(net, name, value)  # set in float64, after the conversion
    return net


def geometry(gb: ts.GBuffer) -> tuple[Tensor, Tensor, Tensor]:
    """Positions and normals (B, 3, L, H, W) and intrinsics (B, 4), float64."""
    points = gb.camera.unproject(torch.where(gb.valid, gb.depth, 1.0).double())
    layers = [normals_from_points(points[:, :, k], gb.valid[:, k]) for k in range(gb.depth.shape[1])]
    if gb.normal is not None:
        layers[0] = gb.normal.double()
    camera = gb.camera
    return points, torch.stack(layers, 2), torch.stack((camera.fx, camera.fy, camera.cx, camera.cy), 1).double()


def oracle(net: ts.RayMarchedSSAO, gb: ts.GBuffer, *, frame: int = 0, eps: float = 2.0**-52) -> Tensor:
    """The oracle's answer, (B, 1, H, W), with the module's numbers."""
    points, normals, intrinsics = geometry(gb)
    batch, _, height, width = gb.depth.shape
    values = net.values()
    reach = torch.full((batch, height, width), values["radius"], dtype=torch.float64)
    if net.max_radius_px is not None:
        focal = intrinsics[:, :2].amax(1)[:, None, None]
        scale = 1.0 if gb.camera.is_orthographic else points[:, 2, 0]
        reach = torch.minimum(reach, 32 * net.max_radius_px * scale / focal)
    rotation, offset = tiled_noise(height, width, frame, dtype=torch.float64, device=gb.depth.device)
    image = oracle_visibility(
        points,
        gb.valid,
        normals,
        reach,
        intrinsics,
        poisson_disk(net.rays, dtype=torch.float64),
        rotation,
        offset,
        orthographic=gb.camera.is_orthographic,
        steps=net.steps,
        falloff=values["falloff"],
        contrast=values["contrast"],
        thickness=values.get("thickness"),
        eps=eps,
        max_radius_px=net.max_radius_px,
    )
    return torch.from_numpy(image)[:, None]


def some_pixels(
    gb: ts.GBuffer,
    pixels: slice,
    *,
    radius: float,
    falloff: float,
    thickness: float | None = None,
    rays: int = 1024,
    steps: int = 64,
) -> tuple[Tensor, Tensor]:
    """Visibility (P,) of a run of pixels of one image, single layer, and which of them saw all of their steps."""
    points, normals, intrinsics = geometry(gb)
    _, _, height, width = gb.depth.shape
    orthographic = gb.camera.is_orthographic
    rotation, offset = tiled_noise(height, width, 0, dtype=torch.float64, device=gb.depth.device)
    spec = _Spec(steps, height, width, orthographic, "exact", 0.05)
    kernel = _March(spec, poisson_disk(rays, dtype=torch.float64), rotation.reshape(-1), offset.reshape(-1))
    inputs = _Inputs(
        points[:, :, 0].flatten(2),
        normals[:, :, 0].flatten(2),
        torch.full((1, height * width), radius, dtype=torch.float64),
        torch.tensor([falloff], dtype=torch.float64),
        None if thickness is None else torch.tensor([thickness], dtype=torch.float64),
        tangent_planes(points, normals, gb.valid, intrinsics, orthographic=orthographic)
        .flatten(2, 3)
        .transpose(1, 2)
        .contiguous(),
        gb.valid.flatten(2).transpose(1, 2),
        intrinsics,
    )
    total = weight = torch.zeros(1, dtype=torch.float64)
    for ray in range(0, rays, 128):
        piece = _Piece(kernel, _Block(slice(ray, ray + 128), slice(0, 1), pixels), inputs, inputs.planes)
        total = total + piece.visibility(*piece.leaves)[0][0]
        weight = weight + piece.weight.sum(0)[0]
    return total / weight, weight > rays * (1 - 1e-9)


def bumps(count: int, height: int, width: int, *, sigma: float = 3.0, seed: int = 1) -> Tensor:
    """(count, height, width) smooth bumps of height 1 at random places, `sigma` pixels wide."""
    generator = torch.Generator().manual_seed(seed)
    centre = torch.rand(count, 2, 1, 1, generator=generator, dtype=torch.float64)
    centre = centre * torch.tensor([height - 12.0, width - 12.0]).view(1, 2, 1, 1) + 6
    y, x = torch.arange(height, dtype=torch.float64)[:, None], torch.arange(width, dtype=torch.float64)
    return torch.exp(-((y - centre[:, 0]) ** 2 + (x - centre[:, 1]) ** 2) / (2 * sigma**2))


def smooth_gbuffer(height: int, width: int) -> ts.GBuffer:
    """A bumpy surface without edges, with the exact normals of its depth."""
    camera = ts.Camera.perspective(50.0, height, width).to(torch.float64)

    def position(u: Tensor, v: Tensor) -> Tensor:
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        a, b = 2.6 * (u / width - 0.5), 2 * (v / height - 0.5)
        z = 4 + 0.25 * torch.sin(5 * a) * torch.cos(4 * b) - 0.5 * torch.exp(-8 * ((a + 0.6) ** 2 + (b - 0.3) ** 2))
        return torch.stack((x * z, y * z, z))

    rows, columns = (torch.arange(size, dtype=torch.float64) + 0.5 for size in (height, width))
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    right, down = (position(u + e, v + f) - position(u - e, v - f) for e, f in ((1e-4, 0.0), (0.0, 1e-4)))
    normal = torch.nn.functional.normalize(torch.linalg.cross(down, right, dim=0), dim=0)
    return ts.GBuffer(position(u, v)[None, 2:], camera, normal=normal[None])


def with_depth(gb: ts.GBuffer, depth: Tensor) -> ts.GBuffer:
    """The same normals and camera on another depth, of any batch."""
    return ts.GBuffer(depth, gb.camera, normal=gb.normal.expand(len(depth), -1, -1, -1))
