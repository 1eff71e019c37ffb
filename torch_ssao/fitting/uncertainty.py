"""How sure a fit is of each parameter."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ssao.fitting.parameters import ParameterSpace

FLAT = 1e-4  # RMSE that a factor e in a direction must at least change, to first order, for the data to determine it
INVOLVED = 0.3  # part of a flat direction from which a parameter counts as being in it


def covariance(jacobian: Tensor, noise: Tensor) -> Tensor:
    """Covariance of the logarithms of the parameters: the sandwich H^-1 (sum_k noise_k^2 j_k j_k') H^-1, H = J'J.

    Args:
        jacobian: (N, P) rows j_k of the weighted residuals.
        noise: (N,) standard deviation of each weighted residual, independent from pixel to pixel.
    Returns: (P, P), by the pseudo-inverse where H is singular.
    Source: delta method for weighted least squares (White 1980 for unequal variances).
    """
    inverse = torch.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    spread = jacobian * noise[:, None]
    return inverse @ (spread.T @ spread) @ inverse


def correlation(covariance: Tensor) -> Tensor:
    """(P, P) correlations of a covariance; nan in the rows and columns of parameters without variance."""
    deviation = covariance.diagonal().clamp(min=0).sqrt()
    known = deviation > 0
    scaled = covariance / torch.where(known, deviation, 1.0)[:, None] / torch.where(known, deviation, 1.0)
    return torch.where(known[:, None] & known, scaled.clamp(-1, 1), torch.nan)


def undetermined(jacobian: Tensor, space: ParameterSpace, log: Tensor) -> tuple[str, ...]:
    """Names of the parameters that lie in a flat direction of the error or at a bound.

    Args:
        jacobian: (N, P) by the logarithms.
        space: the parameters.
        log: (P,) where the fit ended.
    """
    values, directions = torch.linalg.eigh(jacobian.T @ jacobian)
    flat = values.clamp(min=0).sqrt() < FLAT
    involved = (directions[:, flat].abs() > INVOLVED).any(1) | space.at_bound(log).to(flat.device)
    return tuple(name for name, is_flat in zip(space.names, involved.tolist(), strict=True) if is_flat)
