"""Ray-traced truth: cosine-weighted visibility with a per-pixel standard error, and its files."""

from __future__ import annotations

from torch_ssao.reference.image_files import load_image as load_image
from torch_ssao.reference.raytrace import FALLOFFS as FALLOFFS
from torch_ssao.reference.raytrace import raytrace as raytrace
from torch_ssao.reference.storage import Reference as Reference
from torch_ssao.reference.storage import load as load
from torch_ssao.reference.storage import save as save
