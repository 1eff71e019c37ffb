"""Techniques that others ship, written from their published formulae, to be measured beside this library."""

from benchmarks.peers.bitmask import VisibilityBitmask
from benchmarks.peers.crytek import Crytek
from benchmarks.peers.hbao_plus import HBAOPlus
from benchmarks.peers.line_sampled import LineSampled
from benchmarks.peers.mcguire import SAO, Alchemy
from benchmarks.peers.starcraft import StarCraft
from benchmarks.peers.unreal import UnrealAngle
from benchmarks.peers.xegtao import XeGTAO
from torch_ssao.modules.base import AmbientVisibility

PEERS: dict[str, type[AmbientVisibility]] = {
    "crytek": Crytek,
    "starcraft": StarCraft,
    "line_sampled": LineSampled,
    "alchemy": Alchemy,
    "sao": SAO,
    "hbao_plus": HBAOPlus,
    "unreal": UnrealAngle,
    "bitmask": VisibilityBitmask,
    "xegtao": XeGTAO,
}
