"""One final nn.Module a technique over one small abstract base."""

from torch_ssao.modules.base import AmbientVisibility as AmbientVisibility
from torch_ssao.modules.base import ParameterSpec as ParameterSpec
from torch_ssao.modules.ray_march import RayMarchedSSAO as RayMarchedSSAO
from torch_ssao.modules.statvo import StatVO as StatVO

TECHNIQUES: dict[str, type[AmbientVisibility]] = {"statvo": StatVO, "ray_march": RayMarchedSSAO}
