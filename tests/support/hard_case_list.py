"""What people complain of in screen-space ambient occlusion: for each case a figure, its bound, and who misses it.

The tests hold every figure to its bound, or a known failure to the figure measured; `python -m benchmarks.stability`
prints all of them for docs/stability.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch_ssao as ts
from support import hard_case_scenes as scenes
from support import hard_cases as figures
from support.hard_cases import CAPPED, TECHNIQUES


@dataclass(frozen=True)
class HardCase:
    """One figure of one hard case.

    Args:
        number: of the hard case; a case may have several figures.
        title, threads: what goes wrong, and where it was reported.
        figure: from a technique's name; what it says is `meaning`.
        most: its absolute value should not exceed this.
        known: techniques that miss `most`, with the figure measured. Not a licence: a figure that moves fails the test.
        techniques: those that have what the case is about.
        slow: left out of the fast tests.
    """

    number: int
    title: str
    threads: str
    figure: Callable[[str], float]
    meaning: str
    most: float
    known: Mapping[str, float] = field(default_factory=dict)
    techniques: tuple[str, ...] = tuple(TECHNIQUES)
    slow: bool = False

    @property
    def name(self) -> str:
        return self.figure.__name__


_HALO = "o3de/sig-graphics-audio#124, three.js#32200, Nu#691, OloEngineBase#901, PrusaSlicer#2391"
_ORTHO = "three.js#9765, #13286; bevy#13838; Vulkan (Willems)#1250; cuemol2#406; n8ao#33; avogadrolibs#1730"
_NAN = "bevy#8925, #8926; realism-effects#15"
_FACETS = "FlaxEngine#3617, godot#8237, three.js#6446, #8576; Babylon.js#13621, #13652; AmnesiaTDD#39, QGIS#49702, filament#4411"
_BORDER = "MiniEngineAO#6, godot#9678, molstar#1740, WickedEngine#926"
_COST = "DiligentFX#101; Nu#498, #975; cubos#1537, godot#17568, AcerolaFX#19, n8ao#7"
_NOISE = "godot#110997, three.js#33663, sbox-public#10611, RBDOOM#744"
_SKY = "WickedEngine#639, OurMachinery#1008, sbox-issues#5863"

CASES = (
    HardCase(
        *(1, "Halo: a wall 2 to 5 R behind a pillar", _HALO, figures.halo),
        meaning="largest obscurance of the wall",
        most=1e-3,
        known={"march-solid": 0.398},
    ),
    HardCase(
        *(1, "Halo: a wall 1.2 R behind a pillar", _HALO, figures.near_halo),
        meaning="largest obscurance of the wall",
        most=1e-3,
        known={"statvo": 0.377, "bitmask": 0.32, "march": 0.0416, "march-solid": 0.396},
    ),
    HardCase(
        *(1, "Thin occluders: a slat 0.3 R over a floor, defaults", _HALO, figures.under_slat),
        meaning="mean error on the floor beside it",
        most=0.05,
        known={"bitmask": -0.148, "increments": -0.133, "march": -0.121, "march-solid": -0.147},
        techniques=CAPPED,
    ),
    HardCase(
        *(1, "The same with a thickness of 0.05 R and many taps", _HALO, figures.thin_occluder),
        meaning="mean error on the floor beside it",
        most=0.02,
        known={"increments": 0.0463},
        techniques=("bitmask", "increments", "march"),
    ),
    HardCase(
        *(2, "Dark rims: a sphere before a far plane", "three.js#33663, godot#107011", figures.rims),
        meaning="largest change that the plane makes within 3 px of the outline",
        most=1e-3,
        known={"march-solid": 0.335},
    ),
    HardCase(
        *(
            3,
            "Over-darkening with distance: scene and R times 1e-3, 10, 1e6",
            "ShaderInjector#79, n8ao#14",
            figures.scale,
        ),
        meaning="change at the 99.9th percentile, float32",
        most=1e-4,
    ),
    HardCase(
        4,
        "Half resolution, even and odd sizes",
        "godot#62881, #59471; playcanvas#9112; molstar#386, #1356; n8ao#9, #16, #50; three.js#33914",
        figures.half_resolution,
        meaning="mean difference to full resolution at the same points",
        most=0.02,
    ),
    HardCase(
        *(5, "Orthographic: planes at 0 to 80 degrees", _ORTHO, figures.orthographic_planes),
        meaning="largest obscurance",
        most=1e-5,
    ),
    HardCase(
        *(5, "Orthographic: the floor before a wall", _ORTHO, figures.orthographic_wall),
        meaning="largest change of a band's mean against 10 degrees of view",
        most=0.02,
    ),
    HardCase(
        *(6, "Field of view, 10 to 120 degrees, before a wall", "Unity PostProcessing#438, MetaHookSv#42"),
        figure=figures.field_of_view,
        meaning="largest deviation of a band's mean from its mean over the views",
        most=0.02,
        known={"statvo": 0.0306},
    ),
    HardCase(
        *(7, "Depth buffers: four conventions and logarithmic, float32", "n8ao#37, #43; three.js#10199, #32773"),
        figure=figures.depth_buffers,
        meaning="change at the 99th percentile",
        most=1e-3,
    ),
    HardCase(
        8,
        "Far precision: a 60 degree plane at 1e4, 24 bits over 2e4, R = 20 px",
        "godot#53784, #34580; WickedEngine#31, n8ao#42; three.js#11488, #17865; B3DFramework#318, fs2open#7245",
        figures.far_precision,
        meaning="largest obscurance, with given and with estimated normals",
        most=1e-2,
    ),
    HardCase(
        *(9, "Sky over a floor, to 88.7 degrees; its depth unread, its gradient 0", _SKY, figures.sky),
        meaning="largest obscurance of the floor",
        most=1e-5,
    ),
    HardCase(
        *(9, "Sky over a floor: the row beyond 89 degrees, R below a pixel", _SKY, figures.horizon_row),
        meaning="largest obscurance of the floor",
        most=1e-2,
    ),
    HardCase(
        *(10, "NaN, infinite, zero, negative depth; NaN, infinite, zero, overlong normals", _NAN, figures.damage),
        meaning="values outside [0, 1] and derivatives that are not finite",
        most=0,
    ),
    HardCase(
        *(10, "Normals of length 0.8 and 1.25", _NAN, figures.normal_length),
        meaning="largest change",
        most=1e-3,
    ),
    HardCase(
        *(10, "Valid depths of 3e38 and 1e-20 in float32", _NAN, figures.absurd_depths),
        meaning="values outside [0, 1] and derivatives that are not finite",
        most=0,
    ),
    HardCase(
        *(11, "Grazing planes, 1 to 85 degrees, 24-bit depth, exact normals", _FACETS, figures.grazing_planes),
        meaning="largest obscurance",
        most=1e-3,
    ),
    HardCase(
        *(11, "The same with normals estimated from the depth", _FACETS, figures.estimated_normals),
        meaning="largest obscurance",
        most=1e-3,
    ),
    HardCase(
        *(11, "Facets: a convex prism of 24 sides with the cylinder's normals", _FACETS, figures.smooth_facets),
        meaning="mean obscurance within 60 degrees of the front",
        most=0.01,
    ),
    HardCase(
        *(12, "Crop of a larger image, away from the cut (3.3 R)", _BORDER, figures.crop_inside),
        meaning="change at the 99th percentile",
        most=1e-5,
    ),
    HardCase(
        *(12, "Crop of a larger image, within R of the cut", _BORDER, figures.crop_border),
        meaning="mean change",
        most=0.01,
    ),
    HardCase(
        *(13, "Cost near the camera: R times 1000, capped to 16 px where there is a cap", _COST, figures.cost),
        meaning="ratio of the times",
        most=2.0,
        slow=True,
    ),
    HardCase(
        *(13, "What the cap does: caps of 8, 16 and 32 px, R spans 60 to 160", _COST, figures.reach),
        meaning="largest mean change against no cap",
        most=0.02,
        techniques=CAPPED,
    ),
    HardCase(
        *(14, "Parameters relative to R: as 3, all parameters off their defaults, float64"),
        "realism-effects#30, godot-proposals#8816, DiligentFX#121, pex-renderer#94",
        figures.relative_parameters,
        meaning="largest change",
        most=1e-6,
    ),
    HardCase(
        *(15, "Alpha: masked leaves before a plane, their depth unread"),
        "sbox#5690, #6429; bevy#25358, decentraland#4698",
        figures.alpha_mask,
        meaning="largest obscurance of the plane",
        most=1e-5,
    ),
    HardCase(
        *(16, "The same input twice, two places in a batch, the global generator untouched", _NOISE, figures.repeats),
        meaning="largest change, float32",
        most=1e-5,
    ),
    HardCase(
        *(16, "Noise left in a single frame after two denoising passes", _NOISE, figures.noise),
        meaning="standard deviation between frames",
        most=0.03,
    ),
    HardCase(
        *(
            17,
            "Dependence on the number of samples: defaults against many more",
            "three.js#31839",
            figures.sample_count,
        ),
        meaning="mean change",
        most=0.02,
    ),
    HardCase(
        *(18, "Weighting: cosine and uniform closed forms of a wall", "three.js#27185, bevy#7402", figures.weighting),
        meaning="mean error",
        most=5e-3,
        techniques=("bitmask", "increments", "march-solid"),
    ),
    HardCase(
        *(19, "Blur over edges: two planes R/2 apart, three passes", "xeokit-sdk#594, ASSAO", figures.denoised_edge),
        meaning="largest change of the planes' values",
        most=1e-3,
        techniques=CAPPED,
    ),
    HardCase(
        *(20, "A block that only a deeper depth layer holds", "XeGTAO, G3D depth peeling", figures.hidden_layers),
        meaning="share of its obscurance that is missing",
        most=0.7,
        known={"bitmask": 1.0, "increments": 1.0},
    ),
    HardCase(
        *(21, "One interface for all techniques", "ASSAO#6, three.js#29668, r3d#277", figures.one_api),
        meaning="parts of it that are missing",
        most=0,
    ),
)

# Scenes of the cases, with a radius: nothing may be infinite or NaN on any of them, in any precision.
SCENES: dict[str, tuple[Callable[[], ts.GBuffer], float]] = {
    "pillar": (lambda: scenes.pillar(1.2), 1.0),
    "ball": (lambda: scenes.ball(plane=True), 0.5),
    "tiny": (lambda: scenes.scaled(scenes.steps(), 1e-3), 0.4e-3),
    "huge": (lambda: scenes.scaled(scenes.steps(), 1e4), 0.4e4),
    "enormous": (lambda: scenes.scaled(scenes.steps(), 1e6), 0.4e6),
    "orthographic": (lambda: scenes.wall(orthographic=True), 0.5),
    "wide": (lambda: scenes.wall(120.0), 0.5),
    "far plane": (lambda: scenes.far_plane(normals=True), 750.0),
    "horizon": (lambda: scenes.horizon(limit=100.0), 0.5),
    "damaged": (scenes.damaged, 0.5),
    "absurd": (scenes.absurd, 0.5),
    "grazing": (lambda: scenes.quantised_plane(85.0), 0.5),
    "facets": (scenes.facets, 0.5),
    "near": (scenes.steps, 400.0),
    "foliage": (lambda: scenes.foliage()[0], 0.5),
    "layers": (lambda: scenes.hidden_block(bar=True)[0], 1.0),
    "temple": (scenes.temple, 0.8),
}
