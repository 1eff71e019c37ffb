"""Fit techniques to references: parameters to R^n, forward-mode Jacobians, optimistix, standard errors."""

from torch_ssao.fitting import candidates as candidates
from torch_ssao.fitting.fit import fit as fit
from torch_ssao.fitting.priors import Prior as Prior
from torch_ssao.fitting.result import FitResult as FitResult
from torch_ssao.fitting.select import select as select
from torch_ssao.fitting.table import Choice as Choice
