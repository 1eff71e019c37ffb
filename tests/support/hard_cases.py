"""The figures of the hard cases, the smaller the better, as functions of a technique's name.

`support.hard_case_list` says what they mean and where they ought to be.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from support import hard_case_scenes as scenes
from support.gbuffers import plane_gbuffer
from torch_ssao.ops.denoise import denoise_visibility
from torch_ssao.projection import depth_from_zbuffer, zbuffer_from_depth
from torch_ssao.scenes import analytic

Make = Callable[..., ts.modules.AmbientVisibility]

TECHNIQUES: dict[str, Make] = {
    "statvo": ts.StatVO,
    "bitmask": ts.HBAO,
    "increments": lambda *a, **k: ts.HBAO(*a, **({"estimator": "increments"} | k)),
    "march": ts.RayMarchedSSAO,
    "march-solid": lambda *a, **k: ts.RayMarchedSSAO(*a, **({"thickness": None} | k)),
}
TITLES = {
    "statvo": "StatVO",
    "bitmask": "HBAO bitmask",
    "increments": "HBAO increments",
    "march": "RayMarchedSSAO",
    "march-solid": "RayMarchedSSAO, infinite thickness",
}
TAPS: dict[str, tuple[dict[str, int], dict[str, int]]] = {  # the default, and many more
    "statvo": ({}, {"layers": 16}),
    "bitmask": ({}, {"slices": 16, "steps": 16}),
    "increments": ({}, {"slices": 16, "steps": 16}),
    "march": ({}, {"rays": 64, "steps": 32}),
    "march-solid": ({}, {"rays": 64, "steps": 32}),
}
HORIZON = ("bitmask", "increments")
MARCH = ("march", "march-solid")
CAPPED = HORIZON + MARCH  # those that sample, and have a cap and a denoiser


def make(name: str, radius: float, **changes: Any) -> ts.modules.AmbientVisibility:
    """The technique with its defaults, but the radius (set in float64) and `changes`."""
    net = TECHNIQUES[name](1.0, **changes).double()
    net.radius = radius
    return net


def worst(image: Tensor, where: Tensor | None = None) -> float:
    """Largest |image|, or NaN."""
    return float((image if where is None else image[where.expand_as(image)]).abs().max())


# ---- the figures, in the order of the list -------------------------------------------------------------------------


def halo(name: str) -> float:
    return max(worst(1 - make(name, 1.0)(gb), gb.depth == 6.0) for gb in map(scenes.pillar, (2.0, 3.0, 5.0)))


def near_halo(name: str) -> float:
    gb = scenes.pillar(1.2)
    return worst(1 - make(name, 1.0)(gb), gb.depth == 6.0)


def under_slat(name: str, **changes: Any) -> float:
    """Mean error on the floor beside and under a thin slat 0.3 above it, R = 1."""
    scene = analytic.raised_slat(0.3, 0.4)
    gb = scene.render(scene.camera(*scenes.SIZE, view_angle_deg=50.0, span=3.0))
    exact, known = scene.exact(gb, radius=1.0, falloff="linear" if name in MARCH else "binary")
    middle = (..., slice(12, 36), slice(16, 48))
    return float((make(name, 1.0, **changes)(gb) - exact)[middle][(known & (exact < 0.999))[middle]].mean())


def thin_occluder(name: str) -> float:
    return under_slat(name, thickness=0.05, **TAPS[name][1])


def rims(name: str) -> float:
    before, alone = (make(name, 0.5)(scenes.ball(plane=plane)) for plane in (True, False))
    return worst(before - alone, scenes.rim())


def scale(name: str) -> float:
    """Float32, 99.9 % of the pixels: a step that rounding carries over a surface is one ray of one pixel."""
    gb = scenes.steps().to(torch.float32)
    image = make(name, 0.4).float()(gb)
    changes = [make(name, 0.4 * k).float()(scenes.scaled(gb, k)) - image for k in (1e-3, 10.0, 1e6)]
    return max(float(change.abs().flatten().quantile(0.999)) for change in changes)


def half_resolution(name: str) -> float:
    biases = []
    for size in ((96, 128), (97, 131)):
        gb = scenes.temple(*size)
        net, half = make(name, 0.8), scenes.halved(gb)
        full = net(gb)[..., ::2, ::2]
        biases.append(float((net(half) - full)[half.valid_mask].mean()))
    return max(biases, key=abs)


def orthographic_planes(name: str) -> float:
    planes = [plane_gbuffer(a, orthographic=True, dtype=torch.float64) for a in (0.0, 30.0, 60.0, 80.0)]
    return max(worst(1 - make(name, 0.5)(gb)) for gb in planes)


def beside_wall(name: str, gb: ts.GBuffer) -> Tensor:
    """Mean difference to a closed form, on the floor in four bands of distance from the wall, up to the radius.

    The closed form takes out where in a band the pixels happen to lie: StatVO's own value differs from it.
    """
    question = {"statvo": {"weighting": "volumetric"}, "bitmask": {}, "increments": {}}.get(name, {"falloff": "linear"})
    exact, _ = analytic.wall().exact(gb, radius=0.5, **question)
    middle = (..., slice(12, 36), slice(16, 48))  # so that the radius stays on the image
    off, x = (image[middle] for image in (make(name, 0.5)(gb) - exact, scenes.wall_distance(gb)))
    bands = [(0.05 + 0.1 * k, 0.15 + 0.1 * k) for k in range(4)]
    return torch.stack([off[(x > low) & (x < high)].mean() for low, high in bands])


def orthographic_wall(name: str) -> float:
    return worst(beside_wall(name, scenes.wall(orthographic=True)) - beside_wall(name, scenes.wall(10.0)))


def field_of_view(name: str) -> float:
    means = torch.stack([beside_wall(name, scenes.wall(fov)) for fov in (10.0, 30.0, 60.0, 90.0, 120.0)])
    return worst(means - means.mean(0))


def clip_matrix(convention: str, near: float = 0.1, far: float = 100.0) -> Tensor:
    """Float32 perspective matrix that looks along -z (Vulkan: y down)."""
    a, b = {
        "opengl": (-(far + near) / (far - near), -2 * far * near / (far - near)),
        "reversed_z": (near / (far - near), far * near / (far - near)),
    }.get(convention, (-far / (far - near), -far * near / (far - near)))
    flip = -1.0 if convention == "vulkan" else 1.0
    return torch.tensor([[1.6, 0, 0, 0], [0, 2.1 * flip, 0, 0], [0, 0, a, b], [0, 0, -1, 0]])


def depth_buffers(name: str) -> float:
    """Float32 buffers of every convention and a logarithmic one, against the depth that went in."""
    gb = scenes.steps().to(torch.float32)
    net = make(name, 0.4).float()
    again = []
    for convention in ("opengl", "vulkan", "d3d", "reversed_z"):
        P = clip_matrix(convention)
        buffer = zbuffer_from_depth(gb.depth, P, convention=convention)
        again.append(depth_from_zbuffer(buffer, P, convention=convention))
    near, far = 0.1, 100.0
    logarithmic = torch.log(gb.depth / near) / torch.log(torch.tensor(far / near))
    again.append(near * (far / near) ** logarithmic)
    images = [net(replace(gb, depth=depth)) for depth in again]
    return max(float((image - net(gb)).abs().flatten().quantile(0.99)) for image in images)


def far_precision(name: str) -> float:
    net = make(name, 750.0).float()
    return max(worst(1 - net(scenes.far_plane(normals=normals))) for normals in (True, False))


def sky(name: str) -> float:
    """Largest obscurance of a floor under the sky; NaN where the sky's depth changes anything or gets a gradient."""
    gb = scenes.horizon()
    net, depth = make(name, 0.5), gb.depth.clone().requires_grad_()
    image = net(replace(gb, depth=depth))
    (grad,) = torch.autograd.grad(image.cos().sum(), depth)
    deaf = all(torch.equal(net(scenes.horizon(sky)), image) for sky in (1e5, 0.5, torch.nan))
    silent = bool((grad[~gb.valid_mask] == 0).all()) and bool((image[~gb.valid_mask] == 1).all())
    return worst(1 - image.detach()) if deaf and silent else torch.nan


def damage(name: str) -> float:
    """Values that are not in [0, 1], and gradients that are not finite."""
    image, grads = derivatives(name, scenes.damaged(), torch.float32)
    return float((~((image >= 0) & (image <= 1))).sum()) + sum(float((~torch.isfinite(g)).sum()) for g in grads)


def normal_length(name: str) -> float:
    """Normals as interpolation shortens them, and as scaling lengthens them."""
    gb, net = scenes.steps(), make(name, 0.4)
    assert gb.normal is not None
    return max(worst(net(replace(gb, normal=gb.normal * length)) - net(gb)) for length in (0.8, 1.25))


def absurd_depths(name: str) -> float:
    """As `damage`, of valid depths that squares of float32 do not hold: the far value of some renderers, and its inverse."""
    image, grads = derivatives(name, scenes.absurd(), torch.float32)
    return float((~((image >= 0) & (image <= 1))).sum()) + sum(float((~torch.isfinite(g)).sum()) for g in grads)


def horizon_row(name: str) -> float:
    """Largest obscurance where the floor is seen beyond 89 degrees, next to the sky, its radius less than a pixel."""
    return worst(1 - make(name, 0.5)(scenes.horizon(limit=100.0)))


def grazing_planes(name: str) -> float:
    net = make(name, 0.5).float()
    return max(worst(1 - net(scenes.quantised_plane(angle))) for angle in (1.0, 30.0, 60.0, 80.0, 85.0))


def estimated_normals(name: str) -> float:
    net = make(name, 0.5).float()
    gbs = [scenes.quantised_plane(angle, normals=False) for angle in (1.0, 30.0, 60.0, 80.0, 85.0)]
    return max(worst(1 - net(gb)) for gb in gbs)


def smooth_facets(name: str) -> float:
    """Mean obscurance of a convex prism within 60 degrees of the front, the worse of two places in the pixel grid."""
    means = []
    for z in (5.0, 5.1):
        gb = scenes.facets(z=z)
        facing = (gb.normal[:, 2:] < -0.5) & gb.valid_mask
        means.append(float((1 - make(name, 0.5)(gb))[facing].mean()))
    return max(means)


def crops(name: str) -> tuple[Tensor, Tensor]:
    """|difference| between a crop and the larger image, and distance from the cut edges in footprints of the radius."""
    large, radius, (height, width) = scenes.steps(80, 112), 0.2, scenes.SIZE
    net, crop = make(name, radius), scenes.cropped(large, *scenes.SIZE)
    span = crop.camera.footprint(torch.tensor(radius), crop.depth).amax(1)
    u, v = torch.arange(width) + 0.5, torch.arange(height)[:, None] + 0.5
    return (net(crop) - net(large)[..., :height, :width]).abs(), torch.minimum(width - u, height - v) / span


def crop_inside(name: str) -> float:
    change, away = crops(name)
    return float(change[away > 3.3].quantile(0.99))


def crop_border(name: str) -> float:
    change, away = crops(name)
    return float(change[away < 1].mean())


def cost(name: str) -> float:
    """Time with the radius a thousand times larger, capped where there is a cap, over the time with the smaller radius."""
    gb, cap = scenes.steps(), {"max_radius_px": 16.0} if name in CAPPED else {}
    small, large = (make(name, radius, **cap) for radius in (0.4, 400.0))
    taken: dict[Any, list[float]] = {small: [], large: []}
    for _ in range(7):
        for net, times in taken.items():
            start = time.perf_counter()
            net(gb)
            times.append(time.perf_counter() - start)
    return min(taken[large]) / min(taken[small])


def reach(name: str) -> float:
    """The largest mean change that caps of 8, 16 and 32 pixels make where the radius spans 60 to 160 pixels."""
    gb = scenes.temple(144, 192)
    image = make(name, 8.0)(gb)
    seen = gb.valid_mask[:, :1]
    changes = [float((make(name, 8.0, max_radius_px=cap)(gb) - image)[seen].mean()) for cap in (8.0, 16.0, 32.0)]
    return max(changes, key=abs)


def relative_parameters(name: str) -> float:
    """Scaling with every parameter off its default, float64."""
    gb, images = scenes.steps(), []
    for k in (1.0, 1e-3, 1e6):
        net = make(name, 0.4 * k)
        for parameter, value in (
            ("height", 0.6),
            ("falloff", 0.8),
            ("contrast", 1.3),
            ("thickness", 0.3),
            ("bias_deg", 4),
        ):
            if parameter in net.PARAMETERS:
                setattr(net, parameter, value)
        images.append(net(scenes.scaled(gb, k)))
    return max(worst(image - images[0]) for image in images[1:])


def alpha_mask(name: str) -> float:
    """Obscurance by masked leaves; NaN where the depth under the mask matters."""
    gb, plane = scenes.foliage()
    net = make(name, 0.5)
    image = net(gb)
    return worst(1 - image, plane) if torch.equal(image, net(scenes.foliage(2.0)[0])) else torch.nan


def repeats(name: str) -> float:
    """Same input twice (float32), two places in a batch; NaN where the global generator was touched."""
    gb, net = scenes.steps().to(torch.float32), make(name, 0.4).float()
    before = torch.random.get_rng_state()
    image = net(gb)
    other = scenes.scaled(gb, 1.3)
    batch = net(ts.GBuffer.cat([other, gb, other, gb]))
    if not torch.equal(before, torch.random.get_rng_state()):
        return torch.nan
    return max(worst(net(gb) - image), worst(batch[1] - image[0]), worst(batch[3] - image[0]))


def noise(name: str) -> float:
    """Standard deviation between frames after two passes of the denoiser (none for StatVO)."""
    gb, denoise = scenes.temple(), {"denoise": 2} if name in CAPPED else {}
    net = make(name, 0.8, **denoise)
    images = torch.stack([net(gb, frame=frame) for frame in range(8)])
    return float(images.var(0).mean().sqrt())


def sample_count(name: str) -> float:
    gb = scenes.temple()
    few, many = (make(name, 0.8, **taps)(gb).double() for taps in TAPS[name])
    return float((few - many)[gb.valid_mask].mean())


def weighting(name: str) -> float:
    """Mean error on floor and wall against the closed form of each weighting that the technique names."""
    closed: dict[str, list[tuple[dict[str, Any], dict[str, Any]]]] = {
        "bitmask": [({"weighting": w, "thickness": None}, {"weighting": w}) for w in ("cosine", "uniform")],
        "increments": [
            ({"weighting": w, "thickness": None, "falloff": 2.0}, {"weighting": w, "falloff": "quadratic"})
            for w in ("cosine", "uniform")
        ],
        "march-solid": [({}, {"falloff": "linear"})],
    }
    scene = analytic.wall()
    gb = scene.render(scene.camera(*scenes.SIZE))
    span = 1.3 * gb.camera.footprint(torch.tensor(0.3), gb.depth)
    height, width = scenes.SIZE
    u, v = torch.arange(width) + 0.5, torch.arange(height)[:, None] + 0.5
    inside = (span[:, 0] < torch.minimum(u, width - u)) & (span[:, 1] < torch.minimum(v, height - v))
    off = []
    for options, question in closed[name]:
        exact, known = scene.exact(gb, radius=0.3, **question)
        off.append(float((make(name, 0.3, **TAPS[name][1], **options)(gb) - exact)[known & inside].mean()))
    return max(off, key=abs)


def denoised_edge(name: str) -> float:
    """Two planes half a radius apart in depth, 0.3 and 0.9 open: largest change of three passes."""
    depth = torch.full((1, 1, *scenes.SIZE), 4.0, dtype=torch.float64)
    depth[..., 30:] = 4.25
    image = torch.where(depth == 4.0, 0.3, 0.9)[:, 0]
    gb = ts.GBuffer.from_depth(depth, scenes.camera())
    points, radius = gb.camera.unproject(depth)[:, :, 0], torch.full((1,), 0.5, dtype=torch.float64)
    assert gb.normal is not None
    return worst(denoise_visibility(image, points, gb.normal, gb.valid_mask[:, 0], radius, passes=3) - image)


def hidden_layers(name: str) -> float:
    """Share of a block's obscurance on the wall beside it that is missing where a bar hides it, given as deeper layers."""
    (behind, beside), (bare, _) = (scenes.hidden_block(bar=bar) for bar in (True, False))
    net = make(name, 1.0)
    seen, whole = ((1 - net(gb))[beside].mean() for gb in (behind, bare))
    return float(1 - seen / whole)


def one_api(name: str) -> float:
    """What of the common interface is missing: shape, dtype, range, parameters, copies."""
    gb, net = scenes.steps(), make(name, 0.4, learnable="all")
    image = net(gb, frame=3, backend="auto")
    wrong = [
        image.shape != gb.depth[:, :1].shape,
        image.dtype != gb.depth.dtype,
        type(net) not in ts.modules.TECHNIQUES.values(),
        {n.removeprefix("raw_") for n, _ in net.named_parameters()} != set(net.used_parameters()),
        not torch.equal(net(gb, frame=3), image),
    ]
    return float(sum(wrong))


def derivatives(name: str, gb: ts.GBuffer, dtype: torch.dtype, **changes: Any) -> tuple[Tensor, list[Tensor]]:
    """Image and gradients to depth, normals, camera and every parameter, for a random cotangent."""
    gb = gb.to(dtype)
    depth, fx = gb.depth.clone().requires_grad_(), gb.camera.fx.clone().requires_grad_()
    assert gb.normal is not None
    normal = gb.normal.clone().requires_grad_()
    net = make(name, changes.pop("radius", 0.5), learnable="all", **changes)
    net = net if dtype == torch.float64 else net.float()
    half = dtype in (torch.float16, torch.bfloat16)
    with torch.autocast("cpu", dtype=dtype if half else torch.bfloat16, enabled=half):
        image = net(ts.GBuffer(depth, replace(gb.camera, fx=fx), normal=normal, valid=gb.valid))
        cotangent = torch.randn(image.shape, generator=torch.Generator().manual_seed(3), dtype=image.dtype)
        total = (image * cotangent).sum()
    grads = torch.autograd.grad(total, [depth, normal, fx, *net.parameters()], allow_unused=True)
    return image.detach(), [torch.zeros(()) if grad is None else grad for grad in grads]
