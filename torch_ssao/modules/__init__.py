"""One final nn.Module a technique over one small abstract base."""

from torch_ssao.modules.base import AmbientVisibility as AmbientVisibility
from torch_ssao.modules.base import ParameterSpec as ParameterSpec
from torch_ssao.modules.hbao import HBAO as HBAO
from torch_ssao.modules.ray_march import RayMarchedSSAO as RayMarchedSSAO
from torch_ssao.modules.statvo import StatVO as StatVO

TECHNIQUES: dict[str, type[AmbientVisibility]] = {"statvo": StatVO, "hbao": HBAO, "ray_march": RayMarchedSSAO}
