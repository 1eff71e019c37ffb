"""Scenes whose G-buffers and visibility are exact: test suite, benchmark and calibration in one.

World space has z up; the floor is z = 0, walls stand on the y axis and look along +x. `planes`, `round` and `pits` build
scenes out of `torch_ssao.scenes.primitives`; the formulae are in `torch_ssao.scenes.closed_forms`.
"""

from torch_ssao.scenes.analytic.pits import rectangular_pit as rectangular_pit
from torch_ssao.scenes.analytic.pits import round_pit as round_pit
from torch_ssao.scenes.analytic.pits import spherical_bowl as spherical_bowl
from torch_ssao.scenes.analytic.pits import trench as trench
from torch_ssao.scenes.analytic.planes import ceiling as ceiling
from torch_ssao.scenes.analytic.planes import dihedral as dihedral
from torch_ssao.scenes.analytic.planes import finite_wall as finite_wall
from torch_ssao.scenes.analytic.planes import plane as plane
from torch_ssao.scenes.analytic.planes import raised_slat as raised_slat
from torch_ssao.scenes.analytic.planes import room_corner as room_corner
from torch_ssao.scenes.analytic.planes import wall as wall
from torch_ssao.scenes.analytic.round import disk_over_plane as disk_over_plane
from torch_ssao.scenes.analytic.round import lying_cylinder as lying_cylinder
from torch_ssao.scenes.analytic.round import sphere_on_plane as sphere_on_plane
from torch_ssao.scenes.analytic.scene import AnalyticScene as AnalyticScene
from torch_ssao.scenes.analytic.scene import ClosedForm as ClosedForm
from torch_ssao.scenes.analytic.scene import Question as Question
from torch_ssao.scenes.primitives import Annulus as Annulus
from torch_ssao.scenes.primitives import Cylinder as Cylinder
from torch_ssao.scenes.primitives import Patch as Patch
from torch_ssao.scenes.primitives import Sphere as Sphere
