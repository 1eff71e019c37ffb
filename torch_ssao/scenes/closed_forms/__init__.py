"""Exact visibility of simple scenes: closed forms (or one-dimensional quadratures of them) in numpy float64.

Every function returns visibility in [0, 1] (1 = open) as float64, broadcasts over its array arguments, and takes
    radius: R > 0 in scene units, inf allowed; only occluders nearer than R count.
    falloff: the attenuation W(t), t = distance / R, of an occluder: "binary" 1, "linear" 1 - t, "quadratic" 1 - t^2.
        All are 1 for an infinite radius.
    weighting: "cosine" (the ambient-occlusion integral), "uniform" (share of the hemisphere's solid angle) or, where
        the occluder is a half-space, "volumetric" (free share of the half-ball of radius R; falloff must be "binary").
They raise ChoiceError for unknown names and combinations, RangeError for numbers out of range.

Occlusion is 1 - visibility; for cosine weights it is the configuration factor from the point to the occluder, the area
of the occluder's projection onto the unit disk over pi (Nusselt analog). A falloff is a mixture of binary radii:
occlusion_W(R) = integral over t in [0, 1] of occlusion_binary(t R) (-W'(t)). A point at distance rho lies in an
occluding half-space if and only if its ray has hit the boundary within rho, so volumetric obscurance is uniform
weighting with W(t) = 1 - t^3.

`walls`, `caps` (spheres), `boxes` (pits with flat sides, corners) and `curved` hold the forms; all are names of this package.
"""

from torch_ssao.scenes.closed_forms.boxes import parallel_rectangle as parallel_rectangle
from torch_ssao.scenes.closed_forms.boxes import pit_floor as pit_floor
from torch_ssao.scenes.closed_forms.boxes import pit_wall as pit_wall
from torch_ssao.scenes.closed_forms.boxes import room_corner as room_corner
from torch_ssao.scenes.closed_forms.boxes import trench_floor as trench_floor
from torch_ssao.scenes.closed_forms.boxes import trench_wall as trench_wall
from torch_ssao.scenes.closed_forms.boxes import upright_rectangle as upright_rectangle
from torch_ssao.scenes.closed_forms.caps import sphere as sphere
from torch_ssao.scenes.closed_forms.caps import sphere_on_plane as sphere_on_plane
from torch_ssao.scenes.closed_forms.caps import spherical_cap as spherical_cap
from torch_ssao.scenes.closed_forms.common import FALLOFFS as FALLOFFS
from torch_ssao.scenes.closed_forms.common import WEIGHTINGS as WEIGHTINGS
from torch_ssao.scenes.closed_forms.common import check_question as check_question
from torch_ssao.scenes.closed_forms.curved import bowl as bowl
from torch_ssao.scenes.closed_forms.curved import disk_above as disk_above
from torch_ssao.scenes.closed_forms.curved import lying_cylinder as lying_cylinder
from torch_ssao.scenes.closed_forms.curved import round_pit_floor as round_pit_floor
from torch_ssao.scenes.closed_forms.curved import round_pit_wall as round_pit_wall
from torch_ssao.scenes.closed_forms.walls import ceiling as ceiling
from torch_ssao.scenes.closed_forms.walls import dihedral as dihedral
from torch_ssao.scenes.closed_forms.walls import finite_wall as finite_wall
from torch_ssao.scenes.closed_forms.walls import half_space as half_space
from torch_ssao.scenes.closed_forms.walls import plane as plane
from torch_ssao.scenes.closed_forms.walls import raised_slat as raised_slat
from torch_ssao.scenes.closed_forms.walls import wall as wall
