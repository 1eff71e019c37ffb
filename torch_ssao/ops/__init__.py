"""Functions on tensors: one technique or one primitive a file."""

from torch_ssao.ops.denoise import denoise_visibility as denoise_visibility
from torch_ssao.ops.falloff import attenuation as attenuation
from torch_ssao.ops.falloff import contrast_power as contrast_power
from torch_ssao.ops.falloff import psi as psi
from torch_ssao.ops.horizon import horizon_obscurance as horizon_obscurance
from torch_ssao.ops.horizon_bent import horizon_bent_normal as horizon_bent_normal
from torch_ssao.ops.normals import normals_from_points as normals_from_points
from torch_ssao.ops.partition import adaptive_labels as adaptive_labels
from torch_ssao.ops.partition import uniform_labels as uniform_labels
from torch_ssao.ops.ray_march import ray_march_visibility as ray_march_visibility
from torch_ssao.ops.sampling import poisson_disk as poisson_disk
from torch_ssao.ops.sampling import tiled_noise as tiled_noise
from torch_ssao.ops.sat import Lattice as Lattice
from torch_ssao.ops.sat import box_moments as box_moments
from torch_ssao.ops.sat import cell_sums as cell_sums
from torch_ssao.ops.sat import summed_area_table as summed_area_table
from torch_ssao.ops.statvo import statvo_obscurance as statvo_obscurance
